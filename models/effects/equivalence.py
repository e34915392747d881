"""Causes that recordings may not be able to distinguish, and that are reported together."""

from npdr_ppl.language.effect_context import EquivalenceClass

__all__ = [
    "ANGLE_OFFSET",
    "COMMAND_LIMIT",
    "DIRECTIONAL_FRICTION",
    "EQUIVALENCE_CLASSES",
    "FIRST_ORDER_LAG",
    "LATENCY",
    "OVERALL_SCALE",
    "POSITION_SCALE",
    "UNSEEN_TURN",
    "VELOCITY_FEEDBACK",
]

VELOCITY_FEEDBACK = EquivalenceClass(
    "velocity feedback",
    ("viscous_friction", "back-EMF"),
    "the motor's current, or the motion with its terminals open",
)
DIRECTIONAL_FRICTION = EquivalenceClass(
    "directional friction",
    ("asymmetric_coulomb_friction", "coulomb_friction + bias"),
    "nothing in motion; at rest, how far a slow ramp gets before either direction breaks away",
)
LATENCY = EquivalenceClass(
    "latency",
    ("input_delay", "sensor_delay"),
    "motion that no command has caused, such as a push or a free fall",
)
FIRST_ORDER_LAG = EquivalenceClass(
    "first-order lag",
    ("actuator_lag", "sensor_low_pass"),
    "a second sensor, or motion that no command has caused",
)
ANGLE_OFFSET = EquivalenceClass(
    "angle offset",
    ("tilt", "encoder_bias", "unbalance"),
    "several joints under gravity, or the base set down the other way round",
)
OVERALL_SCALE = EquivalenceClass(
    "overall scale",
    ("actuator_gain", "payload", "everything scaled"),
    "gravity against inertia, or a known mass added",
)
POSITION_SCALE = EquivalenceClass(
    "position scale",
    ("spring", "encoder_scale"),
    "a wide range of positions",
)
COMMAND_LIMIT = EquivalenceClass(
    "command limit",
    ("supply_sag", "saturation"),
    "commands near the limit for a good part of the time",
)
UNSEEN_TURN = EquivalenceClass(
    "unseen turn",
    ("base_compliance", "a rocking base", "an elastic gear behind the motor's encoder"),
    "a sensor on the link, or one on the base",
)

EQUIVALENCE_CLASSES: tuple[EquivalenceClass, ...] = (
    VELOCITY_FEEDBACK,
    DIRECTIONAL_FRICTION,
    LATENCY,
    FIRST_ORDER_LAG,
    ANGLE_OFFSET,
    OVERALL_SCALE,
    POSITION_SCALE,
    COMMAND_LIMIT,
    UNSEEN_TURN,
)
