"""Options small enough that a method of the study of returns is done in seconds."""

from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.policies.search_registry import policy_search
from npdr_ppl.preparation.data_options import DataOptions

NUM_STEPS = 200
"""0.4 s of a swing-up, in which no policy gets the pole up."""


TINY_DATA = DataOptions("all/50", 100, "recorded", "float32")
"""How the rollouts of the study are prepared."""


def tiny_options(**changed):
    settings = {
        "iterations": 1,
        "rounds": 1,
        "extra_rounds": 0,
        "num_simulations": 20,
        "start": "prior",
        "search": policy_search("power", population=4, memory=2),
        "search_iterations": 1,
        "num_domains": 3,
        "num_initial_states": 2,
    }
    return LoopOptions(**{**settings, **changed})
