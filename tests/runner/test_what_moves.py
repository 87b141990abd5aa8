"""The moving target is stated before motion, and an unreachable simulation blocks the hardware."""

import os
import socket
from contextlib import contextmanager

import pytest

from rigd.devices import ActuationTarget, describe_actuation_target
from rigd.devices.running_simulator import unreachable_simulator_sockets
from rigd.runner.planning import RefusedError
from rigd.runner.request import load_rig


@pytest.fixture
def profile(write_profile):
    """A profile whose name nobody else on this computer simulates."""
    return write_profile("antenna_can", {"name": f'"out_of_reach_{os.getpid()}"'})


@contextmanager
def listening(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen(1)
        yield path


def test_description_of_hardware_and_simulation(profile, runtime_folder):
    loaded, moving = load_rig(profile)
    assert moving is ActuationTarget.HARDWARE
    assert describe_actuation_target(loaded.rig, moving).startswith(
        f"HARDWARE: {loaded.name} moves the drive on "
    )
    assert "node" in describe_actuation_target(loaded.rig, moving)
    assert describe_actuation_target(loaded.rig, ActuationTarget.LOCK_STEP).startswith(
        "No hardware: "
    )


@pytest.mark.process
def test_no_hardware_motion_with_a_simulation_elsewhere(
    profile, start_simulator, runtime_folder, monkeypatch, tmp_path
):
    """As with sudo, cron or ssh, which have another runtime folder or none."""
    process = start_simulator(profile)
    assert load_rig(profile)[1] is ActuationTarget.SIMULATOR
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(RefusedError, match=rf"XDG_RUNTIME_DIR={runtime_folder} .*--hardware"):
        load_rig(profile)
    assert load_rig(profile, force_hardware=True)[1] is ActuationTarget.HARDWARE
    process.terminate()
    process.wait()
    assert load_rig(profile)[1] is ActuationTarget.HARDWARE


def test_no_hardware_motion_with_a_simulation_of_another_user(profile, runtime_folder):
    name = profile.stem
    with listening(runtime_folder / "elsewhere" / f"{name}.control") as path:
        if os.getuid():
            pytest.skip("only root can give a socket away")
        os.chown(path, 12345, 12345)
        assert unreachable_simulator_sockets(name) == [path]
        with pytest.raises(RefusedError, match=r"by user 12345 .*--hardware"):
            load_rig(profile)
    assert unreachable_simulator_sockets(name) == []


def test_sockets_with_control_characters_in_their_names(profile, runtime_folder):
    """Any user can make one, and the kernel lists its name unchanged, with line breaks."""
    for name in ("a\n1: 2 3 xyz 5 6 7 /8", "b\n1 2 3 xyz 5 6 7 8", "c\x0b1 2 3 xyz 5 6 7 8"):
        with listening(runtime_folder / name):
            assert load_rig(profile)[1] is ActuationTarget.HARDWARE
    with (
        listening(runtime_folder / "\x1b]0;gone\x07" / f"{profile.stem}.control"),
        pytest.raises(RefusedError, match="A simulated rig of") as refused,
    ):
        load_rig(profile)
    assert "\x1b" not in str(refused.value)


def test_other_and_dead_simulated_rigs_are_ignored(profile, runtime_folder):
    with listening(runtime_folder / "rigd" / f"other_{profile.stem}.control"):
        assert load_rig(profile)[1] is ActuationTarget.HARDWARE
    with socket.socket(socket.AF_UNIX) as bound:  # nobody listens there
        bound.bind(str(runtime_folder / "rigd" / f"{profile.stem}.control"))
        assert load_rig(profile)[1] is ActuationTarget.HARDWARE


@pytest.mark.process
def test_error_if_hardware_is_requested_for_a_simulated_rig(start_simulator, profile):
    with pytest.raises(RefusedError, match="--hardware: No hardware: sim is simulated"):
        load_rig("sim", force_hardware=True)
    start_simulator(profile)
    with pytest.raises(RefusedError, match=r"--hardware: .*by the clock"):
        load_rig(profile, force_hardware=True)
