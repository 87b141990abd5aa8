"""Reader of session files: the whole file to arrays, or an error that says what is wrong."""

import mmap
import shlex
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from rigd.session.durable import is_being_written
from rigd.session.errors import SessionError
from rigd.session.format import (
    CONTROL_DTYPE,
    CONTROL_TYPES,
    CONTROL_WIRE_DTYPE,
    SAMPLE_DTYPE,
    SAMPLE_TYPES,
    SAMPLE_WIRE_DTYPE,
    TIMING_DTYPE,
    TIMING_TYPES,
    TIMING_WIRE_DTYPE,
    is_fixed_layout,
    to_native,
)
from rigd.session.mcap_reader import (
    MAX_TOTAL_BYTES,
    McapContents,
    McapError,
    McapTooLargeError,
    read_mcap,
)
from rigd.session.mcap_writer import MESSAGE_HEAD
from rigd.session.schema import (
    CONTROL_SCHEMA,
    CONTROL_TOPIC,
    EVENT_LEVELS,
    EVENT_TOPIC,
    FORMAT_VERSION,
    SAMPLE_SCHEMA,
    SAMPLE_TOPIC,
    TIMING_SCHEMA,
    TIMING_TOPIC,
    message_class,
    schema_data,
)

if TYPE_CHECKING:
    from google.protobuf.message import Message

MAX_EVENTS: Final = 100_000
"""Most lines of a session's log that are read."""

_UNITS: Final = {
    "_kg_m2": "kg·m²",
    "_kg_per_m": "kg/m",
    "_n_m2": "N·m²",
    "_hz": "Hz",
    "_rad": "rad",
    "_ns": "ns",
    "_nm": "N·m",
    "_m": "m",
    "_s": "s",
}
"""Suffix of a key → its unit, the longer suffixes first."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """A channel of fixed-layout messages."""

    topic: str
    schema_name: str
    types: dict[str, str]
    required: tuple[str, ...]
    """Fields that a schema cannot leave out; any other absent one reads as 0."""
    record_dtype: np.dtype[np.void]
    """A message record in the file: its ``head``, then the ``wire`` form."""
    dtype: np.dtype[np.void]


def _record_dtype(wire_dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    return np.dtype([("head", f"V{MESSAGE_HEAD.size}"), ("wire", wire_dtype)])


_SAMPLES: Final = _Layout(
    SAMPLE_TOPIC,
    SAMPLE_SCHEMA,
    SAMPLE_TYPES,
    ("t_ns", "tick", "angle_rad", "coupling_torque_nm"),
    _record_dtype(SAMPLE_WIRE_DTYPE),
    SAMPLE_DTYPE,
)
_CONTROLS: Final = _Layout(
    CONTROL_TOPIC,
    CONTROL_SCHEMA,
    CONTROL_TYPES,
    ("t_ns", "tick"),
    _record_dtype(CONTROL_WIRE_DTYPE),
    CONTROL_DTYPE,
)


_TIMINGS: Final = _Layout(
    TIMING_TOPIC,
    TIMING_SCHEMA,
    TIMING_TYPES,
    ("t_ns", "tick"),
    _record_dtype(TIMING_WIRE_DTYPE),
    TIMING_DTYPE,
)


@dataclass(frozen=True, slots=True)
class Event:
    """A line of the session's log."""

    t_ns: int
    """ns since the session start."""
    level: str
    """"unknown", "debug", "info", "warning", "error" or "fatal"."""
    name: str
    """Process or part that spoke."""
    message: str


@dataclass(frozen=True, slots=True)
class Session:
    """A session as recorded."""

    path: Path
    samples: npt.NDArray[np.void]
    """(n,) of ``SAMPLE_DTYPE``, ticks strictly increasing."""
    start_utc_ns: int
    """Wall clock at tick 0, ns since the Unix epoch."""
    metadata: dict[str, str]
    """The record ``session``."""
    segments: dict[str, tuple[int, int]]
    """Name → first tick and end (exclusive); may be empty."""
    outcome: dict[str, str] | None
    """How the session ended, None if the file does not tell."""
    events: list[Event]
    attachments: dict[str, bytes]

    def number(self, key: str, default: float | None = None) -> float:
        """Return a number of the metadata.

        Parameters
        ----------
        key : of the record ``session``; its suffix is its unit
        default : what to return without that key; None if the key is required

        Raises
        ------
        SessionError
            If the key is required and missing, or its value is not a finite number.
        """
        text = self.metadata.get(key)
        unit = next((f" in {u}" for suffix, u in _UNITS.items() if key.endswith(suffix)), "")
        if text is None:
            if default is not None:
                return default
            raise SessionError(
                f"{self.path}: the metadata 'session' has no {key}. Whoever writes the file must "
                f"state it as a number{unit}."
            )
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not isfinite(value):
            raise SessionError(
                f"{self.path}: {key} in the metadata 'session' is {_quoted(text)}, which is not a "
                f"finite number. Whoever writes the file must state it as a number{unit}."
            )
        return value


def read_session(path: Path, *, max_bytes: int = MAX_TOTAL_BYTES) -> Session:
    """Read a whole session file.

    Parameters
    ----------
    path : a complete file as docs/session_format.md defines it
    max_bytes : most memory that its messages may take, about; a sample takes 150 bytes

    Raises
    ------
    SessionError
        If the file is missing, empty, not an MCAP file, incomplete, damaged, too large, of a later
        format version, or no session.
    """
    contents = _load(path, (SAMPLE_TOPIC, EVENT_TOPIC), max_bytes=max_bytes)
    metadata = merged_metadata(contents, "session") or {}
    version = metadata.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise SessionError(
            f"{path} is of session format version {_quoted(version)}, and this program reads "
            f"version {FORMAT_VERSION}. Use a newer version of it."
        )
    samples = load_samples(path, contents)
    start_utc_ns = _start_utc_ns(path, metadata, contents, samples)
    return Session(
        path=path,
        samples=samples,
        start_utc_ns=start_utc_ns,
        metadata=metadata,
        segments=_segments(path, merged_metadata(contents, "segments") or {}),
        outcome=merged_metadata(contents, "outcome"),
        events=_events(path, contents, start_utc_ns),
        attachments={attachment.name: attachment.data for attachment in contents.attachments},
    )


def read_timings(path: Path) -> npt.NDArray[np.void]:
    """Read the ages of the readings of a session file.

    Returns
    -------
    array (n,) of ``TIMING_DTYPE``; empty if the file has none

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _decode_topic(path, _load(path, (TIMING_TOPIC,)), _TIMINGS)


def read_controls(path: Path) -> npt.NDArray[np.void]:
    """Read the controller's terms of a session file.

    Returns
    -------
    array (n,) of ``CONTROL_DTYPE``; empty if the file has none

    Raises
    ------
    SessionError
        As `read_session` does.
    """
    return _decode_topic(path, _load(path, (CONTROL_TOPIC,)), _CONTROLS)


def _quoted(text: str) -> str:
    """Quote a value of the file, which may be of any length and contain anything."""
    return repr(text if len(text) <= 40 else text[:40] + "…")


def _load(path: Path, topics: Sequence[str], *, max_bytes: int = MAX_TOTAL_BYTES) -> McapContents:
    """Read the container of a session file that must be complete and sound."""
    contents = load_contents(path, topics, max_bytes=max_bytes)
    if contents.damage is not None:
        raise SessionError(_damage_message(path, contents))
    if SAMPLE_TOPIC not in {channel.topic for channel in contents.channels.values()}:
        raise SessionError(
            f"{path} is an MCAP file without the channel {SAMPLE_TOPIC}, so it is no session. "
            "Give a file that `rigd run` or a program following docs/session_format.md recorded."
        )
    return contents


def load_contents(
    path: Path,
    topics: Sequence[str],
    *,
    salvage: bool = False,
    max_bytes: int = MAX_TOTAL_BYTES,
    on_progress: Callable[[float], None] | None = None,
) -> McapContents:
    """Read the container of a file as far as it is sound.

    Parameters
    ----------
    path : the file
    topics, salvage, max_bytes, on_progress : as `rigd.session.mcap_reader.read_mcap` takes them

    Raises
    ------
    SessionError
        If the file is missing, empty, too large or not an MCAP file.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise SessionError(f"{path} is not a file. Give the path of a session file (*.mcap).")
        if status.st_size == 0:
            raise SessionError(f"{path} is empty, nothing was recorded to it. Record it again.")
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        return read_mcap(
            memoryview(mapped), topics, salvage=salvage, max_bytes=max_bytes,
            on_progress=on_progress,
        )  # fmt: skip
    except OSError as error:
        raise SessionError(
            f"{path} cannot be read: {error.strerror or error}. Check the path and its permissions."
        ) from None
    except McapTooLargeError as error:
        raise SessionError(f"{path} {error}. Give a shorter session.") from None
    except McapError as error:
        raise SessionError(f"{path} {error}. Give a session file (*.mcap).") from None


def load_samples(path: Path, contents: McapContents) -> npt.NDArray[np.void]:
    """Decode the samples of a file that was read with their topic.

    Raises
    ------
    SessionError
        If they are not what the format asks for.
    """
    samples = _decode_topic(path, contents, _SAMPLES)
    _check_ticks(path, samples)
    return samples


def _damage_message(path: Path, contents: McapContents) -> str:
    remedy = f"`rigd recover {shlex.quote(str(path))}`"
    if contents.complete:
        return (
            f"{path} is damaged: it {contents.damage}. Copy it again from where it was recorded, "
            f"or save what is intact with {remedy}."
        )
    if is_being_written(path):
        return (
            f"{path} is incomplete, because it is still being recorded. Wait for the end of the "
            "session, or stop it."
        )
    readable = contents.count(SAMPLE_TOPIC)
    advice = f"Save them with {remedy}" if readable else "Record the session again"
    return (
        f"{path} is incomplete: it {contents.damage}; {readable} complete samples are readable "
        f"before that. {advice}."
    )


def merged_metadata(contents: McapContents, name: str) -> dict[str, str] | None:
    """Return the metadata of one name, later records over earlier ones; None without any."""
    records = [record.metadata for record in contents.metadata if record.name == name]
    return {key: value for record in records for key, value in record.items()} if records else None


def _message_class(path: Path, contents: McapContents, channel_id: int) -> "type[Message]":
    """Return the class that decodes the messages of a channel, by the schema in the file."""
    channel = contents.channels[channel_id]
    schema = contents.schemas.get(channel.schema_id)
    if channel.message_encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        raise SessionError(
            f"{path}: {channel.topic} has the encoding {_quoted(channel.message_encoding)} and the "
            f"schema encoding {_quoted(schema.encoding if schema else '')}. A session file has "
            "protobuf there, for both."
        )
    try:
        return message_class(schema.name, schema.data)
    except ValueError as error:
        raise SessionError(
            f"{path}: {channel.topic} cannot be decoded, because its {error}. Whoever writes the "
            "file must put a FileDescriptorSet with all it needs there."
        ) from None


def _has_fixed_schema(path: Path, contents: McapContents, channel_id: int, layout: _Layout) -> bool:
    """Tell whether a channel's schema gives every field the number and type of the fixed layout.

    Raises
    ------
    SessionError
        If by that schema messages cannot be decoded to the layout's fields at all.
    """
    channel = contents.channels[channel_id]
    schema = contents.schemas.get(channel.schema_id)
    if (
        channel.message_encoding == "protobuf"
        and schema is not None
        and (schema.name, schema.encoding) == (layout.schema_name, "protobuf")
        and schema.data == schema_data(layout.schema_name)
    ):
        return True
    decoding = _message_class(path, contents, channel_id)
    empty = decoding()
    fixed = True
    for number, (name, kind) in enumerate(layout.types.items(), start=1):
        declared = decoding.DESCRIPTOR.fields_by_name.get(name)
        if declared is None:
            if name in layout.required:
                raise SessionError(
                    f"{path}: the schema of {layout.topic} has no field {name}, which is required "
                    f"there, of type {kind}."
                )
            fixed = False
            continue
        # What an empty message holds tells singular numbers from everything else.
        if not isinstance(getattr(empty, name), float | int if kind == "double" else int):
            raise SessionError(
                f"{path}: the field {name} of {layout.topic} is not of a type that can be read as "
                f"{kind}, which it should be."
            )
        expected = getattr(declared, f"TYPE_{kind.upper()}")
        fixed = fixed and declared.number == number and declared.type == expected
    return fixed


def _decode_topic(path: Path, contents: McapContents, layout: _Layout) -> npt.NDArray[np.void]:
    """Decode all messages of a channel, in the order of the file.

    Messages of the fixed layout, under a schema that says so, are taken as they are; any other is
    decoded with protobuf by the schema in the file.
    """
    has_fixed_schema = {
        channel.id: _has_fixed_schema(path, contents, channel.id, layout)
        for channel in contents.channels.values()
        if channel.topic == layout.topic
    }
    native = np.empty(contents.count(layout.topic), layout.dtype)
    start = 0
    for run in contents.runs[layout.topic]:
        is_fixed = has_fixed_schema[run.channel] and run.size == layout.record_dtype.itemsize
        for block in run.blocks():
            out = native[start : start + len(block) // run.size]
            places = _take_fixed(block, layout, out) if is_fixed else range(len(out))
            if len(places):
                decode = _message_class(path, contents, run.channel).FromString
                heads = [i * run.size + MESSAGE_HEAD.size for i in places]
                tail = run.size - MESSAGE_HEAD.size
                messages = [block[head : head + tail] for head in heads]
                out[places] = _decoded_fields(path, layout, decode, messages)
            start += len(out)
    return native


def _take_fixed(block: bytes, layout: _Layout, out: npt.NDArray[np.void]) -> Sequence[int]:
    """Decode message records of the fixed length into `out`; return the places of wrong layout."""
    wire = np.frombuffer(block, layout.record_dtype)["wire"]
    to_native(wire, layout.types, out)
    fixed = is_fixed_layout(wire, layout.types)
    return () if fixed.all() else np.flatnonzero(~fixed).tolist()


def _decoded_fields(
    path: Path, layout: _Layout, decode: "Callable[[bytes], Message]", messages: list[bytes]
) -> npt.NDArray[np.void]:
    """Decode messages with protobuf to the layout's fields, absent ones as 0."""
    decoded = [_decoded(path, layout.topic, decode, data) for data in messages]
    try:
        return np.array(
            [tuple([getattr(each, name, 0) for name in layout.types]) for each in decoded],
            layout.dtype,
        )
    except OverflowError as error:
        raise SessionError(
            f"{path}: a message of {layout.topic} holds a number that its field cannot take "
            f"({error}). Whoever writes the file must keep to the types of the format."
        ) from None


def _decoded(
    path: Path, topic: str, decode: "Callable[[bytes], Message]", data: bytes
) -> "Message":
    from google.protobuf.message import DecodeError

    try:
        return decode(data)
    except DecodeError:
        raise SessionError(
            f"{path}: a message of {topic} is not what its schema says. The file is damaged or was "
            "not written as the format asks."
        ) from None


def _check_ticks(path: Path, samples: npt.NDArray[np.void]) -> None:
    ticks = samples["tick"].astype(np.int64)
    backward = np.flatnonzero(np.diff(ticks) <= 0)
    if len(backward):
        first = int(backward[0])
        raise SessionError(
            f"{path}: tick {ticks[first + 1]} follows tick {ticks[first]} in {SAMPLE_TOPIC}, but "
            "ticks must increase from sample to sample. The file was not written as the format "
            "asks."
        )


def _start_utc_ns(
    path: Path, metadata: dict[str, str], contents: McapContents, samples: npt.NDArray[np.void]
) -> int:
    text = metadata.get("start_utc_ns")
    if text is not None:
        if text.isascii() and text.isdigit() and len(text) < 20:
            return int(text)
        raise SessionError(
            f"{path}: start_utc_ns in the metadata 'session' is {_quoted(text)}. Whoever writes "
            "the file must state it as a whole number of ns since 1970, or leave it out."
        )
    if len(samples):
        log_time = int(MESSAGE_HEAD.unpack_from(contents.runs[SAMPLE_TOPIC][0].pieces[0])[4])
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
                f"{path}: the segment {_quoted(name)} is {_quoted(text)}. Whoever writes the file "
                "must state it as 'first,end', two whole numbers of ticks."
            )
        first, end = (int(n) for n in numbers)
        if end < first:
            raise SessionError(
                f"{path}: the segment {_quoted(name)} ends at tick {end}, before its first, "
                f"{first}. Whoever writes the file must correct it."
            )
        segments[name] = (first, end)
    return segments


def _events(path: Path, contents: McapContents, start_utc_ns: int) -> list[Event]:
    """Decode the log; a log that is not protobuf is left out, because no reader needs one."""
    events: list[Event] = []
    if contents.count(EVENT_TOPIC) > MAX_EVENTS:
        raise SessionError(
            f"{path} has {contents.count(EVENT_TOPIC)} messages in {EVENT_TOPIC}, more than the "
            f"{MAX_EVENTS} that are read. Whoever writes the file must log less."
        )
    for run in contents.runs[EVENT_TOPIC]:
        if contents.channels[run.channel].message_encoding != "protobuf":
            continue
        decode = _message_class(path, contents, run.channel).FromString
        records = b"".join(run.pieces)
        for start in range(0, len(records), run.size):
            log_time = int(MESSAGE_HEAD.unpack_from(records, start)[4])
            data = records[start + MESSAGE_HEAD.size : start + run.size]
            events.append(
                _event(_decoded(path, EVENT_TOPIC, decode, data), log_time - start_utc_ns)
            )
    return events


def _event(message: "Message", t_ns: int) -> Event:
    level = getattr(message, "level", 0)
    known = isinstance(level, int) and 0 <= level < len(EVENT_LEVELS)
    return Event(
        t_ns=t_ns,
        level=EVENT_LEVELS[level if known else 0],
        name=str(getattr(message, "name", "")),
        message=str(getattr(message, "message", "")),
    )
