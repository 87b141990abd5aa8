"""Bus simulation: the rig between its lines, with nodes, clock and faults, but no input or output.

Input is passed in with its time of arrival; output of the nodes goes through two callables. So the
same `BusSimulation` runs behind sockets and in a test.
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
from rigd.sim import SimulatedRig, Stuck
from rigd.sim.wire._faults import (
    DISTURBANCES,
    LINE_KINDS,
    SERIAL,
    EventLog,
    Fault,
    FaultError,
    FaultyLine,
    disturbance_of,
)

_MEMORY_SYNCS = 256
"""SYNCs over which the grid's phase is averaged: a single late one hardly moves it."""
_READY_IN_S = 0.5
"""Time until an obstacle is there in real time, longer than the rig takes to make ready for it."""
_FORGET_PERIODS = 100
"""Periods of silence after which the next SYNC may come from another host with its own phase."""
_PATIENCE_NS = 5_000_000_000


# Clocks


class WallClock:
    """Whole periods of wall time, on a grid that follows the SYNC.

    A SYNC marks the tick nearest to it, whether it is up to half a period early or late. A tick
    whose SYNC has not come half a period after it passes without. The grid follows the mean phase
    of the last SYNCs, so that it need not know when the host's loop started.

    Parameters
    ----------
    period_ns
        Length of a period.
    now_ns
        Time of tick 0, on a clock that never steps back.

    Attributes
    ----------
    tick : int
        Tick of the simulated rig.
    """

    def __init__(self, period_ns: float, now_ns: int) -> None:
        self._period_ns = period_ns
        self._origin_ns = float(now_ns)
        self._followed = 0
        self._last_sync = 0
        self.tick = 0

    @property
    def due_ns(self) -> int:
        """Until when the SYNC of the next tick may come."""
        return round(self._origin_ns + (self.tick + 1.5) * self._period_ns)

    @property
    def idle(self) -> bool:
        """No SYNC has come for a long time."""
        return self._followed == 0 or self.tick - self._last_sync > _FORGET_PERIODS

    def sync(self, now_ns: float) -> int:
        """Return how many periods pass with a SYNC at this time: one, but for irregular ones."""
        elapsed = (now_ns - self._origin_ns) / self._period_ns
        nearest = round(elapsed)
        if nearest - self._last_sync > _FORGET_PERIODS:
            self._followed = 0
        self._followed = min(self._followed + 1, _MEMORY_SYNCS)
        self._last_sync = nearest
        self._origin_ns += (elapsed - nearest) * self._period_ns / self._followed
        return self._pass_to(nearest)

    def elapse(self, now_ns: int) -> int:
        """Return how many periods pass without a SYNC, because theirs did not come in time."""
        return self._pass_to(int((now_ns - self._origin_ns) / self._period_ns - 0.5))

    def _pass_to(self, tick: int) -> int:
        passed = max(0, tick - self.tick)
        self.tick += passed
        return passed


class LockStep:
    """One period per SYNC; simulated time waits for the next one.

    It does not wait forever: five seconds after the last SYNC, and at once where no client is left
    who could send one, time goes on by the wall clock, so that a drive notices a dead host. Before
    the first SYNC it goes on too.

    Parameters
    ----------
    period_ns
        Length of a period.
    now_ns
        Wall time, on a clock that never steps back.
    """

    idle = True

    def __init__(self, period_ns: float, now_ns: int) -> None:
        self._period_ns = period_ns
        self._halted_until_ns = float(now_ns)

    @property
    def due_ns(self) -> int:
        """When a period passes without a SYNC."""
        return round(self._halted_until_ns + self._period_ns)

    def sync(self, now_ns: float) -> int:
        """Return how many periods pass with a SYNC: always one."""
        self._halted_until_ns = now_ns + _PATIENCE_NS
        return 1

    def elapse(self, now_ns: int) -> int:
        """Return how many periods pass by the wall clock."""
        passed = max(0, int((now_ns - self._halted_until_ns) / self._period_ns))
        self._halted_until_ns += passed * self._period_ns
        return passed

    def left_alone(self, now_ns: int) -> None:
        """End the waiting: no client is connected any more."""
        self._halted_until_ns = min(self._halted_until_ns, now_ns)


# Nodes and frames

_SYNC = 0x80
_SYNC_HEAD = pack_frame(_SYNC)[:4]
_HIGHEST_ID = 0x7FF
_RECORD_SIZE = 13
_WORDS_ON_CAN = ("id",)
_WORDS_ON_SERIAL = ("bytes",)
_CAN_BYTES = 8
_TRAITS = {
    "no_pre_operational": "stays_operational",
    "no_bit_12": "never_follows",
    "no_watch": "watchless",
}
"""Traits that a fault may give the drive, and the attribute of each."""


class SimulatedNode(Protocol):
    """A device on the simulated CAN bus."""

    frozen: bool

    def reset(self) -> None:
        """Restart by itself."""

    def power_cycle(self) -> None:
        """Start as when its power comes back."""

    def receive(self, can_id: int, data: bytes) -> None:
        """Receive a frame."""

    def tick(self, now_s: float) -> None:
        """Let simulated time pass."""


class SerialDevice(Protocol):
    """A device at the far end of a serial line."""

    frozen: bool

    def reset(self) -> None:
        """Restart by itself."""

    def power_cycle(self) -> None:
        """Start as when its power comes back."""

    def receive(self, data: bytes) -> None:
        """Receive bytes from the host."""

    def emit(self) -> None:
        """Send what a period brings by itself."""

    def tick(self, now_s: float) -> None:
        """Let simulated time pass."""


@dataclass(frozen=True, slots=True, eq=False)
class _Standing:
    """A fault that overrides an attribute of a device."""

    fault: Fault
    device: Any
    attribute: str
    value: object
    normal: object


class BusSimulation:
    """Moves the rig on, and carries frames between host and nodes.

    Parameters
    ----------
    rig, simulated
        Parameters of the rig, and the plant with its devices.
    lock_step
        One period per SYNC, instead of wall time.
    now_ns
        Wall time, on a clock that never steps back.
    send
        Takes a frame for the hosts on the CAN bus, and which of them sent it (None: a node).
    write
        Takes bytes for the host on the serial line.
    cut, mend
        Cuts the "bus" or the line of the "sensor", and puts it together again.
    log
        Takes the events; its time is set here.

    Attributes
    ----------
    periods : int
        Simulated time since the start. In lock-step the nodes' time goes on while the rig itself
        waits for a host, so that they can be set up.
    moved : int
        Periods by which the rig itself moved.
    syncs : int
        SYNCs received.
    bus_off : bool
        Whether the host's controller is off the bus: no frames pass in either direction.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated: SimulatedRig,
        *,
        lock_step: bool,
        now_ns: int,
        send: Callable[[bytes, object], None],
        write: Callable[[bytes], None],
        cut: Callable[[str], None],
        mend: Callable[[str], None],
        log: EventLog,
    ) -> None:
        self._simulated = simulated
        self._period_s = 1 / rig.rate_hz
        self._period_ns = 1e9 / rig.rate_hz
        self._lock_step = lock_step
        self.clock = (LockStep if lock_step else WallClock)(self._period_ns, now_ns)
        self._now_ns = float(now_ns)
        self._send = send
        self._write = write
        self._cut = cut
        self._mend = mend
        self._log = log
        self._nodes: dict[str, SimulatedNode] = {}
        self._serial: SerialDevice | None = None
        self._owed = False
        self._lines = {
            "host": FaultyLine("host", self._from_host, self._postpone, log),
            "drive": FaultyLine("drive", partial(self._from_node, "drive"), self._postpone, log),
            "sensor": FaultyLine("sensor", partial(self._from_node, "sensor"), self._postpone, log),
        }
        self._unheard: deque[tuple[str, int, bytes]] = deque()
        self._emitting = False
        self._order = 0
        self.bus_off = False
        self._postponed: list[tuple[float, int, Callable[[], None]]] = []
        self._planned: list[tuple[float, int, Callable[[], None]]] = []
        self._awaiting_drive: list[Fault] = []
        self._standing: list[_Standing] = []
        self._cut_lines: dict[str, Fault] = {}
        self._obstacles: list[tuple[Fault, Obstacle]] = []
        self._enabled_s: float | None = None
        self.periods = 0
        self.moved = 0
        self.syncs = 0

    @property
    def now_s(self) -> float:
        """Simulated time since the start."""
        return self.periods * self._period_s

    def wait_s(self, now_ns: int, longest_s: float) -> float:
        """Return how long nothing has to be done if nothing comes in, up to the longest wait."""
        due_ns = float("inf") if self.clock.idle else float(self.clock.due_ns)
        if self._postponed and not self._lock_step:
            due_ns = min(due_ns, self._postponed[0][0])
        return min(longest_s, max(0.0, (due_ns - now_ns) * 1e-9))

    @property
    def disturbed(self) -> list[str]:
        """Senders whose next frames a fault may hit."""
        return [sender for sender, line in self._lines.items() if line.disturbed]

    def can_port(self, sender: str) -> Callable[[int, bytes], None]:
        """Return what a node on the bus sends with."""
        return self._lines[sender].send

    def serial_port(self) -> Callable[[bytes], None]:
        """Return what a sensor on a serial line writes with."""
        return self._write_serial

    def join(self, name: str, node: SimulatedNode) -> None:
        """Put a node on the bus."""
        self._nodes[name] = node

    def join_serial(self, device: SerialDevice) -> None:
        """Put the sensor on the serial line."""
        self._serial = device
        self._lines["sensor"] = FaultyLine("sensor", self._to_serial, self._postpone, self._log)

    def step(self) -> None:
        """Advance the rig to the tick of a SYNC; the drive calls it at each one received."""
        if self._owed:
            self._owed = False
            self._move()

    def hear(self, frames: list[bytes], origin: object, now_ns: int) -> None:
        """Process frames of a host, in order, that were read at this time.

        Frames that were read together were not sent together: after a pause of this process there
        may be several SYNCs, which were sent a period apart.
        """
        self._now_ns = now_ns
        syncs = sum(frame.startswith(_SYNC_HEAD) for frame in frames)
        if not syncs and self.clock.idle:
            self.elapse(now_ns)
        sent_ns = now_ns - (syncs - 1) * self._period_ns
        for frame in frames:
            can_id, data = unpack_frame(frame)
            if can_id == _SYNC:
                self._sync(data, origin, sent_ns)
                sent_ns += self._period_ns
            elif can_id <= _HIGHEST_ID:
                self._lines["host"].send(can_id, data, origin)

    def hear_serial(self, data: bytes) -> None:
        """Process bytes of the host on the serial line."""
        if self._serial is not None:
            self._serial.receive(data)

    def elapse(self, now_ns: int) -> None:
        """Advance the time without a SYNC; frames received before must be processed first."""
        self._now_ns = now_ns
        for _ in range(self.clock.elapse(now_ns)):
            self._pass_period()
        if self._postponed and not self._lock_step:
            self._run_due(self._postponed, now_ns)

    def left_alone(self, now_ns: int) -> None:
        """Note that no host is connected any more."""
        if isinstance(self.clock, LockStep):
            self.clock.left_alone(now_ns)

    def inject(self, fault: Fault) -> None:
        """Inject a fault, now or at its time.

        Raises
        ------
        FaultError
            If this rig cannot have it.
        """
        self._check(fault)
        if fault.after_s is None:
            self._begin(fault)
        elif self._enabled_s is None:
            self._awaiting_drive.append(fault)
        else:
            self._plan(self._enabled_s + fault.after_s, partial(self._begin, fault))

    def _sync(self, data: bytes, origin: object, now_ns: float) -> None:
        self.syncs += 1
        periods = self.clock.sync(now_ns)
        for _ in range(periods - 1):
            self._pass_period()
        self._owed = periods > 0
        self._lines["host"].send(_SYNC, data, origin)
        self.step()  # the rig moves even if it was not received
        if periods:
            self._let_nodes_act()

    def _pass_period(self) -> None:
        # In lock-step a rig whose drive is off waits for its host.
        if not self._lock_step or self._simulated.plant.enabled:
            self._move()
        else:
            self.periods += 1
            self._log.time_s = self.now_s
        self._let_nodes_act()

    def _move(self) -> None:
        self._simulated.advance(1)
        self.periods += 1
        self.moved += 1
        self._log.time_s = self.now_s
        # Before the drive answers: a host that has its answer finds the records too.
        if self._serial is not None:
            self._emitting = True
            self._serial.emit()
            self._emitting = False

    def _let_nodes_act(self) -> None:
        """Run the due actions of the nodes, and begin the due faults."""
        if self._serial is not None:
            self._serial.tick(self.now_s)
        for node in self._nodes.values():
            node.tick(self.now_s)
        self._let_hear()
        if self._enabled_s is None and self._simulated.plant.enabled:
            self._enabled_s = self.now_s
            for fault in self._awaiting_drive:
                self.inject(fault)
        if self._planned:
            self._run_due(self._planned, self.now_s)
        if self._postponed and self._lock_step:
            self._run_due(self._postponed, self.periods * self._period_ns)

    # The ways of what is sent.

    def _from_host(self, can_id: int, data: bytes, origin: object) -> None:
        if self.bus_off:
            return
        self._send(pack_frame(can_id, data), origin)
        for node in self._nodes.values():
            node.receive(can_id, data)
        self._let_hear()

    def _from_node(self, sender: str, can_id: int, data: bytes, _: object) -> None:
        if not self.bus_off:
            self._send(pack_frame(can_id, data), None)
        self._unheard.append((sender, can_id, data))

    def _let_hear(self) -> None:
        """Deliver the nodes' frames to each other after their present actions."""
        while self._unheard:
            sender, can_id, data = self._unheard.popleft()
            for name, node in self._nodes.items():
                if name != sender:
                    node.receive(can_id, data)

    def _write_serial(self, data: bytes) -> None:
        line = self._lines["sensor"]
        if self._emitting and line.disturbed:  # record by record
            for at in range(0, len(data), _RECORD_SIZE):
                line.send(SERIAL, data[at : at + _RECORD_SIZE])
        else:
            line.send(SERIAL, data)

    def _to_serial(self, _: int, data: bytes, __: object) -> None:
        self._write(data)

    # Faults.

    def _check(self, fault: Fault) -> None:
        values = fault.values
        device = values.get("device", values.get("from", "drive"))
        if fault.kind in ("saturate", "status") or values.get("what") in ("sensor", "gauge"):
            device = "sensor"
        on_serial = self._serial is not None and device == "sensor"
        if device in ("drive", "sensor") and device not in self._nodes and not on_serial:
            raise FaultError(f"Fault '{fault}': this rig has no {device} on its lines.")
        if fault.kind == "cut" and device == "sensor" and not on_serial:
            raise FaultError(
                f"Fault '{fault}': this rig's sensor has no serial line; use "
                "freeze,device=sensor, or cut for the whole bus."
            )
        for word in _WORDS_ON_CAN if on_serial else _WORDS_ON_SERIAL:
            if word in values:
                raise FaultError(
                    f"Fault '{fault}': {word} is for a sensor on "
                    f"{'CAN' if on_serial else 'a serial line'}, which this one is not."
                )
        if fault.kind == "corrupt" and not on_serial and int(values["byte"]) >= _CAN_BYTES:
            raise FaultError(
                f"Fault '{fault}': byte={values['byte']} has no effect; a CAN frame has at most "
                f"the bytes 0 to {_CAN_BYTES - 1}."
            )

        if fault.kind in DISTURBANCES:
            try:
                self._simulated.check_disturbance(disturbance_of(fault, 0.0))
            except (ObstacleError, RealisationError) as error:
                raise FaultError(f"Fault '{fault}': {error}") from None

    def _begin(self, fault: Fault) -> None:
        self._log("simulator", "fault", fault=str(fault))
        values: dict[str, Any] = dict(fault.values)
        sensor: Any = self._serial or self._nodes.get("sensor")
        drive: Any = self._nodes.get("drive")
        if fault.kind in LINE_KINDS:
            self._lines[values["from"]].add(fault)
        elif fault.kind == "freeze":
            self._stand(fault, drive if values["device"] == "drive" else sensor, "frozen", True)
        elif fault.kind == "saturate":
            self._stand(fault, sensor, "saturate", values["gauge"])
        elif fault.kind == "stuck":
            self._get_stuck(fault, sensor)
        elif fault.kind == "status":
            self._stand(fault, sensor, "status_bits", values["bits"])
        elif fault.kind == "emcy":
            drive.emergency(values["code"], values["register"], bytes(5))
        elif fault.kind == "sto":
            self._stand(fault, drive, "sto_dropped", True)
        elif fault.kind == "busoff":
            self._send(BUS_OFF_FRAME, None)
            self._stand(fault, self, "bus_off", True)
        elif fault.kind == "jump":
            drive.angle_offset_counts += values["counts"]
        elif fault.kind == "object":
            drive.state_object(values["index"], values["sub"], values.get("value"))
        elif fault.kind in ("restart", "power_cycle"):
            device = drive if values["device"] == "drive" else sensor
            (device.reset if fault.kind == "restart" else device.power_cycle)()
        elif fault.kind == "lag":
            self._stand(fault, drive, "torque_lag_s", 1e-3 * values["ms"])
        elif fault.kind in _TRAITS:
            self._stand(fault, drive, _TRAITS[fault.kind], True)
        elif fault.kind in DISTURBANCES:
            now_s = self._simulated.plant.elapsed_s + (0.0 if self._lock_step else _READY_IN_S)
            disturbance = disturbance_of(fault, now_s)
            self._simulated.add_disturbance(disturbance, wait=self._lock_step)
            if isinstance(disturbance, Obstacle):
                self._obstacles.append((fault, disturbance))
        elif fault.kind == "end":
            self._end(values.get("fault"))
        else:
            self._cut_lines[values["device"]] = fault
            self._cut(values["device"])
        self._let_hear()

    def _get_stuck(self, fault: Fault, sensor: Any) -> None:  # noqa: ANN401
        """Make encoder, sensor or one gauge repeat its readings."""
        stuck = Stuck(int(fault.values.get("every", 0)))
        what = fault.values["what"]
        if what == "encoder":
            self._stand(fault, self._simulated, "stuck_encoder", stuck)
        elif what == "sensor":
            self._stand(fault, self._simulated.sensor, "stuck", stuck)
        else:
            self._stand(fault, sensor.gauges, "stuck", (int(fault.values["gauge"]), stuck))

    def _stand(self, fault: Fault, device: Any, attribute: str, value: object) -> None:  # noqa: ANN401
        """Let a fault override an attribute of a device until it ends."""
        others = [s for s in self._standing if (s.device, s.attribute) == (device, attribute)]
        normal = others[0].normal if others else getattr(device, attribute)
        standing = _Standing(fault, device, attribute, value, normal)
        self._standing.append(standing)
        setattr(device, attribute, value)
        if "for" in fault.values:
            end_s = self.now_s + float(fault.values["for"])
            self._plan(end_s, partial(self._end_one, standing))

    def _end_one(self, standing: "_Standing") -> None:
        """Reset the attribute to the value of the latest remaining fault, or to normal."""
        if standing not in self._standing:  # it was ended before its time
            return
        self._standing.remove(standing)
        value = standing.normal
        for other in self._standing:
            if (other.device, other.attribute) == (standing.device, standing.attribute):
                value = other.value
        setattr(standing.device, standing.attribute, value)
        self._log("simulator", "fault over", fault=str(standing.fault))

    def _end(self, kind: str | None) -> None:
        """End all faults of a kind, or all there are."""
        for line in self._lines.values():
            for ended in line.end(kind):
                self._log("simulator", "fault over", fault=ended)
        for standing in [s for s in self._standing if kind in (None, s.fault.kind)]:
            self._end_one(standing)
        if kind in (None, "obstacle"):
            obstacles, self._obstacles = self._obstacles, []
            for fault, obstacle in obstacles:
                self._simulated.remove_obstacle(obstacle)
                self._log("simulator", "fault over", fault=str(fault))
        if kind in (None, "cut"):
            cut, self._cut_lines = self._cut_lines, {}
            for device, fault in cut.items():
                self._mend(device)
                self._log("simulator", "fault over", fault=str(fault))

    def _plan(self, when_s: float, action: Callable[[], None]) -> None:
        self._order += 1
        # Half a period of tolerance: the end of an interval must not depend on rounding.
        heapq.heappush(self._planned, (when_s - 0.5 * self._period_s, self._order, action))

    def _postpone(self, delay_s: float, action: Callable[[], None]) -> None:
        self._order += 1
        now_ns = self.periods * self._period_ns if self._lock_step else self._now_ns
        heapq.heappush(self._postponed, (now_ns + delay_s * 1e9, self._order, action))

    def _run_due(self, queue: list[tuple[float, int, Callable[[], None]]], now: float) -> None:
        while queue and queue[0][0] <= now:
            heapq.heappop(queue)[2]()
        self._let_hear()
