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
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._comparison import MAX_BINS_OF_STORED_RESULTS
from analysis.identify._estimates import Ringing
from analysis.identify._modal_model import (
    BACKGROUND_COEFFICIENTS,
    MODE_CONSTANT_NAMES,
    ModalEstimate,
    ModalModel,
)
from analysis.identify.noise import noise_power_with_peaks, smooth_power
from analysis.identify.residual_tests import input_relation, whiteness
from analysis.optimizer import ConstantBounds, NormalEquations, RecentValues, descend
from rigd.beam import Pole

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify.noise import NoiseSpectrum
    from analysis.identify.residual_tests import InputRelation, Whiteness
    from rigd.beam import Plant

_RELATIVE_TOLERANCE: Final = 1e-8
"""Relative tolerance of the sum of squares at which a descent has converged."""

_MIN_LOSS_FACTOR: Final = 1e-5
"""Lower bound of eta, which is twice the damping ratio of a mode."""

_MAX_LOSS_FACTOR: Final = 1.0
"""Upper bound of eta, which is twice the damping ratio of a mode."""

_MAX_LOG_FREQUENCY_CHANGE: Final = 0.15
"""Largest change of the logarithm of a mode frequency in the search."""

_LOWEST_RELATIVE_FREQUENCY: Final = 0.12
"""Lowest frequency compared, relative to that of the first mode. At lower frequencies the record
contains sensor drift and 1/f noise, but nothing that determines a mode."""

_MODE_REACH_HALF_WIDTHS: Final = 3.0
"""Distance from a mode, in half-widths of its resonance, within which the noise has no narrow peak.
"""

_MIN_RELATIVE_MODE_REACH: Final = 0.02
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
    """Modal model (poles and residues of each mode) fitted to one record.

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
    derivatives : _DerivativeSpan
        Span of all derivatives of the whitened residual.
    ln_damping_by_torque : ndarray, shape (n, 2 K)
        Derivative of the logarithm of each estimated damping ratio by the whitened torque.
    effect_sizes, effect_stds : tuple of float
        Amplitude of each torque spectrum that was fitted with the modes, and its standard
        deviation.
    """

    evidence: tuple[float, ...]
    residual: NDArray[np.complex128]
    noise: NoiseSpectrum
    whiteness: Whiteness
    input_relation: InputRelation
    ringing: Ringing
    derivatives: _DerivativeSpan
    ln_damping_by_torque: NDArray[np.float64]
    effect_sizes: tuple[float, ...]
    effect_stds: tuple[float, ...]

    def cost_reduction_by_spectrum(
        self, torque_spectra: Iterable[NDArray[np.complex128]]
    ) -> NDArray[np.float64]:
        """Return by how much each of c additional torque spectra would reduce the cost, shape (c,).

        Each spectrum is added to the fit alone, with a free amplitude; the cost is the sum of
        whitened squares.

        Parameters
        ----------
        torque_spectra : iterable of ndarray of complex, shape (K,)
            Torque spectra in N·m, not whitened.
        """
        torque_spectra = list(torque_spectra)
        span, residual = self.derivatives.rows(), self.residual.view(np.float64)

        def whitened(columns: slice) -> NDArray[np.float64]:
            bins = slice(columns.start // 2, columns.stop // 2)
            spectra = np.array([spectrum[bins] for spectrum in torque_spectra])
            return np.ascontiguousarray(spectra * self.noise.weight[bins]).view(np.float64)

        blocks = list(_column_blocks(residual.size))
        coefficients = sum(whitened(columns) @ span[:, columns].T for columns in blocks)
        projections, squares = np.zeros((2, len(torque_spectra)))
        for columns in blocks:
            outside_span = whitened(columns) - coefficients @ span[:, columns]
            projections += outside_span @ residual[columns]
            squares += np.einsum("ij,ij->i", outside_span, outside_span)
        cost_reductions: NDArray[np.float64] = projections**2 / np.maximum(
            squares, np.finfo(float).tiny
        )
        return cost_reductions

    def _whiten(self, torque_spectra: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return whitened spectra with real and imaginary parts interleaved, shape (..., 2 K)."""
        return np.ascontiguousarray(torque_spectra * self.noise.weight).view(np.float64)

    def outside_span(self, whitened: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the part of whitened spectra that no parameter of the fit can imitate.

        Parameters
        ----------
        whitened : ndarray, shape (..., 2 K)
            Whitened spectra with real and imaginary parts interleaved.
        """
        span = self.derivatives.rows()
        outside_span: NDArray[np.float64] = whitened - (whitened @ span.T) @ span
        return outside_span

    def effect_std(self, torque_spectrum: NDArray[np.complex128]) -> float:
        """Return the standard deviation that the size of an additional effect would have.

        Parameters
        ----------
        torque_spectrum : ndarray of complex, shape (K,)
            Torque spectrum of the effect in N·m per unit of its size, not whitened.
        """
        remainder = self.outside_span(self._whiten(torque_spectrum))
        return 1 / math.sqrt(max(float(remainder @ remainder), np.finfo(float).tiny))

    def damping_std_ratios(
        self, torque_spectrum: NDArray[np.complex128], prior_std: float
    ) -> NDArray[np.float64]:
        """Return how much less certain damping ratios are with an additional effect, shape (n,).

        Each is the standard deviation with a free size of the effect, over that without it.

        Parameters
        ----------
        torque_spectrum : ndarray of complex, shape (K,)
            Torque spectrum of the effect in N·m per unit of its size, not whitened.
        prior_std : float
            Standard deviation of the size before the record.
        """
        whitened = self._whiten(torque_spectrum)
        size_variance = 1 / (self.effect_std(torque_spectrum) ** -2 + prior_std**-2)
        damping_variance = np.diag(self.covariance)[
            MODE_CONSTANT_NAMES.index("ln_damping_ratio") :: len(MODE_CONSTANT_NAMES)
        ]
        added_variance = (self.ln_damping_by_torque @ whitened) ** 2 * size_variance
        std_ratios: NDArray[np.float64] = np.sqrt(1 + added_variance / damping_variance)
        return std_ratios

    @property
    def explained(self) -> bool:
        """Return whether only noise remains in the residual of the modal model."""
        return self.whiteness.is_white and not self.input_relation.related

    @property
    def visible(self) -> tuple[int, ...]:
        """Return the sorted numbers of the beam modes that are visible in the record."""
        modes_with_evidence = zip(self.numbers, self.evidence, strict=True)
        return tuple(
            sorted(
                mode_number
                for mode_number, deviance_reduction in modes_with_evidence
                if mode_number and deviance_reduction > _MIN_VISIBLE_DEVIANCE_REDUCTION
            )
        )

    def plant_with_modal_frequencies(self, plant: Plant) -> Plant:
        """Return the plant with stiffnesses adjusted to the frequencies of the visible modes.

        The given plant is returned unchanged if there is no such plant, if the visible modes are
        not modes 1 to n without a gap, or if the plant has a tip mass, a compliant clamp or a
        filter.

        Parameters
        ----------
        plant : Plant
            Plant with a bare beam.
        """
        visible_modes = self.visible
        if (
            not visible_modes
            or any(plant.optional_parameters.values())
            or len(visible_modes) != visible_modes[-1]
        ):
            return plant
        frequency_hz = [
            self.poles_rad_s[mode_number].imag / (2 * math.pi) for mode_number in visible_modes
        ]
        try:
            return plant.with_frequencies(frequency_hz)
        except ValueError:
            return plant


def fit_modes(
    comparison: Comparison,
    noise: NoiseSpectrum,
    starts: Sequence[tuple[int, float, float]],
    columns: NDArray[np.complex128] | None = None,
) -> ModalFit | None:
    """Return the modal model fitted to a record; None if no mode is in the band or significant.

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
    search = _ModalSearch.starting_at(comparison, noise, starts, columns)
    if search is None:
        return None
    return search.remove_unexcited_modes().converge_with_noise().add_resonances().fit()


def modes_with_poles(
    comparison: Comparison, noise: NoiseSpectrum, poles: Sequence[tuple[int, float, float]]
) -> ModalFit | None:
    """Return the modal model with given poles and the best residues, without a search.

    Parameters
    ----------
    comparison : Comparison
        Record, reduced to the band.
    noise : NoiseSpectrum
        Noise of the record.
    poles : sequence of (int, float, float)
        Mode number, frequency (Hz) and damping ratio of each mode.
    """
    search = _ModalSearch.starting_at(comparison, noise, poles)
    return None if search is None else search.fit()


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

    @classmethod
    def starting_at(
        cls,
        comparison: Comparison,
        noise: NoiseSpectrum,
        starts: Sequence[tuple[int, float, float]],
        columns: NDArray[np.complex128] | None = None,
    ) -> _ModalSearch | None:
        """Return the search that starts at the modes in the band, or None if there is none."""
        starts_in_band = [
            mode_start for mode_start in starts if mode_start[1] <= comparison.frequency_hz[-1]
        ]
        if not starts_in_band:
            return None
        effect_spectra = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
        effect_spectra = effect_spectra if columns is None else columns
        lowest_hz = _LOWEST_RELATIVE_FREQUENCY * min(hz for _, hz, _ in starts_in_band)
        used_bins = noise.counts & (comparison.frequency_hz >= lowest_hz)
        return cls(
            comparison,
            replace(noise, counts=used_bins),
            effect_spectra,
            tuple(mode_number for mode_number, _, _ in starts_in_band),
            np.array(
                [
                    [math.log(2 * math.pi * hz), 2 * damping_ratio]
                    for _, hz, damping_ratio in starts_in_band
                ]
            ).ravel(),
        )

    def problem(self) -> _ModalProblem:
        """Return the least-squares problem of the modes of this search under its noise estimate."""
        return _ModalProblem(self.comparison, self.noise.weight, self.effect_spectra, self.numbers)

    def descend_to_minimum(self) -> _ModalSearch:
        """Return the search moved to the minimum of the cost under its noise estimate."""
        return self._descend(self.problem())

    def _descend(self, problem: _ModalProblem) -> _ModalSearch:
        """Return the search moved to the minimum of the cost of its problem."""
        lower_bounds = np.column_stack(
            [self.x[::2] - _MAX_LOG_FREQUENCY_CHANGE, np.full(len(self.numbers), _MIN_LOSS_FACTOR)]
        )
        upper_bounds = np.column_stack(
            [self.x[::2] + _MAX_LOG_FREQUENCY_CHANGE, np.full(len(self.numbers), _MAX_LOSS_FACTOR)]
        )
        minimum = descend(
            problem.normal_equations,
            self.x,
            ConstantBounds(lower_bounds.ravel(), upper_bounds.ravel()),
            relative_tolerance=_RELATIVE_TOLERANCE,
            max_evaluations=60,
        )
        return replace(self, x=minimum.x)

    def converge_with_noise(self) -> _ModalSearch:
        """Return the search after descents, noise and unknown torque have converged together."""
        search = self
        for _ in range(_MAX_NOISE_ESTIMATES):
            problem = search.problem()
            search = search._descend(problem)
            linear_parameters = problem.solution_at(search.x).linear_parameters
            modal_model = problem.model(search.x, linear_parameters)
            residual_spectrum = problem.residual(search.x, linear_parameters, modal_model)
            comparison = search.comparison
            # A torque that the modal model lacks would change which part of the angle follows it.
            if not (len(search.effect_spectra) or comparison.drag):
                comparison = comparison.with_reestimated_angle(modal_model, search.noise)
            comparison = comparison.fill_unknown_torque(modal_model)
            noise_power = smooth_power(residual_spectrum, finely=True)
            noise_power = noise_power_with_peaks(
                residual_spectrum,
                noise_power,
                ~search.is_near_mode(),
                ~search.is_near_mode(within_resonance=True),
            )
            noise_power /= comparison.measurement.known_torque_fraction
            used_bins = search.noise.counts
            mean_log_change = np.abs(np.log(noise_power / search.noise.power)[used_bins]).mean()
            search = replace(
                search, comparison=comparison, noise=replace(search.noise, power=noise_power)
            )
            if mean_log_change < _NOISE_LOG_TOLERANCE and comparison.measurement.torque_known.all():
                break
        del problem  # which stores spectra, as the next one does
        return search.descend_to_minimum()

    def span(self) -> NDArray[np.float64]:
        """Return orthonormal rows that span all derivatives of the residual, shape (r, 2 K)."""
        problem = self.problem()
        return problem.uncertainty(self.x, problem.best_fit(self.x)[1]).span

    def is_near_mode(self, *, within_resonance: bool = False) -> NDArray[np.bool_]:
        """Return a mask of the bins in which the residual may belong to a mode, shape (K,).

        The bins `within_resonance` are those up to half of this distance from a mode. A peak of the
        noise does not begin nearer to a mode than the whole distance, and ends there.
        """
        hz = self.comparison.frequency_hz[:, None]
        mode_hz, eta = np.exp(self.x[::2]) / (2 * np.pi), self.x[1::2]
        margin_hz = _MODE_REACH_MARGIN_BINS * float(hz[1, 0] - hz[0, 0])
        reach_hz = (
            np.maximum(_MODE_REACH_HALF_WIDTHS * eta / 2, _MIN_RELATIVE_MODE_REACH) * mode_hz
            + margin_hz
        )
        if within_resonance:
            reach_hz = reach_hz / 2
        near_mode_mask: NDArray[np.bool_] = np.any(np.abs(hz - mode_hz) < reach_hz, axis=1)
        return near_mode_mask

    def cost(self) -> float:
        """Return the cost at the current point: the sum of the squared whitened residual."""
        return self.problem().cost(self.x)

    def add_resonances(self) -> _ModalSearch:
        """Return the search with a resonance added where the residual depends on the motor angle.

        A resonance is added only while it reduces the cost enough and overlaps with no mode.
        """
        search = self
        for _ in range(_MAX_ADDITIONAL_RESONANCES):
            input_dependence = search.residual_dependence_on_angle(
                search.problem().best_fit(search.x)[0]
            )
            if not input_dependence.related:
                break
            resonance_start = [math.log(2 * math.pi * input_dependence.at_hz), 0.02]
            with_resonance = replace(
                search, numbers=(*search.numbers, 0), x=np.concatenate([search.x, resonance_start])
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
        """Return whether the frequency of the last mode is within the width of another mode."""
        mode_rad_s = np.exp(self.x[::2])
        half_widths = mode_rad_s * self.x[1::2] / 2
        least_distances = _MODE_REACH_HALF_WIDTHS * (half_widths[:-1] + half_widths[-1])
        return bool(np.any(np.abs(mode_rad_s[:-1] - mode_rad_s[-1]) < least_distances))

    def remove_unexcited_modes(self) -> _ModalSearch:
        """Return the search without modes that the record does not excite.

        They hardly reduce the cost at first, and lose their damping in a descent.

        Such a mode would fit a narrow line of the noise.
        """
        cost_increases = self.evidence()
        if cost_increases.min() >= _MIN_DEVIANCE_REDUCTION:
            return self
        is_undamped = self.descend_to_minimum().x[1::2] < 2 * _MIN_LOSS_FACTOR
        search = self
        for mode_index in np.flatnonzero((cost_increases < _MIN_DEVIANCE_REDUCTION) & is_undamped)[
            ::-1
        ].tolist():
            search = search._remove_mode(mode_index)
        return search

    def _remove_mode(self, mode_index: int) -> _ModalSearch:
        """Return the search without the mode at `mode_index` in `remaining_numbers`."""
        remaining_numbers = self.numbers[:mode_index] + self.numbers[mode_index + 1 :]
        return replace(
            self,
            numbers=remaining_numbers,
            x=np.delete(self.x, [2 * mode_index, 2 * mode_index + 1]),
        )

    def evidence(self) -> NDArray[np.float64]:
        """Return the cost increase by the removal of each mode alone, without a descent, (n,)."""
        problem = self.problem()
        full_cost = problem.cost(self.x)
        without_mode = [self._remove_mode(i) for i in range(len(self.numbers))]
        return np.array(
            [problem.for_modes(each.numbers).cost(each.x) - full_cost for each in without_mode]
        )

    def residual_dependence_on_angle(self, whitened: NDArray[np.float64]) -> InputRelation:
        """Return the result of a test whether a residual depends linearly on the motor angle."""
        residual = whitened.view(np.complex128)
        angle_spectrum = self.comparison.spectrum(
            self.comparison.angle_rad[self.comparison.retained]
        )
        used_bins = self.noise.counts
        first_used_bin = int(np.argmax(used_bins))
        return input_relation(
            residual[first_used_bin:],
            angle_spectrum[first_used_bin:],
            self.comparison.frequency_hz[first_used_bin:],
        )

    def fit(self) -> ModalFit | None:
        """Return the modal fit after the removal of modes that do not reduce the cost enough.

        Return None if no mode remains. The removed modes are undetermined.
        """
        frequency_order = np.argsort(self.x[::2])
        search = replace(
            self,
            x=self.x.reshape(-1, 2)[frequency_order].ravel(),
            numbers=tuple(self.numbers[i] for i in frequency_order),
        )
        cost_increases = search.evidence()
        while cost_increases.size and cost_increases.min() < _MIN_DEVIANCE_REDUCTION:
            search = search._remove_mode(int(np.argmin(cost_increases))).descend_to_minimum()
            cost_increases = search.evidence()
        if not cost_increases.size:
            return None
        x, numbers = search.x, search.numbers
        problem = search.problem()
        residual, linear_parameters = problem.best_fit(x)
        uncertainty = problem.uncertainty(x, linear_parameters)
        joint_covariance = uncertainty.covariance
        constants, covariance = problem.constants(linear_parameters, x, joint_covariance)
        residual_spectrum = residual.view(np.complex128)
        used_bins = search.noise.counts
        effect_count = len(search.effect_spectra)
        effect_variances = np.diag(joint_covariance)[joint_covariance.shape[0] - effect_count :]
        return ModalFit(
            model=problem.model(x, linear_parameters),
            numbers=numbers,
            constants=constants,
            joint_covariance=covariance,
            evidence=tuple(cost_increases.tolist()),
            residual=residual_spectrum,
            noise=search.noise,
            whiteness=whiteness(
                residual_spectrum[used_bins], search.comparison.frequency_hz[used_bins]
            ),
            input_relation=search.residual_dependence_on_angle(residual),
            ringing=problem.ringing(linear_parameters, joint_covariance),
            derivatives=_DerivativeSpan(search, uncertainty.span),
            ln_damping_by_torque=uncertainty.ln_damping_by_torque,
            effect_sizes=tuple(linear_parameters[linear_parameters.size - effect_count :].tolist()),
            effect_stds=tuple(np.sqrt(effect_variances).tolist()),
        )


class _DerivativeSpan:
    """Orthonormal rows that span all derivatives of the whitened residual of a modal fit.

    Those of a long record take too much memory to be stored with each fit.
    """

    def __init__(self, search: _ModalSearch, rows: NDArray[np.float64]) -> None:
        self._search = search
        self._rows = None if search.comparison.is_long else rows

    def rows(self) -> NDArray[np.float64]:
        """Return the rows, shape (r, 2 K), with real and imaginary parts interleaved."""
        if self._rows is not None:
            return self._rows
        search = self._search
        rows: NDArray[np.float64] = search.comparison.shared_values.at(
            search.x, lambda _x: search.span(), self
        )
        return rows


_COLUMNS_AT_ONCE: Final = 1 << 14
"""Number of columns of the rows of a long record that are processed at once."""


def _column_blocks(column_count: int) -> Iterator[slice]:
    """Yield the ranges of columns that are processed at once: all, unless the record is long."""
    is_long = column_count > 2 * MAX_BINS_OF_STORED_RESULTS
    block_columns = _COLUMNS_AT_ONCE if is_long else max(column_count, 1)
    for first_column in range(0, column_count, block_columns):
        yield slice(first_column, min(first_column + block_columns, column_count))


def _scaled_gram(
    *matrices: NDArray[np.float64], regularization: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Gram matrix of all rows of matrices, scaled to length 1, and their lengths.

    `regularization` is added to the diagonal of the Gram matrix.
    """
    row_count = sum(len(matrix) for matrix in matrices)
    row_squares, gram = np.zeros(row_count), np.zeros((row_count, row_count))
    blocks = list(_column_blocks(matrices[0].shape[1]))
    for columns in blocks:
        row_squares += np.concatenate(
            [np.einsum("ij,ij->i", matrix[:, columns], matrix[:, columns]) for matrix in matrices]
        )
    row_lengths = np.sqrt(row_squares)
    row_lengths[row_lengths == 0] = 1.0  # the spectrum of a decay that ends at once
    for columns in blocks:
        unit_rows = np.concatenate([matrix[:, columns] for matrix in matrices])
        unit_rows /= row_lengths[:, None]
        gram += unit_rows @ unit_rows.T
    gram[np.diag_indices_from(gram)] += regularization
    return gram, row_lengths


def _orthonormalise(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace rows by orthonormal rows with the same span.

    Return the matrix whose product with them restores the given rows.
    """
    gram, row_lengths = _scaled_gram(rows, regularization=1e-13)
    triangular_factor = np.linalg.cholesky(gram)
    # A product takes a third of the time of a solution for many columns.
    orthonormalising_matrix = np.linalg.inv(triangular_factor) / row_lengths
    for columns in _column_blocks(rows.shape[1]):
        rows[:, columns] = orthonormalising_matrix @ rows[:, columns]
    restoring_matrix: NDArray[np.float64] = triangular_factor * row_lengths[:, None]
    return restoring_matrix


def _remove_span(rows: NDArray[np.float64], span: NDArray[np.float64]) -> None:
    """Subtract from rows, in place, their part in the span of orthonormal rows."""
    coefficients = rows @ span.T
    for columns in _column_blocks(rows.shape[1]):
        rows[:, columns] -= coefficients @ span[:, columns]


@dataclass(frozen=True, slots=True)
class _LinearSolution:
    """Best linear parameters of the modal model for one set of frequencies and damping.

    `jacobian` are the derivatives of the whitened `residual` outside the span of the spectra that
    the linear parameters multiply. Real and imaginary parts are interleaved, so that rows have 2 K
    values.
    """

    residual: NDArray[np.float64]
    linear_parameters: NDArray[np.float64]
    jacobian: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Uncertainty:
    """Uncertainty of the modal model at a minimum.

    `covariance` is the joint one of frequencies, damping and linear parameters, `span` are
    orthonormal rows that span all derivatives of the residual, and `ln_damping_by_torque`, shape
    (n, 2 K), is the derivative of the logarithm of each eta by the whitened torque.
    """

    covariance: NDArray[np.float64]
    span: NDArray[np.float64]
    ln_damping_by_torque: NDArray[np.float64]


def _ln_damping_by_torque(
    jacobian: NDArray[np.float64], x: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative of each ln(eta) at a minimum `x` by the whitened torque, (n, 2 K)."""
    gram, row_lengths = _scaled_gram(jacobian, regularization=1e-14)
    derivatives = np.empty((x.size // 2, jacobian.shape[1]))
    for columns in _column_blocks(jacobian.shape[1]):
        # The residual is predicted minus measured: the torque enters it with the opposite sign.
        unit_rows = jacobian[:, columns] / row_lengths[:, None]
        x_by_torque = np.linalg.solve(gram, unit_rows) / row_lengths[:, None]
        derivatives[:, columns] = x_by_torque[1::2] / x[1::2, None]
    return derivatives


def _relative_pole(eta: float) -> complex:
    """Return the pole of a mode over its undamped frequency in rad/s, for the loss factor eta.

    It is the root of ``1 + eta q + q²`` with positive imaginary part.
    """
    return complex(-eta / 2, math.sqrt(1 - eta * eta / 4))


def _relative_pole_derivative(eta: float) -> complex:
    """Return the derivative of `_relative_pole` with respect to the loss factor eta."""
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
        self._recent: RecentValues[_LinearSolution] = (
            comparison.shared_values if comparison.is_long else RecentValues()
        )
        self._numbers = numbers
        self._comparison = comparison
        self._weight = weight
        self._effect_spectra = effect_spectra
        self._s = comparison.prediction.s
        self.scale_rad_s = 2 * math.pi * float(comparison.frequency_hz[-1])
        self._measured_torque = self._whiten(
            comparison.spectrum(comparison.torque_nm[comparison.retained])
        )
        background_responses = np.array(
            [(self._s / self.scale_rad_s) ** n for n in range(BACKGROUND_COEFFICIENTS)]
        )
        self._background = self._predicted_spectra(background_responses)

    def for_modes(self, numbers: tuple[int, ...]) -> _ModalProblem:
        """Return the problem of other modes of the same record."""
        problem = copy(self)
        problem._numbers = numbers
        if not self._comparison.is_long:
            problem._recent = RecentValues()
        return problem

    def _whiten(self, spectra: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return whitened spectra with real and imaginary parts interleaved, shape (..., 2 K)."""
        return np.ascontiguousarray(spectra * self._weight).view(np.float64)

    def _predicted_spectra(
        self, responses: Sequence[NDArray[np.complex128]] | NDArray[np.complex128]
    ) -> NDArray[np.float64]:
        """Return the whitened torque spectra of transfer functions from the angle, (n, 2 K)."""
        comparison = self._comparison
        predicted_spectra = np.empty((len(responses), 2 * self._weight.size))
        for rows in comparison.prediction.row_blocks(len(responses)):
            torque_nm = comparison.prediction.in_time(np.asarray(responses[rows]))
            predicted_spectra[rows] = self._whiten(comparison.spectrum(torque_nm))
        return predicted_spectra

    def _poles(self, x: NDArray[np.float64]) -> list[Pole]:
        """Return the poles of the modes, with their derivatives by frequencies and damping.

        `x` is ``(ln omega_1, eta_1, ln omega_2, …)``.
        """
        poles = []
        for k, (log_omega, eta) in enumerate(x.reshape(-1, 2)):
            omega_rad_s, q = math.exp(log_omega), _relative_pole(eta)
            pole_derivative = np.zeros(x.size, dtype=np.complex128)
            pole_derivative[2 * k] = omega_rad_s * q
            pole_derivative[2 * k + 1] = omega_rad_s * _relative_pole_derivative(eta)
            poles.append(Pole(self._numbers[k], omega_rad_s * q, pole_derivative))
        return poles

    def _nuisance_spectra(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return the torque spectra of all disturbances and effects of unknown amplitude, (m, K).

        They are not whitened.
        """
        return np.concatenate([self._comparison.nuisance_spectra(poles), self._effect_spectra])

    def _drag_change(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return the change of the air-drag torque with the poles, and its derivatives, (1 + k, K).

        Row 0 is the change of the spectrum relative to the plant for which the drag was computed.
        """
        change_and_derivatives = np.zeros(
            (1 + 2 * len(poles), self._weight.size), dtype=np.complex128
        )
        drag_expansion = self._comparison.drag
        if drag_expansion is None:
            return change_and_derivatives
        for pole in poles:
            if pole.mode in drag_expansion.by_pole:
                own_pole = complex(drag_expansion.response.poles[pole.mode - 1])
                pole_difference = pole.at_rad_s - own_pole
                remainder, remainder_slopes = drag_expansion.torque_beyond_first_order(
                    pole.mode, own_pole, pole.at_rad_s
                )
                change_and_derivatives[0] -= remainder
                by_real, by_imaginary = drag_expansion.by_pole[pole.mode]
                change_and_derivatives[0] += (
                    pole_difference.real * by_real + pole_difference.imag * by_imaginary
                )
                by_real_at_pole, by_imaginary_at_pole = (
                    drag_expansion.by_pole[pole.mode] - remainder_slopes
                )
                change_and_derivatives[1:] += np.outer(pole.derivative.real, by_real_at_pole)
                change_and_derivatives[1:] += np.outer(pole.derivative.imag, by_imaginary_at_pole)
        return change_and_derivatives

    def solution_at(self, x: NDArray[np.float64]) -> _LinearSolution:
        """Return the best linear parameters at ``x = (ln omega_1, eta_1, ln omega_2, …)``.

        The solutions at the last points are cached.
        """
        return self._recent.at(x, self._solve_at, self if self._comparison.is_long else None)

    def _solve_at(self, x: NDArray[np.float64]) -> _LinearSolution:
        """Return the best linear parameters at a point `x`, computed without the cache."""
        span = self._linear_spectra(x)
        residual, linear_parameters = self._solve(x, span)
        jacobian = np.empty((x.size, residual.size))
        self._write_jacobian(x, linear_parameters, jacobian)
        _remove_span(jacobian, span)
        return _LinearSolution(residual, linear_parameters, jacobian)

    def best_fit(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the whitened residual and the best linear parameters at a point `x`."""
        if self._comparison.is_long:
            self._recent.clear()
        return self._solve(x, self._linear_spectra(x))

    def cost(self, x: NDArray[np.float64]) -> float:
        """Return the sum of the squared whitened residual at a point `x`."""
        residual, _ = self.best_fit(x)
        return float(residual @ residual)

    def uncertainty(
        self, x: NDArray[np.float64], linear_parameters: NDArray[np.float64]
    ) -> _Uncertainty:
        """Return covariance and derivatives at a minimum `x` with its linear parameters."""
        if self._comparison.is_long:
            self._recent.clear()
        rows = self._linear_spectra(x, x.size)
        spectra, jacobian = rows[: -x.size], rows[-x.size :]
        self._write_jacobian(x, linear_parameters, jacobian)
        gram, row_lengths = _scaled_gram(jacobian, spectra, regularization=1e-14)
        covariance: NDArray[np.float64] = np.linalg.inv(gram) / np.outer(row_lengths, row_lengths)
        # From here on in place: the rows of a long record take much memory.
        _orthonormalise(spectra)
        _remove_span(jacobian, spectra)
        ln_damping_by_torque = _ln_damping_by_torque(jacobian, x)
        _orthonormalise(jacobian)
        return _Uncertainty(covariance, rows, ln_damping_by_torque)

    def _linear_spectra(self, x: NDArray[np.float64], further_rows: int = 0) -> NDArray[np.float64]:
        """Return the whitened spectra that the linear parameters multiply, shape (m, 2 K).

        They are those of the numerators of the modes, of the background and of the nuisances, in
        this order. `further_rows` is the number of rows that are added without values.
        """
        nuisance_spectra = self._nuisance_spectra(self._poles(x))
        nuisance_start = x.size + BACKGROUND_COEFFICIENTS
        nuisance_end = nuisance_start + len(nuisance_spectra)
        rows = np.empty((nuisance_end + further_rows, 2 * self._weight.size))
        for row, spectrum in zip(rows[nuisance_start:nuisance_end], nuisance_spectra, strict=True):
            row[:] = self._whiten(spectrum)
        del nuisance_spectra
        for k, (log_omega, eta) in enumerate(x.reshape(-1, 2)):
            _, _, numerators = self._numerators(log_omega, eta)
            rows[2 * k : 2 * k + 2] = self._predicted_spectra(numerators)
        rows[x.size : nuisance_start] = self._background
        return rows

    def _numerators(
        self, log_omega: float, eta: float
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128], tuple[NDArray[np.complex128], ...]]:
        """Return q, one over the denominator, and both numerators over it, of a mode."""
        q = self._s / math.exp(log_omega)
        inverse_denominator = 1 / (1 + eta * q + q * q)
        return q, inverse_denominator, (q * q * inverse_denominator, q**3 * inverse_denominator)

    def _solve(
        self, x: NDArray[np.float64], spectra: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the residual and linear parameters; make their spectra at `x` orthonormal."""
        triangular_factor = _orthonormalise(spectra)
        measured_torque = self._measured_torque
        if self._comparison.drag is not None:
            measured_torque = measured_torque - self._whiten(self._drag_change(self._poles(x))[0])
        projections = spectra @ measured_torque
        residual: NDArray[np.float64] = projections @ spectra - measured_torque
        linear_parameters = np.linalg.solve(triangular_factor.T, projections)
        return residual, linear_parameters.astype(np.float64, copy=False)

    def _write_jacobian(
        self,
        x: NDArray[np.float64],
        linear_parameters: NDArray[np.float64],
        jacobian: NDArray[np.float64],
    ) -> None:
        """Write the derivatives of the whitened residual by `x` into an array, shape (k, 2 K)."""
        poles = self._poles(x)
        jacobian[:] = 0.0
        if self._comparison.drag is not None:
            jacobian[:] = self._whiten(self._drag_change(poles)[1:])
        if poles:
            nuisance_amplitudes = linear_parameters[x.size + BACKGROUND_COEFFICIENTS :]
            decay_gradient = self._comparison.decay_gradient(poles, nuisance_amplitudes)
            for k, derivative in enumerate(decay_gradient):
                jacobian[k] += self._whiten(derivative)
            del decay_gradient
        for k, (log_omega, eta) in enumerate(x.reshape(-1, 2)):
            q, inverse_denominator, numerators = self._numerators(log_omega, eta)
            a, b = linear_parameters[2 * k : 2 * k + 2]
            response = a * numerators[0] + b * numerators[1]
            denominator_by_ln_omega = (eta * q + 2 * q * q) * inverse_denominator
            jacobian[2 * k : 2 * k + 2] += self._predicted_spectra(
                [
                    response * (denominator_by_ln_omega - 2) - b * numerators[1],
                    -response * q * inverse_denominator,
                ]
            )

    def model(self, x: NDArray[np.float64], linear_parameters: NDArray[np.float64]) -> ModalModel:
        """Return the modal model with given frequencies, damping and linear parameters."""
        mode_points = x.reshape(-1, 2)
        poles, residues = [], []
        background_start = 2 * len(mode_points)
        background_coefficients = linear_parameters[
            background_start : background_start + BACKGROUND_COEFFICIENTS
        ] / self.scale_rad_s ** np.arange(BACKGROUND_COEFFICIENTS)
        for k, (log_omega, eta) in enumerate(mode_points):
            omega_rad_s, (a, b) = math.exp(log_omega), linear_parameters[2 * k : 2 * k + 2]
            q = _relative_pole(eta)
            poles.append(omega_rad_s * q)
            residues.append(omega_rad_s * (a + b * q) * q * q / (2j * q.imag))
            # Add the polynomial part of (a + b q) q² over the denominator.
            background_coefficients[0] += a - b * eta
            background_coefficients[1] += b / omega_rad_s
        return ModalModel(tuple(poles), tuple(residues), tuple(background_coefficients.tolist()))

    def residual(
        self, x: NDArray[np.float64], linear_parameters: NDArray[np.float64], model: ModalModel
    ) -> NDArray[np.complex128]:
        """Return the residual spectrum of a model at a point in N·m, not whitened, shape (K,)."""
        nuisance_amplitudes = linear_parameters[x.size + BACKGROUND_COEFFICIENTS :]
        poles = self._poles(x)
        comparison = self._comparison
        predicted_nm = comparison.prediction.torque(model)[0]
        modal_residual = comparison.spectrum(
            predicted_nm - comparison.torque_nm[comparison.retained]
        )
        drag_change: NDArray[np.complex128] = self._drag_change(poles)[0]
        return drag_change + modal_residual + nuisance_amplitudes @ self._nuisance_spectra(poles)

    def ringing(
        self, linear_parameters: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> Ringing:
        """Return amplitudes and chi-square of the free decay at the beginning of the record.

        The decay of each mode has two amplitudes, which are free linear parameters of the fit.
        """
        mode_count = len(self._numbers)
        decay_start = 2 * mode_count + BACKGROUND_COEFFICIENTS
        decay_amplitudes = linear_parameters[decay_start : decay_start + 2 * mode_count]
        decay_rows = slice(
            2 * mode_count + decay_start, 2 * mode_count + decay_start + 2 * mode_count
        )
        return Ringing(
            amplitude_nm=tuple(np.hypot(decay_amplitudes[::2], decay_amplitudes[1::2]).tolist()),
            chi_square=float(
                decay_amplitudes
                @ np.linalg.solve(covariance[decay_rows, decay_rows], decay_amplitudes)
            ),
            degrees_of_freedom=decay_amplitudes.size,
        )

    def constants(
        self,
        linear_parameters: NDArray[np.float64],
        x: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the constants of all modes, and their covariance with the background coefficients.

        The constants are `MODE_CONSTANT_NAMES`. The shapes are (4 n,) and (4 n + 5, 4 n + 5).
        """
        mode_count = x.size // 2
        mode_constants = np.empty(4 * mode_count)
        background_start = x.size + 2 * mode_count
        derivatives = np.zeros(
            (4 * mode_count + BACKGROUND_COEFFICIENTS, background_start + BACKGROUND_COEFFICIENTS)
        )
        background_rows = derivatives[4 * mode_count :]
        background_rows[:, background_start:] = np.diag(
            self.scale_rad_s ** -np.arange(float(BACKGROUND_COEFFICIENTS))
        )
        for k in range(mode_count):
            log_omega, eta = x[2 * k : 2 * k + 2]
            a, b = linear_parameters[2 * k : 2 * k + 2]
            q = _relative_pole(eta)
            residue_numerator = a + b * q
            # ln of the residue over j: ln omega + ln (a + b q) + 2 ln q - ln(2 Im q) + j pi
            log_residue = np.log(-residue_numerator * q * q / (2 * q.imag)) + log_omega
            pole_derivative = _relative_pole_derivative(eta)
            residue_by_eta = (
                b / residue_numerator + 2 / q
            ) * pole_derivative - pole_derivative.imag / q.imag
            residue_by_a, residue_by_b = 1 / residue_numerator, q / residue_numerator
            mode_constants[4 * k : 4 * k + 4] = (
                log_omega + math.log(q.imag / (2 * math.pi)),
                math.log(eta / 2),
                log_residue.real,
                log_residue.imag,
            )
            mode_rows = derivatives[4 * k : 4 * k + 4]
            omega_index, eta_index, a_index, b_index = (
                2 * k,
                2 * k + 1,
                x.size + 2 * k,
                x.size + 2 * k + 1,
            )
            mode_rows[0, [omega_index, eta_index]] = 1.0, pole_derivative.imag / q.imag
            mode_rows[1, eta_index] = 1 / eta
            mode_rows[2, [omega_index, eta_index, a_index, b_index]] = (
                1.0,
                residue_by_eta.real,
                residue_by_a.real,
                residue_by_b.real,
            )
            mode_rows[3, [eta_index, a_index, b_index]] = (
                residue_by_eta.imag,
                residue_by_a.imag,
                residue_by_b.imag,
            )
            # The remainder of the division of the numerator by the denominator, as in `model`.
            background_rows[0, [a_index, b_index, eta_index]] = 1.0, -eta, -b
            background_rows[1, [b_index, omega_index]] = np.array([1.0, -b]) / math.exp(log_omega)
        used_covariance = covariance[: derivatives.shape[1], : derivatives.shape[1]]
        return mode_constants, derivatives @ used_covariance @ derivatives.T

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Return cost, gradient and Hessian at a point `x`, with Kaufman's Jacobian."""
        solution = self.solution_at(x)
        return NormalEquations(
            cost=float(solution.residual @ solution.residual),
            gradient=solution.jacobian @ solution.residual,
            hessian=solution.jacobian @ solution.jacobian.T,
        )
