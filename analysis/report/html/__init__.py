"""One record's report as one HTML file that needs nothing else."""

from analysis.report.html.subject import Subject, Verdict

__all__ = ["Subject", "Verdict"]
