"""Channels of a session file, and their protobuf schemas, built without a protobuf compiler.

An MCAP schema of encoding ``protobuf`` is a serialised ``FileDescriptorSet`` with the message and
all types to which it refers.
"""

from collections.abc import Mapping
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Final

from rigd.session import limits
from rigd.session.layout import (
    CONTROL_FIELD_TYPES,
    SAMPLE_FIELD_TYPES,
    TIMING_FIELD_TYPES,
    TOUCH_FIELD_TYPES,
)

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.message import Message

FORMAT_VERSION: Final = "1"
"""Version of the session file format, in the metadata of each file."""

SAMPLE_TOPIC: Final = "/rig/sample"
CONTROL_TOPIC: Final = "/rig/control"
TIMING_TOPIC: Final = "/rig/timing"
TOUCH_TOPIC: Final = "/rig/touch"
EVENT_TOPIC: Final = "/rig/event"
"""Topic of the session's log."""

OWN_TOPICS: Final = (SAMPLE_TOPIC, CONTROL_TOPIC, TIMING_TOPIC, EVENT_TOPIC, TOUCH_TOPIC)

SAMPLE_SCHEMA: Final = "rigd.Sample"
CONTROL_SCHEMA: Final = "rigd.Control"
TIMING_SCHEMA: Final = "rigd.Timing"
TOUCH_SCHEMA: Final = "rigd.Touch"
EVENT_SCHEMA: Final = "foxglove.Log"
"""Name of the protobuf message of the session's log."""


EVENT_LEVELS: Final = ("unknown", "debug", "info", "warning", "error", "fatal")
"""Names of the severity levels 0…5 of ``foxglove.Log.Level``."""


def _fixed_layout_file(schema_name: str, field_types: dict[str, str]) -> "FileDescriptorProto":
    """Return the protobuf file descriptor of a message with the given field names and types."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

    package_name, message_name = schema_name.split(".")
    file_descriptor = FileDescriptorProto(
        name=f"{package_name}/{message_name.lower()}.proto", package=package_name, syntax="proto3"
    )
    message_descriptor = file_descriptor.message_type.add(name=message_name)
    for field_number, (field_name, protobuf_type) in enumerate(field_types.items(), start=1):
        message_descriptor.field.add(
            name=field_name,
            number=field_number,
            label=FieldDescriptorProto.LABEL_OPTIONAL,
            type=FieldDescriptorProto.Type.Value(f"TYPE_{protobuf_type.upper()}"),
        )
    return file_descriptor


def _event_file() -> "FileDescriptorProto":
    """Return the protobuf file descriptor of the log message ``foxglove.Log``.

    It contains only the fields used here; https://github.com/foxglove/foxglove-sdk defines all.
    """
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

    file_descriptor = FileDescriptorProto(
        name="foxglove/Log.proto",
        package="foxglove",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    log_descriptor = file_descriptor.message_type.add(name="Log")
    level_enum = log_descriptor.enum_type.add(name="Level")
    for level_number, level_name in enumerate(EVENT_LEVELS):
        level_enum.value.add(name=level_name.upper(), number=level_number)
    log_fields = (
        ("timestamp", FieldDescriptorProto.TYPE_MESSAGE, ".google.protobuf.Timestamp"),
        ("level", FieldDescriptorProto.TYPE_ENUM, ".foxglove.Log.Level"),
        ("message", FieldDescriptorProto.TYPE_STRING, None),
        ("name", FieldDescriptorProto.TYPE_STRING, None),
        ("file", FieldDescriptorProto.TYPE_STRING, None),
        ("line", FieldDescriptorProto.TYPE_FIXED32, None),
    )
    for field_number, (field_name, protobuf_type, type_name) in enumerate(log_fields, start=1):
        log_descriptor.field.add(
            name=field_name,
            number=field_number,
            label=FieldDescriptorProto.LABEL_OPTIONAL,
            type=protobuf_type,
            type_name=type_name,
        )
    return file_descriptor


@cache
def schema_data(schema_name: str) -> bytes:
    """Return the serialised ``FileDescriptorSet`` that a session file contains for a schema."""
    from google.protobuf import timestamp_pb2
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

    if schema_name == EVENT_SCHEMA:
        timestamp_file = FileDescriptorProto()
        timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp_file)
        file_descriptors = [timestamp_file, _event_file()]
    else:
        field_types = {
            SAMPLE_SCHEMA: SAMPLE_FIELD_TYPES,
            CONTROL_SCHEMA: CONTROL_FIELD_TYPES,
            TIMING_SCHEMA: TIMING_FIELD_TYPES,
            TOUCH_SCHEMA: TOUCH_FIELD_TYPES,
        }[schema_name]
        file_descriptors = [_fixed_layout_file(schema_name, field_types)]
    return FileDescriptorSet(file=file_descriptors).SerializeToString(deterministic=True)


@lru_cache(maxsize=16)
def message_class(schema_name: str, schema_bytes: bytes) -> "type[Message]":
    """Return the protobuf class that decodes the messages of a schema.

    Building a class takes as long as decoding dozens of messages, so the last few are cached.
    `schema_name` is the full name of the message type, such as ``rigd.Sample``, and `schema_bytes`
    a serialised ``FileDescriptorSet``. Raise `ValueError` if `schema_bytes` is not a consistent
    ``FileDescriptorSet`` that contains `schema_name`.
    """
    from google.protobuf import descriptor_pool, message_factory
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message import DecodeError

    shown_name = repr(schema_name if len(schema_name) <= 40 else schema_name[:40] + "…")
    if len(schema_bytes) > limits.MAX_SCHEMA_BYTES:
        raise ValueError(
            f"schema {shown_name} has {len(schema_bytes)} bytes, more than the "
            f"{limits.MAX_SCHEMA_BYTES} that are read"
        )
    try:
        files_to_add = {
            file_descriptor.name: file_descriptor
            for file_descriptor in FileDescriptorSet.FromString(schema_bytes).file
        }
        protobuf_pool = descriptor_pool.DescriptorPool()

        def add_file_with_imports(file_name: str) -> None:
            # A file must be added to the pool after the files that it imports.
            file_descriptor = files_to_add.pop(file_name, None)
            if file_descriptor is not None:
                for dependency in file_descriptor.dependency:
                    add_file_with_imports(dependency)
                protobuf_pool.Add(file_descriptor)

        while files_to_add:
            add_file_with_imports(next(iter(files_to_add)))
        message_descriptor = protobuf_pool.FindMessageTypeByName(schema_name)
    except (DecodeError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"schema {shown_name} is not a usable protobuf schema") from error
    return message_factory.GetMessageClass(message_descriptor)


def metadata_for_channel(
    session_record: Mapping[str, str], segments_record: Mapping[str, str]
) -> dict[str, str]:
    """Return the records ``session`` and ``segments`` as metadata of the samples' channel.

    The copy in the channel is protected by the checksum of its chunk. A metadata record of MCAP has
    no checksum, and the checksum of the whole file is missing if the file is truncated.
    """
    return {
        **{f"session.{key}": metadata_value for key, metadata_value in session_record.items()},
        **{f"segments.{key}": metadata_value for key, metadata_value in segments_record.items()},
    }


def metadata_from_channel(channel_metadata: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Return the records ``session`` and ``segments`` from the metadata of the samples' channel.

    This is the inverse of `metadata_for_channel`, except that empty records are missing.
    """
    record_by_name: dict[str, dict[str, str]] = {}
    for key, metadata_value in channel_metadata.items():
        record, separator, key_name = key.partition(".")
        if separator and record in ("session", "segments"):
            record_by_name.setdefault(record, {})[key_name] = metadata_value
    return record_by_name


def event_class() -> "type[Message]":
    """Return the protobuf class that encodes a message of the session's log."""
    return message_class(EVENT_SCHEMA, schema_data(EVENT_SCHEMA))
