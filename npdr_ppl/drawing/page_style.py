"""Style of the drawings in reports and notebooks: the text's own colour, light and dark."""

from importlib.resources import files

__all__ = ["drawing_style", "styled"]


def drawing_style() -> str:
    """Returns the rules for everything inside an element of the class ``npdr``."""
    return files("npdr_ppl.drawing").joinpath("drawings.css").read_text(encoding="utf-8")


def styled(html: str) -> str:
    """Returns drawings with their style, for a notebook.

    Args:
        html: The drawings as HTML.
    """
    return f'<div class="npdr"><style>{drawing_style()}</style>{html}</div>'
