"""Counts in the operator's words, and errors of readable length."""

import pytest

from rigd.printable import counts_text, progress_bar, readable_errors, readable_message


def test_unreadable_counts_are_unknown():
    counts = {"recorded": None, "scheduled": 12_000, "missed": 2, "late": 0, "lost": None}
    assert counts_text(counts) == "unknown of 12 000 samples, 2 missed, 0 late, unknown lost"


def test_error_preserves_its_beginning_and_remedy():
    shown = readable_message(f"a.toml: {'x' * 1_000_000} is unknown; remove it.")
    assert len(shown) < 2100
    assert shown.startswith("a.toml: xxx")
    assert shown.endswith("xxx is unknown; remove it.")
    assert readable_message("a\x1b[2J\r.\nb.") == "a?[2J?.\nb."


def test_first_of_many_lines_are_shown():
    lines = readable_message("\n".join(f"line {i}." for i in range(100_000))).split("\n")
    assert lines[39:] == ["line 39.", "… and 99 960 more lines."]
    assert readable_message("\n".join(["a"] * 40)).count("\n") == 39


def test_only_usage_errors_are_reformatted():
    class UsageError(Exception):
        exit_code = 2
        message = "y" * 10_000

    for error in (UsageError(), ValueError("y" * 10_000)):
        with pytest.raises(type(error)), readable_errors():
            raise error
        assert len(getattr(error, "message", "")) < 2100
    assert len(str(error)) == 10_000


def test_remaining_time_is_known_for_long_steps():
    bar = progress_bar()
    now_s = [0.0]
    bar.get_time = lambda: now_s[-1]
    task = bar.add_task("sessions", total=10)
    for time_s in (100.0, 220.0, 340.0):
        now_s.append(time_s)
        bar.update(task, advance=1)
    assert bar.tasks[0].time_remaining == 840.0
