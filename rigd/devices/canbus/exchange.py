"""The cyclic exchange on one port: who gets which frame, and waiting for replies."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rigd.devices.canbus.frame import BUS_OFF, ERROR_FLAG, ERROR_MASK, LENGTH_AT, read_head
from rigd.devices.canbus.load import FRAME_BITS
from rigd.devices.canbus.port import CanPort
from rigd.devices.contracts import DeviceError

Handler = Callable[[bytes], None]

# linux/can/error.h: class in the identifier, state of the controller in data[1].
_CONTROLLER = 0x04
_CONTROLLER_STATE = 1
_PASSIVE = 0x30
_NO_ACKNOWLEDGE = 0x20

_FAILURES_SKIPPED = 10
"""Failures to receive that one drain bears in `regardless`: an adapter may have several queued."""
_FAILURES_WAITED = 100
"""Likewise of one wait."""
_FAILURE_PAUSE_S = 0.001


class CanExchange:
    """Routes the frames of a port to the drivers that share it.

    Parameters
    ----------
    port
        Open.

    Attributes
    ----------
    error_frames : int
        How often the controller reported a disturbance.
    bits : int
        Of all frames sent and received, nothing stuffed.
    """

    def __init__(self, port: CanPort) -> None:
        self.port = port
        self.bits = 0
        self._send = port.send
        self._receive = port.receive
        self._handlers: dict[int, Handler] = {}
        self.error_frames = 0
        self._trouble = ""
        self._regardless = False

    def send(self, frame: bytes) -> None:
        """Send a frame of the kernel's ``struct can_frame``; raises as the port does."""
        self._send(frame)
        self.bits += FRAME_BITS + 8 * frame[LENGTH_AT]

    def subscribe(self, can_id: int, handler: Handler) -> None:
        """Have a handler called with the data of each frame of this identifier.

        Raises
        ------
        DeviceError
            If another driver takes these frames already.
        """
        if can_id in self._handlers:
            raise DeviceError(
                f"CAN bus {self.port.name}: two devices use the identifier {can_id:#x}; give one "
                "of them another base or node id in the profile."
            )
        self._handlers[can_id] = handler

    def start(self) -> None:
        """Drop what is queued, and have the port let in only what somebody subscribed to."""
        self.port.accept(self._handlers)
        while self._receive() is not None:
            pass

    @contextmanager
    def regardless(self) -> Iterator[None]:
        """Within this block receiving raises nothing, whatever bus and adapter have reported.

        It is for switching a drive off. An error-passive controller goes on sending, and a frame
        that nobody acknowledged is sent again; what the drive then answers has to be taken, and
        SYNC sent, for the torque of an RPDO acts at the next one. `send` raises as ever, for the
        frame that the bus does not take.
        """
        before, self._regardless = self._regardless, True
        try:
            yield
        finally:
            self._regardless = before

    def drain(self) -> None:
        """Deliver everything that has arrived.

        Raises
        ------
        DeviceError
            If the bus is gone, or its controller has switched itself off or reports that it cannot
            send; not within `regardless`.
        """
        if not self._regardless:
            self._deliver()
            if self._trouble:
                raise DeviceError(self._trouble)
            return
        for _ in range(_FAILURES_SKIPPED):
            try:
                self._deliver()
            except Exception:  # an adapter's library may raise anything
                continue
            return

    def _deliver(self) -> None:
        receive, handlers = self._receive, self._handlers
        while (raw := receive()) is not None:
            can_id, length = read_head(raw)
            handler = handlers.get(can_id)
            if handler is not None:
                self.bits += FRAME_BITS + 8 * length
                handler(raw[8 : 8 + length])
            elif can_id & ERROR_FLAG:
                self._note_error(can_id & ERROR_MASK, raw[8:16])

    def wait_until(self, ready: Callable[[], bool], deadline_ns: int) -> bool:
        """Deliver frames until `ready` says yes, or until a time of ``time.monotonic_ns``.

        Returns
        -------
        bool
            Whether it is ready.
        """
        failures = 0
        self.drain()
        while not ready():
            left_ns = deadline_ns - time.monotonic_ns()
            if left_ns <= 0:
                return False
            try:
                self.port.wait(left_ns * 1e-9)
            except Exception:
                failures += 1
                if not self._regardless:
                    raise
                if failures > _FAILURES_WAITED:
                    return False  # the adapter is gone
                time.sleep(min(_FAILURE_PAUSE_S, left_ns * 1e-9))
            self.drain()
        return True

    def _note_error(self, kind: int, data: bytes) -> None:
        self.error_frames += 1
        if kind & BUS_OFF:
            self._trouble = (
                f"CAN bus {self.port.name}: the controller is off the bus (bus-off) after too "
                "many errors; look at cable, termination and bit rate, then bring it up again."
            )
        elif kind & _NO_ACKNOWLEDGE:
            self._trouble = (
                f"CAN bus {self.port.name}: nobody acknowledges our frames; look at cable, "
                "termination, power and bit rate."
            )
        elif kind & _CONTROLLER and data[_CONTROLLER_STATE] & _PASSIVE:
            self._trouble = (
                f"CAN bus {self.port.name}: the controller is error-passive, its frames are "
                "disturbed; look at cable and termination."
            )
