"""Row of one session in the library: data from its session file, quick look and report."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import isfinite
from pathlib import Path
from typing import Any, Final

from rigd.estimates import ReportedMode, modes_from_json
from rigd.printable import printable
from rigd.runtime import read_plain_file
from rigd.session import Validity
from rigd.session.quick_look import read_quick_look

SESSION_SUFFIX: Final = ".mcap"
"""File name suffix of a session file."""
INCOMPLETE_SUFFIX: Final = ".mcap.part"
"""File name suffix of a session file that is being recorded or is incomplete."""
REPORT_FOLDER: Final = re.compile(r"(.+)\.report(?:-(\d+))?")
"""Pattern of the name of a report folder; its groups are session name and report number."""
REPORT_PAGE: Final = "report.html"
"""Name of the HTML page in a report folder."""
RESULTS_FILE: Final = "analysis.json"
"""Name of the file with the results in JSON in a report folder."""

_MAX_JSON_BYTES: Final = 8 << 20
"""Largest size of a JSON file that is read."""
_MAX_TEXT_CHARACTERS: Final = 1000
"""Largest number of characters of a text; longer ones are cut."""
_MAX_META_ENTRIES: Final = 100
"""Largest number of users' metadata entries that a row contains."""
_MAX_COUNT_DIGITS: Final = 18
"""Largest number of digits with which every number is below 2**63."""

JsonObject = dict[str, Any]
"""JSON object."""


@dataclass(frozen=True, slots=True)
class SessionRow:
    """Data of one session in a folder, from the session file and the files of its results.

    Unknown values are empty texts or None. Texts are printable and cut to 1000 characters.
    """

    id: str
    """Name of the session file without ``.mcap`` or, if it is incomplete, without ``.mcap.part``.
    """
    path: Path
    """Path of the session file."""
    size_bytes: int
    """Size of the session file in bytes."""
    start_utc_ns: int | None = None
    """Time of tick 0 by the computer's clock, in ns since 1970 (UTC)."""
    profile: str = ""
    """Name of the rig's profile."""
    specimen: str = ""
    """Name of the specimen."""
    operator: str = ""
    """Name of the operator."""
    excitation: str = ""
    """Name of the excitation, such as ``chirp``."""
    note: str = ""
    """Note of the operator."""
    outcome: str = "unknown"
    """``complete``, ``stopped`` or ``fault``, or ``unknown`` if the file does not state which;
    ``recording`` or ``incomplete`` if the file has no end; ``unreadable`` if it cannot be read."""
    reason: str = ""
    """Reason why the session ended early or failed."""
    duration_s: float | None = None
    """Duration of the record in seconds."""
    scheduled: int | None = None
    """Number of ticks that were scheduled."""
    recorded: int | None = None
    """Number of samples in the file."""
    missed: int | None = None
    """Number of ticks that the loop skipped."""
    late: int | None = None
    """Number of ticks with a late wake-up."""
    lost: int | None = None
    """Number of samples that were measured but not recorded."""
    modes: tuple[ReportedMode, ...] = ()
    """Modes of the last report or, if there is no report, of the quick look."""
    validity: JsonObject | None = None
    """Validity of the linear model for the modes, as `rigd.session.Validity.as_json`; None if there
    are no modes."""
    report: Path | None = None
    """Path of the HTML page of the last report; None if there is no report."""
    meta: dict[str, float | str] = field(default_factory=dict)
    """Metadata that users added, by name."""
    problem: str = ""
    """Problem of the file and its remedy; empty if there is none."""

    def as_dict(self) -> dict[str, Any]:
        """Return the row as a dictionary for JSON."""
        document = {row_field.name: getattr(self, row_field.name) for row_field in fields(self)}
        report_path = None if self.report is None else str(self.report)
        return document | {
            "path": str(self.path),
            "report": report_path,
            "modes": self.mode_documents(),
        }

    def mode_documents(self) -> list[JsonObject]:
        """Return the modes as JSON objects, without their numbers."""
        documents = [mode.as_json() for mode in self.modes]
        return [
            {key: value for key, value in document.items() if key not in ("mode", "shown")}
            for document in documents
        ]


def read_row(
    path: Path, quick_look_path: Path | None, report_folder: Path | None
) -> tuple[SessionRow, bool]:
    """Return the data of a session, and whether they can be stored in the index.

    A file that cannot be read is reported in the row. After a system error, which may be temporary,
    the index must not store the row. `quick_look_path` is the file with the session's quick look,
    and `report_folder` the folder of its last report; None if there is none. Raise
    `FileNotFoundError` if the session file no longer exists.
    """
    from rigd.session import SessionAccessError, SessionError, read_summary
    from rigd.session.user_metadata import added_metadata

    try:
        file_bytes = path.stat().st_size
    except OSError:
        path.lstat()  # raises if no such name exists, unlike for a link to a disk that is absent
        file_bytes = 0
    session_id = path.name.removesuffix(INCOMPLETE_SUFFIX).removesuffix(SESSION_SUFFIX)
    modes_and_validity: dict[str, Any] = _read_modes_and_validity(quick_look_path, report_folder)
    if report_folder is not None and (report_folder / REPORT_PAGE).is_file():
        modes_and_validity["report"] = report_folder / REPORT_PAGE
    try:
        file_summary = read_summary(path)
    except SessionError as error:
        path.lstat()  # raises if the file no longer exists
        row = SessionRow(
            session_id,
            path,
            file_bytes,
            outcome="unreadable",
            problem=printable(str(error)),
            **modes_and_validity,
        )
        return row, not isinstance(error, SessionAccessError)
    file_metadata, outcome_document = file_summary.metadata, file_summary.outcome or {}
    outcome_text = _text_of_key(outcome_document, "outcome") or "unknown"
    if file_summary.is_recording:
        outcome_text = "recording"
    elif file_summary.problem:
        outcome_text = "incomplete"
    scheduled_ticks = _count_of_key(outcome_document, "scheduled")
    tick_count = file_summary.samples if scheduled_ticks is None else scheduled_ticks
    rate_hz = _number_of_key(file_metadata, "rate_hz") or 0.0
    user_metadata = list(added_metadata(file_metadata).items())[:_MAX_META_ENTRIES]
    row = SessionRow(
        id=session_id,
        path=path,
        size_bytes=file_bytes,
        start_utc_ns=_count_of_key(file_metadata, "start_utc_ns"),
        profile=_text_of_key(file_metadata, "profile"),
        specimen=_text_of_key(file_metadata, "specimen"),
        operator=_text_of_key(file_metadata, "operator"),
        excitation=_text_of_key(file_metadata, "excitation"),
        note=_text_of_key(file_metadata, "note"),
        outcome=outcome_text,
        reason=_text_of_key(outcome_document, "reason"),
        duration_s=_finite_or_none(tick_count / rate_hz)
        if tick_count is not None and rate_hz > 0
        else None,
        scheduled=scheduled_ticks,
        recorded=file_summary.samples,
        missed=_count_of_key(outcome_document, "missed"),
        late=_count_of_key(outcome_document, "late"),
        lost=_count_of_key(outcome_document, "lost"),
        meta={
            _printable_cut_text(entry_name): _printable_cut_text(entry_value)
            if isinstance(entry_value, str)
            else entry_value
            for entry_name, entry_value in user_metadata
        },
        problem=file_summary.problem,
        **modes_and_validity,
    )
    return row, True


def _printable_cut_text(text: str) -> str:
    """Return a printable text of at most 1000 characters."""
    return printable(text, _MAX_TEXT_CHARACTERS)


def _text_of_key(key_texts: Mapping[str, str], key: str) -> str:
    """Return the text of a key, cut to 1000 characters; empty if there is none."""
    return _printable_cut_text(key_texts.get(key, "").strip())


def _count_of_key(key_texts: Mapping[str, str], key: str) -> int | None:
    """Return the count that a key states; None if it states no integer from 0 to 2**63 - 1."""
    count_text = key_texts.get(key, "")
    # More digits are not a count and exceed 64 bits.
    is_count_text = (
        count_text.isascii() and count_text.isdigit() and len(count_text) <= _MAX_COUNT_DIGITS + 1
    )
    return int(count_text) if is_count_text and int(count_text) < 2**63 else None


def _number_of_key(key_texts: Mapping[str, str], key: str) -> float | None:
    """Return the number that a key states; None if it is not a finite number."""
    try:
        number = float(key_texts.get(key, "")[:400])
    except ValueError:
        return None
    return number if isfinite(number) else None


# Modes


def _read_modes_and_validity(
    quick_look_path: Path | None, report_folder: Path | None
) -> JsonObject:
    """Return the fields `modes` and `validity` of a row from a session's results.

    The report has priority over the quick look. If there are no results, the dictionary is empty.
    """
    if report_folder is not None:
        for headline_document in _list_in_document(
            _read_json(report_folder / RESULTS_FILE), "headlines"
        ):
            if modes := usable_modes(_list_in_document(headline_document, "modes")):
                return _modes_and_validity(modes, headline_document)
    quick_look_document = None if quick_look_path is None else read_quick_look(quick_look_path)
    return (
        {}
        if quick_look_document is None
        else _modes_and_validity(usable_modes(quick_look_document["modes"]), quick_look_document)
    )


def _modes_and_validity(modes: tuple[ReportedMode, ...], document: object) -> JsonObject:
    """Return the fields `modes` and `validity` of a row from modes and a document of results.

    The dictionary is empty if there are no modes.
    """
    if not modes:
        return {}
    validity_document = document.get("validity") if isinstance(document, dict) else None
    return {"modes": modes, "validity": Validity.from_document(validity_document).as_json()}


def _read_json(path: Path) -> object:
    """Return the content of a JSON file; None if it cannot be read."""
    try:
        return json.loads(read_plain_file(path, _MAX_JSON_BYTES))
    except (OSError, ValueError, RecursionError):  # the session is listed without this result
        return None


def _list_in_document(document: object, key: str) -> list[object]:
    """Return the list at a key of a JSON document; an empty list if there is none."""
    key_value = document.get(key) if isinstance(document, dict) else None
    return key_value if isinstance(key_value, list) else []


def usable_modes(mode_list: object) -> tuple[ReportedMode, ...]:
    """Return the modes of a JSON list that the record shows; invalid entries are left out."""
    return tuple(mode for mode in modes_from_json(mode_list) if mode.shown)


def _finite_or_none(number: float) -> float | None:
    """Return a number, or None if it is not finite."""
    return number if isfinite(number) else None
