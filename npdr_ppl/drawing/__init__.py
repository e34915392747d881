"""Drawing primitives: colours, panels, marginals, HTML tables.

Objects that show themselves in notebooks use them, so this package imports only errors. Start
reading at ``theme.py``.
"""
