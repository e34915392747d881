"""Rollouts: recorded or simulated episodes, their files, their checks and their segments.

May import: language, errors. Start reading at ``recording.py`` (the arrays and what is checked of
them), then ``container.py`` (what users call) and ``segments.py`` (what a simulator replays).
"""

from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.segments import stitch

__all__ = ["Rollouts", "stitch"]
