"""Measured responses published by others, with their modes, and two fits.

`impact_test` is part of the project (tests/data/impact_test). `blade` and `brake_reuss_beam` read
files that may not be redistributed here; `bench_published_modes.py` states their sources.

`fit_poles` is the reference: vector fitting (Gustavsen and Semlyen 1999) in the frequency domain,
with code independent of the analyzer. `fit_record` is the modal model of the analyzer, fitted to a
record. `periodic_record` makes a record in time that has a measured response exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.identify import Comparison, Measurement
from analysis.identify._modal_fit import fit_modes
from analysis.identify.noise import NoiseSpectrum
from rigd.beam import Beam

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

DATA = Path(__file__).parents[1] / "tests" / "data"


@dataclass(frozen=True, slots=True)
class Resonance:
    """Natural frequency and damping ratio of one mode."""

    frequency_hz: float
    damping_ratio: float


@dataclass(frozen=True, slots=True)
class MeasuredResponse:
    """Frequency response at equidistant lines, multiples of their distance."""

    name: str
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]

    @property
    def line_hz(self) -> float:
        """Distance of the lines."""
        return float(self.frequency_hz[-1] - self.frequency_hz[0]) / (self.frequency_hz.size - 1)

    def within(self, first_hz: float, last_hz: float) -> MeasuredResponse:
        """Return the lines of a band."""
        inside = (self.frequency_hz >= first_hz) & (self.frequency_hz <= last_hz)
        return MeasuredResponse(self.name, self.frequency_hz[inside], self.response[inside])


@dataclass(frozen=True, slots=True)
class PublishedMode:
    """Result of another program for the lines of one band."""

    first_hz: float
    last_hz: float
    resonance: Resonance


@dataclass(frozen=True, slots=True)
class InputOutput:
    """Time series of one input and one output."""

    rate_hz: float
    input: NDArray[np.float64]
    output: NDArray[np.float64]


def impact_test() -> tuple[MeasuredResponse, list[PublishedMode]]:
    """Return the response of the impact test and its published modes."""
    folder = DATA / "impact_test"
    frequency_hz, real, imaginary = np.loadtxt(
        folder / "response.csv", delimiter=",", skiprows=1, unpack=True
    )
    table = np.loadtxt(folder / "published_modes.csv", delimiter=",", skiprows=1)
    modes = [PublishedMode(row[0], row[1], Resonance(row[2], row[3])) for row in table.tolist()]
    return MeasuredResponse("impact test", frequency_hz, real + 1j * imaginary), modes


def blade(path: Path) -> tuple[InputOutput, MeasuredResponse]:
    """Return the record of SBPA_lame.mat and the response in the last period of its input."""
    from scipy.io import loadmat

    file = loadmat(path)
    rate_hz = round(1 / float(file["h"].item()), 3)
    samples = int(file["Ns"].item())
    excitation, motion = file["data"].astype(float).T
    spectra = np.fft.rfft(np.stack([excitation, motion])[:, -samples:])
    lines = slice(1, spectra.shape[1])
    frequency_hz = np.arange(spectra.shape[1]) * (rate_hz / samples)
    response = spectra[1, lines] / spectra[0, lines]
    return (
        InputOutput(rate_hz, excitation, motion),
        MeasuredResponse("blade", frequency_hz[lines], response),
    )


def brake_reuss_beam(path: Path) -> list[MeasuredResponse]:
    """Return acceleration over force at each constant acceleration of the Brake-Reuss beam."""
    from scipy.io import loadmat

    file = loadmat(path, squeeze_me=True, struct_as_record=False)
    return [
        MeasuredResponse(
            f"Brake-Reuss beam, {np.median(level.amplitude):.0f} m/s²",
            level.frequency,
            level.amplitude / level.force * np.exp(1j * level.phase),
        )
        for level in file["FRdata"].ResponseControl
    ]


def fit_poles(
    measured: MeasuredResponse, starts_hz: Sequence[float], background: int
) -> list[Resonance]:
    """Return the modes of a response by vector fitting, by rising frequency.

    Complex residues and a real polynomial in s with `background` coefficients are free. Every line
    counts alike.
    """
    largest = 2 * np.pi * measured.frequency_hz[-1]
    s = 2j * np.pi * measured.frequency_hz / largest
    poles = 2 * np.pi * np.array(starts_hz) * (1j - 0.005) / largest
    polynomial = s[:, None] ** np.arange(background)
    for _ in range(100):
        upper, lower = 1 / (s[:, None] - poles), 1 / (s[:, None] - poles.conj())
        fractions = np.stack([upper + lower, 1j * (upper - lower)], axis=2).reshape(s.size, -1)
        equations = np.hstack([fractions, polynomial, -measured.response[:, None] * fractions])
        matrix = np.vstack([equations.real, equations.imag])
        scale = np.linalg.norm(matrix, axis=0)
        right = np.concatenate([measured.response.real, measured.response.imag])
        solution = np.linalg.lstsq(matrix / scale, right)[0] / scale
        weights = solution[-2 * poles.size :]
        # The zeros of 1 + sum(weights * fractions) are the poles of the next step.
        companion = -np.outer(np.tile([2.0, 0.0], poles.size), weights)
        for index, pole in enumerate(poles):
            block = slice(2 * index, 2 * index + 2)
            companion[block, block] += [[pole.real, pole.imag], [-pole.imag, pole.real]]
        zeros = np.linalg.eigvals(companion)
        found = np.array(sorted(zeros[zeros.imag > 0], key=abs))
        if found.size != poles.size:
            raise ValueError(f"{measured.name}: {found.size} of {poles.size} poles are complex.")
        change, poles = np.abs(found - poles).max(), found
        if change < 1e-12:
            break
    else:
        raise ValueError(f"{measured.name}: the poles do not settle.")
    sizes = np.abs(poles)
    return [
        Resonance(float(size * largest / (2 * np.pi)), float(-pole.real / size))
        for pole, size in zip(poles, sizes, strict=True)
    ]


def fit_record(
    record: InputOutput, band_hz: tuple[float, float], starts_hz: Sequence[float]
) -> list[Resonance]:
    """Return the modes by the modal model of the analyzer, one for each start.

    The input is used as the angle, the output as the torque.
    """
    known = np.ones(record.input.size, dtype=bool)
    measurement = Measurement(
        "record",
        record.input,
        record.output - record.output[0],
        record.rate_hz,
        Beam(1.0, 0.1, 1.0),  # whose modes are not used
        known,
        known,
        rest_angle_rad=0.0,
    )
    comparison = Comparison.from_measurement(measurement, band_hz)
    torque = comparison.spectrum(comparison.torque_nm[comparison.retained_samples])
    power = np.full(torque.size, np.mean(np.abs(torque) ** 2))
    white = NoiseSpectrum(power, np.ones(torque.size, dtype=bool), ())
    starts = [(number, hz, 0.005) for number, hz in enumerate(starts_hz, start=1)]
    found = fit_modes(comparison, white, starts)
    if found is None:
        raise ValueError("No mode shows in the band.")
    modes = [found.mode(number) for number in found.visible_mode_numbers]
    return [Resonance(mode.frequency_hz, mode.damping_ratio) for mode in modes]


def phase_resonance(measured: MeasuredResponse) -> Resonance:
    """Return the mode of a single resonance by its phase: -90° and ±45° about it."""
    phase = np.unwrap(np.angle(measured.response))
    at_hz = np.interp([np.pi / 4, np.pi / 2, 3 * np.pi / 4], -phase, measured.frequency_hz)
    return Resonance(float(at_hz[1]), float((at_hz[2] - at_hz[0]) / (2 * at_hz[1])))


def periodic_record(
    measured: MeasuredResponse, rate_hz: float, periods: int, *, slowdown: int = 1
) -> InputOutput:
    """Return a steady record that has the measured response at each of its lines.

    The input is a sweep through the lines that repeats after 1 / line_hz: the output at the lines
    then needs no interpolation, however narrow a resonance is, and what the analyser cut off of a
    decay only scales the residue. With `slowdown` N, all times are N times as long: frequencies
    fall to 1/N of the measured ones and damping ratios stay. The record begins in mid-motion: the
    free decay at its beginning has to be part of the model.
    """
    samples = rate_hz * slowdown / measured.line_hz
    lines = measured.frequency_hz / measured.line_hz
    if not (math.isclose(samples, round(samples)) and np.allclose(lines, np.round(lines))):
        raise ValueError(f"{measured.name}: a period is no whole number of samples.")
    order = np.arange(lines.size)
    spectra = np.zeros((2, round(samples) // 2 + 1), dtype=complex)
    at = np.round(lines).astype(int)
    if at[-1] >= spectra.shape[1]:
        raise ValueError(f"{measured.name}: lines lie beyond half the rate.")
    spectra[0, at] = np.exp(-1j * np.pi * order * (order + 1) / lines.size)
    spectra[1] = spectra[0]
    spectra[1, at] *= measured.response
    signals = np.fft.irfft(spectra, round(samples)) * round(samples)
    return InputOutput(rate_hz, *np.tile(signals, (1, periods)))
