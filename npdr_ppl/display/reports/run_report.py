"""Detects the kind of run in a folder, and writes its report to a file."""

from collections.abc import Callable
from pathlib import Path

from npdr_ppl.atomic_files import replacing
from npdr_ppl.display.reports.comparison_report import comparison_report
from npdr_ppl.display.reports.content import Report
from npdr_ppl.display.reports.demo_report import demo_report
from npdr_ppl.display.reports.discovery_report import discovery_report
from npdr_ppl.display.reports.fit_report import fit_report
from npdr_ppl.display.reports.page import render
from npdr_ppl.display.reports.training_report import training_report
from npdr_ppl.errors import DataError

__all__ = ["read_run", "write_report"]

# A training run may contain a discovery in a subfolder, and every kind contains inference runs,
# so the file at the top level decides.
_READERS: dict[str, Callable[[Path], Report]] = {
    "demo.json": demo_report,
    "discovery.json": discovery_report,
    "comparison.json": comparison_report,
    "train.json": training_report,
    "fit.json": fit_report,
}


def read_run(run: Path) -> Report:
    """Reads a finished run.

    Args:
        run: Folder that ``npdr fit``, ``compare``, ``train``, ``discover`` or ``demo`` wrote.

    Raises:
        DataError: The folder is not one of these, or its files were changed.
    """
    if not run.is_dir():
        raise DataError(f"{run} is not a folder; give the one that was passed as --out.")
    for name, reader in _READERS.items():
        if (run / name).exists():
            try:
                return reader(run)
            except (KeyError, TypeError, AttributeError, IndexError) as error:
                raise DataError(
                    f"{run / name} is not what npdr writes: {type(error).__name__} {error}."
                ) from error
    hint = " Its run is not finished: give the same command again." if _is_begun(run) else ""
    inside = sorted(f.parent for name in _READERS for f in run.glob(f"*/{name}"))
    if not hint and inside:
        hint = f" Did you mean {inside[0]}?"
    raise DataError(
        f"{run} holds none of {', '.join(_READERS)}; give the folder that was passed as --out."
        f"{hint}"
    )


def write_report(run: Path, out: Path | None = None) -> Path:
    """Writes the report on a finished run as one HTML file, and returns its path.

    Args:
        run: Folder of the run.
        out: The file; ``report.html`` in that folder if ``None``.
    """
    page = render(read_run(run))
    path = run / "report.html" if out is None else out
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def _is_begun(run: Path) -> bool:
    return any((run / name).exists() for name in ("loop.json", "run", "settings.json"))
