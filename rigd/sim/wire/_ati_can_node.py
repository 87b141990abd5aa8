"""Simulated ATI sensor with a NETCANOEM box, which only answers requests.

Requests and replies use sixteen consecutive identifiers, base · 16 + opcode. Numbers are
big-endian. The following behaviour, which is not documented for the box, is defined here:

* a request with an unknown opcode, a wrong length or an invalid index (axis or diagnostic channel
  above 5, calibration above 15, base above 0x7F) gets no reply;
* after power-up or a reset calibration 0 is active; after a reset, by request or by its watchdog,
  bit 0 of the status is set as well, up to the next power-up;
* a calibration that is not in the box is selected and confirmed nevertheless, but from then on bit
  6 of the status is set and the matrix reads as not-a-number, like erased memory; serial number,
  units and counts do not depend on the calibration;
* counts per unit and units are reported from firmware 3.7 on, the diagnostic channels from 3.8 on;
  older firmware does not answer these requests;
* a new base is acknowledged with the old one and is used from the next power-up on; a new bit rate
  is acknowledged and has no effect, since the simulated bus has no bit rate.
"""

from collections.abc import Callable, Collection
from struct import Struct

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters
from rigd.sim import SimulatedRig
from rigd.sim.wire._ati_gauges import (
    COUNTS_PER_UNIT,
    SERIAL_NUMBER,
    UNIT_NEWTON,
    UNIT_NEWTON_METRE,
    AtiGauges,
)

_pack_status_and_even_gauges = Struct(">H3h").pack
"""Pack status word and gauges 0, 2, 4."""
_pack_odd_gauges = Struct(">3h").pack
"""Pack gauges 1, 3, 5."""
_pack_matrix_entries = Struct(">2f").pack
"""Pack two entries of the matrix."""
_pack_counts_per_unit = Struct(">2I").pack
"""Pack the counts per unit of force and torque."""
_pack_diagnostic_value = Struct(">H").pack
"""Pack a 16-bit word."""
_pack_firmware = Struct(">BBH").pack
"""Pack major, minor and build number of the firmware."""

_WATCHDOG_RESET_BIT = 1 << 0
"""Status bit: the watchdog has reset the box."""
_BAD_CALIBRATION_BIT = 1 << 6
"""Status bit: the active calibration is bad."""
_ANY_ERROR_BIT = 1 << 15
"""Status bit that is set if any other is set."""
_ERASED_MATRIX_ROW = (float("nan"),) * 6
"""Row of the matrix of a calibration that is not in the box."""
_DIAGNOSTIC_VALUES = (32768, 0, 21450, 43690, 32771, 12)
"""Raw ADC values of the diagnostic channels.

They are middle of the gauges' supply, unused, thermistor, power, excitation, ground."""
_FIRST_FIRMWARE_WITH_COUNTS = (3, 7)
"""First firmware (major, minor) that reports counts per unit and unit codes.

Older firmware has 1 000 000 counts per unit."""
_FIRST_FIRMWARE_WITH_DIAGNOSTICS = (3, 8)
"""First firmware (major, minor) that reports the diagnostic channels."""


class AtiCanNode:
    """Simulated NETCANOEM box with a sensor, on the simulated CAN bus.

    The profile needs a section ``ati_can``: base, serial number (FT12345 if empty) and calibration.
    The sensor of the simulated rig takes one reading per request. `send` sends a reply with
    identifier and data. ``log("sensor", what, **values)`` is called when the box is configured or
    reset.

    `firmware` is the major, minor and build number; before 3.7 the box reports neither counts per
    unit nor units. `calibrations` are the indices of the calibrations in the box; None: only that
    of the profile. `counts_per_unit` are the counts per N and per N·m; 1 000 000 each with a
    firmware before 3.7. The constructor raises `DeviceError` if the profile has no section
    ``ati_can``.

    Attributes
    ----------
    gauges : AtiGauges
        Gauges of the sensor, with its calibration matrix.
    frozen : bool
        Whether the box neither receives nor answers.
    saturate : int or None
        Number of a gauge that reads ±32767; None: none.
    status_bits : int
        Bits set in the status word in addition to those that the box sets itself, which include bit
        15 if any other is set. They remain until they are cleared, even after a reset.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated_rig: SimulatedRig,
        send: Callable[[int, bytes], None],
        log: Callable[..., None],
        *,
        firmware: tuple[int, int, int] = (3, 8, 2),
        calibrations: Collection[int] | None = None,
        counts_per_unit: tuple[int, int] = COUNTS_PER_UNIT,
    ) -> None:
        settings = rig.ati_can
        if settings is None:
            raise DeviceError(
                "The profile has no section [ati_can], which the simulated sensor on CAN needs; "
                "copy it from a profile that has one."
            )
        reports_counts_per_unit = firmware[:2] >= _FIRST_FIRMWARE_WITH_COUNTS
        self.gauges = AtiGauges(
            rig.sensor, counts_per_unit if reports_counts_per_unit else COUNTS_PER_UNIT
        )
        self.frozen = False
        self.saturate: int | None = None
        self.status_bits = 0
        self._measure = simulated_rig.sensor.measure
        self._send = send
        self._log = log
        self._firmware = firmware
        self._calibrations = (
            {settings.calibration} if calibrations is None else frozenset(calibrations)
        )
        self._active_calibration = 0
        self._was_reset = False
        self._base = self._next_base = settings.base_id
        serial_number = settings.serial_number or SERIAL_NUMBER
        self._serial_number = serial_number.encode("ascii", "replace")[:8].ljust(8, b"\0")
        self._requests: dict[int, tuple[int, Callable[[bytes], None]]] = {
            0x0: (0, self._read_gauges),
            0x2: (1, self._read_matrix_row),
            0x5: (0, self._read_serial_number),
            0x6: (1, self._set_calibration),
            0xC: (0, self._reset),
            0xD: (1, self._set_base_identifier),
            0xE: (1, self._set_bit_rate),
            0xF: (0, self._read_firmware),
        }
        if reports_counts_per_unit:
            self._requests[0x7] = (0, self._read_counts_per_unit)
            self._requests[0x8] = (0, self._read_units)
        if firmware[:2] >= _FIRST_FIRMWARE_WITH_DIAGNOSTICS:
            self._requests[0x9] = (1, self._read_diagnostic)

    def receive(self, can_id: int, data: bytes) -> None:
        """Process a received CAN frame: answer a valid request."""
        if can_id >> 4 != self._base or self.frozen:
            return
        request_handler = self._requests.get(can_id & 0xF)
        if request_handler is not None and len(data) == request_handler[0]:
            request_handler[1](data)

    def tick(self, now_s: float) -> None:
        """Do nothing: the NETCANOEM box only answers requests."""

    def reset(self) -> None:
        """Restart the NETCANOEM box, by its watchdog or on request."""
        self._active_calibration = 0
        self._was_reset = True
        self._log("sensor", "reset")

    def power_cycle(self) -> None:
        """Restart the box as after a loss of power."""
        self._active_calibration = 0
        self._was_reset = False
        self._base = self._next_base
        self._log("sensor", "power-up", base_id=self._base)

    def _reply(self, opcode: int, data: bytes) -> None:
        """Send a reply with an opcode and data."""
        self._send(self._base << 4 | opcode, data)

    def _read_gauges(self, _: bytes) -> None:
        """Answer a poll with two frames: status word and gauges."""
        g0, g1, g2, g3, g4, g5 = self.gauges.read_counts((self._measure(),), self.saturate)[
            0
        ].tolist()
        status_word = self.status_bits & 0xFFFF
        if self._was_reset:
            status_word |= _WATCHDOG_RESET_BIT
        if self._active_calibration not in self._calibrations:
            status_word |= _BAD_CALIBRATION_BIT
        if status_word:
            status_word |= _ANY_ERROR_BIT
        self._reply(0x0, _pack_status_and_even_gauges(status_word, g0, g2, g4))
        self._reply(0x1, _pack_odd_gauges(g1, g3, g5))

    def _read_matrix_row(self, request_data: bytes) -> None:
        """Answer a request for a row of the calibration matrix with three frames."""
        axis_index = request_data[0]
        if axis_index > 5:
            return
        is_calibration_known = self._active_calibration in self._calibrations
        matrix_row = (
            self.gauges.matrix[axis_index].tolist() if is_calibration_known else _ERASED_MATRIX_ROW
        )
        for opcode, first_entry in ((0x2, 0), (0x3, 2), (0x4, 4)):
            self._reply(
                opcode, _pack_matrix_entries(matrix_row[first_entry], matrix_row[first_entry + 1])
            )

    def _read_serial_number(self, _: bytes) -> None:
        """Answer a request for the serial number."""
        self._reply(0x5, self._serial_number)

    def _set_calibration(self, request_data: bytes) -> None:
        """Select a calibration by its index, and confirm it."""
        calibration_index = request_data[0]
        if calibration_index > 15:
            return
        self._active_calibration = calibration_index
        self._log(
            "sensor",
            "calibration set",
            index=calibration_index,
            present=calibration_index in self._calibrations,
        )
        self._reply(0x6, request_data)

    def _read_counts_per_unit(self, _: bytes) -> None:
        """Answer a request for the counts per unit of force and torque."""
        self._reply(0x7, _pack_counts_per_unit(*self.gauges.counts_per_unit))

    def _read_units(self, _: bytes) -> None:
        """Answer a request for the unit codes of force and torque."""
        self._reply(0x8, bytes((UNIT_NEWTON, UNIT_NEWTON_METRE)))

    def _read_diagnostic(self, request_data: bytes) -> None:
        """Answer a request for the raw value of a diagnostic channel."""
        if request_data[0] < len(_DIAGNOSTIC_VALUES):
            self._reply(0x9, _pack_diagnostic_value(_DIAGNOSTIC_VALUES[request_data[0]]))

    def _reset(self, _: bytes) -> None:
        """Reset the box on request."""
        self.reset()

    def _set_base_identifier(self, request_data: bytes) -> None:
        """Store a new identifier base for the next power-up, and confirm it."""
        if request_data[0] > 0x7F:
            return
        self._reply(0xD, b"")
        self._next_base = request_data[0]
        self._log("sensor", "base identifier set", base_id=request_data[0])

    def _set_bit_rate(self, request_data: bytes) -> None:
        """Confirm a new bit rate, which has no effect here."""
        self._log(
            "sensor",
            "baud set",
            divisor=request_data[0],
            bitrate_bit_s=2_000_000 / (request_data[0] + 1),
        )
        self._reply(0xE, b"")

    def _read_firmware(self, _: bytes) -> None:
        """Answer a request for the version of the firmware."""
        self._reply(0xF, _pack_firmware(*self._firmware))
