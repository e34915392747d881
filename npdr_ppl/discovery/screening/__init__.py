"""Screening: whether the recording shows anything that no parameters explain, and what it is like.

May import: preparation, models, :mod:`npdr_ppl.discovery.hypothesis`. Start reading at
``alarm.py`` (is something missing?), then ``screening.py`` (which candidate explains it best?).
"""
