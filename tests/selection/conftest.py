"""The sessions of the whole-record tests, and a mode whose stiffness rises, simulated in time."""

import importlib.util
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rigd.beam import clamped_free_eigenvalues, participation

_SYNTHESIS = Path(__file__).parents[1] / "whole_record" / "conftest.py"


@cache
def synthesis():
    spec = importlib.util.spec_from_file_location("whole_record_synthesis", _SYNTHESIS)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def sessions():
    """Make a session of a plant: see `session` in the whole-record tests."""
    return synthesis().session


@pytest.fixture(scope="session")
def plants():
    return synthesis().PLANTS


@pytest.fixture(scope="session")
def link():
    return synthesis().LINK


@cache
def step(name, amplitude_rad, delay_s=0.0, rest_s=1.0, held_s=10.0):
    """Step of the motor, held until the record ends."""
    made = synthesis()
    t = np.arange(round((rest_s + held_s) * made.RATE_HZ)) / made.RATE_HZ - rest_s
    asked_rad = np.where(t >= 0, amplitude_rad, 0.0)
    return made.response(asked_rad, made.PLANTS[name], made.LINK, delay_s, 0.0, ())


@pytest.fixture(scope="session")
def steps():
    """Make a session with a step: see `step`."""
    return step


@cache
def extra_torque(name, rise):
    """What mode 1 of plant `name` (damping of order 1) adds when its stiffness rises by `rise`.

    Runge and Kutta's method on the mode's equation of motion, in y = r + angle:
    ``rho/EI y'' + gamma y' + k (r + zeta r' + rise r³ / R²) = 0``.
    """
    made = synthesis()
    damping, beam, step = made.PLANTS[name], made.LINK, 1 / made.RATE_HZ
    assert damping.alpha == damping.lambda_ == 1
    angle_rad = made.session(name).angle_rad
    n = angle_rad.size
    spectrum = np.fft.rfft(angle_rad, 2 * n)
    s = 2j * np.pi * np.fft.rfftfreq(2 * n, step)
    angle, speed = (np.fft.irfft(2 * x, 4 * n)[: 2 * n].tolist() for x in (spectrum, s * spectrum))
    k = float(clamped_free_eigenvalues(1)[0] / beam.length_m) ** 4
    ratio, gamma, zeta = beam.density_over_stiffness, damping.gamma, damping.zeta

    def run(cubic):
        def force(y, v, i):
            r = y - angle[i]
            return k * (r + zeta * (v - speed[i]) + cubic * r * r * r)

        forces, deflections, y, v = np.zeros(n), np.zeros(n), 0.0, 0.0
        for i in range(n - 1):
            forces[i], deflections[i] = force(y, v, 2 * i), y - angle[2 * i]
            d1 = -(gamma * v + forces[i]) / ratio
            v2 = v + step / 2 * d1
            d2 = -(gamma * v2 + force(y + step / 2 * v, v2, 2 * i + 1)) / ratio
            v3 = v + step / 2 * d2
            d3 = -(gamma * v3 + force(y + step / 2 * v2, v3, 2 * i + 1)) / ratio
            v4 = v + step * d3
            d4 = -(gamma * v4 + force(y + step * v3, v4, 2 * i + 2)) / ratio
            y += step / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v += step / 6 * (d1 + 2 * d2 + 2 * d3 + d4)
        return forces, np.abs(deflections).max()

    linear, largest = run(0.0)
    share = float(participation(beam, 1)[0]) * beam.bending_stiffness_n_m2
    return -share * (run(rise / largest**2)[0] - linear)


@pytest.fixture(scope="session")
def stiffening():
    """Compute the torque that a stiffness rising with the deflection adds: see `extra_torque`."""
    return extra_torque
