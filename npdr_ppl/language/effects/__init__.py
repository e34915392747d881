"""Effects: physical causes that a simulator may lack, declared once and attached to ports.

An effect consists of data and one law. The law uses plain tensors with batch dimensions, so any
engine that provides velocities, commands or measurements can apply it. Effects import their base
class from here, also those in the files of users and of finished discoveries.

May import: the modules beside this package. Start reading at ``effect.py`` (what every effect
has), then ``force.py``.
"""

from npdr_ppl.language.effects.action import ActionEffect, Commands, Uneven
from npdr_ppl.language.effects.compliance import Carrier, ComplianceEffect
from npdr_ppl.language.effects.effect import Effect, upper_end
from npdr_ppl.language.effects.environment import (
    EnvironmentEffect,
    LoadEffect,
    ParameterEffect,
)
from npdr_ppl.language.effects.force import ForceEffect, LinearForceEffect
from npdr_ppl.language.effects.sensor import BentSensorEffect, SensorEffect
from npdr_ppl.language.effects.servo import ServoEffect

__all__ = [
    "ActionEffect",
    "BentSensorEffect",
    "Carrier",
    "Commands",
    "ComplianceEffect",
    "Effect",
    "EnvironmentEffect",
    "ForceEffect",
    "LinearForceEffect",
    "LoadEffect",
    "ParameterEffect",
    "SensorEffect",
    "ServoEffect",
    "Uneven",
    "upper_end",
]
