"""The process of the operator's page: its address, its restarts, its end with the daemon."""

import json
import os
import signal
import socket
import stat
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
from operated_daemons import shown_status
from processes import eventually

from rigd.daemon import _page, page_address
from rigd.engine.workers import PAGE
from rigd.profile import load_profile
from rigd.web import run_page  # noqa: F401 - copies are spared its imports

pytestmark = pytest.mark.process

STATUS = {
    "state": "ready", "doing": "", "since_utc_ns": 0, "reason": "", "zero_lost": False,
    "controller": None, "series": None, "progress": None, "rig": None, "history": [],
}  # fmt: skip


@pytest.fixture
def serve(runtime_folder, tmp_path, monkeypatch, children_copied):
    monkeypatch.setattr(_page, "_RESTART_PAUSE_S", 0.05)
    started = []

    def serve(port=None):
        urls = []
        socket = runtime_folder / "no.daemon"
        started.append(_page.PageProcess(load_profile("sim"), tmp_path, socket, port, urls.append))
        started[-1].urls = urls
        return started[-1]

    yield serve
    for page in started:
        page.close()


def wait_for_address():
    return eventually(lambda: page_address("sim"), within_s=60.0)


def answers(address):
    with urllib.request.urlopen(address.partition("#")[0], timeout=30.0) as answer:
        return answer.status == 200


def test_user_finds_the_page_until_the_daemon_ends(serve, runtime_folder):
    page = serve()
    address = wait_for_address()
    url, _, token = address.partition("#token=")
    assert answers(address)
    assert len(token) >= 32
    (file,) = (runtime_folder / "rigd").glob("page-*")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert page.urls == [url]
    assert token not in url
    status = STATUS | {
        "daemon": {"profile": "sim", "moving": "m", "pid": 1, "output": "o", "web": url}
    }
    assert shown_status(status)["page"].strip() == address
    pid = page._child.pid
    command = Path(f"/proc/{pid}/cmdline").read_bytes() + Path(f"/proc/{pid}/environ").read_bytes()
    assert token.encode() not in command
    page.close()
    assert page_address("sim") is None
    assert not Path(f"/proc/{pid}").exists()
    assert not file.exists()


def test_restarts_of_a_killed_page_are_limited(serve, monkeypatch):
    monkeypatch.setattr(_page, "PAGE", replace(PAGE, restarts=1))
    page = serve()
    address = wait_for_address()
    first = page._child.pid
    os.kill(first, signal.SIGKILL)
    assert eventually(lambda: page._child.pid != first and len(page.urls) == 3, within_s=60.0)
    assert page.urls == [page.urls[0], None, page.urls[0]]
    assert page_address("sim") == address
    assert answers(address)
    os.kill(page._child.pid, signal.SIGKILL)
    page._thread.join(30.0)
    assert not page._thread.is_alive()
    assert page.urls[-1] is None


def test_only_short_runs_count_as_failed_starts(serve, monkeypatch):
    class Clock:
        now_s = 0.0

        def monotonic(self):
            return self.now_s

    def run(_):
        clock.now_s += next(durations_s, 1.0)
        ends_s.append(clock.now_s)

    clock, ends_s = Clock(), []
    durations_s = iter([1.0, 1.0, 1.0, 1.0, 60.0, 1.0, 3600.0])
    monkeypatch.setattr(_page, "time", clock)
    monkeypatch.setattr(_page, "_RESTART_PAUSE_S", 0.0)
    monkeypatch.setattr(_page.PageProcess, "_run_process", run)
    page = serve()
    page._thread.join(30.0)
    assert not page._thread.is_alive()
    assert len(ends_s) == 7 + 5


@pytest.mark.further  # as test_page_server.py
def test_error_if_a_requested_port_is_taken(serve, monkeypatch, caplog):
    monkeypatch.setattr(_page, "PAGE", replace(PAGE, restarts=0))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        page = serve(port)
        page._thread.join(60.0)
        assert f"port {port} cannot be opened" in caplog.text
        assert page_address("sim") is None
        monkeypatch.setattr(_page, "PAGE_PORT", port)
        other = serve()
        assert answers(wait_for_address())
        assert other.urls[0] != f"http://127.0.0.1:{port}/"


def test_failure_of_the_page_is_logged(serve, monkeypatch, caplog):
    async def run(self):
        raise RuntimeError("such a thing")

    monkeypatch.setattr("rigd.web._server.OperatorPageServer.run", run)  # and so in the copy
    monkeypatch.setattr(_page, "PAGE", replace(PAGE, restarts=0))
    page = serve()
    page._thread.join(60.0)
    assert not page._thread.is_alive()
    assert "ended with code 1: unexpected error (RuntimeError('such a thing'))" in caplog.text
    assert len(page.urls) == 2  # it had an address


def test_no_address_from_the_file_of_an_ended_daemon(runtime_folder):
    folder = runtime_folder / "rigd"
    folder.mkdir()
    document = {"pid": os.getpid(), "born": 1, "url": "http://127.0.0.1:1/", "token": "x"}
    (folder / "page-sim.json").write_text(json.dumps(document))
    assert page_address("sim") is None


def test_daemon_imports_nothing_of_the_page():
    code = (
        "import sys, rigd.daemon._main, rigd.daemon._page, rigd.cli.daemon; "
        "print([name for name in ('aiohttp', 'rigd.web') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"
