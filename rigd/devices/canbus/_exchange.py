"""The cyclic exchange on one port: routing of frames, and pairing of replies with requests.

`CanLink` opens a bus once for all its users, `CanExchange` routes each frame to its driver.

Replies on the bus do not say which request they answer, so `ReplyPairing` counts both. A device
answers every request with one reply, in order. Where one is missing, the next to come may be the
missing one, late, or the next one, the missing one being lost; and from then on there is one reply
to each request either way. So one tick is left without a request: if no reply comes in it, none is
on its way, and what is missing is lost. If one comes, replies are late by whole periods, and no
reading counts until they have caught up.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rigd.devices.canbus._budget import FRAME_BITS
from rigd.devices.canbus.port import (
    BUS_OFF,
    ERROR_FLAG,
    ERROR_MASK,
    LENGTH_AT,
    CanPort,
    open_port,
    read_head,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import CanBus
from rigd.devices.running_simulator import SimulatorAddress
from rigd.runtime import HeldError, HeldFile

# Pairing of replies

_STEADY_PERIODS = 3
"""Periods with one reply each after which missing replies count as lost if no pause is possible."""


class Counter(Protocol):
    """Counter of received replies."""

    replies: int
    """Replies since the last reset to zero, regardless of their content."""


class ReplyPairing:
    """Counts requests and their replies.

    Parameters
    ----------
    inbox
        Counter of received replies.
    pauses
        A tick may be left without a request. Not so with a device whose time passes with the
        requests: there what is missing is taken for lost in the end, unproven.

    Attributes
    ----------
    owed : int
        Replies that have not come yet, to the last request or to earlier ones.
    lost : int
        Replies that were assumed to be lost.
    unproven : int
        Lost replies that may also be late by whole periods for good.
    """

    __slots__ = (
        "_alone",
        "_inbox",
        "_pauses",
        "_received",
        "_requested",
        "_steady",
        "lost",
        "owed",
        "unproven",
    )

    def __init__(self, inbox: Counter, *, pauses: bool = True) -> None:
        self._inbox = inbox
        self._pauses = pauses
        self.lost = 0
        self.unproven = 0
        self.start()

    def start(self) -> None:
        """Reset the pairing: no reply is outstanding."""
        self._inbox.replies = 0
        self._requested = self._alone = True
        self._received = 0
        self._steady = 0
        self.owed = 0

    def wants_pause(self) -> bool:
        """Return whether the next tick makes no request; call it when all frames are delivered."""
        if not (self.owed and self._pauses):
            return False
        self._take()
        # A pause with a reply continues until all replies have arrived, or none does.
        return self.owed > 0 and (self._received == 1 if self._requested else self._received > 0)

    def ask(self) -> None:
        """Count a new request, directly before it is sent; call after all frames are delivered."""
        self._close()
        self._requested = True
        self._alone = not self.owed
        self.owed += 1

    def pause(self) -> None:
        """Count a tick without a request, directly before its latch."""
        self._close()
        self._requested = self._alone = False

    def has_caught_up(self) -> bool:
        """Whether the last reply is the one to the last request."""
        return 0 < self.owed <= self._inbox.replies

    def settle(self) -> bool:
        """Count the received replies; return whether that to this tick's request is among them.

        Where older ones were owed as well the next tick is the first to count: what a fault on the
        line delays may come after what was sent later.
        """
        return self._take() > 0 and self.owed == 0 and self._alone

    def _close(self) -> None:
        """End the period of the last tick."""
        self._take()
        if self.owed:
            if not self._requested:
                if not self._received:
                    self.lost += self.owed
                    self.owed = 0
            elif not self._pauses:
                self._steady = self._steady + 1 if self._received == 1 else 0
                if self._steady >= _STEADY_PERIODS:
                    self.lost += self.owed
                    self.unproven += self.owed
                    self.owed = self._steady = 0
        else:
            self._steady = 0
        self._received = 0

    def _take(self) -> int:
        replies, self._inbox.replies = self._inbox.replies, 0
        self._received += replies
        self.owed = max(0, self.owed - replies)
        return replies


# Exchange

Handler = Callable[[bytes], None]

# linux/can/error.h: class in the identifier, state of the controller in data[1].
_CONTROLLER = 0x04
_CONTROLLER_STATE = 1
_PASSIVE = 0x30
_NO_ACKNOWLEDGE = 0x20

_FAILURES_SKIPPED = 10
"""Failures to receive that one drain in `regardless` tolerates: an adapter may queue several."""
_FAILURES_WAITED = 100
"""Failures of reading after which one wait gives up."""
_FAILURE_PAUSE_S = 0.001


class CanExchange:
    """Routes the frames of a port to its drivers.

    Parameters
    ----------
    port
        Open port.

    Attributes
    ----------
    error_frames : int
        Number of disturbances that the controller reported.
    bits : int
        Bits of all frames sent and received, without stuff bits.
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

        Parameters
        ----------
        can_id
            Identifier of 11 bits.
        handler
            Called with the data bytes.

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
        """Discard queued frames, and let the port accept only subscribed identifiers."""
        self.port.accept(self._handlers)
        while self._receive() is not None:
            pass

    @contextmanager
    def regardless(self) -> Iterator[None]:
        """Ignore errors of bus and adapter while receiving within this block.

        It is for switching a drive off. An error-passive controller goes on sending, and a frame
        that was not acknowledged is sent again; what the drive then answers has to be taken, and
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
        """Deliver frames until `ready` returns True, or until a time of ``time.monotonic_ns``.

        Parameters
        ----------
        ready
            Called after every frame.
        deadline_ns
            Time of ``time.monotonic_ns``.

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
                "many errors; check cable, termination and bit rate, then bring it up again."
            )
        elif kind & _NO_ACKNOWLEDGE:
            self._trouble = (
                f"CAN bus {self.port.name}: no device acknowledges the frames sent; check cable, "
                "termination, power and bit rate."
            )
        elif kind & _CONTROLLER and data[_CONTROLLER_STATE] & _PASSIVE:
            self._trouble = (
                f"CAN bus {self.port.name}: the controller is error-passive, its frames are "
                "disturbed; check cable and termination."
            )


# Bus and its users


class BusLock:
    """Lock held from opening a bus to closing it.

    Parameters
    ----------
    bus
        Channel of the bus, or socket of a simulated one.
    simulated
        Whether the bus is simulated: each user has their own.
    """

    def __init__(self, bus: str, *, simulated: bool) -> None:
        self._bus = bus
        self._file = HeldFile(f"bus-{bus}", everybody=not simulated)

    def acquire(self) -> None:
        """Take the bus.

        Raises
        ------
        DeviceError
            If another program has it; the message says which process.
        """
        try:
            self._file.acquire("rigd")
        except HeldError as holder:
            raise DeviceError(
                f"CAN bus {self._bus}: another rigd is using it ({holder}); wait for it, or stop "
                "it."
            ) from None
        except OSError as error:
            raise DeviceError(
                f"CAN bus {self._bus}: it cannot be reserved in {self._file.path.parent} "
                f"({error.strerror}); set XDG_RUNTIME_DIR to a folder that is yours."
            ) from None

    def release(self) -> None:
        """Release the bus; harmless when repeated."""
        self._file.release()


class CanLink:
    """One CAN bus and the drivers of its devices.

    Parameters
    ----------
    settings
        Settings of the bus.
    simulator
        Address of the simulated rig that replaces it, or None.
    """

    def __init__(self, settings: CanBus, simulator: SimulatorAddress | None) -> None:
        self._settings = settings
        self._simulator = simulator
        self._exchange: CanExchange | None = None
        self._users = 0
        simulated = "" if simulator is None else simulator.can_socket
        self._lock = BusLock(simulated or settings.channel, simulated=bool(simulated))

    @property
    def exchange(self) -> CanExchange:
        """The cyclic exchange on the open bus.

        Raises
        ------
        DeviceError
            If the bus is not open.
        """
        if self._exchange is None:
            raise DeviceError(f"CAN bus {self._settings.channel}: it is not open.")
        return self._exchange

    def open(self) -> CanExchange:
        """Open the bus if it is not open yet.

        Raises
        ------
        DeviceError
            If that fails, or another program uses it.
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
        """Release the bus; the last of its users closes it."""
        self._users = max(0, self._users - 1)
        if self._users == 0 and self._exchange is not None:
            self._exchange.port.close()
            self._exchange = None
            self._lock.release()
