"""Equivalent damping of a mode in air against the energy that the air takes in a cycle."""

import numpy as np
import pytest

from analysis.identify._drag import by_law
from analysis.identify.drag_torque import HALF_DENSITY
from rigd.beam import mode_shape


@pytest.mark.parametrize("mode", [1, 2])
@pytest.mark.parametrize(("number", "power"), [(0, 2.0), (1, 4 / 3)])
def test_the_air_takes_as_much_as_linear_damping_of_that_ratio(mode, number, power):
    omega, amplitude, density = 16.0, 0.05, 4.7e-3
    x = (np.arange(2000) + 0.5) / 2000
    turn = 2 * np.pi * (np.arange(720) + 0.5) / 720
    shape = mode_shape(mode, x) / mode_shape(mode, 1.0)
    speed = omega * amplitude * np.outer(shape, np.sin(turn))
    taken = np.mean(HALF_DENSITY * np.abs(speed) ** (power + 1))
    ratio = by_law(mode, omega, amplitude, density)[number]
    linear = np.mean(2 * ratio * omega * density * speed**2)
    assert taken == pytest.approx(linear, rel=1e-3)


def test_at_rest_the_air_takes_nothing():
    assert by_law(1, 16.0, 0.0, 4.7e-3) == pytest.approx([0.0, 0.0])
