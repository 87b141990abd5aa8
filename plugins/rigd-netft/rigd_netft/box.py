"""Simulated Net F/T box that runs inside its driver: web page, stream, and faults of both."""

import random
from collections.abc import Callable, Mapping, Sequence
from math import inf
from operator import mul
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from rigd.devices.contracts import DeviceError, Wrench, WrenchSensor
from rigd.devices.parameters import RigParameters
from rigd_netft import protocol
from rigd_netft.pages import COMMUNICATION_FORM, SENSOR_FORM, SETTINGS_PATH
from rigd_netft.settings import NetFtSettings

_DELIVERED_TAGS: Final = {
    "runstat": "0x00000000", "runrate": "7000", "cfgcpf": "1000000", "cfgcpt": "1000000.0",
    "scfgfu": "N", "scfgtu": "Nm", "cfgcalsn": "FT00001", "cfgcalsel": "0",
    "cfgmr": "20;20;60;1;1;1", "cfgtfx": "0;0;0;0;0;0", "setuserfilter": "0",
    "setbias": "745;17;447;184;-596;-253", "comrdte": "Enabled", "comrdtrate": "7000",
    "comrdtbsiz": "1", "mfgdigver": "2.2.59",
}  # fmt: skip
"""Settings on the page of a box as delivered, by tag."""
_MAX_SENT_BACKLOG_S = 0.1
"""Time in seconds up to which the records since the last tick are sent; older ones are dropped."""
_PROBABILITIES, _DURATIONS = ("loss", "duplicate", "reorder", "malformed"), ("burst", "saturate")
"""Names of the faults whose value is a probability, and of those with a duration in seconds."""
FAULTS: Final = (
    *_PROBABILITIES, *_DURATIONS, "silence", "restart", "threshold", "status", "no_page",
)  # fmt: skip
"""Names of faults."""


class SimulatedBox:
    """Simulated box that measures a wrench in N and N·m, and sends at least one record per tick.

    `tags` are settings on the page that differ from those of a box as delivered. A fault is
    ``name``, ``name=value`` or ``name=value@seconds``, counted from the start of the stream.
    """

    def __init__(
        self,
        read_wrench: Callable[[], Wrench],
        tags: Mapping[str, str] | None = None,
        faults: Sequence[str] = (),
    ) -> None:
        self._read_wrench, self.tags, self._form_count = (
            read_wrench,
            {**_DELIVERED_TAGS, **(tags or {})},
            0,
        )
        self._faults = dict(map(_parse_fault, faults))
        self._random = random.Random(1)
        self._is_streaming, self._has_restarted, self._due_ns = False, False, 0
        self._sequence, self._record_index = 0, 700
        self._held_packets: list[bytes] = []

    def get_page(self, path: str) -> str:
        """Return the web server's answer to a request for a path, or raise OSError."""
        if "no_page" in self._faults:
            raise ConnectionRefusedError("connection refused")
        if path == SETTINGS_PATH:
            settings_text = "".join(f"<{tag}>{value}</{tag}>\n" for tag, value in self.tags.items())
            return f"<netft>\n{settings_text}</netft>\n"
        if (form := urlsplit(path)).path not in (COMMUNICATION_FORM, SENSOR_FORM):
            raise OSError("HTTP status 404")
        self._form_count += 1
        if self._form_count > 3:  # a box drops some of several forms
            return ""
        form_values = dict(parse_qsl(form.query))
        if "comrdte" in form_values:
            form_values["comrdte"] = "Enabled" if form_values["comrdte"] == "1" else "Disabled"
        if "comrdtrate" in form_values:
            form_values["comrdtrate"] = (
                f"{int(protocol.achieved_rate_hz(float(form_values['comrdtrate'])))}"
            )
        if "setbias0" in form_values:
            form_values["setbias"] = ";".join(
                form_values.pop(f"setbias{axis}") for axis in range(6)
            )
        self.tags |= {tag: value for tag, value in form_values.items() if tag in self.tags}
        return ""

    def open(self) -> None:
        """Do nothing: there is no socket."""

    def send(self, request: bytes) -> None:
        """Start or end the stream, as a request from the driver says."""
        if request[:4] in (protocol.STOP_REQUEST[:4], protocol.STREAM_REQUEST[:4]):
            self._is_streaming, self._sequence = request[:4] == protocol.STREAM_REQUEST[:4], 0

    def receive(self, due_ns: int) -> tuple[list[bytes], int]:
        """Return the packets since the last tick, and `due_ns`, the time of this tick.

        Before the first tick `due_ns` is 0: each call then returns the packets of 1 ms, and a time
        later than that of any tick.
        """
        since_last_tick_s = (due_ns - self._due_ns) / 1e9 if self._due_ns else 1e-3
        self._due_ns = due_ns
        return self.packets(min(since_last_tick_s, _MAX_SENT_BACKLOG_S)), due_ns or 1 << 62

    def packets(self, duration_s: float) -> list[bytes]:
        """Return the packets of the records in a time span, at least one, after the faults."""
        if not self._is_streaming or duration_s <= 0:
            return []
        tags, counts_per_unit = self.tags, list[float]()
        for tag, unit_tag, units in (
            ("cfgcpf", "scfgfu", protocol.FORCE_UNITS_N),
            ("cfgcpt", "scfgtu", protocol.TORQUE_UNITS_NM),
        ):  # fmt: skip
            counts_per_unit += 3 * [float(tags[tag]) / units[protocol.unit_key(tags[unit_tag])]]
        axis_counts = tuple(map(round, map(mul, self._read_wrench(), counts_per_unit)))
        record_count = max(1, round(duration_s * float(tags["comrdtrate"])))
        return [
            packet
            for _ in range(record_count)
            for packet in self._arriving_packets(self._make_record(axis_counts))
        ]

    def close(self) -> None:
        """Do nothing: there is no socket."""

    def _is_active(self, fault_name: str) -> bool:
        """Return whether a fault acts on the present record."""
        value, from_s = self._faults.get(fault_name, (0.0, inf))
        elapsed_s = self._sequence / float(self.tags["comrdtrate"]) - from_s
        if fault_name in _PROBABILITIES:
            return elapsed_s >= 0 and self._random.random() < value
        return 0 <= elapsed_s < (value if fault_name in _DURATIONS else inf)

    def _make_record(self, axis_counts: tuple[int, ...]) -> bytes:
        """Return the next record of the stream, with these counts of the six axes."""
        if self._is_active("restart") and not self._has_restarted:
            self._has_restarted, self._sequence, self._record_index = True, 0, 0
        self._sequence, self._record_index = self._sequence + 1, self._record_index + 1
        status_word = 0
        for fault_name, bits in (
            ("saturate", protocol.NETFT.saturation_bits), ("threshold", protocol.THRESHOLD_BIT),
            ("status", int(self._faults.get("status", (0, 0))[0])),
        ):  # fmt: skip
            status_word |= bits | protocol.ANY_ERROR_BIT if self._is_active(fault_name) else 0
        # By the index and not by the clock, so that a burst has no equal counters.
        box_counter = round(
            self._record_index * protocol.COUNTER_HZ / float(self.tags["comrdtrate"])
        )
        return protocol.RECORD_LAYOUT.pack(
            self._sequence, box_counter & 0xFFFFFFFF, status_word, *axis_counts
        )

    def _arriving_packets(self, record: bytes) -> list[bytes]:
        """Apply the faults of the network to a record; return the packets that arrive now."""
        if self._is_active("silence") or self._is_active("loss"):
            return []
        if self._is_active("malformed"):
            record = record[:20]
        packets = [record, record] if self._is_active("duplicate") else [record]
        if self._is_active("burst") or (not self._held_packets and self._is_active("reorder")):
            self._held_packets += packets
            return []
        # A reordered record follows the next one; a burst comes in its own order.
        packets = (
            self._held_packets + packets
            if len(self._held_packets) > 2
            else packets + self._held_packets
        )
        self._held_packets = []
        return packets


def _parse_fault(fault_text: str) -> tuple[str, tuple[float, float]]:
    """Parse a fault; return its name, and its value and start time in seconds."""
    name_and_value, _, from_s = fault_text.partition("@")
    name, _, value = name_and_value.partition("=")
    try:
        fault_value = int(value, 0) if value.startswith("0x") else float(value or 0)
        if name in FAULTS:
            return name, (fault_value, float(from_s or 0))
    except ValueError:
        pass
    raise DeviceError(f'netft.faults: "{fault_text}"; faults are {", ".join(FAULTS)}.')


def simulated_box(
    rig: RigParameters, settings: NetFtSettings, plant_sensor: WrenchSensor
) -> SimulatedBox:
    """Create a simulated box with the profile's settings, which measures a simulated plant."""
    tags = {
        "cfgtfx": ";".join(f"{value:g}" for value in settings.tool_transform),
        "cfgmr": ";".join(f"{value:g}" for value in rig.sensor.range),
        "cfgcalsn": settings.serial_number or _DELIVERED_TAGS["cfgcalsn"],
    }
    return SimulatedBox(plant_sensor.read_wrench, tags, settings.faults)
