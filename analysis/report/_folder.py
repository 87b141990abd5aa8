"""Where reports go: nothing that exists is overwritten, and a folder is complete or absent."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path


class OutputExistsError(ValueError):
    """What was asked to be written exists already."""


class OutputError(Exception):
    """Something could not be written."""


def report_folders(files: Sequence[Path], report: Path | None) -> list[Path]:
    """Choose a folder for each file's report.

    Parameters
    ----------
    files : sequence of Path
    report : Path, optional
        The folder asked for: that of the report of one file, or that which is to hold one folder
        a file, named like it. Default: ``NAME.report`` beside each file, or if that exists
        ``NAME.report-2`` and so on.

    Raises
    ------
    OutputExistsError
        If the folder asked for exists and is not empty.
    """
    if report is None:
        taken: set[Path] = set()
        # A folder given for a file may have no name of its own ("." or "/").
        return [_free(file.parent / f"{file.stem}.report", taken) for file in files]
    if report.exists() and not (report.is_dir() and not any(report.iterdir())):
        raise OutputExistsError(
            f"--report {report} exists and is not an empty folder; choose another name or move it "
            "away, nothing is overwritten."
        )
    if len(files) == 1:
        return [report]
    taken = set()
    return [_free(report / file.stem, taken) for file in files]


def check_new_file(path: Path, what: str) -> None:
    """Raise OutputExistsError if a path exists, naming what it was to be.

    Parameters
    ----------
    path : Path
        The new file.
    what : str
        Option that asked for it.
    """
    if os.path.lexists(path):
        raise OutputExistsError(
            f"{what} {path} exists; choose another name or move it away, nothing is overwritten."
        )


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Give a temporary folder that takes its name when all went well, and vanishes otherwise.

    Raises
    ------
    OutputExistsError
        If a folder of that name has appeared meanwhile and is not empty.
    OutputError
        If it cannot be created.
    """
    part = folder.with_name(f".{folder.name}.part-{os.getpid()}")
    try:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            part.mkdir()
        except OSError as error:
            raise OutputError(
                f"The report {folder} cannot be written: {error.strerror or error}. "
                "Choose a folder with --report."
            ) from error
        yield part
        try:
            part.rename(folder)
        except OSError as error:
            raise OutputExistsError(
                f"The report {folder} has appeared meanwhile ({error.strerror or error}); "
                "nothing is overwritten, choose another name with --report."
            ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def write_new(path: Path, content: str | bytes) -> None:
    """Write a new file, text in UTF-8, with the folders it needs.

    Parameters
    ----------
    path : Path
        The new file.
    content : str or bytes
        What goes into it.

    Raises
    ------
    OutputExistsError, OutputError
        If it exists, or cannot be written.
    """
    check_new_file(path, "The file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as stream:
            if isinstance(content, str):
                # File names may hold bytes that are no text; as escapes they are text, and JSON.
                content = content.encode("utf-8", "backslashreplace")
            stream.write(content)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error


def _free(folder: Path, taken: set[Path]) -> Path:
    """Return the folder, or the first numbered name like it that nothing has and nobody took."""
    number, candidate = 1, folder
    while os.path.lexists(candidate) or candidate in taken:
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    taken.add(candidate)
    return candidate
