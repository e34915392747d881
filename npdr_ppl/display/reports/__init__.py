"""Reports: a finished run as one HTML file that opens from disk, without a network."""

from npdr_ppl.display.reports.run_report import read_run, write_report

__all__ = ["read_run", "write_report"]
