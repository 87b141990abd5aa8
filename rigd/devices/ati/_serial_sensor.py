"""A Digital F/T sensor on a serial line, streaming: set up, then read record by record.

The sensor streams several records for each tick of the loop. The profile's decimating filter and
the calibration are one matrix, applied to the newest records in one product.
"""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from struct import Struct

import numpy as np

from rigd.devices.ati._calibration import SERIAL_CRITICAL, CalibrationBlock, serial_status
from rigd.devices.ati._serial_protocol import ERROR_BIT, RECORD_BITS, RECORD_SIZE, RecordStream
from rigd.devices.ati._serial_setup import SILENCE_S, SerialLine, SerialSetup, held_back
from rigd.devices.contracts import DeviceError, LineHealth, Wrench
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import SimulatorAddress

_FIRST_RECORDS_TIMEOUT_S = 0.5
# The error bit is not covered by the checksum; one flipped bit must not end a session.
_ERRORS_IN_A_ROW = 7
# Unread for longer than this, the kernel's 4 kB may overflow at 91 kB/s and what is left is old.
_IDLE_NS = 20_000_000
_GAP_PERIODS = 2.5
"""Periods without a byte that are a gap: the stream brings several records in each."""
_GAPS, _FEWEST_GAPS = 8, 4
_EVEN = 1.5
"""Largest ratio of a gap to the median gap for gaps to count as even."""
_RECENT_NS = 500_000_000
_STEADY_TICKS = 3
"""Ticks that bring their own records after which what is still missing counts as lost."""

_BITS_PER_BYTE = RECORD_BITS // RECORD_SIZE
_RECORD = np.dtype([("gauges", ">i2", 6), ("check", "u1")])


class AtiSerialSensor:
    """The sensor of a profile with a section ``ati_serial``.

    Parameters
    ----------
    rig
        Parameters with sections ``ati_serial`` and ``acquisition``.
    simulator
        Address of the simulated rig that replaces it, or None.

    Attributes
    ----------
    wrench_stale, wrench_saturated, wrench_time_ns
        State of the last reading; the time (``time.monotonic_ns``) is when its newest record was
        read.
    stream : RecordStream
        Stream, with the counts of records and checksum errors.
    status : list of str
        Last status word of the sensor, in words; it can be read only while the sensor does not
        stream, that is in `connect` and `close`.

    Raises
    ------
    DeviceError
        If the profile lacks a section.
    """

    def __init__(self, rig: RigParameters, simulator: SimulatorAddress | None) -> None:
        settings, acquisition = rig.ati_serial, rig.acquisition
        if settings is None or acquisition is None:
            missing = "ati_serial" if settings is None else "acquisition"
            raise DeviceError(
                f"The profile has no section [{missing}], which a sensor on a serial line needs."
            )
        self._settings = settings
        self._port = settings.port
        self._lock_step = False
        if simulator is not None and simulator.serial_port:
            self._port, self._lock_step = simulator.serial_port, simulator.lock_step
        self._name = f"Sensor ATI Digital F/T on {self._port}"
        self._rate_hz = rig.rate_hz
        self._period_ns = 1e9 / rig.rate_hz
        self._bytes_per_tick = settings.records_per_tick(rig.rate_hz) * RECORD_SIZE
        self._weights = settings.weights(rig.rate_hz)
        self._limit = settings.saturation_counts
        self._deadline_ns = int(acquisition.deadline_us * 1e3)
        # Waiting longer for the one record that lacks would let a sensor whose clock is slow drag
        # every tick's sampling instant along, up to the deadline. In lock-step there is no clock.
        self._patience_ns = self._deadline_ns
        if not self._lock_step:
            self._patience_ns = min(self._deadline_ns, int(1e9 / settings.stream_hz))
        self._line: SerialLine | None = None
        self._block: CalibrationBlock | None = None
        self._operator = np.zeros((6, 6 * len(self._weights)))
        self._history = b""
        self._history_size = len(self._weights) * RECORD_SIZE
        self._unpackers: dict[int, Callable[[bytes], tuple[int, ...]]] = {}
        self.stream = RecordStream()
        self.status: list[str] = []
        self._status_word = 0
        self._errors_in_a_row = 0
        self._arrived = 0
        self._arrived_ns = 0
        self._gaps: deque[tuple[int, int]] = deque(maxlen=_GAPS)
        """When the latest blocks came after a gap, and how long it was."""
        # How many bytes should have come by this tick; a record or two less is not a lag.
        self._due = 0
        self._tick_ns: int | None = None
        self._steady_ticks = 0
        self._damages = 0
        self._missing_records = 0
        self._requested_ns = 0
        self._last_read_ns = 0
        self._wrench: Wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.wrench_stale = True
        self.wrench_saturated = False
        self.gauges: tuple[int, ...] = (0,) * 6
        self.wrench_time_ns = 0

    def connect(self) -> None:
        """Open the port, load the calibration and start the stream.

        Raises
        ------
        DeviceError
            If the sensor is absent, not the profile's, not sound, or does not stream.
        """
        self.close()
        self._check_line_rate()
        self._line = SerialLine(self._port, self._settings.baud, self._name)
        try:
            setup = SerialSetup(self._line, self._settings, self._name)
            setup.stop_streaming()
            self._check_status(setup)
            self._block = setup.read_block()
            setup.load_amplifiers(self._block)
            self._check_status(setup)
            rows = self._block.calibration.wrench_per_wire_count()
            self._operator = np.kron(np.array(self._weights), np.array(rows))
            self._start_streaming(setup)
        except BaseException:
            self._release()
            raise

    def calibration(self) -> dict[str, object]:
        """Return identity, calibration and line as found, for the session file.

        Raises
        ------
        DeviceError
            If the sensor is not connected.
        """
        if self._block is None or self._line is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return {
            "sensor": "ATI Digital F/T",
            **self._block.calibration.as_dict(),
            "calibration": self._settings.calibration,
            "gains": list(self._block.gains),
            "offsets": list(self._block.offsets),
            "status": self.status,
            "port": self._port,
            "baud": self._settings.baud,
            "low_latency": self._line.low_latency,
            "stream_hz": self._settings.stream_hz,
            "filter": self._settings.filter,
            "filter_weights": list(self._weights),
        }

    def request(self, due_ns: int) -> None:
        """Begin the tick; the sensor streams, so nothing is sent."""
        now_ns = self._requested_ns = time.monotonic_ns()
        periods = 1
        if self._tick_ns is not None and not self._lock_step:
            periods = max(1, round((due_ns - self._tick_ns) / self._period_ns))
        self._tick_ns = due_ns
        self._due += periods * self._bytes_per_tick
        if now_ns - self._last_read_ns > _IDLE_NS and not self._lock_step:
            # What has piled up is old, and perhaps full of holes: only what comes now counts.
            self._take(self._open_line().read())
            self._history = b""
            self._due = self._arrived - self.stream.pending + RECORD_SIZE

    def read_wrench(self) -> Wrench:
        """Return the wrench in N and N·m: the filter over the newest records.

        Raises
        ------
        DeviceError
            If the line is gone or the sensor reports an error.
        """
        line = self._open_line()
        new = self._take(line.read())
        while self._arrived < self._due:
            lacks_one = self._due - self._arrived <= RECORD_SIZE
            patience_ns = self._patience_ns if lacks_one else self._deadline_ns
            left_ns = self._requested_ns + patience_ns - time.monotonic_ns()
            if left_ns <= 0:
                break
            line.wait(left_ns * 1e-9)
            new += self._take(line.read())
        self._last_read_ns = time.monotonic_ns()
        self.wrench_stale = self._lags(len(new)) or not new
        if self.wrench_stale:
            return self._wrench
        gauges = self._unpack(new)
        self.gauges = gauges[-6:]
        self.wrench_saturated = max(gauges) >= self._limit or min(gauges) <= -self._limit
        return self._filter()

    def _lags(self, new: int) -> bool:
        """Return whether the newest record is a tick or more late, given `new` bytes of records.

        Records that are late catch up. Lost ones do not: where each of some ticks brings its own
        and the gap stays, they count as lost. But nothing counts records: unless what was lost left
        an incomplete one, all later records may be late by as much, and that doubt is reported.
        Less than a tick is the drift between two clocks, or the sensor's phase.
        """
        complete = self._arrived - self.stream.pending
        if self._due - complete >= self._bytes_per_tick:
            in_step = abs(new - self._bytes_per_tick) <= RECORD_SIZE
            self._steady_ticks = self._steady_ticks + 1 if in_step else 0
            if self._steady_ticks < _STEADY_TICKS:
                return True
            if self.stream.checksum_errors == self._damages:
                self._missing_records += (self._due - complete) // RECORD_SIZE
        self._damages = self.stream.checksum_errors
        self._steady_ticks = 0
        self._due = complete
        return False

    def health(self) -> LineHealth:
        """Return the health of the line, and the status word that was read before the stream."""
        return LineHealth(
            bits=self._arrived * _BITS_PER_BYTE,
            bit_rate_bit_s=self._settings.baud,
            errors=self.stream.checksum_errors,
            status=self._status_word,
            doubt=self._doubt,
            doubt_count=self._doubt_count(),
            cause=self._cause(),
        )

    @property
    def _doubt(self) -> str:
        if not self._missing_records:
            return ""
        return (
            f"{self._name}: records did not arrive, or all have been delayed since; the line does "
            "not show which: the wrench may be older than the file states. Check cable and "
            "adapter; reconnecting (rigd reset, or another rigd run) ends it."
        )

    def _doubt_count(self) -> str:
        missing = self._missing_records
        if not missing:
            return ""
        late_ms = 1e3 * missing / self._settings.stream_hz
        return (
            f"{self._name}: records that did not arrive since it was connected: {missing}; or the "
            f"wrench is late by {late_ms:.2g} ms."
        )

    def _cause(self) -> str:
        """Report that the adapter holds records back if the latest arrived in even blocks."""
        now_ns = time.monotonic_ns()
        gaps_ns = sorted(gap for came_ns, gap in self._gaps if now_ns - came_ns < _RECENT_NS)
        if len(gaps_ns) < _FEWEST_GAPS:
            return ""
        middle_ns = gaps_ns[len(gaps_ns) // 2]
        if not 1 / _EVEN < gaps_ns[0] / middle_ns <= gaps_ns[-1] / middle_ns < _EVEN:
            return ""
        return held_back(middle_ns * 1e-9, self._port)

    def measure(self, duration_s: float) -> dict[str, float]:
        """Watch the stream for a while, between `connect` and the first tick.

        Returns
        -------
        dict
            ``records_hz`` (records a second), ``checksum_errors`` and ``dropped_bytes`` (counted
            meanwhile), ``longest_gap_s`` (between arrivals: what the adapter holds back).
            A simulated rig in lock-step streams nothing meanwhile.

        Raises
        ------
        DeviceError
            If the line is gone or the sensor reports an error.
        """
        line, stream = self._open_line(), self.stream
        self._take(line.read())
        records, errors, dropped = stream.records, stream.checksum_errors, stream.dropped_bytes
        begin_ns = last_received_ns = now_ns = time.monotonic_ns()
        end_ns = begin_ns + int(duration_s * 1e9)
        longest_ns = 0
        while now_ns < end_ns:
            line.wait((end_ns - now_ns) * 1e-9)
            data = line.read()
            now_ns = time.monotonic_ns()
            if data or now_ns >= end_ns:
                longest_ns = max(longest_ns, now_ns - last_received_ns)
                last_received_ns = now_ns
                self._take(data)
        self._last_read_ns = now_ns
        return {
            "records_hz": (stream.records - records) / ((now_ns - begin_ns) * 1e-9),
            "checksum_errors": float(stream.checksum_errors - errors),
            "dropped_bytes": float(stream.dropped_bytes - dropped),
            "longest_gap_s": longest_ns * 1e-9,
        }

    def close(self) -> None:
        """Stop the stream, ask the status word once more, and release the port. Never raises."""
        if self._line is not None:
            with suppress(DeviceError):
                setup = SerialSetup(self._line, self._settings, self._name)
                setup.stop_streaming()
                self.status = serial_status(setup.read_status())
        self._release()

    def _release(self) -> None:
        if self._line is not None:
            self._line.close()
        self._line = None

    def _open_line(self) -> SerialLine:
        if self._line is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return self._line

    def _take(self, data: bytes) -> bytes:
        """Split the received bytes into records; return the new ones."""
        if not data:
            return data
        now_ns = time.monotonic_ns()
        gap_ns = now_ns - self._arrived_ns
        if self._arrived_ns and gap_ns > _GAP_PERIODS * self._period_ns:
            self._gaps.append((now_ns, gap_ns))
        self._arrived += len(data)
        self._arrived_ns = now_ns
        new = self.stream.feed(data)
        if new:
            if max(new[RECORD_SIZE - 1 :: RECORD_SIZE]) & ERROR_BIT:
                self._count_errors(new)
            else:
                self._errors_in_a_row = 0
            # Before a tick's worth of records has arrived, the oldest one is repeated.
            history = self._history or new[:RECORD_SIZE] * len(self._weights)
            self._history = (history + new)[-self._history_size :]
        return new

    def _filter(self) -> Wrench:
        """Compute the wrench from the newest records."""
        newest = np.frombuffer(self._history, _RECORD)["gauges"].astype(float)
        fx, fy, fz, tx, ty, tz = (self._operator @ newest.ravel()).tolist()
        self._wrench = wrench = (fx, fy, fz, tx, ty, tz)
        self.wrench_time_ns = self._arrived_ns
        return wrench

    def _count_errors(self, records: bytes) -> None:
        for check in records[RECORD_SIZE - 1 :: RECORD_SIZE]:
            self._errors_in_a_row = self._errors_in_a_row + 1 if check & ERROR_BIT else 0
            if self._errors_in_a_row >= _ERRORS_IN_A_ROW:
                raise DeviceError(
                    f"{self._name}: its records report an error. Run rigd check to read its status "
                    "word."
                )

    def _unpack(self, records: bytes) -> tuple[int, ...]:
        """Return the gauges of some records, without the checksums."""
        n = len(records) // RECORD_SIZE
        unpack = self._unpackers.get(n)
        if unpack is None:
            unpack = self._unpackers[n] = Struct(">" + "6hx" * n).unpack
        return unpack(records)

    def _check_line_rate(self) -> None:
        settings = self._settings
        needed = settings.stream_hz * RECORD_BITS
        if needed > settings.baud:
            raise DeviceError(
                f"{self._name}: {settings.stream_hz:g} records a second need {needed:.0f} bit/s "
                f"on the line, more than {settings.baud} baud; change ati_serial.stream_hz or "
                "ati_serial.baud."
            )
        if settings.stream_hz < self._rate_hz:
            raise DeviceError(
                f"{self._name}: {settings.stream_hz:g} records a second are fewer than the "
                f"loop's {self._rate_hz:g} ticks; change ati_serial.stream_hz or rate_hz."
            )

    def _check_status(self, setup: SerialSetup) -> None:
        word = self._status_word = setup.read_status()
        self.status = serial_status(word)
        if word & SERIAL_CRITICAL:
            raise DeviceError(
                f"{self._name}: its status word {word:#06x} says that "
                f"{'; '.join(serial_status(word & SERIAL_CRITICAL))}. It does not measure "
                "properly: check sensor, cable and supply."
            )

    def _start_streaming(self, setup: SerialSetup) -> None:
        line = self._open_line()
        begun = setup.start_streaming()
        self._history = b""
        self._errors_in_a_row = 0
        self.stream.start(aligned=True)
        before, first = self._arrived, self.stream.records
        self._take(begun)
        end_ns = time.monotonic_ns() + int(_FIRST_RECORDS_TIMEOUT_S * 1e9)
        # A simulated rig in lock-step sends the first records with the first tick.
        while not self._lock_step and self.stream.records - first < len(self._weights):
            if time.monotonic_ns() > end_ns:
                raise DeviceError(
                    f"{self._name}: it was commanded to stream, but of the "
                    f"{self._arrived - before} bytes that came in {_FIRST_RECORDS_TIMEOUT_S} s "
                    f"only {self.stream.records - first} were sound records. Check cable, "
                    "ati_serial.baud and ati_serial.stream_hz."
                )
            line.wait(SILENCE_S)
            self._take(line.read())
        if self._history:
            # Value that is used if the first tick finds no new records.
            self._filter()
        self._last_read_ns = time.monotonic_ns()
        self._due = self._arrived - self.stream.pending
        self._tick_ns = None
        self._steady_ticks = 0
        self._damages = self.stream.checksum_errors
        self._missing_records = 0
