"""Metadata of a session file: from the rig, the program and the request."""

import subprocess
from pathlib import Path

import pytest

from rigd.engine.messages import DevicesConnected
from rigd.excitation import hold
from rigd.profile import load_profile
from rigd.runner.request import SessionOrder, file_header, software_commit


@pytest.fixture
def metadata_of():
    """Return the metadata of a session with a sensor of this calibration."""

    def make(calibration):
        profile = load_profile("sim")
        order = SessionOrder(profile, hold(rate_hz=1000.0, duration_s=1.0), Path("a.mcap"))
        return file_header(order, DevicesConnected(calibration, {}, {}, True), {}).metadata

    return make


def test_serial_number_of_the_sensor_if_known(metadata_of):
    assert metadata_of({"serial_number": "FT12345"})["sensor_serial_number"] == "FT12345"
    assert "sensor_serial_number" not in metadata_of({"device": "simulated force-torque sensor"})


@pytest.mark.process
def test_the_commit_is_that_of_the_checkout(metadata_of):
    checkout = Path(__file__).parents[2]
    if not (checkout / ".git").exists():
        pytest.skip("this is not a checkout")
    command = ["git", "-C", checkout, "rev-parse", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    commit_of_metadata = metadata_of({})["software_commit"]
    assert commit[:12] in commit_of_metadata or commit_of_metadata.startswith("v")


def test_no_commit_without_checkout_or_git(monkeypatch, tmp_path):
    software_commit.cache_clear()
    monkeypatch.setenv("PATH", str(tmp_path))
    assert software_commit() == {}
    software_commit.cache_clear()
