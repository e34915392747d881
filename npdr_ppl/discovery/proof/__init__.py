"""Evidence for a revised model: held-out gap, intervals, largest residuals, next experiment.

May import: discovery.screening, preparation. Start reading at ``held_out_gap.py``.
"""
