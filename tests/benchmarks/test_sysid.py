"""Rows and the table of the comparison with mujoco.sysid."""

import numpy as np
import pytest
from servo_arms_links import ARMS
from sysid import METHODS, MOST_FRICTION, commands, errors, figures, table, unknowns

ARM = ARMS["six"]


def row(method, *, friction=0.0, message=""):
    found = list(unknowns(ARM, ARM.public, "friction"))
    limits = {link.joint: link.limit for link in ARM.links}
    estimates = {
        each.name: friction * limits[each.joint]
        if each.quantity == "frictionloss"
        else 1.1 * each.truth
        for each in found
    }
    about = {"seed": 0, "set": "friction", "method": method, "message": message}
    return about | {"cpu_seconds": 2.0} | errors(found, estimates)


@pytest.mark.parametrize("which", ["drives", "friction"])
def test_twelve_parameters_lie_in_their_ranges(which):
    found = list(unknowns(ARM, ARM.public, which))
    assert len({each.name for each in found}) == 12
    assert all(each.low <= each.truth < each.high for each in found)


def test_friction_is_a_share_of_the_greatest_torque():
    found = {each.name: each for each in unknowns(ARM, ARM.public, "friction")}
    assert found["frictionloss_elbow"].high == pytest.approx(MOST_FRICTION * 150.0)
    one = row("sysid", friction=0.01)
    assert list(one["friction"].values()) == pytest.approx([0.01] * 6)
    assert list(one["relative"].values()) == pytest.approx([0.1] * 6)


def test_figures_count_reported_friction_and_failures():
    found = figures([row("sysid", friction=0.01), row("sysid"), row("sysid", message="failed")])
    assert found["joints with friction reported, of 6"] == pytest.approx(3.0)
    assert found["relative error in %, worst"] == pytest.approx(10.0)
    assert found["failed"] == 1
    assert figures([row("sysid", message="failed")]) == {"failed": 1}


def test_the_table_has_ratios_to_the_first_method():
    slow = row("closest") | {"cpu_seconds": 5.0}
    lines = list(table([row(METHODS[0]), slow]))
    assert lines[0] == "friction: damping, frictionloss; 1 recordings"
    seconds = next(line for line in lines if line.startswith("CPU seconds"))
    assert seconds.split()[-4:] == ["2", "1.00", "5", "2.50"]


def test_commands_stay_within_their_amplitudes():
    given = commands(ARM, 1.0, np.random.default_rng(0))
    assert given.shape == (500, 6)
    amplitude = [link.amplitude for link in ARM.links]
    home = [link.home for link in ARM.links]
    assert (np.abs(given - home) <= amplitude).all()
