"""Behaviour of drive and sensor that the loop relies on."""

import json
from collections.abc import Callable
from math import isfinite

from rigd.devices.contracts import Devices, Wrench

_PERIOD_NS = 1_000_000
_TORQUE_NM = 0.3
_ROUNDED = 0.1
"""Fraction of a torque by which a drive may round it."""


def _must(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def _run(
    devices: Devices, first: int, ticks: int, torque_nm: float | None = None
) -> tuple[list[float], list[Wrench]]:
    """Let some ticks pass; return angles and wrenches."""
    angles, wrenches = [], []
    for tick in range(first, first + ticks):
        devices.drive.latch(tick * _PERIOD_NS)
        devices.sensor.request(tick * _PERIOD_NS)
        angles.append(devices.drive.read_angle())
        wrenches.append(devices.sensor.read_wrench())
        if torque_nm is not None:
            devices.drive.command(torque_nm)
    return angles, wrenches


def _connect(devices: Devices) -> None:
    devices.drive.connect()
    devices.sensor.connect()


def _until_it_is_enabled_the_rig_is_read_and_nothing_moves(devices: Devices) -> None:
    _connect(devices)
    _must(bool(json.loads(json.dumps(devices.sensor.calibration()))), "there is no calibration")
    angles, wrenches = _run(devices, 0, 300, torque_nm=_TORQUE_NM)
    _must(all(map(isfinite, angles)), "an angle is not finite")
    _must(all(len(wrench) == 6 for wrench in wrenches), "a wrench has not six axes")
    _must(all(isfinite(value) for wrench in wrenches for value in wrench), "nor is a wrench finite")
    _must(not devices.drive.angle_stale, "the angle is stale")
    _must(not devices.sensor.wrench_stale, "the wrench is stale")
    _must(not devices.sensor.wrench_saturated, "the sensor is saturated")
    _must(max(angles) - min(angles) < 1e-3, "it moves before it is enabled")


def _torque_is_what_was_commanded_from_enabling_to_disabling(devices: Devices) -> None:
    _connect(devices)
    devices.drive.enable()
    angles, _ = _run(devices, 0, 300)
    _must(max(angles) - min(angles) < 1e-3, "it moves without a command")
    angles, _ = _run(devices, 300, 60, torque_nm=_TORQUE_NM)
    _must(angles[-1] > angles[0] + 1e-3, "a positive torque does not turn it towards positive")
    devices.drive.disable()
    devices.drive.disable()
    speeds = []
    last = _run(devices, 360, 1, torque_nm=_TORQUE_NM)[0][0]
    for block in range(20):
        angles, _ = _run(devices, 361 + 100 * block, 100, torque_nm=_TORQUE_NM)
        speeds.append(abs(angles[-1] - last))
        last = angles[-1]
    _must(speeds[-1] < 0.2 * max(speeds), "it does not coast to a stop once it is disabled")


def _sent_torque_is_reported(devices: Devices) -> None:
    def reported_nm(first: int) -> float:
        _run(devices, first, 10)
        return devices.drive.command(_TORQUE_NM)

    _connect(devices)
    _must(reported_nm(0) == 0.0, "a torque is reported as sent before it is enabled")
    devices.drive.enable()
    sent_nm = reported_nm(10)
    devices.drive.disable()
    _must(
        abs(sent_nm - _TORQUE_NM) <= _ROUNDED * _TORQUE_NM,
        f"the torque sent is reported as {sent_nm:g} N·m instead of {_TORQUE_NM:g} N·m",
    )
    _must(reported_nm(20) == 0.0, "a torque is reported as sent after it was disabled")


def _disabling_and_closing_work_in_every_state(devices: Devices) -> None:
    devices.drive.disable()
    _connect(devices)
    devices.drive.disable()
    devices.drive.enable()
    devices.drive.disable()
    devices.drive.close()
    devices.drive.close()
    devices.sensor.close()


def _lines_report_their_state(devices: Devices) -> None:
    _must(devices.drive.health().bits in (None, 0), "there were bits on the line before")
    _connect(devices)
    before = devices.drive.health(), devices.sensor.health()
    _run(devices, 0, 100)
    after = devices.drive.health(), devices.sensor.health()
    for then, now in zip(before, after, strict=True):
        if then.bits is None or now.bits is None:
            _must(then.bits is now.bits, "a line's bits are counted now and then")
        else:
            _must(now.bits > then.bits, "a line carries nothing")
            _must((now.bit_rate_bit_s or 0.0) > 0.0, "a line has no bit rate")
        _must(not now.errors, "a line has errors")
    _must(after[1].status == 0, "the sensor's status is not 0")


DEVICE_CHECKS: tuple[Callable[[Devices], None], ...] = (
    _until_it_is_enabled_the_rig_is_read_and_nothing_moves,
    _torque_is_what_was_commanded_from_enabling_to_disabling,
    _sent_torque_is_reported,
    _disabling_and_closing_work_in_every_state,
    _lines_report_their_state,
)
"""What the loop relies on: each takes devices that are opened but not connected, and raises
AssertionError with what is wrong. The second and the third let the motor turn. None of them knows
the inertia: that the torque has the right scale, ``rigd identify motor`` shows."""
