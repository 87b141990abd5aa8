"""Cases of a parametrized test that `make test` leaves to `make test-further`."""

import pytest


def further(*values, **options):
    return pytest.param(*values, marks=pytest.mark.further, **options)
