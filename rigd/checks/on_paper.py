"""Checks of profile and EDS file alone: closed loop, stopping distance, identifiers, sources.

Closed loop: stability, and the margins. The required value depends on what a margin protects
against (see :mod:`rigd.control._margins`). At the angle it is the rule of thumb for the gain of a
feedback loop, a factor of 2. At torque command and torque reading, where the beam is cancelled and
a factor of 2 cannot be had, it is the tolerance of a drive's torque constant and of a calibration,
taken twice: 20 %. The phase margin has to tolerate the largest rotation by such an error (an error
of 20 % across it: 11.5°), together with one period of delay at the second mode (16 Hz: 5.8°): 20°,
rounded up. The delay margin has to tolerate one period more than the profile states: a reading or a
command that is a tick late. A loop that misses this is a warning, not a failure: it is stable as
described, and whether the description is right is what such a session may be for.

Stopping distance: how far the shaft still turns when nothing controls it, because the loop has
failed or runs blind. It is the worst that the limits allow: at the limit of the angle, moving
outwards at the limit of the speed, with the peak torque pushing on. Three things end that, each
after its own time:

* the drive watches over the loop's heartbeat, and misses it when the loop has stopped;
* a loop whose angles do not come goes on with the last one, heartbeat included, and ends the
  session after ``limits.stale_ticks_in_a_row``;
* a loop whose encoder has failed, though its messages are fresh, ends the session by what the
  torques say of the shaft, at full torque within `ENCODER_FAILURE_S`;
* a loop that was delayed reads its sensors again after the ticks it missed, up to
  ``limits.missed_ticks_in_a_row`` of them.

Each is checked by itself, as if the others did not act. Then the shaft coasts to rest, braked by
its friction alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from inspect import signature
from math import degrees, inf, isfinite, isinf, log1p, log10, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING

from rigd.beam import Beam, undamped_frequencies_rad_s
from rigd.beam.realisation import RealisationError
from rigd.checks.rows import CheckResult, CheckRow, grade
from rigd.control import ControlDesignError, stable_loop
from rigd.devices import MAY_BE_UNKNOWN, unknown_values
from rigd.devices.parameters import RigParameters
from rigd.excitation import chirp
from rigd.profile import Profile
from rigd.safety import ENCODER_FAILURE_S
from rigd.safety.limits import Limits
from rigd.session.limits import MAX_SAMPLES

# Modules of devices that a rig does not have are not loaded: these checks precede every session.
if TYPE_CHECKING:
    from rigd.control import Margins
    from rigd.devices.canbus import BusLoad
    from rigd.devices.parameters import AtiSerial, Motor

# Closed loop

TOLERANCE = 1.2
"""Factor that the gains of command and torque reading may be wrong by, up and down."""
LEAST_ANGLE_GAIN = 2.0
LEAST_PHASE_RAD = radians(20.0)
LEAST_DELAY_PERIODS = 1.0


STABILITY = "loop_stability"


def stability_rows(profile: Profile) -> Iterator[CheckRow]:
    """Check whether the loop of a profile's rig is stable."""
    try:
        loop, warning = stable_loop(profile.loop_model())
    except (ControlDesignError, RealisationError) as error:
        yield CheckRow("loop", "stability", str(error), "stable", CheckResult.FAIL, name=STABILITY)
        return
    found = f"closed loop stable, slowest pole {loop.growth_per_s:.2g} 1/s"
    yield CheckRow(
        "loop",
        "stability",
        warning or found,
        "stable",
        grade(fail=False, warn=warning is not None),
        name=STABILITY,
    )


def margin_rows(profile: Profile) -> Iterator[CheckRow]:
    """Check the margins of a stable loop."""
    from rigd.control import loop_margins

    try:
        loop, warning = stable_loop(profile.loop_model())
    except (ControlDesignError, RealisationError) as error:
        warning = str(error)
    if warning is not None:
        yield CheckRow("loop", "margins", "the loop is not stable", "", CheckResult.SKIPPED)
        return
    period_s = 1.0 / profile.rig.rate_hz
    for margins in loop_margins(loop):
        least_gain = LEAST_ANGLE_GAIN if margins.cut == "angle reading" else TOLERANCE
        yield from _margin_rows(margins, least_gain, LEAST_DELAY_PERIODS * period_s)


def _margin_rows(margins: "Margins", least_gain: float, least_delay_s: float) -> Iterator[CheckRow]:
    group = f"loop, {margins.cut}"
    too_strong = "any" if margins.gain_up == inf else _at(_db(margins.gain_up), margins.gain_up_hz)
    too_weak = (
        "any" if margins.gain_down == 0.0 else _at(_db(margins.gain_down), margins.gain_down_hz)
    )
    yield CheckRow(
        group,
        "gain margin",
        f"{too_weak} / {too_strong}",
        f"{_db(1 / least_gain)} / {_db(least_gain)}",
        grade(fail=False, warn=margins.gain_up < least_gain or margins.gain_down > 1 / least_gain),
    )
    yield CheckRow(
        group,
        "phase margin",
        _at(f"{degrees(margins.phase_rad):.1f}°", margins.phase_hz),
        f"{degrees(LEAST_PHASE_RAD):.0f}°",
        grade(fail=False, warn=margins.phase_rad < LEAST_PHASE_RAD),
    )
    yield CheckRow(
        group,
        "delay margin",
        "any"
        if margins.delay_s == inf
        else _at(f"{margins.delay_s * 1e3:.2f} ms", margins.delay_hz),
        f"{least_delay_s * 1e3:.2f} ms",
        grade(fail=False, warn=margins.delay_s < least_delay_s),
    )
    yield CheckRow(
        group,
        "modulus margin",
        _at(f"{margins.modulus:.2f}", margins.modulus_hz),
        "",
        CheckResult.OK,
    )


def _db(gain: float) -> str:
    return f"{20 * log10(gain):+.1f} dB"


def _at(value: str, frequency_hz: float) -> str:
    return value if frequency_hz != frequency_hz else f"{value} ({frequency_hz:.1f} Hz)"


# Stopping distance

_STEP_S = 5e-5
_FOR_EVER_RAD = 100.0
_NO_VISCOUS = 1e-6
"""Viscous over Coulomb friction below which only the latter counts."""
_GROUP = "travel"
_LOOP_FAILS = "if the loop fails"
TRAVEL_LOOP_FAILS = "travel_loop_fails"
TRAVEL_ENCODER_FAILS = "travel_encoder_fails"
TRAVEL_NO_ANGLE = "travel_no_angle"
TRAVEL_MISSED_TICKS = "travel_missed_ticks"


@dataclass(frozen=True, slots=True)
class Travel:
    """Angles from where the loop fails, in rad."""

    driven_rad: float
    """While the torque is still on; infinite beyond 100 rad."""
    coasting_rad: float
    """While the shaft runs out; infinite beyond 100 rad, and where no friction stops it."""

    @property
    def total_rad(self) -> float:
        """Angle until the shaft is at rest."""
        return self.driven_rad + self.coasting_rad


@lru_cache(maxsize=64)
def worst_travel(
    rig: RigParameters, limits: Limits, blind_s: float, max_speed_rad_s: float = inf
) -> Travel:
    """Return the worst travel while nothing controls the shaft.

    Parameters
    ----------
    rig, limits
        Parameters and limits of the profile.
    blind_s
        Time for which the torque stays on; infinite if nothing ends it.
    max_speed_rad_s
        Speed above which the drive by itself exerts no torque.

    Notes
    -----
    Unknown quantities are taken at their worst: while the torque is on the beam does not hold the
    motor back, and after it all of the beam turns on with the shaft, as if it were rigid.
    """
    if isinf(blind_s):
        return Travel(inf, inf)
    motor, beam = rig.motor, rig.beam
    light_kg_m2 = motor.inertia_kg_m2 + rig.sensor.tool_inertia_kg_m2
    heavy_kg_m2 = light_kg_m2 + beam.density_kg_per_m * beam.length_m**3 / 3
    speed_rad_s = limits.velocity_rad_s
    driven_rad = 0.0
    steps = round(blind_s / _STEP_S)
    for step in range(steps):
        torque_nm = motor.peak_torque_nm - _friction_nm(rig, speed_rad_s)
        faster_rad_s = max(0.0, speed_rad_s + torque_nm / light_kg_m2 * _STEP_S)
        before_rad_s, speed_rad_s = speed_rad_s, min(faster_rad_s, max_speed_rad_s)
        driven_rad += 0.5 * (before_rad_s + speed_rad_s) * _STEP_S
        if speed_rad_s == before_rad_s:  # it goes on like this
            driven_rad += speed_rad_s * (steps - 1 - step) * _STEP_S
            break
        if driven_rad > _FOR_EVER_RAD:
            break
    if driven_rad > _FOR_EVER_RAD:
        return Travel(inf, inf)
    coasting_rad = _coasting_rad(heavy_kg_m2, motor, speed_rad_s)
    return Travel(driven_rad, coasting_rad if coasting_rad <= _FOR_EVER_RAD else inf)


def _coasting_rad(inertia_kg_m2: float, motor: "Motor", speed_rad_s: float) -> float:
    """Return the angle in which friction alone stops an inertia; infinite without friction."""
    viscous, coulomb_nm = motor.viscous_nm_s_per_rad, motor.coulomb_nm
    ratio = viscous * speed_rad_s / coulomb_nm if coulomb_nm > 0.0 else inf
    if ratio < _NO_VISCOUS:
        return 0.5 * inertia_kg_m2 * speed_rad_s**2 / coulomb_nm
    if viscous == 0.0:
        return inf if speed_rad_s > 0.0 else 0.0
    braked = log1p(ratio) / ratio if isfinite(ratio) else 0.0
    return inertia_kg_m2 * speed_rad_s / viscous * (1.0 - braked)


@dataclass(frozen=True, slots=True)
class _Blindness:
    """One way in which the torque stays on while nothing controls the shaft."""

    name: str
    what: str
    duration_s: float
    ended_by: str
    """Limit or watchdog that ends it, with its key."""
    key: str


def _ways(profile: Profile) -> tuple[_Blindness, ...]:
    rig, limits, drive = profile.rig, profile.limits, profile.rig.cia402
    assert drive is not None
    stale, missed = limits.stale_ticks_in_a_row, limits.missed_ticks_in_a_row
    own = drive.watchdog_s > drive.heartbeat_timeout_s
    watchdog = "cia402.own_watchdog_s" if own else "cia402.heartbeat_timeout_s"
    return (
        _Blindness(
            TRAVEL_LOOP_FAILS,
            _LOOP_FAILS,
            drive.watchdog_s,
            f"of the drive's watchdog ({watchdog})",
            watchdog,
        ),
        # The tick that finds one too many switches off, and its command has its own delay.
        _Blindness(
            TRAVEL_NO_ANGLE,
            "if no angle comes",
            (stale + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {stale} old angles (limits.stale_ticks_in_a_row)",
            "limits.stale_ticks_in_a_row",
        ),
        _Blindness(
            TRAVEL_ENCODER_FAILS,
            "if the encoder fails",
            ENCODER_FAILURE_S + 2 / rig.rate_hz + rig.actuation.delay_s,
            "of the encoder watch",
            "limits.standstill_torque_nm",
        ),
        _Blindness(
            TRAVEL_MISSED_TICKS,
            "if ticks are missed",
            (missed + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {missed} missed ticks (limits.missed_ticks_in_a_row)",
            "limits.missed_ticks_in_a_row",
        ),
    )


def travel_rows(profile: Profile) -> Iterator[CheckRow]:
    """Compare the worst travel of each way with the angle available beyond the limit."""
    rig, limits, drive = profile.rig, profile.limits, profile.rig.cia402
    if drive is None:
        why = "the drive is part of this program and ends with it"
        yield CheckRow(_GROUP, _LOOP_FAILS, why, "", CheckResult.SKIPPED, name=TRAVEL_LOOP_FAILS)
        return
    ways = _ways(profile)
    margin_rad = limits.stop_angle_rad - limits.angle_rad
    bound = f"at most {margin_rad:.2f} rad (limits.stop_angle_rad - limits.angle_rad)"
    unbounded = isinf(drive.watchdog_s)
    if unbounded:
        ways = tuple(way for way in ways if not isinf(way.duration_s))
        yield CheckRow(
            _GROUP,
            f"worst, {_LOOP_FAILS}",
            "without bound: the profile accepts a drive without a watchdog",
            bound,
            CheckResult.WARNING,
            f"Travel {_LOOP_FAILS}: nothing but the wired stop ends it "
            '(cia402.accept_without = ["watchdog"]).',
            TRAVEL_LOOP_FAILS,
        )
    limited = drive.max_speed_rad_s > 0
    most_rad_s = drive.max_speed_rad_s if limited else inf
    travels = [worst_travel(rig, limits, way.duration_s, most_rad_s) for way in ways]
    longest = max(range(len(ways)), key=lambda number: travels[number].total_rad)
    for number, (way, travel) in enumerate(zip(ways, travels, strict=True)):
        too_far = not travel.total_rad <= margin_rad
        detail = ""
        if number == longest:
            free = worst_travel(rig, limits, way.duration_s)
            detail = "" if unbounded else f"Travel: the worst is {way.what}. "
            detail += (
                f"It relies on the drive's own speed limit of {drive.max_speed_rad_s:g} rad/s "
                f"(object 6080); without it, it would be {_angle(free.total_rad)}."
                if limited
                else "The drive's own speed limit (object 6080) is not set; "
                "cia402.max_speed_rad_s shortens it."
            )
        if too_far:
            detail += (
                f" Travel {way.what}: lower {way.key}, cia402.max_speed_rad_s, "
                "limits.velocity_rad_s or limits.angle_rad."
            )
        worst = "worst, " if number == longest and not unbounded else ""
        yield CheckRow(
            _GROUP,
            f"{worst}{way.what}",
            f"{_angle(travel.total_rad)}: {_angle(travel.driven_rad)} in the "
            f"{way.duration_s * 1e3:g} ms {way.ended_by}, {_angle(travel.coasting_rad)} "
            "coasting",
            bound,
            grade(fail=too_far),
            detail.strip(),
            way.name,
        )


def _angle(angle_rad: float) -> str:
    return f"more than {_FOR_EVER_RAD:g} rad" if isinf(angle_rad) else f"{angle_rad:.2f} rad"


def _friction_nm(rig: RigParameters, speed_rad_s: float) -> float:
    return rig.motor.viscous_nm_s_per_rad * speed_rad_s + rig.motor.coulomb_nm


# EDS file

EDS = "eds"


def eds_rows(path: Path, rig: RigParameters | None) -> Iterator[CheckRow]:
    """Check an EDS file against the requirements on a drive.

    Parameters
    ----------
    path
        Path of the EDS file.
    rig
        Parameters of the profile that the drive is to serve, or None.
    """
    from rigd.devices.cia402 import Grade, check_suitability
    from rigd.devices.eds import EdsError, read_eds

    verdicts = {
        Grade.FITS: CheckResult.OK,
        Grade.SUBSTITUTED: CheckResult.OK,
        Grade.ASK: CheckResult.SKIPPED,
        Grade.ACCEPTED: CheckResult.WARNING,
        Grade.DOUBT: CheckResult.WARNING,
        Grade.REFUSED: CheckResult.FAIL,
    }
    try:
        node_id = rig.cia402.node_id if rig is not None and rig.cia402 is not None else 1
        eds = read_eds(path, node_id)
    except EdsError as error:
        yield CheckRow("EDS", "file", str(error), "", CheckResult.FAIL, name=EDS)
        return
    yield CheckRow("EDS", "file", str(path), "", CheckResult.OK, name=EDS)
    for finding in check_suitability(eds, rig).findings:
        yield CheckRow(
            "EDS",
            finding.what,
            finding.found,
            finding.wanted,
            verdicts[finding.grade],
            finding.sentence,
            EDS,
        )


def drive_file_rows(profile: Profile) -> Iterator[CheckRow]:
    """Compare the EDS file that a profile names with what is required of a drive."""
    settings = profile.rig.cia402
    if settings is not None and settings.eds:
        yield from eds_rows(Path(settings.eds), profile.rig)


# Profile and wiring

HIGH_LOAD = 0.7
"""Load above which one more device, or repeated frames after a disturbance, do not fit."""


def profile_rows(profile: Profile) -> Iterator[CheckRow]:
    """Return the rows on the profile's name and its unverified numbers."""
    yield CheckRow("profile", profile.name, str(profile.path), "", CheckResult.OK)
    assumed = [key for key, source in profile.sources.items() if source == "assumed"]
    yield CheckRow(
        "profile",
        "unverified profile values",
        f"{len(assumed)} of {len(profile.sources)}",
        "none",
        grade(fail=False, warn=bool(assumed)),
        f"Assumed: {', '.join(assumed)}." if assumed else "",
    )


def record_rows(profile: Profile) -> Iterator[CheckRow]:
    """Return the row on the longest record, and whether a default chirp fits into it."""
    options = signature(chirp).parameters
    limit = f"no more than {MAX_SAMPLES} samples can be analysed, exported or replayed"
    usual_s = sum(float(options[name].default) for name in ("rest_s", "duration_s", "ring_down_s"))
    longest_s = MAX_SAMPLES / profile.rig.rate_hz
    yield CheckRow(
        "profile",
        "longest record",
        f"{longest_s:g} s at {profile.rig.rate_hz:g} Hz",
        f"{usual_s:g} s (run chirp)",
        grade(fail=False, warn=longest_s < usual_s),
        f"A chirp of {usual_s:g} s is refused: {limit}." if longest_s < usual_s else "",
    )


_GRAVITY_M_PER_S2 = 9.81
_AXIAL_LOAD = 1.5709
"""Integral of (1 - x) φ'(x)² over that of φ(x)², x from 0 to 1, for mode 1 of a clamped-free beam:
the stiffness that its own weight along it adds (Rayleigh), over the modal mass, in g / L."""
_EXAMPLE_TILT_DEG = 0.5


def plumb_rows(profile: Profile) -> Iterator[CheckRow]:
    """Check whether the motor's axis is stated to be vertical; no session is refused for it."""
    if profile.rig.devices.drive == "sim":
        found, detail, verdict = "the simulated rig has no gravity", "", CheckResult.SKIPPED
    elif profile.axis_tilt_deg is None:
        found, verdict = "not known", CheckResult.WARNING
        shift = _tilt_shift_percent(profile.rig.beam, _EXAMPLE_TILT_DEG)
        detail = (
            f"Axis plumb: gravity along the beam shifts its modes, mode 1 by {shift:.2g} % for "
            f"{_EXAMPLE_TILT_DEG:g}°, which an analysis can mistake for damping or for a mass at "
            "the tip. Measure the inclination of the motor's flange along the resting beam with a "
            "level, and state it as rig.axis_tilt_deg (positive: the tip is lower)."
        )
    else:
        shift = _tilt_shift_percent(profile.rig.beam, profile.axis_tilt_deg)
        found = f"{profile.axis_tilt_deg:g}° off, mode 1 shifted by {shift:+.2g} %"
        detail, verdict = "", CheckResult.OK
    yield CheckRow("profile", "axis plumb", found, "measured", verdict, detail)


def _tilt_shift_percent(beam: Beam, tilt_deg: float) -> float:
    """Return the relative change of mode 1's frequency by gravity along the beam, first order."""
    first_rad_s = undamped_frequencies_rad_s(beam, 1)[0]
    along_m_per_s2 = _GRAVITY_M_PER_S2 * sin(radians(tilt_deg))
    sag = _AXIAL_LOAD * along_m_per_s2 / (2.0 * beam.length_m * first_rad_s**2)
    return float(100.0 * sag)


UNKNOWN_VALUES = "unknown_values"


def unknown_rows(profile: Profile) -> Iterator[CheckRow]:
    """Return the row on unknown values that every session needs."""
    for key in unknown_values(profile.rig):
        remedy = f"{key}: enter its value in {profile.path} ({MAY_BE_UNKNOWN[key]})."
        yield CheckRow(
            "profile", key, "unknown", "a value", CheckResult.FAIL, remedy, UNKNOWN_VALUES
        )


CAN_IDENTIFIERS, CAN_LOAD, SERIAL_LOAD = "can_identifiers", "can_load", "serial_load"


def wiring_rows(rig: RigParameters) -> Iterator[CheckRow]:
    """Check identifiers and load of the bus or line in the profile."""
    if rig.can is not None:
        from rigd.devices.canbus import bus_load, check_identifiers

        collisions = check_identifiers(rig)
        for collision in collisions:
            yield _identifier_row(collision, CheckResult.FAIL)
        if not collisions:
            yield _identifier_row("no collision", CheckResult.OK)
        yield _bus_row(bus_load(rig), rig.can.bitrate_bit_s)
    if rig.ati_serial is not None:
        yield _line_row(rig.ati_serial)


def _identifier_row(found: str, verdict: CheckResult) -> CheckRow:
    return CheckRow("CAN bus", "identifiers", found, "no collision", verdict, name=CAN_IDENTIFIERS)


def _bus_row(load: "BusLoad", bitrate_bit_s: int) -> CheckRow:
    from rigd.devices.canbus import MAX_LOAD

    frames = ", ".join(
        f"{t.what} ({t.can_id:#05x}, {t.length} bytes, {t.rate_hz:g} Hz)" for t in load.traffic
    )
    return CheckRow(
        "CAN bus",
        "load",
        f"{100 * load.worst:.1f} % at worst, {100 * load.plain:.1f} % without stuffing",
        f"at most {100 * MAX_LOAD:.0f} %",
        grade(fail=load.worst > MAX_LOAD, warn=load.worst > HIGH_LOAD),
        f"At {bitrate_bit_s / 1e3:g} kbit/s: {frames}.",
        CAN_LOAD,
    )


def _line_row(serial: "AtiSerial") -> CheckRow:
    from rigd.devices.ati import RECORD_BITS
    from rigd.devices.canbus import MAX_LOAD

    load = RECORD_BITS * serial.stream_hz / serial.baud
    return CheckRow(
        "serial line",
        "load",
        f"{100 * load:.1f} % of {serial.baud} bit/s",
        f"at most {100 * MAX_LOAD:.0f} %",
        grade(fail=load > MAX_LOAD),
        name=SERIAL_LOAD,
    )
