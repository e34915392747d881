"""Effects at a servo, which follows a position or a velocity."""

import math
from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import (
    ActionEffect,
    Commands,
    EnvironmentEffect,
    ServoEffect,
    Uneven,
)
from npdr_ppl.models.effects.references import ASTROM_1995, DYNAMIXEL, MUJOCO, TAO_1996

__all__ = [
    "GoalAccelerationLimit",
    "GoalResolution",
    "GoalSpeedLimit",
    "IntegralAction",
    "ServoDeadBand",
    "ServoForceLimit",
    "ServoGain",
]

# A limit may be anything between tight and unnoticeable. This is the standard deviation of its
# logarithm: a factor of e either way.
_SPREAD = 1.0
# A force limit is not declared where it matters: a factor of 4 either way.
_FORCE_SPREAD = 1.5

# Least divisor, so that a limit of zero gives no NaN.
_LEAST = 1e-300


class ServoGain(EnvironmentEffect):
    """K (1 + ε): a servo's force per unit of error differs from the declared one.

    The damping of a position servo stays; an error of it acts as viscous friction does.
    """

    id = "servo_gain"
    port_kinds = ("servo",)
    parameters = (Parameter("error", "1", 0.0, "relative error ε of the gain"),)
    law = "(1 + ε) K (u − q)"
    excitation = "payload"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 20 %, because gains are seldom documented in SI units."""
        return {"error": dist.Normal(0.0, 0.2)}

    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the servo with the changed gain."""
        return value._replace(gain=(1.0 + parameters["error"]) * value.gain)


class ServoForceLimit(EnvironmentEffect):
    """clip(f, ±f_max): the servo's force has a limit, that of its current or its supply."""

    id = "servo_force_limit"
    port_kinds = ("servo",)
    parameters = (
        Parameter("limit", "{force}", math.inf, "greatest force f_max, before the gear"),
    )
    is_smooth = False
    law = "clip(f, ±f_max)"
    excitation = "wide_range"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Log-normal about the rated force."""
        return {"limit": dist.LogNormal(math.log(port.rated_force), _FORCE_SPREAD)}

    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the servo with the lower one of both limits."""
        return value._replace(limit=torch.minimum(value.limit, parameters["limit"]))


class ServoDeadBand(ServoEffect):
    """K sign(e) max(|e| − δ, 0): the servo does not act on errors up to δ."""

    id = "servo_dead_band"
    parameters = (Parameter("width", "{coordinate}", 0.0, "half width δ"),)
    is_smooth = False
    law = "K sign(e) max(|e| − δ, 0), e = u − q"
    excitation = "slow_ramp"
    reference = TAO_1996

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 1 % of the rated excursion."""
        return {"width": dist.HalfNormal(0.01 * port.rated_position)}

    def act(
        self, error: Tensor, parameters: Mapping[str, Tensor], memory: Tensor | None
    ) -> Tensor:
        """Returns e − clip(e, ±δ), an equal expression."""
        width = parameters["width"]
        return error - error.clamp(-width, width)


class IntegralAction(ServoEffect):
    """K (e + w), ẇ = r e while |w| < w_max: a servo with integral action that cannot wind up.

    The integral part w stays within a limit, as in the position loops of servo drives. As a
    rollout begins, w is zero: the servo has just been switched on at its goal.
    """

    id = "servo_integral_action"
    parameters = (
        Parameter("rate", "1/s", 0.0, "integral gain relative to K, 1/Tᵢ"),
        Parameter("limit", "{coordinate}", math.inf, "greatest integral part w_max of the error"),
    )
    strength = ("rate",)
    # At a typical rate the integral part is at its limit most of the time, at a small one hardly
    # ever.
    is_smooth = False
    law = "K (e + w), ẇ = r e, |w| ≤ w_max"
    excitation = "hold"
    reference = ASTROM_1995

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal, 3/s; log-normal about 5 % of the rated excursion."""
        return {
            "rate": dist.HalfNormal(3.0),
            "limit": dist.LogNormal(math.log(0.05 * port.rated_position), _SPREAD),
        }

    def initial_memory(self, error: Tensor) -> Tensor:
        """Returns an integral part of zero."""
        return torch.zeros_like(error)

    def act(
        self, error: Tensor, parameters: Mapping[str, Tensor], memory: Tensor | None
    ) -> Tensor:
        """Returns e + w."""
        assert memory is not None
        return error + memory

    def next_memory(
        self,
        error: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Tensor | None,
        time_step: float,
    ) -> Tensor:
        """Returns w + h r e within its limit."""
        assert memory is not None
        grown = memory + time_step * parameters["rate"] * error
        return torch.maximum(torch.minimum(grown, parameters["limit"]), -parameters["limit"])


class _GoalEffect(ActionEffect):
    """An effect on the goal of a servo that follows its joint's position."""

    port_kinds = ("servo",)
    is_smooth = False
    reference = DYNAMIXEL

    def suits(self, port: Port) -> bool:
        """Returns whether the servo follows its joint's position."""
        return port.follows_position


class GoalSpeedLimit(_GoalEffect):
    """|ġ| ≤ v: the servo follows a goal g that approaches the commanded one at a limited speed."""

    id = "goal_speed_limit"
    parameters = (Parameter("limit", "{port}/s", math.inf, "greatest speed v"),)
    law = "|ġ| ≤ v"
    excitation = "steps"

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Log-normal; about the rated excursion per second."""
        return {"limit": dist.LogNormal(math.log(port.rated_position), _SPREAD)}

    def initial_memory(self, command: Tensor, start: Start) -> Tensor:
        """Returns the command, which the goal has reached."""
        return command

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Uneven, Any]:
        """Returns the goal during the step, and at its end."""
        furthest = parameters["limit"] * time_step
        command = commands.now()
        distance = command - memory
        arrives = distance.abs() <= furthest
        # The share of the step in which it moves.
        share = torch.where(arrives, distance.abs() / furthest.clamp_min(_LEAST), 1.0)
        travel = torch.where(arrives, distance, furthest * distance.sign())
        goal = torch.where(arrives, command, memory + travel)
        late = 0.5 * share * travel
        moment = share * travel * time_step**2 * (0.25 - share / 6.0)
        return Uneven(goal - late, moment), goal


class GoalAccelerationLimit(_GoalEffect):
    """|g̈| ≤ a: the servo follows a goal g that speeds up and brakes at a limited rate.

    The goal moves as fast as it can and still stop at the command, as the profile generators of
    servos do. With a constant acceleration in a step of length h, it travels h (w + w')/2 from the
    speed w to w'. From there it can stop within the rest of the distance d if
    w'² = 2 a (d − h (w + w')/2), which gives w'.
    """

    id = "goal_acceleration_limit"
    parameters = (Parameter("limit", "{port}/s²", math.inf, "greatest acceleration a"),)
    law = "|g̈| ≤ a"
    excitation = "steps"

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Log-normal; about ten rated excursions per square second."""
        return {"limit": dist.LogNormal(math.log(10.0 * port.rated_position), _SPREAD)}

    def initial_memory(self, command: Tensor, start: Start) -> tuple[Tensor, Tensor]:
        """Returns the command, which the goal has reached, and its speed, zero."""
        return command, torch.zeros_like(command)

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Uneven, Any]:
        """Returns the goal during the step, and goal and speed at its end."""
        goal, speed = memory
        h, command = time_step, commands.now()
        distance = command - goal
        change = parameters["limit"] * h
        furthest = 0.5 * change * h
        arrives = (distance.abs() <= furthest) & (speed.abs() <= change)
        direction = distance.sign()
        ahead = (2.0 * distance.abs() / h - direction * speed).clamp_min(0.0)
        wanted = direction * 2.0 * ahead / (1.0 + torch.sqrt(1.0 + 4.0 * ahead / change))
        reached = torch.maximum(torch.minimum(wanted, speed + change), speed - change)
        reached = torch.where(arrives, 0.0, reached)
        # A goal that arrives brakes over the part of the step that it needs.
        share = torch.where(arrives, distance.abs() / furthest.clamp_min(_LEAST), 1.0)
        travel = torch.where(arrives, distance, 0.5 * h * (speed + reached))
        end = torch.where(arrives, command, goal + travel)
        late = torch.where(arrives, share * distance / 3.0, h * (speed + 2.0 * reached) / 6.0)
        moment = share * travel * h**2 * (2.0 - share) / 12.0
        return Uneven(end - late, moment), (end, reached)


class GoalResolution(_GoalEffect):
    """Δ round(u/Δ): the servo's goal has steps of Δ."""

    id = "goal_resolution"
    parameters = (Parameter("step", "{port}", 0.0, "step Δ"),)
    rounds = "step"
    law = "Δ round(u/Δ)"
    excitation = "slow_ramp"

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Uniform; up to 2 % of the rated excursion: 9 bits per turn are 0.012 rad."""
        return {"step": dist.Uniform(0.0, 0.02 * port.rated_position)}

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the goal."""
        command, step = commands.now(), parameters["step"]
        size = torch.where(step > 0.0, step, 1.0)
        return torch.where(step > 0.0, size * torch.round(command / size), command), memory
