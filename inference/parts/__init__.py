"""What backends are built from: flows, mixtures, training and samplers.

May import: inference.base. Start reading at ``bases/neural_backend.py``.
"""
