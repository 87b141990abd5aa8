"""What the drive's objects are to hold: numbers of the profile in the units of each."""

from math import ceil, tau
from typing import TYPE_CHECKING

from rigd.devices.cia402 import objects
from rigd.devices.cia402.requirements import REQUIREMENTS
from rigd.devices.contracts import DeviceError

if TYPE_CHECKING:
    from rigd.devices.parameters import RigParameters, ServoDrive

_ROUNDING = 1e-9


def fixed_values(node_id: int) -> dict[tuple[int, int], int]:
    """Return what objects are to hold whatever the profile says, by index and sub-index.

    Parameters
    ----------
    node_id
        Of the drive. CiA 301 sets its identifiers beforehand: it is added to all but that of SYNC.
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

    Only what the set-up asks the drive about, such as which watchdog it has, is not among it.

    Parameters
    ----------
    rig
        With a section ``cia402``.

    Raises
    ------
    DeviceError
        If the period cannot be told to a drive.
    """
    settings = rig.cia402
    assert settings is not None
    at_sync = settings.torque_delivery == "at_sync"
    period_us = sync_period_us(rig.rate_hz)
    value, exponent = interpolation_time(rig.rate_hz)
    limit = torque_limit_per_mille(rig)
    wanted = fixed_values(settings.node_id) | {
        (objects.RPDO_COMMUNICATION, 2): objects.AT_EVERY_SYNC if at_sync else objects.ON_ARRIVAL,
        (objects.SYNC_PERIOD_US, 0): period_us,
        (objects.INTERPOLATION_TIME, 1): value,
        (objects.INTERPOLATION_TIME, 2): exponent,
        (objects.ABORT_OPTION, 0): settings.abort_option,
        (objects.COMMUNICATION_ERROR, 1): settings.communication_error_option,
        (objects.HEARTBEAT_PRODUCER_MS, 0): round(settings.drive_heartbeat_period_s * 1000),
        (objects.MAX_TORQUE, 0): limit,
        **{(index, 0): limit for index in objects.TORQUE_LIMITS},
    }
    if settings.max_speed_rad_s > 0:
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
        raise DeviceError(
            f"rig.rate_hz = {rate_hz:g} Hz: its period is no whole number of microseconds, which "
            "a CANopen drive needs; choose another rate, such as 1000 Hz."
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
    raise DeviceError(
        f"rig.rate_hz = {rate_hz:g} Hz: its period cannot be told to a CANopen drive (object 60C2: "
        "1 to 255 times a power of ten of a second); choose another rate, such as 1000 Hz."
    )


def torque_limit_per_mille(rig: "RigParameters") -> int:
    """Return the peak torque in 1/1000 of the rated torque, rounded down, within 16 bits."""
    motor = rig.motor
    return min(int(1000 * motor.peak_torque_nm / motor.rated_torque_nm + _ROUNDING), 32767)


def max_speed_rpm(settings: "ServoDrive") -> int:
    """Return the speed limit in turns of the motor a minute, rounded up, for object 6080."""
    return ceil(settings.max_speed_rad_s * settings.gear_ratio * 60 / tau - _ROUNDING)
