"""The report of a finished run: one HTML file that needs no network."""

from duagc.pipeline.report.page import write_report

__all__ = ["write_report"]
