"""Detects the kind of run in a folder, and writes its report as one HTML file.

The file contains its style, its script and Plotly.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from npdr_ppl.atomic_files import replacing
from npdr_ppl.display.reports.comparison_report import comparison_report
from npdr_ppl.display.reports.content import ChartPart, Report, unfolded
from npdr_ppl.display.reports.demo_report import demo_report
from npdr_ppl.display.reports.discovery_report import discovery_report
from npdr_ppl.display.reports.fit_report import fit_report
from npdr_ppl.display.reports.runs_report import runs_report
from npdr_ppl.display.reports.training_report import training_report
from npdr_ppl.drawing.page_style import drawing_style
from npdr_ppl.errors import DataError
from npdr_ppl.run_files import reading_back

__all__ = ["MAX_BYTES", "read_run", "render", "write_report", "write_runs_report"]

MAX_BYTES = 6_000_000
"""Maximum size of a page in bytes, so that it can be sent by e-mail."""

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
            with reading_back(run / name):
                return reader(run)
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
    return _written(read_run(run), run / "report.html" if out is None else out)


def write_runs_report(runs: Sequence[Path], out: Path) -> Path:
    """Writes several runs side by side as one HTML file, and returns its path.

    Args:
        runs: Folders of ``npdr fit``, ``discover`` or ``train``.
        out: The file.

    Raises:
        DataError: The runs have nothing in common, or a folder is not that of a run.
    """
    return _written(runs_report(runs), out)


def _written(report: Report, path: Path) -> Path:
    page = render(report)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def _is_begun(run: Path) -> bool:
    return any((run / name).exists() for name in ("loop.json", "run", "settings.json"))


def render(report: Report) -> str:
    """Returns the page as HTML.

    The template engine escapes every text. Only the style, the script, Plotly, which come with the
    packages, and drawings, which escape their own texts, are inserted unchanged. The script gets
    its data as JSON.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=PackageLoader("npdr_ppl.display.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    charts: dict[str, Any] = {
        part.name: {"data": part.data, "layout": part.layout}
        for section in report.sections
        for part in unfolded(section.parts)
        if isinstance(part, ChartPart)
    }
    loader = environment.loader
    if loader is None:  # for the type checker: it was given above
        raise RuntimeError("The template engine has no loader.")
    style, script = (
        Markup(loader.get_source(environment, name)[0]) for name in ("report.css", "report.js")
    )
    return environment.get_template("report.html").render(
        report=report,
        charts=charts,
        style=style + Markup(drawing_style()),
        script=script,
        plotly=Markup(get_plotlyjs()) if charts else "",
    )
