"""The folder of a discovery: its settings, and the results once they are complete.

    run.json            model, options, seed, versions, a checksum of the recordings
    discovery.json      the results; written last. A folder with this file is complete, unless a
                        time limit ended the search
    revised_model.py    the model with the effects that were missing
    learned_effect.py   the law that was learned, if the catalogue has none that explains
    draws.safetensors   draws of its posterior, by parameter
    overlays.json       measurements and simulations over time, thinned, for the report
    fits/               the fits that an unfinished discovery has finished

A discovery that was killed leaves no ``discovery.json``, and continues when it is run again: it
reads its fits instead of repeating them. A complete one is not repeated.
"""

import dataclasses
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.discovery_result import Discovery, describe_candidate
from npdr_ppl.discovery.investigation import Investigation
from npdr_ppl.discovery.kept_fits import keep_fits
from npdr_ppl.errors import DataError
from npdr_ppl.language.model import Model
from npdr_ppl.model_code import code_checksum
from npdr_ppl.model_identity import model_name, source_text, versions
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.collection import checksum
from npdr_ppl.run_files import holds_this_run, make_folder, plain, read_json, write_json
from npdr_ppl.run_records import DiscoveryRecord

__all__ = ["STAGES", "DiscoveryFolder", "Stage", "findings_until"]

Stage = Literal["check", "locate", "alarm", "name", "prove"]
"""The stages. Each includes those before it."""

FITS = "fits"
"""Name of the folder of fits."""

STAGES: tuple[Stage, ...] = get_args(Stage)


class DiscoveryFolder:
    """Reads and writes the folder of one discovery.

    Args:
        path: The folder; it is created when something is written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Keeps the fits inside the block for the next run, whose code :meth:`begin` checks."""
        with keep_fits(self.path / FITS):
            yield

    def begin(
        self,
        model: Model,
        rollouts: Rollouts,
        holdout: Rollouts | None,
        options: DataOptions,
        search: DiscoveryOptions,
        *,
        seed: int,
    ) -> None:
        """Writes ``run.json``, or checks that the folder already holds the same discovery.

        Raises:
            DataError: The folder holds another discovery.
        """
        # A search that a time limit ended continues with another limit.
        limitless = dataclasses.replace(search, time_limit=None)
        settings = dataclasses.asdict(limitless) | {
            "effects": search.effects and [repr(effect) for effect in search.effects],
            "segment_length": options.segment_length,
            "precision": options.precision,
            "commands_before": options.commands_before,
        }
        description = plain(
            {
                "command": "discover",
                "name": model_name(model),
                "code": code_checksum(model),
                "options": settings,
                "seed": seed,
                "recordings": [checksum(r) for r in (rollouts, holdout) if r is not None],
            }
        )
        file = self.path / "run.json"
        make_folder(self.path)
        if not holds_this_run(file, description):
            source = {"name": model_name(model), "source": source_text(model)}
            write_json(file, description | {"versions": versions(), "model": source})

    def finished(self, stage: Stage) -> dict[str, Any] | None:
        """Returns the results up to a stage, or ``None`` if the folder does not have them."""
        file = self.path / "discovery.json"
        if not file.exists():
            return None
        found = dict(read_json(file, DiscoveryRecord))
        if found.get("has_stopped", False):
            return None
        reached = found.get("stage", STAGES[0])
        if reached not in STAGES:
            raise DataError(f"{file} has an unknown stage.")
        return found if STAGES.index(reached) >= STAGES.index(stage) else None

    def finish(self, found: dict[str, Any], discovery: Discovery | None = None) -> None:
        """Writes the results.

        Args:
            found: The content of ``discovery.json``.
            discovery: The discovery, if a verdict was reached.
        """
        if discovery is not None:
            discovery.save_model(self.path)
        write_json(self.path / "discovery.json", found)
        if found["stage"] == STAGES[-1] and not found.get("has_stopped", False):
            # No later run needs them.
            shutil.rmtree(self.path / FITS, ignore_errors=True)


def findings_until(
    investigation: Investigation, stage: Stage
) -> tuple[dict[str, Any], Discovery | None]:
    """Runs an investigation up to a stage.

    Args:
        investigation: The investigation.
        stage: The last stage to run.

    Returns:
        The content of ``discovery.json``, and the whole discovery if a verdict was reached.
    """
    reached = STAGES.index(stage)
    if reached >= STAGES.index("name"):
        discovery = investigation.conclude()
        return {"stage": stage, **discovery.to_dict()}, discovery
    found: dict[str, Any] = {
        "stage": stage,
        "data_problems": list(investigation.problems),
        "remarks": list(investigation.remarks),
    }
    if reached >= STAGES.index("locate"):
        found["where"] = [spot.to_dict() for spot in investigation.where]
    if reached >= STAGES.index("alarm"):
        first = investigation.first
        found["alarm"] = {"p_value": first.alarm.p_value, "fired": first.alarm.fired}
        found["ranking"] = [
            describe_candidate(candidate, first.alarm.p_values[candidate.name])
            for candidate in first.ranking
        ]
    investigation.progress.finish()
    return found | {"seconds": investigation.seconds}, None
