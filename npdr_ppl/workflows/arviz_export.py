"""The posterior as an ArviZ object: the only thing that diagnostics read."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.randomness import seeded

if TYPE_CHECKING:
    from npdr_ppl.workflows.arviz_module import az
    from npdr_ppl.workflows.posterior import Posterior

__all__ = ["to_arviz"]

MAX_PREDICTIVE_DRAWS = 100
"""Posterior predictive draws of each member; trajectories are large."""


def to_arviz(
    posterior: "Posterior", num_samples: int = 1_000, *, seed: int = 0
) -> "az.InferenceData":
    """Exports a posterior.

    Groups: ``prior``; ``posterior`` with one chain per independently trained member;
    ``posterior_predictive``; ``observed_data``; ``constant_data`` (the inputs);
    ``log_likelihood`` with one value per *segment*; ``sample_stats`` with the log density of
    every draw. Readings of one segment are strongly correlated, which is why single time steps
    never count as observations.

    Where the model declares no noise, the log likelihood is that of a Gaussian error per channel
    whose variance is estimated from the posterior predictive; the group's attribute
    ``error_model`` says which.

    Args:
        posterior: The posterior.
        num_samples: Draws per member.
        seed: Seed of the draws.
    """
    from npdr_ppl.workflows.arviz_module import az

    prior = posterior.prior
    z = posterior.sample_reference(num_samples, seed=seed)
    members = z.shape[0]

    def by_chain(values: dict[str, Tensor]) -> dict[str, np.ndarray]:
        return {k: v.reshape(members, -1, *v.shape[1:]).numpy() for k, v in values.items()}

    with seeded(seed, "prior"):
        prior_draws = prior.to_parameters(prior.sample(num_samples))
    few = min(num_samples, MAX_PREDICTIVE_DRAWS)
    predictive_z = z[:, :few].flatten(0, 1)
    with seeded(seed, "predictive"):
        predictive = prior.execute(predictive_z)
    observations = posterior.bound.observations
    coords: dict[str, object] = {}
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
        constant[f"{name}_mask"] = inputs.mask.numpy()
        constant[f"{name}_actions"] = inputs.actions.numpy()
        constant[f"{name}_rollout"] = inputs.rollout.numpy()
        constant[f"{name}_start"] = inputs.start.numpy()
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
    draws = by_chain(prior.to_parameters(z.flatten(0, 1)))
    data = az.from_dict(
        posterior=draws,
        prior={k: v[None].numpy() for k, v in prior_draws.items()},
        posterior_predictive=by_chain(predictive),
        observed_data={n: o.value.numpy() for n, o in observations.items()},
        constant_data=constant or None,
        sample_stats={
            "lp": posterior.log_prob_reference(z.flatten(0, 1)).reshape(members, -1).numpy()
        },
        log_likelihood=by_chain({n: v for n, (v, _) in likelihood.items()}),
        coords=coords,
        dims=dims,
        attrs={"inference_library": "npdr_ppl", "backend": posterior.backend.name},
    )
    data["log_likelihood"].attrs["error_model"] = ", ".join(m for _, m in likelihood.values())
    return data


def segment_log_likelihood(
    posterior: "Posterior", name: str, predictive: Tensor, z: Tensor
) -> tuple[Tensor, str]:
    """Returns log p(segment | draw), ``(n, segments)``, and what error model it stands on.

    Args:
        posterior: The posterior.
        name: The black-box site.
        predictive: Simulations at the draws, ``(n,) + plates + event``.
        z: The draws, ``(n, d)``.
    """
    observation = posterior.bound.observations[name]
    if posterior.prior.black_boxes[name].noise is not None:
        exact = posterior.prior.segment_log_prob(name, observation.value, z)
        return exact.flatten(1), "declared noise"
    residual = predictive - observation.value
    if observation.inputs is None or observation.channels is None:
        residual = residual.reshape(len(residual), 1, -1)
        variance = residual.square().mean(dim=(0, 1), keepdim=True)
    else:
        residual = residual[..., list(observation.channels)]
        residual = residual.reshape(len(residual), -1, *residual.shape[-2:])
        mask = observation.inputs.mask[..., None].expand(residual.shape[1:])
        count = mask.sum(dim=(0, 1)) * len(residual)
        variance = (residual.square() * mask).sum(dim=(0, 1, 2)) / count
        residual = residual * mask
        variance = variance.expand_as(residual[0])
    variance = variance.clamp_min(torch.finfo(residual.dtype).tiny)
    log_prob = -0.5 * (residual.square() / variance + torch.log(2 * torch.pi * variance))
    if observation.inputs is not None:
        log_prob = log_prob * observation.inputs.mask[..., None].expand_as(log_prob[0])
    # Readings of a segment are correlated; a segment weighs as much as its mean reading.
    return log_prob.flatten(2).mean(-1), "Gaussian, estimated, mean over a segment"


def _plate_dims(name: str, num: int) -> list[str]:
    return [f"{name}_plate_{i}" for i in range(num)]
