"""The file by which a live view is found, and its ports."""

import json
import os
import socket
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from processes import eventually

from rigd.live._server import free_port
from rigd.live.address import LiveAddress, announce, find, running, withdraw
from rigd.live.publisher import RerunError, RerunServer
from rigd.runtime.addresses import runtime_folder

pytestmark = pytest.mark.process


@pytest.fixture
def address(runtime_folder):
    return LiveAddress.for_this_process("antenna can", grpc_port=9876, page_port=9090, server=1)


def files():
    return list(runtime_folder().glob("live-*"))


@pytest.fixture
def ended_pid():
    """The process id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_view_is_found_by_the_name_of_the_rig(address):
    assert find("antenna can") is None
    announce(address)
    announce(second := replace(address, server=2))
    assert find("antenna can") == second
    assert find("another") is None
    announce(other := replace(address, rig="another", grpc_port=1234))
    assert running() == [other, second]
    withdraw(second)
    assert running() == [other]
    withdraw(other)
    assert files() == []


def test_file_is_private_to_its_user(address):
    before = os.umask(0o000)
    announce(address)
    os.umask(before)
    (file,) = files()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert file.name == "live-antenna-can.json"
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700


def test_file_of_an_ended_process_is_no_live_view(address, ended_pid):
    announce(replace(address, pid=ended_pid))
    announce(replace(address, rig="reborn", born=address.born - 1))  # the id is used again
    assert len(files()) == 2
    assert running() == []
    announce(address)
    assert running() == [address], "a new one takes its place"


def test_zombie_process_has_no_live_view(address):
    wait = "import sys; sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", wait], stdin=subprocess.PIPE) as process:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        child = replace(address, pid=process.pid, born=int(fields[19]))
        announce(child)
        assert running() == [child]
        process.stdin.close()
        assert eventually(lambda: running() == [])


def test_withdraw_removes_only_its_own_file(address, ended_pid):
    announce(address)
    withdraw(replace(address, pid=ended_pid))
    assert find("antenna can") == address


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", json.dumps({"rig": "x", "more": 1})])
def test_files_of_others_are_ignored(address, text):
    announce(address)
    (file,) = files()
    file.write_text(text)
    assert running() == []
    withdraw(address)
    assert file.exists()


def test_error_message_if_the_server_does_not_start(runtime_folder, tmp_path, monkeypatch):
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\necho no such option >&2\nexit 2\n")
    program.chmod(0o755)
    monkeypatch.setattr("rigd.live._program._rerun_program_path", lambda: str(program))
    server = RerunServer("antenna can")
    with pytest.raises(RerunError, match=r"ended: no such option\.$"):
        server.wait()
    server.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_port_in_use_is_not_free(host):
    with socket.create_server((host, 0)) as taken:
        assert free_port(taken.getsockname()[1]) == 0


def test_port_with_closing_connections_is_free():
    with socket.create_server(("127.0.0.1", 0)) as server:
        address_of_server = server.getsockname()
        with socket.create_connection(address_of_server) as client:
            server.accept()[0].close()  # the end that closes first is in TIME_WAIT
            assert client.recv(1) == b""
    assert free_port(address_of_server[1]) == address_of_server[1]


@pytest.mark.parametrize(
    "wrong",
    [
        {"pid": "1\0"},
        {"pid": 1.0},
        {"server": None},
        {"rig": 7},
        {"rig": "sim\x1b[2J"},
        {"rig": "sim\n$(reboot)"},
        {"grpc_port": -5},
        {"grpc_port": "9876; reboot"},
        {"page_port": 70_000},
        {"page_port": True},
        {"colour": "red"},
    ],
)
def test_invalid_addresses_are_ignored(address, wrong):
    announce(address)
    (file,) = files()
    file.write_text(json.dumps(json.loads(file.read_text()) | wrong))
    assert running() == []
    assert find("antenna can") is None


@pytest.mark.parametrize("text", [b"", b"[" * 100_000, b"[1]", b"7", b"\xff", b" " * 10_000])
def test_invalid_documents_are_ignored(address, text):
    announce(address)
    (file,) = files()
    file.write_bytes(text)
    assert running() == []


def test_pipe_in_place_of_a_file_does_not_block(address):
    announce(address)
    (file,) = files()
    os.mkfifo(file.with_name("live-sim.json"))
    file.unlink()
    file.symlink_to("live-sim.json")
    assert running() == []
