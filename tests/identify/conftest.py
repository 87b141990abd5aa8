"""Sessions of a plant whose parameters are known, made in the frequency domain.

The torque is the exact beam's response to a chirp through a motor loop of 20 Hz, at the full rate
and with zeros for three times as long again: another grid of s than the estimator's, and no band.
"""

import importlib.util
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.identify import Comparison, Measurement
from analysis.identify._candidates import CandidateSet
from rigd.beam import Beam, Damping, clamped_free_eigenvalues, participation, transfer

RATE_HZ = 1000.0
SWEEP_S = 30
BAND_HZ = (0.0, 50.0)
LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
PLANTS = {
    "VI": Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594),
    "III": Damping(zeta=0.54e-4, alpha=1.0, gamma=0.02, lambda_=1.0),
    "IV": Damping(zeta=2.49e-4, alpha=0.8, gamma=0.0, lambda_=0.0),
    "like springs": Damping(zeta=0.029, alpha=0.31, gamma=0.15, lambda_=0.41),
    "like masses": Damping(zeta=1.3e-4, alpha=1.51, gamma=2.2e-3, lambda_=1.1),
}


@dataclass(frozen=True, slots=True)
class Session:
    """Signals of ideal instruments, without noise."""

    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]

    def measured(
        self,
        noise_nm: float = 0.0,
        seed: int = 0,
        beam: Beam = LINK,
        unknown_angle: NDArray[np.intp] | None = None,
        unknown_torque: NDArray[np.intp] | None = None,
        rest_angle_rad: float | None = 0.0,
    ) -> Measurement:
        """As the estimator gets it; unknown values are nonsense in it."""
        n = self.angle_rad.size
        noise = np.random.default_rng(seed).normal(scale=noise_nm or 1.0, size=n)
        angle = self.angle_rad.copy()
        torque = self.torque_nm + (noise if noise_nm else 0.0)
        angle_known, torque_known = np.ones((2, n), dtype=bool)
        if unknown_angle is not None:
            angle_known[unknown_angle] = False
            angle[unknown_angle] = np.nan
        if unknown_torque is not None:
            torque_known[unknown_torque] = False
            torque[unknown_torque] = 1e3
        return Measurement(
            name="session.mcap",
            angle_rad=angle,
            torque_nm=torque,
            rate_hz=RATE_HZ,
            beam=beam,
            angle_known=angle_known,
            torque_known=torque_known,
            rest_angle_rad=rest_angle_rad,
            uniformity=0.0,  # these beams are as uniform as the equation has them
        )

    def cut(self, first: int, end: int | None = None) -> "Session":
        return Session(self.angle_rad[first:end], self.torque_nm[first:end])


def beyond_uniform(s, beam, damping, offsets):
    """Modes 2, 3, … with another stiffness instead of their own."""
    p = beam.density_kg_per_m * s**2
    p = p + damping.gamma * beam.bending_stiffness_n_m2 * s**damping.lambda_
    q = beam.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    participations = participation(beam, 1 + len(offsets))[1:]
    of_modes = (clamped_free_eigenvalues(1 + len(offsets))[1:] / beam.length_m) ** 4
    more = 0
    for fraction, k, offset in zip(participations, of_modes, offsets, strict=True):
        loose = k * (1 + offset)
        more = more + fraction * p * q * (loose / (q * loose + p) - k / (q * k + p))
    return more


def response(reference, damping, beam, delay_s, tool_inertia_kg_m2, offsets, follows_at_once=False):
    n = reference.size
    padded = 4 * n
    decay = np.exp(-5.0 * np.arange(n) / n)
    s = 5.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(padded, 1 / RATE_HZ)
    loop = s / (2 * np.pi * 20)
    lag = 1 if follows_at_once else 1 + 1.4 * loop + loop**2
    angle = np.fft.rfft(reference * decay, padded) / lag
    g = transfer(s, beam, damping) + beyond_uniform(s, beam, damping, offsets)
    torque = angle * (g + tool_inertia_kg_m2 * s**2)
    torque *= np.exp(-s * delay_s)
    return Session(*(np.fft.irfft(x, padded)[:n] / decay for x in (angle, torque)))


def sweep_rad(t, sweep_s=SWEEP_S):
    phase = 2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / (2 * sweep_s))
    return np.where((t >= 0) & (t < sweep_s), 0.025 * np.sin(phase), 0.0)


def multisine_rad(t, duration_s=SWEEP_S):
    """A period of 10 s, over and over."""
    line_hz = np.arange(10, 401) / 10
    phases = np.random.default_rng(3).uniform(0, 2 * np.pi, line_hz.size)
    during = (t >= 0) & (t < duration_s)
    period = np.cos(2 * np.pi * line_hz * t[during][:10_000, None] + phases).sum(axis=1)
    reference = np.zeros(t.size)
    reference[during] = np.tile(0.01 / np.abs(period).max() * period, duration_s // 10)
    return reference


@cache
def session(
    name: str,
    beam: Beam = LINK,
    delay_s: float = 0.0,
    tool_inertia_kg_m2: float = 0.0,
    shaken: bool = False,
    offsets: tuple[float, ...] = (),
    multisine: bool = False,
    sweep_s: int = SWEEP_S,
) -> Session:
    """One second of rest, 0.05-50 Hz, 10 s of ring-down; if shaken, 5 s of that before.

    With `multisine`, 391 lines from 1 to 40 Hz instead of the sweep.
    """
    before = 5.0 if shaken else 0.0
    t = np.arange(round((before + sweep_s + 11) * RATE_HZ)) / RATE_HZ - before - 1
    reference = (multisine_rad if multisine else sweep_rad)(t, sweep_s)
    reference[t < -2] += 0.01 * np.sin(2 * np.pi * 2.6 * (t[t < -2] + 1 + before))
    reference[t < -2] += 0.002 * np.sin(2 * np.pi * 16 * (t[t < -2] + 1 + before))
    return response(reference, PLANTS[name], beam, delay_s, tool_inertia_kg_m2, offsets)


@pytest.fixture(scope="session")
def sessions():
    """Make a session of one of the `PLANTS`: see `session`."""
    return session


@pytest.fixture(scope="session")
def responding():
    """Make the session of a plant whose motor follows a reference: see `response`."""
    return lambda reference, damping, beam: response(reference, damping, beam, 0.0, 0.0, ())


@pytest.fixture(scope="session")
def moved_unseen():
    """Make a session in which the motor also makes a bump of a size in each of some gaps."""

    def moved(name: str, gaps: tuple[tuple[int, int], ...], size_rad: float) -> Session:
        whole = session(name)
        bump_rad = np.zeros(whole.angle_rad.size)
        for first, end in gaps:
            bump_rad[first:end] = size_rad * np.hanning(end - first)
        also = response(bump_rad, PLANTS[name], LINK, 0.0, 0.0, (), follows_at_once=True)
        return Session(whole.angle_rad + also.angle_rad, whole.torque_nm + also.torque_nm)

    return moved


@pytest.fixture(scope="session")
def references():
    """Requested angle of a session, at a number of ticks from its start."""

    def reference(n: int, multisine: bool = False) -> NDArray[np.float64]:
        t = np.arange(n) / RATE_HZ - 1
        return multisine_rad(t) if multisine else sweep_rad(t)

    return reference


@pytest.fixture(scope="session")
def plants():
    return PLANTS


def truth(name, beam=LINK, delay_s=0.0, tool_inertia_kg_m2=0.0):
    damping = PLANTS[name]
    return {
        "zeta": damping.zeta,
        "alpha": damping.alpha,
        "gamma": damping.gamma,
        "lambda": damping.lambda_,
        "density_over_stiffness": beam.density_over_stiffness,
        "bending_stiffness_n_m2": beam.bending_stiffness_n_m2,
        "delay_s": delay_s,
        "tool_inertia_kg_m2": tool_inertia_kg_m2,
    }


@pytest.fixture(scope="session")
def true_parameters():
    return truth


@pytest.fixture(scope="session")
def link():
    return LINK


@cache
def step(name, amplitude_rad, delay_s=0.0, rest_s=1.0, held_s=10.0):
    """Step of the motor, held until the record ends."""
    t = np.arange(round((rest_s + held_s) * RATE_HZ)) / RATE_HZ - rest_s
    requested_rad = np.where(t >= 0, amplitude_rad, 0.0)
    return response(requested_rad, PLANTS[name], LINK, delay_s, 0.0, ())


@pytest.fixture(scope="session")
def steps():
    """Make a session with a step: see `step`."""
    return step


@cache
def extra_torque(name, rise, sweep_s=SWEEP_S):
    """Additional torque of mode 1 of plant `name` (damping of order 1), stiffer by `rise`.

    Runge and Kutta's method on the mode's equation of motion, in y = r + angle:
    ``rho/EI y'' + gamma y' + k (r + zeta r' + rise r³ / R²) = 0``.
    """
    damping, beam, step = PLANTS[name], LINK, 1 / RATE_HZ
    assert damping.alpha == damping.lambda_ == 1
    angle_rad = session(name, sweep_s=sweep_s).angle_rad
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
    fraction = float(participation(beam, 1)[0]) * beam.bending_stiffness_n_m2
    return -fraction * (run(rise / largest**2)[0] - linear)


@pytest.fixture(scope="session")
def stiffening():
    """Compute the torque that a stiffness rising with the deflection adds: see `extra_torque`."""
    return extra_torque


@pytest.fixture(scope="session")
def brake():
    """Drag by steps in time: see `brake.py`."""
    spec = importlib.util.spec_from_file_location("brake", Path(__file__).with_name("brake.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def candidates_of():
    """Fit all structures to a measurement, in the usual band: its candidate set."""
    return lambda measurement: CandidateSet.from_measurement(measurement, (), BAND_HZ)


@pytest.fixture(scope="session")
def freest_of():
    """Fit the freest structure alone to a measurement, in the usual band: its candidate set."""
    return lambda measurement: CandidateSet.fit_freest_structure(measurement, (), BAND_HZ)


@pytest.fixture(scope="session")
def candidates():
    """Make a candidate set of candidates that a test made up, without a record."""

    def of(*made_up):
        ranked = tuple(sorted(made_up, key=lambda each: each.bic))
        return CandidateSet(
            comparison=None, noise=None, free_settings=(), candidates=ranked, effect_spectra=()
        )

    return of


@pytest.fixture(scope="session")
def decimation():
    """Decimation of a record at 1 kHz to the usual band."""
    return Comparison.from_measurement(session("VI").measured(), BAND_HZ).decimation
