"""The alarm: whether anything is missing, whatever it may be."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from npdr_ppl.language.channels import Channel
from npdr_ppl.workflows.discovery.chance import LargestStatistic
from npdr_ppl.workflows.discovery.generic_laws import (
    GenericLaw,
    generic_laws,
    reading_laws,
    ringing_laws,
    ripple_laws,
    wave_laws,
)
from npdr_ppl.workflows.discovery.latent_force import Responses
from npdr_ppl.workflows.discovery.moments import forces_at_moments
from npdr_ppl.workflows.discovery.options import DiscoveryOptions
from npdr_ppl.workflows.discovery.projection import Projection
from npdr_ppl.workflows.discovery.screening import Screened
from npdr_ppl.workflows.discovery.sensitivities import Variant

__all__ = ["Alarm", "gains_of", "sound_alarm"]

CATALOGUE_SHARE, LAW_SHARE, RINGING_SHARE, MOMENT_SHARE = 0.6, 0.2, 0.1, 0.1
"""Shares of the false alarms that the catalogue's candidates, generic laws, what rings and forces
at some moments may raise."""


@dataclass(frozen=True)
class Alarm:
    """Whether a fitted model and the recording disagree.

    Attributes:
        p_value: Probability of as large a disagreement by chance, all searching counted.
        fired: Whether it is below the rate of false alarms that was asked for.
        loudest: What disagrees most: an effect's name, or that of a law outside the catalogue.
        gain: Greatest reduction of the misfit by one candidate or law.
        p_values: The same probability for each candidate and law, by name.
    """

    p_value: float
    fired: bool
    loudest: str
    gain: float
    p_values: dict[str, float]


def sound_alarm(
    projection: Projection,
    variants: Sequence[Variant],
    ranking: Sequence[Screened],
    found: Responses,
    sensors: Sequence[Channel],
    options: DiscoveryOptions,
    num_looks: int = 0,
) -> Alarm:
    """Tests a fitted hypothesis against every candidate and every generic law at once.

    Every shape and size of a candidate that was tried counts, and every frequency of a wave.

    Args:
        projection: The fitted hypothesis.
        variants: All candidates in all their shapes and sizes.
        ranking: The candidates that explain anything.
        found: The responses to pulses of force.
        sensors: The simulator's sensors.
        options: The rate of false alarms and the seed.
        num_looks: How often the recording was looked at before.
    """
    chance = LargestStatistic(projection, seed=options.seed)
    generic = generic_laws(found, sensors) + reading_laws(projection)
    gained = gains_of(projection, generic)
    laws = [law for law, _ in gained]
    ringing = ringing_laws(projection)
    waves = wave_laws(found)
    listed = [wave for port in waves.values() for wave in port] + ripple_laws(found, sensors)
    # Each kind is a search of its own: a hundred laws that no one believes in must not make the
    # catalogue's harder to hear.
    values: dict[str, float] = {}
    for variant, p in zip(variants, chance.p_values([v.change for v in variants]), strict=True):
        name = variant.effect.name
        values[name] = min(values.get(name, 1.0), p / CATALOGUE_SHARE)
    for kind, share in (((*laws, *listed), LAW_SHARE), (ringing, RINGING_SHARE)):
        for law, p in zip(kind, chance.p_values([law.change for law in kind]), strict=True):
            values[law.name] = min(1.0, p / share)
    for effect in {v.effect.name: v.effect for v in variants if v.effect.wave}.values():
        own = [values[wave.name] for wave in waves.get(effect.port, [])]
        values[effect.name] = min([values[effect.name], *own])
    moments = forces_at_moments(projection, found)
    for moment in moments:
        values[moment.name] = min(1.0, len(moments) * moment.p_value / MOMENT_SHARE)
    gains = {candidate.name: candidate.gain for candidate in ranking}
    gains |= {law.name: gain for law, gain in (*gained, *gains_of(projection, ringing))}
    # Segments stand out by chance, and what they stand out by is no gain before it is heard.
    heard = [moment for moment in moments if values[moment.name] <= options.false_alarm_rate]
    gains |= {moment.name: moment.gain for moment in heard}
    if not values:
        return Alarm(1.0, False, "", 0.0, {})
    p_value = min(values.values())
    loudest = [name for name, p in values.items() if p == p_value]
    return Alarm(
        p_value,
        # Every effect that was added is one more look.
        p_value <= options.false_alarm_rate / (1 + num_looks),
        max(loudest, key=lambda name: gains.get(name, 0.0)),
        max(gains.values(), default=0.0),
        values,
    )


def gains_of(projection: Projection, laws: list[GenericLaw]) -> list[tuple[GenericLaw, float]]:
    """Returns the laws that refitted parameters do not explain, and what each would gain.

    Args:
        projection: The fitted hypothesis.
        laws: The laws.
    """
    if not laws:
        return []
    scores = projection.scores(torch.cat([law.change for law in laws], dim=-1))
    result, last = [], 0
    for law in laws:
        first, last = last, last + law.change.shape[-1]
        own = slice(first, last)
        # What is absorbed up to rounding errors leaves nothing to judge.
        if float(scores.absorbed[own].min()) < 1.0 - 1e-6:
            result.append((law, scores.gain(own)))
    return result
