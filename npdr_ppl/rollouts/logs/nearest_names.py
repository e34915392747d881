"""The sentence for a name that a log does not have."""

from collections.abc import Iterable
from difflib import get_close_matches

from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks

__all__ = ["missing"]


def missing(kind: str, name: str, known: Iterable[str]) -> str:
    """Returns a sentence that a log has no such column or signal, with the closest names.

    Args:
        kind: Word for what is missing, e.g. ``"signal"``.
        name: The name that was asked for.
        known: The names that there are.
    """
    names = [known_name[:200] for known_name in known][: LIMITS.columns]
    last = name.rpartition("/")[2]
    close = get_close_matches(name[:200], names, n=3, cutoff=0.5)
    close += [n for n in names if last and n.endswith(last) and n not in close][: 3 - len(close)]
    listed = ", ".join(rollout_checks.shown(n, 80) for n in close or names[:5])
    said = f"did you mean {listed}?" if close else f"there are {listed or 'none'}."
    return f"there is no {kind} {rollout_checks.shown(name, 80)}; {said}"
