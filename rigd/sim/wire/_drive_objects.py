"""Object dictionary and state machine of the simulated drive (CiA 402).

The dictionary holds what the drive has besides PDOs and errors. Torques are in 1/1000 of the rated
torque, positions in encoder counts at the output shaft, both in the drive's own direction.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from fractions import Fraction
from typing import TYPE_CHECKING

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import Motor, ServoDrive
from rigd.sim.wire._canopen_services import is_free_id
from rigd.sim.wire._object_dictionary import Abort, AbortCode, Entry, ObjectDictionary

if TYPE_CHECKING:
    from rigd.sim.wire._object_dictionary import DeviceFile


# State machine

RAMP_S = 0.05
"""How long a ramp lasts. In a torque mode there is nothing to ramp: the shaft coasts meanwhile."""

_SWITCH_ON, _ENABLE_VOLTAGE, _NO_QUICK_STOP, _ENABLE_OPERATION = 0x01, 0x02, 0x04, 0x08
_FAULT_RESET = 0x80

_STAY_IN_QUICK_STOP = 5
"""Values of 605A from this one on keep the drive in quick stop."""


class PdsState(Enum):
    """State of the power drive system (PDS): name, and bits 0 to 3, 5 and 6 of the statusword."""

    NOT_READY = ("not ready to switch on", 0x00)
    SWITCH_ON_DISABLED = ("switch on disabled", 0x40)
    READY = ("ready to switch on", 0x21)
    SWITCHED_ON = ("switched on", 0x23)
    OPERATION_ENABLED = ("operation enabled", 0x27)
    QUICK_STOP = ("quick stop active", 0x07)
    FAULT_REACTION = ("fault reaction active", 0x0F)
    FAULT = ("fault", 0x08)

    def __init__(self, label: str, bits: int) -> None:
        self.label = label
        self.bits = bits


_POWERED = (
    PdsState.READY,
    PdsState.SWITCHED_ON,
    PdsState.OPERATION_ENABLED,
    PdsState.QUICK_STOP,
)


class PdsStateMachine:
    """States and transitions of the power drive system.

    Parameters
    ----------
    quick_stop_option, fault_option
        Objects 605A and 605E.
    entered
        Called with the state left after each change; `state` is then the new one.
    may_switch_on
        Called before the first step up from switch on disabled.
    may_enable
        Called before operation is enabled.
    may_reset
        Called at a fault reset; True if no cause of the fault persists.

    Attributes
    ----------
    state : PdsState
        The present one.
    """

    def __init__(
        self,
        quick_stop_option: Entry,
        fault_option: Entry,
        entered: Callable[[PdsState], None],
        may_switch_on: Callable[[], bool],
        may_enable: Callable[[], bool],
        may_reset: Callable[[], bool],
    ) -> None:
        self.state = PdsState.NOT_READY
        self._quick_stop_option = quick_stop_option
        self._fault_option = fault_option
        self._entered = entered
        self._may_switch_on = may_switch_on
        self._may_enable = may_enable
        self._may_reset = may_reset
        self._reset_bit = 0
        self._ramp_since_s: float | None = None

    def start(self) -> None:
        """Go through the self-test after power-on or a reset."""
        self._reset_bit = 0
        self._enter(PdsState.NOT_READY)
        self._enter(PdsState.SWITCH_ON_DISABLED)

    def control(self, word: int) -> None:
        """Process a controlword."""
        reset_bit = word & _FAULT_RESET
        rising, self._reset_bit = reset_bit and not self._reset_bit, reset_bit
        if self.state is PdsState.FAULT:
            if rising and self._may_reset():
                self._enter(PdsState.SWITCH_ON_DISABLED)
        elif not word & _ENABLE_VOLTAGE:
            self.disable_voltage()
        elif not word & _NO_QUICK_STOP:
            self.quick_stop()
        elif not word & _SWITCH_ON:
            self._shut_down(reset_bit)
        else:
            self._switch_on(word, reset_bit)

    def disable_voltage(self) -> None:
        """Switch the power off, whatever is going on; a fault stays one."""
        if self.state in _POWERED:
            self._enter(PdsState.SWITCH_ON_DISABLED)

    def quick_stop(self) -> None:
        """Stop out of operation; out of the states below it, switch the power off."""
        if self.state is PdsState.OPERATION_ENABLED and self._quick_stop_option.value:
            self._enter(PdsState.QUICK_STOP)
        elif self.state is not PdsState.QUICK_STOP:
            self.disable_voltage()

    def fail(self) -> None:
        """Go to fault, by the fault reaction."""
        if self.state in (PdsState.FAULT, PdsState.FAULT_REACTION):
            return
        self._enter(PdsState.FAULT_REACTION)
        if not self._fault_option.value:
            self._enter(PdsState.FAULT)

    def tick(self, now_s: float) -> None:
        """Complete transitions that take time."""
        if self.state not in (PdsState.QUICK_STOP, PdsState.FAULT_REACTION):
            return
        if self._ramp_since_s is None:
            self._ramp_since_s = now_s
        if now_s - self._ramp_since_s < RAMP_S:
            return
        if self.state is PdsState.FAULT_REACTION:
            self._enter(PdsState.FAULT)
        elif self._quick_stop_option.value < _STAY_IN_QUICK_STOP:
            self._enter(PdsState.SWITCH_ON_DISABLED)

    def _shut_down(self, reset_bit: int) -> None:
        if self.state is PdsState.SWITCH_ON_DISABLED:
            if not reset_bit and self._may_switch_on():
                self._enter(PdsState.READY)
        elif self.state in (PdsState.SWITCHED_ON, PdsState.OPERATION_ENABLED):
            self._enter(PdsState.READY)

    def _switch_on(self, word: int, reset_bit: int) -> None:
        """Switch on, enable operation or disable it; upwards only while bit 7 is 0."""
        enable = word & _ENABLE_OPERATION
        if self.state is PdsState.OPERATION_ENABLED and not enable:
            self._enter(PdsState.SWITCHED_ON)
        if reset_bit:
            return
        if self.state is PdsState.READY:
            self._enter(PdsState.SWITCHED_ON)
        stopped = (
            self.state is PdsState.QUICK_STOP
            and self._quick_stop_option.value >= _STAY_IN_QUICK_STOP
        )
        if enable and (self.state is PdsState.SWITCHED_ON or stopped) and self._may_enable():
            self._enter(PdsState.OPERATION_ENABLED)

    def _enter(self, state: PdsState) -> None:
        left, self.state = self.state, state
        self._ramp_since_s = None
        if left is not state:
            self._entered(left)


# Object dictionary

NO_MODE, CYCLIC_SYNCHRONOUS_TORQUE = 0, 10

_DEVICE_TYPE = 0x0002_0192  # a servo drive, by CiA 402
_VENDOR_ID, _PRODUCT_CODE, _REVISION, _SERIAL_NUMBER = 0x5249_4744, 0x402, 0x0001_0000, 1
_DEVICE_NAME = b"simulated servo drive"
_SOFTWARE_VERSION = b"1"
_SUPPORTED_MODES = 1 << (CYCLIC_SYNCHRONOUS_TORQUE - 1)

_SUPPORTED_INDEX, _TARGET_INDEX = 0x6502, 0x6071
_IDENTITY = 0x1018
_IN_SERVICE = (0x6076, 0x608F, 0x6091)
"""Set when a drive is commissioned for its motor: no file contains it."""
_ZERO_MEANS_UNKNOWN = (0x6072, 0x6080, 0x60E0, 0x60E1)
"""Limits; with one of zero no drive would turn."""

_ENCODER_TURNS, _MOST_TURNS = 1000, 1000
"""Turns of the motor that object 608F states its increments for, and most turns in 6091."""
_TORQUE_UNIT_NM = 1e-3
"""Unit of object 6076 where the profile does not state one."""
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


def peak_per_mille(motor: Motor) -> int:
    """Return the peak torque in 1/1000 of the rated torque, rounded down."""
    return min(math.floor(1000 * motor.peak_torque_nm / motor.rated_torque_nm + 1e-9), 0x7FFF)


def add_drive_objects(
    objects: ObjectDictionary,
    motor: Motor,
    drive: ServoDrive,
    rate_hz: float,
    resolution_rad: float,
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

    peak = peak_per_mille(motor)
    add(0x605B, Entry("h", 0, low=0, high=1))
    add(0x605C, Entry("h", 0, low=0, high=1))
    add(0x6076, Entry("I", rated_torque_counts(motor, drive), "ro"))
    supported = add(_SUPPORTED_INDEX, Entry("I", _SUPPORTED_MODES, "ro"))

    def check_mode(value: int) -> None:
        if value != NO_MODE and not (value > 0 and supported.value >> (value - 1) & 1):
            raise Abort(AbortCode.VALUE)

    gear = Fraction(drive.gear_ratio).limit_denominator(_MOST_TURNS)
    increments = round(_ENCODER_TURNS * math.tau / resolution_rad / drive.gear_ratio)
    scales = {
        0x608F: (increments, _ENCODER_TURNS),
        0x6091: (gear.numerator, gear.denominator),
    }
    for index, ratio in scales.items():
        objects.add_record(index, {sub: Entry("I", n, "ro") for sub, n in enumerate(ratio, 1)})

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
    """Use the objects of a drive's file, and their values at power-on.

    Values that the file does not state are as without one: rated torque, limits of zero, and
    identity. A file that does not state the modes is taken to mean cyclic synchronous torque if it
    has a target torque.

    Raises
    ------
    DeviceError
        If the file's type of the rated torque cannot hold this motor's.
    """
    rated = objects[0x6076, 0].value
    own = set(_IN_SERVICE)
    own |= {
        index
        for index in (*_ZERO_MEANS_UNKNOWN, _SUPPORTED_INDEX)
        if (described := file.entries.get((index, 0))) is not None and not described.default
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
