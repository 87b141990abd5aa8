"""Uncertainty of the estimates and of quantities derived from them (delta method).

The covariance of the unknowns is that of a weighted least-squares estimate under the noise spectrum
found, from the curvature of the sum of squares; parameters, modes, loss factors and the free decay
take theirs from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._plant import LOGARITHMIC
from analysis.identify._result import DampingSize, ModeEstimate, Ringing
from analysis.identify.free_decay import decay_columns
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._problem import Projected
    from analysis.identify.free_decay import Pole
    from analysis.identify.parametrization import Unknowns

_WORST_CONDITION: Final = 1e13

_UNDETERMINED: Final = 20.0
"""Standard deviation of an undetermined logarithm: a factor of 1e9 either way."""

_LARGEST_LN_OMEGA: Final = 50.0


# Unknowns and parameters


def covariance_of_unknowns(
    jacobian: NDArray[np.complex128], scatter: float, held: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the covariance of the unknowns that the data determine.

    Parameters
    ----------
    jacobian : ndarray of complex, shape (k, K)
        Derivatives of the whitened residual.
    scatter : float
        Variance of the whitened residual's parts.
    held : ndarray of bool, shape (k,)
        Unknowns at a bound.

    Returns
    -------
    covariance : ndarray, shape (k, k)
        Zero in rows and columns of the others.
    determined : ndarray of bool, shape (k,)
    """
    hessian = (jacobian.conj() @ jacobian.T).real
    scale = np.sqrt(np.diag(hessian))
    determined = ~held & (scale > 0) & np.isfinite(scale)
    covariance = np.zeros_like(hessian)
    if not determined.any():
        return covariance, determined
    block = np.ix_(determined, determined)
    unit = np.outer(scale[determined], scale[determined])
    scaled = hessian[block] / unit
    if np.linalg.cond(scaled) > _WORST_CONDITION:
        return covariance, np.zeros_like(determined)
    covariance[block] = scatter * np.linalg.inv(scaled) / unit
    return covariance, determined


@dataclass(frozen=True, slots=True)
class ParameterUncertainty:
    """Uncertainty of the parameters at a minimum; its attributes are as in `RecordFit`."""

    std: dict[str, float | None]
    interval: dict[str, tuple[float, float] | None]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]
    at_bounds: tuple[str, ...]
    internal: DampingSize | None
    external: DampingSize | None


def parameter_uncertainty(
    unknowns: Unknowns,
    x: NDArray[np.float64],
    held: NDArray[np.bool_],
    of_unknowns: NDArray[np.float64],
    known: NDArray[np.bool_],
) -> ParameterUncertainty:
    """Propagate the covariance of the unknowns to the parameters.

    Parameters
    ----------
    unknowns : Unknowns
    x : ndarray, shape (k,)
        The minimum.
    held : ndarray of bool, shape (k,)
        Unknowns that rest on a bound there.
    of_unknowns : ndarray, shape (k, k)
        Their covariance, zero in rows and columns of those that are not known.
    known : ndarray of bool, shape (k,)
        Unknowns that the data determine.
    """
    chain = unknowns.estimates_by_unknowns(x)
    every_covariance = chain @ of_unknowns @ chain.T
    names, values = unknowns.names, unknowns.parameters(x)
    logarithmic = np.array([name in LOGARITHMIC for name in names])
    known = known & ~(logarithmic & (np.diag(every_covariance) > _UNDETERMINED**2))
    covariance = every_covariance[np.ix_(known, known)]
    determined = tuple(name for name, is_known in zip(names, known, strict=True) if is_known)
    std: dict[str, float | None] = dict.fromkeys(values, 0.0) | dict.fromkeys(names, None)
    intervals: dict[str, tuple[float, float] | None] = dict.fromkeys(names, None)
    for name, spread in zip(determined, np.sqrt(np.diag(covariance)).tolist(), strict=True):
        std[name] = values[name] * spread if name in LOGARITHMIC else spread
        intervals[name] = interval(name, values[name], spread)
    first, _second = unknowns.omega_rad_s
    return ParameterUncertainty(
        std=std,
        interval=intervals,
        determined=determined,
        covariance=covariance,
        at_bounds=tuple(name for name, is_held in zip(names, held, strict=True) if is_held),
        internal=damping_size("zeta", "alpha", values, determined, covariance, first),
        external=damping_size("gamma", "lambda", values, determined, covariance, first),
    )


# Intervals


def interval(name: str, value: float, std: float) -> tuple[float, float]:
    """Return the 95 % interval; `std` is that of the logarithm for logarithmic parameters."""
    half = NORMAL_95 * std
    if name in LOGARITHMIC:
        return value * math.exp(-half), value * math.exp(half)
    return value - half, value + half


def interval_from_zero(value: float, std: float) -> tuple[float, float]:
    """Return the 95 % interval of a non-negative quantity: the possible part of the symmetric one.

    It begins at 0, one-sided, if the estimate is within 1.96 standard deviations of 0 or at 0. It
    covers a true value of 0 in 97.5 % of all records, others in 95 to 97.5 %.

    Parameters
    ----------
    value : float
        The estimate, 0 or more.
    std : float
        Standard deviation without the bound at 0.
    """
    half = NORMAL_95 * std
    return max(value - half, 0.0), value + half


# Damping at its pivot frequency


def damping_size(
    coefficient: str,
    order: str,
    values: dict[str, float],
    names: Sequence[str],
    covariance: NDArray[np.float64],
    least_omega_rad_s: float,
) -> DampingSize | None:
    """Return the loss factor of a damping at the frequency where it depends least on its order.

    A record determines the loss. ``zeta omega^alpha`` equals it only to first order: if the order
    is uncertain by 0.15, it is uncertain by 4 % more than the loss.

    Parameters
    ----------
    coefficient, order : str
        "zeta" and "alpha", or "gamma" and "lambda".
    values : dict
    names : sequence of str
        Determined parameters.
    covariance : ndarray, shape (k, k)
        Theirs, coefficients as logarithms.
    least_omega_rad_s : float
        Frequency of the first mode: below it no mode rings, and a loss there is of no use.
    """
    if coefficient not in names:
        return None
    i = list(names).index(coefficient)
    if order not in names:
        return DampingSize(None, values[coefficient], values[coefficient] * covariance[i, i] ** 0.5)
    j = list(names).index(order)
    angle = math.pi / 2 * values[order]
    slope = np.zeros(len(names))
    slope[i] = 1.0
    # External damping is lost against the inertia rho/EI omega².
    ratio, power = "density_over_stiffness", 2 if coefficient == "gamma" else 0
    if power and ratio in names:
        slope[list(names).index(ratio)] = -1.0
    # ln loss has no covariance with the order where its slope by the order is:
    uncorrelated = -float(slope @ covariance[:, j]) / covariance[j, j]
    turning = math.pi / 2 / math.tan(angle)
    ln_omega = max(uncorrelated - turning, math.log(least_omega_rad_s))
    if abs(ln_omega) > _LARGEST_LN_OMEGA:
        return None  # an order all but unknown is uncorrelated nowhere
    slope[j] = ln_omega + turning
    scale = values[ratio] if power else 1.0
    size = values[coefficient] / scale * math.sin(angle)
    size *= math.exp((values[order] - power) * ln_omega)
    variance = max(float(slope @ covariance @ slope), 0.0)
    return DampingSize(math.exp(ln_omega), size, size * math.sqrt(variance))


# Modes


def mode_table(poles: Sequence[Pole], covariance: NDArray[np.float64]) -> tuple[ModeEstimate, ...]:
    """Return frequencies and damping ratios with standard deviations, by the delta method.

    Parameters
    ----------
    poles : sequence of Pole
        Differentiated by the unknowns; of over-damped modes both.
    covariance : ndarray, shape (k, k)
        Covariance of the unknowns.
    """
    table = []
    for number in dict.fromkeys(pole.mode for pole in poles):
        first, *rest = (pole for pole in poles if pole.mode == number)
        p, dp = first.at_rad_s, first.derivative
        q, dq = (rest[0].at_rad_s, rest[0].derivative) if rest else (p.conjugate(), dp.conj())
        natural = math.sqrt((p * q).real)
        ratio = -(p + q).real / (2 * natural)
        natural_slope = (q * dp + p * dq).real / (2 * natural)
        ratio_slope = -(dp + dq).real / (2 * natural) - ratio * natural_slope / natural
        frequency_slope = np.zeros(dp.size) if rest else dp.imag / (2 * np.pi)
        table.append(
            ModeEstimate(
                number=number,
                frequency_hz=abs(p.imag) / (2 * np.pi),
                frequency_std_hz=_std(frequency_slope, covariance),
                damping_ratio=ratio,
                damping_ratio_std=_std(ratio_slope, covariance),
            )
        )
    return tuple(table)


def _std(slope: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    return math.sqrt(max(float(slope @ covariance @ slope), 0.0))


# Free decay at the start


def ringing(
    poles: Sequence[Pole],
    projected: Projected,
    scatter: float,
    columns: NDArray[np.complex128],
    hum: NDArray[np.complex128],
) -> Ringing:
    """Return the amplitudes of the free decay by mode, with their significance.

    A hum is excluded bin by bin. But it starts and ends with the record and so leaks into all other
    bins, which the free decay would partly explain: only its reduction in addition to the hum
    counts. `columns`, shape (m, K), are the whitened spectra of the free decays and of the other
    projected terms, `hum`, shape (h, K), those of the lines, and `scatter` is the variance of the
    residual's parts.
    """
    count = decay_columns(poles)
    columns, decays = columns[:count], projected.amplitudes[:count]
    explained = float(decays @ projected.amplitude_gram[:count, :count] @ decays)
    if len(hum) and decays.size:
        without = projected.residual - decays @ columns
        combined, left = _combination(without, np.concatenate([columns, hum]))
        explained = _combination(without, hum)[1] - left
        decays = combined[: decays.size]
    amplitudes: dict[int, float] = {}
    start = 0
    for pole in poles:
        width = 2 if pole.oscillates else 1
        size = float(np.linalg.norm(decays[start : start + width]))
        amplitudes[pole.mode] = max(amplitudes.get(pole.mode, 0.0), size)
        start += width
    return Ringing(
        amplitude_nm=tuple(amplitudes.values()),
        chi_square=explained / scatter,
        degrees_of_freedom=decays.size,
    )


def _combination(
    values: NDArray[np.complex128], columns: NDArray[np.complex128]
) -> tuple[NDArray[np.float64], float]:
    """Return the best real combination of columns, (m,), and its remaining sum of squares."""
    parts = np.ascontiguousarray(columns).view(np.float64)
    size = np.sqrt(np.einsum("ij,ij->i", parts, parts))
    size[size == 0] = 1.0
    scaled, right = (parts / size[:, None]).T, values.view(np.float64)
    factors = np.linalg.lstsq(scaled, right)[0]
    rest = right - scaled @ factors
    return factors / size, float(rest @ rest)
