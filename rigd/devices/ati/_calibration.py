"""Calibration of an ATI sensor, from gauge counts to a wrench, and its status words.

A force (N after the unit's factor) is ``F_i = unit · Σ_j M_ij g_j / counts_per_force``, a torque
(N·m) the same with its own unit and counts. NETCANOEM sends the matrix row by row, Digital F/T in a
block of registers.

The status words of both sensors are put into words, and some of their bits forbid measuring.
Sources: the manuals of NETCANOEM and of Digital F/T. They differ in bits 9, 10 and 13.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from struct import pack, unpack

import numpy as np

from rigd.devices.contracts import Wrench

WIRE_ORDER = (0, 2, 4, 1, 3, 5)
"""Gauge at each position of a reading, on CAN and on the serial line."""

Rows = tuple[tuple[float, ...], ...]

_LBF_N = 4.4482216152605
_KGF_N = 9.80665
_FORCE_UNITS = {
    1: ("lbf", _LBF_N),
    2: ("N", 1.0),
    3: ("klbf", 1e3 * _LBF_N),
    4: ("kN", 1e3),
    5: ("kgf", _KGF_N),
    6: ("gf", 1e-3 * _KGF_N),
}
_TORQUE_UNITS = {
    1: ("lbf·in", 0.0254 * _LBF_N),
    2: ("lbf·ft", 0.3048 * _LBF_N),
    3: ("N·m", 1.0),
    4: ("N·mm", 1e-3),
    5: ("kgf·cm", 1e-2 * _KGF_N),
    6: ("kN·m", 1e3),
}
_AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")

_FULL_SCALE_COUNTS = 32768
_LARGEST, _SMALLEST = 1e6, 1e-6
"""N or N·m of one gauge at its full scale: no sensor is built for more or for less (the largest has
40 kN, the smallest resolves 1 mN)."""
_LEAST_RANK = 1e-6
"""Ratio of the singular values below which some loads are not distinguishable in single
precision."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """One calibration of a sensor.

    Parameters
    ----------
    serial_number, part_number, date, family
        As the sensor spells them; empty where it has none.
    force_unit, torque_unit
        ATI's codes, from 1.
    counts_per_force, counts_per_torque
        Counts for one such unit.
    matrix
        Rows Fx, Fy, Fz, Tx, Ty, Tz; columns gauges 0 to 5.
    ratings
        Largest rated load of each axis in the calibration's units; None where it does not say.

    Raises
    ------
    ValueError
        If no wrench can be computed with it; the message is a sentence for the operator.
    """

    serial_number: str
    force_unit: int
    torque_unit: int
    counts_per_force: int
    counts_per_torque: int
    matrix: Rows
    part_number: str = ""
    date: str = ""
    family: str = ""
    ratings: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Raise if no wrench can be computed with the calibration."""
        if self.force_unit not in _FORCE_UNITS or self.torque_unit not in _TORQUE_UNITS:
            raise ValueError(
                f"its calibration has the unit codes {self.force_unit} (force) and "
                f"{self.torque_unit} (torque); known are 1 to 6. Choose another calibration."
            )
        if self.counts_per_force <= 0 or self.counts_per_torque <= 0:
            raise ValueError(
                f"its calibration has {self.counts_per_force} counts per force and "
                f"{self.counts_per_torque} per torque, where positive numbers belong. Choose "
                "another calibration."
            )
        self._check_matrix()

    def _check_matrix(self) -> None:
        for number, (axis, row) in enumerate(zip(_AXES, self.matrix, strict=True)):
            unit = self.force_unit_n if number < 3 else self.torque_unit_nm
            counts = self.counts_per_force if number < 3 else self.counts_per_torque
            per_entry = unit / counts * _FULL_SCALE_COUNTS
            name = "N" if number < 3 else "N·m"
            for gauge, entry in enumerate(row):
                if not isfinite(entry):
                    raise ValueError(
                        f"the entry {axis}, gauge {gauge} of its calibration matrix is {entry}, "
                        "which is not a number. Choose another calibration."
                    )
                if abs(entry) * per_entry > _LARGEST:
                    raise ValueError(
                        f"the entry {axis}, gauge {gauge} of its calibration matrix is {entry:.4g} "
                        f"({abs(entry) * per_entry:.2g} {name} for a gauge at full scale), more "
                        f"than any sensor has ({_LARGEST:g} {name}): its memory is damaged. Choose "
                        "another calibration, or have the sensor repaired."
                    )
            if not any(row):
                raise ValueError(
                    f"the row {axis} of its calibration matrix is zero: that calibration is "
                    "empty. Choose another calibration."
                )
            if max(map(abs, row)) * per_entry < _SMALLEST:
                raise ValueError(
                    f"no entry of the row {axis} of its calibration matrix is beyond "
                    f"{max(map(abs, row)):.2g} (less than {_SMALLEST:g} {name} for a gauge at full "
                    "scale): its memory is damaged. Choose another calibration, or have the sensor "
                    "repaired."
                )
        rows = np.array(self.matrix)
        rows /= np.abs(rows).max(axis=1, keepdims=True)
        rows /= np.abs(rows).max(axis=0, keepdims=True).clip(min=np.finfo(float).tiny)
        singular_values = np.linalg.svd(rows, compute_uv=False)
        if singular_values[-1] < _LEAST_RANK * singular_values[0]:
            raise ValueError(
                "its calibration matrix is singular: some of its six axes are combinations of the "
                "others. Its memory is damaged; choose another calibration, or have the sensor "
                "repaired."
            )

    @property
    def force_unit_n(self) -> float:
        """One unit of force in N."""
        return _FORCE_UNITS[self.force_unit][1]

    @property
    def torque_unit_nm(self) -> float:
        """One unit of torque in N·m."""
        return _TORQUE_UNITS[self.torque_unit][1]

    def wrench_per_count(self) -> Rows:
        """Return the matrix from gauge counts, in natural order, to N and N·m."""
        force = self.force_unit_n / self.counts_per_force
        torque = self.torque_unit_nm / self.counts_per_torque
        return tuple(
            tuple((force if axis < 3 else torque) * entry for entry in row)
            for axis, row in enumerate(self.matrix)
        )

    def wrench_per_wire_count(self) -> Rows:
        """Return the same matrix with its columns in the order of the wire."""
        return tuple(tuple(row[gauge] for gauge in WIRE_ORDER) for row in self.wrench_per_count())

    def as_dict(self) -> dict[str, object]:
        """Return the calibration for the session file; ranges in N and N·m."""
        ranges: list[float] | str = "not stated by the sensor"
        if self.ratings is not None and all(map(isfinite, self.ratings)):
            ranges = [
                (self.force_unit_n if axis < 3 else self.torque_unit_nm) * rating
                for axis, rating in enumerate(self.ratings)
            ]
        return {
            "serial_number": self.serial_number,
            "part_number": self.part_number,
            "calibration_date": self.date,
            "family": self.family,
            "force_unit": _FORCE_UNITS[self.force_unit][0],
            "torque_unit": _TORQUE_UNITS[self.torque_unit][0],
            "counts_per_force": self.counts_per_force,
            "counts_per_torque": self.counts_per_torque,
            "matrix": [list(row) for row in self.matrix],
            "range_n_nm": ranges,
        }


def wrench_function(rows: Rows) -> Callable[[float, float, float, float, float, float], Wrench]:
    """Return the product with a 6x6 matrix as a function of six numbers.

    Written out it takes half the time of NumPy on six numbers that come as Python integers.
    """
    (
        (xa, xb, xc, xd, xe, xf),
        (ya, yb, yc, yd, ye, yf),
        (za, zb, zc, zd, ze, zf),
        (ua, ub, uc, ud, ue, uf),
        (va, vb, vc, vd, ve, vf),
        (wa, wb, wc, wd, we, wf),
    ) = rows

    def wrench(a: float, b: float, c: float, d: float, e: float, f: float) -> Wrench:
        return (
            xa * a + xb * b + xc * c + xd * d + xe * e + xf * f,
            ya * a + yb * b + yc * c + yd * d + ye * e + yf * f,
            za * a + zb * b + zc * c + zd * d + ze * e + zf * f,
            ua * a + ub * b + uc * c + ud * d + ue * e + uf * f,
            va * a + vb * b + vc * c + vd * d + ve * e + vf * f,
            wa * a + wb * b + wc * c + wd * d + we * e + wf * f,
        )

    return wrench


def same_serial_number(wanted: str, found: str) -> bool:
    """Return whether a sensor has the serial number of the profile; an empty one accepts any."""
    return not wanted or wanted.strip().upper() == found.strip().upper()


def text_of(raw: Sequence[int]) -> str:
    """Return bytes as text without padding, or in hexadecimal if they are not text."""
    data = bytes(raw).rstrip(b"\0\xff ")
    text = data.decode("latin-1").strip()
    return text if text.isascii() and (text.isprintable() or not text) else data.hex(" ")


# Calibration block of a Digital F/T

BLOCK_REGISTERS = 133
"""Length of a block, as far as the driver needs it."""

_FIRST_BLOCK = 0x00E3
_BLOCK_SPACING = 192


@dataclass(frozen=True, slots=True)
class CalibrationBlock:
    """A calibration, and the amplifier settings that belong to it."""

    calibration: Calibration
    gains: tuple[int, ...]
    """Gains of gauges 0 to 5, as register values."""
    offsets: tuple[int, ...]


def first_register(number: int) -> int:
    """Return where block ``number`` (1 to 16) begins."""
    return _FIRST_BLOCK + (number - 1) * _BLOCK_SPACING


def parse_block(registers: Sequence[int]) -> CalibrationBlock:
    """Read a block.

    Raises
    ------
    ValueError
        If no wrench can be computed with it; the message is a sentence for the operator.
    """
    raw = pack(f">{BLOCK_REGISTERS}H", *registers)

    def part(first: int, count: int) -> bytes:
        return raw[2 * first : 2 * (first + count)]

    entries = unpack(">36f", part(32, 72))
    counts_per_force, counts_per_torque = unpack(">ii", part(117, 4))
    calibration = Calibration(
        serial_number=text_of(part(0, 4)),
        part_number=text_of(part(4, 16)),
        family=text_of(part(20, 2)),
        date=text_of(part(22, 10)),
        matrix=tuple(tuple(entries[6 * axis : 6 * axis + 6]) for axis in range(6)),
        force_unit=registers[104] >> 8,
        torque_unit=registers[104] & 0xFF,
        ratings=unpack(">6f", part(105, 12)),
        counts_per_force=counts_per_force,
        counts_per_torque=counts_per_torque,
    )
    return CalibrationBlock(
        calibration=calibration,
        gains=unpack(">6H", part(121, 6)),
        offsets=unpack(">6H", part(127, 6)),
    )


# Status words

CAN_WATCHDOG_RESET = 0x0001
CAN_BAD_CALIBRATION = 0x0040
CAN_BUS_ERROR = 0x4000

_COMMON_WORDS = {
    0: "its watchdog has reset the board",
    1: "the gauges' excitation is too high",
    2: "the gauges' excitation is too low",
    3: "its artificial analogue ground is out of range",
    4: "its supply voltage is too high",
    5: "its supply voltage is too low",
    7: "its memory (EEPROM) has failed",
    8: "its configuration is invalid",
}
_CAN_WORDS = {
    **_COMMON_WORDS,
    6: "the active calibration is bad",
    11: "the sensor is too hot",
    12: "the sensor is too cold",
    14: "it has seen errors on the CAN bus",
}
CAN_CRITICAL = 0x18FE
"""Bits 1 to 7, 11 and 12."""

_SERIAL_WORDS = {
    **_COMMON_WORDS,
    9: "the bridges take too much current (broken gauge or cable)",
    10: "the bridges take too little current (broken gauge or cable)",
    11: "the reading of its thermistor is too high",
    12: "the reading of its thermistor is too low",
    13: "the reading of its analogue output is out of range",
}
SERIAL_CRITICAL = 0x3EBE
"""Bits 1 to 5, 7 and 9 to 13: what is critical on NETCANOEM, and the bits only this one has."""


def can_status(word: int) -> list[str]:
    """Describe the status word of a NETCANOEM box, one clause per bit."""
    # Bit 15 summarises the others.
    return _words(word & 0x7FFF, _CAN_WORDS)


def serial_status(word: int) -> list[str]:
    """Describe the status word of a Digital F/T sensor, one clause per bit."""
    return _words(word, _SERIAL_WORDS)


def _words(word: int, table: dict[int, str]) -> list[str]:
    return [
        table.get(bit, f"status bit {bit}, which has no known meaning, is set")
        for bit in range(16)
        if word >> bit & 1
    ]
