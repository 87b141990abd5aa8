"""Object dictionary and state machine of the simulated drive (CiA 402).

The dictionary contains the drive's objects except those of PDOs and errors. Torques are in 1/1000
of the rated torque, positions in encoder counts at the output shaft, both in the drive's own
direction.
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

COASTING_RAMP_S = 0.05
"""Duration of a ramp in seconds, during which the shaft coasts in a torque mode."""

_SWITCH_ON_BIT, _ENABLE_VOLTAGE_BIT, _NO_QUICK_STOP_BIT, _ENABLE_OPERATION_BIT = (
    0x01,
    0x02,
    0x04,
    0x08,
)
"""Controlword bits 0 to 3 of CiA 402; the third is 0 for a quick stop."""
_FAULT_RESET_BIT = 0x80
"""Controlword bit whose rise resets a fault."""

_MIN_STAYING_STOP_OPTION = 5
"""Smallest value of object 605A for which the drive stays in quick stop active."""


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


_POWERED_STATES = (
    PdsState.READY,
    PdsState.SWITCHED_ON,
    PdsState.OPERATION_ENABLED,
    PdsState.QUICK_STOP,
)
"""States of the power drive system that a command can leave to switch on disabled."""


class PdsStateMachine:
    """State machine of the power drive system (CiA 402).

    `quick_stop_option` and `fault_option` are the entries of the objects 605A and 605E.
    `on_state_change` is called after each change with the previous state; `state` is the new one.
    `may_switch_on` returns whether the drive may leave switch on disabled, `may_enable` whether
    operation may be enabled, and `may_reset` whether a fault may be reset, because no cause
    persists.

    Attributes
    ----------
    state : PdsState
        Present state.
    """

    def __init__(
        self,
        quick_stop_option: Entry,
        fault_option: Entry,
        on_state_change: Callable[[PdsState], None],
        may_switch_on: Callable[[], bool],
        may_enable: Callable[[], bool],
        may_reset: Callable[[], bool],
    ) -> None:
        self.state = PdsState.NOT_READY
        self._quick_stop_option = quick_stop_option
        self._fault_option = fault_option
        self._on_state_change = on_state_change
        self._may_switch_on = may_switch_on
        self._may_enable = may_enable
        self._may_reset = may_reset
        self._reset_bit = 0
        self._ramp_since_s: float | None = None

    def start(self) -> None:
        """Pass through the self-test after power-on or a reset, to switch on disabled."""
        self._reset_bit = 0
        self._enter(PdsState.NOT_READY)
        self._enter(PdsState.SWITCH_ON_DISABLED)

    def control(self, controlword: int) -> None:
        """Process a controlword."""
        reset_bit = controlword & _FAULT_RESET_BIT
        is_reset_rising, self._reset_bit = reset_bit and not self._reset_bit, reset_bit
        if self.state is PdsState.FAULT:
            if is_reset_rising and self._may_reset():
                self._enter(PdsState.SWITCH_ON_DISABLED)
        elif not controlword & _ENABLE_VOLTAGE_BIT:
            self.disable_voltage()
        elif not controlword & _NO_QUICK_STOP_BIT:
            self.quick_stop()
        elif not controlword & _SWITCH_ON_BIT:
            self._shut_down(reset_bit)
        else:
            self._switch_on(controlword, reset_bit)

    def disable_voltage(self) -> None:
        """Switch the drive's power off, from any state except fault."""
        if self.state in _POWERED_STATES:
            self._enter(PdsState.SWITCH_ON_DISABLED)

    def quick_stop(self) -> None:
        """Perform a quick stop in operation enabled; in other states switch the power off."""
        if self.state is PdsState.OPERATION_ENABLED and self._quick_stop_option.value:
            self._enter(PdsState.QUICK_STOP)
        elif self.state is not PdsState.QUICK_STOP:
            self.disable_voltage()

    def fail(self) -> None:
        """Change to the state fault, by way of the state fault reaction active."""
        if self.state in (PdsState.FAULT, PdsState.FAULT_REACTION):
            return
        self._enter(PdsState.FAULT_REACTION)
        if not self._fault_option.value:
            self._enter(PdsState.FAULT)

    def tick(self, now_s: float) -> None:
        """Complete transitions that take time, at the simulated time `now_s` in seconds."""
        if self.state not in (PdsState.QUICK_STOP, PdsState.FAULT_REACTION):
            return
        if self._ramp_since_s is None:
            self._ramp_since_s = now_s
        if now_s - self._ramp_since_s < COASTING_RAMP_S:
            return
        if self.state is PdsState.FAULT_REACTION:
            self._enter(PdsState.FAULT)
        elif self._quick_stop_option.value < _MIN_STAYING_STOP_OPTION:
            self._enter(PdsState.SWITCH_ON_DISABLED)

    def _shut_down(self, reset_bit: int) -> None:
        """Process the command shutdown: change to ready to switch on if the state allows that."""
        if self.state is PdsState.SWITCH_ON_DISABLED:
            if not reset_bit and self._may_switch_on():
                self._enter(PdsState.READY)
        elif self.state in (PdsState.SWITCHED_ON, PdsState.OPERATION_ENABLED):
            self._enter(PdsState.READY)

    def _switch_on(self, controlword: int, reset_bit: int) -> None:
        """Process the commands to switch on, and to enable or disable operation.

        No transition to a higher state is made while bit 7 (fault reset) is set.
        """
        enable_bit = controlword & _ENABLE_OPERATION_BIT
        if self.state is PdsState.OPERATION_ENABLED and not enable_bit:
            self._enter(PdsState.SWITCHED_ON)
        if reset_bit:
            return
        if self.state is PdsState.READY:
            self._enter(PdsState.SWITCHED_ON)
        is_quick_stopped = (
            self.state is PdsState.QUICK_STOP
            and self._quick_stop_option.value >= _MIN_STAYING_STOP_OPTION
        )
        if (
            enable_bit
            and (self.state is PdsState.SWITCHED_ON or is_quick_stopped)
            and self._may_enable()
        ):
            self._enter(PdsState.OPERATION_ENABLED)

    def _enter(self, new_state: PdsState) -> None:
        """Change to a state of the power drive system, and report the change."""
        previous_state, self.state = self.state, new_state
        self._ramp_since_s = None
        if previous_state is not new_state:
            self._on_state_change(previous_state)


# Object dictionary

NO_MODE, CYCLIC_SYNCHRONOUS_TORQUE = 0, 10
"""Values of the mode of operation that the drive supports."""

_DEVICE_TYPE = 0x0002_0192  # a servo drive, by CiA 402
_VENDOR_ID, _PRODUCT_CODE, _REVISION, _SERIAL_NUMBER = 0x5249_4744, 0x402, 0x0001_0000, 1
"""Identity of the simulated drive, unless the profile states one."""
_DEVICE_NAME = b"simulated servo drive"
"""Device name of the simulated drive."""
_SOFTWARE_VERSION = b"1"
_SUPPORTED_MODES = 1 << (CYCLIC_SYNCHRONOUS_TORQUE - 1)
"""Value of object 6502: the drive supports only cyclic synchronous torque."""

_SUPPORTED_MODES_INDEX, _TARGET_TORQUE_INDEX = 0x6502, 0x6071
_IDENTITY_INDEX = 0x1018
_COMMISSIONED_INDICES = (0x6076, 0x608F, 0x6091)
"""Indices of objects that are set when a drive is commissioned, so that no file has their
values."""
_LIMIT_INDICES = (0x6072, 0x6080, 0x60E0, 0x60E1)
"""Indices of limits for which 0 in a file means not stated, since no drive would turn with it."""

_ENCODER_REVOLUTIONS, _LARGEST_GEAR_REVOLUTIONS = 1000, 1000
"""Motor revolutions to which object 608F refers, and largest number of revolutions in 6091."""
_TORQUE_UNIT_NM = 1e-3
"""Unit of object 6076 in N·m if the profile does not state one."""
_MAX_SPEED_RPM = 20_000
"""Speed limit of the simulated drive at power-on in revolutions per minute."""

# 605A without the options that stop by a current or voltage limit.
_QUICK_STOP_OPTIONS = (0, 1, 2, 5, 6)


@dataclass(frozen=True, slots=True)
class DriveObjects:
    """Entries of the objects that the simulated drive uses, by their names in CiA 301 and 402."""

    sync_cob_id: Entry
    sync_period_us: Entry
    sync_overflow: Entry
    communication_error_option: Entry
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
    positive_torque_limit: Entry
    negative_torque_limit: Entry

    @property
    def sync_period_s(self) -> float:
        """Period of SYNC in seconds: object 1006, or the interpolation time 60C2 if that is 0."""
        if self.sync_period_us.value:
            return 1e-6 * self.sync_period_us.value
        return float(self.interpolation_value.value * 10.0**self.interpolation_exponent.value)


def rated_torque_counts(motor: Motor, drive: ServoDrive) -> int:
    """Return the rated torque at the motor shaft in counts of object 6076.

    Raise `DeviceError` if the torque is less than one count, or has more than 32 bits.
    """
    torque_unit_nm = drive.rated_torque_unit_nm or _TORQUE_UNIT_NM
    torque_counts = round(motor.rated_torque_nm / drive.gear_ratio / torque_unit_nm)
    if not 0 < torque_counts < 1 << 32:
        raise DeviceError(
            f"Simulated drive: a rated torque of {motor.rated_torque_nm:g} N·m behind a gear of "
            f"{drive.gear_ratio:g} does not fit into object 6076 in units of "
            f"{torque_unit_nm:g} N·m; check cia402.rated_torque_unit_nm."
        )
    return torque_counts


def peak_per_mille(motor: Motor) -> int:
    """Return the motor's peak torque in 1/1000 of its rated torque, rounded down."""
    return min(math.floor(1000 * motor.peak_torque_nm / motor.rated_torque_nm + 1e-9), 0x7FFF)


def add_drive_objects(
    objects: ObjectDictionary,
    motor: Motor,
    drive: ServoDrive,
    rate_hz: float,
    resolution_rad: float,
) -> DriveObjects:
    """Add the drive's objects to a dictionary; return the entries that the simulation uses."""

    def add_object(object_index: int, entry: Entry) -> Entry:
        return objects.add(object_index, entry)

    add_object(0x1000, Entry("I", _DEVICE_TYPE, "ro"))
    sync_cob_id = add_object(0x1005, Entry("I", 0x80, check_value=_check_sync_id))
    sync_period_us = add_object(0x1006, Entry("I"))
    add_object(0x1008, Entry("s", access="ro", text=_DEVICE_NAME))
    add_object(0x100A, Entry("s", access="ro", text=_SOFTWARE_VERSION))
    vendor_and_product = drive.vendor_id or _VENDOR_ID, drive.product_code or _PRODUCT_CODE
    identity_numbers = (*vendor_and_product, _REVISION, _SERIAL_NUMBER)
    objects.add_record(
        0x1018, {sub: Entry("I", n, "ro") for sub, n in enumerate(identity_numbers, 1)}
    )

    def check_overflow(written_value: int) -> None:
        if written_value == 1 or written_value > 240:
            raise Abort(AbortCode.INVALID_VALUE)
        if sync_period_us.value:
            raise Abort(AbortCode.WRONG_STATE)

    sync_overflow = add_object(0x1019, Entry("B", check_value=check_overflow))
    communication_error_option = Entry("B", high=2)
    objects.add_record(0x1029, {1: communication_error_option})

    peak_torque_per_mille = peak_per_mille(motor)
    add_object(0x605B, Entry("h", 0, low=0, high=1))
    add_object(0x605C, Entry("h", 0, low=0, high=1))
    add_object(0x6076, Entry("I", rated_torque_counts(motor, drive), "ro"))
    supported_modes = add_object(_SUPPORTED_MODES_INDEX, Entry("I", _SUPPORTED_MODES, "ro"))

    def check_mode(written_value: int) -> None:
        if written_value != NO_MODE and not (
            written_value > 0 and supported_modes.value >> (written_value - 1) & 1
        ):
            raise Abort(AbortCode.INVALID_VALUE)

    gear_ratio = Fraction(drive.gear_ratio).limit_denominator(_LARGEST_GEAR_REVOLUTIONS)
    encoder_increments = round(_ENCODER_REVOLUTIONS * math.tau / resolution_rad / drive.gear_ratio)
    ratios_by_index = {
        0x608F: (encoder_increments, _ENCODER_REVOLUTIONS),
        0x6091: (gear_ratio.numerator, gear_ratio.denominator),
    }
    for object_index, object_ratio in ratios_by_index.items():
        objects.add_record(
            object_index, {sub: Entry("I", n, "ro") for sub, n in enumerate(object_ratio, 1)}
        )

    interpolation_entries = {1: Entry("B", max(1, round(1e3 / rate_hz)), low=1)}
    interpolation_entries[2] = Entry("b", -3, low=-6, high=0)
    objects.add_record(0x60C2, interpolation_entries)
    return DriveObjects(
        sync_cob_id=sync_cob_id,
        sync_period_us=sync_period_us,
        sync_overflow=sync_overflow,
        communication_error_option=communication_error_option,
        abort_option=add_object(0x6007, Entry("h", 1, low=0, high=3)),
        error_code=add_object(0x603F, Entry("H", 0, "ro", "t")),
        controlword=add_object(0x6040, Entry("H", 0, pdo_directions="rt")),
        statusword=add_object(0x6041, Entry("H", 0, "ro", "t")),
        quick_stop_option=add_object(0x605A, Entry("h", 2, check_value=_check_quick_stop)),
        fault_option=add_object(0x605E, Entry("h", 0, low=0, high=2)),
        mode=add_object(0x6060, Entry("b", NO_MODE, pdo_directions="rt", check_value=check_mode)),
        mode_display=add_object(0x6061, Entry("b", NO_MODE, "ro", "t")),
        position=add_object(0x6064, Entry("i", 0, "ro", "t")),
        velocity=add_object(0x606C, Entry("i", 0, "ro", "t")),
        target_torque=add_object(0x6071, Entry("h", 0, pdo_directions="rt")),
        max_torque=add_object(0x6072, Entry("H", peak_torque_per_mille, pdo_directions="rt")),
        actual_torque=add_object(0x6077, Entry("h", 0, "ro", "t")),
        max_speed_rpm=add_object(0x6080, Entry("I", _MAX_SPEED_RPM)),
        torque_offset=add_object(0x60B2, Entry("h", 0, pdo_directions="rt")),
        interpolation_value=interpolation_entries[1],
        interpolation_exponent=interpolation_entries[2],
        positive_torque_limit=add_object(
            0x60E0, Entry("H", peak_torque_per_mille, pdo_directions="rt")
        ),
        negative_torque_limit=add_object(
            0x60E1, Entry("H", peak_torque_per_mille, pdo_directions="rt")
        ),
    )


def adopt_device_file(objects: ObjectDictionary, device_file: "DeviceFile") -> None:
    """Restrict the dictionary to the objects of a drive's file, with their values at power-on.

    Rated torque, gear, encoder, limits that the file states as zero, and an identity that it does
    not state remain as without a file. If the file does not state the supported modes, cyclic
    synchronous torque is assumed, provided that the file has a target torque. Raise `DeviceError`
    if the data type of object 6076 in the file cannot hold the motor's rated torque.
    """
    rated_counts_before = objects[0x6076, 0].value
    unchanged_indices = set(_COMMISSIONED_INDICES)
    unchanged_indices |= {
        object_index
        for object_index in (*_LIMIT_INDICES, _SUPPORTED_MODES_INDEX)
        if (object_description := device_file.entries.get((object_index, 0))) is not None
        and not object_description.default
    }
    if not any(
        device_file.entries[key].default
        for key in device_file.entries
        if key[0] == _IDENTITY_INDEX and key[1]
    ):
        unchanged_indices.add(_IDENTITY_INDEX)
    objects.adopt_file_entries(device_file.entries, unchanged_indices)
    if (
        _SUPPORTED_MODES_INDEX,
        0,
    ) in device_file.entries and _SUPPORTED_MODES_INDEX in unchanged_indices:
        supported_modes = objects[_SUPPORTED_MODES_INDEX, 0]
        supported_modes.value = supported_modes.default = (
            _SUPPORTED_MODES if (_TARGET_TORQUE_INDEX, 0) in device_file.entries else 0
        )
    if (0x6076, 0) in device_file.entries and objects[0x6076, 0].value != rated_counts_before:
        raise DeviceError(
            f"Simulated drive: object 6076 of {device_file.name} cannot hold the rated torque, "
            f"{rated_counts_before}; check cia402.rated_torque_unit_nm."
        )


def _check_sync_id(sync_id: int) -> None:
    """Raise `Abort` if an identifier cannot be used for SYNC."""
    # Bit 30 would make the drive the producer of SYNC, bit 29 would mean an identifier of 29 bits.
    if sync_id > 0x7FF or not is_free_id(sync_id):
        raise Abort(AbortCode.INVALID_VALUE)


def _check_quick_stop(quick_stop_option: int) -> None:
    """Raise `Abort` if a quick stop option is not supported."""
    if quick_stop_option not in _QUICK_STOP_OPTIONS:
        raise Abort(AbortCode.INVALID_VALUE)
