"""Which signals of a log are the columns of a model."""

import pytest

from npdr_ppl.language.channels import Channel, Follower
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.rollouts.logs.inspection import SignalSummary
from npdr_ppl.rollouts.logs.matching import can_be_left_out, columns_of, matched
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
    return {name: (match.signal.name, match.doubt) for name, match in matches.items()}


PLACE = "by its place among the others"


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
    for column, (signal, doubt) in found_by_name.items():
        joint = column.removesuffix("_velocity").removesuffix("_command")
        assert joint in signal and not doubt


def test_the_name_with_the_fewest_other_words_matches():
    names = ["wrist_shoulder_position", "shoulder_position", "upper_arm_position"]
    assert found(COLUMNS, names)["shoulder"] == ("shoulder_position", "")


def test_other_names_are_taken_in_their_order_if_no_name_contradicts_it():
    assert found(COLUMNS, ["Rotation_pos", "upper_arm_pos"]) == {
        "shoulder": ("Rotation_pos", PLACE),
        "upper_arm": ("upper_arm_pos", ""),
    }
    assert found(COLUMNS, ["upper_arm_pos", "Rotation_pos"]) == {
        "upper_arm": ("upper_arm_pos", "")
    }


def test_joints_may_be_counted_from_zero():
    columns = columns_of([Channel("joint_1", "rad"), Channel("joint_2", "rad")], [])
    assert found(columns, ["q0", "q1"]) == {"joint_1": ("q0", PLACE), "joint_2": ("q1", PLACE)}
    assert found(columns, ["q2", "q1"]) == {"joint_1": ("q1", ""), "joint_2": ("q2", "")}
    doubt = "by its number; some count from 0"
    three = ["q2", "q0", "q1"]
    assert found(columns, three) == {"joint_1": ("q1", doubt), "joint_2": ("q2", doubt)}


def test_numbered_signals_in_alphabetical_order_are_taken_by_number():
    columns = columns_of([Channel(f"joint_{k}", "rad") for k in range(1, 12)], [])
    names = sorted(f"q{k}" for k in range(11))
    assert [signal for signal, _ in found(columns, names).values()] == [f"q{k}" for k in range(11)]


def test_of_two_columns_the_closer_one_gets_a_signal():
    columns = columns_of([Channel("wrist", "rad"), Channel("wrist_roll", "rad")], [])
    names = ["wrist_roll_pos", "forearm_pos"]
    assert found(columns, names) == {"wrist_roll": ("wrist_roll_pos", "")}


def test_a_name_that_says_something_else_is_doubted():
    assert found(columns_of([Channel("shoulder", "rad")], []), ["elbow_pos"]) == {
        "shoulder": ("elbow_pos", PLACE)
    }
    assert not found(columns_of([Channel("level", "1")], []), ["temperature"])


def test_a_measurement_that_never_changes_is_no_match():
    signals = [SignalSummary("shoulder_vel", "", 0.0, 0.0, "velocity")]
    assert not matched(columns_of(SENSORS, []), signals)


def test_the_only_signal_of_a_role_matches_whatever_its_name():
    sensors = [Channel("angle", "rad"), Channel("velocity", "rad/s", rate_of="angle")]
    columns = columns_of(sensors, [Channel("torque", "N m")])
    names = ["position", "velocity", "tau"]
    assert found(columns, names) == {
        "angle": ("position", ""),
        "velocity": ("velocity", ""),
        "torque": ("tau", "may be a measurement"),
    }


def test_an_effort_is_no_command_beside_commands():
    names = ["arm_angle", "pole_angle", "motor_voltage", "motor_current"]
    columns = columns_of(Furuta.sensors, Furuta.actions)
    assert found(columns, names) == {
        "arm_angle": ("arm_angle", ""),
        "pole_angle": ("pole_angle", ""),
        "voltage": ("motor_voltage", ""),
    }


def test_an_effort_that_is_a_sensor_is_no_command():
    sensors = [Channel("angle", "rad"), Channel("motor_current", "A")]
    columns = columns_of(sensors, [Channel("voltage", "V")])
    assert found(columns, ["angle", "motor_current"]).keys() == {"angle", "motor_current"}


def test_a_signal_with_the_name_of_a_column_is_that_column():
    # No word of these names says what they are.
    names = ["upper_arm", "shoulder", "upper_arm_position", "upper_arm_command"]
    matches = found(COLUMNS, names)
    assert matches["shoulder"] == ("shoulder", "")
    assert matches["upper_arm"] == ("upper_arm", "")
    assert matches["upper_arm_command"] == ("upper_arm_command", "")
    signals = [SignalSummary("shoulder", "", 0.0, 0.0, "other")]
    assert "shoulder" not in matched(COLUMNS, signals)  # it never changes


def test_a_position_matches_a_name_that_does_not_say_what_it_measures():
    columns = columns_of([Channel("x", "m"), Channel("pitch", "rad")], [])
    assert found(columns, ["mocap_x", "mocap_y", "mocap_pitch_deg"]) == {
        "x": ("mocap_x", "its name does not say what it measures"),
        "pitch": ("mocap_pitch_deg", ""),
    }


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("Z_mm", "mm", "position"),
        ("J1_dps", "deg/s", "velocity"),
        ("J1_deg", "deg/s", "velocity"),
        ("cmd_Z_mm", "mm", "command"),
        ("tracking_error_mm", "mm", "other"),
        ("distance", "m", "other"),
    ],
)
def test_a_unit_tells_what_a_name_does_not(name, unit, role):
    assert role_of(name, unit) == role


FLOATING = columns_of(
    [
        *(Channel(f"root_{axis}", "m") for axis in "xyz"),
        *(Channel(f"root_q{axis}", "1") for axis in "wxyz"),
        *(Channel(f"root_{axis}_velocity", "m/s", rate_of=f"root_{axis}") for axis in "xyz"),
        *(Channel(f"root_{axis}_spin", "rad/s") for axis in "xyz"),
    ],
    [Channel(f"thrust{number}", "1") for number in range(1, 5)],
)


@pytest.mark.parametrize(
    "parts",
    [
        ("{}", "q{}", "v{}", "gyro_{}"),
        ("pose.position.{}", "pose.orientation.{}", "twist.linear.{}", "twist.angular.{}"),
        ("/mocap/position/{}", "/mocap/quaternion/{}", "vel_{}", "omega_{}"),
        ("pos{}", "quat_{}", "Vel{}", "angularVelocity.{}"),
    ],
)
def test_the_parts_of_a_floating_bodys_pose_are_told_by_their_names(parts):
    position, orientation, velocity, spin = parts
    names = [
        *(position.format(axis) for axis in "xyz"),
        *(orientation.format(axis) for axis in "xyzw"),
        *(velocity.format(axis) for axis in "xyz"),
        *(spin.format(axis) for axis in "xyz"),
        "accel_x", "mag_x", "battery",
        *(f"motor{number}" for number in range(1, 5)),
    ]  # fmt: skip
    matches = found(FLOATING, names)
    assert [matches[f"root_{axis}"][0] for axis in "xyz"] == names[:3]
    assert [matches[f"root_q{axis}"][0] for axis in "xyzw"] == names[3:7]
    assert [matches[f"root_{axis}_velocity"][0] for axis in "xyz"] == names[7:10]
    assert [matches[f"root_{axis}_spin"][0] for axis in "xyz"] == names[10:13]
    assert matches["root_qw"][1] == "check that it is from the body's frame to the world's"
    assert [matches[f"thrust{number}"][0] for number in range(1, 5)] == names[-4:]


def test_a_floating_body_may_have_any_name():
    hull = [c._replace(name=c.name.replace("root", "hull")) for c in FLOATING]
    names = ["x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "gyro_x"]
    matches = found(hull, names)
    assert [matches[f"hull_{axis}"][0] for axis in "xyz"] == names[:3]
    assert matches["hull_y_velocity"][0] == "vy" and matches["hull_x_spin"][0] == "gyro_x"


@pytest.mark.parametrize("motor", ["motor{}", "rotor_{}", "thrust[{}]", "esc_{}"])
def test_commands_are_no_part_of_a_pose(motor):
    names = [f"q{axis}" for axis in "wxyz"]
    names += [motor.format(number) for number in range(1, 5)]
    assert found(FLOATING, names)["thrust1"][0] == motor.format(1)
    matches = found(FLOATING, [*names, "target_position_x"])
    assert "root_x" not in matches and matches["root_qz"][0] == "qz"


def test_two_signals_for_a_part_of_a_pose_are_left_to_the_user():
    assert "root_x" not in found(FLOATING, ["mocap.position.x", "ekf.position.x"])


def test_of_two_fingers_the_one_that_a_signal_names_is_measured():
    fingers = [Channel("finger_joint1", "m"), Channel("finger_joint2", "m")]
    both_ways = [
        Follower("finger_joint1", "finger_joint2", (0.0, 1.0)),
        Follower("finger_joint2", "finger_joint1", (0.0, 1.0)),
    ]
    columns = columns_of([Channel("wrist", "rad"), *fingers], [], both_ways)
    for finger in ("finger_joint1", "finger_joint2"):
        matches = found(columns, ["wrist_pos", f"{finger}_pos"])
        assert matches == {"wrist": ("wrist_pos", ""), finger: (f"{finger}_pos", "")}
        (other,) = (column for column in columns[1:] if column.name != finger)
        assert can_be_left_out(other, columns, matches)
    # One direction only: the leader has to be measured.
    columns = columns_of(fingers, [], both_ways[:1])
    assert not can_be_left_out(columns[1], columns, {"finger_joint1"})
