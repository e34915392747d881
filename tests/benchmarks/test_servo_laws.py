"""Laws inside servos against rigs with equations and an integrator of their own."""

import numpy as np
import pytest
import servo_law_rigs
import torch

import npdr_ppl as npdr
from npdr_ppl.models.effects import effects

FIRST_ORDER = 5e-4
"""Greatest difference in rad between MuJoCo's steps of 0.125 ms and the Runge-Kutta method."""

PROFILE = 6e-3
"""The same for a profile of limited acceleration: ours is planned at every sample, that of the
rig in every step of 0.5 ms."""


@pytest.mark.parametrize("kind", sorted(servo_law_rigs.KINDS))
def test_a_law_in_the_package_moves_the_arm_as_in_the_rig(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(servo_law_rigs, "NOISE", 0.0)
    monkeypatch.setattr(servo_law_rigs, "SPREAD", 0.0)
    monkeypatch.setattr(servo_law_rigs, "SECONDS", 3.0)
    monkeypatch.setattr(servo_law_rigs, "ROLLOUTS", 1)
    case = servo_law_rigs.make_case(kind, 1001)
    (tmp_path / "arm.xml").write_text(servo_law_rigs.mjcf())
    plain = npdr.MujocoSimulator(tmp_path / "arm.xml", {}, time_step=0.01, substeps=80)
    simulator, given = plain, {}
    if case.truth:
        port, _, name = case.truth.rpartition(".")
        simulator = plain.with_effects(effects()[name](port))
        given = {
            f"{case.truth}.{parameter}": torch.tensor(value, dtype=torch.float64)
            for parameter, value in case.values.items()
        }
    # The arm rests at first.
    rollouts = npdr.Rollouts.from_arrays(
        readings=[np.concatenate((r, 0.0 * r), axis=1) for r in case.rollouts.readings],
        actions=list(case.rollouts.actions),
        channel_names=["hinge", "hinge_velocity"],
        action_names=["servo"],
        time_step=0.01,
    )
    inputs = rollouts.inputs(segment_length=None, initial_state="recorded")
    measured = rollouts.observation(None)[..., 0]
    error = float((simulator.simulate(given, inputs)[..., 0] - measured).abs().max())
    without = float((plain.simulate({}, inputs)[..., 0] - measured).abs().max())
    assert error < (PROFILE if kind == "acceleration_limit" else FIRST_ORDER)
    assert not case.truth or without > 10 * error
