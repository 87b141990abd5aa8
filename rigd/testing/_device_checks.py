"""Checks of the behaviour of drive and sensor that the control loop relies on."""

import json
from collections.abc import Callable
from math import isfinite

from rigd.devices.contracts import Devices, Wrench

_TICK_PERIOD_NS = 1_000_000
"""Time between two ticks in nanoseconds."""
_COMMANDED_TORQUE_NM = 0.3
"""Torque that the checks command, in newton metres."""
_MAX_ROUNDING_FRACTION = 0.1
"""Largest relative difference between commanded and sent torque, as a drive may round it."""


def _require(is_satisfied: bool, message: str) -> None:
    """Raise AssertionError with a message unless a condition is true."""
    if not is_satisfied:
        raise AssertionError(message)


def _run_ticks(
    devices: Devices, first_tick: int, tick_count: int, torque_nm: float | None = None
) -> tuple[list[float], list[Wrench]]:
    """Run ticks of the control loop and return the motor angles (rad) and wrenches read."""
    angles_rad, wrenches = [], []
    for tick in range(first_tick, first_tick + tick_count):
        devices.drive.latch(tick * _TICK_PERIOD_NS)
        devices.sensor.request(tick * _TICK_PERIOD_NS)
        angles_rad.append(devices.drive.read_angle())
        wrenches.append(devices.sensor.read_wrench())
        if torque_nm is not None:
            devices.drive.command(torque_nm)
    return angles_rad, wrenches


def _connect_devices(devices: Devices) -> None:
    """Connect the drive and the sensor."""
    devices.drive.connect()
    devices.sensor.connect()


def _check_disabled_rig_stays_at_rest(devices: Devices) -> None:
    """Check that before enabling the readings are valid and a commanded torque causes no motion."""
    _connect_devices(devices)
    _require(bool(json.loads(json.dumps(devices.sensor.calibration()))), "there is no calibration")
    angles_rad, wrenches = _run_ticks(devices, 0, 300, torque_nm=_COMMANDED_TORQUE_NM)
    _require(all(map(isfinite, angles_rad)), "an angle is not finite")
    _require(all(len(wrench) == 6 for wrench in wrenches), "a wrench has not six axes")
    _require(
        all(isfinite(wrench_component) for wrench in wrenches for wrench_component in wrench),
        "nor is a wrench finite",
    )
    _require(not devices.drive.angle_stale, "the angle is stale")
    _require(not devices.sensor.wrench_stale, "the wrench is stale")
    _require(not devices.sensor.wrench_saturated, "the sensor is saturated")
    _require(max(angles_rad) - min(angles_rad) < 1e-3, "it moves before it is enabled")


def _check_torque_only_while_enabled(devices: Devices) -> None:
    """Check that the torque follows the command while, and only while, the drive is enabled."""
    _connect_devices(devices)
    devices.drive.enable()
    angles_rad, _ = _run_ticks(devices, 0, 300)
    _require(max(angles_rad) - min(angles_rad) < 1e-3, "it moves without a command")
    angles_rad, _ = _run_ticks(devices, 300, 60, torque_nm=_COMMANDED_TORQUE_NM)
    _require(
        angles_rad[-1] > angles_rad[0] + 1e-3, "a positive torque does not turn it towards positive"
    )
    devices.drive.disable()
    devices.drive.disable()
    angle_changes_rad = []
    last_angle_rad = _run_ticks(devices, 360, 1, torque_nm=_COMMANDED_TORQUE_NM)[0][0]
    for block_number in range(20):
        angles_rad, _ = _run_ticks(
            devices, 361 + 100 * block_number, 100, torque_nm=_COMMANDED_TORQUE_NM
        )
        angle_changes_rad.append(abs(angles_rad[-1] - last_angle_rad))
        last_angle_rad = angles_rad[-1]
    _require(
        angle_changes_rad[-1] < 0.2 * max(angle_changes_rad),
        "it does not coast to a stop once it is disabled",
    )


def _check_sent_torque_is_reported(devices: Devices) -> None:
    """Check that a drive reports the torque that it sends, which is zero while it is disabled."""

    def reported_torque_nm(first_tick: int) -> float:
        _run_ticks(devices, first_tick, 10)
        return devices.drive.command(_COMMANDED_TORQUE_NM)

    _connect_devices(devices)
    _require(reported_torque_nm(0) == 0.0, "a torque is reported as sent before it is enabled")
    devices.drive.enable()
    sent_torque_nm = reported_torque_nm(10)
    devices.drive.disable()
    _require(
        abs(sent_torque_nm - _COMMANDED_TORQUE_NM) <= _MAX_ROUNDING_FRACTION * _COMMANDED_TORQUE_NM,
        f"the torque sent is reported as {sent_torque_nm:g} N·m instead of "
        f"{_COMMANDED_TORQUE_NM:g} N·m",
    )
    _require(reported_torque_nm(20) == 0.0, "a torque is reported as sent after it was disabled")


def _check_disabling_and_closing(devices: Devices) -> None:
    """Check that a drive can be disabled and closed in every state, and more than once."""
    devices.drive.disable()
    _connect_devices(devices)
    devices.drive.disable()
    devices.drive.enable()
    devices.drive.disable()
    devices.drive.close()
    devices.drive.close()
    devices.sensor.close()


def _check_line_health(devices: Devices) -> None:
    """Check that the devices report the bits, bit rate and errors of their bus or serial line."""
    _require(devices.drive.health().bits in (None, 0), "there were bits on the line before")
    _connect_devices(devices)
    line_healths_before = devices.drive.health(), devices.sensor.health()
    _run_ticks(devices, 0, 100)
    line_healths_after = devices.drive.health(), devices.sensor.health()
    for health_before, health_after in zip(line_healths_before, line_healths_after, strict=True):
        if health_before.bits is None or health_after.bits is None:
            _require(
                health_before.bits is health_after.bits, "a line's bits are counted now and then"
            )
        else:
            _require(health_after.bits > health_before.bits, "a line carries nothing")
            _require((health_after.bit_rate_bit_s or 0.0) > 0.0, "a line has no bit rate")
        _require(not health_after.errors, "a line has errors")
    _require(line_healths_after[1].status == 0, "the sensor's status is not 0")


DEVICE_CHECKS: tuple[Callable[[Devices], None], ...] = (
    _check_disabled_rig_stays_at_rest,
    _check_torque_only_while_enabled,
    _check_sent_torque_is_reported,
    _check_disabling_and_closing,
    _check_line_health,
)
"""Checks of the behaviour that the control loop relies on.

Each check takes devices that are opened but not connected, and raises AssertionError with the
problem. The second and the third check let the motor turn. No check knows the inertia; ``rigd
identify motor`` shows whether the torque has the right scale."""
