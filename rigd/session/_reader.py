"""Reader of session files: returns the whole file as arrays, or raises an error with a remedy."""

import mmap
import shlex
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from rigd.session import limits
from rigd.session._errors import SessionAccessError, SessionError
from rigd.session._mcap_limits import McapError, McapTooLargeError
from rigd.session._mcap_reader import McapContents, MessageBlock, OnBlock, read_mcap
from rigd.session._mcap_writer import MAGIC, MESSAGE_HEAD
from rigd.session._message_decoder import (
    CONTROLS,
    SAMPLES,
    TIMINGS,
    TOUCHES,
    MessageDecoder,
    MessageLayout,
    class_of_channel,
    decoded_message,
    quoted,
)
from rigd.session._schema import EVENT_LEVELS, EVENT_TOPIC, FORMAT_VERSION, SAMPLE_TOPIC
from rigd.session._writer import is_being_written
from rigd.session.layout import to_native
from rigd.units import unit_of

if TYPE_CHECKING:
    from google.protobuf.message import Message

SURVEY_FIELDS: Final = ("t_ns", "tick", "status")
"""Fields that give the number of samples, their order and their flags."""
MAX_EVENTS: Final = 100_000
"""Most lines of a session's log that are read."""
MAX_EVENT_BYTES: Final = 1 << 20
"""Longest message of the log that is read; of a longer one its length is stated."""
MAX_LOG_BYTES: Final = 16 << 20
"""Most of the log that is read."""

_GROWTH: Final = 1 << 16
_BYTES_A_SAMPLE: Final = 60
"""Least size of a sample in the file, unless it repeats itself."""
_LONGEST_NUMBER: Final = 400
"""Characters: the longest finite number in decimal, without its fraction, has 309."""


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """Line of a session's log."""

    t_ns: int
    """ns since the session start."""
    level: str
    """"unknown", "debug", "info", "warning", "error" or "fatal"."""
    name: str
    """Process or part that logged it."""
    message: str
    """Text for the operator."""


@dataclass(frozen=True, slots=True)
class Session:
    """A recorded session."""

    path: Path
    """The file."""
    samples: npt.NDArray[np.void]
    """(n,) of ``SAMPLE_DTYPE``, ticks strictly increasing."""
    start_utc_ns: int
    """Wall clock at tick 0, ns since the Unix epoch."""
    metadata: dict[str, str]
    """The record ``session``."""
    segments: dict[str, tuple[int, int]]
    """Name → first tick and end (exclusive); may be empty."""
    outcome: dict[str, str] | None
    """End of the session; None if the file does not state it."""
    events: list[LoggedEvent]
    """Its log, in the order of time."""
    attachments: dict[str, bytes]
    """Name → contents."""
    events_left_out: int = 0
    """Number of further log lines, which exceeded the limit."""

    def number(self, key: str, default: float | None = None) -> float:
        """Return a number of the metadata.

        Parameters
        ----------
        key : key of the record ``session``; its suffix is its unit
        default : returned without that key; None if the key is required

        Raises
        ------
        SessionError
            If the key is required and missing, or its value is not a finite number.
        """
        text = self.metadata.get(key)
        unit = f" in {unit_of(key)}" if unit_of(key) else ""
        if text is None:
            if default is not None:
                return default
            raise SessionError(
                f"{self.path}: the metadata 'session' has no {key}. The writing program must "
                f"state it as a number{unit}."
            )
        try:
            value = float(text) if len(text) <= _LONGEST_NUMBER else float("nan")
        except ValueError:
            value = float("nan")
        if not isfinite(value):
            raise SessionError(
                f"{self.path}: {key} in the metadata 'session' is {quoted(text)}, which is not a "
                f"finite number. The writing program must state it as a number{unit}."
            )
        return value


def read_session(
    path: str | PathLike[str],
    *,
    fields: Sequence[str] | None = None,
    max_samples: int = limits.MAX_SAMPLES,
    on_samples: Callable[[npt.NDArray[np.void]], None] | None = None,
) -> Session:
    """Read a whole session file.

    Parameters
    ----------
    path : a complete file as docs/session_format.md defines it
    fields : fields of the samples to read, ``tick`` and ``t_ns`` among them; default all
    max_samples : most samples that are stored; they take up to 112 bytes each
    on_samples : called with all fields of the samples, block by block, as they are read

    Raises
    ------
    SessionError
        If the file is missing, empty, not an MCAP file, incomplete, damaged, too large, of a later
        format version, or not a session.

    Examples
    --------
    >>> from rigd.session import read_session
    >>> session = read_session("session.mcap")
    >>> session.segments
    {'rest': (0, 500), 'sweep': (500, 20500), 'ring_down': (20500, 21500)}
    >>> print(session.samples["angle_rad"].size, session.number("beam_length_m"))
    21500 0.98
    """
    path = Path(path)
    log = _Log()
    samples = TopicBuffer(path, SAMPLES, fields, max_samples, on_samples)

    def take(contents: McapContents, block: MessageBlock) -> None:
        samples.decoder.take(contents, block)
        log.take(contents, block)

    contents = _load(path, (SAMPLE_TOPIC, EVENT_TOPIC), take)
    metadata = merged_metadata(contents, "session") or {}
    version = metadata.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise SessionError(
            f"{path} is of session format version {quoted(version)}, and this program reads "
            f"version {FORMAT_VERSION}. Use a newer version of it."
        )
    array = samples.finish(contents)
    _check_ticks(path, array)
    start_utc_ns = _start_utc_ns(path, metadata, log.first_log_time, array)
    return Session(
        path=path,
        samples=array,
        start_utc_ns=start_utc_ns,
        metadata=metadata,
        segments=_segments(path, merged_metadata(contents, "segments") or {}),
        outcome=merged_metadata(contents, "outcome"),
        events=log.events(path, contents, start_utc_ns),
        attachments={attachment.name: attachment.data for attachment in contents.attachments},
        events_left_out=log.left_out,
    )


def read_timings(path: str | PathLike[str]) -> npt.NDArray[np.void]:
    """Read the ages of the readings of a session file.

    Returns
    -------
    array (n,) of ``TIMING_DTYPE``; empty if the file has none

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _read_topic(Path(path), TIMINGS)


def read_controls(path: str | PathLike[str]) -> npt.NDArray[np.void]:
    """Read the controller's terms of a session file.

    Returns
    -------
    array (n,) of ``CONTROL_DTYPE``; empty if the file has none

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _read_topic(Path(path), CONTROLS)


def read_touches(path: str | PathLike[str]) -> npt.NDArray[np.void]:
    """Read the estimated touches of a session file.

    Returns
    -------
    array (n,) of ``TOUCH_DTYPE``; empty if the file has none

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _read_topic(Path(path), TOUCHES)


def _read_topic(path: Path, layout: MessageLayout) -> npt.NDArray[np.void]:
    buffer = TopicBuffer(path, layout, None, limits.MAX_SAMPLES)
    return buffer.finish(_load(path, (layout.topic,), buffer.decoder.take))


class TopicBuffer:
    """Decoded messages of a topic, in an array that grows with the file.

    Parameters
    ----------
    path : the file, for error messages
    layout : layout of the messages
    fields : fields to store; None for all
    most : most messages that may be stored
    on_messages : called with all fields of the messages, block by block
    """

    def __init__(
        self,
        path: Path,
        layout: MessageLayout,
        fields: Sequence[str] | None,
        most: int,
        on_messages: Callable[[npt.NDArray[np.void]], None] | None = None,
    ) -> None:
        self.decoder = MessageDecoder(path, layout, self, None if on_messages else fields)
        self._path = path
        self._topic = layout.topic
        self._most = most
        self._on_messages = on_messages
        # Unused memory of the array is never allocated, and most files need no more.
        expected = min(_file_size(path) // _BYTES_A_SAMPLE, most)
        self._array = np.empty(expected, layout.dtype_of(fields))
        self._length = 0

    def room(self, count: int) -> npt.NDArray[np.void]:
        """Return room for messages; see `rigd.session._message_decoder.MessageSink`."""
        end = self._length + count
        if end > self._most:
            raise SessionError(
                f"{self._path} holds more than the {self._most} messages of {self._topic} that fit "
                "into the memory that reading a session may take. Give a shorter session."
            )
        if end > len(self._array):
            # Resized without a copy, by a small fraction: two arrays would take too much memory.
            grown = max(end, len(self._array) + max(_GROWTH, len(self._array) // 8))
            self._array.resize(min(grown, self._most), refcheck=False)
        if self._on_messages is not None:
            return np.empty(count, self.decoder.dtype)
        return self._array[self._length : end]

    def store(self, messages: npt.NDArray[np.void]) -> None:
        """Count the messages, which are in the array already unless all fields are requested."""
        end = self._length + len(messages)
        if self._on_messages is not None:
            self._on_messages(messages)
            to_native(messages, self._array.dtype.names or (), self._array[self._length : end])
        self._length = end

    def finish(self, contents: McapContents) -> npt.NDArray[np.void]:
        """Return the stored messages.

        Raises
        ------
        SessionError
            If the messages violate the format, or there are too many.
        """
        self.decoder.finish(contents)
        self._array.resize(self._length, refcheck=False)
        return self._array


def _file_size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:  # reported when the file is opened
        return 0


class _Log:
    """Messages of the session's log, up to a limit of memory."""

    def __init__(self) -> None:
        self.first_log_time: int | None = None
        """Log time of the first sample."""
        self.left_out = 0
        """Number of messages of the log that were not stored."""
        self._stored: list[tuple[int, int, bytes | int]] = []
        """Channel, log time, and data or its length."""
        self._bytes = 0

    def take(self, contents: McapContents, block: MessageBlock) -> None:
        """Store the messages of the log."""
        records = block.records
        for channel, size, start, count in block.runs:
            topic = contents.channels[channel].topic
            if topic == SAMPLE_TOPIC:
                if self.first_log_time is None:
                    self.first_log_time = int(MESSAGE_HEAD.unpack_from(records, start)[4])
                continue
            room = MAX_EVENTS - len(self._stored)
            for first in range(start, start + size * min(count, room), size):
                log_time = int(MESSAGE_HEAD.unpack_from(records, first)[4])
                length = size - MESSAGE_HEAD.size
                if length > MAX_EVENT_BYTES:
                    self._stored.append((channel, log_time, length))
                elif self._bytes + length > MAX_LOG_BYTES:
                    self.left_out += 1
                else:
                    self._bytes += length
                    data = bytes(records[first + MESSAGE_HEAD.size : first + size])
                    self._stored.append((channel, log_time, data))
            self.left_out += max(count - room, 0)

    def events(self, path: Path, contents: McapContents, start_utc_ns: int) -> list[LoggedEvent]:
        """Decode the log; one that is not protobuf is left out, because no reader needs it."""
        events: list[LoggedEvent] = []
        decoders: dict[int, Callable[[bytes], Message]] = {}
        for channel, log_time, data in self._stored:
            if contents.channels[channel].message_encoding != "protobuf":
                continue
            t_ns = log_time - start_utc_ns
            if isinstance(data, int):
                events.append(
                    LoggedEvent(t_ns, "unknown", "", f"(a message of {data} bytes, not read)")
                )
                continue
            if channel not in decoders:
                if len(decoders) == limits.MAX_CHANNELS:
                    raise SessionError(
                        f"{path} has more than {limits.MAX_CHANNELS} channels {EVENT_TOPIC}. The "
                        "writing program must put all such messages into one."
                    )
                decoders[channel] = class_of_channel(path, contents, channel).FromString
            message = decoded_message(path, EVENT_TOPIC, decoders[channel], data)
            events.append(_event(message, t_ns))
        return events


def _load(path: Path, topics: Sequence[str], take: OnBlock) -> McapContents:
    """Read the container of a session file that must be complete and sound."""
    contents = load_contents(path, topics, take=take)
    if contents.damage is not None:
        raise SessionError(_damage_message(path, contents))
    if SAMPLE_TOPIC not in {channel.topic for channel in contents.channels.values()}:
        raise no_session(path)
    return contents


def no_session(path: Path) -> SessionError:
    """Return the error of an MCAP file without samples' channel."""
    return SessionError(
        f"{path} is an MCAP file without the channel {SAMPLE_TOPIC}, so it is not a session. "
        "Give a file that `rigd run` or a program following docs/session_format.md recorded."
    )


def load_contents(
    path: Path,
    topics: Sequence[str] | None,
    *,
    take: OnBlock | None = None,
    salvage: bool = False,
    on_progress: Callable[[float], None] | None = None,
) -> McapContents:
    """Read the container of a file as far as it is sound.

    Parameters
    ----------
    path : the file
    topics, take, salvage, on_progress : see `rigd.session._mcap_reader.read_mcap`

    Raises
    ------
    SessionError
        If the file is missing, empty, too large or not an MCAP file.
    """
    with opened(path) as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        return read_mcap(
            memoryview(mapped), topics, take=take, salvage=salvage, on_progress=on_progress
        )


def check_beginning(path: Path) -> None:
    """Check that a file begins as a session file.

    Raises
    ------
    SessionError
        If it is missing, empty or not an MCAP file.
    """
    with opened(path) as file:
        read_mcap(memoryview(file.read(len(MAGIC))), ())


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file; turn errors while it is read as MCAP into session errors."""
    try:
        _refuse_no_file(path)
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise _unreadable(path, error) from None
    except McapTooLargeError as error:
        raise SessionError(f"{path} {error}. Give a shorter session.") from None
    except McapError as error:
        raise _not_mcap(path, error) from None


def _refuse_no_file(path: Path) -> None:
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise SessionError(f"{path} is not a file. Give the path of a session file (*.mcap).")
    if status.st_size == 0:
        raise SessionError(f"{path} is empty, nothing was recorded to it. Record it again.")


def _unreadable(path: Path, error: OSError) -> SessionAccessError:
    return SessionAccessError(
        f"{path} cannot be read: {error.strerror or error}. Check the path and its permissions."
    )


def _not_mcap(path: Path, error: McapError) -> SessionError:
    return SessionError(f"{path} {error}. Give a session file (*.mcap).")


def _damage_message(path: Path, contents: McapContents) -> str:
    from rigd.session._recovery import remedy  # imported here, because it imports this module

    if contents.complete:
        return f"{path} is damaged: it {contents.damage}{remedy(path, was_whole=True)}"
    if is_being_written(path):
        return (
            f"{path} is incomplete, because it is still being recorded. Wait for the end of the "
            "session, or stop it."
        )
    return f"{path} is incomplete: it {contents.damage}{remedy(path, was_whole=False)}"


def merged_metadata(contents: McapContents, name: str) -> dict[str, str] | None:
    """Return the metadata of one name, later records over earlier ones; None without any."""
    records = [record.metadata for record in contents.metadata if record.name == name]
    return {key: value for record in records for key, value in record.items()} if records else None


def _check_ticks(path: Path, samples: npt.NDArray[np.void]) -> None:
    ticks = samples["tick"]
    backward = np.flatnonzero(ticks[1:] <= ticks[:-1])
    if len(backward):
        first = int(backward[0])
        raise SessionError(
            f"{path}: tick {ticks[first + 1]} follows tick {ticks[first]} in {SAMPLE_TOPIC}, but "
            "ticks must increase from sample to sample. Those that do are saved with `rigd recover "
            f"{shlex.quote(str(path))}`."
        )


def _start_utc_ns(
    path: Path, metadata: dict[str, str], log_time: int | None, samples: npt.NDArray[np.void]
) -> int:
    """Return the wall clock at tick 0; `log_time` is that of the first sample."""
    text = metadata.get("start_utc_ns")
    if text is not None:
        if text.isascii() and text.isdigit() and len(text) < 20:
            return int(text)
        raise SessionError(
            f"{path}: start_utc_ns in the metadata 'session' is {quoted(text)}. The writing "
            "program must state it as a whole number of ns since 1970, or leave it out."
        )
    if log_time is not None and len(samples):
        return log_time - int(samples["t_ns"][0])
    return 0


def _segments(path: Path, texts: dict[str, str]) -> dict[str, tuple[int, int]]:
    segments = {}
    for name, text in texts.items():
        numbers = text.split(",")
        if (
            not (len(numbers) == 2 and all(n.isascii() and n.isdigit() for n in numbers))
            or len(text) > 40
        ):
            raise SessionError(
                f"{path}: the segment {quoted(name)} is {quoted(text)}. The writing program "
                "must state it as 'first,end', two whole numbers of ticks."
            )
        first, end = (int(n) for n in numbers)
        if end < first:
            raise SessionError(
                f"{path}: the segment {quoted(name)} ends at tick {end}, before its first, "
                f"{first}. The writing program must correct it."
            )
        segments[name] = (first, end)
    return segments


def _event(message: "Message", t_ns: int) -> LoggedEvent:
    level = getattr(message, "level", 0)
    known = isinstance(level, int) and 0 <= level < len(EVENT_LEVELS)
    return LoggedEvent(
        t_ns=t_ns,
        level=EVENT_LEVELS[level if known else 0],
        name=str(getattr(message, "name", "")),
        message=str(getattr(message, "message", "")),
    )
