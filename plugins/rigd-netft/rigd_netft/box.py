"""Simulated Net F/T box on the loopback interface: web page, stream, and faults of both."""

import random
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler
from socketserver import TCPServer
from threading import Thread
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from rigd.devices.contracts import DeviceError, Wrench, WrenchSensor
from rigd.devices.parameters import RigParameters
from rigd_netft import protocol
from rigd_netft.pages import COMMUNICATION, PAGE, SETTING
from rigd_netft.sensor import NetFtSensor
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
_MAX_FORMS = 3
"""Number of forms that the box takes; it ignores more."""
FAULTS: Final = (
    "loss", "duplicate", "reorder", "malformed", "silence", "burst", "restart", "saturate",
    "threshold", "status", "no_page",
)  # fmt: skip
"""Names of faults; the first four have a probability, burst and saturate a duration in seconds."""


class SimulatedBox:
    """Box that measures a wrench with one record or more for each tick.

    Parameters
    ----------
    read_wrench
        Function that returns the wrench in N and N·m.
    tags
        Settings on the page that differ from those of a delivered box.
    faults
        Faults as ``name``, ``name=value`` or ``name=value@seconds`` after the start of the stream.
    """

    def __init__(
        self,
        read_wrench: Callable[[], Wrench],
        tags: Mapping[str, str] | None = None,
        faults: Sequence[str] = (),
    ) -> None:
        self._read_wrench, self.tags, self._forms = read_wrench, {**_TAGS, **(tags or {})}, 0
        self._faults = {}
        for fault in faults:
            name, _, value = fault.partition("@")[0].partition("=")
            try:
                self._faults[name] = (
                    float(int(value, 0) if value[:2] == "0x" else value or 0),
                    (float(fault.partition("@")[2] or 0)),
                )
            except ValueError:
                name = ""
            if name not in FAULTS:
                raise DeviceError(f'netft.faults: "{fault}"; faults are {", ".join(FAULTS)}.')
        self._random = random.Random(1)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._client: tuple[str, int] | None = None
        self._sequence, self._index, self._restarted = 0, 700, False
        self._held: list[bytes] = []

    @contextmanager
    def page(self) -> Iterator[int]:
        """Serve the page in this context, and yield its port."""
        # Not HTTPServer, which asks for the name of the computer and may wait for seconds.
        server = TCPServer(("127.0.0.1", 0), _handler(self))
        thread = Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        if "no_page" not in self._faults:
            thread.start()
        try:
            yield server.server_address[1]
        finally:
            if thread.is_alive():
                server.shutdown()
            server.server_close()

    def answer(self, path: str) -> tuple[int, str]:
        """Return HTTP status and text for a path of the page."""
        if path == PAGE:
            text = "".join(f"<{tag}>{value}</{tag}>\n" for tag, value in self.tags.items())
            return 200, f"<netft>\n{text}</netft>\n"
        if (form := urlsplit(path)).path not in (COMMUNICATION, SETTING):
            return 404, ""
        self._forms += 1
        values = dict(parse_qsl(form.query)) if self._forms <= _MAX_FORMS else {}
        if "comrdte" in values:
            values["comrdte"] = "Enabled" if values["comrdte"] == "1" else "Disabled"
        if "comrdtrate" in values:
            values["comrdtrate"] = f"{int(protocol.rate_reached_hz(float(values['comrdtrate'])))}"
        if "setbias0" in values:
            values["setbias"] = ";".join(values.pop(f"setbias{axis}") for axis in range(6))
        self.tags |= {tag: value for tag, value in values.items() if tag in self.tags}
        return 302, ""

    def tick(self, duration_s: float) -> int:
        """Answer requests, send the records of a period, and return the number of packets sent."""
        try:
            while True:
                content, sender = self._socket.recvfrom(64)
                header, command, _ = protocol.REQUEST.unpack(content[: protocol.REQUEST.size])
                if header == protocol.HEADER and command in (protocol.STOP, protocol.STREAM):
                    self._client = sender if command == protocol.STREAM else None
                    self._sequence = 0
        except BlockingIOError:
            pass
        if self._client is None:
            return 0
        wrench, sent = self._read_wrench(), 0
        for _ in range(max(1, round(duration_s * float(self.tags["comrdtrate"])))):
            sent += self._send(self._record(wrench))
        return sent

    def run(self, until: Callable[[], bool], period_s: float = 1e-3) -> None:
        """Stream by the clock until a function returns True."""
        due_s = time.monotonic()
        while not until():
            due_s += period_s
            time.sleep(max(0.0, due_s - time.monotonic()))
            self.tick(period_s)

    def close(self) -> None:
        """Release the socket of the stream."""
        self._socket.close()

    def _at(self, fault: str) -> bool:
        """Return whether a fault acts at the present record."""
        if fault not in self._faults:
            return False
        value, from_s = self._faults[fault]
        elapsed_s = self._sequence / float(self.tags["comrdtrate"]) - from_s
        if fault in FAULTS[:4]:
            return elapsed_s >= 0 and self._random.random() < value
        return elapsed_s >= 0 and (fault not in ("burst", "saturate") or elapsed_s < value)

    def _record(self, wrench: Wrench) -> bytes:
        """Return the next record."""
        if self._at("restart") and not self._restarted:
            self._restarted, self._sequence, self._index = True, 0, 0
        self._sequence, self._index = self._sequence + 1, self._index + 1
        status = protocol.ANY_ERROR | protocol.SATURATED if self._at("saturate") else 0
        status |= protocol.ANY_ERROR | protocol.THRESHOLD if self._at("threshold") else 0
        status |= int(self._faults["status"][0]) if self._at("status") else 0
        per_force = float(self.tags["cfgcpf"]) / _unit(self.tags["scfgfu"], protocol.NEWTONS)
        per_torque = float(self.tags["cfgcpt"]) / _unit(self.tags["scfgtu"], protocol.NEWTON_METRES)
        per_axis = (per_force,) * 3 + (per_torque,) * 3
        counts = [round(value * per) for value, per in zip(wrench, per_axis, strict=True)]
        # By the index and not by the clock, so that a burst has no equal counters.
        counter = round(self._index * protocol.INTERNAL_HZ / float(self.tags["comrdtrate"]))
        return protocol.RECORD.pack(self._sequence, counter & 0xFFFFFFFF, status, *counts)

    def _send(self, record: bytes) -> int:
        """Send a record as the faults have it, and return the number of packets sent."""
        if self._at("silence") or self._at("loss"):
            return 0
        if self._at("malformed"):
            record = record[:20]
        packets = [record, record] if self._at("duplicate") else [record]
        if self._at("burst") or (not self._held and self._at("reorder")):
            self._held += packets
            return 0
        # A reordered record follows the next one; a burst comes in its own order.
        packets = self._held + packets if len(self._held) > 2 else packets + self._held
        self._held = []
        assert self._client is not None
        for packet in packets:
            self._socket.sendto(packet, self._client)
        return len(packets)


def _unit(name: str, units: Mapping[str, float]) -> float:
    """Return a unit in N or N·m; 1 for a name that only a test writes."""
    return units.get(name.lower().replace("-", ""), 1.0)


def _handler(box: SimulatedBox) -> type[BaseHTTPRequestHandler]:
    """Return the class that answers requests for the page of a box."""

    class PageHandler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status, text = box.answer(self.path)
            self.send_response(status)
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            pass

    return PageHandler


class _SimulatedNetFt(NetFtSensor):
    """Driver with a simulated box, whose page is served while it connects."""

    def __init__(self, rig: RigParameters, settings: NetFtSettings, box: SimulatedBox) -> None:
        super().__init__(rig, settings, on_request=lambda: box.tick(self._elapsed_s))
        self._simulated_box = box
        self._elapsed_s = self._period_s = 1 / rig.rate_hz

    def request(self, due_ns: int) -> None:
        """Advance the box by the time since the last tick, as a real one streams on meanwhile."""
        since_last_s = (due_ns - self._due_ns) / 1e9 if self._due_ns > 0 else 0.0
        self._elapsed_s = min(max(since_last_s, self._period_s), _LONGEST_PAUSE_S)
        super().request(due_ns)

    def connect(self) -> None:
        """Connect to the simulated box."""
        with self._simulated_box.page() as self._page_port:
            self._settings = replace(self._settings, http_port=self._page_port)
            super().connect()

    def close(self) -> None:
        """End the stream, and release the sockets of driver and box."""
        super().close()
        self._simulated_box.close()


def open_simulated_box(
    rig: RigParameters, settings: NetFtSettings, plant_sensor: WrenchSensor
) -> WrenchSensor:
    """Create the driver of a simulated box that measures a simulated plant."""
    tags = {"cfgtfx": ";".join(f"{value:g}" for value in settings.tool_transform)}
    if settings.serial_number:
        tags["cfgcalsn"] = settings.serial_number
    tags["cfgmr"] = ";".join(f"{value:g}" for value in rig.sensor.range)
    box = SimulatedBox(plant_sensor.read_wrench, tags, settings.faults)
    return _SimulatedNetFt(rig, replace(settings, host="127.0.0.1", port=box.port), box)
