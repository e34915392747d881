"""The verdict of a discovery, and the reason for it."""

from collections.abc import Mapping, Sequence

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.discovery_result import Verdict
from npdr_ppl.discovery.finding import Finding
from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.discovery.search.rounds import Search
from npdr_ppl.discovery.search.settings import EVIDENCE, TRIALS
from npdr_ppl.discovery.settings import VERDICT

__all__ = ["judge", "most_doubtful"]


def judge(
    search: Search,
    effects: Sequence[Finding],
    unexplained: float,
    gap: Mapping[str, Gap],
    options: DiscoveryOptions,
) -> tuple[Verdict, str]:
    """Returns the verdict and the reason for it.

    Args:
        search: The search.
        effects: The effects that were found.
        unexplained: Share of the misfit that the final model leaves.
        gap: Metrics on the held-out recording; empty without one.
        options: Settings of the search.
    """
    if search.has_stopped:
        return "unknown", _best_so_far(effects, options)
    if not effects:
        if not search.rounds[-1].alarm.fired:
            return "none", "This recording shows no missing effect."
        return "unknown", "Simulation and recording disagree, and no effect explains it."
    left = search.rounds[-1].alarm
    # The alarm allows for every kind of noise, so it misses a remainder in only a few segments.
    is_certain = 0.5 * search.final.share * left.gain > TRIALS.certain_evidence
    if (left.fired and unexplained > VERDICT.most_unexplained) or (
        is_certain and unexplained > VERDICT.most_undetected
    ):
        return "unknown", (
            f"The effects that were found leave {unexplained:.0%} of the misfit unexplained. "
            f"The strongest sign of it is {left.strongest}."
        )
    missing = [f for f in effects if not f.corrects]
    if not missing:
        numbers = ", ".join(f.corrects for f in effects)
        return "none", f"No effect is missing. The recording corrects {numbers}."
    explains = sum(f.share for f in missing)
    strained = [f for f in effects if f.at_edge and f.share > VERDICT.minor_share * explains]
    if strained:
        effect = strained[0].effect
        simpler = " or ".join(f"{effect.port}.{law}" for law in effect.contains)
        return "unknown", (
            f"{effect.name} explains the misfit with an implausible value of "
            f"{strained[0].at_edge[0]}. Another law that is similar there is the likelier cause."
            + (f" Compare it with {simpler}." if simpler else "")
        )
    once = [(f, f.repetition) for f in effects if f.repetition and not f.is_found_again]
    if once:
        one, other = (estimate.part for estimate in once[0][1].estimates)
        return "unknown", (
            f"{once[0][0].effect.name} explains the misfit only with different values for {one} "
            f"and {other}, so it is not the cause."
        )
    doubtful = [f for f in effects if f.doubt]
    if sum(f.share for f in doubtful) > VERDICT.minor_share * explains:
        return "unknown", f"{doubtful[0].effect.name} {doubtful[0].doubt}."
    sure = [f for f in effects if f.is_sure(options.confidence)]
    unsure = [f for f in effects if f.can_be_named and f not in sure]
    if sure and sum(f.share for f in unsure) <= VERDICT.minor_share * explains:
        if gap and gap["rmse"].is_open:
            return "unknown", _still_open(sure, gap["rmse"])
        return "named", "Missing: " + ", ".join(f.effect.name for f in sure) + "."
    if not unsure:
        names = ", ".join(f.effect.name for f in missing)
        return "unknown", f"The effects that were found are too small to be named: {names}."
    unclear = most_doubtful(effects, options)
    likeliest = sorted(unclear.alternatives.values(), reverse=True)
    # At least two are named, even if all others are unlikely.
    least = min(EVIDENCE.least_probability, *likeliest[:2])
    names = " or ".join(n for n, p in unclear.alternatives.items() if p >= least)
    return "ambiguous", f"The recording cannot tell which effect is missing: {names}."


def most_doubtful(effects: Sequence[Finding], options: DiscoveryOptions) -> Finding:
    """Returns the uncertain effect, of those that can be named, that explains most."""
    return max(
        (f for f in effects if f.can_be_named and not f.is_sure(options.confidence)),
        key=lambda found: found.share,
    )


def _best_so_far(effects: Sequence[Finding], options: DiscoveryOptions) -> str:
    """Returns the reason of a search that a time limit ended."""
    limit = options.time_limit or 0.0
    names = " and ".join(found.effect.name for found in effects) or "no effect"
    return (
        f"The time limit of {limit:.4g} s ended the search. The best explanation so far is "
        f"{names}; not all alternatives to it were tried. A longer limit continues the search."
    )


def _still_open(effects: Sequence[Finding], gap: Gap) -> str:
    """Returns why effects are not named although the recording that they were found in fits."""
    names = ", ".join(found.effect.name for found in effects)
    if gap.has_grown:
        return (
            f"With {names} the error on the held-out rollouts grows from {gap.before:.3g} to "
            f"{gap.after:.3g}."
        )
    closed = max(0.0, gap.closed or 0.0)
    return (
        f"With {names} the model fits the recording, but closes only {closed:.0%} of the gap on "
        "the held-out rollouts."
    )
