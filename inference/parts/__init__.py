"""What backends are built from: flows, mixtures, training and samplers.

May import: inference.base. Start reading at ``training/neural_backend.py``.
"""
