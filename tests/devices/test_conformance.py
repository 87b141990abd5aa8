"""What the cycle relies on, of every backend."""

import pytest

from rigd.testing import DEVICE_CHECKS

pytestmark = pytest.mark.process


def test_a_backend_does_what_the_loop_relies_on(open_backend):
    for check in DEVICE_CHECKS:
        with open_backend() as devices:
            check(devices)
