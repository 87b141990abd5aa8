"""Index of a folder of sessions: an SQLite file in the folder with one row per session.

The index is a cache. Each row contains the sizes and times of its source files as a stamp, and is
rebuilt if the files no longer match the stamp. An index that cannot be read or written is ignored.
Several programs may use it at the same time: each writes in one transaction, and the stamps reveal
rows that another program overwrote or removed.
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

_APPLICATION_ID: Final = 0x72696764  # "rigd"
"""SQLite's application ID, by which the index is recognised: "rigd" in ASCII."""
_INDEX_VERSION: Final = 3
"""Version of the table's columns and content. Indexes of other versions are rebuilt."""
_SQLITE_FIRST_BYTES: Final = b"SQLite format 3\0"
"""First bytes of every SQLite file."""
_APPLICATION_ID_POSITION: Final = slice(68, 72)
"""Position of the application ID in an SQLite file."""
_MAX_LOCK_WAIT_S: Final = 2.0
"""Longest wait in seconds for another program that is writing the index."""

_DAMAGE_ERROR_CODES: Final = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
"""SQLite's error codes for a damaged index."""

_SQL_TYPES_BY_COLUMN: Final = {
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
"""SQL type of each column except ``file`` and ``stamp``.

Modes, validity and meta are JSON; ``start_utc`` is in ISO 8601."""
_PYTHON_TYPES_BY_SQL_TYPE: Final = {"TEXT": str, "INTEGER": int | None, "REAL": float | None}
"""Python type that a value read from a column must have, by the SQL type of the column."""
_COLUMNS_TO_READ: Final = tuple(name for name in _SQL_TYPES_BY_COLUMN if name != "start_utc")
"""Columns that are read from the index: all but the start time as text, which is for other
programs."""

StampedRow = tuple[str, SessionRow]
"""Stamp of a row (sizes and times of its source files), and the row."""


class LibraryIndex:
    """Index file with the data of the sessions in one folder (SQLite).

    The folder need not have an index or be writable.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / INDEX_NAME

    def read(self) -> dict[str, StampedRow]:
        """Return the rows of the index by file name, each with its stamp.

        The dictionary is empty if there is no valid index.
        """
        if not self._is_own_index():
            return {}
        indexed_rows: dict[str, StampedRow] = {}
        try:
            with self._open_database("ro") as database:
                if database.execute("PRAGMA user_version").fetchone() != (_INDEX_VERSION,):
                    return {}
                column_list = ", ".join(("file", "stamp", *_COLUMNS_TO_READ))
                for file_name, stamp, *column_values in database.execute(
                    f"SELECT {column_list} FROM sessions"
                ):
                    with contextlib.suppress(ValueError, TypeError):  # the row is rebuilt
                        indexed_rows[file_name] = (
                            stamp,
                            self._row_from_values(
                                file_name, dict(zip(_COLUMNS_TO_READ, column_values, strict=True))
                            ),
                        )
        except sqlite3.Error:  # locked for long, or damaged
            return {}
        return indexed_rows

    def write(self, new_rows: Mapping[str, StampedRow], missing_files: Collection[str]) -> None:
        """Store new rows in the index and remove rows of missing files, if the index is writable.

        New and changed rows are given by file name.
        """
        if self._path.exists() and not self._is_own_index():
            return  # the file is not an index of this program
        try:
            self._store_rows(new_rows, missing_files)
        except sqlite3.Error as error:
            if error.sqlite_errorcode & 0xFF not in _DAMAGE_ERROR_CODES:
                return  # a folder that cannot be written to, a full disk, a lock held for long
            with contextlib.suppress(OSError, sqlite3.Error):  # the session files contain all data
                self._path.unlink()
                self._store_rows(new_rows, missing_files)

    def _store_rows(
        self, new_rows: Mapping[str, StampedRow], missing_files: Collection[str]
    ) -> None:
        """Store and remove rows in one transaction, and create the table if necessary."""
        with self._open_database("rwc") as database:
            database.execute("BEGIN IMMEDIATE")
            if database.execute("PRAGMA user_version").fetchone() != (_INDEX_VERSION,):
                column_definitions = ", ".join(
                    f"{column_name} {sql_type}"
                    for column_name, sql_type in _SQL_TYPES_BY_COLUMN.items()
                )
                database.execute("DROP TABLE IF EXISTS sessions")
                database.execute(
                    f"CREATE TABLE sessions (file TEXT PRIMARY KEY, {column_definitions}, stamp "
                    "TEXT)"
                )
                database.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
                database.execute(f"PRAGMA user_version = {_INDEX_VERSION}")
            database.executemany(
                "DELETE FROM sessions WHERE file = ?",
                [(file_name,) for file_name in missing_files if _is_storable_name(file_name)],
            )
            column_names = ("file", "stamp", *_SQL_TYPES_BY_COLUMN)
            placeholders = ", ".join("?" * len(column_names))
            database.executemany(
                f"INSERT OR REPLACE INTO sessions ({', '.join(column_names)}) VALUES "
                f"({placeholders})",
                [
                    (file_name, stamp, *_column_values(row))
                    for file_name, (stamp, row) in new_rows.items()
                    if _is_storable_name(file_name)
                ],
            )
            database.execute("COMMIT")

    @contextmanager
    def _open_database(self, open_mode: str) -> Iterator[sqlite3.Connection]:
        """Provide a connection to the index, without implicit transactions."""
        # Explicit transactions: the implicit ones would commit before a table is created.
        database = sqlite3.connect(
            f"{self._path.absolute().as_uri()}?mode={open_mode}",
            uri=True,
            timeout=_MAX_LOCK_WAIT_S,
            isolation_level=None,
        )
        try:
            yield database
        finally:
            database.close()

    def _is_own_index(self) -> bool:
        """Return whether the index file was written by this program or is empty."""
        try:
            with self._path.open("rb") as index_file:
                first_bytes = index_file.read(_APPLICATION_ID_POSITION.stop)
        except OSError:
            return False
        application_id = _APPLICATION_ID.to_bytes(4, "big")
        return not first_bytes or (
            first_bytes.startswith(_SQLITE_FIRST_BYTES)
            and first_bytes[_APPLICATION_ID_POSITION] == application_id
        )

    def _row_from_values(self, file_name: str, column_values: dict[str, object]) -> SessionRow:
        """Return the session row with the given column values.

        It raises ValueError or TypeError if a value is invalid.
        """
        report_name = column_values["report"]
        for column_name, column_value in column_values.items():
            if column_name != "report" and not isinstance(
                column_value, _PYTHON_TYPES_BY_SQL_TYPE[_SQL_TYPES_BY_COLUMN[column_name]]
            ):
                raise TypeError(column_name)
        column_values["modes"] = usable_modes(json.loads(str(column_values["modes"])))
        validity_document = json.loads(str(column_values["validity"]))
        column_values["validity"] = (
            None
            if validity_document is None
            else Validity.from_document(validity_document).as_json()
        )
        column_values["meta"] = dict(json.loads(str(column_values["meta"])))
        column_values["report"] = None if report_name is None else self._folder / str(report_name)
        return SessionRow(path=self._folder / file_name, **column_values)  # type: ignore[arg-type]


def _column_values(row: SessionRow) -> list[object]:
    """Return a row's values in the order of the index's columns."""
    values_by_name: dict[str, object] = {
        row_field.name: getattr(row, row_field.name) for row_field in fields(row)
    }
    values_by_name["start_utc"] = None if row.start_utc_ns is None else _iso_time(row.start_utc_ns)
    values_by_name["modes"] = json.dumps(row.mode_documents())
    values_by_name["validity"] = json.dumps(row.validity)
    values_by_name["meta"] = json.dumps(row.meta)
    values_by_name["report"] = row.report and os.fspath(row.report.relative_to(row.path.parent))
    return [values_by_name[name] for name in _SQL_TYPES_BY_COLUMN]


def _iso_time(utc_ns: int) -> str | None:
    """Return a time in ns since 1970 as UTC in ISO 8601; None if it is beyond the calendar."""
    try:
        utc_time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)
    except OverflowError:
        return None
    return utc_time.isoformat(timespec="milliseconds")


def _is_storable_name(file_name: str) -> bool:
    """Return whether a file name is valid text. Files with other names are read each time."""
    try:
        file_name.encode()
    except UnicodeEncodeError:
        return False
    return True
