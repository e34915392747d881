"""Backends side by side: scores on held-out segments, ranking, stacking weights.

May import: the rest of :mod:`npdr_ppl.posterior`. Start reading at ``compare.py``.
"""
