"""Rigs with one hidden effect: what is drawn, and that it is the same every time."""

import pytest

from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.furuta_hidden_rigs import HIDDEN, hidden_rig
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.models.furuta_targets import furuta_target

RANGES = {
    "delay": {"input_delay": (0.015, 0.025)},
    "friction": {"arm_friction": (3e-3, 5e-3), "pole_friction": (3e-4, 5e-4)},
    "dead-zone": {"voltage_dead_zone": (0.3, 0.6)},
}
EFFECTS = ("input_delay", "arm_friction", "pole_friction", "voltage_dead_zone")


@pytest.mark.parametrize("kind", HIDDEN)
def test_a_rig_has_one_effect_of_the_size_that_was_asked_for(kind):
    nominal = {parameter.name: parameter.nominal for parameter in Furuta.parameters}
    for seed in range(20):
        rig = hidden_rig(kind, seed)
        assert rig == hidden_rig(kind, seed) != hidden_rig(kind, seed + 1)
        for name in EFFECTS:
            low, high = RANGES[kind].get(name, (0.0, 0.0))
            assert low <= getattr(rig, name) <= high
        assert rig.velocity_time_constant == FurutaRig().velocity_time_constant
        assert rig.tilt == FurutaRig().tilt
        for name, value in rig.parameters.items():
            if "damping" not in name:
                assert abs(value / nominal[name] - 1.0) <= 0.15


def test_rigs_of_a_seed_are_not_the_same_device():
    rigs = [hidden_rig(kind, 3).parameters["arm_mass"] for kind in HIDDEN]
    assert len(set(rigs)) == len(HIDDEN)


@pytest.mark.parametrize("kind", HIDDEN)
def test_they_are_targets_by_their_names(kind):
    target = furuta_target(f"furuta-{kind}-12")
    assert target.name == f"furuta-{kind}-12"
    assert target._rig == hidden_rig(kind, 12)
