"""Driver of a Net F/T box: its line, newest record of its stream, its age, and what was lost."""

import contextlib
import http.client
import socket
import time
from math import inf
from operator import mul
from struct import Struct
from typing import TYPE_CHECKING, Final

from rigd.devices.contracts import DeviceError, LineHealth, Wrench
from rigd.devices.parameters import RigParameters
from rigd_netft import protocol
from rigd_netft.pages import BoxSettings, configure
from rigd_netft.settings import NetFtSettings

if TYPE_CHECKING:
    from rigd_netft.box import SimulatedBox

_TIMEOUT_S = 2.0
"""Longest time in seconds for a connection to the page, and for each read from it."""
_MAX_PAGE_BYTES = 1 << 16
"""Largest size in bytes of a page that is read."""
_BUFFER_BYTES = 4 << 20
"""Requested size of the kernel's buffer; the usual 212 992 bytes hold 256 small packets only."""
_MAX_PACKETS_PER_TICK = 1024
"""Most packets that are read in a tick, so that a flood does not stop the loop."""
_START_ATTEMPTS, _START_WAIT_S = 10, 0.2
"""Number of start requests, each of which can be lost, and the wait for records after each."""
_FIRST_RECORDS = 8
"""Number of records from which the rate is checked."""
_MAX_FIRST_SEQUENCE = 1000
"""Largest sequence number of a stream that has just been started; older streams are beyond."""
_MAX_DRIFT = 1e-4
"""Largest difference of the rates of two clocks, of box and computer."""
_MAX_AGE_PERIODS = 2.0
"""Age of a record, in periods of the loop, above which it counts as stale."""
_COUNTED = ("lost", "duplicates", "out_of_order", "malformed", "restarts")
"""What is counted of a stream."""
_RECORD_BYTES: Final = protocol.RECORD.size
_FRAME_BITS: Final = 8 * (14 + 20 + 8 + _RECORD_BYTES + 4)
"""Bits of a packet with one record on Ethernet."""
_unpack_head: Final = Struct(">III").unpack_from
"""Function that returns the first three numbers of a record: sequence, counter, status."""


class NetworkLine:
    """Line to a box on the network."""

    def __init__(self, settings: NetFtSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None

    def get(self, path: str) -> str:
        """Return the answer to a request for a path of the page; raise OSError without one."""
        settings = self._settings
        connection = http.client.HTTPConnection(settings.host, settings.http_port, _TIMEOUT_S)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            content = answer.read(_MAX_PAGE_BYTES)
        except http.client.HTTPException as error:
            raise OSError(str(error)) from error
        finally:
            connection.close()
        if answer.status not in (200, 302):
            raise OSError(f"HTTP status {answer.status}")
        return content.decode("utf-8", errors="replace")

    def open(self) -> None:
        """Open the socket for requests and records."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._socket.setblocking(False)
        # Connected, the kernel drops packets from elsewhere.
        self._socket.connect((self._settings.host, self._settings.port))

    def send(self, request: bytes) -> None:
        """Send a request; nothing tells whether it arrives."""
        if self._socket is not None:
            with contextlib.suppress(OSError):  # nobody listens there: no record will come
                self._socket.send(request)

    def receive(self, _due_ns: int) -> tuple[list[bytes], int]:
        """Return the packets that have arrived, so that none waits for a later tick, and the time.

        The argument is for a simulated box.
        """
        assert self._socket is not None
        receive, packets = self._socket.recv, list[bytes]()
        try:
            while len(packets) < _MAX_PACKETS_PER_TICK:
                packets.append(receive(64))
        except OSError:  # nothing is there, or the box answered that its port is closed
            pass
        return packets, time.monotonic_ns()

    def close(self) -> None:
        """Release the socket; never raises."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class NetFtSensor:
    """Force-torque sensor behind a Net F/T box; `counts` has the errors of its stream."""

    def __init__(
        self,
        rig: RigParameters,
        settings: NetFtSettings,
        simulated_box: "SimulatedBox | None" = None,
    ) -> None:
        self._settings, self._line = settings, simulated_box or NetworkLine(settings)
        self._box = BoxSettings((1.0,) * 6)
        self._period_ns = 1e9 / rig.rate_hz
        self.wrench_stale, self.wrench_saturated, self.wrench_time_ns = True, False, 0
        self._status = 0
        self._wrench: Wrench = (0.0,) * 6
        self._forget_stream()

    def _forget_stream(self) -> None:
        """Forget records, counts and clock of an earlier stream."""
        self.counts = dict.fromkeys(_COUNTED, 0)
        self._records = self._statuses = self._due_ns = 0
        self._counted = self._before_first = 0  # rise of the counter; sequence before the first
        self._last = 0, 0  # sequence and counter of the newest record
        self._candidate: int | None = None  # sequence of a record that does not fit
        self._newest = b""  # until it is read
        self._box_ns, self._offset_ns = 0, inf  # clock of the box, and what this one is ahead

    def connect(self) -> None:
        """Read and set the box's settings, start its stream, and check status and rate."""
        try:
            self._box = configure(self._settings, self._line.get)
            self._step = self._box.counter_hz / self._settings.rate_hz
            self._line.open()
            self._start()
            self.read_wrench()
        except OSError as error:
            self.close()
            raise self._error(f"{error}; check address and cable.") from error
        except DeviceError:
            self.close()
            raise

    def calibration(self) -> dict[str, object]:
        """Return identity and settings that the box reported."""
        return {
            "device": self._box.kind.device,
            **self._box.identity,
            "records_hz": self._settings.rate_hz,
            "filter_hz": self._settings.filter_hz,
            "status": self._box.kind.status_texts(self._status),
            "scales_n_nm": list(self._box.scales),
        }

    def request(self, due_ns: int) -> None:
        """Note the time of the tick: the box streams by itself."""
        self._due_ns = due_ns

    def read_wrench(self) -> Wrench:
        """Return the wrench of the newest record, after all that have arrived were read."""
        now_ns = self._read()
        if not self._newest:
            self.wrench_stale = True
            return self._wrench
        _, _, _, *counts = protocol.RECORD.unpack(self._newest)
        self._newest = b""
        kind, self._status, self._statuses = self._box.kind, self._statuses, 0
        harmful = self._status & ~(kind.saturated | protocol.ANY_ERROR | protocol.THRESHOLD)
        if harmful:
            texts = "; ".join(kind.status_texts(harmful))
            raise self._error(f"its status {self._status:#010x} reports {texts}.")
        self.wrench_saturated = self._status & kind.saturated != 0
        fx, fy, fz, tx, ty, tz = map(mul, counts, self._box.scales)
        self._wrench = fx, fy, fz, tx, ty, tz
        self.wrench_time_ns = self._time_ns(now_ns)
        self.wrench_stale = now_ns - self.wrench_time_ns > _MAX_AGE_PERIODS * self._period_ns
        return self._wrench

    def health(self) -> LineHealth:
        """Return errors of the stream, and the box's last status word."""
        silent = (
            f"{self._settings.box_name} sends no records: it is off or its cable is unplugged, or "
            "another program has started a stream, which ends this one; close that program."
        )
        return LineHealth(
            bits=self._records * _FRAME_BITS,
            bit_rate_bit_s=100e6,
            errors=sum(self.counts.values()),
            status=self._status,
            cause=silent if self.wrench_stale else "",
        )

    def close(self) -> None:
        """End the stream and release the line; never raises."""
        self._line.send(protocol.STOP)
        self._line.close()

    def measure(self, duration_s: float) -> dict[str, float]:
        """Read the stream for a time; return its rate, longest gap and errors."""
        self._read()
        records, before = self._records, self.counts.copy()
        start_s = last_s = now_s = time.monotonic()
        longest_s = 0.0
        while now_s < start_s + duration_s:
            time.sleep(1e-4)
            known = self._records
            self._read()
            now_s = time.monotonic()
            if self._records > known:
                longest_s, last_s = max(longest_s, now_s - last_s), now_s
        rate_hz = (self._records - records) / (now_s - start_s)
        errors = {name: self.counts[name] - before[name] for name in _COUNTED}
        return {"records_hz": rate_hz, "longest_gap_s": longest_s, **errors}

    def _start(self) -> None:
        """Start the stream, and check that records of the profile's rate come without a fault."""
        for _ in range(_START_ATTEMPTS):
            self._line.send(protocol.STOP)
            self._line.receive(0)  # records of an earlier stream
            self._forget_stream()
            self._line.send(protocol.STREAM)
            deadline_s = time.monotonic() + _START_WAIT_S
            while self._records < _FIRST_RECORDS and time.monotonic() < deadline_s:
                time.sleep(1e-3)
                self._read()
            records = protocol.difference(self._last[0], self._before_first)
            if records > 1 and self._last[0] <= _MAX_FIRST_SEQUENCE:
                break
        else:
            raise self._error(
                f"no record came after {_START_ATTEMPTS} requests for its stream. Check that RDT "
                f"is enabled, and that no firewall drops UDP from its port {self._settings.port}."
            )
        if abs(self._counted - records * self._step) > 1:
            raise self._error(
                f"its counter rises by {self._counted} in {records} records, so it does not send "
                f"{self._settings.rate_hz:g} records per second; correct netft.rate_hz or the rate "
                "in the box."
            )

    def _read(self) -> int:
        """Count the records that have arrived, store the newest, and return the time in ns.

        The box's counter decides: it rises by the same step with each record of a stream. A record
        that does not fit belongs to another stream, or the box was restarted; it is believed when
        the next record follows it.
        """
        packets, now_ns = self._line.receive(self._due_ns)
        counts, step, difference = self.counts, self._step, protocol.difference
        last_sequence, last_counter = self._last
        for packet in packets:
            if len(packet) != _RECORD_BYTES:
                counts["malformed"] += 1
                continue
            sequence, counter, status = _unpack_head(packet)
            if not self._records:
                self._before_first = last_sequence = sequence - 1
                last_counter = counter - round(step)
            self._records += 1
            ahead, rise = sequence - last_sequence, counter - last_counter
            if ahead != 1 or not -1 <= rise - step <= 1:  # the counter is rounded
                ahead, rise = difference(ahead, 0), difference(rise, 0)
                if not -1 <= rise - ahead * step <= 1:
                    if not self._is_restarted(sequence, rise):
                        continue
                elif ahead > 1:
                    counts["lost"] += ahead - 1
                elif ahead < 1:
                    counts["out_of_order" if ahead else "duplicates"] += 1
                    counts["lost"] -= ahead < 0  # as which it had been counted
                    continue
            self._counted += rise
            self._statuses |= status
            self._newest = packet
            last_sequence, last_counter = sequence, counter
        self._last = last_sequence, last_counter
        return now_ns

    def _is_restarted(self, sequence: int, rise: int) -> bool:
        """Return whether a record that does not fit follows another one, as in a new stream."""
        candidate, self._candidate = self._candidate, sequence
        if candidate is None or protocol.difference(sequence, candidate) != 1:
            return False
        self.counts["restarts"] += 1
        self._candidate = None
        if rise < 0:
            raise self._error("it has restarted; its bias may have changed. Start a new session.")
        return True

    def _time_ns(self, now_ns: int) -> int:
        """Return when the newest record was sampled, by the box's counter, on this clock.

        The record that arrived soonest fixes the offset of the clocks; others were delayed on the
        way. The offset may grow as slowly as clocks drift apart. The constant part of the delay is
        sensor.delay_s.
        """
        box_ns = round(self._counted * 1e9 / self._box.counter_hz)
        drifted_ns = self._offset_ns + _MAX_DRIFT * (box_ns - self._box_ns)
        self._box_ns, self._offset_ns = box_ns, min(drifted_ns, now_ns - box_ns)
        return round(box_ns + self._offset_ns)

    def _error(self, text: str) -> DeviceError:
        """Return an error that names the box."""
        return DeviceError(f"{self._settings.box_name}: {text}")
