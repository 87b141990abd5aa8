"""Driver of a Net F/T box: connection, newest record of the stream, its age, and lost records."""

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

_PAGE_TIMEOUT_S = 2.0
"""Largest time in seconds for connecting to the web page, and for each read from it."""
_MAX_PAGE_BYTES = 1 << 16
"""Number of bytes of a web page that are read at most."""
_RECEIVE_BUFFER_BYTES = 4 << 20
"""Requested size of the kernel's buffer; the usual 212 992 bytes hold 256 small packets only."""
_MAX_PACKETS_PER_TICK = 1024
"""Largest number of packets that are read in a tick, so that a flood does not stop the loop."""
_START_ATTEMPTS, _START_WAIT_S = 10, 0.2
"""Number of start requests, of which some may be lost, and time in seconds to wait after each."""
_MIN_RATE_CHECK_RECORDS = 8
"""Number of records by which the rate of a new stream is checked."""
_MAX_NEW_STREAM_SEQUENCE = 1000
"""Sequence number up to which a stream counts as new; that of an older stream is larger."""
_MAX_RELATIVE_CLOCK_DRIFT = 1e-4
"""Largest relative difference between the rates of the clocks of box and computer."""
_MAX_RECORD_AGE_PERIODS = 2.0
"""Age of a record, in periods of the loop, above which it counts as stale."""
_ERROR_COUNT_NAMES = ("lost", "duplicates", "out_of_order", "malformed", "restarts")
"""Names of the errors of a stream that are counted."""
_RECORD_BYTES: Final = protocol.RECORD_LAYOUT.size
_FRAME_BITS: Final = 8 * (14 + 20 + 8 + _RECORD_BYTES + 4)
"""Number of bits that a packet with one record takes on Ethernet."""
_unpack_head: Final = Struct(">III").unpack_from
"""Unpack the first three numbers of a record: sequence number, counter, status word."""


class NetworkLine:
    """Connection to a box on the network: its web page, and the socket for its stream."""

    def __init__(self, settings: NetFtSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None

    def get_page(self, path: str) -> str:
        """Return the web server's answer to a request for a path, or raise OSError."""
        settings = self._settings
        connection = http.client.HTTPConnection(settings.host, settings.http_port, _PAGE_TIMEOUT_S)
        try:
            connection.request("GET", path)
            http_response = connection.getresponse()
            page_bytes = http_response.read(_MAX_PAGE_BYTES)
        except http.client.HTTPException as error:
            raise OSError(str(error)) from error
        finally:
            connection.close()
        if http_response.status not in (200, 302):
            raise OSError(f"HTTP status {http_response.status}")
        return page_bytes.decode("utf-8", errors="replace")

    def open(self) -> None:
        """Open the socket for requests and records."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        self._socket.setblocking(False)
        # Connected, the kernel drops packets from elsewhere.
        self._socket.connect((self._settings.host, self._settings.port))

    def send(self, request: bytes) -> None:
        """Send a request to the box, which confirms no request."""
        if self._socket is not None:
            with contextlib.suppress(OSError):  # nobody listens there: no record will come
                self._socket.send(request)

    def receive(self, _due_ns: int) -> tuple[list[bytes], int]:
        """Return all packets that have arrived, and the time in ns (``time.monotonic_ns``).

        The argument is unused; a simulated box needs it.
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
        """Close the socket; never raises."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class NetFtSensor:
    """Driver of a force-torque sensor with a Net F/T box; `counts` has the stream's errors."""

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
        self._reset_stream()

    def _reset_stream(self) -> None:
        """Reset records, counts and clock for a new stream."""
        self.counts = dict.fromkeys(_ERROR_COUNT_NAMES, 0)
        self._record_count = self._status_bits = self._due_ns = 0
        # Rise of the counter since the start, and sequence number before the first record.
        self._counter_rise = self._sequence_before_first = 0
        self._last_numbers = 0, 0  # sequence and counter of the newest record
        self._candidate_sequence: int | None = None  # sequence of a record that does not fit
        self._newest_packet = b""  # until it is read
        # Clock of the box, and what this computer's clock is ahead.
        self._box_ns, self._clock_offset_ns = 0, inf

    def connect(self) -> None:
        """Read and set the box's settings, start its stream, and check status and rate."""
        try:
            self._box = configure(self._settings, self._line.get_page)
            self._counter_step = self._box.counter_hz / self._settings.rate_hz
            self._line.open()
            self._start_stream()
            self.read_wrench()
        except OSError as error:
            self.close()
            raise self._box_error(f"{error}; check address and cable.") from error
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
            "scales_n_nm": list(self._box.units_per_count),
        }

    def request(self, due_ns: int) -> None:
        """Store the time of the tick; nothing is sent, because the box streams."""
        self._due_ns = due_ns

    def read_wrench(self) -> Wrench:
        """Read all records that have arrived; return the newest wrench in N and N·m."""
        now_ns = self._read_records()
        if not self._newest_packet:
            self.wrench_stale = True
            return self._wrench
        _, _, _, *counts = protocol.RECORD_LAYOUT.unpack(self._newest_packet)
        self._newest_packet = b""
        kind, self._status, self._status_bits = self._box.kind, self._status_bits, 0
        fault_bits = self._status & ~(
            kind.saturation_bits | protocol.ANY_ERROR_BIT | protocol.THRESHOLD_BIT
        )
        if fault_bits:
            fault_texts = "; ".join(kind.status_texts(fault_bits))
            raise self._box_error(f"its status {self._status:#010x} reports {fault_texts}.")
        self.wrench_saturated = self._status & kind.saturation_bits != 0
        fx, fy, fz, tx, ty, tz = map(mul, counts, self._box.units_per_count)
        self._wrench = fx, fy, fz, tx, ty, tz
        self.wrench_time_ns = self._newest_record_time_ns(now_ns)
        self.wrench_stale = now_ns - self.wrench_time_ns > _MAX_RECORD_AGE_PERIODS * self._period_ns
        return self._wrench

    def health(self) -> LineHealth:
        """Return errors of the stream, and the box's last status word."""
        silence_cause = (
            f"{self._settings.box_name} sends no records: it is off or its cable is unplugged, or "
            "another program has started a stream, which ends this one; close that program."
        )
        return LineHealth(
            bits=self._record_count * _FRAME_BITS,
            bit_rate_bit_s=100e6,
            errors=sum(self.counts.values()),
            status=self._status,
            cause=silence_cause if self.wrench_stale else "",
        )

    def close(self) -> None:
        """End the stream and close the socket; never raises."""
        self._line.send(protocol.STOP_REQUEST)
        self._line.close()

    def measure(self, duration_s: float) -> dict[str, float]:
        """Read the stream for a time in seconds; return rate, longest gap and numbers of errors."""
        self._read_records()
        records, counts_before = self._record_count, self.counts.copy()
        start_s = last_s = now_s = time.monotonic()
        longest_gap_s = 0.0
        while now_s < start_s + duration_s:
            time.sleep(1e-4)
            previous_record_count = self._record_count
            self._read_records()
            now_s = time.monotonic()
            if self._record_count > previous_record_count:
                longest_gap_s, last_s = max(longest_gap_s, now_s - last_s), now_s
        rate_hz = (self._record_count - records) / (now_s - start_s)
        error_counts = {
            name: self.counts[name] - counts_before[name] for name in _ERROR_COUNT_NAMES
        }
        return {"records_hz": rate_hz, "longest_gap_s": longest_gap_s, **error_counts}

    def _start_stream(self) -> None:
        """Start the stream, and check that records arrive at the profile's rate."""
        for _ in range(_START_ATTEMPTS):
            self._line.send(protocol.STOP_REQUEST)
            self._line.receive(0)  # records of an earlier stream
            self._reset_stream()
            self._line.send(protocol.STREAM_REQUEST)
            deadline_s = time.monotonic() + _START_WAIT_S
            while self._record_count < _MIN_RATE_CHECK_RECORDS and time.monotonic() < deadline_s:
                time.sleep(1e-3)
                self._read_records()
            received_records = protocol.counter_difference(
                self._last_numbers[0], self._sequence_before_first
            )
            if received_records > 1 and self._last_numbers[0] <= _MAX_NEW_STREAM_SEQUENCE:
                break
        else:
            raise self._box_error(
                f"no record came after {_START_ATTEMPTS} requests for its stream. Check that RDT "
                f"is enabled, and that no firewall drops UDP from its port {self._settings.port}."
            )
        if abs(self._counter_rise - received_records * self._counter_step) > 1:
            raise self._box_error(
                f"its counter rises by {self._counter_rise} in {received_records} records, so it "
                f"does not send {self._settings.rate_hz:g} records per second; correct "
                "netft.rate_hz or the rate in the box."
            )

    def _read_records(self) -> int:
        """Count the records that have arrived, store the newest, and return the time in ns.

        Records of one stream are recognised by the box's counter, which rises by the same step with
        each record. A record whose counter does not fit belongs to another stream, or the box was
        restarted; the new stream is accepted when the next record continues it.
        """
        packets, now_ns = self._line.receive(self._due_ns)
        counts, step, difference = self.counts, self._counter_step, protocol.counter_difference
        last_sequence, last_counter = self._last_numbers
        for packet in packets:
            if len(packet) != _RECORD_BYTES:
                counts["malformed"] += 1
                continue
            sequence, counter, status = _unpack_head(packet)
            if not self._record_count:
                self._sequence_before_first = last_sequence = sequence - 1
                last_counter = counter - round(step)
            self._record_count += 1
            sequence_rise, counter_rise = sequence - last_sequence, counter - last_counter
            if sequence_rise != 1 or not -1 <= counter_rise - step <= 1:  # the counter is rounded
                sequence_rise, counter_rise = (
                    difference(sequence_rise, 0),
                    difference(counter_rise, 0),
                )
                if not -1 <= counter_rise - sequence_rise * step <= 1:
                    if not self._is_restarted(sequence, counter_rise):
                        continue
                elif sequence_rise > 1:
                    counts["lost"] += sequence_rise - 1
                elif sequence_rise < 1:
                    counts["out_of_order" if sequence_rise else "duplicates"] += 1
                    counts["lost"] -= sequence_rise < 0  # as which it had been counted
                    continue
            self._counter_rise += counter_rise
            self._status_bits |= status
            self._newest_packet = packet
            last_sequence, last_counter = sequence, counter
        self._last_numbers = last_sequence, last_counter
        return now_ns

    def _is_restarted(self, sequence: int, counter_rise: int) -> bool:
        """Return whether a record that does not fit continues a new stream; count the restart."""
        candidate_sequence, self._candidate_sequence = self._candidate_sequence, sequence
        if (
            candidate_sequence is None
            or protocol.counter_difference(sequence, candidate_sequence) != 1
        ):
            return False
        self.counts["restarts"] += 1
        self._candidate_sequence = None
        if counter_rise < 0:
            raise self._box_error(
                "it has restarted; its bias may have changed. Start a new session."
            )
        return True

    def _newest_record_time_ns(self, now_ns: int) -> int:
        """Return the time in ns, on this computer's clock, at which the newest record was sampled.

        The box's counter states it. The offset between the clocks is that of the record with the
        shortest delay on the way; it may grow as slowly as clocks drift apart. The constant part of
        the delay is ``sensor.delay_s``.
        """
        box_ns = round(self._counter_rise * 1e9 / self._box.counter_hz)
        drifted_offset_ns = self._clock_offset_ns + _MAX_RELATIVE_CLOCK_DRIFT * (
            box_ns - self._box_ns
        )
        self._box_ns, self._clock_offset_ns = box_ns, min(drifted_offset_ns, now_ns - box_ns)
        return round(box_ns + self._clock_offset_ns)

    def _box_error(self, reason: str) -> DeviceError:
        """Return an error whose message begins with the name of the box."""
        return DeviceError(f"{self._settings.box_name}: {reason}")
