"""Decoder of messages: samples, controls, timings and touches as arrays, from any writer.

Messages of the fixed layout (`rigd.session.layout`) are copied directly. Any other protobuf library
may order the fields differently, omit zeros, number or type fields differently. The decoder then
finds the offsets of the fields in one such message by its schema, and decodes all messages with the
same tags at the same offsets together. It decodes the remaining ones singly, up to a limit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
import numpy.typing as npt

from rigd.session import limits
from rigd.session._errors import SessionError
from rigd.session._mcap_reader import McapContents, MessageBlock, message_starts
from rigd.session._mcap_writer import MESSAGE_HEAD
from rigd.session._schema import (
    CONTROL_SCHEMA,
    CONTROL_TOPIC,
    SAMPLE_SCHEMA,
    SAMPLE_TOPIC,
    TIMING_SCHEMA,
    TIMING_TOPIC,
    TOUCH_SCHEMA,
    TOUCH_TOPIC,
    message_class,
    schema_data,
)
from rigd.session.layout import (
    CONTROL_DTYPE,
    CONTROL_TYPES,
    CONTROL_WIRE_DTYPE,
    SAMPLE_DTYPE,
    SAMPLE_TYPES,
    SAMPLE_WIRE_DTYPE,
    TIMING_DTYPE,
    TIMING_TYPES,
    TIMING_WIRE_DTYPE,
    TOUCH_DTYPE,
    TOUCH_TYPES,
    TOUCH_WIRE_DTYPE,
    Buffer,
    is_fixed_layout,
    to_native,
)

if TYPE_CHECKING:
    from google._upb._message import FieldDescriptor as UpbFieldDescriptor
    from google.protobuf.descriptor import FieldDescriptor
    from google.protobuf.message import Message


_BLOCK_BYTES: Final = 1 << 18
"""Bytes of messages that are decoded together: they stay in the processor's cache."""
_BLOCK_RUNS: Final = 1 << 16
_FEW: Final = 16
"""Below this number messages are decoded singly."""
_MOST_LAYOUTS: Final = 16
"""Layouts of messages of one channel and length: a writer that omits zeros produces a few."""
_MOST_GROUPS: Final = 100_000
"""Times that messages of one layout are decoded together, at about 100 µs each."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types of protobuf
_MOST_FIELD_NUMBER: Final = (1 << 29) - 1
_MOST_TAG_BYTES: Final = 5
_MOST_VARINT_BYTES: Final = 9
"""Bytes of 63 bits: a longer varint is negative or padded."""


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """A channel of fixed-layout messages."""

    topic: str
    schema_name: str
    types: dict[str, str]
    required: tuple[str, ...]
    """Fields that a schema must have; any other absent one reads as 0."""
    record_dtype: np.dtype[np.void]
    """A message record in the file: its ``head``, then the ``wire`` form."""
    dtype: np.dtype[np.void]

    def dtype_of(self, fields: Sequence[str] | None) -> np.dtype[np.void]:
        """Return the type of a decoded message of some fields; None for all."""
        if fields is None:
            return self.dtype
        return np.dtype([(name, self.dtype[name]) for name in fields], align=True)


def _record_dtype(wire_dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    return np.dtype([("head", f"V{MESSAGE_HEAD.size}"), ("wire", wire_dtype)])


SAMPLES: Final = MessageLayout(
    SAMPLE_TOPIC,
    SAMPLE_SCHEMA,
    SAMPLE_TYPES,
    ("t_ns", "tick", "angle_rad", "coupling_torque_nm"),
    _record_dtype(SAMPLE_WIRE_DTYPE),
    SAMPLE_DTYPE,
)
CONTROLS: Final = MessageLayout(
    CONTROL_TOPIC,
    CONTROL_SCHEMA,
    CONTROL_TYPES,
    ("t_ns", "tick"),
    _record_dtype(CONTROL_WIRE_DTYPE),
    CONTROL_DTYPE,
)
TIMINGS: Final = MessageLayout(
    TIMING_TOPIC,
    TIMING_SCHEMA,
    TIMING_TYPES,
    ("t_ns", "tick"),
    _record_dtype(TIMING_WIRE_DTYPE),
    TIMING_DTYPE,
)

TOUCHES: Final = MessageLayout(
    TOUCH_TOPIC,
    TOUCH_SCHEMA,
    TOUCH_TYPES,
    ("t_ns", "tick"),
    _record_dtype(TOUCH_WIRE_DTYPE),
    TOUCH_DTYPE,
)

# Declared type → how to read it as the array's type, where no value can be lost.
_SAME: Final = {
    "double": {"TYPE_DOUBLE": "<f8", "TYPE_FLOAT": "<f4"},
    "sfixed64": {"TYPE_SFIXED64": "<i8", "TYPE_INT64": "varint", "TYPE_UINT32": "varint32"},
    "fixed32": {"TYPE_FIXED32": "<u4", "TYPE_UINT32": "varint32"},
}


@dataclass(frozen=True, slots=True)
class _FieldOffsets:
    """Offsets of the fields in messages of one length whose bytes are `pattern` under `mask`."""

    mask: npt.NDArray[np.uint8]
    pattern: npt.NDArray[np.uint8]
    fields: tuple[tuple[str, int, int, str], ...]
    """Name, first byte, bytes, and numpy type, "varint" or "varint32"."""
    absent: tuple[str, ...]
    """Missing fields, which read as 0."""


class MessageSink(Protocol):
    """Destination of decoded messages."""

    def room(self, count: int) -> npt.NDArray[np.void]:
        """Return an array (count,) of the decoder's dtype to be filled with the next messages."""
        ...

    def store(self, messages: npt.NDArray[np.void]) -> None:
        """Take that array, filled."""
        ...


class MessageDecoder:
    """Decodes the messages of one topic, in the order of the file.

    An error is raised at the end only: damage of the file is reported first.

    Parameters
    ----------
    path : the file, for messages
    layout : layout of the messages
    sink : gets the decoded messages of `fields`, block by block
    fields : fields of the layout to decode; by default all
    """

    def __init__(
        self,
        path: Path,
        layout: MessageLayout,
        sink: MessageSink,
        fields: Sequence[str] | None = None,
    ) -> None:
        self._path = path
        self._layout = layout
        self._sink = sink
        self.dtype = layout.dtype_of(fields)
        self.error: SessionError | None = None
        self._channels: dict[int, bool] = {}  # channel → whether it is of the topic
        self._fixed: dict[int, bool] = {}  # channel of the topic → whether its schema is the fixed
        self._classes: dict[int, type[Message]] = {}
        self._offsets: dict[tuple[int, int], list[_FieldOffsets]] = {}
        self._contents: McapContents | None = None
        self._parts: list[Buffer] = []
        self._runs: list[tuple[int, int, int]] = []  # channel, bytes of a record, count
        self._length = 0
        self._single = 0
        self._groups = 0

    def take(self, contents: McapContents, block: MessageBlock) -> None:
        """Collect the messages of the topic in a block of records."""
        if self.error is not None:
            return
        self._contents = contents
        known = self._channels
        records = memoryview(block.records)
        for channel, size, start, count in block.runs:
            is_mine = known.get(channel)
            if is_mine is None:
                is_mine = self.is_of_topic(contents, channel)
            if not is_mine:
                continue
            part = records[start : start + size * count]
            # A slice holds all of the records in memory, which is fine where it is most of them.
            self._parts.append(part if 2 * len(part) > len(records) else bytes(part))
            self._runs.append((channel, size, count))
            self._length += len(part)
            if self._length >= _BLOCK_BYTES or len(self._runs) >= _BLOCK_RUNS:
                self.flush()
                if self.error is not None:
                    return

    def is_of_topic(self, contents: McapContents, channel: int) -> bool:
        """Return whether a channel belongs to the decoded topic."""
        is_mine = self._channels.get(channel)
        if is_mine is None:
            is_mine = contents.channels[channel].topic == self._layout.topic
            self._channels[channel] = is_mine
        return is_mine

    def flush(self) -> None:
        """Decode the collected messages and pass them on."""
        parts, runs = self._parts, self._runs
        self._parts, self._runs, self._length = [], [], 0
        if not runs or self.error is not None:
            return
        try:
            self._decode(parts, np.array(runs, np.int64))
        except SessionError as error:
            self.error = error

    def finish(self, contents: McapContents) -> None:
        """Decode the last messages.

        Raises
        ------
        SessionError
            If a message, or a schema of the topic, cannot be read.
        """
        self.flush()
        if self.error is None:
            for channel in contents.channels.values():
                if channel.topic == self._layout.topic:
                    self._has_fixed_schema(contents, channel.id)
        else:
            raise self.error

    def _decode(self, parts: list[Buffer], runs: npt.NDArray[np.int64]) -> None:
        """Decode runs of messages whose bytes follow one another in `parts`."""
        channel, size, _ = runs[0].tolist()
        if (runs[:, :2] == runs[0, :2]).all():
            block = b"".join(parts)
            # A block is a little longer than `_BLOCK_BYTES`; a much longer one is cut.
            is_long = len(block) > 2 * _BLOCK_BYTES
            most = max(_BLOCK_BYTES // size, 1) * size if is_long else len(block)
            for first in range(0, len(block), most):
                part = block[first : first + most]
                out = self._sink.room(len(part) // size)
                self._decode_group(channel, size, part, out)
                self._sink.store(out)
            return
        records = np.frombuffer(b"".join(parts), np.uint8)
        starts = message_starts(runs)
        kinds = np.repeat(runs[:, 0] << 40 | runs[:, 1], runs[:, 2])
        out = self._sink.room(len(starts))
        for kind in np.unique(kinds).tolist():
            (indices,) = np.nonzero(kinds == kind)
            size = kind & ((1 << 40) - 1)
            every = np.ndarray(len(records) - size + 1, f"V{size}", records, 0, (1,))
            group = every[starts[indices]].tobytes()
            decoded = np.empty(len(indices), self.dtype)
            self._decode_group(kind >> 40, size, group, decoded)
            out[indices] = decoded
        self._sink.store(out)

    def _decode_group(
        self, channel: int, size: int, records: bytes, out: npt.NDArray[np.void]
    ) -> None:
        """Decode message records of one channel and length."""
        contents, layout = self._contents, self._layout
        assert contents is not None
        if size > limits.MAX_DECODED_BYTES:
            raise SessionError(
                f"{self._path}: a message of {layout.topic} has {size} bytes, more than the "
                f"{limits.MAX_DECODED_BYTES} that are read. The writing program must write one "
                "sample per message."
            )
        if self._has_fixed_schema(contents, channel) and size == layout.record_dtype.itemsize:
            wire = np.frombuffer(records, layout.record_dtype)["wire"]
            to_native(wire, out.dtype.names or (), out)
            fixed = is_fixed_layout(wire, layout.types)
            if fixed.all():
                return
            (indices,) = np.nonzero(~fixed)
        else:
            indices = np.arange(len(out))
        data = np.frombuffer(records, np.uint8).reshape(len(out), size)[:, MESSAGE_HEAD.size :]
        self._decode_by_offsets(channel, data, indices, out)

    def _decode_by_offsets(
        self,
        channel: int,
        data: npt.NDArray[np.uint8],
        indices: npt.NDArray[np.int64],
        out: npt.NDArray[np.void],
    ) -> None:
        """Decode the messages (n, bytes) at `indices`, those of one layout together."""
        known = self._offsets.setdefault((channel, data.shape[1]), [])
        number = 0
        while len(indices) >= _FEW and self._groups < _MOST_GROUPS:
            rows = data if len(indices) == len(data) else data[indices]
            if number == len(known):
                found = self._find_offsets(channel, rows[0].tobytes())
                if found is None or number == _MOST_LAYOUTS:
                    break
                known.append(found)
            layout = known[number]
            alike = ((rows & layout.mask) == layout.pattern).all(axis=1)
            self._groups += 1
            number += 1
            if alike.any():
                _take_at_offsets(layout, rows[alike], indices[alike], out)
                indices = indices[~alike]
        if len(indices):
            self._decode_single(channel, [data[i].tobytes() for i in indices], indices, out)

    def _find_offsets(self, channel: int, message: bytes) -> _FieldOffsets | None:
        """Return the offsets of a message's fields; None if it must be decoded singly."""
        cls = self._class(channel)
        empty, descriptor = cls(), cls.DESCRIPTOR
        if not empty.IsInitialized() or any(len(group.fields) > 1 for group in descriptor.oneofs):
            return None
        mask, fields = np.zeros(len(message), np.uint8), {}
        position = 0
        while position < len(message):
            start = position
            tag, position = _varint(message, start)
            number, wire = tag >> 3, tag & 7
            begin = position
            if wire == _VARINT:
                _, position = _varint(message, begin)
                mask[begin:position] = 0x80
            elif wire in (_FIXED64, _FIXED32):
                position += 8 if wire == _FIXED64 else 4
            elif wire == _BYTES:
                length, position = _varint(message, begin)
                mask[begin:position] = 0xFF
                position += length
            else:
                return None
            if (
                not 1 <= number <= _MOST_FIELD_NUMBER
                or position > len(message)
                or begin - start > _MOST_TAG_BYTES
                or (wire == _VARINT and position - begin > _MOST_VARINT_BYTES)
            ):
                return None
            mask[start:begin] = 0xFF
            declared = descriptor.fields_by_number.get(number)
            if declared is not None:
                kind = self._kind(declared, wire)
                if kind is None:
                    return None
                fields[declared.name] = (declared.name, begin, position - begin, kind)
        names = self.dtype.names or ()
        absent = {name: getattr(empty, name, 0) for name in names if name not in fields}
        if any(absent.values()):  # not zero by default, and possibly out of range
            return None
        return _FieldOffsets(
            mask,
            np.frombuffer(message, np.uint8) & mask,
            tuple(entry for name, entry in fields.items() if name in names),
            tuple(absent),
        )

    def _kind(self, declared: "FieldDescriptor | UpbFieldDescriptor", wire: int) -> str | None:
        """Return how to read a field of many messages at once; None if that is impossible."""
        kinds = _SAME.get(self._layout.types.get(declared.name, ""), {})
        for name, kind in kinds.items():
            if declared.type == getattr(declared, name):
                needed = {"<f8": _FIXED64, "<i8": _FIXED64, "<f4": _FIXED32, "<u4": _FIXED32}
                return kind if wire == needed.get(kind, _VARINT) else None
        return None

    def _decode_single(
        self,
        channel: int,
        messages: list[bytes],
        indices: npt.NDArray[np.int64],
        out: npt.NDArray[np.void],
    ) -> None:
        """Decode messages with protobuf, absent fields as 0."""
        self._single += len(messages)
        if self._single > limits.MAX_SINGLE_MESSAGES:
            raise SessionError(
                f"{self._path}: more than {limits.MAX_SINGLE_MESSAGES} messages of "
                f"{self._layout.topic} differ so much from one another that they would have to be "
                "decoded one by one, which would take too long. The writing program must write all "
                "fields of every message, in one order."
            )
        decode = self._class(channel).FromString
        decoded = [decoded_message(self._path, self._layout.topic, decode, m) for m in messages]
        names = self.dtype.names or ()
        try:
            out[indices] = np.array(
                [tuple([getattr(each, name, 0) for name in names]) for each in decoded],
                self.dtype,
            )
        except OverflowError as error:
            raise SessionError(
                f"{self._path}: a message of {self._layout.topic} holds a number that its field "
                f"cannot take ({error}). The writing program must keep to the types of the "
                "format."
            ) from None

    def _class(self, channel: int) -> "type[Message]":
        """Return the class that decodes the messages of a channel of the topic."""
        found = self._classes.get(channel)
        if found is None:
            assert self._contents is not None
            found = class_of_channel(self._path, self._contents, channel)
            self._classes[channel] = found
        return found

    def _has_fixed_schema(self, contents: McapContents, channel: int) -> bool:
        known = self._fixed.get(channel)
        if known is None:
            self._contents = contents
            known = self._fixed[channel] = self._check_schema(contents, channel)
        return known

    def _check_schema(self, contents: McapContents, channel_id: int) -> bool:
        """Return whether a schema gives every field the number and type of the fixed layout.

        Raises
        ------
        SessionError
            If messages of that schema cannot be decoded to the layout's fields at all.
        """
        layout, path = self._layout, self._path
        channel = contents.channels[channel_id]
        schema = contents.schemas.get(channel.schema_id)
        if len(self._fixed) >= limits.MAX_CHANNELS:
            raise SessionError(
                f"{path} has more than {limits.MAX_CHANNELS} channels {layout.topic}. The writing "
                "program must put all such messages into one."
            )
        if (
            channel.message_encoding == "protobuf"
            and schema is not None
            and (schema.name, schema.encoding) == (layout.schema_name, "protobuf")
            and schema.data == schema_data(layout.schema_name)
        ):
            return True
        decoding = self._class(channel_id)
        empty = decoding()
        fixed = True
        for number, (name, kind) in enumerate(layout.types.items(), start=1):
            declared = decoding.DESCRIPTOR.fields_by_name.get(name)
            if declared is None:
                if name in layout.required:
                    raise SessionError(
                        f"{path}: the schema of {layout.topic} has no field {name}, which is "
                        f"required there, of type {kind}."
                    )
                fixed = False
                continue
            # The default value distinguishes singular numbers from everything else.
            if not isinstance(getattr(empty, name), float | int if kind == "double" else int):
                raise SessionError(
                    f"{path}: the field {name} of {layout.topic} is not of a type that can be read "
                    f"as {kind}, which it should be."
                )
            expected = getattr(declared, f"TYPE_{kind.upper()}")
            fixed = fixed and declared.number == number and declared.type == expected
        return fixed


def class_of_channel(path: Path, contents: McapContents, channel_id: int) -> "type[Message]":
    """Return the class that decodes the messages of a channel, by the schema in the file.

    Raises
    ------
    SessionError
        If the channel is not protobuf, or its schema cannot be used.
    """
    channel = contents.channels[channel_id]
    schema = contents.schemas.get(channel.schema_id)
    if channel.message_encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        raise SessionError(
            f"{path}: {channel.topic} has the encoding {quoted(channel.message_encoding)} and the "
            f"schema encoding {quoted(schema.encoding if schema else '')}. A session file has "
            "protobuf there, for both."
        )
    try:
        return message_class(schema.name, schema.data)
    except ValueError as error:
        raise SessionError(
            f"{path}: {channel.topic} cannot be decoded, because its {error}. The writing program "
            "must put a FileDescriptorSet with all it needs there."
        ) from None


def decoded_message(
    path: Path, topic: str, decode: "Callable[[bytes], Message]", data: bytes
) -> "Message":
    """Decode a message.

    Raises
    ------
    SessionError
        If it contradicts its schema.
    """
    from google.protobuf.message import DecodeError

    try:
        return decode(data)
    except DecodeError:
        raise SessionError(
            f"{path}: a message of {topic} is not what its schema says. The file is damaged or was "
            "not written as the format asks."
        ) from None


def quoted(text: str) -> str:
    """Quote a value of the file, which may be of any length and contain anything."""
    return repr(text if len(text) <= 40 else text[:40] + "…")


def _take_at_offsets(
    layout: _FieldOffsets,
    rows: npt.NDArray[np.uint8],
    indices: npt.NDArray[np.int64],
    out: npt.NDArray[np.void],
) -> None:
    """Decode messages (n, bytes) of one layout to `indices` of the array."""
    rows = np.ascontiguousarray(rows)
    count, size = rows.shape
    for name, first, length, kind in layout.fields:
        if kind.startswith("varint"):
            value = np.zeros(count, np.uint64)
            for i in range(length):
                value |= (rows[:, first + i] & 0x7F).astype(np.uint64) << np.uint64(7 * i)
            if kind == "varint32":
                value &= np.uint64(0xFFFFFFFF)
            out[name][indices] = value.astype(out.dtype[name])
        else:
            out[name][indices] = np.ndarray(count, kind, rows, first, (size,))
    for name in layout.absent:
        out[name][indices] = 0


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """Return a number and the offset of its end; negative, with an end behind the data, if none."""
    value = 0
    for i, byte in enumerate(data[position : position + 10]):
        value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return value, position + i + 1
    return -1, len(data) + 1
