"""Numbers of the profile in the units of the drive's objects."""

from math import ceil, tau
from typing import TYPE_CHECKING

from rigd.devices.contracts import DeviceError

if TYPE_CHECKING:
    from rigd.devices.parameters import RigParameters, ServoDrive

_ROUNDING = 1e-9


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
