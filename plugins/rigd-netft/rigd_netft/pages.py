"""The box's web page: its settings, how they are read, set and checked."""

import http.client
import re
from dataclasses import dataclass

from rigd.devices.contracts import DeviceError
from rigd_netft.protocol import CUT_OFFS_HZ, INTERNAL_HZ, NEWTON_METRES, NEWTONS
from rigd_netft.settings import NetFtSettings

PAGE, COMMUNICATION, SETTING = "/netftapi2.xml", "/comm.cgi", "/setting.cgi"
"""Paths on the box: its settings, and the forms by which two groups of them are set."""
_TIMEOUT_S = 2.0
"""Longest time in seconds for a connection, and for each read from it."""
_MAX_PAGE_BYTES = 1 << 16
"""Largest size in bytes of a page that is read."""
_TAG = re.compile(r"<(\w{1,32})>([^<]{0,400})</\1>")
"""Pattern of a setting on the page."""


@dataclass(frozen=True, slots=True)
class BoxSettings:
    """Settings of a box that bear on its records."""

    scales: tuple[float, ...]
    """N or N·m per count of each axis."""
    is_axia: bool = False
    """Whether the device is an Ethernet Axia, whose status bits have other meanings."""
    counter_hz: float = INTERNAL_HZ
    """Rate in Hz of the box's own counter."""
    identity: tuple[tuple[str, object], ...] = ()
    """What the box reported, for the session file."""


class BoxPage:
    """Web page of a box, with error messages that name the box.

    Parameters
    ----------
    settings
        Settings of the profile.
    name
        Name of the box in messages.
    """

    def __init__(self, settings: NetFtSettings, name: str) -> None:
        self._settings, self._name = settings, name

    def configure(self) -> BoxSettings:
        """Set rate, filter and bias where they differ from the profile, and read all back.

        Raises
        ------
        DeviceError
            If the page does not answer, or a value does not suit the profile.
        """
        settings, tags = self._settings, self.read()
        wanted = {"comrdte": "Enabled", "comrdtrate": f"{settings.rate_hz:g}", "comrdtbsiz": "1"}
        if not _agrees(tags, wanted):  # all in one request: a box drops some of several
            self._get(_query(COMMUNICATION, wanted | {"comrdte": "1"}))
        wanted_setting = {"setuserfilter": str(CUT_OFFS_HZ.index(settings.filter_hz))}
        zero_bias = {f"setbias{axis}": "0" for axis in range(6)}
        set_bias = settings.bias == "zero" and any(_numbers(tags.get("setbias", "")))
        if set_bias or not _agrees(tags, wanted_setting):
            self._get(_query(SETTING, wanted_setting | (zero_bias if set_bias else {})))
        tags = self.read()
        for key, value in (wanted | wanted_setting).items():
            if key in tags and not _agrees(tags, {key: value}):
                self._refuse(key, tags[key], f"{value} was set", "set it on the page of the box")
        if settings.bias == "zero" and any(_numbers(tags.get("setbias", ""))):
            self._refuse("setbias", tags["setbias"], "zero was set", "clear it on the page")
        transform = _numbers(tags.get("cfgtfx", ""))
        if transform and tuple(transform) != settings.tool_transform:
            self._refuse(
                "cfgtfx", tags["cfgtfx"], f"netft.tool_transform is {settings.tool_transform}",
                "correct the tool transformation in the box or in the profile",
            )  # fmt: skip
        serial = tags.get("cfgcalsn", "")
        if settings.serial_number and serial != settings.serial_number:
            self._refuse(
                "cfgcalsn", serial, f"netft.serial_number is {settings.serial_number}",
                "connect the sensor of the profile, or correct the profile",
            )  # fmt: skip
        return self._box_settings(tags)

    def read(self) -> dict[str, str]:
        """Return the settings on the page by their tags."""
        tags = dict(_TAG.findall(self._get(PAGE)))
        if not {"cfgcpf", "cfgcpt"} <= tags.keys():
            raise DeviceError(f"{self._name}: its page {PAGE} has no counts per force and torque.")
        return {key: value.strip() for key, value in tags.items()}

    def _box_settings(self, tags: dict[str, str]) -> BoxSettings:
        """Return scales, kind and identity from the settings on the page."""
        scales = []
        for count_tag, unit_tags, units in (
            ("cfgcpf", ("scfgfu", "cfgfu"), NEWTONS),
            ("cfgcpt", ("scfgtu", "cfgtu"), NEWTON_METRES),
        ):
            unit_tag = next((tag for tag in unit_tags if tag in tags), unit_tags[0])
            unit = re.sub(r"[^a-z]", "", tags.get(unit_tag, "").lower())
            if unit not in units:
                self._refuse(unit_tag, tags.get(unit_tag, ""), "unknown unit", "choose another")
            counts = _numbers(tags[count_tag])
            if len(counts) != 1 or not counts[0] > 0:
                self._refuse(count_tag, tags[count_tag], "no number above 0", "check the box")
            scales.append(units[unit] / counts[0])
        per_axis = (scales[0],) * 3 + (scales[1],) * 3
        ratings, counter_hz = _numbers(tags.get("cfgmr", "")), _numbers(tags.get("runrate", ""))
        counts_per_unit = (_numbers(tags["cfgcpf"])[0],) * 3 + (_numbers(tags["cfgcpt"])[0],) * 3
        identity: dict[str, object] = {
            "serial_number": tags.get("cfgcalsn", ""), "firmware": tags.get("mfgdigver", ""),
            "calibration": tags.get("cfgcalsel", ""), "bias_counts": tags.get("setbias", ""),
            "tool_transform": tags.get("cfgtfx", ""), "mac_address": tags.get("nethwaddr", ""),
            "unit_of_force": tags.get("scfgfu", ""), "unit_of_torque": tags.get("scfgtu", ""),
        }  # fmt: skip
        if len(ratings) == 6:
            identity["range"] = [
                rating * counts * scale
                for rating, counts, scale in zip(ratings, counts_per_unit, per_axis, strict=True)
            ]
        is_axia = "axia" in tags.get("prodname", "").lower() or bool(
            {"setadcrate", "setrate"} & tags.keys()
        )
        return BoxSettings(
            per_axis, is_axia, counter_hz[0] if counter_hz and counter_hz[0] > 0 else INTERNAL_HZ,
            tuple(identity.items()),
        )  # fmt: skip

    def _refuse(self, tag: str, found: str, why: str, remedy: str) -> None:
        """Raise the error for a setting that does not suit the profile."""
        raise DeviceError(f'{self._name}: its setting {tag} is "{found}", but {why}; {remedy}.')

    def _get(self, path: str) -> str:
        """Return the answer of the box to a request for a path."""
        settings = self._settings
        connection = http.client.HTTPConnection(settings.host, settings.http_port, _TIMEOUT_S)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            content = answer.read(_MAX_PAGE_BYTES).decode("utf-8", errors="replace")
        except (OSError, http.client.HTTPException) as error:
            raise DeviceError(
                f"{self._name}: its web page http://{settings.host}:{settings.http_port}{path} "
                f"does not answer ({error}). Check address and cable; for a box without a page, "
                "state netft.counts_per_n and netft.counts_per_nm."
            ) from error
        finally:
            connection.close()
        if answer.status not in (200, 302):
            raise DeviceError(f"{self._name}: {path} was answered with HTTP {answer.status}.")
        return content


def _query(path: str, values: dict[str, str]) -> str:
    """Return the path that sets values by a form of the page."""
    return f"{path}?" + "&".join(f"{key}={value}" for key, value in values.items())


def _agrees(tags: dict[str, str], wanted: dict[str, str]) -> bool:
    """Return whether settings on the page have the wanted values; absent ones are not compared."""
    return all(
        tags.get(key, value).lower() == value.lower()
        or (_numbers(tags[key]) == _numbers(value) != [])
        for key, value in wanted.items()
    )


def _numbers(text: str) -> list[float]:
    """Return the numbers of a setting, separated by semicolons; none if one is not a number."""
    try:
        return [float(part) for part in text.split(";")]
    except ValueError:
        return []
