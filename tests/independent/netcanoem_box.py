"""A sensor box that speaks NETCANOEM, from ATI's manual 9610-05-1030: an independent witness."""

import struct
from collections.abc import Callable

import numpy as np

COUNTS_PER_UNIT = 1_000_000
SERIAL = b"FT99001\0"
FIRMWARE = (3, 8, 2)
NEWTON, NEWTON_METRE = 2, 3

_NOISE_COUNTS = 10.0
# Six gauges, each axis seen by several: an orthogonal pattern, scaled to the axis' range.
_PATTERN = np.linalg.qr(np.random.default_rng(40).normal(size=(6, 6)))[0]
_RANGES = np.array([20.0, 20.0, 60.0, 1.0, 1.0, 1.0])
_GAUGES_AT_RANGE = 12_000
MATRIX = (_RANGES * COUNTS_PER_UNIT / _GAUGES_AT_RANGE)[:, None] * _PATTERN
"""Rows Fx, Fy, Fz, Tx, Ty, Tz; wrench = MATRIX @ gauges / counts per unit."""
_OFFSET = np.array([310.0, -120.0, 77.0, -401.0, 56.0, 210.0])


class NetCanOemBox:
    """Answers each request with its frames.

    Parameters
    ----------
    base
        Upper seven bits of its identifiers.
    wrench
        Returns Fx, Fy, Fz in N and Tx, Ty, Tz in N·m of now.
    send
        Takes identifier and data.
    """

    def __init__(
        self,
        base: int,
        wrench: Callable[[], tuple[float, ...]],
        send: Callable[[int, bytes], None],
    ) -> None:
        self._first = base << 4
        self._wrench, self._send = wrench, send
        self._to_gauges = np.linalg.inv(MATRIX) * COUNTS_PER_UNIT
        self._noise = np.random.default_rng(41)
        self.status = 0

    def take(self, can_id: int, data: bytes) -> None:
        """Answer a frame, if it is a request to this box."""
        opcode = can_id - self._first
        if opcode == 0x0 and not data:
            self._send_gauges()
        elif opcode == 0x2 and len(data) == 1 and data[0] < 6:
            for third in range(3):
                pair = MATRIX[data[0], 2 * third : 2 * third + 2]
                self._send(self._first + 2 + third, struct.pack(">2f", *pair))
        elif opcode == 0x5:
            self._send(can_id, SERIAL)
        elif opcode == 0x6 and len(data) == 1:
            self._send(can_id, bytes(data))
        elif opcode == 0x7:
            self._send(can_id, struct.pack(">II", COUNTS_PER_UNIT, COUNTS_PER_UNIT))
        elif opcode == 0x8:
            self._send(can_id, bytes([NEWTON, NEWTON_METRE]))
        elif opcode == 0xF:
            self._send(can_id, struct.pack(">BBH", *FIRMWARE))

    def _send_gauges(self) -> None:
        raw = self._to_gauges @ np.array(self._wrench()) + _OFFSET
        raw += self._noise.normal(scale=_NOISE_COUNTS, size=6)
        gauges = [int(each) for each in np.clip(np.rint(raw), -32768, 32767)]
        self._send(self._first, struct.pack(">H3h", self.status, *gauges[0::2]))
        self._send(self._first + 1, struct.pack(">3h", *gauges[1::2]))
