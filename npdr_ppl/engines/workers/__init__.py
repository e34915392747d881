"""A pool for engines that run one simulation at a time. A fault loses only its own draw.

May import: errors, randomness. Start reading at ``session.py`` (``npdr.workers``), then
``pool.py``.
"""

from npdr_ppl.engines.workers.faults import Faults
from npdr_ppl.engines.workers.options import Executor, WorkerOptions
from npdr_ppl.engines.workers.pool import Outcome, Pool
from npdr_ppl.engines.workers.session import Workers, collect_faults, report_progress, workers
from npdr_ppl.engines.workers.task import Draw, Task

__all__ = [
    "Draw",
    "Executor",
    "Faults",
    "Outcome",
    "Pool",
    "Task",
    "WorkerOptions",
    "Workers",
    "collect_faults",
    "report_progress",
    "workers",
]
