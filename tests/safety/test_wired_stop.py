"""The wired stop (STO) of the drive simulated in this process."""

import pytest
from shipped_profile import load_shipped

from rigd.devices import open_devices
from rigd.devices.contracts import DeviceError


@pytest.fixture
def direct():
    devices = open_devices(load_shipped("sim").rig)
    devices.drive.connect()
    devices.drive.enable()
    devices.drive.latch(0)
    devices.drive.command(0.2)
    return devices.drive


def test_the_direct_drive_loses_torque_at_the_stop(direct):
    direct.sto_dropped = True
    assert not direct._plant.enabled
    direct.command(0.2)
    assert direct._plant._torque_nm == 0.0
    with pytest.raises(DeviceError, match=r"the wired stop \(STO\) was dropped"):
        direct.read_angle()


def test_the_direct_drive_stays_off_until_enabled_again(direct):
    direct.sto_dropped = True
    direct.disable()
    direct.read_angle()  # a drive that is off may be watched
    with pytest.raises(DeviceError, match="STO"):
        direct.enable()
    direct.sto_dropped = False
    assert not direct._plant.enabled
    direct.enable()
    direct.read_angle()
    assert direct._plant.enabled
