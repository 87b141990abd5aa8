"""Search for the lowest minimum of one structure: coarse response first, then the whole record.

The ratio of the two transforms of the whole record (the empirical transfer function estimate) is
exact except for ringing before and after the record. A few hundred of its points, densest at the
resonances, distinguish the minima in a hundredth of the time. The descents on the whole record
start at the minima of this coarse response.
"""

from __future__ import annotations

import itertools
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._hum import find_hum_near_modes, resonance_half_width_hz
from analysis.identify._problem import Objective
from analysis.identify.free_decay import count_decay_spectra
from analysis.identify.noise import Hum, NoiseSpectrum, estimate_noise
from analysis.identify.parametrization import StepRule
from analysis.optimizer import NormalEquations, descend
from analysis.paper import representative_points
from rigd.beam import ResponseGrid

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify.parametrization import Unknowns
    from analysis.optimizer import Minimum
    from rigd.beam import Plant


# Resonances

_LN_DENSITY_RATIO_SHIFTS: Final = np.linspace(-0.5, 0.5, 101)
"""Shifts of ln(rho/EI) at which the resonances are compared with the record."""

_SCAN_DAMPING_UNKNOWNS: Final = {"zeta": -4.5, "alpha": 1.0, "gamma": -3.0, "lambda": 1.0}
"""Damping at which the shifts are compared, as `Unknowns.start` accepts it."""


def unknowns_shift_to_resonances(
    coarse_response: CoarseResponse, unknowns: Unknowns
) -> NDArray[np.float64]:
    """Return the shift of the unknowns that aligns the resonances with the record, (k,).

    If a resonance is off by more than its width, no descent finds it.
    """
    moderate_damping_start = unknowns.start(
        np.array(
            [_SCAN_DAMPING_UNKNOWNS[parameter_name] for parameter_name in unknowns.structure.free]
        )
    )
    aligning_shift = np.zeros(moderate_damping_start.size)
    if "density_over_stiffness" in unknowns.names:
        aligning_shift[unknowns.names.index("density_over_stiffness")] = (
            coarse_response.best_ln_ratio_shift(unknowns.plant(moderate_damping_start))
        )
    return aligning_shift


# Coarse response

_COARSE_POINTS: Final = 400
"""Number of points of the coarse response."""

_MIN_EXCITED_POWER_RATIO: Final = 1e-2
"""Minimum power of the angle in a line of its spectrum, relative to the largest power nearby.
Between the lines of a multisine, leakage and ringing are all that a transform shows."""

_MAX_LINE_FRACTION: Final = 0.5
"""Largest fraction of bins with this power in a spectrum that consists of lines."""

_EXCITED_BAND_COUNT: Final = 100
"""Number of equal parts of the band, in each of which the powers are compared."""

_COARSE_COST_TOLERANCE: Final = 1e-2
"""Relative tolerance of the cost in a descent on the coarse response."""

_SAME_MINIMUM_DISTANCE: Final = 0.05
"""Minima whose plants differ by less than this fraction of the cost count as one."""

_MAX_COARSE_EVALUATIONS: Final = 60
"""Largest number of evaluations in a descent on the coarse response."""

_LN_START_COEFFICIENTS: Final = {
    name: tuple(np.log([1e-4, 1e-3, 1e-2, 1e-1])) for name in ("zeta", "gamma")
}
"""Logarithms of the start values of zeta and gamma, relative to stiffness and inertia at a mode:
about twice a damping ratio."""

_START_ORDERS: Final = (0.5, 1.5)
"""Start values of alpha and lambda besides 1."""


class CoarseResponse:
    """Measured frequency response of a record at a few hundred points, with their weights.

    A cost on it is cheap to compute.
    """

    __slots__ = ("_frequency_hz", "_measured", "_response", "_responses", "_shifts", "_weights")

    def __init__(self, comparison: Comparison) -> None:
        sample_count = comparison.angle_rad.size
        all_frequencies_hz = np.fft.rfftfreq(sample_count, 1 / comparison.decimation.rate_hz)
        first_hz, last_hz = comparison.frequency_hz[[0, -1]]
        band_bins = np.flatnonzero(
            (all_frequencies_hz >= first_hz) & (all_frequencies_hz <= last_hz)
        )
        angle_spectrum = np.fft.rfft(comparison.angle_rad)[band_bins]
        torque_spectrum = np.fft.rfft(comparison.torque_nm)[band_bins]
        # Without excitation the motor moved with the noise: such bins show no response.
        coherent_angle_spectrum = np.fft.rfft(comparison.reference_coherent_angle_rad())[band_bins]
        angle_power = coherent_angle_spectrum.real**2 + coherent_angle_spectrum.imag**2
        part_starts = np.arange(
            0, angle_power.size, max(angle_power.size // _EXCITED_BAND_COUNT, 1)
        )
        largest_power_nearby = np.repeat(
            np.maximum.reduceat(angle_power, part_starts),
            np.diff(part_starts, append=angle_power.size),
        )
        is_excited = angle_power > 1e-12 * angle_power.max()
        is_line = angle_power > _MIN_EXCITED_POWER_RATIO * largest_power_nearby
        if np.count_nonzero(is_line) < _MAX_LINE_FRACTION * is_line.size:
            is_excited &= is_line
        measured_response, response_weights = (
            torque_spectrum[is_excited] / angle_spectrum[is_excited],
            angle_power[is_excited],
        )
        selected_bins, self._weights = representative_points(
            measured_response, response_weights / response_weights.sum(), _COARSE_POINTS
        )
        self._measured = measured_response[selected_bins]
        self._frequency_hz = all_frequencies_hz[band_bins][is_excited][selected_bins]
        self._response = ResponseGrid(2j * np.pi * self._frequency_hz)
        self._responses: dict[Plant, NDArray[np.complex128]] = {}
        self._shifts: dict[Plant, float] = {}

    def with_noise_weights(
        self, noise: NoiseSpectrum, frequency_hz: NDArray[np.float64]
    ) -> CoarseResponse:
        """Return the measured response with the weights for another noise spectrum.

        `frequency_hz`, shape (K,), are the frequencies of the bins of the noise spectrum.
        """
        noise_weight = np.interp(self._frequency_hz, frequency_hz, noise.weight**2)
        whitened_response = copy(self)
        whitened_response._weights = self._weights * noise_weight / (self._weights @ noise_weight)
        whitened_response._shifts = {}
        return whitened_response

    def cost(self, plant: Plant) -> float:
        """Return the weighted mean square of predicted minus measured response, in (N·m/rad)²."""
        return self._mean_square(self._predicted_response(plant) - self._measured)

    def _predicted_response(self, plant: Plant) -> NDArray[np.complex128]:
        """Return the predicted response of a plant, from the cache if it has been computed."""
        if plant not in self._responses:
            self._responses[plant] = self._response.evaluate(plant)[0]
        return self._responses[plant]

    def best_ln_ratio_shift(self, plant: Plant) -> float:
        """Return the shift of ln(rho/EI), at constant losses, for which a plant fits best."""
        # Cached: structures that differ only in what is free begin at the same plant.
        if plant not in self._shifts:
            ratio, gamma = plant.beam.density_over_stiffness, plant.damping.gamma
            shifted_plants = (
                plant.with_parameters(
                    {"density_over_stiffness": factor * ratio, "gamma": factor * gamma}
                )
                for factor in np.exp(_LN_DENSITY_RATIO_SHIFTS).tolist()
            )
            shift_costs = [
                self._mean_square(self._response.evaluate(shifted)[0] - self._measured)
                for shifted in shifted_plants
            ]
            self._shifts[plant] = float(_LN_DENSITY_RATIO_SHIFTS[int(np.argmin(shift_costs))])
        return self._shifts[plant]

    def distance(self, first_plant: Plant, second_plant: Plant) -> float:
        """Return the weighted mean square of the difference between two plants' responses."""
        return self._mean_square(
            self._predicted_response(first_plant) - self._predicted_response(second_plant)
        )

    def are_plants_alike(self, first_plant: Plant, second_plant: Plant) -> bool:
        """Return whether two plants respond so similarly that they count as the same minimum."""
        return self.distance(first_plant, second_plant) <= _SAME_MINIMUM_DISTANCE * min(
            self.cost(first_plant), self.cost(second_plant)
        )

    def normal_equations(
        self, unknowns: Unknowns, vector_of_unknowns: NDArray[np.float64]
    ) -> NormalEquations:
        """Return the cost, with its gradient and Gauss-Newton matrix by the unknowns."""
        plant, unknown_slopes = unknowns.plant_and_gradient(vector_of_unknowns)
        response_and_gradient = self._response.evaluate(plant, unknowns.gradient_names)
        response_deviation = response_and_gradient[0] - self._measured
        jacobian = unknown_slopes.T @ response_and_gradient[1:]
        weighted_jacobian = jacobian.conj() * self._weights
        return NormalEquations(
            cost=self._mean_square(response_deviation),
            gradient=(weighted_jacobian @ response_deviation).real,
            hessian=(weighted_jacobian @ jacobian.T).real,
        )

    def _mean_square(self, response_deviation: NDArray[np.complex128]) -> float:
        """Return the weighted mean square of a deviation of the response, in (N·m/rad)²."""
        return float(self._weights @ (response_deviation.real**2 + response_deviation.imag**2))


def start_vectors_for_search(
    coarse_response: CoarseResponse, unknowns: Unknowns
) -> list[NDArray[np.float64]]:
    """Return start vectors from which descents reach all relevant minima, each of shape (k,).

    The first is the best fit with all orders 1, which is close to most materials and to air. The
    others have the same losses with different orders.
    """
    aligning_shift = unknowns_shift_to_resonances(coarse_response, unknowns)
    start_values_by_parameter = [
        _LN_START_COEFFICIENTS.get(parameter_name, (1.0,))
        for parameter_name in unknowns.structure.free
    ]
    shifted_starts = [
        unknowns.start(np.array(start_vector)) + aligning_shift
        for start_vector in itertools.product(*start_values_by_parameter)
    ]
    best_start = min(shifted_starts, key=lambda x: coarse_response.cost(unknowns.plant(x)))
    start_vectors = [best_start]
    order_indices = [
        i
        for i, parameter_name in enumerate(unknowns.names)
        if parameter_name in ("alpha", "lambda")
    ]
    for order_values in (
        itertools.product(_START_ORDERS, repeat=len(order_indices)) if order_indices else ()
    ):
        start_vector = best_start.copy()
        start_vector[order_indices] = order_values
        start_vectors.append(start_vector)
    return start_vectors


def coarse_minima(
    coarse_response: CoarseResponse,
    unknowns: Unknowns,
    start_vectors: Iterable[NDArray[np.float64]],
) -> list[Minimum]:
    """Return the distinct minima of the coarse cost from some start vectors, the lowest first."""
    step_rule = StepRule.for_unknowns(unknowns)
    minima = [
        descend(
            lambda x: coarse_response.normal_equations(unknowns, x),
            start_vector,
            step_rule,
            relative_tolerance=_COARSE_COST_TOLERANCE,
            max_evaluations=_MAX_COARSE_EVALUATIONS,
        )
        for start_vector in start_vectors
    ]
    distinct_minima: list[Minimum] = []
    for minimum in sorted(minima, key=lambda m: m.cost):
        plant = unknowns.plant(minimum.x)
        if not any(
            coarse_response.are_plants_alike(plant, unknowns.plant(known_minimum.x))
            for known_minimum in distinct_minima
        ):
            distinct_minima.append(minimum)
    return distinct_minima


# Descents on the whole record

_RIVAL_COST_TOLERANCE: Final = 1e-2
"""Relative tolerance of the descents that decide which of several minima is lower."""

_MAX_RIVAL_DESCENTS: Final = 2
"""Largest number of coarse minima from which the whole record is fitted."""

_MAX_RIVAL_COST_RATIO: Final = 1.5
"""Cost of a coarse minimum, relative to the lowest one, from which it is ignored."""

_MAX_BETTER_COST_RATIO: Final = 0.9
"""Cost of another coarse minimum, relative to that at the end of a descent, below which it is
refined."""

_MAX_STORED_MINIMA: Final = 4
"""Largest number of stored minima that are compared again under another noise spectrum."""

MAX_ANGLE_REESTIMATES: Final = 4
"""Largest number of re-estimates of the angle that follows the reference."""

_MAX_HUM_SEARCHES: Final = 3
"""Largest number of searches for hum. More than one is needed, since the first fit attributed part
of the hum to the beam."""


@dataclass(frozen=True, slots=True)
class Descent:
    """Current point of a least-squares fit of one structure: objective and vector of unknowns.

    `noise_and_cost` is the cost at the end of a descent, with the noise spectrum under which it was
    computed.
    """

    objective: Objective
    x: NDArray[np.float64]
    noise_and_cost: tuple[NoiseSpectrum, float] | None = None

    @property
    def plant(self) -> Plant:
        """Return rig and beam at the current point of the descent."""
        return self.objective.unknowns.plant(self.x)

    def descend_to_minimum(
        self,
        noise: NoiseSpectrum,
        cost_tolerance: float,
        give_up_condition: tuple[int, float] | None = None,
    ) -> Descent:
        """Descend to the local minimum under a noise spectrum.

        `cost_tolerance` is relative to the sum of squares. `give_up_condition` is the number of
        evaluations and the cost above which `descend` gives up.
        """
        step_rule = StepRule.for_unknowns(self.objective.unknowns)
        objective, minimum = self.objective.find_minimum(
            self.x,
            noise.weight,
            step_rule,
            relative_tolerance=cost_tolerance,
            give_up_condition=give_up_condition,
        )
        return Descent(objective, minimum.x, (noise, minimum.cost))

    def cost(self, noise: NoiseSpectrum) -> float:
        """Return the sum of squares at the current point under a noise spectrum."""
        if self.noise_and_cost is not None and self.noise_and_cost[0] is noise:
            return self.noise_and_cost[1]
        return self.objective.normal_equations(self.x, noise.weight).cost

    def with_reestimated_angle(self, noise: NoiseSpectrum, cost_tolerance: float) -> Descent:
        """Re-estimate the part of the angle that follows the reference, and descend; repeat both.

        Return `self` if this part of the angle has converged already.
        """
        descent = self
        for _ in range(MAX_ANGLE_REESTIMATES):
            comparison = descent.objective.comparison.with_reestimated_angle(descent.plant, noise)
            if comparison is descent.objective.comparison:
                break
            descent = Descent(Objective(comparison, descent.objective.unknowns), descent.x)
            noise = descent.noise()
            descent = descent.descend_to_minimum(noise, cost_tolerance)
        return descent

    def hum(self) -> tuple[Hum, ...]:
        """Return the hum (narrow-band disturbance) that is found near modes of the current beam."""
        comparison = self.objective.comparison
        linearisation, noise = self.objective.linearise(self.x), self.noise()
        torque_amplitudes = self.objective.project(linearisation, noise.weight).amplitudes
        decay_count = count_decay_spectra(linearisation.poles) * (
            1 + len(comparison.later_decay_spectra)
        )
        decay_spectra = self.objective.unknown_torque_spectra(linearisation)[:decay_count]
        free_decay_nm = comparison.to_time_series(torque_amplitudes[:decay_count] @ decay_spectra)
        return find_hum_near_modes(
            comparison, self.plant, linearisation.poles, noise, free_decay_nm
        )

    def remove_hum(self, cost_tolerance: float) -> Descent:
        """Remove the hum near modes from the data, and fit again; return `self` if none exists."""
        descent = self
        for _ in range(_MAX_HUM_SEARCHES):
            hum = descent.hum()
            if not hum:
                return self
            hum_free_objective = Objective(
                descent.objective.comparison.remove_hum(hum), descent.objective.unknowns
            )
            descent = Descent(hum_free_objective, descent.x)
            descent = descent.descend_to_minimum(descent.noise(), cost_tolerance)
        return descent

    def noise(self, *, with_lines: bool = False) -> NoiseSpectrum:
        """Return the noise spectrum of the current residual, without the free decay."""
        objective, comparison = self.objective, self.objective.comparison
        linearisation = objective.linearise(self.x)
        is_near_mode = driven_spectra = None
        if with_lines:
            frequency_hz = comparison.frequency_hz
            angle, measured_torque = (
                comparison.spectrum(channel[comparison.retained_samples])
                for channel in (comparison.angle_rad, comparison.torque_nm)
            )
            driven_spectra = angle, linearisation.residual + measured_torque
            is_near_mode = np.zeros(frequency_hz.size, dtype=bool)
            for mode_pole in linearisation.poles:
                mode_width_hz = resonance_half_width_hz(
                    mode_pole, float(frequency_hz[1] - frequency_hz[0])
                )
                is_near_mode |= (
                    np.abs(frequency_hz - abs(mode_pole.at_rad_s.imag) / (2 * np.pi))
                    < mode_width_hz
                )
        noise = estimate_noise(
            objective.project(linearisation, 1.0).residual,
            comparison.frequency_hz,
            comparison.sample_count,
            comparison.measurement.known_torque_fraction,
            is_near_mode,
            driven_spectra,
        )
        return replace(noise, power=noise.power + comparison.encoder_noise_power(self.plant))


@dataclass(frozen=True, slots=True)
class StructureSearch:
    """Search for the best fits of one structure to one record: minima of the sum of squares.

    Attributes
    ----------
    objective : Objective
        Sum of squares of the whole record.
    coarse_response : CoarseResponse
        Some points of the frequency response of the record.
    order_one_start : ndarray, shape (k,)
        Unknowns of the best start with all orders 1.
    minima : list of Minimum
        Minima of the coarse response under white noise, the lowest first.
    """

    objective: Objective
    coarse_response: CoarseResponse
    order_one_start: NDArray[np.float64]
    minima: list[Minimum]

    @classmethod
    def from_objective(
        cls, objective: Objective, coarse_response: CoarseResponse
    ) -> StructureSearch:
        """Search the whole range of the unknowns for minima of the coarse response."""
        start_vectors = start_vectors_for_search(coarse_response, objective.unknowns)
        return cls(
            objective,
            coarse_response,
            start_vectors[0],
            coarse_minima(coarse_response, objective.unknowns, start_vectors),
        )

    @property
    def unknowns(self) -> Unknowns:
        """Return the unknowns of the structure."""
        return self.objective.unknowns

    def with_comparison(self, comparison: Comparison) -> StructureSearch:
        """Return the search with the same starts and minima for other data of the same record."""
        return replace(self, objective=Objective(comparison, self.unknowns))

    def lowest_coarse_minimum(self) -> Descent:
        """Return a descent that starts at the lowest minimum of the coarse response."""
        return Descent(self.objective, self.minima[0].x)

    def descend_to_lowest(
        self, noise: NoiseSpectrum, known_descent: Descent | None = None
    ) -> Descent:
        """Descend to the lowest minimum of the whole record under a noise spectrum.

        Under another noise spectrum another minimum may be the lowest. So all minima are compared
        again on the coarse response, which is cheap, and the best few are refined on the whole
        record.
        """
        whitened_response = self.coarse_response.with_noise_weights(
            noise, self.objective.comparison.frequency_hz
        )
        start_vectors = [minimum.x for minimum in self.minima[:_MAX_STORED_MINIMA]]
        whitened_minima = coarse_minima(
            whitened_response, self.unknowns, [*start_vectors, self.order_one_start]
        )
        rival_descents = [
            Descent(self.objective, minimum.x)
            for minimum in whitened_minima[:_MAX_RIVAL_DESCENTS]
            if minimum.cost < _MAX_RIVAL_COST_RATIO * whitened_minima[0].cost
        ]
        if known_descent is not None:
            known_plant = self.unknowns.plant(known_descent.x)
            rival_descents = [known_descent] + [
                rival_descent
                for rival_descent in rival_descents
                if not whitened_response.are_plants_alike(
                    known_plant, self.unknowns.plant(rival_descent.x)
                )
                and whitened_response.cost(self.unknowns.plant(rival_descent.x))
                < _MAX_BETTER_COST_RATIO * whitened_response.cost(known_plant)
            ]
        if len(rival_descents) == 1:
            return rival_descents[0]
        final_descents = [
            rival_descent.descend_to_minimum(noise, _RIVAL_COST_TOLERANCE)
            for rival_descent in rival_descents
        ]
        return min(final_descents, key=lambda final_descent: final_descent.cost(noise))
