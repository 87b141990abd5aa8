"""Contract of the cycle with every backend."""

import pytest

from rigd.testing import DEVICE_CHECKS

pytestmark = pytest.mark.process


def test_backends_meet_the_contract_of_the_loop(open_backend):
    for check in DEVICE_CHECKS:
        with open_backend() as devices:
            check(devices)
