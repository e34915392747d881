"""Training of ensembles of networks, round by round. Start at ``neural_backend.py``."""
