"""Effects at a servo, which follows a position or a velocity."""

from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import EnvironmentEffect
from npdr_ppl.models.effects.references import MUJOCO

__all__ = ["ServoGain"]


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
