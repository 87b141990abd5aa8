"""Requirements on a drive's object dictionary: one table for set-up, EDS files and docs.

An object is *core* if no session is possible without it, and *optional* if something else replaces
it. An optional object may be read-only if it holds an allowed value (:class:`AllowedValue`). If
nothing replaces it by itself, the profile has to accept its absence by name
(``cia402.accept_without``), or the drive is refused.

Imports nothing but the indices, so that a program which only reads an EDS file can use it.
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
TORQUE_LIMIT: Final = "torque_limit"
ABORT_OPTION: Final = "abort_option"
TORQUE_FEEDBACK: Final = "torque_feedback"
ACCEPTABLE: Final = (WATCHDOG, TORQUE_LIMIT, ABORT_OPTION, TORQUE_FEEDBACK)
"""Names of what a profile may accept that its drive lacks."""


class ObjectAccess(Flag):
    """Kind of access to an object."""

    READ = auto()
    """Read by SDO."""
    WRITE = auto()
    """Written by SDO, in pre-operational, unless the object already holds what is needed."""
    SENT = auto()
    """Mapped into the drive's TPDO (an EDS has PDOMapping = 1, access ro, rw or rwr)."""
    RECEIVED = auto()
    """Mapped into the drive's RPDO (PDOMapping = 1, access rw, rww or wo)."""


class Watchdog(Enum):
    """Watchdog in the drive that takes the torque off when this computer falls silent."""

    HEARTBEAT = "heartbeat consumer (1016:1)"
    RPDO_DEADLINE = "deadline of the RPDO (1400:5)"
    OWN = "maker's own watchdog (cia402.own_watchdog_s)"
    NONE = "none"


def watchdog(*, heartbeat: bool, rpdo_deadline: bool, own: bool) -> Watchdog:
    """Return the watchdog that is active, the best one first.

    Parameters
    ----------
    heartbeat, rpdo_deadline
        Whether the drive has 1016:1, and 1400:5.
    own
        Whether the profile states the time of the drive's own one.
    """
    if heartbeat:
        return Watchdog.HEARTBEAT
    if rpdo_deadline:
        return Watchdog.RPDO_DEADLINE
    return Watchdog.OWN if own else Watchdog.NONE


class AllowedValue(Enum):
    """Rule for the value of an object that cannot be written."""

    EQUAL = "exactly"
    """The required value."""
    AT_LEAST = "at least"
    """A limit of at least the required value."""
    EQUAL_OR_UNUSED = "exactly, or 0"
    """The required value, or 0: not used."""
    ANY = "any"
    """It is only read."""

    def allows(self, found: int, wanted: int) -> bool:
        """Return whether a value is allowed where another one is required.

        Parameters
        ----------
        found, wanted
            Value that the object holds, and the required one.
        """
        if self in (AllowedValue.EQUAL, AllowedValue.EQUAL_OR_UNUSED):
            return found == wanted or (self is AllowedValue.EQUAL_OR_UNUSED and found == 0)
        return self is AllowedValue.ANY or found >= wanted


@dataclass(frozen=True, slots=True)
class Requirement:
    """One object, or one sub-index of it.

    Attributes
    ----------
    index, sub
        Index and sub-index of the object.
    name
        Name in CiA 301 or 402.
    core
        No session without it.
    access
        Kind of access to it.
    stand_in
        Replacement where it is absent; empty where there is none.
    sentence
        Consequence and remedy where it is absent or cannot be used, for the operator.
    fit
        Values that it may hold where it cannot be written.
    accept
        Name under which ``cia402.accept_without`` has to accept its absence; empty where it does
        not have to. (For 1016:1 only if no other :class:`Watchdog` is active.)
    zero
        Has to read 0 where it is there: something that a drive may hold from before.
    """

    index: int
    sub: int
    name: str
    core: bool
    access: ObjectAccess
    stand_in: str = ""
    sentence: str = ""
    fit: AllowedValue = AllowedValue.EQUAL
    accept: str = ""
    zero: bool = False

    @property
    def address(self) -> str:
        """Index and sub-index as messages show them: ``6072`` or ``1016:1``."""
        return f"{self.index:04X}:{self.sub}" if self.sub else f"{self.index:04X}"

    def missing(self, accepted: Collection[str] = ()) -> str:
        """Return why a drive without it is refused, as a sentence; empty if it is not.

        Parameters
        ----------
        accepted
            ``cia402.accept_without`` of the profile.
        """
        if not self.core and (not self.accept or self.accept in accepted):
            return ""
        remedy = (
            f' To run without it: cia402.accept_without = ["{self.accept}"].' if self.accept else ""
        )
        return f"it has no object {self.address} ({self.name}). {self.sentence}{remedy}"


_R, _W = ObjectAccess.READ, ObjectAccess.WRITE
_NOT_USABLE: Final = "Without it the drive cannot be used: check whether its firmware offers it."
_DYNAMIC: Final = (
    "Its PDOs must be mappable as rigd needs them, or be mapped so already: RPDO1 with "
    "controlword and target torque, TPDO1 with statusword, position and actual torque."
)
_FROM_BEFORE: Final = "Set it to 0 with the drive's own tool, and store that."

CORE: Final = (
    Requirement(
        objects.CONTROLWORD,
        0,
        "Controlword",
        True,
        _W | ObjectAccess.RECEIVED,
        sentence=_NOT_USABLE,
    ),
    Requirement(
        objects.STATUSWORD, 0, "Statusword", True, _R | ObjectAccess.SENT, sentence=_NOT_USABLE
    ),
    Requirement(
        objects.MODE,
        0,
        "Modes of operation",
        True,
        _R | _W,
        sentence="It must accept 10, cyclic synchronous torque mode.",
    ),
    Requirement(
        objects.MODE_DISPLAY, 0, "Modes of operation display", True, _R, sentence=_NOT_USABLE
    ),
    Requirement(
        objects.POSITION,
        0,
        "Position actual value",
        True,
        _R | ObjectAccess.SENT,
        sentence="The loop runs on it.",
    ),
    Requirement(
        objects.TARGET_TORQUE,
        0,
        "Target torque",
        True,
        ObjectAccess.RECEIVED,
        sentence="Without it the drive has no torque mode that rigd could use.",
    ),
    Requirement(
        objects.SUPPORTED_MODES,
        0,
        "Supported drive modes",
        True,
        _R,
        sentence="Its bit 9 must say that the drive has cyclic synchronous torque mode.",
    ),
    Requirement(objects.RPDO_COMMUNICATION, 1, "COB-ID of RPDO1", True, _R | _W, sentence=_DYNAMIC),
    Requirement(
        objects.RPDO_COMMUNICATION,
        2,
        "Transmission type of RPDO1",
        True,
        _R | _W,
        sentence="It must be 1 (at_sync) or 255 (on_arrival), as cia402.torque_delivery says.",
    ),
    Requirement(objects.RPDO_MAPPING, 0, "Mapping of RPDO1", True, _R | _W, sentence=_DYNAMIC),
    Requirement(objects.TPDO_COMMUNICATION, 1, "COB-ID of TPDO1", True, _R | _W, sentence=_DYNAMIC),
    Requirement(
        objects.TPDO_COMMUNICATION,
        2,
        "Transmission type of TPDO1",
        True,
        _R | _W,
        sentence="It must be 1: an angle at every SYNC.",
    ),
    Requirement(objects.TPDO_MAPPING, 0, "Mapping of TPDO1", True, _R | _W, sentence=_DYNAMIC),
)
"""No session without one of these. Mapping entries 1600 and 1A00 sub 1 and on go with sub 0."""

OPTIONAL: Final = (
    # Identity and texts: reported, and compared only if the profile states them.
    Requirement(
        objects.IDENTITY,
        1,
        "Vendor-ID",
        False,
        _R,
        "nothing: cia402.vendor_id = 0",
        fit=AllowedValue.ANY,
    ),
    Requirement(
        objects.IDENTITY,
        2,
        "Product code",
        False,
        _R,
        "nothing: cia402.product_code = 0",
        fit=AllowedValue.ANY,
    ),
    Requirement(objects.DEVICE_NAME, 0, "Device name", False, _R, "no name", fit=AllowedValue.ANY),
    Requirement(
        objects.ERROR_CODE,
        0,
        "Error code",
        False,
        _R,
        "the emergency message",
        fit=AllowedValue.ANY,
    ),
    # SYNC.
    Requirement(
        objects.SYNC_COB_ID,
        0,
        "COB-ID SYNC",
        False,
        _R | _W,
        "0x080, the default of CiA 301",
    ),
    Requirement(
        objects.SYNC_PERIOD_US,
        0,
        "Communication cycle period",
        False,
        _R | _W,
        "transmission type 1: the drive goes by the SYNCs that come",
        "It must be the period of rig.rate_hz in microseconds, or 0.",
        AllowedValue.EQUAL_OR_UNUSED,
    ),
    Requirement(
        objects.SYNC_WINDOW_US,
        0,
        "Synchronous window length",
        False,
        _R | _W,
        "no window",
        f"A torque that comes later than it is dropped. {_FROM_BEFORE}",
        zero=True,
    ),
    Requirement(
        objects.SYNC_OVERFLOW,
        0,
        "Synchronous counter overflow value",
        False,
        _R | _W,
        "a SYNC without counter",
        f"rigd sends SYNC without a counter. {_FROM_BEFORE}",
        zero=True,
    ),
    Requirement(
        objects.INTERPOLATION_TIME,
        1,
        "Interpolation time period value",
        False,
        _R | _W,
        "the SYNC: each torque holds until the next",
        "With 60C2:2 it has to be the period of rig.rate_hz.",
    ),
    Requirement(
        objects.INTERPOLATION_TIME,
        2,
        "Interpolation time index",
        False,
        _R | _W,
        "the SYNC: each torque holds until the next",
        "With 60C2:1 it has to be the period of rig.rate_hz.",
    ),
    # Who watches over whom.
    Requirement(
        objects.HEARTBEAT_CONSUMER,
        1,
        "Consumer heartbeat time",
        False,
        _R | _W,
        "the deadline of the RPDO (1400:5), or the drive's own watchdog (cia402.own_watchdog_s)",
        "Nothing in the drive would remove the torque if this computer stops communicating. If the "
        "drive has its own watchdog, set that up and state its time: cia402.own_watchdog_s.",
        accept=WATCHDOG,
    ),
    Requirement(
        objects.RPDO_COMMUNICATION,
        objects.EVENT_TIMER,
        "Event timer of RPDO1",
        False,
        _R | _W,
        "the heartbeat consumer (1016:1), which comes first",
    ),
    Requirement(
        objects.ABORT_OPTION,
        0,
        "Abort connection option code",
        False,
        _R | _W,
        "",
        "The drive's reaction to the loss of this computer is then manufacturer-specific: see its "
        "manual, and test it at a low torque by pulling the cable. If it has a suitable value, "
        "use that for cia402.abort_option.",
        accept=ABORT_OPTION,
    ),
    Requirement(
        objects.COMMUNICATION_ERROR,
        1,
        "Error behaviour on communication error",
        False,
        _R | _W,
        "the default of CiA 301: to pre-operational",
        "It must be cia402.communication_error_option.",
    ),
    Requirement(
        objects.HEARTBEAT_PRODUCER_MS,
        0,
        "Producer heartbeat time",
        False,
        _R | _W,
        "the TPDO of every SYNC, and limits.stale_ticks_in_a_row",
        "It must be cia402.drive_heartbeat_period_s in milliseconds.",
    ),
    Requirement(
        objects.EMERGENCY_COB_ID,
        0,
        "COB-ID EMCY",
        False,
        _R | _W,
        "0x080 + node id, the default of CiA 301",
        "Its emergency messages would not be received.",
    ),
    # Torque and speed.
    Requirement(
        objects.MAX_TORQUE,
        0,
        "Max torque",
        False,
        _R | _W,
        "a manufacturer-specific limit, set by cia402.set_objects (maxon EPOS4: 3001:2), the speed "
        "limit 6080, and the cut to motor.peak_torque_nm in this program",
        "The drive then has no limit of its own for the torque that rigd could set. Set the one "
        "that its maker gives it by cia402.set_objects.",
        accept=TORQUE_LIMIT,
    ),
    *(
        Requirement(
            index,
            0,
            name,
            False,
            _R | _W,
            "Max torque (6072)",
            "It cuts torques that the profile allows: raise it with the drive's own tool, or lower "
            "motor.peak_torque_nm.",
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
        _R | _W,
        "none is added",
        f"The drive adds it to every torque. {_FROM_BEFORE}",
        zero=True,
    ),
    Requirement(
        objects.RATED_TORQUE,
        0,
        "Motor rated torque",
        False,
        _R,
        "motor.rated_torque_nm alone: cia402.rated_torque_unit_nm = 0",
        "What 1000 thousandths of torque are cannot be compared with the profile: set "
        "cia402.rated_torque_unit_nm = 0, and measure it (rigd identify motor).",
        fit=AllowedValue.ANY,
    ),
    *(
        Requirement(
            index,
            sub,
            name,
            False,
            _R,
            "the probing move before the first session (docs/safety.md)",
            fit=AllowedValue.ANY,
        )
        for index, sub, name in (
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
        _R | ObjectAccess.SENT,
        "",
        "Torque commands that are lost, or cut by the drive, would not be noticed.",
        fit=AllowedValue.ANY,
        accept=TORQUE_FEEDBACK,
    ),
    Requirement(
        objects.MAX_SPEED_RPM,
        0,
        "Max motor speed",
        False,
        _R | _W,
        "nothing: cia402.max_speed_rad_s = 0, and a longer worst travel in rigd check",
        "The drive has no limit of its own for the speed: set cia402.max_speed_rad_s = 0, and see "
        "what rigd check then says of the worst travel.",
    ),
    # What a drive may hold from before.
    Requirement(
        objects.TPDO_COMMUNICATION,
        objects.INHIBIT_TIME,
        "Inhibit time of TPDO1",
        False,
        _R | _W,
        "no inhibit time",
        f"It keeps back angles that SYNC asks for. {_FROM_BEFORE}",
        zero=True,
    ),
    Requirement(
        objects.POLARITY,
        0,
        "Polarity",
        False,
        _R,
        "no polarity",
        "It turns the position, the speed or the torque round: turned alone, one of them makes the "
        f"loop run away. {_FROM_BEFORE} The direction of the axis is cia402.direction.",
        zero=True,
    ),
    Requirement(
        objects.QUICK_STOP_OPTION, 0, "Quick stop option code", False, _R, "–", fit=AllowedValue.ANY
    ),
    Requirement(
        objects.FAULT_REACTION_OPTION,
        0,
        "Fault reaction option code",
        False,
        _R,
        "–",
        fit=AllowedValue.ANY,
    ),
)
"""Objects that something else can replace."""

REQUIREMENTS: Final = CORE + OPTIONAL

MAY_BE_WRITE_ONLY: Final = (
    objects.MODE,
    objects.INTERPOLATION_TIME,
    objects.ABORT_OPTION,
    objects.COMMUNICATION_ERROR,
    objects.HEARTBEAT_PRODUCER_MS,
    objects.MAX_TORQUE,
    objects.MAX_SPEED_RPM,
)
"""Objects that are set whatever they held before, so that one that cannot be read is written and
not verified. (6060 is write-only in the first editions of CiA 402; 6061 shows the mode.)"""

_BY_ADDRESS: Final = {(each.index, each.sub): each for each in REQUIREMENTS}


def requirement(index: int, sub: int = 0) -> Requirement:
    """Return the row of an object.

    Parameters
    ----------
    index, sub
        Index and sub-index of the object.

    Raises
    ------
    KeyError
        If rigd asks nothing of it.
    """
    return _BY_ADDRESS[index, sub]


_ROUNDING = 1e-9


def fixed_values(node_id: int) -> dict[tuple[int, int], int]:
    """Return what objects are to hold whatever the profile says, by index and sub-index.

    Parameters
    ----------
    node_id
        Node number of the drive. It is added to all predefined identifiers (CiA 301) but SYNC's.
    """
    return {
        **{(row.index, row.sub): 0 for row in REQUIREMENTS if row.zero},
        (objects.MODE, 0): objects.CYCLIC_TORQUE,
        (objects.SYNC_COB_ID, 0): objects.SYNC_ID,
        (objects.EMERGENCY_COB_ID, 0): 0x080 + node_id,
        (objects.TPDO_COMMUNICATION, 1): 0x180 + node_id,
        (objects.TPDO_COMMUNICATION, 2): objects.AT_EVERY_SYNC,
        (objects.RPDO_COMMUNICATION, 1): 0x200 + node_id,
    }


def wanted_values(rig: "RigParameters") -> dict[tuple[int, int], int]:
    """Return what the set-up has the drive's objects hold, by index and sub-index.

    Only what the set-up asks the drive about, such as which watchdog it has, is not among it; nor
    is what follows from a value that the profile does not know.

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
    at_sync = settings.torque_delivery == "at_sync"
    period_us = sync_period_us(rig.rate_hz)
    value, exponent = interpolation_time(rig.rate_hz)
    unknown = unknown_values(rig)
    wanted = fixed_values(settings.node_id) | {
        (objects.RPDO_COMMUNICATION, 2): objects.AT_EVERY_SYNC if at_sync else objects.ON_ARRIVAL,
        (objects.SYNC_PERIOD_US, 0): period_us,
        (objects.INTERPOLATION_TIME, 1): value,
        (objects.INTERPOLATION_TIME, 2): exponent,
        (objects.ABORT_OPTION, 0): settings.abort_option,
        (objects.COMMUNICATION_ERROR, 1): settings.communication_error_option,
        (objects.HEARTBEAT_PRODUCER_MS, 0): round(settings.drive_heartbeat_period_s * 1000),
    }
    if not {"motor.peak_torque_nm", "motor.rated_torque_nm"}.intersection(unknown):
        limit = torque_limit_per_mille(rig)
        limiting = (objects.MAX_TORQUE, *objects.TORQUE_LIMITS)
        wanted |= {(index, 0): limit for index in limiting}
    if settings.max_speed_rad_s > 0 and "cia402.gear_ratio" not in unknown:
        wanted[objects.MAX_SPEED_RPM, 0] = max_speed_rpm(settings)
    return wanted


def sync_period_us(rate_hz: float) -> int:
    """Return the period in whole microseconds, for object 1006.

    Raises
    ------
    DeviceError
        If it is none.
    """
    period_us = 1e6 / rate_hz
    if abs(period_us - round(period_us)) > _ROUNDING * period_us:
        from rigd.devices.contracts import DeviceError  # which loads numpy

        raise DeviceError(
            f"rig.rate_hz = {rate_hz:g} Hz: the period of a CANopen drive must be a whole "
            "number of microseconds; choose another rate, such as 1000 Hz."
        )
    return round(period_us)


def interpolation_time(rate_hz: float) -> tuple[int, int]:
    """Return value (1 to 255) and power of ten in s of the period, for object 60C2.

    Milliseconds come first: some drives take nothing else.

    Raises
    ------
    DeviceError
        If there is no such pair.
    """
    for exponent in (-3, -4, -5, -6, -2, -1, 0):
        value = 10.0**-exponent / rate_hz
        if 0.5 < value < 255.5 and abs(value - round(value)) <= _ROUNDING * value:
            return round(value), exponent
    from rigd.devices.contracts import DeviceError

    raise DeviceError(
        f"rig.rate_hz = {rate_hz:g} Hz: its period cannot be set in a CANopen drive (object 60C2: "
        "1 to 255 times a power of ten of a second); choose another rate, such as 1000 Hz."
    )


def torque_limit_per_mille(rig: "RigParameters") -> int:
    """Return the peak torque in 1/1000 of the rated torque, rounded down, within 16 bits."""
    motor = rig.motor
    return min(int(1000 * motor.peak_torque_nm / motor.rated_torque_nm + _ROUNDING), 32767)


def max_speed_rpm(settings: "ServoDrive") -> int:
    """Return the speed limit in turns of the motor a minute, rounded up, for object 6080."""
    return ceil(settings.max_speed_rad_s * settings.gear_ratio * 60 / tau - _ROUNDING)
