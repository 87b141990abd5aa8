"""The process of the operator's page: found by its user, started again, ended with the daemon."""

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
        told = []
        socket = runtime_folder / "no.daemon"
        started.append(_page.PageProcess(load_profile("sim"), tmp_path, socket, port, told.append))
        started[-1].told = told
        return started[-1]

    yield serve
    for page in started:
        page.close()


def found():
    return eventually(lambda: page_address("sim"), within_s=60.0)


def answers(address):
    with urllib.request.urlopen(address.partition("#")[0], timeout=30.0) as answer:
        return answer.status == 200


def test_the_page_is_found_by_its_user_and_ends_with_the_daemon(serve, runtime_folder):
    page = serve()
    address = found()
    url, _, token = address.partition("#token=")
    assert answers(address)
    assert len(token) >= 32
    (file,) = (runtime_folder / "rigd").glob("page-*")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert page.told == [url]
    assert token not in url
    told = STATUS | {
        "daemon": {"profile": "sim", "moving": "m", "pid": 1, "output": "o", "web": url}
    }
    assert shown_status(told)["page"].strip() == address
    pid = page._child.pid
    command = Path(f"/proc/{pid}/cmdline").read_bytes() + Path(f"/proc/{pid}/environ").read_bytes()
    assert token.encode() not in command
    page.close()
    assert page_address("sim") is None
    assert not Path(f"/proc/{pid}").exists()
    assert not file.exists()


def test_a_page_that_is_killed_comes_back_at_its_place_and_is_given_up_at_last(serve, monkeypatch):
    monkeypatch.setattr(_page, "PAGE", replace(PAGE, restarts=1))
    page = serve()
    address = found()
    first = page._child.pid
    os.kill(first, signal.SIGKILL)
    assert eventually(lambda: page._child.pid != first and len(page.told) == 3, within_s=60.0)
    assert page.told == [page.told[0], None, page.told[0]]
    assert page_address("sim") == address
    assert answers(address)
    os.kill(page._child.pid, signal.SIGKILL)
    page._thread.join(30.0)
    assert not page._thread.is_alive()
    assert page.told[-1] is None


def test_only_starts_that_do_not_last_are_counted(serve, monkeypatch):
    class Clock:
        now_s = 0.0

        def monotonic(self):
            return self.now_s

    def run(_):
        clock.now_s += next(lasted_s, 1.0)
        ran.append(clock.now_s)

    clock, ran = Clock(), []
    lasted_s = iter([1.0, 1.0, 1.0, 1.0, 60.0, 1.0, 3600.0])
    monkeypatch.setattr(_page, "time", clock)
    monkeypatch.setattr(_page, "_RESTART_PAUSE_S", 0.0)
    monkeypatch.setattr(_page.PageProcess, "_run_process", run)
    page = serve()
    page._thread.join(30.0)
    assert not page._thread.is_alive()
    assert len(ran) == 7 + 5


@pytest.mark.further  # as test_page_server.py
def test_a_port_that_is_taken_is_said_if_it_was_asked_for(serve, monkeypatch, caplog):
    monkeypatch.setattr(_page, "PAGE", replace(PAGE, restarts=0))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        page = serve(port)
        page._thread.join(60.0)
        assert f"port {port} cannot be had" in caplog.text
        assert page_address("sim") is None
        monkeypatch.setattr(_page, "PAGE_PORT", port)
        other = serve()
        assert answers(found())
        assert other.told[0] != f"http://127.0.0.1:{port}/"


def test_a_page_that_fails_ends_and_its_reason_is_logged(serve, monkeypatch, caplog):
    async def run(self):
        raise RuntimeError("such a thing")

    monkeypatch.setattr("rigd.web._server.OperatorPageServer.run", run)  # and so in the copy
    monkeypatch.setattr(_page, "PAGE", replace(PAGE, restarts=0))
    page = serve()
    page._thread.join(60.0)
    assert not page._thread.is_alive()
    assert "ended with code 1: unexpected error (RuntimeError('such a thing'))" in caplog.text
    assert len(page.told) == 2  # it had an address


def test_a_file_of_a_daemon_that_is_gone_is_no_address(runtime_folder):
    folder = runtime_folder / "rigd"
    folder.mkdir()
    told = {"pid": os.getpid(), "born": 1, "url": "http://127.0.0.1:1/", "token": "x"}
    (folder / "page-sim.json").write_text(json.dumps(told))
    assert page_address("sim") is None


def test_a_daemon_imports_nothing_of_the_page():
    code = (
        "import sys, rigd.daemon._main, rigd.daemon._page, rigd.cli.daemon; "
        "print([name for name in ('aiohttp', 'rigd.web') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"
