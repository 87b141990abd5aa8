"""Driver of a CiA 402 drive: set-up, the exchange of every tick, guards, enabling and disabling.

A TPDO does not say which SYNC it answers: :mod:`rigd.devices.canbus._exchange` counts both, and
where that is in doubt a SYNC is left out. A drive that takes more than a period for its answer is
refused by :meth:`Cia402Drive.connect` already.
"""

from collections.abc import Callable
from math import isnan

from rigd.devices.canbus import CanExchange, CanLink
from rigd.devices.cia402._node import Node, ReceivedFrames
from rigd.devices.cia402._protocol import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    ENABLED,
    FAULT_BIT,
    FOLLOWS_TARGET,
    STATE_BITS,
    DriveState,
    NodeFrames,
    state_of,
)
from rigd.devices.cia402._setup import DriveCapabilities, set_up
from rigd.devices.cia402._standing import reset_fault
from rigd.devices.cia402._transitions import (
    StopRequestedError,
    TorqueFollowing,
    left_operation,
    step_up,
    switch_off,
)
from rigd.devices.cia402.objects import ACTUAL_TORQUE, HEARTBEAT_CONSUMER, HEARTBEAT_PRODUCER_MS
from rigd.devices.cia402.requirements import Watchdog, torque_limit_per_mille
from rigd.devices.contracts import DeviceError, LineHealth
from rigd.devices.parameters import RigParameters

_HALF_TURN = 1 << 31
_ALL_COUNTS = (1 << 32) - 1


class Cia402Drive:
    """A CiA 402 servo drive in cyclic synchronous torque mode.

    Where ``acquisition.deadline_us`` is longer than a period, the drive is a simulated one in
    lock-step, whose time passes with the SYNCs: then every reply is waited for, a SYNC counts as
    one period, and nothing depends on how fast this computer is.

    Parameters
    ----------
    rig
        Parameters with the sections ``cia402`` and ``acquisition``.
    link
        The bus, which may be shared.

    Attributes
    ----------
    angle_stale : bool
        The last angle read is not the one of the SYNC it belongs to.
    angle_time_ns : int
        ``time.monotonic_ns`` when the SYNC of the last angle was sent.
    angle_rad : float
        The last angle, from the position at :meth:`connect`.
    """

    def __init__(self, rig: RigParameters, link: CanLink) -> None:
        assert rig.cia402 is not None
        assert rig.acquisition is not None
        assert rig.can is not None
        settings = rig.cia402
        self._rig = rig
        self._bit_rate_bit_s = rig.can.bitrate_bit_s
        self._link = link
        self._name = f"Drive (CANopen node {settings.node_id})"
        self._frames = NodeFrames(settings.node_id, settings.host_node_id)
        self._idle = self._frames.rpdo(DISABLE_VOLTAGE, 0)
        self._inbox = ReceivedFrames(self._name, settings.sto_error_code)
        self._same_tick = rig.acquisition.mode == "same_tick"
        self._silence_ns = round(settings.drive_heartbeat_timeout_s * 1e9)
        self._rad_per_count = rig.encoder.resolution_rad * settings.direction
        self._per_mille_per_nm = 1000 * settings.direction / rig.motor.rated_torque_nm
        self._limit = torque_limit_per_mille(rig)
        self._following = TorqueFollowing(
            self._name,
            settings.torque_tolerance_percent,
            settings.torque_response_s,
            1 / rig.rate_hz,
        )
        self._open = False
        self._subscribed: CanExchange | None = None
        self._node: Node | None = None
        self._capabilities: DriveCapabilities | None = None
        self._listens = True
        self._has_rpdo_deadline = False
        self._enabled = False
        self._may_be_on = False
        self._inbox.guard(FAULT_BIT, 0)
        self._awaiting = False
        self._last_received_ns = 0
        self._position = 0
        self._counts = 0
        self.angle_rad = 0.0
        self.angle_stale = False
        self.angle_time_ns = 0
        self.off_doubt = ""

    def connect(self) -> None:
        """Open the bus, verify and configure the drive, start it, and take its angle as zero.

        Between this and the first tick no SYNC is sent, and no heartbeat.

        Raises
        ------
        DeviceError
            If the drive is absent, in fault, differs from the profile, or rejects the
            configuration.
        """
        if self._rig.encoder.resolution_rad == 0:
            raise DeviceError(
                f"{self._name}: encoder.resolution_rad = 0 rad, but a drive counts encoder steps; "
                "give the angle of one count at the output shaft."
            )
        exchange = self._open_link()
        self._node = None
        self._enabled = self._may_be_on = False
        self._inbox.clear()
        self._inbox.guard(FAULT_BIT, 0)
        capabilities = self._capabilities = set_up(exchange.port, self._rig, self._name)
        has_torque = capabilities.has(ACTUAL_TORQUE)
        self._inbox.with_torque = has_torque
        self._following.compares = has_torque
        # Without a heartbeat of its own the drive is monitored by its TPDOs alone.
        self._listens = capabilities.has(HEARTBEAT_PRODUCER_MS)
        self._has_rpdo_deadline = capabilities.watchdog is Watchdog.RPDO_DEADLINE
        self._subscribe(exchange)
        exchange.start()
        node = self._node = Node(self._rig, exchange, self._frames, self._inbox)
        node.go_operational(beats=self._listens)
        node.await_first_reply()
        self._position, self._counts = self._inbox.position, 0
        self.angle_rad = 0.0
        self.angle_stale = False
        self.angle_time_ns = node.sync_ns
        node.pairing.settle()  # that reply is of no tick
        self._awaiting = False
        node.resume()

    def identity(self) -> dict[str, object]:
        """Return the identity that the drive reported at :meth:`connect`.

        Returns
        -------
        dict
            ``vendor_id``, ``product_code``, ``revision``, ``serial_number`` (None where it has
            none), ``device_name``, ``supported_modes`` (object 6502), ``rated_torque_counts``
            (6076) and, where the profile gives its unit, ``rated_torque_nm`` at the output shaft;
            ``gear_ratio`` (6091) and ``encoder_step_rad`` (608F, 6092), None where it states none;
            ``quick_stop_option`` (605A) and ``fault_reaction_option`` (605E) where it has them.
        """
        return {} if self._capabilities is None else dict(self._capabilities.identity)

    def capabilities(self) -> DriveCapabilities | None:
        """Return the capabilities found at :meth:`connect`, or None before."""
        return self._capabilities

    def statement(self) -> dict[str, str]:
        """Return the drive's own safeguards as metadata of a session file.

        Returns
        -------
        dict
            ``drive_identity``, ``drive_watchdog`` and ``drive_watchdog_s``; where the drive lacks
            something that the profile accepts by name, ``drive_without``; where something replaces
            an object, ``drive_stand_ins``; objects that the profile has set, ``drive_objects_set``.
        """
        capabilities = self._capabilities
        if capabilities is None:
            return {}
        numbers = ("vendor_id", "product_code", "revision", "serial_number")
        facts = {
            "drive_identity": " ".join(
                f"0x{number:X}"
                if isinstance(number := capabilities.identity.get(key), int)
                else "-"
                for key in numbers
            ),
            "drive_watchdog": capabilities.watchdog.value,
            "drive_watchdog_s": repr(capabilities.watchdog_s),
        }
        stand_ins = [f"{row.address}: {row.stand_in}" for row in capabilities.lacks if row.stand_in]
        for key, texts in (
            ("drive_without", capabilities.accepted),
            ("drive_stand_ins", stand_ins),
            ("drive_objects_set", capabilities.assigned),
        ):
            if texts:
                facts[key] = "; ".join(texts)
        return facts

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Bring the drive to operation enabled, at zero torque.

        Sends SYNC, RPDO and heartbeat itself, once a period; meant to be called between two ticks.

        Parameters
        ----------
        stop
            Called once a period; if it returns True, the drive is disabled instead.

        Raises
        ------
        DeviceError
            If the drive does not reach that state; it is then disabled again.
        """
        node = self._connected()
        if self._enabled:
            return
        node.refuse_alarm()
        self._may_be_on = True
        try:
            step_up(node, stop)
        except StopRequestedError:
            self.disable()
            return
        except DeviceError:
            self.disable()
            raise
        self._enabled = True
        self._following.start()
        follows = FOLLOWS_TARGET if node.settings.follows_target_bit else 0
        self._inbox.guard(STATE_BITS | follows, ENABLED | follows)
        node.resume()

    def latch(self, due_ns: int) -> None:
        """Send SYNC, on which the drive latches its angle, unless one has to be left out.

        Parameters
        ----------
        due_ns
            When the tick was due; heartbeats of both sides are timed by it.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """
        node = self._connected()
        if not self._same_tick:
            self._settle_previous(node)
        if self._has_rpdo_deadline and not self._enabled:
            # The drive times the RPDOs from the first on, also while no torque is commanded.
            node.exchange.send(self._idle)
        node.send_sync_or_pause()
        self._awaiting = True
        node.now_ns = node.now_ns + node.period_ns if node.lock_step else due_ns

    def read_angle(self) -> float:
        """Return the angle in rad at the output shaft, from the position at :meth:`connect`.

        The heartbeat goes out here when it is due: sent with the SYNC it would come between that
        and the sensor's request.

        Raises
        ------
        DeviceError
            If the drive has reported a fault, has left the state it should be in, or is silent.
        """
        node = self._connected()
        if self._awaiting:
            self._awaiting = False
            if self._same_tick:
                caught_up = node.pairing.has_caught_up
                node.exchange.wait_until(caught_up, node.sync_ns + node.deadline_ns)
                self._settle(node)
            node.send_heartbeat()
        inbox = self._inbox
        if inbox.received or not self._listens:
            inbox.received = False
            self._last_received_ns = node.now_ns
        if (
            inbox.alarm
            or inbox.strayed is not None
            or node.now_ns - self._last_received_ns > self._silence_ns
        ):
            self._complain(node)
        return self.angle_rad

    def command(self, torque_nm: float) -> float:
        """Set the torque in N·m at the output shaft; clipped to the motor's peak torque.

        A drive that is not enabled gets zero torque and the command to stay so.

        Returns
        -------
        float
            The torque as sent, a whole number of thousandths of the rated torque.

        Raises
        ------
        DeviceError
            If the torque is not a number, or the bus is gone.
        """
        send = self._connected().exchange.send
        if not self._enabled:
            send(self._idle)
            return 0.0
        per_mille = torque_nm * self._per_mille_per_nm
        limit = self._limit
        if not -limit <= per_mille <= limit:
            if isnan(per_mille):
                raise DeviceError(f"{self._name}: the torque command is not a number.")
            per_mille = limit if per_mille > 0 else -limit
        sent = round(per_mille)
        self._following.command(sent)
        send(self._frames.rpdo(ENABLE_OPERATION, sent))
        return sent / self._per_mille_per_nm

    def health(self) -> LineHealth:
        """Return the health of the bus, as far as its frames are sent or received here."""
        if self._node is None:
            return LineHealth()
        exchange = self._node.exchange
        pairing = self._node.pairing
        unproven = pairing.unproven
        doubt = count = ""
        if unproven:
            how = "in lock-step" if self._node.lock_step else "while cia402.sync_gaps = false"
            doubt = (
                f"{self._name}: a TPDO did not arrive, or all have been delayed by a period since, "
                f"which is unknown {how}: angles may be older than the file states."
            )
            count = f"{self._name}: TPDOs that did not arrive since it was connected: {unproven}."
        errors = exchange.error_frames + pairing.lost + self._inbox.malformed
        return LineHealth(
            exchange.bits, self._bit_rate_bit_s, errors, doubt=doubt, doubt_count=count
        )

    def disable(self) -> None:
        """Zero the torque and disable the drive. Works in every state and never raises.

        If the statusword does not show it off within some 50 ms, the command goes by SDO as well,
        and last the node is stopped.
        """
        self._enabled = False
        self._inbox.guard(FAULT_BIT, 0)
        node = self._node
        if node is None:
            return
        if not self._may_be_on:
            node.send_if_possible(self._idle)
            return
        if switch_off(node):
            self._may_be_on = False
            self.off_doubt = ""
        else:
            self.off_doubt = (
                f"{self._name}: it does not show that it is off (statusword "
                f"0x{self._inbox.statusword:04X}); check that it is, by its STO if need be. "
                f"{self._own_end()}"
            )
        node.resume()

    def reset_fault(self) -> str | None:
        """Switch off and reset a fault, for the operator; the drive must then be reconnected.

        Returns
        -------
        str or None
            What the fault was, in words; None if there was none. Either way the drive has shown
            itself off, and that it would get ready to switch on.

        Raises
        ------
        DeviceError
            If the drive does not answer, does not report that it is off within 0.2 s, the fault
            persists, or it does not become ready.
        """
        self.disable()
        exchange = self._open_link()
        self._node = None
        return reset_fault(exchange.port, self._rig, self._name)

    def close(self) -> None:
        """Disable, have the drive leave operational and expect no more heartbeats; release.

        A drive that may still be on goes on watching for heartbeats, and misses them.
        """
        self.disable()
        self._inbox.watching = False
        node, self._node = self._node, None
        if node is not None and not self._may_be_on:
            node.send_if_possible(self._frames.pre_operational)
            if self._capabilities is not None and self._capabilities.watchdog is Watchdog.HEARTBEAT:
                node.write(self._frames.forget_heartbeat, HEARTBEAT_CONSUMER, 1)
        if self._open:
            self._open = False
            self._link.close()

    def _own_end(self) -> str:
        """Describe what removes the torque of a drive that cannot be switched off."""
        capabilities = self._capabilities
        if capabilities is None or capabilities.watchdog is Watchdog.NONE:
            return "It has no watchdog that would end it by itself."
        return (
            "Without the loop it has to switch itself off within "
            f"{capabilities.watchdog_s:g} s, by its {capabilities.watchdog.value}."
        )

    def _connected(self) -> Node:
        if self._node is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return self._node

    def _open_link(self) -> CanExchange:
        if not self._open:
            self._link.open()
            self._open = True
        return self._link.exchange

    def _subscribe(self, exchange: CanExchange) -> None:
        if self._subscribed is exchange:
            return
        self._subscribed = exchange
        exchange.subscribe(self._frames.tpdo_id, self._inbox.take_tpdo)
        exchange.subscribe(self._frames.emergency_id, self._inbox.take_emergency)
        exchange.subscribe(self._frames.heartbeat_id, self._inbox.take_heartbeat)
        exchange.subscribe(self._frames.reply_id, self._inbox.take_reply)

    def _settle_previous(self, node: Node) -> None:
        """Process the reply to the previous tick's SYNC, which should have arrived."""
        if node.lock_step and node.pairing.owed:
            node.exchange.wait_until(node.pairing.has_caught_up, node.sync_ns + node.deadline_ns)
        else:
            node.exchange.drain()
        self._settle(node)

    def _settle(self, node: Node) -> None:
        """Store the position if it is the reply to the last SYNC."""
        fresh = node.pairing.settle() and self._inbox.legible
        self.angle_stale = not fresh
        if self._enabled and fresh:
            self._following.compare(self._inbox.torque)
        if fresh:
            position = self._inbox.position
            # The 32-bit counter wraps around.
            self._counts += (position - self._position + _HALF_TURN & _ALL_COUNTS) - _HALF_TURN
            self._position = position
            self.angle_rad = self._counts * self._rad_per_count
            self.angle_time_ns = node.sync_ns

    def _complain(self, node: Node) -> None:
        """Raise the error of the drive, if there is one."""
        node.refuse_alarm()
        statusword = self._inbox.strayed
        if statusword is not None and state_of(statusword) is not DriveState.OPERATION_ENABLED:
            node.await_alarm()
            node.refuse_alarm()
            raise left_operation(self._name, statusword)
        if statusword is not None:
            raise DeviceError(
                f"{self._name}: it ignores the target torque: bit 12 of its statusword "
                f"0x{statusword:04X} is not set; check its own diagnosis, and if this drive has "
                "no such bit: cia402.follows_target_bit = false."
            )
        silence_s = (node.now_ns - self._last_received_ns) * 1e-9
        raise DeviceError(
            f"{self._name}: no heartbeat for {silence_s:.3g} s, more than "
            f"cia402.drive_heartbeat_timeout_s = {node.settings.drive_heartbeat_timeout_s:g} s; "
            "check its supply and the cable."
        )
