"""PooledSimulator: batches, plates, seeds and effects around an engine of one simulation."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.cli import main as cli
from npdr_ppl.errors import SimulationError
from npdr_ppl.inference.registry import backend
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects.actuation import InputDelay
from npdr_ppl.rollouts import Rollouts
from tests.helpers.bullet_models import PendulumModel, bullet_pendulum, pendulum_urdf
from tests.helpers.faulty import FaultRates
from tests.helpers.faulty_simulator import FaultMessenger
from tests.helpers.pooled_models import Drift


@pytest.fixture(scope="module", autouse=True)
def one_worker():
    """Keeps one process for all tests that do not ask for others."""
    with npdr.workers("serial") as used:
        yield used


def inputs(actions):
    single = Inputs.single(
        actions, torch.zeros(1, dtype=torch.float64), action_names=("push",),
        state_names=("level",), time_step=0.1, history=3,
    )  # fmt: skip
    return single


@pytest.mark.slow
def test_every_element_of_a_batch_gets_its_own_parameters_and_inputs():
    actions = torch.randn(2, 1, 5, 1, generator=torch.Generator().manual_seed(0)).double()
    single = inputs(actions[0, 0])
    readings = torch.tensor([[[0.5]], [[-0.5]]], dtype=torch.float64)
    batched = replace(
        single, actions=actions, initial_readings=readings, initial_values=readings,
        past_actions=torch.zeros(2, 1, 3, 1, dtype=torch.float64),
    )  # fmt: skip
    gain = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
    found = Drift(noise=0.0).simulate({"gain": gain}, batched)
    expected = readings[..., None, :] + gain[..., None, None, None] * actions.cumsum(-2)
    torch.testing.assert_close(found, expected)


@pytest.mark.slow
def test_random_simulators_follow_the_global_seed_and_nothing_else():
    simulator = Drift(noise=1.0)
    given = inputs(torch.zeros(4, 1, dtype=torch.float64))
    gain = {"gain": torch.ones(6, dtype=torch.float64)}

    def simulate(seed):
        torch.manual_seed(seed)
        return simulator.simulate(gain, given), simulator.simulate(gain, given)

    first, second = simulate(1)
    assert not torch.equal(first, second)
    assert not torch.equal(first[0], first[1])
    with npdr.workers("threads", num_workers=2, chunk_size=1):
        again = simulate(1)
    assert torch.equal(first, again[0]) and torch.equal(second, again[1])
    assert not torch.equal(first, simulate(2)[0])


def test_action_effects_look_into_the_past():
    actions = torch.arange(1.0, 6.0, dtype=torch.float64)[:, None]
    given = inputs(actions)
    given = replace(given, past_actions=given.past_actions + 10.0, start=given.start + 7)
    delayed = Drift(noise=0.0).with_effects(InputDelay("push"))
    delay = {"push.input_delay.delay": torch.tensor([0.0, 0.2], dtype=torch.float64)}
    level = delayed.simulate(delay, given)[..., 0]
    torch.testing.assert_close(level[0, 0], actions[:, 0].cumsum(0))
    torch.testing.assert_close(
        level[1, 0], torch.tensor([10.0, 10.0, 1.0, 2.0, 3.0], dtype=torch.float64).cumsum(0)
    )


def test_a_wrong_shape_is_one_sentence():
    with pytest.raises(SimulationError, match=r"\(4, 2\); expected \(4, 1\)"):
        Drift(noise=0.0, columns=2).simulate({}, inputs(torch.zeros(4, 1)))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording by the Bullet pendulum itself, with mass 1.1 kg, damping 0.15 and some noise."""
    folder = tmp_path_factory.mktemp("recording")
    simulator = bullet_pendulum(pendulum_urdf(folder))
    time = 0.02 * torch.arange(80, dtype=torch.float64)
    given = Inputs.single(
        (4.0 * torch.sin(5.0 * time))[:, None], torch.tensor([0.2, 0.0]).double(),
        action_names=("torque",), state_names=("angle", "velocity"), time_step=0.02,
    )  # fmt: skip
    true = {"mass": torch.tensor(1.1).double(), "damping": torch.tensor(0.15).double()}
    after = simulator.simulate(true, given)[0]
    readings = torch.cat((given.initial_values, after))
    noise = torch.randn(readings.shape, generator=torch.Generator().manual_seed(3))
    readings = readings + noise * torch.tensor([0.005, 0.03])
    rollouts = Rollouts.from_arrays(
        readings=[readings.numpy()], actions=[given.actions[0].numpy()],
        channel_names=("angle", "velocity"), action_names=("torque",), time_step=0.02,
    )  # fmt: skip
    rollouts.to_csv(folder / "recording.csv")
    return folder, rollouts


@pytest.mark.slow
def test_inference_survives_faults_and_reports_them(recording, tmp_path):
    folder, rollouts = recording
    model = PendulumModel(folder / "pendulum.urdf")
    log = tmp_path / "faults"
    log.mkdir()
    options = {
        "backend": backend("snpe-c", members=1), "num_simulations": 300,
        "options": npdr.DataOptions("all/10", None, "recorded"), "seed": 1, "progress": False,
    }  # fmt: skip
    with npdr.workers("threads", 2, time_limit=3.0) as used:
        clean = npdr.infer(model, rollouts, **options)
        faulty = FaultMessenger(FaultRates(0.02, 0.005, 0.03), log)(model)
        cured = npdr.infer(faulty, rollouts, checkpoint=tmp_path / "run", **options)
        resumed = npdr.infer(faulty, rollouts, checkpoint=tmp_path / "run", **options)
        assert used.is_used and used.faults
    assert clean.provenance.faults == {
        "draws": 300, "crashed": 0, "hung": 0, "nan": 0, "raised": 0, "retried": 0, "lost": 0
    }  # fmt: skip
    counts = cured.provenance.faults
    assert resumed.provenance.faults == counts
    assert counts["crashed"] and counts["nan"]
    assert counts["lost"] == 0
    # Every fault was cured by its retry, so inference saw the very same simulations.
    assert cured.most_likely(seed=0) == clean.most_likely(seed=0)
    assert abs(float(clean.most_likely(seed=0)["mass"]) - 1.1) < 0.1


MODEL_FILE = """
import pyro, pyro.distributions as dist
import npdr_ppl as npdr
from tests.helpers.bullet_models import SENSORS, TORQUE
from npdr_ppl.engines.bullet import BulletSettings, BulletSimulator, Urdf

def build(client, parameters):
    # Defined in this file, which no worker can import.
    return Urdf({urdf!r})(client, parameters)

def model(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
    simulator = BulletSimulator(
        build, parameters={{"mass": "link rod mass"}}, actions=(TORQUE,), sensors=SENSORS,
        settings=BulletSettings(time_step=0.02),
    )
    return npdr.simulate("trajectory", simulator, {{"mass": mass}}, inputs)
"""


@pytest.mark.slow
def test_the_command_line_chooses_workers(monkeypatch, capsys, recording, tmp_path):
    folder, _ = recording
    file = tmp_path / "own.py"
    urdf = str(folder / "pendulum.urdf")
    file.write_text(MODEL_FILE.format(urdf=urdf))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))

    def fit(model, *words):
        out = tmp_path / f"fit-{len(list(tmp_path.iterdir()))}"
        command = [
            "npdr", "fit", str(model), "--data", str(folder / "recording.csv"), "--out", str(out),
            "--rounds", "1", "--simulations", "40", "--embedding", "all/20", "--backend", "abc",
            "--quiet", "--segment-length", "0", "--initial-state", "estimated", *words,
        ]  # fmt: skip
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit) as stop:
            cli.main()
        return stop.value.code or 0, out, capsys.readouterr().err

    code, out, errors = fit(f"{file}:model", "--executor", "threads", "--workers", "2")
    assert code == 0, errors
    assert "no effect" not in errors
    written = json.loads((out / "fit.json").read_text())
    assert written["engine"]["trajectory"]["solver_iterations"] == 50
    faults = written["faults"]
    assert faults["draws"] >= 40 and faults["lost"] == 0
    code, out, errors = fit("pendulum", "--workers", "2")
    assert code == 0
    assert "had no effect" in errors
    assert "faults" not in json.loads((out / "fit.json").read_text())
    code, _, errors = fit(f"{file}:model", "--address", "tcp://127.0.0.1:1")
    assert code == 2
    assert errors.startswith("npdr: The executor 'loky' has no address")


def test_a_plate_of_devices_is_one_batch(one_worker):
    def model(given):
        with pyro.plate("devices", 3):
            gain = pyro.sample("gain", dist.Uniform(1.0, 2.0))
            return npdr.simulate("trajectory", Drift(noise=0.0), {"gain": gain}, given)

    before = one_worker.faults.num_draws
    assert model(inputs(torch.ones(4, 1))).shape == (3, 1, 4, 1)
    assert one_worker.faults.num_draws == before + 3
