"""Calibration of an ATI sensor (from gauge counts to a wrench), and descriptions of its status.

A force is ``F_i = unit · Σ_j M_ij g_j / counts_per_force`` in N; a torque in N·m follows likewise
with the unit of torque and the counts per torque. NETCANOEM sends the matrix row by row, Digital
F/T in a block of registers.

The module also describes the sensors' status words, and lists the bits with which no session may
start. Sources: the manuals of NETCANOEM and of Digital F/T, which differ in bits 9, 10 and 13.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from struct import pack, unpack

import numpy as np

from rigd.devices.contracts import Wrench

WIRE_ORDER = (0, 2, 4, 1, 3, 5)
"""Number of the gauge at each position of a reading, on CAN and on the serial line."""

MatrixRows = tuple[tuple[float, ...], ...]
"""Rows of a 6x6 matrix."""

_LBF_N = 4.4482216152605
"""One pound-force in N."""
_KGF_N = 9.80665
"""One kilogram-force in N."""
_FORCE_UNITS = {
    1: ("lbf", _LBF_N),
    2: ("N", 1.0),
    3: ("klbf", 1e3 * _LBF_N),
    4: ("kN", 1e3),
    5: ("kgf", _KGF_N),
    6: ("gf", 1e-3 * _KGF_N),
}
"""Name and value in N of each unit of force, by ATI's unit code."""
_TORQUE_UNITS = {
    1: ("lbf·in", 0.0254 * _LBF_N),
    2: ("lbf·ft", 0.3048 * _LBF_N),
    3: ("N·m", 1.0),
    4: ("N·mm", 1e-3),
    5: ("kgf·cm", 1e-2 * _KGF_N),
    6: ("kN·m", 1e3),
}
"""Name and value in N·m of each unit of torque, by ATI's unit code."""
_AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
"""Names of the six axes of a wrench."""

_FULL_SCALE_COUNTS = 32768
"""Gauge counts at full scale."""
_MAX_MATRIX_ENTRY, _MIN_MATRIX_ENTRY = 1e6, 1e-6
"""Largest and smallest plausible matrix entry, in N or N·m for one gauge at full scale.

No sensor is beyond them: the largest is for 40 kN, the smallest resolves 1 mN."""
_MIN_SINGULAR_VALUE_RATIO = 1e-6
"""Smallest permitted ratio of smallest to largest singular value of the scaled matrix.

Below it some loads are not distinguishable in single precision."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibration of an ATI sensor: matrix, units and identity.

    The constructor raises `ValueError` if no wrench can be computed with the calibration; the
    message is for the operator.

    Attributes
    ----------
    serial_number, part_number, date, family
        Texts as stored in the sensor; empty if it has none.
    force_unit, torque_unit
        ATI's codes of the units, from 1.
    counts_per_force, counts_per_torque
        Counts per unit of force and per unit of torque.
    matrix
        Calibration matrix; rows Fx, Fy, Fz, Tx, Ty, Tz, columns gauges 0 to 5.
    rated_loads
        Largest rated load of each axis in the calibration's units; None if not stated.
    """

    serial_number: str
    force_unit: int
    torque_unit: int
    counts_per_force: int
    counts_per_torque: int
    matrix: MatrixRows
    part_number: str = ""
    date: str = ""
    family: str = ""
    rated_loads: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError if no wrench can be computed with the calibration."""
        if self.force_unit not in _FORCE_UNITS or self.torque_unit not in _TORQUE_UNITS:
            raise ValueError(
                f"its calibration has the unit codes {self.force_unit} (force) and "
                f"{self.torque_unit} (torque); known are 1 to 6. Choose another calibration."
            )
        if self.counts_per_force <= 0 or self.counts_per_torque <= 0:
            raise ValueError(
                f"its calibration has {self.counts_per_force} counts per force and "
                f"{self.counts_per_torque} per torque, but both must be positive. Choose another "
                "calibration."
            )
        self._check_calibration_matrix()

    def _check_calibration_matrix(self) -> None:
        """Raise ValueError if the calibration matrix has an implausible entry or is singular."""
        for axis_index, (axis, row) in enumerate(zip(_AXES, self.matrix, strict=True)):
            axis_unit = self.force_unit_n if axis_index < 3 else self.torque_unit_nm
            counts_per_unit = self.counts_per_force if axis_index < 3 else self.counts_per_torque
            full_scale_load = axis_unit / counts_per_unit * _FULL_SCALE_COUNTS
            unit_name = "N" if axis_index < 3 else "N·m"
            for gauge, matrix_entry in enumerate(row):
                if not isfinite(matrix_entry):
                    raise ValueError(
                        f"the entry {axis}, gauge {gauge} of its calibration matrix is "
                        f"{matrix_entry}, which is not a number. Choose another calibration."
                    )
                if abs(matrix_entry) * full_scale_load > _MAX_MATRIX_ENTRY:
                    raise ValueError(
                        f"the entry {axis}, gauge {gauge} of its calibration matrix is "
                        f"{matrix_entry:.4g} ({abs(matrix_entry) * full_scale_load:.2g} "
                        f"{unit_name} for a gauge at full scale), more than any sensor has "
                        f"({_MAX_MATRIX_ENTRY:g} {unit_name}): its memory is damaged. Choose "
                        "another calibration, or have the sensor repaired."
                    )
            if not any(row):
                raise ValueError(
                    f"the row {axis} of its calibration matrix is zero: that calibration is "
                    "empty. Choose another calibration."
                )
            if max(map(abs, row)) * full_scale_load < _MIN_MATRIX_ENTRY:
                raise ValueError(
                    f"no entry of the row {axis} of its calibration matrix is beyond "
                    f"{max(map(abs, row)):.2g} (less than {_MIN_MATRIX_ENTRY:g} {unit_name} for a "
                    "gauge at full scale): its memory is damaged. Choose another calibration, or "
                    "have the sensor repaired."
                )
        scaled_matrix = np.array(self.matrix)
        scaled_matrix /= np.abs(scaled_matrix).max(axis=1, keepdims=True)
        scaled_matrix /= (
            np.abs(scaled_matrix).max(axis=0, keepdims=True).clip(min=np.finfo(float).tiny)
        )
        singular_values = np.linalg.svd(scaled_matrix, compute_uv=False)
        if singular_values[-1] < _MIN_SINGULAR_VALUE_RATIO * singular_values[0]:
            raise ValueError(
                "its calibration matrix is singular: some of its six axes are combinations of the "
                "others. Its memory is damaged; choose another calibration, or have the sensor "
                "repaired."
            )

    @property
    def force_unit_n(self) -> float:
        """Calibration's unit of force in N."""
        return _FORCE_UNITS[self.force_unit][1]

    @property
    def torque_unit_nm(self) -> float:
        """Calibration's unit of torque in N·m."""
        return _TORQUE_UNITS[self.torque_unit][1]

    def wrench_per_count(self) -> MatrixRows:
        """Return the 6x6 matrix that converts counts of gauges 0 to 5 to a wrench in N and N·m."""
        force_per_count = self.force_unit_n / self.counts_per_force
        torque_per_count = self.torque_unit_nm / self.counts_per_torque
        return tuple(
            tuple(
                (force_per_count if axis < 3 else torque_per_count) * matrix_entry
                for matrix_entry in row
            )
            for axis, row in enumerate(self.matrix)
        )

    def wrench_per_wire_count(self) -> MatrixRows:
        """Return the 6x6 matrix that converts gauge counts in wire order to a wrench in N, N·m."""
        return tuple(tuple(row[gauge] for gauge in WIRE_ORDER) for row in self.wrench_per_count())

    def as_dict(self) -> dict[str, object]:
        """Return the calibration as a dictionary for the session file, ranges in N and N·m."""
        axis_ranges: list[float] | str = "not stated by the sensor"
        if self.rated_loads is not None and all(map(isfinite, self.rated_loads)):
            axis_ranges = [
                (self.force_unit_n if axis < 3 else self.torque_unit_nm) * rating
                for axis, rating in enumerate(self.rated_loads)
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
            "range_n_nm": axis_ranges,
        }


def wrench_from_counts_function(
    matrix_rows: MatrixRows,
) -> Callable[[float, float, float, float, float, float], Wrench]:
    """Return a function that multiplies a 6x6 matrix by six gauge counts, its arguments.

    Its product, written out, takes half the time that NumPy takes for six Python integers.
    """
    (
        (xa, xb, xc, xd, xe, xf),
        (ya, yb, yc, yd, ye, yf),
        (za, zb, zc, zd, ze, zf),
        (ua, ub, uc, ud, ue, uf),
        (va, vb, vc, vd, ve, vf),
        (wa, wb, wc, wd, we, wf),
    ) = matrix_rows

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


def same_serial_number(profile_number: str, sensor_number: str) -> bool:
    """Return whether a sensor has the profile's serial number, or the profile states none."""
    return not profile_number or profile_number.strip().upper() == sensor_number.strip().upper()


def printable_text(raw_bytes: Sequence[int]) -> str:
    """Decode bytes to text, without padding; return hexadecimal digits if it is not printable."""
    unpadded_bytes = bytes(raw_bytes).rstrip(b"\0\xff ")
    decoded_text = unpadded_bytes.decode("latin-1").strip()
    return (
        decoded_text
        if decoded_text.isascii() and (decoded_text.isprintable() or not decoded_text)
        else unpadded_bytes.hex(" ")
    )


# Calibration block of a Digital F/T

BLOCK_REGISTER_COUNT = 133
"""Number of 16-bit registers of a calibration block that the driver reads."""

_FIRST_BLOCK_ADDRESS = 0x00E3
"""Address of the first register of calibration block 1."""
_BLOCK_SPACING_REGISTERS = 192
"""Number of registers from the beginning of one calibration block to the next."""


@dataclass(frozen=True, slots=True)
class CalibrationBlock:
    """Calibration of a Digital F/T sensor, with the amplifier settings that belong to it."""

    calibration: Calibration
    """Calibration matrix, units and identity."""
    amplifier_gains: tuple[int, ...]
    """Amplifier gains of gauges 0 to 5, as register values."""
    amplifier_offsets: tuple[int, ...]
    """Amplifier offsets of gauges 0 to 5, as register values."""


def calibration_block_address(block_number: int) -> int:
    """Return the address of the first register of calibration block `block_number` (1 to 16)."""
    return _FIRST_BLOCK_ADDRESS + (block_number - 1) * _BLOCK_SPACING_REGISTERS


def parse_block(registers: Sequence[int]) -> CalibrationBlock:
    """Parse the registers of a calibration block.

    Raise `ValueError` if no wrench can be computed with the calibration; the message is for the
    operator.
    """
    raw_bytes = pack(f">{BLOCK_REGISTER_COUNT}H", *registers)

    def register_bytes(first_register: int, register_count: int) -> bytes:
        return raw_bytes[2 * first_register : 2 * (first_register + register_count)]

    matrix_entries = unpack(">36f", register_bytes(32, 72))
    counts_per_force, counts_per_torque = unpack(">ii", register_bytes(117, 4))
    calibration = Calibration(
        serial_number=printable_text(register_bytes(0, 4)),
        part_number=printable_text(register_bytes(4, 16)),
        family=printable_text(register_bytes(20, 2)),
        date=printable_text(register_bytes(22, 10)),
        matrix=tuple(tuple(matrix_entries[6 * axis : 6 * axis + 6]) for axis in range(6)),
        force_unit=registers[104] >> 8,
        torque_unit=registers[104] & 0xFF,
        rated_loads=unpack(">6f", register_bytes(105, 12)),
        counts_per_force=counts_per_force,
        counts_per_torque=counts_per_torque,
    )
    return CalibrationBlock(
        calibration=calibration,
        amplifier_gains=unpack(">6H", register_bytes(121, 6)),
        amplifier_offsets=unpack(">6H", register_bytes(127, 6)),
    )


# Status words

CAN_WATCHDOG_RESET_BIT = 0x0001
"""Status bit of a NETCANOEM box: its watchdog has reset it."""
CAN_BAD_CALIBRATION_BIT = 0x0040
"""Status bit of a NETCANOEM box: the active calibration is bad."""
CAN_BUS_ERROR_BIT = 0x4000
"""Status bit of a NETCANOEM box: it has seen errors on the CAN bus."""

_COMMON_STATUS_BITS = {
    0: "its watchdog has reset the board",
    1: "the gauges' excitation is too high",
    2: "the gauges' excitation is too low",
    3: "its artificial analogue ground is out of range",
    4: "its supply voltage is too high",
    5: "its supply voltage is too low",
    7: "its memory (EEPROM) has failed",
    8: "its configuration is invalid",
}
"""Meanings of the status bits that both kinds of sensor have, by bit number."""
_CAN_STATUS_BITS = {
    **_COMMON_STATUS_BITS,
    6: "the active calibration is bad",
    11: "the sensor is too hot",
    12: "the sensor is too cold",
    14: "it has seen errors on the CAN bus",
}
"""Meanings of the status bits of a NETCANOEM box, by bit number."""
CRITICAL_CAN_STATUS_BITS = 0x18FE
"""Status bits of a NETCANOEM box that forbid measuring: 1 to 7, 11 and 12."""

_SERIAL_STATUS_BITS = {
    **_COMMON_STATUS_BITS,
    9: "the bridges take too much current (broken gauge or cable)",
    10: "the bridges take too little current (broken gauge or cable)",
    11: "the reading of its thermistor is too high",
    12: "the reading of its thermistor is too low",
    13: "the reading of its analogue output is out of range",
}
"""Meanings of the status bits of a Digital F/T sensor, by bit number."""
CRITICAL_SERIAL_STATUS_BITS = 0x3EBE
"""Status bits of a Digital F/T sensor that forbid measuring: 1 to 5, 7 and 9 to 13.

They are the bits that are critical on NETCANOEM, and the bits that only Digital F/T has."""


def describe_can_status(status_word: int) -> list[str]:
    """Describe the status word of a NETCANOEM box, one clause per set bit."""
    # Bit 15 summarises the others.
    return _meanings_of_set_bits(status_word & 0x7FFF, _CAN_STATUS_BITS)


def describe_serial_status(status_word: int) -> list[str]:
    """Describe the status word of a Digital F/T sensor, one clause per set bit."""
    return _meanings_of_set_bits(status_word, _SERIAL_STATUS_BITS)


def _meanings_of_set_bits(status_word: int, bit_meanings: dict[int, str]) -> list[str]:
    """Return the meanings of the set bits of a status word."""
    return [
        bit_meanings.get(bit, f"status bit {bit}, which has no known meaning, is set")
        for bit in range(16)
        if status_word >> bit & 1
    ]
