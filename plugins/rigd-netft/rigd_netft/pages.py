"""The box's web page: its settings, how they are read, set and checked."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import prod
from typing import Final, get_args
from urllib.parse import urlencode

from rigd.devices.contracts import DeviceError
from rigd_netft import protocol
from rigd_netft.settings import NetFtSettings

PAGE, COMMUNICATION, SETTING = "/netftapi2.xml", "/comm.cgi", "/setting.cgi"
"""Paths on the box: its settings, and the forms by which two groups of them are set."""
_TAG: Final = re.compile(r"<(\w{1,32})>([^<]{0,400})</\1>")
"""Pattern of a setting on the page."""
_IDENTITY: Final = {
    "serial_number": "cfgcalsn", "firmware": "mfgdigver", "calibration": "cfgcalsel",
    "bias_counts": "setbias", "tool_transform": "cfgtfx", "mac_address": "nethwaddr",
    "unit_of_force": "scfgfu", "unit_of_torque": "scfgtu",
}  # fmt: skip
"""Settings that the session file states, with their tags on the page."""


@dataclass(frozen=True, slots=True)
class BoxSettings:
    """Settings of a box that bear on its records."""

    scales: tuple[float, ...]
    """N or N·m per count of each axis."""
    kind: protocol.BoxKind = protocol.NETFT
    """Kind of box."""
    counter_hz: float = protocol.INTERNAL_HZ
    """Rate in Hz of the box's own counter."""
    identity: Mapping[str, object] = field(default_factory=dict)
    """Identity and settings that the box reported, for the session file."""


def configure(settings: NetFtSettings, get: Callable[[str], str]) -> BoxSettings:
    """Set rate, filter and bias where they differ from the profile, and read all back.

    `get` returns the answer to a request for a path, or raises OSError without one.

    Raises
    ------
    DeviceError
        If the page does not answer, or a value does not suit the profile.
    """
    if settings.counts_per_n > 0:
        scales = (1 / settings.counts_per_n,) * 3 + (1 / settings.counts_per_nm,) * 3
        assumed = {"assumed": "counts, N and N·m, rate and filter of netft"}
        return BoxSettings(scales, identity=assumed)
    communication = {
        "comrdte": "Enabled", "comrdtrate": f"{settings.rate_hz:g}", "comrdtbsiz": "1"
    }  # fmt: skip
    setting = {"setuserfilter": str(get_args(protocol.CutOffHz).index(settings.filter_hz))}
    if settings.bias == "zero":
        setting |= {f"setbias{axis}": "0" for axis in range(6)}
    try:
        tags = _tags(get(PAGE))
        for form, values in ((COMMUNICATION, communication), (SETTING, setting)):
            if not all(_agrees(tags, *each) for each in values.items()):
                # All in one request: a box drops some of several. The form has 1 for Enabled.
                get(f"{form}?{urlencode(values).replace('Enabled', '1')}")
        tags = _tags(get(PAGE))
    except OSError as error:
        raise DeviceError(
            f"{settings.box_name}: its web page http://{settings.host}:{settings.http_port}{PAGE} "
            f"does not answer ({error}). Check address and cable; for a box without a page, state "
            "netft.counts_per_n and netft.counts_per_nm."
        ) from error
    try:
        for tag, value in (communication | setting).items():
            _require(_agrees(tags, tag, value), tags, tag, f"{value} was set; set it on the page")
        _require(
            _agrees(tags, "cfgtfx", ";".join(map(str, settings.tool_transform))), tags, "cfgtfx",
            f"netft.tool_transform is {settings.tool_transform}; correct the one or the other",
        )  # fmt: skip
        _require(
            settings.serial_number in ("", tags.get("cfgcalsn")), tags, "cfgcalsn",
            f"netft.serial_number is {settings.serial_number}; connect the sensor of the profile, "
            "or correct the profile",
        )  # fmt: skip
        return _box_settings(tags)
    except ValueError as error:
        raise DeviceError(f"{settings.box_name}: its setting {error}.") from error


def _tags(page: str) -> dict[str, str]:
    """Return the settings on a page by their tags; the bias also by axis, as in the form."""
    tags = {tag: value.strip() for tag, value in _TAG.findall(page)}
    offsets = tags.get("setbias", "").split(";")
    return tags | {f"setbias{axis}": counts for axis, counts in enumerate(offsets) if counts}


def _box_settings(tags: Mapping[str, str]) -> BoxSettings:
    """Return scales, kind and identity from the settings on the page."""
    counts, scales = list[float](), list[float]()
    for tag, unit_tags, units in (
        ("cfgcpf", ("scfgfu", "cfgfu"), protocol.NEWTONS),
        ("cfgcpt", ("scfgtu", "cfgtu"), protocol.NEWTON_METRES),
    ):
        unit_tag = next((each for each in unit_tags if each in tags), unit_tags[0])
        unit = protocol.unit_key(tags.get(unit_tag, ""))
        _require(unit in units, tags, unit_tag, "unknown unit; choose another")
        per_unit = _numbers(tags.get(tag, ""))
        positive = len(per_unit) == 1 and per_unit[0] > 0
        _require(positive, tags, tag, "no number above 0; check the box")
        counts += 3 * per_unit
        scales += 3 * [units[unit] / per_unit[0]]
    identity: dict[str, object] = {name: tags.get(tag, "") for name, tag in _IDENTITY.items()}
    ratings = _numbers(tags.get("cfgmr", ""))
    if len(ratings) == 6:
        identity["range"] = list(map(prod, zip(ratings, counts, scales, strict=True)))
    counter_hz = max(0.0, *_numbers(tags.get("runrate", "0"))) or protocol.INTERNAL_HZ
    is_axia = (
        "axia" in tags.get("prodname", "").lower() or "setadcrate" in tags or "setrate" in tags
    )
    kind = protocol.AXIA if is_axia else protocol.NETFT
    return BoxSettings(tuple(scales), kind, counter_hz, identity)


def _require(suits: bool, tags: Mapping[str, str], tag: str, reason: str) -> None:
    """Raise ValueError for a setting that does not suit."""
    if not suits:
        raise ValueError(f'{tag} is "{tags.get(tag, "")}", but {reason}')


def _agrees(tags: Mapping[str, str], tag: str, wanted: str) -> bool:
    """Return whether a setting has the wanted value; an absent one is not compared."""
    found = tags.get(tag, wanted)
    return found.lower() == wanted.lower() or _numbers(found) == _numbers(wanted) != []


def _numbers(text: str) -> list[float]:
    """Return the numbers of a setting, separated by semicolons; none if one is not a number."""
    try:
        return [float(part) for part in text.split(";")]
    except ValueError:
        return []
