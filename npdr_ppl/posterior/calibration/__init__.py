"""Calibration of a posterior: coverage and ranks over simulated truths.

May import: the rest of :mod:`npdr_ppl.posterior`. Start reading at ``calibrate.py``.
"""
