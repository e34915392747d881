"""The catalogue of effects: physical causes that a simulator may miss."""

from npdr_ppl.language.effects import Effect
from npdr_ppl.models.effects.actuation import (
    ActuatorGain,
    ActuatorLag,
    DeadZone,
    InputDelay,
    SupplySag,
)
from npdr_ppl.models.effects.forces import Bias, HardeningSpring, Spring, Unbalance
from npdr_ppl.models.effects.friction import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    QuadraticDrag,
    StribeckFriction,
    ViscousFriction,
)
from npdr_ppl.models.effects.sensing import EncoderBias, EncoderScale, SensorLowPass
from npdr_ppl.models.effects.surroundings import Tilt

__all__ = [
    "ActuatorGain",
    "ActuatorLag",
    "AsymmetricCoulombFriction",
    "Bias",
    "CoulombFriction",
    "DeadZone",
    "EncoderBias",
    "EncoderScale",
    "HardeningSpring",
    "InputDelay",
    "QuadraticDrag",
    "SensorLowPass",
    "Spring",
    "StribeckFriction",
    "SupplySag",
    "Tilt",
    "Unbalance",
    "ViscousFriction",
    "effects",
]

_CATALOGUE: tuple[type[Effect], ...] = (
    ViscousFriction,
    CoulombFriction,
    AsymmetricCoulombFriction,
    StribeckFriction,
    QuadraticDrag,
    InputDelay,
    ActuatorLag,
    SensorLowPass,
    SupplySag,
    DeadZone,
    ActuatorGain,
    Bias,
    Spring,
    HardeningSpring,
    Unbalance,
    Tilt,
    EncoderBias,
    EncoderScale,
)


def effects() -> dict[str, type[Effect]]:
    """Returns every effect of the catalogue by its id.

    Example:
        >>> effects()["coulomb_friction"]("arm")
        CoulombFriction(port='arm')
    """
    return {effect.id: effect for effect in _CATALOGUE}
