"""Summary of a session file, as text and as a document."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from rigd.printable import counts_text, grouped, listed, printable
from rigd.session import limits
from rigd.session._errors import SessionError
from rigd.session._reader import SURVEY_FIELDS, LoggedEvent, Session, read_session
from rigd.session.layout import Status
from rigd.session.online_fit import mode_line
from rigd.session.quick_look import fit_of
from rigd.session.touches import touch_line, touches_of
from rigd.units import suffix_of, unit_of

_RECOVERED: Final = "recovered_"
_MOST_CHARACTERS: Final = 200_000
_AROUND: Final = 120
"""Characters around an entry in either form."""
_LONGEST_KEY: Final = 200
_LONGEST_TEXT: Final = 10_000
_WIDEST_KEY: Final = 40
_COUNTS: Final = frozenset(
    {"scheduled", "recorded", "missed", "late", "lost", "stale_angles", "stale_wrenches"}
)
_UTC: Final = "_utc_ns"
_START: Final = f"start{_UTC}"
_DIGITS: Final = 6
_MEASURED_DIGITS: Final = 3
"""Significant digits of a tare: more are noise in half a second."""
_LONGEST_NUMBERS: Final = 200
_LONGEST_COUNT: Final = 12
"""Digits of a number of ticks: of thirty years at 1 kHz."""

_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """Summary of a session file without analysing it."""

    path: Path
    """The file."""
    size_bytes: int
    """Its size."""
    start_utc: str
    """ISO 8601, to the microsecond."""
    rate_hz: float
    """Nominal rate."""
    samples: int
    """Recorded samples."""
    ticks: int
    """Number of ticks from the first recorded one to the last, both included."""
    duration_s: float
    """`ticks` at the nominal rate."""
    missing_ticks: int
    """Gaps between the first recorded tick and the last."""
    status_counts: dict[str, int]
    """Name of a status bit → samples that have it; only those that occur."""
    segments: dict[str, tuple[int, int]]
    """Name → first tick and end (exclusive)."""
    metadata: dict[str, str]
    """The record ``session``, with texts cut to a readable length."""
    outcome: dict[str, str] | None
    """End of the session; None if the file does not state it."""
    events: list[LoggedEvent]
    """Its log, with texts cut as well."""
    attachments: dict[str, int]
    """Name → bytes."""
    left_out: list[str]
    """Parts of the file that are too long to be shown, in words."""
    absent: str = ""
    """Samples that were recorded but are not in the file, in words; empty: none, or unknown."""

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as a document of JSON types."""
        return {
            "path": str(self.path),
            "size_bytes": self.size_bytes,
            "start_utc": self.start_utc,
            "rate_hz": self.rate_hz,
            "samples": self.samples,
            "ticks": self.ticks,
            "duration_s": self.duration_s,
            "missing_ticks": self.missing_ticks,
            "status_counts": self.status_counts,
            "segments": {name: list(ticks) for name, ticks in self.segments.items()},
            "metadata": self.metadata,
            "outcome": self.outcome,
            "events": [
                {
                    "t_ns": event.t_ns,
                    "level": event.level,
                    "name": event.name,
                    "message": event.message,
                }
                for event in self.events
            ],
            "attachments": self.attachments,
            "left_out": self.left_out,
            "absent": self.absent,
        }

    def lines(self) -> list[str]:
        """Return the summary as lines of text, with rounded numbers and local times as well."""
        rows = [
            ("file", f"{self.path} ({self.size_bytes / 1e6:.2f} MB)"),
            ("started", _clock(datetime.fromisoformat(self.start_utc))),
            *_outcome(self.outcome or {}, is_whole=not self.absent),
            *([("absent", self.absent)] if self.absent else []),
            *(("recovered", f"{k}: {v}") for k, v in _recovery(self.outcome or {}).items()),
            (
                "samples",
                f"{grouped(self.samples)} at {self.rate_hz:g} Hz, {self.duration_s:g} s, "
                f"{grouped(self.missing_ticks)} ticks missing",
            ),
            *(
                ("flagged", f"{name}: {grouped(n)} samples")
                for name, n in self.status_counts.items()
            ),
            *(
                ("segment", f"{name}: {first} to {end} ({(end - first) / self.rate_hz:g} s)")
                for name, (first, end) in self.segments.items()
            ),
            *(("attached", f"{name} ({size} bytes)") for name, size in self.attachments.items()),
            *(_rounded(key, value) for key, value in self.metadata.items() if key != _START),
            *(
                (f"{event.t_ns / 1e9:.3f} s", f"{event.level}: {event.message} [{event.name}]")
                for event in self.events
            ),
            *(("not shown", sentence) for sentence in self.left_out),
        ]
        width = min(max(len(key) for key, _ in rows), _WIDEST_KEY)
        return [f"{printable(key):{width}}  {printable(value)}" for key, value in rows]


def describe(path: str | PathLike[str]) -> SessionInfo:
    """Read a session file and summarise it.

    Raises
    ------
    SessionError
        If the file cannot be read or does not state a rate greater than 0.

    Examples
    --------
    >>> from rigd.session import describe
    >>> found = describe("session.mcap")
    >>> found.rate_hz, found.samples, found.outcome["outcome"]
    (1000.0, 21500, 'complete')
    """
    path = Path(path)
    session = read_session(path, fields=SURVEY_FIELDS, max_samples=limits.MAX_SURVEYED)
    rate_hz = session.number("rate_hz")
    if rate_hz <= 0:
        raise SessionError(
            f"{path}: rate_hz in the metadata 'session' is {rate_hz:g}, but must be greater than 0 "
            "Hz. The writing program must correct it."
        )
    ticks = session.samples["tick"]
    span = int(ticks[-1]) - int(ticks[0]) + 1 if len(ticks) else 0
    left_out: list[str] = []
    # Ticks missing at the end leave no gap; only the outcome states them.
    scheduled = (session.outcome or {}).get("scheduled", "")
    if scheduled.isascii() and scheduled.isdigit():
        if _is_count(scheduled):
            span = max(span, int(scheduled))
        else:
            left_out.append(f"scheduled of the outcome, a number of {len(scheduled)} digits")
    return SessionInfo(
        path=path,
        size_bytes=path.stat().st_size,
        start_utc=_iso(session.start_utc_ns),
        rate_hz=rate_hz,
        samples=len(ticks),
        ticks=span,
        duration_s=span / rate_hz,
        missing_ticks=span - len(ticks),
        status_counts=_status_counts(session),
        segments=_Excerpt("segments", 50_000, left_out).mapping(session.segments),
        metadata=_Excerpt("keys", _MOST_CHARACTERS, left_out).texts(session.metadata),
        outcome=None
        if session.outcome is None
        else _Excerpt("keys of the outcome", 100_000, left_out).texts(session.outcome),
        events=_Excerpt("messages of the log", 500_000, left_out).events(
            session.events, session.events_left_out
        ),
        attachments=_Excerpt("attachments", 50_000, left_out).mapping(
            {name: len(data) for name, data in session.attachments.items()}
        ),
        left_out=left_out,
        absent=_absent(session),
    )


def _absent(session: Session) -> str:
    """Describe samples that outcome or segments state and the file lacks: it was trimmed."""
    ticks = session.samples["tick"]
    stated = (session.outcome or {}).get("recorded", "")
    recorded = int(stated) if _is_count(stated) else 0
    there = f"those of ticks {ticks[0]} to {ticks[-1]} are" if len(ticks) else "none is"
    if recorded > len(ticks):
        return (
            f"{grouped(recorded - len(ticks))} of the {grouped(recorded)} samples that were "
            f"recorded are not in this file ({there}): it was trimmed. Take the original."
        )
    first, end = (int(ticks[0]), int(ticks[-1]) + 1) if len(ticks) else (0, 0)
    outside = [
        name
        for name, (begins, ends) in session.segments.items()
        if ends > begins and (begins < first or ends > end)
    ]
    if outside and (session.outcome or {}).get("outcome") == "complete":
        return (
            f"Samples of {listed(outside)} are not in this file ({there}): it was trimmed. Take "
            "the original."
        )
    return ""


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= _LONGEST_COUNT


def _cut(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    return f"{text[:most]}… and {len(text) - most} more characters"


def readable_texts(values: Mapping[str, str], what: str) -> tuple[dict[str, str], list[str]]:
    """Cut texts of a file to a readable length, and make them harmless to a terminal.

    Parameters
    ----------
    values : texts by their keys, of any number and length
    what : name of the texts, in the plural

    Returns
    -------
    The first of them, and a line on the others if there are any.
    """
    left_out: list[str] = []
    shown = _Excerpt(what, _MOST_CHARACTERS, left_out).texts(values)
    return {printable(key): printable(value) for key, value in shown.items()}, left_out


class _Excerpt:
    """First characters of an entry of the file, whose length is not limited.

    Parameters
    ----------
    what : name of the part, in the plural
    most : characters to show, in either form; those of all parts stay below 1 MB
    left_out : gets a line if the part is longer
    """

    def __init__(self, what: str, most: int, left_out: list[str]) -> None:
        self._what = what
        self._left_out = left_out
        self._room = most

    def mapping(self, values: Mapping[str, _Value]) -> dict[str, _Value]:
        """Return the first entries, each cut to a readable length."""
        shown: dict[str, _Value] = {}
        for count, (key, value) in enumerate(values.items()):
            short_key = _cut(key, _LONGEST_KEY)
            if not self._has_room(short_key, str(value)):
                self._leave_out(len(values) - count)
                break
            shown[short_key] = value
        return shown

    def texts(self, values: Mapping[str, str]) -> dict[str, str]:
        """Return the first entries, with long values cut."""
        return self.mapping({key: _cut(value, _LONGEST_TEXT) for key, value in values.items()})

    def events(self, events: Sequence[LoggedEvent], unread: int) -> list[LoggedEvent]:
        """Return the first events, with long texts cut; `unread` more are in the file."""
        shown: list[LoggedEvent] = []
        for event in events:
            short = replace(
                event,
                name=_cut(event.name, _LONGEST_KEY),
                message=_cut(event.message, _LONGEST_TEXT),
            )
            if not self._has_room(short.name, short.message):
                break
            shown.append(short)
        self._leave_out(len(events) - len(shown) + unread)
        return shown

    def _has_room(self, *texts: str) -> bool:
        # In JSON a character may take twelve, and both forms add something to a text.
        self._room -= sum(len(json.dumps(text)) for text in texts) + _AROUND
        return self._room >= 0

    def _leave_out(self, count: int) -> None:
        if count:
            self._left_out.append(f"… and {count} more {self._what} not shown")


def _status_counts(session: Session) -> dict[str, int]:
    status = session.samples["status"]
    counts = {flag.name or "": int(np.count_nonzero(status & flag.value)) for flag in Status}
    return {name.lower(): count for name, count in counts.items() if count}


def _iso(utc_ns: int) -> str:
    return _utc(utc_ns).isoformat(timespec="microseconds")


def _utc(utc_ns: int) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)


def _outcome(outcome: dict[str, str], *, is_whole: bool) -> Iterator[tuple[str, str]]:
    shown_keys = {"outcome", "reason", "touches", "fit"}
    shown_keys |= {_RECOVERED + key for key in _recovery(outcome)}
    text = outcome.get("outcome", "unknown")
    text = text.capitalize() if is_whole else f"Recorded as {text}"
    with suppress(KeyError, ValueError):  # outcome of another program, or of a recovery
        text += f": {counts_text(outcome)}"
        shown_keys |= _COUNTS
    reason = outcome.get("reason")
    yield "outcome", f"{text}. {reason}" if reason else text
    for touch in touches_of(outcome):
        yield "touch", touch_line(touch).removeprefix("Touch ")
    for mode in (fit_of(outcome) or {"modes": []})["modes"]:
        if mode["shown"]:
            yield "fit", mode_line(mode)
    yield from (
        _rounded(key, value) for key, value in outcome.items() if key not in shown_keys and value
    )


def _rounded(key: str, value: str) -> tuple[str, str]:
    """Return a key and its value as text, a number rounded and with its unit.

    JSON has the original key and all digits.
    """
    if len(value) > _LONGEST_NUMBERS:
        return key, value
    with suppress(ValueError, OverflowError):
        if key.endswith(_UTC):
            return key.removesuffix(_UTC), _clock(_utc(int(value)))
        digits = _MEASURED_DIGITS if key.startswith("tare_") else _DIGITS
        shown = [
            f"{float(each):.{digits}g}" if "." in each else f"{int(each)}"
            for each in value.split(",")
        ]
        name = key.removesuffix(suffix_of(key)).replace("_", " ")
        return name, f"{', '.join(shown)} {unit_of(key)}".rstrip()
    return key.replace("_", " "), value


def _clock(moment: datetime) -> str:
    """Return a time in UTC and in the local time zone."""
    utc = f"{moment:%Y-%m-%d %H:%M:%S} UTC"
    local = moment.astimezone()
    return f"{utc} ({local:%Y-%m-%d %H:%M:%S %Z})" if local.utcoffset() else utc


def _recovery(outcome: dict[str, str]) -> dict[str, str]:
    """Return the outcome's items on a recovery, without the common prefix of the keys."""
    return {
        key.removeprefix(_RECOVERED): value
        for key, value in outcome.items()
        if key.startswith(_RECOVERED)
    }
