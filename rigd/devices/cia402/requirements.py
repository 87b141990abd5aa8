"""Requirements on a drive's object dictionary, in one table for set-up, EDS check and documents.

An object is *core* if no session is possible without it, and *optional* if something else replaces
it. An optional object may be read-only if it holds an allowed value (:class:`AllowedValue`). If
there is no automatic replacement, the profile has to accept that the object is missing
(``cia402.accept_without``), or the drive is refused.

The module imports only the indices, so that a program that only reads an EDS file can use it.
"""

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum, Flag, auto
from math import ceil, tau
from typing import TYPE_CHECKING, Final

from rigd.devices import unknown_values
from rigd.devices.cia402 import objects

if TYPE_CHECKING:
    from rigd.devices.parameters import RigParameters, ServoDrive

WATCHDOG: Final = "watchdog"
"""Name in ``cia402.accept_without`` for a drive without a watchdog over this computer."""
TORQUE_LIMIT: Final = "torque_limit"
"""Name in ``cia402.accept_without`` for a drive without a configurable torque limit."""
ABORT_OPTION: Final = "abort_option"
"""Name in ``cia402.accept_without`` for a drive without a configurable abort connection option."""
TORQUE_FEEDBACK: Final = "torque_feedback"
"""Name in ``cia402.accept_without`` for a drive that does not report its actual torque."""
ACCEPTABLE_MISSING_FUNCTIONS: Final = (WATCHDOG, TORQUE_LIMIT, ABORT_OPTION, TORQUE_FEEDBACK)
"""Names in ``cia402.accept_without`` of the functions that a drive may lack."""


class ObjectAccess(Flag):
    """Ways in which the driver accesses an object: by SDO or in a PDO."""

    READ_BY_SDO = auto()
    """The object is read by SDO."""
    WRITTEN_BY_SDO = auto()
    """The object is written by SDO in pre-operational, unless it already holds the required
    value."""
    SENT_IN_TPDO = auto()
    """The object is mapped into the drive's TPDO (in an EDS: PDOMapping = 1, access ro, rw or
    rwr)."""
    RECEIVED_IN_RPDO = auto()
    """The object is mapped into the drive's RPDO (in an EDS: PDOMapping = 1, access rw, rww or
    wo)."""


class Watchdog(Enum):
    """Watchdog by which the drive removes the torque if this computer stops communicating."""

    HEARTBEAT = "heartbeat consumer (1016:1)"
    RPDO_DEADLINE = "deadline of the RPDO (1400:5)"
    OWN = "manufacturer's own watchdog (cia402.own_watchdog_s)"
    NONE = "none"


def most_reliable_watchdog(
    *, has_heartbeat_consumer: bool, has_rpdo_deadline: bool, has_own_watchdog: bool
) -> Watchdog:
    """Return the kind of watchdog that a drive uses: the most reliable one that it has.

    Parameters
    ----------
    has_heartbeat_consumer, has_rpdo_deadline
        Whether the drive has the objects 1016:1 and 1400:5.
    has_own_watchdog
        Whether the profile states the timeout of a manufacturer-specific watchdog.
    """
    if has_heartbeat_consumer:
        return Watchdog.HEARTBEAT
    if has_rpdo_deadline:
        return Watchdog.RPDO_DEADLINE
    return Watchdog.OWN if has_own_watchdog else Watchdog.NONE


class AllowedValue(Enum):
    """Rule by which the value of a read-only object is accepted."""

    EQUAL = "exactly"
    """The object holds the required value."""
    AT_LEAST = "at least"
    """The object is a limit, and holds at least the required value."""
    EQUAL_OR_UNUSED = "exactly, or 0"
    """The object holds the required value, or 0, which means that the drive does not use it."""
    ANY = "any"
    """Every value is accepted, because the object is only read."""

    def allows(self, present_value: int, required_value: int) -> bool:
        """Return whether this rule accepts the value that an object holds.

        Parameters
        ----------
        present_value, required_value
            Value that the object holds, and value that is required.
        """
        if self in (AllowedValue.EQUAL, AllowedValue.EQUAL_OR_UNUSED):
            return present_value == required_value or (
                self is AllowedValue.EQUAL_OR_UNUSED and present_value == 0
            )
        return self is AllowedValue.ANY or present_value >= required_value


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirement on one object, or on one sub-index of it, in the drive's object dictionary.

    Attributes
    ----------
    index, subindex
        Index and sub-index of the object.
    name
        Name in CiA 301 or 402.
    is_core
        Whether no session is possible without the object.
    access
        How the driver accesses the object.
    replacement
        What replaces the object if it is absent; empty if nothing does.
    consequence
        Consequence and remedy if the object is absent or unusable, for the operator.
    value_rule
        Rule for the value of the object if it is read-only.
    acceptance_name
        Name in ``cia402.accept_without`` that permits a drive without the object; empty if no
        permission is needed. (For 1016:1 only if no other :class:`Watchdog` is active.)
    must_be_zero
        Whether the object has to read 0 if the drive has it, since the drive may have stored
        another value in earlier use.
    """

    index: int
    subindex: int
    name: str
    is_core: bool
    access: ObjectAccess
    replacement: str = ""
    consequence: str = ""
    value_rule: AllowedValue = AllowedValue.EQUAL
    acceptance_name: str = ""
    must_be_zero: bool = False

    @property
    def address(self) -> str:
        """Index and sub-index of the object as messages show them: ``6072`` or ``1016:1``."""
        return f"{self.index:04X}:{self.subindex}" if self.subindex else f"{self.index:04X}"

    def refusal_reason(self, accepted_names: Collection[str] = ()) -> str:
        """Return the reason to refuse a drive without this object; empty if it is accepted.

        Parameters
        ----------
        accepted_names
            ``cia402.accept_without`` of the profile.
        """
        if not self.is_core and (
            not self.acceptance_name or self.acceptance_name in accepted_names
        ):
            return ""
        remedy = (
            f' To run without it: cia402.accept_without = ["{self.acceptance_name}"].'
            if self.acceptance_name
            else ""
        )
        return f"it has no object {self.address} ({self.name}). {self.consequence}{remedy}"


_READ_ACCESS, _WRITE_ACCESS = ObjectAccess.READ_BY_SDO, ObjectAccess.WRITTEN_BY_SDO
_DRIVE_NOT_USABLE: Final = (
    "Without it the drive cannot be used: check whether its firmware offers it."
)
_PDO_MAPPING_NEEDED: Final = (
    "Its PDOs must be mappable as rigd needs them, or be mapped so already: RPDO1 with "
    "controlword and target torque, TPDO1 with statusword, position and actual torque."
)
_CLEAR_STORED_VALUE: Final = "Set it to 0 with the drive's own tool, and store that."

CORE_REQUIREMENTS: Final = (
    Requirement(
        objects.CONTROLWORD,
        0,
        "Controlword",
        True,
        _WRITE_ACCESS | ObjectAccess.RECEIVED_IN_RPDO,
        consequence=_DRIVE_NOT_USABLE,
    ),
    Requirement(
        objects.STATUSWORD,
        0,
        "Statusword",
        True,
        _READ_ACCESS | ObjectAccess.SENT_IN_TPDO,
        consequence=_DRIVE_NOT_USABLE,
    ),
    Requirement(
        objects.MODE,
        0,
        "Modes of operation",
        True,
        _READ_ACCESS | _WRITE_ACCESS,
        consequence="It must accept 10, cyclic synchronous torque mode.",
    ),
    Requirement(
        objects.MODE_DISPLAY,
        0,
        "Modes of operation display",
        True,
        _READ_ACCESS,
        consequence=_DRIVE_NOT_USABLE,
    ),
    Requirement(
        objects.POSITION,
        0,
        "Position actual value",
        True,
        _READ_ACCESS | ObjectAccess.SENT_IN_TPDO,
        consequence="The loop runs on it.",
    ),
    Requirement(
        objects.TARGET_TORQUE,
        0,
        "Target torque",
        True,
        ObjectAccess.RECEIVED_IN_RPDO,
        consequence="Without it the drive has no torque mode that rigd could use.",
    ),
    Requirement(
        objects.SUPPORTED_MODES,
        0,
        "Supported drive modes",
        True,
        _READ_ACCESS,
        consequence="Its bit 9 must say that the drive has cyclic synchronous torque mode.",
    ),
    Requirement(
        objects.RPDO_COMMUNICATION,
        1,
        "COB-ID of RPDO1",
        True,
        _READ_ACCESS | _WRITE_ACCESS,
        consequence=_PDO_MAPPING_NEEDED,
    ),
    Requirement(
        objects.RPDO_COMMUNICATION,
        2,
        "Transmission type of RPDO1",
        True,
        _READ_ACCESS | _WRITE_ACCESS,
        consequence="It must be 1 (at_sync) or 255 (on_arrival), as cia402.torque_delivery says.",
    ),
    Requirement(
        objects.RPDO_MAPPING,
        0,
        "Mapping of RPDO1",
        True,
        _READ_ACCESS | _WRITE_ACCESS,
        consequence=_PDO_MAPPING_NEEDED,
    ),
    Requirement(
        objects.TPDO_COMMUNICATION,
        1,
        "COB-ID of TPDO1",
        True,
        _READ_ACCESS | _WRITE_ACCESS,
        consequence=_PDO_MAPPING_NEEDED,
    ),
    Requirement(
        objects.TPDO_COMMUNICATION,
        2,
        "Transmission type of TPDO1",
        True,
        _READ_ACCESS | _WRITE_ACCESS,
        consequence="It must be 1: an angle at every SYNC.",
    ),
    Requirement(
        objects.TPDO_MAPPING,
        0,
        "Mapping of TPDO1",
        True,
        _READ_ACCESS | _WRITE_ACCESS,
        consequence=_PDO_MAPPING_NEEDED,
    ),
)
"""Requirements on objects without which no session is possible.

Rows for sub-index 0 of the mappings 1600 and 1A00 stand for the entries from sub-index 1 on,
too."""

OPTIONAL_REQUIREMENTS: Final = (
    # Identity and texts: reported, and compared only if the profile states them.
    Requirement(
        objects.IDENTITY,
        1,
        "Vendor-ID",
        False,
        _READ_ACCESS,
        "nothing: cia402.vendor_id = 0",
        value_rule=AllowedValue.ANY,
    ),
    Requirement(
        objects.IDENTITY,
        2,
        "Product code",
        False,
        _READ_ACCESS,
        "nothing: cia402.product_code = 0",
        value_rule=AllowedValue.ANY,
    ),
    Requirement(
        objects.DEVICE_NAME,
        0,
        "Device name",
        False,
        _READ_ACCESS,
        "no name",
        value_rule=AllowedValue.ANY,
    ),
    Requirement(
        objects.ERROR_CODE,
        0,
        "Error code",
        False,
        _READ_ACCESS,
        "the emergency message",
        value_rule=AllowedValue.ANY,
    ),
    # SYNC.
    Requirement(
        objects.SYNC_COB_ID,
        0,
        "COB-ID SYNC",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "0x080, the default of CiA 301",
    ),
    Requirement(
        objects.SYNC_PERIOD_US,
        0,
        "Communication cycle period",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "transmission type 1: the drive follows the SYNCs that it receives",
        "It must be the period of rig.rate_hz in microseconds, or 0.",
        AllowedValue.EQUAL_OR_UNUSED,
    ),
    Requirement(
        objects.SYNC_WINDOW_US,
        0,
        "Synchronous window length",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "no window",
        f"A torque that arrives later than that is dropped. {_CLEAR_STORED_VALUE}",
        must_be_zero=True,
    ),
    Requirement(
        objects.SYNC_OVERFLOW,
        0,
        "Synchronous counter overflow value",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "a SYNC without counter",
        f"rigd sends SYNC without a counter. {_CLEAR_STORED_VALUE}",
        must_be_zero=True,
    ),
    Requirement(
        objects.INTERPOLATION_TIME,
        1,
        "Interpolation time period value",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "the SYNC: each torque holds until the next",
        "With 60C2:2 it has to be the period of rig.rate_hz.",
    ),
    Requirement(
        objects.INTERPOLATION_TIME,
        2,
        "Interpolation time index",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "the SYNC: each torque holds until the next",
        "With 60C2:1 it has to be the period of rig.rate_hz.",
    ),
    # Monitoring of this computer by the drive, and of the drive by this computer.
    Requirement(
        objects.HEARTBEAT_CONSUMER,
        1,
        "Consumer heartbeat time",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "the deadline of the RPDO (1400:5), or the drive's own watchdog (cia402.own_watchdog_s)",
        "Nothing in the drive would remove the torque if this computer stops communicating. If the "
        "drive has its own watchdog, set that up and state its time: cia402.own_watchdog_s.",
        acceptance_name=WATCHDOG,
    ),
    Requirement(
        objects.RPDO_COMMUNICATION,
        objects.EVENT_TIMER_SUBINDEX,
        "Event timer of RPDO1",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "the heartbeat consumer (1016:1), which comes first",
    ),
    Requirement(
        objects.ABORT_OPTION,
        0,
        "Abort connection option code",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "",
        "The drive's reaction to the loss of this computer is then manufacturer-specific: see its "
        "manual, and test it at a low torque by pulling the cable. If it has a suitable value, "
        "use that for cia402.abort_option.",
        acceptance_name=ABORT_OPTION,
    ),
    Requirement(
        objects.COMMUNICATION_ERROR,
        1,
        "Error behaviour on communication error",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "the default of CiA 301: to pre-operational",
        "It must be cia402.communication_error_option.",
    ),
    Requirement(
        objects.HEARTBEAT_PRODUCER_MS,
        0,
        "Producer heartbeat time",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "the TPDO of every SYNC, and limits.stale_ticks_in_a_row",
        "It must be cia402.drive_heartbeat_period_s in milliseconds.",
    ),
    Requirement(
        objects.EMERGENCY_COB_ID,
        0,
        "COB-ID EMCY",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "0x080 + node id, the default of CiA 301",
        "Its emergency messages would not be received.",
    ),
    # Torque and speed.
    Requirement(
        objects.MAX_TORQUE,
        0,
        "Max torque",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "a manufacturer-specific limit, set by cia402.set_objects (maxon EPOS4: 3001:2), the speed "
        "limit 6080, and the cut to motor.peak_torque_nm in this program",
        "The drive then has no limit of its own for the torque that rigd could set. Set its "
        "manufacturer-specific limit with cia402.set_objects.",
        acceptance_name=TORQUE_LIMIT,
    ),
    *(
        Requirement(
            index,
            0,
            name,
            False,
            _READ_ACCESS | _WRITE_ACCESS,
            "Max torque (6072)",
            "It limits torques that the profile allows: raise it with the drive's own tool, or "
            "lower motor.peak_torque_nm.",
            AllowedValue.AT_LEAST,
        )
        for index, name in zip(
            objects.TORQUE_LIMITS,
            ("Positive torque limit value", "Negative torque limit value"),
            strict=True,
        )
    ),
    Requirement(
        objects.TORQUE_OFFSET,
        0,
        "Torque offset",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "none is added",
        f"The drive adds it to every torque. {_CLEAR_STORED_VALUE}",
        must_be_zero=True,
    ),
    Requirement(
        objects.RATED_TORQUE,
        0,
        "Motor rated torque",
        False,
        _READ_ACCESS,
        "motor.rated_torque_nm alone: cia402.rated_torque_unit_nm = 0",
        "What 1000 thousandths of torque are cannot be compared with the profile: set "
        "cia402.rated_torque_unit_nm = 0, and measure it (rigd identify motor).",
        value_rule=AllowedValue.ANY,
    ),
    *(
        Requirement(
            index,
            subindex,
            name,
            False,
            _READ_ACCESS,
            "the probing move before the first session (docs/safety.md)",
            value_rule=AllowedValue.ANY,
        )
        for index, subindex, name in (
            (objects.ENCODER_RESOLUTION, 1, "Encoder increments"),
            (objects.ENCODER_RESOLUTION, 2, "Motor revolutions"),
            (objects.GEAR_RATIO, 1, "Motor shaft revolutions"),
            (objects.GEAR_RATIO, 2, "Driving shaft revolutions"),
            (objects.FEED_CONSTANT, 1, "Feed"),
            (objects.FEED_CONSTANT, 2, "Driving shaft revolutions of the feed"),
        )
    ),
    Requirement(
        objects.ACTUAL_TORQUE,
        0,
        "Torque actual value",
        False,
        _READ_ACCESS | ObjectAccess.SENT_IN_TPDO,
        "",
        "Torque commands that are lost, or limited by the drive, would not be noticed.",
        value_rule=AllowedValue.ANY,
        acceptance_name=TORQUE_FEEDBACK,
    ),
    Requirement(
        objects.MAX_SPEED_RPM,
        0,
        "Max motor speed",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "nothing: cia402.max_speed_rad_s = 0, and a longer worst travel in rigd check",
        "The drive has no limit of its own for the speed: set cia402.max_speed_rad_s = 0, and see "
        "the worst travel in rigd check.",
    ),
    # Values that a drive may have stored in earlier use.
    Requirement(
        objects.TPDO_COMMUNICATION,
        objects.INHIBIT_TIME_SUBINDEX,
        "Inhibit time of TPDO1",
        False,
        _READ_ACCESS | _WRITE_ACCESS,
        "no inhibit time",
        f"It delays angles that SYNC requests. {_CLEAR_STORED_VALUE}",
        must_be_zero=True,
    ),
    Requirement(
        objects.POLARITY,
        0,
        "Polarity",
        False,
        _READ_ACCESS,
        "no polarity",
        "It reverses the position, the speed or the torque: if only one of them is reversed, the "
        f"loop is unstable. {_CLEAR_STORED_VALUE} The direction of the axis is cia402.direction.",
        must_be_zero=True,
    ),
    Requirement(
        objects.QUICK_STOP_OPTION,
        0,
        "Quick stop option code",
        False,
        _READ_ACCESS,
        "–",
        value_rule=AllowedValue.ANY,
    ),
    Requirement(
        objects.FAULT_REACTION_OPTION,
        0,
        "Fault reaction option code",
        False,
        _READ_ACCESS,
        "–",
        value_rule=AllowedValue.ANY,
    ),
)
"""Requirements on objects that something else can replace."""

REQUIREMENTS: Final = CORE_REQUIREMENTS + OPTIONAL_REQUIREMENTS
"""All requirements on the drive's object dictionary."""

POSSIBLY_WRITE_ONLY_INDICES: Final = (
    objects.MODE,
    objects.INTERPOLATION_TIME,
    objects.ABORT_OPTION,
    objects.COMMUNICATION_ERROR,
    objects.HEARTBEAT_PRODUCER_MS,
    objects.MAX_TORQUE,
    objects.MAX_SPEED_RPM,
)
"""Indices of objects that are written without verification if they cannot be read.

They are written even if they may already hold the value. (6060 is write-only in the first editions
of CiA 402; 6061 shows the mode.)"""

_REQUIREMENT_BY_ADDRESS: Final = {(each.index, each.subindex): each for each in REQUIREMENTS}
"""Requirement by index and sub-index."""


def requirement(index: int, subindex: int = 0) -> Requirement:
    """Return the requirement on the drive's object at an index and sub-index.

    Parameters
    ----------
    index, subindex
        Index and sub-index of the object.

    Raises
    ------
    KeyError
        If there is no requirement on this object.
    """
    return _REQUIREMENT_BY_ADDRESS[index, subindex]


_PERIOD_ROUNDING_TOLERANCE = 1e-9
"""Tolerance for rounding errors of floating-point numbers, relative."""


def profile_independent_values(node_id: int) -> dict[tuple[int, int], int]:
    """Return the required object values that do not depend on the profile, by index and sub-index.

    Parameters
    ----------
    node_id
        Node number of the drive. The predefined CAN identifiers (CiA 301) contain it, except that
        of SYNC.
    """
    return {
        **{(row.index, row.subindex): 0 for row in REQUIREMENTS if row.must_be_zero},
        (objects.MODE, 0): objects.CYCLIC_TORQUE_MODE,
        (objects.SYNC_COB_ID, 0): objects.SYNC_CAN_ID,
        (objects.EMERGENCY_COB_ID, 0): 0x080 + node_id,
        (objects.TPDO_COMMUNICATION, 1): 0x180 + node_id,
        (objects.TPDO_COMMUNICATION, 2): objects.TRANSMISSION_AT_EVERY_SYNC,
        (objects.RPDO_COMMUNICATION, 1): 0x200 + node_id,
    }


def required_values(rig: "RigParameters") -> dict[tuple[int, int], int]:
    """Return the values that the set-up writes to the drive's objects, by index and sub-index.

    Values that depend on what the drive reports, such as its kind of watchdog, are not included,
    nor are values that follow from a setting that is unknown in the profile.

    Parameters
    ----------
    rig
        Parameters with a section ``cia402``.

    Raises
    ------
    DeviceError
        If a drive cannot represent the period.
    """
    settings = rig.cia402
    assert settings is not None
    is_torque_delivered_at_sync = settings.torque_delivery == "at_sync"
    period_us = sync_period_us(rig.rate_hz)
    interpolation_value, exponent = interpolation_time(rig.rate_hz)
    unknown_keys = unknown_values(rig)
    required_value_by_address = profile_independent_values(settings.node_id) | {
        (objects.RPDO_COMMUNICATION, 2): objects.TRANSMISSION_AT_EVERY_SYNC
        if is_torque_delivered_at_sync
        else objects.TRANSMISSION_ON_ARRIVAL,
        (objects.SYNC_PERIOD_US, 0): period_us,
        (objects.INTERPOLATION_TIME, 1): interpolation_value,
        (objects.INTERPOLATION_TIME, 2): exponent,
        (objects.ABORT_OPTION, 0): settings.abort_option,
        (objects.COMMUNICATION_ERROR, 1): settings.communication_error_option,
        (objects.HEARTBEAT_PRODUCER_MS, 0): round(settings.drive_heartbeat_period_s * 1000),
    }
    if not {"motor.peak_torque_nm", "motor.rated_torque_nm"}.intersection(unknown_keys):
        max_torque_per_mille = torque_limit_per_mille(rig)
        torque_limit_indices = (objects.MAX_TORQUE, *objects.TORQUE_LIMITS)
        required_value_by_address |= {
            (index, 0): max_torque_per_mille for index in torque_limit_indices
        }
    if settings.max_speed_rad_s > 0 and "cia402.gear_ratio" not in unknown_keys:
        required_value_by_address[objects.MAX_SPEED_RPM, 0] = max_speed_rpm(settings)
    return required_value_by_address


def sync_period_us(rate_hz: float) -> int:
    """Return the period of the loop in whole microseconds, for object 1006.

    Raises
    ------
    DeviceError
        If the period is not a whole number of microseconds.
    """
    period_us = 1e6 / rate_hz
    if abs(period_us - round(period_us)) > _PERIOD_ROUNDING_TOLERANCE * period_us:
        from rigd.devices.contracts import DeviceError  # which loads numpy

        raise DeviceError(
            f"rig.rate_hz = {rate_hz:g} Hz: the period of a CANopen drive must be a whole "
            "number of microseconds; choose another rate, such as 1000 Hz."
        )
    return round(period_us)


def interpolation_time(rate_hz: float) -> tuple[int, int]:
    """Return the loop's period as value (1 to 255) and power of ten in s, for object 60C2.

    Milliseconds are tried first, because some drives accept no other unit.

    Raises
    ------
    DeviceError
        If no such pair represents the period.
    """
    for exponent in (-3, -4, -5, -6, -2, -1, 0):
        unit_count = 10.0**-exponent / rate_hz
        if (
            0.5 < unit_count < 255.5
            and abs(unit_count - round(unit_count)) <= _PERIOD_ROUNDING_TOLERANCE * unit_count
        ):
            return round(unit_count), exponent
    from rigd.devices.contracts import DeviceError

    raise DeviceError(
        f"rig.rate_hz = {rate_hz:g} Hz: its period cannot be set in a CANopen drive (object 60C2: "
        "1 to 255 times a power of ten of a second); choose another rate, such as 1000 Hz."
    )


def torque_limit_per_mille(rig: "RigParameters") -> int:
    """Return the motor's peak torque in 1/1000 of its rated torque, rounded down, at most 32767."""
    motor = rig.motor
    return min(
        int(1000 * motor.peak_torque_nm / motor.rated_torque_nm + _PERIOD_ROUNDING_TOLERANCE), 32767
    )


def max_speed_rpm(settings: "ServoDrive") -> int:
    """Return the motor's speed limit in revolutions per minute, rounded up, for object 6080."""
    return ceil(
        settings.max_speed_rad_s * settings.gear_ratio * 60 / tau - _PERIOD_ROUNDING_TOLERANCE
    )
