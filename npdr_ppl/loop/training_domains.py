"""The choice of the domains in which the loop trains a policy after an iteration.

They are made by ``domains.py``; this module chooses their parameters, with the options' spread.
"""

from collections.abc import Callable

import torch

from npdr_ppl.loop.domains import Domains, domains_at
from npdr_ppl.loop.loop_options import SPREAD_WIDER, Action, LoopOptions
from npdr_ppl.posterior.posterior import Posterior

__all__ = ["training_domains"]


def training_domains(
    posterior: Posterior,
    options: LoopOptions,
    action: Action,
    *,
    from_prior: Callable[[int], Domains],
    seed: int,
    most_likely_seed: int,
    num_restarts: int = 0,
) -> Domains:
    """Returns draws of the posterior, or its most likely sample, with the options' spread.

    Args:
        posterior: The posterior.
        options: Options of the loop.
        action: The action after the diagnosis; it may need more spread, or draws of the prior.
        from_prior: Draws a given number of domains from the prior.
        seed: Seed of the draws.
        most_likely_seed: Seed of the search for the most likely sample.
        num_restarts: Restarts of the policy search before this one; each halves the spread.
    """
    num_prior = 0
    if action is Action.MIXED:
        num_prior = round(options.prior_share * options.num_domains)
    number = options.num_domains - num_prior
    if options.domains == "posterior":
        z = posterior.sample_mixture(number, seed=seed)
    else:
        most_likely = posterior.most_likely(seed=most_likely_seed)
        z = posterior.prior.to_reference({k: v[None] for k, v in most_likely.items()})
        z = z.expand(number, -1)
    generator = torch.Generator().manual_seed(seed)
    # If the model is wrong, its posterior is too narrow, by an unknown factor.
    spread = options.spread * (2.0 if action in SPREAD_WIDER else 1.0)
    # No policy may exist for all domains of a wide spread, and a compromise can fail in all draws
    # of the posterior itself.
    spread *= 0.5**num_restarts
    domains = domains_at(posterior.prior, z).spread(spread, generator)
    return domains.followed_by(from_prior(num_prior)) if num_prior else domains
