"""Rollouts: recorded or simulated episodes, their files, their checks and their segments."""

from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.io.simurlacra import load_simurlacra
from npdr_ppl.rollouts.segments import stitch

__all__ = ["Rollouts", "load_simurlacra", "stitch"]
