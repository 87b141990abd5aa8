"""Sessions as long as the paper's, of beams with known parameters.

Made in the frequency domain: chirp 0.025 rad, 0.05-50 Hz in 120 s behind a motor loop of 20 Hz, at
1 kHz, 1 s of rest before and 15 s after; encoder steps of 7e-5 rad, torque noise of 1e-2 N·m and
steps of 1.25e-4 N·m.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.identify import Measurement
from rigd.beam import Beam, Damping, Plant, ResponseGrid
from rigd.spectral import FrequencyResponse, Segmentation, welch_response

RATE_HZ = 1000.0
SWEEP = slice(1000, 121_000)
BAND_HZ = (0.5875, 50.0)
LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
PLANTS = {
    "VI": Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594),
    "III": Damping(zeta=0.54e-4, alpha=1.0, gamma=0.02, lambda_=1.0),
    "IV": Damping(zeta=2.49e-4, alpha=0.8, gamma=0.0, lambda_=0.0),
}


@dataclass(frozen=True, slots=True)
class Session:
    """Angle and torque of the exact beam."""

    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]

    def noisy(self, seed: int) -> "Session":
        """Return the session as measured, with noise and quantisation."""
        noise = np.random.default_rng(seed).normal(scale=1e-2, size=self.torque_nm.size)
        return Session(
            np.round(self.angle_rad / 7e-5) * 7e-5,
            np.round((self.torque_nm + noise) / 1.25e-4) * 1.25e-4,
        )

    def h1(self, overlap: int = Segmentation().overlap) -> FrequencyResponse:
        """Return the paper's estimate in its band."""
        return welch_response(
            self.angle_rad[SWEEP], self.torque_nm[SWEEP], RATE_HZ, overlap=overlap
        ).band(*BAND_HZ)

    def measurement(self) -> Measurement:
        """Return the input of the whole-record estimator."""
        known = np.ones(self.angle_rad.size, dtype=bool)
        return Measurement("session", self.angle_rad, self.torque_nm, RATE_HZ, LINK, known, known)


def session(plant: Plant) -> Session:
    """Return the exact response to the chirp, on a finer grid than that of any estimator."""
    n = 136_000
    t = np.arange(n) / RATE_HZ - 1
    chirp = 0.025 * np.sin(2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / 240))
    reference = np.where((t >= 0) & (t < 120), chirp, 0.0)
    decay = np.exp(-5.0 * np.arange(n) / n)
    s = 5.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1 / RATE_HZ)
    loop = 2 * np.pi * 20
    angle = np.fft.rfft(reference * decay, 4 * n) / (1 + 1.4 * s / loop + (s / loop) ** 2)
    torque = ResponseGrid(s).evaluate(plant, angle_transform=angle)[0]
    return Session(*(np.fft.irfft(x, 4 * n)[:n] / decay for x in (angle, torque)))
