"""The sizes in which candidate effects are simulated."""

import pytest
import torch

from npdr_ppl.discovery.screening.probes import probe_of
from npdr_ppl.discovery.screening.settings import SENSITIVITY
from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import ActuatorLag, Contact, CoulombFriction
from tests.helpers.exported_robots import ARM


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(integrator="Euler", friction=0.0, spring=""))
    return MujocoSimulator(path, time_step=0.01)


def sizes_of(effect, arm):
    inputs = Inputs.single(
        torch.ones(10, 2).double(),
        torch.zeros(len(arm.states)).double(),
        action_names=tuple(action.name for action in arm.actions),
        state_names=tuple(state.name for state in arm.states),
        time_step=0.01,
    )
    return {size for _, _, size in probe_of(effect, inputs, arm, None).cases}


def test_contact_is_tried_weaker_and_stronger(arm):
    """A foot that sticks does so with more friction, too; only with less does it slip."""
    typical = set(SENSITIVITY.sizes)
    assert sizes_of(Contact("contact"), arm) == typical | {-size for size in typical}


def test_what_cannot_be_negative_is_not_tried_there(arm):
    assert sizes_of(ActuatorLag("motor"), arm) == set(SENSITIVITY.sizes)
    friction = CoulombFriction(arm.joints[0])
    assert sizes_of(friction, arm) == {SENSITIVITY.smooth_size}
