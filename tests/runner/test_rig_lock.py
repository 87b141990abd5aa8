"""Only one program at a time runs a rig."""

import os
import subprocess
import sys

import pytest

from rigd.runtime.locks import RigBusyError, RigLock


def test_error_names_the_holder_of_the_rig(runtime_folder):
    with RigLock("antenna", "rigd serve", hardware=False):
        with pytest.raises(RigBusyError, match=rf"rigd serve, process {os.getpid()}"):
            RigLock("antenna", "rigd run", hardware=False).acquire()
        with RigLock("another", "rigd run", hardware=False):
            pass
    with RigLock("antenna", "rigd run", hardware=False):
        pass


def test_simulated_rigs_have_one_lock_except_with_a_daemon(runtime_folder):
    with (
        RigLock("sim", "rigd run", hardware=False, exclusive=False),
        RigLock("sim", "rigd run", hardware=False, exclusive=False),
        pytest.raises(RigBusyError),
    ):
        RigLock("sim", "rigd serve", hardware=False).acquire()
    with (
        RigLock("sim", "rigd serve", hardware=False),
        pytest.raises(RigBusyError, match="rigd start"),
    ):
        RigLock("sim", "rigd run", hardware=False, exclusive=False).acquire()


def test_hardware_is_locked_for_all_users_of_the_computer(runtime_folder, monkeypatch, tmp_path):
    monkeypatch.setattr("rigd.runtime.locks._COMMON_LOCK_FOLDER", tmp_path)
    with RigLock("antenna 1", "rigd serve", hardware=True):
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "another user's"))
        (path,) = tmp_path.iterdir()
        assert path.name == "rigd-rig-antenna-1.lock"
        assert path.stat().st_mode & 0o777 == 0o666
        with pytest.raises(RigBusyError):
            RigLock("antenna 1", "rigd run", hardware=True).acquire()
        with RigLock("antenna 1", "rigd run", hardware=False):
            pass


@pytest.mark.process
def test_unnamed_holder_of_a_lock_is_found_by_the_kernel(runtime_folder):
    with RigLock("antenna", "rigd run", hardware=False) as lock:
        path = lock._file.path
    path.write_text("rigd serve, process 1")
    code = "import fcntl, time; fcntl.flock(0, fcntl.LOCK_EX); print(1, flush=True); time.sleep(60)"
    with path.open() as stolen:
        process = subprocess.Popen(
            [sys.executable, "-c", code], stdin=stolen, stdout=subprocess.PIPE
        )
    try:
        assert process.stdout.readline() == b"1\n"
        with pytest.raises(RigBusyError, match=rf"process {process.pid} of user {os.getuid()}\b"):
            RigLock("antenna", "rigd run", hardware=False).acquire()
    finally:
        process.kill()
        process.communicate()


def test_error_names_an_unusable_folder(monkeypatch, tmp_path):
    (tmp_path / "rigd").write_text("where the folder should be")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(RigBusyError, match="XDG_RUNTIME_DIR"):
        RigLock("antenna", "rigd run", hardware=False).acquire()
