"""``rigd check`` and ``rigd reset`` as an operator sees them."""

import json

import pytest
from cases import further
from typer.testing import CliRunner

from rigd.checks import check_without_devices
from rigd.cli.app import app
from rigd.devices.contracts import DeviceError
from rigd.profile import load_profile

pytestmark = pytest.mark.process


@pytest.fixture
def rigd(monkeypatch):
    """Run one of the two commands; returns exit code, standard output and standard error."""
    monkeypatch.setattr("rigd.cli.check.signal.signal", lambda *_: None)  # of the test runner
    monkeypatch.setenv("COLUMNS", "80")

    def run(*arguments):
        done = CliRunner().invoke(app, arguments)
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done.exit_code, done.stdout, done.stderr

    return run


def changed_profile(profile, tmp_path, old, new):
    assert old in profile.text
    path = tmp_path / "changed.toml"
    path.write_text(profile.text.replace(old, new, 1), encoding="utf-8")
    return str(path)


def test_a_table_of_80_columns_and_a_verdict(rigd, stand_ins):
    code, text, _ = rigd("check", "--profile", "antenna_can")
    assert code == 0, text
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    for heading in ("profile", "CAN bus", "loop, torque command", "real time", "drive", "sensor"):
        assert any(line.strip() == heading for line in lines), heading
    assert "Verdict: warnings (failed: 0, warnings: " in " ".join(lines)
    assert "Assumed: motor.inertia_kg_m2" in text


@pytest.fixture(scope="module")
def rows_of_can():
    return check_without_devices(load_profile("antenna_can"), None)[:-1]


@pytest.fixture
def cached_rows(rows_of_can, monkeypatch):
    """Reuse the rows computed for the shipped profile, as in the table above."""
    monkeypatch.setattr("rigd.checks._check._rows_without_devices", lambda _: list(rows_of_can))


@pytest.mark.usefixtures("cached_rows")
def test_json_is_one_document(rigd, stand_ins):
    code, text, _ = rigd("check", "--profile", "antenna_can", "--json")
    assert code == 0
    document = json.loads(text)
    assert set(document) == {"verdict", "rows"}
    assert document["verdict"] == "warnings"
    assert all(
        set(row) == {"group", "what", "found", "wanted", "verdict", "detail", "name"}
        for row in document["rows"]
    )
    assert {row["verdict"] for row in document["rows"]} <= {"ok", "warning", "failed", "skipped"}


@pytest.mark.usefixtures("cached_rows")
def test_a_dead_device_fails_with_its_message(rigd, stand_ins, silent):
    stand_ins.drive.fails_at["connect"] = silent
    code, text, _ = rigd("check", "--profile", "antenna_can", "--json")
    assert code == 1
    document = json.loads(text)
    assert document["verdict"] == "failed"
    assert str(silent) in [row["found"] for row in document["rows"]]
    assert stand_ins.closed


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        pytest.param(
            "base_id = { value = 0x68", "base_id = { value = 0x20", "RPDO1", id="identifiers"
        ),
        further("value = 1_000_000, source", "value = 500_000, source", "% at worst", id="load"),
    ],
)
def test_nothing_is_sent_on_a_wrong_bus(rigd, stand_ins, can_profile, tmp_path, old, new, word):
    path = changed_profile(can_profile, tmp_path, old, new)
    code, text, _ = rigd("check", "--profile", path, "--json")
    assert code == 1
    rows = json.loads(text)["rows"]
    assert any(row["verdict"] == "failed" and word in row["found"] for row in rows)
    assert rows[-1]["verdict"] == "skipped"
    assert stand_ins.calls == []


@pytest.mark.parametrize("command", ["check", "reset"])
def test_wrong_use(rigd, command):
    code, text, errors = rigd(command, "--profile", "nowhere")
    assert code == 2
    assert text == ""
    assert "There is no profile 'nowhere'" in errors


def test_the_simulation_can_be_checked(rigd):
    code, text, _ = rigd("check")
    assert code == 0
    assert "simulated in this" in text


def test_missing_hardware(rigd, can_profile, tmp_path):
    """The real drivers, and a bus that does not exist: rows, no traceback."""
    path = changed_profile(can_profile, tmp_path, 'channel = "can0"', 'channel = "nocan9"')
    code, text, _ = rigd("check", "--profile", path, "--json")
    assert code == 1
    failed = [row for row in json.loads(text)["rows"] if row["verdict"] == "failed"]
    assert [row["group"] for row in failed] == ["sensor", "drive"]
    assert all("nocan9" in row["found"] for row in failed)


def test_reset_names_the_fault(rigd, stand_ins):
    stand_ins.drive.fault = "heartbeat of this computer lost (error code 0x8130)"
    code, text, _ = rigd("reset", "--profile", "antenna_can")
    assert code == 0
    assert "was in fault: heartbeat of this computer lost" in text
    assert stand_ins.calls == ["open", "drive.reset_fault", "drive.close"]


def test_reset_without_a_fault(rigd, stand_ins):
    code, text, _ = rigd("reset", "--profile", "antenna_can")
    assert code == 0
    assert "not in fault" in text


def test_reset_of_a_lasting_fault(rigd, stand_ins):
    stand_ins.drive.fails_at["reset_fault"] = DeviceError("Drive: the fault stands.")
    code, _, errors = rigd("reset", "--profile", "antenna_can")
    assert code == 1
    assert errors == "Error: Drive: the fault stands.\n"
    assert stand_ins.calls[-1] == "drive.close"


def test_reset_without_daemon_requires_the_name_of_the_rig(rigd, stand_ins):
    """The simulated rig, to which other commands default, would report a success."""
    code, text, errors = rigd("reset")
    assert code == 2
    assert text == ""
    assert errors.startswith("Error: Nothing was reset. No daemon ")  # is running, or answers
    assert "rigd reset --profile NAME" in errors
    assert "sim is simulated" in errors
    assert stand_ins.calls == []


def test_reset_by_a_driver_without_reset_reports_no_success(rigd, stand_ins):
    stand_ins.drive = object()
    code, text, errors = rigd("reset", "--profile", "antenna_can")
    assert code == 1
    assert text == ""
    assert "antenna_can: nothing was reset" in errors
    assert "press the wired stop" in errors


def test_a_simulated_drive_has_no_fault(rigd):
    code, text, _ = rigd("reset", "--profile", "sim")
    assert code == 0
    assert "sim is simulated" in text
    assert "no fault to reset" in text
