"""Folders of reports: each is complete or absent, and no other files are overwritten.

Each folder contains a list of its files with their SHA-256 checksums (``SHA256SUMS``, which
``sha256sum -c`` can check). A file that is in the list and unchanged was written by an analysis. No
other file is ever replaced or removed.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rigd.documents import DocumentError, read_json, read_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

_MAX_CHECKSUM_LIST_BYTES: Final = 10_000_000
"""Largest size of a list of files that is read, in bytes: a hundred thousand files."""
CHECKSUM_LIST_NAME: Final = "SHA256SUMS"
"""Name of the file that lists a report's files with their checksums."""

UNIFORMITY_FIGURE: Final = "uniform_beam"
"""Name of the file with the figure of the test of the beam's uniformity, without suffix."""
FIGURES: Final = ("record_frf", UNIFORMITY_FIGURE, "loss_factor", "residual", "record_signals")
"""File names of a whole record's figures.

The second figure is omitted if too few modes are visible for the test."""
WELCH_FIGURES: Final = ("welch_signals", "welch_frf", "welch_torque")
"""Names of the Welch fits' figures."""
_WELCH_FIGURES_WITH_RECORD: Final = ("welch_frf",)
"""Names of the Welch fits' figures in a report with whole-record fits.

The whole-record fits have their own figures of signals and torque."""

_RESULT_KEYS: Final = frozenset(("versions", "headlines", "fits"))
"""Keys by which a JSON document is recognised as results of an analysis."""


class OutputExistsError(ValueError):
    """Error if a file or folder that is to be written exists already."""


class OutputError(Exception):
    """Error if an output file or folder cannot be written."""


# Names


def welch_figure_names(*, with_paper_figures: bool, has_whole_record: bool) -> tuple[str, ...]:
    """Return the names of the Welch fits' figures in a report.

    Parameters
    ----------
    with_paper_figures : bool
        Whether the Welch fits were run.
    has_whole_record : bool
        Whether the whole-record fits were run.
    """
    if not with_paper_figures:
        return ()
    return _WELCH_FIGURES_WITH_RECORD if has_whole_record else WELCH_FIGURES


def report_folders(
    session_files: Sequence[Path], report_path: Path | None, *, overwrite: bool = False
) -> list[Path]:
    """Return the folder for each file's report; raise if a report must not be written there.

    Parameters
    ----------
    session_files : sequence of Path
        Session files that are analysed.
    report_path : Path, optional
        Requested folder. With one file it is that file's report; with several files it contains one
        folder per file, named like the file. Default: ``NAME.report`` next to each file, or if that
        exists ``NAME.report-2`` and so on.
    overwrite : bool
        Whether an earlier report is replaced.

    Raises
    ------
    OutputExistsError
        If the folder exists, is not empty and contains no earlier report to replace.
    """
    if report_path is None:
        # A folder given for a file may have no name of its own ("." or "/").
        requested_folders = [
            session_file.parent / f"{session_file.stem}.report" for session_file in session_files
        ]
    elif overwrite or _is_missing_or_empty(report_path):
        requested_folders = (
            [report_path]
            if len(session_files) == 1
            else [report_path / session_file.stem for session_file in session_files]
        )
    else:
        raise OutputExistsError(
            f"--report {report_path} exists and is not an empty folder; choose another name, or "
            "replace an earlier report with --overwrite. Nothing is overwritten without it."
        )
    reserved_folders: set[Path] = set()
    if not overwrite:
        return (
            requested_folders
            if requested_folders == [report_path]
            else [
                _unused_folder(requested_folder, reserved_folders)
                for requested_folder in requested_folders
            ]
        )
    folders = [
        _unused_folder(requested_folder, reserved_folders, overwrite=True)
        for requested_folder in requested_folders
    ]
    for folder in folders:
        _require_replaceable_folder(folder)
    return folders


def check_new_file(path: Path, message_subject: str, *, overwrite: bool = False) -> None:
    """Raise OutputExistsError if a path exists and must not be replaced.

    Parameters
    ----------
    path : Path
        File to be written.
    message_subject : str
        Beginning of the error message: the option that requests the file, or "The file".
    overwrite : bool
        Whether the file may exist if it contains results of an analysis in JSON.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise OutputExistsError(
            f"{message_subject} {path} exists; choose another name or move it away, nothing is "
            "overwritten."
        )
    if not _contains_results(path):
        raise OutputExistsError(
            f"{message_subject} {path} exists and does not hold results of an analysis, which is "
            "all that --overwrite replaces; choose another name or move it away."
        )


def _is_missing_or_empty(folder: Path) -> bool:
    """Return whether a report can be written to a path: it does not exist or is an empty folder."""
    return not os.path.lexists(folder) or (folder.is_dir() and not any(folder.iterdir()))


def _unused_folder(folder: Path, reserved_folders: set[Path], *, overwrite: bool = False) -> Path:
    """Return a folder's path, or the first unused one with a number appended if it is in use."""
    folder_number, candidate_folder = 1, folder
    while candidate_folder in reserved_folders or (
        os.path.lexists(candidate_folder) and not overwrite
    ):
        folder_number += 1
        candidate_folder = folder.with_name(f"{folder.name}-{folder_number}")
    reserved_folders.add(candidate_folder)
    return candidate_folder


def _contains_results(path: Path) -> bool:
    """Return whether a file contains the results of an analysis in JSON."""
    if path.is_symlink() or not path.is_file():
        return False
    try:
        json_content = read_json(path)
    except DocumentError:
        return False
    return isinstance(json_content, dict) and json_content.keys() >= _RESULT_KEYS


# Writing


@contextmanager
def new_report_folder(folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Provide a temporary folder that is renamed on success and removed on failure.

    Parameters
    ----------
    folder : Path
        Final path of the folder.
    overwrite : bool
        Whether an earlier report in this folder is replaced: the files of the report are removed,
        all other files remain.

    Raises
    ------
    OutputExistsError
        If another program has created the folder in the meantime and it is not empty, or if a file
        of the earlier report was changed.
    OutputError
        If the folder cannot be created.
    """
    temporary_folder = folder.with_name(f".{folder.name}.part-{os.getpid()}")
    try:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            temporary_folder.mkdir()
        except OSError as error:
            raise OutputError(
                f"The report {folder} cannot be written: {error.strerror or error}. "
                "Choose a folder with --report."
            ) from error
        yield temporary_folder
        checksums = {
            path.relative_to(temporary_folder).as_posix(): {sha256(path)}
            for path in sorted(temporary_folder.rglob("*"))
            if path.is_file()
        }
        if overwrite and not _is_missing_or_empty(folder):
            _replace_report(folder, temporary_folder, checksums)
            return
        (temporary_folder / CHECKSUM_LIST_NAME).write_text(
            _checksum_list_text(checksums), encoding="utf-8"
        )
        with suppress(OSError):
            folder.rmdir()  # Windows does not replace a folder, not even an empty one
        try:
            temporary_folder.rename(folder)
        except OSError as error:
            raise OutputExistsError(
                f"The report {folder} was created meanwhile ({error.strerror or error}); "
                "nothing is overwritten, choose another name with --report."
            ) from error
    finally:
        shutil.rmtree(temporary_folder, ignore_errors=True)


def write_new_file(path: Path, file_content: str | bytes, *, overwrite: bool = False) -> None:
    """Write a new file, and create the folders of its path. Text is encoded as UTF-8.

    Parameters
    ----------
    path : Path
        File to be written.
    file_content : str or bytes
        Content of the file.
    overwrite : bool
        Whether the file replaces earlier results of an analysis.

    Raises
    ------
    OutputExistsError, OutputError
        If the file exists or cannot be written.
    """
    check_new_file(path, "The file", overwrite=overwrite)
    if isinstance(file_content, str):
        # File names may hold bytes that are not text; as escapes they are text, and valid JSON.
        file_content = file_content.encode("utf-8", "backslashreplace")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path):
            _replace_file(path, file_content)
        else:
            with path.open("xb") as file_stream:
                file_stream.write(file_content)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error


def _replace_file(path: Path, file_bytes: bytes) -> None:
    """Replace a file atomically, so that the old file remains if the disk is full."""
    temporary_path = path.with_name(f".{path.name}.part-{os.getpid()}")
    try:
        temporary_path.write_bytes(file_bytes)
        temporary_path.replace(path)
    finally:
        temporary_path.unlink(missing_ok=True)


# Earlier reports


def _require_replaceable_folder(folder: Path) -> None:
    """Raise OutputExistsError unless a folder is absent, empty or contains an earlier report."""
    if not _is_missing_or_empty(folder) and not (
        folder.is_dir() and (folder / CHECKSUM_LIST_NAME).is_file()
    ):
        raise OutputExistsError(
            f"--overwrite replaces reports of an analysis, and {folder} is not one: it has no list "
            f"of its files ({CHECKSUM_LIST_NAME}). Choose another folder with --report, or move "
            "it away."
        )


def _replace_report(
    folder: Path, temporary_folder: Path, checksums: Mapping[str, set[str]]
) -> None:
    """Move a new report's files into an earlier report's folder, and remove the earlier files."""
    earlier_checksums = _read_checksum_list(folder)
    for file_name in checksums:
        if os.path.lexists(folder / file_name) and not _is_unchanged_report_file(
            folder, file_name, earlier_checksums
        ):
            raise OutputExistsError(
                f"The report {folder} is unchanged: {file_name} in it was modified, or not written "
                "by an analysis, and --overwrite does not replace such files; move it away, or "
                "choose another folder with --report."
            )
    try:
        # If this is interrupted, the list still contains all files.
        all_checksums = {
            file_name: earlier_checksums.get(file_name, set()) | checksums.get(file_name, set())
            for file_name in {*earlier_checksums, *checksums}
        }
        _replace_file(folder / CHECKSUM_LIST_NAME, _checksum_list_text(all_checksums).encode())
        for file_name in checksums:
            (folder / file_name).parent.mkdir(parents=True, exist_ok=True)
            (temporary_folder / file_name).replace(folder / file_name)
        for file_name in earlier_checksums.keys() - checksums.keys():
            if _is_unchanged_report_file(folder, file_name, earlier_checksums):
                (folder / file_name).unlink()
                with suppress(OSError):  # folders that are not empty stay
                    (folder / file_name).parent.rmdir()
        _replace_file(folder / CHECKSUM_LIST_NAME, _checksum_list_text(checksums).encode())
    except OSError as error:
        raise OutputError(
            f"The report {folder} cannot be replaced: {error.strerror or error}."
        ) from error


def _is_unchanged_report_file(
    folder: Path, file_name: str, listed_checksums: Mapping[str, set[str]]
) -> bool:
    """Return whether a file in a report's folder is listed there and has a listed checksum."""
    file_path = folder / file_name
    is_inside_folder = (
        file_path.resolve().is_relative_to(folder.resolve()) and not file_path.is_symlink()
    )
    return (
        is_inside_folder
        and file_path.is_file()
        and sha256(file_path) in listed_checksums.get(file_name, ())
    )


def _read_checksum_list(folder: Path) -> dict[str, set[str]]:
    """Return the SHA-256 checksums in the list of a report's folder, by file name.

    A file has two checksums if the analysis was interrupted while it replaced the file.
    """
    checksums: dict[str, set[str]] = {}
    try:
        for list_line in read_text(
            folder / CHECKSUM_LIST_NAME, _MAX_CHECKSUM_LIST_BYTES
        ).splitlines():
            checksum, _, file_name = list_line.partition("  ")
            checksums.setdefault(file_name, set()).add(checksum)
    except DocumentError as error:
        raise OutputError(f"{folder / CHECKSUM_LIST_NAME} {error}.") from error
    return checksums


def _checksum_list_text(checksums: Mapping[str, set[str]]) -> str:
    """Return the text of a report's list of files and checksums."""
    return "".join(
        f"{checksum}  {file_name}\n"
        for file_name in sorted(checksums)
        for checksum in sorted(checksums[file_name])
    )


def sha256(path: Path) -> str:
    """Return the SHA-256 checksum of a file, in hexadecimal."""
    with path.open("rb") as file_stream:
        return hashlib.file_digest(file_stream, "sha256").hexdigest()
