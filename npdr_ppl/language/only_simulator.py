"""The simulator of a model that has one, without any data."""

from collections.abc import Mapping

import torch
from pyro import poutine
from torch import Tensor

from npdr_ppl.errors import ModelError, NpdrError
from npdr_ppl.language.handlers import SkipSimulation
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.model import Model
from npdr_ppl.language.program_runs import alone, sample_sites, traced
from npdr_ppl.language.sites import BlackBox, SimulatorBlackBox

__all__ = ["only_simulator"]


def only_simulator(
    model: Model, values: Mapping[str, Tensor] | None = None
) -> tuple[SimulatorBlackBox, set[str]]:
    """Returns the only black-box site of a model, and the names of its other sites.

    The model's program runs, but nothing is simulated.

    Args:
        model: The model.
        values: Values by site; those that are not given are drawn from the priors.

    Raises:
        ModelError: The model has several black-box sites or one without a simulator, or its
            program needs a recording.
    """
    # Inputs without channels, which a program only passes on.
    nothing = Inputs.single(
        torch.zeros(1, 0), torch.zeros(0), action_names=(), state_names=(), time_step=1.0
    )
    with alone(), torch.random.fork_rng(devices=[]), SkipSimulation():
        try:
            trace = traced(poutine.condition(model, data=dict(values or {})), (nothing,))
        except NpdrError:
            raise
        except Exception as error:  # of the user's program
            raise ModelError(
                f"The model cannot run without a recording ({type(error).__name__}: "
                f"{str(error).splitlines()[0] if str(error) else 'no message'})."
            ) from error
    sites = dict(sample_sites(trace))
    boxes = [site["fn"] for site in sites.values() if isinstance(site["fn"], BlackBox)]
    if len(boxes) != 1 or not isinstance(boxes[0], SimulatorBlackBox):
        raise ModelError(f"The model has {len(boxes)} black-box sites; one simulator is needed.")
    latent = {name for name, site in sites.items() if not isinstance(site["fn"], BlackBox)}
    return boxes[0], latent
