"""Bias of frequency responses and fits by a controller that feeds the sensor noise back.

The controller feeds the measured torque forward, so the sensor noise moves the motor. N sessions
(``--sessions``) of one plant (``--plant``) are computed exactly, with the paper's chirp or a
multisine (``--multisine``), each twice with the same noise: with the noise moving the motor, and
with the noise in the torque alone. The program prints for every estimator and parameter

* loop: the mean difference of the two, which only the feedback can cause;
* mean error: that of the sessions with feedback;

both in standard deviations between sessions. The fits are those of the paper with 1/omega weights;
beam and clamp are known. The motor (2e-3 kg m², a loop of 80 rad/s, one tick late) is that of
tests/identify.
"""

import argparse
from dataclasses import dataclass, field

import numpy as np
from exact_sessions import BAND_HZ, LINK, PLANTS, RATE_HZ, SWEEP
from gate import Gate, Row
from numpy.typing import NDArray

from analysis.models import STRUCTURES
from analysis.paper import fit_frf
from rigd.beam import Plant, ResponseGrid
from rigd.spectral import FrequencyResponse, instrumental_response, welch_response

SAMPLES = 136_000
NOISE_NM = 1e-2
CLAMP_KG_M2 = 1e-5
DECAY = np.exp(-5.0 * np.arange(SAMPLES) / SAMPLES)
S = 5.0 * RATE_HZ / SAMPLES + 2j * np.pi * np.fft.rfftfreq(4 * SAMPLES, 1 / RATE_HZ)
Real = NDArray[np.float64]
ROWS = tuple(
    # Measured 0.12, 0.59, 0.22 and 0.04 with 40 sessions, standard errors 0.07 to 0.2
    # (docs/validation/paper_method.md), and 0.13, 1.9, 0.87 and 0.32 with four.
    Row(f"{estimator}: largest effect of the feedback", most=most, unit="standard deviations")
    for estimator, most in (("h1", 0.6), ("h2", 2.5), ("hv", 1.2), ("iv", 0.6))
)


def reference_rad(*, multisine: bool) -> Real:
    """Return the paper's chirp, or 12 periods of 10 s with lines from 0.5 to 50 Hz."""
    t = np.arange(SAMPLES) / RATE_HZ - 1
    during = (t >= 0) & (t < 120)
    if not multisine:
        return np.where(during, 0.025 * np.sin(2 * np.pi * (0.05 * t + 49.95 * t**2 / 240)), 0.0)
    line_hz = np.arange(5, 501) / 10
    phases = np.random.default_rng(3).uniform(0, 2 * np.pi, line_hz.size)
    period = np.cos(2 * np.pi * line_hz * t[during][:10_000, None] + phases).sum(axis=1)
    reference = np.zeros(SAMPLES)
    reference[during] = np.tile(0.01 / np.abs(period).max() * period, 12)
    return reference


def answer(spectrum: NDArray[np.complex128]) -> Real:
    """Return the signal of a spectrum."""
    samples: Real = np.fft.irfft(spectrum, 4 * SAMPLES)[:SAMPLES] / DECAY
    return samples


@dataclass(frozen=True, slots=True)
class Records:
    """Measured signals of one session."""

    reference_rad: Real
    angle_rad: Real
    torque_nm: Real

    def response(self, estimator: str) -> FrequencyResponse:
        """Return one of Welch's estimates, in the paper's band."""
        angle, torque = self.angle_rad[SWEEP], self.torque_nm[SWEEP]
        if estimator == "iv":
            found = instrumental_response(self.reference_rad[SWEEP], angle, torque, RATE_HZ)
        else:
            found = welch_response(angle, torque, RATE_HZ, estimator=estimator)
        return found.band(*BAND_HZ)


class Rig:
    """One plant under one excitation."""

    def __init__(self, name: str, *, multisine: bool) -> None:
        self.plant = Plant(LINK, PLANTS[name], 0.0, CLAMP_KG_M2)
        self.reference = reference_rad(multisine=multisine)
        loop = 2 * np.pi * 20
        moved = np.fft.rfft(self.reference * DECAY, 4 * SAMPLES)
        moved = moved / (1 + 1.4 * S / loop + (S / loop) ** 2)
        self.grid = ResponseGrid(S)
        self.angle = answer(moved)
        self.torque = answer(self.grid.evaluate(self.plant, angle_transform=moved)[0])
        self.turned = 500 * S * (S + 310) / (S + 80) ** 4 * np.exp(-S / RATE_HZ)
        self.answered = self.grid.evaluate(self.plant, angle_transform=self.turned)[0]

    def session(self, seed: int, *, fed_back: bool) -> Records:
        """Return a session with noise that moves the motor (`fed_back`) or does not."""
        noise = np.random.default_rng(seed).normal(scale=NOISE_NM, size=SAMPLES)
        angle, torque = self.angle, self.torque + noise
        if fed_back:
            spectrum = np.fft.rfft(noise * DECAY, 4 * SAMPLES)
            angle = angle + answer(spectrum * self.turned)
            torque = torque + answer(spectrum * self.answered)
        return Records(self.reference, angle, torque)


@dataclass(slots=True)
class Found:
    """Values by estimator and parameter: one for every session."""

    values: dict[tuple[str, str], list[float]] = field(default_factory=dict)

    def add(self, estimator: str, parameters: dict[str, float], names: tuple[str, ...]) -> None:
        """Add the values of one session."""
        for name in names:
            self.values.setdefault((estimator, name), []).append(parameters[name])


def fit_all(records: Records, name: str, found: Found) -> None:
    """Fit one session by every estimator."""
    structure = STRUCTURES[name]
    for estimator in ("h1", "h2", "hv", "iv"):
        frf = records.response(estimator)
        fit = fit_frf(
            frf.frequency_hz, frf.response, LINK, structure, "omega",
            tool_inertia_kg_m2=CLAMP_KG_M2,
        )  # fmt: skip
        found.add(estimator, dict(fit.parameters), structure.free)


def main() -> None:
    """Print the errors of one plant, and check the limits of the effect of the feedback."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--plant", choices=PLANTS, default="VI")
    parser.add_argument("--multisine", action="store_true", help="instead of the chirp")
    gate = Gate(ROWS, parser)
    given = gate.given
    rig = Rig(given.plant, multisine=given.multisine)
    fed, apart = Found(), Found()
    for seed in range(given.sessions):
        fit_all(rig.session(seed, fed_back=True), given.plant, fed)
        fit_all(rig.session(seed, fed_back=False), given.plant, apart)
    print(f"Type {given.plant}, {'multisine' if given.multisine else 'chirp'}, ", end="")
    print(f"{given.sessions} sessions; in standard deviations between sessions:")
    largest: dict[str, list[float]] = {}
    for (estimator, name), values in fed.values.items():
        under, alone = np.array(values), np.array(apart.values[estimator, name])
        std = float(alone.std(ddof=1))
        if std == 0:
            continue
        loop = (under - alone) / std
        uncertain = loop.std(ddof=1) / np.sqrt(loop.size)
        largest.setdefault(estimator, []).append(abs(float(loop.mean())))
        error = float(under.mean() - rig.plant.parameters[name]) / std
        print(
            f"  {estimator:9} {name:24} loop {loop.mean():+8.2f} ± {uncertain:.2f}   "
            f"mean error {error:+9.2f}   one std {std:.3g}"
        )
    for estimator, effects in largest.items():
        gate.measured(f"{estimator}: largest effect of the feedback", np.max(effects))
    gate.finish()


if __name__ == "__main__":
    main()
