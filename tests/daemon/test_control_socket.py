"""The daemon's socket: access rights, and clients that misbehave."""

import asyncio
import base64
import contextlib
import grp
import json
import os
import resource
import socket
import stat
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rigd.daemon import _server as server
from rigd.daemon import address, background
from rigd.daemon.address import (
    AddressError,
    UnknownGroupError,
    find_daemon_socket,
    running_daemon_sockets,
    socket_path,
)
from rigd.runner import signal_blocks
from rigd.runtime.addresses import socket_answers

LONG = {
    "command": "start",
    "excitation": "hold",
    "parameters": {"duration_s": 2.0, "rest_s": 0.0, "ring_down_s": 0.0},
    "repeat": 1000,
}


class Link:
    """A client within the event loop."""

    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer

    async def send(self, document):
        line = document if isinstance(document, bytes) else json.dumps(document).encode() + b"\n"
        self.writer.write(line)
        await self.writer.drain()

    async def next(self):
        """Return the next message, or None at the end."""
        line = await asyncio.wait_for(self.reader.readline(), 60.0)
        return json.loads(line) if line else None

    async def request(self, document):
        await self.send(document)
        while "reply" not in (message := await self.next()):
            pass
        return message

    async def close(self):
        self.writer.close()
        with contextlib.suppress(OSError):
            await self.writer.wait_closed()


class Served:
    """A service behind its socket."""

    def __init__(self, operated, path):
        self.operated = operated
        self.path = path
        self.server = server.Server(address.bind_daemon_socket(path, None))
        operated.service._publish = self.server.publish
        self.links = []

    async def connect(self):
        link = Link(*await asyncio.open_unix_connection(self.path, limit=1 << 20))
        self.links.append(link)
        return link

    async def until(self, state):
        while self.operated.state != state:
            await asyncio.sleep(0.002)

    def run(self, scenario):
        """Run a scenario with the server, and end it as the daemon does."""

        async def whole():
            self.server.serve(self.operated.service)
            try:
                await scenario(self)
            finally:
                await self.operated.service.close("the test is over")
                await self.server.close()
                for link in self.links:
                    await link.close()

        self.operated.loop.run_until_complete(whole())


@pytest.fixture
def served(operated, runtime_folder):
    return Served(operated, socket_path("sim"))


def descriptors():
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - the descriptor that lists counts too


def test_commands_and_events(served):
    async def scenario(served):
        listener, operator = await served.connect(), await served.connect()
        assert await listener.request({"command": "watch", "id": 3}) == {
            "reply": "watch", "ok": True, "id": 3,
        }  # fmt: skip
        status = await operator.request({"command": "status"})
        assert status["state"] == "ready"
        short = LONG | {"repeat": 2, "parameters": LONG["parameters"] | {"duration_s": 0.3}}
        assert (await operator.request(short))["plan"]["record_s"] == 0.3
        events = []
        while not events or events[-1]["event"] != "series":
            events.append(await listener.next())
        assert [e["to"] for e in events if e["event"] == "state"] == ["running", "ready"]
        assert sum(e["event"] == "session" for e in events) == 2
        assert len(events[-1]["sessions"]) == 2
        refused = await listener.request({"command": "tare"})
        assert not refused["ok"]
        assert f"process {os.getpid()}" in refused["error"]
        await operator.close()
        while (await listener.request({"command": "status"}))["controller"] is not None:
            pass
        assert (await listener.request({"command": "tare"}))["ok"]

    served.run(scenario)


def test_client_with_closed_write_side_is_answered_and_disconnected(served):
    async def scenario(served):
        link = await served.connect()
        await link.send(b'{"command":"tare"}\n{"command":"status"}')
        link.writer.write_eof()
        assert (await link.next())["reply"] == "tare"
        assert await link.next() is None
        assert served.operated.service.controller is None

    served.run(scenario)


@pytest.mark.parametrize("leave", ["close", "close after the end of requests"])
@pytest.mark.parametrize("phase", ["connecting", "planning"])
def test_start_of_a_client_that_has_gone_moves_nothing(
    operate, runtime_folder, monkeypatch, phase, leave
):
    operated, proceed = operate(), threading.Event()
    served = Served(operated, socket_path("sim"))
    if phase == "connecting":
        operated.world.then = lambda _: proceed.wait(60.0)
    else:
        operated.open()
        perform = background.PlanJob.perform
        monkeypatch.setattr(
            background.PlanJob, "perform", lambda job: proceed.wait(60.0) and perform(job)
        )

    async def scenario(served):
        if phase == "connecting":
            opening = asyncio.create_task(operated.service.open())
            await asyncio.sleep(0)
        operator, other = await served.connect(), await served.connect()
        await operator.send(LONG)
        if leave != "close":
            operator.writer.write_eof()

        async def status_with(controller):
            while True:
                status = await other.request({"command": "status"})
                if bool(status["controller"]) is controller:
                    return status

        try:
            assert (await status_with(controller=True))["doing"] == phase
            await operator.close()
            async with asyncio.timeout(30.0):  # which only a failed test takes
                await status_with(controller=False)
        finally:
            proceed.set()
        if phase == "connecting":
            await opening
        while (status := await other.request({"command": "status"}))["doing"]:
            pass
        assert (status["state"], status["series"]) == ("ready", None)
        assert (await other.request({"command": "tare"}))["ok"]

    served.run(scenario)


def test_start_is_refused_if_the_daemon_ends_during_the_planning(served, monkeypatch):
    planning, replies = asyncio.Event(), []

    async def plan(job):
        await planning.wait()

    monkeypatch.setattr(background, "perform", plan)
    monkeypatch.setattr(background.PlanJob, "is_heavy", True)

    async def scenario(served):
        operator = await served.connect()
        await operator.send(LONG | {"id": 5})
        while served.operated.service.status()["doing"] != "planning":
            await asyncio.sleep(0.001)
        replies.append(asyncio.create_task(operator.next()))

    served.run(scenario)
    planning.set()
    reply = served.operated.loop.run_until_complete(replies[0])
    assert (reply["reply"], reply["ok"], reply["id"]) == ("start", False, 5)
    assert "shut down" in reply["error"]


def test_misbehaving_clients_do_not_harm_a_running_session(served, monkeypatch):
    monkeypatch.setattr(server, "_MAX_UNREAD_BYTES", 65_536)

    async def scenario(served):
        operator = await served.connect()
        assert (await operator.request(LONG))["ok"]
        await operator.close()

        rude = await served.connect()
        await rude.send(b"\xff\x00{{{\n" + b"[" * 50_000 + b"\n" + b"\n" * 20)
        assert [(await rude.next())["ok"] for _ in range(22)] == [False] * 22

        endless = await served.connect()
        with contextlib.suppress(OSError):
            await endless.send(b"x" * 1_000_000)
        with contextlib.suppress(OSError):
            assert "65536 bytes" in (await endless.next())["error"]
            assert await endless.next() is None

        half = await served.connect()
        await half.send(b'{"command": "sta')

        flood = await served.connect()
        await flood.send(b'{"command":"status"}\n' * 500)
        assert (await flood.next())["reply"] == "status"

        slow = await served.connect()
        assert (await slow.request({"command": "watch"}))["ok"]
        for _ in range(2000):
            served.server.publish({"event": "message", "text": "x" * 1000})
        await asyncio.sleep(0.01)
        assert all(not client.is_subscribed for client in served.server._clients)

        status = await (await served.connect()).request({"command": "status"})
        assert status["state"] == "running"
        assert [s["outcome"] for s in status["series"]["sessions"]] == (
            ["complete"] * len(status["series"]["sessions"])
        )
        assert (await (await served.connect()).request({"command": "stop"}))["stopping"]
        await served.until("ready")

    served.run(scenario)
    assert served.operated.world.wrong == []


async def join_queue(link, path):
    """Connect without waiting to be accepted, only for room in the queue."""
    while True:
        try:
            return link.connect(str(path))
        except BlockingIOError:
            await asyncio.sleep(0.001)


def test_stop_succeeds_among_hundreds_of_connections(served):
    async def scenario(served):
        operator = await served.connect()
        assert (await operator.request(LONG))["ok"]
        before = descriptors()
        refusals = most = 0
        for _ in range(4):
            links = [
                socket.socket(socket.AF_UNIX) for _ in range(server.MAX_PENDING_CONNECTIONS + 10)
            ]
            for link in links:
                link.setblocking(False)
                await join_queue(link, served.path)
            while len(served.server._pending_connections) < server.MAX_PENDING_CONNECTIONS:
                await asyncio.sleep(0.001)
            await asyncio.sleep(0.01)
            assert len(served.server._clients) <= server.MAX_CLIENTS
            assert len(served.server._pending_connections) <= server.MAX_PENDING_CONNECTIONS
            # Some connections are closing, and a session has its files.
            most = max(most, descriptors() - len(links))
            for link in links:
                with contextlib.suppress(BlockingIOError):
                    refusals += b"too many clients" in link.recv(1000)
                link.close()
        assert refusals > 0
        assert most <= before + server.MAX_PENDING_CONNECTIONS + server.MAX_CLIENTS
        assert (await operator.request({"command": "status"}))["state"] == "running"
        assert (await (await served.connect()).request({"command": "stop"}))["stopping"]
        await served.until("ready")
        assert served.operated.service.controller is not None

    served.run(scenario)


def test_stop_is_executed_beyond_the_limit_of_clients(served, monkeypatch):
    monkeypatch.setattr(server, "MAX_CLIENTS", 5)

    async def scenario(served):
        assert (await (await served.connect()).request(LONG))["ok"]
        watchers = [await served.connect() for _ in range(4)]
        assert (await watchers[0].request({"command": "watch"}))["ok"]
        for listener in watchers[1:]:
            assert (await listener.request({"command": "watch"}))["ok"]
        refused = await (await served.connect()).request({"command": "status"})
        assert (refused["ok"], refused["crowded"]) == (False, True)
        reply = await (await served.connect()).request({"command": "stop", "id": 7})
        assert (reply["stopping"], reply["id"]) == (True, 7)
        await served.until("ready")

    served.run(scenario)


def test_connections_of_one_process_displace_no_other(served, monkeypatch):
    """The connection of another process is the oldest, and stays."""
    crowd = []

    def introduced(link):
        silent = introduce(link)
        if crowd:
            silent.peer = replace(silent.peer, pid=1)
        return silent

    introduce = served.server._identified_connection
    monkeypatch.setattr(served.server, "_identified_connection", introduced)

    async def scenario(served):
        slow = await served.connect()
        await slow.send(b'{"command":')
        while not served.server._pending_connections:
            await asyncio.sleep(0.001)
        for _ in range(3 * server.MAX_PENDING_CONNECTIONS):
            crowd.append(socket.socket(socket.AF_UNIX))
            crowd[-1].setblocking(False)
            await join_queue(crowd[-1], served.path)
        await asyncio.sleep(0.05)
        assert len(served.server._pending_connections) == server.MAX_PENDING_CONNECTIONS
        assert b"too many clients" in crowd[0].recv(1000)
        assert (await slow.request(b'"status"}\n'))["state"] == "ready"
        for link in crowd:
            link.close()

    served.run(scenario)


def test_subscribers_leave_connections_for_requests(served):
    async def scenario(served):
        watchers = [await served.connect() for _ in range(server.MAX_CLIENTS)]
        replies = [await listener.request({"command": "watch"}) for listener in watchers]
        assert sum(reply["ok"] for reply in replies) == server.MAX_SUBSCRIBERS
        assert (await (await served.connect()).request({"command": "status"}))["ok"]

    served.run(scenario)


@pytest.mark.parametrize("is_stop", [False, True])
def test_without_descriptors_only_a_stop_is_executed(served, is_stop):
    async def scenario(served):
        link = socket.socket(socket.AF_UNIX)
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        fill = []
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors() + 20, limits[1]))
        try:
            with contextlib.suppress(OSError):
                while True:
                    fill.append(os.open(os.devnull, os.O_RDONLY))
            link.connect(str(served.path))
            link.sendall(b'{"command":"%s"}\n' % (b"stop" if is_stop else b"status"))
            await asyncio.sleep(0.05)
        finally:
            for fd in fill:
                os.close(fd)
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        link.settimeout(10.0)
        reply = json.loads(link.recv(1000))
        link.close()
        assert "stopping" in reply if is_stop else "too many clients" in reply["error"]
        assert (await (await served.connect()).request({"command": "status"}))["ok"]

    served.run(scenario)


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_socket_belongs_to_its_user(runtime_folder):
    path = socket_path("my rig/2")
    assert path.parent == runtime_folder / "rigd"
    listener = address.bind_daemon_socket(path, None)
    assert mode(path) == 0o600
    assert mode(path.parent) == 0o700
    assert not socket_answers(path)  # not before it listens
    listener.listen(5)
    assert socket_answers(path)
    with pytest.raises(AddressError, match="Another daemon"):
        address.bind_daemon_socket(path, None)
    listener.close()
    with address.bind_daemon_socket(path, None):  # what a dead daemon left
        assert not socket_answers(path)


def test_socket_of_a_group(runtime_folder):
    group = grp.getgrgid(os.getgid()).gr_name
    common = runtime_folder / "common"
    path = socket_path("sim", common)
    with pytest.raises(AddressError, match=f"install -d -o .* -g {group} .*{common}"):
        address.bind_daemon_socket(path, group)
    assert not common.exists()  # it is the administrator's to make
    common.mkdir(mode=0o700)
    with pytest.raises(AddressError, match=f"closed to the group {group}"):
        address.bind_daemon_socket(path, group)
    common.chmod(0o710)
    common.chmod(0o2770)
    with pytest.raises(AddressError, match=f"{common} is writable by its group"):
        address.bind_daemon_socket(path, group)
    common.chmod(0o710)
    with address.bind_daemon_socket(path, group):
        assert mode(path) == 0o660
        assert path.stat().st_gid == os.getgid()
    with pytest.raises(UnknownGroupError, match="no such group"):
        address.bind_daemon_socket(path, "nobody-has-this-group")


def test_error_with_remedy_for_an_impossible_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(AddressError, match="XDG_RUNTIME_DIR"):
        address.bind_daemon_socket(tmp_path / "file" / "sim.daemon", None)
    with pytest.raises(AddressError, match="XDG_RUNTIME_DIR"):
        address.bind_daemon_socket(tmp_path / ("x" * 120) / "sim.daemon", None)


def test_daemons_are_found(runtime_folder, monkeypatch):
    monkeypatch.setattr(address, "GROUP_FOLDER", runtime_folder / "common")
    with pytest.raises(AddressError, match="rigd serve"):
        find_daemon_socket(None)
    with (
        address.bind_daemon_socket(socket_path("one"), None) as one,
        address.bind_daemon_socket(socket_path("two"), None) as two,
    ):
        one.listen(5)
        assert find_daemon_socket(None) == socket_path("one")  # the other one is dead
        two.listen(5)
        assert running_daemon_sockets() == [socket_path("one"), socket_path("two")]
        with pytest.raises(AddressError, match=r"one, two.*--profile"):
            find_daemon_socket(None)
        assert find_daemon_socket("two") == socket_path("two")
        with pytest.raises(AddressError, match="rigd serve --profile three"):
            find_daemon_socket("three")
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime_folder / "rigd"))
        elsewhere = f"one listens on {socket_path('one', runtime_folder / 'rigd')}"
        with pytest.raises(AddressError, match=elsewhere):
            find_daemon_socket("one")
        monkeypatch.undo()
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime_folder))
        assert isinstance(find_daemon_socket("one"), Path)


def test_signals_are_sent_to_their_subscribers_only(served, monkeypatch):
    monkeypatch.setattr(signal_blocks, "_ABANDONED_AFTER_S", 1e9)  # however slow the computer is

    async def scenario(served):
        streaming = asyncio.create_task(served.operated.service.stream_signals())
        other, listener = await served.connect(), await served.connect()
        await other.request({"command": "watch"})
        await listener.request({"command": "watch", "signals": True})
        await served.connect()
        event = await listener.next()
        assert (event["event"], event["count"]) == ("signals", 0)
        await other.request(LONG | {"repeat": 1, "parameters": LONG["parameters"]})
        events = []
        while not events or events[-1]["event"] != "series":
            events.append(await listener.next())
        blocks = [event for event in events if event["event"] == "signals" and event["count"]]
        decoded = {
            name: np.concatenate(
                [np.frombuffer(base64.b64decode(block[name]), "<f4") for block in blocks]
            )
            for name in ("angle_rad", "angle_reference_rad", "coupling_torque_nm")
        }
        assert {name: values.size for name, values in decoded.items()} == dict.fromkeys(
            decoded, 2000
        )
        gauges = [block["gauges"] for block in blocks if block["gauges"] is not None]
        assert all(each["angle"]["unit"] == "rad" for each in gauges)  # ten times a second
        assert all(len(json.dumps(event)) < 65_536 for event in events)
        other_events = []
        while not other_events or other_events[-1]["event"] != "series":
            other_events.append(await other.next())
        assert all(event["event"] != "signals" for event in other_events)
        await listener.close()
        await other.request({"command": "status"})
        assert served.operated.service._signal_watchers == set()
        streaming.cancel()

    served.run(scenario)
