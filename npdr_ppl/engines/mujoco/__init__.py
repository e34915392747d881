"""MuJoCo as a simulator: any MJCF file, its parameters bound by readable names.

May import: engines.common, language. Start reading at ``simulator.py``, then ``mechanism.py``.
"""

from npdr_ppl.engines.mujoco.parameters import Scale
from npdr_ppl.engines.mujoco.simulator import MujocoSimulator

__all__ = ["MujocoSimulator", "Scale"]
