"""List of the sessions in a folder: its files are found, read if new or changed, and filtered."""

import os
from collections.abc import Callable
from datetime import datetime, time, timedelta
from pathlib import Path
from typing import Final

from rigd.errors import UserError
from rigd.library._index import LibraryIndex, StampedRow
from rigd.library._row import (
    INCOMPLETE_SUFFIX,
    REPORT_FOLDER,
    REPORT_PAGE,
    RESULTS_FILE,
    SESSION_SUFFIX,
    SessionRow,
    read_row,
)
from rigd.session.quick_look import QUICK_LOOK_SUFFIX

_NS_PER_S: Final = 1_000_000_000
"""Number of nanoseconds in a second."""
_DATE_CHARACTERS: Final = len("2026-11-20")
"""Number of characters of a date without a time of day."""


class LibraryError(UserError, ValueError):
    """Error if sessions cannot be listed; the message names folder or filter, and the remedy."""


def list_sessions(
    folder: str | os.PathLike[str],
    *,
    specimen: str | None = None,
    operator: str | None = None,
    excitation: str | None = None,
    outcome: str | None = None,
    since: str | datetime | None = None,
    until: str | datetime | None = None,
    text: str | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> list[SessionRow]:
    """Return the sessions in a folder, the newest first.

    Files that are new or changed, by size and time, are read, and the index of the folder is
    updated if it is writable. Incomplete and third-party files are listed with the reason.
    Subfolders are not searched.

    Parameters
    ----------
    folder
        Folder with the session files.
    specimen, operator, excitation, outcome
        Required values, which are compared regardless of case; None permits any value.
    since, until
        First and last permitted start time in ISO 8601, local unless an offset is given. A date
        without a time as `until` includes the whole day.
    text
        Text that must occur, in any case, in specimen, operator, excitation, note, reason, metadata
        or name.
    on_progress
        Function that is called from time to time with the fraction of new files that have been
        read.

    Returns
    -------
    list of SessionRow
        Rows of the sessions that pass all filters.

    Raises
    ------
    LibraryError
        If the folder does not exist or cannot be read, or a date is invalid.

    Examples
    --------
    >>> from rigd.library import list_sessions
    >>> (row,) = list_sessions(".", excitation="chirp")
    >>> row.id, row.outcome, row.duration_s
    ('session', 'complete', 21.5)
    """
    first_ns, last_ns = _parse_time_ns(since, "since"), _parse_time_ns(until, "until")
    requested_values = {
        "specimen": specimen,
        "operator": operator,
        "excitation": excitation,
        "outcome": outcome,
    }
    required_values = {
        field_name: required_value.strip().casefold()
        for field_name, required_value in requested_values.items()
        if required_value
    }

    def is_requested_row(row: SessionRow) -> bool:
        if any(
            getattr(row, field_name).casefold() != required_value
            for field_name, required_value in required_values.items()
        ):
            return False
        if first_ns is not None and (row.start_utc_ns is None or row.start_utc_ns < first_ns):
            return False
        if last_ns is not None and (row.start_utc_ns is None or row.start_utc_ns > last_ns):
            return False
        return not text or text.casefold() in _searchable_text(row)

    matching_rows = [row for row in _read_rows(Path(folder), on_progress) if is_requested_row(row)]
    return sorted(matching_rows, key=lambda row: (row.start_utc_ns or 0, row.id), reverse=True)


def _searchable_text(row: SessionRow) -> str:
    """Return the texts of a row in which `list_sessions` searches, joined and case-folded."""
    row_texts = (row.id, row.specimen, row.operator, row.excitation, row.note, row.reason)
    user_metadata = (f"{entry_name}={entry_value}" for entry_name, entry_value in row.meta.items())
    return "\n".join((*row_texts, *user_metadata)).casefold()


def _parse_time_ns(given_time: str | datetime | None, argument_name: str) -> int | None:
    """Return a time in ns since 1970, or None if no time is given.

    A date without a time of day means the end of the day for the argument ``until``, else its
    start.
    """
    if given_time is None or given_time == "":
        return None
    try:
        parsed_time = (
            given_time
            if isinstance(given_time, datetime)
            else datetime.fromisoformat(given_time.strip())
        )
        if (
            argument_name == "until"
            and not isinstance(given_time, datetime)
            and _is_date_only(given_time)
        ):
            parsed_time = datetime.combine(parsed_time, time()) + timedelta(days=1, microseconds=-1)
        # Without an offset it is local time.
        return int(parsed_time.timestamp()) * _NS_PER_S + parsed_time.microsecond * 1000
    except (ValueError, OverflowError, OSError):
        raise LibraryError(
            f"{argument_name} = {str(given_time)[:40]!r} is not a date; write 2026-11-20 or "
            "2026-11-20T14:30."
        ) from None


def _is_date_only(text: str) -> bool:
    """Return whether a text is a date without a time of day, by its length."""
    return len(text.strip()) <= _DATE_CHARACTERS


# Files


class _SessionFiles:
    """Session file in a folder, with its quick look and its last report."""

    def __init__(self, folder_entry: os.DirEntry[str]) -> None:
        self.path = Path(folder_entry.path)
        self.stamp = _size_and_time_stamp(folder_entry.path)
        self.quick_look: Path | None = None
        self.report: Path | None = None

    def add_results(self, quick_look_path: Path | None, report_folder: Path | None) -> None:
        """Add the paths of quick look and report, and append their sizes and times to the stamp."""
        self.quick_look, self.report = quick_look_path, report_folder
        if quick_look_path is not None:
            self.stamp += f" look {_size_and_time_stamp(quick_look_path)}"
        if report_folder is not None:
            self.stamp += (
                f" {report_folder.name} {_size_and_time_stamp(report_folder / RESULTS_FILE)}"
                f" {_size_and_time_stamp(report_folder / REPORT_PAGE)}"
            )


def _read_rows(folder: Path, on_progress: Callable[[float], None] | None) -> list[SessionRow]:
    """Return the rows of a folder's sessions from its index, or from files that are new or changed.

    The index is updated.
    """
    session_files = _find_session_files(folder)
    folder_index = LibraryIndex(folder)
    indexed_rows = folder_index.read()
    all_rows: list[SessionRow] = []
    new_rows: dict[str, StampedRow] = {}
    files_to_read = []
    for file_name, files_of_session in session_files.items():
        file_stamp, row = indexed_rows.get(file_name, ("", None))
        # The stamp does not show whether an incomplete file is being recorded.
        if (
            row is not None
            and file_stamp == files_of_session.stamp
            and not file_name.endswith(INCOMPLETE_SUFFIX)
        ):
            all_rows.append(row)
        else:
            files_to_read.append(file_name)
    for file_number, file_name in enumerate(files_to_read, start=1):
        files_of_session = session_files[file_name]
        try:
            row, is_storable = read_row(
                files_of_session.path, files_of_session.quick_look, files_of_session.report
            )
        except OSError:  # the file was removed or received its final name
            continue
        all_rows.append(row)
        if is_storable and not file_name.endswith(INCOMPLETE_SUFFIX):
            new_rows[file_name] = files_of_session.stamp, row
        if on_progress is not None:
            on_progress(file_number / len(files_to_read))
    missing_files = indexed_rows.keys() - session_files.keys()
    if new_rows or missing_files:
        folder_index.write(new_rows, missing_files)
    return all_rows


def _find_session_files(folder: Path) -> dict[str, _SessionFiles]:
    """Return the session files of a folder by name, with their quick looks and last reports.

    It raises LibraryError if the path is not a folder or the folder cannot be read.
    """
    session_files: dict[str, _SessionFiles] = {}
    quick_looks_by_session: dict[str, Path] = {}
    reports_by_session: dict[str, tuple[int, Path]] = {}
    try:
        with os.scandir(folder) as folder_entries:
            for folder_entry in folder_entries:
                file_name = folder_entry.name
                if file_name.endswith((SESSION_SUFFIX, INCOMPLETE_SUFFIX)):
                    session_files[file_name] = _SessionFiles(folder_entry)
                elif file_name.endswith(QUICK_LOOK_SUFFIX):
                    quick_looks_by_session[file_name.removesuffix(QUICK_LOOK_SUFFIX)] = Path(
                        folder_entry.path
                    )
                elif match := REPORT_FOLDER.fullmatch(file_name):
                    report_number = int((match[2] or "1")[:9])
                    if report_number >= reports_by_session.get(match[1], (0, None))[0]:
                        reports_by_session[match[1]] = report_number, Path(folder_entry.path)
    except OSError as error:
        raise LibraryError(
            f"{folder}: the folder cannot be listed ({error.strerror}); give a folder of session "
            "files."
        ) from None
    for file_name, files_of_session in session_files.items():
        if file_name.endswith(SESSION_SUFFIX):
            session_name = file_name.removesuffix(SESSION_SUFFIX)
            files_of_session.add_results(
                quick_looks_by_session.get(session_name),
                reports_by_session.get(session_name, (0, None))[1],
            )
    return session_files


def _size_and_time_stamp(path: str | os.PathLike[str]) -> str:
    """Return size and modification time of a file as text; empty if they cannot be read."""
    try:
        file_status = Path(path).stat()
    except OSError:
        return ""
    return f"{file_status.st_size} {file_status.st_mtime_ns}"
