"""Effects that change a command before it reaches the dynamics."""

import math
from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import ActionEffect, Commands, Uneven, upper_end
from npdr_ppl.models.effects.equivalence import (
    COMMAND_LIMIT,
    FIRST_ORDER_LAG,
    LATENCY,
    OVERALL_SCALE,
)
from npdr_ppl.models.effects.lag import remaining
from npdr_ppl.models.effects.references import JANOT_2019, LJUNG_1999, MUJOCO, TAO_1996

__all__ = ["ActuatorGain", "ActuatorLag", "DeadZone", "InputDelay", "Saturation", "SupplySag"]


class InputDelay(ActionEffect):
    """u(t − d) with a delay d that need not be a whole number of steps.

    Commands are held for a step. With d = (n + f) h, step k of length h therefore uses u_{k−n−1}
    for the fraction f of the step and u_{k−n} for the rest.
    """

    id = "input_delay"
    may_be_shared = True
    parameters = (Parameter("delay", "s", 0.0, "delay d"),)
    is_smooth = False
    law = "u(t − d)"
    equivalence = (LATENCY,)
    excitation = "chirp"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Uniform up to 30 ms."""
        return {"delay": dist.Uniform(0.0, 0.03)}

    def history(self, parameters: Mapping[str, Tensor], time_step: float) -> int:
        """Returns the number of steps in the longest delay."""
        return math.floor(float(parameters["delay"].detach().max()) / time_step) + 1

    @property
    def memory_time(self) -> float:
        """Nothing beside the commands that it requests: n and f do not change."""
        return 0.0

    def initial_memory(self, command: Tensor, start: Start) -> tuple[Tensor, Tensor]:
        """Returns n and f."""
        steps = start.parameters["delay"] / start.time_step
        whole = torch.floor(steps.detach())
        return whole.long().expand(command.shape), (steps - whole).expand(command.shape)

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Uneven, Any]:
        """Returns the command of the delayed step."""
        whole, fraction = memory
        later = commands.delayed(whole)
        rise = fraction * (later - commands.delayed(whole + 1))
        return Uneven(later - rise, (0.5 * time_step**2) * (1.0 - fraction) * rise), memory


class ActuatorLag(ActionEffect):
    """τ̇ = (u − τ)/T: a first-order lag with time constant T; the mean over a step acts."""

    id = "actuator_lag"
    may_be_shared = True
    parameters = (Parameter("time_constant", "s", 0.0, "time constant T"),)
    law = "τ̇ = (u − τ)/T"
    equivalence = (FIRST_ORDER_LAG,)
    excitation = "steps"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Uniform up to 50 ms."""
        return {"time_constant": dist.Uniform(0.0, 0.05)}

    @property
    def memory_time(self) -> float:
        """Ten of the longest time constants that the prior allows."""
        given = self.given_priors.get("time_constant")
        return 10.0 * (0.05 if given is None else upper_end(given))

    def initial_memory(self, command: Tensor, start: Start) -> Any:
        """Returns the settled output, and its relative errors in the next step.

        These are the output's deviation from the command at the step's end, its mean and its
        moment, relative to the deviation at the step's start.
        """
        time_constant, half = start.parameters["time_constant"], 0.5 * start.time_step
        decay = remaining(time_constant, start.time_step)
        mean = time_constant / start.time_step * (1.0 - decay)
        moment = time_constant * ((time_constant - half) - (time_constant + half) * decay)
        return command, tuple(share.expand(command.shape) for share in (decay, mean, moment))

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Uneven, Any]:
        """Returns the output during the step, and the output at its end."""
        output, shares = memory
        command = commands.now()
        missing = output - command
        decay, mean, moment = shares
        reached = Uneven(torch.addcmul(command, missing, mean), missing * moment)
        return reached, (torch.addcmul(command, missing, decay), shares)


class ActuatorGain(ActionEffect):
    """(1 + ε) u."""

    id = "actuator_gain"
    port_kinds = ("action",)
    parameters = (Parameter("error", "1", 0.0, "relative gain error ε"),)
    law = "(1 + ε) u"
    equivalence = (OVERALL_SCALE,)
    excitation = "payload"
    reference = JANOT_2019

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 7 %."""
        return {"error": dist.Normal(0.0, 0.07)}

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns (1 + ε) u."""
        return (1.0 + parameters["error"]) * commands.now(), memory


class SupplySag(ActionEffect):
    """(1 − a |u|/u_rated) u: a gain that falls with the load."""

    id = "supply_sag"
    port_kinds = ("action",)
    parameters = (Parameter("sag", "1/({port})", 0.0, "relative loss of gain per command a"),)
    law = "(1 − a|u|) u"
    equivalence = (COMMAND_LIMIT,)
    excitation = "wide_range"
    reference = TAO_1996

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 10 % at the rated command."""
        return {"sag": dist.HalfNormal(0.1 / port.rated)}

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns (1 − a |u|) u."""
        command = commands.now()
        return (1.0 - parameters["sag"] * command.abs()) * command, memory


class Saturation(ActionEffect):
    """clip(u, ±u_max): a limit below the limit that the channel declares."""

    id = "saturation"
    parameters = (Parameter("limit", "{port}", math.inf, "greatest command u_max"),)
    is_smooth = False
    law = "clip(u, ±u_max)"
    equivalence = (COMMAND_LIMIT,)
    excitation = "wide_range"
    reference = TAO_1996

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Uniform; 50 to 100 % of the rated command."""
        return {"limit": dist.Uniform(0.5 * port.rated, port.rated)}

    def probe(self, port: Port) -> dict[str, float]:
        """Returns 80 % of the rated command."""
        return {"limit": 0.8 * port.rated}

    def peaks(self, commands: Tensor, time_step: float) -> dict[str, float]:
        """Returns the greatest magnitude of the commands."""
        return {"limit": float(commands.abs().max())}

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the clipped command."""
        limit = parameters["limit"]
        return commands.now().clamp(-limit, limit), memory


class DeadZone(ActionEffect):
    """sign(u) max(|u| − δ, 0)."""

    id = "dead_zone"
    port_kinds = ("action",)
    parameters = (Parameter("width", "{port}", 0.0, "half width δ"),)
    is_smooth = False
    law = "sign(u) max(|u| − δ, 0)"
    excitation = "slow_ramp"
    reference = TAO_1996

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 3 % of the rated command."""
        return {"width": dist.HalfNormal(0.03 * port.rated)}

    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns u − clip(u, ±δ), an equal expression."""
        command, width = commands.now(), parameters["width"]
        return command - command.clamp(-width, width), memory
