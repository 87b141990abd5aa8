"""Driver of a Net F/T box: newest record of its stream, its age, and what was lost on the way."""

import contextlib
import select
import socket
import time
from collections.abc import Callable
from operator import mul
from struct import Struct
from typing import Final

from rigd.devices.contracts import DeviceError, LineHealth, Wrench
from rigd.devices.parameters import RigParameters
from rigd_netft import protocol
from rigd_netft.pages import BoxPage, BoxSettings
from rigd_netft.settings import NetFtSettings

_BUFFER_BYTES = 4 << 20
"""Requested size of the kernel's buffer; the usual 212 992 bytes hold 256 small packets only."""
_MAX_PACKETS_PER_TICK = 1024
"""Most packets that are read in a tick, so that a flood does not stop the loop."""
_START_ATTEMPTS, _START_WAIT_S = 10, 0.2
"""Number of start requests, each of which can be lost, and the wait for a record after each."""
_FIRST_RECORDS = 8
"""Number of records from which the rate is checked."""
_MAX_FIRST_SEQUENCE = 1000
"""Largest sequence number of a stream that has just been started; older streams are beyond."""
_CLOCK_WINDOW_NS = 2_000_000_000
"""Time in ns over which the clocks are compared; a difference of 100 ppm makes 0.2 ms in it."""
_MAX_AGE_PERIODS = 2.0
"""Age of a record, in periods of the loop, above which it counts as stale."""
_COUNTER_JITTER = 1
"""Largest deviation of the counter from its step, as it is rounded."""
_COUNTED = ("lost", "duplicates", "out_of_order", "malformed", "restarts")
"""What is counted of a stream."""
_NEVER_NS = 1 << 62
"""Offset of the clocks in ns that no comparison gives."""
_FRAME_BITS = 8 * (14 + 20 + 8 + protocol.RECORD.size + 4)
"""Bits of a packet with one record on Ethernet."""


class NetFtSensor:
    """Force-torque sensor behind a Net F/T box.

    Parameters
    ----------
    rig
        Parameters of the rig.
    settings
        Section ``[netft]`` of its profile.
    on_request
        Function that advances a simulated box and returns the number of its packets; None: a box
        that streams by itself.
    """

    def __init__(
        self,
        rig: RigParameters,
        settings: NetFtSettings,
        on_request: Callable[[], int] | None = None,
    ) -> None:
        self._settings, self._on_request = settings, on_request
        self._name = f"Net F/T box at {settings.host}"
        self._socket: socket.socket | None = None
        self._box = BoxSettings((1.0,) * 6)
        self._buffer, self._newest = bytearray(2048), bytearray(2048)
        self._step = 1.0
        self._period_ns = 1e9 / rig.rate_hz
        self.wrench_stale, self.wrench_saturated, self.wrench_time_ns = True, False, 0
        self._status = self._due_ns = 0
        self._wrench: Wrench = (0.0,) * 6
        self._forget_stream()

    def _forget_stream(self) -> None:
        """Forget records, counts and clock of an earlier stream."""
        self.counts = dict.fromkeys(_COUNTED, 0)
        self._records = self._statuses = self._count = 0
        self._is_new = False
        self._first: tuple[int, int] | None = None
        self._last: tuple[int, int] | None = None
        self._candidate: tuple[int, int] | None = None
        self._window, self._offsets_ns = -1, (_NEVER_NS, _NEVER_NS)

    # Contract of a sensor

    def connect(self) -> None:
        """Read and set the box's settings, start its stream, and check status and rate."""
        settings = self._settings
        if settings.counts_per_n > 0:
            per_axis = (1 / settings.counts_per_n,) * 3 + (1 / settings.counts_per_nm,) * 3
            assumed = (("assumed", "counts, N and N·m, rate and filter of netft"),)
            self._box = BoxSettings(per_axis, identity=assumed)
        else:
            self._box = BoxPage(settings, self._name).configure()
        if self._box.is_axia:
            self._bits, self._saturated = protocol.AXIA_BITS, protocol.AXIA_SATURATED
        else:
            self._bits, self._saturated = protocol.NETFT_BITS, protocol.SATURATED
        self._no_fault = self._saturated | protocol.ANY_ERROR | protocol.THRESHOLD
        self._step = self._box.counter_hz / settings.rate_hz
        self._ns_per_count = 1e9 / self._box.counter_hz
        try:
            # Connected, the kernel drops packets from elsewhere.
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            self._socket.setblocking(False)
            self._socket.connect((settings.host, settings.port))
            self._start()
        except OSError as error:
            self.close()
            raise DeviceError(f"{self._name}: {error}; check address and cable.") from error
        except DeviceError:
            self.close()
            raise

    def calibration(self) -> dict[str, object]:
        """Return identity and settings that the box reported."""
        return {
            "device": "Axia" if self._box.is_axia else "Net F/T",
            **dict(self._box.identity),
            "records_hz": self._settings.rate_hz,
            "filter_hz": self._settings.filter_hz,
            "status": protocol.status_texts(self._status, self._bits),
            "scales_n_nm": list(self._box.scales),
        }

    def request(self, due_ns: int) -> None:
        """Note the time of the tick: the box streams by itself, unless it is simulated."""
        self._due_ns = due_ns
        if self._on_request is not None:
            self._wait_for(self._on_request())

    def read_wrench(self) -> Wrench:
        """Return the wrench of the newest record, after all that have arrived were read."""
        self._drain()
        if not self._is_new:
            self.wrench_stale = True
            return self._wrench
        self._is_new = False
        status, self._statuses = self._statuses, 0
        self._status = status
        if status & ~self._no_fault:
            texts = "; ".join(protocol.status_texts(status & ~self._no_fault, self._bits))
            raise DeviceError(f"{self._name}: its status {status:#010x} reports {texts}.")
        self.wrench_saturated = bool(status & self._saturated)
        fx, fy, fz, tx, ty, tz = map(
            mul, protocol.RECORD.unpack_from(self._newest)[3:], self._box.scales
        )
        self._wrench = fx, fy, fz, tx, ty, tz
        now_ns = self._due_ns if self._on_request is not None else time.monotonic_ns()
        self.wrench_time_ns = self._time_ns(now_ns)
        self.wrench_stale = now_ns - self.wrench_time_ns > _MAX_AGE_PERIODS * self._period_ns
        return self._wrench

    def health(self) -> LineHealth:
        """Return errors of the stream, and the box's last status word."""
        return LineHealth(
            bits=self._records * _FRAME_BITS,
            bit_rate_bit_s=100e6,
            errors=sum(self.counts.values()),
            status=self._status,
            cause=(
                f"{self._name} sends no records: it is off or its cable is unplugged, or another "
                "program has started a stream, which ends this one; close that program."
                if self.wrench_stale
                else ""
            ),
        )

    def close(self) -> None:
        """End the stream and release the socket; never raises."""
        if self._socket is not None:
            self._send(protocol.STOP)
            self._socket.close()
            self._socket = None

    def measure(self, duration_s: float) -> dict[str, float]:
        """Read the stream for a time; return its rate, longest gap and errors."""
        self._drain()
        records, before = self._records, dict(self.counts)
        start_s = last_s = now_s = time.monotonic()
        longest_s = 0.0
        while now_s < start_s + duration_s:
            self._wait(start_s + duration_s - now_s)
            self._drain()
            now_s = time.monotonic()
            longest_s, last_s = max(longest_s, now_s - last_s), now_s
        rate_hz = (self._records - records) / (now_s - start_s)
        errors = {name: self.counts[name] - before[name] for name in _COUNTED}
        return {"records_hz": rate_hz, "longest_gap_s": longest_s, **errors}

    # Stream

    def _start(self) -> None:
        """Start the stream, and check that records of the profile's rate come without a fault."""
        for _ in range(_START_ATTEMPTS):
            self._send(protocol.STOP)
            self._drain()  # records of an earlier stream
            self._forget_stream()
            self._send(protocol.STREAM)
            deadline_s = time.monotonic() + _START_WAIT_S
            while time.monotonic() < deadline_s and self._records < _FIRST_RECORDS:
                if self._on_request is not None:
                    self._wait_for(self._on_request())
                self._wait(_START_WAIT_S)
                self._drain()
            if (
                self._last is not None
                and self._first != self._last
                and self._last[0] <= _MAX_FIRST_SEQUENCE
            ):
                break
        else:
            raise DeviceError(
                f"{self._name}: no record came after {_START_ATTEMPTS} requests for its stream. "
                "Check that RDT is enabled, and that no firewall drops UDP from its port "
                f"{self._settings.port}."
            )
        assert self._first is not None
        records = protocol.difference(self._last[0], self._first[0])
        counted = protocol.difference(self._last[1], self._first[1])
        if abs(counted - records * self._step) > 1:
            raise DeviceError(
                f"{self._name}: its counter rises by {counted} in {records} records, so it does "
                f"not send {self._settings.rate_hz:g} records per second; correct netft.rate_hz or "
                "the rate in the box."
            )
        self.read_wrench()
        if self._on_request is not None:  # its clock is that of the ticks, which have not begun
            self._offsets_ns = _NEVER_NS, _NEVER_NS

    def _send(self, command: int) -> None:
        """Send a request; nothing tells whether it arrives."""
        assert self._socket is not None
        with contextlib.suppress(OSError):  # nobody listens there: no record will come
            self._socket.send(protocol.request(command))

    def _wait(self, timeout_s: float) -> None:
        """Wait until a packet is there, or a time has passed."""
        assert self._socket is not None
        select.select([self._socket], [], [], max(0.0, timeout_s))

    def _wait_for(self, packets: int) -> None:
        """Read the packets that a simulated box has just sent."""
        for _ in range(packets):
            self._wait(_START_WAIT_S)
            self._drain(1)

    def _drain(self, max_packets: int = _MAX_PACKETS_PER_TICK) -> None:
        """Read the packets that have arrived, so that none waits for a later tick."""
        assert self._socket is not None
        receive, head, step = self._socket.recv_into, _HEAD.unpack_from, self._step
        for _ in range(max_packets):
            try:
                size = receive(self._buffer)
            except OSError:  # nothing is there, or the box answered that its port is closed
                return
            if size == protocol.RECORD.size and self._last is not None:
                sequence, counter, status = head(self._buffer)
                last_sequence, last_counter = self._last
                rise = counter - last_counter
                if sequence - last_sequence == 1 and -1 <= rise - step <= 1:  # as nearly always
                    self._records += 1
                    self._count += rise
                    self._last = sequence, counter
                    self._statuses |= status
                    self._is_new = True
                    self._buffer, self._newest = self._newest, self._buffer
                    continue
            if size == 0 or size % protocol.RECORD.size:
                self.counts["malformed"] += 1
                continue
            for offset in range(0, size, protocol.RECORD.size):
                self._take(offset)

    def _take(self, offset: int) -> None:
        """Count a record, and keep it if it is the newest.

        The box's counter decides: it rises by the same step with each record of a stream. A record
        that does not fit belongs to another stream, or the box was restarted; it is believed when
        the next record follows it.
        """
        sequence, counter, status = _HEAD.unpack_from(self._buffer, offset)
        self._records += 1
        last, candidate = self._last, self._candidate
        if last is None:
            self._first = sequence, counter
            self._adopt(sequence, counter, status, offset)
            return
        ahead = protocol.difference(sequence, last[0])
        if abs(protocol.difference(counter, last[1]) - ahead * self._step) <= _COUNTER_JITTER:
            if ahead > 0:
                self.counts["lost"] += ahead - 1
                self._adopt(sequence, counter, status, offset)
            elif ahead == 0:
                self.counts["duplicates"] += 1
            else:  # it had been counted as lost
                self.counts["out_of_order"] += 1
                self.counts["lost"] -= 1
            return
        self._candidate = sequence, counter
        if candidate is None or protocol.difference(sequence, candidate[0]) != 1:
            return
        self.counts["restarts"] += 1
        self._candidate = None
        if protocol.difference(counter, last[1]) < 0:
            raise DeviceError(
                f"{self._name} has restarted; its bias may have changed. Start a new session."
            )
        self._adopt(sequence, counter, status, offset)

    def _adopt(self, sequence: int, counter: int, status: int, offset: int) -> None:
        """Take a record as the newest."""
        if self._last is not None:
            self._count += protocol.difference(counter, self._last[1])
        self._last = sequence, counter
        self._statuses |= status
        self._is_new = True
        record = self._buffer[offset : offset + protocol.RECORD.size]
        self._newest[: protocol.RECORD.size] = record

    def _time_ns(self, now_ns: int) -> int:
        """Return when the newest record was sampled, by the box's counter, on this clock.

        The record that arrived soonest within the last seconds fixes the offset of the clocks;
        others were delayed on the way. The constant part of the delay is sensor.delay_s.
        """
        box_ns = round(self._count * self._ns_per_count)
        offset_ns = now_ns - box_ns
        if box_ns // _CLOCK_WINDOW_NS != self._window:
            self._window = box_ns // _CLOCK_WINDOW_NS
            self._offsets_ns = self._offsets_ns[1], offset_ns
        self._offsets_ns = self._offsets_ns[0], min(self._offsets_ns[1], offset_ns)
        return box_ns + min(self._offsets_ns)


_HEAD: Final = Struct(">III")
"""First three numbers of a record: sequence, counter, status."""
