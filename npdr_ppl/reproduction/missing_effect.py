"""The effects that the paper's model of the real Furuta pendulum lacks.

Muratore et al. (2021) fitted nine parameters of the rigid-body equations to five swing-ups, and
Table 2 gives the remaining error. Here discovery starts from the same equations and the first
three swing-ups. The other two, and chirps at another sampling rate, test the effects that it adds.

Discovery fits short segments and also estimates their initial states. Table 2 evaluates the
prediction of longer segments. Both models are therefore fitted again, on the rollouts to fit, to
segments of Table 2's length.

The paper re-synchronises to recorded states, whose velocities the rig's driver has filtered. Even
a model of this filter then starts from filtered velocities. The main results therefore use initial
states that a smoother estimates; results from recorded states are for comparison with the paper.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from npdr_ppl import metrics
from npdr_ppl.discovery import Discovery, DiscoveryOptions, Investigation
from npdr_ppl.discovery.discovery_folder import DiscoveryFolder, findings_until
from npdr_ppl.discovery.hypothesis import Hypothesis, fit_hypothesis
from npdr_ppl.errors import DataError
from npdr_ppl.language.model import Model
from npdr_ppl.models.furuta import Furuta, furuta
from npdr_ppl.preparation.data_options import DataOptions, checked_options
from npdr_ppl.preparation.evaluation import nominal_parameters, score
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.reproduction.table2 import PAPER, SEGMENT_LENGTH
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.segments import InitialState
from npdr_ppl.run_files import claimed, read_json, write_json
from npdr_ppl.run_records import ReproductionRecord

__all__ = ["Story", "load_recordings", "reproduce_missing_effect"]

SWING_UP, CHIRP = "swing_up_500hz_5s.csv", "chirp_positive_250hz_10s.csv"
"""File names of the recordings in a folder."""

CHIRP_SEGMENT_LENGTH = 100
"""Number of steps of 4 ms; the duration equals Table 2's 200 steps of 2 ms."""

Row = dict[str, metrics.Summary]


@dataclass(frozen=True)
class Story:
    """The discovery, and the models before and after.

    Attributes:
        discovery: The discovery.
        refitted: The paper's equations, fitted to Table 2's segments.
        revised: The equations with the missing effects, fitted to the same segments.
    """

    discovery: Discovery
    refitted: Hypothesis
    revised: Hypothesis


def load_recordings(path: Path) -> tuple[Rollouts, Rollouts | None]:
    """Loads the swing-ups and, if it exists, the other excitation.

    Args:
        path: The folder of both files, or the file of the swing-ups; the other file is then
            searched in its folder.

    Raises:
        DataError: There are no swing-ups, or they are from another device.
    """
    if not path.exists():
        raise DataError(f"{path} does not exist.")
    file = path / SWING_UP if path.is_dir() else path
    if path.is_dir() and not file.exists():
        raise DataError(f"{path} has no {SWING_UP}.")
    swing_ups = Rollouts.load(file)
    swing_ups.check(Furuta.sensors, Furuta.actions)
    other = file.with_name(CHIRP)
    return swing_ups, Rollouts.load(other) if other.exists() else None


def reproduce_missing_effect(
    swing_ups: Rollouts,
    chirps: Rollouts | None,
    out: Path,
    *,
    holdout: tuple[int, ...] = (3, 4),
    options: DataOptions | None = None,
    search: DiscoveryOptions | None = None,
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> tuple[Story | None, dict[str, Any]]:
    """Finds the effects that the paper's equations lack; writes ``missing-effect.json``.

    Args:
        swing_ups: The paper's recordings, 500 Hz.
        chirps: The same rig under another excitation, or ``None``.
        out: Folder for results; an interrupted search in it continues, a finished one is read.
        holdout: Swing-ups for the evaluation; the others are fitted.
        options: How the recordings are prepared for discovery.
        search: Settings of the search.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        Discovery and models, ``None`` if results of a finished run were read, and the content of
        ``missing-effect.json``.

    Raises:
        DataError: The recordings have too few rollouts, or the folder holds another search.
    """
    if max(holdout) >= len(swing_ups):
        raise DataError(f"rollout {max(holdout)} is to be held out; there are {len(swing_ups)}.")
    train = swing_ups[[i for i in range(len(swing_ups)) if i not in holdout]]
    test = swing_ups[list(holdout)]
    options, search = checked_options(options), search or DiscoveryOptions()
    folder, file = DiscoveryFolder(out), out / "missing-effect.json"
    with claimed(out):
        folder.begin(furuta, train, test, options, search, seed=seed)
        if file.exists():
            return None, dict(read_json(file, ReproductionRecord))
        with reporter(progress) as report, folder.kept():
            investigation = Investigation(
                furuta,
                train,
                holdout=test,
                options=options,
                search=search,
                seed=seed,
                progress=report,
            )
            found, discovery = findings_until(investigation, "prove")
        assert discovery is not None
        nominal = nominal_parameters(furuta, train.inputs(SEGMENT_LENGTH))
        story = Story(
            discovery,
            _refitted(furuta, investigation.given, train),
            _refitted(discovery.model, discovery.search.final, train),
        )
        fits = {"refitted": story.refitted, "revised": story.revised}
        result = {
            "rows": {
                "nominal": _row(furuta, nominal, test, chirps),
                **{name: _row(h.model, h.parameters, test, chirps) for name, h in fits.items()},
            },
            "closest_fit": {name: h.parameters for name, h in fits.items()},
            # The paper's fit of the same equations is its NPDR.
            "paper": {"nominal": _published("nominal"), "refitted": _published("snpe-c")},
            "skipped": {} if chirps is not None else {"chirp": f"There is no {CHIRP}."},
            "verdict": discovery.verdict,
            "effects": found["effects"],
            "held_out": list(holdout),
        }
        folder.finish(found, discovery)
        write_json(file, result)
    return story, result


def _refitted(model: Model, found: Hypothesis, rollouts: Rollouts) -> Hypothesis:
    """Fits a model of the discovery to Table 2's segments; starts at the discovery's parameters.

    Args:
        model: The hypothesis's model without its effects.
        found: The hypothesis.
        rollouts: The rollouts to fit.
    """
    options = DataOptions(None, SEGMENT_LENGTH, "estimated", "float64")
    return fit_hypothesis(model, rollouts, options, effects=found.effects, start=found.parameters)


def _row(model: Any, parameters: Any, held_out: Rollouts, chirps: Rollouts | None) -> Row:
    """Returns Table 2's metrics from estimated and recorded states, and those of the chirps."""
    row = _scores(model, parameters, held_out, SEGMENT_LENGTH, "estimated")
    recorded = _scores(model, parameters, held_out, SEGMENT_LENGTH, "recorded")
    row |= {f"{name}_recorded": value for name, value in recorded.items()}
    if chirps is not None:
        other = _scores(model, parameters, chirps, CHIRP_SEGMENT_LENGTH, "estimated")
        row |= {f"{name}_chirp": value for name, value in other.items()}
    return row


def _scores(
    model: Any, parameters: Any, rollouts: Rollouts, length: int, initial_state: InitialState
) -> Row:
    options = DataOptions(None, length, initial_state, "float64")
    found = score(model, rollouts, parameters, options)
    return {name: metrics.summarise(value) for name, value in found.items()}


def _published(method: str) -> dict[str, Any]:
    """Returns the paper's numbers, which are for recorded initial states."""
    return {name: PAPER[method][name] for name in ("rmse", "dtw")}
