"""Weighting functions of the cost, Eq. (27) and the general form of the paper's Appendix A."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

WeightingFunction = Callable[[NDArray[np.float64]], NDArray[np.float64]]
Weighting = str | WeightingFunction

_LARGEST_POWER = 10
"""Beyond it, a handful of points at one end of the band would have all the weight."""


class WeightingError(ValueError):
    """A weighting that does not exist, or that is not positive and finite where it is used."""


def weights(omega_rad_s: NDArray[np.float64], weighting: Weighting) -> NDArray[np.float64]:
    """Weights ``W_p = p(omega_p) / sum_i p(omega_i)`` on an evenly spaced grid (A5).

    Parameters
    ----------
    omega_rad_s : ndarray, shape (n,)
        Positive.
    weighting : str or callable
        ``"const"``: p = 1, the mean square error. ``"omega"``: p = 1/omega, the mean over a
        logarithmic frequency axis. ``"omega^K"`` with a number K: p = omega**K, so that
        ``"omega"`` is ``"omega^-1"`` by another name. A callable is p itself: omega in rad/s,
        shape (n,), to values of that shape that are not negative.

    Returns
    -------
    ndarray, shape (n,)
        Not negative, of sum 1.

    Raises
    ------
    WeightingError
        If there is no such weighting, or its values are negative, not finite or all zero.
    """
    name = weighting_name(weighting)
    if callable(weighting):
        p = np.asarray(weighting(omega_rad_s), dtype=np.float64)
        if p.shape != omega_rad_s.shape:
            raise WeightingError(
                f"The weighting {name} gave values of shape {p.shape} for {omega_rad_s.shape} "
                "frequencies; it must give one value for each."
            )
    else:
        p = omega_rad_s ** _exponent(weighting)
    total = float(p.sum())
    if not (math.isfinite(total) and total > 0 and float(p.min()) >= 0):
        raise WeightingError(
            f"The weighting {name} must be finite, not negative and not all zero over "
            f"{float(omega_rad_s.min()):g} to {float(omega_rad_s.max()):g} rad/s."
        )
    return p / total


def weighting_name(weighting: Weighting) -> str:
    """Return what a weighting is called in results: its name, or its function's.

    Raises
    ------
    WeightingError
        If there is no weighting of that name.
    """
    if callable(weighting):
        return str(getattr(weighting, "__name__", type(weighting).__name__))
    _exponent(weighting)
    return weighting


def _exponent(weighting: str) -> float:
    if weighting == "const":
        return 0.0
    if weighting == "omega":
        return -1.0
    base, separator, power = weighting.partition("^")
    try:
        exponent = float(power)
    except ValueError:
        exponent = math.nan
    if base != "omega" or not separator or not abs(exponent) <= _LARGEST_POWER:
        raise WeightingError(
            f"There is no weighting {weighting!r}; choose const, omega (which is 1/omega) or "
            f"omega^K with a number K from -{_LARGEST_POWER} to {_LARGEST_POWER}, such as "
            "omega^-0.5."
        )
    return exponent
