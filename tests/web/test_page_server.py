"""The page's server in front of a daemon: messages to pages, and requests passed on."""

import asyncio
import base64
import contextlib
import json
import socket
import threading
import time
import weakref
from collections import deque
from dataclasses import replace

import aiohttp
import numpy as np
import pytest
from processes import eventually
from web_daemon import TOKEN

from rigd.engine.processes import ChildError, ChildProcess
from rigd.engine.workers import PAGE
from rigd.excitation import KINDS

ACTING = {
    "Authorization": f"Bearer {TOKEN}",
    "X-Rigd": "1",
    "Content-Type": "application/json",
}


class Pages:
    """A browser's part, in an event loop of this thread."""

    def __init__(self, served):
        self.served = served
        self.base = f"http://127.0.0.1:{served.port}/"

    def run(self, scenario):
        async def whole():
            async with aiohttp.ClientSession(self.base) as session:
                return await asyncio.wait_for(scenario(session), 60.0)

        return asyncio.run(whole())


@pytest.fixture
def pages(served):
    return Pages(served)


LINES = weakref.WeakKeyDictionary()
"""Lines received over a WebSocket and not yet read."""


async def until(socket, kind, **members):
    """Wait for a message of a type; return it with all messages before it."""
    before = []
    lines = LINES.setdefault(socket, deque())
    while lines or (message := await socket.receive()).type is aiohttp.WSMsgType.TEXT:
        if not lines:
            lines.extend(message.data.split("\n"))
        report = json.loads(lines.popleft())
        if report["type"] == kind and members.items() <= report.items():
            return report, before
        before.append(report)
    raise AssertionError(f"closed before {kind}: {before}")


async def command(session, headers=ACTING, **request):
    async with session.post("/api/command", data=json.dumps(request), headers=headers) as answer:
        return answer.status, await answer.json()


def test_new_page_receives_rig_state_and_model(served, pages):
    # After a standstill of the computer no new message of the daemon may have come yet.
    assert eventually(lambda: served.server._status is not None, within_s=30.0)

    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            _, before = await until(socket, "nominal")
            return before

    hello, *_ = before = pages.run(scenario)
    assert [each["type"] for each in before][:2] == ["hello", "status"]
    assert hello["profile"] == "sim"
    assert hello["limits"]["angle_rad"] == 1.57
    chirp = {option["name"]: option for option in hello["excitations"]["chirp"]}
    assert chirp["amplitude_rad"] == {
        "name": "amplitude_rad", "unit": "rad", "default": 0.025, "help": "Amplitude A.",
    }  # fmt: skip
    (targets, *_) = hello["excitations"]["until"]
    assert (targets["name"], targets["text"]) == ("targets", True)
    assert all(option["help"] for kind in hello["excitations"].values() for option in kind)
    assert set(hello["excitations"]) == set(KINDS)


def test_specimens_with_a_file_are_offered(served, pages, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "specimens" / "long one.toml"
    file.parent.mkdir()
    file.touch()
    finding = served.server._find_specimens()
    asyncio.run_coroutine_threadsafe(finding, served.loop).result(30.0)

    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            return (await until(socket, "hello"))[0]

    assert "long one" in pages.run(scenario)["specimens"]


@pytest.mark.parametrize(
    ("reply", "status"),
    [
        ({}, 200),
        ({"ok": False, "error": "no", "wrong_use": True}, 400),
        ({"ok": False, "error": "later", "wrong_use": False}, 409),
    ],
)
def test_requests_and_replies_are_passed_on(served, pages, reply, status):
    served.daemon.replies["tare"] = reply

    async def scenario(session):
        return await command(session, command="tare", id=3)

    assert pages.run(scenario) == (status, {"reply": "tare", "ok": True} | reply)
    assert {"command": "tare", "id": 3} in served.daemon.acted


def test_a_stop_and_a_prediction_need_no_token(served, pages):
    served.daemon.replies["stop"] = {"stopping": True}
    plain = {name: value for name, value in ACTING.items() if name != "Authorization"}

    async def scenario(session):
        return (
            await command(session, plain, command="stop"),
            await command(session, plain, command="predict", excitation="hold"),
        )

    (stopped, reply), (predicted, _) = pages.run(scenario)
    assert (stopped, predicted) == (200, 200)
    assert reply["stopping"]


async def wait_for_request(daemon, name, count=1):
    """Wait until a daemon has received a request."""
    while sum(each["command"] == name for each in daemon.requests) < count:
        await asyncio.sleep(0.005)


@pytest.fixture
def delay_reply(served):
    """Delay the daemon's answer to a command until the returned function is called."""

    def delay(name):
        served.daemon.delays[name] = event = asyncio.Event()
        return lambda: served.call(event.set)

    yield delay
    for event in served.daemon.delays.values():
        served.call(event.set)
    served.daemon.delays.clear()


@pytest.fixture
def cleared_daemon(served):
    """Clear requests and replies of the daemon."""
    served.daemon.requests.clear()
    served.daemon.replies.clear()
    yield
    served.daemon.replies.clear()


@pytest.mark.usefixtures("cleared_daemon")
def test_no_start_after_a_stop_and_another_request(served, pages, delay_reply):
    release = delay_reply("check")

    async def scenario(session):
        checking = asyncio.create_task(command(session, command="check"))
        await wait_for_request(served.daemon, "check")
        starting = asyncio.create_task(command(session, command="start", excitation="chirp"))
        await asyncio.sleep(0.05)
        stopped, _ = await command(session, command="stop")
        release()
        return (await checking)[0], stopped, await starting

    checked, stopped, (status, reply) = pages.run(scenario)
    assert (checked, stopped, status) == (200, 200, 409)
    assert "try again" in reply["error"]
    assert [each["command"] for each in served.daemon.acted] == ["check"]


@pytest.mark.usefixtures("cleared_daemon")
def test_stop_cancels_a_start_delayed_by_too_many_clients(served, pages):
    served.daemon.replies["start"] = {"ok": False, "crowded": True, "error": "Too many clients."}

    async def scenario(session):
        starting = asyncio.create_task(command(session, command="start", excitation="chirp"))
        await wait_for_request(served.daemon, "start")
        await command(session, command="stop")
        del served.daemon.replies["start"]
        return await starting

    status, reply = pages.run(scenario)
    assert status == 409
    assert "stopped before it began" in reply["error"]


def test_page_receives_strips_gauges_and_events_with_times(served, pages):
    angle = base64.b64encode(np.full(100, 0.5, dtype="<f4").tobytes()).decode()
    gauges = {"angle": {"value": 0.5, "limit": 1.0, "unit": "rad", "fraction": 0.5}}
    signals = {
        "event": "signals", "first_tick": 0, "count": 100, "rate_hz": 1000.0, "t_ns": 0,
        "angle_rad": angle, "angle_reference_rad": angle, "coupling_torque_nm": angle,
        "gauges": gauges, "frequency_hz": 3.0,
    }  # fmt: skip

    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            await until(socket, "nominal")
            served.call(served.daemon.publish, signals)
            strip, _ = await until(socket, "strip")
            shown_gauges, _ = await until(socket, "gauges")
            level = {"event": "message", "level": "warning", "text": "Hot."}
            served.call(served.daemon.publish, level)
            event, _ = await until(socket, "event")
            transition = {"from": "ready", "to": "running", "reason": "r", "utc_ns": 5}
            served.call(served.daemon.publish, {"event": "state", **transition})
            state, _ = await until(socket, "state")
        async with session.ws_connect("/api/live") as socket:  # a page that is opened later
            again, before = await until(socket, "event")
            return strip, shown_gauges, event, state, again, before

    strip, shown_gauges, event, state, again, before = pages.run(scenario)
    assert strip["angle_max"] == [0.5, 0.5]
    assert (shown_gauges["angle"], shown_gauges["frequency_hz"]) == (gauges["angle"], 3.0)
    assert abs(event["utc_ns"] * 1e-9 - time.time()) < 30.0
    assert (event["level"], event["text"]) == ("warning", "Hot.")
    assert state == {"type": "state", "from": "ready", "to": "running", "reason": "r", "utc_ns": 5}
    assert again == event
    assert strip in before


def test_lost_daemon_is_reported_within_a_second(served, pages):
    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            await until(socket, "nominal")
            began_s = time.monotonic()
            served.daemon.silent = True
            lost, _ = await until(socket, "lost")
            took_s = time.monotonic() - began_s
            served.daemon.silent = False
            await until(socket, "status")
            began_s = time.monotonic()
            for writer in served.daemon.watchers:
                served.call(writer.close)
            gone, _ = await until(socket, "lost")
            gone_s = time.monotonic() - began_s
            await until(socket, "status")
            return lost, took_s, gone, gone_s

    lost, took_s, gone, gone_s = pages.run(scenario)
    assert "has sent nothing" in lost["reason"]
    assert "rigd serve" in gone["reason"]
    assert took_s < 1.5
    assert gone_s < 1.0


def test_only_the_stalled_page_is_dropped(served, pages, replace_in_page):
    replace_in_page(most_waiting=20)
    stopped = served.connect()
    stopped.sendall(
        f"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nConnection: Upgrade\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
    )
    assert b" 101 " in stopped.recv(1000)
    long = {"event": "message", "level": "info", "text": "x" * 50_000}

    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            await until(socket, "nominal")
            assert len(served.server.pages) == 2
            for _ in range(200):
                served.call(served.daemon.publish, long)
                await until(socket, "event", text=long["text"])
                if len(served.server.pages) == 1:
                    return True
        return False

    try:
        assert pages.run(scenario)
    finally:
        stopped.close()
        served.server.pages._events.clear()


def test_number_of_pages_is_limited(served, pages, replace_in_page):
    replace_in_page(most_pages=1)

    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            await until(socket, "nominal")
            with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
                await session.ws_connect("/api/live")
            return refusal.value.status

    assert pages.run(scenario) == 503


@pytest.fixture
def begin_session(served):
    """Have the daemon report a running session of an excitation, in a file of that name."""

    def session(name, excitation):
        plan = {
            "segments": {
                name: list(end_series) for name, end_series in excitation.segments.items()
            },
            "record_s": excitation.reference_rad.size / excitation.rate_hz,
            **{name: served._job[name] for name in ("beam", "damping")},
        }
        series = {"path": name, "running": True, "excitation": excitation.kind, "notes": {}}
        served.daemon.status |= {"state": "running", "series": series | {"plan": plan}}
        served.call(served.server._link.request_status)

    yield session
    served.daemon.status |= {"state": "ready", "series": None}
    served.call(served.server._link.request_status)
    assert eventually(lambda: served.server._session is None)


def test_response_of_a_search_is_that_of_its_scan(served, begin_session, replace_in_page):
    begun = []
    replace_in_page(response=lambda sweep, *_, **__: begun.append(tuple(sweep)))
    excitation = KINDS["until"](rate_hz=1000, targets="damping 1%", at_most_s=60)
    begin_session("out/1-until.mcap", excitation)
    assert eventually(lambda: begun)
    assert begun[0] == excitation.segments["scan"]


def test_each_session_of_a_series_sends_the_nominal_model(served, pages, begin_session):
    excitation = KINDS["chirp"](rate_hz=1000, duration_s=10)

    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            await until(socket, "nominal")
            for path in ("out/1.mcap", "out/2.mcap"):
                served.server._shown = {"type": "response"}
                begin_session(path, excitation)
                await until(socket, "nominal")
                assert served.server._shown is None

    pages.run(scenario)


@contextlib.asynccontextmanager
async def open_live_page(served, session):
    """Open a page; yield its socket, and the server's connection to the daemon."""
    async with session.ws_connect("/api/live") as socket:
        await until(socket, "nominal")
        (following,) = served.daemon.connected
        yield socket, following


def end_series(served, series):
    served.call(served.daemon.publish, {"event": "series", "series": series})


@pytest.mark.usefixtures("cleared_daemon")
def test_started_session_has_control_until_its_series_ends(served, pages):
    connections = []

    async def scenario(session):
        async with open_live_page(served, session) as (socket, following):
            served.daemon.replies["start"] = {"series": 1}
            await command(session, command="start", excitation="chirp")
            await command(session, command="reset")
            connections.append(served.daemon.connected - {following})
            end_series(served, 1)
            await until(socket, "series")
            while served.daemon.connected != {following}:
                await asyncio.sleep(0.01)
            await command(session, command="zero")
            return following

    following = pages.run(scenario)
    assert [len(each) for each in connections] == [1]
    assert eventually(lambda: served.daemon.connected == {following})


@pytest.mark.usefixtures("cleared_daemon")
def test_request_is_sent_once_if_a_series_ends_meanwhile(served, pages, delay_reply):
    served.daemon.replies["start"] = {"series": 1}

    async def scenario(session):
        async with open_live_page(served, session) as (socket, following):
            await command(session, command="start", excitation="chirp")
            served.daemon.replies["start"] = {"series": 2}
            release = delay_reply("start")
            starting = asyncio.create_task(command(session, command="start", excitation="hold"))
            await wait_for_request(served.daemon, "start", 2)
            end_series(served, 1)
            await until(socket, "series")
            release()
            answer = await starting
            # The new series has control until it ends.
            holding = served.daemon.connected - {following}
            end_series(served, 2)
            await until(socket, "series")
            return answer, holding, following

    (status, reply), holding, following = pages.run(scenario)
    assert (status, reply["series"], len(holding)) == (200, 2, 1)
    assert [each["command"] for each in served.daemon.acted] == ["start", "start"]
    assert eventually(lambda: served.daemon.connected == {following})


@pytest.mark.usefixtures("cleared_daemon")
def test_request_with_lost_reply_is_not_repeated(served, pages, delay_reply):
    served.daemon.replies["start"] = {"series": 1}

    async def scenario(session):
        async with open_live_page(served, session) as (_, following):
            await command(session, command="start", excitation="chirp")
            delay_reply("zero")
            zeroing = asyncio.create_task(command(session, command="zero"))
            await wait_for_request(served.daemon, "zero")
            (holding,) = served.daemon.connected - {following}
            served.call(holding.close)
            lost, _ = await zeroing
            # A connection that is closed before anything was sent causes no refusal.
            return lost, (await command(session, command="tare"))[0]

    assert pages.run(scenario) == (503, 200)
    assert [each["command"] for each in served.daemon.acted] == ["start", "zero", "tare"]


@pytest.mark.usefixtures("cleared_daemon")
def test_control_is_released_if_the_series_ends_early(served, pages, delay_reply):
    served.daemon.replies["start"] = {"series": 1}

    async def scenario(session):
        async with open_live_page(served, session) as (socket, following):
            release = delay_reply("start")
            starting = asyncio.create_task(command(session, command="start", excitation="chirp"))
            await wait_for_request(served.daemon, "start")
            end_series(served, 1)
            await until(socket, "series")
            release()
            assert (await starting)[0] == 200
            return following

    following = pages.run(scenario)
    assert eventually(lambda: served.daemon.connected == {following})


@pytest.mark.usefixtures("cleared_daemon")
def test_stop_does_not_wait_for_lists_of_sessions(served, pages, replace_in_page):
    began, release, at_once = threading.Event(), threading.Event(), []

    def list_slowly(_):
        at_once.append(None)
        began.set()
        release.wait(20.0)
        at_once.pop()
        return []

    replace_in_page(list_sessions=list_slowly)

    async def scenario(session):
        listings = [asyncio.create_task(session.get("/api/sessions")) for _ in range(40)]
        await asyncio.to_thread(began.wait, 20.0)
        await asyncio.sleep(0.2)
        try:
            stopping = command(session, command="stop")
            return len(at_once), await asyncio.wait_for(stopping, 10.0)
        finally:
            release.set()
            for answer in await asyncio.gather(*listings):
                answer.release()

    concurrent, (status, _) = pages.run(scenario)
    assert (concurrent, status) == (1, 200)


@pytest.mark.usefixtures("cleared_daemon")
def test_a_page_stops_over_its_websocket(served, pages):
    served.daemon.replies["stop"] = {"stopping": True}

    async def scenario(session):
        async with session.ws_connect("/api/live") as socket:
            await until(socket, "nominal")
            await socket.send_str("stop")
            stopped, _ = await until(socket, "stop")
            served.daemon.replies["stop"] = {"ok": False, "error": "Not now."}
            await socket.send_str("stop")
            return stopped, (await until(socket, "stop"))[0]

    stopped, refused = pages.run(scenario)
    assert stopped["stopping"]
    assert (refused["ok"], refused["error"]) == (False, "Not now.")
    assert [each["command"] for each in served.daemon.requests].count("stop") == 2


@pytest.mark.process
@pytest.mark.usefixtures("children_copied")
def test_page_process_writes_no_invalid_requests_to_its_terminal(served):
    page = ChildProcess(replace(PAGE, captures_stderr=True))
    try:
        page.start(served._job)
        port = page.poll(60.0).port
        for nonsense in (bytes(range(256)), b"GET / HTTP/1.1\r\nHost: [\r\nX\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", port), 30.0) as link:
                link.sendall(nonsense)
                assert link.recv(100).split()[1] == b"400"
        page.close_input()
        with pytest.raises(ChildError, match="page process was ended with exit code 0"):
            page.poll(60.0)
        assert page.error_text() == ""
    finally:
        page.stop()
