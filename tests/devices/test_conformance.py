"""What the cycle relies on, of every backend."""

import pytest

from rigd.testing import DEVICE_CHECKS

pytestmark = pytest.mark.process


@pytest.mark.parametrize("check", DEVICE_CHECKS, ids=lambda check: check.__name__.strip("_"))
def test_a_backend_does_what_the_loop_relies_on(check, devices):
    check(devices)
