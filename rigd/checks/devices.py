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

from rigd.checks.rows import CheckResult, CheckRow, grade, name_of, value_of
from rigd.devices import ActuationTarget, actuation_target, open_devices
from rigd.devices.cia402 import DriveCapabilities
from rigd.devices.cia402.requirements import WATCHDOG, Watchdog
from rigd.devices.contracts import DeviceError, Devices
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import find_simulator
from rigd.engine.timing import RealClock
from rigd.profile import Profile
from rigd.safety.probing_move import MEASURED

_SCALES = {"gear_ratio": "6091", "encoder_step_rad": "608F, 6092"}
"""What a drive need not state of its position, and the objects."""
_IN_HEX = ("vendor_id", "product_code", "supported_modes")


_WATCHDOG_DETAIL = {
    Watchdog.OWN: (
        "Watchdog: its timeout is as stated in the profile (cia402.own_watchdog_s) and cannot be "
        "read back. Test it at low torque: kill rigd and time how long the torque stays on."
    ),
    Watchdog.NONE: (
        "Watchdog: should this computer fail with the torque on, nothing but the wired stop (STO) "
        "takes it off."
    ),
}


# Drive


@runtime_checkable
class InspectableDrive(Protocol):
    """A drive with an identity; simulated ones in this process have none."""

    def identity(self) -> Mapping[str, object]:
        """Return the identity reported at connecting; the keys end in their units."""


@runtime_checkable
class InspectedDrive(Protocol):
    """A drive whose objects were checked when it was connected."""

    def capabilities(self) -> DriveCapabilities | None:
        """Return the capabilities found at connecting."""


def _drive_rows(drive: InspectableDrive, rig: RigParameters) -> Iterator[CheckRow]:
    """Show identity and rated torque; what contradicts the profile was refused on connecting."""
    settings = rig.cia402
    wanted = {
        "rated_torque_nm": f"{rig.motor.rated_torque_nm:.4g} N·m",
        "supported_modes": "0x200 (cyclic torque) among them",
    }
    if settings is not None:
        wanted["gear_ratio"] = f"{settings.gear_ratio:.5g}"
        wanted["encoder_step_rad"] = f"{rig.encoder.resolution_rad:.4g} rad"
        wanted["vendor_id"] = f"{settings.vendor_id:#x}" if settings.vendor_id else "any"
        wanted["product_code"] = f"{settings.product_code:#x}" if settings.product_code else "any"
    for key, value in drive.identity().items():
        if key in _IN_HEX and isinstance(value, int):
            found = f"{value:#x}"
        else:
            found = "not stated by the drive" if value in (None, "") else value_of(key, value)
        verdict = CheckResult.OK
        if key in _SCALES and value is None:
            found = f"unknown: the drive does not state it (object {_SCALES[key]})"
            verdict = CheckResult.SKIPPED
        yield CheckRow("drive", name_of(key), found, wanted.get(key, ""), verdict)
    capabilities = drive.capabilities() if isinstance(drive, InspectedDrive) else None
    if capabilities is not None:
        yield from _safeguard_rows(capabilities)


def _safeguard_rows(capabilities: DriveCapabilities) -> Iterator[CheckRow]:
    """Show the watchdog, the replacements of missing objects, and what was accepted."""
    watchdog, after_s = capabilities.watchdog, capabilities.watchdog_s
    unproven = watchdog in (Watchdog.OWN, Watchdog.NONE)
    yield CheckRow(
        "drive",
        "watchdog",
        f"{watchdog.value}, {after_s * 1e3:g} ms" if isfinite(after_s) else "none: accepted",
        "switches the torque off if this computer stops communicating",
        CheckResult.WARNING if unproven else CheckResult.OK,
        _WATCHDOG_DETAIL.get(watchdog, ""),
    )
    accepted = capabilities.accepted
    for row in capabilities.lacks:
        missing = row.accept in accepted
        substitute = f"stands in: {row.stand_in}" if row.stand_in and row.accept != WATCHDOG else ""
        if row.accept == WATCHDOG:
            substitute = f"stands in: {watchdog.value}" if watchdog is not Watchdog.NONE else ""
        by_name = f'accepted by cia402.accept_without "{row.accept}"' if missing else ""
        yield CheckRow(
            "drive",
            f"object {row.address} ({row.name})",
            "; ".join(("absent or not usable", *filter(None, (by_name, substitute)))),
            "",
            CheckResult.WARNING if missing else CheckResult.OK,
            f"{row.name}: {row.sentence}" if missing else "",
        )
    for text in capabilities.assigned:
        yield CheckRow("drive", "object set", text, "read back", CheckResult.OK)


# Sensor

MEASURED_S = 1.0
_ROUNDING = 1.001
# Relative error of a stream's rate: more than clocks differ by; too much for the filter's weights.
_RATE_OFF, _RATE_WRONG = 0.01, 0.05

_UNSTATED = "not stated by the sensor"
_RANGES = ("range_n_nm", "range")
_SHOWN = ("sensor", "device", "serial_number", "part_number", "calibration")
_ALWAYS_SHOWN = ("firmware", "calibration_date")
_STATUS = "status"
_ASSUMED = "assumed"


@runtime_checkable
class MeasurableSensor(Protocol):
    """A sensor whose rate can be measured; simulated ones in this process have none."""

    def measure(self, duration_s: float) -> Mapping[str, float]:
        """Measure polls or stream for a while; the keys of the result end in their units."""


def calibration_rows(found: Mapping[str, object], rig: RigParameters) -> Iterator[CheckRow]:
    """Return the rows of identity and calibration, and compare ranges with the profile's.

    Parameters
    ----------
    found
        Calibration as the sensor reports it.
    rig
        Parameters of the profile.
    """
    for key in _SHOWN:
        if key in found:
            yield CheckRow(
                "sensor", name_of(key), _value(key, found), _wanted(key, rig), CheckResult.OK
            )
    for key in _ALWAYS_SHOWN:
        yield CheckRow("sensor", name_of(key), _value(key, found), "", CheckResult.OK)
    yield _range_row(found, rig.sensor.range)
    if found.get(_ASSUMED):
        yield CheckRow(
            "sensor",
            "counts and units",
            "assumed, below",
            "reported by the sensor",
            CheckResult.WARNING,
            f"Sensor: assumed are {found[_ASSUMED]}; compare with its calibration certificate.",
        )
    status = found.get(_STATUS)
    if status is not None:
        yield CheckRow(
            "sensor",
            "status",
            value_of(_STATUS, status),
            "none",
            grade(fail=False, warn=bool(status)),
        )
    more = [
        f"{name_of(key)} {value_of(key, value)}"
        for key, value in found.items()
        if key not in (*_SHOWN, *_ALWAYS_SHOWN, *_RANGES, _STATUS, _ASSUMED, "matrix")
        and value != ""
    ]
    if more:
        detail = f"Sensor: {'; '.join(more)}."
        yield CheckRow("sensor", "more", f"{len(more)} values, below", "", CheckResult.OK, detail)


def _measured_rows(
    measured: Mapping[str, float], rig: RigParameters, cause: str = ""
) -> Iterator[CheckRow]:
    """Return the rows on rate and turn-round; `cause` is the sensor's reason for gaps."""
    for key, value in measured.items():
        wanted, verdict = _assess_diagnostic(key, value, rig)
        detail = cause if key == "longest_gap_s" and verdict is not CheckResult.OK else ""
        yield CheckRow("sensor", name_of(key), value_of(key, value), wanted, verdict, detail)


def _value(key: str, found: Mapping[str, object]) -> str:
    value = found.get(key)
    return _UNSTATED if value in (None, "") else value_of(key, value)


def _wanted(key: str, rig: RigParameters) -> str:
    if key != "serial_number":
        return ""
    expected = rig.ati_can.serial_number if rig.ati_can else ""
    return expected or (rig.ati_serial.serial_number if rig.ati_serial else "") or "any"


def _range_row(found: Mapping[str, object], wanted: tuple[float, ...]) -> CheckRow:
    limits = "profile: " + value_of("range_n_nm", wanted)
    key = next((key for key in _RANGES if key in found), "")
    rated = found.get(key)
    if not isinstance(rated, list | tuple):
        # Over CAN there is no request for it.
        return CheckRow("sensor", "range", _UNSTATED, limits, CheckResult.OK)
    beyond = any(ours > _ROUNDING * float(its) for ours, its in zip(wanted, rated, strict=True))
    return CheckRow("sensor", "range", value_of("range_n_nm", rated), limits, grade(fail=beyond))


def _assess_diagnostic(key: str, value: float, rig: RigParameters) -> tuple[str, CheckResult]:
    """Return the expected value of a diagnostic, and the verdict."""
    period_s = 1.0 / rig.rate_hz
    acquisition = rig.acquisition
    same_tick = acquisition is not None and acquisition.mode == "same_tick"
    patience_s = acquisition.deadline_us * 1e-6 if acquisition and same_tick else period_s
    patience = f"at most {patience_s * 1e3:.4g} ms"
    if key == "polls_hz":
        return f"at least {rig.rate_hz:g} Hz", grade(fail=not value >= rig.rate_hz)
    if key == "records_hz" and rig.ati_serial is not None:
        stated = rig.ati_serial.stream_hz
        off = abs(value / stated - 1.0)
        return f"{stated:g} Hz", grade(fail=not off <= _RATE_WRONG, warn=off > _RATE_OFF)
    if key == "turnaround_median_s":
        return patience, grade(fail=not value <= patience_s)
    if key == "turnaround_p99_s":
        return patience, grade(fail=False, warn=not value <= patience_s)
    if key == "longest_gap_s":
        return f"at most {period_s * 1e3:.4g} ms", grade(fail=False, warn=value > period_s)
    # Everything else is a count of what should not happen.
    return "0", grade(fail=False, warn=value > 0)


# Exchange of a tick

TICKS = 500
_FEW_MISSING = 0.02
_MANY_MISSING = 0.2
_GROUP = "exchange"


def _exchange_rows(
    profile: Profile, devices: Devices, moves: ActuationTarget
) -> Iterator[CheckRow]:
    """Run some ticks without a torque, and check latency and losses of the replies.

    Parameters
    ----------
    profile
        Profile whose limits count.
    devices
        Devices that are connected, not enabled.
    moves
        What moves. In lock-step the simulated rig waits for this computer: times mean nothing.

    Raises
    ------
    DeviceError
        If a device reports an error, or its line is gone.
    """
    drive, sensor = devices.drive, devices.sensor
    period_ns = round(1e9 / profile.rig.rate_hz)
    waited_ms, angles_rad = np.zeros(TICKS), np.zeros(TICKS)
    missing_angles = missing_wrenches = saturated = 0
    clock = RealClock()
    due_ns = clock.now_ns()
    for tick in range(TICKS):
        due_ns = max(due_ns + period_ns, clock.now_ns())
        clock.wait_until(due_ns)
        begin_ns = time.monotonic_ns()
        drive.latch(due_ns)
        sensor.request(due_ns)
        angles_rad[tick] = drive.read_angle()
        sensor.read_wrench()
        waited_ms[tick] = (time.monotonic_ns() - begin_ns) * 1e-6
        missing_angles += drive.angle_stale
        missing_wrenches += sensor.wrench_stale
        saturated += sensor.wrench_saturated

    yield _reply_row(profile, waited_ms, moves)
    for what, missing in (
        ("angles missing", missing_angles),
        ("wrenches missing", missing_wrenches),
    ):
        verdict = grade(fail=missing > _MANY_MISSING * TICKS, warn=missing > _FEW_MISSING * TICKS)
        yield CheckRow(
            _GROUP,
            what,
            f"{missing} of {TICKS} ticks",
            f"at most {100 * _FEW_MISSING:.0f} %",
            verdict,
        )
    yield CheckRow(
        _GROUP, "sensor saturated", f"{saturated} of {TICKS} ticks", "0", grade(fail=saturated > 0)
    )
    moved_rad = float(np.ptp(angles_rad))
    allowed_rad = max(
        profile.session.rest_velocity_rad_s * TICKS / profile.rig.rate_hz,
        2.0 * profile.rig.encoder.resolution_rad,
    )
    yield CheckRow(
        _GROUP,
        "shaft moved",
        f"{moved_rad:.2g} rad",
        f"at most {allowed_rad:.2g} rad",
        grade(fail=False, warn=moved_rad > allowed_rad),
    )


def _reply_row(profile: Profile, waited_ms: np.ndarray, moves: ActuationTarget) -> CheckRow:
    acquisition = profile.rig.acquisition
    median, late = np.percentile(waited_ms, [50, 99]).tolist()
    found = f"p50 {median:.2f} ms, p99 {late:.2f} ms"
    what = "both replies after"
    if acquisition is None or acquisition.mode == "previous_tick":
        return CheckRow(
            _GROUP, what, "replies of the previous tick are used", "", CheckResult.SKIPPED
        )
    if moves is ActuationTarget.LOCK_STEP:
        return CheckRow(_GROUP, what, found, "any time (lock-step)", CheckResult.OK)
    limit_ms = acquisition.deadline_us * 1e-3
    verdict = grade(fail=median >= limit_ms, warn=late >= limit_ms)
    return CheckRow(_GROUP, what, found, f"less than {limit_ms:.2f} ms", verdict)


# Probing move


def _probing_rows(profile: Profile, moves: ActuationTarget) -> Iterator[CheckRow]:
    """Return the row on scales and signs: known, or verified before the first session."""
    if moves is ActuationTarget.SIMULATED:
        return
    missing = [key for key in MEASURED if profile.sources.get(key) != "measured"]
    if not missing:
        found, verdict = "motor and encoder are measured", CheckResult.OK
    else:
        found = "scales and signs: verified by the probing move before the first session"
        verdict = CheckResult.SKIPPED
    detail = (
        f"Probing move: sessions begin with it because {', '.join(missing)} "
        f"{'is' if len(missing) == 1 else 'are'} not measured; rigd probe makes it by itself "
        "(docs/safety.md)."
        if missing
        else ""
    )
    yield CheckRow("drive", "probing move", found, "", verdict, detail)


# All devices


def inspect_devices(profile: Profile) -> list[CheckRow]:
    """Connect to the devices of a profile, read them, run some ticks, and release them.

    No torque: the drive is never enabled. Whatever happens, both devices are closed.
    """
    rig = profile.rig
    moves = actuation_target(rig)
    rows = list(_link_rows(rig, moves))
    try:
        devices = open_devices(rig)
        with ExitStack() as closing:
            closing.callback(devices.sensor.close)
            closing.callback(devices.drive.close)
            _ask(profile, devices, moves, rows)
    except (DeviceError, OSError) as error:
        rows.append(CheckRow("devices", "open and close", str(error), "", CheckResult.FAIL))
    return rows


def _ask(profile: Profile, devices: Devices, moves: ActuationTarget, rows: list[CheckRow]) -> None:
    rig, drive, sensor = profile.rig, devices.drive, devices.sensor

    def about_drive() -> Iterator[CheckRow]:
        drive.connect()
        yield CheckRow("drive", "connection", _answer(moves), "an answer, no fault", CheckResult.OK)
        if isinstance(drive, InspectableDrive):
            yield from _drive_rows(drive, rig)
        yield from _probing_rows(profile, moves)

    def about_sensor() -> Iterator[CheckRow]:
        sensor.connect()
        yield CheckRow(
            "sensor", "connection", _answer(moves), "an answer, no error", CheckResult.OK
        )
        yield from calibration_rows(sensor.calibration(), rig)

    def rate() -> Iterator[CheckRow]:
        if not isinstance(sensor, MeasurableSensor) or moves.any_clock:
            yield CheckRow(
                "sensor", "rate", f"not measured: {moves.value}", "", CheckResult.SKIPPED
            )
        else:
            measured = sensor.measure(MEASURED_S)
            yield from _measured_rows(measured, rig, sensor.health().cause)

    # The drive last: once it is operational it expects a SYNC every period.
    sensor_answers = _try("sensor", about_sensor(), rows) and _try("sensor", rate(), rows)
    drive_answers = _try("drive", about_drive(), rows)
    if moves is ActuationTarget.SIMULATED:
        rows.append(
            CheckRow("exchange", "ticks", "simulated in this process", "", CheckResult.SKIPPED)
        )
    elif drive_answers and sensor_answers:
        _try("exchange", _exchange_rows(profile, devices, moves), rows)
    else:
        why = "not without drive and sensor"
        rows.append(CheckRow("exchange", "ticks", why, "", CheckResult.SKIPPED))


def _try(group: str, found: Iterable[CheckRow], rows: list[CheckRow]) -> bool:
    """Collect rows up to the first error, which becomes a row; return whether there was none."""
    try:
        rows.extend(found)
    except (DeviceError, OSError) as error:
        rows.append(CheckRow(group, "error", str(error), "", CheckResult.FAIL))
        return False
    return True


def _answer(moves: ActuationTarget) -> str:
    return "simulated in this process" if moves is ActuationTarget.SIMULATED else "it answers"


def _link_rows(rig: RigParameters, moves: ActuationTarget) -> Iterator[CheckRow]:
    simulator = find_simulator(rig.name)
    if simulator is not None:
        where = f"{moves.value} (process {simulator.pid})"
        yield CheckRow("link", "what moves", where, "", CheckResult.OK)
        return
    yield CheckRow("link", "what moves", moves.value, "", CheckResult.OK)
    if rig.can is not None:
        bus = f"{rig.can.channel} ({rig.can.interface})"
        yield CheckRow("link", "CAN", bus, "", CheckResult.OK)
    if rig.ati_serial is not None:
        yield CheckRow(
            "link",
            "serial",
            f"{rig.ati_serial.port}, {rig.ati_serial.baud} baud",
            "",
            CheckResult.OK,
        )
