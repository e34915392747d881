"""Target domains: the devices, other engines and recordings that policies are run on.

May import: engines, rollouts, language. Start reading at ``base.py``, then ``hardware.py``, the
template for a physical device.
"""

from npdr_ppl.targets.base import (
    Controller,
    TargetDomain,
    TargetError,
    end_episode,
    partial_rollout,
)
from npdr_ppl.targets.gymnasium import GymnasiumTarget
from npdr_ppl.targets.hardware import HardwareReport, HardwareTarget
from npdr_ppl.targets.recorded import RecordedTarget

__all__ = [
    "Controller",
    "GymnasiumTarget",
    "HardwareReport",
    "HardwareTarget",
    "RecordedTarget",
    "TargetDomain",
    "TargetError",
    "end_episode",
    "partial_rollout",
]
