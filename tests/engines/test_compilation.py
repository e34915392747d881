"""When loops are compiled, which kernels are shared, and life without a compiler."""

import logging
import os
import subprocess
import sys

import pytest
import torch

from npdr_ppl.engines.common import compilation
from npdr_ppl.engines.common.compilation import (
    has_compiler,
    is_worthwhile,
    signature,
    steps_per_call,
)
from npdr_ppl.errors import CompilationError, DependencyError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import ActuatorLag, CoulombFriction, InputDelay, SensorLowPass
from npdr_ppl.models.furuta import Furuta, SwingUpReward
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.linear import Linear
from npdr_ppl.policies.neural import Neural

CPU = torch.device("cpu")

needs_compiler = pytest.mark.skipif(not has_compiler("cpu"), reason="there is no C++ compiler")


def test_equal_simulators_share_a_kernel():
    friction = CoulombFriction("arm")
    assert signature(Furuta()) == signature(Furuta(compile="always"))
    assert signature(Furuta().with_effects(friction)) == signature(
        Furuta().with_effects(CoulombFriction("arm"))
    )
    assert signature(SwingUpReward()) == signature(SwingUpReward())
    different = [
        Furuta(),
        Furuta(integrator="rk4"),
        Furuta(substeps=2),
        Furuta().with_effects(friction),
        Furuta().with_effects(CoulombFriction("pole")),
        Pendulum(),
        SwingUpReward(),
        SwingUpReward(arm_angle_weight=1.0),
    ]
    assert len({signature(thing) for thing in different}) == len(different)


def test_tensors_and_functions_count_by_identity():
    one, other = torch.zeros(2), torch.zeros(2)
    assert signature({"x": one}) == signature({"x": one})
    assert signature({"x": one}) != signature({"x": other})
    assert signature(len) != signature(max)


def test_policies_that_differ_in_their_default_weights_share_a_kernel():
    def neural(**options):
        return Neural(("angle", "velocity"), ("torque",), [(-1.0, 1.0)], **options)

    assert signature(neural(seed=0)) == signature(neural(seed=1))
    assert signature(neural(hidden=(8,))) != signature(neural(hidden=(4,)))


def test_small_computations_are_not_compiled():
    assert not is_worthwhile("auto", CPU, num_steps=1_000, batch_size=1_000)
    assert not is_worthwhile("never", CPU, num_steps=10**6, batch_size=10**6)


@needs_compiler
def test_many_time_steps_many_simulations_and_many_calls_each_make_a_computation_large():
    assert is_worthwhile("auto", CPU, num_steps=10**6, batch_size=1)
    assert is_worthwhile("auto", CPU, num_steps=100, batch_size=10**8)
    assert is_worthwhile("auto", CPU, num_steps=1_000, batch_size=1_000, expected_calls=10**3)
    assert is_worthwhile("always", CPU, num_steps=1, batch_size=1)


def test_a_call_takes_as_many_steps_as_its_use_is_long():
    sizes = {"num_steps": 2_500, "batch_size": 600}
    taken = [steps_per_call(**sizes, expected_calls=n) for n in (1, 10**2, 10**3, 10**5)]
    assert taken == sorted(taken)
    assert (taken[0], taken[-1]) == (2, 10)


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    has_compiler.cache_clear()
    compilation._log_once.cache_clear()
    yield
    has_compiler.cache_clear()


def test_without_a_compiler_large_computations_run_eagerly_and_say_so_once(no_compiler, caplog):
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert not is_worthwhile("auto", CPU, num_steps=10**6, batch_size=10**6)
    assert [record.message for record in caplog.records] == [
        "There is no compiler, so time loops run eagerly, about ten times slower."
    ]
    with pytest.raises(DependencyError, match="needs a C\\+\\+ compiler"):
        is_worthwhile("always", CPU, num_steps=1, batch_size=1)


class BranchingPendulum(Pendulum):
    """Decides on a value of the state, which eager code may and compiled code may not."""

    def accelerations(self, positions, velocities, actions, forces, constants):
        if float(positions[0].detach().abs().max()) > 1e6:
            forces = (0.0,)
        return super().accelerations(positions, velocities, actions, forces, constants)


@pytest.fixture
def eager_to_compile(monkeypatch):
    monkeypatch.setattr(compilation, "_COMPILE_SECONDS", 0.0)
    compilation._log_once.cache_clear()
    compilation._compile.cache_clear()


def replay(simulator):
    inputs = Inputs(
        actions=torch.ones(2, 25, 1),
        action_names=("torque",),
        initial_readings=torch.zeros(2, 2),
        initial_values=torch.zeros(2, 2),
        initial_rates=None,
        channel_names=("angle", "velocity"),
        past_actions=torch.zeros(2, 0, 1),
        time_step=0.02,
        mask=torch.ones(2, 25, dtype=torch.bool),
        rollout=torch.zeros(2, dtype=torch.long),
        start=torch.tensor([0, 25]),
    )
    return simulator.simulate({}, inputs)


def angle(positions, velocities, commands):
    return positions[0]


def roll_out(simulator):
    policy = Linear(("angle", "velocity"), ("torque",))
    # The same function each time, for functions count by identity.
    episodes = simulator.roll_out({}, policy, torch.ones(3, 2), 25, reward=angle)
    return episodes.returns


@needs_compiler
@pytest.mark.parametrize("run", [replay, roll_out])
def test_what_cannot_be_traced_runs_eagerly_and_says_so_once(run, eager_to_compile, caplog):
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            torch.testing.assert_close(run(BranchingPendulum()), run(Pendulum(compile="never")))
    (message,) = [r.message for r in caplog.records if r.name == compilation.__name__]
    assert message.startswith("Torch could not compile a time loop: ")
    assert message.endswith("It runs eagerly instead, about ten times slower.")
    assert "\n" not in message
    with pytest.raises(CompilationError, match="Torch could not compile a time loop: "):
        run(BranchingPendulum(compile="always"))


REFUSAL = """
import logging, sys
import torch
from npdr_ppl.engines.common import compilation
from npdr_ppl.errors import CompilationError
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.linear import Linear

messages, log = [], sys.argv[1]
handler = logging.Handler()
handler.emit = lambda record: messages.append(record.getMessage())
logging.getLogger(compilation.__name__).addHandler(handler)
compilation._COMPILE_SECONDS = 0.0

def angle(positions, velocities, commands):
    return positions[0]

def roll_out(simulator):
    policy = Linear(("angle", "velocity"), ("torque",))
    return simulator.roll_out({}, policy, torch.ones(3, 2), 25, reward=angle).returns

returns = roll_out(Pendulum())
assert torch.allclose(returns, roll_out(Pendulum(compile="never")))
(message,) = messages
assert message.endswith("about ten times slower."), message
refused = open(log).read()
assert refused
roll_out(Pendulum())
assert open(log).read() == refused, "it has tried again"
try:
    roll_out(Pendulum(compile="always"))
except CompilationError as error:
    assert "refused" in str(error), error
else:
    raise AssertionError("compile='always' ran eagerly")
"""


@pytest.mark.slow
@needs_compiler
def test_code_that_the_compiler_refuses_runs_eagerly(tmp_path):
    """In a process of its own, because torch remembers its compiler in many places."""
    log = tmp_path / "calls"
    compiler = tmp_path / "g++"
    compiler.write_text(
        "#!/bin/sh\n"
        'case "$*" in *--version*) exec g++ --version;; esac\n'
        f"echo refused | tee -a '{log}' >&2\n"
        "exit 1\n"
    )
    compiler.chmod(0o755)
    found = subprocess.run(
        [sys.executable, "-c", REFUSAL, str(log)],
        env=os.environ | {"CXX": str(compiler), "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "c")},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.slow
@needs_compiler
@pytest.mark.usefixtures("short_kernels")
def test_a_loop_with_a_filter_compiles_one_kernel():
    filtered = Pendulum(compile="always").with_effects(SensorLowPass("velocity"))
    time_constant = {"velocity.sensor_low_pass.time_constant": torch.full((3,), 0.05)}
    policy = Linear(("angle", "velocity"), ("torque",))
    graphs = torch._dynamo.utils.counters["stats"]
    before = graphs["unique_graphs"]
    filtered.roll_out(time_constant, policy, torch.tensor([[0.1, 0.0]]), 11)
    assert graphs["unique_graphs"] == before + 1


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:The .grad attribute:UserWarning"
)  # torch's compiler, of itself
@needs_compiler
@pytest.mark.usefixtures("short_kernels")
def test_compiled_replay_agrees_with_the_eager_one_and_has_its_gradients():
    attached = (
        ActuatorLag("torque"),
        InputDelay("torque"),
        CoulombFriction("hinge"),
        SensorLowPass("velocity"),
    )
    generator = torch.Generator().manual_seed(0)

    def run(mode, num_draws, num_segments):
        states = torch.randn(num_segments, 2, generator=generator.manual_seed(1)).double()
        inputs = Inputs(
            actions=3.0 * torch.randn(num_segments, 33, 1, generator=generator).double(),
            action_names=("torque",),
            initial_readings=states + 0.1,
            initial_values=states,
            initial_rates=None,
            channel_names=("angle", "velocity"),
            past_actions=torch.randn(num_segments, 4, 1, generator=generator).double(),
            time_step=0.02,
            mask=torch.ones(num_segments, 33, dtype=torch.bool),
            rollout=torch.zeros(num_segments, dtype=torch.long),
            start=33 * torch.arange(num_segments),
        )
        given = {
            "mass": torch.linspace(0.5, 1.5, num_draws, dtype=torch.float64),
            "torque.actuator_lag.time_constant": torch.tensor(0.03, dtype=torch.float64),
            "torque.input_delay.delay": torch.tensor(0.047, dtype=torch.float64),
            "hinge.coulomb_friction.magnitude": torch.tensor(0.2, dtype=torch.float64),
            "velocity.sensor_low_pass.time_constant": torch.tensor(0.01, dtype=torch.float64),
        }
        for value in given.values():
            value.requires_grad_()
        out = Pendulum(compile=mode).with_effects(*attached).simulate(given, inputs)
        return out, torch.autograd.grad(out.square().sum(), list(given.values()))

    for sizes in ((3, 2), (4, 3)):  # another size does not compile anew
        eager, eager_gradients = run("never", *sizes)
        fast, fast_gradients = run("always", *sizes)
        torch.testing.assert_close(fast, eager, rtol=1e-9, atol=1e-11)
        torch.testing.assert_close(fast_gradients, eager_gradients, rtol=1e-7, atol=1e-9)


def test_only_options_that_torch_has_are_passed(monkeypatch):
    assert set(compilation._recompile_options()) <= {"recompile_limit", "isolate_recompiles"}
    monkeypatch.setattr(torch, "compile", lambda function, *, fullgraph, options: function)
    assert compilation._recompile_options() == {}
