"""Driver of a CiA 402 drive: set-up, exchange of values in every tick, enabling and disabling.

A TPDO does not state which SYNC it answers, so :mod:`rigd.devices.canbus._exchange` counts both.
In case of doubt it omits one SYNC. :meth:`Cia402Drive.connect` refuses a drive that needs more than
a period for its answer.
"""

from collections.abc import Callable
from math import isnan

from rigd.devices.canbus import CanExchange, CanLink
from rigd.devices.cia402._node import Node, ReceivedFrames
from rigd.devices.cia402._protocol import (
    DISABLE_VOLTAGE_COMMAND,
    ENABLE_OPERATION_COMMAND,
    FAULT_BIT,
    FOLLOWS_TARGET_BIT,
    OPERATION_ENABLED_BITS,
    STATE_BITS,
    DriveState,
    NodeFrames,
    drive_state,
)
from rigd.devices.cia402._setup import DriveCapabilities, set_up_drive
from rigd.devices.cia402._switch_off import reset_fault
from rigd.devices.cia402._transitions import (
    StopRequestedError,
    TorqueFollowingCheck,
    enable_operation,
    operation_left_error,
    switch_off,
)
from rigd.devices.cia402.objects import ACTUAL_TORQUE, HEARTBEAT_CONSUMER, HEARTBEAT_PRODUCER_MS
from rigd.devices.cia402.requirements import Watchdog, torque_limit_per_mille
from rigd.devices.contracts import DeviceError, LineHealth
from rigd.devices.parameters import RigParameters

_HALF_POSITION_COUNTER_RANGE = 1 << 31
"""Half of the range of the drive's 32-bit position counter, in counts."""
_POSITION_COUNTER_MASK = (1 << 32) - 1
"""Mask with the 32 bits of the drive's position counter."""


class Cia402Drive:
    """Driver of a CiA 402 servo drive in cyclic synchronous torque mode.

    If ``acquisition.deadline_us`` is longer than a period, the drive is simulated in lock-step: its
    time advances by one period with each SYNC. The driver then waits for every reply, and nothing
    depends on the speed of this computer.

    Parameters
    ----------
    rig
        Parameters with the sections ``cia402`` and ``acquisition``.
    link
        CAN bus of the drive, which the sensor may use, too.

    Attributes
    ----------
    angle_stale : bool
        Whether `angle_rad` is older than the last SYNC, because its reply has not been received.
    angle_time_ns : int
        Time in nanoseconds (``time.monotonic_ns``) at which the SYNC of `angle_rad` was sent.
    angle_rad : float
        Last angle of the output shaft in radians, relative to its position at :meth:`connect`.
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
        self._idle_rpdo = self._frames.rpdo_frame(DISABLE_VOLTAGE_COMMAND, 0)
        self._inbox = ReceivedFrames(self._name, settings.sto_error_code)
        self._replies_in_same_tick = rig.acquisition.mode == "same_tick"
        self._heartbeat_timeout_ns = round(settings.drive_heartbeat_timeout_s * 1e9)
        self._rad_per_count = rig.encoder.resolution_rad * settings.direction
        self._per_mille_per_nm = 1000 * settings.direction / rig.motor.rated_torque_nm
        self._max_torque_per_mille = torque_limit_per_mille(rig)
        self._torque_check = TorqueFollowingCheck(
            self._name,
            settings.torque_tolerance_percent,
            settings.torque_response_s,
            1 / rig.rate_hz,
        )
        self._is_open = False
        self._subscribed: CanExchange | None = None
        self._node: Node | None = None
        self._capabilities: DriveCapabilities | None = None
        self._has_heartbeat = True
        self._has_rpdo_deadline = False
        self._enabled = False
        self._may_be_on = False
        self._inbox.require_status(FAULT_BIT, 0)
        self._awaits_reply = False
        self._last_received_ns = 0
        self._position = 0
        self._relative_counts = 0
        self.angle_rad = 0.0
        self.angle_stale = False
        self.angle_time_ns = 0
        self.off_doubt = ""

    def connect(self) -> None:
        """Open the bus, verify, configure and start the drive; its present angle becomes zero.

        No SYNC and no heartbeat is sent between this call and the first tick.

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
        self._inbox.require_status(FAULT_BIT, 0)
        capabilities = self._capabilities = set_up_drive(exchange.port, self._rig, self._name)
        reports_torque = capabilities.has_object(ACTUAL_TORQUE)
        self._inbox.tpdo_has_torque = reports_torque
        self._torque_check.is_active = reports_torque
        # Without a heartbeat of its own the drive is monitored by its TPDOs alone.
        self._has_heartbeat = capabilities.has_object(HEARTBEAT_PRODUCER_MS)
        self._has_rpdo_deadline = capabilities.watchdog is Watchdog.RPDO_DEADLINE
        self._subscribe(exchange)
        exchange.start()
        node = self._node = Node(self._rig, exchange, self._frames, self._inbox)
        node.go_operational(has_heartbeat=self._has_heartbeat)
        node.await_first_reply()
        self._position, self._relative_counts = self._inbox.position, 0
        self.angle_rad = 0.0
        self.angle_stale = False
        self.angle_time_ns = node.sync_ns
        node.pairing.process_replies()  # the first reply belongs to no tick
        self._awaits_reply = False
        node.restart_heartbeat_timing()

    def identity(self) -> dict[str, object]:
        """Return the identity that the drive reported at :meth:`connect`.

        Returns
        -------
        dict
            ``vendor_id``, ``product_code``, ``revision``, ``serial_number`` (None if the drive has
            no such number), ``device_name``, ``supported_modes`` (object 6502),
            ``rated_torque_counts`` (6076) and, if the profile states its unit, ``rated_torque_nm``
            at the output shaft; ``gear_ratio`` (6091) and ``encoder_step_rad`` (608F, 6092), None
            if the drive does not state them; ``quick_stop_option`` (605A) and
            ``fault_reaction_option`` (605E) if the drive has them. Empty before `connect`.
        """
        return {} if self._capabilities is None else dict(self._capabilities.identity)

    def capabilities(self) -> DriveCapabilities | None:
        """Return the drive's capabilities found at :meth:`connect`, or None before `connect`."""
        return self._capabilities

    def statement(self) -> dict[str, str]:
        """Return texts on the drive's own safeguards, such as its watchdog, as session metadata.

        Returns
        -------
        dict
            ``drive_identity``, ``drive_watchdog`` and ``drive_watchdog_s``; ``drive_without`` if
            the drive lacks a function and the profile accepts that; ``drive_stand_ins`` if
            something replaces an absent object; ``drive_objects_set`` if the profile sets
            manufacturer-specific objects. Empty before `connect`.
        """
        capabilities = self._capabilities
        if capabilities is None:
            return {}
        identity_keys = ("vendor_id", "product_code", "revision", "serial_number")
        metadata = {
            "drive_identity": " ".join(
                f"0x{number:X}"
                if isinstance(number := capabilities.identity.get(key), int)
                else "-"
                for key in identity_keys
            ),
            "drive_watchdog": capabilities.watchdog.value,
            "drive_watchdog_s": repr(capabilities.watchdog_timeout_s),
        }
        replacement_texts = [
            f"{row.address}: {row.replacement}"
            for row in capabilities.missing_objects
            if row.replacement
        ]
        for key, texts in (
            ("drive_without", capabilities.accepted_missing_functions),
            ("drive_stand_ins", replacement_texts),
            ("drive_objects_set", capabilities.assigned_objects),
        ):
            if texts:
                metadata[key] = "; ".join(texts)
        return metadata

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Bring the drive to the state operation enabled, at zero torque.

        This method itself sends SYNC, RPDO and heartbeat once a period; call it between two ticks.

        Parameters
        ----------
        stop
            Called once a period; if it returns True, the drive is disabled instead.

        Raises
        ------
        DeviceError
            If the drive does not reach the state; the driver then disables it.
        """
        node = self._require_node()
        if self._enabled:
            return
        node.raise_if_alarmed()
        self._may_be_on = True
        try:
            enable_operation(node, stop)
        except StopRequestedError:
            self.disable()
            return
        except DeviceError:
            self.disable()
            raise
        self._enabled = True
        self._torque_check.reset()
        follows_target_bit = FOLLOWS_TARGET_BIT if node.settings.follows_target_bit else 0
        self._inbox.require_status(
            STATE_BITS | follows_target_bit, OPERATION_ENABLED_BITS | follows_target_bit
        )
        node.restart_heartbeat_timing()

    def latch(self, due_ns: int) -> None:
        """Send SYNC, on which the drive samples its angle.

        No SYNC is sent in a tick that has to omit it, so that late replies are recognised.

        Parameters
        ----------
        due_ns
            Time in nanoseconds at which the tick was due. The heartbeats of computer and drive are
            due by this time.

        Raises
        ------
        DeviceError
            If the bus has failed.
        """
        node = self._require_node()
        if not self._replies_in_same_tick:
            self._store_previous_reply(node)
        if self._has_rpdo_deadline and not self._enabled:
            # The drive times the RPDOs from the first on, also while no torque is commanded.
            node.exchange.send(self._idle_rpdo)
        node.send_sync_or_pause()
        self._awaits_reply = True
        node.now_ns = node.now_ns + node.period_ns if node.lock_step else due_ns

    def read_angle(self) -> float:
        """Return the angle of the output shaft in rad, relative to its position at :meth:`connect`.

        This method also sends the heartbeat when it is due; sent in `latch`, the heartbeat would
        delay the request to the sensor.

        Raises
        ------
        DeviceError
            If the drive has reported a fault, has left the expected state, or no longer answers.
        """
        node = self._require_node()
        if self._awaits_reply:
            self._awaits_reply = False
            if self._replies_in_same_tick:
                is_up_to_date = node.pairing.is_up_to_date
                node.exchange.wait_until(is_up_to_date, node.sync_ns + node.deadline_ns)
                self._store_reply(node)
            node.send_heartbeat()
        inbox = self._inbox
        if inbox.heartbeat_received or not self._has_heartbeat:
            inbox.heartbeat_received = False
            self._last_received_ns = node.now_ns
        if (
            inbox.alarm
            or inbox.unexpected_statusword is not None
            or node.now_ns - self._last_received_ns > self._heartbeat_timeout_ns
        ):
            self._raise_drive_error(node)
        return self.angle_rad

    def command(self, torque_nm: float) -> float:
        """Send a torque command in N·m at the output shaft, clipped to the motor's peak torque.

        A drive that is not enabled is sent zero torque and the command to stay disabled.

        Returns
        -------
        float
            Torque as sent, in N·m, rounded to whole thousandths of the rated torque.

        Raises
        ------
        DeviceError
            If the torque is not a number, or the bus has failed.
        """
        send_frame = self._require_node().exchange.send
        if not self._enabled:
            send_frame(self._idle_rpdo)
            return 0.0
        torque_per_mille = torque_nm * self._per_mille_per_nm
        max_torque_per_mille = self._max_torque_per_mille
        if not -max_torque_per_mille <= torque_per_mille <= max_torque_per_mille:
            if isnan(torque_per_mille):
                raise DeviceError(f"{self._name}: the torque command is not a number.")
            torque_per_mille = (
                max_torque_per_mille if torque_per_mille > 0 else -max_torque_per_mille
            )
        sent_torque_per_mille = round(torque_per_mille)
        self._torque_check.register_command(sent_torque_per_mille)
        send_frame(self._frames.rpdo_frame(ENABLE_OPERATION_COMMAND, sent_torque_per_mille))
        return sent_torque_per_mille / self._per_mille_per_nm

    def health(self) -> LineHealth:
        """Return number of bits, bit rate and errors of the bus, as this driver sees them."""
        if self._node is None:
            return LineHealth()
        exchange = self._node.exchange
        pairing = self._node.pairing
        presumed_lost_count = pairing.presumed_lost_count
        doubt_text = lost_tpdos_text = ""
        if presumed_lost_count:
            doubt_reason = (
                "in lock-step" if self._node.lock_step else "while cia402.sync_gaps = false"
            )
            doubt_text = (
                f"{self._name}: a TPDO did not arrive, or all have been delayed by a period since, "
                f"which is unknown {doubt_reason}: angles may be older than the file states."
            )
            lost_tpdos_text = (
                f"{self._name}: TPDOs that did not arrive since it was connected: "
                f"{presumed_lost_count}."
            )
        error_count = (
            exchange.error_frames + pairing.lost_reply_count + self._inbox.malformed_frames
        )
        return LineHealth(
            exchange.bits,
            self._bit_rate_bit_s,
            error_count,
            doubt=doubt_text,
            doubt_count=lost_tpdos_text,
        )

    def disable(self) -> None:
        """Zero the torque and disable the drive; works in every state and never raises.

        If the statusword does not confirm within some 50 ms that the drive is off, the command is
        also sent by SDO, and finally the node is stopped.
        """
        self._enabled = False
        self._inbox.require_status(FAULT_BIT, 0)
        node = self._node
        if node is None:
            return
        if not self._may_be_on:
            node.send_if_possible(self._idle_rpdo)
            return
        if switch_off(node):
            self._may_be_on = False
            self.off_doubt = ""
        else:
            self.off_doubt = (
                f"{self._name}: it does not show that it is off (statusword "
                f"0x{self._inbox.statusword:04X}); check that it is, by its STO if need be. "
                f"{self._describe_watchdog()}"
            )
        node.restart_heartbeat_timing()

    def reset_fault(self) -> str | None:
        """Switch the drive off and reset its fault; the drive must then be reconnected.

        Returns
        -------
        str or None
            Description of the fault; None if the drive was not in fault. In both cases the drive
            has reported that it is off, and has shown that it can get ready to switch on.

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
        """Disable the drive, end its monitoring of this computer's heartbeat, and release the bus.

        A drive that may still have torque keeps monitoring, so that its watchdog removes the
        torque.
        """
        self.disable()
        self._inbox.must_stay_operational = False
        node, self._node = self._node, None
        if node is not None and not self._may_be_on:
            node.send_if_possible(self._frames.pre_operational)
            if self._capabilities is not None and self._capabilities.watchdog is Watchdog.HEARTBEAT:
                node.send_write_request(
                    self._frames.end_heartbeat_monitoring, HEARTBEAT_CONSUMER, 1
                )
        if self._is_open:
            self._is_open = False
            self._link.close()

    def _describe_watchdog(self) -> str:
        """Return which watchdog removes the torque of a drive that cannot be switched off."""
        capabilities = self._capabilities
        if capabilities is None or capabilities.watchdog is Watchdog.NONE:
            return "It has no watchdog that would end it by itself."
        return (
            "Without the loop it has to switch itself off within "
            f"{capabilities.watchdog_timeout_s:g} s, by its {capabilities.watchdog.value}."
        )

    def _require_node(self) -> Node:
        """Return the connected node, or raise if the drive is not connected."""
        if self._node is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return self._node

    def _open_link(self) -> CanExchange:
        """Open the bus unless this driver has it open, and return its exchange."""
        if not self._is_open:
            self._link.open()
            self._is_open = True
        return self._link.exchange

    def _subscribe(self, exchange: CanExchange) -> None:
        """Route the drive's frames to the inbox, once per exchange."""
        if self._subscribed is exchange:
            return
        self._subscribed = exchange
        exchange.subscribe(self._frames.tpdo_id, self._inbox.store_tpdo)
        exchange.subscribe(self._frames.emergency_id, self._inbox.store_emergency)
        exchange.subscribe(self._frames.heartbeat_id, self._inbox.store_heartbeat)
        exchange.subscribe(self._frames.reply_id, self._inbox.store_sdo_reply)

    def _store_previous_reply(self, node: Node) -> None:
        """Process the drive's reply to the previous tick's SYNC, which should have arrived."""
        if node.lock_step and node.pairing.outstanding:
            node.exchange.wait_until(node.pairing.is_up_to_date, node.sync_ns + node.deadline_ns)
        else:
            node.exchange.deliver_frames()
        self._store_reply(node)

    def _store_reply(self, node: Node) -> None:
        """Store the angle and check the torque if the last TPDO answers the last SYNC.

        Otherwise the stored angle is registered as stale.
        """
        is_new_angle_valid = node.pairing.process_replies() and self._inbox.is_last_tpdo_valid
        self.angle_stale = not is_new_angle_valid
        if self._enabled and is_new_angle_valid:
            self._torque_check.check_torque(self._inbox.torque)
        if is_new_angle_valid:
            position_counts = self._inbox.position
            # The 32-bit counter wraps around.
            self._relative_counts += (
                position_counts - self._position + _HALF_POSITION_COUNTER_RANGE
                & _POSITION_COUNTER_MASK
            ) - _HALF_POSITION_COUNTER_RANGE
            self._position = position_counts
            self.angle_rad = self._relative_counts * self._rad_per_count
            self.angle_time_ns = node.sync_ns

    def _raise_drive_error(self, node: Node) -> None:
        """Raise the error that explains why the drive no longer follows commands, or is silent."""
        node.raise_if_alarmed()
        statusword = self._inbox.unexpected_statusword
        if statusword is not None and drive_state(statusword) is not DriveState.OPERATION_ENABLED:
            node.await_emergency_message()
            node.raise_if_alarmed()
            raise operation_left_error(self._name, statusword)
        if statusword is not None:
            raise DeviceError(
                f"{self._name}: it ignores the target torque: bit 12 of its statusword "
                f"0x{statusword:04X} is not set; check its own diagnosis, and if this drive has "
                "no such bit: cia402.follows_target_bit = false."
            )
        heartbeat_silence_s = (node.now_ns - self._last_received_ns) * 1e-9
        raise DeviceError(
            f"{self._name}: no heartbeat for {heartbeat_silence_s:.3g} s, more than "
            f"cia402.drive_heartbeat_timeout_s = {node.settings.drive_heartbeat_timeout_s:g} s; "
            "check its supply and the cable."
        )
