"""Fit of the modal model to a record by output error, like the fit of the beam.

The linear parameters (residues and background) are eliminated at each point, so that the search
varies only frequency and damping of each mode (variable projection). The fitted form has numerators
that are of similar size within the band::

    G(s) = sum_k (A_k + B_k q) q² / (1 + eta_k q + q²) + b0 + … + b4 s⁴,    q = s / omega_k

It is the pole-residue form (`ModalModel`) with a different background. Estimates of the noise
spectrum from the residual alternate with the fit. The spectrum may have any smooth form.

References
----------
G. H. Golub and V. Pereyra, Separable nonlinear least squares, Inverse Problems 19 (2003) R1-R26.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._modal_model import BACKGROUND_COEFFICIENTS, ModalEstimate, ModalModel
from analysis.identify._result import Ringing
from analysis.identify.free_decay import Pole, mode_poles
from analysis.identify.noise import noise_power_with_peaks, smooth_power
from analysis.identify.residual_tests import input_relation, whiteness
from analysis.optimizer import Box, NormalEquations, RecentValues, descend
from rigd.beam import LoadedBeam

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._plant import Plant
    from analysis.identify.noise import NoiseSpectrum
    from analysis.identify.residual_tests import InputRelation, Whiteness

_RELATIVE_TOLERANCE: Final = 1e-8
"""Relative tolerance of the sum of squares at which a descent has converged."""

_LEAST_ETA: Final = 1e-5
"""Lower bound of eta, which is twice the damping ratio of a mode."""

_LARGEST_ETA: Final = 1.0
"""Upper bound of eta, which is twice the damping ratio of a mode."""

_MAX_LOG_FREQUENCY_CHANGE: Final = 0.15
"""Largest change of the logarithm of a mode frequency in the search."""

_LOWEST_RELATIVE_FREQUENCY: Final = 0.12
"""Lowest frequency compared, relative to that of the first mode. At lower frequencies the record
contains sensor drift and 1/f noise, but nothing that determines a mode."""

_MODE_REACH_HALF_WIDTHS: Final = 3.0
"""Distance from a mode, in half-widths of its resonance, within which the noise has no narrow peak.
"""

_LEAST_RELATIVE_MODE_REACH: Final = 0.02
"""Minimum distance from a mode, relative to its frequency, within which the noise has no narrow
peak."""

_MODE_REACH_MARGIN_BINS: Final = 24
"""Number of frequency bins added to the distance from a mode within which the noise has no narrow
peak."""

_MAX_NOISE_ESTIMATES: Final = 3
"""Maximum number of estimates of the noise spectrum, each followed by a descent."""

_NOISE_LOG_TOLERANCE: Final = 0.02
"""Mean change of the logarithm of the noise power below which the noise spectrum has converged."""

_MAX_ADDITIONAL_RESONANCES: Final = 2
"""Maximum number of resonances, of the sensor or the mount, that are added to those of the beam."""

_MIN_DEVIANCE_REDUCTION: Final = 60.0
"""Minimum reduction of the deviance by a mode or an additional resonance that is retained."""

_MIN_VISIBLE_DEVIANCE_REDUCTION: Final = 400.0
"""Minimum reduction of the deviance by a mode that counts as visible: its damping ratio is then
known to a tenth."""


@dataclass(frozen=True, slots=True)
class ModalFit(ModalEstimate):
    """Modal model fitted to one record.

    Attributes
    ----------
    evidence : tuple of float
        Reduction of the deviance by each mode.
    residual : ndarray of complex, shape (K,)
        Whitened residual; its real and imaginary parts have variance 1 if only noise remains.
    noise : NoiseSpectrum
        Noise spectrum estimated from this residual; bins below the first mode are excluded.
    whiteness : Whiteness
        Test of whether the residual is white.
    input_relation : InputRelation
        Test of whether the residual depends linearly on the motor angle.
    ringing : Ringing
        Free decay at the beginning of the record.
    span : ndarray, shape (r, 2 K)
        Orthonormal rows that span all derivatives of the whitened residual, with real and imaginary
        parts interleaved.
    """

    evidence: tuple[float, ...]
    residual: NDArray[np.complex128]
    noise: NoiseSpectrum
    whiteness: Whiteness
    input_relation: InputRelation
    ringing: Ringing
    span: NDArray[np.float64]

    def cost_reduction_by_spectrum(self, columns: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return by how much each additional torque spectrum would reduce the cost, shape (c,).

        Each spectrum is added to the fit alone, with a free amplitude; the cost is the sum of
        whitened squares.

        Parameters
        ----------
        columns : ndarray of complex, shape (c, K)
            Torque spectra in N·m, not whitened.
        """
        whitened = np.ascontiguousarray(columns * self.noise.weight).view(np.float64)
        whitened -= (whitened @ self.span.T) @ self.span
        projections = whitened @ self.residual.view(np.float64)
        squares = np.maximum(np.einsum("ij,ij->i", whitened, whitened), np.finfo(float).tiny)
        cost_reductions: NDArray[np.float64] = projections**2 / squares
        return cost_reductions

    @property
    def explained(self) -> bool:
        """Return whether only noise remains in the residual of the modal model."""
        return self.whiteness.white and not self.input_relation.related

    @property
    def visible(self) -> tuple[int, ...]:
        """Return the sorted numbers of the beam modes that are visible in the record."""
        modes = zip(self.numbers, self.evidence, strict=True)
        return tuple(
            sorted(
                number
                for number, reduction in modes
                if number and reduction > _MIN_VISIBLE_DEVIANCE_REDUCTION
            )
        )

    def plant_with_modal_frequencies(self, plant: Plant) -> Plant:
        """Return the plant with each visible mode's stiffness adjusted to its fitted frequency.

        The given plant is returned unchanged if there is no such plant, if the visible modes are
        not modes 1 to n without a gap, or if the plant has a tip mass, a compliant clamp or a
        filter.

        Parameters
        ----------
        plant : Plant
            Plant with a bare beam.
        """
        visible = self.visible
        if not visible or any(plant.optional_parameters.values()) or len(visible) != visible[-1]:
            return plant
        poles = dict(zip(self.numbers, self.model.poles_rad_s, strict=True))
        frequency_hz = [poles[number].imag / (2 * math.pi) for number in visible]
        try:
            loaded_beam = LoadedBeam(plant.beam, plant.damping).with_frequencies(frequency_hz)
        except ValueError:
            return plant
        return replace(
            plant, beam=loaded_beam.beam, stiffness_offsets=loaded_beam.stiffness_offsets
        )


def fit_modes(
    comparison: Comparison,
    noise: NoiseSpectrum,
    starts: Sequence[tuple[int, float, float]],
    columns: NDArray[np.complex128] | None = None,
) -> ModalFit | None:
    """Fit the modal model to a record; return None if no mode is within the band or significant.

    Parameters
    ----------
    comparison : Comparison
        Record, reduced to the band.
    noise : NoiseSpectrum
        First estimate; bins that it excludes stay excluded.
    starts : sequence of (int, float, float)
        Mode number, approximate frequency (Hz) and approximate damping ratio of each mode.
    columns : ndarray of complex, shape (c, K), optional
        Torque spectra of known form and unknown amplitude, as for `Objective`.
    """
    starts_in_band = [each for each in starts if each[1] <= comparison.frequency_hz[-1]]
    if not starts_in_band:
        return None
    effect_spectra = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
    effect_spectra = effect_spectra if columns is None else columns
    lowest_hz = _LOWEST_RELATIVE_FREQUENCY * min(hz for _, hz, _ in starts_in_band)
    counts = noise.counts & (comparison.frequency_hz >= lowest_hz)
    search = _ModalSearch(
        comparison,
        replace(noise, counts=counts),
        effect_spectra,
        tuple(number for number, _, _ in starts_in_band),
        np.array(
            [[math.log(2 * math.pi * hz), 2 * ratio] for _, hz, ratio in starts_in_band]
        ).ravel(),
    )
    return search.remove_unexcited_modes().converge_with_noise().add_resonances().fit()


@dataclass(frozen=True, slots=True)
class _ModalSearch:
    """Search for mode frequencies and damping under one noise estimate.

    `x` is the current point ``(ln omega_1, eta_1, ln omega_2, …)``, with omega in rad/s.
    """

    comparison: Comparison
    noise: NoiseSpectrum
    effect_spectra: NDArray[np.complex128]
    numbers: tuple[int, ...]
    x: NDArray[np.float64]

    def problem(self) -> _ModalProblem:
        """Return the least-squares problem of these modes under this noise estimate."""
        return _ModalProblem(self.comparison, self.noise.weight, self.effect_spectra, self.numbers)

    def descend_to_minimum(self) -> _ModalSearch:
        """Return the search at the minimum of the cost under the current noise estimate."""
        low = np.column_stack(
            [self.x[::2] - _MAX_LOG_FREQUENCY_CHANGE, np.full(len(self.numbers), _LEAST_ETA)]
        )
        high = np.column_stack(
            [self.x[::2] + _MAX_LOG_FREQUENCY_CHANGE, np.full(len(self.numbers), _LARGEST_ETA)]
        )
        minimum = descend(
            self.problem().normal_equations,
            self.x,
            Box(low.ravel(), high.ravel()),
            relative_tolerance=_RELATIVE_TOLERANCE,
            max_evaluations=60,
        )
        return replace(self, x=minimum.x)

    def converge_with_noise(self) -> _ModalSearch:
        """Alternate descents with estimates of noise and unknown torque until they converge."""
        search = self
        for _ in range(_MAX_NOISE_ESTIMATES):
            search = search.descend_to_minimum()
            problem = search.problem()
            model = problem.model(search.x)
            residual = problem.residual(search.x, model)
            comparison = search.comparison.renewed(model, search.noise).fill_unknown_torque(model)
            power = smooth_power(residual, finely=True)
            power = noise_power_with_peaks(residual, power, ~search.is_near_mode())
            power /= comparison.measurement.known_torque_fraction
            counts = search.noise.counts
            change = np.abs(np.log(power / search.noise.power)[counts]).mean()
            search = replace(
                search, comparison=comparison, noise=replace(search.noise, power=power)
            )
            if change < _NOISE_LOG_TOLERANCE and comparison.measurement.torque_known.all():
                break
        return search.descend_to_minimum()

    def is_near_mode(self) -> NDArray[np.bool_]:
        """Return a mask of the bins in which the residual may belong to a mode, shape (K,)."""
        hz = self.comparison.frequency_hz[:, None]
        frequencies, eta = np.exp(self.x[::2]) / (2 * np.pi), self.x[1::2]
        bins_hz = _MODE_REACH_MARGIN_BINS * float(hz[1, 0] - hz[0, 0])
        reach_hz = (
            np.maximum(_MODE_REACH_HALF_WIDTHS * eta / 2, _LEAST_RELATIVE_MODE_REACH) * frequencies
            + bins_hz
        )
        is_near: NDArray[np.bool_] = np.any(np.abs(hz - frequencies) < reach_hz, axis=1)
        return is_near

    def cost(self) -> float:
        """Return the sum of the squared whitened residual at the current point."""
        residual = self.problem().solution_at(self.x).residual
        return float(residual @ residual)

    def add_resonances(self) -> _ModalSearch:
        """Add a resonance at the frequency where the residual depends on the motor angle.

        A resonance is added only while it reduces the cost enough and overlaps with no mode.
        """
        search = self
        for _ in range(_MAX_ADDITIONAL_RESONANCES):
            input_dependence = search.residual_dependence_on_angle(
                search.problem().solution_at(search.x)
            )
            if not input_dependence.related:
                break
            start = [math.log(2 * math.pi * input_dependence.at_hz), 0.02]
            with_resonance = replace(
                search, numbers=(*search.numbers, 0), x=np.concatenate([search.x, start])
            ).converge_with_noise()
            without_resonance = replace(
                search, noise=with_resonance.noise, comparison=with_resonance.comparison
            ).descend_to_minimum()
            if (
                without_resonance.cost() - with_resonance.cost() < _MIN_DEVIANCE_REDUCTION
                or with_resonance.last_mode_overlaps()
            ):
                break
            search = with_resonance
        return search

    def last_mode_overlaps(self) -> bool:
        """Return whether the last mode lies within the width of another mode."""
        frequencies = np.exp(self.x[::2])
        half_widths = frequencies * self.x[1::2] / 2
        least_distances = _MODE_REACH_HALF_WIDTHS * (half_widths[:-1] + half_widths[-1])
        return bool(np.any(np.abs(frequencies[:-1] - frequencies[-1]) < least_distances))

    def remove_unexcited_modes(self) -> _ModalSearch:
        """Remove modes that hardly reduce the cost at first and lose their damping in a descent.

        Such a mode would fit a narrow line of the noise.
        """
        cost_increases = self.evidence()
        if cost_increases.min() >= _MIN_DEVIANCE_REDUCTION:
            return self
        is_undamped = self.descend_to_minimum().x[1::2] < 2 * _LEAST_ETA
        search = self
        for index in np.flatnonzero((cost_increases < _MIN_DEVIANCE_REDUCTION) & is_undamped)[
            ::-1
        ].tolist():
            search = search._remove_mode(index)
        return search

    def _remove_mode(self, index: int) -> _ModalSearch:
        """Return the search without the mode at an index."""
        numbers = self.numbers[:index] + self.numbers[index + 1 :]
        return replace(self, numbers=numbers, x=np.delete(self.x, [2 * index, 2 * index + 1]))

    def evidence(self) -> NDArray[np.float64]:
        """Return the cost increase if each mode alone is removed, with no new descent, (n,)."""
        cost = self.cost()
        return np.array([self._remove_mode(i).cost() - cost for i in range(len(self.numbers))])

    def residual_dependence_on_angle(self, point: _LinearSolution) -> InputRelation:
        """Test whether the residual at a point depends linearly on the motor angle."""
        residual = point.residual.view(np.complex128)
        angle = self.comparison.spectrum(self.comparison.angle_rad[self.comparison.retained])
        is_used = self.noise.counts
        first_used = int(np.argmax(is_used))
        return input_relation(
            residual[first_used:], angle[first_used:], self.comparison.frequency_hz[first_used:]
        )

    def fit(self) -> ModalFit | None:
        """Return the fit after the removal of modes that do not reduce the cost enough.

        Return None if no mode remains. The removed modes are undetermined.
        """
        order = np.argsort(self.x[::2])
        search = replace(
            self,
            x=self.x.reshape(-1, 2)[order].ravel(),
            numbers=tuple(self.numbers[i] for i in order),
        )
        cost_increases = search.evidence()
        while cost_increases.size and cost_increases.min() < _MIN_DEVIANCE_REDUCTION:
            search = search._remove_mode(int(np.argmin(cost_increases))).descend_to_minimum()
            cost_increases = search.evidence()
        if not cost_increases.size:
            return None
        x, numbers = search.x, search.numbers
        problem = search.problem()
        point = problem.solution_at(x)
        joint_covariance = problem.covariance(point)
        constants, covariance = problem.constants(point, x, joint_covariance)
        residual = point.residual.view(np.complex128)
        is_used = search.noise.counts
        return ModalFit(
            model=problem.model(x),
            numbers=numbers,
            constants=constants,
            joint_covariance=covariance,
            evidence=tuple(cost_increases.tolist()),
            residual=residual,
            noise=search.noise,
            whiteness=whiteness(residual[is_used], search.comparison.frequency_hz[is_used]),
            input_relation=search.residual_dependence_on_angle(point),
            ringing=problem.ringing(point, joint_covariance),
            span=np.concatenate([point.span, _orthonormal_rows(point.jacobian)[0]]),
        )


def _scaled_gram(
    rows: NDArray[np.float64], regularization: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return rows scaled to length 1, their regularized Gram matrix and their former lengths."""
    lengths = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    lengths[lengths == 0] = 1.0  # the spectrum of a decay that ends at once
    scaled = rows / lengths[:, None]
    gram = scaled @ scaled.T
    gram[np.diag_indices_from(gram)] += regularization
    return scaled, gram, lengths


def _orthonormal_rows(rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return orthonormal rows of the same span, and the matrix that restores the given rows."""
    scaled, gram, lengths = _scaled_gram(rows, 1e-13)
    factor = np.linalg.cholesky(gram)
    return np.linalg.solve(factor, scaled), factor * lengths[:, None]


@dataclass(frozen=True, slots=True)
class _LinearSolution:
    """Solution for the linear parameters at one point, with its whitened residual and derivatives.

    `columns` are the whitened spectra that the linear parameters multiply, `span` is an orthonormal
    basis of these, and `jacobian` the part of `full_jacobian` outside that span. Real and imaginary
    parts are interleaved, so that rows have 2 K values.
    """

    residual: NDArray[np.float64]
    linear_parameters: NDArray[np.float64]
    columns: NDArray[np.float64]
    span: NDArray[np.float64]
    full_jacobian: NDArray[np.float64]
    jacobian: NDArray[np.float64]


def _unit_pole(eta: float) -> complex:
    """Return the root of ``1 + eta q + q²`` with positive imaginary part."""
    return complex(-eta / 2, math.sqrt(1 - eta * eta / 4))


def _unit_pole_derivative(eta: float) -> complex:
    """Return the derivative, with respect to eta, of the upper root of ``1 + eta q + q²``."""
    return complex(-0.5, -eta / (4 * math.sqrt(1 - eta * eta / 4)))


class _ModalProblem:
    """Least-squares problem of the modal model: its unknowns are mode frequencies and damping."""

    def __init__(
        self,
        comparison: Comparison,
        weight: NDArray[np.float64],
        effect_spectra: NDArray[np.complex128],
        numbers: tuple[int, ...],
    ) -> None:
        self._recent: RecentValues[_LinearSolution] = RecentValues()
        self._numbers = numbers
        self._comparison = comparison
        self._weight = weight
        self._effect_spectra = effect_spectra
        self._s = comparison.prediction.s
        self.scale_rad_s = 2 * math.pi * float(comparison.frequency_hz[-1])
        self._measured_torque = self._whiten(
            comparison.spectrum(comparison.torque_nm[comparison.retained])
        )
        background = np.array(
            [(self._s / self.scale_rad_s) ** n for n in range(BACKGROUND_COEFFICIENTS)]
        )
        self._background = self._predicted_spectra(background)

    def _whiten(self, spectra: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return whitened spectra with real and imaginary parts interleaved, shape (..., 2 K)."""
        return np.ascontiguousarray(spectra * self._weight).view(np.float64)

    def _predicted_spectra(self, responses: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the whitened torque spectra of transfer functions from the angle, (n, 2 K)."""
        comparison = self._comparison
        return self._whiten(comparison.spectrum(comparison.prediction.in_time(responses)))

    def _poles(self, x: NDArray[np.float64]) -> list[Pole]:
        """Return the poles of the modes at a point, with their derivatives by the point."""
        poles = []
        for k, (log_omega, eta) in enumerate(x.reshape(-1, 2)):
            omega, q = math.exp(log_omega), _unit_pole(eta)
            derivative = np.zeros(x.size, dtype=np.complex128)
            derivative[2 * k] = omega * q
            derivative[2 * k + 1] = omega * _unit_pole_derivative(eta)
            poles.append(Pole(self._numbers[k], omega * q, derivative))
        return poles

    def _nuisance_spectra(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return the spectra of all effects of unknown amplitude, not whitened, shape (m, K)."""
        return np.concatenate([self._comparison.nuisance_spectra(poles), self._effect_spectra])

    def _drag_change(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return how the drag torque changes with the poles, and its derivatives, shape (1 + k, K).

        Row 0 is the change of the spectrum relative to the plant for which the drag was computed.
        """
        total = np.zeros((1 + 2 * len(poles), self._weight.size), dtype=np.complex128)
        drag = self._comparison.drag
        if drag is None:
            return total
        reference_poles = {
            pole.mode: pole.at_rad_s for pole in mode_poles(drag.plant, len(drag.by_pole), ())
        }
        for pole in poles:
            if pole.mode in drag.by_pole and pole.mode in reference_poles:
                by_real, by_imaginary = drag.by_pole[pole.mode]
                difference = pole.at_rad_s - reference_poles[pole.mode]
                total[0] += difference.real * by_real + difference.imag * by_imaginary
                total[1:] += np.outer(pole.derivative.real, by_real)
                total[1:] += np.outer(pole.derivative.imag, by_imaginary)
        return total

    def solution_at(self, x: NDArray[np.float64]) -> _LinearSolution:
        """Solve for the linear parameters at ``x = (ln omega_1, eta_1, ln omega_2, …)``.

        The solutions at the last two points are cached.
        """
        return self._recent.at(x, self._solve_at)

    def _solve_at(self, x: NDArray[np.float64]) -> _LinearSolution:
        """Solve for the linear parameters at a point, without the cache."""
        modes = x.reshape(-1, 2)
        rows: list[NDArray[np.complex128]] = []
        derivative_rows: list[NDArray[np.complex128]] = []
        for log_omega, eta in modes:
            omega = math.exp(log_omega)
            q = self._s / omega
            inverse_denominator = 1 / (1 + eta * q + q * q)
            numerators = (q * q * inverse_denominator, q**3 * inverse_denominator)
            rows += numerators
            # Derivatives by ln omega and eta of either numerator over the denominator
            for power, row in zip((2, 3), numerators, strict=True):
                derivative_rows.append(row * ((eta * q + 2 * q * q) * inverse_denominator - power))
                derivative_rows.append(-row * q * inverse_denominator)
        numerator_count = len(rows)
        spectra = self._predicted_spectra(
            np.array(rows + derivative_rows).reshape(-1, self._s.size)
        )
        poles = self._poles(x)
        nuisance_spectra = self._whiten(self._nuisance_spectra(poles))
        drag, *drag_jacobian = self._whiten(self._drag_change(poles))
        columns = np.concatenate([spectra[:numerator_count], self._background, nuisance_spectra])
        span, factor = _orthonormal_rows(columns)
        measured_torque = self._measured_torque - drag
        projections = span @ measured_torque
        residual = projections @ span - measured_torque
        linear_parameters = np.linalg.solve(factor.T, projections)
        nuisance_amplitudes = linear_parameters[numerator_count + BACKGROUND_COEFFICIENTS :]
        jacobian = np.array(drag_jacobian).reshape(x.size, residual.size)
        if poles:
            jacobian += self._whiten(self._comparison.decay_gradient(poles, nuisance_amplitudes))
        for k in range(len(modes)):
            a, b = linear_parameters[2 * k : 2 * k + 2]
            mode_derivatives = spectra[numerator_count + 4 * k : numerator_count + 4 * k + 4]
            jacobian[2 * k] += a * mode_derivatives[0] + b * mode_derivatives[2]
            jacobian[2 * k + 1] += a * mode_derivatives[1] + b * mode_derivatives[3]
        projected_jacobian = jacobian - (jacobian @ span.T) @ span
        return _LinearSolution(
            residual, linear_parameters, columns, span, jacobian, projected_jacobian
        )

    def model(self, x: NDArray[np.float64]) -> ModalModel:
        """Return the modal model at a point, with the best linear parameters."""
        linear_parameters = self.solution_at(x).linear_parameters
        modes = x.reshape(-1, 2)
        poles, residues = [], []
        first_background = 2 * len(modes)
        background = linear_parameters[
            first_background : first_background + BACKGROUND_COEFFICIENTS
        ] / self.scale_rad_s ** np.arange(BACKGROUND_COEFFICIENTS)
        for k, (log_omega, eta) in enumerate(modes):
            omega, (a, b) = math.exp(log_omega), linear_parameters[2 * k : 2 * k + 2]
            q = _unit_pole(eta)
            poles.append(omega * q)
            residues.append(omega * (a + b * q) * q * q / (2j * q.imag))
            # Add the polynomial part of (a + b q) q² over the denominator.
            background[0] += a - b * eta
            background[1] += b / omega
        return ModalModel(tuple(poles), tuple(residues), tuple(background.tolist()))

    def residual(self, x: NDArray[np.float64], model: ModalModel) -> NDArray[np.complex128]:
        """Return the residual spectrum of a model at a point in N·m, not whitened, shape (K,)."""
        first_nuisance = 2 * len(self._numbers) + BACKGROUND_COEFFICIENTS
        amplitudes = self.solution_at(x).linear_parameters[first_nuisance:]
        poles = self._poles(x)
        comparison = self._comparison
        torque = comparison.prediction.torque(model)[0]
        modal_residual = comparison.spectrum(torque - comparison.torque_nm[comparison.retained])
        drag_change: NDArray[np.complex128] = self._drag_change(poles)[0]
        return drag_change + modal_residual + amplitudes @ self._nuisance_spectra(poles)

    def covariance(self, point: _LinearSolution) -> NDArray[np.float64]:
        """Return the joint covariance of the point and the linear parameters."""
        _, gram, lengths = _scaled_gram(np.concatenate([point.full_jacobian, point.columns]), 1e-14)
        covariance: NDArray[np.float64] = np.linalg.inv(gram) / np.outer(lengths, lengths)
        return covariance

    def ringing(self, point: _LinearSolution, covariance: NDArray[np.float64]) -> Ringing:
        """Return the free decay at the beginning of the record, with its chi-square.

        The decay of each mode has two amplitudes, which are free linear parameters of the fit.
        """
        mode_count = len(self._numbers)
        first_decay = 2 * mode_count + BACKGROUND_COEFFICIENTS
        amplitudes = point.linear_parameters[first_decay : first_decay + 2 * mode_count]
        rows = slice(2 * mode_count + first_decay, 2 * mode_count + first_decay + 2 * mode_count)
        return Ringing(
            amplitude_nm=tuple(np.hypot(amplitudes[::2], amplitudes[1::2]).tolist()),
            chi_square=float(amplitudes @ np.linalg.solve(covariance[rows, rows], amplitudes)),
            degrees_of_freedom=amplitudes.size,
        )

    def constants(
        self, point: _LinearSolution, x: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the constants of all modes, and their joint covariance with the background.

        The constants are `MODE_CONSTANT_NAMES`. The shapes are (4 n,) and (4 n + 5, 4 n + 5).
        """
        mode_count = x.size // 2
        constants = np.empty(4 * mode_count)
        first_background = x.size + 2 * mode_count
        derivatives = np.zeros(
            (4 * mode_count + BACKGROUND_COEFFICIENTS, first_background + BACKGROUND_COEFFICIENTS)
        )
        background_rows = derivatives[4 * mode_count :]
        background_rows[:, first_background:] = np.diag(
            self.scale_rad_s ** -np.arange(float(BACKGROUND_COEFFICIENTS))
        )
        for k in range(mode_count):
            log_omega, eta = x[2 * k : 2 * k + 2]
            a, b = point.linear_parameters[2 * k : 2 * k + 2]
            q = _unit_pole(eta)
            numerator = a + b * q
            # ln of the residue over j: ln omega + ln (a + b q) + 2 ln q - ln(2 Im q) + j pi
            log_residue = np.log(-numerator * q * q / (2 * q.imag)) + log_omega
            pole_derivative = _unit_pole_derivative(eta)
            residue_by_eta = (
                b / numerator + 2 / q
            ) * pole_derivative - pole_derivative.imag / q.imag
            residue_by_a, residue_by_b = 1 / numerator, q / numerator
            constants[4 * k : 4 * k + 4] = (
                log_omega + math.log(q.imag / (2 * math.pi)),
                math.log(eta / 2),
                log_residue.real,
                log_residue.imag,
            )
            rows = derivatives[4 * k : 4 * k + 4]
            omega_index, eta_index, a_index, b_index = (
                2 * k,
                2 * k + 1,
                x.size + 2 * k,
                x.size + 2 * k + 1,
            )
            rows[0, [omega_index, eta_index]] = 1.0, pole_derivative.imag / q.imag
            rows[1, eta_index] = 1 / eta
            rows[2, [omega_index, eta_index, a_index, b_index]] = (
                1.0,
                residue_by_eta.real,
                residue_by_a.real,
                residue_by_b.real,
            )
            rows[3, [eta_index, a_index, b_index]] = (
                residue_by_eta.imag,
                residue_by_a.imag,
                residue_by_b.imag,
            )
            # The remainder of the division of the numerator by the denominator, as in `model`.
            background_rows[0, [a_index, b_index, eta_index]] = 1.0, -eta, -b
            background_rows[1, [b_index, omega_index]] = np.array([1.0, -b]) / math.exp(log_omega)
        used_covariance = covariance[: derivatives.shape[1], : derivatives.shape[1]]
        return constants, derivatives @ used_covariance @ derivatives.T

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Return the normal equations at a point for the descent, with Kaufman's Jacobian."""
        point = self.solution_at(x)
        return NormalEquations(
            cost=float(point.residual @ point.residual),
            gradient=point.jacobian @ point.residual,
            hessian=point.jacobian @ point.jacobian.T,
        )
