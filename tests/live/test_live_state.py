"""The overview shows the state of a session and its reason within a second."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from processes import eventually

from rigd.beam import Beam
from rigd.engine.shared_state import Phase, StateField, StopReason
from rigd.live.messages import LiveSession
from rigd.live.publisher import SessionStateReader, last_response
from rigd.view import SessionDescription
from rigd.view.banner import (
    FINISHING,
    RETURNING,
    RUNNING,
    STOPPING,
    SUPERVISOR_SILENT,
    SUPERVISOR_SILENT_TORQUE_OFF,
    preparing_state,
)
from rigd.view.frequency_charts import LastResponse

pytestmark = pytest.mark.process

PERIOD_S = 1 / 15
"""Period at which a publisher with a session reads the shared state."""


def test_every_state_of_a_session_in_the_shared_state(channels):
    shared_state, states = channels.shared_state, SessionStateReader(channels)

    def state(**words):
        for name, value in words.items():
            shared_state[StateField[name]] = value
        shared_state.beat(StateField.SUPERVISOR_BEAT)
        return states.read(0.0)

    assert state(PHASE=Phase.OFF) == preparing_state()
    assert state(PHASE=Phase.TARING) == preparing_state("Taring.")
    assert state(PHASE=Phase.WAITING) == preparing_state("Waiting for the beam to rest.")
    assert state(PHASE=Phase.READY, RECORD_MAY_START=1) == preparing_state("Ready.")
    assert state(PHASE=Phase.RUNNING) == RUNNING
    assert state(STOP_REASON=StopReason.OPERATOR) == STOPPING
    assert state(STOP_REASON=StopReason.NONE, PHASE=Phase.RETURNING) == RETURNING
    assert state(PHASE=Phase.OFF) == FINISHING


def test_hanging_supervisor_is_reported_within_a_second(channels):
    shared_state, states, now_s = channels.shared_state, SessionStateReader(channels), 100.0
    shared_state[StateField.RECORD_MAY_START], shared_state[StateField.PHASE] = 1, Phase.RUNNING
    for _ in range(100):
        now_s += PERIOD_S
        shared_state.beat(StateField.SUPERVISOR_BEAT)
        assert states.read(now_s) == RUNNING
    hung_s = now_s
    while states.read(now_s) != SUPERVISOR_SILENT:
        now_s += PERIOD_S
    assert now_s - hung_s < 0.8
    shared_state.beat(StateField.SUPERVISOR_BEAT)
    assert states.read(now_s + PERIOD_S) == RUNNING
    shared_state[StateField.PHASE] = Phase.OFF
    for _ in range(20):
        now_s += PERIOD_S
        state = states.read(now_s)
    assert state == SUPERVISOR_SILENT_TORQUE_OFF
    shared_state[StateField.RECORD_MAY_START] = 0  # before a record the supervisor may be silent
    assert states.read(now_s + PERIOD_S) == preparing_state()


def words(columns) -> list[str]:
    """Return the headings of the banner, in the order of their times."""
    _, texts = columns.sent("/state", "TextDocument:text")
    found = [text.split("\n")[0].removeprefix("# ").split(" · ")[0] for (text,) in texts]
    return [word for i, word in enumerate(found) if i == 0 or word != found[i - 1]]


def first_sent_s(columns, word: str) -> float:
    times_s, texts = columns.sent("/state", "TextDocument:text")
    return min(s for s, (text,) in zip(times_s, texts, strict=True) if text.startswith(f"# {word}"))


@pytest.mark.further  # as by the shared state, and in the received recordings
def test_running_and_fault_are_shown_within_a_second(publisher, producer, receive):
    shared_state, sent_s = producer.channels.shared_state, {"RUNNING": [], "FAULT": []}
    received = receive(publisher)
    for number in range(3):  # other load on this computer only makes it slower
        begins = tuple(ring.written_count for ring in producer.channels.rings)
        publisher.show(f"session {number}", begins)
        sent_s["RUNNING"].append(time.time())
        shared_state[StateField.PHASE] = Phase.RUNNING
        time.sleep(0.5)
        sent_s["FAULT"].append(time.time())
        publisher.finish("fault", "The drive was lost.")
        time.sleep(0.3)
    recordings = received()
    for word, times_s in sent_s.items():
        delays_s = [
            first_sent_s(recordings[f"recording of session {number}"], word) - event_s
            for number, event_s in enumerate(times_s)
        ]
        assert min(delays_s) < 1.0, (word, delays_s)
    shown = recordings["recording of session 0"]
    assert words(shown)[-2:] == ["RUNNING", "FAULT"]
    _, texts = shown.sent("/state", "TextDocument:text")
    assert "The drive was lost." in texts[-1][0]


def test_end_of_a_session_is_shown_with_its_reason(received):
    shown = received["fault"]
    assert words(shown)[-2:] == ["RUNNING", "FAULT"]
    _, texts = shown.sent("/state", "TextDocument:text")
    assert "The drive was lost." in texts[-1][0]


def assert_supervisor_lost(columns, *, off):
    assert words(columns)[-1] == "SUPERVISOR LOST"
    _, texts = columns.sent("/state", "TextDocument:text")
    assert ("the torque is off." in texts[-1][0]) is off
    _, lines = columns("/events", "TextLog:text")
    assert lines[-1][0].startswith("The supervising process ended")


def test_lost_supervisor_is_reported(received):
    assert_supervisor_lost(received["lost"], off=False)


@pytest.mark.further
def test_lost_supervisor_is_reported_with_the_torque_off(producer, start_publisher, save):
    publisher = start_publisher(
        first="from rigd.live import publisher as p; p._MAX_ORPHANED_SESSION_S = 0.5"
    )
    shared_state = producer.channels.shared_state
    shared_state[StateField.PHASE] = Phase.RUNNING
    saver = save(publisher.address)
    assert eventually(saver.has_begun)
    shared_state[StateField.PHASE] = Phase.OFF
    publisher.end()
    (columns,) = saver.recordings().values()
    assert_supervisor_lost(columns, off=True)


# Response of the last session


def write_quick_look(folder: Path, name: str, specimen: str | None, magnitude: float = 2.0) -> None:
    response = {
        "frequency_hz": [1.0, 2.0], "magnitude": [magnitude, 1.0], "phase_rad": [np.pi, 0.0]
    }  # fmt: skip
    start_utc_ns = int(name.partition("-")[2][:6])
    document = {"version": 1, "specimen": specimen, "response": response}
    text = json.dumps(document | {"start_utc_ns": start_utc_ns})
    (folder / f"{name}.look.json").write_text(text)


def computed_response(session: str, specimen: str) -> LastResponse:
    return LastResponse(session, specimen, np.array([1.0]), np.array([5.0 + 0j]))


def live_session(folder: Path | None, specimen: str) -> LiveSession:
    beam = Beam(length_m=0.5, density_kg_per_m=0.047, bending_stiffness_n_m2=0.2)
    description = SessionDescription(
        "20261122-120000-chirp", 1000.0, 10, (0, 10), beam, None, specimen=specimen
    )
    return LiveSession(description, "id", (0,), folder)


def test_newest_quick_look_of_the_specimen_is_used(tmp_path):
    write_quick_look(tmp_path, "20261122-100000-chirp", "A", magnitude=1.0)
    write_quick_look(tmp_path, "20261122-110000-chirp", "A", magnitude=3.0)
    write_quick_look(tmp_path, "20261122-113000-chirp", "B")
    write_quick_look(tmp_path, "20261122-114000-chirp", None)
    (tmp_path / "20261122-115000-chirp.look.json").write_text("{")
    found = last_response(live_session(tmp_path, "A"), None)
    assert found.session == "20261122-110000-chirp"
    assert found.frequency_hz.tolist() == [1.0, 2.0]
    assert found.response == pytest.approx([-3.0, 1.0])
    assert last_response(live_session(tmp_path, ""), None).session == "20261122-114000-chirp"
    assert last_response(live_session(tmp_path, "C"), None) is None


def test_computed_response_replaces_a_missing_quick_look(tmp_path):
    write_quick_look(tmp_path, "20261122-100000-chirp", "A")
    later, earlier = (
        computed_response("20261122-113000-chirp", "A"),
        computed_response("20261122-090000-chirp", "A"),
    )
    assert last_response(live_session(tmp_path, "A"), later) is later
    assert last_response(live_session(tmp_path, "A"), earlier).session == "20261122-100000-chirp"
    assert last_response(live_session(None, "A"), earlier) is earlier
    assert last_response(live_session(None, "B"), later) is None
