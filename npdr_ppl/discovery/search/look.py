"""One look at a fitted model: is anything missing, and which candidates explain most?"""

from collections.abc import Callable, Iterator

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.alarm import sound_alarm
from npdr_ppl.discovery.screening.groups import ranked_laws, ranked_pairs
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.sensitivities import Variant
from npdr_ppl.discovery.screening.separation import separation_matrix
from npdr_ppl.discovery.screening.variants import candidates_at, variants_of
from npdr_ppl.discovery.search.rounds import Round
from npdr_ppl.discovery.search.settings import SEARCH
from npdr_ppl.memory import release_freed_memory
from npdr_ppl.progress import Reporter, Step

__all__ = ["look"]


def look(
    hypothesis: Hypothesis,
    options: DiscoveryOptions,
    *,
    seed: int = 0,
    number: int | None = None,
    report: Callable[[str], None] = lambda _: None,
    progress: Reporter | None = None,
) -> Round:
    """Tests whether an effect is missing, and ranks all candidates by linear gain.

    Args:
        hypothesis: The fitted model.
        options: Settings of the search.
        seed: Seed of the permutation tests.
        number: Number of parallel processes; by default that of the enclosing ``workers`` block.
            The result does not depend on it.
        report: Called with a sentence about the result.
        progress: Where to show how many candidates are done.
    """
    release_freed_memory()
    averaged = hypothesis.averaged()
    projection = Projection(averaged)
    step = (progress or Reporter()).stage("screen candidates")
    step(None, "responses to pulses of force")
    found = responses(averaged)
    candidates = candidates_at(hypothesis, options)
    variants = variants_of(candidates, projection, found, number=number)
    variants = _counted(variants, len(candidates), step)
    alarm, ranking = sound_alarm(
        projection,
        variants,
        found,
        hypothesis.simulator.sensors,
        false_alarm_rate=options.false_alarm_rate,
        seed=seed,
    )
    separation = separation_matrix(projection, ranking[: SEARCH.num_leading])
    pairs = ranked_pairs(projection, ranking[: SEARCH.num_paired])
    laws = ranked_laws(projection, ranking)
    shares = {c.name: c.shares_by_channel(projection) for c in ranking[: SEARCH.num_leading]}
    ranking = [candidate.without_change() for candidate in ranking]
    width = averaged.segments.steps_per_average
    if width > 1:
        fastest = 0.5 / (width * hypothesis.segments.inputs.time_step)
        report(
            f"long recording: averages of {width} steps were searched, so that effects above "
            f"{fastest:.3g} Hz are not visible"
        )
    best = ", ".join(s.name for s in ranking[:3]) or "none"
    report(f"p = {alarm.p_value:.2g} ({alarm.strongest}); the best candidates are {best}")
    return Round(hypothesis, averaged, alarm, ranking, separation, pairs, laws, shares)


def _counted(variants: Iterator[Variant], num: int, step: Step) -> Iterator[Variant]:
    """Yields the variants, and reports of how many of ``num`` candidates they are."""
    seen: set[str] = set()
    step(0.0, f"0 of {num} candidates")
    for variant in variants:
        if variant.effect.name not in seen:
            # The variants of a candidate follow each other: those before it are done.
            step(len(seen) / num, f"{len(seen)} of {num} candidates")
            seen.add(variant.effect.name)
        yield variant
    step(None, "laws that are not in the catalogue")
