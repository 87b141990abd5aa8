"""``rigd bench``: how punctual the loop is on this computer, and which rate it can hold."""

from rigd.bench.measure import Measurement
from rigd.bench.program import Bench, Results
from rigd.bench.report import as_json, report_lines

__all__ = ["Bench", "Measurement", "Results", "as_json", "report_lines"]
