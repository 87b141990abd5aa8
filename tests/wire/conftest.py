"""Sessions on the simulated rig's wires, in this process's own crew."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from rigd.engine.signals import StopRequest
from rigd.excitation import chirp
from rigd.profile import load_profile
from rigd.supervisor.orders import Order
from rigd.supervisor.rig import Rig
from rigd.supervisor.session import SessionResult

HW_PROFILES = Path(__file__).parents[2] / "hw_profiles"


@dataclass(frozen=True)
class DriveLog:
    """What the simulated drive says it was told."""

    entries: list[dict]

    @classmethod
    def read(cls, path: Path) -> "DriveLog":
        return cls([json.loads(line) for line in path.read_text("utf-8").splitlines()])

    def of(self, what: str, device: str = "drive") -> list[dict]:
        return [e for e in self.entries if e["device"] == device and e["what"] == what]

    @property
    def last_torque(self) -> dict:
        """Torque and whether the drive is enabled, as they stand at the end."""
        return self.of("torque")[-1]


@pytest.fixture
def quiet_profile(tmp_path):
    """A shipped profile whose simulated sensor has no noise, as a file; more can be changed."""

    def make(name: str, *changes: tuple[str, str]) -> Path:
        text = (HW_PROFILES / f"{name}.toml").read_text("utf-8")
        quiet = (
            ("torque_noise_nm = { value = 5.0e-3", "torque_noise_nm = { value = 0.0"),
            ("force_noise_n = { value = 2.0e-2", "force_noise_n = { value = 0.0"),
        )
        for old, new in (*quiet, *changes):
            assert old in text, old
            text = text.replace(old, new, 1)
        path = tmp_path / f"{name}.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return make


@pytest.fixture
def run_order(tmp_path):
    """Run a short chirp on a profile, without the command line."""

    def run(profile, name: str, *, fast: bool, **options) -> SessionResult:
        settings = {"duration_s": 4.0, "rest_s": 0.3, "ring_down_s": 0.5, "stop_hz": 20.0}
        excitation = chirp(rate_hz=profile.rig.rate_hz, **(settings | options))
        order = Order(
            profile=profile,
            excitation=excitation,
            path=tmp_path / f"{name}.mcap",
        )
        rig = Rig(profile, fast=fast)
        try:
            rig.connect()
            return rig.run(order, StopRequest(), lambda *_: None)
        finally:
            rig.disconnect()

    return run


@pytest.fixture
def load():
    return load_profile


@pytest.fixture
def drive_log():
    return DriveLog.read
