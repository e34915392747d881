"""Learned likelihoods go back into the program.

A posterior of a backend that learnt the likelihood of *one* simulation (``nle``, ``nre``) gives
any model with the same black box a density: hierarchical models of several devices and rollouts,
other priors, models in which the black box is one part of many. Pyro's NUTS and SVI then run on
them without simulating once more (Papamakarios, Sterratt & Murray 2019; Boelts et al. 2022 call
it amortisation over the model's structure).
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError, ModelError, ShapeError
from npdr_ppl.inference.parts.bases.likelihood_backend import LikelihoodBackend
from npdr_ppl.language.handlers import LikelihoodMessenger
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.model import Model
from npdr_ppl.language.sites import BlackBox, SimulatorBlackBox, SiteLikelihood
from npdr_ppl.posterior.posterior import Posterior

__all__ = ["LearnedLikelihood", "with_likelihood"]


class LearnedLikelihood:
    """The likelihood of one black box, as a backend learnt it.

    Of an ensemble the mean likelihood is taken. Outside the support of the prior that the
    simulations were drawn from the likelihood is zero, because nothing was learnt there.

    Args:
        posterior: A posterior of ``nle`` or ``nre``; its model has one black-box site whose
            parameters are latent sites of the same name, or constants.

    Raises:
        BackendError: The backend learns no likelihood.
        ModelError: The model is not of this kind.
    """

    def __init__(self, posterior: Posterior) -> None:
        backend = posterior.backend
        if not isinstance(backend, LikelihoodBackend):
            raise BackendError(
                f"Backend {backend.name!r} learns a posterior, which holds for one prior only; "
                "a likelihood for other models comes from 'nle' or 'nre'."
            )
        bound = posterior.bound
        if len(bound.observations) != 1:
            raise ModelError(
                f"The learnt likelihood must be of one black-box site; the model has "
                f"{', '.join(bound.observations)}."
            )
        (self._site, self._observation), *_ = bound.observations.items()
        self._prior = bound.prior
        self._box = bound.prior.black_boxes[self._site]
        if self._observation.value.dim() != len(self._box.event_shape):
            raise ModelError(
                "The learnt likelihood must be of a single simulation; the model it was learnt "
                f"from has plates around site {self._site!r}."
            )
        strangers = [s.name for s in self._prior.sites if s.name not in self._box.parameters]
        if strangers:
            raise ModelError(
                f"The latent sites {', '.join(strangers)} are not parameters of the black box "
                f"{self._site!r}; learn its likelihood from a model whose latent sites are."
            )
        self._members = backend.log_likelihoods(posterior.problem, posterior.states[-1])
        self._features: tuple[Tensor, Tensor] | None = None

    def log_prob(self, box: BlackBox, value: Tensor) -> Tensor:
        """Returns the learnt log density, of the batch shape; see :class:`SiteLikelihood`.

        Raises:
            ModelError: The site is not of the black box that was learnt.
            ShapeError: The value is not of its shape.
        """
        self._check(box, value)
        event_dim = self._observation.value.dim()
        batch = torch.broadcast_shapes(box.batch_shape, value.shape[: value.dim() - event_dim])
        parameters = {}
        for site in self._prior.sites:
            given = box.parameters[site.name].to(site.dtype)
            parameters[site.name] = given.expand(batch + site.shape).reshape((-1, *site.shape))
        inside = self._prior.on_support({k: v.detach() for k, v in parameters.items()})
        z = self._prior.to_reference(parameters)
        x = self._value_features(value)
        x = x.expand((*batch, -1)).reshape((-1, x.shape[-1]))
        members = torch.stack([member(z.float(), x) for member in self._members]).double()
        log_prob = members.logsumexp(0) - math.log(len(members))
        return torch.where(inside, log_prob, -torch.inf).reshape(batch)

    def _value_features(self, value: Tensor) -> Tensor:
        """Returns the features of a value, its batch shape plus ``(F,)``.

        The last value's are kept, because samplers ask for the same one at every step.
        """
        if self._features is None or self._features[0] is not value:
            event = self._observation.value.shape
            with torch.no_grad():
                flat = value.reshape((-1, *event)).to(self._observation.value.dtype)
                features = self._observation.features(flat).float()
            batch = value.shape[: value.dim() - len(event)]
            self._features = value, features.reshape((*batch, -1))
        return self._features[1]

    def _check(self, box: BlackBox, value: Tensor) -> None:
        event = self._observation.value.shape
        if value.shape[value.dim() - len(event) :] != event:
            raise ShapeError(
                f"The learnt likelihood is of values of shape {tuple(event)}; site {box.site!r} "
                f"has {tuple(value.shape)}."
            )
        latent = {site.name for site in self._prior.sites}
        unlike = [
            name
            for name, learnt in self._box.parameters.items()
            if name not in box.parameters
            or (name not in latent and not _are_equal(box.parameters[name], learnt))
        ]
        unlike += [name for name in box.parameters if name not in self._box.parameters]
        if unlike:
            raise ModelError(
                f"Site {box.site!r} is not the black box whose likelihood was learnt: they "
                f"differ in {', '.join(unlike)}."
            )
        if isinstance(box, SimulatorBlackBox) and isinstance(self._box, SimulatorBlackBox):
            if box.inputs is not self._box.inputs and not _have_equal(
                box.inputs, self._box.inputs
            ):
                raise ModelError(
                    f"Site {box.site!r} has other inputs than those the likelihood was learnt "
                    "for; a learnt likelihood holds for one set of actions and initial states."
                )


def with_likelihood(
    model: Model,
    estimator: Posterior | SiteLikelihood,
    *,
    site: str | None = None,
) -> Callable[..., Any]:
    """Returns the model with a learnt density at its black-box sites.

    Args:
        model: A Pyro model, hierarchical or not.
        estimator: A posterior of ``nle`` or ``nre`` fitted to a model of one simulation, or a
            likelihood of one's own.
        site: Name of the only black-box site to give it to; ``None`` for all.

    Returns:
        A Pyro model for ``pyro.infer.NUTS`` and ``SVI`` after ``pyro.condition``.

    Raises:
        BackendError: The posterior's backend learns no likelihood.
        ModelError: The posterior's model is not of one black box.

    Example:
        >>> import pyro, pyro.distributions as dist, torch
        >>> import npdr_ppl as npdr
        >>> def counter(rate):
        ...     return torch.poisson(20 * rate)[:, None] / 20
        >>> def one():
        ...     rate = pyro.sample("rate", dist.Uniform(0.5, 2.0))
        ...     return npdr.simulate("x", counter, {"rate": rate})
        >>> learnt = npdr.infer(one, torch.tensor([1.0]), backend="nle", num_simulations=500)
        >>> def series():
        ...     mean = pyro.sample("mean", dist.Uniform(0.8, 1.6))
        ...     with pyro.plate("device", 3):
        ...         rate = pyro.sample("rate", dist.Normal(mean, 0.1))
        ...         return npdr.simulate("x", counter, {"rate": rate})
        >>> measured = torch.tensor([[1.0], [1.2], [1.1]])
        >>> conditioned = pyro.condition(npdr.with_likelihood(series, learnt), {"x": measured})
        >>> pyro.poutine.trace(conditioned).get_trace().log_prob_sum().isfinite().item()
        True
    """
    if isinstance(estimator, Posterior):
        estimator = LearnedLikelihood(estimator)
    return LikelihoodMessenger(estimator, site)(model)


def _are_equal(a: Tensor, b: Tensor) -> bool:
    return bool(torch.allclose(a.double(), b.double(), rtol=1e-6))


def _have_equal(a: Inputs, b: Inputs) -> bool:
    return (
        a.time_step == b.time_step
        and a.actions.shape == b.actions.shape
        and a.initial_values.shape == b.initial_values.shape
        and bool(torch.equal(a.actions, b.actions))
        and bool(torch.equal(a.initial_values, b.initial_values))
        and bool(torch.equal(a.mask, b.mask))
    )
