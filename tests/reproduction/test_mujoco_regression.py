"""Recovering the parameters of MJCF mechanisms from motions that MuJoCo itself has made."""

import logging

import mujoco
import numpy as np
import pytest

from npdr_ppl.engines.mujoco.base_parameters import MujocoInverseDynamics, with_parameters
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.reproduction.mujoco_regression import regress_mjcf, regress_mjcf_recording
from npdr_ppl.rollouts.differentiation import Smoothing

ARM = """
<mujoco model="two-link arm">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="RK4"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.2" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04" mass="2"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.005"/>
        <geom type="capsule" fromto="0 0 0 0.05 0 -0.3" size="0.03" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" gear="30"/>
    <motor joint="elbow" gear="-10"/>
  </actuator>
</mujoco>
"""

CHAIN = """
<mujoco model="chain in space">
  <option timestep="0.002" integrator="RK4" gravity="1 0 -9"><flag contact="disable"/></option>
  <default><joint damping="0.3" armature="0.02"/><geom density="600"/></default>
  <worldbody>
    <body name="base" pos="0 0 1" euler="10 20 0">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1" stiffness="400"/>
      <geom type="box" size=".1 .08 .06"/>
      <body name="link" pos="0.1 0.02 0" euler="0 30 15">
        <joint name="roll" axis="1 0 0"/>
        <geom type="cylinder" size=".04 .12" pos=".1 0 0" euler="0 90 0"/>
        <body name="mount" pos="0.2 0 0"><geom type="sphere" size=".05"/>
          <body name="hand" pos="0.05 0 0" euler="40 0 0">
            <joint name="pitch" axis="0 1 0" stiffness="3"/>
            <joint name="yaw" axis="0 0 1" pos="0 .01 0" stiffness="3"/>
            <geom type="ellipsoid" size=".03 .06 .09" pos=".04 .02 -.03"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

CART_POLE = """
<mujoco model="cart-pole">
  <option timestep="0.001" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="1.2" diaginertia="1 1 1"/>
      <joint name="rail" type="slide" axis="1 0 0" damping="0.8" frictionloss="0.5"/>
      <body name="pole">
        <inertial pos="0 0 -0.25" mass="0.3" diaginertia="0.01 0.01 0.0005"/>
        <joint name="hinge" axis="0 1 0" damping="0.01"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="rail" gear="4"/></actuator>
</mujoco>
"""


def simulate(model, num_steps, excitation, substeps=1):
    """Steps MuJoCo; returns qpos, qvel, qacc and applied forces at the start of each step."""
    data = mujoco.MjData(model)
    rows = []
    for step in range(num_steps):
        time = step * model.opt.timestep * substeps
        if model.nu:
            data.ctrl[:] = excitation(time)
        else:
            data.qfrc_applied[:] = excitation(time)
        mujoco.mj_forward(model, data)
        applied = data.qfrc_applied + data.qfrc_actuator
        rows.append([x.copy() for x in (data.qpos, data.qvel, data.qacc, applied, data.ctrl)])
        for _ in range(substeps):
            mujoco.mj_step(model, data)
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def sinusoids(number, strength, seed=0):
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(2.0, 12.0, (4, number))
    phase = rng.uniform(0.0, 6.3, (4, number))
    return lambda time: strength * np.sin(frequency * time + phase).sum(0) / 2.0


def perturbed(model, size, seed=1):
    """The same mechanism with other nominal parameters: what is known beforehand."""
    dynamics = MujocoInverseDynamics(model)
    values = dynamics.nominal()
    rng = np.random.default_rng(seed)
    bodies = len(dynamics.bodies)
    factors = np.concatenate(
        (np.repeat(np.exp(size * rng.standard_normal(bodies)), 10), np.ones(3 * model.nv))
    )
    factors[10 * bodies :] = np.exp(size * rng.standard_normal(3 * model.nv))
    return with_parameters(model, values * factors)


def errors(posterior, truth):
    """Errors of the base parameters, relative to what they are made of."""
    expected = posterior.grouping @ truth
    size = np.abs(posterior.grouping) @ np.maximum(np.abs(truth), posterior.scales)
    return np.abs(posterior.base.mean.numpy() - expected) / size


FIXED = {
    ARM: ("*.frictionloss",),
    CHAIN: ("*.frictionloss",),
    CART_POLE: ("hinge.frictionloss", "*.armature"),
}

SOFT_FRICTION = 0.02
"""MuJoCo's dry friction is a soft constraint: about rest it is less than its bound."""


@pytest.mark.parametrize(
    ("xml", "strength", "rank", "tolerance"),
    [
        # A planar arm: inertia and first moments (2) of each link, the elbow's armature, which
        # sees the relative acceleration alone, and two dampings.
        (ARM, 0.5, 9, 1e-6),
        (CHAIN, 15.0, None, 1e-6),
        # The total mass, the pole's inertia and first moments, two dampings, dry friction.
        (CART_POLE, 2.0, 7, SOFT_FRICTION),
    ],
    ids=["arm", "chain", "cart-pole"],
)
def test_base_parameters_come_back_from_motion(xml, strength, rank, tolerance):
    model = mujoco.MjModel.from_xml_string(xml)
    number = model.nu or model.nv
    q, v, a, applied, _ = simulate(model, 600, sinusoids(number, strength), substeps=5)
    truth = MujocoInverseDynamics(model).nominal()
    posterior = regress_mjcf(perturbed(model, 0.3), q, v, a, applied, fixed=FIXED[xml])
    assert rank is None or len(posterior.base_names) == rank
    assert errors(posterior, truth).max() < tolerance
    # Whatever the physical parameters are: they predict the forces of another motion.
    q, v, a, applied, _ = simulate(model, 50, sinusoids(number, strength, seed=5), substeps=5)
    parameters = posterior.to_physical(posterior.base.mean.numpy()[None])[0]
    predicted = posterior.dynamics.regressors(q, v, a) @ parameters
    targets = posterior.dynamics.targets(q, v, applied)
    moving = np.abs(v).min(-1) > 0.05
    difference = np.abs(predicted - targets)[moving]
    assert difference.max() < 3.0 * tolerance * np.abs(targets).max()


def test_the_rank_is_that_of_unrelated_states():
    """What a trajectory tells of the chain is all that any states could tell."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    q, v, a, applied, _ = simulate(model, 600, sinusoids(model.nv, 15.0), substeps=5)
    posterior = regress_mjcf(model, q, v, a, applied)
    rng = np.random.default_rng(0)
    states = rng.standard_normal((3, 200, model.nv))
    rows = posterior.dynamics.regressors(*states).reshape(-1, len(posterior.names))
    assert np.linalg.matrix_rank(rows * posterior.scales, tol=1e-8) == len(posterior.base_names)
    # A parameter set that differs by what nothing tells has the same base parameters.
    _, _, null = np.linalg.svd(rows)
    blind = posterior.grouping @ null[len(posterior.base_names) :].T
    assert np.abs(blind / posterior.scales.max()).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("xml", [ARM, CART_POLE], ids=["arm", "cart-pole"])
def test_recordings_of_positions_and_controls_do(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    strength = {ARM: 0.5, CART_POLE: 2.0}[xml]
    # Controls are held for a recorded step of 2 ms.
    model.opt.timestep = 0.0005
    q, v, a, applied, controls = simulate(model, 6000, sinusoids(model.nu, strength), substeps=4)
    truth = MujocoInverseDynamics(model).nominal()
    posterior = regress_mjcf_recording(
        perturbed(model, 0.2), q, controls[:-1], 0.002, fixed=FIXED[xml]
    )
    assert errors(posterior, truth).max() < {ARM: 5e-3, CART_POLE: SOFT_FRICTION}[xml]


def test_noise_is_covered_and_implausible_draws_are_counted(caplog):
    model = mujoco.MjModel.from_xml_string(ARM)
    q, v, a, applied, _ = simulate(model, 600, sinusoids(2, 0.5), substeps=5)
    truth = MujocoInverseDynamics(model).nominal()
    rng = np.random.default_rng(2)
    noise = np.array([0.3, 0.1]) * rng.standard_normal(applied.shape)
    posterior = regress_mjcf(model, q, v, a, applied + noise, fixed=("*.frictionloss",))
    sds = posterior.base.standard_deviations().numpy()
    error = np.abs(posterior.base.mean.numpy() - posterior.grouping @ truth)
    assert (error < 4.5 * sds).all(), "nine comparisons, false alarm once in 10 000"
    assert (error > 0.1 * sds).any()
    with caplog.at_level(logging.WARNING):
        parameters, possible = posterior.draw(2_000)
    # Counted one by one, with MuJoCo as the judge of what a body can be.
    names = list(posterior.names)
    brakes = [names.index(f"{joint}.damping") for joint in ("shoulder", "elbow")]
    assert possible.any()
    for values in parameters[possible][:20]:
        assert (values[brakes] >= 0.0).all()
        assert with_parameters(model, values).body_mass[1] > 0.0
    for values in parameters[~possible][:20]:
        with pytest.raises(ModelError):
            with_parameters(model, values)
    if not possible.all():
        assert f"{int((~possible).sum())} of 2000 draws" in caplog.text
    again, _ = posterior.draw(2_000)
    np.testing.assert_array_equal(again, parameters)


def test_least_change_keeps_what_is_known():
    """With the nominal parameters right and exact data, nothing changes."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    q, v, a, applied, _ = simulate(model, 300, sinusoids(model.nv, 15.0), substeps=5)
    posterior = regress_mjcf(model, q, v, a, applied)
    mean = np.array(list(posterior.mean().values()))
    assert (np.abs(mean - posterior.nominal) < 1e-6 * posterior.scales).all()
    with pytest.raises(ModelError, match="No parameter is called 'hand.colour'"):
        regress_mjcf(model, q, v, a, applied, fixed=["hand.colour"])
    with pytest.raises(DataError, match="all is fixed"):
        regress_mjcf(model, q, v, a, applied, fixed=["*"])


def test_only_hinges_and_slides_are_differentiated():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(ModelError, match="hinges and slides"):
        regress_mjcf_recording(model, np.zeros((100, 7)), np.zeros((99, 0)), 0.01)
    arm = mujoco.MjModel.from_xml_string(ARM)
    with pytest.raises(DataError, match="below half the sampling rate"):
        regress_mjcf_recording(
            arm, np.zeros((100, 2)), np.zeros((99, 2)), 0.01, smoothing=Smoothing(80.0)
        )
