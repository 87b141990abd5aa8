"""`rigd identify motor`, as an operator runs it."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from rigd.profile import load_profile
from rigd.runner.session import SessionResult
from rigd.runtime import StopRequest
from rigd.session import read_session


def pasted(text, toml):
    """A profile's text with the proposed lines instead of its own."""
    section = ""
    lines = text.splitlines()
    for line in toml.splitlines():
        if line.startswith("["):
            section = line
        elif line:
            key = line.split(" = ")[0]
            start = lines.index(section)
            line_number = next(
                i for i in range(start, len(lines)) if lines[i].startswith(key + " = ")
            )
            lines[line_number] = line
    return "\n".join(lines)


@pytest.mark.process
@pytest.mark.further  # as test_identified_motors.py, without processes
def test_command_proposes_lines_for_the_profile(rigd, tmp_path):
    done = rigd(
        "identify",
        "motor",
        "--profile",
        "sim",
        "--fast",
        "--seed",
        "1",
        "--json",
        "--output",
        "out",
    )
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    names = sorted(path.name.split("-", 2)[2] for path in (tmp_path / "out").iterdir())
    assert names == ["motor-multisine.mcap", "motor-speeds.mcap", "motor-trial.mcap"]
    assert [path.rsplit("motor-")[1] for path in document["files"]] == [
        "multisine.mcap",
        "speeds.mcap",
    ]

    profile = load_profile("sim")
    motor, delay_s = profile.rig.motor, profile.rig.actuation.delay_s
    for key, truth, largest in (
        ("motor.inertia_kg_m2", motor.inertia_kg_m2, 0.002),
        ("motor.viscous_nm_s_per_rad", motor.viscous_nm_s_per_rad, 0.01),
        ("motor.coulomb_nm", motor.coulomb_nm, 0.005),
        ("motor.rated_torque_nm", motor.rated_torque_nm, 0.001),
        ("actuation.delay_s", delay_s, 0.02),
        ("control.friction_compensation_nm", motor.coulomb_nm, 0.005),
    ):
        found = document["parameters"][key]
        assert abs(found["value"] - truth) < 3 * found["std"], key
        assert found["std"] < largest * truth, key
        assert found["source"] == "assumed"
        assert found["differs"] is False
    assert document["torque_scale"]["value"] == pytest.approx(1.0, abs=0.003)

    path = tmp_path / "measured.toml"
    path.write_text(pasted(profile.text, document["toml"]))
    measured = load_profile(path)
    assert measured.sources["motor.inertia_kg_m2"] == "measured"
    assert measured.sources["control.friction_compensation_nm"] == "measured"
    found = document["parameters"]["motor.inertia_kg_m2"]
    assert abs(measured.rig.motor.inertia_kg_m2 - found["value"]) < 0.1 * found["std"]

    # Again from the files, with a wrong profile; nothing moves.
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(
        profile.text.replace("inertia_kg_m2 = { value = 2.0e-3", "inertia_kg_m2 = { value = 2.5e-3")
    )
    options = [part for file in document["files"] for part in ("--from", file)]
    again = rigd("identify", "motor", "--profile", wrong, *options)
    assert again.returncode == 0, again.stderr
    assert re.search(r"motor\.inertia_kg_m2 .* 0\.0025 +assumed +DIFFERS", again.stdout)
    assert re.search(r"motor\.coulomb_nm .* agrees", again.stdout)
    lines = again.stdout.partition("For the profile:")[2]
    assert tomllib.loads(lines) == tomllib.loads(document["toml"])
    assert len(list((tmp_path / "out").iterdir())) == 3

    session = read_session(tmp_path / document["files"][0])
    assert session.outcome["outcome"] == "complete"
    assert session.number("control_inertia_kg_m2") == pytest.approx(2e-3, rel=0.03)


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (("--torque-percent", "0"), 2, "--torque-percent 0"),
        (("--torque-percent", "3"), 2, "allow at least"),
        (("--stroke-rad", "2"), 2, "limits.angle_rad"),
        (("--stroke-rad", "wide"), 2, "--stroke-rad"),
        (("--profile", "nosuch"), 2, "nosuch"),
        (("--from", "nosuch.mcap"), 1, "nosuch.mcap"),
        (("--from", "nosuch.mcap", "--profile", "nosuch"), 2, "nosuch"),
    ],
)
def test_wrong_use(rigd_here, tmp_path, options, code, words):
    done = rigd_here("identify", "motor", "--fast", *options)
    text = done.stdout + done.stderr
    assert done.returncode == code, text
    assert words in text
    assert "Traceback" not in text
    assert len(text) < 1500
    assert not list(tmp_path.rglob("*.mcap*"))


@pytest.mark.parametrize("outcome", ["fault", "complete"])
def test_no_estimate_follows_a_trial_that_ended_early(rigd_here, monkeypatch, outcome):
    trial = SessionResult(Path("a.mcap"), outcome, "The tare drifted.", 9, 9, 0, 0, 0, fault=True)
    monkeypatch.setattr("rigd.cli.identify.start_processes", lambda **_: (StopRequest(), None))
    monkeypatch.setattr("rigd.runner.run_in_foreground", lambda *_, **__: [trial])
    done = rigd_here("identify", "motor", "--fast")
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


@pytest.mark.process
def test_a_session_of_another_kind_is_refused(rigd_here, short_chirps):
    done = rigd_here("identify", "motor", "--from", short_chirps[0])
    assert done.returncode == 1
    assert "was not recorded by rigd identify motor" in done.stderr
    assert done.stdout == ""
