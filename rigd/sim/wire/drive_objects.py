"""What stands in the object dictionary of the simulated drive, besides PDOs and errors.

Torques are in 1/1000 of the rated torque, positions in encoder counts at the output shaft, both in
the drive's own direction.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import Motor, ServoDrive
from rigd.sim.wire.canopen_objects import Abort, AbortCode, Entry, ObjectDictionary
from rigd.sim.wire.canopen_pdo import is_free_id

if TYPE_CHECKING:
    from rigd.sim.wire.canopen_eds import DeviceFile

NO_MODE, CYCLIC_SYNCHRONOUS_TORQUE = 0, 10

_DEVICE_TYPE = 0x0002_0192  # a servo drive, by CiA 402
_VENDOR_ID, _PRODUCT_CODE, _REVISION, _SERIAL_NUMBER = 0x5249_4744, 0x402, 0x0001_0000, 1
_DEVICE_NAME = b"simulated servo drive"
_SOFTWARE_VERSION = b"1"
_SUPPORTED_MODES = 1 << (CYCLIC_SYNCHRONOUS_TORQUE - 1)

_SUPPORTED_INDEX, _TARGET_INDEX = 0x6502, 0x6071
_IDENTITY = 0x1018
_IN_SERVICE = (0x6076,)
"""Whoever puts a drive into service tells it its motor: no file knows it."""
_NOT_TOLD_BY_ZERO = (0x6072, 0x6080, 0x60E0, 0x60E1)
"""Limits; with one of zero no drive would turn."""

_TORQUE_UNIT_NM = 1e-3
"""Of object 6076 where the profile does not state one."""
_MAX_SPEED_RPM = 20_000

# 605A without the options that stop by a current or voltage limit.
_QUICK_STOP_OPTIONS = (0, 1, 2, 5, 6)


@dataclass(frozen=True, slots=True)
class DriveObjects:
    """The entries that the drive itself works with, by their names in CiA 301 and 402."""

    sync_cob_id: Entry
    sync_period_us: Entry
    sync_overflow: Entry
    communication_error: Entry
    abort_option: Entry
    error_code: Entry
    controlword: Entry
    statusword: Entry
    quick_stop_option: Entry
    fault_option: Entry
    mode: Entry
    mode_display: Entry
    position: Entry
    velocity: Entry
    target_torque: Entry
    max_torque: Entry
    actual_torque: Entry
    max_speed_rpm: Entry
    torque_offset: Entry
    interpolation_value: Entry
    interpolation_exponent: Entry
    positive_limit: Entry
    negative_limit: Entry

    @property
    def sync_period_s(self) -> float:
        """Period of the SYNC: 1006, or where that is 0 the interpolation time 60C2."""
        if self.sync_period_us.value:
            return 1e-6 * self.sync_period_us.value
        return float(self.interpolation_value.value * 10.0**self.interpolation_exponent.value)


def rated_torque_counts(motor: Motor, drive: ServoDrive) -> int:
    """Return object 6076: the rated torque at the motor's shaft.

    Raises
    ------
    DeviceError
        If it is less than one count.
    """
    unit_nm = drive.rated_torque_unit_nm or _TORQUE_UNIT_NM
    counts = round(motor.rated_torque_nm / drive.gear_ratio / unit_nm)
    if not 0 < counts < 1 << 32:
        raise DeviceError(
            f"Simulated drive: a rated torque of {motor.rated_torque_nm:g} N·m behind a gear of "
            f"{drive.gear_ratio:g} does not fit into object 6076 in units of {unit_nm:g} N·m; "
            "check cia402.rated_torque_unit_nm."
        )
    return counts


def peak_permille(motor: Motor) -> int:
    """Return the peak torque in 1/1000 of the rated torque, rounded down."""
    return min(math.floor(1000 * motor.peak_torque_nm / motor.rated_torque_nm + 1e-9), 0x7FFF)


def add_drive_objects(
    objects: ObjectDictionary, motor: Motor, drive: ServoDrive, rate_hz: float
) -> DriveObjects:
    """Add the objects, at their power-on values, and return those the drive works with."""

    def add(index: int, entry: Entry) -> Entry:
        return objects.add(index, entry)

    add(0x1000, Entry("I", _DEVICE_TYPE, "ro"))
    sync_cob_id = add(0x1005, Entry("I", 0x80, check=_check_sync_id))
    sync_period_us = add(0x1006, Entry("I"))
    add(0x1008, Entry("s", access="ro", text=_DEVICE_NAME))
    add(0x100A, Entry("s", access="ro", text=_SOFTWARE_VERSION))
    identity = drive.vendor_id or _VENDOR_ID, drive.product_code or _PRODUCT_CODE
    numbers = (*identity, _REVISION, _SERIAL_NUMBER)
    objects.add_record(0x1018, {sub: Entry("I", n, "ro") for sub, n in enumerate(numbers, 1)})

    def check_overflow(value: int) -> None:
        if value == 1 or value > 240:
            raise Abort(AbortCode.VALUE)
        if sync_period_us.value:
            raise Abort(AbortCode.STATE)

    sync_overflow = add(0x1019, Entry("B", check=check_overflow))
    communication_error = Entry("B", high=2)
    objects.add_record(0x1029, {1: communication_error})

    peak = peak_permille(motor)
    add(0x605B, Entry("h", 0, low=0, high=1))
    add(0x605C, Entry("h", 0, low=0, high=1))
    add(0x6076, Entry("I", rated_torque_counts(motor, drive), "ro"))
    supported = add(_SUPPORTED_INDEX, Entry("I", _SUPPORTED_MODES, "ro"))

    def check_mode(value: int) -> None:
        if value != NO_MODE and not (value > 0 and supported.value >> (value - 1) & 1):
            raise Abort(AbortCode.VALUE)

    interpolation = {1: Entry("B", max(1, round(1e3 / rate_hz)), low=1)}
    interpolation[2] = Entry("b", -3, low=-6, high=0)
    objects.add_record(0x60C2, interpolation)
    return DriveObjects(
        sync_cob_id=sync_cob_id,
        sync_period_us=sync_period_us,
        sync_overflow=sync_overflow,
        communication_error=communication_error,
        abort_option=add(0x6007, Entry("h", 1, low=0, high=3)),
        error_code=add(0x603F, Entry("H", 0, "ro", "t")),
        controlword=add(0x6040, Entry("H", 0, mapping="rt")),
        statusword=add(0x6041, Entry("H", 0, "ro", "t")),
        quick_stop_option=add(0x605A, Entry("h", 2, check=_check_quick_stop)),
        fault_option=add(0x605E, Entry("h", 0, low=0, high=2)),
        mode=add(0x6060, Entry("b", NO_MODE, mapping="rt", check=check_mode)),
        mode_display=add(0x6061, Entry("b", NO_MODE, "ro", "t")),
        position=add(0x6064, Entry("i", 0, "ro", "t")),
        velocity=add(0x606C, Entry("i", 0, "ro", "t")),
        target_torque=add(0x6071, Entry("h", 0, mapping="rt")),
        max_torque=add(0x6072, Entry("H", peak, mapping="rt")),
        actual_torque=add(0x6077, Entry("h", 0, "ro", "t")),
        max_speed_rpm=add(0x6080, Entry("I", _MAX_SPEED_RPM)),
        torque_offset=add(0x60B2, Entry("h", 0, mapping="rt")),
        interpolation_value=interpolation[1],
        interpolation_exponent=interpolation[2],
        positive_limit=add(0x60E0, Entry("H", peak, mapping="rt")),
        negative_limit=add(0x60E1, Entry("H", peak, mapping="rt")),
    )


def follow_file(objects: ObjectDictionary, file: "DeviceFile") -> None:
    """Have the objects that a drive's file has, and their values at power-on.

    What the file does not tell, or cannot, is as without one: rated torque, limits of zero, and
    identity. A file that does not tell the modes is taken to mean cyclic synchronous torque where
    it has a target torque.

    Raises
    ------
    DeviceError
        If the file's type of the rated torque cannot hold this motor's.
    """
    rated = objects[0x6076, 0].value
    own = set(_IN_SERVICE)
    own |= {
        index
        for index in (*_NOT_TOLD_BY_ZERO, _SUPPORTED_INDEX)
        if (said := file.entries.get((index, 0))) is not None and not said.default
    }
    if not any(file.entries[key].default for key in file.entries if key[0] == _IDENTITY and key[1]):
        own.add(_IDENTITY)
    objects.follow(file.entries, own)
    if (_SUPPORTED_INDEX, 0) in file.entries and _SUPPORTED_INDEX in own:
        supported = objects[_SUPPORTED_INDEX, 0]
        supported.value = supported.default = (
            _SUPPORTED_MODES if (_TARGET_INDEX, 0) in file.entries else 0
        )
    if (0x6076, 0) in file.entries and objects[0x6076, 0].value != rated:
        raise DeviceError(
            f"Simulated drive: object 6076 of {file.name} cannot hold the rated torque, {rated}; "
            "check cia402.rated_torque_unit_nm."
        )


def _check_sync_id(value: int) -> None:
    # Bit 30 would make the drive the producer, bit 29 the identifier a long one.
    if value > 0x7FF or not is_free_id(value):
        raise Abort(AbortCode.VALUE)


def _check_quick_stop(value: int) -> None:
    if value not in _QUICK_STOP_OPTIONS:
        raise Abort(AbortCode.VALUE)
