"""The alarm: tests whether any effect is missing, in the catalogue or not."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

from torch import Tensor

from npdr_ppl.discovery.screening.generic_laws import (
    GenericLaw,
    generic_laws,
    reading_laws,
    ringing_laws,
    ripple_laws,
    wave_laws,
)
from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.moments import forces_at_moments
from npdr_ppl.discovery.screening.permutation_tests import LargestStatistic
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.pulse_changes import ForceChange, PulseChanges
from npdr_ppl.discovery.screening.screening import Screened, Screening
from npdr_ppl.discovery.screening.sensitivities import Variant
from npdr_ppl.discovery.screening.settings import ALARM
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.effects import Effect

__all__ = ["Alarm", "sound_alarm"]


@dataclass(frozen=True)
class Alarm:
    """Whether a fitted model and the recording disagree.

    Attributes:
        p_value: Probability of a disagreement this large by chance, corrected for the search.
        strongest: Name of the effect, or of the law outside the catalogue, with the least p-value.
        gain: Greatest reduction of the misfit by one candidate or law.
        p_values: P-value of each candidate and law, by name.
        limit: The p-value up to which it fires: the requested false-alarm rate.
    """

    p_value: float
    strongest: str
    gain: float
    p_values: dict[str, float]
    limit: float

    @property
    def fired(self) -> bool:
        """Whether the p-value is low enough."""
        return self.p_value <= self.limit


def sound_alarm(
    projection: Projection,
    variants: Iterable[Variant],
    found: Responses,
    sensors: Sequence[Channel],
    *,
    false_alarm_rate: float,
    seed: int,
) -> tuple[Alarm, list[Screened]]:
    """Tests a fitted hypothesis against every candidate and every generic law at once.

    The test is corrected for every tried shape and size of a candidate, and every frequency of a
    wave. Candidates and laws are processed one after another, so that their changes need not fit
    into memory together.

    Args:
        projection: The fitted hypothesis.
        variants: All candidates, in all shapes and sizes.
        found: The responses to pulses of force.
        sensors: The simulator's sensors.
        false_alarm_rate: Probability that an alarm fires although nothing is missing.
        seed: Seed of the simulated noise.

    Returns:
        The alarm, and the candidates that explain a part of the misfit, the best first.
    """
    chance = LargestStatistic(projection, seed=seed)
    ports = {name: PulseChanges(projection, change) for name, change in found.by_port.items()}
    generic = generic_laws(found, ports, sensors) + reading_laws(projection)
    simulator = projection.hypothesis.simulator
    # A body that floats has nothing that repeats with its position.
    bearings = {name: p for name, p in ports.items() if not simulator.port(name).is_floating}
    listed = wave_laws(found, ports) + ripple_laws(found, bearings, sensors)
    # Each kind is tested separately, so that many implausible laws do not hide an effect of the
    # catalogue.
    values: dict[str, float] = {}
    screening = Screening(projection)
    effects: list[Effect] = []
    changes = _screened(variants, screening, effects)
    for p, effect in zip(chance.p_values(changes), effects, strict=True):
        values[effect.name] = min(values.get(effect.name, 1.0), p / ALARM.catalogue_share)
    ranking = screening.ranking()
    gains = {candidate.name: candidate.gain for candidate in ranking}
    names: list[str] = []
    changes = _unexplained(generic, projection, gains, names)
    p_values = chance.p_values(chain(changes, (law.change for law in listed)))
    for p, name in zip(p_values, (*names, *(law.name for law in listed)), strict=True):
        values[name] = min(1.0, p / ALARM.law_share)
    names = []
    changes = _unexplained(ringing_laws(projection), projection, gains, names)
    for p, name in zip(chance.p_values(changes), names, strict=True):
        values[name] = min(1.0, p / ALARM.ringing_share)
    by_kind: dict[tuple[str, str], float] = {}
    for law in listed:
        key = law.kind, law.port
        by_kind[key] = min(values[law.name], by_kind.get(key, 1.0))
    for effect in (candidate.variant.effect for candidate in ranking):
        kind = "wave" if effect.wave else "ripple" if effect.has_ripples else ""
        if kind and (kind, effect.port) in by_kind:
            own = values.get(effect.name, 1.0)
            values[effect.name] = min(own, by_kind[kind, effect.port])
    moments = forces_at_moments(projection, found)
    for moment in moments:
        values[moment.name] = min(1.0, len(moments) * moment.p_value / ALARM.moment_share)
    # Some segments stand out by chance: their gain is used only where that is unlikely.
    unlikely = [moment for moment in moments if values[moment.name] <= false_alarm_rate]
    gains |= {moment.name: moment.gain for moment in unlikely}
    if not values:
        return Alarm(1.0, "", 0.0, {}, false_alarm_rate), ranking
    p_value = min(values.values())
    strongest = [name for name, p in values.items() if p == p_value]
    alarm = Alarm(
        p_value,
        min(strongest, key=lambda name: (-gains.get(name, 0.0), name)),
        max(gains.values(), default=0.0),
        values,
        false_alarm_rate,
    )
    return alarm, ranking


def _screened(
    variants: Iterable[Variant], screening: Screening, effects: list[Effect]
) -> Iterator[Tensor]:
    """Screens candidates and yields their changes; appends their effects to ``effects``.

    Shapes that were found on the recording itself are only screened: on permuted residuals, the
    search would have found others.
    """
    for variant in variants:
        screening.add(variant)
        if not variant.is_hinted:
            effects.append(variant.effect)
            yield variant.change


def _unexplained(
    laws: Iterable[GenericLaw], projection: Projection, gains: dict[str, float], names: list[str]
) -> Iterator[Tensor | ForceChange]:
    """Yields the changes of laws that refitted parameters cannot imitate; adds gains and names."""
    for law in laws:
        change = law.change
        if isinstance(change, ForceChange):
            scores = change.pulses.scores(change.values)
        else:
            scores = projection.scores(change)
        # A change that is absorbed up to rounding errors cannot be tested.
        if float(scores.absorbed.min()) < 1.0 - 1e-6:
            gains[law.name] = scores.gain(slice(None))
            names.append(law.name)
            yield change
