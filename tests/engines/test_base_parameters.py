"""The linear form of inverse dynamics against MuJoCo's own, on random mechanisms."""

import mujoco
import numpy as np
import pytest

from npdr_ppl.engines.mujoco.base_parameters import (
    MujocoInverseDynamics,
    actuator_forces,
    load_mjcf,
)
from npdr_ppl.errors import ModelError, ShapeError

JOINTS = ("hinge", "slide", "ball", "two", "none")


def numbers(values):
    return " ".join(f"{value:.6f}" for value in values)


def random_mjcf(seed):
    """A random tree of bodies with every kind of joint, some welded, one perhaps floating."""
    rng = np.random.default_rng(seed)

    def joint(kind, name):
        common = f'damping="{rng.uniform(0, 1):.3f}" armature="{rng.uniform(0, 0.1):.3f}"'
        dry = f'frictionloss="{rng.uniform(0, 0.05):.3f}"'
        axis = numbers(rng.standard_normal(3))
        pos = numbers(0.1 * rng.standard_normal(3))
        if kind == "two":
            return joint("slide", f"{name}a") + joint("hinge", f"{name}b")
        if kind == "ball":
            return f'<joint name="{name}" type="ball" pos="{pos}" {common}/>'
        if kind == "none":
            return ""
        spring = 'stiffness="2.5"' if rng.random() < 0.5 else ""
        return f'<joint name="{name}" type="{kind}" axis="{axis}" {common} {dry} {spring}/>'

    def body(depth, name):
        kind = str(rng.choice(JOINTS)) if depth else str(rng.choice(["free", *JOINTS[:4]]))
        joints = f'<freejoint name="{name}"/>' if kind == "free" else joint(kind, name)
        children = "".join(
            body(depth + 1, f"{name}{i}") for i in range(rng.integers(0, 3)) if depth < 2
        )
        geom = (
            f'<geom type="ellipsoid" size="{numbers(rng.uniform(0.05, 0.2, 3))}" '
            f'pos="{numbers(0.1 * rng.standard_normal(3))}" '
            f'euler="{numbers(90 * rng.standard_normal(3))}"/>'
        )
        pose = f'pos="{numbers(0.3 * rng.standard_normal(3))}"'
        turn = f'euler="{numbers(90 * rng.standard_normal(3))}"'
        return f'<body name="{name}" {pose} {turn}>{joints}{geom}{children}</body>'

    gravity = numbers(5.0 * rng.standard_normal(3))
    return (
        f'<mujoco><option gravity="{gravity}"><flag contact="disable"/></option>'
        f"<worldbody>{body(0, 'b')}{body(0, 'c')}</worldbody></mujoco>"
    )


def random_motion(model, num=8, seed=0):
    """Random states and accelerations, and the forces that MuJoCo says they take."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    velocities = rng.standard_normal((num, model.nv))
    # Near rest MuJoCo's dry friction is a soft constraint and not yet all of its bound.
    velocities += 0.5 * np.sign(velocities)
    accelerations = rng.standard_normal((num, model.nv))
    positions, forces = np.zeros((num, model.nq)), np.zeros((num, model.nv))
    for n in range(num):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.standard_normal(model.nv), 1.0)
        positions[n] = data.qpos
        data.qvel[:], data.qacc[:] = velocities[n], accelerations[n]
        mujoco.mj_inverse(model, data)
        forces[n] = data.qfrc_inverse
    return positions, velocities, accelerations, forces


@pytest.mark.parametrize("seed", range(12))
def test_agrees_with_mujoco(seed):
    model = mujoco.MjModel.from_xml_string(random_mjcf(seed))
    dynamics = MujocoInverseDynamics(model)
    positions, velocities, accelerations, forces = random_motion(model)
    nominal = dynamics.nominal()
    assert nominal.shape == (10 * len(dynamics.bodies) + 3 * model.nv,)
    left = dynamics.regressors(positions, velocities, accelerations) @ nominal
    right = dynamics.targets(positions, velocities, forces)
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-8 * max(1.0, np.abs(right).max()))


def test_forces_of_actuators_have_their_gears():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>'
        '<actuator><motor joint="j" gear="50"/><position joint="j" kp="7"/></actuator></mujoco>'
    )
    positions, velocities = np.array([[0.3], [0.0]]), np.zeros((2, 1))
    forces = actuator_forces(model, positions, velocities, np.array([[0.1, 0.0], [0.0, 1.0]]))
    np.testing.assert_allclose(forces, [[5.0 - 7 * 0.3], [7.0]])
    filtered = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>'
        '<actuator><general joint="j" dyntype="integrator"/></actuator></mujoco>'
    )
    with pytest.raises(ModelError, match="Actuators with states"):
        actuator_forces(filtered, positions, velocities, np.zeros((2, 1)))


def test_bad_models_and_shapes_are_refused(tmp_path):
    (tmp_path / "bad.xml").write_text("<mujoco><robot/></mujoco>")
    with pytest.raises(ModelError, match="not a readable MJCF file"):
        load_mjcf(tmp_path / "bad.xml")
    (tmp_path / "still.xml").write_text("<mujoco/>")
    with pytest.raises(ModelError, match="has no joints"):
        MujocoInverseDynamics(load_mjcf(tmp_path / "still.xml"))
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='a'><joint/><geom size='.1'/></body></worldbody>"
        "<equality><weld body1='a'/></equality></mujoco>"
    )
    with pytest.raises(ModelError, match="1 equality constraints"):
        MujocoInverseDynamics(model)
    model = mujoco.MjModel.from_xml_string(random_mjcf(0))
    positions, velocities, accelerations, forces = random_motion(model)
    dynamics = MujocoInverseDynamics(model)
    with pytest.raises(ShapeError, match=r"velocities must have shape \(8, "):
        dynamics.regressors(positions, velocities[:, :-1], accelerations)
    with pytest.raises(ShapeError, match="Applied forces"):
        dynamics.targets(positions, velocities, forces[:-1])
