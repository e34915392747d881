"""Reports: a finished run as one HTML file that opens from disk, without a network.

May import: everything but the command line. Start reading at ``run_report.py``.
"""

from npdr_ppl.display.reports.run_report import read_run, write_report, write_runs_report

__all__ = ["read_run", "write_report", "write_runs_report"]
