"""Recordings of hidden rigs whose true states are known."""

import numpy as np
from hidden_rigs import RIGS
from hidden_rigs.recording import record

from npdr_ppl.randomness import derived_seed


def recording_of(name):
    """A rig with parameters of its own and nothing hidden, in three excitations."""
    rig = RIGS[name]
    generator = np.random.default_rng(derived_seed(0, name, "parameters"))
    parameters = dict(rig.known)
    parameters |= {key: generator.uniform(*ends) for key, ends in rig.unknown.items()}
    return record(
        rig,
        ("multisine", "steps", "chirp"),
        parameters=parameters,
        measurement=rig.measurement,
        seed=derived_seed(0, name, "recording"),
    )
