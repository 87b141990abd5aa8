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

from analysis.identify._modal_model import MODE_CONSTANT_NAMES, ModalEstimate
from analysis.identify._modal_problem import ModalProblem, column_blocks
from analysis.identify._visible_modes import is_excited
from analysis.identify.noise import noise_power_with_peaks, smooth_power
from analysis.identify.residual_tests import input_relation, whiteness
from analysis.optimizer import ConstantBounds, descend

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._estimates import Ringing
    from analysis.identify.noise import NoiseSpectrum
    from analysis.identify.residual_tests import InputRelation, Whiteness
    from rigd.beam import Plant

_COST_TOLERANCE: Final = 1e-8
"""Relative tolerance of the sum of squares at which a descent has converged."""

_MIN_LOSS_FACTOR: Final = 1e-5
"""Lower bound of eta, which is twice the damping ratio of a mode."""

_MAX_LOSS_FACTOR: Final = 1.0
"""Upper bound of eta, which is twice the damping ratio of a mode."""

_MAX_LOG_FREQUENCY_CHANGE: Final = 0.15
"""Largest change of the logarithm of a mode frequency in the search."""

_MIN_FREQUENCY_TO_FIRST_MODE: Final = 0.12
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

_MAX_NOISE_ESTIMATE_ROUNDS: Final = 3
"""Maximum number of estimates of the noise spectrum, each followed by a descent."""

_LOG_NOISE_TOLERANCE: Final = 0.02
"""Mean change of the logarithm of the noise power below which the noise spectrum has converged."""

_MAX_ADDITIONAL_RESONANCES: Final = 2
"""Maximum number of resonances, of the sensor or the mount, that are added to those of the beam."""

_MIN_DEVIANCE_REDUCTION_BY_MODE: Final = 60.0
"""Minimum reduction of the deviance by a mode or an additional resonance that is retained."""

_MIN_VISIBLE_DEVIANCE_REDUCTION: Final = 400.0
"""Minimum reduction of the deviance by a mode that counts as visible: its damping ratio is then
known to a tenth."""


_MAX_RESIDUE_STD_GROWTH: Final = 10.0
"""Growth of the standard deviations of the residues by the free decay from which the response to
the motor is not determined. Before a step it is 1 to 4 after a rest of 0.3 s or more, and 35 to 170
after 0.1 s or less."""

_MAX_RELATIVE_RESIDUE_STD: Final = 0.3
"""Standard deviation of the logarithm of a visible mode's residue from which the response to the
motor is not determined, as in the decay after a step. Intervals assume that the fit is linear in
the unknowns, and are wrong for more uncertain residues."""


@dataclass(frozen=True, slots=True)
class ModalFit(ModalEstimate):
    """Modal model (poles and residues of each mode) fitted to one record.

    Attributes
    ----------
    cost_increases_without_mode : tuple of float
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
    derivative_span : _DerivativeSpan
        Span of all derivatives of the whitened residual.
    ln_damping_per_torque : ndarray, shape (n, 2 K)
        Derivative of the logarithm of each estimated damping ratio by the whitened torque.
    effect_sizes, effect_stds : tuple of float
        Amplitude of each torque spectrum that was fitted with the modes, and its standard
        deviation.
    """

    cost_increases_without_mode: tuple[float, ...]
    residual: NDArray[np.complex128]
    noise: NoiseSpectrum
    whiteness: Whiteness
    input_relation: InputRelation
    ringing: Ringing
    derivative_span: _DerivativeSpan
    ln_damping_per_torque: NDArray[np.float64]
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
        span_rows, residual = self.derivative_span.span_rows(), self.residual.view(np.float64)

        def whitened_spectra(columns: slice) -> NDArray[np.float64]:
            frequency_bins = slice(columns.start // 2, columns.stop // 2)
            spectra = np.array([spectrum[frequency_bins] for spectrum in torque_spectra])
            return np.ascontiguousarray(spectra * self.noise.weight[frequency_bins]).view(
                np.float64
            )

        column_ranges = list(column_blocks(residual.size))
        span_coefficients = sum(
            whitened_spectra(columns) @ span_rows[:, columns].T for columns in column_ranges
        )
        projections, squared_norms = np.zeros((2, len(torque_spectra)))
        for columns in column_ranges:
            outside_span = whitened_spectra(columns) - span_coefficients @ span_rows[:, columns]
            projections += outside_span @ residual[columns]
            squared_norms += np.einsum("ij,ij->i", outside_span, outside_span)
        cost_reductions: NDArray[np.float64] = projections**2 / np.maximum(
            squared_norms, np.finfo(float).tiny
        )
        return cost_reductions

    def _whiten(self, torque_spectra: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return whitened spectra with real and imaginary parts interleaved, shape (..., 2 K)."""
        return np.ascontiguousarray(torque_spectra * self.noise.weight).view(np.float64)

    def part_outside_span(self, whitened_spectra: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the part of whitened spectra that no parameter of the fit can imitate.

        Parameters
        ----------
        whitened_spectra : ndarray, shape (..., 2 K)
            Whitened spectra with real and imaginary parts interleaved.
        """
        span_rows = self.derivative_span.span_rows()
        part_outside_span: NDArray[np.float64] = (
            whitened_spectra - (whitened_spectra @ span_rows.T) @ span_rows
        )
        return part_outside_span

    def effect_std(self, torque_spectrum: NDArray[np.complex128]) -> float:
        """Return the standard deviation that the size of an additional effect would have.

        Parameters
        ----------
        torque_spectrum : ndarray of complex, shape (K,)
            Torque spectrum of the effect in N·m per unit of its size, not whitened.
        """
        unexplained_part = self.part_outside_span(self._whiten(torque_spectrum))
        return 1 / math.sqrt(max(float(unexplained_part @ unexplained_part), np.finfo(float).tiny))

    def damping_std_growth_factors(
        self, torque_spectrum: NDArray[np.complex128], prior_size_std: float
    ) -> NDArray[np.float64]:
        """Return how much less certain damping ratios are with an additional effect, shape (n,).

        Each value is the standard deviation with the effect, whose size is free, divided by that
        without the effect.

        Parameters
        ----------
        torque_spectrum : ndarray of complex, shape (K,)
            Torque spectrum of the effect in N·m per unit of its size, not whitened.
        prior_size_std : float
            Standard deviation of the size before the record.
        """
        whitened_spectrum = self._whiten(torque_spectrum)
        size_variance = 1 / (self.effect_std(torque_spectrum) ** -2 + prior_size_std**-2)
        damping_variance = np.diag(self.covariance)[
            MODE_CONSTANT_NAMES.index("ln_damping_ratio") :: len(MODE_CONSTANT_NAMES)
        ]
        added_damping_variance = (
            self.ln_damping_per_torque @ whitened_spectrum
        ) ** 2 * size_variance
        growth_factors: NDArray[np.float64] = np.sqrt(1 + added_damping_variance / damping_variance)
        return growth_factors

    @property
    def residual_is_noise(self) -> bool:
        """Return whether only noise remains in the residual of the modal model."""
        return self.whiteness.is_white and not self.input_relation.related

    @property
    def visible_mode_numbers(self) -> tuple[int, ...]:
        """Return the sorted numbers of the beam modes that are visible in the record."""
        modes_with_cost_increase = zip(
            self.mode_numbers, self.cost_increases_without_mode, strict=True
        )
        return tuple(
            sorted(
                mode_number
                for mode_number, deviance_reduction in modes_with_cost_increase
                if mode_number and deviance_reduction > _MIN_VISIBLE_DEVIANCE_REDUCTION
            )
        )

    @property
    def determines_response(self) -> bool:
        """Return whether the response to the motor is distinct from a ringing of the beam.

        Otherwise residues, and all that follows from them, are not determined.
        """
        residue_indices = self.constant_indices(self.visible_mode_numbers)[
            MODE_CONSTANT_NAMES.index("ln_residue") :: len(MODE_CONSTANT_NAMES)
        ]
        residue_variances = np.diag(self.covariance)[residue_indices]
        return self.ringing.residue_std_growth <= _MAX_RESIDUE_STD_GROWTH and bool(
            np.all(residue_variances <= _MAX_RELATIVE_RESIDUE_STD**2)
        )

    @property
    def has_damping_at_limit(self) -> bool:
        """Return whether a visible mode has the largest damping of the search."""
        visible_poles = (self.poles_rad_s[number] for number in self.visible_mode_numbers)
        return any(-2 * pole.real > 0.999 * _MAX_LOSS_FACTOR * abs(pole) for pole in visible_poles)

    def plant_with_modal_frequencies(self, plant: Plant) -> Plant:
        """Return the plant with stiffnesses adjusted to the frequencies of the visible modes.

        The given plant is returned unchanged if no stiffnesses give these frequencies, if the
        visible modes are not modes 1 to n without a gap, or if the plant has a tip mass, a
        compliant clamp or a filter.

        Parameters
        ----------
        plant : Plant
            Plant with a bare beam.
        """
        visible_numbers = self.visible_mode_numbers
        if (
            not visible_numbers
            or any(plant.optional_parameters.values())
            or len(visible_numbers) != visible_numbers[-1]
        ):
            return plant
        mode_frequencies_hz = [
            self.poles_rad_s[mode_number].imag / (2 * math.pi) for mode_number in visible_numbers
        ]
        try:
            return plant.with_frequencies(mode_frequencies_hz)
        except ValueError:
            return plant


def fit_modes(
    comparison: Comparison,
    noise: NoiseSpectrum,
    mode_starts: Sequence[tuple[int, float, float]],
    torque_spectra: NDArray[np.complex128] | None = None,
) -> ModalFit | None:
    """Return the modal model fitted to a record; None if no mode is in the band or significant.

    `noise` is a first estimate; bins that it excludes stay excluded. `mode_starts` are the mode
    number, approximate frequency in Hz and approximate damping ratio of each mode.
    `torque_spectra`, shape (c, K), are of known form and unknown amplitude, as for `Objective`.
    """
    search = _ModalSearch.from_mode_starts(comparison, noise, mode_starts, torque_spectra)
    if search is None:
        return None
    search = search.remove_unexcited_modes().converge_with_noise().remove_undamped_modes()
    return search.add_resonances().fit()


def fit_with_given_poles(
    comparison: Comparison, noise: NoiseSpectrum, mode_poles: Sequence[tuple[int, float, float]]
) -> ModalFit | None:
    """Return the modal model with given poles and the best residues, without a search.

    A pole is given by mode number, frequency in Hz and damping ratio.
    """
    search = _ModalSearch.from_mode_starts(comparison, noise, mode_poles)
    return None if search is None else search.fit()


@dataclass(frozen=True, slots=True)
class _ModalSearch:
    """Search for mode frequencies and damping under one noise estimate.

    `mode_unknowns` is the current point ``(ln omega_1, eta_1, ln omega_2, …)``, with omega in
    rad/s.
    """

    comparison: Comparison
    noise: NoiseSpectrum
    effect_spectra: NDArray[np.complex128]
    mode_numbers: tuple[int, ...]
    mode_unknowns: NDArray[np.float64]

    @classmethod
    def from_mode_starts(
        cls,
        comparison: Comparison,
        noise: NoiseSpectrum,
        mode_starts: Sequence[tuple[int, float, float]],
        torque_spectra: NDArray[np.complex128] | None = None,
    ) -> _ModalSearch | None:
        """Return a search that starts at the modes in the band; None if no mode is in the band."""
        starts_in_band = [
            mode_start for mode_start in mode_starts if mode_start[1] <= comparison.frequency_hz[-1]
        ]
        if not starts_in_band:
            return None
        effect_spectra = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
        effect_spectra = effect_spectra if torque_spectra is None else torque_spectra
        lowest_hz = _MIN_FREQUENCY_TO_FIRST_MODE * min(hz for _, hz, _ in starts_in_band)
        is_compared = noise.is_compared & (comparison.frequency_hz >= lowest_hz)
        return cls(
            comparison,
            replace(noise, is_compared=is_compared),
            effect_spectra,
            tuple(mode_number for mode_number, _, _ in starts_in_band),
            np.array(
                [
                    [math.log(2 * math.pi * hz), 2 * damping_ratio]
                    for _, hz, damping_ratio in starts_in_band
                ]
            ).ravel(),
        )

    def problem(self) -> ModalProblem:
        """Return the least-squares problem of the modes of this search under its noise estimate."""
        return ModalProblem(
            self.comparison, self.noise.weight, self.effect_spectra, self.mode_numbers
        )

    def descend_to_minimum(self) -> _ModalSearch:
        """Return the search moved to the minimum of the cost under its noise estimate."""
        return self._descend(self.problem())

    def _descend(self, problem: ModalProblem) -> _ModalSearch:
        """Return the search moved to the minimum of the cost of its problem."""
        lower_bounds = np.column_stack(
            [
                self.mode_unknowns[::2] - _MAX_LOG_FREQUENCY_CHANGE,
                np.full(len(self.mode_numbers), _MIN_LOSS_FACTOR),
            ]
        )
        upper_bounds = np.column_stack(
            [
                self.mode_unknowns[::2] + _MAX_LOG_FREQUENCY_CHANGE,
                np.full(len(self.mode_numbers), _MAX_LOSS_FACTOR),
            ]
        )
        minimum = descend(
            problem.normal_equations,
            self.mode_unknowns,
            ConstantBounds(lower_bounds.ravel(), upper_bounds.ravel()),
            relative_tolerance=_COST_TOLERANCE,
            max_evaluations=60,
        )
        return replace(self, mode_unknowns=minimum.x)

    def converge_with_noise(self) -> _ModalSearch:
        """Alternate descents with estimates of noise and unknown torque until all converge."""
        search = self
        for _ in range(_MAX_NOISE_ESTIMATE_ROUNDS):
            problem = search.problem()
            search = search._descend(problem)
            linear_parameters = problem.solution_at(search.mode_unknowns).linear_parameters
            modal_model = problem.modal_model(search.mode_unknowns, linear_parameters)
            residual_spectrum = problem.residual_spectrum(
                search.mode_unknowns, linear_parameters, modal_model
            )
            comparison = search.comparison
            # A torque that the modal model lacks would change which part of the angle follows it.
            if not (len(search.effect_spectra) or comparison.drag):
                comparison = comparison.with_reestimated_angle(modal_model, search.noise)
            comparison = comparison.fill_unknown_torque(
                modal_model, *problem.decays(search.mode_unknowns, linear_parameters)
            )
            noise_power = smooth_power(residual_spectrum, has_narrow_blocks=True)
            noise_power = noise_power_with_peaks(
                residual_spectrum,
                noise_power,
                ~search.is_near_mode(),
                ~search.is_near_mode(within_resonance=True),
            )
            noise_power /= comparison.measurement.known_torque_fraction
            noise_power += comparison.encoder_noise_power(modal_model)
            is_compared = search.noise.is_compared
            mean_log_change = np.abs(np.log(noise_power / search.noise.power)[is_compared]).mean()
            search = replace(
                search, comparison=comparison, noise=replace(search.noise, power=noise_power)
            )
            if mean_log_change < _LOG_NOISE_TOLERANCE and comparison.measurement.torque_known.all():
                break
        del problem  # which stores spectra, as the next one does
        return search.descend_to_minimum()

    def derivative_span_rows(self) -> NDArray[np.float64]:
        """Return orthonormal rows that span all derivatives of the residual, shape (r, 2 K)."""
        problem = self.problem()
        return problem.uncertainty(
            self.mode_unknowns, problem.residual_and_linear_parameters(self.mode_unknowns)[1]
        ).span_rows

    def is_near_mode(self, *, within_resonance: bool = False) -> NDArray[np.bool_]:
        """Return a mask of the bins in which the residual may belong to a mode, shape (K,).

        They are the bins within a distance that depends on the width of the resonance; with
        `within_resonance`, within half of this distance. A peak of the noise begins outside of the
        whole distance, and ends at half of it.
        """
        bin_hz = self.comparison.frequency_hz[:, None]
        mode_hz, eta = np.exp(self.mode_unknowns[::2]) / (2 * np.pi), self.mode_unknowns[1::2]
        margin_hz = _MODE_REACH_MARGIN_BINS * float(bin_hz[1, 0] - bin_hz[0, 0])
        mode_reach_hz = (
            np.maximum(_MODE_REACH_HALF_WIDTHS * eta / 2, _MIN_RELATIVE_MODE_REACH) * mode_hz
            + margin_hz
        )
        if within_resonance:
            mode_reach_hz = mode_reach_hz / 2
        is_near_any_mode: NDArray[np.bool_] = np.any(
            np.abs(bin_hz - mode_hz) < mode_reach_hz, axis=1
        )
        return is_near_any_mode

    def cost(self) -> float:
        """Return the cost at the current point: the sum of the squared whitened residual."""
        return self.problem().cost(self.mode_unknowns)

    def add_resonances(self) -> _ModalSearch:
        """Return the search with a resonance added where the residual depends on the motor angle.

        A resonance is added only while it reduces the cost enough and overlaps with no mode.
        """
        search = self
        for _ in range(_MAX_ADDITIONAL_RESONANCES):
            input_dependence = search.residual_dependence_on_angle(
                search.problem().residual_and_linear_parameters(search.mode_unknowns)[0]
            )
            if not input_dependence.related:
                break
            resonance_start = [math.log(2 * math.pi * input_dependence.at_hz), 0.02]
            search_with_resonance = replace(
                search,
                mode_numbers=(*search.mode_numbers, 0),
                mode_unknowns=np.concatenate([search.mode_unknowns, resonance_start]),
            ).converge_with_noise()
            search_without_resonance = replace(
                search,
                noise=search_with_resonance.noise,
                comparison=search_with_resonance.comparison,
            ).descend_to_minimum()
            if (
                search_without_resonance.cost() - search_with_resonance.cost()
                < _MIN_DEVIANCE_REDUCTION_BY_MODE
                or search_with_resonance.last_mode_overlaps()
            ):
                break
            search = search_with_resonance
        return search

    def last_mode_overlaps(self) -> bool:
        """Return whether the frequency of the last mode is within the width of another mode."""
        mode_rad_s = np.exp(self.mode_unknowns[::2])
        half_widths = mode_rad_s * self.mode_unknowns[1::2] / 2
        least_distances = _MODE_REACH_HALF_WIDTHS * (half_widths[:-1] + half_widths[-1])
        return bool(np.any(np.abs(mode_rad_s[:-1] - mode_rad_s[-1]) < least_distances))

    def remove_unexcited_modes(self) -> _ModalSearch:
        """Return the search without modes that are not excited in the record.

        Such modes hardly reduce the cost at the start, and lose their damping in a descent. They
        would be fitted to a narrow line of the noise.
        """
        cost_increases = self.cost_increases_without_mode()
        if cost_increases.min() >= _MIN_DEVIANCE_REDUCTION_BY_MODE:
            return self
        is_undamped = self.descend_to_minimum().mode_unknowns[1::2] < 2 * _MIN_LOSS_FACTOR
        return self._remove_modes((cost_increases < _MIN_DEVIANCE_REDUCTION_BY_MODE) & is_undamped)

    def remove_undamped_modes(self) -> _ModalSearch:
        """Return the search without modes that lost their damping: they are not in the record.

        Where the reference does not excite the motor, its angle is noise. A mode fitted there
        predicts a torque that was not measured, and its damping falls to its bound to make this
        torque small. The fit gives evidence for the mode nevertheless, because it estimates the
        incoherent part of angle and torque with the mode itself. A mode that the reference excites
        stays: it may lose its damping to drag, or to an impact that is not in the model.
        """
        mode_hz = np.exp(self.mode_unknowns[::2]) / (2 * np.pi)
        is_undamped = self.mode_unknowns[1::2] < 2 * _MIN_LOSS_FACTOR
        damped_hz = mode_hz[~is_undamped].tolist()
        is_removed = is_undamped.copy()
        for i in np.flatnonzero(is_undamped):
            is_removed[i] = not any(
                is_excited(self.comparison, float(mode_hz[i]), compared_hz=other_hz)
                for other_hz in damped_hz
            )
        if is_undamped.all() or not is_removed.any():
            return self
        search = self._remove_modes(is_removed)
        return search.converge_with_noise().remove_undamped_modes()

    def _remove_modes(self, removed_modes: int | NDArray[np.bool_]) -> _ModalSearch:
        """Return the search without the mode at an index, or without those of a mask."""
        return replace(
            self,
            mode_numbers=tuple(np.delete(self.mode_numbers, removed_modes).tolist()),
            mode_unknowns=np.delete(
                self.mode_unknowns.reshape(-1, 2), removed_modes, axis=0
            ).ravel(),
        )

    def cost_increases_without_mode(self) -> NDArray[np.float64]:
        """Return the cost increase by the removal of each mode alone, without a descent, (n,)."""
        problem = self.problem()
        full_cost = problem.cost(self.mode_unknowns)
        searches_without_mode = [self._remove_modes(i) for i in range(len(self.mode_numbers))]
        return np.array(
            [
                problem.for_modes(search.mode_numbers).cost(search.mode_unknowns) - full_cost
                for search in searches_without_mode
            ]
        )

    def residual_dependence_on_angle(self, whitened_residual: NDArray[np.float64]) -> InputRelation:
        """Return the result of a test whether a residual depends linearly on the motor angle."""
        residual = whitened_residual.view(np.complex128)
        angle_spectrum = self.comparison.spectrum(
            self.comparison.angle_rad[self.comparison.retained_samples]
        )
        is_compared = self.noise.is_compared
        first_compared_bin = int(np.argmax(is_compared))
        return input_relation(
            residual[first_compared_bin:],
            angle_spectrum[first_compared_bin:],
            self.comparison.frequency_hz[first_compared_bin:],
        )

    def fit(self) -> ModalFit | None:
        """Return the modal fit after the removal of modes that do not reduce the cost enough.

        Return None if no mode of the beam remains. The removed modes are undetermined.
        """
        frequency_order = np.argsort(self.mode_unknowns[::2])
        search = replace(
            self,
            mode_unknowns=self.mode_unknowns.reshape(-1, 2)[frequency_order].ravel(),
            mode_numbers=tuple(self.mode_numbers[i] for i in frequency_order),
        )
        cost_increases = search.cost_increases_without_mode()
        while cost_increases.size and cost_increases.min() < _MIN_DEVIANCE_REDUCTION_BY_MODE:
            search = search._remove_modes(int(np.argmin(cost_increases))).descend_to_minimum()
            cost_increases = search.cost_increases_without_mode()
        if not any(search.mode_numbers):  # additional resonances alone are no model of the beam
            return None
        mode_unknowns, mode_numbers = search.mode_unknowns, search.mode_numbers
        problem = search.problem()
        residual, linear_parameters = problem.residual_and_linear_parameters(mode_unknowns)
        uncertainty = problem.uncertainty(mode_unknowns, linear_parameters)
        joint_covariance = uncertainty.covariance
        mode_constants, covariance = problem.constants_with_covariance(
            linear_parameters, mode_unknowns, joint_covariance
        )
        residual_spectrum = residual.view(np.complex128)
        is_compared = search.noise.is_compared
        effect_count = len(search.effect_spectra)
        effect_variances = np.diag(joint_covariance)[joint_covariance.shape[0] - effect_count :]
        return ModalFit(
            model=problem.modal_model(mode_unknowns, linear_parameters),
            mode_numbers=mode_numbers,
            mode_constants=mode_constants,
            joint_covariance=covariance,
            cost_increases_without_mode=tuple(cost_increases.tolist()),
            residual=residual_spectrum,
            noise=search.noise,
            whiteness=whiteness(
                residual_spectrum[is_compared], search.comparison.frequency_hz[is_compared]
            ),
            input_relation=search.residual_dependence_on_angle(residual),
            ringing=problem.ringing(linear_parameters, joint_covariance),
            derivative_span=_DerivativeSpan(search, uncertainty.span_rows),
            ln_damping_per_torque=uncertainty.ln_damping_per_torque,
            effect_sizes=tuple(linear_parameters[linear_parameters.size - effect_count :].tolist()),
            effect_stds=tuple(np.sqrt(effect_variances).tolist()),
        )


class _DerivativeSpan:
    """Orthonormal rows that span all derivatives of the whitened residual of a modal fit.

    The rows of a long record are computed again when needed: they take too much memory to be stored
    with each fit.
    """

    def __init__(self, search: _ModalSearch, span_rows: NDArray[np.float64]) -> None:
        self._search = search
        self._rows = None if search.comparison.is_long else span_rows

    def span_rows(self) -> NDArray[np.float64]:
        """Return the rows, shape (r, 2 K), with real and imaginary parts interleaved."""
        if self._rows is not None:
            return self._rows
        search = self._search
        span_rows: NDArray[np.float64] = search.comparison.shared_result_cache.value_at(
            search.mode_unknowns, lambda _mode_unknowns: search.derivative_span_rows(), self
        )
        return span_rows
