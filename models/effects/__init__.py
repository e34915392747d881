"""The catalogue of effects: physical causes that a simulator may miss.

May import: language. Start reading at ``friction.py``.
"""

from npdr_ppl.models.effects.actuation import (
    ActuatorGain,
    ActuatorLag,
    DeadZone,
    InputDelay,
    Saturation,
    SupplySag,
)
from npdr_ppl.models.effects.candidates import candidate_effects
from npdr_ppl.models.effects.carriers import BaseCompliance
from npdr_ppl.models.effects.disturbances import (
    Cogging,
    ParameterDrift,
    PeriodicDisturbance,
    Wind,
)
from npdr_ppl.models.effects.equivalence import EQUIVALENCE_CLASSES
from npdr_ppl.models.effects.forces import Bias, HardeningSpring, Spring, Unbalance
from npdr_ppl.models.effects.friction import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    QuadraticDrag,
    StribeckFriction,
    ViscousFriction,
)
from npdr_ppl.models.effects.friction_with_state import (
    FrictionDrift,
    LoadDependentFriction,
    PreslidingFriction,
)
from npdr_ppl.models.effects.registry import effect_class, effects
from npdr_ppl.models.effects.sensing import (
    EncoderBias,
    EncoderScale,
    Quantisation,
    SensorLowPass,
)
from npdr_ppl.models.effects.servos import (
    GoalAccelerationLimit,
    GoalResolution,
    GoalSpeedLimit,
    IntegralAction,
    ServoDeadBand,
    ServoForceLimit,
    ServoGain,
)
from npdr_ppl.models.effects.surroundings import Contact, OffsetPayload, Payload, Tilt
from npdr_ppl.models.effects.timing import ClockSkew, SensorDelay
from npdr_ppl.models.effects.transmission import Backlash, JointElasticity

__all__ = [
    "EQUIVALENCE_CLASSES",
    "ActuatorGain",
    "ActuatorLag",
    "AsymmetricCoulombFriction",
    "Backlash",
    "BaseCompliance",
    "Bias",
    "ClockSkew",
    "Cogging",
    "Contact",
    "CoulombFriction",
    "DeadZone",
    "EncoderBias",
    "EncoderScale",
    "FrictionDrift",
    "GoalAccelerationLimit",
    "GoalResolution",
    "GoalSpeedLimit",
    "HardeningSpring",
    "InputDelay",
    "IntegralAction",
    "JointElasticity",
    "LoadDependentFriction",
    "OffsetPayload",
    "ParameterDrift",
    "Payload",
    "PeriodicDisturbance",
    "PreslidingFriction",
    "QuadraticDrag",
    "Quantisation",
    "Saturation",
    "SensorDelay",
    "SensorLowPass",
    "ServoDeadBand",
    "ServoForceLimit",
    "ServoGain",
    "Spring",
    "StribeckFriction",
    "SupplySag",
    "Tilt",
    "Unbalance",
    "ViscousFriction",
    "Wind",
    "candidate_effects",
    "effect_class",
    "effects",
]
