"""Origin of a result: versions, seeds, settings, the model's source and checksums of data."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.content import CodePart, Section, TablePart, TextPart
from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import Description

__all__ = ["checksum", "data_files", "provenance_section", "run_description", "source_section"]

MAX_FILES = 2_000
"""Maximum number of files with data of a run; each takes a row of the report."""


def run_description(folder: Path) -> dict[str, Any]:
    """Returns the content of a run's ``run.json`` or ``loop.json``; empty if there is neither."""
    for file in (folder / "run.json", folder / "run" / "run.json", folder / "loop.json"):
        if file.exists():
            return dict(read_json(file, Description))
    return {}


def data_files(folder: Path) -> list[Path]:
    """Returns the files with measured data that a run keeps."""
    found = [
        *folder.glob("data_*"),
        *folder.glob("run/data_*"),
        *folder.glob("rollouts/*.nc"),
        *folder.glob("recording.*"),
    ]
    if len(found) > MAX_FILES:
        raise DataError(f"{folder} has more than {MAX_FILES} files with data.")
    return sorted(found)


def source_section(description: Mapping[str, Any]) -> list[Section]:
    """Returns the model's source as a section; no section if it was not recorded."""
    model = description.get("model")
    text = model.get("source") if isinstance(model, Mapping) else model
    if not isinstance(text, str) or not text.strip():
        return []
    part = CodePart(text.rstrip(), "Source of the model in this run.")
    return [Section("Model", [part], is_folded=True)]


def provenance_section(description: Mapping[str, Any], folder: Path) -> Section:
    """Returns versions, seeds, settings and checksums."""
    rows = [
        [name, _words(description[name])]
        for name in (
            "backend",
            "options",
            "target",
            "task",
            "seed",
            "rounds",
            "iterations",
            "num_simulations",
            "binding",
        )
        if name in description
    ]
    versions = description.get("versions") or {}
    rows += [[f"version of {name}", str(value)] for name, value in versions.items()]
    if fingerprint := description.get("fingerprint"):
        rows.append(["SHA-256 of the data", str(fingerprint)])
    rows += [[f"SHA-256 of {f.relative_to(folder)}", checksum(f)] for f in data_files(folder)]
    if not rows:
        parts = [TextPart("The run did not record its origin.")]
        return Section("Provenance", parts, is_folded=True)
    caption = "Settings and files that are needed to reproduce this result."
    table = TablePart(("item", "value"), rows, caption, "prose")
    return Section("Provenance", [table], is_folded=True)


def checksum(path: Path) -> str:
    """Returns a file's SHA-256 as hexadecimal digits; a dash if it is no file of a run's size."""
    if not path.is_file() or path.stat().st_size > LIMITS.file_bytes:
        return "–"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_words(item)}" for key, item in value.items())
    return str(value)
