"""`npdr export` to ranges, a Gymnasium wrapper and events of Isaac Lab."""

import json
import os
import runpy
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
import yaml

from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import CoulombFriction, InputDelay, StribeckFriction, Tilt
from npdr_ppl.policies.linear import Linear
from npdr_ppl.policies.power import PoWER
from tests.helpers import isaac_lab_stub
from tests.helpers.command_line import run_for_module
from tests.helpers.effect_files import DAMPING
from tests.helpers.exported_runs import (
    MEANS,
    NUM_DRAWS,
    write_discovery,
    write_fit,
    write_robot,
)
from tests.helpers.mujoco_files import GYMNASIUM, needs_gymnasium

MODEL = "arm_model.py:model"


@pytest.fixture
def draws(tmp_path, monkeypatch):
    """Draws of the fit in the folder ``fit``, beside the robot's file and its model."""
    monkeypatch.chdir(tmp_path)
    write_robot(tmp_path)
    return write_fit(tmp_path / "fit", MEANS)


def arm_environment(file="arm.xml"):
    """Returns the arm as an environment; the shoulder is to rise to 0.5 rad."""
    pytest.importorskip("gymnasium")
    from gymnasium import spaces
    from gymnasium.envs.mujoco import MujocoEnv

    class Arm(MujocoEnv):
        metadata: ClassVar = {
            "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
            "render_fps": 100,
        }

        def observe(self):
            return np.concatenate([self.data.qpos, self.data.qvel])

        def reset_model(self):
            return self.observe()

        def step(self, action):
            self.do_simulation(action, self.frame_skip)
            error = self.data.qpos[0] - 0.5
            return self.observe(), -float(error**2), False, False, {}

    return Arm(str(Path(file).resolve()), 2, spaces.Box(-np.inf, np.inf, shape=(4,)))


def exported_wrapper():
    words = "export", "fit", MODEL, "--to", "arm_gym.py", "--as", "gymnasium"
    code, _, err = run_for_module(*words)
    assert code == 0, err
    return runpy.run_path("arm_gym.py")["RandomisedRobot"]


@pytest.mark.parametrize("name", ["ranges.yaml", "ranges.json"])
def test_ranges_hold_means_intervals_correlations_and_draws(draws, name):
    code, _, err = run_for_module("export", "fit", "--to", name, "--draws", "100")
    assert code == 0, err
    text = Path(name).read_text()
    found = json.loads(text) if name.endswith("json") else yaml.safe_load(text)
    assert found["names"] == list(MEANS)
    mass = found["parameters"]["mass"]
    assert mass["unit"] == "kg" and found["parameters"]["damping"]["unit"] is None
    assert mass["mean"] == pytest.approx(draws["mass"].mean())
    assert mass["interval_94"] == pytest.approx(np.quantile(draws["mass"], [0.03, 0.97]))
    table = np.array(found["draws"])
    assert table.shape == (100, len(MEANS)) and table.dtype == float
    every = np.stack(list(draws.values()), axis=-1)
    assert all(any(np.array_equal(row, other) for other in every) for row in table)
    wanted = np.corrcoef(table.T)
    assert np.abs(np.array(found["correlations"]) - wanted).max() < 1e-4
    assert found["correlations"][0][1] > 0.3


def test_small_numbers_of_ranges_are_numbers_in_yaml(tmp_path):
    write_fit(tmp_path / "tiny", {"a": 1e-5, "b": 3e-7})
    code, _, err = run_for_module("export", tmp_path / "tiny", "--to", tmp_path / "r.yaml")
    assert code == 0, err
    found = yaml.safe_load((tmp_path / "r.yaml").read_text())
    assert isinstance(found["parameters"]["b"]["mean"], float)
    assert all(isinstance(number, float) for row in found["draws"] for number in row)


def test_a_discovery_is_exported_with_its_revised_model(draws, tmp_path):
    means = {name: MEANS[name] for name in ("mass", "damping", "kp", "centre", "density", "grip")}
    found = write_discovery(tmp_path / "discovery", means)
    (tmp_path / "discovery" / "revised_model.py").write_text(
        (tmp_path / "arm_model.py").read_text().replace("def model", "def revised_model")
        .replace('"arm.xml"', f'"{tmp_path / "arm.xml"}"')
    )  # fmt: skip
    code, text, err = run_for_module("export", "discovery", "--to", "new.xml")
    assert code == 0, err
    assert "is ambiguous: Two causes." in text and 'kp="5.0' in Path("new.xml").read_text()
    code, _, err = run_for_module("export", "discovery", "--to", "ranges.json")
    assert code == 0, err
    assert json.loads(Path("ranges.json").read_text())["parameters"]["mass"][
        "mean"
    ] == pytest.approx(found["mass"].mean())


def test_an_environment_is_another_robot_after_every_reset(draws):
    wrapper = exported_wrapper()
    env = wrapper(arm_environment())
    model = env.unwrapped.model
    seen = []
    for _ in range(20):
        _, info = env.reset()
        row = info["draw"]
        # All from the same draw, so that correlations stay.
        assert model.body("hand").mass[0] == draws["mass"][row]
        assert model.joint("shoulder").damping[0] == draws["damping"][row]
        assert model.actuator("servo").gainprm[0] == draws["kp"][row]
        assert model.actuator("servo").biasprm[1] == -draws["kp"][row]
        assert model.opt.density == draws["density"][row]
        friction = draws["shoulder_torque.coulomb_friction.magnitude"]
        assert model.joint("shoulder").frictionloss[0] == friction[row]
        assert info["parameters"]["motor.input_delay.delay"] == pytest.approx(
            draws["motor.input_delay.delay"][row]
        )
        seen.append(row)
    assert len(set(seen)) > 10 and max(seen) < NUM_DRAWS
    assert env.reset(options={"draw": 7})[1]["draw"] == 7
    first = [env.reset(seed=3)[1]["draw"], env.reset()[1]["draw"]]
    assert [env.reset(seed=3)[1]["draw"], env.reset()[1]["draw"]] == first


def test_the_environment_moves_as_our_simulator_with_the_same_draw(draws):
    wrapper = exported_wrapper()
    env = wrapper(arm_environment())
    ours = runpy.run_path("arm_model.py")["arm"].with_effects(
        CoulombFriction("shoulder_torque"),
        Tilt("gravity"),
        StribeckFriction("elbow_torque"),
        InputDelay("motor"),
    )
    time = 0.01 * np.arange(100)
    commands = np.stack([2.0 * np.sin(7.0 * time), np.sin(5.0 * time)], axis=-1)
    inputs = Inputs.single(
        torch.from_numpy(commands),
        torch.zeros(4, dtype=torch.float64),
        action_names=("motor", "servo"),
        state_names=tuple(state.name for state in ours.states),
        time_step=0.01,
    )
    for row in (3, 250):
        own = {n: torch.tensor(v[row]) for n, v in draws.items() if "encoder" not in n}
        wanted = ours.simulate(own, inputs)[0].numpy()
        env.reset(options={"draw": row})
        steps = [env.step(command) for command in commands]
        moved = np.array([observation for observation, *_ in steps])
        assert np.abs(moved - wanted).max() < 1e-9
        measured = np.array([info["measured"]["elbow"] for *_, info in steps])
        bias = draws["elbow.encoder_bias.offset"][row]
        assert np.abs(measured - bias - wanted[:, 1]).max() < 1e-9
        nominal = MujocoSimulator("arm.xml", time_step=0.01).simulate({}, inputs)[0].numpy()
        assert np.abs(wanted - nominal).max() > 0.1


def test_an_effect_of_ones_own_acts_in_the_environment_with_the_value_of_the_draw(draws):
    Path("own.py").write_text(DAMPING)
    site = "shoulder_torque.cubic_damping.damping"
    names = ("mass", "damping", "kp", "centre", "density", "grip")
    drawn = write_fit(Path("own"), {name: MEANS[name] for name in names} | {site: 0.5})
    words = "export", "own", MODEL, "--effect", "own.py:CubicDamping@shoulder_torque"
    code, _, err = run_for_module(*words, "--to", "own_gym.py", "--as", "gymnasium")
    assert code == 0, err
    wrapper = runpy.run_path("own_gym.py")["RandomisedRobot"]
    env = wrapper(arm_environment())
    _, info = env.reset(options={"draw": 11})
    assert info["parameters"][site] == drawn[site][11]
    data = env.unwrapped.data
    data.qvel[0] = 2.0
    env.unwrapped.frame_skip = 1
    env.step(np.zeros(2))
    assert data.qfrc_applied[0] == pytest.approx(-drawn[site][11] * 2.0**3)


def episode(env, policy, seed, num_steps=150):
    """Returns the return of an episode."""
    observation, _ = env.reset(seed=seed)
    control, total = policy.controller({}), 0.0
    for step in range(num_steps):
        command = np.clip(control(observation, 0.01 * step), -3.0, 3.0)
        observation, reward, *_ = env.step(np.array([command[0], 0.0]))
        total += reward
    return total


def hidden_rig():
    """Returns an environment of the arm with the means as its parameters, made of a file."""
    code, _, err = run_for_module("export", "fit", MODEL, "--to", "hidden.xml")
    assert code == 0, err
    env = arm_environment("hidden.xml")
    effects = runpy.run_path("hidden_effects.py")["Effects"](env.model)

    def reset_model():
        effects.reset(env.data)
        return env.observe()

    # As the file says that it is used.
    env._step_mujoco_simulation = lambda ctrl, count: effects.step(env.data, ctrl, count)
    env.reset_model = reset_model
    return env


@pytest.mark.slow
def test_a_policy_trained_in_the_randomised_environment_works_on_the_hidden_rig(draws):
    wrapper = exported_wrapper()
    env = wrapper(arm_environment())
    names = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")
    policy = Linear(names, ("motor",), max_gain=20.0)
    search = PoWER(population=12, exploration=2.0)
    state, generator = search.init(policy), torch.Generator().manual_seed(0)
    for iteration in range(8):
        candidates = search.ask(state, generator)
        returns = [
            np.mean([episode(env, policy.with_parameters(row), 3 * iteration + k) for k in (0, 1)])
            for row in candidates
        ]
        state = search.tell(state, candidates, torch.tensor(np.array(returns)))
    trained = policy.with_parameters(search.parameters(state))
    rig = hidden_rig()
    untrained, learnt = (episode(rig, p, seed=0) for p in (policy, trained))
    print(f"cost on the hidden rig: {-untrained:.2f} without control, {-learnt:.2f} trained")
    assert learnt > 0.4 * untrained  # returns are negative: at most 40 % of the cost


def test_events_of_isaac_lab_have_the_arguments_that_it_takes(draws, monkeypatch):
    words = "export", "fit", MODEL, "--to", "events.py", "--as", "isaac-lab"
    code, text, err = run_for_module(*words, "--json")
    assert code == 0, err
    left_out = json.loads(text)["left_out"]
    for name in ("elbow_torque.stribeck_friction", "motor.input_delay", "elbow.encoder_bias"):
        assert left_out[name] == "Isaac Lab has no event for this law"
    assert left_out["density"] == "Isaac Lab has no event for it"
    isaac_lab_stub.install(monkeypatch)
    found = runpy.run_path("events.py")["EventCfg"]
    mass = found.body_hand_mass.params
    assert mass["asset_cfg"].body_names == "hand" and mass["recompute_inertia"]
    wanted = np.quantile(draws["mass"], [0.03, 0.97])
    assert mass["mass_distribution_params"] == pytest.approx(wanted, rel=1e-5)
    low, high = found.body_hand_centre.params["com_range"]["z"]
    assert low == pytest.approx(np.quantile(draws["centre"], 0.03) + 0.1, abs=1e-6) and high > low
    gains = found.joint_elbow_gains.params
    assert gains["stiffness_distribution_params"] == pytest.approx(
        np.quantile(draws["kp"], [0.03, 0.97]), rel=1e-5
    )
    assert gains["damping_distribution_params"] == (0.25, 0.25)
    assert found.joint_shoulder_parameters.params["friction_distribution_params"][0] > 0.08
    low, high = found.body_hand_material.params["static_friction_range"]
    assert 0.7 < low < 0.8 < high < 0.9
    assert len(found.gravity.params["gravity_distribution_params"][0]) == 3


def test_events_of_isaac_lab_are_those_of_the_robot_under_their_own_names(
    draws, tmp_path, monkeypatch
):
    text = (tmp_path / "arm.xml").read_text().replace('"elbow"', '"shoul-der"')
    text = text.replace('"shoulder"', '"shoul_der"')
    floor = '<geom name="floor" type="plane" size="1 1 1" pos="0 0 -3"/>'
    (tmp_path / "arm.xml").write_text(text.replace("<worldbody>", f"<worldbody>{floor}"))
    model = (tmp_path / "arm_model.py").read_text().replace("geom palm", "geom floor")
    model = model.replace('"damping": "joint shoulder', '"damping": "joint shoul_der')
    model = model.replace('"density": "option density"', '"other": "joint shoul-der damping"')
    (tmp_path / "arm_model.py").write_text(model)
    write_fit(tmp_path / "two", {n: MEANS[n] for n in ("mass", "damping", "kp", "centre", "grip")}
              | {"other": 0.3})  # fmt: skip
    words = "export", "two", MODEL, "--to", "events.py", "--as", "isaac-lab"
    code, text, err = run_for_module(*words, "--json")
    assert code == 0, err
    reason = json.loads(text)["left_out"]["geom_friction of floor"]
    assert reason == "it belongs to the world, not to the robot"
    isaac_lab_stub.install(monkeypatch)
    found = vars(runpy.run_path("events.py")["EventCfg"])
    gains = [term for name, term in found.items() if name.endswith(("gains", "gains_"))]
    named = {term.params["asset_cfg"].joint_names for term in gains}
    assert named == {"shoul-der", "shoul_der"}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("fit", MODEL), "Give the new file"),
        (("fit", MODEL, "--to", "x.txt"), "has none of the endings"),
        (("fit", MODEL, "--to", "x.py"), "Add --as gymnasium or --as isaac-lab"),
        (("fit", MODEL, "--to", "x.yaml", "--as", "gymnasium"), "its ending has to be .py"),
        (("fit", MODEL, "--to", "a-b.py", "--as", "gymnasium"), "cannot be imported"),
        (("fit", MODEL, "--to", "class.py", "--as", "gymnasium"), "cannot be imported"),
        (("fit", "--to", "x.py", "--as", "gymnasium"), "Give the model of the run"),
        (("old", "--to", "x.yaml"), "has no posterior.nc"),
        (("other", "--to", "x.yaml"), "has no draws of lost; it is of another run"),
        (("fit", MODEL, "--to", "x.urdf"), "was not made from a URDF file"),
        (("fit", MODEL, "--to", "arm_model.py", "--as", "isaac-lab"), "exists already"),
    ],
)
def test_bad_input_gives_one_sentence(draws, tmp_path, words, sentence):
    for name in ("old", "other"):
        write_fit(tmp_path / name, {"mass": 0.4})
    (tmp_path / "old" / "posterior.nc").unlink()
    record = json.loads((tmp_path / "other" / "fit.json").read_text())
    record["parameters"]["lost"] = record["parameters"]["mass"]
    (tmp_path / "other" / "fit.json").write_text(json.dumps(record))
    code, _, err = run_for_module("export", *words)
    assert code == 2 and err.count("\n") == 1 and sentence in err


STOCK = """
import pyro, pyro.distributions as dist
import npdr_ppl as npdr

cart = npdr.MujocoSimulator({path!r}, {{"gear": "actuator slide gear"}})

def model(inputs):
    gear = pyro.sample("gear", dist.Uniform(50.0, 150.0))
    return npdr.simulate("x", cart, {{"gear": gear}}, inputs)
"""


@needs_gymnasium
@pytest.mark.filterwarnings("ignore")
def test_an_environment_of_gymnasium_is_randomised(tmp_path, monkeypatch):
    import gymnasium

    monkeypatch.chdir(tmp_path)
    path = str(GYMNASIUM / "inverted_pendulum.xml")
    Path("cart.py").write_text(STOCK.format(path=path))
    name = MujocoSimulator(path).joints[0]
    draws = write_fit(tmp_path / "fit", {"gear": 110.0, f"{name}.stribeck_friction.excess": 2.0,
                                         f"{name}.stribeck_friction.speed": 0.2})  # fmt: skip
    words = "export", "fit", "cart.py:model", "--to", "cart_gym.py", "--as", "gymnasium"
    code, _, err = run_for_module(*words)
    assert code == 0, err
    env = runpy.run_path("cart_gym.py")["RandomisedRobot"](gymnasium.make("InvertedPendulum-v5"))
    random, lengths = np.random.default_rng(0), []
    for seed in range(5):
        _, info = env.reset(seed=seed)
        assert env.unwrapped.model.actuator_gear[0, 0] == draws["gear"][info["draw"]]
        for step in range(1000):
            observation, _, ends, cut, _ = env.step(random.uniform(-3.0, 3.0, 1))
            assert np.isfinite(observation).all()
            if ends or cut:
                lengths.append(step)
                break
    assert len(lengths) == 5


def test_another_robot_is_named(draws, tmp_path):
    wrapper = exported_wrapper()
    text = (tmp_path / "arm.xml").read_text().replace('"hand"', '"other"')
    (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(ValueError, match="has no body 'hand'"):
        wrapper(arm_environment())


HOSTILE = "x&#10;    import os; os.environ['NPDR_HOSTILE'] = '1'&#10;&quot;&quot;&quot;"
"""A name in a robot's file that would be a statement in Python."""


@pytest.mark.parametrize("kind", ["gymnasium", "isaac-lab", "robot"])
def test_names_in_a_robots_file_cannot_become_code(draws, tmp_path, monkeypatch, kind):
    monkeypatch.delenv("NPDR_HOSTILE", raising=False)
    text = (tmp_path / "arm.xml").read_text()
    (tmp_path / "arm.xml").write_text(
        text.replace('"servo"', f'"{HOSTILE}"').replace("<geom", f'<geom name="{HOSTILE}"', 1)
    )
    # Names with line breaks can be given by patterns only.
    fields = '"friction": "geom x* friction sliding", "gear": "actuator x* gear",'
    model = (tmp_path / "arm_model.py").read_text()
    model = model.replace('"kp": "actuator servo kp",', fields)
    (tmp_path / "arm_model.py").write_text(model)
    means = {n: v for n, v in MEANS.items() if "." not in n and n != "kp"}
    means |= {"friction": 0.7, "gear": 1.1, "motor.input_delay.delay": 0.01}
    write_fit(tmp_path / "hostile", means)
    to, written = ("new.xml", "new_effects.py") if kind == "robot" else ("new.py", "new.py")
    words = "export", "hostile", MODEL, "--to", to, "--as", kind
    code, _, err = run_for_module(*words)
    assert code == 0, err
    isaac_lab_stub.install(monkeypatch)
    runpy.run_path(written)
    assert "NPDR_HOSTILE" not in os.environ
