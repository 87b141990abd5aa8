"""Checks of the connected devices: drive, sensor and their exchange, without a torque.

The devices are connected, read and polled, but the drive is never enabled. The exchange of a tick
is as in a session before the drive is enabled: SYNC, poll, replies. It runs in an ordinary process,
which wakes up late now and then; a fault of a device shows in most ticks.
"""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from math import isfinite
from typing import Protocol, runtime_checkable

import numpy as np

from rigd.check_rows import CheckResult, CheckRow, grade
from rigd.checks.rows import format_value, key_label
from rigd.devices import ActuationTarget, actuation_target, open_devices
from rigd.devices.cia402 import DriveCapabilities
from rigd.devices.cia402.requirements import WATCHDOG, Watchdog
from rigd.devices.contracts import DeviceError, Devices
from rigd.devices.kinds import DEVICES
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import find_simulator
from rigd.engine.timing import RealClock
from rigd.plugins import plugin_errors
from rigd.profile import Profile
from rigd.safety.probing_move import PROBED_KEYS

_OBJECT_NUMBERS_BY_SCALE = {"gear_ratio": "6091", "encoder_step_rad": "608F, 6092"}
"""Map from a position scale that a drive need not state to the CiA 402 objects that state it."""
_HEXADECIMAL_KEYS = ("vendor_id", "product_code", "supported_modes")
"""Keys of a drive's identity that are shown as hexadecimal numbers."""


_WATCHDOG_ADVICE = {  # Advice on watchdogs that were not proven on the drive
    Watchdog.OWN: (
        "Watchdog: its timeout is as stated in the profile (cia402.own_watchdog_s) and cannot be "
        "read back. Test it at low torque: kill rigd and time how long the torque stays on."
    ),
    Watchdog.NONE: (
        "Watchdog: if this computer fails with the torque on, only the wired stop (STO) switches "
        "it off."
    ),
}


# Drive


@runtime_checkable
class IdentifiableDrive(Protocol):
    """Drive that can report its identity; drives simulated in this process cannot."""

    def identity(self) -> Mapping[str, object]:
        """Return what the drive reported about itself when it was connected.

        The keys end in their units.
        """


@runtime_checkable
class DriveWithCapabilities(Protocol):
    """Drive whose CiA 402 objects were checked when it was connected."""

    def capabilities(self) -> DriveCapabilities | None:
        """Return the capabilities found at connection, or None if none were checked."""


def _drive_rows(drive: IdentifiableDrive, rig: RigParameters) -> Iterator[CheckRow]:
    """Yield check results on the drive's identity, rated torque and safeguards.

    None of these checks fails: a drive that contradicts the profile was refused when connecting.
    """
    drive_settings = rig.cia402
    wanted_text_by_key = {
        "rated_torque_nm": f"{rig.motor.rated_torque_nm:.4g} N·m",
        "supported_modes": "0x200 (cyclic torque) among them",
    }
    if drive_settings is not None:
        wanted_text_by_key["gear_ratio"] = f"{drive_settings.gear_ratio:.5g}"
        wanted_text_by_key["encoder_step_rad"] = f"{rig.encoder.resolution_rad:.4g} rad"
        wanted_text_by_key["vendor_id"] = (
            f"{drive_settings.vendor_id:#x}" if drive_settings.vendor_id else "any"
        )
        wanted_text_by_key["product_code"] = (
            f"{drive_settings.product_code:#x}" if drive_settings.product_code else "any"
        )
    for key, found_value in drive.identity().items():
        if key in _HEXADECIMAL_KEYS and isinstance(found_value, int):
            found_text = f"{found_value:#x}"
        else:
            found_text = (
                "not stated by the drive"
                if found_value in (None, "")
                else format_value(key, found_value)
            )
        check_result = CheckResult.OK
        if key in _OBJECT_NUMBERS_BY_SCALE and found_value is None:
            found_text = (
                f"unknown: the drive does not state it (object {_OBJECT_NUMBERS_BY_SCALE[key]})"
            )
            check_result = CheckResult.SKIPPED
        yield CheckRow(
            "drive", key_label(key), found_text, wanted_text_by_key.get(key, ""), check_result
        )
    capabilities = drive.capabilities() if isinstance(drive, DriveWithCapabilities) else None
    if capabilities is not None:
        yield from _safeguard_rows(capabilities)


def _safeguard_rows(capabilities: DriveCapabilities) -> Iterator[CheckRow]:
    """Yield check results on the drive's watchdog, missing objects, and objects that were set."""
    watchdog, watchdog_s = capabilities.watchdog, capabilities.watchdog_timeout_s
    is_unproven_watchdog = watchdog in (Watchdog.OWN, Watchdog.NONE)
    yield CheckRow(
        "drive",
        "watchdog",
        f"{watchdog.value}, {watchdog_s * 1e3:g} ms" if isfinite(watchdog_s) else "none: accepted",
        "switches the torque off if this computer stops communicating",
        CheckResult.WARNING if is_unproven_watchdog else CheckResult.OK,
        _WATCHDOG_ADVICE.get(watchdog, ""),
    )
    accepted_features = capabilities.accepted_missing_functions
    for row in capabilities.missing_objects:
        is_accepted = row.acceptance_name in accepted_features
        substitute_text = (
            f"in its place: {row.replacement}"
            if row.replacement and row.acceptance_name != WATCHDOG
            else ""
        )
        if row.acceptance_name == WATCHDOG:
            substitute_text = (
                f"in its place: {watchdog.value}" if watchdog is not Watchdog.NONE else ""
            )
        acceptance_text = (
            f'accepted by cia402.accept_without "{row.acceptance_name}"' if is_accepted else ""
        )
        yield CheckRow(
            "drive",
            f"object {row.address} ({row.name})",
            "; ".join(("absent or not usable", *filter(None, (acceptance_text, substitute_text)))),
            "",
            CheckResult.WARNING if is_accepted else CheckResult.OK,
            f"{row.name}: {row.consequence}" if is_accepted else "",
        )
    for safeguard_text in capabilities.assigned_objects:
        yield CheckRow("drive", "object set", safeguard_text, "read back", CheckResult.OK)


# Sensor

RATE_MEASUREMENT_S = 1.0
"""Duration in seconds of the measurement of the sensor's rate."""
_RANGE_TOLERANCE_FACTOR = 1.001
"""Largest ratio of the profile's to the sensor's range that counts as equal."""
_RATE_ERROR_WARNING, _RATE_ERROR_FAILURE = 0.01, 0.05
"""Relative errors of the sensor's record rate that give a warning and a failure.

The first is more than clocks differ by; the second is too much for the filter's weights."""

_NOT_REPORTED_TEXT = "not stated by the sensor"
"""Text for a value that the sensor does not report."""
_RANGE_KEYS = ("range_n_nm", "range")
"""Keys of a calibration that hold the sensor's measuring range."""
_KEYS_SHOWN_IF_REPORTED = ("sensor", "device", "serial_number", "part_number", "calibration")
"""Keys of a calibration that have a row if the sensor reports them."""
_KEYS_ALWAYS_SHOWN = ("firmware", "calibration_date")
"""Keys of a calibration that always have a row."""
_STATUS_KEY = "status"
"""Key of a calibration that holds the sensor's status."""
_ASSUMED_KEY = "assumed"
"""Key of a calibration that names the values that the sensor did not report."""


@runtime_checkable
class MeasurableSensor(Protocol):
    """Sensor whose rate of readings can be measured; sensors simulated in this process cannot."""

    def measure(self, duration_s: float) -> Mapping[str, float]:
        """Read the sensor for a time, and return its measured rate, delays and error counts.

        The keys end in their units.
        """


def calibration_rows(calibration: Mapping[str, object], rig: RigParameters) -> Iterator[CheckRow]:
    """Yield check results on the sensor's identity, calibration and measuring range.

    Parameters
    ----------
    calibration
        Calibration that the sensor reports.
    rig
        Parameters of the profile, with which serial number and range are compared.
    """
    for key in _KEYS_SHOWN_IF_REPORTED:
        if key in calibration:
            yield CheckRow(
                "sensor",
                key_label(key),
                _format_calibration_value(key, calibration),
                _required_calibration_value(key, rig),
                CheckResult.OK,
            )
    for key in _KEYS_ALWAYS_SHOWN:
        yield CheckRow(
            "sensor",
            key_label(key),
            _format_calibration_value(key, calibration),
            "",
            CheckResult.OK,
        )
    yield _range_row(calibration, rig.sensor.range)
    if calibration.get(_ASSUMED_KEY):
        yield CheckRow(
            "sensor",
            "counts and units",
            "assumed, below",
            "reported by the sensor",
            CheckResult.WARNING,
            f"Sensor: {calibration[_ASSUMED_KEY]} are assumed; compare them with its calibration "
            "certificate.",
        )
    sensor_status = calibration.get(_STATUS_KEY)
    if sensor_status is not None:
        yield CheckRow(
            "sensor",
            "status",
            format_value(_STATUS_KEY, sensor_status),
            "none",
            grade(fail=False, warn=bool(sensor_status)),
        )
    other_value_texts = [
        f"{key_label(key)} {format_value(key, found_value)}"
        for key, found_value in calibration.items()
        if key
        not in (
            *_KEYS_SHOWN_IF_REPORTED,
            *_KEYS_ALWAYS_SHOWN,
            *_RANGE_KEYS,
            _STATUS_KEY,
            _ASSUMED_KEY,
            "matrix",
        )
        and found_value != ""
    ]
    if other_value_texts:
        detail_text = f"Sensor: {'; '.join(other_value_texts)}."
        value_count_text = (
            "1 value" if len(other_value_texts) == 1 else f"{len(other_value_texts)} values"
        )
        yield CheckRow(
            "sensor", "more", f"{value_count_text}, below", "", CheckResult.OK, detail_text
        )


def _measured_rows(
    measured_values: Mapping[str, float], rig: RigParameters, longest_gap_cause: str = ""
) -> Iterator[CheckRow]:
    """Yield check results on the sensor's measured rate and response times.

    `longest_gap_cause` is the reason for gaps that the sensor reports.
    """
    for key, measured_value in measured_values.items():
        wanted_text, check_result = _assess_diagnostic(key, measured_value, rig)
        detail_text = (
            longest_gap_cause
            if key == "longest_gap_s" and check_result is not CheckResult.OK
            else ""
        )
        yield CheckRow(
            "sensor",
            key_label(key),
            format_value(key, measured_value),
            wanted_text,
            check_result,
            detail_text,
        )


def _format_calibration_value(calibration_key: str, calibration: Mapping[str, object]) -> str:
    """Format the value of a key of the calibration with its unit."""
    calibration_value = calibration.get(calibration_key)
    return (
        _NOT_REPORTED_TEXT
        if calibration_value in (None, "")
        else format_value(calibration_key, calibration_value)
    )


def _required_calibration_value(calibration_key: str, rig: RigParameters) -> str:
    """Return the value of a key of the calibration that the profile requires, or ""."""
    if calibration_key != "serial_number":
        return ""
    sensor_settings = (rig.ati_can, rig.ati_serial, *rig.added_settings)
    return next(
        filter(None, (getattr(each, calibration_key, "") for each in sensor_settings)), "any"
    )


def _range_row(calibration: Mapping[str, object], profile_range: tuple[float, ...]) -> CheckRow:
    """Return the result that compares the sensor's measuring range with that of the profile."""
    limits_text = "profile: " + format_value("range_n_nm", profile_range)
    range_key = next((range_key for range_key in _RANGE_KEYS if range_key in calibration), "")
    reported_range = calibration.get(range_key)
    if not isinstance(reported_range, list | tuple):
        # Over CAN the range cannot be requested.
        return CheckRow("sensor", "range", _NOT_REPORTED_TEXT, limits_text, CheckResult.OK)
    exceeds_range = any(
        profile_value > _RANGE_TOLERANCE_FACTOR * float(sensor_value)
        for profile_value, sensor_value in zip(profile_range, reported_range, strict=True)
    )
    return CheckRow(
        "sensor",
        "range",
        format_value("range_n_nm", reported_range),
        limits_text,
        grade(fail=exceeds_range),
    )


def _assess_diagnostic(
    diagnostic_key: str, measured_value: float, rig: RigParameters
) -> tuple[str, CheckResult]:
    """Return the required value of a measured diagnostic as text, and the check's result."""
    period_s = 1.0 / rig.rate_hz
    acquisition = rig.acquisition
    uses_same_tick = acquisition is not None and acquisition.mode == "same_tick"
    deadline_s = acquisition.deadline_us * 1e-6 if acquisition and uses_same_tick else period_s
    deadline_text = f"at most {deadline_s * 1e3:.4g} ms"
    if diagnostic_key == "polls_hz":
        return f"at least {rig.rate_hz:g} Hz", grade(fail=not measured_value >= rig.rate_hz)
    if diagnostic_key == "records_hz" and (stated_hz := _sensor_stream_hz(rig)) is not None:
        relative_rate_error = abs(measured_value / stated_hz - 1.0)
        return f"{stated_hz:g} Hz", grade(
            fail=not relative_rate_error <= _RATE_ERROR_FAILURE,
            warn=relative_rate_error > _RATE_ERROR_WARNING,
        )
    if diagnostic_key == "turnaround_median_s":
        return deadline_text, grade(fail=not measured_value <= deadline_s)
    if diagnostic_key == "turnaround_p99_s":
        return deadline_text, grade(fail=False, warn=not measured_value <= deadline_s)
    if diagnostic_key == "longest_gap_s":
        return f"at most {period_s * 1e3:.4g} ms", grade(fail=False, warn=measured_value > period_s)
    # All other diagnostics are counts of errors.
    return "0", grade(fail=False, warn=measured_value > 0)


def _sensor_stream_hz(rig: RigParameters) -> float | None:
    """Return the records per second that the sensor streams, or None if it is polled."""
    sensor_kind = DEVICES.get(rig.devices.sensor)
    if sensor_kind is None or sensor_kind.stream_hz is None:
        return None
    with plugin_errors(DEVICES.owner(sensor_kind.name)):
        return sensor_kind.stream_hz(rig)


# Exchange of a tick

EXCHANGE_CHECK_TICKS = 500
"""Number of ticks in which the exchange with the devices is checked."""
_MISSING_REPLY_WARNING_FRACTION = 0.02
"""Fraction of ticks without a reply above which there is a warning."""
_MISSING_REPLY_FAILURE_FRACTION = 0.2
"""Fraction of ticks without a reply above which the check fails."""
_EXCHANGE_GROUP = "exchange"
"""Group of the rows on the exchange with the devices."""


def _exchange_rows(
    profile: Profile, devices: Devices, target: ActuationTarget
) -> Iterator[CheckRow]:
    """Run `EXCHANGE_CHECK_TICKS` ticks without torque, and yield rows on late and missing replies.

    The devices are connected but not enabled. If a simulated rig in lock-step moves, it waits for
    this computer, so that delays are meaningless. Raises DeviceError if a device reports an error
    or its line is lost.
    """
    drive, sensor = devices.drive, devices.sensor
    period_ns = round(1e9 / profile.rig.rate_hz)
    reply_delays_ms, angles_rad = np.zeros(EXCHANGE_CHECK_TICKS), np.zeros(EXCHANGE_CHECK_TICKS)
    missing_angles = missing_wrenches = saturated_ticks = 0
    real_clock = RealClock()
    tick_due_ns = real_clock.now_ns()
    for tick_number in range(EXCHANGE_CHECK_TICKS):
        tick_due_ns = max(tick_due_ns + period_ns, real_clock.now_ns())
        real_clock.wait_until(tick_due_ns)
        exchange_begin_ns = time.monotonic_ns()
        drive.latch(tick_due_ns)
        sensor.request(tick_due_ns)
        angles_rad[tick_number] = drive.read_angle()
        sensor.read_wrench()
        reply_delays_ms[tick_number] = (time.monotonic_ns() - exchange_begin_ns) * 1e-6
        missing_angles += drive.angle_stale
        missing_wrenches += sensor.wrench_stale
        saturated_ticks += sensor.wrench_saturated

    yield _reply_row(profile, reply_delays_ms, target)
    for missing_text, missing_count in (
        ("angles missing", missing_angles),
        ("wrenches missing", missing_wrenches),
    ):
        check_result = grade(
            fail=missing_count > _MISSING_REPLY_FAILURE_FRACTION * EXCHANGE_CHECK_TICKS,
            warn=missing_count > _MISSING_REPLY_WARNING_FRACTION * EXCHANGE_CHECK_TICKS,
        )
        yield CheckRow(
            _EXCHANGE_GROUP,
            missing_text,
            f"{missing_count} of {EXCHANGE_CHECK_TICKS} ticks",
            f"at most {100 * _MISSING_REPLY_WARNING_FRACTION:.0f} %",
            check_result,
        )
    yield CheckRow(
        _EXCHANGE_GROUP,
        "sensor saturated",
        f"{saturated_ticks} of {EXCHANGE_CHECK_TICKS} ticks",
        "0",
        grade(fail=saturated_ticks > 0),
    )
    motion_rad = float(np.ptp(angles_rad))
    allowed_motion_rad = max(
        profile.session.rest_velocity_rad_s * EXCHANGE_CHECK_TICKS / profile.rig.rate_hz,
        2.0 * profile.rig.encoder.resolution_rad,
    )
    yield CheckRow(
        _EXCHANGE_GROUP,
        "shaft moved",
        f"{motion_rad:.2g} rad",
        f"at most {allowed_motion_rad:.2g} rad",
        grade(fail=False, warn=motion_rad > allowed_motion_rad),
    )


def _reply_row(profile: Profile, reply_delays_ms: np.ndarray, target: ActuationTarget) -> CheckRow:
    """Return the result that compares the delays of the devices' replies with the deadline."""
    acquisition = profile.rig.acquisition
    median_ms, p99_ms = np.percentile(reply_delays_ms, [50, 99]).tolist()
    found_text = f"p50 {median_ms:.2f} ms, p99 {p99_ms:.2f} ms"
    row_label = "both replies after"
    if acquisition is None or acquisition.mode == "previous_tick":
        return CheckRow(
            _EXCHANGE_GROUP,
            row_label,
            "replies of the previous tick are used",
            "",
            CheckResult.SKIPPED,
        )
    if target is ActuationTarget.LOCK_STEP:
        return CheckRow(
            _EXCHANGE_GROUP, row_label, found_text, "any time (lock-step)", CheckResult.OK
        )
    deadline_ms = acquisition.deadline_us * 1e-3
    check_result = grade(fail=median_ms >= deadline_ms, warn=p99_ms >= deadline_ms)
    return CheckRow(
        _EXCHANGE_GROUP, row_label, found_text, f"less than {deadline_ms:.2f} ms", check_result
    )


# Probing move


def _probing_rows(profile: Profile, target: ActuationTarget) -> Iterator[CheckRow]:
    """Yield the check result on whether scales and signs are known or need a probing move."""
    if target is ActuationTarget.SIMULATED:
        return
    unmeasured_keys = [key for key in PROBED_KEYS if profile.sources.get(key) != "measured"]
    if not unmeasured_keys:
        found_text, check_result = "motor and encoder are measured", CheckResult.OK
    else:
        found_text = "scales and signs: verified by the probing move before the first session"
        check_result = CheckResult.SKIPPED
    detail_text = (
        f"Probing move: sessions begin with it because {', '.join(unmeasured_keys)} "
        f"{'is' if len(unmeasured_keys) == 1 else 'are'} not measured; rigd probe runs it alone "
        "(docs/safety.md)."
        if unmeasured_keys
        else ""
    )
    yield CheckRow("drive", "probing move", found_text, "", check_result, detail_text)


# All devices


def inspect_devices(profile: Profile) -> list[CheckRow]:
    """Connect to the devices of a profile, check them without torque, and return the rows.

    The drive is never enabled. Both devices are closed at the end, even after an error.
    """
    rig = profile.rig
    target = actuation_target(rig)
    check_rows = list(_link_rows(rig, target))
    try:
        devices = open_devices(rig)
        with ExitStack() as exit_stack:
            exit_stack.callback(devices.sensor.close)
            exit_stack.callback(devices.drive.close)
            _check_devices(profile, devices, target, check_rows)
    except (DeviceError, OSError) as error:
        check_rows.append(CheckRow("devices", "open and close", str(error), "", CheckResult.FAIL))
    return check_rows


def _check_devices(
    profile: Profile, devices: Devices, target: ActuationTarget, check_rows: list[CheckRow]
) -> None:
    """Connect drive and sensor, and append the rows of their checks to `check_rows`."""
    rig, drive, sensor = profile.rig, devices.drive, devices.sensor

    def drive_rows() -> Iterator[CheckRow]:
        drive.connect()
        yield CheckRow(
            "drive", "connection", _connection_text(target), "an answer, no fault", CheckResult.OK
        )
        if isinstance(drive, IdentifiableDrive):
            yield from _drive_rows(drive, rig)
        yield from _probing_rows(profile, target)

    def sensor_rows() -> Iterator[CheckRow]:
        sensor.connect()
        yield CheckRow(
            "sensor", "connection", _connection_text(target), "an answer, no error", CheckResult.OK
        )
        yield from calibration_rows(sensor.calibration(), rig)

    def rate_rows() -> Iterator[CheckRow]:
        if not isinstance(sensor, MeasurableSensor) or target.allows_virtual_clock:
            yield CheckRow(
                "sensor", "rate", f"not measured: {target.value}", "", CheckResult.SKIPPED
            )
        else:
            measured_values = sensor.measure(RATE_MEASUREMENT_S)
            yield from _measured_rows(measured_values, rig, sensor.health().cause)

    # The drive is connected last, since an operational drive expects a SYNC every period.
    is_sensor_ok = _collect_rows("sensor", sensor_rows(), check_rows) and _collect_rows(
        "sensor", rate_rows(), check_rows
    )
    is_drive_ok = _collect_rows("drive", drive_rows(), check_rows)
    if target is ActuationTarget.SIMULATED:
        check_rows.append(
            CheckRow("exchange", "ticks", "simulated in this process", "", CheckResult.SKIPPED)
        )
    elif is_drive_ok and is_sensor_ok:
        _collect_rows("exchange", _exchange_rows(profile, devices, target), check_rows)
    else:
        skip_reason = "not without drive and sensor"
        check_rows.append(CheckRow("exchange", "ticks", skip_reason, "", CheckResult.SKIPPED))


def _collect_rows(
    row_group: str, found_rows: Iterable[CheckRow], check_rows: list[CheckRow]
) -> bool:
    """Append the rows of a check to `check_rows`, and return whether the check raised no error.

    An error of a device becomes a failed row.
    """
    try:
        check_rows.extend(found_rows)
    except (DeviceError, OSError) as error:
        check_rows.append(CheckRow(row_group, "error", str(error), "", CheckResult.FAIL))
        return False
    return True


def _connection_text(target: ActuationTarget) -> str:
    """Return the finding for a connected device: "simulated in this process" or "it answers"."""
    return "simulated in this process" if target is ActuationTarget.SIMULATED else "it answers"


def _link_rows(rig: RigParameters, target: ActuationTarget) -> Iterator[CheckRow]:
    """Yield check results on the target that will move and on its bus and serial line."""
    simulator = find_simulator(rig.name)
    if simulator is not None:
        target_text = f"{target.value} (process {simulator.pid})"
        yield CheckRow("link", "what moves", target_text, "", CheckResult.OK)
        return
    yield CheckRow("link", "what moves", target.value, "", CheckResult.OK)
    if rig.can is not None:
        bus_text = f"{rig.can.channel} ({rig.can.interface})"
        yield CheckRow("link", "CAN", bus_text, "", CheckResult.OK)
    sensor_kind = DEVICES.get(rig.devices.sensor)
    if sensor_kind is not None and sensor_kind.address is not None:
        plugin_owner = DEVICES.owner(sensor_kind.name)
        with plugin_errors(plugin_owner):
            sensor_address = sensor_kind.address(rig)
        link_label = "serial" if plugin_owner is None else sensor_kind.name
        yield CheckRow("link", link_label, sensor_address, "", CheckResult.OK)
