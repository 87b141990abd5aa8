"""Byte layout of a session file's messages.

Every message of ``/rig/sample``, ``/rig/control``, ``/rig/timing`` and ``/rig/touch`` is protobuf
of *fixed layout*: all fields are ``sfixed64``, ``fixed32`` or ``double``, numbered from 1 in the
order below, and all are written, even if they are 0. Tags are then constant bytes and all messages
of a topic have the same length: one ``struct.pack_into`` writes a message, one
``numpy.frombuffer`` reads a block of messages, and any protobuf decoder can read them.

The control process packs messages with this module, which therefore imports numpy and the standard
library only.
"""

import struct
from collections.abc import Iterable, Mapping
from enum import IntFlag
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

Buffer = bytes | bytearray | memoryview

SAMPLE_FIELD_TYPES: Final[dict[str, str]] = {
    "t_ns": "sfixed64",
    "tick": "fixed32",
    "angle_reference_rad": "double",
    "angle_rad": "double",
    "torque_command_nm": "double",
    "coupling_torque_nm": "double",
    "fx_n": "double",
    "fy_n": "double",
    "fz_n": "double",
    "tx_nm": "double",
    "ty_nm": "double",
    "tz_nm": "double",
    "status": "fixed32",
    "lateness_ns": "fixed32",
    "work_ns": "fixed32",
}
"""Field name → protobuf type, for the message ``rigd.Sample``, in the order of field numbers."""

WRENCH_FIELDS: Final = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
"""Fields of ``rigd.Sample`` with the three forces and three torques of the sensor."""

CONTROL_FIELD_TYPES: Final[dict[str, str]] = {
    "t_ns": "sfixed64",
    "tick": "fixed32",
    "proportional_nm": "double",
    "integral_nm": "double",
    "derivative_nm": "double",
    "feedforward_nm": "double",
    "friction_nm": "double",
    "unlimited_torque_nm": "double",
}
"""Field name → protobuf type, for the message ``rigd.Control``, in the order of field numbers."""

TIMING_FIELD_TYPES: Final[dict[str, str]] = {
    "t_ns": "sfixed64",
    "tick": "fixed32",
    "angle_age_s": "double",
    "wrench_age_s": "double",
}
"""Field name → protobuf type, for the message ``rigd.Timing``, in the order of field numbers."""

TOUCH_FIELD_TYPES: Final[dict[str, str]] = {
    "t_ns": "sfixed64",
    "tick": "fixed32",
    "x_m": "double",
    "x_std_m": "double",
    "force_n": "double",
    "force_std_n": "double",
    "stiffness_n_per_m": "double",
    "stiffness_std_n_per_m": "double",
    "kind": "fixed32",
}
"""Field name → protobuf type, for the message ``rigd.Touch``, in the order of field numbers."""

TOUCH_KINDS: Final = ("unknown", "rigid", "yielding", "moving", "knock")
"""Kinds of obstacle that the beam touched: names of the values 0…4 of the field ``kind``."""

_NUMPY_TYPE_BY_PROTOBUF_TYPE: Final = {"sfixed64": "<i8", "fixed32": "<u4", "double": "<f8"}
_WIRE_TYPE_BY_PROTOBUF_TYPE: Final = {
    "sfixed64": 1,
    "fixed32": 5,
    "double": 1,
}  # of the protobuf encoding


class Status(IntFlag):
    """Flags of a sample: bits of its field ``status``; the other bits are reserved."""

    TORQUE_SATURATED = 1
    """The torque command was reduced to the torque limit."""
    WRENCH_SATURATED = 2
    """At least one axis of the force-torque sensor was at the end of its range."""
    ANGLE_STALE = 4
    """No new angle arrived in time, so that the last angle is repeated."""
    WRENCH_STALE = 8
    """No new wrench arrived in time, so that the last wrench is repeated."""
    AFTER_MISSED = 16
    """This is the first sample after ticks that the control loop missed."""
    AFTER_LOST = 32
    """This is the first sample after samples that were measured but could not be recorded."""
    LIMIT_WARNING = 64
    """A limit of the profile is nearly reached or exceeded."""
    TORQUE_OFF = 128
    """No torque is commanded; whether the drive obeys is stated by the outcome of the session."""
    LATE = 256
    """The control loop woke up late for this tick."""
    TOUCHED = 512
    """In this tick the control loop detected that the beam touched an obstacle."""


def field_tag(field_number: int, protobuf_type: str) -> int:
    """Return the protobuf tag byte that precedes a field of a fixed-layout message.

    Parameters
    ----------
    field_number
        Field number, from 1 to 15.
    protobuf_type
        Type of the field: "sfixed64", "fixed32" or "double".

    Examples
    --------
    >>> from rigd.session.layout import field_tag
    >>> hex(field_tag(2, "fixed32"))
    '0x15'
    """
    return field_number << 3 | _WIRE_TYPE_BY_PROTOBUF_TYPE[protobuf_type]


def _native_dtype(field_types: dict[str, str]) -> np.dtype[np.void]:
    """Return the array type of a decoded message with the given fields and protobuf types."""
    # Aligned: NumPy's loops over one field are then as fast as over any strided array.
    return np.dtype(
        [
            (field_name, _NUMPY_TYPE_BY_PROTOBUF_TYPE[protobuf_type])
            for field_name, protobuf_type in field_types.items()
        ],
        align=True,
    )


def _wire_dtype(field_types: dict[str, str]) -> np.dtype[np.void]:
    """Return the array type of an encoded message: each field after its tag byte ``tag_NAME``."""
    dtype_fields: list[tuple[str, str]] = []
    for field_name, protobuf_type in field_types.items():
        dtype_fields += [
            (f"tag_{field_name}", "u1"),
            (field_name, _NUMPY_TYPE_BY_PROTOBUF_TYPE[protobuf_type]),
        ]
    return np.dtype(dtype_fields)


SAMPLE_FIELDS: Final = tuple(SAMPLE_FIELD_TYPES)
SAMPLE_DTYPE: Final = _native_dtype(SAMPLE_FIELD_TYPES)
"""Array type of a decoded sample."""
SAMPLE_WIRE_DTYPE: Final = _wire_dtype(SAMPLE_FIELD_TYPES)
"""Array type of an encoded sample in the file: each field after its tag byte ``tag_NAME``."""
SAMPLE_SIZE: Final = SAMPLE_WIRE_DTYPE.itemsize
"""Length of an encoded sample in bytes."""

CONTROL_DTYPE: Final = _native_dtype(CONTROL_FIELD_TYPES)
"""Array type of a decoded message with the controller's terms."""
CONTROL_WIRE_DTYPE: Final = _wire_dtype(CONTROL_FIELD_TYPES)
"""Array type of an encoded message with the controller's terms: each field after its tag byte."""
CONTROL_SIZE: Final = CONTROL_WIRE_DTYPE.itemsize
"""Length of an encoded message with the controller's terms in bytes."""

TIMING_DTYPE: Final = _native_dtype(TIMING_FIELD_TYPES)
"""Array type of a decoded message with the ages of the angle and wrench readings."""
TIMING_WIRE_DTYPE: Final = _wire_dtype(TIMING_FIELD_TYPES)
"""Array type of an encoded message with the readings' ages: each field after its tag byte."""
TIMING_SIZE: Final = TIMING_WIRE_DTYPE.itemsize
"""Length of an encoded message with the readings' ages in bytes."""

TOUCH_DTYPE: Final = _native_dtype(TOUCH_FIELD_TYPES)
"""Array type of a decoded message with an estimated touch."""
TOUCH_WIRE_DTYPE: Final = _wire_dtype(TOUCH_FIELD_TYPES)
"""Array type of an encoded message with an estimated touch: each field after its tag byte."""
TOUCH_SIZE: Final = TOUCH_WIRE_DTYPE.itemsize
"""Length of an encoded message with an estimated touch in bytes."""

_pack_sample: Final = struct.Struct("<Bq BI" + "Bd" * 10 + "BI" * 3).pack_into
_pack_control: Final = struct.Struct("<Bq BI" + "Bd" * 6).pack_into
_pack_timing: Final = struct.Struct("<Bq BI" + "Bd" * 2).pack_into


def pack_sample_into(
    buffer: bytearray | memoryview,
    offset: int,
    t_ns: int,
    tick: int,
    angle_reference_rad: float,
    angle_rad: float,
    torque_command_nm: float,
    coupling_torque_nm: float,
    fx_n: float,
    fy_n: float,
    fz_n: float,
    tx_nm: float,
    ty_nm: float,
    tz_nm: float,
    status: int,
    lateness_ns: int,
    work_ns: int,
) -> None:
    """Encode one sample as ``SAMPLE_SIZE`` bytes of `buffer` from `offset`.

    The control loop calls this once a tick. `lateness_ns` and `work_ns` are clamped to 0…2³²−1 ns.
    Any other value outside its field's range raises ``struct.error``.

    Parameters
    ----------
    buffer
        Memory to write to.
    offset
        Position of the encoded sample in the buffer, in bytes.
    t_ns
        Scheduled time of the tick, in nanoseconds since the session start.
    tick
        Number of the tick.
    angle_reference_rad, angle_rad
        Reference angle and measured angle.
    torque_command_nm, coupling_torque_nm
        Commanded motor torque, and measured torque about the motor's axis.
    fx_n, fy_n, fz_n, tx_nm, ty_nm, tz_nm
        Tared wrench in the sensor's frame.
    status
        Combined bits of `Status`.
    lateness_ns, work_ns
        Wake-up latency and execution time of the tick.

    Examples
    --------
    >>> from rigd.session.layout import SAMPLE_SIZE, decode_samples, pack_sample_into
    >>> block = bytearray(SAMPLE_SIZE)
    >>> pack_sample_into(block, 0, 5_000_000, 5, 0.01, 0.009, *[0.0] * 8, 0, 12_000, 90_000)
    >>> sample = decode_samples(block)[0]
    >>> print(sample["tick"], sample["angle_rad"], sample["lateness_ns"])
    5 0.009 12000
    """
    if not 0 <= lateness_ns <= 0xFFFFFFFF:
        lateness_ns = 0 if lateness_ns < 0 else 0xFFFFFFFF
    if not 0 <= work_ns <= 0xFFFFFFFF:
        work_ns = 0 if work_ns < 0 else 0xFFFFFFFF
    # The tags are literals because this call takes a considerable part of the loop's own time.
    # fmt: off
    _pack_sample(
        buffer, offset,
        0x09, t_ns, 0x15, tick,
        0x19, angle_reference_rad, 0x21, angle_rad,
        0x29, torque_command_nm, 0x31, coupling_torque_nm,
        0x39, fx_n, 0x41, fy_n, 0x49, fz_n, 0x51, tx_nm, 0x59, ty_nm, 0x61, tz_nm,
        0x6D, status, 0x75, lateness_ns, 0x7D, work_ns,
    )
    # fmt: on


def pack_control_into(
    buffer: bytearray | memoryview,
    offset: int,
    t_ns: int,
    tick: int,
    proportional_nm: float,
    integral_nm: float,
    derivative_nm: float,
    feedforward_nm: float,
    friction_nm: float,
    unlimited_torque_nm: float,
) -> None:
    """Encode the controller's terms of one tick as ``CONTROL_SIZE`` bytes of `buffer`.

    Parameters
    ----------
    buffer
        Memory to write to.
    offset
        Position of the encoded message in the buffer, in bytes.
    t_ns
        Scheduled time of the tick, in nanoseconds since the session start.
    tick
        Number of the tick.
    proportional_nm, integral_nm, derivative_nm, feedforward_nm, friction_nm
        Torques of the controller's terms.
    unlimited_torque_nm
        Sum of the torques before it is limited.
    """
    # fmt: off
    _pack_control(
        buffer, offset,
        0x09, t_ns, 0x15, tick,
        0x19, proportional_nm, 0x21, integral_nm, 0x29, derivative_nm,
        0x31, feedforward_nm, 0x39, friction_nm, 0x41, unlimited_torque_nm,
    )
    # fmt: on


def pack_timing_into(
    buffer: bytearray | memoryview,
    offset: int,
    t_ns: int,
    tick: int,
    angle_age_s: float,
    wrench_age_s: float,
) -> None:
    """Encode the ages of one tick's readings as ``TIMING_SIZE`` bytes of `buffer`.

    Parameters
    ----------
    buffer
        Memory to write to.
    offset
        Position of the encoded message in the buffer, in bytes.
    t_ns
        Scheduled time of the tick, in nanoseconds since the session start.
    tick
        Number of the tick.
    angle_age_s, wrench_age_s
        Time from the measurement of the angle and of the wrench until the controller used them.
    """
    _pack_timing(buffer, offset, 0x09, t_ns, 0x15, tick, 0x19, angle_age_s, 0x21, wrench_age_s)


def pack_touch(
    t_ns: int,
    tick: int,
    x_m: float,
    x_std_m: float,
    force_n: float,
    force_std_n: float,
    stiffness_n_per_m: float,
    stiffness_std_n_per_m: float,
    kind: str,
) -> bytes:
    """Return the ``TOUCH_SIZE`` bytes that encode an estimated touch of the beam on an obstacle.

    An unknown distance, force or stiffness is NaN.

    Parameters
    ----------
    t_ns
        Time of the first contact, in nanoseconds since the session start.
    tick
        Tick in which the control loop detected the touch.
    x_m, x_std_m
        Distance of the contact point from the motor's axis, and its standard deviation.
    force_n, force_std_n
        Peak magnitude of the contact force, and its standard deviation.
    stiffness_n_per_m, stiffness_std_n_per_m
        Contact stiffness of the obstacle, and its standard deviation.
    kind
        One of ``TOUCH_KINDS``; any other text is encoded as unknown.
    """
    touch_values = (
        t_ns, tick, x_m, x_std_m, force_n, force_std_n, stiffness_n_per_m, stiffness_std_n_per_m,
        TOUCH_KINDS.index(kind) if kind in TOUCH_KINDS else 0,
    )  # fmt: skip
    return _encode_messages(
        dict(zip(TOUCH_FIELD_TYPES, touch_values, strict=True)), TOUCH_FIELD_TYPES, TOUCH_WIRE_DTYPE
    )


def encode_samples(field_values: Mapping[str, npt.ArrayLike]) -> bytes:
    """Return the encoded bytes of samples, in the fixed layout that `decode_samples` reads.

    Parameters
    ----------
    field_values : mapping of str to array (n,)
        Name of a sample field → values; ``tick`` is required, other absent fields are 0.

    Examples
    --------
    >>> from rigd.session.layout import decode_samples, encode_samples
    >>> decode_samples(encode_samples({"tick": [0, 1], "angle_rad": [0.1, 0.2]}))["angle_rad"]
    array([0.1, 0.2])
    """
    return _encode_messages(field_values, SAMPLE_FIELD_TYPES, SAMPLE_WIRE_DTYPE)


def _encode_messages(
    field_values: Mapping[str, npt.ArrayLike],
    field_types: dict[str, str],
    wire_dtype: np.dtype[np.void],
) -> bytes:
    """Return messages encoded in the fixed layout, from field name → values (n,)."""
    wire_messages = np.zeros(np.size(field_values["tick"]), wire_dtype)
    for field_number, (field_name, protobuf_type) in enumerate(field_types.items(), start=1):
        wire_messages[f"tag_{field_name}"] = field_tag(field_number, protobuf_type)
        if field_name in field_values:
            wire_messages[field_name] = field_values[field_name]
    return wire_messages.tobytes()


def is_fixed_layout(
    wire_messages: npt.NDArray[np.void], field_types: dict[str, str]
) -> npt.NDArray[np.bool_]:
    """Return a mask of the encoded messages whose tag bytes are all those of the fixed layout.

    Parameters
    ----------
    wire_messages : array (n,) of encoded messages, such as of ``SAMPLE_WIRE_DTYPE``
    field_types : protobuf types of the fields, such as ``SAMPLE_FIELD_TYPES``

    Returns
    -------
    array (n,) of bool
    """
    tag_offsets, tag_values = _tag_offsets_and_values(
        wire_messages.dtype, tuple(field_types.items())
    )
    message_bytes = (
        np.ascontiguousarray(wire_messages)
        .view(np.uint8)
        .reshape(wire_messages.size, wire_messages.dtype.itemsize)
    )
    has_fixed_layout: npt.NDArray[np.bool_] = (message_bytes[:, tag_offsets] == tag_values).all(
        axis=1
    )
    return has_fixed_layout


@cache
def _tag_offsets_and_values(
    wire_dtype: np.dtype[np.void], field_types: tuple[tuple[str, str], ...]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.uint8]]:
    """Return the offsets and the values of the tag bytes in an encoded message."""
    assert wire_dtype.fields is not None
    tag_offsets = [wire_dtype.fields[f"tag_{field_name}"][1] for field_name, _ in field_types]
    tag_values = [
        field_tag(field_number, protobuf_type)
        for field_number, (_, protobuf_type) in enumerate(field_types, start=1)
    ]
    return np.array(tag_offsets), np.array(tag_values, dtype=np.uint8)


def to_native(
    wire_messages: npt.NDArray[np.void],
    field_names: Iterable[str],
    native_messages: npt.NDArray[np.void],
) -> None:
    """Copy fields of encoded messages into an array of decoded messages.

    Parameters
    ----------
    wire_messages : array (n,) of encoded messages
    field_names
        Names of the fields to copy.
    native_messages : array (n,) of decoded messages, which is written to
    """
    for field_name in field_names:
        native_messages[field_name] = wire_messages[field_name]


def _decode_messages(
    packed_messages: Buffer,
    field_types: dict[str, str],
    wire_dtype: np.dtype[np.void],
    dtype: np.dtype[np.void],
) -> npt.NDArray[np.void]:
    """Return the decoded messages of a block of bytes; raise ValueError if a tag byte is wrong."""
    packed_length = memoryview(packed_messages).nbytes
    if packed_length % wire_dtype.itemsize:
        raise ValueError(
            f"a block of {packed_length} bytes is not a whole number of {wire_dtype.itemsize}-byte "
            "messages"
        )
    wire_messages = np.frombuffer(packed_messages, wire_dtype)
    has_fixed_layout = is_fixed_layout(wire_messages, field_types)
    if not has_fixed_layout.all():
        raise ValueError(
            f"message {int(np.argmin(has_fixed_layout))} of the block is not of the fixed layout"
        )
    decoded_messages = np.empty(wire_messages.shape, dtype)
    to_native(wire_messages, field_types, decoded_messages)
    return decoded_messages


def decode_samples(packed_samples: Buffer) -> npt.NDArray[np.void]:
    """Return the samples that a block of bytes encodes in the fixed layout.

    Parameters
    ----------
    packed_samples : n × ``SAMPLE_SIZE`` bytes

    Returns
    -------
    new array (n,) of ``SAMPLE_DTYPE``

    Raises
    ------
    ValueError
        If the length is not a multiple of ``SAMPLE_SIZE``, or a tag byte is wrong.
    """
    return _decode_messages(packed_samples, SAMPLE_FIELD_TYPES, SAMPLE_WIRE_DTYPE, SAMPLE_DTYPE)


def decode_controls(packed_controls: Buffer) -> npt.NDArray[np.void]:
    """Return the controller terms (n,) of ``CONTROL_DTYPE`` that a block of bytes encodes."""
    return _decode_messages(packed_controls, CONTROL_FIELD_TYPES, CONTROL_WIRE_DTYPE, CONTROL_DTYPE)


def decode_timings(packed_timings: Buffer) -> npt.NDArray[np.void]:
    """Return the ages of readings (n,) of ``TIMING_DTYPE`` that a block of bytes encodes."""
    return _decode_messages(packed_timings, TIMING_FIELD_TYPES, TIMING_WIRE_DTYPE, TIMING_DTYPE)


def decode_touches(packed_touches: Buffer) -> npt.NDArray[np.void]:
    """Return the estimated touches (n,) of ``TOUCH_DTYPE`` that a block of bytes encodes."""
    return _decode_messages(packed_touches, TOUCH_FIELD_TYPES, TOUCH_WIRE_DTYPE, TOUCH_DTYPE)
