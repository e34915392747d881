"""A model bound to measured data, the input of every backend."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.embeddings import Embedding, embedding_by_name
from npdr_ppl.errors import DataError, ModelError, ShapeError
from npdr_ppl.inference.base import Problem
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.linear_regression_problem import LinearRegression
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import BlackBox, SimulatorBlackBox
from npdr_ppl.preparation.data_options import PLAIN_FEATURES, DataOptions
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.preparation.linear_regression import regression_of
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.differentiation import Smoothing

__all__ = ["BoundModel", "Data", "bind", "problem_of"]

Data = Rollouts | Tensor | Mapping[str, Rollouts | Tensor]
"""Observations: rollouts or a tensor for a model with one black-box site, or one for each site by
name."""


@dataclass(frozen=True)
class Observation:
    """The observation at one black-box site.

    Attributes:
        value: The observation in the shape of the site's value: plates, then the event. Channels
            that the data lack are zero.
        channels: Positions of the measured channels among the simulator's sensors, ``None`` for
            a plain function.
        inputs: The segments' inputs with these channels only, ``None`` for a plain function.
        embedding: Maps trajectories to features, ``None`` for the output itself.
    """

    value: Tensor
    channels: tuple[int, ...] | None
    inputs: Inputs | None
    embedding: Embedding | None

    def features(self, output: Tensor) -> Tensor:
        """Maps simulator output, ``(n,) + value.shape``, to features ``(n, ...)``."""
        if self.embedding is None or self.inputs is None or self.channels is None:
            return output.reshape(len(output), -1)
        measured = output[..., list(self.channels)]
        plates = measured.shape[1:-3]
        if not plates:
            return self.embedding.features(measured, self.inputs)
        elements = [
            self.embedding.features(part, self.inputs.element(index))
            for index, part in enumerate(measured.flatten(1, len(plates)).unbind(1))
        ]
        return torch.stack(elements, dim=1).flatten(1, 2)


@dataclass(frozen=True)
class BoundModel:
    """A model, its arguments and the observations.

    Attributes:
        model: The Pyro model.
        args: Its positional arguments.
        prior: Its prior in reference coordinates.
        observations: The observations, by black-box site.
        data: The data as given, by black-box site.
        options: How the data were prepared.
        starts: Initial states of the segments, if known better than by the smoother.
        likelihood: Likelihood of the recording with initial states integrated out, for models of
            one deterministic simulator; ``None`` for all others.
    """

    model: Model
    args: tuple[Any, ...]
    prior: Prior
    observations: Mapping[str, Observation]
    data: Mapping[str, Rollouts | Tensor]
    options: DataOptions
    starts: InitialStates | None = None
    likelihood: SegmentLikelihood | None = None

    def features(self, outputs: Mapping[str, Tensor]) -> Tensor:
        """Maps the sites' outputs to one feature array per simulation."""
        parts = [o.features(outputs[name]) for name, o in self.observations.items()]
        if len(parts) == 1:
            return parts[0]
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def observed_features(self) -> Tensor:
        """Returns the features of the observation, without batch dimension."""
        return self.features({n: o.value[None] for n, o in self.observations.items()})[0]

    def network_builder(self) -> Callable[[], torch.nn.Module] | None:
        """Returns the factory of the embedding's trainable network, if it has one."""
        embeddings = [o.embedding for o in self.observations.values()]
        trained = [e for e in embeddings if e is not None and e.is_trained]
        if not trained:
            return None
        if len(embeddings) > 1:
            raise ModelError(
                "A trained embedding serves models with one black-box site; use a fixed "
                "embedding, or join the sites."
            )
        shape = self.observed_features().shape

        def build() -> torch.nn.Module:
            network = trained[0].network(shape)
            if network is None:
                raise ModelError(f"{trained[0]!r} says it is trained, but has no network.")
            return network

        return build


def bind(
    model: Model,
    data: Data,
    options: DataOptions,
    device: str | torch.device = "cpu",
    *,
    starts: InitialStates | None = None,
    likelihood: SegmentLikelihood | None = None,
) -> BoundModel:
    """Binds a model to measured data.

    Args:
        model: A Pyro model with black-box sites; it takes the inputs of its site (a dictionary of
            inputs by site name if rollouts were measured at several), or nothing if all its sites
            are plain functions.
        data: The observations.
        options: How they are prepared.
        device: Where trajectories are simulated.
        starts: Initial states of the segments of the only rollouts, if better known than by the
            smoother.
        likelihood: Likelihood of the recording, if it has one; see :class:`BoundModel`.

    Raises:
        DataError: The data do not fit the model.
        ModelError: The model cannot be inferred; see :class:`~npdr_ppl.language.prior.Prior`.
    """
    named: Mapping[str, Rollouts | Tensor] | None = data if isinstance(data, Mapping) else None
    every: list[Rollouts | Tensor] = [data] if not isinstance(data, Mapping) else [*data.values()]
    recorded = [part for part in every if isinstance(part, Rollouts)]
    layout = [options.inputs(part) for part in recorded]
    if starts is not None:
        layout = [starts.put_into(inputs) for inputs in layout]
    layout = [inputs.to(device=device) for inputs in layout]
    args: tuple[Any, ...] = ()
    if len(layout) == 1:
        args = (layout[0],)
    elif named is not None and layout:
        names = [name for name, part in named.items() if isinstance(part, Rollouts)]
        args = (_InputsBySite(zip(names, layout, strict=True)),)
    prior = Prior(model, args)
    boxes = prior.black_boxes
    if not boxes:
        raise ModelError("The model has no black-box site; declare one with npdr.simulate.")
    if named is None:
        if len(boxes) > 1:
            raise DataError(
                f"The model has the black-box sites {', '.join(boxes)}; give the data of each as "
                "a dictionary."
            )
        named = dict.fromkeys(boxes, every[0])
    if set(named) != set(boxes):
        raise DataError(
            f"The data are for {', '.join(named)}, but the model's black-box sites are "
            f"{', '.join(boxes)}."
        )
    site_inputs = dict(
        zip([n for n, part in named.items() if isinstance(part, Rollouts)], layout, strict=True)
    )
    # Without a preparation there is no closest fit at which a score can be computed.
    embedding = PLAIN_FEATURES if options.embedding == "score" else options.embedding
    chosen = embedding_by_name(embedding) if isinstance(embedding, str) else embedding
    observations = {
        name: _observe(name, box, named[name], site_inputs.get(name), chosen, prior)
        for name, box in boxes.items()
    }
    return BoundModel(model, args, prior, observations, named, options, starts, likelihood)


def problem_of(bound: BoundModel, device: str | torch.device = "cpu") -> Problem:
    """Returns the inference problem that a backend receives."""
    prior = bound.prior
    return Problem(
        num_parameters=prior.num_parameters,
        observation=bound.observed_features().float(),
        sample_prior=lambda num: prior.sample(num).float(),
        log_prior=lambda z: prior.log_prob(z).to(z),
        is_prior_standard_normal=prior.is_standard_normal,
        build_network=bound.network_builder(),
        device=torch.device(device),
        regression=_regression(bound),
        log_likelihood=_log_likelihood(bound),
    )


def _log_likelihood(bound: BoundModel) -> Callable[[Tensor], Tensor] | None:
    """Returns the log density of all measurements, if the model has one with gradients."""
    prior, marginal = bound.prior, bound.likelihood
    if marginal is not None and marginal.is_differentiable:
        return marginal.log_prob
    for box in prior.black_boxes.values():
        if box.noise is None or not box.is_differentiable:
            return None

    def log_likelihood(z: Tensor) -> Tensor:
        total = torch.zeros(len(z), dtype=torch.float64)
        for name, observation in bound.observations.items():
            log_prob = prior.pointwise_log_prob(name, observation.value, z)
            if observation.channels is not None:  # absent ones hold zeros
                log_prob = log_prob[..., list(observation.channels)]
            total = total + log_prob.flatten(1).sum(-1).cpu()
        return total.to(z)

    return log_likelihood


def _regression(bound: BoundModel) -> Callable[[Smoothing], LinearRegression] | None:
    """Returns a function that makes the model's linear regression, once per choice of filters."""
    if len(bound.data) != 1:
        return None
    (name, data), *_ = bound.data.items()
    box = bound.prior.black_boxes[name]
    if not isinstance(box, SimulatorBlackBox) or not isinstance(data, Rollouts):
        return None

    @cache
    def regression(smoothing: Smoothing) -> LinearRegression:
        return regression_of(bound.prior, box, data, smoothing)

    return regression


class _InputsBySite(dict[str, Inputs]):
    """Inputs by site; raises an error if the model asks for a site without data."""

    def __missing__(self, name: str) -> Inputs:
        raise DataError(f"The data are for {', '.join(self)}, but the model asks for {name!r}.")


def _observe(
    name: str,
    box: BlackBox,
    data: Rollouts | Tensor,
    inputs: Inputs | None,
    embedding: Embedding | None,
    prior: Prior,
) -> Observation:
    if not isinstance(box, SimulatorBlackBox):
        if isinstance(data, Rollouts):
            raise DataError(
                f"Site {name!r} is a function without inputs, so its observation is a tensor; for "
                "rollouts, write f(parameters, initial_state, actions, time_step) and declare it "
                "with npdr.FunctionSimulator(f, states=[...], ...)."
            )
        value = torch.as_tensor(data, dtype=torch.get_default_dtype())
        with seeded(0, "bind", name):
            simulated = prior.execute(prior.sample(2))[name].shape[1:]
        if value.shape != simulated:
            raise ShapeError(
                f"The observation of {name!r} has shape {tuple(value.shape)}, but the model "
                f"simulates {tuple(simulated)}."
            )
        if not bool(torch.isfinite(value).all()):
            raise DataError(f"The observation of {name!r} contains NaN or infinity.")
        return Observation(value, None, None, None)
    if not isinstance(data, Rollouts) or inputs is None:
        raise DataError(f"Site {name!r} simulates trajectories; give rollouts, not a tensor.")
    simulator = box.simulator
    data.check(simulator.sensors, simulator.actions, allow_extra=True, strict=False)
    names = [sensor.name for sensor in simulator.sensors]
    measured = [channel for channel in names if channel in data.measured_names]
    if not measured:
        raise DataError(
            f"The data have none of the channels {', '.join(names)} that {simulator.name} "
            f"reports; they have {', '.join(data.channel_names)}."
        )
    if embedding is None:
        raise ModelError("Trajectories need an embedding; the default is 'bayessim'.")
    recorded = data.observation(inputs, channels=measured).to(inputs.actions.device)
    columns = tuple(names.index(channel) for channel in measured)
    value = recorded.new_zeros((*recorded.shape[:-1], len(names)))
    value[..., list(columns)] = recorded
    return Observation(value, columns, inputs.select_channels(measured), embedding)
