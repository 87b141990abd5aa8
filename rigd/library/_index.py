"""Index of a folder of sessions: an SQLite file in the folder with one row per session.

The index is a cache. Each row has the stamp of its source files, and is rebuilt when the stamp
differs. An index that cannot be read or written is ignored. Several programs may use it at the same
time: each writes in one transaction, and the stamps reveal rows that another program overwrote or
removed.
"""

import contextlib
import json
import os
import sqlite3
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from rigd.library._row import SessionRow, usable_modes
from rigd.session import Validity

INDEX_NAME: Final = "library.sqlite"
"""File name of the index."""

_APPLICATION: Final = 0x72696764  # "rigd"
_VERSION: Final = 3
"""Version of the table and of the content of a row; older indexes are rebuilt."""
_HEADER: Final = b"SQLite format 3\0"
_APPLICATION_OFFSET: Final = slice(68, 72)
_PATIENCE_S: Final = 2.0
"""Longest wait for another writing program."""

_DAMAGED: Final = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
"""Error codes of an invalid index."""

_TYPES: Final = {
    "id": "TEXT",
    "start_utc": "TEXT",
    "start_utc_ns": "INTEGER",
    "profile": "TEXT",
    "specimen": "TEXT",
    "operator": "TEXT",
    "excitation": "TEXT",
    "note": "TEXT",
    "outcome": "TEXT",
    "reason": "TEXT",
    "duration_s": "REAL",
    "scheduled": "INTEGER",
    "recorded": "INTEGER",
    "missed": "INTEGER",
    "late": "INTEGER",
    "lost": "INTEGER",
    "size_bytes": "INTEGER",
    "modes": "TEXT",
    "validity": "TEXT",
    "report": "TEXT",
    "meta": "TEXT",
    "problem": "TEXT",
}
"""Columns in addition to ``file`` and ``stamp``. Modes, validity and meta are JSON; times are UTC
in ISO 8601."""
_KINDS: Final = {"TEXT": str, "INTEGER": int | None, "REAL": float | None}
_READ: Final = tuple(name for name in _TYPES if name != "start_utc")

Stamped = tuple[str, SessionRow]
"""A row and the stamp of its source files."""


class Index:
    """Index of one folder.

    Parameters
    ----------
    folder
        Folder of the sessions; the index may be there or not, and need not be writable.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / INDEX_NAME

    def read(self) -> dict[str, Stamped]:
        """Return the rows by file name; empty without a valid index."""
        if not self._is_ours():
            return {}
        rows: dict[str, Stamped] = {}
        try:
            with self._connected("ro") as database:
                if database.execute("PRAGMA user_version").fetchone() != (_VERSION,):
                    return {}
                columns = ", ".join(("file", "stamp", *_READ))
                for file, stamp, *values in database.execute(f"SELECT {columns} FROM sessions"):
                    with contextlib.suppress(ValueError, TypeError):  # the row is rebuilt
                        rows[file] = stamp, self._row(file, dict(zip(_READ, values, strict=True)))
        except sqlite3.Error:  # locked for long, or damaged
            return {}
        return rows

    def write(self, rows: Mapping[str, Stamped], gone: Collection[str]) -> None:
        """Store rows by file name and remove those of missing files, if possible.

        Parameters
        ----------
        rows
            New rows, and those that have changed.
        gone
            Names of files that are not there any more.
        """
        if self._path.exists() and not self._is_ours():
            return  # the file is not an index of this program
        try:
            self._store(rows, gone)
        except sqlite3.Error as error:
            if error.sqlite_errorcode & 0xFF not in _DAMAGED:
                return  # a folder that cannot be written to, a full disk, a lock held for long
            with contextlib.suppress(OSError, sqlite3.Error):  # the files have everything
                self._path.unlink()
                self._store(rows, gone)

    def _store(self, rows: Mapping[str, Stamped], gone: Collection[str]) -> None:
        with self._connected("rwc") as database:
            database.execute("BEGIN IMMEDIATE")
            if database.execute("PRAGMA user_version").fetchone() != (_VERSION,):
                columns = ", ".join(f"{name} {kind}" for name, kind in _TYPES.items())
                database.execute("DROP TABLE IF EXISTS sessions")
                database.execute(
                    f"CREATE TABLE sessions (file TEXT PRIMARY KEY, {columns}, stamp TEXT)"
                )
                database.execute(f"PRAGMA application_id = {_APPLICATION}")
                database.execute(f"PRAGMA user_version = {_VERSION}")
            database.executemany(
                "DELETE FROM sessions WHERE file = ?", [(file,) for file in gone if _storable(file)]
            )
            names = ("file", "stamp", *_TYPES)
            marks = ", ".join("?" * len(names))
            database.executemany(
                f"INSERT OR REPLACE INTO sessions ({', '.join(names)}) VALUES ({marks})",
                [
                    (file, stamp, *_values(row))
                    for file, (stamp, row) in rows.items()
                    if _storable(file)
                ],
            )
            database.execute("COMMIT")

    @contextmanager
    def _connected(self, mode: str) -> Iterator[sqlite3.Connection]:
        # Explicit transactions: the implicit ones would commit before a table is created.
        database = sqlite3.connect(
            f"{self._path.absolute().as_uri()}?mode={mode}",
            uri=True,
            timeout=_PATIENCE_S,
            isolation_level=None,
        )
        try:
            yield database
        finally:
            database.close()

    def _is_ours(self) -> bool:
        """Return whether the file is an index of this program, or empty."""
        try:
            with self._path.open("rb") as file:
                head = file.read(_APPLICATION_OFFSET.stop)
        except OSError:
            return False
        mark = _APPLICATION.to_bytes(4, "big")
        return not head or (head.startswith(_HEADER) and head[_APPLICATION_OFFSET] == mark)

    def _row(self, file: str, values: dict[str, object]) -> SessionRow:
        """Return the row of the columns; raise ValueError or TypeError if they are invalid."""
        report = values["report"]
        for name, value in values.items():
            if name != "report" and not isinstance(value, _KINDS[_TYPES[name]]):
                raise TypeError(name)
        values["modes"] = usable_modes(json.loads(str(values["modes"])))
        stated = json.loads(str(values["validity"]))
        values["validity"] = None if stated is None else Validity.of_document(stated).as_json()
        values["meta"] = dict(json.loads(str(values["meta"])))
        values["report"] = None if report is None else self._folder / str(report)
        return SessionRow(path=self._folder / file, **values)  # type: ignore[arg-type]


def _values(row: SessionRow) -> list[object]:
    values: dict[str, object] = {each.name: getattr(row, each.name) for each in fields(row)}
    values["start_utc"] = None if row.start_utc_ns is None else _iso(row.start_utc_ns)
    values["modes"] = json.dumps(row.modes)
    values["validity"] = json.dumps(row.validity)
    values["meta"] = json.dumps(row.meta)
    values["report"] = row.report and os.fspath(row.report.relative_to(row.path.parent))
    return [values[name] for name in _TYPES]


def _iso(utc_ns: int) -> str | None:
    try:
        moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)
    except OverflowError:
        return None
    return moment.isoformat(timespec="milliseconds")


def _storable(file: str) -> bool:
    """Return whether a name is valid text; other files are read each time."""
    try:
        file.encode()
    except UnicodeEncodeError:
        return False
    return True
