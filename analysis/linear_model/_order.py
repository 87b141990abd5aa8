"""Choice of the states of a realisation: the fewest that reach an accuracy, or a given number."""

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

    from analysis.linear_model._pole_fit import InputKind, PoleFit
    from analysis.linear_model._state_space import StateSpace

MAX_RELATIVE_ERROR: Final = 1e-3
"""Largest relative error in the band that ``--order auto`` accepts."""

_REAL_POLE_RANGES_RAD_S: Final = ((0.1, 1e3), (0.3, 3e3), (0.03, 1e4), (0.03, 3e2), (30.0, 1e4))
"""Ranges to be tried for the logarithmically spaced real poles, in rad/s."""
_MAX_REAL_POLES: Final = 12
"""Largest number of added real poles."""

_MAX_INTEGRATORS: Final = 2
"""Largest number of integrals of the acceleration: velocity and angle."""


def realise_response(
    fit: PoleFit, order: int | None, input_kind: InputKind
) -> tuple[PoleStructure, StateSpace]:
    """Approximate a response by a state space with a given number of states, or as few as suffice.

    `order` is the number of states, including those of filters; None for as few as suffice for an
    error of `MAX_RELATIVE_ERROR`. The input is "acceleration", or "angle" for angle, velocity and
    acceleration. Raise `LinearModelError` if no number of states suffices, or no stable realisation
    has the given number.
    """
    dynamics = fit.dynamics
    if order is not None:
        min_states = len(dynamics.real_poles) + sum(
            filter_order for _, filter_order in dynamics.torque_filters
        )
        max_states = min_states + 2 * len(dynamics.pole_pairs) + _MAX_REAL_POLES
        zero_real_poles = dict.fromkeys(range(len(dynamics.pole_pairs) + 1), 0)
        realisation = _best_realisation(
            fit, order - min_states, input_kind, zero_real_poles, np.inf
        )
        if realisation is not None:
            return realisation
        raise LinearModelError(
            f"A stable model with {order} states was not found: the model may have "
            f"{min_states} to {max_states} states, 2 for each of the "
            f"{dynamics.pair_count_in_band} modes "
            "in its band; state another number, or --order auto."
        )
    min_real_poles = {
        pair_count: bisect_left(
            range(_MAX_REAL_POLES + 1), True, key=partial(_real_poles_suffice, fit, pair_count)
        )
        for pair_count in range(dynamics.pair_count_in_band, len(dynamics.pole_pairs) + 1)
    }
    min_real_poles = {
        pair_count: real_pole_count
        for pair_count, real_pole_count in min_real_poles.items()
        if real_pole_count <= _MAX_REAL_POLES
    }
    smallest_state_count = min(
        (
            2 * pair_count + real_pole_count
            for pair_count, real_pole_count in min_real_poles.items()
        ),
        default=0,
    )
    largest_state_count = (
        max((2 * pair_count for pair_count in min_real_poles), default=-1)
        + _MAX_REAL_POLES
        + _MAX_INTEGRATORS
    )
    for state_count in range(smallest_state_count, largest_state_count + 1):
        realisation = _best_realisation(
            fit, state_count, input_kind, min_real_poles, MAX_RELATIVE_ERROR
        )
        if realisation is not None:
            return realisation
    raise LinearModelError(
        f"The model was not realised with a relative error of {MAX_RELATIVE_ERROR:g} from "
        f"{dynamics.band_hz[0]:g} to {dynamics.band_hz[1]:g} Hz; state a number of states "
        "with --order N, whose error is then reported."
    )


def _real_poles_suffice(fit: PoleFit, pair_count: int, real_pole_count: int) -> bool:
    """Return whether a fit with this many real poles has an error within `MAX_RELATIVE_ERROR`.

    Besides the real poles, it has `pair_count` conjugate pole pairs and two poles at s = 0.
    """
    pole_structures = _structures_with_real_poles(pair_count, real_pole_count, _MAX_INTEGRATORS)
    return any(
        fit.solve(pole_structure)[1] <= MAX_RELATIVE_ERROR for pole_structure in pole_structures
    )


def _structures_with_states(
    pair_count: int, state_count: int, input_kind: InputKind
) -> Iterator[PoleStructure]:
    """Yield the pole structures with a number of conjugate pairs and a total number of states.

    `state_count` leaves out the states of over-damped modes and filters, which all structures have.
    """
    if input_kind == "angle":  # which has the velocity and the acceleration as inputs
        yield from _structures_with_real_poles(
            pair_count, state_count - 2 * pair_count, _MAX_INTEGRATORS
        )
        return
    for integrator_count in range(_MAX_INTEGRATORS + 1):
        yield from _structures_with_real_poles(
            pair_count, state_count - 2 * pair_count - integrator_count, integrator_count
        )


def _structures_with_real_poles(
    pair_count: int, real_pole_count: int, integrator_count: int
) -> Iterator[PoleStructure]:
    """Yield the pole structures with numbers of conjugate pairs, real poles and integrators.

    They differ in the range over which the added real poles are spread.
    """
    if not 0 <= real_pole_count <= _MAX_REAL_POLES:
        return
    for first_rad_s, last_rad_s in _REAL_POLE_RANGES_RAD_S[: None if real_pole_count else 1]:
        poles_rad_s = (
            np.geomspace(first_rad_s, last_rad_s, real_pole_count)
            if real_pole_count > 1
            else np.full(real_pole_count, (first_rad_s * last_rad_s) ** 0.5)
        )
        yield PoleStructure(pair_count, tuple((-poles_rad_s).tolist()), integrator_count)


def _best_realisation(
    fit: PoleFit,
    state_count: int,
    input_kind: InputKind,
    min_real_poles: Mapping[int, int],
    error_tolerance: float,
) -> tuple[PoleStructure, StateSpace] | None:
    """Return the most accurate stable state space with an error within a tolerance, or None.

    `min_real_poles` gives the admissible numbers of pairs and, for each, the smallest number of
    real poles.
    """
    accurate_fits: list[tuple[float, int, PoleStructure, NDArray[np.float64]]] = []
    for pole_structure in (
        candidate_structure
        for pair_count, min_real_pole_count in min_real_poles.items()
        for candidate_structure in _structures_with_states(pair_count, state_count, input_kind)
        if len(candidate_structure.added_real_poles_rad_s) >= min_real_pole_count
    ):
        fit_coefficients, fit_error = fit.solve(pole_structure)
        if fit_error <= error_tolerance:
            accurate_fits.append((fit_error, len(accurate_fits), pole_structure, fit_coefficients))
    for _, _, pole_structure, fit_coefficients in sorted(
        accurate_fits, key=lambda accurate_fit: accurate_fit[:2]
    ):
        state_space = fit.system(pole_structure, fit_coefficients, input_kind)
        is_accurate = (
            error_tolerance == np.inf or fit.relative_error(state_space).max() <= error_tolerance
        )
        if is_accurate and fit.is_stable_on_motor(pole_structure, fit_coefficients):
            return pole_structure, state_space
    return None
