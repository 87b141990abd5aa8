"""Drivers are found by name, and unknown names are refused."""

import subprocess
import sys
from pathlib import Path

import pytest

from rigd.devices import check_selection
from rigd.devices.parameters import DeviceSelection
from rigd.errors import UserError


def test_unknown_drivers_are_refused_with_the_known_ones():
    with pytest.raises(UserError, match=r'a\.toml: .*"steam".*choose drive = "sim"'):
        check_selection(DeviceSelection(drive="steam", sensor="sim"), Path("a.toml"))


@pytest.mark.process
def test_the_simulation_is_imported_only_if_named():
    code = (
        "import sys, rigd.devices._registry, rigd.engine.control_process\n"
        "assert not [name for name in sys.modules if name.startswith('rigd.sim')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
