"""Logs as robots write them: their signals, what the signals mean, and rollouts made of them.

May import: language, errors, rollouts. Start reading at ``log.py`` (what every reader returns),
then ``mapping.py`` (which signal is which channel) and ``assemble.py`` (from signals to rollouts).
"""

from npdr_ppl.rollouts.logs.assemble import rollouts_of
from npdr_ppl.rollouts.logs.log import Log, Signal
from npdr_ppl.rollouts.logs.log_settings import LogSettings
from npdr_ppl.rollouts.logs.mapping import Mapping, SignalMapping
from npdr_ppl.rollouts.logs.read import read_log

__all__ = [
    "Log",
    "LogSettings",
    "Mapping",
    "Signal",
    "SignalMapping",
    "read_log",
    "rollouts_of",
]
