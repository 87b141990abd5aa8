"""Reading of beam and clamp from a TOML file, such as the profile of a rig."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from analysis.exchange._source import ExchangeError
from analysis.record_checks import (
    MAX_AXIS_TILT_DEG,
    MAX_TIP_MASS_KG,
    MAX_UNCERTAINTY_PERCENT,
    MAX_UNIFORMITY_PERCENT,
    UNCERTAIN_QUANTITIES,
)
from rigd.beam import Beam
from rigd.documents import DocumentError, parse_toml, read_text
from rigd.units import finite_number, unit_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


_USED_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    "rig": ("axis_tilt_deg",),
    "beam": ("length_m", "density_kg_per_m", "bending_stiffness_n_m2", "tip_mass_kg"),
    "sensor": ("tool_inertia_kg_m2",),
    "uncertainty": (
        *(f"{quantity}_percent" for quantity in UNCERTAIN_QUANTITIES),
        "uniformity_percent",
    ),
}
"""Keys that are read, by section."""
_UNUSED_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    "rig": ("rate_hz",),
    "beam": ("damping",),
    "sensor": (
        "resolution",
        "range",
        "projection",
        "delay_s",
        "filter_hz",
        "filter_order",
        "shear_projection",
    ),
}
"""Other keys that a profile has in these sections."""
_UNUSED_SECTIONS: Final = (
    "motor", "encoder", "actuation", "control", "limits", "session", "realtime", "metadata",
    "devices", "can", "acquisition", "cia402", "ati_can", "ati_serial", "simulation",
)  # fmt: skip
"""Other sections of a profile. The parts of installed packages may have further ones."""


_LEAST_BEAM_NUMBER: Final = 1e-9
"""Least length, density and stiffness of a beam in their units; the inverse is the largest."""


@dataclass(frozen=True, slots=True)
class SpecimenFile:
    """Beam, clamp and uncertainties of an imported record's specimen, as a file states them.

    Attributes
    ----------
    beam : Beam
        Beam of the specimen.
    tool_inertia_kg_m2 : float
        Inertia about the motor's axis of the parts between torque sensor and beam.
    uncertainty_percent : mapping of str to float
        Stated relative standard uncertainties of the `UNCERTAIN_QUANTITIES`.
    uniformity_percent : float or None
        Relative standard deviation of mode frequencies from those of a uniform beam; None if not
        stated.
    tip_mass_kg : float or None
        Point mass at the beam's tip; None if not stated.
    axis_tilt_deg : float or None
        Angle between the plane in which the beam moves and the horizontal, measured along the beam
        at rest, positive if the beam points downhill; None if not stated.
    """

    beam: Beam
    tool_inertia_kg_m2: float = 0.0
    uncertainty_percent: Mapping[str, float] = field(default_factory=dict)
    uniformity_percent: float | None = None
    tip_mass_kg: float | None = None
    axis_tilt_deg: float | None = None


def read_specimen(path: Path) -> SpecimenFile:
    """Read beam, tool inertia, tilt and uncertainties of a specimen from a TOML file.

    Only ``[beam]`` is required. A number is given alone or, as in a profile, with its origin:
    ``{ value = 0.98, source = "measured" }``. Other entries of a profile are not used, because they
    describe the rig's own recorder and not the one of the imported record. Entries that no profile
    has are refused, because they may be misspelt.

    Raises
    ------
    ExchangeError
        If the file cannot be read, or a number of the beam is missing or not positive.

    Examples
    --------
    >>> from pathlib import Path
    >>> from analysis.exchange import read_specimen
    >>> read_specimen(Path("rig.toml")).beam.length_m
    0.98
    """
    try:
        file_content = parse_toml(read_text(path))
    except DocumentError as error:
        raise ExchangeError(f"{path}: {error}.") from error
    rig_section, beam_section, sensor_section, uncertainty_section = (
        _read_section(path, file_content, section_name)
        for section_name in ("rig", "beam", "sensor", "uncertainty")
    )
    _check_keys(path, file_content)
    read_percent = partial(
        _number_in_range, path, "uncertainty", uncertainty_section, min_value=0.0
    )
    tool_inertia_kg_m2 = 0.0
    if "tool_inertia_kg_m2" in sensor_section:
        tool_inertia_kg_m2 = _required_number(path, "sensor", sensor_section, "tool_inertia_kg_m2")
        if tool_inertia_kg_m2 < 0.0:
            raise ExchangeError(
                f"{path}: sensor.tool_inertia_kg_m2 is {tool_inertia_kg_m2:g} kg·m², but an "
                "inertia cannot be negative."
            )
    return SpecimenFile(
        Beam(
            length_m=_positive_number(path, beam_section, "length_m"),
            density_kg_per_m=_positive_number(path, beam_section, "density_kg_per_m"),
            bending_stiffness_n_m2=_positive_number(path, beam_section, "bending_stiffness_n_m2"),
        ),
        tool_inertia_kg_m2,
        {
            quantity: percent_value
            for quantity in UNCERTAIN_QUANTITIES
            if (
                percent_value := read_percent(
                    f"{quantity}_percent", max_value=MAX_UNCERTAINTY_PERCENT
                )
            )
            is not None
        },
        read_percent("uniformity_percent", max_value=MAX_UNIFORMITY_PERCENT),
        _number_in_range(
            path, "beam", beam_section, "tip_mass_kg", min_value=0.0, max_value=MAX_TIP_MASS_KG
        ),
        _number_in_range(
            path,
            "rig",
            rig_section,
            "axis_tilt_deg",
            min_value=-MAX_AXIS_TILT_DEG,
            max_value=MAX_AXIS_TILT_DEG,
        ),
    )


def _read_section(path: Path, content: Mapping[str, Any], section_name: str) -> Mapping[str, Any]:
    """Return a section of the file, empty if it is absent; raise if the entry is no section."""
    section = content.get(section_name, {})
    if not isinstance(section, dict):
        raise ExchangeError(
            f"{path}: {section_name} is not a section; write [{section_name}] with its keys below."
        )
    return section


def _check_keys(path: Path, content: Mapping[str, Any]) -> None:
    """Raise if the file has a section, or a key in one of the used sections, that is unknown."""
    for name, entry in content.items():
        if name in _USED_KEYS:
            for key in entry:
                if key not in (*_USED_KEYS[name], *_UNUSED_KEYS.get(name, ())):
                    raise ExchangeError(f"{path}: {name}.{key} is unknown; {_remedy(name, key)}.")
        elif not isinstance(entry, dict):
            if isinstance(entry, int | float):
                raise ExchangeError(
                    f"{path}: {name} is in no section; write it below one of the sections "
                    f"{', '.join(f'[{section}]' for section in _USED_KEYS)}."
                )
        elif name not in _UNUSED_SECTIONS:
            similar_names = difflib.get_close_matches(name.lower(), _USED_KEYS, 1, 0.75)
            # A profile, which selects devices, may have sections of installed packages.
            if similar_names or "devices" not in content:
                raise ExchangeError(
                    f"{path}: the section [{name}] is unknown; "
                    + (
                        f"write [{similar_names[0]}]."
                        if similar_names
                        else f"remove it, as only "
                        f"{', '.join(f'[{section}]' for section in _USED_KEYS)} are used."
                    )
                )


def _remedy(section_name: str, unknown_key: str) -> str:
    """Return what to do about an unknown key: another section, another spelling, or removal."""
    for other_section, keys in _USED_KEYS.items():
        if unknown_key in keys:
            return f"write it in section [{other_section}]"
    similar_keys = difflib.get_close_matches(unknown_key, _USED_KEYS[section_name], 1)
    if similar_keys:
        return f"write {similar_keys[0]}, in {unit_of(similar_keys[0])}"
    return f"remove it, as [{section_name}] has {', '.join(_USED_KEYS[section_name])}"


def _positive_number(path: Path, section: Mapping[str, Any], key: str) -> float:
    """Return a positive number of the beam; raise if it is missing, or not positive and usual."""
    number = _required_number(path, "beam", section, key)
    if not number > 0.0:
        raise ExchangeError(
            f"{path}: beam.{key} is {number:g} {unit_of(key)}, but must be positive."
        )
    if not _LEAST_BEAM_NUMBER <= number <= 1 / _LEAST_BEAM_NUMBER:
        raise ExchangeError(
            f"{path}: beam.{key} is {number:g} {unit_of(key)}, but must lie between "
            f"{_LEAST_BEAM_NUMBER:g} and {1 / _LEAST_BEAM_NUMBER:g}."
        )
    return number


def _number_in_range(
    path: Path,
    section_name: str,
    section: Mapping[str, Any],
    key: str,
    *,
    min_value: float,
    max_value: float,
) -> float | None:
    """Return an optional number of a section, or None if absent; raise if it is out of range."""
    if key not in section:
        return None
    number = _required_number(path, section_name, section, key)
    if not min_value <= number <= max_value:
        raise ExchangeError(
            f"{path}: {section_name}.{key} is {number:g} {unit_of(key)}, but must lie between "
            f"{min_value:g} and {max_value:g}."
        )
    return number


def _required_number(path: Path, section_name: str, section: Mapping[str, Any], key: str) -> float:
    """Return a required number of a section; raise ExchangeError if it is missing or not finite.

    The entry is the number, or a table with the key ``value`` for it, as in a profile.
    """
    section_value, unit_text = section.get(key), unit_of(key)
    if isinstance(section_value, dict):
        other_parts = sorted(section_value.keys() - {"value", "source"})
        if other_parts:
            raise ExchangeError(
                f"{path}: {section_name}.{key} has the unknown part '{other_parts[0]}'; state the "
                f"value in {unit_text}, with value and source only."
            )
        section_value = section_value.get("value")
    if section_value is None:
        raise ExchangeError(
            f"{path}: has no {section_name}.{key}; state it in {unit_text} in section "
            f"[{section_name}]."
        )
    number = finite_number(section_value)
    if number is None:
        raise ExchangeError(
            f"{path}: {section_name}.{key} is {section_value!r}, but must be a number in "
            f"{unit_text}."
        )
    return number
