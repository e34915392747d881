"""Renders a report as one HTML file that contains its style, its script and Plotly."""

from typing import Any

from npdr_ppl.display.reports.content import ChartPart, Report

__all__ = ["MAX_BYTES", "render"]

MAX_BYTES = 6_000_000
"""Maximum size of a page in bytes, so that it can be sent by e-mail."""


def render(report: Report) -> str:
    """Returns the page as HTML.

    The template engine escapes every text. Only the style, the script and Plotly, which come with
    the packages, are inserted unchanged. The script gets its data as JSON.
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
