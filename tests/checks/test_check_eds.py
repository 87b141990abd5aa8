"""``rigd check --eds``: checks of a drive by its file alone."""

import json
import time

import pytest
from eds_files import COMPLETE, WITH_TORQUE, WITHOUT_TORQUE, eds_path, eds_text, without

from rigd.cli.app import app
from rigd.profile import load_profile

pytestmark = pytest.mark.process


@pytest.fixture
def rigd(rigd_here, monkeypatch):
    monkeypatch.setattr("rigd.cli.check.signal.signal", lambda *_: None)  # of the test runner
    monkeypatch.setattr("rigd.checks.devices.open_devices", fail_if_called)
    return rigd_here


def fail_if_called(*_, **__):
    raise AssertionError("nothing is connected")


def rows_of(done):
    return json.loads(done.stdout)["rows"]


@pytest.fixture
def profile_with(tmp_path):
    """The shipped profile with extra lines in the section of the drive."""

    def write(lines):
        path = tmp_path / "rig.toml"
        text = load_profile("antenna_can").text
        path.write_text(text.replace("[cia402]", f"[cia402]\n{lines}", 1))
        return path

    return write


@pytest.mark.parametrize("name", WITH_TORQUE)
def test_a_drive_with_torque_mode_can_be_used(rigd, name):
    done = rigd("check", "--eds", eds_path(name))
    assert done.returncode == 0, done.stdout
    assert "according to its EDS file, this drive can be used" in " ".join(done.stdout.split())


@pytest.mark.parametrize("name", WITHOUT_TORQUE)
def test_a_drive_without_torque_mode_is_refused(rigd, name):
    start = time.process_time()
    done = rigd("check", "--eds", eds_path(name))
    assert time.process_time() - start < 5.0  # it is below one where nothing else runs
    assert done.returncode == 1
    printed = " ".join(done.stdout.split())
    assert "No cyclic synchronous torque mode: object 6502 = 0x" in printed
    assert "lacks bit 9" in printed
    assert "Verdict: failed" in printed
    assert "this drive cannot be used" in printed


def test_a_missing_core_object_is_named(rigd, tmp_path):
    path = tmp_path / "drive.eds"
    path.write_text(eds_text(without("6071")))
    done = rigd("check", "--eds", path, "--json")
    assert done.returncode == 1
    document = json.loads(done.stdout)
    assert document["verdict"] == "failed"
    (failed,) = (row for row in document["rows"] if row["verdict"] == "failed")
    assert failed["what"] == "6071 Target torque"
    assert "It has no object 6071 (Target torque)." in failed["detail"]


def test_json_is_the_document_of_every_check(rigd):
    done = rigd("check", "--eds", eds_path("elmo_gold"), "--json")
    document = json.loads(done.stdout)
    assert set(document) == {"verdict", "rows"}
    for row in document["rows"]:
        assert set(row) == {"group", "what", "found", "wanted", "verdict", "detail", "name"}
        assert row["group"] == "EDS"
        assert row["verdict"] in ("ok", "warning", "failed", "skipped")


def test_values_of_a_profile_are_compared(rigd, profile_with):
    epos = eds_path("epos4_0170")
    done = rigd("check", "--eds", epos, "--profile", "antenna_can", "--json")
    assert done.returncode == 1
    assert [r["what"] for r in rows_of(done) if r["verdict"] == "failed"] == ["6072 Max torque"]
    path = profile_with('accept_without = ["torque_limit"]')
    done = rigd("check", "--eds", epos, "--profile", path, "--json")
    assert done.returncode == 0
    assert [r["what"] for r in rows_of(done) if r["verdict"] == "warning"] == ["6072 Max torque"]


def test_the_eds_of_a_profile_comes_first(rigd, profile_with, monkeypatch):
    monkeypatch.setattr("rigd.checks._check.inspect_devices", lambda _: [])
    path = profile_with(f"eds = '{eds_path('elmo_gold')}'")
    rows = rows_of(rigd("check", "--profile", path, "--json"))
    groups = list(dict.fromkeys(row["group"] for row in rows))
    assert groups[:3] == ["EDS", "profile", "CAN bus"]
    alone = rows_of(rigd("check", "--eds", eds_path("elmo_gold"), "--profile", path, "--json"))
    assert [row for row in rows if row["group"] == "EDS"] == alone


def test_a_profile_with_an_invalid_eds_fails(rigd, profile_with, tmp_path, monkeypatch):
    monkeypatch.setattr("rigd.checks._check.inspect_devices", lambda _: [])
    (tmp_path / "x.eds").write_bytes(b"\0" * 1000)
    done = rigd("check", "--profile", profile_with('eds = "x.eds"'), "--json")
    assert done.returncode == 1
    assert "x.eds: is not an EDS file" in rows_of(done)[0]["found"]


@pytest.mark.parametrize("content", [None, b"", b"\0\1\2", b"<xml/>"])
def test_invalid_eds_files(rigd, tmp_path, content):
    path = tmp_path / "drive.eds"
    if content is not None:
        path.write_bytes(content)
    done = rigd("check", "--eds", path, "--json")
    assert done.returncode == 1
    (row,) = rows_of(done)
    assert row["verdict"] == "failed"
    assert str(path) in row["found"]


def test_a_profile_without_cia402_is_wrong_use(rigd):
    done = rigd("check", "--eds", eds_path("e35"), "--profile", "sim")
    assert done.returncode == 2
    assert "no section [cia402]" in done.stderr


def test_help_describes_eds():
    (command,) = (c for c in app.registered_commands if c.callback.__name__ == "check")
    assert "--eds" in command.callback.__doc__
    assert COMPLETE  # the table that a drive is to have
