"""Mini golf: kinematics, contacts against textbook physics, and the simulator's duties."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.pooled.pool_simulator import Segment
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.prior import Prior
from npdr_ppl.models.effects import InputDelay
from npdr_ppl.models.mini_golf import MiniGolf, mini_golf, mini_golf_two_restitutions
from npdr_ppl.models.mini_golf.clubs import ClubHead
from npdr_ppl.models.mini_golf.course import CLUB_MASS, HOLE, StrikeParameters
from npdr_ppl.models.mini_golf.kinematics import JOINTS, Pose, head_path
from npdr_ppl.models.mini_golf.scene import GRAVITY, SUB_STEPS, Scene

RECORDING = Path(__file__).parents[2].parent / "shared/data/mini_golf/strike_100hz_8s.csv"
needs_recording = pytest.mark.skipif(
    not RECORDING.exists(), reason=f"the recordings {RECORDING} are absent"
)

TIME_STEP = 0.01
SWING_START = (18.996, -87.227, 74.150, -75.577, 56.207, -175.163, -41.544)
SWING_END = (8.629, -93.443, 72.302, -82.318, 52.147, -183.896, -51.561)

PLAIN = StrikeParameters(
    ball_radius=0.02,
    ball_mass=0.005,
    club_restitution=1.0,
    obstacle_restitution=0.0,
    ball_rolling_friction=0.0,
    ball_friction=0.6,
    ball_inertia_factor=0.4,
    ground_friction=0.4,
    hole_radius=0.025,
    obstacle_shifts=((0.0, -10.0, 0.0), (0.0, -10.0, 0.0)),  # out of the way
)
HEAD_SPEED = 0.5


@pytest.fixture(scope="module")
def scene():
    scene = Scene()
    yield scene
    scene.close()


class Straight(ClubHead):
    """A head that follows given poses instead of joint angles."""

    def __init__(self, poses):
        super().__init__(np.empty((0, 7)), TIME_STEP / SUB_STEPS, SUB_STEPS, GRAVITY)
        self.poses = poses


def strike(scene, parameters, *, y=0.0, x=0.1, num_steps=100, speed=HEAD_SPEED):
    """A head that moves 6 cm along x and then stands; the ball lies 5 cm ahead of it."""
    time = np.arange(num_steps * SUB_STEPS + 1) * TIME_STEP / SUB_STEPS
    position = np.zeros((len(time), 3))
    position[:] = x - 0.05, y, parameters.ball_radius
    position[:, 0] += np.minimum(speed * time, 0.06)
    rotation = np.broadcast_to(Pose.of(0, 0, 0, 0, 90, 0).rotation, (len(time), 3, 3))
    return scene.strike(
        parameters, np.array((x, y)), Straight(Pose(position, rotation)), TIME_STEP
    )


def speeds(positions):
    return np.linalg.norm(np.diff(positions, axis=0), axis=-1) / TIME_STEP


def swing(num_steps=60, *, moving=True):
    """Inputs of the paper's strike: joints linear in time over half a second, then at rest."""
    share = torch.clamp(torch.arange(num_steps, dtype=torch.float64) / 50, max=1.0)[:, None]
    start, end = (torch.deg2rad(torch.tensor(v).double()) for v in (SWING_START, SWING_END))
    angles = start + share * (end - start) * (1.0 if moving else 0.0)
    return Inputs.single(
        angles,
        torch.cat([torch.tensor((0.304, 1.298)).double(), angles[0]]),
        action_names=tuple(action.name for action in MiniGolf.actions),
        state_names=tuple(state.name for state in MiniGolf.states),
        time_step=TIME_STEP,
    )


def test_kinematics_puts_the_head_where_the_rig_read_it_at_the_strikes_start():
    angles = np.deg2rad([SWING_START])
    # The recording's first sample differs from the planned start by some hundredths of a degree.
    np.testing.assert_allclose(head_path(angles).position[0], (0.221, 1.297, 0.018), atol=2e-3)


@needs_recording
def test_kinematics_reproduces_the_rigs_own_reading():
    rollouts = npdr.Rollouts.load(RECORDING)
    angles = rollouts.readings[0][:1, 2:]
    found = head_path(angles).position[0]
    np.testing.assert_allclose(found, (0.22100, 1.29692, 0.01833), atol=1e-5)


def test_joint_ranges_contain_the_strike():
    for joint, first, last in zip(JOINTS, SWING_START, SWING_END, strict=True):
        assert joint.lower < np.deg2rad(min(first, last))
        assert np.deg2rad(max(first, last)) < joint.upper


def test_velocities_of_a_path_are_those_of_its_positions():
    time = np.arange(41) * 0.0025
    turn = np.stack([Pose.of(0, 0, 0, 0, 0, 90 * t).rotation for t in time])
    poses = Pose(np.stack([time, 0 * time, 2 * time], -1), turn)
    club = Straight(poses)
    held_up = (0.0, 0.0, GRAVITY * 0.0025)
    np.testing.assert_allclose(np.array(club.velocities) - held_up, [[1, 0, 2]] * 40)
    np.testing.assert_allclose(club.rates, [[0, 0, np.pi / 2]] * 40, atol=1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0, 1.5])
def test_the_head_passes_on_its_momentum(scene, restitution):
    """v = (1 + e) u M / (M + m): twice the head's speed at e = 1, its own at e = 0."""
    smooth = replace(PLAIN, club_restitution=restitution, ball_friction=0.0)
    launched = speeds(strike(scene, smooth))[-1]
    expected = (1 + restitution) * HEAD_SPEED * CLUB_MASS / (CLUB_MASS + PLAIN.ball_mass)
    assert launched == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("factor", "share"), [(0.4, 5 / 7), (2 / 3, 3 / 5)])
def test_a_sliding_ball_comes_to_roll(scene, factor, share):
    """A launched ball keeps 1/(1 + I/(m r²)) of its speed once it rolls."""
    speed = speeds(strike(scene, replace(PLAIN, ball_inertia_factor=factor)))
    smooth = speeds(strike(scene, replace(PLAIN, ball_friction=0.0)))
    assert speed[-1] == pytest.approx(share * smooth[-1], rel=0.02)
    assert speed[-1] == pytest.approx(speed[-20], rel=1e-3)


def test_sliding_decelerates_by_the_product_of_frictions(scene):
    speed = speeds(strike(scene, PLAIN))
    fastest = int(speed.argmax())
    deceleration = (speed[fastest] - speed[fastest + 5]) / (5 * TIME_STEP)
    assert deceleration == pytest.approx(0.6 * 0.4 * GRAVITY, rel=0.02)


def test_rolling_decelerates_by_the_rolling_friction(scene):
    """a = g ρ / (r (1 + 2/5)), where Bullet's ρ is the ball's times the ground's friction."""
    rough = replace(PLAIN, ball_rolling_friction=5e-4)
    speed = speeds(strike(scene, rough, num_steps=120))
    deceleration = (speed[70] - speed[110]) / (40 * TIME_STEP)
    assert deceleration == pytest.approx(GRAVITY * 5e-4 * 0.4 / (0.02 * 1.4), rel=0.02)


@pytest.mark.parametrize("speed", [0.1, 0.2, 0.3, 0.5])
def test_the_hole_holds_the_ball(scene, speed):
    positions = strike(scene, PLAIN, x=HOLE[0] - 0.2, y=HOLE[1], num_steps=500, speed=speed)
    assert np.linalg.norm(positions[-1] - HOLE) < 0.03
    np.testing.assert_array_equal(positions[-1], positions[-20])


def test_a_ball_that_nothing_strikes_lies_still(scene):
    positions = strike(scene, PLAIN, speed=0.0)
    np.testing.assert_allclose(positions, [[0.1, 0.0]] * 100, atol=1e-6)


def test_a_wall_throws_the_ball_back(scene):
    """Off the end rail, whose face is at x = 1.40, with the obstacles' restitution."""
    bouncy = replace(PLAIN, obstacle_restitution=0.5, ball_friction=0.0)
    positions = strike(scene, bouncy, x=1.2, y=1.1, num_steps=45)
    before, after = np.diff(positions[:, 0])[[15, -1]] / TIME_STEP
    assert positions[:, 0].max() == pytest.approx(1.40 - 0.02, abs=3e-3)
    assert after == pytest.approx(-0.5 * before, rel=0.02)


def test_strikes_do_not_depend_on_what_was_simulated_before(scene):
    first = strike(scene, PLAIN)
    strike(scene, replace(PLAIN, ball_radius=0.026, ball_rolling_friction=3e-4), y=0.3)
    np.testing.assert_array_equal(strike(scene, PLAIN), first)
    other = Scene()
    np.testing.assert_array_equal(strike(other, PLAIN), first)
    other.close()


@pytest.mark.slow
def test_prior_draws_are_finite_and_the_same_in_batches_and_alone():
    inputs = swing(120)
    prior = Prior(mini_golf, (inputs,))
    z = prior.sample(24)
    together = prior.execute(z)["trajectory"]
    assert together.shape == (24, 1, 120, 9)
    assert bool(torch.isfinite(together).all())
    alone = torch.cat([prior.execute(row[None])["trajectory"] for row in z[20:]])
    torch.testing.assert_close(together[20:], alone, rtol=0, atol=0)
    moved = (together[:, 0, -1, :2] - inputs.initial_values[0, :2]).norm(dim=-1)
    assert int((moved > 0.05).sum()) > 12


def test_joints_are_replayed_exactly():
    inputs = swing(60)
    trajectory = MiniGolf().simulate({}, inputs)
    torch.testing.assert_close(trajectory[0, :-1, 2:], inputs.actions[0, 1:], rtol=0, atol=0)
    torch.testing.assert_close(trajectory[0, -1, 2:], inputs.actions[0, -1], rtol=0, atol=0)


def test_without_a_swing_the_ball_stays():
    trajectory = MiniGolf().simulate({}, swing(40, moving=False))
    assert float((trajectory[0, :, :2] - torch.tensor((0.304, 1.298)).double()).abs().max()) < 1e-6


def test_a_livelier_club_strikes_further():
    inputs = swing(45)
    free = {"left_shift_y": torch.tensor(-9.0), "right_shift_y": torch.tensor(-9.0)}
    factor = {"club_restitution": torch.tensor([0.0, 1.0, 2.0])}
    ends = MiniGolf().simulate(free | factor, inputs)[:, 0, -1, 0]
    assert bool((ends.diff() > 0.01).all())


def test_the_second_model_separates_the_restitutions():
    prior = Prior(mini_golf_two_restitutions, (swing(5),))
    names = [site.name for site in prior.sites]
    assert len(names) == 11
    assert {"club_restitution", "obstacle_restitution"} < set(names)
    assert "ball_restitution" not in names


def test_segments_that_begin_under_way_are_refused():
    inputs = replace(swing(20), start=torch.tensor([10]))
    with pytest.raises(DataError, match="whole strikes"):
        MiniGolf().simulate({}, inputs)


def test_effects_of_commands_and_readings_apply():
    inputs = swing(30)
    lagging = MiniGolf().with_effects(InputDelay(port="joint_1_command"))
    delay = {"joint_1_command.input_delay.delay": torch.tensor(0.05)}
    moved = lagging.simulate(delay, inputs)[0, :, 2]
    plain = MiniGolf().simulate({}, inputs)[0, :, 2]
    torch.testing.assert_close(moved[5:-1], plain[:-6])


def test_the_whole_arm_strikes_as_the_head_alone():
    inputs = swing(80)
    draws = {"ball_restitution": torch.tensor([0.0, 0.5, 1.0])}
    head, arm = (MiniGolf(club).simulate(draws, inputs)[:, 0, :, :2] for club in ("head", "arm"))
    away = (head[:, -1] - head[:, 0]).norm(dim=-1)
    assert bool((away > 0.1).all())
    assert bool(((arm - head).norm(dim=-1).amax(-1) < 0.03 * away).all())


def test_an_unknown_club_is_refused():
    with pytest.raises(ModelError, match="'head' or 'arm'"):
        MiniGolf("putter")


@pytest.mark.parametrize("club", ["head", "arm"])
def test_shortcuts_out_of_the_clubs_reach_change_nothing(monkeypatch, club):
    """Only near the club are sub-steps made one by one, and only there is it moved."""
    simulator = MiniGolf(club)
    workspace = simulator.set_up()
    given = swing(150)
    start = torch.stack(simulator.initial_states(given), dim=-1)[0].numpy()
    segment = Segment(start, given.actions[0].numpy(), TIME_STEP, 0.0)
    parameters = {parameter.name: parameter.nominal for parameter in simulator.parameters}
    quick = simulator.simulate_one(workspace, parameters, segment, 0)
    monkeypatch.setattr("npdr_ppl.models.mini_golf.scene.REACH", 100.0)
    thorough = simulator.simulate_one(workspace, parameters, segment, 0)
    assert np.linalg.norm(quick[-1, :2] - quick[0, :2]) > 0.3
    np.testing.assert_allclose(quick, thorough, rtol=0, atol=1e-9 if club == "head" else 1e-6)
    workspace.scene.close()
