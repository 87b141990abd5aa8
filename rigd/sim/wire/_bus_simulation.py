"""Bus simulation: the simulated rig with its nodes, clock and faults, without sockets.

Frames and bytes are passed in with their time of arrival. The output of the nodes is passed to two
callables. So the same `BusSimulation` runs with sockets and in a test.
"""

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from rigd.beam.realisation import RealisationError
from rigd.devices.canbus.port import BUS_OFF_FRAME, pack_frame, unpack_frame
from rigd.devices.obstacles import Obstacle, ObstacleError
from rigd.devices.parameters import RigParameters
from rigd.sim import SimulatedRig, StuckReadings
from rigd.sim.wire._faults import (
    DISTURBANCE_FAULT_KINDS,
    LINE_FAULT_KINDS,
    SERIAL_PSEUDO_ID,
    EventLog,
    Fault,
    FaultError,
    FaultyLine,
    disturbance_of,
)

_AVERAGED_SYNC_COUNT = 256
"""Number of SYNCs over which the phase of the tick grid is averaged.

A single late SYNC then hardly changes the phase."""
_OBSTACLE_LEAD_TIME_S = 0.5
"""Time in seconds from the injection of an obstacle in real time until the obstacle is present.

Preparing the obstacle takes less."""
_NEW_PHASE_PERIODS = 100
"""Number of periods without SYNC after which the next SYNC may have a new phase (another host)."""
_LOCK_STEP_MAX_WAIT_NS = 5_000_000_000
"""Time in nanoseconds that simulated time waits for a SYNC in lock-step."""


# Clocks


class WallClock:
    """Clock of a simulated rig in real time, whose tick grid follows the received SYNCs.

    A SYNC belongs to the nearest tick, at most half a period away. If none has arrived half a
    period after a tick, the tick passes without SYNC. The grid follows the mean phase of the last
    SYNCs, so that it does not need to know when the host's loop started. `now_ns` is the time of
    tick 0 on a monotonic clock.

    Attributes
    ----------
    tick : int
        Number of the present tick of the simulated rig.
    """

    def __init__(self, period_ns: float, now_ns: int) -> None:
        self._period_ns = period_ns
        self._origin_ns = float(now_ns)
        self._averaged_syncs = 0
        self._last_sync = 0
        self.tick = 0

    @property
    def due_ns(self) -> int:
        """Time in nanoseconds until which the SYNC of the next tick may arrive."""
        return round(self._origin_ns + (self.tick + 1.5) * self._period_ns)

    @property
    def is_idle(self) -> bool:
        """Whether no SYNC has been received yet, or none in the last 100 periods."""
        return self._averaged_syncs == 0 or self.tick - self._last_sync > _NEW_PHASE_PERIODS

    def sync(self, now_ns: float) -> int:
        """Process a SYNC received at `now_ns`; return the number of elapsed periods, normally 1."""
        elapsed_periods = (now_ns - self._origin_ns) / self._period_ns
        nearest_tick = round(elapsed_periods)
        if nearest_tick - self._last_sync > _NEW_PHASE_PERIODS:
            self._averaged_syncs = 0
        self._averaged_syncs = min(self._averaged_syncs + 1, _AVERAGED_SYNC_COUNT)
        self._last_sync = nearest_tick
        self._origin_ns += (elapsed_periods - nearest_tick) * self._period_ns / self._averaged_syncs
        return self._advance_to(nearest_tick)

    def elapse(self, now_ns: int) -> int:
        """Return the number of periods that have elapsed until `now_ns` without a SYNC in time."""
        return self._advance_to(int((now_ns - self._origin_ns) / self._period_ns - 0.5))

    def _advance_to(self, tick: int) -> int:
        """Advance the clock to a tick, and return the number of elapsed periods."""
        elapsed_periods = max(0, tick - self.tick)
        self.tick += elapsed_periods
        return elapsed_periods


class LockStep:
    """Clock of a simulated rig in lock-step: each SYNC advances it by one period.

    The clock does not wait for ever. Five seconds after the last SYNC, or at once if no client is
    connected any more, time continues by the wall clock, so that a drive notices a dead host. Time
    also runs by the wall clock before the first SYNC. `now_ns` is the present time on a monotonic
    clock.
    """

    is_idle = True

    def __init__(self, period_ns: float, now_ns: int) -> None:
        self._period_ns = period_ns
        self._waiting_until_ns = float(now_ns)

    @property
    def due_ns(self) -> int:
        """Time in ns (``time.monotonic_ns``) at which the next period elapses without a SYNC."""
        return round(self._waiting_until_ns + self._period_ns)

    def sync(self, now_ns: float) -> int:
        """Process a SYNC received at `now_ns`; return the number of elapsed periods, always 1."""
        self._waiting_until_ns = now_ns + _LOCK_STEP_MAX_WAIT_NS
        return 1

    def elapse(self, now_ns: int) -> int:
        """Return the number of periods that have elapsed by the wall clock without a SYNC."""
        elapsed_periods = max(0, int((now_ns - self._waiting_until_ns) / self._period_ns))
        self._waiting_until_ns += elapsed_periods * self._period_ns
        return elapsed_periods

    def stop_waiting(self, now_ns: int) -> None:
        """Stop waiting for a SYNC, since no client is connected any more."""
        self._waiting_until_ns = min(self._waiting_until_ns, now_ns)


# Nodes and frames

_SYNC_ID = 0x80
"""CAN identifier of SYNC."""
_SYNC_ID_BYTES = pack_frame(_SYNC_ID)[:4]
"""First bytes of a raw SYNC frame: its identifier."""
_MAX_CAN_ID = 0x7FF
"""Highest 11-bit CAN identifier."""
_STREAM_RECORD_BYTES = 13
"""Size in bytes of a record on the serial line."""
_CAN_ONLY_KEYS = ("id",)
"""Keys of a fault that make sense only on the CAN bus."""
_SERIAL_ONLY_KEYS = ("bytes",)
"""Keys of a fault that make sense only on the serial line."""
_MAX_CAN_DATA_BYTES = 8
"""Largest number of data bytes of a CAN frame."""
_DRIVE_ATTRIBUTES = {
    "no_pre_operational": "stays_operational",
    "no_bit_12": "never_sets_bit_12",
    "no_watch": "ignores_silent_host",
}
"""Attribute of the simulated drive that a kind of fault sets to True."""


class SimulatedNode(Protocol):
    """Device on the simulated CAN bus."""

    frozen: bool
    """Whether the device neither sends nor receives."""

    def reset(self) -> None:
        """Restart the device, as by its own watchdog."""

    def power_cycle(self) -> None:
        """Restart the device as after a loss of power."""

    def receive(self, can_id: int, data: bytes) -> None:
        """Process a CAN frame that the device has received."""

    def tick(self, now_s: float) -> None:
        """Advance the device to the simulated time `now_s`, in seconds."""


class SerialDevice(Protocol):
    """Simulated device, such as a sensor, at the end of a simulated serial line."""

    frozen: bool
    """Whether the device neither sends nor receives."""

    def reset(self) -> None:
        """Restart the device, as by its own watchdog."""

    def power_cycle(self) -> None:
        """Restart the device as after a loss of power."""

    def receive(self, data: bytes) -> None:
        """Process bytes that the device has received from the host."""

    def emit(self) -> None:
        """Send the bytes that the device streams in a period."""

    def tick(self, now_s: float) -> None:
        """Advance the device to the simulated time `now_s`, in seconds."""


@dataclass(frozen=True, slots=True, eq=False)
class _AttributeOverride:
    """Active fault that overrides an attribute of a device, and the attribute's normal value."""

    fault: Fault
    device: Any
    attribute_name: str
    faulty_value: object
    normal_value: object


class BusSimulation:
    """Simulated rig with its lines, which transfers frames between host and nodes.

    In lock-step, each SYNC advances the rig by one period; otherwise, wall time advances it.
    `now_ns` is the present time on a monotonic clock. `send_frame` sends a frame to the hosts on
    the CAN bus; its second argument is the host that sent the frame, or None for a node.
    `write_bytes` sends bytes to the host on the serial line. `interrupt_line` and
    `reconnect_line` interrupt and reconnect the "bus" or the line of the "sensor". This class sets
    the time of `log`.

    Attributes
    ----------
    periods : int
        Simulated time since the start, in periods. In lock-step the nodes' time continues while the
        rig itself waits for a host, so that the nodes can be set up.
    rig_periods : int
        Number of periods by which the rig itself has advanced.
    syncs : int
        Number of received SYNCs.
    bus_off : bool
        Whether the host's controller is off the bus, so that no frames pass in either direction.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated_rig: SimulatedRig,
        *,
        lock_step: bool,
        now_ns: int,
        send_frame: Callable[[bytes, object], None],
        write_bytes: Callable[[bytes], None],
        interrupt_line: Callable[[str], None],
        reconnect_line: Callable[[str], None],
        log: EventLog,
    ) -> None:
        self._simulated_rig = simulated_rig
        self._period_s = 1 / rig.rate_hz
        self._period_ns = 1e9 / rig.rate_hz
        self._lock_step = lock_step
        self.clock = (LockStep if lock_step else WallClock)(self._period_ns, now_ns)
        self._now_ns = float(now_ns)
        self._send_to_hosts = send_frame
        self._write_to_host = write_bytes
        self._interrupt = interrupt_line
        self._reconnect = reconnect_line
        self._log = log
        self._nodes: dict[str, SimulatedNode] = {}
        self._serial_device: SerialDevice | None = None
        self._advance_is_due = False
        self._lines = {
            "host": FaultyLine("host", self._deliver_from_host, self._schedule_delivery, log),
            "drive": FaultyLine(
                "drive", partial(self._deliver_from_node, "drive"), self._schedule_delivery, log
            ),
            "sensor": FaultyLine(
                "sensor", partial(self._deliver_from_node, "sensor"), self._schedule_delivery, log
            ),
        }
        self._undelivered_frames: deque[tuple[str, int, bytes]] = deque()
        self._is_streaming = False
        self._action_count = 0
        self.bus_off = False
        self._delayed_deliveries: list[tuple[float, int, Callable[[], None]]] = []
        self._scheduled_actions: list[tuple[float, int, Callable[[], None]]] = []
        self._faults_after_enabling: list[Fault] = []
        self._overrides: list[_AttributeOverride] = []
        self._cut_lines: dict[str, Fault] = {}
        self._obstacles: list[tuple[Fault, Obstacle]] = []
        self._enabled_s: float | None = None
        self.periods = 0
        self.rig_periods = 0
        self.syncs = 0

    @property
    def now_s(self) -> float:
        """Simulated time since the start in seconds."""
        return self.periods * self._period_s

    def wait_s(self, now_ns: int, max_wait_s: float) -> float:
        """Return the time in s until an action is due even without input, at most `max_wait_s`."""
        due_ns = float("inf") if self.clock.is_idle else float(self.clock.due_ns)
        if self._delayed_deliveries and not self._lock_step:
            due_ns = min(due_ns, self._delayed_deliveries[0][0])
        return min(max_wait_s, max(0.0, (due_ns - now_ns) * 1e-9))

    @property
    def disturbed_senders(self) -> list[str]:
        """Names of the senders whose next frames a fault may affect."""
        return [
            sender_name
            for sender_name, faulty_line in self._lines.items()
            if faulty_line.is_disturbed
        ]

    def can_sender(self, sender: str) -> Callable[[int, bytes], None]:
        """Return the function by which a node sends frames on the simulated CAN bus."""
        return self._lines[sender].send

    def serial_writer(self) -> Callable[[bytes], None]:
        """Return the function by which a sensor writes to the serial line."""
        return self._write_serial

    def add_node(self, node_name: str, simulated_node: SimulatedNode) -> None:
        """Connect a node to the simulated CAN bus."""
        self._nodes[node_name] = simulated_node

    def add_serial_device(self, device: SerialDevice) -> None:
        """Connect the simulated sensor to the simulated serial line."""
        self._serial_device = device
        self._lines["sensor"] = FaultyLine(
            "sensor", self._deliver_to_serial_host, self._schedule_delivery, self._log
        )

    def step(self) -> None:
        """Advance the simulated rig by the period of a SYNC that the drive has received."""
        if self._advance_is_due:
            self._advance_is_due = False
            self._advance_rig()

    def receive_frames(self, frames: list[bytes], sending_host: object, now_ns: int) -> None:
        """Process frames of a host, in order; `now_ns` is the time at which they were read.

        Frames that are read together may have been sent at different times: after a pause of this
        process there may be several SYNCs, which were sent a period apart.
        """
        self._now_ns = now_ns
        sync_count = sum(can_frame.startswith(_SYNC_ID_BYTES) for can_frame in frames)
        if not sync_count and self.clock.is_idle:
            self.elapse(now_ns)
        sync_sent_ns = now_ns - (sync_count - 1) * self._period_ns
        for can_frame in frames:
            can_id, data = unpack_frame(can_frame)
            if can_id == _SYNC_ID:
                self._process_sync(data, sending_host, sync_sent_ns)
                sync_sent_ns += self._period_ns
            elif can_id <= _MAX_CAN_ID:
                self._lines["host"].send(can_id, data, sending_host)

    def receive_serial(self, data: bytes) -> None:
        """Pass bytes of the host on the serial line to the simulated sensor."""
        if self._serial_device is not None:
            self._serial_device.receive(data)

    def elapse(self, now_ns: int) -> None:
        """Advance the time without a SYNC; frames received before must already be processed."""
        self._now_ns = now_ns
        for _ in range(self.clock.elapse(now_ns)):
            self._run_period()
        if self._delayed_deliveries and not self._lock_step:
            self._run_due_actions(self._delayed_deliveries, now_ns)

    def stop_waiting(self, now_ns: int) -> None:
        """Stop waiting for a SYNC, since no host is connected any more."""
        if isinstance(self.clock, LockStep):
            self.clock.stop_waiting(now_ns)

    def inject(self, fault: Fault) -> None:
        """Begin a fault now, or schedule the fault if it has a start time.

        Raise `FaultError` if the fault is not possible on this rig.
        """
        self._check_fault(fault)
        if fault.after_s is None:
            self._begin_fault(fault)
        elif self._enabled_s is None:
            self._faults_after_enabling.append(fault)
        else:
            self._schedule(self._enabled_s + fault.after_s, partial(self._begin_fault, fault))

    def _process_sync(self, data: bytes, sending_host: object, now_ns: float) -> None:
        """Process a SYNC: advance clock, rig and nodes, and deliver the SYNC."""
        self.syncs += 1
        elapsed_periods = self.clock.sync(now_ns)
        for _ in range(elapsed_periods - 1):
            self._run_period()
        self._advance_is_due = elapsed_periods > 0
        self._lines["host"].send(_SYNC_ID, data, sending_host)
        self.step()  # the rig advances even if the drive has not received the SYNC
        if elapsed_periods:
            self._run_nodes()

    def _run_period(self) -> None:
        """Advance time and nodes by a period, and the rig unless it waits for its host."""
        # In lock-step, a rig waits for its host while its drive is off.
        if not self._lock_step or self._simulated_rig.plant.enabled:
            self._advance_rig()
        else:
            self.periods += 1
            self._log.time_s = self.now_s
        self._run_nodes()

    def _advance_rig(self) -> None:
        """Advance the rig by one period, and send the records of the serial sensor."""
        self._simulated_rig.advance(1)
        self.periods += 1
        self.rig_periods += 1
        self._log.time_s = self.now_s
        # Before the drive answers, so that a host with its answer also finds the records.
        if self._serial_device is not None:
            self._is_streaming = True
            self._serial_device.emit()
            self._is_streaming = False

    def _run_nodes(self) -> None:
        """Run the due actions of the nodes, and begin or end the due faults."""
        if self._serial_device is not None:
            self._serial_device.tick(self.now_s)
        for simulated_node in self._nodes.values():
            simulated_node.tick(self.now_s)
        self._deliver_to_nodes()
        if self._enabled_s is None and self._simulated_rig.plant.enabled:
            self._enabled_s = self.now_s
            for due_fault in self._faults_after_enabling:
                self.inject(due_fault)
        if self._scheduled_actions:
            self._run_due_actions(self._scheduled_actions, self.now_s)
        if self._delayed_deliveries and self._lock_step:
            self._run_due_actions(self._delayed_deliveries, self.periods * self._period_ns)

    # Delivery of frames and bytes.

    def _deliver_from_host(self, can_id: int, data: bytes, sending_host: object) -> None:
        """Deliver a frame of a host to the other hosts and to the nodes."""
        if self.bus_off:
            return
        self._send_to_hosts(pack_frame(can_id, data), sending_host)
        for simulated_node in self._nodes.values():
            simulated_node.receive(can_id, data)
        self._deliver_to_nodes()

    def _deliver_from_node(self, sender: str, can_id: int, data: bytes, _: object) -> None:
        """Deliver a frame of a node to the hosts, and queue it for the other nodes."""
        if not self.bus_off:
            self._send_to_hosts(pack_frame(can_id, data), None)
        self._undelivered_frames.append((sender, can_id, data))

    def _deliver_to_nodes(self) -> None:
        """Deliver queued frames of nodes to the other nodes, after their present actions."""
        while self._undelivered_frames:
            sender, can_id, data = self._undelivered_frames.popleft()
            for node_name, simulated_node in self._nodes.items():
                if node_name != sender:
                    simulated_node.receive(can_id, data)

    def _write_serial(self, data: bytes) -> None:
        """Send bytes of the sensor over the serial line, record by record if a fault acts on it."""
        serial_line = self._lines["sensor"]
        if self._is_streaming and serial_line.is_disturbed:  # record by record
            for record_offset in range(0, len(data), _STREAM_RECORD_BYTES):
                serial_line.send(
                    SERIAL_PSEUDO_ID, data[record_offset : record_offset + _STREAM_RECORD_BYTES]
                )
        else:
            serial_line.send(SERIAL_PSEUDO_ID, data)

    def _deliver_to_serial_host(self, _: int, data: bytes, __: object) -> None:
        """Pass bytes of the simulated sensor to the host, unless the line has dropped them."""
        self._write_to_host(data)

    # Faults.

    def _check_fault(self, fault: Fault) -> None:
        """Raise if a fault is not possible on this rig."""
        fault_values = fault.values
        device_name = fault_values.get("device", fault_values.get("from", "drive"))
        if fault.kind in ("saturate", "status") or fault_values.get("what") in ("sensor", "gauge"):
            device_name = "sensor"
        is_on_serial_line = self._serial_device is not None and device_name == "sensor"
        if (
            device_name in ("drive", "sensor")
            and device_name not in self._nodes
            and not is_on_serial_line
        ):
            raise FaultError(f"Fault '{fault}': this rig has no {device_name} on its lines.")
        if fault.kind == "cut" and device_name == "sensor" and not is_on_serial_line:
            raise FaultError(
                f"Fault '{fault}': this rig's sensor has no serial line; use "
                "freeze,device=sensor, or cut for the whole bus."
            )
        for key in _CAN_ONLY_KEYS if is_on_serial_line else _SERIAL_ONLY_KEYS:
            if key in fault_values:
                raise FaultError(
                    f"Fault '{fault}': {key} is for a sensor on "
                    f"{'CAN' if is_on_serial_line else 'a serial line'}, which this one is not."
                )
        if (
            fault.kind == "corrupt"
            and not is_on_serial_line
            and int(fault_values["byte"]) >= _MAX_CAN_DATA_BYTES
        ):
            raise FaultError(
                f"Fault '{fault}': byte={fault_values['byte']} has no effect; a CAN frame has at "
                f"most the bytes 0 to {_MAX_CAN_DATA_BYTES - 1}."
            )

        if fault.kind in DISTURBANCE_FAULT_KINDS:
            try:
                self._simulated_rig.check_disturbance(disturbance_of(fault, 0.0))
            except (ObstacleError, RealisationError) as error:
                raise FaultError(f"Fault '{fault}': {error}") from None

    def _begin_fault(self, fault: Fault) -> None:
        """Begin an injected fault now: change the device, line or rig that it concerns."""
        self._log("simulator", "fault", fault=str(fault))
        fault_values: dict[str, Any] = dict(fault.values)
        sensor_device: Any = self._serial_device or self._nodes.get("sensor")
        drive_node: Any = self._nodes.get("drive")
        if fault.kind in LINE_FAULT_KINDS:
            self._lines[fault_values["from"]].add_fault(fault)
        elif fault.kind == "freeze":
            self._override_attribute(
                fault,
                drive_node if fault_values["device"] == "drive" else sensor_device,
                "frozen",
                True,
            )
        elif fault.kind == "saturate":
            self._override_attribute(fault, sensor_device, "saturate", fault_values["gauge"])
        elif fault.kind == "stuck":
            self._begin_stuck_readings(fault, sensor_device)
        elif fault.kind == "status":
            self._override_attribute(fault, sensor_device, "status_bits", fault_values["bits"])
        elif fault.kind == "emcy":
            drive_node.emergency(fault_values["code"], fault_values["register"], bytes(5))
        elif fault.kind == "sto":
            self._override_attribute(fault, drive_node, "sto_dropped", True)
        elif fault.kind == "busoff":
            self._send_to_hosts(BUS_OFF_FRAME, None)
            self._override_attribute(fault, self, "bus_off", True)
        elif fault.kind == "jump":
            drive_node.angle_offset_counts += fault_values["counts"]
        elif fault.kind == "object":
            drive_node.override_object(
                fault_values["index"], fault_values["sub"], fault_values.get("value")
            )
        elif fault.kind in ("restart", "power_cycle"):
            fault_device = drive_node if fault_values["device"] == "drive" else sensor_device
            (fault_device.reset if fault.kind == "restart" else fault_device.power_cycle)()
        elif fault.kind == "lag":
            self._override_attribute(fault, drive_node, "torque_lag_s", 1e-3 * fault_values["ms"])
        elif fault.kind in _DRIVE_ATTRIBUTES:
            self._override_attribute(fault, drive_node, _DRIVE_ATTRIBUTES[fault.kind], True)
        elif fault.kind in DISTURBANCE_FAULT_KINDS:
            obstacle_start_s = self._simulated_rig.plant.elapsed_s + (
                0.0 if self._lock_step else _OBSTACLE_LEAD_TIME_S
            )
            disturbance = disturbance_of(fault, obstacle_start_s)
            self._simulated_rig.add_disturbance(disturbance, wait=self._lock_step)
            if isinstance(disturbance, Obstacle):
                self._obstacles.append((fault, disturbance))
        elif fault.kind == "end":
            self._end_faults(fault_values.get("fault"))
        else:
            self._cut_lines[fault_values["device"]] = fault
            self._interrupt(fault_values["device"])
        self._deliver_to_nodes()

    def _begin_stuck_readings(self, fault: Fault, sensor: Any) -> None:  # noqa: ANN401
        """Make the encoder, the sensor or one gauge repeat its readings."""
        stuck_readings = StuckReadings(int(fault.values.get("every", 0)))
        stuck_device = fault.values["what"]
        if stuck_device == "encoder":
            self._override_attribute(fault, self._simulated_rig, "stuck_encoder", stuck_readings)
        elif stuck_device == "sensor":
            self._override_attribute(fault, self._simulated_rig.sensor, "stuck", stuck_readings)
        else:
            self._override_attribute(
                fault, sensor.gauges, "stuck", (int(fault.values["gauge"]), stuck_readings)
            )

    def _override_attribute(
        self,
        fault: Fault,
        device: Any,  # noqa: ANN401
        attribute_name: str,
        faulty_value: object,
    ) -> None:
        """Let a fault give an attribute of a device another value until the fault ends."""
        other_overrides = [
            s for s in self._overrides if (s.device, s.attribute_name) == (device, attribute_name)
        ]
        normal_value = (
            other_overrides[0].normal_value if other_overrides else getattr(device, attribute_name)
        )
        override = _AttributeOverride(fault, device, attribute_name, faulty_value, normal_value)
        self._overrides.append(override)
        setattr(device, attribute_name, faulty_value)
        if "for" in fault.values:
            fault_end_s = self.now_s + float(fault.values["for"])
            self._schedule(fault_end_s, partial(self._end_override, override))

    def _end_override(self, override: "_AttributeOverride") -> None:
        """End a fault that overrides an attribute of a device.

        The attribute gets the value of the latest other fault that overrides it, or else its normal
        value.
        """
        if override not in self._overrides:  # it was ended before its scheduled end
            return
        self._overrides.remove(override)
        restored_value = override.normal_value
        for other_override in self._overrides:
            if (other_override.device, other_override.attribute_name) == (
                override.device,
                override.attribute_name,
            ):
                restored_value = other_override.faulty_value
        setattr(override.device, override.attribute_name, restored_value)
        self._log("simulator", "fault over", fault=str(override.fault))

    def _end_faults(self, fault_kind: str | None) -> None:
        """End all faults of a kind, or all faults if it is None."""
        for faulty_line in self._lines.values():
            for ended_kind in faulty_line.end_faults(fault_kind):
                self._log("simulator", "fault over", fault=ended_kind)
        for override in [s for s in self._overrides if fault_kind in (None, s.fault.kind)]:
            self._end_override(override)
        if fault_kind in (None, "obstacle"):
            active_obstacles, self._obstacles = self._obstacles, []
            for fault, obstacle in active_obstacles:
                self._simulated_rig.remove_obstacle(obstacle)
                self._log("simulator", "fault over", fault=str(fault))
        if fault_kind in (None, "cut"):
            cut_lines, self._cut_lines = self._cut_lines, {}
            for device_name, fault in cut_lines.items():
                self._reconnect(device_name)
                self._log("simulator", "fault over", fault=str(fault))

    def _schedule(self, due_s: float, action: Callable[[], None]) -> None:
        """Schedule an action at a simulated time in seconds since the start."""
        self._action_count += 1
        # Half a period of tolerance, so that the end of an interval does not depend on rounding.
        heapq.heappush(
            self._scheduled_actions, (due_s - 0.5 * self._period_s, self._action_count, action)
        )

    def _schedule_delivery(self, delay_s: float, action: Callable[[], None]) -> None:
        """Deliver a frame after a delay: simulated time in lock-step, otherwise wall-clock time."""
        self._action_count += 1
        now_ns = self.periods * self._period_ns if self._lock_step else self._now_ns
        heapq.heappush(
            self._delayed_deliveries, (now_ns + delay_s * 1e9, self._action_count, action)
        )

    def _run_due_actions(
        self, action_queue: list[tuple[float, int, Callable[[], None]]], present_time: float
    ) -> None:
        """Run the actions of a queue that are due at a time, and deliver the nodes' frames."""
        while action_queue and action_queue[0][0] <= present_time:
            heapq.heappop(action_queue)[2]()
        self._deliver_to_nodes()
