"""Sessions on the simulated rig's wires, in a process group of this process's own."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from rigd.engine.shared_state import LogEvent, Phase
from rigd.excitation import chirp
from rigd.profile import load_profile
from rigd.runner import Rig
from rigd.runner.request import SessionOrder
from rigd.runner.session import SessionProgress, SessionResult
from rigd.runtime import StopRequest
from rigd.sim.wire import inject


@dataclass(frozen=True)
class DriveLog:
    """Log of the simulated drive on its commands."""

    entries: list[dict]

    @classmethod
    def read(cls, path: Path) -> "DriveLog":
        whole, _, _ = path.read_text("utf-8").rpartition("\n")  # it may be writing the next line
        return cls([json.loads(line) for line in whole.splitlines()])

    def of(self, what: str, device: str = "drive") -> list[dict]:
        return [e for e in self.entries if e["device"] == device and e["what"] == what]

    @property
    def last_torque(self) -> dict:
        """Torque and whether the drive is enabled, at the end."""
        return self.of("torque")[-1]


@pytest.fixture
def quiet_profile(write_profile):
    """A shipped profile without sensor noise, as a file; other values can be changed."""

    def make(name: str, values: dict[str, str] | None = None, *, patient: bool = False) -> Path:
        quiet = {"simulation.torque_noise_nm": "0.0", "simulation.force_noise_n": "0.0"}
        return write_profile(name, quiet | (values or {}), patient=patient)

    return make


@pytest.fixture
def run_order(children_copied, tmp_path):
    """Run a short chirp on a profile, without the command line.

    Faults are injected in the middle of the record, however long the start takes, one after the
    other; the ticks before which this was are noted in `injected`.
    """

    def run(
        profile, name: str, *, fast: bool, faults=(), injected: list | None = None, **options
    ) -> SessionResult:
        noted = [] if injected is None else injected

        def watch(progress: SessionProgress, _: list[LogEvent]) -> None:
            if progress.phase != Phase.RUNNING or len(noted) == len(faults):
                return
            if progress.tick > (noted[-1] if noted else 0) + 200:
                noted.append(progress.tick)
                inject(profile.name, [faults[len(noted) - 1]])

        settings = {"duration_s": 2.0, "rest_s": 0.3, "ring_down_s": 0.5, "stop_hz": 20.0}
        excitation = chirp(rate_hz=profile.rig.rate_hz, **(settings | options))
        order = SessionOrder(
            profile=profile,
            excitation=excitation,
            path=tmp_path / f"{name}.mcap",
        )
        rig = Rig(profile, uses_virtual_clock=fast)
        try:
            rig.connect()
            return rig.run(order, StopRequest(), watch)
        finally:
            rig.disconnect()

    return run


@pytest.fixture
def load():
    return load_profile


@pytest.fixture
def drive_log():
    return DriveLog.read
