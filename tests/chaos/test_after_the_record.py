"""A record remains complete whatever happens after its last tick."""

import os
import signal
from dataclasses import replace

import pytest
from shipped_profile import load_shipped

from rigd.engine import shared_memory_fd
from rigd.engine.channels import DESCRIPTOR_COUNT, create_channels
from rigd.engine.messages import FileHeader
from rigd.engine.recorder import Recorder
from rigd.engine.shared_state import Phase, StateField
from rigd.excitation import hold
from rigd.runner import Rig
from rigd.runner.request import SessionOrder
from rigd.runtime import StopRequest
from rigd.session import SessionWriter, read_session
from rigd.session.layout import pack_sample_into


@pytest.fixture
def channels():
    descriptors = [shared_memory_fd() for _ in range(DESCRIPTOR_COUNT)]
    channels = create_channels(1000.0, descriptors)
    yield channels
    channels.close()
    for descriptor in descriptors:
        os.close(descriptor)


@pytest.mark.parametrize(
    ("ticks", "outcome", "reason"),
    [
        (300, "complete", "After the record: The supervising process ended."),
        (299, "fault", "The supervising process ended during the session."),
    ],
)
def test_recorder_alone_recognises_a_whole_record(channels, tmp_path, ticks, outcome, reason):
    shared_state, ring = channels.shared_state, channels.samples
    recorder = Recorder(channels, SessionWriter(tmp_path / "alone.mcap"))
    segments = {"rest": (0, 100), "sweep": (100, 300)}
    recorder.header = FileHeader({"rate_hz": "1000.0"}, segments, attachments={})
    for tick in range(ticks):
        pack_sample_into(ring.buffer, ring.next_slot(), tick * 10**6, tick, *[0.0] * 10, 0, 0, 0)
        ring.publish()
    shared_state[StateField.START_UTC_NS] = 10**18
    shared_state[StateField.SCHEDULED_TICKS] = ticks
    shared_state[StateField.PHASE] = Phase.OFF
    recorder.close_without_supervisor()  # which finds all of it in the rings
    session = read_session(tmp_path / "alone.mcap")
    assert len(session.samples) == ticks
    assert session.outcome["outcome"] == outcome
    assert session.outcome["reason"] == reason
    assert session.outcome["scheduled"] == session.outcome["recorded"] == str(ticks)


@pytest.mark.process
@pytest.mark.usefixtures("children_copied")
def test_whole_record_if_control_process_dies_while_returning(tmp_path):
    profile = load_shipped("sim")
    profile = replace(profile, session=replace(profile.session, tare_s=0.5, return_s=60.0))
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=0.3, rest_s=0.1, ring_down_s=0.0)
    rig = Rig(profile, uses_virtual_clock=True)

    def listener(progress, events):
        control = next(p for p in rig.status().processes if p.name == "control")
        if progress.phase is Phase.RETURNING and control.state != "ended":
            os.kill(control.pid, signal.SIGKILL)

    try:
        rig.connect()
        result = rig.run(
            SessionOrder(profile, excitation, tmp_path / "a.mcap"), StopRequest(), listener
        )
    finally:
        rig.disconnect()
    assert result.outcome == "complete"
    assert result.reason == (
        "After the record: The control process was killed by signal 9. Without its heartbeat, the "
        "watchdog of the drive must switch the torque off, which nothing confirms: press the wired "
        "stop (STO) before anybody approaches."
    )
    assert not result.is_successful
    assert result.scheduled == 400 == result.recorded
    assert read_session(result.path).outcome["outcome"] == "complete"
