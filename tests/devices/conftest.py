"""All backends, opened but not connected."""

import contextlib
import os
from dataclasses import replace

import pytest
from cases import further

from rigd.devices import open_devices
from rigd.profile import load_profile

HARDWARE = "RIGD_HARDWARE"


@pytest.fixture(autouse=True)
def _patient(patient_drives):
    pass


@pytest.fixture(params=["direct", "can", further("serial"), further("previous_tick"), "hardware"])
def open_backend(request, start_simulator, monkeypatch):
    """Open drive and sensor: simulated directly, by wire in lock-step, or the real ones."""
    # The time that a simulated drive takes to answer during set-up depends on the computer.
    if request.param != "hardware":
        for name in ("_SDO_TIMEOUT_S", "_SHORT_SDO_TIMEOUT_S"):
            monkeypatch.setattr(f"rigd.devices.cia402._sdo.{name}", 10.0)
    if request.param == "hardware":
        name = os.environ.get(HARDWARE)
        if not name:
            pytest.skip(f"HARDWARE NOT TESTED: {HARDWARE} names no profile of a rig that may move")
        rig = load_profile(name).rig
    elif request.param == "direct":
        rig = load_profile("sim").rig
    else:
        name = "antenna_serial" if request.param == "serial" else "antenna_can"
        rig = load_profile(name).rig
        if request.param == "previous_tick":
            rig = replace(rig, acquisition=replace(rig.acquisition, mode="previous_tick"))
        start_simulator(name, "--lock-step")

    @contextlib.contextmanager
    def opened():
        devices = open_devices(rig)
        try:
            yield devices
        finally:
            devices.drive.close()
            devices.sensor.close()

    return opened
