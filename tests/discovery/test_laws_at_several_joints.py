"""The same law at several joints is one hypothesis with a strength per joint."""

import mujoco
import numpy as np
import pyro
import pyro.distributions as dist
import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.screening.groups import num_counted
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.models.effects import Bias, CoulombFriction, ViscousFriction

JOINTS = ("shoulder", "elbow", "wrist", "finger")
STEP, NOISE = 0.005, 1e-4
FRICTION = {"shoulder": 0.3, "elbow": 0.15, "finger": 0.05}  # none at the wrist


def chain(friction=None, timestep=0.005):
    """A chain of four links, each with a motor."""
    inner = ""
    for name in reversed(JOINTS):
        loss = (friction or {}).get(name, 0.0)
        inner = f"""<body name="{name}_link" pos="0.3 0 0"><joint name="{name}" axis="0 1 0"
        armature="0.02" damping="0.2" frictionloss="{loss}"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3"/>{inner}</body>"""
    motors = "".join(f'<motor name="{n}_motor" joint="{n}" ctrlrange="-3 3"/>' for n in JOINTS)
    text = f"""<mujoco><option timestep="{timestep}" integrator="implicitfast" gravity="0 0 0"/>
    <worldbody>{inner}</worldbody><actuator>{motors}</actuator></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def recorded(friction, seed=0, num_steps=250, substeps=10):
    """Two recordings of positions and velocities in steps ten times finer than the model's."""
    model, rng = chain(friction, STEP / substeps), np.random.default_rng(seed)
    readings, commands = [], []
    for _ in range(2):
        data = mujoco.MjData(model)
        time = STEP * np.arange(num_steps)
        waves = [np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in (0.5, 0.9, 1.3, 1.7)]
        torques = np.stack([waves[k] * s for k, s in enumerate((2.0, 1.2, 0.6, 0.3))], axis=1)
        rows = [np.r_[data.qpos, data.qvel]]
        for torque in torques:
            data.ctrl[:] = torque
            for _ in range(substeps):
                mujoco.mj_step(model, data)
            rows.append(np.r_[data.qpos, data.qvel])
        readings.append(np.array(rows) + NOISE * rng.standard_normal((num_steps + 1, 8)))
        commands.append(torques)
    return npdr.Rollouts.from_arrays(
        readings=readings,
        actions=commands,
        channel_names=[*JOINTS, *(f"{name}_velocity" for name in JOINTS)],
        action_names=[f"{name}_motor" for name in JOINTS],
        time_step=STEP,
    )


ARM = npdr.MujocoSimulator(chain(), {"damping": [f"joint {name} damping" for name in JOINTS]})


def model(inputs):
    damping = pyro.sample("damping", dist.Uniform(0.05, 0.5))
    return npdr.simulate("trajectory", ARM, {"damping": damping}, inputs)


def places(*laws):
    ports = [f"{name}_torque" for name in JOINTS]
    return tuple(law(port) for law in laws for port in ports)


@pytest.fixture(scope="module")
def searched():
    options = npdr.DiscoveryOptions(effects=places(CoulombFriction, ViscousFriction, Bias))
    said = []
    searcher = Searcher(model, recorded(FRICTION), options, said.append, seed=0)
    first = searcher.look(searcher.settled(searcher.fit_base()))
    return searcher, first, said


@pytest.mark.slow
def test_joints_without_the_law_are_no_members(searched):
    _, first, _ = searched
    law = first.laws[0]
    wanted = {f"{name}_torque.coulomb_friction" for name in FRICTION}
    assert law.names == wanted
    assert law.gain > first.ranking[0].gain
    assert [law.gain for law in first.laws] == sorted((g.gain for g in first.laws), reverse=True)
    for name, magnitude in FRICTION.items():
        found = float(law.parameters[f"{name}_torque.coulomb_friction.magnitude"])
        assert found == pytest.approx(magnitude, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("max_effects", "num_rounds"),
    [(1, 2), pytest.param(5, 3, id="once two of its joints were added")],
)
def test_friction_in_three_joints_is_added_at_once(searched, max_effects, num_rounds):
    searcher, first, said = searched
    said.clear()
    found = searcher.run(first, max_effects=max_effects)
    assert set(found.final.names) == {f"{name}_torque.coulomb_friction" for name in FRICTION}
    assert len(found.rounds) == num_rounds
    assert any(text.endswith("together are likelier") for text in said)
    for name, magnitude in FRICTION.items():
        value = found.final.parameters[f"{name}_torque.coulomb_friction.magnitude"]
        assert float(value) == pytest.approx(magnitude, rel=0.05)


def test_a_law_at_several_joints_counts_as_one_effect():
    everywhere = places(CoulombFriction)
    assert num_counted(everywhere) == 1
    assert num_counted(everywhere[:2]) == 2
    assert num_counted((*everywhere, Bias("elbow_torque"))) == 2
    assert num_counted(()) == 0


@pytest.mark.slow
def test_one_joint_with_friction_makes_no_group():
    options = npdr.DiscoveryOptions(effects=places(CoulombFriction, ViscousFriction))
    searcher = Searcher(model, recorded({"elbow": 0.15}), options, seed=0)
    first = searcher.look(searcher.fit_base())
    assert first.ranking[0].name == "elbow_torque.coulomb_friction"
    assert not any("coulomb" in law.name for law in first.laws)
