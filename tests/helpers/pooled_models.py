"""A simulator in plain NumPy for the tests of PooledSimulator."""

import numpy as np

from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator
from npdr_ppl.language.channels import Channel, Parameter, Port


class Drift(PooledSimulator):
    """A level that a push moves by as much as its gain says, with noise of its own."""

    states = (Channel("level", "m"),)
    actions = (Channel("push", "m"),)
    sensors = states
    parameters = (Parameter("gain", "1", 1.0),)
    ports = (Port("push", "action", "m"),)
    time_step = 0.1

    def __init__(self, noise, columns=1):
        self.noise = noise
        self.columns = columns
        self.is_deterministic = noise == 0.0

    def simulate_one(self, workspace, parameters, segment, seed):
        moves = parameters["gain"] * segment.actions[:, 0]
        moves = moves + self.noise * np.random.default_rng(seed).normal(size=len(moves))
        level = segment.initial_state[0] + moves.cumsum()
        return np.repeat(level[:, None], self.columns, axis=1)
