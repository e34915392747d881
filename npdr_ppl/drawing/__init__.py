"""Drawing primitives: colours, panels, marginals, HTML tables, curves, bars and maps.

Reports use them, and objects that show themselves in notebooks, so this package imports only
errors. Start reading at ``theme.py``, or at ``curves_html.py`` for what needs no matplotlib.
"""
