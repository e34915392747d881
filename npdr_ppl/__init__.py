"""Probabilistic programming for robot simulators."""
