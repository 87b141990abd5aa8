"""Warnings of several files: a common one is reported once, with the names of the files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_MAX_NAMED_FILES: Final = 3
"""Number of files that a shared warning names."""


class FileWarnings(NamedTuple):
    """Warnings of one file.

    Attributes
    ----------
    name : str
        Name of the file in the report.
    path : Path
        Path of the file, which its warnings may contain.
    warnings : sequence of str
        Sentences.
    """

    name: str
    path: Path
    warnings: Sequence[str]


def shared_warnings(files: Sequence[FileWarnings], kinds_text: str = "files") -> list[str]:
    """Return the warnings of files, each once, in the order of their first occurrence.

    Parameters
    ----------
    files : sequence of FileWarnings
        All files, also those without a warning.
    kinds_text : str
        What the files are called, such as the blocks of one session.

    Returns
    -------
    list of str
        Sentences that begin with the name of the file, or with the number of files that have the
        warning and a few of their names.
    """
    names_by_text: dict[str, dict[int, str]] = {}
    for file_index, file in enumerate(files):
        for sentence in file.warnings:
            # What differs by the path of the file alone is the same warning.
            warning_text = sentence.replace(f"{file.path}: ", "")
            names_by_text.setdefault(warning_text, {})[file_index] = file.name
    return [
        f"{_files_text(list(names.values()), len(files), kinds_text)}: {warning_text}"
        for warning_text, names in names_by_text.items()
    ]


def _files_text(names: Sequence[str], file_count: int, kinds_text: str) -> str:
    """Return a text on the files that have a warning: their number and a few of their names."""
    if len(names) == 1:
        return names[0]
    if len(names) == file_count:
        return f"all {file_count} {kinds_text}"
    named_files = ", ".join(names[:_MAX_NAMED_FILES])
    unnamed_count = len(names) - _MAX_NAMED_FILES
    return (
        f"{len(names)} of {file_count} {kinds_text} ({named_files}"
        f"{f' and {unnamed_count} more' if unnamed_count > 0 else ''})"
    )
