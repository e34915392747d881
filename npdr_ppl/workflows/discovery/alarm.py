"""The alarm: whether anything is missing, whatever it may be."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from npdr_ppl.workflows.discovery.chance import LargestStatistic
from npdr_ppl.workflows.discovery.latent_force import GenericLaw
from npdr_ppl.workflows.discovery.options import DiscoveryOptions
from npdr_ppl.workflows.discovery.projection import Projection
from npdr_ppl.workflows.discovery.screening import Screened

__all__ = ["Alarm", "sound_alarm"]


CATALOGUE_SHARE = 0.75
"""Share of the false alarms that the catalogue's candidates may raise; the rest is for generic
laws."""


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
    ranking: Sequence[Screened],
    laws: Sequence[GenericLaw],
    options: DiscoveryOptions,
) -> Alarm:
    """Tests a fitted hypothesis against every candidate and every generic law at once.

    Args:
        projection: The fitted hypothesis.
        ranking: The candidates.
        laws: The generic laws.
        options: The rate of false alarms and the seed.
    """
    groups, names, gains = [], [], []
    for candidate in ranking:
        groups.append(candidate.variant.change)
        names.append(candidate.name)
        gains.append(candidate.gain)
    if laws:
        scores = projection.scores(torch.cat([law.change for law in laws], dim=-1))
        information = scores.information.diagonal()
        # What the refitted parameters explain leaves nothing but rounding errors.
        known = scores.absorbed < 1.0 - 1e-6
        for k in torch.nonzero(known)[:, 0].tolist():
            groups.append(laws[k].change)
            names.append(laws[k].name)
            gains.append(float(scores.score[k] ** 2 / information[k]))
    if not groups:
        return Alarm(1.0, False, "", 0.0, {})
    chance = LargestStatistic(projection, seed=options.seed)
    # Each kind is a search of its own: a hundred laws that no one believes in must not make the
    # catalogue's harder to hear.
    num = len(ranking)
    values = [
        *(min(1.0, p / CATALOGUE_SHARE) for p in chance.p_values(groups[:num])),
        *(min(1.0, p / (1.0 - CATALOGUE_SHARE)) for p in chance.p_values(groups[num:])),
    ]
    p_value = min(values)
    loudest = max((k for k in range(len(names)) if values[k] == p_value), key=lambda k: gains[k])
    return Alarm(
        p_value,
        p_value <= options.false_alarm_rate,
        names[loudest],
        max(gains),
        dict(zip(names, values, strict=True)),
    )
