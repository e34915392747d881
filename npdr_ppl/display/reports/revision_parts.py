"""The revised model as a diff, and the figures of a run."""

import base64
import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.content import (
    CodePart,
    DiffPart,
    Part,
    PicturePart,
    Section,
    TextPart,
)
from npdr_ppl.run_files import read_bytes, read_text

__all__ = ["pictures_section", "revision_section"]

MAX_PICTURE_BYTES = 700_000
"""Maximum total size of the pictures on a page in base64 characters, so that the page stays
small; larger ones are only named."""

MAX_COMPARED = 100_000
"""Maximum number of characters of two models that are compared; this takes up to a second."""


def revision_section(folder: Path, description: Mapping[str, Any]) -> list[Section]:
    """Returns the revised model, as a diff if the previous model is known."""
    file = folder / "revised_model.py"
    if not file.exists():
        return []
    revised = read_text(file)
    model = description.get("model")
    before = model.get("source") if isinstance(model, Mapping) else model
    is_long = len(revised) + len(str(before)) > MAX_COMPARED
    part: Part
    if not isinstance(before, str) or not before.strip() or is_long:
        part = CodePart(revised, "revised_model.py, for MODEL")
    else:
        lines = difflib.unified_diff(
            before.splitlines(), revised.splitlines(), "model", "revised_model.py", lineterm=""
        )
        part = DiffPart(
            list(lines), "Changes to the model; revised_model.py can be used as MODEL."
        )
    return [Section("Revised model", [part], is_folded=True)]


def pictures_section(folder: Path) -> list[Section]:
    """Returns the figures that the run has drawn."""
    parts: list[Part] = []
    left_out, size = [], 0
    for file in sorted(folder.glob("*.png")):
        if size + file.stat().st_size * 4 / 3 > MAX_PICTURE_BYTES:
            left_out.append(file.name)
            continue
        content = base64.b64encode(read_bytes(file)).decode("ascii")
        size += len(content)
        caption = file.stem.replace("_", " ")
        parts.append(PicturePart(f"data:image/png;base64,{content}", caption))
    if left_out:
        parts.append(TextPart(f"Too large for this page: {', '.join(left_out)}."))
    return [Section("Figures", parts, is_folded=True)] if parts else []
