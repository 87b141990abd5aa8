"""Parameters of a nearly uniform beam from the modal constants of a record.

No real antenna is as uniform as the frequencies are precise. So the parameters are estimated with a
stated tolerance: in addition to the measurement noise, each ln frequency has that standard
deviation, and each ln residue three times as much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from analysis.identify.beam_uniformity import MIN_P_VALUE_OF_UNIFORM_BEAM
from analysis.identify.uniform_beam import (
    INTEGRAL_TOLERANCE_RATIO,
    ORDER_RANGE,
    PARAMETERS,
    UniformBeamProblem,
)
from analysis.statistics import NORMAL_95, chi_square_p_value
from rigd.beam import DAMPING_PARAMETERS, LOGARITHMIC_PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify._modal_model import ModalEstimate
    from analysis.optimizer import Minimum
    from rigd.beam import Plant

EstimateBasis = Literal["geometry", "losses", "none"]
"""Data that an estimate with tolerance uses."""

_PLAUSIBLE_P_VALUE: Final = 0.3
"""p-value from which the stated tolerance suffices. The limit is high, since the damping orders of
the fit compensate a part of the deviations of a beam that exceeds the tolerance."""

_PLAUSIBLE_P_VALUE_WITH_WIDER_TOLERANCE: Final = 0.1
"""p-value from which the wider tolerance suffices."""

_WIDER_FREQUENCY_TOLERANCE: Final = 3e-3
"""Relative frequency tolerance that is tried if the stated one does not suffice."""

_LOOSE_FREQUENCY_TOLERANCE: Final = 0.05
"""Relative frequency tolerance at which frequencies and residues have almost no weight."""

_LOSS_TOLERANCE: Final = 0.01
"""Relative tolerance of the damping ratios of a beam so uneven that only its losses are fitted."""

_MIN_VISIBLE_MODES: Final = 2
"""Smallest number of visible modes for an estimate with tolerance."""

_MAX_AGREEING_DEVIANCE: Final = 1.0
"""Increase of chi-square up to which the losses agree with an order of 1, for frequencies within
the stated tolerance: one standard deviation."""

_DAMPING_COEFFICIENTS: Final = ("zeta", "gamma")
"""Damping coefficients that are tested for their absence."""

_MAX_PROFILE_STEPS: Final = 8
"""Largest number of values at which the profile is computed towards one end of an interval."""

_INTERVAL_END_TOLERANCE: Final = 0.05
"""Distance of the root of the chi-square rise from 1.96 at which an interval end is accepted."""

_MAX_DISTANCE_GROWTH: Final = 3.0
"""Largest factor by which one profile step increases the distance from the estimate."""

_MAX_INTERVAL_EXPONENT: Final = 300.0
"""Largest exponent of an interval end, which keeps `exp` finite."""


@dataclass(frozen=True, slots=True)
class TolerantEstimate:
    """Beam parameters from the modal constants, with a tolerance for a nearly uniform beam.

    Attributes
    ----------
    basis : str
        "geometry": all modal constants, with frequencies and residues within the tolerance.
        "losses": damping ratios and residue phases alone. "none": no beam with two dampings of one
        order each explains the losses.
    uniformity, stated_uniformity : float
        Assumed relative standard deviation of each frequency, and the one that was stated.
    p_value : float or None
        Probability of at least the remaining chi-square by chance. None without degrees of
        freedom.
    plant : Plant
        Rig and beam with the estimated parameters.
    values, std : mapping of str to float
        Estimates and standard deviations, by the names of `PARAMETERS`.
    interval : mapping of str to (float, float)
        95 % intervals by the profile of chi-square. An end that the modes do not bound is infinite
        or the edge of the range.
    covariance : ndarray, shape (7, 7)
        Covariance of `PARAMETERS`, with those in `LOGARITHMIC_PARAMETERS` as logarithms.
    first_rad_s : float
        Frequency of the first visible mode, in rad/s.
    deviance_of_order_one : mapping of str to float
        Increase of chi-square if "alpha" or "lambda" is fixed at 1, with damping ratios and residue
        phases alone. 0 if the interval contains 1.
    deviance_without_damping : mapping of str to float
        Increase of chi-square if the damping with coefficient "zeta" or "gamma" is left out.
    """

    basis: EstimateBasis
    uniformity: float
    stated_uniformity: float
    p_value: float | None
    plant: Plant
    values: Mapping[str, float]
    std: Mapping[str, float]
    interval: Mapping[str, tuple[float, float]]
    covariance: NDArray[np.float64]
    first_rad_s: float
    deviance_of_order_one: dict[str, float]
    deviance_without_damping: dict[str, float]

    @property
    def rests_on_frequencies(self) -> bool:
        """Return whether an order differs from 1 although the losses alone agree with 1.

        Then the order was chosen for its elastic part, which shifts the frequencies. If these
        deviate by more than the stated tolerance, the losses alone must exclude 1.
        """
        has_stated_tolerance = self.uniformity <= self.stated_uniformity
        agreeing_deviance = _MAX_AGREEING_DEVIANCE if has_stated_tolerance else NORMAL_95**2
        return any(
            not self.interval[order_name][0] <= 1 <= self.interval[order_name][1]
            and deviance < agreeing_deviance
            for order_name, deviance in self.deviance_of_order_one.items()
        )

    def covariance_json(self) -> dict[str, Any]:
        """Return names and covariance matrix of the beam parameters as a dict for JSON.

        A name with the prefix ``ln_`` means the logarithm of the parameter.
        """
        parameter_names = [
            f"ln_{parameter_name}" if parameter_name in LOGARITHMIC_PARAMETERS else parameter_name
            for parameter_name in PARAMETERS
        ]
        return {"names": parameter_names, "matrix": self.covariance.tolist()}


def tolerant_estimate(
    modal_estimate: ModalEstimate,
    nominal_plant: Plant,
    uniformity: float,
    tilt_deg: float | None = None,
    *,
    is_uniform: bool,
) -> TolerantEstimate | None:
    """Estimate damping and beam parameters from the modal constants, with a tolerance.

    If a uniform beam with the stated tolerance does not predict the constants, a wider tolerance is
    used. If that fails, too, only damping ratios and residue phases are used. What makes a beam
    uneven changes its losses as well: if it is not uniform, damping ratios have a tolerance, too.

    Parameters
    ----------
    modal_estimate : ModalEstimate
        Fitted modal model with the covariance of its constants.
    nominal_plant : Plant
        Rig and specimen as the file states them.
    uniformity : float
        Stated relative standard deviation of each frequency.
    tilt_deg : float, optional
        Angle in degrees between the beam at rest and the horizontal, as the file states it;
        positive if the tip is lower than the root.
    is_uniform : bool
        Whether a uniform beam predicts the modes (`uniform_beam_test`).

    Returns
    -------
    TolerantEstimate or None
        None if fewer than two modes are visible.
    """
    mode_numbers = modal_estimate.visible_mode_numbers
    if len(mode_numbers) < _MIN_VISIBLE_MODES:
        return None
    wider_frequency_tolerance = max(_WIDER_FREQUENCY_TOLERANCE, uniformity)
    tolerance_attempts: tuple[tuple[EstimateBasis, float, float], ...] = (
        ("geometry", uniformity, _PLAUSIBLE_P_VALUE),
        ("geometry", wider_frequency_tolerance, _PLAUSIBLE_P_VALUE_WITH_WIDER_TOLERANCE),
        ("losses", _LOOSE_FREQUENCY_TOLERANCE, MIN_P_VALUE_OF_UNIFORM_BEAM),
    )
    for estimate_basis, frequency_tolerance, min_p_value in tolerance_attempts:
        loss_tolerance = (
            0.0
            if is_uniform
            else _LOSS_TOLERANCE
            if estimate_basis == "losses"
            else INTEGRAL_TOLERANCE_RATIO * frequency_tolerance
        )
        problem = UniformBeamProblem(
            modal_estimate,
            mode_numbers,
            nominal_plant,
            frequency_tolerance,
            tilt_deg,
            loss_tolerance,
        )
        minima = problem.minima()
        # With the loose tolerance frequencies and residues do not count as data.
        constant_count = problem.constant_count // (2 if estimate_basis == "losses" else 1)
        degrees_of_freedom = constant_count - (
            len(PARAMETERS) if estimate_basis == "geometry" else len(PARAMETERS) - 2
        )
        degrees_of_freedom += problem.count_idle_unknowns(minima[0])
        p_value = (
            float(chi_square_p_value(minima[0].cost, degrees_of_freedom))
            if degrees_of_freedom > 0
            else None
        )
        if p_value is None or p_value >= min_p_value:
            break
    else:
        estimate_basis = "none"
    beam_estimate = _estimate_at_minimum(problem, minima, estimate_basis, p_value, uniformity)
    orders_excluding_one = [
        order_name for order_name in ("alpha", "lambda")
        if not beam_estimate.interval[order_name][0] <= 1 <= beam_estimate.interval[order_name][1]
    ]  # fmt: skip
    if not orders_excluding_one:
        return beam_estimate
    if estimate_basis == "geometry":
        problem = UniformBeamProblem(
            modal_estimate,
            mode_numbers,
            nominal_plant,
            _LOOSE_FREQUENCY_TOLERANCE,
            tilt_deg,
            loss_tolerance,
        )
        minima = problem.minima()
    best_minimum = minima[0]
    order_one_deviances = {
        order_name: problem.minimize_with_fixed(
            PARAMETERS.index(order_name), 1.0, best_minimum.x
        ).cost
        - best_minimum.cost
        for order_name in orders_excluding_one
    }
    return replace(
        beam_estimate,
        deviance_of_order_one=beam_estimate.deviance_of_order_one | order_one_deviances,
    )


def _estimate_at_minimum(
    problem: UniformBeamProblem,
    minima: Sequence[Minimum],
    estimate_basis: EstimateBasis,
    p_value: float | None,
    stated_uniformity: float,
) -> TolerantEstimate:
    """Return the beam parameters at the lowest minimum, with their uncertainties.

    The minima are sorted by chi-square, the lowest first.
    """
    best_minimum = minima[0]
    plant = problem.plant(best_minimum.x)
    bounded_hessian = best_minimum.equations.hessian + np.diag(
        1 / (problem.upper - problem.lower) ** 2
    )
    covariance = problem.transform @ np.linalg.inv(bounded_hessian) @ problem.transform.T
    parameter_values = problem.parameters(best_minimum.x)
    parameter_stds = np.sqrt(np.diag(covariance))
    deviance_without_damping = {
        parameter_name: problem.minimize_without_damping(
            PARAMETERS.index(parameter_name), best_minimum.x
        ).cost
        - best_minimum.cost
        for parameter_name in _DAMPING_COEFFICIENTS
    }
    near_minima = [minimum for minimum in minima if minimum.cost - best_minimum.cost < NORMAL_95**2]
    intervals: dict[str, tuple[float, float]] = {}
    std: dict[str, float] = {}
    for parameter_index, parameter_name in enumerate(PARAMETERS):
        parameter_value, parameter_std = (
            float(parameter_values[parameter_index]),
            float(parameter_stds[parameter_index]),
        )
        if parameter_name in DAMPING_PARAMETERS:
            lower_end, upper_end = (
                _interval_end(problem, parameter_index, best_minimum, interval_side * parameter_std)
                for interval_side in (-1.0, 1.0)
            )
            near_minimum_values = [
                float(problem.parameters(minimum.x)[parameter_index]) for minimum in near_minima
            ]
            lower_end, upper_end = (
                min(lower_end, *near_minimum_values),
                max(upper_end, *near_minimum_values),
            )
        else:
            lower_end, upper_end = (
                parameter_value - NORMAL_95 * parameter_std,
                parameter_value + NORMAL_95 * parameter_std,
            )
        if parameter_name in LOGARITHMIC_PARAMETERS:
            parameter_value, parameter_std = (
                math.exp(parameter_value),
                math.exp(parameter_value) * parameter_std,
            )
            lower_end, upper_end = (
                math.exp(lower_end),
                math.exp(min(upper_end, _MAX_INTERVAL_EXPONENT)),
            )
        intervals[parameter_name], std[parameter_name] = (lower_end, upper_end), parameter_std
    return TolerantEstimate(
        basis=estimate_basis,
        uniformity=problem.uniformity,
        stated_uniformity=stated_uniformity,
        p_value=p_value,
        plant=plant,
        values=plant.parameters,
        std=std,
        interval=intervals,
        covariance=covariance,
        first_rad_s=float(2 * np.pi * np.exp(problem.measured[0])),
        deviance_of_order_one={"alpha": 0.0, "lambda": 0.0},
        deviance_without_damping=deviance_without_damping,
    )


def _interval_end(
    problem: UniformBeamProblem, parameter_index: int, best_minimum: Minimum, signed_std: float
) -> float:
    """Return one end of the 95 % interval of a parameter, where chi-square has risen by 3.84.

    Return the edge of the range if chi-square does not rise so far. `parameter_index` is the index
    of the parameter in `PARAMETERS`. `signed_std` is its standard deviation, negative for the lower
    end.
    """
    estimated_value = float(problem.parameters(best_minimum.x)[parameter_index])
    range_edge = math.copysign(math.inf, signed_std)
    if PARAMETERS[parameter_index] in ("alpha", "lambda"):
        range_edge = ORDER_RANGE[0 if signed_std < 0 else 1]
    inside_value, inside_root, x = estimated_value, 0.0, best_minimum.x
    trial_value = estimated_value + NORMAL_95 * signed_std
    outside_value: float | None = None
    for _ in range(_MAX_PROFILE_STEPS):
        trial_value = (
            max(trial_value, range_edge) if signed_std < 0 else min(trial_value, range_edge)
        )
        trial_minimum = problem.minimize_with_fixed(parameter_index, trial_value, x)
        deviance_root = math.sqrt(max(trial_minimum.cost - best_minimum.cost, 0.0))
        if abs(deviance_root - NORMAL_95) < _INTERVAL_END_TOLERANCE:
            return trial_value
        if deviance_root < NORMAL_95:
            inside_value, inside_root, x = trial_value, deviance_root, trial_minimum.x
            if trial_value == range_edge:
                return range_edge
        else:
            outside_value, outside_root = trial_value, deviance_root
        if outside_value is None:
            value_distance = (inside_value - estimated_value) * min(
                NORMAL_95 / max(inside_root, 0.2), _MAX_DISTANCE_GROWTH
            )
            trial_value = estimated_value + value_distance
        else:
            trial_value = inside_value + (outside_value - inside_value) * (
                NORMAL_95 - inside_root
            ) / (outside_root - inside_root)
    return trial_value if outside_value is not None else range_edge
