"""Figures and reports of finished runs.

May import: everything but the command line. Start reading at ``plots/fit_figures.py`` and
``reports/run_report.py``.
"""
