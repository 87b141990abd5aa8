"""Reader of session files: the whole file to arrays, or an error that says what is wrong."""

import mmap
import stat
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.session.errors import SessionError
from rigd.session.format import (
    CONTROL_DTYPE,
    CONTROL_TYPES,
    CONTROL_WIRE_DTYPE,
    SAMPLE_DTYPE,
    SAMPLE_TYPES,
    SAMPLE_WIRE_DTYPE,
    is_fixed_layout,
    to_native,
)
from rigd.session.mcap_reader import MESSAGE_HEAD, McapContents, McapError, read_mcap
from rigd.session.schema import (
    CONTROL_SCHEMA,
    CONTROL_TOPIC,
    EVENT_LEVELS,
    EVENT_TOPIC,
    FORMAT_VERSION,
    SAMPLE_SCHEMA,
    SAMPLE_TOPIC,
    message_class,
    schema_data,
)

if TYPE_CHECKING:
    from google.protobuf.message import Message

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
    wire_dtype: np.dtype[np.void]
    dtype: np.dtype[np.void]


_SAMPLES: Final = _Layout(
    SAMPLE_TOPIC,
    SAMPLE_SCHEMA,
    SAMPLE_TYPES,
    ("t_ns", "tick", "angle_rad", "coupling_torque_nm"),
    SAMPLE_WIRE_DTYPE,
    SAMPLE_DTYPE,
)
_CONTROLS: Final = _Layout(
    CONTROL_TOPIC,
    CONTROL_SCHEMA,
    CONTROL_TYPES,
    ("t_ns", "tick"),
    CONTROL_WIRE_DTYPE,
    CONTROL_DTYPE,
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


def read_session(path: Path) -> Session:
    """Read a whole session file.

    Parameters
    ----------
    path : a complete file as docs/session_format.md defines it

    Raises
    ------
    SessionError
        If the file is missing, empty, not an MCAP file, incomplete, damaged, of a later format
        version, or no session.
    """
    contents = _load(path, (SAMPLE_TOPIC, EVENT_TOPIC))
    metadata = _merged(contents, "session") or {}
    version = metadata.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise SessionError(
            f"{path} is of session format version {_quoted(version)}, and this program reads "
            f"version {FORMAT_VERSION}. Use a newer version of it."
        )
    samples = _decode_topic(path, contents, _SAMPLES)
    _check_ticks(path, samples)
    start_utc_ns = _start_utc_ns(path, metadata, contents, samples)
    return Session(
        path=path,
        samples=samples,
        start_utc_ns=start_utc_ns,
        metadata=metadata,
        segments=_segments(path, _merged(contents, "segments") or {}),
        outcome=_merged(contents, "outcome"),
        events=_events(path, contents, start_utc_ns),
        attachments={attachment.name: attachment.data for attachment in contents.attachments},
    )


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
    contents = _load(path, (CONTROL_TOPIC,))
    return _decode_topic(path, contents, _CONTROLS)


def _quoted(text: str) -> str:
    """Quote a value of the file, which may be of any length and contain anything."""
    return repr(text if len(text) <= 40 else text[:40] + "…")


def _load(path: Path, topics: Sequence[str]) -> McapContents:
    """Read the container of a session file that must be complete and sound."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise SessionError(f"{path} is not a file. Give the path of a session file (*.mcap).")
        if status.st_size == 0:
            raise SessionError(f"{path} is empty, nothing was recorded to it. Record it again.")
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        contents = read_mcap(memoryview(mapped), topics)
    except OSError as error:
        raise SessionError(
            f"{path} cannot be read: {error.strerror or error}. Check the path and its permissions."
        ) from None
    except McapError as error:
        raise SessionError(f"{path} {error}. Give a session file (*.mcap).") from None
    if contents.damage is not None:
        raise SessionError(_damage_message(path, contents))
    if SAMPLE_TOPIC not in {channel.topic for channel in contents.channels.values()}:
        raise SessionError(
            f"{path} is an MCAP file without the channel {SAMPLE_TOPIC}, so it is no session. "
            "Give a file that `rigd run` or a program following docs/session_format.md recorded."
        )
    return contents


def _damage_message(path: Path, contents: McapContents) -> str:
    if contents.complete:
        return (
            f"{path} is damaged: it {contents.damage}. Copy it again from where it was recorded, "
            "or record the session again."
        )
    return (
        f"{path} is incomplete: it {contents.damage}; {contents.count(SAMPLE_TOPIC)} complete "
        "samples are readable before that. If it is still being recorded, wait for the end; if "
        "not, save them with a tool that recovers MCAP files (`mcap recover`, https://mcap.dev) "
        "or record the session again."
    )


def _merged(contents: McapContents, name: str) -> dict[str, str] | None:
    """Return the metadata of one name, later records over earlier ones; None without any."""
    records = [record.metadata for record in contents.metadata if record.name == name]
    return {key: value for record in records for key, value in record.items()} if records else None


def _message_class(path: Path, contents: McapContents, channel_id: int) -> "type[Message]":
    """Return the class that decodes the messages of a channel, by the schema in the file."""
    channel = contents.channels[channel_id]
    schema = contents.schemas.get(channel.schema_id)
    if channel.message_encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        raise SessionError(
            f"{path}: {channel.topic} is encoded as {_quoted(channel.message_encoding)} with schema "
            f"encoding {_quoted(schema.encoding if schema else '')}. A session file has protobuf "
            "there, for both."
        )
    try:
        return message_class(schema.name, schema.data)
    except ValueError as error:
        raise SessionError(
            f"{path}: {channel.topic} cannot be decoded, because its {error}. Whoever writes the "
            "file must put a FileDescriptorSet with all it needs there."
        ) from None


def _decoder(
    path: Path, contents: McapContents, channel_id: int, layout: _Layout
) -> tuple["type[Message] | None", bool]:
    """Return how to decode a channel, and whether its schema is that of the fixed layout.

    The class is None where the schema is literally this package's, because it is dear to make and
    then as good as never needed.
    """
    channel = contents.channels[channel_id]
    schema = contents.schemas.get(channel.schema_id)
    if (
        channel.message_encoding == "protobuf"
        and schema is not None
        and (schema.name, schema.encoding) == (layout.schema_name, "protobuf")
        and schema.data == schema_data(layout.schema_name)
    ):
        return None, True
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
        fixed &= declared.number == number and declared.type == expected
    return decoding, fixed


def _decode_topic(path: Path, contents: McapContents, layout: _Layout) -> npt.NDArray[np.void]:
    """Decode all messages of a channel, in the order of the file.

    Messages of the fixed layout, under a schema that says so, are taken as they are; any other is
    decoded with protobuf by the schema in the file.
    """
    decoders = {
        channel.id: _decoder(path, contents, channel.id, layout)
        for channel in contents.channels.values()
        if channel.topic == layout.topic
    }
    record_dtype = np.dtype([("head", f"V{MESSAGE_HEAD.size}"), ("wire", layout.wire_dtype)])
    parts: list[npt.NDArray[np.void]] = []
    rows: list[tuple[float, ...]] = []  # of decoded messages that are not in parts yet
    for channel_id, size, records in contents.runs[layout.topic]:
        decoding, fixed_schema = decoders[channel_id]
        count = len(records) // size
        if fixed_schema and size == record_dtype.itemsize:
            wire = np.frombuffer(records, record_dtype)["wire"]
            fixed = is_fixed_layout(wire, layout.types)
            native = to_native(wire, layout.types, layout.dtype)
            others = np.flatnonzero(~fixed).tolist()
        else:
            native = np.zeros(count, layout.dtype)
            others = range(count)
        for i in others:
            ...
    return np.concatenate(parts)
