"""Fit of the modal model to a record, by output error as that of the beam.

The linear parameters (residues and background) are eliminated at each point, so that the search is
over frequency and damping of each mode alone (variable projection). With numerators of one size
within the band::

    G(s) = sum_k (A_k + B_k q) q² / (1 + eta_k q + q²) + b0 + … + b4 s⁴,    q = s / omega_k

is the pole-residue form (`ModalModel`) with another background. The spectrum of the noise is
estimated from the residual, in turns with the fit; it may have any smooth shape.

References
----------
G. H. Golub and V. Pereyra, Separable nonlinear least squares, Inverse Problems 19 (2003) R1-R26.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._modal_model import BACKGROUND, ModalEstimate, ModalModel
from analysis.identify._result import Ringing
from analysis.identify.free_decay import Pole, mode_poles
from analysis.identify.noise import smooth_power, with_peaks
from analysis.identify.residual_tests import input_relation, whiteness
from analysis.optimizer import Box, NormalEquations, Recent, descend
from rigd.beam import LoadedBeam

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._plant import Plant
    from analysis.identify.noise import NoiseSpectrum
    from analysis.identify.residual_tests import InputRelation, Whiteness

_TOLERANCE: Final = 1e-8
_NARROWEST: Final = 1e-5
_WIDEST: Final = 1.0
"""Least and largest eta, twice the damping ratio."""

_NEAR: Final = 0.15
"""How far a mode may be from where the search begins, relatively."""

_LOWEST: Final = 0.12
"""Lowest frequency compared, relative to the first mode: below are drift and 1/f noise, and nothing
that determines a mode."""

_HALF_WIDTHS: Final = 3.0
_NEAREST: Final = 0.02
_NEAREST_BINS: Final = 24
"""Range about a mode in which the noise has no narrow peak: in half-widths, at least relative to
the frequency, and bins beyond."""

_NOISE_PASSES: Final = 3
_CONVERGED: Final = 0.02
"""Change of the noise's mean logarithm below which it is not estimated again."""

_MOST_FURTHER: Final = 2
"""Limit of resonances in addition to those of the beam: of the sensor or the mount."""

_EVIDENCE: Final = 60.0
"""Deviance that a further resonance must save."""

_VISIBLE: Final = 400.0
"""Deviance by which a mode must improve the fit: its damping ratio is then known to a tenth."""


@dataclass(frozen=True, slots=True)
class ModalFit(ModalEstimate):
    """Modal model fitted to a record.

    Attributes
    ----------
    evidence : tuple of float
        Deviance reduction by each mode.
    residual : ndarray of complex, shape (K,)
        Whitened; parts of variance 1 where chance is all that remains.
    noise : Noise
        As estimated from this residual; bins below the first mode do not count.
    whiteness : Whiteness
    input_relation : InputRelation
    ringing : Ringing
        Free decay with which the record begins.
    span : ndarray, shape (r, 2 K)
        Orthonormal rows that all derivatives of the whitened residual span, its real and imaginary
        parts side by side.
    """

    evidence: tuple[float, ...]
    residual: NDArray[np.complex128]
    noise: NoiseSpectrum
    whiteness: Whiteness
    input_relation: InputRelation
    ringing: Ringing
    span: NDArray[np.float64]

    def saved_by(self, columns: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the squares that each of some further columns would save, shape (c,).

        Parameters
        ----------
        columns : ndarray of complex, shape (c, K)
            Spectra in N·m, not whitened.
        """
        white = np.ascontiguousarray(columns * self.noise.weight).view(np.float64)
        white -= (white @ self.span.T) @ self.span
        along = white @ self.residual.view(np.float64)
        squares = np.maximum(np.einsum("ij,ij->i", white, white), np.finfo(float).tiny)
        saved: NDArray[np.float64] = along**2 / squares
        return saved

    @property
    def explained(self) -> bool:
        """Return whether only noise remains."""
        return self.whiteness.white and not self.input_relation.related

    @property
    def visible(self) -> tuple[int, ...]:
        """Return the numbers of the beam's modes that the record shows."""
        shown = zip(self.numbers, self.evidence, strict=True)
        return tuple(sorted(number for number, saved in shown if number and saved > _VISIBLE))

    def plant_like(self, plant: Plant) -> Plant:
        """Return a plant with the frequencies of the visible modes, each by its own stiffness.

        Parameters
        ----------
        plant : Plant
            Without anything at its ends.
        """
        visible = self.visible
        if not visible or any(plant.extras.values()) or len(visible) != visible[-1]:
            return plant
        poles = dict(zip(self.numbers, self.model.poles_rad_s, strict=True))
        frequency_hz = [poles[number].imag / (2 * math.pi) for number in visible]
        try:
            like = LoadedBeam(plant.beam, plant.damping).with_frequencies(frequency_hz)
        except ValueError:
            return plant
        return replace(plant, beam=like.beam, stiffness_offsets=like.stiffness_offsets)


def fit_modes(
    comparison: Comparison,
    noise: NoiseSpectrum,
    starts: Sequence[tuple[int, float, float]],
    columns: NDArray[np.complex128] | None = None,
) -> ModalFit | None:
    """Fit the modal model to a record.

    Parameters
    ----------
    comparison : Comparison
    noise : Noise
        First estimate; its lines stay excluded.
    starts : sequence of (int, float, float)
        Number, frequency (Hz) and damping ratio of each mode, roughly.
    columns : ndarray of complex, shape (c, K), optional
        Spectra of known shape and unknown size, as for `Objective`.

    Returns
    -------
    ModalFit or None
        None if no mode is within the band.
    """
    inside = [each for each in starts if each[1] <= comparison.frequency_hz[-1]]
    if not inside:
        return None
    further = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
    further = further if columns is None else columns
    lowest_hz = _LOWEST * min(hz for _, hz, _ in inside)
    counts = noise.counts & (comparison.frequency_hz >= lowest_hz)
    search = _ModalSearch(
        comparison,
        replace(noise, counts=counts),
        further,
        tuple(number for number, _, _ in inside),
        np.array([[math.log(2 * math.pi * hz), 2 * ratio] for _, hz, ratio in inside]).ravel(),
    )
    return search.without_unexcited_modes().converged().with_further_resonances().fit()


@dataclass(frozen=True, slots=True)
class _ModalSearch:
    """Modes at one point of the search, under one noise estimate."""

    comparison: Comparison
    noise: NoiseSpectrum
    further: NDArray[np.complex128]
    numbers: tuple[int, ...]
    x: NDArray[np.float64]

    def problem(self) -> _ModalProblem:
        """Return the residual of these modes under this noise."""
        return _ModalProblem(self.comparison, self.noise.weight, self.further, self.numbers)

    def descended(self) -> _ModalSearch:
        """Descend under this noise."""
        low = np.column_stack([self.x[::2] - _NEAR, np.full(len(self.numbers), _NARROWEST)])
        high = np.column_stack([self.x[::2] + _NEAR, np.full(len(self.numbers), _WIDEST)])
        found = descend(
            self.problem().normal_equations,
            self.x,
            Box(low.ravel(), high.ravel()),
            relative_tolerance=_TOLERANCE,
            max_evaluations=60,
        )
        return replace(self, x=found.x)

    def converged(self) -> _ModalSearch:
        """Alternate descents with estimates of noise and unknown torque until they converge."""
        search = self
        for _ in range(_NOISE_PASSES):
            search = search.descended()
            problem = search.problem()
            model = problem.model(search.x)
            residual = problem.residual(search.x, model)
            comparison = search.comparison.renewed(model, search.noise).filled(model)
            power = smooth_power(residual, finely=True)
            power = with_peaks(residual, power, ~search.near_modes())
            power /= comparison.measurement.known_torque_fraction
            counts = search.noise.counts
            change = np.abs(np.log(power / search.noise.power)[counts]).mean()
            search = replace(
                search, comparison=comparison, noise=replace(search.noise, power=power)
            )
            if change < _CONVERGED and comparison.measurement.torque_known.all():
                break
        return search.descended()

    def near_modes(self) -> NDArray[np.bool_]:
        """Return the bins in which the residual may belong to a mode, shape (K,)."""
        hz = self.comparison.frequency_hz[:, None]
        frequencies, eta = np.exp(self.x[::2]) / (2 * np.pi), self.x[1::2]
        bins_hz = _NEAREST_BINS * float(hz[1, 0] - hz[0, 0])
        reach = np.maximum(_HALF_WIDTHS * eta / 2, _NEAREST) * frequencies + bins_hz
        near: NDArray[np.bool_] = np.any(np.abs(hz - frequencies) < reach, axis=1)
        return near

    def cost(self) -> float:
        """Return the sum of whitened squares at this point."""
        residual = self.problem().at(self.x).residual
        return float(residual @ residual)

    def with_further_resonances(self) -> _ModalSearch:
        """Add a resonance where the residual still follows the angle, if it explains that."""
        search = self
        for _ in range(_MOST_FURTHER):
            related = search.relation(search.problem().at(search.x))
            if not related.related:
                break
            start = [math.log(2 * math.pi * related.at_hz), 0.02]
            more = replace(
                search, numbers=(*search.numbers, 0), x=np.concatenate([search.x, start])
            ).converged()
            at = replace(search, noise=more.noise, comparison=more.comparison).descended()
            if at.cost() - more.cost() < _EVIDENCE or more.last_overlaps():
                break
            search = more
        return search

    def last_overlaps(self) -> bool:
        """Return whether the last resonance lies within the width of another."""
        frequencies = np.exp(self.x[::2])
        half_widths = frequencies * self.x[1::2] / 2
        reach = _HALF_WIDTHS * (half_widths[:-1] + half_widths[-1])
        return bool(np.any(np.abs(frequencies[:-1] - frequencies[-1]) < reach))

    def without_unexcited_modes(self) -> _ModalSearch:
        """Remove modes that save nothing at first and then follow a line of the noise."""
        saved = self.evidence()
        if saved.min() >= _EVIDENCE:
            return self
        undamped = self.descended().x[1::2] < 2 * _NARROWEST
        search = self
        for index in np.flatnonzero((saved < _EVIDENCE) & undamped)[::-1].tolist():
            search = search._without(index)
        return search

    def _without(self, index: int) -> _ModalSearch:
        numbers = self.numbers[:index] + self.numbers[index + 1 :]
        return replace(self, numbers=numbers, x=np.delete(self.x, [2 * index, 2 * index + 1]))

    def evidence(self) -> NDArray[np.float64]:
        """Return the cost reduction by each mode with the others unchanged, shape (n,)."""
        own = self.cost()
        return np.array([self._without(i).cost() - own for i in range(len(self.numbers))])

    def relation(self, point: _ModalPoint) -> InputRelation:
        """Return the relation of the residual at this point to the angle."""
        residual = point.residual.view(np.complex128)
        angle = self.comparison.spectrum(self.comparison.angle_rad[self.comparison.retained])
        counts = self.noise.counts
        first = int(np.argmax(counts))
        return input_relation(residual[first:], angle[first:], self.comparison.frequency_hz[first:])

    def fit(self) -> ModalFit | None:
        """Return the fit without modes that save nothing: they are undetermined."""
        order = np.argsort(self.x[::2])
        search = replace(
            self,
            x=self.x.reshape(-1, 2)[order].ravel(),
            numbers=tuple(self.numbers[i] for i in order),
        )
        saved = search.evidence()
        while saved.size and saved.min() < _EVIDENCE:
            search = search._without(int(np.argmin(saved))).descended()
            saved = search.evidence()
        if not saved.size:
            return None
        x, numbers = search.x, search.numbers
        problem = search.problem()
        point = problem.at(x)
        every = problem.covariance(point)
        constants, covariance = problem.constants(point, x, every)
        residual = point.residual.view(np.complex128)
        counts = search.noise.counts
        return ModalFit(
            model=problem.model(x),
            numbers=numbers,
            constants=constants,
            joint_covariance=covariance,
            evidence=tuple(saved.tolist()),
            residual=residual,
            noise=search.noise,
            whiteness=whiteness(residual[counts], search.comparison.frequency_hz[counts]),
            input_relation=search.relation(point),
            ringing=problem.ringing(point, every),
            span=np.concatenate([point.span, _orthonormal(point.jacobian)[0]]),
        )


def _gram(
    rows: NDArray[np.float64], regularization: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return rows of length 1, their regularized Gram matrix, and their original lengths."""
    scale = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    scale[scale == 0] = 1.0  # a decay that is over at once
    scaled = rows / scale[:, None]
    gram = scaled @ scaled.T
    gram[np.diag_indices_from(gram)] += regularization
    return scaled, gram, scale


def _orthonormal(rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return orthonormal rows with the same span, and the factor that restores the rows."""
    scaled, gram, scale = _gram(rows, 1e-13)
    factor = np.linalg.cholesky(gram)
    return np.linalg.solve(factor, scaled), factor * scale[:, None]


@dataclass(frozen=True, slots=True)
class _ModalPoint:
    """Whitened residual of the best linear parameters at one point, and its derivatives."""

    residual: NDArray[np.float64]
    linear: NDArray[np.float64]
    columns: NDArray[np.float64]
    span: NDArray[np.float64]
    full_jacobian: NDArray[np.float64]
    jacobian: NDArray[np.float64]


def _unit_pole(eta: float) -> complex:
    """Return the upper root of ``1 + eta q + q²``."""
    return complex(-eta / 2, math.sqrt(1 - eta * eta / 4))


def _unit_pole_slope(eta: float) -> complex:
    """Differentiate `_unit_pole` by eta."""
    return complex(-0.5, -eta / (4 * math.sqrt(1 - eta * eta / 4)))


class _ModalProblem:
    """Whitened residual of some modes as a function of frequencies and damping."""

    def __init__(
        self,
        comparison: Comparison,
        weight: NDArray[np.float64],
        further: NDArray[np.complex128],
        numbers: tuple[int, ...],
    ) -> None:
        self._recent: Recent[_ModalPoint] = Recent()
        self._numbers = numbers
        self._comparison = comparison
        self._weight = weight
        self._further = further
        self._s = comparison.prediction.s
        self.scale_rad_s = 2 * math.pi * float(comparison.frequency_hz[-1])
        self._measured = self._white(comparison.spectrum(comparison.torque_nm[comparison.retained]))
        background = np.array([(self._s / self.scale_rad_s) ** n for n in range(BACKGROUND)])
        self._background = self._spectra(background)

    def _white(self, spectra: NDArray[np.complex128]) -> NDArray[np.float64]:
        return np.ascontiguousarray(spectra * self._weight).view(np.float64)

    def _spectra(self, responses: NDArray[np.complex128]) -> NDArray[np.float64]:
        comparison = self._comparison
        return self._white(comparison.spectrum(comparison.prediction.in_time(responses)))

    def _poles(self, x: NDArray[np.float64]) -> list[Pole]:
        """Return the poles at a point, with derivatives by it."""
        poles = []
        for k, (log_omega, eta) in enumerate(x.reshape(-1, 2)):
            omega, q = math.exp(log_omega), _unit_pole(eta)
            derivative = np.zeros(x.size, dtype=np.complex128)
            derivative[2 * k] = omega * q
            derivative[2 * k + 1] = omega * _unit_pole_slope(eta)
            poles.append(Pole(self._numbers[k], omega * q, derivative))
        return poles

    def _nuisance(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        return np.concatenate([self._comparison.nuisance(poles), self._further])

    def _drag(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return the change of the torque by drag with the poles, and derivatives, (1 + k, K)."""
        total = np.zeros((1 + 2 * len(poles), self._weight.size), dtype=np.complex128)
        drag = self._comparison.drag
        if drag is None:
            return total
        own = {pole.mode: pole.at_rad_s for pole in mode_poles(drag.plant, len(drag.by_pole), ())}
        for pole in poles:
            if pole.mode in drag.by_pole and pole.mode in own:
                by_real, by_imaginary = drag.by_pole[pole.mode]
                apart = pole.at_rad_s - own[pole.mode]
                total[0] += apart.real * by_real + apart.imag * by_imaginary
                total[1:] += np.outer(pole.derivative.real, by_real)
                total[1:] += np.outer(pole.derivative.imag, by_imaginary)
        return total

    def at(self, x: NDArray[np.float64]) -> _ModalPoint:
        """Eliminate the linear parameters at ``x = (ln omega_1, eta_1, ln omega_2, …)``.

        The last two points are cached.
        """
        return self._recent.at(x, self._at)

    def _at(self, x: NDArray[np.float64]) -> _ModalPoint:
        modes = x.reshape(-1, 2)
        rows: list[NDArray[np.complex128]] = []
        slopes: list[NDArray[np.complex128]] = []
        for log_omega, eta in modes:
            omega = math.exp(log_omega)
            q = self._s / omega
            over = 1 / (1 + eta * q + q * q)
            numerators = (q * q * over, q**3 * over)
            rows += numerators
            # d/d eta and d/d ln omega of either numerator over the denominator
            for power, row in zip((2, 3), numerators, strict=True):
                slopes.append(row * ((eta * q + 2 * q * q) * over - power))
                slopes.append(-row * q * over)
        count = len(rows)
        spectra = self._spectra(np.array(rows + slopes).reshape(-1, self._s.size))
        poles = self._poles(x)
        nuisance = self._white(self._nuisance(poles))
        drag, *by_drag = self._white(self._drag(poles))
        columns = np.concatenate([spectra[:count], self._background, nuisance])
        span, factor = _orthonormal(columns)
        measured = self._measured - drag
        along = span @ measured
        residual = along @ span - measured
        linear = np.linalg.solve(factor.T, along)
        decays = linear[count + BACKGROUND :]
        jacobian = np.array(by_drag).reshape(x.size, residual.size)
        if poles:
            jacobian += self._white(self._comparison.decay_gradient(poles, decays))
        for k in range(len(modes)):
            a, b = linear[2 * k : 2 * k + 2]
            four = spectra[count + 4 * k : count + 4 * k + 4]
            jacobian[2 * k] += a * four[0] + b * four[2]
            jacobian[2 * k + 1] += a * four[1] + b * four[3]
        projected = jacobian - (jacobian @ span.T) @ span
        return _ModalPoint(residual, linear, columns, span, jacobian, projected)

    def model(self, x: NDArray[np.float64]) -> ModalModel:
        """Return the modal model at a point."""
        linear = self.at(x).linear
        modes = x.reshape(-1, 2)
        poles, residues = [], []
        first = 2 * len(modes)
        background = linear[first : first + BACKGROUND] / self.scale_rad_s ** np.arange(BACKGROUND)
        for k, (log_omega, eta) in enumerate(modes):
            omega, (a, b) = math.exp(log_omega), linear[2 * k : 2 * k + 2]
            q = _unit_pole(eta)
            poles.append(omega * q)
            residues.append(omega * (a + b * q) * q * q / (2j * q.imag))
            # (a + b q) q² over the denominator, less its remainder
            background[0] += a - b * eta
            background[1] += b / omega
        return ModalModel(tuple(poles), tuple(residues), tuple(background.tolist()))

    def residual(self, x: NDArray[np.float64], model: ModalModel) -> NDArray[np.complex128]:
        """Return the residual of the model at a point in N·m, not whitened."""
        first = 2 * len(self._numbers) + BACKGROUND
        amplitudes = self.at(x).linear[first:]
        here = self._poles(x)
        comparison = self._comparison
        torque = comparison.prediction.torque(model)[0]
        bare = comparison.spectrum(torque - comparison.torque_nm[comparison.retained])
        drag: NDArray[np.complex128] = self._drag(here)[0]
        return drag + bare + amplitudes @ self._nuisance(here)

    def covariance(self, point: _ModalPoint) -> NDArray[np.float64]:
        """Return the covariance of the unknowns and the linear parameters."""
        _, gram, scale = _gram(np.concatenate([point.full_jacobian, point.columns]), 1e-14)
        covariance: NDArray[np.float64] = np.linalg.inv(gram) / np.outer(scale, scale)
        return covariance

    def ringing(self, point: _ModalPoint, covariance: NDArray[np.float64]) -> Ringing:
        """Return the free decay at the beginning, two amplitudes a mode, and its chi-square."""
        count = len(self._numbers)
        first = 2 * count + BACKGROUND
        decays = point.linear[first : first + 2 * count]
        rows = slice(2 * count + first, 2 * count + first + 2 * count)
        return Ringing(
            amplitude_nm=tuple(np.hypot(decays[::2], decays[1::2]).tolist()),
            chi_square=float(decays @ np.linalg.solve(covariance[rows, rows], decays)),
            degrees_of_freedom=decays.size,
        )

    def constants(
        self, point: _ModalPoint, x: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return `CONSTANTS` of all modes, and their covariance with that of the background."""
        count = x.size // 2
        constants = np.empty(4 * count)
        linear = x.size + 2 * count  # index of the first coefficient of the background
        chain = np.zeros((4 * count + BACKGROUND, linear + BACKGROUND))
        background = chain[4 * count :]
        background[:, linear:] = np.diag(self.scale_rad_s ** -np.arange(float(BACKGROUND)))
        for k in range(count):
            log_omega, eta = x[2 * k : 2 * k + 2]
            a, b = point.linear[2 * k : 2 * k + 2]
            q = _unit_pole(eta)
            over = a + b * q
            # ln of the residue over j: ln omega + ln (a + b q) + 2 ln q - ln(2 Im q) + j pi
            log_residue = np.log(-over * q * q / (2 * q.imag)) + log_omega
            by_eta_q = _unit_pole_slope(eta)
            by_eta = (b / over + 2 / q) * by_eta_q - by_eta_q.imag / q.imag
            by_a, by_b = 1 / over, q / over
            constants[4 * k : 4 * k + 4] = (
                log_omega + math.log(q.imag / (2 * math.pi)),
                math.log(eta / 2),
                log_residue.real,
                log_residue.imag,
            )
            rows = chain[4 * k : 4 * k + 4]
            omega_at, eta_at, a_at, b_at = 2 * k, 2 * k + 1, x.size + 2 * k, x.size + 2 * k + 1
            rows[0, [omega_at, eta_at]] = 1.0, by_eta_q.imag / q.imag
            rows[1, eta_at] = 1 / eta
            rows[2, [omega_at, eta_at, a_at, b_at]] = 1.0, by_eta.real, by_a.real, by_b.real
            rows[3, [eta_at, a_at, b_at]] = by_eta.imag, by_a.imag, by_b.imag
            # What the numerator leaves beyond the poles, as in `model`.
            background[0, [a_at, b_at, eta_at]] = 1.0, -eta, -b
            background[1, [b_at, omega_at]] = np.array([1.0, -b]) / math.exp(log_omega)
        own = covariance[: chain.shape[1], : chain.shape[1]]
        return constants, chain @ own @ chain.T

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Return the normal equations for the descent (Kaufman's Jacobian)."""
        point = self.at(x)
        return NormalEquations(
            cost=float(point.residual @ point.residual),
            gradient=point.jacobian @ point.residual,
            hessian=point.jacobian @ point.jacobian.T,
        )
