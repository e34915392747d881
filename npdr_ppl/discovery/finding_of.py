"""What a discovery says about the effects that its search added."""

from collections.abc import Mapping, Sequence

from npdr_ppl.discovery.finding import Finding
from npdr_ppl.discovery.proof.parameter_intervals import Estimate
from npdr_ppl.discovery.screening.equivalents import equivalents
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.discovery.search.parts import PartResult
from npdr_ppl.discovery.search.repeatability import Repetition, repetitions
from npdr_ppl.discovery.search.rounds import Search
from npdr_ppl.discovery.search.settings import EVIDENCE
from npdr_ppl.discovery.settings import VERDICT
from npdr_ppl.language.handlers import num_finer_steps

__all__ = ["finding_of", "findings_of"]


def findings_of(
    search: Search,
    every: dict[str, Estimate],
    at_edge: Sequence[tuple[str, ...]],
    found_in: Mapping[str, Sequence[PartResult]],
) -> list[Finding]:
    """Returns what a discovery says about all effects; the one that explains most comes first.

    Args:
        search: The search.
        every: Estimates of all parameters, by site.
        at_edge: For each effect that it added, the shape parameters with an implausible value.
        found_in: Whether parts of the recording show an effect, by its name.
    """
    again = repetitions(search.final)
    effects = [
        finding_of(
            added,
            search,
            every,
            implausible,
            again.get(added.effect.name),
            found_in.get(added.effect.name, []),
        )
        for added, implausible in zip(search.added, at_edge, strict=True)
    ]
    return sorted(effects, key=lambda found: found.share, reverse=True)


def finding_of(
    added: Added,
    search: Search,
    every: dict[str, Estimate],
    at_edge: tuple[str, ...],
    repetition: Repetition | None,
    found_in: Sequence[PartResult],
) -> Finding:
    """Returns what a discovery says about an effect.

    Args:
        added: The effect, as the search added it.
        search: The search.
        every: Estimates of all parameters, by site.
        at_edge: Its shape parameters with an implausible value.
        repetition: Its strengths in parts of the recording, if they were compared.
        found_in: Whether parts of the recording show it.
    """
    effect = added.effect
    sizes = [
        abs(every[site].mean - p.nominal) / max(every[site].sd, 1e-300)
        for p in effect.strengths
        if (site := f"{effect.name}.{p.name}") in every
    ]
    is_zero = bool(sizes) and max(sizes) < VERDICT.fewest_deviations
    whole = sum(other.share for other in search.missing)
    is_small = (
        search.is_approximate
        and added.share <= VERDICT.minor_share * whole
        and (search.has_stopped or effect.name in search.minor)
    )
    alternatives = [
        name
        for name, probability in added.alternatives.items()
        if (probability >= EVIDENCE.least_probability or name in added.fitting)
        and name != effect.name
    ]
    alternatives += added.forms
    known = equivalents(effect, search.final.names)
    # An id is enough, except for the same law at another place.
    causes = [
        name if name.endswith(f".{effect.id}") else name.rsplit(".", 1)[1] for name in alternatives
    ]
    return Finding(
        effect,
        added.probability,
        added.alternatives,
        tuple(name for name in dict.fromkeys([*causes, *known]) if name != effect.id),
        added.share,
        {
            site.removeprefix(f"{effect.name}."): every[site]
            for site in effect.parameter_names
            if site in every
        },
        at_edge,
        is_minor=is_zero or is_small,
        corrects=search.final.simulator.corrected_number(effect),
        repetition=repetition,
        found_in=tuple(found_in),
        is_compared=added.is_compared,
        may_be_step_error=_may_be_step_error(added, search, every),
    )


def _may_be_step_error(added: Added, search: Search, every: Mapping[str, Estimate]) -> bool:
    """Returns whether an effect may be what a simulator's steps miss.

    What an engine of low order misses in a step looks like a delay or a lag of a part of the step.
    Finer steps would show whether it is one, but not every simulator has them.
    """
    simulator, strengths = search.final.simulator, added.effect.strengths
    has_finer = num_finer_steps(search.final.model) > 0 or simulator.with_finer_steps() is not None
    if has_finer or not all(p.unit == "s" for p in strengths):
        return False
    sites = [f"{added.effect.name}.{p.name}" for p in strengths]
    known = [abs(every[site].mean) for site in sites if site in every]
    return bool(known) and max(known) < simulator.time_step
