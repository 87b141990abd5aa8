"""Search for a running simulated rig; the address of a dead one is ignored."""

import json
import socket
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest

from rigd.devices.running_simulator import SimulatorAddress, find_simulator, write_address_file
from rigd.runtime.addresses import runtime_folder as current_folder


@pytest.fixture
def alive(runtime_folder):
    """The control socket of a simulator that runs."""
    path = runtime_folder / "control"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()
        yield str(path)


def test_an_announced_simulator_is_found(alive):
    address = SimulatorAddress(4711, alive, "/run/can", "/dev/pts/7", lock_step=True)
    path = write_address_file("antenna", address)
    assert find_simulator("antenna") == address
    assert find_simulator("sim") is None
    assert [entry.name for entry in path.parent.iterdir()] == ["antenna.json"]
    assert path.parent.stat().st_mode & 0o077 == 0


def test_announcing_again_replaces(alive):
    write_address_file("antenna", SimulatorAddress(1, alive))
    write_address_file("antenna", SimulatorAddress(2, alive))
    assert find_simulator("antenna").pid == 2


def test_a_rig_without_a_simulator_has_none(runtime_folder):
    assert find_simulator("antenna") is None


def test_the_address_of_a_dead_simulator_is_not_found(runtime_folder):
    path = runtime_folder / "control"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()
    assert path.exists()
    write_address_file("antenna", SimulatorAddress(1, str(path)))
    assert find_simulator("antenna") is None
    path.unlink()
    assert find_simulator("antenna") is None


def test_a_busy_simulator_counts_as_running(runtime_folder):
    """If it counted as dead, the drivers would open the hardware."""
    path = str(runtime_folder / "control")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(path)
        listener.listen(0)
        write_address_file("antenna", SimulatorAddress(1, path))
        with ExitStack() as queued:
            with pytest.raises(BlockingIOError):
                while True:
                    waiting = queued.enter_context(socket.socket(socket.AF_UNIX))
                    waiting.setblocking(False)
                    waiting.connect(path)
            assert find_simulator("antenna") is not None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "7",
        "null",
        "{}",
        '{"pid": 1}',
        '{"pid": 1, "control_socket": "x", "unknown": 1}',
        '{"pid": 1, "control_socket": 5}',
        '{"pid": 1, "control_socket": null}',
        '{"pid": 1, "control_socket": "a\\u0000b"}',
        '{"pid": 1, "control_socket": "/' + 300 * "x" + '"}',
        '{"pid": 1, "control_socket": ""}',
    ],
)
def test_a_garbled_file_is_not_a_simulator(runtime_folder, text):
    path = write_address_file("antenna", SimulatorAddress(1, "x"))
    path.write_text(text, encoding="utf-8")
    assert find_simulator("antenna") is None


def test_a_binary_file_is_not_a_simulator(runtime_folder):
    write_address_file("antenna", SimulatorAddress(1, "x")).write_bytes(b"\xff\xfe\x00")
    assert find_simulator("antenna") is None


def test_other_settings_of_the_file_remain(alive):
    path = write_address_file("antenna", SimulatorAddress(1, alive, can_socket="c"))
    assert json.loads(path.read_text("utf-8"))["can_socket"] == "c"


def test_default_runtime_folder_of_the_user(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    assert current_folder().parent == Path(tempfile.gettempdir())
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert current_folder().parent == Path(tempfile.gettempdir())
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert current_folder() == tmp_path / "rigd"
