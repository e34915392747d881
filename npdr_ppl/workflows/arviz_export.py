"""The posterior as an ArviZ object: the only thing that diagnostics read."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.randomness import seeded
from npdr_ppl.workflows.units import parameter_units

if TYPE_CHECKING:
    from npdr_ppl.workflows.arviz_module import Data
    from npdr_ppl.workflows.posterior import PosteriorBase

__all__ = ["effective_share", "segment_log_likelihood", "to_arviz"]

MIN_STEPS = 8
"""Steps of a segment below which autocorrelation cannot be estimated."""

MAX_PREDICTIVE_DRAWS = 100
"""Posterior predictive draws of each member; trajectories are large."""

MAX_PRIOR_PREDICTIVE_DRAWS = 50
"""Prior predictive draws, those of the first prior draws; enough to see what the prior allows."""


def to_arviz(posterior: "PosteriorBase", num_samples: int = 1_000, *, seed: int = 0) -> "Data":
    """Exports a posterior.

    Groups: ``prior`` and ``prior_predictive``; ``posterior`` with one chain per independently
    trained member; ``posterior_predictive``; ``observed_data``; ``constant_data`` (the inputs);
    ``log_likelihood`` with one value per *segment*; ``sample_stats`` with the log density of
    every draw. Readings of one segment are strongly correlated, which is why single time steps
    never count as observations. Parameters carry their ``units`` as an attribute where they are
    known.

    Where the model declares no noise, the log likelihood is that of a Gaussian error per channel
    whose variance is estimated from the posterior predictive. Either is weighted by the share of
    independent readings; see :func:`effective_share`. The attribute ``error_model`` of the
    log likelihood says what was used.

    Args:
        posterior: The posterior.
        num_samples: Draws per member.
        seed: Seed of the draws.
    """
    from npdr_ppl.workflows.arviz_module import from_dict

    prior = posterior.prior
    z = posterior.sample_reference(num_samples, seed=seed)
    members = z.shape[0]

    def by_chain(values: dict[str, Tensor]) -> dict[str, np.ndarray]:
        return {k: _array(v.reshape(members, -1, *v.shape[1:])) for k, v in values.items()}

    with seeded(seed, "prior"):
        prior_z = prior.sample(num_samples)
        prior_predictive = prior.execute(prior_z[:MAX_PRIOR_PREDICTIVE_DRAWS])
    few = min(num_samples, MAX_PREDICTIVE_DRAWS)
    predictive_z = z[:, :few].flatten(0, 1)
    with seeded(seed, "predictive"):
        predictive = prior.execute(predictive_z)
    observations = posterior.bound.observations
    coords: dict[str, list[str]] = {}
    dims: dict[str, list[str]] = {}
    constant: dict[str, np.ndarray] = {}
    for name, observation in observations.items():
        box = prior.black_boxes[name]
        if not isinstance(box, SimulatorBlackBox) or observation.inputs is None:
            continue
        event = [f"{name}_segment", f"{name}_step", f"{name}_channel"]
        dims[name] = _plate_dims(name, observation.value.dim() - 3) + event
        coords[event[2]] = [sensor.name for sensor in box.simulator.sensors]
        inputs = observation.inputs
        constant[f"{name}_mask"] = _array(inputs.mask)
        constant[f"{name}_actions"] = _array(inputs.actions)
        constant[f"{name}_rollout"] = _array(inputs.rollout)
        constant[f"{name}_start"] = _array(inputs.start)
        constant[f"{name}_measured"] = np.isin(
            np.arange(len(box.simulator.sensors)), observation.channels or ()
        )
        dims[f"{name}_mask"] = event[:2]
        dims[f"{name}_rollout"] = dims[f"{name}_start"] = event[:1]
        dims[f"{name}_measured"] = event[2:]
    likelihood = {
        name: segment_log_likelihood(posterior, name, predictive[name], predictive_z)
        for name in observations
    }
    log_density = posterior.log_prob_reference(z.flatten(0, 1)).reshape(members, -1)
    groups = {
        "posterior": by_chain(prior.to_parameters(z.flatten(0, 1))),
        "prior": {k: _array(v[None]) for k, v in prior.to_parameters(prior_z).items()},
        "prior_predictive": {k: _array(v[None]) for k, v in prior_predictive.items()},
        "posterior_predictive": by_chain(predictive),
        "observed_data": {n: _array(o.value) for n, o in observations.items()},
        "sample_stats": {"lp": _array(log_density)},
        "log_likelihood": by_chain({n: v for n, (v, _) in likelihood.items()}),
    }
    if constant:
        groups["constant_data"] = constant
    return from_dict(
        groups,
        coords=coords,
        dims=dims,
        attrs={"inference_library": "npdr_ppl", "backend": posterior.backend_name},
        variable_attrs={
            "posterior": {n: {"units": u} for n, u in parameter_units(posterior).items()},
            "prior": {n: {"units": u} for n, u in parameter_units(posterior).items()},
            "log_likelihood": {n: {"error_model": m} for n, (_, m) in likelihood.items()},
        },
    )


def segment_log_likelihood(
    posterior: "PosteriorBase", name: str, predictive: Tensor, z: Tensor
) -> tuple[Tensor, str]:
    """Returns log p(segment | draw), ``(n, segments)``, and what error model it stands on.

    Args:
        posterior: The posterior.
        name: The black-box site.
        predictive: Simulations at the draws, ``(n,) + plates + event``.
        z: The draws, ``(n, d)``.
    """
    observation = posterior.bound.observations[name]
    residual = (predictive - observation.value).double()
    if posterior.prior.black_boxes[name].has_density:
        log_prob = posterior.prior.pointwise_log_prob(name, observation.value, z).double()
        error_model = "declared noise"
    else:
        axes = tuple(range(residual.dim() - 1))
        variance = residual.square().mean(axes).clamp_min(torch.finfo(torch.float64).tiny)
        log_prob = -0.5 * (residual.square() / variance + torch.log(2 * torch.pi * variance))
        error_model = "Gaussian, variance estimated"
    if observation.inputs is None or observation.channels is None:
        return log_prob.reshape(len(z), -1).sum(-1, keepdim=True).cpu(), error_model
    channels, mask = list(observation.channels), observation.inputs.mask.cpu()
    log_prob, residual = log_prob.cpu(), residual.cpu()
    log_prob = log_prob[..., channels] * mask[..., None]
    log_prob = log_prob.reshape(len(z), -1, *log_prob.shape[-2:])
    # What the mean prediction leaves over tells how far readings of a segment are independent.
    left = residual.mean(0)[..., channels].reshape(log_prob.shape[1:])
    share = effective_share(left, mask)
    shown = ", ".join(f"{value:.2g}" for value in share)
    return (log_prob * share).sum((-1, -2)), f"{error_model}, independent readings {shown}"


def effective_share(residual: Tensor, mask: Tensor) -> Tensor:
    """Returns which share of a segment's readings is worth an independent one, per channel.

    The residuals of the segments are treated as chains, whose effective sample size ArviZ
    estimates; readings weighted by it make a composite likelihood of the right magnitude (Ribatet,
    Cooley & Davison 2012).

    Args:
        residual: Residuals, ``(plates × segments, steps, channels)``.
        mask: Which steps exist, ``(segments, steps)``.
    """
    from npdr_ppl.workflows.arviz_module import ess_of_array

    whole = mask.all(-1).repeat(len(residual) // len(mask))
    chains = residual[whole] if bool(whole.any()) else residual
    total = chains.shape[0] * chains.shape[1]
    if chains.shape[1] < MIN_STEPS:
        return torch.ones(residual.shape[-1], dtype=torch.float64)
    sizes = [ess_of_array(values.numpy(), method="mean") for values in chains.unbind(-1)]
    share = torch.tensor(sizes, dtype=torch.float64) / total
    return share.nan_to_num(1.0).clamp(1 / chains.shape[1], 1.0)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _plate_dims(name: str, num: int) -> list[str]:
    return [f"{name}_plate_{i}" for i in range(num)]
