"""The live view of a rig from the supervisor's side: start, address, restarts, and their limit."""

import os
import resource
import signal
from types import SimpleNamespace

import numpy as np
import pytest
from processes import eventually

from rigd.engine.shared_state import StateField
from rigd.excitation import make_excitation
from rigd.live.address import find
from rigd.profile import load_profile
from rigd.runner import Rig
from rigd.runner import _live_view as live_view
from rigd.runner.request import SessionOrder
from rigd.runner.session import SessionFailedError
from rigd.runtime import StopRequest
from rigd.session import read_session

pytestmark = pytest.mark.process


@pytest.fixture
def profile(write_profile):
    return load_profile(str(write_profile("sim")))


@pytest.fixture
def rig(children_copied, profile, runtime_folder, monkeypatch):
    # The duration of the start depends on the machine, and is not tested here.
    monkeypatch.setattr(live_view, "_ADDRESS_TIMEOUT_S", 60.0)
    monkeypatch.setattr(live_view, "_SHOW_TIMEOUT_S", 60.0)
    rig = Rig(profile, uses_virtual_clock=True, with_live_view=True)
    rig.connect()
    yield rig
    rig.disconnect()


@pytest.fixture
def order(profile, tmp_path):
    """Return the order for a session."""

    def order(name: str, duration_s: float = 1.0) -> SessionOrder:
        excitation = make_excitation(
            "hold", {"duration_s": duration_s, "rest_s": 0.0}, profile.rig.rate_hz
        )
        return SessionOrder(profile, excitation, tmp_path / f"{name}.mcap")

    return order


@pytest.fixture
def run(rig, order):
    """Run a session under the virtual clock; return its result and its messages."""

    def run(name: str, duration_s: float = 1.0, meanwhile=lambda progress: None, stop=None):
        session_order = order(name, duration_s)
        stop = stop or StopRequest()
        messages = [rig.show_session(session_order, stop)]

        def watch(progress, events) -> None:
            messages.extend(event.message for event in events)
            meanwhile(progress)

        return rig.run(session_order, stop, watch), messages

    return run


def test_view_of_a_series_is_complete_and_restarted(rig, run, save):
    first, (message, *_) = run("first")
    view = rig.status().live_view
    assert message == f"Live view: {view.viewer_url}"
    assert view == find("sim")
    saver = save(view)
    second, (message, *_) = run("second")
    assert message == f"Live view: {view.viewer_url}"
    assert rig.status().live_view == view, "the same process, and the same server"
    assert (first.live_dropped, second.live_dropped) == (0, 0)
    assert eventually(saver.has_all)
    os.kill(view.pid, signal.SIGKILL)

    def replaced() -> bool:
        rig.check_control_process()
        return rig.status().live_view.pid != view.pid

    assert eventually(replaced)
    third, messages = run("third", 0.1)
    assert messages[0].startswith("Live view: http://127.0.0.1:")
    assert "The live process was killed by signal 9. It is restarted" in "\n".join(messages)
    assert (third.outcome, third.live_dropped) == ("complete", 0)
    rig.disconnect()
    assert find("sim") is None
    shown = [columns("/signals", "coupling_torque_nm") for columns in saver.recordings().values()]
    assert len(shown) == 2
    for result in (first, second):
        samples = read_session(result.path).samples
        assert any(
            np.array_equal(time_ns, samples["t_ns"])
            and np.allclose(torque_nm[:, 0], samples["coupling_torque_nm"], rtol=0.0, atol=1e-12)
            for time_ns, torque_nm in shown
        )


@pytest.mark.further  # as test_live_backlog.py
def test_counts_of_a_session_are_not_shown_in_the_next(rig, run, order):
    run("first")
    shared_state = rig._group.channels.shared_state
    assert shared_state[StateField.RECORD_MAY_START]
    rig.show_session(order("second"), StopRequest())
    assert shared_state[StateField.RECORD_MAY_START] == 0


@pytest.mark.further  # as a fault in test_live_state.py
def test_outcome_of_a_session_is_shown(rig, run, save):
    stop_at = StopRequest()

    def stop(progress) -> None:
        if progress.tick > 1000:
            stop_at.request()

    run("before")
    saver = save(rig.status().live_view)
    result, _ = run("stopped", 60.0, stop, stop_at)
    assert eventually(saver.has_all)
    rig.disconnect()
    logs = [columns("/events", "TextLog:text")[1] for columns in saver.recordings().values()]
    outcomes = [lines[-1].tolist() for lines in logs]
    assert [f"Outcome: {result.outcome}. {result.reason}"] in outcomes
    assert result.outcome == "stopped"
    assert "# STOPPED\n\nStopped by the operator." in [
        "\n".join(columns.sent("/state", "TextDocument:text")[1][-1][0].split("\n")[:3])
        for columns in saver.recordings().values()
    ]


@pytest.mark.further  # as a fault in test_live_state.py
def test_full_disk_is_shown_as_a_fault_with_its_reason(rig, run, save):
    run("before", 0.5)
    saver = save(rig.status().live_view)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Only the recorder writes a file, and it is started with the session.
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))
    try:
        with pytest.raises(SessionFailedError, match="cannot be written"):
            run("full", 60.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert eventually(saver.has_all)
    rig.disconnect()
    banners = [
        columns.sent("/state", "TextDocument:text")[1][-1][0]
        for columns in saver.recordings().values()
    ]
    assert [text for text in banners if text.startswith("# FAULT") and "cannot be written" in text]


@pytest.mark.slow
def test_repeatedly_killed_view_is_given_up_without_the_session(rig, run):
    killed = set()
    stop = StopRequest()
    given_up_at = None

    def kill(progress) -> None:
        nonlocal given_up_at
        for process in rig.status().processes:
            if process.name == "live" and process.state == "running":
                killed.add(process.pid)
                os.kill(process.pid, signal.SIGKILL)
        if rig.status().live_view is None:
            given_up_at = given_up_at or progress.tick
            if progress.tick > given_up_at + 5000:
                stop.request()

    result, messages = run("watched", 2000.0, kill, stop)  # for as long as it takes
    assert len(killed) == 4
    assert sum("It is restarted" in text for text in messages) == 3
    assert sum("It is not restarted" in text for text in messages) == 1
    assert result.outcome == "stopped"
    assert result.recorded == result.scheduled > given_up_at + 5000
    _, messages = run("next")
    assert messages[0].startswith("Live view: "), "a new session is a new chance"


class IdleGroup:
    """A group whose publisher exists and does nothing."""

    def __init__(self):
        self.channels = SimpleNamespace(specs=None, rings=())
        self.started = 0
        self.silent_s = 0.0
        self.on_poll = lambda: None

    def idle_process(self, process):
        self.started += 1

    def __getitem__(self, process):
        return SimpleNamespace(
            messages=lambda timeout_s: self.on_poll() or [],
            kill=lambda: None,
            send=lambda message: None,
        )

    def stalled_s(self, process):
        return self.silent_s


@pytest.mark.parametrize(("is_ready", "timeout_s"), [(False, 60.0), (True, 5.0)])
def test_starting_view_has_a_longer_timeout(is_ready, timeout_s):
    group = IdleGroup()
    view = live_view.LiveViewClient(group, "rig")
    view._is_ready = is_ready
    while group.started == 1:
        group.silent_s += 0.1
        view.check_heartbeat()
    assert group.silent_s == pytest.approx(timeout_s, abs=0.5)


def test_stop_is_not_delayed_by_a_missing_view(order):
    group, stop, polls = IdleGroup(), StopRequest(), []

    def poll():
        polls.append(1)
        if len(polls) == 3:
            stop.request()

    group.on_poll = poll
    view = live_view.LiveViewClient(group, "rig")
    assert view.show_session(order("held up"), stop).startswith("The live view is still starting")
    assert len(polls) == 4  # once more for what it shows
