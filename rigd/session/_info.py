"""Summary of a session file for `rigd info`, as lines of text and as JSON."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from rigd.estimates import modes_from_json
from rigd.printable import count_with_separators, counts_text, listed, printable
from rigd.session import limits
from rigd.session._errors import SessionError
from rigd.session._reader import ORDER_AND_FLAG_FIELDS, LoggedEvent, Session, read_session
from rigd.session.layout import Status
from rigd.session.quick_look import fit_of
from rigd.session.touches import touch_line, touches_of
from rigd.units import suffix_of, unit_of

_RECOVERY_KEY_PREFIX: Final = "recovered_"
_MAX_METADATA_CHARACTERS: Final = 200_000
"""Maximum number of characters of the metadata that are shown."""
_ENTRY_OVERHEAD_CHARACTERS: Final = 120
"""Number of characters, such as quotes and spaces, that the text or JSON form adds to an entry."""
_MAX_KEY_CHARACTERS: Final = 200
"""Maximum number of characters of a key that are shown."""
_MAX_TEXT_CHARACTERS: Final = 50_000
"""Maximum number of characters of a value that are shown."""
_MAX_KEY_COLUMN_WIDTH: Final = 40
"""Maximum width in characters of the first column of the text form."""
_COUNT_KEYS: Final = frozenset(
    {"scheduled", "recorded", "missed", "late", "lost", "stale_angles", "stale_wrenches"}
)
_UTC_KEY_SUFFIX: Final = "_utc_ns"
_START_KEY: Final = f"start{_UTC_KEY_SUFFIX}"
_SIGNIFICANT_DIGITS: Final = 6
"""Number of significant digits with which numbers of the metadata are shown."""
_TARE_DIGITS: Final = 3
"""Number of significant digits of a tare; more digits of a mean over half a second are noise."""
_MAX_ROUNDED_CHARACTERS: Final = 200
"""Maximum number of characters of a number or a list of numbers that is shown rounded."""
_MAX_COUNT_DIGITS: Final = 12
"""Maximum number of digits of a tick count, which is enough for thirty years at 1 kHz."""

_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """Summary of a session file: metadata, counts of samples, and log."""

    path: Path
    """Path of the session file."""
    size_bytes: int
    """Length of the session file in bytes."""
    start_utc: str
    """UTC time of tick 0 in ISO 8601 format, to the microsecond."""
    rate_hz: float
    """Nominal sample rate."""
    samples: int
    """Number of samples in the file."""
    ticks: int
    """Number of ticks from the first to the last recorded tick, or the number of scheduled ticks if
    this is larger."""
    duration_s: float
    """Duration of the session: `ticks` at the nominal sample rate."""
    missing_ticks: int
    """Number of ticks without a sample: `ticks` minus `samples`."""
    status_counts: dict[str, int]
    """Name of a status flag → number of samples with that flag, for flags that occur."""
    segments: dict[str, tuple[int, int]]
    """Segment name → first tick and end tick (exclusive)."""
    metadata: dict[str, str]
    """Record ``session``, with texts cut to a readable length."""
    outcome: dict[str, str] | None
    """Record ``outcome``: how the session ended; None if the file does not state it."""
    events: list[LoggedEvent]
    """Events of the session's log, with texts cut to a readable length."""
    attachments: dict[str, int]
    """Name of an attached file → its length in bytes."""
    omission_texts: list[str]
    """Sentences that state which contents of the file are too long to be shown."""
    missing_samples_text: str = ""
    """Sentence that states which recorded samples are missing from the file; empty if none are."""

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as a dictionary that can be written as JSON."""
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
            "segments": {
                segment_name: list(segment_ticks)
                for segment_name, segment_ticks in self.segments.items()
            },
            "metadata": self.metadata,
            "outcome": self.outcome,
            "events": [
                {
                    "t_ns": logged_event.t_ns,
                    "level": logged_event.level,
                    "name": logged_event.name,
                    "message": logged_event.message,
                }
                for logged_event in self.events
            ],
            "attachments": self.attachments,
            "left_out": self.omission_texts,
            "absent": self.missing_samples_text,
        }

    def lines(self) -> list[str]:
        """Return the summary as text lines, with rounded numbers, and times in UTC and locally."""
        title_rows = [
            ("file", f"{self.path} ({self.size_bytes / 1e6:.2f} MB)"),
            ("started", _time_text(datetime.fromisoformat(self.start_utc))),
            *_outcome_rows(self.outcome or {}, is_complete=not self.missing_samples_text),
            *([("absent", self.missing_samples_text)] if self.missing_samples_text else []),
            *(("recovered", f"{k}: {v}") for k, v in _recovery_entries(self.outcome or {}).items()),
            (
                "samples",
                f"{count_with_separators(self.samples)} at {self.rate_hz:g} Hz, "
                f"{self.duration_s:g} s, {count_with_separators(self.missing_ticks)} ticks missing",
            ),
            *(
                ("flagged", f"{name}: {count_with_separators(n)} samples")
                for name, n in self.status_counts.items()
            ),
            *(
                ("segment", f"{name}: {first} to {end} ({(end - first) / self.rate_hz:g} s)")
                for name, (first, end) in self.segments.items()
            ),
            *(("attached", f"{name} ({size} bytes)") for name, size in self.attachments.items()),
            *(
                _rounded_row(key, value)
                for key, value in self.metadata.items()
                if key != _START_KEY
            ),
            *(
                (
                    f"{logged_event.t_ns / 1e9:.3f} s",
                    f"{logged_event.level}: {logged_event.message} [{logged_event.name}]",
                )
                for logged_event in self.events
            ),
            *(("not shown", sentence) for sentence in self.omission_texts),
        ]
        key_column_width = min(max(len(key) for key, _ in title_rows), _MAX_KEY_COLUMN_WIDTH)
        return [
            f"{printable(key):{key_column_width}}  {printable(value)}" for key, value in title_rows
        ]


def describe(
    path: str | PathLike[str], on_progress: Callable[[float], None] | None = None
) -> SessionInfo:
    """Return a summary of a session file.

    Parameters
    ----------
    path : path of a complete file
    on_progress : called repeatedly with the completed fraction of the work, from 0 to 1

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
    session = read_session(
        path,
        fields=ORDER_AND_FLAG_FIELDS,
        max_samples=limits.MAX_RECORDED_SAMPLES,
        on_progress=on_progress,
    )
    rate_hz = session.number("rate_hz")
    if rate_hz <= 0:
        raise SessionError(
            f"{path}: rate_hz in the metadata 'session' is {rate_hz:g}, but must be greater than 0 "
            "Hz. The writing program must correct it."
        )
    ticks = session.samples["tick"]
    spanned_tick_count = int(ticks[-1]) - int(ticks[0]) + 1 if len(ticks) else 0
    omission_texts: list[str] = []
    # Ticks missing at the end leave no gap; only the outcome states them.
    scheduled_text = (session.outcome or {}).get("scheduled", "")
    if scheduled_text.isascii() and scheduled_text.isdigit():
        if _is_count(scheduled_text):
            spanned_tick_count = max(spanned_tick_count, int(scheduled_text))
        else:
            omission_texts.append(
                f"scheduled of the outcome, a number of {len(scheduled_text)} digits"
            )
    return SessionInfo(
        path=path,
        size_bytes=path.stat().st_size,
        start_utc=_iso_text(session.start_utc_ns),
        rate_hz=rate_hz,
        samples=len(ticks),
        ticks=spanned_tick_count,
        duration_s=spanned_tick_count / rate_hz,
        missing_ticks=spanned_tick_count - len(ticks),
        status_counts=_status_counts(session),
        segments=_EntryLimiter("segments", 50_000, omission_texts).limited_entries(
            session.segments
        ),
        metadata=_EntryLimiter("keys", _MAX_METADATA_CHARACTERS, omission_texts).limited_texts(
            session.metadata
        ),
        outcome=None
        if session.outcome is None
        else _EntryLimiter("keys of the outcome", 100_000, omission_texts).limited_texts(
            session.outcome
        ),
        events=_EntryLimiter("messages of the log", 500_000, omission_texts).limited_events(
            session.events, session.omitted_event_count
        ),
        attachments=_EntryLimiter("attachments", 50_000, omission_texts).limited_entries(
            {
                attachment_name: len(attachment_bytes)
                for attachment_name, attachment_bytes in session.attachments.items()
            }
        ),
        omission_texts=omission_texts,
        missing_samples_text=_missing_samples_sentence(session),
    )


def _missing_samples_sentence(session: Session) -> str:
    """Return a sentence on the samples that were cut off from a file; empty if none were.

    Samples are missing if the file has fewer than its record ``outcome`` or its segments state.
    """
    ticks = session.samples["tick"]
    stated_count = (session.outcome or {}).get("recorded", "")
    recorded_count = int(stated_count) if _is_count(stated_count) else 0
    present_text = f"those of ticks {ticks[0]} to {ticks[-1]} are" if len(ticks) else "none is"
    if recorded_count > len(ticks):
        return (
            f"{count_with_separators(recorded_count - len(ticks))} of the "
            f"{count_with_separators(recorded_count)} samples that were "
            f"recorded are not in this file ({present_text}): it was trimmed. Take the original."
        )
    first_present_tick, present_end_tick = (
        (int(ticks[0]), int(ticks[-1]) + 1) if len(ticks) else (0, 0)
    )
    incomplete_segments = [
        segment_name
        for segment_name, (first_tick, end_tick) in session.segments.items()
        if end_tick > first_tick
        and (first_tick < first_present_tick or end_tick > present_end_tick)
    ]
    if incomplete_segments and (session.outcome or {}).get("outcome") == "complete":
        return (
            f"Samples of {listed(incomplete_segments)} are not in this file ({present_text}): it "
            "was trimmed. Take the original."
        )
    return ""


def _is_count(number_text: str) -> bool:
    """Return whether a text is a whole number of at most twelve digits."""
    return number_text.isascii() and number_text.isdigit() and len(number_text) <= _MAX_COUNT_DIGITS


def _shortened(long_text: str, max_characters: int) -> str:
    """Return a text cut to `max_characters`, then the number of omitted characters."""
    if len(long_text) <= max_characters:
        return long_text
    return f"{long_text[:max_characters]}… and {len(long_text) - max_characters} more characters"


def readable_texts(
    file_texts: Mapping[str, str], entries_noun: str
) -> tuple[dict[str, str], list[str]]:
    """Cut texts of a file to a readable length, and escape control characters.

    Parameters
    ----------
    file_texts : key → text, of any number and length
    entries_noun : plural noun for the texts, for the line on omitted texts

    Returns
    -------
    The first texts (key → text), and a list with a line on the omitted texts, if there are any.
    """
    omission_texts: list[str] = []
    shown_texts = _EntryLimiter(
        entries_noun, _MAX_METADATA_CHARACTERS, omission_texts
    ).limited_texts(file_texts)
    return {
        printable(key): printable(shown_text) for key, shown_text in shown_texts.items()
    }, omission_texts


class _EntryLimiter:
    """Limiter of the entries of one kind, such as events, to a total number of characters.

    `entries_noun` is a plural noun for the entries. `max_characters` is the maximum number of
    characters of all entries in text or JSON form. A line on omitted entries is appended to
    `omission_texts`.
    """

    def __init__(self, entries_noun: str, max_characters: int, omission_texts: list[str]) -> None:
        self._entries_noun = entries_noun
        self._omission_texts = omission_texts
        self._remaining_characters = max_characters

    def limited_entries(self, entries: Mapping[str, _Value]) -> dict[str, _Value]:
        """Return the first entries of a mapping, up to the maximum, with long keys cut."""
        shown_entries: dict[str, _Value] = {}
        for entry_count, (key, entry_value) in enumerate(entries.items()):
            short_key = _shortened(key, _MAX_KEY_CHARACTERS)
            if not self._reserve_characters(short_key, str(entry_value)):
                self._report_omitted(len(entries) - entry_count)
                break
            shown_entries[short_key] = entry_value
        return shown_entries

    def limited_texts(self, text_entries: Mapping[str, str]) -> dict[str, str]:
        """Return the first entries of a mapping of texts, with long keys and long texts cut."""
        return self.limited_entries(
            {
                key: _shortened(entry_text, _MAX_TEXT_CHARACTERS)
                for key, entry_text in text_entries.items()
            }
        )

    def limited_events(
        self, events: Sequence[LoggedEvent], unread_event_count: int
    ) -> list[LoggedEvent]:
        """Return the first events, up to the maximum, with long texts cut.

        `unread_event_count` is the number of further events in the file.
        """
        shown_events: list[LoggedEvent] = []
        for logged_event in events:
            shortened_event = replace(
                logged_event,
                name=_shortened(logged_event.name, _MAX_KEY_CHARACTERS),
                message=_shortened(logged_event.message, _MAX_TEXT_CHARACTERS),
            )
            if not self._reserve_characters(shortened_event.name, shortened_event.message):
                break
            shown_events.append(shortened_event)
        self._report_omitted(len(events) - len(shown_events) + unread_event_count)
        return shown_events

    def _reserve_characters(self, *texts: str) -> bool:
        """Return whether an entry with these texts fits, and count its characters."""
        # A character may take twelve characters in JSON, and both forms add some to a text.
        self._remaining_characters -= (
            sum(len(json.dumps(text)) for text in texts) + _ENTRY_OVERHEAD_CHARACTERS
        )
        return self._remaining_characters >= 0

    def _report_omitted(self, omitted_count: int) -> None:
        """Append a line that states the number of omitted entries, unless it is 0."""
        if omitted_count:
            self._omission_texts.append(
                f"… and {omitted_count} more {self._entries_noun} not shown"
            )


def _status_counts(session: Session) -> dict[str, int]:
    """Return the number of samples with each status flag that occurs: flag name → number."""
    status_flags = session.samples["status"]
    sample_count_by_flag = {
        flag.name or "": int(np.count_nonzero(status_flags & flag.value)) for flag in Status
    }
    return {
        flag_name.lower(): sample_count
        for flag_name, sample_count in sample_count_by_flag.items()
        if sample_count
    }


def _iso_text(utc_ns: int) -> str:
    """Return a time in nanoseconds since the Unix epoch as ISO 8601 text."""
    return _utc_datetime(utc_ns).isoformat(timespec="microseconds")


def _utc_datetime(utc_ns: int) -> datetime:
    """Return a time in nanoseconds since the Unix epoch as a UTC datetime."""
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)


def _outcome_rows(outcome: dict[str, str], *, is_complete: bool) -> Iterator[tuple[str, str]]:
    """Yield the rows (title, text) for the record ``outcome``, with touches and fitted modes."""
    excluded_keys = {"outcome", "reason", "touches", "fit"}
    excluded_keys |= {_RECOVERY_KEY_PREFIX + key for key in _recovery_entries(outcome)}
    outcome_text = outcome.get("outcome", "unknown")
    outcome_text = outcome_text.capitalize() if is_complete else f"Recorded as {outcome_text}"
    with suppress(KeyError, ValueError):  # outcome of another program, or of a recovery
        outcome_text += f": {counts_text(outcome)}"
        excluded_keys |= _COUNT_KEYS
    reason_text = outcome.get("reason")
    yield "outcome", f"{outcome_text}. {reason_text}" if reason_text else outcome_text
    for touch in touches_of(outcome):
        yield "touch", touch_line(touch).removeprefix("Touch ")
    for mode in modes_from_json((fit_of(outcome) or {}).get("modes")):
        if mode.shown:
            yield "fit", mode.summary_line()
    yield from (
        _rounded_row(key, outcome_value)
        for key, outcome_value in outcome.items()
        if key not in excluded_keys and outcome_value
    )


def _rounded_row(key: str, metadata_value: str) -> tuple[str, str]:
    """Return a metadata key and value for a row of text, with rounded numbers and units.

    A value that is neither a number nor a list of numbers is returned unchanged.
    """
    if len(metadata_value) > _MAX_ROUNDED_CHARACTERS:
        return key, metadata_value
    with suppress(ValueError, OverflowError):
        if key.endswith(_UTC_KEY_SUFFIX):
            return key.removesuffix(_UTC_KEY_SUFFIX), _time_text(_utc_datetime(int(metadata_value)))
        significant_digits = _TARE_DIGITS if key.startswith("tare_") else _SIGNIFICANT_DIGITS
        rounded_numbers = [
            f"{float(number_text):.{significant_digits}g}"
            if "." in number_text
            else f"{int(number_text)}"
            for number_text in metadata_value.split(",")
        ]
        shown_key = key.removesuffix(suffix_of(key)).replace("_", " ")
        return shown_key, f"{', '.join(rounded_numbers)} {unit_of(key)}".rstrip()
    return key.replace("_", " "), metadata_value


def _time_text(time_utc: datetime) -> str:
    """Return the text of a time in UTC, and in the local time zone if that is another one."""
    utc_text = f"{time_utc:%Y-%m-%d %H:%M:%S} UTC"
    local_time = time_utc.astimezone()
    return f"{utc_text} ({local_time:%Y-%m-%d %H:%M:%S %Z})" if local_time.utcoffset() else utc_text


def _recovery_entries(outcome: dict[str, str]) -> dict[str, str]:
    """Return the entries of the record ``outcome`` that a recovery added, without key prefix."""
    return {
        key.removeprefix(_RECOVERY_KEY_PREFIX): outcome_value
        for key, outcome_value in outcome.items()
        if key.startswith(_RECOVERY_KEY_PREFIX)
    }
