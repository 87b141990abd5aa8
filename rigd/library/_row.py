"""One session of the library: data from its file, its quick look and its report."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import isfinite
from pathlib import Path
from typing import Any, Final

from rigd.printable import printable
from rigd.runtime import read_plain_file
from rigd.session import Validity
from rigd.session.quick_look import modes_of, read_quick_look

SUFFIX: Final = ".mcap"
TORN_SUFFIX: Final = ".mcap.part"
REPORT_FOLDER: Final = re.compile(r"(.+)\.report(?:-(\d+))?")
"""Name of a report folder: session and number of the report."""
REPORT_PAGE: Final = "report.html"
NUMBERS: Final = "analysis.json"

_MOST_JSON_BYTES: Final = 8 << 20
_MOST_CHARACTERS: Final = 1000
_MOST_META: Final = 100
_MOST_DIGITS: Final = 18

Mode = dict[str, Any]
Document = dict[str, Any]


@dataclass(frozen=True, slots=True)
class SessionRow:
    """A session file of a folder, with the data of its session.

    Unknown values are empty texts or None. Texts are printable and truncated to 1000 characters.
    """

    id: str
    """Name of the file without ``.mcap`` or, for an incomplete file, ``.mcap.part``."""
    path: Path
    """The file."""
    size_bytes: int
    """Its size."""
    start_utc_ns: int | None = None
    """Wall clock at tick 0, ns since the Unix epoch."""
    profile: str = ""
    """Name of the rig's profile."""
    specimen: str = ""
    """Name of the specimen."""
    operator: str = ""
    """Operator."""
    excitation: str = ""
    """Kind of the excitation."""
    note: str = ""
    """Note."""
    outcome: str = "unknown"
    """``complete``, ``stopped`` or ``fault``; ``unknown`` if the file does not state it;
    ``recording`` or ``incomplete`` for a file without an end; ``unreadable``."""
    reason: str = ""
    """Why the session ended early, or failed."""
    duration_s: float | None = None
    """Length of the record."""
    scheduled: int | None = None
    """Ticks that were due."""
    recorded: int | None = None
    """Samples in the file."""
    missed: int | None = None
    """Ticks that the loop skipped."""
    late: int | None = None
    """Ticks that woke late."""
    lost: int | None = None
    """Samples that were taken but not recorded."""
    modes: tuple[Mode, ...] = ()
    """Modes of the last report, or else of the quick look: objects ``frequency_hz`` and
    ``damping_ratio`` and ``participation`` (or None), each with ``value``, ``std``, ``interval_95``
    and ``flag``, and ``source``."""
    validity: Document | None = None
    """Validity of the linear model for the modes, as `rigd.session.Validity.as_json`; None without
    modes."""
    report: Path | None = None
    """HTML page of the last report."""
    meta: dict[str, float | str] = field(default_factory=dict)
    """Metadata that users added, by name."""
    problem: str = ""
    """Problem of the file and its remedy; else empty."""

    def as_dict(self) -> dict[str, Any]:
        """Return the row for JSON."""
        document = {each.name: getattr(self, each.name) for each in fields(self)}
        report = None if self.report is None else str(self.report)
        return document | {"path": str(self.path), "report": report, "modes": list(self.modes)}


def read_row(path: Path, quick_look: Path | None, report: Path | None) -> tuple[SessionRow, bool]:
    """Return the row of a session; unreadable parts are reported in the row.

    Parameters
    ----------
    path
        Session file.
    quick_look
        File of its quick look, if there is one.
    report
        Folder of its last report, if there is one.

    Returns
    -------
    SessionRow
        The row.
    bool
        Whether the row is valid until the files change; False after a system error.

    Raises
    ------
    FileNotFoundError
        If the file no longer exists.
    """
    from rigd.session import SessionAccessError, SessionError, read_summary
    from rigd.session.user_metadata import added_metadata

    size = path.stat().st_size
    name = path.name.removesuffix(TORN_SUFFIX).removesuffix(SUFFIX)
    results: dict[str, Any] = _modes(quick_look, report)
    if report is not None and (report / REPORT_PAGE).is_file():
        results["report"] = report / REPORT_PAGE
    try:
        summary = read_summary(path)
    except SessionError as error:
        path.stat()  # raises if the file no longer exists
        row = SessionRow(
            name, path, size, outcome="unreadable", problem=printable(str(error)), **results
        )
        return row, not isinstance(error, SessionAccessError)
    metadata, outcome = summary.metadata, summary.outcome or {}
    ended = _text(outcome, "outcome") or "unknown"
    if summary.recording:
        ended = "recording"
    elif summary.problem:
        ended = "incomplete"
    scheduled = _count(outcome, "scheduled")
    ticks = summary.samples if scheduled is None else scheduled
    rate_hz = _number(metadata, "rate_hz") or 0.0
    added = list(added_metadata(metadata).items())[:_MOST_META]
    row = SessionRow(
        id=name,
        path=path,
        size_bytes=size,
        start_utc_ns=_count(metadata, "start_utc_ns"),
        profile=_text(metadata, "profile"),
        specimen=_text(metadata, "specimen"),
        operator=_text(metadata, "operator"),
        excitation=_text(metadata, "excitation"),
        note=_text(metadata, "note"),
        outcome=ended,
        reason=_text(outcome, "reason"),
        duration_s=_finite(ticks / rate_hz) if ticks is not None and rate_hz > 0 else None,
        scheduled=scheduled,
        recorded=summary.samples,
        missed=_count(outcome, "missed"),
        late=_count(outcome, "late"),
        lost=_count(outcome, "lost"),
        meta={
            _cut(name): _cut(value) if isinstance(value, str) else value for name, value in added
        },
        problem=summary.problem,
        **results,
    )
    return row, True


def _cut(text: str) -> str:
    return printable(text, _MOST_CHARACTERS)


def _text(values: Mapping[str, str], key: str) -> str:
    return _cut(values.get(key, "").strip())


def _count(values: Mapping[str, str], key: str) -> int | None:
    text = values.get(key, "")
    # More digits are not a count and exceed 64 bits.
    countable = text.isascii() and text.isdigit() and len(text) <= _MOST_DIGITS + 1
    return int(text) if countable and int(text) < 2**63 else None


def _number(values: Mapping[str, str], key: str) -> float | None:
    try:
        number = float(values.get(key, "")[:400])
    except ValueError:
        return None
    return number if isfinite(number) else None


# Modes


def _modes(quick_look: Path | None, report: Path | None) -> Document:
    """Return modes and validity of the report, or else of the quick look; nothing without them."""
    if report is not None:
        for headline in _list(_document(report / NUMBERS), "headlines"):
            if modes := usable_modes(_list(headline, "modes")):
                return _with_validity(modes, headline)
    found = None if quick_look is None else read_quick_look(quick_look)
    return {} if found is None else _with_validity(usable_modes(found["modes"]), found)


def _with_validity(modes: tuple[Mode, ...], found: object) -> Document:
    if not modes:
        return {}
    stated = found.get("validity") if isinstance(found, dict) else None
    return {"modes": modes, "validity": Validity.of_document(stated).as_json()}


def _document(path: Path) -> object:
    try:
        return json.loads(read_plain_file(path, _MOST_JSON_BYTES))
    except (OSError, ValueError, RecursionError):  # the session is listed without this result
        return None


def _list(document: object, key: str) -> list[object]:
    found = document.get(key) if isinstance(document, dict) else None
    return found if isinstance(found, list) else []


def usable_modes(modes: object) -> tuple[Mode, ...]:
    """Return the observed modes of a list whose numbers are finite."""
    return tuple(
        {name: mode[name] for name in ("frequency_hz", "damping_ratio", "participation", "source")}
        for mode in modes_of(modes)
        if mode["shown"]
    )


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
