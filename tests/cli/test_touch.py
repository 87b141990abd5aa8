"""`rigd run touch`, from the command line to the session file."""

import json
import subprocess

import numpy as np
import pytest
from cases import further

from rigd.engine.workers import TOUCH
from rigd.session import read_session, read_touches
from rigd.session.layout import TOUCH_KINDS, Status

pytestmark = pytest.mark.process

OBSTACLE = "x=0.62,angle=0.4,stiffness=3000"
QUICK = ("--settle", "0.3", "--rest", "0.5", "--ring-down", "0.2", "--hold", "0.4", "--seed", "1")


def touches_of(done):
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(done.stdout)
    (session,) = document["sessions"]
    assert session["outcome"] == "complete"
    assert session["scheduled"] == session["recorded"]
    assert document["touches"] == session["touches"]
    return session, document["touches"]


@pytest.fixture(scope="module")
def touch_session(run_patched):
    """Two passes against an obstacle: standard error, session, touches, record.

    With a third of the positions, the preparation of the estimator takes less time.
    """
    command = ["touch", "0.6", "--passes", "2", "--fast", "--json", "--no-look", *QUICK]
    command += ["--obstacle", OBSTACLE]
    patches = {"rigd.touch._tables._POSITION_SPACING_M": 0.02}
    code, output, errors = run_patched("touched", command, patches, TOUCH)
    session, touches = touches_of(subprocess.CompletedProcess([], code, output, errors))
    return errors, session, touches, read_session(session["path"])


def test_each_pass_locates_the_obstacle(touch_session):
    _, _, touches, _ = touch_session
    assert [touch["number"] for touch in touches] == [1, 2]
    for touch in touches:
        low, high = touch["x_m"]["interval_95"]
        assert low < touch["x_m"]["value"] < high
        # Five of its standard deviations, and never more than a centimetre.
        assert abs(touch["x_m"]["value"] - 0.62) < min(5 * touch["x_m"]["std"], 0.01)
        assert touch["kind"] in ("rigid", "unknown")
        assert touch["model"] == "profile"


def test_the_file_has_the_detections_and_the_estimates(touch_session):
    _, _, touches, record = touch_session
    status, tick = record.samples["status"], record.samples["tick"]
    marked = tick[(status & Status.TOUCHED) != 0]
    assert marked.size == 2
    assert json.loads(record.outcome["touches"]) == touches
    messages = read_touches(record.path)
    # On a busy computer the second one may not have been estimated in time.
    estimated = [touch for touch in touches if "kind" in touch]
    assert estimated
    assert messages["tick"].tolist() == [marked[touch["number"] - 1] for touch in estimated]
    assert messages["x_m"].tolist() == [touch["x_m"]["value"] for touch in estimated]
    assert messages["kind"].tolist() == [TOUCH_KINDS.index(touch["kind"]) for touch in estimated]
    for at, touch in zip(marked / 1000, touches, strict=True):
        assert -0.001 < at - touch["time_s"]["value"] < 0.02
    assert record.metadata["excitation"] == "touch"
    assert "0.0,1.0,0.0" in record.metadata["shear_projection"]
    assert any("Touch detected" in event.message for event in record.events)


def test_motor_brakes_at_once_and_returns(touch_session):
    _, _, _, record = touch_session
    samples = record.samples
    for at in np.flatnonzero((samples["status"] & Status.TOUCHED) != 0):
        after = samples["angle_rad"][at + 150 : at + 350]
        assert np.ptp(after) < 5e-3
        assert after.max() < 0.6 - 0.1
        assert samples["angle_reference_rad"][at + 150] < samples["angle_rad"][at] + 0.1
    assert abs(samples["angle_rad"][-1]) < 2e-3


def test_touches_are_printed(touch_session):
    printed, _, touches, _ = touch_session
    assert "goes to 0.6 rad at 1 rad/s, 2 times, brakes within" in printed
    x = touches[1]["x_m"]
    assert f"Touch 2: {x['value']:.3f}"[:13] in printed


@pytest.mark.further  # as the detector of tests/touch
def test_no_touch_without_an_obstacle(rigd):
    command = ("run", "touch", "0.4", "--speed", "2", "--fast", "--json", "--no-look")
    _, touches = touches_of(rigd(*command, *QUICK))
    assert touches == []


@pytest.mark.further  # as in tests/engine
def test_obstacle_on_the_way_back_stops_the_session(rigd, tmp_path):
    # The way back begins after some 0.5 + 0.3 + 0.6 + 0.4 s of record, and half a second of holding
    # before; the obstacle stops a beam that turns in the negative direction.
    obstacle = "x=0.6,angle=0.2,stiffness=3000,side=-1,from=2.5"
    command = ("run", "touch", "0.4", "--fast", "--json", "--no-look", *QUICK)
    done = rigd(*command, "--obstacle", obstacle)
    (session,) = json.loads(done.stdout)["sessions"]
    assert session["outcome"] == "stopped"
    assert "way back" in session["reason"]
    samples = read_session(tmp_path / session["path"]).samples
    assert samples["torque_command_nm"][-1] == 0.0
    assert samples["status"][-1] & Status.TORQUE_OFF


@pytest.mark.further  # as in tests/engine, without processes
def test_excessive_force_is_a_fault(rigd):
    command = ("run", "touch", "0.6", "--speed", "2", "--fast", "--json", "--no-look", *QUICK)
    done = rigd(*command, "--force-limit", "0.3", "--obstacle", OBSTACLE)
    assert done.returncode == 1
    (session,) = json.loads(done.stdout)["sessions"]
    assert session["outcome"] == "fault"
    assert "force_limit_n = 0.3 N" in session["reason"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        further(("0", "--fast"), "angle_rad = 0 rad is the angle"),
        further(("0.5", "--speed", "0"), "speed_rad_s = 0 rad/s must be more than 0 rad/s"),
        further(("0.5", "--hold", "0.001"), "ends before the motor has stopped"),
        (("1.8",), "limits.angle_rad); reduce the angle or the speed.\n"),
        further(("0.5", "--model", "none.json"), "none.json"),
    ],
)
def test_wrong_options_are_refused(rigd, arguments, expected):
    done = rigd("run", "touch", *arguments, "--fast", "--no-look")
    assert done.returncode == 2
    assert expected in done.stderr
