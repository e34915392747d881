"""Small tables in HTML, for notebooks; every text is escaped."""

from collections.abc import Mapping, Sequence
from html import escape

__all__ = ["facts", "table"]


def facts(title: str, values: Mapping[str, str]) -> str:
    """Returns a heading and a table of names and values."""
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in values.items()
    )
    return f"<div><strong>{escape(title)}</strong><table>{rows}</table></div>"


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a table with headings; the first cell of each row is its name."""
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(
        f'<tr><th style="text-align:left">{escape(row[0])}</th>'
        + "".join(f"<td>{escape(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
