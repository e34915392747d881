"""Base classes that several methods share: training in rounds, on which proposals, of what.

May import: the other parts. Start reading at ``neural_backend.py``.
"""
