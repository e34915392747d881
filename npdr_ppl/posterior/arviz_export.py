"""The posterior as an ArviZ object: the only thing that diagnostics read."""

import json
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.posterior.density_mixture import DensityMixture
from npdr_ppl.posterior.exported_checks import ATTRIBUTE
from npdr_ppl.posterior.parameter_units import parameter_units
from npdr_ppl.preparation.draw_budget import affordable_draws, executed_in_parts
from npdr_ppl.preparation.effective_share import effective_share
from npdr_ppl.preparation.sampling_settings import DRAW_BUDGET
from npdr_ppl.randomness import seeded

if TYPE_CHECKING:
    from npdr_ppl.arviz_module import Data

__all__ = ["to_arviz"]


MAX_PREDICTIVE_DRAWS = 100
"""Number of posterior predictive draws of each member. All of them have log likelihoods. The
number of trajectories that are kept is limited by
:data:`~npdr_ppl.preparation.sampling_settings.DRAW_BUDGET`."""

MAX_PRIOR_PREDICTIVE_DRAWS = 50
"""Prior predictive draws, those of the first prior draws; enough to see what the prior allows."""


def to_arviz(posterior: DensityMixture, num_samples: int = 1_000, *, seed: int = 0) -> "Data":
    """Exports a posterior.

    Groups: ``prior`` and ``prior_predictive``; ``posterior`` with one chain per independently
    trained member; ``posterior_predictive``; ``observed_data``; ``constant_data`` (the inputs);
    ``log_likelihood`` with one value per *segment*; ``sample_stats`` with the log density of
    every draw. Trajectories of long recordings are large: then the predictive groups have fewer
    draws, the first ones of each chain. Readings of one segment are strongly correlated, which is
    why single time steps never count as observations. Parameters carry their ``units`` as an
    attribute where they are known.

    Where the model declares no noise, the log likelihood is that of a Gaussian error per channel
    whose variance is estimated from the posterior predictive. Either is weighted by the share of
    independent readings; see :mod:`npdr_ppl.preparation.effective_share`. The attribute
    ``error_model`` of the log likelihood says what was used.

    Args:
        posterior: The posterior.
        num_samples: Draws per member.
        seed: Seed of the draws.
    """
    from npdr_ppl.arviz_module import from_dict

    prior = posterior.prior
    z = posterior.sample_reference(num_samples, seed=seed)
    members = z.shape[0]
    observations = posterior.bound.observations
    num_readings = sum(observation.value.numel() for observation in observations.values())

    def by_chain(values: dict[str, Tensor]) -> dict[str, np.ndarray]:
        return {k: _array(v.reshape(members, -1, *v.shape[1:])) for k, v in values.items()}

    with seeded(seed, "prior"):
        prior_z = prior.sample(num_samples)
        num_prior = affordable_draws(
            MAX_PRIOR_PREDICTIVE_DRAWS, num_readings, budget=DRAW_BUDGET.most_bytes // 4
        )
        prior_predictive = prior.execute(prior_z[:num_prior])
    few = min(num_samples, MAX_PREDICTIVE_DRAWS)
    predictive_z = z[:, :few].flatten(0, 1)
    is_kept = torch.zeros(members, few, dtype=torch.bool)
    is_kept[:, : affordable_draws(few, members * num_readings)] = True
    predictive, likelihood = _predicted(
        posterior, predictive_z, is_kept.flatten(), num_readings, seed=seed
    )
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
    if (known := posterior.bound.likelihood) is not None:
        noise = "declared" if known.is_noise_declared else "estimated"
        model = (
            f"{noise} noise, initial states integrated out, independent measurements "
            f"{known.share:.2g}"
        )
        values = known.by_segment(predictive_z)
        likelihood = {name: (values, model) for name in observations}
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
        attrs={
            "inference_library": "npdr_ppl",
            "backend": posterior.backend_name,
            ATTRIBUTE: json.dumps(posterior.checks()),
        },
        variable_attrs={
            "posterior": {n: {"units": u} for n, u in parameter_units(posterior.prior).items()},
            "prior": {n: {"units": u} for n, u in parameter_units(posterior.prior).items()},
            "log_likelihood": {n: {"error_model": m} for n, (_, m) in likelihood.items()},
        },
    )


def _predicted(
    posterior: DensityMixture, z: Tensor, is_kept: Tensor, num_readings: int, *, seed: int
) -> tuple[dict[str, Tensor], dict[str, tuple[Tensor, str]]]:
    """Simulates draws in parts, and keeps some of the trajectories.

    Args:
        posterior: The posterior.
        z: The draws, ``(n, d)``.
        is_kept: Mask of the draws whose trajectories are kept, ``(n,)``.
        num_readings: Number of measurements in one simulation.
        seed: Seed of the random numbers in simulations.

    Returns:
        Two dictionaries by site: the trajectories that are kept; and the log likelihood of all
        draws, ``(n, segments)``, with the description of its error model.
    """
    sites = {name: _SegmentLikelihood(posterior, name) for name in posterior.bound.observations}
    kept: dict[str, list[Tensor]] = {name: [] for name in posterior.prior.black_boxes}
    done = 0
    with seeded(seed, "predictive"):
        for part, outputs in executed_in_parts(posterior.prior, z, num_readings):
            own = is_kept[done : done + len(part)]
            done += len(part)
            for name, output in outputs.items():
                kept[name].append(output[own.to(output.device)])
            for name, site in sites.items():
                site.add(part, outputs[name])
    return (
        {name: torch.cat(parts) for name, parts in kept.items()},
        {name: site.finish() for name, site in sites.items()},
    )


class _SegmentLikelihood:
    """Sums up log p(segment | draw) of one site, draw by draw.

    Args:
        posterior: The posterior.
        name: The black-box site.
    """

    def __init__(self, posterior: DensityMixture, name: str) -> None:
        self._prior, self._name = posterior.prior, name
        self._observation = posterior.bound.observations[name]
        self._has_density = posterior.prior.black_boxes[name].has_density
        observed = self._segments(self._observation.value[None])[0]  # (G, K, C)
        inputs = self._observation.inputs
        self._mask = torch.ones(observed.shape, dtype=torch.bool)
        if inputs is not None:
            measured = inputs.measured(inputs.channel_names).cpu()
            repeats = len(observed) // inputs.num_segments
            self._mask = measured.repeat(repeats, 1, 1).expand(observed.shape)
        self._parts: list[Tensor] = []
        self._left = torch.zeros(observed.shape, dtype=torch.float64)
        self._square = torch.zeros(observed.shape[-1], dtype=torch.float64)
        self._num_draws = 0

    def add(self, z: Tensor, predictive: Tensor) -> None:
        """Takes simulations ``(n,) + plates + event`` at draws ``(n, d)`` into account."""
        residual = self._segments((predictive - self._observation.value).double().cpu())
        self._left += residual.sum(0)
        square = residual.square_() * self._mask
        self._square += square.sum((0, 1, 2))
        self._num_draws += len(z)
        if self._has_density:
            value = self._observation.value
            density = self._prior.pointwise_log_prob(self._name, value, z).double().cpu()
            self._parts.append((self._segments(density) * self._mask).sum(2))
        else:
            self._parts.append(square.sum(2))

    def finish(self) -> tuple[Tensor, str]:
        """Returns the log likelihood, ``(n, segments)``, and the name of its error model."""
        log_prob, error_model = torch.cat(self._parts), "declared noise"  # (n, G, C)
        if not self._has_density:
            count = self._mask.sum((0, 1)).clamp_min(1)
            variance = self._square / (self._num_draws * count)
            variance = variance.clamp_min(torch.finfo(torch.float64).tiny)
            constant = self._mask.sum(1) * torch.log(2 * torch.pi * variance)
            log_prob = -0.5 * (log_prob / variance + constant)
            error_model = "Gaussian, variance estimated"
        inputs = self._observation.inputs
        if inputs is None or self._observation.channels is None:
            return log_prob.sum((1, 2))[:, None], error_model
        # What the mean prediction leaves over tells how far readings of a segment are independent.
        share = effective_share(self._left / self._num_draws, self._mask)
        shown = ", ".join(f"{value:.2g}" for value in share)
        return (log_prob * share).sum(-1), f"{error_model}, independent readings {shown}"

    def _segments(self, values: Tensor) -> Tensor:
        """Returns readings ``(n,) + plates + event`` by segment, ``(n, G, K, C)``.

        Channels that were not measured are left out; a plain function's output is one segment.
        """
        observation = self._observation
        if observation.inputs is None or observation.channels is None:
            last = values.shape[-1] if values.dim() > 1 else 1
            return values.reshape(len(values), 1, -1, last)
        segments = values.reshape(len(values), -1, *values.shape[-2:])
        every = len(observation.channels) == values.shape[-1]
        return segments if every else segments[..., list(observation.channels)]


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _plate_dims(name: str, num: int) -> list[str]:
    return [f"{name}_plate_{i}" for i in range(num)]
