"""A session's worth of data from the exact model, made in the frequency domain.

Angle: the paper's chirp behind a double pole at 80 rad/s. Torque: the exact beam's response to it,
by convolution in the frequency domain with zeros for as long again. Both as the instruments give
them: encoder steps of 7e-5 rad, torque noise of 5e-3 N·m and steps of 1.25e-4 N·m.
"""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cases import further
from numpy.typing import NDArray

from analysis.models import STRUCTURES
from rigd.beam import Beam, Damping, transfer
from rigd.session import read_session
from rigd.spectral import FrequencyResponse, welch_response

RATE_HZ = 1000.0
SAMPLES = 120_000
DATA = Path(__file__).parents[1] / "data"


@dataclass(frozen=True, slots=True)
class Sweep:
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]

    def welch(self, overlap: int = 2590) -> FrequencyResponse:
        estimate = welch_response(self.angle_rad, self.torque_nm, RATE_HZ, overlap=overlap)
        return estimate.band(0.5875, 50.0)


@cache
def _angle_spectrum() -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    t = np.arange(SAMPLES) / RATE_HZ
    chirp = 0.025 * np.sin(2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / (2 * 120)))
    s = 2j * np.pi * np.fft.rfftfreq(2 * SAMPLES, 1 / RATE_HZ)
    return s, np.fft.rfft(chirp, 2 * SAMPLES) / (1 + s / 80) ** 2


def _steps(values, step):
    return np.round(values / step) * step


@pytest.fixture(scope="session")
def link() -> Beam:
    """The paper's Table 1."""
    return Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)


@pytest.fixture(scope="session")
def plant() -> Damping:
    """The paper's type VI with frequency-dependent weights."""
    return Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)


@pytest.fixture(scope="session")
def mode_hz() -> NDArray[np.float64]:
    """Undamped clamped-free frequencies of the link."""
    return np.array([16.045, 100.55, 281.55]) / (2 * np.pi)


@pytest.fixture(scope="session")
def paper_grid_hz() -> NDArray[np.float64]:
    return np.arange(94, 8001) / 160


@pytest.fixture(scope="session")
def paper_dampings() -> dict[tuple[str, str], Damping]:
    """Means of the paper's Table 3, by type and weighting."""
    means: dict[tuple[str, str], dict[str, float]] = {}
    with (DATA / "paper_table3.csv").open() as file:
        for row in csv.DictReader(file):
            key = row["type"], row["weighting"]
            means.setdefault(key, {})[row["parameter"]] = float(row["mean"])
    return {key: STRUCTURES[key[0]].damping(values) for key, values in means.items()}


@pytest.fixture(scope="session")
def paper_table4() -> dict[tuple[str, int, str, str], float]:
    """Deviations by quantity, mode, weighting and type."""
    with (DATA / "paper_table4.csv").open() as file:
        return {
            (row["quantity"], int(row["mode"]), row["weighting"], name): float(row[name])
            for row in csv.DictReader(file)
            for name in ("I", "II", "III", "IV", "V", "VI")
        }


@pytest.fixture(scope="session")
def sweep(link: Beam) -> Callable[[Damping, int | None], Sweep]:
    """Make the records of one session; without a seed, free of noise and steps."""

    def make(damping: Damping, seed: int | None) -> Sweep:
        s, angle_spectrum = _angle_spectrum()
        angle = np.fft.irfft(angle_spectrum)[:SAMPLES]
        torque = np.fft.irfft(angle_spectrum * transfer(s, link, damping))[:SAMPLES]
        if seed is None:
            return Sweep(angle, torque)
        noise = np.random.default_rng(seed).normal(scale=5e-3, size=SAMPLES)
        return Sweep(_steps(angle, 7e-5), _steps(torque + noise, 1.25e-4))

    return make


@pytest.fixture(scope="session")
def clean_frf(sweep, plant) -> FrequencyResponse:
    return sweep(plant, None).welch()


@pytest.fixture(scope="session")
def synthetic_frf(sweep, plant) -> FrequencyResponse:
    return sweep(plant, 7_301_926_554).welch()


@pytest.fixture(scope="session")
def shipped_frf(paper_session) -> FrequencyResponse:
    """Welch's estimate of a session that the rig recorded with the simulation as shipped."""
    session = read_session(paper_session[0])
    samples = session.samples[slice(*session.segments["sweep"])]
    return Sweep(samples["angle_rad"], samples["coupling_torque_nm"]).welch()


@pytest.fixture(scope="session", params=["synthetic", further("shipped")])
def noisy_frf(request) -> FrequencyResponse:
    """A response with noise: of the exact model, and of the shipped simulation."""
    frf: FrequencyResponse = request.getfixturevalue(f"{request.param}_frf")
    return frf
