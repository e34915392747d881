"""Whether parts of a recording alone show the effects that a search of all of it found.

:mod:`~npdr_ppl.discovery.search.repeatability` compares an effect's strengths in two parts. This
asks whether a part shows the effect at all, and whether another law explains the part better.

The search has fitted the model with the effect, without it, and with alternatives in its place.
Let J be the derivatives by the parameters and C the covariance of the residuals r, as in
:mod:`~npdr_ppl.discovery.screening.projection`. Information and scores are sums over segments, so
the closest fit z + δ to a part P follows, to first order, without another search:

    δ = (ρ Σ_P Jᵀ C⁻¹ J + 1)⁻¹ (ρ Σ_P Jᵀ C⁻¹ r − z)

with the share ρ of independent measurements. Each model is simulated once at its z + δ, and the
models' evidence is compared along the part. One step can be wrong where the motion is sensitive or
sticks: it then gains less than the ½ δᵀ (ρ Σ_P Jᵀ C⁻¹ r − z) that it should. If the result could
be another one with what the other models' steps failed to gain, fits of the part decide; also if
the result is not certain, and before every "not found".

A part in which the robot hardly moves may be too weak to show an effect: a spring that hardens
needs large angles. It contradicts the effect if another law explains it clearly better, or if
the effect gains less log density in the whole recording than in the rest alone, by more than
−ln α with α = ``EVIDENCE.least_probability``. With the true law, the Bayes factor of a part, given
the rest, is below α with a probability of at most α, however much or little the part can show.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.search.alternatives import Added, probabilities
from npdr_ppl.discovery.search.evidence import weigh
from npdr_ppl.discovery.search.parsimony import overlap
from npdr_ppl.discovery.search.repeatability import HALVES, halves
from npdr_ppl.discovery.search.rounds import Search
from npdr_ppl.discovery.search.settings import EVIDENCE, REPEATABILITY, TRIALS
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.progress import Step

__all__ = ["PartResult", "doubt_of", "found_in_parts"]


@dataclass(frozen=True)
class PartResult:
    """Whether a part of a recording shows an effect.

    Attributes:
        part: Which part, e.g. ``"the first half"``.
        is_found: Whether the part's evidence favours the model with the effect, or with another
            form of the same law, and no other law explains the part clearly better.
        probability: Probability of the effect against the model without it, in this part.
        instead: Name of a law that explains the part clearly better; empty if there is none.
        contradicts: Whether another law explains the part clearly better, or the part, together
            with the rest of the recording, lowers the evidence for the effect. A part that neither
            shows nor contradicts an effect is too weak to show it.
    """

    part: str
    is_found: bool
    probability: float
    instead: str = ""
    contradicts: bool = False

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values."""
        return asdict(self)


def found_in_parts(
    search: Search,
    report: Callable[[str], None] = lambda _: None,
    progress: Step = lambda fraction, status: None,
) -> dict[str, list[PartResult]]:
    """Returns which parts of the recording show each effect, by the effect's name.

    Parts are both halves and, with three rollouts or more, the recording without each of them.

    Args:
        search: The search of the whole recording.
        report: Called with a sentence about each effect that a part does not show.
        progress: Called with the fraction of the effects that is compared.

    Returns:
        The results; empty if the recording has fewer than ``REPEATABILITY.fewest_segments``
        segments. A part is left out if the model cannot be simulated along it.
    """
    if len(search.final.fit.offsets) < REPEATABILITY.fewest_segments:
        return {}
    num, result = len(search.added), dict[str, list[PartResult]]()
    for number, added in enumerate(search.added):
        progress(number / num, f"{number} of {num} effects sought in parts of the recording")
        compared = _Compared(search, added)
        name = added.effect.name
        result[name] = []
        for part, index in _parts(search.final):
            found = compared.along(part, index)
            if found is not None:
                result[name].append(found)
                if not found.is_found:
                    because = f": {found.instead} explains it better" if found.instead else ""
                    does = "contradicts" if found.contradicts else "is too weak to show"
                    report(f"{part} {does} {name}{because}")
    progress(1.0, f"{num} of {num} effects sought in parts of the recording")
    return result


def doubt_of(found_in: Sequence[PartResult]) -> str:
    """Returns why an effect is not found again, to follow its name in a sentence.

    It is found again if no part contradicts it and at least one half alone shows it.

    Args:
        found_in: The effect's results; none if it was not sought in parts.

    Returns:
        An empty string if there is no doubt.
    """
    for each in found_in:
        if each.contradicts:
            where = f"{each.part} of the recording" if each.part in HALVES else each.part
            better = f", which {each.instead} explains better" if each.instead else ""
            return f"is contradicted by {where}{better}"
    sought = [each for each in found_in if each.part in HALVES] or list(found_in)
    if sought and not any(each.is_found for each in sought):
        return "was not found in " + " or ".join(each.part for each in sought) + " alone"
    return ""


def _parts(hypothesis: Hypothesis) -> Iterator[tuple[str, Tensor]]:
    """Yields the parts' names and segments: both halves, and the rest without each rollout."""
    rollout = hypothesis.segments.inputs.rollout
    yield from halves(len(rollout))
    names = rollout.unique().tolist()
    for name in names if len(names) > 2 else ():
        yield f"the recording without rollout {name}", (rollout != name).nonzero()[:, 0]


class _Compared:
    """An effect's model and its alternatives, compared along parts of the recording.

    Args:
        search: The search of the whole recording.
        added: The effect.
    """

    def __init__(self, search: Search, added: Added) -> None:
        self._effect, self._is_approximate = added.effect, search.is_approximate
        trials = {name: h for (place, name), h in search.trials.items() if place == added.place}
        self._without = trials.pop("", None)
        self._trials = trials
        self._fitting = added.fitting
        self._steps: dict[str, _Step | None] = {}

    def along(self, part: str, index: Tensor) -> PartResult | None:
        """Returns whether a part shows the effect, ``None`` if it cannot be simulated.

        Args:
            part: Name of the part.
            index: Its segments.
        """
        if self._without is None:
            return PartResult(part, True, 1.0)
        own = self._effect.name
        steps = self._closest(index)
        models = {name: model for name, (model, _) in steps.items()}
        if own not in models or "" not in models:
            return None
        missed = {name: gain for name, (_, gain) in steps.items() if name != own}
        least = self._judged(part, models, missed)
        if least.is_found and least.probability >= REPEATABILITY.certain_probability:
            return self._judged(part, models)
        asked = (own, "", least.instead) if least.instead else (own, "")
        result = self._judged(part, {name: _refitted(models[name]) for name in asked})
        if result.is_found or result.instead:
            return result
        return replace(result, contradicts=self._is_less_likely_with(index))

    def _is_less_likely_with(self, index: Tensor) -> bool:
        """Returns whether the effect gains clearly less in the whole recording than in the rest.

        Each gain is that in log density at the closest fit. A part that does not show the effect
        changes the gain little.

        Args:
            index: The part's segments.
        """
        assert self._without is not None
        own, rest = self._trials[self._effect.name], _others(index, self._without)
        whole = _loss(self._without, own) - _loss(own, own)
        losses = []
        for model in (self._without, own):
            here = model.along(rest)
            here.keep_difference(model.difference[rest])
            found = Trials(here.segments).refitted_along(here.segments, here, here.effects)
            if found is None:
                return False
            # Each fit has a scale of its own, so that it need not be the best one at this scale.
            losses.append(min(_loss(here, own), _loss(found, own)))
        return whole - (losses[0] - losses[1]) < math.log(EVIDENCE.least_probability)

    def _closest(self, index: Tensor) -> dict[str, tuple[Hypothesis, float]]:
        """Returns the models with the least loss along a part, see :meth:`_Step.along`."""
        assert self._without is not None
        every = {"": self._without} | self._trials
        scale = self._trials[self._effect.name].fit.scale
        losses = {name: float(h.losses(scale)[index].sum()) for name, h in every.items()}
        others = sorted(set(self._trials) - {self._effect.name}, key=lambda name: losses[name])
        chosen = [self._effect.name, "", *others[: TRIALS.most_converged]]
        for name in chosen:
            if name not in self._steps:
                self._steps[name] = _Step(every[name]) if every[name].can_be_linearised else None
        return {
            name: step.along(index) for name in chosen if (step := self._steps[name]) is not None
        }

    def _judged(
        self,
        part: str,
        models: Mapping[str, Hypothesis],
        granted: Mapping[str, float] | None = None,
    ) -> PartResult:
        """Returns what models that are fitted to a part say.

        Args:
            part: Name of the part.
            models: The models by the law's name, ``""`` for the one without the effect.
            granted: Log density that is added to that of models, by name.
        """
        own, granted = self._effect.name, granted or {}
        without = models[""]
        laws = {name: h for name, h in models.items() if name}
        against_none = weigh([without, models[own]], [granted.get("", 0.0), 0.0])[1]
        weights = probabilities(laws, without, self._is_approximate, granted)
        likeliest = max(weights, key=lambda name: weights[name])
        is_likely = weights[own] >= EVIDENCE.least_probability or self._is_same(likeliest, models)
        is_found = against_none >= REPEATABILITY.least_probability and is_likely
        instead = "" if is_likely else likeliest
        return PartResult(part, is_found, against_none, instead, contradicts=bool(instead))

    def _is_same(self, name: str, models: Mapping[str, Hypothesis]) -> bool:
        """Returns whether a law is another form of the effect."""
        if name in self._fitting:
            return True
        law = next(effect for effect in models[name].effects if effect.name == name)
        return overlap(law, self._effect)


def _others(index: Tensor, hypothesis: Hypothesis) -> Tensor:
    """Returns the indices of all other segments of a hypothesis."""
    is_other = torch.ones(hypothesis.segments.inputs.num_segments, dtype=torch.bool)
    is_other[index] = False
    return is_other.nonzero()[:, 0]


def _loss(model: Hypothesis, reference: Hypothesis) -> float:
    """Returns minus the log density of a fit, the prior included.

    Args:
        model: The fitted model.
        reference: The model whose residuals give the scale and the share.
    """
    misfit = reference.share * float(model.losses(reference.fit.scale).sum())
    return misfit + 0.5 * float(model.fit.z.square().sum())


def _refitted(part: Hypothesis) -> Hypothesis:
    """Returns a model fitted along its part; the given one if the fit fails."""
    segments = part.segments
    return Trials(segments).refitted_along(segments, part, part.effects) or part


class _Step:
    """One Gauss-Newton step from a fit to the whole recording to a fit to a part.

    Args:
        hypothesis: The fit to the whole recording.
    """

    def __init__(self, hypothesis: Hypothesis) -> None:
        self._whole, self._projection = hypothesis, Projection(hypothesis)
        self._information = self._projection.parameter_information_by_segment

    def along(self, index: Tensor) -> tuple[Hypothesis, float]:
        """Returns the model along a part, at the better end of the step.

        Args:
            index: The part's segments.

        Returns:
            The model, and by how much less its log density has grown than the step should gain.
        """
        whole, share = self._whole, self._whole.share
        z = whole.fit.z.double()
        eye = torch.eye(len(z), dtype=torch.float64)
        score = share * self._projection.parameter_scores[index].sum(0) - z
        step = torch.linalg.solve(share * self._information[index].sum(0) + eye, score)
        here = whole.along(index)
        here.keep_difference(whole.difference[index])
        offsets = self._projection.offsets_after(step)[index]
        there = replace(here, fit=replace(here.fit, z=z + step, offsets=offsets))
        losses = self._loss(here), self._loss(there)
        gain = max(0.0, losses[0] - losses[1])
        return there if gain > 0.0 else here, max(0.0, 0.5 * float(step @ score) - gain)

    def _loss(self, part: Hypothesis) -> float:
        """Returns minus the log density along a part, the prior included."""
        loss = self._whole.share * float(part.losses(part.fit.scale).sum())
        loss += 0.5 * float(part.fit.z.square().sum())
        return loss if math.isfinite(loss) else math.inf
