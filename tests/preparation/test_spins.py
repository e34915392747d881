"""Spins of a floating body at the starts of segments, where they were not measured."""

from types import SimpleNamespace

import pytest
import torch

from npdr_ppl.language.channels import Spin
from npdr_ppl.preparation.initial_states import InitialStates, with_spins

QUATERNION = ("qw", "qx", "qy", "qz")
SPINS = ("x_spin", "y_spin", "z_spin")
SIMULATOR = SimpleNamespace(followers=[Spin(n, k, QUATERNION) for k, n in enumerate(SPINS)])


def states(orientation, spin):
    """Returns initial states of a turning body, with its spins unknown."""
    w, turn = orientation[:, :1], orientation[:, 1:]
    rate = 0.5 * torch.cat(
        [-(turn * spin).sum(1, keepdim=True), w * spin + torch.linalg.cross(turn, spin)], dim=1
    )
    unknown = torch.full_like(spin, 7.0)
    values, rates = torch.cat((orientation, unknown), 1), torch.cat((rate, unknown), 1)
    return InitialStates(values, rates, torch.full_like(values, 0.1), torch.full_like(values, 0.1))


def random_motion():
    generator = torch.Generator().manual_seed(0)
    orientation = torch.randn(20, 4, generator=generator).double()
    spin = torch.randn(20, 3, generator=generator).double()
    return orientation / orientation.norm(dim=1, keepdim=True), spin


def test_spins_follow_from_orientations_and_their_rates():
    orientation, spin = random_motion()
    recording = SimpleNamespace(channel_names=(*QUATERNION, *SPINS), measured_names=QUATERNION)
    found = with_spins(states(orientation, spin), SIMULATOR, recording)
    assert found.values[:, 4:] == pytest.approx(spin.numpy())
    assert found.values[:, :4] == pytest.approx(orientation.numpy())
    # All parts of the quaternion's rate have the error 0.1, and a spin is twice one of them.
    assert found.value_errors[:, 4:] == pytest.approx(0.2)
    assert not found.rate_errors[:, 4:].any() and found.rate_errors[:, :4].all()


@pytest.mark.parametrize(
    ("recorded", "measured"),
    [((*QUATERNION, *SPINS), (*QUATERNION, *SPINS)), ((*QUATERNION[1:], *SPINS), QUATERNION[1:])],
    ids=["measured", "no quaternion"],
)
def test_other_recordings_are_left_alone(recorded, measured):
    known = states(*random_motion())
    recording = SimpleNamespace(channel_names=recorded, measured_names=measured)
    assert with_spins(known, SIMULATOR, recording) is known
