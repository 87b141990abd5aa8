"""Checks of profile and EDS file alone: values, record, wiring, and what packages add."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from inspect import signature
from math import radians, sin
from pathlib import Path
from typing import TYPE_CHECKING

from rigd.beam import Beam, undamped_frequencies_rad_s
from rigd.check_rows import CheckResult, CheckRow, grade
from rigd.control import ControlDesignError
from rigd.control.contracts import ControllerError
from rigd.control.kinds import CONTROLLERS, make_controller
from rigd.devices import MAY_BE_UNKNOWN, is_simulated_here, unknown_values
from rigd.devices.kinds import DEVICES, selected_kinds
from rigd.devices.parameters import RigParameters
from rigd.excitation import chirp
from rigd.plugins import PluginError, plugin_errors
from rigd.profile import Profile
from rigd.session.limits import MAX_SAMPLES

# Modules of devices that a rig does not have are not loaded: these checks precede every session.
if TYPE_CHECKING:
    from rigd.devices.canbus import BusLoad
    from rigd.devices.parameters import AtiSerial

# EDS file

EDS_ROW = "eds"
"""Name of the rows on the drive's EDS file."""


def eds_rows(path: Path, rig: RigParameters | None) -> Iterator[CheckRow]:
    """Yield the check results that compare a drive's EDS file with the requirements on a drive.

    Parameters
    ----------
    path
        Path of the EDS file.
    rig
        Parameters of the rig in which the drive is to be used, or None for any rig.
    """
    from rigd.devices.cia402 import Grade, check_suitability
    from rigd.devices.eds import EdsError, read_eds

    result_by_grade = {
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
        yield CheckRow("EDS", "file", str(error), "", CheckResult.FAIL, name=EDS_ROW)
        return
    yield CheckRow("EDS", "file", str(path), "", CheckResult.OK, name=EDS_ROW)
    for finding in check_suitability(eds, rig).findings:
        yield CheckRow(
            "EDS",
            finding.checked_item,
            finding.stated_text,
            finding.required_text,
            result_by_grade[finding.grade],
            finding.consequence,
            EDS_ROW,
        )


def drive_file_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield check results on the EDS file that the profile names; none if it names no file."""
    drive_settings = profile.rig.cia402
    if drive_settings is not None and drive_settings.eds:
        yield from eds_rows(Path(drive_settings.eds), profile.rig)


# Profile and wiring

HIGH_BUS_LOAD_FRACTION = 0.7
"""Bus load, as a fraction, above which there is a warning.

An additional device, or repeated frames after a disturbance, would not fit."""


def profile_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield check results on the profile's name and its assumed, not verified, numbers."""
    yield CheckRow("profile", profile.name, str(profile.path), "", CheckResult.OK)
    assumed_keys = [
        key for key, number_source in profile.sources.items() if number_source == "assumed"
    ]
    yield CheckRow(
        "profile",
        "unverified profile values",
        f"{len(assumed_keys)} of {len(profile.sources)} assumed",
        "none",
        grade(fail=False, warn=bool(assumed_keys)),
        f"Assumed: {', '.join(assumed_keys)}." if assumed_keys else "",
    )


def record_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the result on the longest possible record, and whether a default chirp fits into it."""
    chirp_parameters = signature(chirp).parameters
    limit_text = f"no more than {MAX_SAMPLES} samples can be analysed, exported or replayed"
    default_chirp_duration_s = sum(
        float(chirp_parameters[parameter_name].default)
        for parameter_name in ("rest_s", "duration_s", "ring_down_s")
    )
    longest_record_s = MAX_SAMPLES / profile.rig.rate_hz
    yield CheckRow(
        "profile",
        "longest record",
        f"{longest_record_s:g} s at {profile.rig.rate_hz:g} Hz",
        f"{default_chirp_duration_s:g} s (run chirp)",
        grade(fail=False, warn=longest_record_s < default_chirp_duration_s),
        f"A chirp of {default_chirp_duration_s:g} s is refused: {limit_text}."
        if longest_record_s < default_chirp_duration_s
        else "",
    )


_GRAVITY_M_PER_S2 = 9.81
"""Gravitational acceleration in m/s²."""
_AXIAL_LOAD_COEFFICIENT = 1.5709
"""Stiffness that the beam's axial weight adds to mode 1, over its modal mass, in units of g/L.

It is Rayleigh's quotient of a clamped-free beam: the integral of (1 - x) φ'(x)² over that of φ(x)²,
x from 0 to 1."""
_EXAMPLE_TILT_DEG = 0.5
"""Inclination in degrees of the example in the advice on the axis."""


def axis_tilt_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the result on the measured inclination of the motor's axis; it refuses no session."""
    if is_simulated_here(profile.rig):
        found_text, detail_text, check_result = (
            "the simulated rig has no gravity",
            "",
            CheckResult.SKIPPED,
        )
    elif profile.axis_tilt_deg is None:
        found_text, check_result = "not known", CheckResult.WARNING
        frequency_shift_percent = _tilt_frequency_shift_percent(profile.rig.beam, _EXAMPLE_TILT_DEG)
        detail_text = (
            "Axis plumb: gravity along the beam shifts its modes, mode 1 by "
            f"{frequency_shift_percent:.2g} % for "
            f"{_EXAMPLE_TILT_DEG:g}°, which an analysis can mistake for damping or for a mass at "
            "the tip. Measure the inclination of the motor's flange along the resting beam with a "
            "level, and state it as rig.axis_tilt_deg (positive: the tip is lower)."
        )
    else:
        frequency_shift_percent = _tilt_frequency_shift_percent(
            profile.rig.beam, profile.axis_tilt_deg
        )
        found_text = (
            f"{profile.axis_tilt_deg:g}° off, mode 1 shifted by {frequency_shift_percent:+.2g} %"
        )
        detail_text, check_result = "", CheckResult.OK
    yield CheckRow("profile", "axis plumb", found_text, "measured", check_result, detail_text)


def _tilt_frequency_shift_percent(beam: Beam, tilt_deg: float) -> float:
    """Return the first-order change in per cent of mode 1's frequency by gravity along the beam."""
    first_frequency_rad_s = undamped_frequencies_rad_s(beam, 1)[0]
    axial_gravity_m_per_s2 = _GRAVITY_M_PER_S2 * sin(radians(tilt_deg))
    relative_frequency_shift = (
        _AXIAL_LOAD_COEFFICIENT
        * axial_gravity_m_per_s2
        / (2.0 * beam.length_m * first_frequency_rad_s**2)
    )
    return float(100.0 * relative_frequency_shift)


UNKNOWN_VALUES_ROW = "unknown_values"
"""Name of the rows on required values that the profile states as unknown."""


def unknown_value_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield a failed row for each value that every session needs and the profile lacks."""
    for key in unknown_values(profile.rig):
        remedy_text = f"{key}: enter its value in {profile.path} ({MAY_BE_UNKNOWN[key]})."
        yield CheckRow(
            "profile", key, "unknown", "a value", CheckResult.FAIL, remedy_text, UNKNOWN_VALUES_ROW
        )


CAN_IDENTIFIERS_ROW, CAN_LOAD_ROW, SERIAL_LOAD_ROW = "can_identifiers", "can_load", "serial_load"
"""Names of the rows on colliding CAN identifiers, on the bus load, and on the serial line's load.
"""


def wiring_rows(rig: RigParameters) -> Iterator[CheckRow]:
    """Yield results on the CAN identifiers and on the load of the CAN bus and the serial line."""
    if rig.can is not None:
        from rigd.devices.canbus import bus_load, check_identifiers

        identifier_collisions = check_identifiers(rig)
        for id_collision in identifier_collisions:
            yield _can_identifier_row(id_collision, CheckResult.FAIL)
        if not identifier_collisions:
            yield _can_identifier_row("no collision", CheckResult.OK)
        yield _bus_row(bus_load(rig), rig.can.bitrate_bit_s)
    if rig.ati_serial is not None:
        yield _serial_line_row(rig.ati_serial)


DEVICE_SETTINGS_ROW = "device_settings"
"""Name of the rows that installed packages add for their devices."""


def added_device_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the rows that the kinds of the profile's devices declare."""
    for device_kind in selected_kinds(profile.rig.devices):
        plugin_owner = DEVICES.owner(device_kind.name)
        if plugin_owner is not None:
            yield CheckRow("devices", device_kind.name, plugin_owner.label, "", CheckResult.OK)
        if device_kind.check_rows is not None:
            with plugin_errors(plugin_owner):
                yield from _named_rows(device_kind.check_rows(profile.rig), DEVICE_SETTINGS_ROW)


CONTROLLER_ROW = "controller"
"""Name of the rows on the controller that an installed package adds."""
_MAX_START_TORQUE_FRACTION = 1e-6
"""Largest torque of a controller at rest, as a fraction of the motor's peak torque."""


def added_controller_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the rows on the controller of an installed package; none for the shipped one."""
    controller_name = profile.control.controller
    plugin_owner = CONTROLLERS.owner(controller_name)
    if plugin_owner is None:
        return
    yield CheckRow("controller", controller_name, plugin_owner.label, "", CheckResult.OK)
    rig = profile.controlled_rig()
    row_label, wanted_text = "torque after a reset", "0 N·m"
    try:
        start_torques_nm = []
        controller = make_controller(rig)
        for start_rad in (0.0, profile.limits.angle_rad):
            controller.reset(start_rad)
            controller.step(start_rad, start_rad, 0.0)
            start_torques_nm.append(abs(controller.unlimited_torque_nm))
        controller_kind = CONTROLLERS.load(plugin_owner)
        with plugin_errors(plugin_owner):
            declared_rows = (
                ()
                if controller_kind.check_rows is None
                else tuple(_named_rows(controller_kind.check_rows(rig), CONTROLLER_ROW))
            )
    except (ControllerError, ControlDesignError, PluginError) as error:
        yield CheckRow(
            "controller", row_label, str(error), wanted_text, CheckResult.FAIL, name=CONTROLLER_ROW
        )
        return
    largest_start_torque_nm = max(start_torques_nm)
    yield CheckRow(
        "controller",
        row_label,
        f"{largest_start_torque_nm:.3g} N·m",
        wanted_text,
        grade(fail=not largest_start_torque_nm <= _MAX_START_TORQUE_FRACTION * rig.torque_limit_nm),
        name=CONTROLLER_ROW,
    )
    yield from declared_rows


def _named_rows(declared_rows: Iterable[CheckRow], row_name: str) -> Iterator[CheckRow]:
    """Yield the rows that a part of the rig declares, with the name of such rows.

    Raises
    ------
    TypeError
        If one of them is not a `CheckRow`.
    """
    for row in declared_rows:
        if not isinstance(row, CheckRow):
            raise TypeError(f"check_rows has returned a {type(row).__name__}, and not a CheckRow")
        yield replace(row, name=row_name)


def _can_identifier_row(found_text: str, check_result: CheckResult) -> CheckRow:
    """Return the check result on the CAN identifiers."""
    return CheckRow(
        "CAN bus", "identifiers", found_text, "no collision", check_result, name=CAN_IDENTIFIERS_ROW
    )


def _bus_row(bus_load: "BusLoad", bitrate_bit_s: int) -> CheckRow:
    """Return the check result on the load of the CAN bus."""
    from rigd.devices.canbus import MAX_BUS_LOAD

    frames_text = ", ".join(
        f"{t.frame_name} ({t.can_id:#05x}, {t.data_length} bytes, {t.rate_hz:g} Hz)"
        for t in bus_load.cyclic_frames
    )
    return CheckRow(
        "CAN bus",
        "load",
        f"{100 * bus_load.worst_case_load:.1f} % at worst, "
        f"{100 * bus_load.load_without_stuffing:.1f} % without stuffing",
        f"at most {100 * MAX_BUS_LOAD:.0f} %",
        grade(
            fail=bus_load.worst_case_load > MAX_BUS_LOAD,
            warn=bus_load.worst_case_load > HIGH_BUS_LOAD_FRACTION,
        ),
        f"At {bitrate_bit_s / 1e3:g} kbit/s: {frames_text}.",
        CAN_LOAD_ROW,
    )


def _serial_line_row(serial_settings: "AtiSerial") -> CheckRow:
    """Return the check result on the load of the serial line."""
    from rigd.devices.ati import RECORD_BITS
    from rigd.devices.canbus import MAX_BUS_LOAD

    serial_line_load = RECORD_BITS * serial_settings.stream_hz / serial_settings.baud
    return CheckRow(
        "serial line",
        "load",
        f"{100 * serial_line_load:.1f} % of {serial_settings.baud} bit/s",
        f"at most {100 * MAX_BUS_LOAD:.0f} %",
        grade(fail=serial_line_load > MAX_BUS_LOAD),
        name=SERIAL_LOAD_ROW,
    )
