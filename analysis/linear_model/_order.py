"""Choice of the states of a realisation: the fewest for an accuracy, or the best of a number."""

from __future__ import annotations

from bisect import bisect_left
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.linear_model._dynamics import LinearModelError
from analysis.linear_model._pole_fit import PoleStructure

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from analysis.linear_model._pole_fit import Input, PoleFit
    from analysis.linear_model._state_space import StateSpace

MAX_RELATIVE_ERROR: Final = 1e-3
"""Accuracy over the band at which `auto` stops."""

_LADDERS_RAD_S: Final = ((0.1, 1e3), (0.3, 3e3), (0.03, 1e4), (0.03, 3e2), (30.0, 1e4))
"""First and last of the real poles, which are spaced evenly in the logarithm."""
_MOST_REAL: Final = 12
_MOST_INTEGRATORS: Final = 2


def realised(fit: PoleFit, order: int | None, given: Input) -> tuple[PoleStructure, StateSpace]:
    """Realise a response with a number of states.

    Parameters
    ----------
    fit : PoleFit
    order : int or None
        Number of states, those of filters included; None: as few as suffice for an error of
        `MAX_RELATIVE_ERROR`.
    given : str
        Input.

    Raises
    ------
    LinearModelError
        If no number suffices, or a realisation has not as many states or is not stable.
    """
    dynamics = fit.dynamics
    if order is not None:
        fixed = len(dynamics.real_poles) + sum(each for _, each in dynamics.filters)
        most = fixed + 2 * len(dynamics.pairs) + _MOST_REAL
        every = dict.fromkeys(range(len(dynamics.pairs) + 1), 0)
        best = _best(fit, order - fixed, given, every, np.inf)
        if best is not None:
            return best
        raise LinearModelError(
            f"A stable model with {order} states was not found: the model may have {fixed} to "
            f"{most} states, 2 for each of the {dynamics.in_band} modes in its band; state another "
            "number, or --order auto."
        )
    least = {
        pairs: bisect_left(range(_MOST_REAL + 1), True, key=partial(_suffice, fit, pairs))
        for pairs in range(dynamics.in_band, len(dynamics.pairs) + 1)
    }
    least = {pairs: real for pairs, real in least.items() if real <= _MOST_REAL}
    first = min((2 * pairs + real for pairs, real in least.items()), default=0)
    last = max((2 * pairs for pairs in least), default=-1) + _MOST_REAL + _MOST_INTEGRATORS
    for states in range(first, last + 1):
        best = _best(fit, states, given, least, MAX_RELATIVE_ERROR)
        if best is not None:
            return best
    raise LinearModelError(
        f"The model was not realised with a relative error of {MAX_RELATIVE_ERROR:g} from "
        f"{dynamics.band_hz[0]:g} to {dynamics.band_hz[1]:g} Hz; state a number of states "
        "with --order N, whose error is then reported."
    )


def _suffice(fit: PoleFit, pairs: int, real: int) -> bool:
    """Return whether a number of real poles suffices, with both integrators."""
    ladders = _ladders(pairs, real, _MOST_INTEGRATORS)
    return any(fit.solve(structure)[1] <= MAX_RELATIVE_ERROR for structure in ladders)


def _structures(pairs: int, states: int, given: Input) -> Iterator[PoleStructure]:
    """Return the structures of a number of pairs and of states beyond those of all structures."""
    if given == "angle":  # which has the velocity and the acceleration as inputs
        yield from _ladders(pairs, states - 2 * pairs, _MOST_INTEGRATORS)
        return
    for integrators in range(_MOST_INTEGRATORS + 1):
        yield from _ladders(pairs, states - 2 * pairs - integrators, integrators)


def _ladders(pairs: int, real: int, integrators: int) -> Iterator[PoleStructure]:
    if not 0 <= real <= _MOST_REAL:
        return
    for low, high in _LADDERS_RAD_S[: None if real else 1]:
        poles = np.geomspace(low, high, real) if real > 1 else np.full(real, (low * high) ** 0.5)
        yield PoleStructure(pairs, tuple((-poles).tolist()), integrators)


def _best(
    fit: PoleFit, states: int, given: Input, least: Mapping[int, int], tolerance: float
) -> tuple[PoleStructure, StateSpace] | None:
    """Return the most accurate stable realisation within a tolerance, None if there is none.

    It has the given number of pairs and at least the given number of real poles.
    """
    found: list[tuple[float, int, PoleStructure, NDArray[np.float64]]] = []
    for structure in (
        each
        for pairs, real in least.items()
        for each in _structures(pairs, states, given)
        if len(each.ladder_rad_s) >= real
    ):
        coefficients, error = fit.solve(structure)
        if error <= tolerance:
            found.append((error, len(found), structure, coefficients))
    for _, _, structure, coefficients in sorted(found, key=lambda each: each[:2]):
        system = fit.system(structure, coefficients, given)
        accurate = tolerance == np.inf or fit.error(system).max() <= tolerance
        if accurate and fit.stable_on_motor(structure, coefficients):
            return structure, system
    return None
