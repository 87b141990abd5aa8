"""``rigd simulate``: a simulated rig as a process of its own, on the wire.

One thread, one loop: it waits for frames, for bytes of the serial line, and for the time to pass.
The operator's commands come over the control socket.
"""

import gc
import math
import os
import select
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters
from rigd.devices.simulator import SimulatorAddress, announce, described, find_simulator, forget
from rigd.sim.devices import SimulatedRig
from rigd.sim.wire.control import ControlSocket, ask
from rigd.sim.wire.errors import WrongUseError
from rigd.sim.wire.faults import Fault, FaultError, parse_fault
from rigd.sim.wire.hub import Handlers, Hub, VirtualCan, is_virtual
from rigd.sim.wire.log import EventLog
from rigd.sim.wire.lone_process import only_one, socket_folder, stop_requested
from rigd.sim.wire.pty_line import PtyLine
from rigd.sim.wire.transport import without_transport
from rigd.sim.wire.world import World

if TYPE_CHECKING:
    from rigd.sim.wire.canopen_eds import DeviceFile

__all__ = [
    "DeviceError",
    "SimulatorOptions",
    "WrongUseError",
    "check_on_wire",
    "inject",
    "parse_fault",
    "run_simulator",
]

_IDLE_S = 0.01
"""How often the loop looks up while nothing hurries."""


@dataclass(frozen=True, slots=True)
class SimulatorOptions:
    """How a simulated rig is run."""

    lock_step: bool = False
    """Move on by one period a SYNC instead of by wall time."""
    log: Path | None = None
    """File of JSON lines, one an event; a new one."""
    faults: tuple[Fault, ...] = ()
    quiet: bool = False
    """Tell nothing on the terminal."""
    eds: Path | None = None
    """The manufacturer's file of the drive that is simulated; by default the profile's, if any."""


def check_on_wire(rig: RigParameters) -> None:
    """Refuse a rig of which there is nothing to put on the wire.

    Raises
    ------
    WrongUseError
        If it has no drive on a bus.
    """
    if rig.cia402 is None or rig.can is None:
        raise WrongUseError(
            f"The profile {rig.name} has no drive on a bus (sections [can] and [cia402]): its "
            "devices are simulated within a session, so there is nothing to put on the wire and "
            "no fault to inject there. Take a profile of a rig with a bus, such as antenna_can."
        )


def run_simulator(rig: RigParameters, options: SimulatorOptions) -> int:
    """Run the simulated rig that stands in for a profile's, until a signal ends it.

    Returns
    -------
    int
        Exit code.

    Raises
    ------
    WrongUseError
        If the profile cannot be simulated on the wire, a fault is none that this rig can have, or
        the log's name is taken.
    DeviceError
        If its simulated rig runs already, or if sockets or files cannot be made.
    """
    check_on_wire(rig)
    if rig.devices.sensor != "ati_serial":
        rig = replace(rig, ati_serial=None)  # a profile may describe more than it uses
    with ExitStack() as stack:
        stack.enter_context(only_one(rig.name))
        log = EventLog(options.log, quiet=options.quiet)
        stack.callback(log.close)
        starting = stack.enter_context(ExitStack())
        starting.callback(log.discard)
        process = _Process(rig, options, log, stack)
        stop = stack.enter_context(stop_requested())
        process.start()
        starting.pop_all()
        process.serve(stop)
    return 0


def inject(rig_name: str, specs: list[str]) -> list[str]:
    """Inject faults into the running simulated rig of a profile.

    Returns
    -------
    list of str
        The faults as it understood them; without any, lines on how it stands.

    Raises
    ------
    DeviceError
        If no simulated rig of that name runs, or it refuses.
    WrongUseError
        If a fault is not written as it should be; then none is injected.
    """
    address = find_simulator(rig_name)
    if address is None:
        raise DeviceError(
            f"No simulated rig of the profile {rig_name} runs; start it with: rigd simulate "
            f"--profile {rig_name}"
        )
    for spec in specs:
        parse_fault(spec)  # all of them, before the first one happens
    if not specs:
        return [f"{name}: {value}" for name, value in ask(address, {"status": True}).items()]
    return [str(ask(address, {"inject": spec})["injected"]) for spec in specs]


class _Process:
    """The lines to the outside, and the loop that serves them."""

    def __init__(
        self, rig: RigParameters, options: SimulatorOptions, log: EventLog, stack: ExitStack
    ) -> None:
        assert rig.can is not None
        self._rig = rig
        self._options = options
        self._log = log
        self._stack = stack
        self._handlers: Handlers = {}
        self._file: DeviceFile | None = None
        assert rig.cia402 is not None
        eds = options.eds or (Path(rig.cia402.eds) if rig.cia402.eds else None)
        if eds is not None:
            from rigd.sim.wire.canopen_eds import read_device

            self._file = read_device(eds, rig.cia402.node_id)
        folder = stack.enter_context(socket_folder(rig.name))
        self._bus: Hub | VirtualCan
        can_socket = ""
        if rig.can.interface == "socketcan" and is_virtual(rig.can.channel):
            self._bus = VirtualCan(rig.can.channel, self._handlers, self._on_frames)
        else:
            can_socket = str(folder / f"{rig.name}.can")
            self._bus = Hub(Path(can_socket), self._handlers, self._on_frames, self._on_clients)
        stack.callback(self._bus.close)
        self._line: PtyLine | None = None
        if rig.ati_serial is not None:
            self._line = PtyLine(self._handlers, self._on_bytes, self._on_port)
            stack.callback(self._line.close)
        self._world = self._make_world()
        control = ControlSocket(folder / f"{rig.name}.control", self._handlers, self._answer)
        stack.callback(control.close)
        self._address = SimulatorAddress(
            pid=os.getpid(),
            control_socket=str(folder / f"{rig.name}.control"),
            can_socket=can_socket,
            serial_port=self._port,
            lock_step=options.lock_step,
            rig=described(rig),
        )

    def start(self) -> None:
        """Let the faults in that are there from the start, and say where the rig is."""
        for fault in self._options.faults:
            self._world.inject(fault)
        started = {} if self._options.lock_step else {"monotonic_ns": time.monotonic_ns()}
        self._log(
            "simulator",
            "started",
            rig=self._rig.name,
            lock_step=self._options.lock_step,
            **({} if self._file is None else {"eds": self._file.name}),
            **started,
        )
        for line in self._invitation():
            self._log.tell(line)
        announce(self._rig.name, self._address)
        self._stack.callback(forget, self._rig.name)
        # Set-up leaves objects that never go: no need to look through them again and again.
        gc.collect()
        gc.freeze()
        gc.disable()
        self._stack.callback(gc.enable)
        if not self._options.lock_step:
            # Replies in time while other processes work too; below every real-time loop. Of 2500
            # replies on two busy cores 7 were late with it and 95 without.
            with suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))

    def serve(self, stop: Callable[[], bool]) -> None:
        """Serve until a stop is asked for."""
        handlers, world, line, log = self._handlers, self._world, self._line, self._log
        now_ns = time.monotonic_ns
        look_ns = 0
        while not stop():
            ready, _, _ = select.select(handlers, (), (), world.wait_s(now_ns(), _IDLE_S))
            for descriptor in ready:
                handler = handlers.get(descriptor)
                if handler is not None:  # not closed by one of the others
                    handler()
            now = now_ns()
            world.elapse(now)
            if now > look_ns:
                look_ns = now + round(_IDLE_S * 1e9)
                log.flush()
                if line is not None:
                    line.look()
        self._log("simulator", "ended")

    def _make_world(self) -> World:
        # Late: a process that only injects a fault needs none of it.
        from rigd.sim.wire.drive_node import DriveNode

        rig = self._rig
        simulated = SimulatedRig(without_transport(rig))
        line = self._line
        world = World(
            rig,
            simulated,
            lock_step=self._options.lock_step,
            now_ns=time.monotonic_ns(),
            send=self._bus.send,
            write=_nowhere if line is None else line.write,
            cut=self._cut,
            mend=self._mend,
            log=self._log,
        )
        assert rig.cia402 is not None
        drive = DriveNode(
            rig,
            simulated,
            world.step,
            world.can_port("drive"),
            self._log,
            sync_timeout_s=self._sync_timeout_s(),
            file=self._file,
        )
        world.join("drive", drive)
        if rig.ati_serial is not None:
            from rigd.sim.wire.ati_serial_device import AtiSerialDevice

            world.join_serial(AtiSerialDevice(rig, simulated, world.serial_port(), self._log))
        elif rig.ati_can is not None:
            from rigd.sim.wire.ati_can_node import AtiCanNode

            world.join("sensor", AtiCanNode(rig, simulated, world.can_port("sensor"), self._log))
        return world

    def _sync_timeout_s(self) -> float:
        """How long the drive bears that no SYNC comes."""
        drive = self._rig.cia402
        assert drive is not None
        if drive.own_watchdog_s:
            return drive.own_watchdog_s
        if self._file is not None and (0x1006, 0) not in self._file.entries:
            return math.inf  # it is not told when to expect one
        # How long others bear it is not known: as long as its heartbeat may stay away.
        return drive.heartbeat_timeout_s

    def _invitation(self) -> Iterator[str]:
        address, rig = self._address, self._rig
        assert rig.can is not None
        mode = "one period a SYNC (lock-step)" if address.lock_step else "by wall time"
        yield f"Simulated rig {rig.name}, {rig.rate_hz:g} Hz, {mode}; Ctrl-C ends it."
        yield f"  CAN      {address.can_socket or f'{rig.can.channel} (virtual)'}"
        if address.serial_port:
            yield f"  serial   {address.serial_port}"
        if self._file is not None:
            objects = len({index for index, _ in self._file.entries})
            yield f"  drive    as {self._file.name} has it, {objects} objects"
        fast = " --fast" if address.lock_step else ""
        yield f"  session  rigd run chirp --profile {rig.name}{fast}"
        yield f"  fault    rigd inject --profile {rig.name} freeze,device=drive,for=0.5"

    def _on_frames(self, frames: list[bytes], origin: object) -> None:
        self._world.hear(frames, origin, time.monotonic_ns())

    def _on_bytes(self, data: bytes) -> None:
        self._world.hear_serial(data)

    def _on_clients(self, what: str, count: int) -> None:
        self._log("bus", what, clients=count)
        if count == 0:
            self._world.left_alone(time.monotonic_ns())

    def _on_port(self, is_open: bool) -> None:
        self._log("line", "port opened" if is_open else "port closed")

    def _cut(self, device: str) -> None:
        if device == "bus":
            self._bus.close()
        elif self._line is not None:
            self._line.close()

    def _mend(self, device: str) -> None:
        if device == "bus":
            self._bus.open()
        elif self._line is not None:
            self._line.open()
            # The line may be another one now: whoever comes has to find it.
            self._address = replace(self._address, serial_port=self._port)
            announce(self._rig.name, self._address)

    @property
    def _port(self) -> str:
        return "" if self._line is None else self._line.port

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        if "inject" in request:
            try:
                fault = parse_fault(str(request["inject"]))
                self._world.inject(fault)
            except (FaultError, DeviceError) as error:
                return {"error": str(error)}
            return {"injected": str(fault)}
        if "status" in request:
            return {
                "rig": self._rig.name,
                "drive": "default" if self._file is None else self._file.name,
                "time_s": round(self._world.now_s, 6),
                "lock_step": self._options.lock_step,
                "moved_periods": self._world.moved,
                "syncs": self._world.syncs,
                "clients": self._bus.clients,
                "lost_frames": self._bus.lost,
                "lost_bytes": 0 if self._line is None else self._line.lost,
                "disturbed": self._world.disturbed,
            }
        return {"error": "A request has to be 'inject' or 'status'."}


def _nowhere(data: bytes) -> None:
    """Take what a rig without a serial line never writes."""
