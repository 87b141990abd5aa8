"""A warning common to several files is reported once, with their number and a few names."""

from pathlib import Path

import pytest

from analysis.report import FileWarnings, shared_warnings

LEFT_OUT = "Welch fits left out: a multisine excites some lines only."


def of_files(*warnings: tuple[str, ...]) -> list[FileWarnings]:
    return [
        FileWarnings(f"{number}.mcap", Path(f"folder/{number}.mcap"), texts)
        for number, texts in enumerate(warnings)
    ]


@pytest.mark.parametrize(
    ("warnings", "lines"),
    [
        ([(), ()], []),
        ([("a",), ()], ["0.mcap: a"]),
        ([("a", "b"), ("b",)], ["0.mcap: a", "all 2 files: b"]),
        ([("a",), ("a",), ()], ["2 of 3 files (0.mcap, 1.mcap): a"]),
        (
            [(LEFT_OUT,)] * 5 + [()],
            [f"5 of 6 files (0.mcap, 1.mcap, 2.mcap and 2 more): {LEFT_OUT}"],
        ),
        ([("a", "a"), ()], ["0.mcap: a"]),
    ],
)
def test_each_warning_is_reported_once(warnings: list[tuple[str, ...]], lines: list[str]):
    assert shared_warnings(of_files(*warnings)) == lines


def test_warnings_are_compared_without_their_paths():
    files = of_files(("folder/0.mcap: no memory",), ("folder/1.mcap: no memory",), ("alone",))
    assert shared_warnings(files) == [
        "2 of 3 files (0.mcap, 1.mcap): no memory",
        "2.mcap: alone",
    ]
