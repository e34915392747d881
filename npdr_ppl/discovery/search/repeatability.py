"""Whether an effect that was found in a recording is found again in parts of it.

A real cause acts in all parts of a recording with the same strength. A law that compensates for
something else has another strength wherever the motion is different. The parameters are estimated
again in each of two disjoint parts, by one Gauss-Newton step from the fit to the whole recording,
which needs no simulation. Only where these estimates contradict each other, the parts are fitted.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
from scipy import stats
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_segment_model
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.search.settings import REPEATABILITY
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effects import Effect

__all__ = ["HALVES", "PartEstimate", "Repetition", "halves", "repeated_effects", "repetitions"]


HALVES = "the first half", "the second half"
"""Names of the halves of a recording."""


@dataclass(frozen=True)
class PartEstimate:
    """An effect's strengths in one part of a recording.

    Attributes:
        part: Which part, e.g. ``"the first half"``.
        strengths: Mean and standard deviation by short name.
    """

    part: str
    strengths: Mapping[str, tuple[float, float]]

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values; numbers that are not finite become ``None``."""
        values = {
            name: {"mean": _finite(mean), "sd": _finite(sd)}
            for name, (mean, sd) in self.strengths.items()
        }
        return {"part": self.part, "strengths": values}


@dataclass(frozen=True)
class Repetition:
    """Comparison of an effect's strengths in disjoint parts of a recording.

    Attributes:
        estimates: The strengths in the pair of parts that differ most.
        distance: Squared distance between the two estimates, in units of its variance.
        size: Squared size of the effect in the same units.
        is_found_again: Whether the estimates do not contradict each other in any pair of parts.
    """

    estimates: tuple[PartEstimate, ...]
    distance: float
    size: float
    is_found_again: bool

    @property
    def contradiction(self) -> float:
        """The squared distance relative to the squared size."""
        return self.distance / max(self.size, 1e-12)

    def to_list(self) -> list[dict[str, object]]:
        """Returns the estimates as JSON-serialisable values."""
        return [estimate.to_dict() for estimate in self.estimates]


def repetitions(hypothesis: Hypothesis) -> dict[str, Repetition]:
    """Compares each effect of a hypothesis in disjoint parts of the recording.

    An effect is not found again if its estimates in two parts differ by more than chance allows,
    and by more than the effect's size. A part that hardly determines the effect contradicts
    nothing. A contradiction counts only if fits of the parts confirm it: one Gauss-Newton step is
    wrong where the motion is sensitive or sticks, and does not lead to another minimum.

    Args:
        hypothesis: The fitted model; its effects are compared.

    Returns:
        The comparison by the effect's name; empty if the recording has fewer than
        ``REPEATABILITY.fewest_segments`` segments, or simulations fail close to the fit.
    """
    num = len(hypothesis.fit.offsets)
    is_long = num >= REPEATABILITY.fewest_segments
    if not is_long or not hypothesis.effects or not hypothesis.can_be_linearised:
        return {}
    pairs = list(_pairs(hypothesis.segments.inputs.rollout))
    by_part, refitted = _ByPart(hypothesis), _Refitted(hypothesis)
    result = {}
    for effect in hypothesis.effects:
        found = [_compared(by_part, effect, pair, len(pairs)) for pair in pairs]
        doubtful = sorted(
            (k for k, each in enumerate(found) if not each.is_found_again),
            key=lambda k: -found[k].contradiction,
        )
        confirmed = None
        for k in doubtful:
            try:
                found[k] = _compared(refitted, effect, pairs[k], len(pairs))
            except NpdrError:  # a part alone cannot be simulated
                pass
            if not found[k].is_found_again:
                confirmed = found[k]
                break
        result[effect.name] = confirmed or max(found, key=lambda each: each.contradiction)
    return result


def repeated_effects(
    current: Hypothesis, trials: Trials, report: Callable[[str], None] = lambda _: None
) -> Hypothesis:
    """Removes effects that are not found again in parts of the recording, the worst first.

    The last effect stays, so that a verdict can report it.

    Args:
        current: The model with all effects that were found.
        trials: Fits the model.
        report: Called with a sentence about each effect that is removed.
    """
    while len(current.effects) > 1:
        found = repetitions(current)
        refuted = {name: each for name, each in found.items() if not each.is_found_again}
        if not refuted:
            break
        worst = max(
            (effect for effect in current.effects if effect.name in refuted),
            key=lambda effect: refuted[effect.name].contradiction,
        )
        without = trials.without(current, worst)
        if without is None:
            break
        report(f"{worst.name} is not found again in parts of the recording")
        current = without
    return current


def halves(num: int) -> list[tuple[str, Tensor]]:
    """Returns the name and the indices of each half of some segments.

    Args:
        num: Number of segments.
    """
    parts = torch.arange(num).tensor_split(2)
    return list(zip(HALVES, parts, strict=True))


def _pairs(rollout: Tensor) -> Iterator[tuple[tuple[str, Tensor], tuple[str, Tensor]]]:
    """Yields pairs of disjoint parts: both halves, and each of several rollouts with the rest."""
    first, second = halves(len(rollout))
    yield first, second
    index = torch.arange(len(rollout))
    names = rollout.unique().tolist()
    for name in names if len(names) > 2 else ():
        own = rollout == name
        yield (f"rollout {name}", index[own]), ("the other rollouts", index[~own])


class _ByPart:
    """Estimates of a hypothesis's parameters in parts of the recording."""

    def __init__(self, hypothesis: Hypothesis) -> None:
        projection = Projection(hypothesis)
        self._share = hypothesis.share
        self._z = hypothesis.fit.z.double()
        self._information = projection.parameter_information_by_segment
        self._scores = projection.parameter_scores
        self._prior = hypothesis.segments.prior
        sites = [site.name for site in self._prior.sites]
        self._values = {
            name: value.detach().double()[0].flatten()
            for name, value in self._prior.to_parameters(self._z[None]).items()
        }
        slopes = torch.autograd.functional.jacobian(self._flat, self._z)
        sizes = [self._values[name].numel() for name in sites]
        self._slopes = dict(zip(sites, slopes.split(sizes), strict=True))

    def _flat(self, z: Tensor) -> Tensor:
        """Returns all parameters one after another."""
        values = self._prior.to_parameters(z[None])
        return torch.cat([values[site.name].double().flatten() for site in self._prior.sites])

    def estimate(self, sites: list[str], index: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and covariance of some parameters, given some of the segments.

        Args:
            sites: The parameters' sites.
            index: The segments.
        """
        part = len(index) / len(self._information)
        eye = torch.eye(len(self._z), dtype=torch.float64)
        information = self._share * self._information[index].sum(0) + eye
        # The prior's pull is the same in all parts and does not count.
        whole = self._share * self._scores.sum(0)
        scores = self._share * self._scores[index].sum(0) - part * whole
        step, covariance = torch.linalg.solve(information, scores), torch.linalg.inv(information)
        slopes = torch.cat([self._slopes[site] for site in sites])
        values = torch.cat([self._values[site] for site in sites])
        return values + slopes @ step, slopes @ covariance @ slopes.mT


class _Refitted:
    """The same from fits of the parts.

    Args:
        hypothesis: The hypothesis, from which the fits begin.
    """

    def __init__(self, hypothesis: Hypothesis) -> None:
        self._whole = hypothesis
        self._parts: dict[tuple[int, ...], _ByPart] = {}

    def estimate(self, sites: list[str], index: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and covariance of some parameters in a part; see :class:`_ByPart`.

        Raises:
            NpdrError: The part cannot be simulated.
        """
        whole, key = self._whole, tuple(index.tolist())
        if key not in self._parts:
            part = fit_segment_model(
                whole.segments.along(index),
                effects=whole.effects,
                start=whole.parameters,
                offsets=whole.fit.offsets[index],
            )
            self._parts[key] = _ByPart(part)
        return self._parts[key].estimate(sites, torch.arange(len(index)))


def _compared(
    by_part: _ByPart | _Refitted,
    effect: Effect,
    pair: tuple[tuple[str, Tensor], tuple[str, Tensor]],
    num_pairs: int,
) -> Repetition:
    """Compares an effect's strengths in two parts."""
    sites = [f"{effect.name}.{p.name}" for p in effect.strengths]
    # An infinite nominal value, as that of a limit, is no distance; the value itself is the size.
    nominal = torch.tensor(
        [p.nominal if math.isfinite(p.nominal) else 0.0 for p in effect.strengths],
        dtype=torch.float64,
    )
    (first, one), (second, other) = (by_part.estimate(sites, index) for _, index in pair)
    metric = torch.linalg.pinv(one + other, hermitian=True)
    difference, mean = first - second, 0.5 * (first + second) - nominal
    distance, size = float(difference @ metric @ difference), float(mean @ metric @ mean)
    limit = stats.chi2.isf(REPEATABILITY.false_alarm_rate / num_pairs, len(sites))
    estimates = tuple(
        PartEstimate(
            part,
            {
                p.name: (float(value), math.sqrt(max(0.0, float(variance))))
                for p, value, variance in zip(
                    effect.strengths, found, covariance.diagonal(), strict=True
                )
            },
        )
        for (part, _), found, covariance in zip(pair, (first, second), (one, other), strict=True)
    )
    is_found_again = not (distance > limit and distance > size)
    return Repetition(estimates, distance, size, is_found_again)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
