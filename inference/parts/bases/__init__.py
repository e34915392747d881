"""Base classes that several methods share: training in rounds, proposals, kinds of estimators.

May import: the other parts. Start reading at ``neural_backend.py``.
"""
