"""Effects that may be added to a hypothesis, in all their shapes, and what each would change."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial

import torch

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.equivalents import irreducible
from npdr_ppl.discovery.screening.force_shapes import force_shape
from npdr_ppl.discovery.screening.generic_laws import strongest_frequency, strongest_ripple
from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.rounded_commands import strongest_rounding
from npdr_ppl.discovery.screening.sensitivities import Variant, sensitivities
from npdr_ppl.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.reference import quantile
from npdr_ppl.models.effects import candidate_effects

__all__ = ["candidates_at", "variants_of"]

LEAST_SPEED = 0.03
"""Smallest speed for which priors are widened, as a share of the rated speed. The joints of
the seven-joint arm of ``benchmarks/servo_arms.py`` reach 7 % or more of theirs (seed 1040)."""

PARTS_PER_PROCESS = 4
"""Parts of the candidates per process, which it computes one after another. The changes of a part
are in memory together."""


def candidates_at(hypothesis: Hypothesis, options: DiscoveryOptions) -> tuple[Effect, ...]:
    """Returns the effects that may be added to a hypothesis."""
    if options.effects is not None:
        candidates = tuple(e for e in options.effects if e.name not in hypothesis.names)
    else:
        every = candidate_effects(hypothesis.simulator)
        candidates = irreducible((e for e in every if not e.only_if_asked), hypothesis.names)
    simulator, time_step = hypothesis.simulator, hypothesis.segments.inputs.time_step
    speeds, result = _recorded_speeds(hypothesis), []
    for effect in candidates:
        if not effect.is_noise:
            port = simulator.port(effect.port)
            may_be_negative = not effect.given_priors and simulator.corrected_number(effect)
            effect = effect.at_rate(port, time_step)
            effect = effect.at_speed(port, speeds.get(effect.port, port.rated_speed))
            result.append(effect.of_either_sign(port) if may_be_negative else effect)
    return tuple(result)


def _recorded_speeds(hypothesis: Hypothesis) -> dict[str, float]:
    """Returns the greatest speed at a segment's start at ports whose rated speed is a guess.

    It is at least ``LEAST_SPEED`` of the rated one: the rates of a joint that only trembles are
    noise.
    """
    segments = hypothesis.segments
    if segments.recorded_rates is None:
        return {}
    inputs = replace(segments.inputs, initial_rates=segments.recorded_rates)
    result = {}
    for port, speeds in hypothesis.simulator.speeds_at_starts(inputs).items():
        least = LEAST_SPEED * hypothesis.simulator.port(port).rated_speed
        result[port] = max(least, float(speeds.nan_to_num(0.0).abs().max()))
    return result


def variants_of(
    candidates: tuple[Effect, ...],
    projection: Projection,
    found: Responses,
    *,
    number: int | None = None,
) -> Iterator[Variant]:
    """Yields the candidates in all shapes and sizes, waves also at the strongest frequency.

    Ripples have the strongest number per turn, roundings also the strongest step, and springs and
    winds also the shape that explains most.

    Args:
        candidates: The effects.
        projection: The fitted hypothesis that they would be added to.
        found: The responses to pulses of force at the joints.
        number: Number of parallel processes; by default that of the enclosing ``workers`` block.
    """
    hypothesis = projection.hypothesis
    hints = {
        effect.name: {effect.wave: strongest_frequency(projection, found, effect.port)}
        for effect in candidates
        if effect.wave and effect.port in found.by_port
    }
    for effect in candidates:
        port = hypothesis.simulator.port(effect.port)
        if effect.rounds and port.joint in found.by_port:
            largest = float(quantile(effect.priors(port)[effect.rounds], torch.tensor(0.999)))
            step = strongest_rounding(projection, found, port.name, port.joint, largest)
            if step is not None:
                hints[effect.name] = {effect.rounds: step}
        elif effect.name not in hints and (shape := force_shape(projection, found, effect)):
            hints[effect.name] = shape
    candidates, numbered = _with_ripples(candidates, projection, found)
    for variant in _in_all_shapes(projection, candidates, hints, number):
        yield replace(variant, is_hinted=True) if variant.effect.name in numbered else variant


def _with_ripples(
    candidates: tuple[Effect, ...], projection: Projection, found: Responses
) -> tuple[tuple[Effect, ...], set[str]]:
    """Returns candidates with the strongest ripples, and the names of those that have some."""
    result, numbered = [], set()
    for effect in candidates:
        port = projection.hypothesis.simulator.port(effect.port)
        if effect.has_ripples and port.coordinate == "rad" and effect.port in found.by_port:
            strongest = strongest_ripple(projection, found, effect.port)
            if strongest is not None:
                effect = effect.with_ripples(strongest)
                numbered.add(effect.name)
        result.append(effect)
    return tuple(result), numbered


def _in_all_shapes(
    projection: Projection,
    candidates: tuple[Effect, ...],
    hints: Mapping[str, Mapping[str, float]],
    number: int | None,
) -> Iterator[Variant]:
    """Yields the candidates in all shapes and sizes, from several processes if there are any."""
    hypothesis = projection.hypothesis
    number = number or num_processes(hypothesis.simulator)
    if number == 1:
        yield from sensitivities(hypothesis, candidates, hints, projection)
        return
    # Every part holds effects of every kind.
    num_parts = min(len(candidates), PARTS_PER_PROCESS * number)
    parts = [candidates[k::num_parts] for k in range(num_parts)]
    bare = replace(hypothesis)  # without cached results, which need not be sent
    # The derivatives are large, so they are sent only with resonances, which need them.
    items = [(part, projection if any(e.is_resonant for e in part) else None) for part in parts]
    for found in side_by_side(partial(_listed, bare, hints), items, number):
        yield from found


def _listed(
    hypothesis: Hypothesis,
    hints: Mapping[str, Mapping[str, float]],
    item: tuple[tuple[Effect, ...], Projection | None],
) -> list[Variant]:
    effects, projection = item
    return list(sensitivities(hypothesis, effects, hints, projection))
