"""From the covariance of the unknowns to what is said of each parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.whole_record.plant import LOGARITHMIC
from analysis.whole_record.uncertainty import damping_size, interval

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record.result import DampingSize
    from analysis.whole_record.unknowns import Unknowns

_UNDETERMINED: Final = 20.0
"""Standard deviation of a logarithm that says nothing: a factor of 1e9 either way."""


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
