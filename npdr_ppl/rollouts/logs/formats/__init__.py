"""The formats of logs: each module reads one family of files and returns a ``Log``.

May import: errors, reading_limits, rollouts. Start reading at ``tables.py`` (columns to signals)
and ``trees.py`` (nested data to signals), which several formats share.
"""
