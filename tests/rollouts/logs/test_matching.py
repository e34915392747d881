"""Which signals of a log are the columns of a model."""

import pytest

from npdr_ppl.language.channels import Channel
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.rollouts.logs.inspection import SignalSummary
from npdr_ppl.rollouts.logs.matching import columns_of, matched
from npdr_ppl.rollouts.logs.signal_names import role_of

SENSORS = [
    Channel("shoulder", "rad"),
    Channel("upper_arm", "rad"),
    Channel("shoulder_velocity", "rad/s", rate_of="shoulder"),
    Channel("upper_arm_velocity", "rad/s", rate_of="upper_arm"),
]
ACTIONS = [Channel("shoulder_command", "rad"), Channel("upper_arm_command", "rad")]
COLUMNS = columns_of(SENSORS, ACTIONS)


def found(columns, names):
    signals = [SignalSummary(name, "", -1.0, 1.0, role_of(name)) for name in names]
    matches = matched(columns, signals)
    return {name: (match.signal.name, match.is_by_order) for name, match in matches.items()}


@pytest.mark.parametrize(
    ("joint_states", "goals"),
    [
        (["{}_position", "{}_velocity"], "{}_command"),
        (["/joint_states/{}_joint/position", "/joint_states/{}_joint/velocity"], "/cmd/{}_joint"),
        (["observation.state.{}.pos", "observation.state.{}.vel"], "action.{}.pos"),
    ],
)
def test_names_with_the_same_joint_and_role_match(joint_states, goals):
    joints = ["upper_arm", "shoulder"]  # another order than the model's
    names = [text.format(joint) for text in (*joint_states, goals) for joint in joints]
    found_by_name = found(COLUMNS, names)
    assert len(found_by_name) == len(COLUMNS)
    for column, (signal, is_by_order) in found_by_name.items():
        joint = column.removesuffix("_velocity").removesuffix("_command")
        assert joint in signal and not is_by_order


def test_the_name_with_the_fewest_other_words_matches():
    names = ["wrist_shoulder_position", "shoulder_position", "upper_arm_position"]
    assert found(COLUMNS, names)["shoulder"] == ("shoulder_position", False)


def test_other_names_are_taken_in_their_order_if_no_name_contradicts_it():
    assert found(COLUMNS, ["Rotation_pos", "upper_arm_pos"]) == {
        "shoulder": ("Rotation_pos", True),
        "upper_arm": ("upper_arm_pos", False),
    }
    assert found(COLUMNS, ["upper_arm_pos", "Rotation_pos"]) == {
        "upper_arm": ("upper_arm_pos", False)
    }


def test_joints_may_be_counted_from_zero():
    columns = columns_of([Channel("joint_1", "rad"), Channel("joint_2", "rad")], [])
    assert found(columns, ["q0", "q1"]) == {"joint_1": ("q0", True), "joint_2": ("q1", True)}
    assert found(columns, ["q2", "q1"]) == {"joint_1": ("q1", False), "joint_2": ("q2", False)}


def test_the_only_signal_of_a_role_matches_whatever_its_name():
    sensors = [Channel("angle", "rad"), Channel("velocity", "rad/s", rate_of="angle")]
    columns = columns_of(sensors, [Channel("torque", "N m")])
    names = ["position", "velocity", "tau"]
    assert found(columns, names) == {
        column.name: (name, False) for column, name in zip(columns, names, strict=True)
    }


def test_an_effort_is_no_command_beside_commands():
    names = ["arm_angle", "pole_angle", "motor_voltage", "motor_current"]
    columns = columns_of(Furuta.sensors, Furuta.actions)
    assert found(columns, names) == {
        "arm_angle": ("arm_angle", False),
        "pole_angle": ("pole_angle", False),
        "voltage": ("motor_voltage", False),
    }
