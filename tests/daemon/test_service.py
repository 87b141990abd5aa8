"""The daemon's logic on a rig in this process: commands, states, control, and failures."""

import asyncio
import json
import re

import pytest
from cases import further
from operated_daemons import CommandError, Peer, parse_request, printed_status, shown_status
from processes import eventually

from rigd.devices import ActuationTarget
from rigd.devices.contracts import DeviceError, LineHealth
from rigd.engine.processes import ChildError
from rigd.engine.shared_state import StateField
from rigd.session import read_session
from rigd.view._recorded import describe_recorded_session

SHORT = {
    "excitation": "hold",
    "parameters": {"duration_s": 0.3, "rest_s": 0.0, "ring_down_s": 0.0},
}
OTHER = Peer(2, 200, 0)


def fail(drive):
    raise DeviceError("The drive is gone.")


def fall_silent(drive):
    drive.inner.angle_stale = True


def transitions(operated):
    return [(e["from"], e["to"]) for e in operated.events if e["event"] == "state"]


def test_session_runs_from_ready_to_ready(operated, tmp_path):
    assert operated.state == "ready"
    reply = operated.request("start", **SHORT, notes={"operator": "Ada"})
    assert reply["plan"]["record_s"] == 0.3
    assert operated.state == "ready"
    assert transitions(operated) == [("idle", "ready"), ("ready", "running"), ("running", "ready")]
    (session,) = operated.last["sessions"]
    assert session["outcome"] == "complete"
    assert session["recorded"] == 300
    assert session["path"].startswith(str(tmp_path / "out"))
    assert not operated.last["failed"]
    assert operated.world.highest_nm > 0.0
    assert operated.world.drives[0].safe
    assert operated.world.wrong == []


SPECIMEN = """
[beam]
length_m = { value = 0.95, source = "measured" }
density_kg_per_m = { value = 4.7e-3, source = "paper" }
bending_stiffness_n_m2 = { value = 0.090275, source = "paper" }
[beam.damping]
alpha = { value = 1.0, source = "assumed" }
zeta = { value = 8.0e-5, source = "assumed" }
lambda = { value = 0.6, source = "assumed" }
gamma = { value = 5.0e-2, source = "assumed" }
"""


def test_file_has_specimen_metadata_and_predictions(operated, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "specimens").mkdir()
    (tmp_path / "specimens" / "antenna 4.toml").write_text(SPECIMEN)
    notes = {"specimen": "antenna 4", "meta": {"temperature_c": 21.4, "batch": "7"}}
    plan = operated.request("start", **SHORT, notes=notes)["plan"]
    assert "length 0.95 m (profile: 0.98)" in plan["specimen_in_words"]
    session = read_session(operated.last["sessions"][0]["path"])
    metadata = session.metadata
    assert (metadata["specimen"], metadata["beam_length_m"]) == ("antenna 4", "0.95")
    assert (metadata["meta_temperature_c"], metadata["meta_batch"]) == ("21.4", "7")
    assert session.number("predicted_peak_torque_nm") == plan["peak_torque_nm"]
    assert session.number("predicted_peak_tip_slope_rad") == plan["tip"]["slope_rad"]
    assert session.number("limit_torque_nm") == plan["limits"]["torque_nm"]
    assert session.attachments["specimen.toml"].decode() == SPECIMEN
    assert describe_recorded_session(session).damping.zeta == 8e-5
    # The next start names no specimen and has the profile's beam again.
    operated.request("start", **SHORT)
    session = read_session(operated.last["sessions"][0]["path"])
    assert session.metadata["beam_length_m"] == "0.98"
    assert "specimen.toml" not in session.attachments
    assert describe_recorded_session(session).damping.zeta == 7.1e-5
    (tmp_path / "specimens" / "antenna 4.toml").write_text("[beam]")
    refused = operated.request("start", **SHORT, notes=notes)
    assert str(refused) == "specimens/antenna 4.toml: section [beam] is missing."
    assert refused.wrong_use


@pytest.mark.further  # as tests/excitation/test_move_sessions.py
def test_move_from_the_current_angle(operated):
    brief = {"rest_s": 0.1, "ring_down_s": 0.1}
    reply = operated.request("start", excitation="move", parameters={"angle_rad": 0.05, **brief})
    assert "to 0.05 rad" in reply["plan"]["sweep"]
    assert operated.last["sessions"][0]["outcome"] == "complete"
    reply = operated.request("start", excitation="move", parameters={"by_rad": -0.08, **brief})
    assert reply["plan"]["parameters"]["by_rad"] == pytest.approx(-0.08)
    assert reply["plan"]["parameters"]["angle_rad"] == pytest.approx(-0.03, abs=1e-3)
    session = read_session(operated.last["sessions"][0]["path"])
    assert session.samples["angle_rad"][0] == pytest.approx(0.05, abs=1e-3)
    refused = operated.request("start", excitation="move", parameters={"angle_rad": -0.03, **brief})
    assert "already" in str(refused)
    assert refused.wrong_use
    predicted = operated.request("predict", excitation="move", parameters={"by_rad": 0.1, **brief})
    assert predicted["plan"]["parameters"]["angle_rad"] == pytest.approx(0.07, abs=1e-3)
    assert predicted["largest_amplitude_rad"] is None


def test_series_uses_one_connection_and_stops_at_first_failure(operated):
    operated.request("start", **SHORT, repeat=2)
    assert [s["outcome"] for s in operated.last["sessions"]] == ["complete", "complete"]
    assert len(operated.world.drives) == 1
    operated.world.countdown, operated.world.then = 1560, fail
    operated.request("start", **SHORT, repeat=3)
    assert [s["outcome"] for s in operated.last["sessions"]] == ["complete", "fault"]
    assert operated.last["failed"]
    assert operated.state == "fault"
    assert "The drive is gone." in operated.service.status()["reason"]


def test_any_client_can_stop_the_series(operated):
    def stop(drive):
        reply = operated.meanwhile("stop")
        assert reply == {"stopping": True}
        assert operated.state == "stopping"

    operated.world.countdown, operated.world.then = 500, stop
    operated.request("start", **SHORT, repeat=5)
    (session,) = operated.last["sessions"]
    assert session["outcome"] == "stopped"
    assert operated.last["stopped"]
    assert not operated.last["failed"]
    assert operated.state == "ready"
    assert ("stopping", "ready") in transitions(operated)
    assert operated.request("stop", peer=OTHER) == {"stopping": False}


def test_stop_between_two_sessions_is_stated(operated, monkeypatch):
    run = operated.rig.run

    def run_and_stop(*arguments):
        result = run(*arguments)
        operated.service.stop("stop requested by a test")
        return result

    monkeypatch.setattr(operated.rig, "run", run_and_stop)
    operated.request("start", **SHORT, repeat=3)
    assert [session["outcome"] for session in operated.last["sessions"]] == ["complete"]
    assert operated.last["reason"] == "Stopped after 1 of 3 sessions."
    assert (operated.last["failed"], operated.state) == (False, "ready")


def test_commands_not_allowed_in_a_state_are_refused(operated):
    refused = []

    def request_everything(drive):
        for command, fields in (("start", SHORT), ("tare", {}), ("zero", {}), ("reset", {})):
            refused.append(operated.meanwhile(command, **fields))

    operated.world.countdown, operated.world.then = 500, request_everything
    operated.request("start", **SHORT)
    assert len(refused) == 4
    assert all(isinstance(error, CommandError) for error in refused)
    assert all("running" in str(error) for error in refused)
    assert operated.last["sessions"][0]["outcome"] == "complete"
    assert isinstance(operated.request("reset"), CommandError)


def test_control_belongs_to_one_client_until_it_leaves(operated):
    operated.request("tare")
    refusal = operated.request("start", peer=OTHER, **SHORT)
    assert "controlled by process 100 of" in str(refusal)
    assert operated.service.status()["controller"]["pid"] == 100
    assert operated.request("status", peer=OTHER)["state"] == "ready"
    operated.service.release_control(OTHER)
    assert isinstance(operated.request("zero", peer=OTHER), CommandError)
    operated.service.release_control(operated.peer)
    assert "moved_rad" in operated.request("zero", peer=OTHER)


def test_disconnecting_client_stops_nothing(operated):
    def leave(drive):
        operated.service.release_control(operated.peer)

    operated.world.countdown, operated.world.then = 500, leave
    operated.request("start", **SHORT)
    assert operated.last["sessions"][0]["outcome"] == "complete"


def test_tare_and_zero_without_torque(operated):
    tare = operated.request("tare")
    assert set(tare["mean"]) == {"fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm"}
    assert operated.request("zero")["moved_rad"] == pytest.approx(0.0, abs=1e-3)
    assert operated.world.highest_nm == 0.0


def test_only_reset_leaves_a_fault(operated):
    operated.world.countdown, operated.world.then = 500, fail
    operated.request("start", **SHORT)
    assert operated.state == "fault"
    for command, fields in (("start", SHORT), ("tare", {}), ("zero", {})):
        refusal = operated.request(command, **fields)
        assert "rigd reset" in str(refusal)
    operated.watch()
    assert operated.state == "fault"
    operated.request("reset")
    assert operated.state == "ready"
    assert transitions(operated)[-2:] == [("fault", "idle"), ("idle", "ready")]
    _, *printed = re.findall(r"(\w+) → (\w+)", printed_status(operated.request("status")))
    assert printed == transitions(operated)[-4:]
    operated.request("start", **SHORT)
    assert operated.last["sessions"][0]["outcome"] == "complete"


def test_reset_after_a_limit_violation_retains_the_zero(operated):
    operated.request("zero")
    operated.world.countdown, operated.world.then = 500, fall_silent
    operated.request("start", **SHORT)
    assert operated.state == "fault"
    assert operated.rig.connected
    operated.world.drives[0].inner.angle_stale = False
    assert operated.request("reset") == {"zero_lost": False}
    assert transitions(operated)[-1] == ("fault", "ready")
    operated.request("start", **SHORT)
    assert operated.last["sessions"][0]["outcome"] == "complete"


def slip(drive):
    drive.offset_rad = 8000 * 7e-5


@pytest.mark.parametrize("when", ["ready", further("session")])
def test_encoder_jump_makes_the_zero_void(operated, when):
    """The limits are void too: nothing starts until the zero is set again."""
    operated.request("zero")
    if when == "ready":  # no time passes under the virtual clock until the next request
        slip(operated.world.drives[0])
    else:
        operated.world.countdown, operated.world.then = 1150, slip
    operated.request("start", **SHORT)
    assert operated.state == "fault"
    assert "encoder" in operated.last["reason"]
    assert "0.56 rad" in operated.last["reason"]
    assert "the zero" in operated.last["reason"]
    assert "rigd reset" in str(operated.request("start", **SHORT))
    assert operated.request("reset") == {"zero_lost": True}
    refusal = operated.request("start", **SHORT)
    assert isinstance(refusal, CommandError)
    assert "rigd zero" in str(refusal)
    operated.request("zero")
    operated.request("start", **SHORT)
    assert operated.last["sessions"][0]["outcome"] == "complete"


def test_encoder_jump_before_the_zero_is_reported(operated):
    slip(operated.world.drives[0])
    assert "The encoder jumped by 0.56 rad" in str(operated.request("zero"))
    assert operated.state == "fault"


def test_lost_zero_must_be_set_before_the_next_session(operated):
    operated.request("zero")
    operated.world.countdown, operated.world.then = 500, fail
    operated.request("start", **SHORT)
    assert operated.request("reset") == {"zero_lost": True}
    assert "rigd zero" in str(operated.request("start", **SHORT))
    assert operated.service.status()["zero_lost"]
    operated.request("zero")
    operated.request("start", **SHORT)
    assert operated.last["sessions"][0]["outcome"] == "complete"


@pytest.mark.parametrize("simulated", [False, True], ids=["hardware", "simulated"])
@pytest.mark.usefixtures("runtime_folder")
def test_zero_of_the_connection_is_lost_on_hardware_only(operate, simulated, monkeypatch):
    """The angle at another connection is a zero that nobody has chosen, also if none was set.

    The driver of the hardware cannot reset a fault, so that the reset only connects it again.
    """
    operated = operate()
    operated.world.simulated = simulated
    monkeypatch.setattr(
        "rigd.devices._fault_reset.open_devices", lambda rig, _: operated.world.open_devices(rig)
    )
    operated.open()
    assert not operated.service.status()["zero_lost"]
    operated.world.countdown, operated.world.then = 500, fail
    operated.request("start", **SHORT)
    assert operated.state == "fault"
    operated.world.absent = True
    assert "does not answer" in str(operated.request("reset"))
    operated.world.absent = False
    assert operated.request("reset") == {"zero_lost": not simulated}
    assert operated.service.status()["zero_lost"] is not simulated
    if not simulated:
        assert "rigd zero" in str(operated.request("start", **SHORT))
        operated.request("zero")
    operated.request("start", **SHORT)
    assert operated.last["sessions"][0]["outcome"] == "complete"


def test_failed_connection_is_a_fault_until_reset(operate):
    operated = operate()
    operated.world.absent = True
    operated.open()
    assert operated.state == "fault"
    assert "does not answer" in str(operated.request("reset"))
    assert operated.state == "fault"
    operated.world.absent = False
    operated.request("reset")
    assert operated.state == "ready"


def test_reset_does_not_replace_simulation_by_hardware(operated):
    operated.world.countdown, operated.world.then = 500, fail
    operated.request("start", **SHORT)
    operated.moving = ActuationTarget.HARDWARE
    assert "restart the daemon" in str(operated.request("reset"))
    assert operated.state == "fault"
    assert len(operated.world.drives) == 1


def test_death_of_control_process_between_two_sessions_reports_no_missing_file(
    operated, monkeypatch
):
    run, results = operated.rig.run, []

    def run_once(*arguments):
        if results:
            operated.rig._group.control.kill()
            operated.rig.check_control_process()
        results.append(run(*arguments))
        return results[-1]

    monkeypatch.setattr(operated.rig, "run", run_once)
    operated.request("start", **SHORT, repeat=2)
    assert [session["outcome"] for session in operated.last["sessions"]] == ["complete"]
    assert operated.last["failed"]
    assert "was killed" in operated.last["reason"]
    assert "file" not in operated.last["reason"]


@pytest.mark.parametrize("closing", [True, False])
def test_stop_signal_before_the_session_is_no_failure(operated, monkeypatch, closing):
    """The control process gets the signal before its order, alone or with the whole daemon."""
    run, closed = operated.rig.run, []

    def close():
        closed.append(operated.loop.create_task(operated.service.close("the daemon got SIGINT")))

    def signal_and_run(*arguments):
        if closing:
            operated.loop.call_soon_threadsafe(close)
            assert eventually(lambda: closed)
        operated.rig._group.control.stop()
        return run(*arguments)

    monkeypatch.setattr(operated.rig, "run", signal_and_run)
    operated.request("start", **SHORT, repeat=2)
    (session,) = operated.last["sessions"]
    assert (session["outcome"], session["path"]) == ("stopped", None)
    assert (operated.last["stopped"], operated.last["failed"]) == (True, False)
    if closing:
        operated.loop.run_until_complete(closed[0])
    assert operated.state == ("idle" if closing else "fault")
    if not closing:
        assert operated.service.status()["reason"] == "The control process was asked to end."


def test_death_of_control_process_between_sessions_is_a_fault(operated):
    operated.rig._group.control.kill()
    for _ in range(100):
        operated.watch()
        if operated.state == "fault":
            break
    assert operated.state == "fault"
    assert "killed by signal 9" in operated.service.status()["reason"]


def test_fault_after_a_stop_request_is_a_fault(operated):
    def stop_and_jump(drive):
        operated.meanwhile("stop")
        drive.offset_rad = 3.0

    operated.world.countdown, operated.world.then = 1500, stop_and_jump
    operated.request("start", excitation="hold", parameters={"duration_s": 5.0})
    assert operated.last["stopped"]
    assert operated.last["failed"]
    assert operated.state == "fault"
    assert operated.last["sessions"][0]["outcome"] == "fault"


def test_report_of_a_dead_recorder_names_the_partial_file(operated):
    operated.world.countdown = 1500
    operated.world.then = lambda _: operated.rig._group.recorder.kill()
    operated.request("start", excitation="hold", parameters={"duration_s": 5.0})
    assert operated.state == "fault"
    for words in ("killed by signal 9", "drive is disabled", "rigd recover"):
        assert words in operated.last["reason"]
    (session,) = operated.last["sessions"]
    assert (session["outcome"], session["path"], session["recorded"]) == ("fault", None, None)
    assert session["part"].endswith(".mcap.part")
    assert session["scheduled"] > 0
    (event_of_session,) = (event for event in operated.events if event["event"] == "session")
    assert event_of_session.items() >= session.items()


def test_doubt_about_disabled_drive_is_reported_with_other_failures(operated):
    doubt = "Drive: it does not show that it is off; check that it is, by its STO if need be."

    def fail_both(drive):
        drive.off_doubt = doubt
        operated.rig._group.recorder.kill()

    operated.world.countdown, operated.world.then = 1500, fail_both
    operated.request("start", excitation="hold", parameters={"duration_s": 5.0})
    assert operated.state == "fault"
    reason = operated.last["reason"]
    for words in ("killed by signal 9", doubt, "rigd recover"):
        assert words in reason
    assert "is disabled" not in reason


def test_start_beyond_the_limits_is_refused_before_motion(operated):
    refusal = operated.request(
        "start", excitation="step", parameters={"amplitude_rad": 3.0, "duration_s": 1.0}
    )
    assert refusal.wrong_use
    assert "limits.angle_rad" in str(refusal)
    assert operated.state == "ready"
    assert operated.world.highest_nm == 0.0


@pytest.mark.parametrize("name", ["missing.csv", "/dev/zero"])
def test_only_regular_files_are_read(operated, tmp_path, name):
    refusal = operated.request(
        "start", excitation="file", parameters={"path": str(tmp_path / name)}
    )
    assert refusal.wrong_use
    assert name in str(refusal)


def test_start_is_refused_if_no_file_can_be_created(operated, tmp_path):
    (tmp_path / "out").write_text("in the way")
    refusal = operated.request("start", **SHORT)
    assert "cannot be created" in str(refusal)
    assert not refusal.wrong_use  # the same request may succeed later
    assert operated.state == "ready"


def test_unwritable_folder_ends_the_series_as_a_fault(operated, tmp_path):
    def take_away(drive):
        (tmp_path / "out").rename(tmp_path / "gone")
        (tmp_path / "out").write_text("in the way")

    operated.world.countdown, operated.world.then = 1250, take_away
    operated.request("start", **SHORT, repeat=2)
    assert operated.last["failed"]
    assert operated.world.drives[0].safe


def test_unexpected_error_ends_with_everything_off(operated, monkeypatch):
    def raise_error(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(operated.rig, "run", raise_error)
    operated.request("start", **SHORT)
    assert operated.state == "fault"
    assert not operated.rig.connected
    assert "ZeroDivisionError" in operated.last["reason"]


def test_session_completes_though_its_signals_fail(operated, monkeypatch):
    monkeypatch.setattr(operated.rig, "signals", lambda: 1 / 0)
    operated.service._signal_watchers.add(operated.peer)
    operated.request("start", **SHORT)
    assert operated.state == "ready"
    assert operated.last["sessions"][0]["outcome"] == "complete"


def test_unexpected_error_while_connecting_can_be_reset(operate, monkeypatch):
    def raise_error(*_, **__):
        raise ZeroDivisionError

    operated = operate()
    with monkeypatch.context() as broken:
        broken.setattr(operated.rig, "connect", raise_error)
        operated.open()
        assert operated.state == "fault"
        assert "ZeroDivisionError" in str(operated.request("reset"))
    assert operated.state == "fault"
    operated.request("reset")
    assert operated.state == "ready"


def test_request_waits_for_the_connection_of_the_devices(operate):
    operated = operate()

    async def request_zero():
        opening = asyncio.create_task(operated.service.open())
        await asyncio.sleep(0)
        assert operated.service.status()["doing"] == "connecting"
        reply = await operated.handle("zero")
        await opening
        return reply

    assert "moved_rad" in operated.loop.run_until_complete(request_zero())
    assert operated.state == "ready"


def test_stop_cancels_a_waiting_start(operate):
    operated = operate()
    line = json.dumps({"command": "start", **SHORT}).encode()

    async def start_and_stop():
        opening = asyncio.create_task(operated.service.open())
        await asyncio.sleep(0)
        started = asyncio.create_task(operated.service.execute(parse_request(line), operated.peer))
        await asyncio.sleep(0)
        assert await operated.handle("stop", peer=OTHER) == {"stopping": False}
        with pytest.raises(CommandError, match="stopped before it began"):
            await started
        await opening

    operated.loop.run_until_complete(start_and_stop())
    assert operated.state == "ready"
    assert operated.world.highest_nm == 0.0


def test_failed_start_of_a_process_can_be_reset(operated, monkeypatch):
    assert operated.request("start", **SHORT)["series"] == 1
    group = operated.rig._group
    with monkeypatch.context() as broken:
        broken.setattr(type(group), "_start", refuse_to_start)
        operated.request("start", **SHORT)
    assert operated.state == "fault"
    assert "cannot be started" in operated.last["reason"]
    operated.request("reset")
    operated.request("start", **SHORT)
    assert operated.state == "ready"


def refuse_to_start(*_):
    raise ChildError("The recorder process cannot be started.")


def test_reset_does_not_connect_a_closing_rig(operated):
    operated.world.countdown, operated.world.then = 500, fail
    operated.request("start", **SHORT)
    assert operated.state == "fault"

    async def both():
        reset = asyncio.ensure_future(operated.handle("reset"))
        await asyncio.sleep(0)
        await operated.service.close("it ends")
        return await reset

    refusal = operated.loop.run_until_complete(both())
    assert "shut down" in str(refusal)
    assert not operated.rig.connected


def test_no_supervisor_beat_while_no_stop_can_be_received(operated, monkeypatch):
    can_receive = iter([True, True, False])
    monkeypatch.setattr(operated.service, "_can_receive_stop", lambda: next(can_receive, False))
    beats = []
    operated.world.countdown = 500
    operated.world.then = lambda _: beats.append(shared_state(operated)[StateField.SUPERVISOR_BEAT])
    operated.request("start", **SHORT, repeat=2)
    assert shared_state(operated)[StateField.SUPERVISOR_BEAT] == beats[0]
    assert len(operated.last["sessions"]) == 1
    assert "does not respond" in operated.last["reason"]


def shared_state(operated):
    return operated.rig._group.channels.shared_state


def test_the_end_of_the_daemon_stops_a_session_safely(operated):
    operated.world.countdown = 500
    operated.world.then = lambda drive: operated.loop.call_soon_threadsafe(close)
    closed = []

    def close():
        closed.append(operated.loop.create_task(operated.service.close("it ends")))

    operated.request("start", excitation="hold", parameters={"duration_s": 60.0}, repeat=3)
    operated.loop.run_until_complete(closed[0])
    (session,) = operated.last["sessions"]
    assert session["outcome"] == "stopped"
    assert operated.state == "idle"
    assert not operated.rig.connected
    assert operated.world.drives[0].safe
    assert "shut down" in str(operated.request("reset"))


def test_status_has_progress_processes_and_topics(operated):
    statuses = []

    def record_status(drive):
        operated.service.poll_status()
        statuses.append(operated.service.status())

    operated.service.poll_status()  # from now on it sees the samples
    operated.world.countdown, operated.world.then = 500, record_status
    operated.request("start", **SHORT)
    (status,) = statuses
    assert status["state"] == "running"
    assert status["progress"]["phase"] == status["progress"]["activity"] == "running"
    assert 0 < status["progress"]["tick"] < status["progress"]["total"] == 300
    signals, health = status["rig"]["signals"], status["rig"]["health"]
    assert signals["rate_hz"] == 1000.0
    assert signals["peak_torque_command_nm"] >= abs(status["rig"]["torque_command_nm"])
    assert (health["missed"], health["lost"], health["bus_load_percent"]) == (0, 0, None)
    assert health["sensor_status"] == 0
    json.dumps(status, allow_nan=False)
    assert {p["name"]: p["state"] for p in status["rig"]["processes"]} == {
        "control": "running", "recorder": "running", "supervisor": "running",
    }  # fmt: skip
    topics = status["rig"]["topics"]
    assert topics[-1]["name"] == "/rig/sample"
    assert topics[-1]["rate_hz"] > 0.0
    idle_hz = [topic["rate_hz"] for topic in topics if not topic["written"]]
    assert idle_hz
    assert not any(idle_hz)
    assert [(h["from"], h["to"]) for h in status["history"]] == [
        ("idle", "ready"), ("ready", "running"),
    ]  # fmt: skip
    assert any(event["event"] == "progress" for event in operated.events)


def test_status_never_shows_the_counts_of_the_previous_session(operated, monkeypatch):
    """Between two polls, and before the session itself has begun."""
    run, statuses = operated.rig.run, []

    def record_status_and_run(*arguments):
        statuses.append(operated.service.status())
        return run(*arguments)

    operated.world.countdown = 500
    operated.world.then = lambda drive: operated.service.poll_status()
    operated.request("start", **SHORT)
    monkeypatch.setattr(operated.rig, "run", record_status_and_run)
    operated.request("start", **SHORT, repeat=2)
    assert [(status["progress"]["session"], status["progress"]["tick"]) for status in statuses] == [
        (1, 0), (2, 0),
    ]  # fmt: skip
    assert [status["progress"]["phase"] for status in statuses] == ["off", "off"]


def test_session_is_preparing_while_the_drive_is_off(operated):
    statuses = []

    def record_status(drive):
        assert not drive.enabled
        operated.service.poll_status()
        statuses.append(operated.service.status())

    operated.world.countdown, operated.world.then = 100, record_status
    operated.request("start", **SHORT)
    (status,) = statuses
    assert (status["state"], status["progress"]["phase"]) == ("running", "taring")
    assert status["progress"]["activity"] == "preparing"
    assert shown_status(status)["state"].strip().startswith("preparing since ")


def test_refused_start_retains_the_last_series(operated):
    assert operated.service.status()["series"] is None
    assert isinstance(operated.request("start", **TOO_FAR), CommandError)
    assert operated.service.status()["series"] is None
    operated.request("start", **SHORT, repeat=2)
    last = operated.service.status()["series"]
    assert len(last["sessions"]) == 2
    assert isinstance(operated.request("start", **TOO_FAR), CommandError)
    assert operated.service.status()["series"] == last


TOO_FAR = {"excitation": "chirp", "parameters": {"amplitude_rad": 9.0}}


def test_log_has_refusals_and_results(operated, caplog):
    caplog.set_level("INFO", "rigd.serve")
    operated.request("start", **TOO_FAR)
    operated.request("reset")
    operated.request("tare", peer=OTHER)
    operated.request("start", **SHORT)
    messages = [record.getMessage() for record in caplog.records]
    refused = [line for line in messages if ": refused: " in line]
    assert [line.partition(":")[0] for line in refused] == ["start", "reset", "tare"]
    assert "amplitude_rad = 9" in refused[0]
    assert "is controlled by" in refused[2]
    (result,) = [line for line in messages if "samples" in line]
    path = operated.last["sessions"][0]["path"]
    assert result == (
        f"series 2: session 1 of 1, {path}: Complete: 300 of 300 samples, 0 missed, 0 late."
    )


def test_log_has_warnings(operated, caplog):
    caplog.set_level("INFO", "rigd.serve")

    def doubt(drive):
        drive.health = lambda: LineHealth(doubt="Angles are old.")

    operated.world.countdown, operated.world.then = 500, doubt
    operated.request("start", **SHORT)
    (record,) = [r for r in caplog.records if r.getMessage() == "series 1: Angles are old."]
    assert record.levelname == "WARNING"


def test_failed_reset_retains_the_first_reason(operated, caplog):
    operated.world.countdown, operated.world.then = 500, fail
    operated.request("start", **SHORT)
    first = operated.service.status()["reason"]
    operated.world.absent = True
    for _ in range(2):  # not longer each time
        assert str(operated.request("reset")) == "The drive does not answer."
        assert operated.service.status()["reason"] == (
            f"The drive does not answer. Not reset: {first}"
        )
    operated.world.absent = False
    operated.request("reset")
    operated.world.countdown, operated.world.then = 500, fail
    operated.request("start", **SHORT)
    assert operated.service.status()["reason"] == first
