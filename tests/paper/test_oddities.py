"""The oddities of the paper's results, on short sessions of beams whose parameters are known.

`benchmarks/bench_oddities.py` shows them on sessions as long as the paper's. These are half as
long: a chirp of 60 s at 500 Hz. The torque comes from the exact beam; modes of another stiffness
from the sum over modes.
"""

from dataclasses import asdict, dataclass
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.models import STRUCTURES
from analysis.paper import fit_many
from rigd.beam import Damping, clamped_free_eigenvalues, modes, participation, transfer
from rigd.spectral import (
    FrequencyResponse,
    Segmentation,
    segment_count,
    segment_lengths,
    welch_response,
)

RATE_HZ = 500.0
REST, END, SAMPLES = 500, 30_500, 34_000
SEGMENTS = Segmentation(*segment_lengths(END - REST, 8, 0.15), 40_000)
INTEGER = Damping(zeta=7.1e-5, alpha=1.0, gamma=5.5e-2, lambda_=0.594)
NOT_UNIFORM = (0.006, 0.005, -0.013)


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


def of_modes(s, beam, damping, offsets):
    """Modes 1, 2, … with another stiffness instead of their own."""
    p = beam.density_kg_per_m * s**2
    p = p + damping.gamma * beam.bending_stiffness_n_m2 * s**damping.lambda_
    q = beam.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    stiffness = (clamped_free_eigenvalues(len(offsets)) / beam.length_m) ** 4
    more = 0
    for fraction, k, offset in zip(
        participation(beam, len(offsets)), stiffness, offsets, strict=True
    ):
        loose = k * (1 + offset)
        more = more + fraction * p * q * (loose / (q * loose + p) - k / (q * k + p))
    return more


@pytest.fixture(scope="module")
def session(link):
    """Make a session of a damping, and of a stiffness of the modes that is not the link's."""

    @cache
    def made(damping, offsets=()):
        t = np.arange(SAMPLES) / RATE_HZ - REST / RATE_HZ
        phase = 2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / 120)
        reference = np.where((t >= 0) & (t < 60), 0.025 * np.sin(phase), 0.0)
        decay = np.exp(-5.0 * np.arange(SAMPLES) / SAMPLES)
        s = 5.0 * RATE_HZ / SAMPLES + 2j * np.pi * np.fft.rfftfreq(4 * SAMPLES, 1 / RATE_HZ)
        loop = 2 * np.pi * 20
        angle = np.fft.rfft(reference * decay, 4 * SAMPLES) / (1 + 1.4 * s / loop + (s / loop) ** 2)
        torque = angle * (transfer(s, link, damping) + of_modes(s, link, damping, offsets))
        return Session(*(np.fft.irfft(x, 4 * SAMPLES)[:SAMPLES] / decay for x in (angle, torque)))

    return made


def paper_route(h1, link, names):
    """Parameters by type and weighting."""
    fits = fit_many(h1.frequency_hz, h1.response, link, [STRUCTURES[name] for name in names])
    return {(fit.structure.name, fit.weighting): fit.parameters for fit in fits}


@pytest.fixture(scope="module")
def found(session, link):
    """Fit to a beam of internal damping of order 1, whose modes are not a uniform one's."""
    h1 = session(INTEGER, offsets=NOT_UNIFORM).h1(noise_nm=1e-2, seed=1)
    return paper_route(h1, link, ["I", "III", "IV", "VI"])


@pytest.mark.fit
@pytest.mark.parametrize("name", ["I", "IV"])
def test_internal_damping_alone_is_many_times_larger_with_omega_weights(found, name):
    assert 4 < found[name, "omega"]["zeta"] / found[name, "const"]["zeta"] < 20


@pytest.mark.fit
def test_type_iii_hardly_depends_on_the_weights(found):
    const, omega = found["III", "const"], found["III", "omega"]
    assert omega["zeta"] / const["zeta"] == pytest.approx(1.0, abs=0.2)
    assert omega["gamma"] / const["gamma"] == pytest.approx(1.0, abs=0.3)


@pytest.mark.fit
def test_stiffness_offsets_appear_as_a_fractional_order(found, session, link):
    assert found["VI", "const"]["alpha"] > 1.25
    assert found["VI", "const"]["zeta"] < INTEGER.zeta / 3
    uniform = paper_route(session(INTEGER).h1(noise_nm=1e-2, seed=1), link, ["VI"])
    assert uniform["VI", "const"]["alpha"] == pytest.approx(1.0, abs=0.08)


def test_the_first_peak_saturates(session, link):
    """However little the damping, Welch's peak is no higher and no narrower than the window's."""
    hz = np.linspace(2.2, 2.9, 14_001)
    true_db, welch_db, welch_hz = [], [], []
    for fraction in (0.05, 0.1, 0.2):
        damping = Damping(INTEGER.zeta, 1.0, INTEGER.gamma * fraction, INTEGER.lambda_)
        true_db.append(20 * np.log10(np.abs(transfer(2j * np.pi * hz, link, damping)).max()))
        h1 = session(damping).h1().band(2.2, 2.9)
        size = np.abs(h1.response)
        welch_db.append(20 * np.log10(size.max()))
        welch_hz.append(np.count_nonzero(size > size.max() / np.sqrt(2)) * RATE_HZ / SEGMENTS.nfft)
    assert true_db[0] - true_db[2] > 6
    assert welch_db[0] - welch_db[2] < 1.5
    assert true_db[0] - welch_db[0] > 12
    assert min(welch_hz) > 0.9 * max(welch_hz)


@pytest.mark.fit
def test_first_damping_is_that_of_the_window(session, link):
    damping = Damping(INTEGER.zeta, 1.0, INTEGER.gamma * 0.1, INTEGER.lambda_)
    true = modes(link, damping, 1)[0].damping_ratio
    h1 = session(damping).h1(noise_nm=1e-3, seed=1)
    for parameters in paper_route(h1, link, ["VII"]).values():
        plain = STRUCTURES["VII"].damping(parameters)
        assert modes(link, plain, 1)[0].damping_ratio > 2 * true


def test_one_sample_less_of_overlap_loses_the_third_peak(session, link):
    """Sweep of 30 000 samples: eight segments of 4317 overlap by 648 or end after it."""
    assert segment_count(30_000, 4317, 648) == 8
    assert segment_count(30_000, 4317, 647) == 7
    made = session(INTEGER)
    lengths = {"segment_length": 4317}
    eight, seven = (made.h1(overlap=overlap, **lengths) for overlap in (648, 647))
    for h1, lost in ((eight, False), (seven, True)):
        third = np.abs(h1.band(44.0, 46.0).response).max()
        truth = np.abs(transfer(2j * np.pi * 44.83, link, INTEGER))
        assert (20 * np.log10(third / truth) < -3) == lost
