"""Loader of profiles: reads a TOML file and validates it into frozen dataclasses.

Every number has the form ``{ value = 2.0e-3, source = "assumed" }``, with its unit in the key, so
that assumed and measured numbers are distinguishable. The dataclasses declare the ranges with
``annotated_types``; this module enforces them. All problems of a file are reported at once.

An unknown number has the form ``{ source = "unknown" }``, without a value.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from rigd import documents
from rigd.control import SHIPPED_CONTROLLER
from rigd.control.kinds import CONTROLLERS
from rigd.devices import MAY_BE_UNKNOWN
from rigd.devices.kinds import DEVICES
from rigd.devices.parameters import RigParameters
from rigd.documents import DocumentError
from rigd.errors import UserError
from rigd.plugins import PluginError
from rigd.profile import _diagnostics as diagnostics
from rigd.profile._locations import profile_files
from rigd.profile._schema import (
    NUMBER_SOURCES,
    SECTIONS,
    UNKNOWN_SOURCE,
    Profile,
    add_section,
    is_number_type,
    key_defaults,
    key_types,
    optional_sections,
    section_fields,
)


class ProfileError(UserError, ValueError):
    """Error of an unusable profile or specimen file; the message has a line for each problem."""


def load_profile(name_or_path: str | Path) -> Profile:
    """Read and validate the profile of a rig.

    Parameters
    ----------
    name_or_path
        Path of a file, or file name without ``.toml``. The name is searched in ``hw_profiles`` of
        the working folder, then in the user's own folder (``$XDG_CONFIG_HOME/rigd/profiles``), then
        among the shipped profiles.

    Returns
    -------
    Profile
        Validated profile.

    Raises
    ------
    ProfileError
        If there is no such file, or it has mistakes. Every problem is reported with its key, value,
        unit and remedy.

    Examples
    --------
    >>> from rigd.profile import load_profile
    >>> rig = load_profile("sim").rig
    >>> rig.rate_hz, rig.beam.length_m
    (1000.0, 0.98)
    """
    profile_path = _find_profile(name_or_path)
    return profile_from_text(read_text(profile_path), profile_path)


def read_text(path: Path) -> str:
    """Return the text of a profile or specimen file.

    Raise `ProfileError` if the file cannot be read, or is not text.
    """
    try:
        return documents.read_text(path)
    except DocumentError as error:
        raise ProfileError(f"{path}: {error}.") from error


def profile_from_text(profile_text: str, profile_path: Path) -> Profile:
    """Validate a profile's text and return the profile; the file `profile_path` need not exist.

    Raise `ProfileError` if the text has mistakes.
    """
    document = parse_document(profile_text, profile_path)
    added_section_names = _add_sections_of_devices(document, profile_path)
    _add_section_of_controller(document, profile_path)
    problem_messages: list[str] = []
    profile_values, source_by_key = flatten_document(document, problem_messages)
    absent_section_names = {
        section_name
        for section_name in optional_sections()
        if not any(k.startswith(section_name + ".") for k in profile_values)
        and not (section_name in document and _has_defaults_only(section_name))
    }
    unknown_keys = frozenset(
        key for key, number_source in source_by_key.items() if number_source == UNKNOWN_SOURCE
    )
    profile_values = validate_values(
        profile_values, problem_messages, frozenset(absent_section_names), unknown_keys
    )
    if not problem_messages:
        problem_messages.extend(_resolve_eds_path(profile_path, profile_values))
        problem_messages.extend(diagnostics.contradictions(profile_values))
        problem_messages.extend(diagnostics.wiring_contradictions(profile_values))
    if problem_messages:
        raise problems_error(profile_path, problem_messages)

    section_by_name = {
        section_name: _build_section(section_name, profile_values)
        for section_name in SECTIONS
        if section_name not in absent_section_names
    }
    return Profile(
        name=profile_values["name"],
        description=profile_values["description"],
        path=profile_path,
        text=profile_text,
        rig=RigParameters(
            rate_hz=section_by_name["rig"].rate_hz,
            beam=section_by_name["beam"].uniform_beam,
            damping=section_by_name["beam.damping"],
            motor=section_by_name["motor"],
            encoder=section_by_name["encoder"],
            sensor=section_by_name["sensor"],
            actuation=section_by_name["actuation"],
            devices=section_by_name["devices"],
            simulation=section_by_name.get("simulation"),
            name=profile_values["name"],
            can=section_by_name.get("can"),
            acquisition=section_by_name.get("acquisition"),
            cia402=section_by_name.get("cia402"),
            ati_can=section_by_name.get("ati_can"),
            ati_serial=section_by_name.get("ati_serial"),
            added_settings=tuple(
                section_by_name[name] for name in added_section_names if name in section_by_name
            ),
        ),
        control=section_by_name["control"],
        limits=section_by_name["limits"],
        session=section_by_name["session"],
        realtime=section_by_name["realtime"],
        metadata=section_by_name["metadata"],
        uncertainty=section_by_name["uncertainty"],
        sources=source_by_key,
        tip_mass_kg=section_by_name["beam"].tip_mass_kg,
        axis_tilt_deg=section_by_name["rig"].axis_tilt_deg,
        controller_settings=_controller_settings(section_by_name),
    )


def _has_defaults_only(section_name: str) -> bool:
    """Return whether every key of a section may be omitted."""
    return all(key in key_defaults() for key, _ in section_fields(section_name))


def _controller_settings(section_by_name: Mapping[str, Any]) -> object | None:
    """Return the section of the controller that a package adds, or None if it has none."""
    controller_name = section_by_name["control"].controller
    return None if controller_name == SHIPPED_CONTROLLER else section_by_name.get(controller_name)


def _add_sections_of_devices(document: Mapping[str, Any], profile_path: Path) -> list[str]:
    """Register the profile sections that devices of installed packages need; return their names.

    Raise `ProfileError` if a package that adds a device of the profile cannot be used.
    """
    device_selection = document.get("devices")
    device_names = device_selection.values() if isinstance(device_selection, dict) else ()
    added_section_names = []
    for device_name in dict.fromkeys(filter(lambda value: isinstance(value, str), device_names)):
        try:
            plugin, kind = DEVICES.owner(device_name), DEVICES.get(device_name)
            if plugin is not None and kind is not None:
                add_section(kind, plugin)
                if kind.settings is not None:
                    added_section_names.append(kind.name)
        except PluginError as error:
            raise ProfileError(f'{profile_path}: devices: "{device_name}": {error}') from error
    return added_section_names


def _add_section_of_controller(document: Mapping[str, Any], profile_path: Path) -> None:
    """Register the profile section that the controller of an installed package needs.

    Raise `ProfileError` if the package that adds the controller of the profile cannot be used.
    """
    control_section = document.get("control")
    controller_name = (
        control_section.get("controller") if isinstance(control_section, dict) else None
    )
    if not isinstance(controller_name, str) or controller_name == SHIPPED_CONTROLLER:
        return
    try:
        owner_plugin = CONTROLLERS.owner(controller_name)
        if owner_plugin is not None:
            add_section(CONTROLLERS.load(owner_plugin), owner_plugin)
    except PluginError as error:
        raise ProfileError(
            f'{profile_path}: control.controller = "{controller_name}": {error}'
        ) from error


def parse_document(toml_text: str, path: Path) -> dict[str, Any]:
    """Return the TOML document in the text of a file.

    Raise `ProfileError` if the text is not valid TOML.
    """
    try:
        return documents.parse_toml(toml_text)
    except DocumentError as error:
        raise ProfileError(f"{path}: {error}.") from error


def problems_error(path: Path, problem_messages: Iterable[str]) -> ProfileError:
    """Return the error to raise for a file, with a line for each problem."""
    # An array that is too short has an equal problem for each missing number.
    return ProfileError(
        "\n".join(f"{path}: {problem}" for problem in dict.fromkeys(problem_messages))
    )


def _find_profile(name_or_path: str | Path) -> Path:
    """Return the path of a profile, or raise ProfileError if there is none."""
    if not str(name_or_path):
        raise ProfileError(f"No profile is named; {_known_profiles_text()}, or give a .toml file.")
    given_path = Path(name_or_path)
    if given_path.suffix == ".toml" or given_path.parent != Path():
        if given_path.is_file():
            return given_path
        raise ProfileError(f"{given_path}: there is no such file; {_known_profiles_text()}.")
    profile_files_by_name = profile_files()
    if str(given_path) in profile_files_by_name:
        return profile_files_by_name[str(given_path)][0].path
    raise ProfileError(
        f"There is no profile '{given_path}'; {_known_profiles_text()}. Make one of that name by "
        f"'rigd profiles copy sim {given_path}', or give the path of a .toml file."
    )


def known_profiles() -> list[str]:
    """Return the names of all profiles: in the working folder, the user's folder, and shipped."""
    return list(profile_files())


def _known_profiles_text() -> str:
    """Return the names of all known profiles as a clause for messages."""
    profile_names = known_profiles()
    return (
        "known profiles are " + ", ".join(profile_names)
        if profile_names
        else "no profiles are known here"
    )


def _resolve_eds_path(profile_path: Path, values_by_key: dict[str, Any]) -> Iterator[str]:
    """Make the drive's EDS path in the values absolute; yield a message if there is no file."""
    eds_name = values_by_key.get("cia402.eds")
    if not eds_name:
        return
    eds_path = profile_path.resolve().parent / eds_name
    values_by_key["cia402.eds"] = str(eds_path)
    if not eds_path.is_file():
        yield (
            f'cia402.eds = "{eds_name}": there is no file {eds_path}; give its path, relative to '
            "the profile's folder, or remove the key."
        )


def flatten_document(
    document: Mapping[str, Any], problem_messages: list[str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return a profile's values, and the origins of its numbers, each by dotted keys.

    An origin is what the key ``source`` of a number states. A message for each missing or invalid
    one is appended to `problem_messages`.
    """
    values_by_key: dict[str, Any] = {}
    source_by_key: dict[str, str] = {}
    for key, entry in _dotted_entries(document, ""):
        if not isinstance(entry, dict):
            values_by_key[key] = entry
            if _is_number_key(key):
                problem_messages.append(diagnostics.number_without_source_message(key, entry))
            continue
        number_source = entry.get("source")
        if number_source == UNKNOWN_SOURCE and key in MAY_BE_UNKNOWN and "value" not in entry:
            source_by_key[key] = number_source
            values_by_key[key] = math.nan
            continue
        values_by_key[key] = entry.get("value")
        if number_source == UNKNOWN_SOURCE:
            problem_messages.append(diagnostics.invalid_unknown_source_message(key, entry))
        elif number_source in NUMBER_SOURCES:
            source_by_key[key] = number_source
        elif _is_number_key(key):
            problem_messages.append(diagnostics.missing_source_message(key, number_source))
        problem_messages.extend(
            f"{key} has the unknown part '{other_keys}'; only value and source go there."
            for other_keys in sorted(entry.keys() - {"value", "source"})
        )
    return values_by_key, source_by_key


def _is_number_key(profile_key: str) -> bool:
    """Return whether the value of a key is a number or six numbers; False for unknown keys."""
    return profile_key in key_types() and is_number_type(key_types()[profile_key])


def _dotted_entries(toml_table: Mapping[str, Any], key_prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys of a document with their entries.

    A table that is not a section and has ``value`` or ``source`` is the entry of a number.
    """
    for key, entry in toml_table.items():
        dotted_key = key_prefix + key
        if isinstance(entry, dict) and (
            dotted_key in SECTIONS or (entry and not entry.keys() & {"value", "source"})
        ):
            yield from _dotted_entries(entry, dotted_key + ".")
        else:
            yield dotted_key, entry


def validate_values(
    values_by_key: Mapping[str, Any],
    problem_messages: list[str],
    absent_section_names: frozenset[str],
    unknown_keys: frozenset[str] = frozenset(),
) -> dict[str, Any]:
    """Check types and ranges of all values, and return them with defaults for missing keys.

    Keys are dotted; the NaN of an unknown key is not checked. A message for each problem is
    appended to `problem_messages`. `absent_section_names` are those that the file omits; the top
    level has the empty name.
    """
    # TOML has only arrays, and strict validation requires tuples.
    values_with_tuples = {
        k: tuple(v) if isinstance(v, list) else v for k, v in values_by_key.items()
    }
    try:
        known_values = {
            key: key_value
            for key, key_value in values_with_tuples.items()
            if key not in unknown_keys
        }
        validation_model = _validation_model(
            tuple(SECTIONS), absent_section_names, unknown_keys
        ).model_validate(known_values)
    except ValidationError as error:
        error_details = error.errors(include_url=False)
        missing_keys = [
            str(d["loc"][0]) for d in error_details if d["type"] == "missing" and not d["loc"][1:]
        ]
        problem_messages.extend(diagnostics.missing_key_messages(missing_keys, values_with_tuples))
        for error_detail in error_details:
            if error_detail["type"] == "extra_forbidden":
                problem_messages.append(
                    diagnostics.unknown_key_message(str(error_detail["loc"][0]), values_with_tuples)
                )
            elif str(error_detail["loc"][0]) not in missing_keys:
                problem_messages.append(diagnostics.wrong_value_message(error_detail))
        return values_with_tuples
    validated_values: dict[str, Any] = validation_model.model_dump(by_alias=True)
    problem_messages.extend(diagnostics.implausible_number_messages(validated_values))
    return validated_values | dict.fromkeys(unknown_keys, math.nan)


@cache
def _validation_model(
    section_names: tuple[str, ...],  # noqa: ARG001 - installed packages can add some
    absent_section_names: frozenset[str],
    unknown_keys: frozenset[str],
) -> type[BaseModel]:
    """Return the pydantic model that validates all keys of a profile at once.

    A model for each section would be slow to build.
    """
    field_definitions: dict[str, Any] = {
        f"key_{key_index}": (value_type, Field(default=key_defaults().get(key, ...), alias=key))
        for key_index, (key, value_type) in enumerate(key_types().items())
        if key.rpartition(".")[0] not in absent_section_names and key not in unknown_keys
    }
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    return create_model("Profile", __config__=model_config, **field_definitions)


def _build_section(section_name: str, values_by_key: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return the dataclass of a section with its validated values."""
    return SECTIONS[section_name](
        **{field_name: values_by_key[key] for key, field_name in section_fields(section_name)}
    )
