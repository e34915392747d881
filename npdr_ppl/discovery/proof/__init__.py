"""Evidence for a revised model: held-out gap, parameter intervals, where it disagrees, what next.

May import: discovery.screening, preparation. Start reading at ``held_out_gap.py``.
"""
