"""Mini golf: a robot arm strikes a ball past two obstacles towards a hole, in PyBullet.

May import: engines, language. Start reading at ``simulator.py``.
"""

from npdr_ppl.models.mini_golf.model import mini_golf, mini_golf_two_restitutions
from npdr_ppl.models.mini_golf.simulator import MiniGolf

__all__ = ["MiniGolf", "mini_golf", "mini_golf_two_restitutions"]
