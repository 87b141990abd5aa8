"""Sessions of a folder: search, comparison with the index, reading of new files, and filters."""

import os
from collections.abc import Callable
from datetime import datetime, time, timedelta
from pathlib import Path
from typing import Final

from rigd.errors import UserError
from rigd.library._index import Index, Stamped
from rigd.library._row import (
    NUMBERS,
    REPORT_FOLDER,
    REPORT_PAGE,
    SUFFIX,
    TORN_SUFFIX,
    SessionRow,
    read_row,
)
from rigd.session.quick_look import QUICK_LOOK_SUFFIX

_NS_PER_S: Final = 1_000_000_000
_DATE_CHARACTERS: Final = len("2026-11-20")


class LibraryError(UserError, ValueError):
    """Sessions cannot be listed; the message names the folder or filter, and the remedy."""


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
    """List the sessions of a folder, the newest first.

    New or changed files, by size and time, are read, and the index of the folder is updated if it
    is writable. Incomplete and third-party files are listed with the reason. Subfolders are not
    searched.

    Parameters
    ----------
    folder
        Folder of the session files.
    specimen, operator, excitation, outcome
        Required values, case-insensitive; None for any.
    since, until
        First and last permitted start time, in ISO 8601, local unless an offset is given. A date
        alone as `until` includes its day.
    text
        Text that any of specimen, operator, excitation, note, reason, metadata or name must
        contain, case-insensitive.
    on_progress
        Called from time to time with the fraction of new files that have been read.

    Returns
    -------
    list of SessionRow

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
    begins, ends = _moment_ns(since, "since"), _moment_ns(until, "until")
    exactly = {
        "specimen": specimen,
        "operator": operator,
        "excitation": excitation,
        "outcome": outcome,
    }
    wanted = {name: value.strip().casefold() for name, value in exactly.items() if value}

    def fits(row: SessionRow) -> bool:
        if any(getattr(row, name).casefold() != value for name, value in wanted.items()):
            return False
        if begins is not None and (row.start_utc_ns is None or row.start_utc_ns < begins):
            return False
        if ends is not None and (row.start_utc_ns is None or row.start_utc_ns > ends):
            return False
        return not text or text.casefold() in _searched(row)

    rows = [row for row in _rows(Path(folder), on_progress) if fits(row)]
    return sorted(rows, key=lambda row: (row.start_utc_ns or 0, row.id), reverse=True)


def _searched(row: SessionRow) -> str:
    texts = (row.id, row.specimen, row.operator, row.excitation, row.note, row.reason)
    added = (f"{name}={value}" for name, value in row.meta.items())
    return "\n".join((*texts, *added)).casefold()


def _moment_ns(given: str | datetime | None, name: str) -> int | None:
    """Return a time in ns since the epoch; for a date alone, the start or end of its day."""
    if given is None or given == "":
        return None
    try:
        moment = given if isinstance(given, datetime) else datetime.fromisoformat(given.strip())
        if name == "until" and not isinstance(given, datetime) and _is_date(given):
            moment = datetime.combine(moment, time()) + timedelta(days=1, microseconds=-1)
        # Without an offset it is local time.
        return int(moment.timestamp()) * _NS_PER_S + moment.microsecond * 1000
    except (ValueError, OverflowError, OSError):
        raise LibraryError(
            f"{name} = {str(given)[:40]!r} is not a date; write 2026-11-20 or 2026-11-20T14:30."
        ) from None


def _is_date(given: str) -> bool:
    return len(given.strip()) <= _DATE_CHARACTERS


# Files


class _Found:
    """Session file of a folder, with its quick look and report."""

    def __init__(self, entry: os.DirEntry[str]) -> None:
        self.path = Path(entry.path)
        self.stamp = _stamp_of(entry.path)
        self.quick_look: Path | None = None
        self.report: Path | None = None

    def with_results(self, quick_look: Path | None, report: Path | None) -> None:
        """Add quick look and report, and append their stamps to the stamp of the file."""
        self.quick_look, self.report = quick_look, report
        if quick_look is not None:
            self.stamp += f" look {_stamp_of(quick_look)}"
        if report is not None:
            self.stamp += (
                f" {report.name} {_stamp_of(report / NUMBERS)} {_stamp_of(report / REPORT_PAGE)}"
            )


def _rows(folder: Path, on_progress: Callable[[float], None] | None) -> list[SessionRow]:
    found = _scan(folder)
    index = Index(folder)
    known = index.read()
    rows: list[SessionRow] = []
    fresh: dict[str, Stamped] = {}
    unread = []
    for name, file in found.items():
        stamp, row = known.get(name, ("", None))
        # The stamp does not show whether an incomplete file is being recorded.
        if row is not None and stamp == file.stamp and not name.endswith(TORN_SUFFIX):
            rows.append(row)
        else:
            unread.append(name)
    for number, name in enumerate(unread, start=1):
        file = found[name]
        try:
            row, holds = read_row(file.path, file.quick_look, file.report)
        except OSError:  # the file was removed or received its final name
            continue
        rows.append(row)
        if holds and not name.endswith(TORN_SUFFIX):
            fresh[name] = file.stamp, row
        if on_progress is not None:
            on_progress(number / len(unread))
    gone = known.keys() - found.keys()
    if fresh or gone:
        index.write(fresh, gone)
    return rows


def _scan(folder: Path) -> dict[str, _Found]:
    """Return the session files of a folder by name, with quick look and last report.

    Raises
    ------
    LibraryError
        If it is not a folder, or cannot be read.
    """
    found: dict[str, _Found] = {}
    quick_looks: dict[str, Path] = {}
    reports: dict[str, tuple[int, Path]] = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                name = entry.name
                if name.endswith((SUFFIX, TORN_SUFFIX)):
                    found[name] = _Found(entry)
                elif name.endswith(QUICK_LOOK_SUFFIX):
                    quick_looks[name.removesuffix(QUICK_LOOK_SUFFIX)] = Path(entry.path)
                elif match := REPORT_FOLDER.fullmatch(name):
                    number = int((match[2] or "1")[:9])
                    if number >= reports.get(match[1], (0, None))[0]:
                        reports[match[1]] = number, Path(entry.path)
    except OSError as error:
        raise LibraryError(
            f"{folder}: the folder cannot be listed ({error.strerror}); give a folder of session "
            "files."
        ) from None
    for name, file in found.items():
        if name.endswith(SUFFIX):
            stem = name.removesuffix(SUFFIX)
            file.with_results(quick_looks.get(stem), reports.get(stem, (0, None))[1])
    return found


def _stamp_of(path: str | os.PathLike[str]) -> str:
    """Return size and time of a file; empty if they are not known."""
    try:
        status = Path(path).stat()
    except OSError:
        return ""
    return f"{status.st_size} {status.st_mtime_ns}"
