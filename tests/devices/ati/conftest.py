"""Fake ATI sensors, and rigs that have one."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rigd.profile import load_profile


def load_module(name):
    """Import a module of this folder: pytest's import mode puts the folder on no path."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).parent / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return sys.modules[name]


@pytest.fixture(scope="session")
def fakes():
    return load_module("fakes_ati")


@pytest.fixture(scope="session")
def fuzz(fakes):
    return load_module("fuzz_ati")


@pytest.fixture
def can_rig(fakes):
    rig = load_profile("antenna_can").rig
    return replace(
        rig,
        ati_can=replace(rig.ati_can, base_id=fakes.BASE, calibration=1, serial_number=""),
        acquisition=replace(rig.acquisition, mode="same_tick", deadline_us=200.0),
    )


@pytest.fixture
def serial_rig():
    rig = load_profile("antenna_serial").rig
    return replace(
        rig,
        rate_hz=1000.0,
        ati_serial=replace(rig.ati_serial, calibration=1, serial_number="", filter="mean"),
        acquisition=replace(rig.acquisition, mode="same_tick", deadline_us=2000.0),
    )


@pytest.fixture
def digital_ft(fakes):
    sensor = fakes.FakeDigitalFt()
    yield sensor
    sensor.close()
