"""From a report to one HTML file: template, style, script and Plotly, all inside the page."""

from typing import Any

from npdr_ppl.display.reports.content import ChartPart, Report

__all__ = ["MAX_BYTES", "render"]

MAX_BYTES = 6_000_000
"""Size that a page should stay below, so that it can be sent by mail."""


def render(report: Report) -> str:
    """Returns the page.

    Every text is escaped by the template engine. Only the style, the script and Plotly, which ship
    with the packages, go in as they are; data reach the script as JSON.
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
        for part in section.parts
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
        style=style,
        script=script,
        plotly=Markup(get_plotlyjs()) if charts else "",
    )
