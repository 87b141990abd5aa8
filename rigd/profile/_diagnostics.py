"""Checks for contradictions between a profile's values, and the messages on its mistakes.

`contradictions` finds values that contradict each other, `wiring_contradictions` those in the
wiring of the devices. The messages are also on sources, keys and sections that are missing or
unknown.
"""

import difflib
import re
from collections.abc import Iterator, Mapping
from math import pi, sqrt
from typing import Any

from pydantic_core import ErrorDetails

from rigd.beam import Beam, undamped_frequencies_rad_s
from rigd.control import ControlDesignError, design_pid
from rigd.control.declaration import ControllerKind
from rigd.control.kinds import CONTROLLERS
from rigd.devices import MAY_BE_UNKNOWN
from rigd.devices.declaration import DeviceKind
from rigd.devices.kinds import DEVICES, selected_kinds
from rigd.devices.obstacles import (
    INCOMPATIBLE_WITH_FORCES,
    INCOMPATIBLE_WITH_OBSTACLES,
    ObstacleError,
    check_obstacles,
    parse_obstacle,
)
from rigd.devices.parameters import DeviceSelection
from rigd.plugins import plugin_errors
from rigd.printable import printable
from rigd.profile._schema import (
    NUMBER_SOURCES,
    SECTIONS,
    TEXT_KEYS,
    is_number_type,
    key_types,
    optional_sections,
    section_fields,
)
from rigd.safety.limits import RECORDER_BUFFER_S
from rigd.session.user_metadata import NOTES, MetadataError, check_name
from rigd.units import UNITS, is_usable_size, suffix_of, unit_of

_AXIS_UNITS_BY_KEY = {  # Units of keys with six numbers, one for each axis of the sensor
    "sensor.resolution": "N, N, N, N·m, N·m, N·m",
    "sensor.range": "N, N, N, N·m, N·m, N·m",
    "sensor.projection": "m, m, m, 1, 1, 1",
    "sensor.shear_projection": "1, 1, 1, 1/m, 1/m, 1/m",
    "simulation.offset": "N, N, N, N·m, N·m, N·m",
}

_MAX_LIMIT_TO_MOTOR_ACCELERATION = 100.0
"""Largest limit of the acceleration, relative to the motor's largest acceleration.

With a higher limit no jump of the encoder would be detected."""

_RIG_NAME_PATTERN = re.compile(r"[^\W_][\w .-]{0,63}")
"""Pattern of valid names of a rig, which file names contain."""

_FIRST_MODE_BAND_HZ = 0.1, 100.0
"""Plausible lowest and highest frequency in Hz of the undamped beam's first mode."""


_MAX_DELAY_ROUNDING_S = 1e-9
"""Largest rounding error in seconds of a stated delay."""
_PARALLEL_SQUARED_SINE = 1e-6
"""Squared sine of the angle between two projections below which they count as parallel."""
_MAX_SHOWN_CHARACTERS = 200
"""Largest number of characters of a value in a message."""
_MAX_SHOWN_ITEMS = 12
"""Largest number of items of an array in a message."""


def missing_source_message(profile_key: str, number_source: object) -> str:
    """Return the message for a number whose ``source``, its origin, is missing or invalid."""
    if number_source is None:
        return f"{profile_key} has no source; add source = {_quoted_choice(NUMBER_SOURCES)}."
    return (
        f"{profile_key} has source = {_shown_value(number_source)}; choose "
        f"{_quoted_choice(NUMBER_SOURCES)}."
    )


def invalid_unknown_source_message(profile_key: str, number_entry: Mapping[str, Any]) -> str:
    """Return the message for a key with source "unknown" that has a value or requires one."""
    if profile_key in MAY_BE_UNKNOWN:
        return (
            f"{profile_key} = {_shown_value(number_entry['value'])}{_unit_text(profile_key)} has a "
            'value, and source = "unknown"; '
            f"remove the value, or choose {_quoted_choice(NUMBER_SOURCES)} as its source."
        )
    return (
        f'{profile_key} has source = "unknown", but needs a value; only '
        f"{', '.join(MAY_BE_UNKNOWN)} may be "
        "unknown."
    )


def number_without_source_message(profile_key: str, stated_value: object) -> str:
    """Return the message for a profile's number whose origin (key ``source``) is not stated."""
    return (
        f"{profile_key} = {_shown_value(stated_value)}{_unit_text(profile_key)} does not state its "
        "source; write "
        f'{{ value = {_shown_value(stated_value)}, source = "…" }} with '
        f"{_quoted_choice(NUMBER_SOURCES)}."
    )


def implausible_number_messages(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for numbers that are within their range but impossible for any rig."""
    for key, key_value in profile_values.items():
        for number in key_value if isinstance(key_value, tuple) else (key_value,):
            if isinstance(number, int | float) and not is_usable_size(number):
                yield (
                    f"{key} = {_shown_value(number)}{_unit_text(key)} is not plausible for a rig; "
                    "check its unit."
                )


def contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for values that are within their ranges but contradict each other."""
    if not _RIG_NAME_PATTERN.fullmatch(profile_values["name"]):
        yield (
            f"name = {_shown_value(profile_values['name'])} cannot be used in file names; use "
            "letters, digits, spaces and . _ - only, at most 64, and begin with a letter or digit."
        )
    rated_torque_nm, peak_torque_nm = (
        profile_values["motor.rated_torque_nm"],
        profile_values["motor.peak_torque_nm"],
    )
    if peak_torque_nm < rated_torque_nm:
        yield (
            f"motor.peak_torque_nm = {peak_torque_nm:g} N·m is below motor.rated_torque_nm = "
            f"{rated_torque_nm:g} N·m; the peak is at least the rated torque."
        )
    continuous_torque_nm = profile_values["motor.continuous_torque_nm"]
    if peak_torque_nm >= rated_torque_nm and continuous_torque_nm > peak_torque_nm:
        yield (
            f"motor.continuous_torque_nm = {continuous_torque_nm:g} N·m is above "
            f"motor.peak_torque_nm = {peak_torque_nm:g} N·m; continuous torque must not exceed "
            "peak torque."
        )
    torque_command_limit_nm = profile_values["limits.torque_command_nm"]
    if torque_command_limit_nm < peak_torque_nm:
        yield (
            f"limits.torque_command_nm = {torque_command_limit_nm:g} N·m is below "
            f"motor.peak_torque_nm = {peak_torque_nm:g} N·m, where commands saturate; the "
            "controller's command limit must be higher."
        )
    angle_limit_rad, stop_angle_rad = (
        profile_values["limits.angle_rad"],
        profile_values["limits.stop_angle_rad"],
    )
    if stop_angle_rad <= angle_limit_rad:
        yield (
            f"limits.stop_angle_rad = {stop_angle_rad:g} rad is not above limits.angle_rad = "
            f"{angle_limit_rad:g} rad; "
            "the shaft could not come to rest before it is stopped by force."
        )
    yield from _unreachable_limit_messages(profile_values)
    yield from _drag_contradictions(profile_values)
    yield from _hum_contradictions(profile_values)
    drift_warning_nm, drift_limit_nm = (
        profile_values["session.tare_drift_nm"],
        profile_values["limits.tare_drift_nm"],
    )
    if drift_limit_nm < drift_warning_nm:
        yield (
            f"limits.tare_drift_nm = {drift_limit_nm:g} N·m, which ends a session, is below "
            f"session.tare_drift_nm = {drift_warning_nm:g} N·m, which warns; it must be the "
            "greater one."
        )
    yield from first_mode_contradictions(profile_values)
    if not any(profile_values["sensor.projection"]):
        yield (
            "sensor.projection is all zero; give the coefficients that turn a wrench into the "
            "motor's torque."
        )
    yield from _shear_contradictions(profile_values)
    yield from _obstacle_problems(profile_values)
    for key_name in profile_values["metadata.required"]:
        try:
            if key_name not in NOTES:
                check_name(key_name)
        except MetadataError as error:
            yield f"metadata.required: {error}"
    try:
        design_pid(
            profile_values["motor.inertia_kg_m2"],
            profile_values["motor.viscous_nm_s_per_rad"],
            profile_values["control.pole_rad_s"],
        )
    except ControlDesignError as error:
        yield str(error)


def first_mode_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield a message if the beam's first mode has an implausible frequency.

    The reason is often a wrong unit.
    """
    first_mode_hz = float(
        undamped_frequencies_rad_s(
            Beam(
                profile_values["beam.length_m"],
                profile_values["beam.density_kg_per_m"],
                profile_values["beam.bending_stiffness_n_m2"],
            ),
            1,
        )[0]
    ) / (2 * pi)
    low_hz, high_hz = _FIRST_MODE_BAND_HZ
    if not low_hz <= first_mode_hz <= high_hz:
        yield (
            f"beam.length_m, beam.density_kg_per_m and beam.bending_stiffness_n_m2 give a first "
            f"mode at {first_mode_hz:.3g} Hz, outside {low_hz:g} to {high_hz:g} Hz; check their "
            "units."
        )


def _drag_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for settings of a simulated rig that are incompatible with its air drag."""
    if not profile_values.get("simulation.air_drag_m"):
        return
    for key_name in INCOMPATIBLE_WITH_FORCES:
        if profile_values.get(f"simulation.{key_name}"):
            yield (
                f"simulation.{key_name} and simulation.air_drag_m cannot be simulated together; "
                "leave one of them out, or make it 0."
            )


def _hum_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield a message if the simulated sensor's hum has too high a frequency for its rate."""
    rate_hz, hum_hz = profile_values["rig.rate_hz"], profile_values.get("simulation.hum_hz", 0.0)
    readings_per_tick = max(1, round(profile_values.get("ati_serial.stream_hz", rate_hz) / rate_hz))
    if profile_values.get("simulation.hum_nm") and hum_hz >= 0.5 * readings_per_tick * rate_hz:
        yield (
            f"simulation.hum_hz = {hum_hz:g} Hz is not below half of the "
            f"{readings_per_tick * rate_hz:g} "
            "readings that the simulated sensor takes each second; choose less than "
            f"{0.5 * readings_per_tick * rate_hz:g} Hz, 50 or 60 for the mains."
        )


def _shear_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield a message if a profile has the same sensor axis for shear force and torque."""
    torque_projection, shear_projection = (
        profile_values["sensor.projection"],
        profile_values["sensor.shear_projection"],
    )
    squared_scalar_product = (
        sum(a * b for a, b in zip(torque_projection, shear_projection, strict=True)) ** 2
    )
    product_of_squared_lengths = sum(a * a for a in torque_projection) * sum(
        b * b for b in shear_projection
    )
    if (
        product_of_squared_lengths > 0
        and squared_scalar_product > (1 - _PARALLEL_SQUARED_SINE) * product_of_squared_lengths
    ):
        yield (
            f"sensor.shear_projection = {_shown_value(shear_projection)} is a multiple of "
            "sensor.projection: shear and torque could not be distinguished; give the coefficients "
            "that turn a wrench into the force across the beam."
        )


def _obstacle_problems(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for invalid or incompatible obstacles of a simulated rig."""
    beam = Beam(
        profile_values["beam.length_m"],
        profile_values["beam.density_kg_per_m"],
        profile_values["beam.bending_stiffness_n_m2"],
    )
    effect_values = {
        effect_name: profile_values.get(f"simulation.{effect_name}")
        for effect_name in INCOMPATIBLE_WITH_OBSTACLES
    }
    for obstacle_text in profile_values.get("simulation.obstacles") or ():
        try:
            check_obstacles([parse_obstacle(obstacle_text)], beam, effect_values)
        except ObstacleError as error:
            yield f"simulation.obstacles: {error}"


def _unreachable_limit_messages(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for limits so high that this rig cannot exceed them."""
    angle_rad, inertia_kg_m2 = (
        profile_values["limits.angle_rad"],
        profile_values["motor.inertia_kg_m2"],
    )
    motor_acceleration_rad_s2 = profile_values["motor.peak_torque_nm"] / inertia_kg_m2
    angle_limits_text = f"limits.angle_rad = {angle_rad:g} rad to either side"
    error_limit_rad, speed_limit_rad_s = (
        profile_values["limits.tracking_error_rad"],
        profile_values["limits.velocity_rad_s"],
    )
    if error_limit_rad >= 2 * angle_rad:
        yield (
            f"limits.tracking_error_rad = {error_limit_rad:g} rad can never be exceeded: reference "
            f"and angle are within {angle_limits_text}; choose less than {2 * angle_rad:g} rad, "
            "some three times the error of your excitation."
        )
    max_speed_rad_s = sqrt(2 * motor_acceleration_rad_s2 * 2 * angle_rad)
    if speed_limit_rad_s >= max_speed_rad_s:
        yield (
            f"limits.velocity_rad_s = {speed_limit_rad_s:g} rad/s can never be exceeded: the peak "
            f"torque accelerates the motor alone to {max_speed_rad_s:.4g} rad/s between "
            f"{angle_limits_text}; choose less, some three times the speed of your excitation."
        )
    acceleration_limit_rad_s2 = profile_values["limits.acceleration_rad_s2"]
    if acceleration_limit_rad_s2 > _MAX_LIMIT_TO_MOTOR_ACCELERATION * motor_acceleration_rad_s2:
        yield (
            f"limits.acceleration_rad_s2 = {acceleration_limit_rad_s2:g} rad/s² cannot detect a "
            f"jump of the encoder: it is more than {_MAX_LIMIT_TO_MOTOR_ACCELERATION:g} times the "
            f"{motor_acceleration_rad_s2:.4g} rad/s² that the peak torque gives the motor alone; "
            "choose two to five times that."
        )
    recorder_lag_s = profile_values["limits.recorder_lag_s"]
    if recorder_lag_s >= RECORDER_BUFFER_S:
        yield (
            f"limits.recorder_lag_s = {recorder_lag_s:g} s can never be exceeded: shared memory "
            f"holds {RECORDER_BUFFER_S:g} s, and the next sample is lost; choose less, 12 s for "
            "example."
        )


def missing_key_messages(
    missing_keys: list[str], profile_values: Mapping[str, Any]
) -> Iterator[str]:
    """Yield a message for each missing key or section.

    `missing_keys` has the missing keys, `profile_values` the values of the file.
    """
    reported_sections = set()
    for key in missing_keys:
        section = key.rpartition(".")[0]
        if section and not any(k.rpartition(".")[0] == section for k in profile_values):
            if section not in reported_sections:
                reported_sections.add(section)
                yield f"section [{section}] is missing."
        elif key in TEXT_KEYS:
            yield f'{key} is missing; add {key} = "…" at the top.'
        else:
            yield (
                f'{key} is missing; add it as {{ value = …, source = "…" }}'
                f"{_unit_text(key, ' in')}."
            )


def unknown_key_message(profile_key: str, profile_values: Mapping[str, Any]) -> str:
    """Return the message for an unknown key, with the key that was probably meant."""
    if profile_key in SECTIONS:
        return (
            f"{profile_key} = {_shown_value(profile_values[profile_key])} must be a section; write "
            f"[{profile_key}] and its keys below."
        )
    if package_message := _section_of_package_message(
        profile_key.partition(".")[0], profile_values
    ):
        return package_message
    section = profile_key.rpartition(".")[0]
    section_keys = [k for k in key_types() if k.rpartition(".")[0] == section]
    if not section_keys:
        similar_names = difflib.get_close_matches(section or profile_key, SECTIONS, 1)
        hint_text = (
            f"did you mean [{similar_names[0]}]?"
            if similar_names
            else f"sections are {', '.join(SECTIONS)}."
        )
        return f"{profile_key} is not a key of a profile; {hint_text}"
    for candidate_key in section_keys:
        unit_suffix = suffix_of(candidate_key)
        key_without_unit = candidate_key.removesuffix(unit_suffix)
        if unit_suffix and profile_key.startswith(key_without_unit + "_"):
            return (
                f"{profile_key} = {_shown_value(profile_values[profile_key])} has the wrong unit "
                f"('{profile_key.removeprefix(key_without_unit + '_')}'); write {candidate_key}, "
                f"the value in {UNITS[unit_suffix]}."
            )
    similar_names = difflib.get_close_matches(profile_key, section_keys, 1)
    if similar_names:
        return (
            f"{profile_key} is unknown; did you mean {similar_names[0]}"
            f"{_unit_text(similar_names[0], ', in')}?"
        )
    key_names_text = ", ".join(k.rpartition(".")[2] for k in section_keys)
    return (
        f"{profile_key} is unknown; {f'[{section}]' if section else 'the top'} has "
        f"{key_names_text}."
    )


def _section_of_package_message(section: str, profile_values: Mapping[str, Any]) -> str:
    """Return the message for an unknown section of a package's part, or "" if it is of none."""
    if section in SECTIONS:
        return ""
    for noun, registry, keys in (
        ("device", DEVICES, ("devices.drive", "devices.sensor")),
        ("controller", CONTROLLERS, ("control.controller",)),
    ):
        is_installed = section in registry.names()
        naming_keys = [key for key in keys if profile_values.get(key) == section]
        if naming_keys and not is_installed:
            return (
                f'{naming_keys[0]} = "{section}": no installed package has this {noun} (rigd '
                "plugins lists those of packages); install its package in this environment."
            )
        if is_installed and not naming_keys:
            lines = " or ".join(f'{key.rpartition(".")[2]} = "{section}"' for key in keys)
            return (
                f"[{section}] is the section of the {noun} {section}, which this profile does not "
                f"use; write {lines} in the section [{keys[0].partition('.')[0]}]."
            )
    return ""


_REQUIREMENT_BY_ERROR_TYPE = {  # Required value, by the type of pydantic's error
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text in quotes",
    "tuple_type": "an array of six numbers",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "missing": "an array of six numbers",
    "too_long": "an array of six numbers",
    "string_too_short": "text",
}
_BOUND_WORDS_BY_ERROR_TYPE = {  # Name of the bound in pydantic's error, and its wording
    "greater_than": ("gt", "more than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def wrong_value_message(error_detail: ErrorDetails) -> str:
    """Return the message for a value of the wrong type or outside its range."""
    key, *item_position = error_detail["loc"]
    if error_detail["type"] == "missing":  # one of the six
        item_position = []
    item_key = f"{key}[{item_position[0]}]" if item_position else str(key)
    value_statement = f"{item_key} = {_shown_value(error_detail['input'])}{_unit_text(str(key))}"
    if error_detail["type"] == "literal_error":
        remedy_text = f"must be {error_detail['ctx']['expected']}".replace("'", '"')
    elif error_detail["type"] in _BOUND_WORDS_BY_ERROR_TYPE:
        bound_name, bound_words = _BOUND_WORDS_BY_ERROR_TYPE[error_detail["type"]]
        remedy_text = f"must be {bound_words} {error_detail['ctx'][bound_name]:g}"
        if str(key).startswith("beam.damping."):
            remedy_text += ": a negative coefficient or an order of 2 or more is an unstable beam"
    elif error_detail["type"] == "tuple_type" and not is_number_type(key_types()[str(key)]):
        remedy_text = "must be an array of texts in quotes"
    else:
        remedy_text = (
            f"must be {_REQUIREMENT_BY_ERROR_TYPE.get(error_detail['type'], error_detail['msg'])}"
        )
    return f"{value_statement} {remedy_text}."


def _unit_text(profile_key: str, preceding_text: str = "") -> str:
    """Return a profile key's unit after `preceding_text` and a space, or "" if it has no unit."""
    unit = _AXIS_UNITS_BY_KEY.get(profile_key) or unit_of(profile_key)
    return f"{preceding_text} {unit}" if unit else ""


def _shown_value(profile_value: object) -> str:
    """Return a value as printable text for a message, shortened if necessary."""
    if profile_value is None:
        return "nothing"
    if isinstance(profile_value, str):
        return f'"{printable(profile_value, _MAX_SHOWN_CHARACTERS)}"'
    if isinstance(profile_value, bool):
        return str(profile_value).lower()
    if isinstance(profile_value, tuple | list):
        shown_items = [_shown_value(list_item) for list_item in profile_value[:_MAX_SHOWN_ITEMS]]
        return f"[{', '.join(shown_items)}{', …' if len(profile_value) > _MAX_SHOWN_ITEMS else ''}]"
    return printable(
        f"{profile_value:g}" if isinstance(profile_value, float) else str(profile_value),
        _MAX_SHOWN_CHARACTERS,
    )


def _quoted_choice(choices: tuple[str, ...]) -> str:
    """Return the words in quotes, joined by "or"."""
    return " or ".join(f'"{choice}"' for choice in choices)


# Devices and their wiring


def wiring_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for contradictions in the settings of the devices and their wiring."""
    section_messages = list(_section_problems(profile_values))
    yield from section_messages
    if section_messages:
        return
    if "acquisition.mode" in profile_values:
        yield from _acquisition_contradictions(profile_values)
    for kind in _selected_kinds(profile_values):
        if kind.contradictions is not None:
            with plugin_errors(DEVICES.owner(kind.name)):
                yield from kind.contradictions(profile_values)
    controller = _selected_controller(profile_values)
    if controller is not None and controller.contradictions is not None:
        with plugin_errors(CONTROLLERS.owner(controller.name)):
            yield from controller.contradictions(profile_values)
    yield from _delay_contradictions(profile_values)


def _section_problems(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for profile sections that the selected devices lack or do not use."""
    drive_name, sensor_name = profile_values["devices.drive"], profile_values["devices.sensor"]
    controller_name = profile_values["control.controller"]
    controller = _selected_controller(profile_values)
    if controller is None:
        yield (
            f'control.controller = "{controller_name}" is not known; choose '
            f"{_quoted_choice(tuple(CONTROLLERS.names()))}."
        )
    controller_sections = () if controller is None else controller.required_sections
    required_sections = {
        section_name
        for kind in _selected_kinds(profile_values)
        for section_name in kind.required_sections
    }
    used_sections = {
        section_name
        for section_name in optional_sections()
        if any(key in profile_values for key, _ in section_fields(section_name))
    }
    for section_name in controller_sections:
        if section_name not in used_sections:
            yield (
                f"section [{section_name}] is missing, which control.controller = "
                f'"{controller_name}" needs.'
            )
    for section_name in sorted(required_sections - used_sections):
        yield (
            f'section [{section_name}] is missing, which devices.drive = "{drive_name}" with '
            f'devices.sensor = "{sensor_name}" needs.'
        )
    # Any profile may have the noise and offset of a simulated rig.
    unneeded_sections = used_sections - required_sections - {"simulation", *controller_sections}
    for section_name in sorted(unneeded_sections):
        yield (
            f'section [{section_name}] belongs to none of devices.drive = "{drive_name}" and '
            f'devices.sensor = "{sensor_name}"; remove it.'
        )


def _selected_kinds(profile_values: Mapping[str, Any]) -> tuple[DeviceKind, ...]:
    """Return the known kinds of device that a profile names."""
    return selected_kinds(
        DeviceSelection(profile_values["devices.drive"], profile_values["devices.sensor"])
    )


def _selected_controller(profile_values: Mapping[str, Any]) -> ControllerKind | None:
    """Return the kind of controller that a profile names, or None if it is not known."""
    return CONTROLLERS.get(profile_values["control.controller"])


def _acquisition_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield a message if the deadline of the replies is longer than a period."""
    period_us = 1e6 / profile_values["rig.rate_hz"]
    deadline_us = profile_values["acquisition.deadline_us"]
    if deadline_us >= period_us:
        yield (
            f"acquisition.deadline_us = {deadline_us:g} µs is not below the period of "
            f"{period_us:g} µs; choose a half of it or less."
        )


def _delay_contradictions(profile_values: Mapping[str, Any]) -> Iterator[str]:
    """Yield messages for delays that are shorter than their protocol allows."""
    period_s = 1 / profile_values["rig.rate_hz"]
    min_reading_delay_s = (
        period_s if profile_values.get("acquisition.mode") == "previous_tick" else 0.0
    )
    min_torque_delay_s = (
        period_s if profile_values.get("cia402.torque_delivery") == "at_sync" else 0.0
    )
    delay_causes = (
        ("encoder.delay_s", min_reading_delay_s, "the reply of the previous tick"),
        ("sensor.delay_s", min_reading_delay_s, "the reply of the previous tick"),
        ("actuation.delay_s", min_torque_delay_s, "a torque that takes effect at the next SYNC"),
    )
    for key, min_delay_s, delay_cause in delay_causes:
        if profile_values[key] < min_delay_s - _MAX_DELAY_ROUNDING_S:
            yield (
                f"{key} = {profile_values[key]:g} s is less than {delay_cause} alone: at least "
                f"{min_delay_s:.6g} s."
            )
