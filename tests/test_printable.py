"""Counts in the operator's words."""

from rigd.printable import counts_text


def test_counts_that_nobody_could_read_are_unknown():
    counts = {"recorded": None, "scheduled": 12_000, "missed": 2, "late": 0, "lost": None}
    assert counts_text(counts) == "unknown of 12 000 samples, 2 missed, 0 late, unknown lost"
