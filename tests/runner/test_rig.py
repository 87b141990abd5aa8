"""A rig in its own processes, without the command line: connected once, and then used."""

import gc
import os
import signal
import time
from pathlib import Path

import pytest
from processes import children, eventually
from shipped_profile import load_shipped

from rigd.engine.shared_state import Phase
from rigd.excitation import hold
from rigd.runner import Rig, RigError, RigStoppedError
from rigd.runner.request import SessionOrder
from rigd.runner.session import SessionFailedError
from rigd.runtime import StopRequest
from rigd.session import read_session

pytestmark = [pytest.mark.process, pytest.mark.usefixtures("children_copied")]


@pytest.fixture
def profile():
    return load_shipped("sim")


@pytest.fixture
def rig(profile):
    rig = Rig(profile, uses_virtual_clock=True)
    rig.connect()
    yield rig
    rig.disconnect()


@pytest.fixture
def run(profile, tmp_path):
    """Run a short session."""
    number = iter(range(100))

    def run(rig, *, stop=None, listener=lambda *_: None, duration_s=1.0):
        excitation = hold(
            rate_hz=profile.rig.rate_hz, duration_s=duration_s, rest_s=0.2, ring_down_s=0.0
        )
        order = SessionOrder(profile, excitation, tmp_path / f"{next(number)}.mcap")
        return rig.run(order, stop or StopRequest(), listener)

    return run


def descriptors() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def test_disconnected_rig_leaves_no_processes_and_descriptors(profile, run):
    gc.collect()  # objects of other tests: their descriptors would be closed later
    before = set(children(os.getpid())), descriptors()
    rig = Rig(profile, uses_virtual_clock=True)
    assert rig.status() is None
    rig.connect()
    assert run(rig).is_successful
    assert run(rig).is_successful
    rig.disconnect()
    rig.disconnect()
    assert rig.status() is None
    assert set(children(os.getpid())) <= before[0]
    assert descriptors() <= before[1]


def test_status_has_every_process_and_topic(rig, run):
    first = rig.status()
    assert first.phase is Phase.OFF
    assert first.torque_command_nm == 0.0
    assert {p.name: p.state for p in first.processes} == {
        "control": "running", "recorder": "waiting", "supervisor": "running",
    }  # fmt: skip
    result = run(rig)
    second = rig.status()
    written = {topic.name: topic.written for topic in second.topics}
    assert written["/rig/sample"] == result.recorded == 1200
    assert written["/rig/control"] == 120
    assert written["/rig/timing"] == 0  # under the virtual clock
    assert {topic.name: topic.expected_hz for topic in second.topics} == {
        "/rig/event": None, "/rig/control": 100.0, "/rig/timing": 1000.0, "/rig/sample": 1000.0,
    }  # fmt: skip
    assert all(topic.waiting == 0 for topic in second.topics)
    assert (second.tick, second.missed, second.lost) == (1200, 0, 0)


@pytest.mark.further  # as in the daemon's service
def test_tare_and_zero_between_sessions(rig, run):
    run(rig)
    tare = rig.tare()
    assert set(tare) == {"mean", "std", "torque_std_nm"}
    assert abs(rig.zero()["moved_rad"]) < 1e-2
    assert rig.status().angle_rad == 0.0
    assert run(rig).is_successful


@pytest.mark.further  # as in the service
def test_progress_of_a_session_begins_at_zero(rig, run):
    run(rig)
    ticks = []
    run(rig, listener=lambda progress, _: ticks.append(progress.tick))
    assert ticks == sorted(ticks)
    assert ticks[0] == 0


def test_zero_is_lost_with_the_connection(rig, run):
    rig.zero()
    rig.disconnect()
    with pytest.raises(RigError, match="not connected"):
        run(rig)
    rig.connect()
    with pytest.raises(RigError, match="rigd zero"):
        run(rig)
    rig.zero()
    assert run(rig).is_successful


def test_death_of_the_control_process_is_noticed(rig):
    rig.check_control_process()
    (control,) = (p for p in rig.status().processes if p.name == "control")
    os.kill(control.pid, signal.SIGKILL)
    deadline = time.monotonic() + 10.0
    with pytest.raises(RigError, match="killed by signal 9"):
        while time.monotonic() < deadline:
            rig.check_control_process()
            time.sleep(0.01)
    assert not rig.connected


def test_hanging_control_process_is_killed_at_a_stop(rig, run, monkeypatch):
    monkeypatch.setattr("rigd.runner.session._DRIVE_TIMEOUT_S", 0.3)  # under the virtual clock
    stop = StopRequest()

    def listener(progress, events):
        if progress.phase is Phase.RUNNING and not stop.requested:
            (control,) = (p for p in rig.status().processes if p.name == "control")
            os.kill(control.pid, signal.SIGSTOP)
            stop.request()

    result = run(rig, stop=stop, listener=listener, duration_s=100.0)
    assert (result.outcome, result.fault) == ("fault", True)  # although a stop was requested
    assert "did not stop within 0.3 s and was killed" in result.reason
    assert len(read_session(result.path).samples) == result.recorded


def test_file_created_meanwhile_is_not_overwritten(rig, run, tmp_path):
    def listener(progress, events):
        if progress.phase is Phase.RUNNING:
            (tmp_path / "0.mcap").write_text("somebody else's")

    # So long that the listener is called while it runs, whatever the load.
    with pytest.raises(SessionFailedError, match="not overwritten"):
        run(rig, listener=listener, duration_s=100.0)
    assert (tmp_path / "0.mcap").read_text() == "somebody else's"
    assert (tmp_path / "0.mcap.part").exists()


@pytest.mark.further  # as in the daemon's service
def test_stop_ends_only_one_session(rig, run, tmp_path):
    stop = StopRequest()

    def listener(progress, events):
        if progress.phase is Phase.RUNNING:
            stop.request()

    stopped = run(rig, stop=stop, listener=listener, duration_s=100.0)
    assert stopped.outcome == "stopped"
    assert stopped.scheduled == stopped.recorded + stopped.missed + stopped.lost < 100_200
    after = run(rig)
    assert after.is_successful
    assert read_session(after.path).samples["tick"].tolist() == list(range(1200))


def test_death_of_the_recorder_ends_only_its_session(rig, run, tmp_path):
    def listener(progress, events):
        if progress.phase is Phase.RUNNING:
            (recorder,) = (p for p in rig.status().processes if p.name == "recorder")
            if recorder.state != "ended":
                os.kill(recorder.pid, signal.SIGKILL)

    with pytest.raises(SessionFailedError, match="killed by signal 9") as caught:
        run(rig, listener=listener, duration_s=100.0)
    result = caught.value.result()
    assert (result.outcome, result.fault, result.path) == ("fault", True, None)
    assert result.part == tmp_path / "0.mcap.part"
    assert 0 < result.scheduled < 100_200
    assert result.as_dict()["recorded"] is None
    (tmp_path / "0.mcap").touch()  # completed by a slow recorder, or another's file
    assert caught.value.result().path is None
    result.part.unlink()
    assert caught.value.result().path == tmp_path / "0.mcap"
    assert rig.status().phase is Phase.OFF
    assert run(rig).is_successful


def test_death_of_the_control_process_in_a_probing_move_asks_for_the_wired_stop(rig, profile):
    rig._group.control.kill()
    with pytest.raises(RigError, match=r"killed by signal 9.*press the wired stop \(STO\)"):
        rig.probe(profile, StopRequest())
    assert not rig.connected


def test_probing_move_ended_by_a_stop_signal(rig, profile):
    control = rig._group.control
    os.kill(control.pid, signal.SIGINT)
    assert eventually(lambda: not control.running)
    with pytest.raises(RigStoppedError):
        rig.probe(profile, StopRequest())
    assert not rig.connected
