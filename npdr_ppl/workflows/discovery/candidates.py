"""The candidates at a hypothesis: which effects may be added, and what each would change."""

from functools import partial

from npdr_ppl.language.effects import Effect
from npdr_ppl.models.effects import candidate_effects
from npdr_ppl.workflows.discovery.equivalents import irreducible
from npdr_ppl.workflows.discovery.generic_laws import strongest_frequency
from npdr_ppl.workflows.discovery.hypothesis import Hypothesis
from npdr_ppl.workflows.discovery.latent_force import Responses
from npdr_ppl.workflows.discovery.options import DiscoveryOptions
from npdr_ppl.workflows.discovery.projection import Projection
from npdr_ppl.workflows.discovery.sensitivities import Variant, sensitivities
from npdr_ppl.workflows.discovery.side_by_side import num_processes, side_by_side

__all__ = ["candidates_at", "variants_of"]


def candidates_at(hypothesis: Hypothesis, options: DiscoveryOptions) -> tuple[Effect, ...]:
    """Returns the effects that may be added to a hypothesis."""
    if options.effects is not None:
        candidates = tuple(e for e in options.effects if e.name not in hypothesis.names)
    else:
        candidates = irreducible(candidate_effects(hypothesis.simulator), hypothesis.names)
    simulator, time_step = hypothesis.simulator, hypothesis.segments.inputs.time_step
    return tuple(
        effect.at_rate(simulator.port(effect.port), time_step)
        for effect in candidates
        if not effect.is_noise
    )


def variants_of(
    candidates: tuple[Effect, ...], projection: Projection, found: Responses
) -> list[Variant]:
    """Returns the candidates in all their shapes and sizes, waves at the strongest frequency too.

    Args:
        candidates: The effects.
        projection: The fitted hypothesis that they would be added to.
        found: What pulses of force at the joints would change there.
    """
    hypothesis = projection.hypothesis
    hints = {
        effect.name: {effect.wave: strongest_frequency(projection, found, effect.port)}
        for effect in candidates
        if effect.wave and effect.port in found.by_port
    }
    # Dealt out in turn, so that each process gets effects of every kind.
    number = num_processes(hypothesis.simulator)
    parts = [candidates[k::number] for k in range(number)]
    function = partial(sensitivities, hypothesis, hints=hints)
    variants: list[Variant] = []
    for part in side_by_side(function, parts, number):
        variants += part
    order = {effect.name: place for place, effect in enumerate(candidates)}
    return sorted(variants, key=lambda variant: order[variant.effect.name])
