"""Training of ensembles of networks on preconditioned data. Start at ``ensemble_training.py``."""
