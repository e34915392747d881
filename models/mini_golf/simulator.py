"""The simulator of one strike: joint angles replayed, the ball's course out."""

import copy
from collections.abc import Mapping
from typing import Self

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models.mini_golf.course import StrikeParameters
from npdr_ppl.models.mini_golf.kinematics import JOINTS
from npdr_ppl.models.mini_golf.strikes import Swing, available_workers, run_strikes

__all__ = ["MiniGolf"]

_BALL = (Channel("ball_x", "m"), Channel("ball_y", "m"))
_ANGLES = tuple(
    Channel(f"joint_{i}", "rad", joint.lower, joint.upper) for i, joint in enumerate(JOINTS, 1)
)
_COMMANDS = tuple(
    Channel(f"{angle.name}_command", "rad", angle.lower, angle.upper) for angle in _ANGLES
)


class MiniGolf(Simulator):
    """A robot arm strikes a golf ball, which rolls past two obstacles towards a hole.

    The arm is where it is told to be: a command is the joints' position at its own time, between
    two commands they move linearly, and the club head's pose and velocity follow by forward
    kinematics. Rigid-body contacts with the ball are PyBullet's; see
    :mod:`npdr_ppl.models.mini_golf.scene` for how they are solved.

    Bullet multiplies restitutions. The ball's is a factor of all rebounds; the club's and the
    obstacles' are 1 unless told otherwise, so that ball restitution alone decides. The club's may
    exceed 1: a flexible shaft gives back more than the head's own motion.

    A strike is simulated from its first sample, at which the ball is at rest.

    Args:
        num_workers: Processes to simulate in; ``None`` for one per core.
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
    ports = tuple(Port(action.name, "action", "rad", rated=1.0) for action in _COMMANDS)
    time_step = 0.01

    def __init__(self, num_workers: int | None = None) -> None:
        self.num_workers = available_workers() if num_workers is None else num_workers
        if self.num_workers < 1:
            raise ModelError(f"num_workers is at least 1, got {num_workers}.")

    def with_effects(self, *effects: Effect) -> Self:
        """Returns a copy if there is nothing to attach.

        Raises:
            ModelError: There is; Bullet's contacts have no place for effects yet.
        """
        if effects:
            raise ModelError(f"{self.name} takes no effects, but got {effects[0].name}.")
        return copy.copy(self)

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Simulates all strikes; see :meth:`Simulator.simulate`.

        Raises:
            DataError: A segment does not begin where its rollout does.
        """
        self.check_parameters(parameters)
        self.check_inputs(inputs)
        if bool(inputs.start.any()):
            raise DataError(
                f"{self.name} simulates whole strikes, from the ball at rest; leave out the "
                "segment length."
            )
        domain = self.nominal() | dict(parameters)
        batch_shape = torch.broadcast_shapes(
            inputs.batch_shape, *(value.shape for value in domain.values())
        )
        names = [p.name for p in self.parameters]
        columns = [domain[name].double().expand(batch_shape).reshape(-1) for name in names]
        table = torch.stack(columns, dim=-1).cpu()
        result = torch.zeros(
            (table.shape[0], inputs.num_segments, inputs.num_steps, len(self.sensors)),
            dtype=torch.float64,
        )
        for rows, element in _by_element(inputs, batch_shape):
            draws = [_strike_parameters(dict(zip(names, row))) for row in table[rows].tolist()]
            for segment in range(inputs.num_segments):
                swing = self._swing(element, segment)
                num_steps = len(swing.angles) - 1
                balls = run_strikes(swing, draws, self.num_workers)
                result[rows, segment, :num_steps, :2] = torch.from_numpy(balls)
                result[rows, segment, :num_steps, 2:] = torch.from_numpy(swing.angles[1:])
        shape = (*batch_shape, *result.shape[1:])
        return result.reshape(shape).to(inputs.actions)

    def _swing(self, inputs: Inputs, segment: int) -> Swing:
        """Returns the arm's motion in a segment and the ball's place at its start."""
        columns = [inputs.action_names.index(action.name) for action in self.actions]
        num_steps = int(inputs.mask[segment].sum())
        angles = inputs.actions[segment, :num_steps][:, columns].double().cpu().numpy()
        # What the joints were told after the last step is not on record: they hold still.
        angles = np.concatenate([angles, angles[-1:]])
        ball = torch.stack([state[..., segment] for state in self.initial_states(inputs)[:2]])
        return Swing(angles, ball.double().cpu().numpy(), inputs.time_step)


def _by_element(inputs: Inputs, batch_shape: torch.Size) -> list[tuple[Tensor, Inputs]]:
    """Returns the rows of the flat batch that share inputs, and these inputs."""
    rows = torch.arange(batch_shape.numel())
    if not inputs.batch_shape:
        return [(rows, inputs)]
    count = inputs.batch_shape.numel()
    index = torch.arange(count).reshape(inputs.batch_shape).expand(batch_shape).reshape(-1)
    return [(rows[index == i], inputs.element(i)) for i in range(count)]


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
