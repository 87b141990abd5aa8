"""Result of a session for its operator, after the end of the loop."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from shipped_profile import load_shipped

from rigd.engine.messages import DevicesConnected, FileClosed, SessionFinished
from rigd.excitation import hold
from rigd.runner.request import SessionOrder
from rigd.runner.session import SessionFailedError, SessionSupervisor, can_always_receive_stop

KILLED = "The fit process was killed by signal 9."
STOPPED = "Stopped by the operator."
COUNTS = {"scheduled": 1200, "missed": 0, "late": 0, "stale_angles": 0, "stale_wrenches": 0}


@pytest.fixture
def close():
    """Close a session with or without a failed fit process, and with or without a file."""

    def close_session(finished, failure, unmet_reason="", *, recorded=True, slow=lambda poll: poll):
        profile = load_shipped("sim")
        order = SessionOrder(profile, hold(rate_hz=1000.0, duration_s=1.0), Path("a.mcap"))
        group = MagicMock()
        group.channels.shared_state.__getitem__.return_value = 0
        group.channels.events = MagicMock(
            oldest_index=0, written_count=0, capacity=16, record_size=1, buffer=bytes(1000)
        )
        connected = DevicesConnected({}, {}, {"clock": "virtual"}, simulated=True)
        session = SessionSupervisor(
            order, group, connected, None, lambda *_: None, can_always_receive_stop
        )
        session._fit = MagicMock(search_failure=failure, unmet_reason=unmet_reason, segments={})
        session._fit.finish.return_value = {}
        session._fit.poll.return_value = []

        def poll(_):
            (message,) = group.recorder.send.call_args.args
            outcome = message.outcome
            if not recorded:
                return FileClosed()
            return FileClosed(order.path, COUNTS, outcome["outcome"], outcome["reason"])

        group.recorder.poll.side_effect = slow(poll)
        return session._close(finished)

    return close_session


@pytest.mark.parametrize("recorded", [True, False])
def test_stop_does_not_hide_the_reason_of_the_end(close, recorded):
    stopped = SessionFinished("stopped", STOPPED, fault=False, counts=COUNTS)
    result = close(stopped, KILLED, recorded=recorded)
    assert (result.outcome, result.fault) == ("stopped", True)
    assert result.reason == f"{KILLED} {STOPPED}"
    plain = close(stopped, "", recorded=recorded)
    assert (plain.reason, plain.fault) == (STOPPED, False)


def test_reason_of_a_complete_record_is_stated_once(close):
    complete = SessionFinished("complete", "", fault=False, counts=COUNTS)
    result = close(complete, KILLED, f"Not known whether the whole record has it: {KILLED}")
    assert result.reason.count(KILLED) == 1
    later = replace(complete, reason="After the record: The tare drifted.", fault=True)
    result = close(later, KILLED, "unused")
    assert result.reason == f"{KILLED} After the record: The tare drifted."


@pytest.mark.parametrize(("stall_s", "whole"), [(11.9, True), (60.0, False)])
def test_allowed_stall_of_the_disk_at_the_end(close, monkeypatch, stall_s, whole):
    now_s = 0.0

    def poll(answer):
        def polled(patience_s):
            nonlocal now_s
            now_s += 10 * patience_s
            return answer(patience_s) if now_s > stall_s else None

        return polled

    monkeypatch.setattr("rigd.runner.session.time.monotonic", lambda: now_s)
    complete = SessionFinished("complete", "", fault=False, counts=COUNTS)
    if whole:
        assert close(complete, "", slow=poll).outcome == "complete"
    else:
        with pytest.raises(SessionFailedError, match="does not answer within 22 s"):
            close(complete, "", slow=poll)
