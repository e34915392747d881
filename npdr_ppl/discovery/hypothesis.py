"""A hypothesis: the model with some effects, fitted to the recording."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any
from weakref import ref

import torch
from torch import Tensor

from npdr_ppl.discovery.kept_fits import made_or_read
from npdr_ppl.discovery.settings import HYPOTHESIS
from npdr_ppl.errors import DataError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.language.model import Model
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_fit import SegmentFit, fit_segments
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts

__all__ = ["Hypothesis", "extended", "fit_hypothesis", "fit_segment_model", "with_effects"]


@dataclass(frozen=True)
class Hypothesis:
    """A model with effects, fitted to the recording.

    Attributes:
        model: The model, effects included.
        effects: The effects that were added to the original model, in the order of adding.
        segments: The model on the recording's segments.
        fit: Parameters and initial states with the smallest misfit.
    """

    model: Model
    effects: tuple[Effect, ...]
    segments: SegmentModel
    fit: SegmentFit

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out the linearisation, which the other process computes again if it needs it."""
        return {name: value for name, value in vars(self).items() if name != "_linearised"}

    @property
    def names(self) -> tuple[str, ...]:
        """The effects' names."""
        return tuple(effect.name for effect in self.effects)

    @property
    def simulator(self) -> Simulator:
        """The simulator with all effects."""
        return self.segments.simulator

    @cached_property
    def difference(self) -> Tensor:
        """Measurement minus simulation at the fit, ``(S, K, C)``."""
        difference = self.segments.difference(self.fit.z[None], self.fit.offsets[None])[0]
        _KEPT.add(self, "difference", difference.nbytes)
        return difference

    def keep_difference(self, difference: Tensor) -> None:
        """Sets :attr:`difference`, which is known, so that it is not simulated again."""
        self.__dict__["difference"] = difference
        _KEPT.add(self, "difference", difference.nbytes)

    def keep_linearisation(self, linearisation: Linearisation) -> None:
        """Sets :attr:`linearisation`, which is known, so that it is not simulated again."""
        self.__dict__["_linearised"] = linearisation
        _KEPT.add(self, "_linearised", linearisation.num_bytes)

    @property
    def known_linearisation(self) -> Linearisation | None:
        """:attr:`linearisation` if it need not be computed."""
        return vars(self).get("_linearised")

    @cached_property
    def _linearised(self) -> Linearisation:
        found = self.segments.linearise(self.fit.z, self.fit.offsets, self.fit.scale)
        _KEPT.add(self, "_linearised", found.num_bytes)
        return found

    def averaged(self) -> "Hypothesis":
        """Returns the hypothesis with neighbouring measurements averaged if there are very many.

        For a :class:`Projection` only: a likelihood needs all measurements.
        """
        segments = self.segments.averaged(HYPOTHESIS.most_measurements, HYPOTHESIS.least_averages)
        return self if segments is self.segments else replace(self, segments=segments)

    def along(self, index: Tensor) -> "Hypothesis":
        """Returns the hypothesis along some of the segments, with the same parameters.

        Args:
            index: Their indices.
        """
        fit = replace(self.fit, offsets=self.fit.offsets[index])
        return Hypothesis(self.model, self.effects, self.segments.along(index), fit)

    @property
    def can_be_linearised(self) -> bool:
        """Whether the simulation succeeds at the fit and close to it."""
        return self._linearised.is_regular

    @property
    def linearisation(self) -> Linearisation:
        """Residuals and derivatives at the fit, whitened by its own scale.

        Raises:
            DataError: Simulations fail close to the fit.
        """
        if not self.can_be_linearised:
            raise DataError(
                "Simulations fail right beside the model's closest fit; check the recording's "
                "units, take shorter segments, or narrow the priors."
            )
        return self._linearised

    def estimated_starts(self) -> InitialStates | None:
        """Estimates the segments' initial states and their errors along the fitted motion."""
        return self.segments.estimated_starts(self.fit.z, self.fit.scale)

    @cached_property
    def parameters(self) -> dict[str, Tensor]:
        """The fitted parameters by latent site, each of shape ``site.shape``."""
        values = self.segments.prior.to_parameters(self.fit.z[None])
        return {name: value[0] for name, value in values.items()}

    @cached_property
    def share(self) -> float:
        """Effective number of independent measurements, as a share of all measurements."""
        residual = self.segments.whitened(self.difference, self.fit.scale)
        return self.segments.effective_share(residual)

    @cached_property
    def likelihood(self) -> SegmentLikelihood:
        """The recording's likelihood, with the noise estimated from the fit's residuals.

        Raises:
            DataError: Simulations fail close to the fit.
        """
        return SegmentLikelihood(
            self.segments, self.fit, self.linearisation, self.share, is_noise_declared=False
        )

    def losses(self, scale: Tensor) -> Tensor:
        """Returns minus the log density of each segment, up to a constant, ``(S,)``.

        Args:
            scale: Standard deviation of the measurements per channel, ``(C,)``.
        """
        residual = self.segments.whitened(self.difference, scale)
        return 0.5 * (residual.square().sum(-1) + self.fit.offsets.square().sum(-1))

    def squares(self, scale: Tensor) -> Tensor:
        """Returns the sum of squared whitened residuals of each channel, ``(C,)``.

        Args:
            scale: Standard deviation of the measurements per channel, ``(C,)``.
        """
        residual = self.segments.whitened(self.difference, scale)
        return residual.square().unflatten(-1, (-1, len(scale))).sum((0, 1))

    def at_edge(self, effect: Effect) -> tuple[str, ...]:
        """Returns the names of an effect's shape parameters with an implausible value.

        With such a value the law may equal another law: wind with a speed of zero is drag.
        Strengths may have any size, and frequencies are searched everywhere.
        """
        shapes = {p.name for p in effect.parameters} - set(effect.strength) - {effect.wave}
        if not effect.strength:
            return ()
        sites = dict(zip(effect.parameter_names, (p.name for p in effect.parameters), strict=True))
        return tuple(
            sites[site.name]
            for site in self.segments.prior.sites
            if sites.get(site.name) in shapes
            and bool(
                (self.fit.z[site.coordinates].abs() > HYPOTHESIS.implausible_coordinate).any()
            )
        )

    @property
    def complexity(self) -> float:
        """The evidence's penalty for the priors and the number of the effects' parameters.

        It is half the squared coordinates, plus half the log of the number of segments for each
        parameter of an effect: each prior is worth one segment (Kass & Wasserman 1995). Priors as
        wide as typical sizes would penalise every effect that is small but clearly detected.
        """
        z = self.fit.z.clamp_min(HYPOTHESIS.least_penalised)
        num = sum(len(effect.parameters) for effect in self.effects)
        return 0.5 * float(z.square().sum()) + 0.5 * num * math.log(len(self.fit.offsets))


class _Kept:
    """Bounds the memory of what fitted models cache: the oldest is dropped, and computed again.

    A search compares tens of fitted models. On a long recording of many channels, a linearisation
    has hundreds of megabytes.
    """

    def __init__(self) -> None:
        self._kept: list[tuple[ref[Hypothesis], str, int]] = []

    def add(self, hypothesis: Hypothesis, name: str, num_bytes: int) -> None:
        """Notes that a hypothesis caches something, and drops others if they are too large.

        Args:
            hypothesis: The hypothesis.
            name: Name of the cached attribute.
            num_bytes: Its size.
        """
        alive = [
            (owner, other, size)
            for owner, other, size in self._kept
            if owner() is not None and (owner() is not hypothesis or other != name)
        ]
        self._kept = [*alive, (ref(hypothesis), name, num_bytes)]
        while len(self._kept) > 1 and sum(n for _, _, n in self._kept) > HYPOTHESIS.kept_bytes:
            (oldest, dropped, _), *self._kept = self._kept
            if (owner_now := oldest()) is not None:
                vars(owner_now).pop(dropped, None)


_KEPT = _Kept()


def with_effects(model: Model, effects: Sequence[Effect]) -> Model:
    """Returns the model with effects attached."""
    for effect in effects:
        model = add_effect(model, effect)
    return model


def extended(
    base: SegmentModel, effects: Sequence[Effect], starts: InitialStates | None
) -> SegmentModel:
    """Returns a model with effects along the segments of the model without them.

    Args:
        base: The model without effects, along the recording.
        effects: The effects.
        starts: The segments' initial states; ``None`` for those of the smoother.

    Raises:
        ModelError: An effect cannot be attached to the model.
    """
    segments = base.starting_from(starts)
    return segments.with_model(with_effects(base.model, effects)) if effects else segments


def fit_hypothesis(
    model: Model,
    rollouts: Rollouts,
    options: DataOptions,
    *,
    effects: tuple[Effect, ...] = (),
    start: Mapping[str, Tensor] | None = None,
    max_steps: int = 12,
    is_rough: bool = False,
) -> Hypothesis:
    """Cuts a recording into segments and fits a model with effects to them.

    Args:
        model: The original model.
        rollouts: The recording.
        options: How it is cut into segments.
        effects: Effects to add.
        start: Initial guess by site; other parameters begin in the middle of their priors.
        max_steps: Greatest number of steps of the fit.
        is_rough: Whether to take rough steps only.

    Raises:
        DataError: The simulation fails at the initial guess, or the data do not fit the model.
    """
    segments = SegmentModel(with_effects(model, effects), rollouts, options)
    return fit_segment_model(
        segments, effects=effects, start=start, max_steps=max_steps, is_rough=is_rough
    )


def fit_segment_model(
    segments: SegmentModel,
    *,
    effects: tuple[Effect, ...] = (),
    start: Mapping[str, Tensor] | None = None,
    offsets: Tensor | None = None,
    held: Mapping[str, float] | None = None,
    max_steps: int = 12,
    is_rough: bool = False,
) -> Hypothesis:
    """Fits a model along the segments of a recording.

    Args:
        segments: The model, effects included, and the recording.
        effects: Those of its effects that the original model lacks.
        start: Initial guess by site; other parameters begin in the middle of their priors.
        offsets: Initial guess of the offsets of the initial states, ``(S, m)``.
        held: Reference coordinates of sites that are not fitted.
        max_steps: Greatest number of steps of the fit.
        is_rough: Whether to take rough steps only.

    Raises:
        DataError: The simulation fails at the initial guess.
    """
    z = segments.place_of(start or {})
    stays = torch.zeros(z.shape, dtype=torch.bool)
    for site in segments.prior.sites:
        if held and site.name in held:
            z[site.coordinates], stays[site.coordinates] = held[site.name], True

    made: SegmentFit | None = None

    def make() -> dict[str, Tensor]:
        nonlocal made
        made = fit_segments(
            segments, z, offsets=offsets, held=stays, max_steps=max_steps, is_rough=is_rough
        )
        return {"z": made.z, "offsets": made.offsets, "scale": made.scale}

    fit = made_or_read(make, segments, z, offsets, stays, max_steps, is_rough)
    found = Hypothesis(
        segments.model, effects, segments, SegmentFit(fit["z"], fit["offsets"], fit["scale"])
    )
    if made is not None and made.linearisation is not None:
        found.keep_linearisation(made.linearisation)
    if made is not None and made.difference is not None:
        found.keep_difference(made.difference)
    return found
