"""The registry of effects: the catalogue, and effects that other packages and the user add.

Other packages add theirs by an entry point of group ``npdr_ppl.effects``: its name is the effect's
id, its value a subclass of :class:`~npdr_ppl.language.effects.Effect`. Users add theirs by
``npdr effects --add``; see :mod:`npdr_ppl.models.effects.added`.
"""

from collections.abc import Mapping

from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect
from npdr_ppl.models.effects.added import added_effects
from npdr_ppl.registry import Registry

__all__ = ["effect_class", "effects"]

GROUP = "npdr_ppl.effects"

_HOME = "npdr_ppl.models.effects"

BUILT_IN = {
    "viscous_friction": f"{_HOME}.friction:ViscousFriction",
    "coulomb_friction": f"{_HOME}.friction:CoulombFriction",
    "asymmetric_coulomb_friction": f"{_HOME}.friction:AsymmetricCoulombFriction",
    "stribeck_friction": f"{_HOME}.friction:StribeckFriction",
    "presliding_friction": f"{_HOME}.friction_with_state:PreslidingFriction",
    "quadratic_drag": f"{_HOME}.friction:QuadraticDrag",
    "load_dependent_friction": f"{_HOME}.friction_with_state:LoadDependentFriction",
    "friction_drift": f"{_HOME}.friction_with_state:FrictionDrift",
    "input_delay": f"{_HOME}.actuation:InputDelay",
    "sensor_delay": f"{_HOME}.timing:SensorDelay",
    "actuator_lag": f"{_HOME}.actuation:ActuatorLag",
    "sensor_low_pass": f"{_HOME}.sensing:SensorLowPass",
    "saturation": f"{_HOME}.actuation:Saturation",
    "supply_sag": f"{_HOME}.actuation:SupplySag",
    "dead_zone": f"{_HOME}.actuation:DeadZone",
    "actuator_gain": f"{_HOME}.actuation:ActuatorGain",
    "servo_gain": f"{_HOME}.servos:ServoGain",
    "servo_force_limit": f"{_HOME}.servos:ServoForceLimit",
    "servo_dead_band": f"{_HOME}.servos:ServoDeadBand",
    "servo_integral_action": f"{_HOME}.servos:IntegralAction",
    "goal_speed_limit": f"{_HOME}.servos:GoalSpeedLimit",
    "goal_acceleration_limit": f"{_HOME}.servos:GoalAccelerationLimit",
    "goal_resolution": f"{_HOME}.servos:GoalResolution",
    "bias": f"{_HOME}.forces:Bias",
    "cogging": f"{_HOME}.disturbances:Cogging",
    "spring": f"{_HOME}.forces:Spring",
    "hardening_spring": f"{_HOME}.forces:HardeningSpring",
    "joint_elasticity": f"{_HOME}.transmission:JointElasticity",
    "backlash": f"{_HOME}.transmission:Backlash",
    "base_compliance": f"{_HOME}.carriers:BaseCompliance",
    "payload": f"{_HOME}.surroundings:Payload",
    "offset_payload": f"{_HOME}.surroundings:OffsetPayload",
    "unbalance": f"{_HOME}.forces:Unbalance",
    "tilt": f"{_HOME}.surroundings:Tilt",
    "encoder_bias": f"{_HOME}.sensing:EncoderBias",
    "encoder_scale": f"{_HOME}.sensing:EncoderScale",
    "quantisation": f"{_HOME}.sensing:Quantisation",
    "clock_skew": f"{_HOME}.timing:ClockSkew",
    "contact": f"{_HOME}.surroundings:Contact",
    "wind": f"{_HOME}.disturbances:Wind",
    "periodic_disturbance": f"{_HOME}.disturbances:PeriodicDisturbance",
    "parameter_drift": f"{_HOME}.disturbances:ParameterDrift",
}
"""Effects of this package by id."""


_REGISTRY = Registry("effect", Effect, ModelError, GROUP, BUILT_IN)


def effect_class(name: str) -> type[Effect]:
    """Returns the class of an effect.

    Args:
        name: Its id, e.g. ``"coulomb_friction"``.

    Raises:
        ModelError: There is no such effect, it cannot be loaded, or its id differs from the name.
    """
    locations = _REGISTRY.locations()
    if name in locations:
        return _found(name, locations)
    added = added_effects(frozenset(locations))
    if name in added:
        return added[name].effect
    return _found(name, {**locations, **{key: str(own.file) for key, own in added.items()}})


def effects() -> dict[str, type[Effect]]:
    """Returns every effect by its id, the catalogue's first and those of the user last.

    Example:
        >>> effects()["coulomb_friction"]("arm")
        CoulombFriction(port='arm')
    """
    # Which packages are installed is read once, not for every effect.
    locations = _REGISTRY.locations()
    found = {name: _found(name, locations) for name in locations}
    added = added_effects(frozenset(locations))
    return found | {name: own.effect for name, own in added.items()}


def _found(name: str, locations: Mapping[str, str]) -> type[Effect]:
    """Returns the class of an effect of a package, see :func:`effect_class`."""
    effect = _REGISTRY.find(name, locations)
    if effect.id != name:
        raise ModelError(
            f"The entry point {name!r} of group {GROUP} names an effect whose id is "
            f"{effect.id!r}; both have to be the same."
        )
    return effect
