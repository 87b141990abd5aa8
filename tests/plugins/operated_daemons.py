"""The daemon's service on a rig whose processes are threads: everything else is the real thing.

Tests of the daemon take its requests and refusals from here: `parse_request`, `RequestError`,
`CommandError`, `Peer`, and its states.
"""

import asyncio
import contextlib
import json
import queue
import threading
from concurrent.futures import ThreadPoolExecutor

from rich.console import Console

from rigd.cli.status_view import status_table
from rigd.daemon._protocol import CommandError, RequestError, StartRequest, parse_request
from rigd.daemon._service import Service
from rigd.daemon._states import DaemonState, DaemonStateMachine, IllegalTransitionError, Peer
from rigd.devices import ActuationTarget, open_devices
from rigd.devices.contracts import DeviceError, Devices
from rigd.engine import control_process as control
from rigd.engine import recorder
from rigd.engine.processes import ChildError
from rigd.engine.workers import CONTROL
from rigd.runner import ProcessGroup, Rig
from rigd.runner import _rig as rig_module
from rigd.runtime import StopRequest
from rigd.session import SessionError, SessionWriter

__all__ = [
    "CommandError", "DaemonState", "DaemonStateMachine", "IllegalTransitionError", "Operated",
    "Peer", "RequestError", "StartRequest", "parse_request",
]  # fmt: skip

_ENDED = object()


class Died(BaseException):
    """The process is gone: what it would have done next it does not do."""


class WatchedDrive:
    """The simulated drive, with a log of what must not be, and something that happens on demand.

    `then` is called in the control thread, before the `countdown`-th call from now.
    """

    def __init__(self, inner, world):
        self.inner = inner
        self.world = world
        self.enabled = False
        self.torque_nm = 0.0
        self.offset_rad = 0.0
        self.dead = False
        self.off_doubt = ""

    def __getattr__(self, name):
        return getattr(self.inner, name)

    @property
    def safe(self):
        return not self.enabled and self.torque_nm == 0.0

    def happen(self):
        if self.dead:
            raise Died
        self.world.happen(self)

    def connect(self):
        self.happen()
        if self.world.absent:
            raise DeviceError("The drive does not answer.")
        self.inner.connect()

    def enable(self, stop=None):
        self.happen()
        self.world.witness("enabled")
        self.inner.enable()
        self.enabled = True

    def latch(self, due_ns):
        self.happen()
        self.inner.latch(due_ns)

    def read_angle(self):
        return self.inner.read_angle() + self.offset_rad

    def command(self, torque_nm):
        if torque_nm != 0.0:
            self.world.witness("commanded")
            if not self.enabled:
                self.world.wrong.append("a torque without an enabled drive")
        self.torque_nm = self.inner.command(torque_nm)
        self.world.highest_nm = max(self.world.highest_nm, abs(self.torque_nm))
        return self.torque_nm

    def health(self):
        return self.inner.health()

    def disable(self):
        if not self.dead:
            self.switch_off()

    def switch_off(self):
        self.inner.disable()
        self.enabled, self.torque_nm = False, 0.0

    def close(self):
        self.disable()


class World:
    """What the drives of one service did, and what is to happen to them."""

    def __init__(self):
        self.drives = []
        self.wrong = []
        self.countdown = 0
        self.then = None
        self.absent = False
        self.simulated = True
        self.highest_nm = 0.0
        self.service = None

    def witness(self, what):
        state = self.service.state
        if state not in ("running", "stopping"):
            self.wrong.append(f"{what} while {state}")

    def happen(self, drive):
        if self.then is None:
            return
        self.countdown -= 1
        if self.countdown <= 0:
            then, self.then = self.then, None
            then(drive)

    def open_devices(self, rig):
        devices = open_devices(rig)
        self.drives.append(WatchedDrive(devices.drive, self))
        return Devices(self.drives[-1], devices.sensor, simulated=self.simulated)


class ThreadParent:
    """The supervisor, as a process that is a thread sees it."""

    def __init__(self, child):
        self.child = child

    def receive_job(self):
        return self.poll(None)

    def poll(self, timeout_s):
        if self.child.killed:
            raise Died
        try:
            message = self.child.inbox.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if self.child.killed:
            raise Died
        if message is _ENDED:
            raise EOFError
        return message

    def send(self, message):
        self.child.outbox.put(message)

    def alive(self):
        if self.child.killed:
            raise Died
        return True


_current = threading.local()


class ThreadChild:
    """A process of a rig that is a thread; it can be killed all the same."""

    pid = 4711

    def __init__(self, name, main, world):
        self.name = name
        self.main = main
        self.world = world
        self.inbox, self.outbox = queue.Queue(), queue.Queue()
        self.killed = False
        self.thread = threading.Thread(target=self.work, daemon=True)

    def work(self):
        _current.parent, _current.writer = ThreadParent(self), None
        try:
            self.main()
        except (Died, SystemExit, EOFError):
            pass
        finally:
            if self.killed and self.name == "control":
                self.world.drives[-1].switch_off()  # its own watchdog
            if self.killed and self.name == "recorder" and _current.writer is not None:
                with contextlib.suppress(SessionError):
                    _current.writer.abandon()  # a process's files are closed with it
            self.outbox.put(_ENDED)

    def start(self, job):
        self.thread.start()
        self.send(job)

    def send(self, message):
        self.inbox.put(message)

    @property
    def running(self):
        return not self.killed

    def poll(self, timeout_s):
        try:
            message = self.outbox.get(timeout=max(timeout_s, 1e-6))
        except queue.Empty:
            return None
        if message is _ENDED:
            self.outbox.put(_ENDED)
            raise ChildError(f"The {self.name} process was killed by signal 9.")
        return message

    def resume(self):
        pass

    def kill(self):
        self.killed = True
        if self.name == "control" and self.world.drives:
            self.world.drives[-1].dead = True
        self.inbox.put(_ENDED)
        if self.thread.ident is not None and self.thread is not threading.current_thread():
            self.thread.join(30.0)

    def stop(self):
        if self.thread.ident is not None:
            self.inbox.put(_ENDED)
            self.thread.join(30.0)
            assert not self.thread.is_alive()


def open_writer(path):
    _current.writer = SessionWriter(path)
    return _current.writer


def open_watched(rig, moving):
    return ThreadGroup.world.open_devices(rig)


class ThreadGroup(ProcessGroup):
    """Control and recorder as threads of this process."""

    world = None

    def _start(self, process):
        main = control.main if process is CONTROL else recorder.main
        self._children[process] = ThreadChild(process.name, main, self.world)
        self._processes_with_job.discard(process)


class QuietStop(StopRequest):
    def catch_signals(self):
        pass


class Operated:
    """A service in an event loop, operated step by step."""

    def __init__(self, profile, folder, *, live=False):
        self.world = World()
        ThreadGroup.world = self.world
        self.loop = asyncio.new_event_loop()
        self.worker = ThreadPoolExecutor(1)
        self.events = []
        self.rig = Rig(profile, uses_virtual_clock=True)
        self.moving = ActuationTarget.SIMULATED
        self.service = self.world.service = Service(
            self.rig,
            profile,
            folder,
            self.worker,
            self.events.append,
            lambda: self.moving,
            uses_virtual_clock=True,
        )
        self.peer = Peer(1, 100, 0)

    @property
    def state(self):
        return self.service.state

    def request(self, command, *, peer=None, **fields):
        """Execute a request to its end; return the reply or the refusal."""
        return self.loop.run_until_complete(self.handle(command, peer=peer, **fields))

    async def handle(self, command, *, peer=None, **fields):
        line = json.dumps({"command": command, **fields}).encode()
        request = parse_request(line)
        try:
            reply = await self.service.execute(request, peer or self.peer)
        except CommandError as error:
            return error
        while self.state in ("running", "stopping") and command == "start":
            await asyncio.sleep(0.002)
        return reply

    def meanwhile(self, command, **fields):
        """Make a request from another thread, while a session runs."""
        line = json.dumps({"command": command, **fields}).encode()
        handled = self.service.execute(parse_request(line), self.peer)
        try:
            return asyncio.run_coroutine_threadsafe(handled, self.loop).result(30.0)
        except CommandError as error:
            return error

    def open(self):
        self.loop.run_until_complete(self.service.open())
        return self

    def watch(self):
        self.loop.run_until_complete(self.service.check_connection())

    def close(self):
        self.loop.run_until_complete(self.service.close("the test is over"))
        self.worker.shutdown()
        self.loop.close()

    @property
    def last(self):
        """The end of the last series."""
        return [event for event in self.events if event["event"] == "series"][-1]


def printed_status(status):
    """Return what `rigd status` prints."""
    console = Console(width=300)
    with console.capture() as captured:
        console.print(status_table(status))
    return captured.get()


def shown_status(status):
    """Return what `rigd status` shows, by the names of the rows at its head."""
    head = printed_status(status).partition("\n\n")[0]
    return {name: text for name, _, text in (line.partition(" ") for line in head.splitlines())}


def run_processes_as_threads(monkeypatch):
    """Have the processes of every rig be threads of this one, with a drive that is watched."""
    for module in (control, recorder):
        monkeypatch.setattr(module, "SupervisorConnection", lambda: _current.parent)
    monkeypatch.setattr(recorder, "ignore_signals", lambda: None)
    monkeypatch.setattr(recorder, "SessionWriter", open_writer)
    monkeypatch.setattr(control, "StopRequest", QuietStop)
    monkeypatch.setattr(control, "disable_garbage_collection", lambda: "off")
    monkeypatch.setattr(control, "open_devices", open_watched)
    monkeypatch.setattr(rig_module, "ProcessGroup", ThreadGroup)
