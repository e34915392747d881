"""Simulators, effects, policies and fits give the same results on a GPU as on the CPU."""

import pytest
import torch
from torch.torch_version import TorchVersion

import npdr_ppl as npdr
from npdr_ppl.engines.common.compilation import has_compiler
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.effects import Backlash, CoulombFriction, SensorDelay, candidate_effects
from npdr_ppl.models.furuta import Furuta, SwingUpReward, initial_states
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp
from npdr_ppl.posterior.posterior import Posterior
from tests.models.test_effects import draws, some_inputs

DEVICE = "cuda"

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")

compiles = pytest.mark.skipif(
    not has_compiler("cuda") or TorchVersion(torch.__version__) < (2, 13),
    reason="needs Triton, and torch 2.11 cannot compile generators over named tuples",
)

NUM_DRAWS = 1_000


def on_device(parameters):
    return {name: value.to(DEVICE) for name, value in parameters.items()}


def both(simulator, parameters, inputs):
    """Results of the CPU and of the GPU; the latter must have stayed there."""
    there = simulator.simulate(on_device(parameters), inputs.to(device=DEVICE))
    assert there.device.type == DEVICE
    return simulator.simulate(parameters, inputs), there.cpu()


@pytest.mark.parametrize("effect", candidate_effects(Furuta()), ids=lambda effect: effect.name)
def test_effects(effect):
    simulator = Furuta(compile="never").with_effects(effect)
    parameters = draws(effect, simulator.port(effect.port), 4)
    here, there = both(simulator, parameters, some_inputs(Furuta, num_steps=20))
    # Friction and play switch, and rounding decides at which of two steps.
    is_close = torch.isclose(there, here, rtol=1e-8, atol=1e-9).flatten(1).all(1)
    assert is_close.float().mean() >= 0.75


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # torch's compiler, of itself
@compiles
@pytest.mark.usefixtures("short_kernels")
def test_compiled_loops():
    attached = SensorDelay("arm_velocity"), Backlash("arm"), CoulombFriction("pole")
    simulator = Furuta(compile="always").with_effects(*attached)
    parameters = {"pole_mass": torch.tensor([0.02, 0.024, 0.03], dtype=torch.float64)}
    for effect in attached:
        probe = effect.probe(Furuta().port(effect.port)).items()
        parameters |= {f"{effect.name}.{n}": torch.tensor(v).double() for n, v in probe}
    inputs = some_inputs(Furuta, num_steps=30)
    there = simulator.simulate(on_device(parameters), inputs.to(device=DEVICE)).cpu()
    eager = Furuta(compile="never").with_effects(*attached).simulate(parameters, inputs)
    torch.testing.assert_close(there, eager, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("mode", ["never", pytest.param("always", marks=compiles)])
@pytest.mark.filterwarnings("ignore")  # torch's compiler, of itself
def test_closed_loop(mode):
    policy = FurutaSwingUp()
    gains = policy.parameters.double() * torch.linspace(0.9, 1.1, 5)[:, None].double()
    states = initial_states(3, torch.Generator().manual_seed(0)).double()
    returns = []
    for device in ("cpu", DEVICE):
        out = Furuta().roll_out(
            {"pole_mass": torch.tensor([0.02, 0.03], device=device)[:, None, None]},
            policy.with_parameters(gains[:, None].to(device)),
            states.to(device),
            100,
            reward=SwingUpReward(),
            compile=mode if device == DEVICE else "never",
        )
        assert out.returns.device.type == device
        returns.append(out.returns.cpu())
    torch.testing.assert_close(*returns, rtol=1e-6, atol=1e-6)


def test_mujoco_returns_its_result_on_the_device_of_the_inputs():
    rig = npdr.MujocoSimulator(FurutaRig().model(), {"payload": "body pole mass"})
    inputs = npdr.Inputs.single(
        torch.ones(10, len(rig.actions), dtype=torch.float64),
        torch.zeros(len(rig.states)),
        action_names=tuple(action.name for action in rig.actions),
        state_names=tuple(state.name for state in rig.states),
        time_step=rig.time_step,
    )
    here, there = both(rig, {"payload": torch.tensor([0.02, 0.03])}, inputs)
    assert torch.equal(here, there)


@pytest.mark.slow
def test_a_saved_fit_has_the_same_density_on_both_devices(
    noisy_pendulum, recording, quick, tmp_path
):
    posterior = npdr.infer(
        noisy_pendulum,
        recording,
        backend=quick,
        num_simulations=500,
        device=DEVICE,
        corrects=False,
        progress=False,
    )
    posterior.save(tmp_path / "fit")
    z = posterior.sample_reference(NUM_DRAWS).flatten(0, -2)
    assert z.device.type == "cpu"
    here, there = (
        Posterior.load(tmp_path / "fit", model=noisy_pendulum, device=device).densities
        for device in ("cpu", DEVICE)
    )
    for density, other in zip(here, there, strict=True):
        expected = density.log_prob(z)
        torch.testing.assert_close(other.log_prob(z).cpu(), expected, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_a_fit_with_effects_is_corrected_on_the_device(noisy_pendulum, recording, quick):
    model = npdr.add_effect(noisy_pendulum, CoulombFriction("hinge"))
    posterior = npdr.infer(
        model,
        recording,
        backend=quick,
        rounds=2,
        num_simulations=500,
        device=DEVICE,
        progress=False,
    )
    assert all(value.isfinite().all() for value in posterior.sample(100).values())
    assert npdr.diagnose(posterior.to_arviz(100)).decision


@pytest.mark.slow
def test_a_trained_embedding(noisy_pendulum, recording):
    tiny = backend("snpe-c", transforms=1, hidden=(16,), epochs=2, members=1)
    posterior = npdr.infer(
        noisy_pendulum,
        recording,
        backend=tiny,
        num_simulations=50,
        options=npdr.DataOptions(embedding="gru/10"),
        device=DEVICE,
        progress=False,
    )
    assert posterior.sample(10)["mass"].isfinite().all()
