"""Simulator engines: what turns a model author's equations into batched trajectories."""
