"""Reader of session files: returns the whole file as arrays, or raises an error with a remedy."""

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from rigd.session import limits
from rigd.session._contents import load_contents, recovery_advice
from rigd.session._errors import SessionError
from rigd.session._mcap_limits import McapDamageError
from rigd.session._mcap_reader import IsChunkNeeded, McapContents, MessageBlock, OnBlock
from rigd.session._mcap_writer import MESSAGE_HEAD_FORMAT
from rigd.session._message_decoder import (
    CONTROLS,
    SAMPLES,
    TIMINGS,
    TOUCHES,
    MessageDecoder,
    MessageLayout,
    class_of_channel,
    decoded_message,
    quoted_excerpt,
)
from rigd.session._schema import EVENT_LEVELS, EVENT_TOPIC, FORMAT_VERSION, SAMPLE_TOPIC
from rigd.session._writer import is_being_written
from rigd.units import unit_of

if TYPE_CHECKING:
    from google.protobuf.message import Message

ORDER_AND_FLAG_FIELDS: Final = ("t_ns", "tick", "status")
"""Sample fields that show number, order and flags of the samples; read instead of all signals."""
MAX_EVENTS: Final = 100_000
"""Maximum number of events that are read from a session's log."""
MAX_EVENT_BYTES: Final = 1 << 20
"""Maximum length in bytes of a log message that is read; a longer one is replaced by its length."""
MAX_LOG_BYTES: Final = 16 << 20
"""Maximum total length in bytes of the log messages that are read."""

_MIN_ARRAY_GROWTH: Final = 1 << 16
"""Minimum number of messages by which the array of decoded messages grows."""
_MIN_SAMPLE_RECORD_BYTES: Final = 60
"""Assumed minimum size of a sample in the file, in bytes after compression."""
_PART_MARGIN_S: Final = 2.0
"""Time in seconds before and after a part of a session of which chunks are read as well."""
_MAX_CLOCK_DEVIATION: Final = 1e-3
"""Maximum relative deviation of the time stamps from the number of ticks; it widens the margin."""
_MAX_NUMBER_CHARACTERS: Final = 400
"""Maximum length of the text of a number; the longest finite number has 309 integer digits."""


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """Event in the log of a session file."""

    t_ns: int
    """Time of the event in nanoseconds since the session start."""
    level: str
    """Severity: "unknown", "debug", "info", "warning", "error" or "fatal"."""
    name: str
    """Name of the process or component that logged the event."""
    message: str
    """Text of the event for the operator."""


@dataclass(frozen=True, slots=True)
class Session:
    """Content of a session file: samples, metadata, log and attachments."""

    path: Path
    """Path of the session file."""
    samples: npt.NDArray[np.void]
    """Samples, an array (n,) of ``SAMPLE_DTYPE`` with strictly increasing ticks."""
    start_utc_ns: int
    """Wall-clock time of tick 0, in nanoseconds since the Unix epoch."""
    metadata: dict[str, str]
    """Record ``session``: key → text."""
    segments: dict[str, tuple[int, int]]
    """Segment name → first tick and end tick (exclusive). It may be empty."""
    outcome: dict[str, str] | None
    """Record ``outcome``: how the session ended; None if the file does not state it."""
    events: list[LoggedEvent]
    """Events of the session's log, in the order of the file."""
    attachments: dict[str, bytes]
    """Name of an attached file → its contents."""
    omitted_event_count: int = 0
    """Number of further events in the file, which were not read because of the limits."""

    def number(self, key: str, default: float | None = None) -> float:
        """Return the number that the metadata states for a key.

        Parameters
        ----------
        key : key of the record ``session``; its suffix is the unit
        default : number to return if the key is missing; None if the key is required

        Raises
        ------
        SessionError
            If the key is required and missing, or its value is not a finite number.
        """
        number_text = self.metadata.get(key)
        unit_text = f" in {unit_of(key)}" if unit_of(key) else ""
        if number_text is None:
            if default is not None:
                return default
            raise SessionError(
                f"{self.path}: the metadata 'session' has no {key}. The writing program must "
                f"state it as a number{unit_text}."
            )
        try:
            parsed_number = (
                float(number_text) if len(number_text) <= _MAX_NUMBER_CHARACTERS else float("nan")
            )
        except ValueError:
            parsed_number = float("nan")
        if not isfinite(parsed_number):
            raise SessionError(
                f"{self.path}: {key} in the metadata 'session' is {quoted_excerpt(number_text)}, "
                "which is not a finite number. The writing program must state it as a "
                f"number{unit_text}."
            )
        return parsed_number


def read_session(
    path: str | PathLike[str],
    *,
    fields: Sequence[str] | None = None,
    max_samples: int = limits.MAX_SAMPLES,
    on_samples: Callable[[npt.NDArray[np.void]], None] | None = None,
    part_s: tuple[float, float] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Session:
    """Read a complete session file: samples, metadata, log and attachments.

    Parameters
    ----------
    path : path of a complete file, whose format docs/session_format.md defines
    fields : sample fields to store, which must include ``tick`` and ``t_ns``; None for all
    max_samples : maximum number of samples, each of which takes up to 112 bytes of memory
    on_samples : called with each block of samples, with all fields, while the file is read; the
        returned session then has no samples
    part_s : beginning and end of a part, in s since the session's start. Chunks of samples before
        or after it, except those of the segment ``rest``, are neither read nor checked; the samples
        near its ends may be outside the part. By default, all samples are read.
    on_progress : called repeatedly with the completed fraction of the work, from 0 to 1

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
    undecoded_log = _UndecodedLog()
    sample_order = _SampleOrder(path)

    def check_and_forward_samples(sample_block: npt.NDArray[np.void]) -> None:
        assert on_samples is not None
        sample_order.check_samples(sample_block)
        on_samples(sample_block)

    sample_buffer = TopicBuffer(
        path,
        SAMPLES,
        fields,
        max_samples,
        None if on_samples is None else check_and_forward_samples,
    )

    def add_block(mcap_contents: McapContents, block: MessageBlock) -> None:
        sample_buffer.decoder.add_block(mcap_contents, block)
        undecoded_log.add_block(mcap_contents, block)

    mcap_contents = _load_intact_contents(
        path,
        (SAMPLE_TOPIC, EVENT_TOPIC),
        add_block,
        None if part_s is None else _ChunksOfPart(part_s),
        on_progress,
    )
    metadata = merged_metadata(mcap_contents, "session") or {}
    format_version = metadata.get("format_version", FORMAT_VERSION)
    if format_version != FORMAT_VERSION:
        raise SessionError(
            f"{path} is of session format version {quoted_excerpt(format_version)}, and this "
            f"program reads version {FORMAT_VERSION}. Use a newer version of it."
        )
    sample_array = sample_buffer.finish(mcap_contents)
    sample_order.check_samples(sample_array)
    start_utc_ns = _start_utc_ns(
        path, metadata, undecoded_log.first_log_time, sample_order.first_t_ns
    )
    return Session(
        path=path,
        samples=sample_array,
        start_utc_ns=start_utc_ns,
        metadata=metadata,
        segments=_parsed_segments(path, merged_metadata(mcap_contents, "segments") or {}),
        outcome=merged_metadata(mcap_contents, "outcome"),
        events=undecoded_log.events(path, mcap_contents, start_utc_ns),
        attachments={attachment.name: attachment.data for attachment in mcap_contents.attachments},
        omitted_event_count=undecoded_log.omitted_count,
    )


def read_timings(path: str | PathLike[str]) -> npt.NDArray[np.void]:
    """Read the ages of the angle and wrench readings at each tick of a session.

    Returns
    -------
    array (n,) of ``TIMING_DTYPE``; empty if the file contains no ages

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _read_topic(Path(path), TIMINGS)


def read_controls(path: str | PathLike[str]) -> npt.NDArray[np.void]:
    """Read the torques of the controller's terms (proportional, integral, …) in a session.

    Returns
    -------
    array (n,) of ``CONTROL_DTYPE``; empty if the file contains no controller terms

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _read_topic(Path(path), CONTROLS)


def read_touches(path: str | PathLike[str]) -> npt.NDArray[np.void]:
    """Read the contacts of the beam with an obstacle that were estimated during a session.

    Returns
    -------
    array (n,) of ``TOUCH_DTYPE``; empty if the file contains no touches

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _read_topic(Path(path), TOUCHES)


def _read_topic(path: Path, layout: MessageLayout) -> npt.NDArray[np.void]:
    """Return all messages of one topic of a session file as an array (n,)."""
    topic_buffer = TopicBuffer(path, layout, None, limits.MAX_SAMPLES)
    return topic_buffer.finish(
        _load_intact_contents(path, (layout.topic,), topic_buffer.decoder.add_block)
    )


class TopicBuffer:
    """Growing array of the decoded messages of one topic.

    The path of the file is for its size and for error messages. `fields` are the names of the
    fields to store; None for all. More than `max_messages` messages raise an error. If there is
    `on_messages`, it is called with each block of messages, with all fields, and no message is
    stored.
    """

    def __init__(
        self,
        path: Path,
        layout: MessageLayout,
        fields: Sequence[str] | None,
        max_messages: int,
        on_messages: Callable[[npt.NDArray[np.void]], None] | None = None,
    ) -> None:
        self.decoder = MessageDecoder(path, layout, self, None if on_messages else fields)
        self._path = path
        self._topic = layout.topic
        self._max_messages = max_messages
        self._on_messages = on_messages
        # Unused memory of the array is never allocated, and most files need no more.
        expected_messages = (
            0 if on_messages else min(_file_size(path) // _MIN_SAMPLE_RECORD_BYTES, max_messages)
        )
        self._array = np.empty(expected_messages, layout.dtype_of(fields))
        self._message_count = 0

    def next_message_array(self, message_count: int) -> npt.NDArray[np.void]:
        """Return the elements of the array that the next `message_count` messages fill.

        Raises SessionError if there are more messages than `max_messages`.
        """
        messages_end = self._message_count + message_count
        if messages_end > self._max_messages:
            raise SessionError(
                f"{self._path} holds more than the {self._max_messages} messages of {self._topic} "
                "that fit into the memory that reading a session may take. Give a shorter session, "
                "or a part of it (--from and --to of analyze, and of analyze export record)."
            )
        if self._on_messages is not None:
            return np.empty(message_count, self.decoder.dtype)
        if messages_end > len(self._array):
            # Resized without a copy, by a small fraction: two arrays would take too much memory.
            new_length = max(
                messages_end, len(self._array) + max(_MIN_ARRAY_GROWTH, len(self._array) // 8)
            )
            self._array.resize(min(new_length, self._max_messages), refcheck=False)
        return self._array[self._message_count : messages_end]

    def store(self, messages: npt.NDArray[np.void]) -> None:
        """Count the decoded messages, and pass them to `on_messages` if they are not stored."""
        if self._on_messages is not None:
            self._on_messages(messages)
        self._message_count += len(messages)

    def finish(self, contents: McapContents) -> npt.NDArray[np.void]:
        """Decode the remaining messages, and return all of them as an array (n,).

        Raises SessionError if the messages violate the format, or if there are too many.
        """
        self.decoder.finish(contents)
        if self._on_messages is None:
            self._array.resize(self._message_count, refcheck=False)
        # The decoder refers to this buffer: the cycle would retain the array of a long file.
        del self.decoder
        return self._array


def _file_size(path: Path) -> int:
    """Return the length of a file in bytes, or 0 if it cannot be determined."""
    try:
        return path.stat().st_size
    except OSError:  # reported when the file is opened
        return 0


class _UndecodedLog:
    """Undecoded messages of a session's log, of limited number and length."""

    def __init__(self) -> None:
        self.first_log_time: int | None = None
        """Log time of the file's first sample, in nanoseconds since the Unix epoch."""
        self.omitted_count = 0
        """Number of log messages that were not stored because of the limits."""
        self._stored_messages: list[tuple[int, int, bytes | int]] = []
        """For each log message: channel, log time in ns, and its data or the length of it."""
        self._stored_bytes = 0

    def add_block(self, contents: McapContents, block: MessageBlock) -> None:
        """Store the log messages of a block, and the log time of the first sample."""
        records = block.records
        for channel, message_size, run_start, message_count in block.runs:
            topic = contents.channels[channel].topic
            if topic == SAMPLE_TOPIC:
                if self.first_log_time is None:
                    self.first_log_time = int(
                        MESSAGE_HEAD_FORMAT.unpack_from(records, run_start)[4]
                    )
                continue
            remaining_count = MAX_EVENTS - len(self._stored_messages)
            for record_offset in range(
                run_start,
                run_start + message_size * min(message_count, remaining_count),
                message_size,
            ):
                log_time = int(MESSAGE_HEAD_FORMAT.unpack_from(records, record_offset)[4])
                data_length = message_size - MESSAGE_HEAD_FORMAT.size
                if data_length > MAX_EVENT_BYTES:
                    self._stored_messages.append((channel, log_time, data_length))
                elif self._stored_bytes + data_length > MAX_LOG_BYTES:
                    self.omitted_count += 1
                else:
                    self._stored_bytes += data_length
                    message_data = bytes(
                        records[
                            record_offset + MESSAGE_HEAD_FORMAT.size : record_offset + message_size
                        ]
                    )
                    self._stored_messages.append((channel, log_time, message_data))
            self.omitted_count += max(message_count - remaining_count, 0)

    def events(self, path: Path, contents: McapContents, start_utc_ns: int) -> list[LoggedEvent]:
        """Return the decoded log messages; a log whose encoding is not protobuf is left out."""
        logged_events: list[LoggedEvent] = []
        decoder_by_channel: dict[int, Callable[[bytes], Message]] = {}
        for channel, log_time, message_data in self._stored_messages:
            if contents.channels[channel].message_encoding != "protobuf":
                continue
            t_ns = log_time - start_utc_ns
            if isinstance(message_data, int):
                logged_events.append(
                    LoggedEvent(
                        t_ns, "unknown", "", f"(a message of {message_data} bytes, not read)"
                    )
                )
                continue
            if channel not in decoder_by_channel:
                if len(decoder_by_channel) == limits.MAX_CHANNELS_PER_TOPIC:
                    raise SessionError(
                        f"{path} has more than {limits.MAX_CHANNELS_PER_TOPIC} channels "
                        f"{EVENT_TOPIC}. The writing program must put all such messages into one."
                    )
                decoder_by_channel[channel] = class_of_channel(path, contents, channel).FromString
            log_message = decoded_message(
                path, EVENT_TOPIC, decoder_by_channel[channel], message_data
            )
            logged_events.append(_decoded_event(log_message, t_ns))
        return logged_events


class _ChunksOfPart:
    """Selection of the first chunk, and of those of a part and of the segment ``rest``.

    Every chunk is selected of a file that does not state its rate and its start before the samples.
    The chunks of the part follow each other in the file. If others are between them, their stated
    times are wrong, and `McapDamageError` is raised.
    """

    def __init__(self, part_s: tuple[float, float]) -> None:
        self._part_s = part_s
        self._log_time_ranges: list[tuple[float, float]] | None = None  # of rest and part
        self._part_state = "before"  # whether the chunk is before, in or after the part

    def __call__(self, contents: McapContents, first_log_time: int, last_log_time: int) -> bool:
        """Return whether a chunk with messages between two log times is needed."""
        is_first = self._log_time_ranges is None  # it may declare the channels of all
        if self._log_time_ranges is None:
            self._log_time_ranges = self._ranges_of_log_time(contents)
        (rest_first, rest_last), (part_first, part_last) = self._log_time_ranges
        is_in_rest = first_log_time <= rest_last and last_log_time >= rest_first
        if first_log_time <= part_last and last_log_time >= part_first:
            if self._part_state == "after":
                raise McapDamageError("states times of its chunks that do not increase")
            self._part_state = "in"
            return True
        if self._part_state == "in":
            self._part_state = "after"
        return is_first or is_in_rest

    def _ranges_of_log_time(self, contents: McapContents) -> list[tuple[float, float]]:
        """Return first and last log time in ns of rest and part, with a margin around each."""
        metadata = merged_metadata(contents, "session") or {}
        segments = merged_metadata(contents, "segments") or {}
        try:
            start_utc_ns = np.uint64(metadata["start_utc_ns"]).item()
            rest_end_s = int(segments.get("rest", "0,0").split(",")[1]) / float(metadata["rate_hz"])
        except (KeyError, ValueError, ArithmeticError, IndexError):
            return [(-inf, inf), (-inf, inf)]

        def log_time(time_s: float, side: int) -> float:
            margin_s = _PART_MARGIN_S + _MAX_CLOCK_DEVIATION * abs(time_s)
            return start_utc_ns + 1e9 * (time_s + side * margin_s)

        return [
            (log_time(from_s, -1), log_time(to_s, 1))
            for from_s, to_s in ((0.0, rest_end_s), self._part_s)
        ]


def _load_intact_contents(
    path: Path,
    topics: Sequence[str],
    on_block: OnBlock,
    is_chunk_needed: IsChunkNeeded | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> McapContents:
    """Return the contents of a session file; raise if it is incomplete or damaged."""
    contents = load_contents(
        path, topics, on_block=on_block, on_progress=on_progress, is_chunk_needed=is_chunk_needed
    )
    if contents.damage is not None:
        raise SessionError(_damage_message(path, contents))
    if SAMPLE_TOPIC not in {channel.topic for channel in contents.channels.values()}:
        raise no_samples_error(path)
    return contents


def no_samples_error(path: Path) -> SessionError:
    """Return the error for an MCAP file that has no channel of samples."""
    return SessionError(
        f"{path} is an MCAP file without the channel {SAMPLE_TOPIC}, so it is not a session. "
        "Give a file that `rigd run` or a program following docs/session_format.md recorded."
    )


def _damage_message(path: Path, contents: McapContents) -> str:
    """Return the error message for an incomplete or damaged file, with the remedy."""
    if contents.is_complete:
        return f"{path} is damaged: it {contents.damage}{recovery_advice(path, was_complete=True)}"
    if is_being_written(path):
        return (
            f"{path} is incomplete, because it is still being recorded. Wait for the end of the "
            "session, or stop it."
        )
    return f"{path} is incomplete: it {contents.damage}{recovery_advice(path, was_complete=False)}"


def merged_metadata(contents: McapContents, record_name: str) -> dict[str, str] | None:
    """Return the metadata records of one name as one dictionary, or None if there are none.

    A later record replaces the values of an earlier one.
    """
    record_contents = [
        record.metadata for record in contents.metadata if record.name == record_name
    ]
    return (
        {
            key: metadata_value
            for record in record_contents
            for key, metadata_value in record.items()
        }
        if record_contents
        else None
    )


class _SampleOrder:
    """Check that the ticks of samples, which arrive in blocks, increase strictly."""

    def __init__(self, path: Path) -> None:
        self.first_t_ns: int | None = None
        """Time of the first sample in nanoseconds since the session start."""
        self._path = path
        self._last_tick: int | None = None

    def check_samples(self, samples: npt.NDArray[np.void]) -> None:
        """Check the next samples; raise SessionError if their ticks do not increase."""
        ticks = samples["tick"]
        if not len(ticks):
            return
        if self.first_t_ns is None:
            self.first_t_ns = int(samples["t_ns"][0])
        if self._last_tick is not None and ticks[0] <= self._last_tick:
            raise self._order_error(self._last_tick, int(ticks[0]))
        self._last_tick = int(ticks[-1])
        backward_indices = np.flatnonzero(ticks[1:] <= ticks[:-1])
        if len(backward_indices):
            raise self._order_error(*ticks[backward_indices[0] :][:2].tolist())

    def _order_error(self, tick: int, next_tick: int) -> SessionError:
        """Return the error for two consecutive samples whose ticks do not increase."""
        return SessionError(
            f"{self._path}: tick {next_tick} follows tick {tick} in {SAMPLE_TOPIC}, but "
            "ticks must increase from sample to sample. Those that do are saved with `rigd recover "
            f"{shlex.quote(str(self._path))}`."
        )


def _start_utc_ns(
    path: Path, metadata: dict[str, str], first_log_time_ns: int | None, first_t_ns: int | None
) -> int:
    """Return the wall-clock time of tick 0 in nanoseconds since the Unix epoch, or 0 if unknown.

    The metadata state this time. If not, it is the first sample's log time minus its time
    `first_t_ns` since the start of the session.
    """
    start_time_text = metadata.get("start_utc_ns")
    if start_time_text is not None:
        if start_time_text.isascii() and start_time_text.isdigit() and len(start_time_text) < 20:
            return int(start_time_text)
        raise SessionError(
            f"{path}: start_utc_ns in the metadata 'session' is "
            f"{quoted_excerpt(start_time_text)}. The "
            "writing program must state it as a whole number of ns since 1970, or leave it out."
        )
    if first_log_time_ns is not None and first_t_ns is not None:
        return first_log_time_ns - first_t_ns
    return 0


def _parsed_segments(path: Path, segment_texts: dict[str, str]) -> dict[str, tuple[int, int]]:
    """Return the segments, name → (first tick, end tick), from the texts of record ``segments``."""
    segments = {}
    for segment_name, ticks_text in segment_texts.items():
        tick_texts = ticks_text.split(",")
        if (
            not (len(tick_texts) == 2 and all(n.isascii() and n.isdigit() for n in tick_texts))
            or len(ticks_text) > 40
        ):
            raise SessionError(
                f"{path}: the segment {quoted_excerpt(segment_name)} is "
                f"{quoted_excerpt(ticks_text)}. The "
                "writing program must state it as 'first,end', two whole numbers of ticks."
            )
        first, end = (int(n) for n in tick_texts)
        if end < first:
            raise SessionError(
                f"{path}: the segment {quoted_excerpt(segment_name)} ends at tick {end}, before "
                f"its first, {first}. The writing program must correct it."
            )
        segments[segment_name] = (first, end)
    return segments


def _decoded_event(log_message: "Message", t_ns: int) -> LoggedEvent:
    """Return the event of a decoded log message."""
    level_number = getattr(log_message, "level", 0)
    is_level_known = isinstance(level_number, int) and 0 <= level_number < len(EVENT_LEVELS)
    return LoggedEvent(
        t_ns=t_ns,
        level=EVENT_LEVELS[level_number if is_level_known else 0],
        name=str(getattr(log_message, "name", "")),
        message=str(getattr(log_message, "message", "")),
    )
