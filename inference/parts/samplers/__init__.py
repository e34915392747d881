"""Samplers, importance weights and conjugate regression. Start at ``tempering.py``."""
