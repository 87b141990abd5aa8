"""Failed rows of `rigd check` in the daemon: refused, accepted by name, recorded."""

import json
from dataclasses import replace
from math import nan

import pytest
from operated_daemons import CommandError, RequestError, parse_request

from rigd.profile import load_profile
from rigd.session import read_session

SHORT = {
    "excitation": "hold",
    "parameters": {"duration_s": 0.3, "rest_s": 0.0, "ring_down_s": 0.0},
}
ROW = "travel_missed_ticks"


@pytest.fixture
def profile(profile):
    """A rig whose worst travel is beyond its stop, as with a wired drive, in this process."""
    rig = replace(profile.rig, cia402=load_profile("antenna_can").rig.cia402)
    limits = replace(
        load_profile("antenna_can").limits, missed_ticks_in_a_row=400, missed_percent=99.0
    )
    return replace(profile, rig=rig, limits=limits)


def test_failed_row_is_shown_and_refuses_a_start(operated):
    (shown,) = operated.request("status")["daemon"]["failed_checks"]
    assert (shown["name"], shown["acceptable"], shown["accepted"]) == (ROW, True, False)
    assert "of 400 missed ticks (limits.missed_ticks_in_a_row)" in shown["text"]
    refused = operated.request("start", **SHORT)
    assert isinstance(refused, CommandError)
    assert not refused.wrong_use  # the profile is to be another
    assert str(refused).endswith(f"To accept it for one session: --accept {ROW}.")
    plan = operated.request("predict", **SHORT)["plan"]
    assert ROW in plan["refused"]
    assert operated.world.highest_nm == 0.0
    assert operated.state == "ready"


def test_accepted_row_is_recorded_and_valid_for_one_start(operated):
    plan = operated.request("start", **SHORT, accept=[ROW], repeat=2)["plan"]
    assert plan["refused"] is None
    assert [each["accepted"] for each in plan["failed_checks"]] == [True]
    assert [each["outcome"] for each in operated.last["sessions"]] == ["complete", "complete"]
    for each in operated.last["sessions"]:
        session = read_session(each["path"])
        assert session.metadata["accepted_checks"] == ROW
        (event,) = [e for e in session.events if "rigd check" in e.message]
        assert event.level == "warning"
        assert event.message.startswith("Accepted by the operator, though rigd check fails:")
        assert "limits.missed_ticks_in_a_row" in event.message
    assert isinstance(operated.request("start", **SHORT), CommandError)


def test_unknown_and_passed_rows_cannot_be_accepted(operated):
    refused = operated.request("start", **SHORT, accept=["travel"])
    assert refused.wrong_use
    assert str(refused) == (
        "--accept travel: no row of rigd check has that name; those that can be accepted are eds, "
        f"travel_loop_fails, travel_no_angle, travel_encoder_fails, {ROW}."
    )
    refused = operated.request("start", **SHORT, accept=[ROW, "loop_stability"])
    assert refused.wrong_use
    assert "cannot be accepted: the shaft could not be held" in str(refused)
    needless = operated.request("start", **SHORT, accept=[ROW, "travel_no_angle"])["plan"]
    assert needless["refused"] is None
    assert needless["warnings"][0] == (
        "--accept travel_no_angle: it did not fail; nothing was accepted."
    )


@pytest.mark.parametrize("accept", ["travel_missed_ticks", [1], ["x" * 65], ["x"] * 33, None])
def test_accept_is_a_list_of_short_names(accept):
    line = {"command": "start", "excitation": "hold", "accept": accept}
    with pytest.raises(RequestError, match=r"^accept"):
        parse_request(json.dumps(line).encode())


def test_fault_names_unknown_values(operate, profile):
    unknown = replace(profile.rig.motor, peak_torque_nm=nan)
    object.__setattr__(profile, "rig", replace(profile.rig, motor=unknown))
    operated = operate().open()
    status = operated.request("status")
    assert (status["state"], status["rig"]) == ("fault", None)
    assert "motor.peak_torque_nm is unknown; enter its value" in status["reason"]
    failed = {each["name"]: each for each in status["daemon"]["failed_checks"]}
    assert not failed["unknown_values"]["acceptable"]
    for command, fields in (("start", SHORT), ("zero", {}), ("tare", {})):
        assert isinstance(operated.request(command, **fields), CommandError)
    assert "motor.peak_torque_nm" in str(operated.request("predict", **SHORT))
    assert "motor.peak_torque_nm" in str(operated.request("reset"))
    assert operated.state == "fault"
    assert operated.world.drives == []
