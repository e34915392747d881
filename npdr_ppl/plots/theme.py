"""One look for all figures; see :mod:`npdr_ppl.displays.theme`."""

from npdr_ppl.displays.theme import COLORS, SERIES, save_figure, theme

__all__ = ["COLORS", "SERIES", "save_figure", "theme"]
