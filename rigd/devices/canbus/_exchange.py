"""Cyclic exchange on one CAN port: routing of frames, and pairing of replies with requests.

`CanLink` opens a bus once for all its drivers. `CanExchange` routes each frame to its driver.

Replies on the bus do not state which request they answer, so `ReplyPairing` counts both. A device
answers every request with one reply, in order. If a reply is missing, the next reply may be the
missing one, late, or the reply to the next request, the missing one being lost. From then on one
reply arrives per request in either case. Therefore one tick is run without a request. If no reply
arrives in this tick, none is under way, and the missing reply is lost. If a reply arrives, replies
are late by whole periods, and no reading is valid until all outstanding replies have arrived.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rigd.devices.canbus._budget import BITS_OF_EMPTY_FRAME
from rigd.devices.canbus.adapters import open_port
from rigd.devices.canbus.port import (
    BUS_OFF_ERROR_CLASS,
    DATA_LENGTH_OFFSET,
    ERROR_CLASS_MASK,
    ERROR_FRAME_FLAG,
    CanPort,
    unpack_header,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import CanBus
from rigd.devices.running_simulator import SimulatorAddress
from rigd.runtime.locks import LockFile, LockHeldError

# Pairing of replies

_STEADY_PERIODS_BEFORE_LOSS = 3
"""Number of consecutive periods with one reply each after which missing replies count as lost.

The rule applies only if no tick may be run without a request."""


class ReplyCounter(Protocol):
    """Object that counts received replies, in its attribute `reply_count`."""

    reply_count: int
    """Number of replies received since this was last set to zero, regardless of their content."""


class ReplyPairing:
    """Counter of requests and replies that finds out whether the last reply is to the last request.

    Parameters
    ----------
    reply_counter
        Object that counts the received replies.
    may_omit_request
        Whether a tick may be run without a request. This is not possible with a device whose time
        advances with the requests; missing replies then finally count as lost without proof.

    Attributes
    ----------
    outstanding : int
        Number of replies that have not arrived yet, to the last request or to earlier ones.
    lost_reply_count : int
        Number of replies that count as lost.
    presumed_lost_count : int
        Number of replies that count as lost without proof: instead, all later replies may be late
        by whole periods.
    """

    __slots__ = (
        "_has_request",
        "_is_only_request",
        "_may_omit_request",
        "_replies_in_period",
        "_reply_counter",
        "_steady_periods",
        "lost_reply_count",
        "outstanding",
        "presumed_lost_count",
    )

    def __init__(self, reply_counter: ReplyCounter, *, may_omit_request: bool = True) -> None:
        self._reply_counter = reply_counter
        self._may_omit_request = may_omit_request
        self.lost_reply_count = 0
        self.presumed_lost_count = 0
        self.reset()

    def reset(self) -> None:
        """Reset the pairing: no reply is outstanding."""
        self._reply_counter.reply_count = 0
        self._has_request = self._is_only_request = True
        self._replies_in_period = 0
        self._steady_periods = 0
        self.outstanding = 0

    def needs_pause(self) -> bool:
        """Return whether the next tick has to make no request, so that late replies are recognised.

        Call it after all received frames are delivered.
        """
        if not (self.outstanding and self._may_omit_request):
            return False
        self._count_replies()
        # A pause with a reply continues until all replies have arrived, or none does.
        return self.outstanding > 0 and (
            self._replies_in_period == 1 if self._has_request else self._replies_in_period > 0
        )

    def register_request(self) -> None:
        """Count a new request to the device, directly before the request is sent.

        Call it after all received frames are delivered.
        """
        self._end_period()
        self._has_request = True
        self._is_only_request = not self.outstanding
        self.outstanding += 1

    def register_pause(self) -> None:
        """Register that the tick that begins makes no request."""
        self._end_period()
        self._has_request = self._is_only_request = False

    def is_up_to_date(self) -> bool:
        """Return whether all outstanding replies, up to that to the last request, have arrived."""
        return 0 < self.outstanding <= self._reply_counter.reply_count

    def process_replies(self) -> bool:
        """Count the received replies; return whether this tick's request has been answered.

        If replies to earlier requests were outstanding, too, the result is False: a faulty line may
        deliver a delayed reply after later replies. The next tick is then the first valid one.
        """
        return self._count_replies() > 0 and self.outstanding == 0 and self._is_only_request

    def _end_period(self) -> None:
        """End the period of the last tick: decide whether outstanding replies count as lost."""
        self._count_replies()
        if self.outstanding:
            if not self._has_request:
                if not self._replies_in_period:
                    self.lost_reply_count += self.outstanding
                    self.outstanding = 0
            elif not self._may_omit_request:
                self._steady_periods = (
                    self._steady_periods + 1 if self._replies_in_period == 1 else 0
                )
                if self._steady_periods >= _STEADY_PERIODS_BEFORE_LOSS:
                    self.lost_reply_count += self.outstanding
                    self.presumed_lost_count += self.outstanding
                    self.outstanding = self._steady_periods = 0
        else:
            self._steady_periods = 0
        self._replies_in_period = 0

    def _count_replies(self) -> int:
        """Add the newly received replies to the counts, and return their number."""
        new_replies, self._reply_counter.reply_count = self._reply_counter.reply_count, 0
        self._replies_in_period += new_replies
        self.outstanding = max(0, self.outstanding - new_replies)
        return new_replies


# Exchange

FrameHandler = Callable[[bytes], None]
"""Function that a driver registers for frames; it is called with the data bytes of a frame."""

# linux/can/error.h: the identifier contains the class of the error, data[1] the controller's state.
_CONTROLLER_STATE_ERROR_CLASS = 0x04
"""Class of an error frame about the controller's state."""
_CONTROLLER_STATE_OFFSET = 1
"""Offset of the controller's state in the data of an error frame."""
_ERROR_PASSIVE_BITS = 0x30
"""Bits of the controller's state that mean error-passive, in receiving or sending."""
_NO_ACKNOWLEDGE_ERROR_CLASS = 0x20
"""Class of an error frame: no device has acknowledged a sent frame."""

_MAX_DELIVERY_ERRORS = 10
"""Largest number of receive errors, which an adapter may queue, that one `deliver_frames` ignores.

The limit applies within `ignore_errors`."""
_MAX_WAIT_ERRORS = 100
"""Number of receive errors that end one wait within `ignore_errors`."""
_RECEIVE_ERROR_PAUSE_S = 0.001
"""Pause in seconds after a receive error."""


class CanExchange:
    """Exchange of frames on an open CAN port, which routes received frames to the drivers.

    Parameters
    ----------
    port
        Open port.

    Attributes
    ----------
    error_frames : int
        Number of error frames that the CAN controller reported.
    bits : int
        Total number of bits of all frames sent and received, without stuff bits.
    """

    def __init__(self, port: CanPort) -> None:
        self.port = port
        self.bits = 0
        self._send = port.send
        self._receive = port.receive
        self._handlers: dict[int, FrameHandler] = {}
        self.error_frames = 0
        self._bus_error = ""
        self._ignores_errors = False

    def send(self, frame: bytes) -> None:
        """Send a raw frame (the kernel's ``struct can_frame``) and count its bits.

        Raises the errors of :meth:`CanPort.send`.
        """
        self._send(frame)
        self.bits += BITS_OF_EMPTY_FRAME + 8 * frame[DATA_LENGTH_OFFSET]

    def subscribe(self, can_id: int, handler: FrameHandler) -> None:
        """Register a function that receives the data of each frame with this identifier.

        Parameters
        ----------
        can_id
            CAN identifier of 11 bits.
        handler
            Function that is called with the data bytes of each frame.

        Raises
        ------
        DeviceError
            If another driver has registered a function for this identifier.
        """
        if can_id in self._handlers:
            raise DeviceError(
                f"CAN bus {self.port.name}: two devices use the identifier {can_id:#x}; give one "
                "of them another base or node id in the profile."
            )
        self._handlers[can_id] = handler

    def start(self) -> None:
        """Discard queued frames, and accept only frames with subscribed identifiers."""
        self.port.accept(self._handlers)
        while self._receive() is not None:
            pass

    @contextmanager
    def ignore_errors(self) -> Iterator[None]:
        """Ignore errors of bus and adapter while receiving within this context.

        The context is needed to switch a drive off. An error-passive controller goes on sending,
        and a frame that was not acknowledged is sent again. The drive's answers then have to be
        received, and SYNC has to be sent, because the torque of an RPDO takes effect at the next
        SYNC. `send` still raises if the bus does not accept a frame.
        """
        previous_setting, self._ignores_errors = self._ignores_errors, True
        try:
            yield
        finally:
            self._ignores_errors = previous_setting

    def deliver_frames(self) -> None:
        """Deliver all frames that have arrived to their drivers, without waiting.

        Raises
        ------
        DeviceError
            If the bus has failed, or its controller has switched itself off or reports that it
            cannot send; not within `ignore_errors`.
        """
        if not self._ignores_errors:
            self._deliver_received_frames()
            if self._bus_error:
                raise DeviceError(self._bus_error)
            return
        for _ in range(_MAX_DELIVERY_ERRORS):
            try:
                self._deliver_received_frames()
            except Exception:  # an adapter's library may raise anything
                continue
            return

    def _deliver_received_frames(self) -> None:
        """Deliver all frames that have arrived, and register error frames of the controller."""
        receive_frame, frame_handlers = self._receive, self._handlers
        while (raw_frame := receive_frame()) is not None:
            can_id, data_length = unpack_header(raw_frame)
            frame_handler = frame_handlers.get(can_id)
            if frame_handler is not None:
                self.bits += BITS_OF_EMPTY_FRAME + 8 * data_length
                frame_handler(raw_frame[8 : 8 + data_length])
            elif can_id & ERROR_FRAME_FLAG:
                self._register_error(can_id & ERROR_CLASS_MASK, raw_frame[8:16])

    def wait_until(self, is_ready: Callable[[], bool], deadline_ns: int) -> bool:
        """Deliver frames until `is_ready` returns True, or the deadline passes.

        Parameters
        ----------
        is_ready
            Condition, which is checked after every delivery.
        deadline_ns
            Deadline in nanoseconds on the clock ``time.monotonic_ns``.

        Returns
        -------
        bool
            Whether the condition became true before the deadline.
        """
        wait_failure_count = 0
        self.deliver_frames()
        while not is_ready():
            remaining_ns = deadline_ns - time.monotonic_ns()
            if remaining_ns <= 0:
                return False
            try:
                self.port.wait(remaining_ns * 1e-9)
            except Exception:
                wait_failure_count += 1
                if not self._ignores_errors:
                    raise
                if wait_failure_count > _MAX_WAIT_ERRORS:
                    return False  # the adapter has failed
                time.sleep(min(_RECEIVE_ERROR_PAUSE_S, remaining_ns * 1e-9))
            self.deliver_frames()
        return True

    def _register_error(self, error_class: int, error_data: bytes) -> None:
        """Count an error frame of the controller, and store a message if no frame can be sent."""
        self.error_frames += 1
        if error_class & BUS_OFF_ERROR_CLASS:
            self._bus_error = (
                f"CAN bus {self.port.name}: the controller is off the bus (bus-off) after too "
                "many errors; check cable, termination and bit rate, then bring it up again."
            )
        elif error_class & _NO_ACKNOWLEDGE_ERROR_CLASS:
            self._bus_error = (
                f"CAN bus {self.port.name}: no device acknowledges the frames sent; check cable, "
                "termination, power and bit rate."
            )
        elif (
            error_class & _CONTROLLER_STATE_ERROR_CLASS
            and error_data[_CONTROLLER_STATE_OFFSET] & _ERROR_PASSIVE_BITS
        ):
            self._bus_error = (
                f"CAN bus {self.port.name}: the controller is error-passive, its frames are "
                "disturbed; check cable and termination."
            )


# Bus and its users


class BusLock:
    """Lock that prevents other programs from using a CAN bus while this one has it open.

    `bus_channel` is the channel of the bus, or the socket of a simulated bus, whose lock concerns
    only processes of the same user.
    """

    def __init__(self, bus_channel: str, *, is_simulated: bool) -> None:
        self._bus_channel = bus_channel
        self._file = LockFile(f"bus-{bus_channel}", for_all_users=not is_simulated)

    def acquire(self) -> None:
        """Lock the bus.

        Raise `DeviceError` with the process of another program that has locked the bus.
        """
        try:
            self._file.acquire("rigd")
        except LockHeldError as holder:
            raise DeviceError(
                f"CAN bus {self._bus_channel}: another rigd is using it ({holder}); wait for it, "
                "or stop it."
            ) from None
        except OSError as error:
            raise DeviceError(
                f"CAN bus {self._bus_channel}: it cannot be reserved in {self._file.path.parent} "
                f"({error.strerror}); set XDG_RUNTIME_DIR to a folder that is yours."
            ) from None

    def release(self) -> None:
        """Release the lock of the bus; harmless when repeated."""
        self._file.release()


class CanLink:
    """CAN bus that the drivers of its devices open together.

    Parameters
    ----------
    settings
        Settings of the bus in the profile.
    simulator
        Address of the simulated rig that replaces the bus, or None.
    """

    def __init__(self, settings: CanBus, simulator: SimulatorAddress | None) -> None:
        self._settings = settings
        self._simulator = simulator
        self._exchange: CanExchange | None = None
        self._users = 0
        simulated_bus_socket = "" if simulator is None else simulator.can_socket
        self._lock = BusLock(
            simulated_bus_socket or settings.channel, is_simulated=bool(simulated_bus_socket)
        )

    @property
    def exchange(self) -> CanExchange:
        """Cyclic exchange of frames on the open CAN bus.

        Raises
        ------
        DeviceError
            If the bus is not open.
        """
        if self._exchange is None:
            raise DeviceError(f"CAN bus {self._settings.channel}: it is not open.")
        return self._exchange

    def open(self) -> CanExchange:
        """Open the bus for one more driver, and return its exchange.

        Raises
        ------
        DeviceError
            If the bus cannot be opened, or another program uses it.
        """
        if self._exchange is None:
            self._lock.acquire()
            try:
                self._exchange = CanExchange(open_port(self._settings, self._simulator))
            except BaseException:
                self._lock.release()
                raise
        self._users += 1
        return self._exchange

    def close(self) -> None:
        """Release the bus for one driver; the bus is closed after its last driver."""
        self._users = max(0, self._users - 1)
        if self._users == 0 and self._exchange is not None:
            self._exchange.port.close()
            self._exchange = None
            self._lock.release()
