"""Normalising flows and velocity networks as conditional densities. Start at ``flows.py``."""
