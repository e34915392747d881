"""The simulator of one strike: it replays joint angles and returns the ball's path."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator, Segment
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.mini_golf.clubs import Club, ClubKind, club_of
from npdr_ppl.models.mini_golf.course import StrikeParameters
from npdr_ppl.models.mini_golf.kinematics import JOINTS
from npdr_ppl.models.mini_golf.scene import GRAVITY, SETTINGS, SUB_STEPS, Scene

__all__ = ["MiniGolf", "Workspace"]

Array = NDArray[np.float64]

_BALL = (Channel("ball_x", "m"), Channel("ball_y", "m"))
_ANGLES = tuple(
    Channel(f"joint_{i}", "rad", joint.lower, joint.upper) for i, joint in enumerate(JOINTS, 1)
)
_COMMANDS = tuple(
    Channel(f"{angle.name}_command", "rad", angle.lower, angle.upper) for angle in _ANGLES
)


class Workspace:
    """A scene, and the club with the path of the latest joint angles.

    Attributes:
        scene: The connection to Bullet.
    """

    def __init__(self) -> None:
        self.scene = Scene()
        self._key: tuple[bytes, float] | None = None
        self._club: Club | None = None

    def club(self, kind: ClubKind, angles: Array, time_step: float) -> Club:
        """Returns the club for joint angles at the boundaries of steps, ``(K + 1, 7)`` in rad.

        Between the boundaries the angles are linear in time. The club is kept, because thousands
        of draws share one swing and its kinematics take as long as a strike.
        """
        key = (angles.tobytes(), time_step)
        if self._club is None or key != self._key:
            bounds = np.arange(len(angles))
            time = np.arange((len(angles) - 1) * SUB_STEPS + 1) / SUB_STEPS
            fine = np.stack([np.interp(time, bounds, joint) for joint in angles.T], axis=-1)
            self._club = club_of(kind, fine, time_step / SUB_STEPS, SUB_STEPS, GRAVITY)
            self._key = key
        return self._club


class MiniGolf(PooledSimulator):
    """A robot arm strikes a golf ball, which rolls past two obstacles towards a hole.

    The arm follows its commands exactly. A command is the joints' position at its own time, and
    between two commands they move linearly. The club head's pose and velocity follow by forward
    kinematics. Rigid-body contacts with the ball are PyBullet's; see
    :mod:`npdr_ppl.models.mini_golf.scene` for how they are solved.

    Bullet multiplies restitutions. The ball's is a factor of all rebounds. The club's and the
    obstacles' are 1 by default, so that only the ball's has an effect. The club's may exceed 1,
    because a flexible shaft returns more than the head's own motion.

    A strike is simulated from its first sample, at which the ball is at rest.

    Args:
        club: The striker: ``"head"``, the club head alone, or ``"arm"``, the whole arm as one
            multi-body. The arm launches the ball in the same way and takes several times as long
            to simulate.
    """

    states = (*_BALL, *_ANGLES)
    actions = _COMMANDS
    sensors = states
    parameters = (
        Parameter("ball_radius", "m", 0.02, "radius of the ball"),
        Parameter("ball_mass", "kg", 0.005, "mass of the ball"),
        Parameter("ball_restitution", "1", 0.5, "factor of every rebound of the ball"),
        Parameter("ball_rolling_friction", "m", 1e-5, "rolling friction of the ball"),
        Parameter("left_shift_x", "m", 0.0, "left obstacle's place, relative to the plan"),
        Parameter("left_shift_y", "m", 0.0, "left obstacle's place, relative to the plan"),
        Parameter("left_turn", "rad", 0.0, "left obstacle's angle, relative to the plan"),
        Parameter("right_shift_x", "m", 0.0, "right obstacle's place, relative to the plan"),
        Parameter("right_shift_y", "m", 0.0, "right obstacle's place, relative to the plan"),
        Parameter("right_turn", "rad", 0.0, "right obstacle's angle, relative to the plan"),
        Parameter("club_restitution", "1", 1.0, "rebound off the club, times the ball's"),
        Parameter("obstacle_restitution", "1", 1.0, "rebound off obstacles, times the ball's"),
        Parameter("ball_friction", "1", 0.6, "sliding friction of the ball, a factor"),
        Parameter("ball_inertia_factor", "1", 0.4, "I/(m r²): 2/5 solid, 2/3 hollow"),
        Parameter("ground_friction", "1", 0.4, "sliding friction of the ground, a factor"),
        Parameter("hole_radius", "m", 0.025, "radius of the sticky disc that is the hole"),
    )
    ports = (
        *(Port(action.name, "action", "rad", rated=1.0) for action in _COMMANDS),
        *(Port(channel.name, "sensor", channel.unit, rated=1.0) for channel in states),
    )
    time_step = SETTINGS.time_step

    def __init__(self, club: ClubKind = "head") -> None:
        if club not in get_args(ClubKind):
            raise ModelError(f"the club is 'head' or 'arm', not {club!r}.")
        self.club: ClubKind = club

    def recorded_settings(self) -> dict[str, Any]:
        """Returns the settings of the engine, for JSON."""
        return {"engine": "bullet", "club": self.club, **asdict(SETTINGS)}

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Simulates all strikes; see :meth:`Simulator.simulate`.

        Raises:
            DataError: A segment does not begin at the start of its rollout.
        """
        if bool(inputs.start.any()):
            raise DataError(
                f"{self.name} simulates whole strikes, from the ball at rest; leave out the "
                "segment length."
            )
        return super().simulate(parameters, inputs)

    def set_up(self) -> Workspace:
        """Returns the data that all strikes of one process share."""
        return Workspace()

    def simulate_one(
        self, workspace: Workspace, parameters: Mapping[str, float], segment: Segment, seed: int
    ) -> Array:
        """Simulates one strike; nothing in it is random.

        Args:
            workspace: What :meth:`set_up` returned.
            parameters: All parameters, in the declared units.
            segment: The commands, and the initial position of the ball.
            seed: Has no effect.

        Returns:
            Ball and joints after each step, ``(steps, 9)`` in m and rad.
        """
        # The command after the last step is not recorded, so the joints keep their position.
        angles = np.concatenate([segment.actions, segment.actions[-1:]])
        ball = workspace.scene.strike(
            _strike_parameters(parameters),
            segment.initial_state[: len(_BALL)],
            workspace.club(self.club, angles, segment.time_step),
            segment.time_step,
        )
        return np.concatenate([ball, angles[1:]], axis=-1)


def _strike_parameters(values: Mapping[str, float]) -> StrikeParameters:
    restitution = values["ball_restitution"]
    left, right = (
        (values[f"{side}_shift_x"], values[f"{side}_shift_y"], values[f"{side}_turn"])
        for side in ("left", "right")
    )
    return StrikeParameters(
        ball_radius=values["ball_radius"],
        ball_mass=values["ball_mass"],
        club_restitution=restitution * values["club_restitution"],
        obstacle_restitution=restitution * values["obstacle_restitution"],
        ball_rolling_friction=values["ball_rolling_friction"],
        ball_friction=values["ball_friction"],
        ball_inertia_factor=values["ball_inertia_factor"],
        ground_friction=values["ground_friction"],
        hole_radius=values["hole_radius"],
        obstacle_shifts=(left, right),
    )
