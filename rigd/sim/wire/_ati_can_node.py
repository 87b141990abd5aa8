"""The simulated ATI sensor behind a NETCANOEM box: it answers requests, and sends nothing else.

Requests and replies use one range of sixteen identifiers, base · 16 + opcode; everything on the
wire is big-endian. Behaviour that is not documented for the box is defined here:

* a request with an unknown opcode, of another length, or with an index that cannot be (axis or
  diagnostic channel above 5, calibration above 15, base above 0x7F) gets no reply;
* after power-up or a reset calibration 0 is active; after a reset, by request or by its watchdog,
  bit 0 of the status is set as well, up to the next power-up;
* a calibration that is not in the box is selected and echoed all the same, but from then on bit 6
  of the status is set and the matrix reads as not-a-number, as erased memory does; serial number,
  units and counts do not depend on the calibration;
* counts per unit and units are reported from firmware 3.7 on, the diagnostic channels from 3.8 on;
  older firmware does not answer these requests;
* a new base is acknowledged under the old one and holds from the next power-up on; a new bit rate
  is acknowledged and changes nothing here, where there is none.
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

_STATUS_AND_EVEN = Struct(">H3h").pack
_ODD = Struct(">3h").pack
_ELEMENTS = Struct(">2f").pack
_COUNTS = Struct(">2I").pack
_WORD = Struct(">H").pack
_FIRMWARE = Struct(">BBH").pack

_WATCHDOG_RESET = 1 << 0
_BAD_CALIBRATION = 1 << 6
_ANY_ERROR = 1 << 15
_ERASED_ROW = (float("nan"),) * 6
_DIAGNOSTICS = (32768, 0, 21450, 43690, 32771, 12)
"""Mid of the gauges' supply, unused, thermistor, power, excitation, ground: raw ADC values."""
_FIRST_WITH_COUNTS = (3, 7)
"""Older firmware knows no request for counts per unit, which are 1 000 000 each, or for units."""
_FIRST_WITH_DIAGNOSTICS = (3, 8)


class AtiCanNode:
    """A NETCANOEM box with a sensor.

    Parameters
    ----------
    rig
        With a section ``ati_can``: base, serial number (FT12345 if empty) and calibration.
    simulated
        Simulated sensor: one reading for each request.
    send
        Takes identifier and data of a reply.
    log
        Called ``log("sensor", what, **values)`` when the box is set or reset.
    firmware
        Major, minor, build; before 3.7 the box reports neither counts per unit nor units.
    calibrations
        Indices that hold a calibration; the profile's alone if not given.
    counts_per_unit
        Per N and per N·m; 1 000 000 each with a firmware before 3.7.

    Attributes
    ----------
    gauges : AtiGauges
        The calibration that is served.
    frozen : bool
        Whether the box neither answers nor receives.
    saturate : int or None
        This gauge reads ±32767.
    status_bits : int
        Set in the status word on top of what the box finds itself; bit 15 follows. They stay
        until they are taken away, a reset notwithstanding.

    Raises
    ------
    DeviceError
        If the profile has no section ``ati_can``.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated: SimulatedRig,
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
        reports_counts = firmware[:2] >= _FIRST_WITH_COUNTS
        self.gauges = AtiGauges(rig.sensor, counts_per_unit if reports_counts else COUNTS_PER_UNIT)
        self.frozen = False
        self.saturate: int | None = None
        self.status_bits = 0
        self._measure = simulated.sensor.measure
        self._send = send
        self._log = log
        self._firmware = firmware
        self._calibrations = (
            {settings.calibration} if calibrations is None else frozenset(calibrations)
        )
        self._active = 0
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
            0xD: (1, self._set_base),
            0xE: (1, self._set_baud),
            0xF: (0, self._read_firmware),
        }
        if reports_counts:
            self._requests[0x7] = (0, self._read_counts_per_unit)
            self._requests[0x8] = (0, self._read_units)
        if firmware[:2] >= _FIRST_WITH_DIAGNOSTICS:
            self._requests[0x9] = (1, self._read_diagnostic)

    def receive(self, can_id: int, data: bytes) -> None:
        """Receive a frame."""
        if can_id >> 4 != self._base or self.frozen:
            return
        request = self._requests.get(can_id & 0xF)
        if request is not None and len(data) == request[0]:
            request[1](data)

    def tick(self, now_s: float) -> None:
        """Nothing here takes time: the box only answers."""

    def reset(self) -> None:
        """Restart, by its watchdog or on request."""
        self._active = 0
        self._was_reset = True
        self._log("sensor", "reset")

    def power_cycle(self) -> None:
        """Simulate a power cycle."""
        self._active = 0
        self._was_reset = False
        self._base = self._next_base
        self._log("sensor", "power-up", base_id=self._base)

    def _reply(self, opcode: int, data: bytes) -> None:
        self._send(self._base << 4 | opcode, data)

    def _read_gauges(self, _: bytes) -> None:
        g0, g1, g2, g3, g4, g5 = self.gauges.read((self._measure(),), self.saturate)[0].tolist()
        status = self.status_bits & 0xFFFF
        if self._was_reset:
            status |= _WATCHDOG_RESET
        if self._active not in self._calibrations:
            status |= _BAD_CALIBRATION
        if status:
            status |= _ANY_ERROR
        self._reply(0x0, _STATUS_AND_EVEN(status, g0, g2, g4))
        self._reply(0x1, _ODD(g1, g3, g5))

    def _read_matrix_row(self, data: bytes) -> None:
        axis = data[0]
        if axis > 5:
            return
        known = self._active in self._calibrations
        row = self.gauges.matrix[axis].tolist() if known else _ERASED_ROW
        for opcode, first in ((0x2, 0), (0x3, 2), (0x4, 4)):
            self._reply(opcode, _ELEMENTS(row[first], row[first + 1]))

    def _read_serial_number(self, _: bytes) -> None:
        self._reply(0x5, self._serial_number)

    def _set_calibration(self, data: bytes) -> None:
        index = data[0]
        if index > 15:
            return
        self._active = index
        self._log("sensor", "calibration set", index=index, present=index in self._calibrations)
        self._reply(0x6, data)

    def _read_counts_per_unit(self, _: bytes) -> None:
        self._reply(0x7, _COUNTS(*self.gauges.counts_per_unit))

    def _read_units(self, _: bytes) -> None:
        self._reply(0x8, bytes((UNIT_NEWTON, UNIT_NEWTON_METRE)))

    def _read_diagnostic(self, data: bytes) -> None:
        if data[0] < len(_DIAGNOSTICS):
            self._reply(0x9, _WORD(_DIAGNOSTICS[data[0]]))

    def _reset(self, _: bytes) -> None:
        self.reset()

    def _set_base(self, data: bytes) -> None:
        if data[0] > 0x7F:
            return
        self._reply(0xD, b"")
        self._next_base = data[0]
        self._log("sensor", "base identifier set", base_id=data[0])

    def _set_baud(self, data: bytes) -> None:
        self._log("sensor", "baud set", divisor=data[0], bitrate_bit_s=2_000_000 / (data[0] + 1))
        self._reply(0xE, b"")

    def _read_firmware(self, _: bytes) -> None:
        self._reply(0xF, _FIRMWARE(*self._firmware))
