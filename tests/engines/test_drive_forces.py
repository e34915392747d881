"""Forces of actuators without a call of the engine, against the engine's."""

from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.mujoco.drive_forces import DriveForces, has_direct_drives
from npdr_ppl.models.effects import CoulombFriction, LoadDependentFriction, PreslidingFriction
from tests.helpers.mujoco_files import random_inputs, value

JOINTS = """
<mujoco><compiler autolimits="true"/><worldbody>
  <body><joint name="hinge" type="hinge" axis="0 1 0" actuatorfrcrange="-1.5 1.5"/>
    <geom size="0.1" mass="1" pos="0.2 0 0"/>
    <body pos="0.4 0 0"><joint name="slide" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="1"/></body></body></worldbody>
  <tendon><fixed name="both"><joint joint="hinge" coef="1"/></fixed></tendon>
  <actuator>{actuators}</actuator></mujoco>
"""

DRIVES = """
<motor name="motor" joint="hinge" gear="-3"/>
<position name="servo" joint="slide" kp="40" kv="3" gear="2" forcerange="-9 9"/>
<velocity name="speed" joint="slide" kv="2"/>
<general name="general" joint="hinge" gainprm="0.5" biastype="affine" biasprm="0.1 -0.2 -0.3"/>
"""


def model_with(actuators: str) -> mujoco.MjModel:
    """Returns a model of a hinge that carries a slide."""
    return mujoco.MjModel.from_xml_string(JOINTS.format(actuators=actuators))


@pytest.mark.parametrize("name", ["", "actuator_gainprm", "actuator_forcerange"])
def test_forces_equal_the_engines(name: str) -> None:
    """They do where limits act and where simulations differ in a field."""
    rng = np.random.default_rng(3)
    batch = mujoco.batch.Batch(model_with(DRIVES), 50)
    simulator = npdr.MujocoSimulator(model_with(DRIVES))
    if name:
        own = batch.expand(name)
        own *= rng.uniform(0.5, 1.5, (50, *[1] * (own.ndim - 1)))
    batch.state[:, 1:5] = rng.standard_normal((50, 4))
    drives = DriveForces(batch, simulator.force_ports)
    batch.bind("ctrl")[:] = rng.standard_normal((50, 4))
    expected = batch.bind("qfrc_actuator")
    batch.forward()
    zero = torch.zeros(50)
    found = np.stack([joint.drive.numpy() for joint in drives.read((zero, zero), (zero, zero))])
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found.T, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("actuators", "is_direct"),
    [
        (DRIVES, True),
        ('<motor name="a" tendon="both"/>', False),
        ('<position name="a" joint="hinge" kp="1" timeconst="0.1"/>', False),
        ('<muscle name="a" joint="hinge" lengthrange="0 1"/>', False),
    ],
)
def test_what_has_a_closed_form(actuators: str, is_direct: bool) -> None:
    """Tendons, filters and muscles have none."""
    assert has_direct_drives(model_with(actuators)) is is_direct


def test_dry_friction_is_the_engines() -> None:
    """It is, except beside laws that read accelerations, which are without dry friction."""
    simulator = npdr.MujocoSimulator(model_with(DRIVES))
    dry = CoulombFriction("hinge_torque")
    loaded = simulator.with_effects(dry, LoadDependentFriction("slide_force"))
    assert simulator.with_effects(dry).is_native(dry) and loaded.is_native(dry)
    assert not simulator.with_effects(dry, PreslidingFriction("slide_force")).is_native(dry)


def test_simulations_are_those_with_the_engines_forces(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shortcut changes no number."""
    simulator = npdr.MujocoSimulator(model_with(DRIVES))
    simulator = simulator.with_effects(LoadDependentFriction("hinge_torque"))
    inputs = random_inputs(simulator, num_steps=50)
    given = {"hinge_torque.load_dependent_friction.coefficient": value([0.0, 0.3])}
    found = simulator.simulate(given, inputs)
    monkeypatch.setattr("npdr_ppl.engines.mujoco.stepper.has_direct_drives", lambda model: False)
    torch.testing.assert_close(found, simulator.simulate(given, inputs), atol=1e-12, rtol=0.0)
    assert (found[1] - found[0]).abs().max() > 1e-3


def test_a_subclass_with_another_law_is_not_the_engines() -> None:
    """Only the law itself is."""

    class Half(CoulombFriction):
        def dry_friction(self, *arguments: Any) -> torch.Tensor:
            return 0.5 * super().dry_friction(*arguments)

    simulator = npdr.MujocoSimulator(model_with(DRIVES))
    effect = Half("hinge_torque")
    assert not simulator.with_effects(effect).is_native(effect)
