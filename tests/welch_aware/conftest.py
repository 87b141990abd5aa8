"""Sessions of beams whose parameters are known, and what Welch's estimator makes of them.

Half the paper's: a chirp of 60 s at 500 Hz. The torque comes from the exact beam on a grid of its
own, at the full rate; modes of another stiffness from the sum over modes.
"""

from dataclasses import asdict, dataclass
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.welch_aware import fit_welch_aware
from rigd.beam import Beam, Damping, clamped_free_eigenvalues, participation, transfer
from rigd.spectral import FrequencyResponse, Segmentation, segment_lengths, welch_response

RATE_HZ = 500.0
REST, END, SAMPLES = 500, 30_500, 34_000
SEGMENTS = Segmentation(*segment_lengths(END - REST, 8, 0.15), 40_000)
LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)


@dataclass(frozen=True, slots=True)
class Session:
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]

    def h1(self, noise_nm: float = 0.0, seed: int = 0, **kwargs) -> FrequencyResponse:
        noise = noise_nm * np.random.default_rng(seed).normal(size=SAMPLES)
        sweep = slice(REST, END)
        estimate = welch_response(
            self.angle_rad[sweep],
            (self.torque_nm + noise)[sweep],
            RATE_HZ,
            **{**asdict(SEGMENTS), **kwargs},
        )
        return estimate.band(0.8, 50.0)

    def aware(self, h1: FrequencyResponse, structure, weighting="omega", **kwargs):
        """Fit one structure through the estimator; the link is what is known of the beam."""
        (fit,) = fit_welch_aware(
            self.angle_rad, RATE_HZ, h1.frequency_hz, h1.response, SEGMENTS, LINK,
            [structure], weighting, estimated_from=slice(REST, END), **kwargs,
        )  # fmt: skip
        return fit


def _of_modes(s, beam, damping, offsets):
    """Modes 1, 2, … with another stiffness in place of their own."""
    p = beam.density_kg_per_m * s**2
    p = p + damping.gamma * beam.bending_stiffness_n_m2 * s**damping.lambda_
    q = beam.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    of_modes = (clamped_free_eigenvalues(len(offsets)) / beam.length_m) ** 4
    more = 0
    for share, k, offset in zip(participation(beam, len(offsets)), of_modes, offsets, strict=True):
        loose = k * (1 + offset)
        more = more + share * p * q * (loose / (q * loose + p) - k / (q * k + p))
    return more


@cache
def _session(damping, beam=LINK, delay_s=0.0, tool_inertia_kg_m2=0.0, offsets=()):
    t = np.arange(SAMPLES) / RATE_HZ - REST / RATE_HZ
    phase = 2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / 120)
    reference = np.where((t >= 0) & (t < 60), 0.025 * np.sin(phase), 0.0)
    decay = np.exp(-5.0 * np.arange(SAMPLES) / SAMPLES)
    s = 5.0 * RATE_HZ / SAMPLES + 2j * np.pi * np.fft.rfftfreq(4 * SAMPLES, 1 / RATE_HZ)
    loop = 2 * np.pi * 20
    angle = np.fft.rfft(reference * decay, 4 * SAMPLES) / (1 + 1.4 * s / loop + (s / loop) ** 2)
    g = transfer(s, beam, damping) + _of_modes(s, beam, damping, offsets)
    torque = angle * (g + tool_inertia_kg_m2 * s**2) * np.exp(-s * delay_s)
    return Session(*(np.fft.irfft(x, 4 * SAMPLES)[:SAMPLES] / decay for x in (angle, torque)))


@pytest.fixture(scope="session")
def session():
    """Make a session of a damping, and of what else differs from the link at rest."""
    return _session


@pytest.fixture(scope="session")
def link():
    return LINK


@pytest.fixture(scope="session")
def plants():
    return {
        "III": Damping(zeta=0.54e-4, alpha=1.0, gamma=0.02, lambda_=1.0),
        "IV": Damping(zeta=2.49e-4, alpha=0.8, gamma=0.0, lambda_=0.0),
        "VI": Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594),
    }
