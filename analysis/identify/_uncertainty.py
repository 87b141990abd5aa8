"""Uncertainty of the estimates and of quantities derived from them (delta method).

The covariance of the unknowns is that of a weighted least-squares estimate under the estimated
noise spectrum, from the curvature of the sum of squares. The uncertainties of parameters, modes,
loss factors and the free decay follow from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._estimates import ModeEstimate, PivotLossFactor, Ringing
from analysis.identify.free_decay import count_decay_spectra
from analysis.statistics import NORMAL_95
from rigd.beam import LOGARITHMIC_PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._problem import ProjectedResidual
    from analysis.identify.parametrization import Unknowns
    from rigd.beam import Pole

_MAX_CONDITION_NUMBER: Final = 1e13
"""Condition number of the scaled curvature from which the unknowns count as not determined."""

_UNDETERMINED_LN_STD: Final = 20.0
"""Standard deviation from which a logarithm counts as not determined: a factor of 1e9 either
way."""

_MAX_LN_PIVOT_FREQUENCY: Final = 50.0
"""Largest magnitude of ln(pivot frequency) at which a loss factor is reported."""


# Unknowns and parameters


def covariance_of_unknowns(
    jacobian: NDArray[np.complex128], residual_variance: float, is_at_bound: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the covariance of those unknowns that the data determine.

    The covariance, shape (k, k), is 0 in rows and columns of the other unknowns. Return also a mask
    of the determined unknowns, shape (k,). `jacobian`, shape (k, K), are the derivatives of the
    whitened residual by the unknowns, and `residual_variance` is the variance of real and imaginary
    parts of that residual.
    """
    hessian_matrix = (jacobian.conj() @ jacobian.T).real
    hessian_scale = np.sqrt(np.diag(hessian_matrix))
    is_determined = ~is_at_bound & (hessian_scale > 0) & np.isfinite(hessian_scale)
    covariance = np.zeros_like(hessian_matrix)
    if not is_determined.any():
        return covariance, is_determined
    determined_block = np.ix_(is_determined, is_determined)
    scale_products = np.outer(hessian_scale[is_determined], hessian_scale[is_determined])
    scaled_hessian = hessian_matrix[determined_block] / scale_products
    if np.linalg.cond(scaled_hessian) > _MAX_CONDITION_NUMBER:
        return covariance, np.zeros_like(is_determined)
    covariance[determined_block] = (
        residual_variance * np.linalg.inv(scaled_hessian) / scale_products
    )
    return covariance, is_determined


@dataclass(frozen=True, slots=True)
class ParameterUncertainty:
    """Uncertainty of the fitted plant parameters, with attributes as in `RecordFit`."""

    std: dict[str, float | None]
    interval: dict[str, tuple[float, float] | None]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]
    at_bounds: tuple[str, ...]
    internal: PivotLossFactor | None
    external: PivotLossFactor | None


def parameter_uncertainty(
    unknowns: Unknowns,
    vector_of_unknowns: NDArray[np.float64],
    is_at_bound: NDArray[np.bool_],
    unknown_covariance: NDArray[np.float64],
    is_determined: NDArray[np.bool_],
) -> ParameterUncertainty:
    """Return standard deviations and intervals of the plant parameters at a minimum.

    They follow from the covariance of the unknowns, shape (k, k), which is 0 in rows and columns of
    unknowns that are not determined. `vector_of_unknowns`, `is_at_bound` and `is_determined` have
    the shape (k,).
    """
    parameter_slopes = unknowns.estimates_by_unknowns(vector_of_unknowns)
    parameter_covariance = parameter_slopes @ unknown_covariance @ parameter_slopes.T
    parameter_names, parameter_values = unknowns.names, unknowns.parameters(vector_of_unknowns)
    is_logarithmic = np.array(
        [parameter_name in LOGARITHMIC_PARAMETERS for parameter_name in parameter_names]
    )
    is_determined = is_determined & ~(
        is_logarithmic & (np.diag(parameter_covariance) > _UNDETERMINED_LN_STD**2)
    )
    determined_covariance = parameter_covariance[np.ix_(is_determined, is_determined)]
    determined_names = tuple(
        parameter_name
        for parameter_name, is_known in zip(parameter_names, is_determined, strict=True)
        if is_known
    )
    stds_by_parameter: dict[str, float | None] = dict.fromkeys(
        parameter_values, 0.0
    ) | dict.fromkeys(parameter_names, None)
    intervals_by_parameter: dict[str, tuple[float, float] | None] = dict.fromkeys(
        parameter_names, None
    )
    for parameter_name, natural_std in zip(
        determined_names, np.sqrt(np.diag(determined_covariance)).tolist(), strict=True
    ):
        stds_by_parameter[parameter_name] = (
            parameter_values[parameter_name] * natural_std
            if parameter_name in LOGARITHMIC_PARAMETERS
            else natural_std
        )
        intervals_by_parameter[parameter_name] = interval(
            parameter_name, parameter_values[parameter_name], natural_std
        )
    first_omega_rad_s, _second_omega_rad_s = unknowns.omega_rad_s
    return ParameterUncertainty(
        std=stds_by_parameter,
        interval=intervals_by_parameter,
        determined=determined_names,
        covariance=determined_covariance,
        at_bounds=tuple(
            parameter_name
            for parameter_name, is_held in zip(parameter_names, is_at_bound, strict=True)
            if is_held
        ),
        internal=pivot_loss_factor(
            "zeta",
            "alpha",
            parameter_values,
            determined_names,
            determined_covariance,
            first_omega_rad_s,
        ),
        external=pivot_loss_factor(
            "gamma",
            "lambda",
            parameter_values,
            determined_names,
            determined_covariance,
            first_omega_rad_s,
        ),
    )


# Intervals


def interval(parameter_name: str, parameter_value: float, std: float) -> tuple[float, float]:
    """Return the 95 % interval of a parameter.

    `std` is the standard deviation of the logarithm for parameters in `LOGARITHMIC_PARAMETERS`.
    """
    half_width = NORMAL_95 * std
    if parameter_name in LOGARITHMIC_PARAMETERS:
        return parameter_value * math.exp(-half_width), parameter_value * math.exp(half_width)
    return parameter_value - half_width, parameter_value + half_width


def interval_from_zero(
    estimated_value: float, std: float, half_width: float = NORMAL_95
) -> tuple[float, float]:
    """Return the 95 % interval of a quantity that cannot be negative.

    It is the non-negative part of the symmetric interval. So it begins at 0 if the estimate is
    within 1.96 standard deviations of 0. It covers a true value of 0 in 97.5 % of all records,
    other true values in 95 to 97.5 %. `std` is the standard deviation without the bound at 0, and
    `half_width` the half width of the symmetric interval in standard deviations.
    """
    return max(estimated_value - half_width * std, 0.0), estimated_value + half_width * std


# Loss factor at its pivot frequency


def pivot_loss_factor(
    coefficient_name: str,
    order_name: str,
    parameter_values: dict[str, float],
    determined_names: Sequence[str],
    covariance: NDArray[np.float64],
    min_omega_rad_s: float,
) -> PivotLossFactor | None:
    """Return the loss factor of a damping at its pivot frequency, or None if undetermined.

    At the pivot frequency the loss factor depends least on the order. A record determines the loss
    factor. ``zeta omega^alpha`` equals it only to first order: if the order is uncertain by 0.15,
    ``zeta omega^alpha`` is uncertain by 4 % more than the loss factor.

    Parameters
    ----------
    coefficient_name, order_name : str
        "zeta" and "alpha", or "gamma" and "lambda".
    parameter_values : dict
        Values of all parameters, by name.
    determined_names : sequence of str
        Names of the determined parameters.
    covariance : ndarray, shape (k, k)
        Covariance of the determined parameters, with coefficients as logarithms.
    min_omega_rad_s : float
        Smallest pivot frequency: that of the first mode, below which no mode vibrates.
    """
    if coefficient_name not in determined_names:
        return None
    coefficient_index = list(determined_names).index(coefficient_name)
    if order_name not in determined_names:
        return PivotLossFactor(
            None,
            parameter_values[coefficient_name],
            parameter_values[coefficient_name]
            * covariance[coefficient_index, coefficient_index] ** 0.5,
        )
    order_index = list(determined_names).index(order_name)
    order_phase_rad = math.pi / 2 * parameter_values[order_name]
    ln_loss_gradient = np.zeros(len(determined_names))
    ln_loss_gradient[coefficient_index] = 1.0
    # The loss of external damping is relative to the inertia rho/EI omega².
    ratio_name, inertia_power = "density_over_stiffness", 2 if coefficient_name == "gamma" else 0
    if inertia_power and ratio_name in determined_names:
        ln_loss_gradient[list(determined_names).index(ratio_name)] = -1.0
    # At this derivative of ln loss by the order, ln loss and order are uncorrelated:
    pivot_slope = (
        -float(ln_loss_gradient @ covariance[:, order_index]) / covariance[order_index, order_index]
    )
    phase_term = math.pi / 2 / math.tan(order_phase_rad)
    ln_omega = max(pivot_slope - phase_term, math.log(min_omega_rad_s))
    if abs(ln_omega) > _MAX_LN_PIVOT_FREQUENCY:
        return None  # an almost undetermined order has no pivot frequency
    ln_loss_gradient[order_index] = ln_omega + phase_term
    inertia_scale = parameter_values[ratio_name] if inertia_power else 1.0
    loss_factor = parameter_values[coefficient_name] / inertia_scale * math.sin(order_phase_rad)
    loss_factor *= math.exp((parameter_values[order_name] - inertia_power) * ln_omega)
    relative_variance = max(float(ln_loss_gradient @ covariance @ ln_loss_gradient), 0.0)
    return PivotLossFactor(
        math.exp(ln_omega), loss_factor, loss_factor * math.sqrt(relative_variance)
    )


# Modes


def mode_table(poles: Sequence[Pole], covariance: NDArray[np.float64]) -> tuple[ModeEstimate, ...]:
    """Return frequencies and damping ratios of the modes, with standard deviations (delta method).

    The covariance, shape (k, k), is that of the unknowns by which the poles are differentiated. An
    over-damped mode has both of its poles.
    """
    mode_estimates = []
    for mode_number in dict.fromkeys(pole.mode for pole in poles):
        first_pole, *other_poles = (pole for pole in poles if pole.mode == mode_number)
        p, dp = first_pole.at_rad_s, first_pole.derivative
        q, dq = (
            (other_poles[0].at_rad_s, other_poles[0].derivative)
            if other_poles
            else (p.conjugate(), dp.conj())
        )
        natural_rad_s = math.sqrt((p * q).real)
        damping_ratio = -(p + q).real / (2 * natural_rad_s)
        frequency_rad_s_slope = (q * dp + p * dq).real / (2 * natural_rad_s)
        damping_ratio_slope = (
            -(dp + dq).real / (2 * natural_rad_s)
            - damping_ratio * frequency_rad_s_slope / natural_rad_s
        )
        frequency_hz_slope = np.zeros(dp.size) if other_poles else dp.imag / (2 * np.pi)
        mode_estimates.append(
            ModeEstimate(
                number=mode_number,
                frequency_hz=abs(p.imag) / (2 * np.pi),
                frequency_std_hz=_propagated_std(frequency_hz_slope, covariance),
                damping_ratio=damping_ratio,
                damping_ratio_std=_propagated_std(damping_ratio_slope, covariance),
            )
        )
    return tuple(mode_estimates)


def _propagated_std(derivatives: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Return the standard deviation of a quantity from its derivatives by the unknowns.

    `derivatives` have the shape (k,), and `covariance`, that of the unknowns, has (k, k).
    """
    return math.sqrt(max(float(derivatives @ covariance @ derivatives), 0.0))


# Free decay at the start


def ringing(
    poles: Sequence[Pole],
    projected_residual: ProjectedResidual,
    residual_variance: float,
    nuisance_spectra: NDArray[np.complex128],
    hum_spectra: NDArray[np.complex128],
) -> Ringing:
    """Return the amplitude of the free decay in each mode, with its chi-square.

    The bins of a hum are excluded. But a hum starts and ends with the record and so leaks into all
    other bins, where free decays would explain a part of it. So chi-square is the reduction of the
    sum of squares by free decays and hum together, minus that by the hum alone.
    `nuisance_spectra`, shape (m, K), are the whitened spectra of the free decays and of the other
    terms that are projected out. `hum_spectra`, shape (h, K), are those of the hum.
    `residual_variance` is the variance of real and imaginary parts of the residual.
    """
    decay_count = count_decay_spectra(poles)
    nuisance_spectra, decay_amplitudes = (
        nuisance_spectra[:decay_count],
        projected_residual.amplitudes[:decay_count],
    )
    explained_cost = float(
        decay_amplitudes
        @ projected_residual.amplitude_gram[:decay_count, :decay_count]
        @ decay_amplitudes
    )
    if len(hum_spectra) and decay_amplitudes.size:
        residual_without_decays = projected_residual.residual - decay_amplitudes @ nuisance_spectra
        best_factors, remaining_cost = _least_squares_combination(
            residual_without_decays, np.concatenate([nuisance_spectra, hum_spectra])
        )
        explained_cost = (
            _least_squares_combination(residual_without_decays, hum_spectra)[1] - remaining_cost
        )
        decay_amplitudes = best_factors[: decay_amplitudes.size]
    mode_amplitudes: dict[int, float] = {}
    first_column = 0
    for decay_pole in poles:
        column_count = 2 if decay_pole.oscillates else 1
        mode_amplitude = float(
            np.linalg.norm(decay_amplitudes[first_column : first_column + column_count])
        )
        mode_amplitudes[decay_pole.mode] = max(
            mode_amplitudes.get(decay_pole.mode, 0.0), mode_amplitude
        )
        first_column += column_count
    return Ringing(
        amplitude_nm=tuple(mode_amplitudes.values()),
        chi_square=explained_cost / residual_variance,
        degrees_of_freedom=decay_amplitudes.size,
    )


def _least_squares_combination(
    target_spectrum: NDArray[np.complex128], basis_spectra: NDArray[np.complex128]
) -> tuple[NDArray[np.float64], float]:
    """Fit a spectrum by a linear combination of m other spectra with real factors.

    Return the factors, shape (m,), and the sum of squares that remains.
    """
    real_spectra = np.ascontiguousarray(basis_spectra).view(np.float64)
    spectrum_norms = np.sqrt(np.einsum("ij,ij->i", real_spectra, real_spectra))
    spectrum_norms[spectrum_norms == 0] = 1.0
    scaled_spectra, real_values = (
        (real_spectra / spectrum_norms[:, None]).T,
        target_spectrum.view(np.float64),
    )
    scaled_coefficients = np.linalg.lstsq(scaled_spectra, real_values)[0]
    unexplained_values = real_values - scaled_spectra @ scaled_coefficients
    return scaled_coefficients / spectrum_norms, float(unexplained_values @ unexplained_values)
