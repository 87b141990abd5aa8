"""A controller that feeds the sensor's noise back, and the reference that owes nothing to it."""

from dataclasses import asdict

import numpy as np
import pytest

from analysis.models import STRUCTURES
from analysis.welch_aware import WelchAwareError
from rigd.beam import transfer
from rigd.spectral import Segmentation, instrumental_response, segment_lengths

CLAMP_KG_M2 = 1e-5
RATE_HZ, SAMPLES = 500.0, 34_000
SWEEP = slice(500, 30_500)
SEGMENTS = Segmentation(*segment_lengths(30_000, 8, 0.15), 40_000)


def moved_by_noise(session, link, damping, seed):
    """Let noise of the torque move a motor (2e-3 kg m², 80 rad/s), and the beam answer."""
    decay = np.exp(-5.0 * np.arange(SAMPLES) / SAMPLES)
    s = 5.0 * RATE_HZ / SAMPLES + 2j * np.pi * np.fft.rfftfreq(4 * SAMPLES, 1 / RATE_HZ)
    noise = 1e-2 * np.random.default_rng(seed).normal(size=SAMPLES)
    turned = 500 * s * (s + 310) / (s + 80) ** 4 * np.exp(-s / RATE_HZ)
    turned = turned * np.fft.rfft(noise * decay, 4 * SAMPLES)
    answered = turned * (transfer(s, link, damping) + CLAMP_KG_M2 * s**2)
    angle, torque = (np.fft.irfft(x, 4 * SAMPLES)[:SAMPLES] / decay for x in (turned, answered))
    return (
        (session.angle_rad, session.torque_nm + noise),
        (session.angle_rad + angle, session.torque_nm + noise + torque),
    )


def test_the_reference_takes_the_feedback_out(session, link, plants):
    """Against the same noise in the torque alone, which leaves little to chance."""
    made = session(plants["III"], tool_inertia_kg_m2=CLAMP_KG_M2)
    reference = made.angle_rad  # the noise is in neither
    shifts = {"h1": [], "iv": []}
    for seed in range(2):
        found = {}
        for angle, torque in moved_by_noise(made, link, plants["III"], seed):
            moved = type(made)(angle, torque)
            hiv = instrumental_response(
                reference[SWEEP], angle[SWEEP], torque[SWEEP], RATE_HZ, **asdict(SEGMENTS)
            ).band(0.8, 50.0)
            three = STRUCTURES["III"]
            known = {"tool_inertia_kg_m2": CLAMP_KG_M2}
            for name, fit in (
                ("h1", moved.aware(moved.h1(), three, **known)),
                ("iv", moved.aware(hiv, three, reference_rad=reference, **known)),
            ):
                found.setdefault(name, []).append(fit)
        for name, (alone, fed_back) in found.items():
            shift = fed_back.parameters["tool_inertia_kg_m2"]
            shift -= alone.parameters["tool_inertia_kg_m2"]
            shifts[name].append(shift / fed_back.std["tool_inertia_kg_m2"])
    # Ten seeds: 2.29 ± 0.17 and -0.04 ± 0.03; one scatters by 0.5 and 0.09.
    assert np.mean(shifts["h1"]) > 1.0
    assert abs(np.mean(shifts["iv"])) < 0.3


def test_a_reference_of_another_length_is_refused(session, plants):
    made = session(plants["III"])
    with pytest.raises(WelchAwareError, match="one value of the reference"):
        made.aware(made.h1(), STRUCTURES["III"], reference_rad=made.angle_rad[1:])
