"""Screening: tests whether parameters explain the recording, and ranks what could be missing.

May import: preparation, models, :mod:`npdr_ppl.discovery.hypothesis`. Start reading at
``alarm.py`` (is something missing?), then ``screening.py`` (which candidate explains it best?).
"""
