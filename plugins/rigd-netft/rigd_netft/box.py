"""Simulated Net F/T box in the process of its driver: web page, stream, and faults of both."""

import random
from collections.abc import Callable, Mapping, Sequence
from math import inf
from operator import mul
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from rigd.devices.contracts import DeviceError, Wrench, WrenchSensor
from rigd.devices.parameters import RigParameters
from rigd_netft import protocol
from rigd_netft.pages import COMMUNICATION, PAGE, SETTING
from rigd_netft.settings import NetFtSettings

_TAGS: Final = {
    "runstat": "0x00000000", "runrate": "7000", "cfgcpf": "1000000", "cfgcpt": "1000000.0",
    "scfgfu": "N", "scfgtu": "Nm", "cfgcalsn": "FT00001", "cfgcalsel": "0",
    "cfgmr": "20;20;60;1;1;1", "cfgtfx": "0;0;0;0;0;0", "setuserfilter": "0",
    "setbias": "745;17;447;184;-596;-253", "comrdte": "Enabled", "comrdtrate": "7000",
    "comrdtbsiz": "1", "mfgdigver": "2.2.59",
}  # fmt: skip
"""Settings of the box on its page, as it is delivered."""
_LONGEST_PAUSE_S = 0.1
"""Longest time between two ticks for which records are sent."""
_PROBABILITIES, _DURATIONS = ("loss", "duplicate", "reorder", "malformed"), ("burst", "saturate")
"""Faults with a probability, and those with a duration in seconds."""
FAULTS: Final = (
    *_PROBABILITIES, *_DURATIONS, "silence", "restart", "threshold", "status", "no_page",
)  # fmt: skip
"""Names of faults."""


class SimulatedBox:
    """Box that measures a wrench in N and N·m, with one record or more for each tick.

    Tags are settings on the page that differ from those of a delivered box. A fault is ``name``,
    ``name=value`` or ``name=value@seconds`` after the start of the stream.
    """

    def __init__(
        self,
        read_wrench: Callable[[], Wrench],
        tags: Mapping[str, str] | None = None,
        faults: Sequence[str] = (),
    ) -> None:
        self._read_wrench, self.tags, self._forms = read_wrench, {**_TAGS, **(tags or {})}, 0
        self._faults = dict(map(_read_fault, faults))
        self._random = random.Random(1)
        self._streams, self._restarted, self._due_ns = False, False, 0
        self._sequence, self._index = 0, 700
        self._held: list[bytes] = []

    def get(self, path: str) -> str:
        """Return the answer to a request for a path of the page; raise OSError without one."""
        if "no_page" in self._faults:
            raise ConnectionRefusedError("connection refused")
        if path == PAGE:
            text = "".join(f"<{tag}>{value}</{tag}>\n" for tag, value in self.tags.items())
            return f"<netft>\n{text}</netft>\n"
        if (form := urlsplit(path)).path not in (COMMUNICATION, SETTING):
            raise OSError("HTTP status 404")
        self._forms += 1
        if self._forms > 3:  # a box drops some of several forms
            return ""
        values = dict(parse_qsl(form.query))
        if "comrdte" in values:
            values["comrdte"] = "Enabled" if values["comrdte"] == "1" else "Disabled"
        if "comrdtrate" in values:
            values["comrdtrate"] = f"{int(protocol.rate_reached_hz(float(values['comrdtrate'])))}"
        if "setbias0" in values:
            values["setbias"] = ";".join(values.pop(f"setbias{axis}") for axis in range(6))
        self.tags |= {tag: value for tag, value in values.items() if tag in self.tags}
        return ""

    def open(self) -> None:
        """Do nothing: there is no socket."""

    def send(self, request: bytes) -> None:
        """Act on a request from the driver."""
        if request[:4] in (protocol.STOP[:4], protocol.STREAM[:4]):
            self._streams, self._sequence = request[:4] == protocol.STREAM[:4], 0

    def receive(self, due_ns: int) -> tuple[list[bytes], int]:
        """Return the packets since the last tick, and the time, which is that of the tick.

        Before the first tick, at 0 ns, each call is a tick, whose time has no relation to others.
        """
        since_last_s = (due_ns - self._due_ns) / 1e9 if self._due_ns else 1e-3
        self._due_ns = due_ns
        return self.packets(min(since_last_s, _LONGEST_PAUSE_S)), due_ns or 1 << 62

    def packets(self, duration_s: float) -> list[bytes]:
        """Return the packets of a time: one record or more, as the faults have them."""
        if not self._streams or duration_s <= 0:
            return []
        tags, per_axis = self.tags, list[float]()
        for tag, unit_tag, units in (
            ("cfgcpf", "scfgfu", protocol.NEWTONS), ("cfgcpt", "scfgtu", protocol.NEWTON_METRES)
        ):  # fmt: skip
            per_axis += 3 * [float(tags[tag]) / units[protocol.unit_key(tags[unit_tag])]]
        counts = tuple(map(round, map(mul, self._read_wrench(), per_axis)))
        count = max(1, round(duration_s * float(tags["comrdtrate"])))
        return [packet for _ in range(count) for packet in self._sent(self._record(counts))]

    def close(self) -> None:
        """Do nothing: there is no socket."""

    def _at(self, fault: str) -> bool:
        """Return whether a fault acts at the present record."""
        value, from_s = self._faults.get(fault, (0.0, inf))
        elapsed_s = self._sequence / float(self.tags["comrdtrate"]) - from_s
        if fault in _PROBABILITIES:
            return elapsed_s >= 0 and self._random.random() < value
        return 0 <= elapsed_s < (value if fault in _DURATIONS else inf)

    def _record(self, counts: tuple[int, ...]) -> bytes:
        """Return the next record."""
        if self._at("restart") and not self._restarted:
            self._restarted, self._sequence, self._index = True, 0, 0
        self._sequence, self._index = self._sequence + 1, self._index + 1
        status = 0
        for fault, bits in (
            ("saturate", protocol.NETFT.saturated), ("threshold", protocol.THRESHOLD),
            ("status", int(self._faults.get("status", (0, 0))[0])),
        ):  # fmt: skip
            status |= bits | protocol.ANY_ERROR if self._at(fault) else 0
        # By the index and not by the clock, so that a burst has no equal counters.
        counter = round(self._index * protocol.INTERNAL_HZ / float(self.tags["comrdtrate"]))
        return protocol.RECORD.pack(self._sequence, counter & 0xFFFFFFFF, status, *counts)

    def _sent(self, record: bytes) -> list[bytes]:
        """Return the packets that the faults make of a record and of those that were held back."""
        if self._at("silence") or self._at("loss"):
            return []
        if self._at("malformed"):
            record = record[:20]
        packets = [record, record] if self._at("duplicate") else [record]
        if self._at("burst") or (not self._held and self._at("reorder")):
            self._held += packets
            return []
        # A reordered record follows the next one; a burst comes in its own order.
        packets = self._held + packets if len(self._held) > 2 else packets + self._held
        self._held = []
        return packets


def _read_fault(text: str) -> tuple[str, tuple[float, float]]:
    """Return name, value and start in seconds of a fault."""
    name_and_value, _, from_s = text.partition("@")
    name, _, value = name_and_value.partition("=")
    try:
        number = int(value, 0) if value.startswith("0x") else float(value or 0)
        if name in FAULTS:
            return name, (number, float(from_s or 0))
    except ValueError:
        pass
    raise DeviceError(f'netft.faults: "{text}"; faults are {", ".join(FAULTS)}.')


def simulated_box(
    rig: RigParameters, settings: NetFtSettings, plant_sensor: WrenchSensor
) -> SimulatedBox:
    """Create a simulated box that suits the profile and measures a simulated plant."""
    tags = {
        "cfgtfx": ";".join(f"{value:g}" for value in settings.tool_transform),
        "cfgmr": ";".join(f"{value:g}" for value in rig.sensor.range),
        "cfgcalsn": settings.serial_number or _TAGS["cfgcalsn"],
    }
    return SimulatedBox(plant_sensor.read_wrench, tags, settings.faults)
