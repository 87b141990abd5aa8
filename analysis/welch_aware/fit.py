"""Fit of the damping structures through Welch's estimator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify import SETTINGS, Box, Plant, Unknowns, descend
from analysis.models import STRUCTURES, Weighting, weighting_name, weights
from analysis.welch_aware.comparison import Measured
from analysis.welch_aware.estimator import WelchAwareError
from analysis.welch_aware.objective import Objective
from analysis.welch_aware.starting import PlainResponse, starting_points
from analysis.welch_aware.summary import summary
from rigd.beam import Damping

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.identify import Minimum, Setting
    from analysis.models import Structure
    from analysis.welch_aware.result import WelchAwareFit
    from rigd.beam import Beam
    from rigd.spectral import Segmentation

_FIRST_TOLERANCE: Final = 1e-2
_FIRST_EVALUATIONS: Final = 20
_TOLERANCE: Final = 1e-8


def fit_welch_aware(
    angle_rad: NDArray[np.float64],
    rate_hz: float,
    frequency_hz: NDArray[np.float64],
    measured_response: NDArray[np.complex128],
    segmentation: Segmentation,
    beam: Beam,
    structures: Iterable[Structure] = tuple(STRUCTURES.values()),
    weighting: Weighting = "omega",
    *,
    fixed: Iterable[Setting] = (),
    delay_s: float = 0.0,
    tool_inertia_kg_m2: float = 0.0,
    estimated_from: slice = slice(None),
    window: str = "hamming",
    uniform: bool = True,
    reference_rad: NDArray[np.float64] | None = None,
) -> tuple[WelchAwareFit, ...]:
    """Fit structures to a Welch estimate by putting the model through the same estimator.

    A window cuts off what rings longer than a segment lasts, and blurs what varies within a bin:
    Welch's H1 of a lightly damped beam is not its frequency response. Here the torque that the
    exact model predicts for the angle is divided, windowed and averaged as the measured one was,
    and Eq. (26) compares the two estimates. The windows' effect is then the same on both sides.

    Where the torque itself is at hand, `analysis.identify.fit_record` is more precise.

    Parameters
    ----------
    angle_rad : ndarray, shape (n,)
        Measured motor angle, relative to where the beam rested before the first sample. Where only
        the reference is left: the reference, if the motor follows it closely in the band.
    rate_hz : float
    frequency_hz : ndarray, shape (K,)
        Increasing, on the estimate's grid; at most 0.4 `rate_hz`.
    measured_response : ndarray of complex, shape (K,)
        H1 from angle to torque in N·m/rad, or Hiv with `reference_rad`; a lag of the torque
        is a negative phase.
    segmentation : Segmentation
        Of the estimate.
    beam : Beam
        Nominal: where the search for density and stiffness starts.
    structures : iterable of Structure
    weighting : str or callable
        See `analysis.models.weights`.
    fixed : iterable of str
        Settings (`analysis.identify.SETTINGS`) that stay at the nominal values.
    delay_s : float
        By how much the torque in the estimate is older than the angle, nominally.
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam, nominally.
    estimated_from : slice
        Samples of the angle that were divided into segments; those before only set the beam in
        motion.
    window : {"hamming", "hann", "rectangular"}
        Of the estimate; symmetric.
    uniform : bool
        Whether the beam is taken to be uniform, as Eq. 25 has it; otherwise the stiffness of each
        mode in the band but the first is free as well.
    reference_rad : ndarray, shape (n,), optional
        What the motor was asked for, if the estimate is `rigd.spectral.instrumental_response`.

    Returns
    -------
    tuple of WelchAwareFit
        In the order of `structures`.

    Raises
    ------
    WelchAwareError
        Angle, response and segments do not belong together, or cannot be used.
    WeightingError
        There is no such weighting.
    ValueError
        There is no such setting.

    Examples
    --------
    The response of a beam whose first mode rings for longer than the segments of 8 s, and what a
    fit to the response itself makes of it:

    >>> import numpy as np
    >>> from analysis.paper._fit import fit_frf
    >>> from analysis.models import STRUCTURES
    >>> from analysis.welch_aware import fit_welch_aware
    >>> from analysis.identify import Plant
    >>> from analysis.identify._predictor import Prediction
    >>> from rigd.beam import Beam, Damping
    >>> from rigd.spectral import Segmentation, welch_response
    >>> rate_hz, time_s = 125.0, np.arange(7500) / 125.0
    >>> angle_rad = 0.025 * np.sin(2 * np.pi * (0.05 + 0.25 * time_s) * time_s)
    >>> beam = Beam(0.98, 4.7e-3, 0.090275)
    >>> plant = Plant(beam, Damping(zeta=5e-5, alpha=1.0, gamma=0.02, lambda_=1.0))
    >>> torque_nm, _ = Prediction(angle_rad, rate_hz, slice(7500)).torque(plant)
    >>> segments = Segmentation(1000, 150, 8000)
    >>> h1 = welch_response(angle_rad, torque_nm, rate_hz, segment_length=1000, overlap=150,
    ...                     nfft=8000).band(0.6, 30.0)
    >>> plain = fit_frf(h1.frequency_hz, h1.response, beam, STRUCTURES["III"], "omega")
    >>> (aware,) = fit_welch_aware(angle_rad, rate_hz, h1.frequency_hz, h1.response, segments,
    ...                            beam, [STRUCTURES["III"]])
    >>> [round(fit.parameters["gamma"], 4) for fit in (plain, aware)]
    [0.0821, 0.02]
    """
    fixed = tuple(fixed)
    unknown = sorted(set(fixed) - set(SETTINGS))
    if unknown:
        raise ValueError(f"{unknown} cannot be fixed: choose from {SETTINGS}.")
    free = tuple(name for name in SETTINGS if name not in fixed)
    measured = Measured(
        np.asarray(angle_rad, dtype=np.float64), rate_hz, frequency_hz, measured_response,
        segmentation, window, estimated_from, reference_rad,
    )  # fmt: skip
    measured.check()
    comparison = measured.comparison(weighting)
    every = weights(2 * np.pi * frequency_hz, weighting)
    plain = PlainResponse(frequency_hz, measured_response, every)
    whole = measured.whole(comparison, every)
    nominal = Plant(beam, Damping(), delay_s, tool_inertia_kg_m2)
    modes = 1 if uniform else comparison.visible_modes(beam)
    found = []
    for structure in structures:
        objective = Objective(comparison, Unknowns.of(structure, nominal, free, modes))
        _check_enough(objective)
        minimum = _descend(objective, plain)
        found.append(summary(objective, minimum.x, weighting_name(weighting), whole))
    return tuple(found)


def _check_enough(objective: Objective) -> None:
    unknowns, points = len(objective.unknowns.names), objective.comparison.measured.size
    if points < unknowns:
        raise WelchAwareError(
            f"The response holds {points} values that the segments tell apart, too few for "
            f"{unknowns} unknowns; widen the band or fix more settings."
        )


def _descend(objective: Objective, plain: PlainResponse) -> Minimum:
    """Descend from the best few starts, and on from where it is lowest."""
    bounds = Box(*objective.unknowns.bounds)
    # The most promising start last: what was computed where it ends is kept for going on.
    ends = [
        descend(
            objective.normal_equations,
            start,
            bounds,
            relative_tolerance=_FIRST_TOLERANCE,
            learns=False,
            max_evaluations=_FIRST_EVALUATIONS,
        )
        for start in reversed(starting_points(plain, objective.unknowns))
    ]
    lowest = min(ends, key=lambda end: end.cost)
    return descend(
        objective.normal_equations,
        lowest.x,
        bounds,
        relative_tolerance=_TOLERANCE,
        learns=False,
    )
