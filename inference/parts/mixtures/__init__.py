"""Mixtures of Gaussians, learnt and closed-form. Start at ``gaussian_mixture.py``."""
