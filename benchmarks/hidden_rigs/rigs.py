"""The five rigs, one of them in two engines."""

import math
from dataclasses import replace

from hidden_rigs import under_test
from hidden_rigs.equations import (
    CartPoleMechanics,
    DriveMechanics,
    FurutaMechanics,
    PendulumMechanics,
    TwoLinkMechanics,
)
from hidden_rigs.excitation import Band
from hidden_rigs.measurement import Measurement
from hidden_rigs.plant import Layout
from hidden_rigs.rig import Centring, Place, Rig
from npdr_ppl.models.two_link_arm import LOWER_LENGTH, UPPER_LENGTH

__all__ = ["RIGS"]

_FRICTION = (
    "coulomb_friction",
    "asymmetric_coulomb_friction",
    "stribeck_friction",
    "presliding_friction",
    "quadratic_drag",
)
_COMMAND = ("input_delay", "actuator_lag", "saturation", "supply_sag", "dead_zone")
_FORCE = ("bias", "spring", "hardening_spring", "periodic_disturbance")
_TURNING = ("cogging", "wind")
_LOAD = ("load_dependent_friction",)
# Where the inertia that a drive sees hardly varies: elsewhere a motor's share of it is no number.
_GEAR = ("joint_elasticity", "backlash")
_OUTSIDE_FORCE = (
    "bouc_wen_hysteresis",
    "position_dependent_friction",
    "cubic_damping",
    "square_root_drag",
    "cross_term",
    "hard_stop",
    "detents",
    "torque_bursts",
)
_OUTSIDE_COMMAND = ("position_dependent_gain", "asymmetric_gain")


def _at(port: str, *groups: tuple[str, ...]) -> tuple[Place, ...]:
    return tuple((port, effect_id) for group in groups for effect_id in group)


def _pairs(joint: str, command: str, *others: tuple[str, str]) -> tuple[tuple[Place, Place], ...]:
    """Returns the pairs that every rig has at a joint and a command, and others at the joint."""
    at_joint = (
        ("coulomb_friction", "quadratic_drag"),
        ("coulomb_friction", "stribeck_friction"),
        ("coulomb_friction", "hardening_spring"),
        ("coulomb_friction", "periodic_disturbance"),
        ("hardening_spring", "bias"),
        ("backlash", "coulomb_friction"),
        *others,
    )
    at_command = (("input_delay", "actuator_lag"), ("dead_zone", "actuator_lag"))
    return (
        *(((joint, one), (joint, other)) for one, other in at_joint),
        *(((command, one), (command, other)) for one, other in at_command),
    )


_Alternatives = dict[Place, tuple[tuple[Place, ...], ...]]


def _one_of(*members: Place) -> _Alternatives:
    """Returns each member with the others."""
    return {m: tuple((other,) for other in members if other != m) for m in members}


def _asymmetric(*joints: str) -> _Alternatives:
    """Returns asymmetric friction with its equivalent: friction and a bias."""
    return {
        (joint, "asymmetric_coulomb_friction"): (((joint, "coulomb_friction"), (joint, "bias")),)
        for joint in joints
    }


_PENDULUM_OFFSET = _one_of(("gravity", "tilt"), ("angle", "encoder_bias"), ("hinge", "unbalance"))
_ARM_OFFSET = _one_of(("gravity", "tilt"), ("shoulder_angle", "encoder_bias"))


PENDULUM = Rig(
    name="pendulum",
    model=under_test.pendulum,
    simulator=under_test.pendulum_simulator,
    mechanics=PendulumMechanics,
    layout=Layout(("hinge",), ("torque",), ("angle",), ("velocity",)),
    known={"damping": 0.0, "gravity": 9.81},
    unknown={"mass": (0.85, 1.15), "length": (0.88, 1.12)},
    time_step=0.01,
    substeps=10,
    duration=5.0,
    amplitudes=(4.5,),
    limits=(4.5,),
    band=Band(0.3, 2.0),
    # Without friction it would swing up for ever.
    centring=(Centring((0.0,), (0.2,)),),
    start_spread=(1.5,),
    measurement=Measurement((2.0 * math.pi / 4096,), (0.02,)),
    effects=(
        *_at("hinge", ("viscous_friction",), _FRICTION, _FORCE, _TURNING, _LOAD, _GEAR),
        *_at("torque", _COMMAND),
        ("angle,velocity", "sensor_delay"),
        ("velocity", "sensor_low_pass"),
        ("gravity", "tilt"),
        ("hinge", "unbalance"),
        ("angle", "encoder_bias"),
        ("angle", "encoder_scale"),
        ("clock", "clock_skew"),
    ),
    pairs=_pairs(
        "hinge",
        "torque",
        ("coulomb_friction", "viscous_friction"),
        ("coulomb_friction", "cogging"),
    ),
    absorbed=(("torque", "actuator_gain"), ("payload", "payload")),
    inseparable={
        **_one_of(("torque", "input_delay"), ("angle,velocity", "sensor_delay")),
        **_PENDULUM_OFFSET,
    },
    same={**_PENDULUM_OFFSET, **_asymmetric("hinge")},
    outside=(
        *_at("hinge", _OUTSIDE_FORCE),
        *_at("torque", _OUTSIDE_COMMAND),
        ("angle", "eccentric_encoder"),
    ),
)

FURUTA = Rig(
    name="furuta",
    model=under_test.furuta,
    simulator=under_test.furuta_simulator,
    mechanics=FurutaMechanics,
    layout=Layout(
        ("arm", "pole"),
        ("voltage",),
        ("arm_angle", "pole_angle"),
        ("arm_velocity", "pole_velocity"),
    ),
    known={"gravity": 9.81},
    unknown={
        "motor_resistance": (7.6, 9.2),
        "motor_constant": (0.038, 0.046),
        "arm_mass": (0.085, 0.105),
        "arm_length": (0.077, 0.093),
        "pole_mass": (0.0215, 0.0265),
        "pole_length": (0.117, 0.141),
        "arm_damping": (2e-5, 3e-4),
        "pole_damping": (2e-6, 3e-5),
    },
    time_step=0.002,
    substeps=4,
    duration=4.0,
    amplitudes=(3.8,),
    limits=(4.0,),
    band=Band(0.8, 3.0),
    centring=(Centring((4.0, 0.0), (0.2, 0.0)),),
    start_spread=(0.2, 2.0),
    measurement=Measurement((2.0 * math.pi / 2048,) * 2, (0.05, 0.1)),
    effects=(
        *_at("arm", _FRICTION, _FORCE, _TURNING, _LOAD),
        *_at("pole", _FRICTION, ("bias", "spring", "cogging")),
        *_at("voltage", _COMMAND),
        ("arm_angle,pole_angle,arm_velocity,pole_velocity", "sensor_delay"),
        ("arm_velocity,pole_velocity", "sensor_low_pass"),
        ("gravity", "tilt"),
        ("pole_angle", "encoder_bias"),
        ("pole_angle", "encoder_scale"),
        ("clock", "clock_skew"),
    ),
    absorbed=(
        ("voltage", "actuator_gain"),
        ("arm", "viscous_friction"),
        ("pole", "viscous_friction"),
    ),
    same=_asymmetric("arm", "pole"),
    inseparable=_one_of(
        ("voltage", "input_delay"),
        ("arm_angle,pole_angle,arm_velocity,pole_velocity", "sensor_delay"),
    ),
    outside=(*_at("arm", _OUTSIDE_FORCE), *_at("voltage", _OUTSIDE_COMMAND)),
)

FURUTA_MUJOCO = replace(
    FURUTA,
    name="furuta_mujoco",
    effects=(
        ("arm", "coulomb_friction"),
        ("pole", "coulomb_friction"),
        ("voltage", "input_delay"),
        ("voltage", "actuator_lag"),
        ("arm_velocity,pole_velocity", "sensor_low_pass"),
        ("gravity", "tilt"),
    ),
    absorbed=(("arm", "viscous_friction"), ("pole", "viscous_friction")),
    inseparable={},
    same={},
    outside=(),
    engine="mujoco",
)

CART_POLE = Rig(
    name="cart_pole",
    model=under_test.cart_pole,
    simulator=under_test.cart_pole_simulator,
    mechanics=CartPoleMechanics,
    layout=Layout(
        ("rail", "hinge"),
        ("force",),
        ("cart_position", "pole_angle"),
        ("cart_velocity", "pole_velocity"),
    ),
    known={"gravity": 9.81},
    unknown={
        "cart_mass": (0.85, 1.15),
        "pole_mass": (0.16, 0.24),
        "pole_length": (0.52, 0.68),
        "cart_damping": (0.3, 1.0),
        "pole_damping": (0.002, 0.008),
    },
    time_step=0.01,
    substeps=10,
    duration=5.0,
    amplitudes=(16.0,),
    limits=(20.0,),
    band=Band(0.6, 2.5),
    centring=(Centring((12.0, 0.0), (4.0, -0.6)),),
    start_spread=(0.3, 1.2),
    measurement=Measurement((2e-4, 2.0 * math.pi / 4096), (0.01, 0.03)),
    effects=(
        *_at("rail", _FRICTION, _FORCE, _LOAD, _GEAR),
        *_at("hinge", _FRICTION, ("bias", "spring"), _TURNING),
        *_at("force", _COMMAND),
        ("cart_position,pole_angle,cart_velocity,pole_velocity", "sensor_delay"),
        ("cart_velocity,pole_velocity", "sensor_low_pass"),
        ("gravity", "tilt"),
        ("pole_angle", "encoder_bias"),
        ("cart_position", "encoder_scale"),
        ("pole_angle", "encoder_scale"),
        ("clock", "clock_skew"),
    ),
    pairs=_pairs(
        "rail",
        "force",
        ("coulomb_friction", "load_dependent_friction"),
        ("joint_elasticity", "coulomb_friction"),
    ),
    absorbed=(
        ("force", "actuator_gain"),
        ("payload", "payload"),
        ("rail", "viscous_friction"),
        ("hinge", "viscous_friction"),
        ("cart_position", "encoder_bias"),
    ),
    same=_asymmetric("rail", "hinge"),
    inseparable=_one_of(
        ("force", "input_delay"),
        ("cart_position,pole_angle,cart_velocity,pole_velocity", "sensor_delay"),
    ),
    outside=(
        *_at("rail", _OUTSIDE_FORCE),
        *_at("force", _OUTSIDE_COMMAND),
        ("pole_angle", "eccentric_encoder"),
    ),
)

EMPS = Rig(
    name="emps",
    model=under_test.emps,
    simulator=under_test.emps_simulator,
    mechanics=DriveMechanics,
    layout=Layout(("carriage",), ("voltage",), ("position",), ("velocity",)),
    known={"drive_gain": 35.15065},
    unknown={"mass": (82.0, 108.0), "viscous_friction": (160.0, 250.0)},
    time_step=0.004,
    substeps=4,
    duration=5.0,
    amplitudes=(5.0,),
    limits=(10.0,),
    band=Band(0.4, 3.0),
    centring=(Centring((8.0,), (2.0,)),),
    start_spread=(0.1,),
    measurement=Measurement((1e-5,), (5e-4,)),
    effects=(
        *_at("carriage", _FRICTION, _FORCE, _LOAD, _GEAR),
        *_at("voltage", _COMMAND),
        ("position,velocity", "sensor_delay"),
        ("velocity", "sensor_low_pass"),
        ("position", "encoder_scale"),
        ("clock", "clock_skew"),
    ),
    pairs=_pairs(
        "carriage",
        "voltage",
        ("coulomb_friction", "load_dependent_friction"),
        ("joint_elasticity", "coulomb_friction"),
    ),
    absorbed=(
        ("voltage", "actuator_gain"),
        ("payload", "payload"),
        ("carriage", "viscous_friction"),
        ("position", "encoder_bias"),
    ),
    inseparable={
        **_one_of(("voltage", "input_delay"), ("position,velocity", "sensor_delay")),
        **_one_of(("voltage", "actuator_lag"), ("position,velocity", "sensor_low_pass")),
    },
    rests_anywhere=True,
    same=_asymmetric("carriage"),
    outside=(*_at("carriage", _OUTSIDE_FORCE), *_at("voltage", _OUTSIDE_COMMAND)),
)

TWO_LINK_ARM = Rig(
    name="two_link_arm",
    model=under_test.two_link_arm,
    simulator=under_test.two_link_arm_simulator,
    mechanics=TwoLinkMechanics,
    layout=Layout(
        ("shoulder", "elbow"),
        ("shoulder_torque", "elbow_torque"),
        ("shoulder_angle", "elbow_angle"),
        ("shoulder_velocity", "elbow_velocity"),
    ),
    known={
        "gravity": 9.81,
        "lower_mass": 0.8,
        "upper_length": UPPER_LENGTH,
        "lower_length": LOWER_LENGTH,
    },
    unknown={
        "upper_mass": (1.0, 1.4),
        "shoulder_damping": (0.06, 0.2),
        "elbow_damping": (0.02, 0.06),
    },
    time_step=0.005,
    # Not the five of the engine under test.
    substeps=8,
    duration=5.0,
    amplitudes=(8.0, 2.2),
    limits=(10.0, 3.0),
    band=Band(0.3, 2.0),
    centring=(Centring((2.0, 0.0), (0.4, 0.0)), Centring((0.0, 0.5), (0.0, 0.08))),
    start_spread=(0.8, 1.0),
    measurement=Measurement((2.0 * math.pi / 4096,) * 2, (0.03, 0.05)),
    effects=(
        *_at("shoulder", _FRICTION, _FORCE, _TURNING, _LOAD),
        *_at("elbow", _FRICTION, _FORCE, _TURNING, _LOAD),
        *_at("shoulder_torque", _COMMAND, ("actuator_gain",)),
        *_at("elbow_torque", _COMMAND, ("actuator_gain",)),
        ("shoulder_angle,elbow_angle,shoulder_velocity,elbow_velocity", "sensor_delay"),
        ("shoulder_velocity,elbow_velocity", "sensor_low_pass"),
        ("payload", "payload"),
        ("gravity", "tilt"),
        ("elbow_angle", "encoder_bias"),
        ("shoulder_angle", "encoder_scale"),
        ("elbow_angle", "encoder_scale"),
        ("clock", "clock_skew"),
    ),
    absorbed=(("shoulder", "viscous_friction"), ("elbow", "viscous_friction")),
    same={**_ARM_OFFSET, **_asymmetric("shoulder", "elbow")},
    inseparable=_ARM_OFFSET,
    outside=(
        *_at("shoulder", _OUTSIDE_FORCE),
        *_at("elbow", _OUTSIDE_FORCE),
        *_at("elbow_torque", _OUTSIDE_COMMAND),
        ("elbow_angle", "eccentric_encoder"),
    ),
)

RIGS: dict[str, Rig] = {
    rig.name: rig for rig in (PENDULUM, FURUTA, FURUTA_MUJOCO, CART_POLE, EMPS, TWO_LINK_ARM)
}
"""The rigs by name."""
