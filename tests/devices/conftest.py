"""Every backend there is, opened but not connected."""

import pytest

from rigd.devices.registry import open_devices
from rigd.profile import load_profile


@pytest.fixture
def rig():
    return load_profile("sim").rig


@pytest.fixture(params=["sim"])
def devices(request, rig):
    return {"sim": lambda: open_devices(rig)}[request.param]()
