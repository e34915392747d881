"""Planning: the next recording, which tells surviving causes apart or narrows parameters.

``limits`` says what the robot may do, ``excitations`` makes commands within limits, ``judging``
predicts what a recording with them would show, ``search`` improves them, and ``exploration`` does
all this for the best ones. ``selection`` chooses rollouts, ``chances`` says how probably discovery
then names the right cause, and ``wider`` which limit prevents it. May import: posterior,
discovery, preparation, models. Start reading at ``plan.py``.
"""

from npdr_ppl.planning.limits import Limits
from npdr_ppl.planning.plan import Plan, plan_recording

__all__ = ["Limits", "Plan", "plan_recording"]
