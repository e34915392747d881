"""Content of a report, independent of its layout; each kind of run fills it in."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = [
    "ChartPart",
    "CodePart",
    "DiffPart",
    "DrawingPart",
    "Explained",
    "FindingsPart",
    "FoldedPart",
    "Headline",
    "KeyFigure",
    "Part",
    "PicturePart",
    "Report",
    "Section",
    "TablePart",
    "TextPart",
    "Tone",
    "unfolded",
]

Tone = Literal["good", "warn", "bad", "plain"]
"""Rating of a number; the page shows a word next to every colour, for colour-blind readers."""


@dataclass(frozen=True)
class Headline:
    """The main result, at the top of the page.

    Attributes:
        word: The result in a few words, such as ``"accept"``.
        sentence: Reason.
        tone: Rating.
    """

    word: str
    sentence: str
    tone: Tone = "plain"


@dataclass(frozen=True)
class KeyFigure:
    """A number for the top of the page."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class TextPart:
    """A paragraph."""

    text: str
    kind: str = field(default="text", init=False)


@dataclass(frozen=True)
class TablePart:
    """A table; the first column holds names, the others mostly numbers.

    Attributes:
        columns: Headings.
        rows: Cells as text.
        caption: What the table shows.
        layout: Whether cells are numbers, which are not wrapped, or prose, which is wrapped.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    layout: Literal["figures", "prose"] = "figures"
    kind: str = field(default="table", init=False)


@dataclass(frozen=True)
class ChartPart:
    """An interactive chart.

    Attributes:
        name: Identifier on the page.
        caption: Content of the chart and how to read it.
        data: Plotly's traces.
        layout: Plotly's layout; the page sets the colours of text and grid.
        height: Height in CSS pixels.
    """

    name: str
    caption: str
    data: Sequence[Mapping[str, Any]]
    layout: Mapping[str, Any]
    height: int = 320
    kind: str = field(default="chart", init=False)


@dataclass(frozen=True)
class DrawingPart:
    """A drawing of :mod:`npdr_ppl.drawing`, which needs no script.

    Attributes:
        html: The drawing. Its texts are escaped; nothing else may be put here.
        caption: What it shows and how to read it.
        is_wide: Whether it takes the larger part of a row that it shares with another drawing.
    """

    html: str
    caption: str = ""
    is_wide: bool = False
    kind: str = field(default="drawing", init=False)


@dataclass(frozen=True)
class CodePart:
    """Source text."""

    text: str
    caption: str = ""
    kind: str = field(default="code", init=False)


@dataclass(frozen=True)
class DiffPart:
    """A unified diff, line by line."""

    lines: Sequence[str]
    caption: str = ""
    kind: str = field(default="diff", init=False)


@dataclass(frozen=True)
class PicturePart:
    """A figure that the run has drawn, embedded as data."""

    data_uri: str
    caption: str
    kind: str = field(default="picture", init=False)


@dataclass(frozen=True)
class Explained:
    """A diagnostic with its meaning in plain language.

    Attributes:
        name: Name of the diagnostic.
        value: Its value as text.
        tone: Rating of the value.
        meaning: What the diagnostic measures, and what this value means.
    """

    name: str
    value: str
    tone: Tone
    meaning: str


@dataclass(frozen=True)
class FindingsPart:
    """Several diagnostics."""

    findings: Sequence[Explained]
    kind: str = field(default="findings", init=False)


@dataclass(frozen=True)
class FoldedPart:
    """Parts that a click unfolds.

    Attributes:
        summary: What is inside.
        parts: The parts.
    """

    summary: str
    parts: "Sequence[Part]"
    kind: str = field(default="folded", init=False)


Part = (
    TextPart
    | TablePart
    | ChartPart
    | DrawingPart
    | CodePart
    | DiffPart
    | PicturePart
    | FindingsPart
    | FoldedPart
)


def unfolded(parts: Sequence[Part]) -> Iterator[Part]:
    """Yields parts, and those inside folded ones."""
    for part in parts:
        yield part
        if isinstance(part, FoldedPart):
            yield from unfolded(part.parts)


@dataclass(frozen=True)
class Section:
    """A chapter of the page.

    Attributes:
        title: Heading.
        parts: Content.
        is_folded: Whether a click unfolds it: for what few readers need, such as source text.
    """

    title: str
    parts: Sequence[Part]
    is_folded: bool = False


@dataclass(frozen=True)
class Report:
    """A whole page.

    Attributes:
        kind: Command that made the run, such as ``"fit"``.
        title: Heading.
        verdict: Main result, at the top.
        figures: Key figures, below the verdict.
        sections: All other content.
        lead: What the first screen shows below the verdict: at most a wide and a narrow drawing.
    """

    kind: str
    title: str
    verdict: Headline
    figures: Sequence[KeyFigure]
    sections: Sequence[Section]
    lead: Sequence[DrawingPart] = ()
