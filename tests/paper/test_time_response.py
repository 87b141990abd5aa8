"""The modelled torque against sums over modes, and the filters around it against known answers."""

from types import SimpleNamespace

import numpy as np
import pytest

from analysis.paper.welch_analysis import band_limited, largest_oscillation_time_s, modelled_torque
from rigd.beam import Beam, Damping, transfer

BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
DAMPING = Damping(zeta=2e-4, alpha=1.0, gamma=0.05, lambda_=1.0)


def record_of(angle_rad, **others):
    return SimpleNamespace(
        angle_rad=angle_rad,
        rate_hz=1000.0,
        beam=BEAM,
        tool_inertia_kg_m2=others.get("tool", 0.0),
        angle_delay_s=others.get("angle_delay", 0.0),
        torque_delay_s=others.get("torque_delay", 0.0),
        rest_angle_rad=others.get("rest"),
    )


def smooth_start(n, frequency_hz):
    t = np.arange(n) / 1000
    return 0.01 * (1 - np.exp(-3 * t)) ** 3 * np.sin(2 * np.pi * frequency_hz * t), t


@pytest.mark.parametrize("frequency_hz", [1.0, 2.5, 12.0, 40.0])
def test_a_sine_settles_to_the_transfer_function(frequency_hz):
    angle, t = smooth_start(40_000, frequency_hz)
    torque = modelled_torque(record_of(angle, tool=1e-5), DAMPING)
    s = 2j * np.pi * frequency_hz
    response = transfer(np.array([s]), BEAM, DAMPING)[0] + 1e-5 * s**2
    steady = 0.01 * np.imag(response * np.exp(s * t))
    steady_part = slice(30_000, 39_900)  # the end is cut off, which rings in the last few samples
    assert np.abs(torque - steady)[steady_part].max() < 2e-3 * np.abs(steady).max()


def test_response_is_causal():
    angle, _ = smooth_start(8192, 5.0)
    late = np.concatenate((np.zeros(2000), angle))
    torque = modelled_torque(record_of(late), DAMPING)
    early, later = np.abs(torque[:1950]).max(), np.abs(torque[2000:]).max()
    assert early < 1e-4 * later


def test_constant_angle_needs_no_torque():
    angle, _ = smooth_start(8192, 5.0)
    expected = modelled_torque(record_of(angle), DAMPING)
    offset = modelled_torque(record_of(angle + 0.3, rest=0.3), DAMPING)
    np.testing.assert_allclose(offset, expected, atol=1e-9 * np.abs(expected).max())


def test_delays_shift_the_torque():
    angle, t = smooth_start(40_000, 12.0)
    torque = modelled_torque(record_of(angle, torque_delay=3e-3, angle_delay=1e-3), DAMPING)
    undelayed = modelled_torque(record_of(angle), DAMPING)
    steady_part = slice(20_000, 39_000)
    shifted = np.interp(t - 2e-3, t, undelayed)
    assert np.abs(torque - shifted)[steady_part].max() < 1e-3 * np.abs(undelayed).max()


def test_band_limited_passes_only_the_band():
    t = np.arange(10_000) / 1000
    low, high = np.sin(2 * np.pi * 5 * t), np.sin(2 * np.pi * 200 * t)
    inside = slice(1000, 9000)
    filtered = band_limited(low + high, 1000.0, (0.0, 50.0))
    np.testing.assert_allclose(filtered[inside], low[inside], atol=0.02)


@pytest.mark.parametrize("centre_s", [2.0, 7.5])
def test_loudest_time_is_that_of_the_burst(centre_s):
    t = np.arange(10_000) / 1000
    burst = np.exp(-(((t - centre_s) / 0.5) ** 2)) * np.sin(2 * np.pi * 16 * t)
    louder_elsewhere = 5 * np.exp(-(((t - 5.0) / 0.5) ** 2)) * np.sin(2 * np.pi * 60 * t)
    found_s = largest_oscillation_time_s(burst + louder_elsewhere, 1000.0, 16.0)
    assert found_s == pytest.approx(centre_s, abs=0.1)
