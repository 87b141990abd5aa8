"""A blade of one mode, as vibration laboratories record it: its damping does not go with the band.

The reaction in such a record has the first mode of a beam, plus a fraction of its quasi-static
response that no beam has: other modes and the fixture.
"""

import numpy as np
import pytest
from cases import further

from analysis.identify import Measurement, fit_record, select
from analysis.models import STRUCTURES
from rigd.beam import Beam, undamped_frequencies_rad_s

pytestmark = pytest.mark.fit

RATE_HZ = 500.0
FREQUENCY_HZ, DAMPING_RATIO = 18.556, 0.00523
DELAY_S = 0.69e-3


def blade(fraction):
    """One minute of a sweep to 50 Hz, with 1 % of noise."""
    n, padded = 30_000, 1 << 17
    t = np.arange(n) / RATE_HZ
    angle = np.sin(2 * np.pi * (0.5 * t + (50 - 0.5) * t**2 / (2 * t[-1])))
    sigma = 5 * RATE_HZ / padded
    s = sigma + 2j * np.pi * np.fft.rfftfreq(padded, 1 / RATE_HZ)
    omega = 2 * np.pi * FREQUENCY_HZ
    resonance = 1 / (s**2 + 2 * DAMPING_RATIO * omega * s + omega**2) + fraction / omega**2
    # The first mode of a clamped beam has 97 % of its inertia about the root.
    response = 0.323 * omega**2 * s**2 * resonance * np.exp(-s * DELAY_S)
    decay = np.exp(-sigma * t)
    torque = np.fft.irfft(np.fft.rfft(angle * decay, padded) * response, padded)[:n] / decay
    torque += 0.01 * np.std(torque) * np.random.default_rng(1).standard_normal(n)
    (unit_rad_s,) = undamped_frequencies_rad_s(Beam(1.0, 1.0, 1.0), 1)
    beam = Beam(1.0, 1.0, (1.01 * omega / unit_rad_s) ** 2)
    known = np.ones(n, dtype=bool)
    return Measurement("blade", angle, torque, RATE_HZ, beam, known, known)


@pytest.mark.parametrize("band_hz", [(2.0, 30.0), further((0.0, 50.0))])
@pytest.mark.parametrize(("fraction", "within"), [(0.05, 6e-6), further(-0.3, 6e-5)])
def test_frequency_and_damping_do_not_depend_on_the_band(fraction, within, band_hz):
    """The second fraction requires a negative tool inertia, which no rig has."""
    (fit,) = fit_record(blade(fraction), [STRUCTURES["VI"]], band_hz=band_hz).fits
    mode = fit.modes[0]
    assert mode.frequency_hz == pytest.approx(FREQUENCY_HZ, abs=1e-3)
    assert mode.damping_ratio == pytest.approx(DAMPING_RATIO, abs=within)


def test_delay_is_not_separable_from_the_damping_of_one_mode(sessions):
    headline = select(sessions("VI").measured(noise_nm=5e-3, seed=1), band_hz=(5.0, 20.0)).headline
    assert headline.visible_modes == (2,)
    for name in ("delay_s", "density_over_stiffness", "bending_stiffness_n_m2"):
        assert headline.parameters[name].flag is not None, name
