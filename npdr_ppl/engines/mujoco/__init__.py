"""MuJoCo as a simulator: any MJCF file, its parameters bound by readable names."""

from npdr_ppl.engines.mujoco.parameters import Scale
from npdr_ppl.engines.mujoco.simulator import MujocoSimulator

__all__ = ["MujocoSimulator", "Scale"]
