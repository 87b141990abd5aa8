"""Driver of a Digital F/T sensor on a serial line, whose stream is read record by record.

The sensor streams several records per tick of the loop. The profile's decimating filter and the
calibration form one matrix, which is multiplied by the gauge counts of the newest records.
"""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from struct import Struct

import numpy as np

from rigd.devices.ati._calibration import (
    CRITICAL_SERIAL_STATUS_BITS,
    CalibrationBlock,
    describe_serial_status,
)
from rigd.devices.ati._serial_protocol import (
    RECORD_BITS,
    RECORD_ERROR_BIT,
    RECORD_SIZE,
    RecordStream,
)
from rigd.devices.ati._serial_setup import (
    FRAME_SILENCE_S,
    SerialLine,
    SerialSetup,
    describe_adapter_delay,
)
from rigd.devices.contracts import DeviceError, LineHealth, Wrench
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import SimulatorAddress

_FIRST_RECORDS_TIMEOUT_S = 0.5
"""Time in seconds to wait for the first valid records of the stream."""
_MAX_ERROR_RECORDS = 7
"""Number of consecutive records with the error bit set that end a session.

It is above 1 because the checksum does not protect this bit against errors of the line."""
_MAX_TIME_WITHOUT_READ_NS = 20_000_000
"""Time in nanoseconds without reading after which received bytes are discarded.

After a longer time the kernel's buffer of 4 kB may overflow at 91 kB/s, and its content is old."""
_MIN_GAP_PERIODS = 2.5
"""Number of periods without a byte that count as a gap; the stream has several records per
period."""
_STORED_GAPS, _MIN_EVALUATED_GAPS = 8, 4
"""Number of the latest gaps that are stored, and smallest number that is evaluated."""
_MAX_EQUAL_GAP_RATIO = 1.5
"""Largest ratio of a gap to the median gap for which gaps count as equal."""
_MAX_GAP_AGE_NS = 500_000_000
"""Age in nanoseconds up to which a gap is evaluated."""
_STEADY_TICKS_BEFORE_LOSS = 3
"""Number of consecutive ticks that bring only their own records, before missing ones are lost."""

_BITS_PER_BYTE = RECORD_BITS // RECORD_SIZE
"""Number of bits on the line per byte."""
_RECORD_LAYOUT = np.dtype([("gauges", ">i2", 6), ("check", "u1")])
"""Layout of a record as NumPy data type."""


class AtiSerialSensor:
    """Driver of an ATI Digital F/T sensor on a serial line.

    Parameters
    ----------
    rig
        Parameters with sections ``ati_serial`` and ``acquisition``.
    simulator
        Address of the simulated rig that replaces the hardware, or None.

    Attributes
    ----------
    wrench_stale, wrench_saturated, wrench_time_ns
        Whether the last wrench is stale, whether one of its gauges is saturated, and the time in
        nanoseconds (``time.monotonic_ns``) at which its newest record was read.
    stream : RecordStream
        Record stream, which counts records and checksum errors.
    status : list of str
        Descriptions of the set bits of the sensor's last status word. The word can be read only
        while the sensor does not stream, that is in `connect` and `close`.

    Raises
    ------
    DeviceError
        If the profile lacks a section.
    """

    def __init__(self, rig: RigParameters, simulator: SimulatorAddress | None) -> None:
        settings, acquisition = rig.ati_serial, rig.acquisition
        if settings is None or acquisition is None:
            missing_section = "ati_serial" if settings is None else "acquisition"
            raise DeviceError(
                f"The profile has no section [{missing_section}], which a sensor on a serial line "
                "needs."
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
        self._weights = settings.filter_weights(rig.rate_hz)
        self._saturation_counts = settings.saturation_counts
        self._deadline_ns = int(acquisition.deadline_us * 1e3)
        # Waiting longer for a single missing record would let a sensor with a slow clock delay the
        # sampling instant of every tick, up to the deadline. In lock-step there is no clock.
        self._single_record_wait_ns = self._deadline_ns
        if not self._lock_step:
            self._single_record_wait_ns = min(self._deadline_ns, int(1e9 / settings.stream_hz))
        self._line: SerialLine | None = None
        self._calibration_block: CalibrationBlock | None = None
        self._filter_matrix = np.zeros((6, 6 * len(self._weights)))
        self._history = b""
        self._history_size = len(self._weights) * RECORD_SIZE
        self._unpackers: dict[int, Callable[[bytes], tuple[int, ...]]] = {}
        self.stream = RecordStream()
        self.status: list[str] = []
        self._status_word = 0
        self._error_records = 0
        self._arrived_bytes = 0
        self._arrived_ns = 0
        self._latest_gaps: deque[tuple[int, int]] = deque(maxlen=_STORED_GAPS)
        """Time and length in nanoseconds of the latest gaps between arrivals."""
        # Number of bytes that should have arrived by this tick; one or two records less are no lag.
        self._due_bytes = 0
        self._tick_ns: int | None = None
        self._steady_ticks = 0
        self._known_checksum_errors = 0
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
            If the sensor is absent, differs from the profile, reports an error, or does not stream.
        """
        self.close()
        self._check_line_rate()
        self._line = SerialLine(self._port, self._settings.baud, self._name)
        try:
            sensor_setup = SerialSetup(self._line, self._settings, self._name)
            sensor_setup.stop_streaming()
            self._check_status(sensor_setup)
            self._calibration_block = sensor_setup.read_calibration_block()
            sensor_setup.load_amplifier_settings(self._calibration_block)
            self._check_status(sensor_setup)
            wire_count_matrix = self._calibration_block.calibration.wrench_per_wire_count()
            self._filter_matrix = np.kron(np.array(self._weights), np.array(wire_count_matrix))
            self._start_streaming(sensor_setup)
        except BaseException:
            self._close_port()
            raise

    def calibration(self) -> dict[str, object]:
        """Return identity, calibration and line settings of the sensor, for the session file.

        Raises
        ------
        DeviceError
            If the sensor is not connected.
        """
        if self._calibration_block is None or self._line is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return {
            "sensor": "ATI Digital F/T",
            **self._calibration_block.calibration.as_dict(),
            "calibration": self._settings.calibration,
            "gains": list(self._calibration_block.amplifier_gains),
            "offsets": list(self._calibration_block.amplifier_offsets),
            "status": self.status,
            "port": self._port,
            "baud": self._settings.baud,
            "low_latency": self._line.low_latency,
            "stream_hz": self._settings.stream_hz,
            "filter": self._settings.filter,
            "filter_weights": list(self._weights),
        }

    def request(self, due_ns: int) -> None:
        """Begin a tick that was due at `due_ns`; nothing is sent, because the sensor streams."""
        now_ns = self._requested_ns = time.monotonic_ns()
        elapsed_periods = 1
        if self._tick_ns is not None and not self._lock_step:
            elapsed_periods = max(1, round((due_ns - self._tick_ns) / self._period_ns))
        self._tick_ns = due_ns
        self._due_bytes += elapsed_periods * self._bytes_per_tick
        if now_ns - self._last_read_ns > _MAX_TIME_WITHOUT_READ_NS and not self._lock_step:
            # Queued bytes are old and may have gaps: only bytes that arrive from now on count.
            self._split_records(self._open_line().read())
            self._history = b""
            self._due_bytes = self._arrived_bytes - self.stream.pending_byte_count + RECORD_SIZE

    def read_wrench(self) -> Wrench:
        """Return the wrench in N and N·m, filtered from the newest records.

        Raises
        ------
        DeviceError
            If the line has failed or the sensor reports an error.
        """
        serial_line = self._open_line()
        new_records = self._split_records(serial_line.read())
        while self._arrived_bytes < self._due_bytes:
            lacks_one_record = self._due_bytes - self._arrived_bytes <= RECORD_SIZE
            wait_limit_ns = self._single_record_wait_ns if lacks_one_record else self._deadline_ns
            remaining_ns = self._requested_ns + wait_limit_ns - time.monotonic_ns()
            if remaining_ns <= 0:
                break
            serial_line.wait(remaining_ns * 1e-9)
            new_records += self._split_records(serial_line.read())
        self._last_read_ns = time.monotonic_ns()
        self.wrench_stale = self._is_lagging(len(new_records)) or not new_records
        if self.wrench_stale:
            return self._wrench
        gauge_counts = self._unpack_gauges(new_records)
        self.gauges = gauge_counts[-6:]
        self.wrench_saturated = (
            max(gauge_counts) >= self._saturation_counts
            or min(gauge_counts) <= -self._saturation_counts
        )
        return self._filtered_wrench()

    def _is_lagging(self, new_byte_count: int) -> bool:
        """Return whether the newest record is a tick or more late.

        `new_byte_count` is the number of bytes received in this tick. Late records arrive in
        addition to those of later ticks, lost records do not. If some consecutive ticks bring only
        their own records, the missing records count as lost. Since records have no counter, all
        later records may instead be delayed, unless the loss left an incomplete record. This doubt
        is reported. A lag below one tick is caused by the drift between two clocks, or by the
        sensor's phase.
        """
        bytes_in_complete_records = self._arrived_bytes - self.stream.pending_byte_count
        if self._due_bytes - bytes_in_complete_records >= self._bytes_per_tick:
            has_only_own_records = abs(new_byte_count - self._bytes_per_tick) <= RECORD_SIZE
            self._steady_ticks = self._steady_ticks + 1 if has_only_own_records else 0
            if self._steady_ticks < _STEADY_TICKS_BEFORE_LOSS:
                return True
            if self.stream.checksum_errors == self._known_checksum_errors:
                self._missing_records += (
                    self._due_bytes - bytes_in_complete_records
                ) // RECORD_SIZE
        self._known_checksum_errors = self.stream.checksum_errors
        self._steady_ticks = 0
        self._due_bytes = bytes_in_complete_records
        return False

    def health(self) -> LineHealth:
        """Return load and errors of the serial line, and the sensor's status word.

        The status word was read before the stream started.
        """
        return LineHealth(
            bits=self._arrived_bytes * _BITS_PER_BYTE,
            bit_rate_bit_s=self._settings.baud,
            errors=self.stream.checksum_errors,
            status=self._status_word,
            doubt=self._age_doubt,
            doubt_count=self._missing_records_sentence(),
            cause=self._describe_adapter_delay_cause(),
        )

    @property
    def _age_doubt(self) -> str:
        """Reason why the wrench may be older than stated; empty text if no records are missing."""
        if not self._missing_records:
            return ""
        return (
            f"{self._name}: records did not arrive, or all have been delayed since; the line does "
            "not show which: the wrench may be older than the file states. Check cable and "
            "adapter; reconnecting (rigd reset, or another rigd run) ends it."
        )

    def _missing_records_sentence(self) -> str:
        """Return a sentence with the number of missing records; empty if none are missing."""
        missing_record_count = self._missing_records
        if not missing_record_count:
            return ""
        possible_delay_ms = 1e3 * missing_record_count / self._settings.stream_hz
        return (
            f"{self._name}: records that did not arrive since it was connected: "
            f"{missing_record_count}; or the wrench is late by {possible_delay_ms:.2g} ms."
        )

    def _describe_adapter_delay_cause(self) -> str:
        """Return a message that a USB adapter delays the records, or an empty text.

        The adapter is recognised by records that arrive in blocks at regular intervals.
        """
        now_ns = time.monotonic_ns()
        gaps_ns = sorted(
            gap for arrival_ns, gap in self._latest_gaps if now_ns - arrival_ns < _MAX_GAP_AGE_NS
        )
        if len(gaps_ns) < _MIN_EVALUATED_GAPS:
            return ""
        median_gap_ns = gaps_ns[len(gaps_ns) // 2]
        if (
            not 1 / _MAX_EQUAL_GAP_RATIO
            < gaps_ns[0] / median_gap_ns
            <= gaps_ns[-1] / median_gap_ns
            < _MAX_EQUAL_GAP_RATIO
        ):
            return ""
        return describe_adapter_delay(median_gap_ns * 1e-9, self._port)

    def measure(self, duration_s: float) -> dict[str, float]:
        """Receive the stream for a while and return statistics; call it before the first tick.

        Returns
        -------
        dict
            ``records_hz`` (records per second), ``checksum_errors`` and ``dropped_bytes`` (numbers
            in this time), ``longest_gap_s`` (longest time between arrivals, caused by the adapter).
            A simulated rig in lock-step streams nothing in this time.

        Raises
        ------
        DeviceError
            If the line has failed or the sensor reports an error.
        """
        serial_line, record_stream = self._open_line(), self.stream
        self._split_records(serial_line.read())
        records_before, errors_before, dropped_before = (
            record_stream.records,
            record_stream.checksum_errors,
            record_stream.dropped_bytes,
        )
        begin_ns = last_received_ns = now_ns = time.monotonic_ns()
        end_ns = begin_ns + int(duration_s * 1e9)
        longest_gap_ns = 0
        while now_ns < end_ns:
            serial_line.wait((end_ns - now_ns) * 1e-9)
            received_bytes = serial_line.read()
            now_ns = time.monotonic_ns()
            if received_bytes or now_ns >= end_ns:
                longest_gap_ns = max(longest_gap_ns, now_ns - last_received_ns)
                last_received_ns = now_ns
                self._split_records(received_bytes)
        self._last_read_ns = now_ns
        return {
            "records_hz": (record_stream.records - records_before) / ((now_ns - begin_ns) * 1e-9),
            "checksum_errors": float(record_stream.checksum_errors - errors_before),
            "dropped_bytes": float(record_stream.dropped_bytes - dropped_before),
            "longest_gap_s": longest_gap_ns * 1e-9,
        }

    def close(self) -> None:
        """Stop the stream, read the status word once more, and release the port; never raises."""
        if self._line is not None:
            with suppress(DeviceError):
                sensor_setup = SerialSetup(self._line, self._settings, self._name)
                sensor_setup.stop_streaming()
                self.status = describe_serial_status(sensor_setup.read_status())
        self._close_port()

    def _close_port(self) -> None:
        """Close the serial port."""
        if self._line is not None:
            self._line.close()
        self._line = None

    def _open_line(self) -> SerialLine:
        """Return the open serial line, or raise if the sensor is not connected."""
        if self._line is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return self._line

    def _split_records(self, received_bytes: bytes) -> bytes:
        """Split received bytes into records; return the new complete records."""
        if not received_bytes:
            return received_bytes
        now_ns = time.monotonic_ns()
        gap_ns = now_ns - self._arrived_ns
        if self._arrived_ns and gap_ns > _MIN_GAP_PERIODS * self._period_ns:
            self._latest_gaps.append((now_ns, gap_ns))
        self._arrived_bytes += len(received_bytes)
        self._arrived_ns = now_ns
        new_records = self.stream.feed(received_bytes)
        if new_records:
            if max(new_records[RECORD_SIZE - 1 :: RECORD_SIZE]) & RECORD_ERROR_BIT:
                self._count_error_records(new_records)
            else:
                self._error_records = 0
            # Before a tick's worth of records has arrived, the oldest one is repeated.
            previous_records = self._history or new_records[:RECORD_SIZE] * len(self._weights)
            self._history = (previous_records + new_records)[-self._history_size :]
        return new_records

    def _filtered_wrench(self) -> Wrench:
        """Compute, store and return the filtered wrench, in N and N·m, from the newest records."""
        newest_gauges = np.frombuffer(self._history, _RECORD_LAYOUT)["gauges"].astype(float)
        fx, fy, fz, tx, ty, tz = (self._filter_matrix @ newest_gauges.ravel()).tolist()
        self._wrench = wrench = (fx, fy, fz, tx, ty, tz)
        self.wrench_time_ns = self._arrived_ns
        return wrench

    def _count_error_records(self, records: bytes) -> None:
        """Count consecutive records with the error bit, and raise if there are too many."""
        for check_byte in records[RECORD_SIZE - 1 :: RECORD_SIZE]:
            self._error_records = self._error_records + 1 if check_byte & RECORD_ERROR_BIT else 0
            if self._error_records >= _MAX_ERROR_RECORDS:
                raise DeviceError(
                    f"{self._name}: its records report an error. Run rigd check to read its status "
                    "word."
                )

    def _unpack_gauges(self, records: bytes) -> tuple[int, ...]:
        """Return the gauge counts in the given records, six per record, in wire order."""
        record_count = len(records) // RECORD_SIZE
        unpack_counts = self._unpackers.get(record_count)
        if unpack_counts is None:
            unpack_counts = self._unpackers[record_count] = Struct(
                ">" + "6hx" * record_count
            ).unpack
        return unpack_counts(records)

    def _check_line_rate(self) -> None:
        """Raise if the line is too slow for the stream, or the stream is slower than the loop."""
        settings = self._settings
        stream_bit_s = settings.stream_hz * RECORD_BITS
        if stream_bit_s > settings.baud:
            raise DeviceError(
                f"{self._name}: {settings.stream_hz:g} records a second need {stream_bit_s:.0f} "
                f"bit/s on the line, more than {settings.baud} baud; change ati_serial.stream_hz "
                "or ati_serial.baud."
            )
        if settings.stream_hz < self._rate_hz:
            raise DeviceError(
                f"{self._name}: {settings.stream_hz:g} records a second are fewer than the "
                f"loop's {self._rate_hz:g} ticks; change ati_serial.stream_hz or rate_hz."
            )

    def _check_status(self, sensor_setup: SerialSetup) -> None:
        """Read the status word, and raise if it has a critical bit."""
        status_word = self._status_word = sensor_setup.read_status()
        self.status = describe_serial_status(status_word)
        if status_word & CRITICAL_SERIAL_STATUS_BITS:
            raise DeviceError(
                f"{self._name}: its status word {status_word:#06x} says that "
                f"{'; '.join(describe_serial_status(status_word & CRITICAL_SERIAL_STATUS_BITS))}. "
                "It does not measure properly: check sensor, cable and supply."
            )

    def _start_streaming(self, sensor_setup: SerialSetup) -> None:
        """Start the stream and wait for the first valid records, or raise."""
        serial_line = self._open_line()
        first_stream_bytes = sensor_setup.start_streaming()
        self._history = b""
        self._error_records = 0
        self.stream.start(starts_at_record=True)
        bytes_before, records_before = self._arrived_bytes, self.stream.records
        self._split_records(first_stream_bytes)
        end_ns = time.monotonic_ns() + int(_FIRST_RECORDS_TIMEOUT_S * 1e9)
        # A simulated rig in lock-step sends the first records with the first tick.
        while not self._lock_step and self.stream.records - records_before < len(self._weights):
            if time.monotonic_ns() > end_ns:
                raise DeviceError(
                    f"{self._name}: it was commanded to stream, but of the "
                    f"{self._arrived_bytes - bytes_before} bytes that came in "
                    f"{_FIRST_RECORDS_TIMEOUT_S} s only {self.stream.records - records_before} "
                    "were valid records. Check cable, ati_serial.baud and ati_serial.stream_hz."
                )
            serial_line.wait(FRAME_SILENCE_S)
            self._split_records(serial_line.read())
        if self._history:
            # Value that is used if the first tick finds no new records.
            self._filtered_wrench()
        self._last_read_ns = time.monotonic_ns()
        self._due_bytes = self._arrived_bytes - self.stream.pending_byte_count
        self._tick_ns = None
        self._steady_ticks = 0
        self._known_checksum_errors = self.stream.checksum_errors
        self._missing_records = 0
