"""Summary of a session file, for people and for programs."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from rigd.session.errors import SessionError
from rigd.session.format import Status
from rigd.session.reader import Event, Session, read_session

_RECOVERED = "recovered_"


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """What there is to know of a session file without analysing it."""

    path: Path
    size_bytes: int
    start_utc: str
    """ISO 8601, to the microsecond."""
    rate_hz: float
    samples: int
    ticks: int
    """From the first recorded tick to the last, both counted."""
    duration_s: float
    """`ticks` at the nominal rate."""
    missing_ticks: int
    """Gaps between the first recorded tick and the last."""
    status_counts: dict[str, int]
    """Name of a status bit → samples that have it; only those that occur."""
    segments: dict[str, tuple[int, int]]
    metadata: dict[str, str]
    outcome: dict[str, str] | None
    events: list[Event]
    attachments: dict[str, int]
    """Name → bytes."""

    def as_dict(self) -> dict[str, Any]:
        """Return it as a document of JSON types."""
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
        }

    def lines(self) -> list[str]:
        """Return it as lines of text."""
        rows = [
            ("file", f"{self.path} ({self.size_bytes / 1e6:.2f} MB)"),
            ("started", self.start_utc),
            ("outcome", "unknown" if self.outcome is None else _outcome(self.outcome)),
            *(("recovered", f"{k}: {v}") for k, v in _recovery(self.outcome or {}).items()),
            (
                "samples",
                f"{self.samples} at {self.rate_hz:g} Hz, {self.duration_s:.3f} s, "
                f"{self.missing_ticks} ticks missing",
            ),
            *(("flagged", f"{name}: {n} samples") for name, n in self.status_counts.items()),
            *(
                ("segment", f"{name}: {first} to {end} ({(end - first) / self.rate_hz:g} s)")
                for name, (first, end) in self.segments.items()
            ),
            *(("attached", f"{name} ({size} bytes)") for name, size in self.attachments.items()),
            *((key, value) for key, value in self.metadata.items()),
            *(
                (f"{event.t_ns / 1e9:.3f} s", f"{event.level}: {event.message} [{event.name}]")
                for event in self.events
            ),
        ]
        width = max(len(key) for key, _ in rows)
        return [f"{key:{width}}  {_one_line(value)}" for key, value in rows]


def describe(path: str | PathLike[str]) -> SessionInfo:
    """Read a session file and summarise it.

    Raises
    ------
    SessionError
        If the file cannot be read or does not state a rate greater than 0.
    """
    path = Path(path)
    session = read_session(path)
    rate_hz = session.number("rate_hz")
    if rate_hz <= 0:
        raise SessionError(
            f"{path}: rate_hz in the metadata 'session' is {rate_hz:g}, but must be greater than 0 "
            "Hz. Whoever writes the file must correct it."
        )
    ticks = session.samples["tick"]
    span = int(ticks[-1]) - int(ticks[0]) + 1 if len(ticks) else 0
    # Ticks that are missing at the end leave no gap; only the outcome knows of them.
    scheduled = (session.outcome or {}).get("scheduled", "")
    if scheduled.isdecimal():
        span = max(span, int(scheduled))
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
        segments=session.segments,
        metadata=session.metadata,
        outcome=session.outcome,
        events=session.events,
        attachments={name: len(data) for name, data in session.attachments.items()},
    )


def _status_counts(session: Session) -> dict[str, int]:
    status = session.samples["status"]
    counts = {flag.name or "": int(np.count_nonzero(status & flag.value)) for flag in Status}
    return {name.lower(): count for name, count in counts.items() if count}


def _iso(utc_ns: int) -> str:
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)
    return moment.isoformat(timespec="microseconds")


def _outcome(outcome: dict[str, str]) -> str:
    first = outcome.get("outcome", "unknown")
    told_apart = ("outcome", *(_RECOVERED + key for key in _recovery(outcome)))
    others = ", ".join(f"{k} {v}" for k, v in outcome.items() if k not in told_apart and v)
    return f"{first} ({others})" if others else first


def _recovery(outcome: dict[str, str]) -> dict[str, str]:
    """Return what the outcome says of a recovery, without the common part of the keys."""
    return {
        key.removeprefix(_RECOVERED): value
        for key, value in outcome.items()
        if key.startswith(_RECOVERED)
    }


def _one_line(text: str) -> str:
    """Make control characters of the file harmless to a terminal."""
    return "".join(c if c.isprintable() else " " for c in text)
