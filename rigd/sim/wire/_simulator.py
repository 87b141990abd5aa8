"""``rigd simulate``: process of a simulated rig on a CAN bus and serial line.

One event loop in one thread waits for frames, for bytes of the serial line and for the next period.
The operator's commands arrive on the control socket.
"""

import fcntl
import gc
import json
import math
import os
import select
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigd.devices import describe_unknown_values, fresh_seed, session_seed
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import (
    SimulatorAddress,
    ask_simulator,
    find_simulator,
    parameters_by_dotted_key,
    remove_address_file,
    write_address_file,
)
from rigd.runtime.addresses import runtime_folder
from rigd.sim import SimulatedRig
from rigd.sim.wire._bus_simulation import BusSimulation
from rigd.sim.wire._faults import EventLog, Fault, FaultError, WrongUseError, parse_fault
from rigd.sim.wire._links import (
    HandlersByDescriptor,
    PtyLine,
    VirtualBus,
    VirtualCan,
    is_virtual_can,
    listen,
    without_transport_delay,
)

if TYPE_CHECKING:
    from rigd.sim.wire._object_dictionary import DeviceFile

__all__ = [
    "DeviceError",
    "SimulatorOptions",
    "WrongUseError",
    "check_on_wire",
    "inject",
    "parse_fault",
    "run_simulator",
]

_MAX_SOCKET_NAME_BYTES = 107
"""Longest name of a Unix socket in bytes."""
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end the simulator."""


# One simulation per rig


@contextmanager
def reserve_rig_name(rig_name: str) -> Iterator[None]:
    """Reserve the rig's name within this context, or raise if another simulator uses it."""
    lock_folder = runtime_folder()
    try:
        lock_folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        lock_file = (lock_folder / f"{rig_name}.lock").open("w")
    except OSError as error:
        raise DeviceError(
            f"The simulated rig cannot use the folder {lock_folder} ({error.strerror}); set "
            "XDG_RUNTIME_DIR to one that is yours."
        ) from None
    with lock_file:
        try:
            fcntl.flock(lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            running_simulator = find_simulator(rig_name)
            process_text = (
                "" if running_simulator is None else f" (process {running_simulator.pid})"
            )
            raise DeviceError(
                f"A simulated rig of the profile {rig_name} is already running{process_text}; end "
                "it first, or use that one."
            ) from None
        # Remove the address file of a dead simulator first: it names the sockets to be created.
        remove_address_file(rig_name)
        yield


@contextmanager
def socket_folder(rig_name: str) -> Iterator[Path]:
    """Yield a folder whose path is short enough for sockets in it; temporary if necessary."""
    runtime_path = runtime_folder()
    if len(os.fsencode(runtime_path / f"{rig_name}.control")) <= _MAX_SOCKET_NAME_BYTES:
        yield runtime_path
        return
    with tempfile.TemporaryDirectory(prefix="rigd-", dir="/tmp") as short_folder:
        yield Path(short_folder)


@contextmanager
def stop_requested() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether a signal to end the process has arrived.

    Signals that the process ignores remain ignored.
    """
    received_signals: list[int] = []
    previous_handlers = {
        signal_number: signal.getsignal(signal_number) for signal_number in _STOP_SIGNALS
    }
    caught_signals = [
        signal_number
        for signal_number, signal_handler in previous_handlers.items()
        if signal_handler != signal.SIG_IGN
    ]
    for signal_number in caught_signals:
        signal.signal(
            signal_number, lambda signal_received, _: received_signals.append(signal_received)
        )
    try:
        yield lambda: bool(received_signals)
    finally:
        for signal_number in caught_signals:
            signal.signal(signal_number, previous_handlers[signal_number])


# Control socket

RequestHandler = Callable[[dict[str, Any]], dict[str, Any]]
"""Function that returns the reply to a request."""

_MAX_REQUEST_BYTES = 65_536
"""Longest request in bytes."""


class ControlSocket:
    """Unix socket on which other processes send requests, served by the event loop.

    This class updates `handlers`, the handlers of the event loop by file descriptor.
    `answer_request` returns the reply to a request.
    """

    def __init__(
        self, path: Path, handlers: HandlersByDescriptor, answer_request: RequestHandler
    ) -> None:
        self._handlers = handlers
        self._answer = answer_request
        self._links: dict[socket.socket, bytes] = {}
        self._path = path
        self._listener = listen(path)
        handlers[self._listener.fileno()] = self._accept

    def close(self) -> None:
        """Close the control socket and the connections of all clients."""
        for client_socket in list(self._links):
            self._drop(client_socket)
        del self._handlers[self._listener.fileno()]
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        """Accept the connection of a client, and register it in the event loop."""
        with suppress(OSError):
            client_socket, _ = self._listener.accept()
            client_socket.setblocking(False)
            self._links[client_socket] = b""
            self._handlers[client_socket.fileno()] = lambda: self._receive(client_socket)

    def _receive(self, client_socket: socket.socket) -> None:
        """Receive bytes of a client, and reply to each complete line with a request."""
        try:
            received_bytes = client_socket.recv(_MAX_REQUEST_BYTES)
        except BlockingIOError:
            return
        except OSError:
            received_bytes = b""
        *complete_lines, incomplete_line = (self._links[client_socket] + received_bytes).split(
            b"\n"
        )
        if not received_bytes or len(incomplete_line) > _MAX_REQUEST_BYTES:
            self._drop(client_socket)
            return
        self._links[client_socket] = incomplete_line
        for request_line in complete_lines:
            with suppress(OSError):  # a client that does not read gets no reply
                client_socket.send(json.dumps(self._reply(request_line)).encode() + b"\n")

    def _reply(self, request_line: bytes) -> dict[str, Any]:
        """Return the reply to one line with a JSON request."""
        try:
            parsed_request = json.loads(request_line)
        except ValueError:
            parsed_request = None
        if not isinstance(parsed_request, dict):
            return {"error": "A request is one line with one JSON object."}
        return self._answer(parsed_request)

    def _drop(self, client_socket: socket.socket) -> None:
        """Close the connection of a client."""
        del self._links[client_socket]
        del self._handlers[client_socket.fileno()]
        client_socket.close()


# The process

_MAX_EVENT_WAIT_S = 0.01
"""Longest time in seconds that the event loop waits while nothing is due."""


@dataclass(frozen=True, slots=True)
class SimulatorOptions:
    """Options of a simulated rig."""

    lock_step: bool = False
    """Whether each SYNC advances the rig by one period, instead of wall time."""
    log: Path | None = None
    """Path of a new file of JSON lines, one per event; None: no file."""
    faults: tuple[Fault, ...] = ()
    """Faults to inject at the start."""
    quiet: bool = False
    """Whether nothing is shown on the terminal."""
    eds: Path | None = None
    """Path of the EDS file of the drive to simulate; None: the profile's, if any."""


def check_on_wire(rig: RigParameters) -> None:
    """Raise if a rig has no drive on a CAN bus that could be simulated.

    Raises
    ------
    WrongUseError
        If the rig has no drive on a bus.
    """
    if rig.cia402 is None or rig.can is None:
        raise WrongUseError(
            f"The profile {rig.name} has no drive on a bus (sections [can] and [cia402]): its "
            "devices are simulated within a session, so there are no bus messages and no faults to "
            "inject. Use a profile of a rig with a bus, such as antenna_can."
        )


def run_simulator(rig: RigParameters, options: SimulatorOptions) -> int:
    """Run the simulated rig that replaces a profile's hardware, until a signal ends it.

    Parameters
    ----------
    rig
        Parameters of the rig.
    options
        Options of the simulation and of its output.

    Returns
    -------
    int
        Exit code of the process.

    Raises
    ------
    WrongUseError
        If the profile cannot be simulated on a bus or has unknown values, a fault is not possible
        on this rig, or the log file exists.
    DeviceError
        If another process already simulates this rig, or sockets or files cannot be created.
    """
    check_on_wire(rig)
    if unknown_text := describe_unknown_values(rig):
        raise WrongUseError(unknown_text)
    if rig.devices.sensor != "ati_serial":
        rig = replace(rig, ati_serial=None)  # a profile may describe a sensor that it does not use
    with ExitStack() as exit_stack:
        exit_stack.enter_context(reserve_rig_name(rig.name))
        log = EventLog(options.log, quiet=options.quiet)
        exit_stack.callback(log.close)
        startup_stack = exit_stack.enter_context(ExitStack())
        startup_stack.callback(log.discard)
        simulator_process = _SimulatorProcess(rig, options, log, exit_stack)
        is_stop_requested = exit_stack.enter_context(stop_requested())
        simulator_process.start()
        startup_stack.pop_all()
        simulator_process.serve(is_stop_requested)
    return 0


def inject(rig_name: str, fault_specs: list[str]) -> list[str]:
    """Inject faults into the running simulated rig of a profile.

    Parameters
    ----------
    rig_name
        Name of the profile.
    fault_specs
        Faults in the syntax of `parse_fault`; an empty list requests the status.

    Returns
    -------
    list of str
        One line per fault, with the command that ends it if it is persistent; without faults, the
        lines of the simulator's status.

    Raises
    ------
    DeviceError
        If no simulated rig of the profile runs, or it refuses a fault.
    WrongUseError
        If a fault has a syntax error; then no fault is injected.
    """
    simulator_address = find_simulator(rig_name)
    if simulator_address is None:
        raise DeviceError(
            f"No simulated rig of the profile {rig_name} runs; start it with: rigd simulate "
            f"--profile {rig_name}"
        )
    faults = [
        parse_fault(spec) for spec in fault_specs
    ]  # all of them, before the first one happens
    if not fault_specs:
        return [
            f"{value_name}: {injected_value}"
            for value_name, injected_value in ask_simulator(
                simulator_address, {"status": True}
            ).items()
        ]
    report_lines = []
    for fault, spec in zip(faults, fault_specs, strict=True):
        injected_fault = str(ask_simulator(simulator_address, {"inject": spec})["injected"])
        end_command = f"rigd inject --profile {rig_name} end,fault={fault.kind}"
        report_lines.append(
            f"{injected_fault}; it lasts until: {end_command}"
            if fault.is_persistent
            else injected_fault
        )
    return report_lines


class _SimulatorProcess:
    """Process of a simulated rig: its connections, and the event loop that serves them."""

    def __init__(
        self, rig: RigParameters, options: SimulatorOptions, log: EventLog, exit_stack: ExitStack
    ) -> None:
        assert rig.can is not None
        self._rig = rig
        self._options = options
        self._log = log
        self._exit_stack = exit_stack
        self._handlers: HandlersByDescriptor = {}
        self._device_file: DeviceFile | None = None
        assert rig.cia402 is not None
        eds_path = options.eds or (Path(rig.cia402.eds) if rig.cia402.eds else None)
        if eds_path is not None:
            from rigd.sim.wire._object_dictionary import read_device

            self._device_file = read_device(eds_path, rig.cia402.node_id)
        socket_folder_path = exit_stack.enter_context(socket_folder(rig.name))
        self._bus: VirtualBus | VirtualCan
        can_socket_path = ""
        if rig.can.interface == "socketcan" and is_virtual_can(rig.can.channel):
            self._bus = VirtualCan(rig.can.channel, self._handlers, self._on_frames)
        else:
            can_socket_path = str(socket_folder_path / f"{rig.name}.can")
            self._bus = VirtualBus(
                Path(can_socket_path), self._handlers, self._on_frames, self._on_clients
            )
        exit_stack.callback(self._bus.close)
        self._serial_line: PtyLine | None = None
        if rig.ati_serial is not None:
            self._serial_line = PtyLine(self._handlers, self._on_bytes, self._on_port)
            exit_stack.callback(self._serial_line.close)
        stated_seed = None if rig.simulation is None else rig.simulation.seed
        self._seed = fresh_seed() if stated_seed is None else stated_seed
        self._sessions = 0
        self._bus_simulation = self._make_bus_simulation()
        control_socket = ControlSocket(
            socket_folder_path / f"{rig.name}.control", self._handlers, self._answer
        )
        exit_stack.callback(control_socket.close)
        self._address = SimulatorAddress(
            pid=os.getpid(),
            control_socket=str(socket_folder_path / f"{rig.name}.control"),
            can_socket=can_socket_path,
            serial_port=self._serial_port,
            lock_step=options.lock_step,
            rig=parameters_by_dotted_key(rig),
        )

    def start(self) -> None:
        """Inject the initial faults, print the rig's addresses, and write the address file."""
        for initial_fault in self._options.faults:
            self._bus_simulation.inject(initial_fault)
        start_log_values = {} if self._options.lock_step else {"monotonic_ns": time.monotonic_ns()}
        self._log(
            "simulator",
            "started",
            rig=self._rig.name,
            lock_step=self._options.lock_step,
            **({} if self._device_file is None else {"eds": self._device_file.name}),
            **start_log_values,
        )
        for start_line in self._start_messages():
            self._log.print_line(start_line)
        write_address_file(self._rig.name, self._address)
        self._exit_stack.callback(remove_address_file, self._rig.name)
        # Set-up leaves objects that are never freed: exclude them from garbage collection.
        gc.collect()
        gc.freeze()
        gc.disable()
        self._exit_stack.callback(gc.enable)
        if not self._options.lock_step:
            # Real-time priority for replies in time while other processes work, below every
            # real-time loop. Of 2500 replies on two busy cores, 7 were late with it, 95 without.
            with suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))

    def serve(self, is_stop_requested: Callable[[], bool]) -> None:
        """Run the simulator's event loop until a stop is requested."""
        event_handlers, bus_simulation, serial_line, log = (
            self._handlers,
            self._bus_simulation,
            self._serial_line,
            self._log,
        )
        monotonic_ns = time.monotonic_ns
        next_poll_ns = 0
        while not is_stop_requested():
            ready_descriptors, _, _ = select.select(
                event_handlers, (), (), bus_simulation.wait_s(monotonic_ns(), _MAX_EVENT_WAIT_S)
            )
            for descriptor in ready_descriptors:
                event_handler = event_handlers.get(descriptor)
                if event_handler is not None:  # not closed by one of the others
                    event_handler()
            now_ns = monotonic_ns()
            bus_simulation.elapse(now_ns)
            if now_ns > next_poll_ns:
                next_poll_ns = now_ns + round(_MAX_EVENT_WAIT_S * 1e9)
                log.flush()
                if serial_line is not None:
                    serial_line.poll()
        self._log("simulator", "ended")

    def _make_bus_simulation(self) -> BusSimulation:
        """Create the bus simulation with its drive and sensor."""
        # Imported late: a process that only injects a fault does not need it.
        from rigd.sim.wire._drive_node import DriveNode

        rig = self._rig
        simulated_rig = self._simulated_rig = SimulatedRig(without_transport_delay(rig))
        serial_line = self._serial_line
        bus_simulation = BusSimulation(
            rig,
            simulated_rig,
            lock_step=self._options.lock_step,
            now_ns=time.monotonic_ns(),
            send_frame=self._bus.send,
            write_bytes=_discard_output if serial_line is None else serial_line.write,
            interrupt_line=self._interrupt,
            reconnect_line=self._reconnect,
            log=self._log,
        )
        assert rig.cia402 is not None
        drive_node = DriveNode(
            rig,
            simulated_rig,
            bus_simulation.step,
            bus_simulation.can_sender("drive"),
            self._log,
            sync_timeout_s=self._sync_timeout_s(),
            device_file=self._device_file,
        )
        bus_simulation.add_node("drive", drive_node)
        if rig.ati_serial is not None:
            from rigd.sim.wire._ati_serial_device import AtiSerialDevice

            bus_simulation.add_serial_device(
                AtiSerialDevice(rig, simulated_rig, bus_simulation.serial_writer(), self._log)
            )
        elif rig.ati_can is not None:
            from rigd.sim.wire._ati_can_node import AtiCanNode

            bus_simulation.add_node(
                "sensor",
                AtiCanNode(rig, simulated_rig, bus_simulation.can_sender("sensor"), self._log),
            )
        return bus_simulation

    def _sync_timeout_s(self) -> float:
        """Return the time in seconds without SYNC after which the drive goes to fault."""
        drive_settings = self._rig.cia402
        assert drive_settings is not None
        if drive_settings.own_watchdog_s:
            return drive_settings.own_watchdog_s
        if self._device_file is not None and (0x1006, 0) not in self._device_file.entries:
            return math.inf  # no period is configured
        # The tolerance of other drives is not known: use the heartbeat timeout.
        return drive_settings.heartbeat_timeout_s

    def _start_messages(self) -> Iterator[str]:
        """Yield the lines for the operator at the start: addresses, and commands to try."""
        simulator_address, rig = self._address, self._rig
        assert rig.can is not None
        clock_text = (
            "one period per SYNC (lock-step)" if simulator_address.lock_step else "by wall time"
        )
        yield f"Simulated rig {rig.name}, {rig.rate_hz:g} Hz, {clock_text}; Ctrl-C ends it."
        yield f"  CAN      {simulator_address.can_socket or f'{rig.can.channel} (virtual)'}"
        if simulator_address.serial_port:
            yield f"  serial   {simulator_address.serial_port}"
        if self._device_file is not None:
            object_count = len({object_index for object_index, _ in self._device_file.entries})
            yield f"  drive    as {self._device_file.name} has it, {object_count} objects"
        fast_option = " --fast" if simulator_address.lock_step else ""
        yield f"  session  rigd run chirp --profile {rig.name}{fast_option}"
        yield f"  fault    rigd inject --profile {rig.name} freeze,device=drive,for=0.5"

    def _on_frames(self, frames: list[bytes], sending_host: object) -> None:
        """Pass frames of a host to the simulation."""
        self._bus_simulation.receive_frames(frames, sending_host, time.monotonic_ns())

    def _on_bytes(self, data: bytes) -> None:
        """Pass bytes of the serial host to the simulation."""
        self._bus_simulation.receive_serial(data)

    def _on_clients(self, event_text: str, client_count: int) -> None:
        """Log that a client of the CAN bus has connected or disconnected."""
        self._log("bus", event_text, clients=client_count)
        if client_count == 0:
            self._bus_simulation.stop_waiting(time.monotonic_ns())

    def _on_port(self, is_open: bool) -> None:
        """Log that the serial port was opened or closed."""
        self._log("line", "port opened" if is_open else "port closed")

    def _interrupt(self, device: str) -> None:
        """Interrupt the simulated CAN bus or serial line."""
        if device == "bus":
            self._bus.close()
        elif self._serial_line is not None:
            self._serial_line.close()

    def _reconnect(self, device: str) -> None:
        """Reconnect the simulated CAN bus or serial line."""
        if device == "bus":
            self._bus.open()
        elif self._serial_line is not None:
            self._serial_line.open()
            # The line may have a new name, which the next process has to find.
            self._address = replace(self._address, serial_port=self._serial_port)
            write_address_file(self._rig.name, self._address)

    @property
    def _serial_port(self) -> str:
        """Name of the serial port for the host; empty if there is none."""
        return "" if self._serial_line is None else self._serial_line.port

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the reply to a request on the control socket.

        A request injects a fault, reads the simulator's status, or renews the noise.
        """
        if "inject" in request:
            try:
                injected_fault = parse_fault(str(request["inject"]))
                self._bus_simulation.inject(injected_fault)
            except (FaultError, DeviceError) as error:
                return {"error": str(error)}
            return {"injected": str(injected_fault)}
        if "renew_noise" in request:
            new_seed = request["renew_noise"]
            if new_seed is not None and not (type(new_seed) is int and new_seed >= 0):
                return {"error": "The seed has to be a whole number from 0 on, or null."}
            return {"seed": self._renew_noise(new_seed)}
        if "status" in request:
            return {
                "rig": self._rig.name,
                "drive": "default" if self._device_file is None else self._device_file.name,
                "time_s": round(self._bus_simulation.now_s, 6),
                "lock_step": self._options.lock_step,
                "moved_periods": self._bus_simulation.rig_periods,
                "syncs": self._bus_simulation.syncs,
                "clients": self._bus.client_count,
                "lost_frames": self._bus.lost_frame_count,
                "lost_bytes": 0 if self._serial_line is None else self._serial_line.lost_byte_count,
                "disturbed": self._bus_simulation.disturbed_senders,
            }
        return {"error": "A request has to be 'inject', 'status' or 'renew_noise'."}

    def _renew_noise(self, seed: int | None) -> int:
        """Restart the noise with a seed (None: the next of the series), and return the seed."""
        if seed is None:
            self._sessions += 1
            seed = session_seed(self._seed, self._sessions)
        self._simulated_rig.begin_session(seed)
        return seed


def _discard_output(data: bytes) -> None:
    """Discard output, for a rig without a serial line."""
