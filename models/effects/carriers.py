"""What carries a joint yields: a base that rocks, or a gear with the encoder on its motor."""

from collections.abc import Mapping

import pyro.distributions as dist
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import Carrier, ComplianceEffect
from npdr_ppl.models.effects.equivalence import UNSEEN_TURN
from npdr_ppl.models.effects.references import SPONG_1987

__all__ = ["BaseCompliance"]

_RIGID = 1e-18
"""Smaller compliances, in rad/(N m) or m/N, are replaced by this one, at which nothing moves by
more than rounding errors."""


class BaseCompliance(ComplianceEffect):
    """φ + 2 ζ T φ̇ + T² φ̈ = −c τ: what carries the joint turns by φ under its force τ.

    The encoder measures the joint relative to its carrier, so it does not see φ, but all further
    links move with it. Examples are a base that rocks about the joint's axis, and a gear that
    twists behind the motor's encoder. T is the time constant of the carrier alone. With the
    inertia J that the joint moves, the time constant becomes √(T² + c J).
    """

    id = "base_compliance"
    parameters = (
        Parameter("compliance", "{coordinate}/({port})", 0.0, "compliance c"),
        Parameter("time_constant", "s", 0.02, "time constant T of the carrier alone"),
        Parameter("damping_ratio", "1", 0.1, "damping ratio ζ of the carrier alone"),
    )
    strength = ("compliance",)
    is_smooth = False
    has_local_minima = True
    # A search among the whole catalogue has not been shown to name it: see the limits in
    # docs/effects.md.
    only_if_asked = True
    law = "φ + 2 ζ T φ̇ + T² φ̈ = −c τ, a turn that the encoder does not see"
    equivalence = (UNSEEN_TURN,)
    excitation = "chirp"
    reference = SPONG_1987

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Compliance half-normal: 1 % of the rated excursion at the rated force."""
        return {
            "compliance": dist.HalfNormal(0.01 * port.rated_position / port.rated),
            "time_constant": dist.LogNormal(-4.0, 0.7),
            "damping_ratio": dist.LogNormal(-2.3, 0.7),
        }

    def carrier(self, parameters: Mapping[str, Tensor]) -> Carrier:
        """Returns the carrier."""
        stiffness = 1.0 / parameters["compliance"].clamp_min(_RIGID)
        return Carrier(stiffness, parameters["time_constant"], parameters["damping_ratio"])
