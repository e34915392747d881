"""Gymnasium environments as simulators, one simulation at a time on workers.

May import: engines.common, engines.pooled, language. Start reading at ``simulator.py``.
"""

from npdr_ppl.engines.gymnasium.attributes import Attribute
from npdr_ppl.engines.gymnasium.simulator import GymnasiumSimulator

__all__ = ["Attribute", "GymnasiumSimulator"]
