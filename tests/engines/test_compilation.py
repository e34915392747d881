"""When loops are compiled, which kernels are shared, and life without a compiler."""

import logging

import pytest
import torch

from npdr_ppl.engines import compilation
from npdr_ppl.engines.compilation import has_compiler, is_worthwhile, signature
from npdr_ppl.errors import DependencyError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import ActuatorLag, CoulombFriction, InputDelay, SensorLowPass
from npdr_ppl.models.furuta import Furuta, SwingUpReward
from npdr_ppl.models.pendulum import Pendulum

CPU = torch.device("cpu")


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


def test_small_computations_are_not_compiled():
    assert not is_worthwhile("auto", 1_000_000, CPU)
    assert not is_worthwhile("never", 10**12, CPU)


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    has_compiler.cache_clear()
    compilation._log_once.cache_clear()
    yield
    has_compiler.cache_clear()


def test_without_a_compiler_large_computations_run_eagerly_and_say_so_once(no_compiler, caplog):
    with caplog.at_level(logging.WARNING):
        assert not is_worthwhile("auto", 10**12, CPU)
        assert not is_worthwhile("auto", 10**12, CPU)
    assert [record.message for record in caplog.records] == [
        "There is no compiler, so time loops run eagerly, about ten times slower."
    ]
    with pytest.raises(DependencyError, match="needs a C\\+\\+ compiler"):
        is_worthwhile("always", 1, CPU)


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:The .grad attribute:UserWarning"
)  # torch's compiler, of itself
@pytest.mark.skipif(not has_compiler("cpu"), reason="there is no C++ compiler")
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
