"""Profiles to check, and stand-ins for real devices, which record the calls."""

import pytest

from rigd.devices.contracts import DeviceError, Devices, LineHealth
from rigd.profile import load_profile


@pytest.fixture(autouse=True)
def _no_simulator(tmp_path, monkeypatch, patient_drives):
    """A simulated rig running on this computer must not be found."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture(scope="session")
def can_profile():
    return load_profile("antenna_can")


@pytest.fixture(scope="session")
def serial_profile():
    return load_profile("antenna_serial")


class StandInDrive:
    """Follows the contract of a drive; fails in the methods of `fails_at`."""

    def __init__(self, calls):
        self.calls = calls
        self.fails_at = {}
        self.stale_every = 0
        self.angle_stale = False
        self.angle_time_ns = 0
        self.fault = None
        self.angles_rad = iter(())

    def _called(self, what):
        self.calls.append(f"drive.{what}")
        if what in self.fails_at:
            raise self.fails_at[what]

    def connect(self):
        self._called("connect")

    def identity(self):
        return {
            "vendor_id": 0x1234,
            "product_code": 7,
            "serial_number": None,
            "device_name": "a drive",
            "supported_modes": 0x200,
            "rated_torque_nm": 0.5,
        }

    def enable(self, stop=None):
        self._called("enable")

    def latch(self, due_ns):
        self._called("latch")
        ticks = self.calls.count("drive.latch")
        self.angle_stale = self.stale_every > 0 and ticks % self.stale_every == 0

    def read_angle(self):
        return next(self.angles_rad, 0.0)

    def command(self, torque_nm):
        self._called("command")

    def disable(self):
        self._called("disable")

    def reset_fault(self):
        self._called("reset_fault")
        return self.fault

    def close(self):
        self._called("close")


class StandInSensor:
    """Follows the contract of a sensor on CAN."""

    def __init__(self, calls):
        self.calls = calls
        self.cause = ""
        self.fails_at = {}
        self.wrench_stale = False
        self.wrench_saturated = False
        self.wrench_time_ns = 0
        self.found = {
            "sensor": "a sensor",
            "serial_number": "FT12345",
            "firmware": "3.8.2",
            "calibration_date": "2020-01-02",
            "range_n_nm": [20.0, 20.0, 60.0, 1.0, 1.0, 1.0],
            "status": [],
            "matrix": [[1.0] * 6] * 6,
            "counts_per_force": 1_000_000,
        }
        self.measured = {
            "polls_hz": 1500.0,
            "turnaround_median_s": 4e-4,
            "turnaround_p99_s": 5e-4,
            "lost": 0.0,
        }

    def _called(self, what):
        self.calls.append(f"sensor.{what}")
        if what in self.fails_at:
            raise self.fails_at[what]

    def connect(self):
        self._called("connect")

    def health(self):
        return LineHealth(cause=self.cause)

    def calibration(self):
        return self.found

    def measure(self, duration_s):
        self._called("measure")
        return self.measured

    def request(self, due_ns):
        self._called("request")

    def read_wrench(self):
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def close(self):
        self._called("close")


class StandIns:
    def __init__(self):
        self.calls = []
        self.drive = StandInDrive(self.calls)
        self.sensor = StandInSensor(self.calls)

    def open(self, rig, moving=None):
        self.calls.append("open")
        return Devices(drive=self.drive, sensor=self.sensor, simulated=False)

    @property
    def closed(self):
        return {"drive.close", "sensor.close"} <= set(self.calls)


@pytest.fixture
def stand_ins(monkeypatch):
    """Fake devices, which the checks open as those of the profile."""
    made = StandIns()
    monkeypatch.setattr("rigd.checks.devices.open_devices", made.open)
    monkeypatch.setattr("rigd.devices._fault_reset.open_devices", made.open)
    monkeypatch.setattr("rigd.checks.devices.EXCHANGE_CHECK_TICKS", 100)
    return made


@pytest.fixture
def silent():
    return DeviceError("Drive: it does not answer; check its supply.")
