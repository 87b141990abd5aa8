"""Decoder of protobuf messages to NumPy arrays: samples, controller terms, ages and touches.

Messages of the fixed layout (`rigd.session.layout`) are copied directly. Other programs may write
the fields in another order, with other numbers or types, or omit zeros. The decoder then uses the
schema to find the offsets of the fields in one such message, and decodes all messages with the same
tags at the same offsets together. It decodes the remaining messages one by one, up to a limit.
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
from rigd.session._mcap_writer import MESSAGE_HEAD_FORMAT
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
    CONTROL_FIELD_TYPES,
    CONTROL_WIRE_DTYPE,
    SAMPLE_DTYPE,
    SAMPLE_FIELD_TYPES,
    SAMPLE_WIRE_DTYPE,
    TIMING_DTYPE,
    TIMING_FIELD_TYPES,
    TIMING_WIRE_DTYPE,
    TOUCH_DTYPE,
    TOUCH_FIELD_TYPES,
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
"""Number of bytes of messages that are decoded together, chosen to fit the processor's cache."""
_MAX_BLOCK_RUNS: Final = 1 << 16
"""Maximum number of runs of messages that are decoded together."""
_MIN_GROUP_MESSAGES: Final = 16
"""Minimum number of messages that are decoded together; fewer are decoded one by one."""
_MAX_LAYOUTS_PER_CHANNEL: Final = 16
"""Maximum number of field layouts for messages of one channel and length. A program that omits
zeros writes a few layouts."""
_MAX_LAYOUT_COMPARISONS: Final = 100_000
"""Maximum number of times that messages are compared with a field layout, at about 100 µs each."""

_VARINT_WIRE_TYPE, _FIXED64_WIRE_TYPE, _BYTES_WIRE_TYPE, _FIXED32_WIRE_TYPE = (
    0,
    1,
    2,
    5,
)  # wire types of protobuf
_MAX_FIELD_NUMBER: Final = (1 << 29) - 1
_MAX_TAG_BYTES: Final = 5
_MAX_VARINT_BYTES: Final = 9
"""Maximum length of a non-negative 64-bit varint in bytes: a longer one is negative or padded."""


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """Topic, schema and array types of one kind of message with the fixed layout."""

    topic: str
    schema_name: str
    field_types: dict[str, str]
    required_fields: tuple[str, ...]
    """Fields that a file's schema must have; any other field that it lacks is decoded as 0."""
    record_dtype: np.dtype[np.void]
    """Array type of a message record: its ``head``, then the encoded message as ``wire``."""
    dtype: np.dtype[np.void]
    """Array type of a decoded message."""

    def dtype_of(self, field_names: Sequence[str] | None) -> np.dtype[np.void]:
        """Return the array type of a decoded message with the given fields, or with all if None."""
        if field_names is None:
            return self.dtype
        return np.dtype(
            [(field_name, self.dtype[field_name]) for field_name in field_names], align=True
        )


def _record_dtype(wire_dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return the array type of an MCAP message record whose data has the type `wire_dtype`."""
    return np.dtype([("head", f"V{MESSAGE_HEAD_FORMAT.size}"), ("wire", wire_dtype)])


SAMPLES: Final = MessageLayout(
    SAMPLE_TOPIC,
    SAMPLE_SCHEMA,
    SAMPLE_FIELD_TYPES,
    ("t_ns", "tick", "angle_rad", "coupling_torque_nm"),
    _record_dtype(SAMPLE_WIRE_DTYPE),
    SAMPLE_DTYPE,
)
CONTROLS: Final = MessageLayout(
    CONTROL_TOPIC,
    CONTROL_SCHEMA,
    CONTROL_FIELD_TYPES,
    ("t_ns", "tick"),
    _record_dtype(CONTROL_WIRE_DTYPE),
    CONTROL_DTYPE,
)
TIMINGS: Final = MessageLayout(
    TIMING_TOPIC,
    TIMING_SCHEMA,
    TIMING_FIELD_TYPES,
    ("t_ns", "tick"),
    _record_dtype(TIMING_WIRE_DTYPE),
    TIMING_DTYPE,
)

TOUCHES: Final = MessageLayout(
    TOUCH_TOPIC,
    TOUCH_SCHEMA,
    TOUCH_FIELD_TYPES,
    ("t_ns", "tick"),
    _record_dtype(TOUCH_WIRE_DTYPE),
    TOUCH_DTYPE,
)

# Type of the fixed layout → protobuf type in the file's schema → how to read it without loss.
_LOSSLESS_CONVERSIONS: Final = {
    "double": {"TYPE_DOUBLE": "<f8", "TYPE_FLOAT": "<f4"},
    "sfixed64": {"TYPE_SFIXED64": "<i8", "TYPE_INT64": "varint", "TYPE_UINT32": "varint32"},
    "fixed32": {"TYPE_FIXED32": "<u4", "TYPE_UINT32": "varint32"},
}


@dataclass(frozen=True, slots=True)
class _FieldOffsets:
    """Offsets of the fields in messages of one length whose tags are at the same bytes.

    A message has these offsets if (bytes of the message) AND `tag_mask` equals `tag_pattern`.
    """

    tag_mask: npt.NDArray[np.uint8]
    tag_pattern: npt.NDArray[np.uint8]
    fields: tuple[tuple[str, int, int, str], ...]
    """For each field: name, offset of its first byte, length in bytes, and its NumPy type or
    "varint" or "varint32"."""
    absent_fields: tuple[str, ...]
    """Names of the fields that are absent from the messages and are decoded as 0."""


class MessageSink(Protocol):
    """Destination of decoded messages, which provides the arrays that the decoder fills."""

    def next_message_array(self, message_count: int) -> npt.NDArray[np.void]:
        """Return an array (count,) that the decoder fills with the next messages."""
        ...

    def store(self, messages: npt.NDArray[np.void]) -> None:
        """Process the array from `next_message_array` after the decoder has filled it."""
        ...


class MessageDecoder:
    """Decoder of the messages of one topic, in the order of the file.

    The first error is stored in `error` and raised by `finish`, so that damage of the file can be
    reported first.

    The decoded messages are passed to `sink` block by block. `fields` are the names of the fields
    to decode; None for all. The path of the file is for error messages.
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
        self._is_topic_channel: dict[int, bool] = {}  # channel → whether it is of the topic
        self._is_fixed_schema: dict[
            int, bool
        ] = {}  # channel of the topic → whether its layout is fixed
        self._classes: dict[int, type[Message]] = {}
        self._offsets: dict[tuple[int, int], list[_FieldOffsets]] = {}
        self._contents: McapContents | None = None
        self._collected_records: list[Buffer] = []
        self._collected_runs: list[tuple[int, int, int]] = []  # channel, bytes of a record, count
        self._collected_bytes = 0
        self._single_messages = 0
        self._layout_comparisons = 0

    def add_block(self, contents: McapContents, block: MessageBlock) -> None:
        """Collect the messages of the topic from a block, and decode them when there are enough."""
        if self.error is not None:
            return
        self._contents = contents
        is_topic_channel = self._is_topic_channel
        block_records = memoryview(block.records)
        for channel_id, message_size, run_start, message_count in block.runs:
            is_of_topic = is_topic_channel.get(channel_id)
            if is_of_topic is None:
                is_of_topic = self.is_of_topic(contents, channel_id)
            if not is_of_topic:
                continue
            run_records = block_records[run_start : run_start + message_size * message_count]
            # A slice holds all of the records in memory, which is fine where it is most of them.
            self._collected_records.append(
                run_records if 2 * len(run_records) > len(block_records) else bytes(run_records)
            )
            self._collected_runs.append((channel_id, message_size, message_count))
            self._collected_bytes += len(run_records)
            if (
                self._collected_bytes >= _BLOCK_BYTES
                or len(self._collected_runs) >= _MAX_BLOCK_RUNS
            ):
                self.flush()
                if self.error is not None:
                    return

    def is_of_topic(self, contents: McapContents, channel_id: int) -> bool:
        """Return whether a channel belongs to the decoded topic."""
        is_of_topic = self._is_topic_channel.get(channel_id)
        if is_of_topic is None:
            is_of_topic = contents.channels[channel_id].topic == self._layout.topic
            self._is_topic_channel[channel_id] = is_of_topic
        return is_of_topic

    def flush(self) -> None:
        """Decode the collected messages, and pass them to the sink."""
        record_parts, message_runs = self._collected_records, self._collected_runs
        self._collected_records, self._collected_runs, self._collected_bytes = [], [], 0
        if not message_runs or self.error is not None:
            return
        try:
            self._decode(record_parts, np.array(message_runs, np.int64))
        except SessionError as error:
            self.error = error

    def finish(self, contents: McapContents) -> None:
        """Decode the remaining messages, and check the schemas of channels without messages.

        Raises SessionError if a message or a schema of the topic cannot be decoded.
        """
        self.flush()
        if self.error is None:
            for channel in contents.channels.values():
                if channel.topic == self._layout.topic:
                    self._has_fixed_schema(contents, channel.id)
        else:
            raise self.error

    def _decode(self, record_parts: list[Buffer], message_runs: npt.NDArray[np.int64]) -> None:
        """Decode the message records in `record_parts`.

        A row of `message_runs` (n, 3) contains channel number, record length in bytes, and number
        of records.
        """
        channel_id, message_size, _ = message_runs[0].tolist()
        if (message_runs[:, :2] == message_runs[0, :2]).all():
            joined_records = b"".join(record_parts)
            # A block is a little longer than `_BLOCK_BYTES`; a much longer one is cut.
            is_cut_into_parts = len(joined_records) > 2 * _BLOCK_BYTES
            part_length = (
                max(_BLOCK_BYTES // message_size, 1) * message_size
                if is_cut_into_parts
                else len(joined_records)
            )
            for part_start in range(0, len(joined_records), part_length):
                record_part = joined_records[part_start : part_start + part_length]
                output_messages = self._sink.next_message_array(len(record_part) // message_size)
                self._decode_group(channel_id, message_size, record_part, output_messages)
                self._sink.store(output_messages)
            return
        record_bytes = np.frombuffer(b"".join(record_parts), np.uint8)
        message_offsets = message_starts(message_runs)
        group_keys = np.repeat(message_runs[:, 0] << 40 | message_runs[:, 1], message_runs[:, 2])
        output_messages = self._sink.next_message_array(len(message_offsets))
        for group_key in np.unique(group_keys).tolist():
            (message_indices,) = np.nonzero(group_keys == group_key)
            message_size = group_key & ((1 << 40) - 1)
            overlapping_records = np.ndarray(
                len(record_bytes) - message_size + 1, f"V{message_size}", record_bytes, 0, (1,)
            )
            group_records = overlapping_records[message_offsets[message_indices]].tobytes()
            decoded_messages = np.empty(len(message_indices), self.dtype)
            self._decode_group(group_key >> 40, message_size, group_records, decoded_messages)
            output_messages[message_indices] = decoded_messages
        self._sink.store(output_messages)

    def _decode_group(
        self,
        channel_id: int,
        record_size: int,
        record_bytes: bytes,
        output_messages: npt.NDArray[np.void],
    ) -> None:
        """Decode message records of one channel, of equal size in bytes, into an array (n,)."""
        contents, fixed_layout = self._contents, self._layout
        assert contents is not None
        if record_size > limits.MAX_SAMPLE_MESSAGE_BYTES:
            raise SessionError(
                f"{self._path}: a message of {fixed_layout.topic} has {record_size} bytes, more "
                f"than the {limits.MAX_SAMPLE_MESSAGE_BYTES} that are read. The writing program "
                "must write one sample per message."
            )
        if (
            self._has_fixed_schema(contents, channel_id)
            and record_size == fixed_layout.record_dtype.itemsize
        ):
            wire_messages = np.frombuffer(record_bytes, fixed_layout.record_dtype)["wire"]
            to_native(wire_messages, output_messages.dtype.names or (), output_messages)
            has_fixed_layout = is_fixed_layout(wire_messages, fixed_layout.field_types)
            if has_fixed_layout.all():
                return
            (message_indices,) = np.nonzero(~has_fixed_layout)
        else:
            message_indices = np.arange(len(output_messages))
        message_bytes = np.frombuffer(record_bytes, np.uint8).reshape(
            len(output_messages), record_size
        )[:, MESSAGE_HEAD_FORMAT.size :]
        self._decode_by_offsets(channel_id, message_bytes, message_indices, output_messages)

    def _decode_by_offsets(
        self,
        channel_id: int,
        message_bytes: npt.NDArray[np.uint8],
        message_indices: npt.NDArray[np.int64],
        output_messages: npt.NDArray[np.void],
    ) -> None:
        """Decode some of the messages (n, bytes) into the same rows of `output_messages`.

        Messages whose fields have the same byte offsets are decoded together.
        """
        known_layouts = self._offsets.setdefault((channel_id, message_bytes.shape[1]), [])
        layout_index = 0
        while (
            len(message_indices) >= _MIN_GROUP_MESSAGES
            and self._layout_comparisons < _MAX_LAYOUT_COMPARISONS
        ):
            matching_rows = (
                message_bytes
                if len(message_indices) == len(message_bytes)
                else message_bytes[message_indices]
            )
            if layout_index == len(known_layouts):
                new_layout = self._find_offsets(channel_id, matching_rows[0].tobytes())
                if new_layout is None or layout_index == _MAX_LAYOUTS_PER_CHANNEL:
                    break
                known_layouts.append(new_layout)
            field_layout = known_layouts[layout_index]
            has_layout = ((matching_rows & field_layout.tag_mask) == field_layout.tag_pattern).all(
                axis=1
            )
            self._layout_comparisons += 1
            layout_index += 1
            if has_layout.any():
                _decode_at_offsets(
                    field_layout,
                    matching_rows[has_layout],
                    message_indices[has_layout],
                    output_messages,
                )
                message_indices = message_indices[~has_layout]
        if len(message_indices):
            self._decode_one_by_one(
                channel_id,
                [message_bytes[i].tobytes() for i in message_indices],
                message_indices,
                output_messages,
            )

    def _find_offsets(self, channel_id: int, message_bytes: bytes) -> _FieldOffsets | None:
        """Return the offsets of the fields in a message, also for messages with the same layout.

        Returns None if such messages must be decoded one by one with the protobuf package.
        """
        decoding_class = self._message_class(channel_id)
        empty_message, message_descriptor = decoding_class(), decoding_class.DESCRIPTOR
        if not empty_message.IsInitialized() or any(
            len(oneof_group.fields) > 1 for oneof_group in message_descriptor.oneofs
        ):
            return None
        tag_mask, found_fields = np.zeros(len(message_bytes), np.uint8), {}
        position = 0
        while position < len(message_bytes):
            field_start = position
            tag, position = _read_varint(message_bytes, field_start)
            field_number, wire_type = tag >> 3, tag & 7
            value_start = position
            if wire_type == _VARINT_WIRE_TYPE:
                _, position = _read_varint(message_bytes, value_start)
                tag_mask[value_start:position] = 0x80
            elif wire_type in (_FIXED64_WIRE_TYPE, _FIXED32_WIRE_TYPE):
                position += 8 if wire_type == _FIXED64_WIRE_TYPE else 4
            elif wire_type == _BYTES_WIRE_TYPE:
                field_length, position = _read_varint(message_bytes, value_start)
                tag_mask[value_start:position] = 0xFF
                position += field_length
            else:
                return None
            if (
                not 1 <= field_number <= _MAX_FIELD_NUMBER
                or position > len(message_bytes)
                or value_start - field_start > _MAX_TAG_BYTES
                or (wire_type == _VARINT_WIRE_TYPE and position - value_start > _MAX_VARINT_BYTES)
            ):
                return None
            tag_mask[field_start:value_start] = 0xFF
            field_descriptor = message_descriptor.fields_by_number.get(field_number)
            if field_descriptor is not None:
                array_conversion = self._array_conversion(field_descriptor, wire_type)
                if array_conversion is None:
                    return None
                found_fields[field_descriptor.name] = (
                    field_descriptor.name,
                    value_start,
                    position - value_start,
                    array_conversion,
                )
        field_names = self.dtype.names or ()
        absent_fields = {
            field_name: getattr(empty_message, field_name, 0)
            for field_name in field_names
            if field_name not in found_fields
        }
        if any(absent_fields.values()):  # not zero by default, and possibly out of range
            return None
        return _FieldOffsets(
            tag_mask,
            np.frombuffer(message_bytes, np.uint8) & tag_mask,
            tuple(
                found_field
                for field_name, found_field in found_fields.items()
                if field_name in field_names
            ),
            tuple(absent_fields),
        )

    def _array_conversion(
        self, field_descriptor: "FieldDescriptor | UpbFieldDescriptor", wire_type: int
    ) -> str | None:
        """Return how a field of many messages is decoded: as a NumPy type, "varint" or "varint32".

        Returns None if the field must be decoded message by message. `wire_type` is the number of
        the protobuf wire type in the messages.
        """
        lossless_conversions = _LOSSLESS_CONVERSIONS.get(
            self._layout.field_types.get(field_descriptor.name, ""), {}
        )
        for type_name, array_type in lossless_conversions.items():
            if field_descriptor.type == getattr(field_descriptor, type_name):
                required_wire_types = {
                    "<f8": _FIXED64_WIRE_TYPE,
                    "<i8": _FIXED64_WIRE_TYPE,
                    "<f4": _FIXED32_WIRE_TYPE,
                    "<u4": _FIXED32_WIRE_TYPE,
                }
                return (
                    array_type
                    if wire_type == required_wire_types.get(array_type, _VARINT_WIRE_TYPE)
                    else None
                )
        return None

    def _decode_one_by_one(
        self,
        channel_id: int,
        encoded_messages: list[bytes],
        message_indices: npt.NDArray[np.int64],
        output_messages: npt.NDArray[np.void],
    ) -> None:
        """Decode messages one by one with the protobuf package; absent fields become 0."""
        self._single_messages += len(encoded_messages)
        if self._single_messages > limits.MAX_SINGLY_DECODED_MESSAGES:
            raise SessionError(
                f"{self._path}: more than {limits.MAX_SINGLY_DECODED_MESSAGES} messages of "
                f"{self._layout.topic} differ so much from one another that they would have to be "
                "decoded one by one, which would take too long. The writing program must write all "
                "fields of every message, in one order."
            )
        decode_message = self._message_class(channel_id).FromString
        decoded_messages = [
            decoded_message(self._path, self._layout.topic, decode_message, m)
            for m in encoded_messages
        ]
        field_names = self.dtype.names or ()
        try:
            output_messages[message_indices] = np.array(
                [
                    tuple([getattr(single_message, field_name, 0) for field_name in field_names])
                    for single_message in decoded_messages
                ],
                self.dtype,
            )
        except OverflowError as error:
            raise SessionError(
                f"{self._path}: a message of {self._layout.topic} holds a number that its field "
                f"cannot take ({error}). The writing program must keep to the types of the "
                "format."
            ) from None

    def _message_class(self, channel_id: int) -> "type[Message]":
        """Return the protobuf class that decodes the messages of a channel."""
        decoding_class = self._classes.get(channel_id)
        if decoding_class is None:
            assert self._contents is not None
            decoding_class = class_of_channel(self._path, self._contents, channel_id)
            self._classes[channel_id] = decoding_class
        return decoding_class

    def _has_fixed_schema(self, contents: McapContents, channel_id: int) -> bool:
        """Return whether a channel's schema is that of the fixed layout."""
        is_fixed = self._is_fixed_schema.get(channel_id)
        if is_fixed is None:
            self._contents = contents
            is_fixed = self._is_fixed_schema[channel_id] = self._check_schema(contents, channel_id)
        return is_fixed

    def _check_schema(self, contents: McapContents, channel_id: int) -> bool:
        """Return whether a channel's schema has the field numbers and types of the fixed layout.

        Raises SessionError if the messages cannot be converted to the fields of the layout at all.
        """
        fixed_layout, path = self._layout, self._path
        channel = contents.channels[channel_id]
        schema = contents.schemas.get(channel.schema_id)
        if len(self._is_fixed_schema) >= limits.MAX_CHANNELS_PER_TOPIC:
            raise SessionError(
                f"{path} has more than {limits.MAX_CHANNELS_PER_TOPIC} channels "
                f"{fixed_layout.topic}. The writing program must put all such messages into one."
            )
        if (
            channel.message_encoding == "protobuf"
            and schema is not None
            and (schema.name, schema.encoding) == (fixed_layout.schema_name, "protobuf")
            and schema.data == schema_data(fixed_layout.schema_name)
        ):
            return True
        decoding_class = self._message_class(channel_id)
        empty_message = decoding_class()
        is_fixed = True
        for field_number, (field_name, protobuf_type) in enumerate(
            fixed_layout.field_types.items(), start=1
        ):
            field_descriptor = decoding_class.DESCRIPTOR.fields_by_name.get(field_name)
            if field_descriptor is None:
                if field_name in fixed_layout.required_fields:
                    raise SessionError(
                        f"{path}: the schema of {fixed_layout.topic} has no field {field_name}, "
                        f"which is required there, of type {protobuf_type}."
                    )
                is_fixed = False
                continue
            # The default value distinguishes singular numbers from everything else.
            if not isinstance(
                getattr(empty_message, field_name),
                float | int if protobuf_type == "double" else int,
            ):
                raise SessionError(
                    f"{path}: the field {field_name} of {fixed_layout.topic} is not of a type "
                    f"that can be read as {protobuf_type}, which it should be."
                )
            expected_type = getattr(field_descriptor, f"TYPE_{protobuf_type.upper()}")
            is_fixed = (
                is_fixed
                and field_descriptor.number == field_number
                and field_descriptor.type == expected_type
            )
        return is_fixed


def class_of_channel(path: Path, contents: McapContents, channel_id: int) -> "type[Message]":
    """Return the protobuf class that decodes the messages of a channel, from its schema.

    Raises SessionError if the channel's encoding is not protobuf, or if its schema is unusable.
    """
    channel = contents.channels[channel_id]
    schema = contents.schemas.get(channel.schema_id)
    if channel.message_encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        raise SessionError(
            f"{path}: {channel.topic} has the encoding {quoted_excerpt(channel.message_encoding)} "
            f"and the schema encoding {quoted_excerpt(schema.encoding if schema else '')}. A "
            "session file has protobuf there, for both."
        )
    try:
        return message_class(schema.name, schema.data)
    except ValueError as error:
        raise SessionError(
            f"{path}: {channel.topic} cannot be decoded, because its {error}. The writing program "
            "must put a FileDescriptorSet with all it needs there."
        ) from None


def decoded_message(
    path: Path, topic: str, decode_message: "Callable[[bytes], Message]", message_bytes: bytes
) -> "Message":
    """Return the protobuf message that `decode_message` makes of some bytes.

    Raises SessionError if the bytes contradict the schema of the message.
    """
    from google.protobuf.message import DecodeError

    try:
        return decode_message(message_bytes)
    except DecodeError:
        raise SessionError(
            f"{path}: a message of {topic} is not what its schema says. The file is damaged or was "
            "not written as the format asks."
        ) from None


def quoted_excerpt(file_text: str) -> str:
    """Return a text from a file in quotes, with escaped characters, and cut to 40 characters."""
    return repr(file_text if len(file_text) <= 40 else file_text[:40] + "…")


def _decode_at_offsets(
    field_offsets: _FieldOffsets,
    message_rows: npt.NDArray[np.uint8],
    message_indices: npt.NDArray[np.int64],
    output_messages: npt.NDArray[np.void],
) -> None:
    """Decode messages (n, bytes) with equal field offsets into elements of `output_messages`."""
    message_rows = np.ascontiguousarray(message_rows)
    message_count, message_size = message_rows.shape
    for field_name, first_byte, field_length, array_conversion in field_offsets.fields:
        if array_conversion.startswith("varint"):
            absent_value = np.zeros(message_count, np.uint64)
            for i in range(field_length):
                absent_value |= (message_rows[:, first_byte + i] & 0x7F).astype(
                    np.uint64
                ) << np.uint64(7 * i)
            if array_conversion == "varint32":
                absent_value &= np.uint64(0xFFFFFFFF)
            output_messages[field_name][message_indices] = absent_value.astype(
                output_messages.dtype[field_name]
            )
        else:
            output_messages[field_name][message_indices] = np.ndarray(
                message_count, array_conversion, message_rows, first_byte, (message_size,)
            )
    for field_name in field_offsets.absent_fields:
        output_messages[field_name][message_indices] = 0


def _read_varint(message_bytes: bytes, varint_start: int) -> tuple[int, int]:
    """Return the integer of the varint at `varint_start`, and the offset where the varint ends.

    Returns -1 and an offset beyond `message_bytes` if there is no complete varint.
    """
    varint_value = 0
    for i, byte in enumerate(message_bytes[varint_start : varint_start + 10]):
        varint_value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return varint_value, varint_start + i + 1
    return -1, len(message_bytes) + 1
