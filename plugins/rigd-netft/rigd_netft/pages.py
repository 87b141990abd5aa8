"""Web page of the box: read, set and check the box's settings."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import prod
from typing import Final, get_args
from urllib.parse import urlencode

from rigd.devices.contracts import DeviceError
from rigd_netft import protocol
from rigd_netft.settings import NetFtSettings

SETTINGS_PATH, COMMUNICATION_FORM, SENSOR_FORM = "/netftapi2.xml", "/comm.cgi", "/setting.cgi"
"""Paths on the box's web server: page of settings, and the forms that set two groups of them."""
_SETTING_PATTERN: Final = re.compile(r"<(\w{1,32})>([^<]{0,400})</\1>")
"""Pattern of a setting on the page: tag and value."""
_IDENTITY_TAGS: Final = {
    "serial_number": "cfgcalsn", "firmware": "mfgdigver", "calibration": "cfgcalsel",
    "bias_counts": "setbias", "tool_transform": "cfgtfx", "mac_address": "nethwaddr",
    "unit_of_force": "scfgfu", "unit_of_torque": "scfgtu",
}  # fmt: skip
"""Tags of the settings that the session file states, by their keys in the file."""


@dataclass(frozen=True, slots=True)
class BoxSettings:
    """Settings of a box that are needed to interpret its records."""

    units_per_count: tuple[float, ...]
    """Force in N or torque in N·m per count, for each axis."""
    kind: protocol.BoxKind = protocol.NETFT
    """Kind of box."""
    counter_hz: float = protocol.COUNTER_HZ
    """Rate in Hz of the box's own counter."""
    identity: Mapping[str, object] = field(default_factory=dict)
    """Identity and settings that the box reported, for the session file."""


def configure(settings: NetFtSettings, get_page: Callable[[str], str]) -> BoxSettings:
    """Set rate, filter and bias of the box as the profile says; read and check all settings.

    `get_page` returns the web server's answer to a request for a path, or raises OSError.

    Raises
    ------
    DeviceError
        If the page does not answer, or a value does not suit the profile.
    """
    if settings.counts_per_n > 0:
        units_per_count = (1 / settings.counts_per_n,) * 3 + (1 / settings.counts_per_nm,) * 3
        assumed_settings = {"assumed": "counts, N and N·m, rate and filter of netft"}
        return BoxSettings(units_per_count, identity=assumed_settings)
    communication_settings = {
        "comrdte": "Enabled", "comrdtrate": f"{settings.rate_hz:g}", "comrdtbsiz": "1"
    }  # fmt: skip
    sensor_settings = {"setuserfilter": str(get_args(protocol.CutOffHz).index(settings.filter_hz))}
    if settings.bias == "zero":
        sensor_settings |= {f"setbias{axis}": "0" for axis in range(6)}
    try:
        tags = _settings_by_tag(get_page(SETTINGS_PATH))
        for form, values in (
            (COMMUNICATION_FORM, communication_settings),
            (SENSOR_FORM, sensor_settings),
        ):
            if not all(_has_value(tags, *name_and_value) for name_and_value in values.items()):
                # All in one request: a box drops some of several. The form has 1 for Enabled.
                get_page(f"{form}?{urlencode(values).replace('Enabled', '1')}")
        tags = _settings_by_tag(get_page(SETTINGS_PATH))
    except OSError as error:
        raise DeviceError(
            f"{settings.box_name}: its web page "
            f"http://{settings.host}:{settings.http_port}{SETTINGS_PATH} does not answer "
            f"({error}). Check address and cable; for a box without a page, state "
            "netft.counts_per_n and netft.counts_per_nm."
        ) from error
    try:
        for tag, value in (communication_settings | sensor_settings).items():
            _require_suitable(
                _has_value(tags, tag, value), tags, tag, f"{value} was set; set it on the page"
            )
        _require_suitable(
            _has_value(tags, "cfgtfx", ";".join(map(str, settings.tool_transform))), tags, "cfgtfx",
            f"netft.tool_transform is {settings.tool_transform}; correct one of them",
        )  # fmt: skip
        _require_suitable(
            settings.serial_number in ("", tags.get("cfgcalsn")), tags, "cfgcalsn",
            f"netft.serial_number is {settings.serial_number}; connect the sensor of the profile, "
            "or correct the profile",
        )  # fmt: skip
        return _box_settings(tags)
    except ValueError as error:
        raise DeviceError(f"{settings.box_name}: its setting {error}.") from error


def _settings_by_tag(page: str) -> dict[str, str]:
    """Return the settings on a page by tag, the bias also as one setting per axis."""
    tags = {tag: value.strip() for tag, value in _SETTING_PATTERN.findall(page)}
    bias_counts = tags.get("setbias", "").split(";")
    return tags | {f"setbias{axis}": counts for axis, counts in enumerate(bias_counts) if counts}


def _box_settings(tags: Mapping[str, str]) -> BoxSettings:
    """Return units per count, kind, counter rate and identity of a box from its settings."""
    counts_per_unit, units_per_count = list[float](), list[float]()
    for tag, unit_tags, units in (
        ("cfgcpf", ("scfgfu", "cfgfu"), protocol.FORCE_UNITS_N),
        ("cfgcpt", ("scfgtu", "cfgtu"), protocol.TORQUE_UNITS_NM),
    ):
        unit_tag = next((each for each in unit_tags if each in tags), unit_tags[0])
        unit = protocol.unit_key(tags.get(unit_tag, ""))
        _require_suitable(unit in units, tags, unit_tag, "unknown unit; choose another")
        counts_of_one_unit = _parse_numbers(tags.get(tag, ""))
        is_positive = len(counts_of_one_unit) == 1 and counts_of_one_unit[0] > 0
        _require_suitable(is_positive, tags, tag, "not a number above 0; check the box")
        counts_per_unit += 3 * counts_of_one_unit
        units_per_count += 3 * [units[unit] / counts_of_one_unit[0]]
    identity: dict[str, object] = {name: tags.get(tag, "") for name, tag in _IDENTITY_TAGS.items()}
    axis_ratings = _parse_numbers(tags.get("cfgmr", ""))
    if len(axis_ratings) == 6:
        identity["range"] = list(
            map(prod, zip(axis_ratings, counts_per_unit, units_per_count, strict=True))
        )
    counter_hz = max(0.0, *_parse_numbers(tags.get("runrate", "0"))) or protocol.COUNTER_HZ
    is_axia = (
        "axia" in tags.get("prodname", "").lower() or "setadcrate" in tags or "setrate" in tags
    )
    kind = protocol.AXIA if is_axia else protocol.NETFT
    return BoxSettings(tuple(units_per_count), kind, counter_hz, identity)


def _require_suitable(is_suitable: bool, tags: Mapping[str, str], tag: str, reason: str) -> None:
    """Raise ValueError with the setting's value and the reason unless the setting is suitable."""
    if not is_suitable:
        raise ValueError(f'{tag} is "{tags.get(tag, "")}", but {reason}')


def _has_value(tags: Mapping[str, str], tag: str, required_value: str) -> bool:
    """Return whether a setting has the wanted_value value, or is not on the page."""
    page_value = tags.get(tag, required_value)
    return (
        page_value.lower() == required_value.lower()
        or _parse_numbers(page_value) == _parse_numbers(required_value) != []
    )


def _parse_numbers(numbers_text: str) -> list[float]:
    """Parse numbers separated by semicolons; return an empty list if any is not a number."""
    try:
        return [float(part) for part in numbers_text.split(";")]
    except ValueError:
        return []
