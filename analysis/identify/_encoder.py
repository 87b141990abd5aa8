"""Steps of the encoder: their size, and readings of a motor at rest.

While the beam rings, a resting motor moves by much less than a count. But if it rests near the edge
between two counts, its encoder alternates between them at the frequency of the mode. A fit takes
this square wave for motion that drives the mode, and shifts the frequency of the mode: in one of 14
searches by seven standard deviations. The alternating readings show that the motor is at the edge.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.decimation import runs_of_true

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MIN_ALTERNATING_CHANGES: Final = 4
"""Minimum number of alternating changes between two counts that show a motor at rest."""

_MAX_SINGLE_COUNT_RATIO: Final = 1.5
"""Largest change of the reading that is a single count, relative to the smallest change of the
record."""


_STEP_QUANTILES: Final = (0.01, 0.0)
"""Quantiles of the changes of the angle that may be a single step of the encoder. Smaller changes
than that of the first quantile may be halves of a step, from a correction of the readings."""

_MAX_STEP_DEVIATION: Final = 0.05
"""Largest deviation of a change from a multiple of the step, relative to the step."""

_MIN_FRACTION_OF_MULTIPLES: Final = 0.9
"""Smallest fraction of the changes that are multiples of the step of an encoder."""


def encoder_step_rad(angle_rad: NDArray[np.float64]) -> float:
    """Return the step of the encoder that measured an angle, in rad; 0 if the angle has no steps.

    Parameters
    ----------
    angle_rad : ndarray, shape (n,)
        Measured angle; NaN where it is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.identify._encoder import encoder_step_rad
    >>> angle_rad = np.sin(np.arange(1000) / 100)
    >>> encoder_step_rad(angle_rad), round(encoder_step_rad(0.01 * np.round(100 * angle_rad)), 6)
    (0.0, 0.01)
    """
    changes_rad = np.abs(np.diff(angle_rad))
    changes_rad = changes_rad[changes_rad > 0]
    if changes_rad.size == 0:
        return 0.0
    for quantile in _STEP_QUANTILES:
        step_rad = float(np.quantile(changes_rad, quantile, method="inverted_cdf"))
        step_counts = changes_rad / step_rad
        is_multiple = np.abs(step_counts - np.round(step_counts)) < _MAX_STEP_DEVIATION
        if np.mean(is_multiple) > _MIN_FRACTION_OF_MULTIPLES:
            return step_rad
    return 0.0


def angle_without_alternating_counts(
    angle_rad: NDArray[np.float64], reference_rad: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return the angle in rad with alternating readings at rest replaced by their mean, shape (n,).

    Only readings under a constant reference are replaced. The reference of the motor's controller
    is None without a controller.
    """
    if reference_rad is None:
        return angle_rad
    differences_rad = np.diff(angle_rad)
    change_indices = np.flatnonzero(differences_rad)
    if change_indices.size < _MIN_ALTERNATING_CHANGES:
        return angle_rad
    changes_rad = differences_rad[change_indices]
    reference_move_numbers = np.cumsum(np.diff(reference_rad) != 0)[change_indices]
    is_alternating_change = (
        (changes_rad[1:] == -changes_rad[:-1])
        & (np.abs(changes_rad[1:]) <= _MAX_SINGLE_COUNT_RATIO * np.abs(changes_rad).min())
        & (reference_move_numbers[1:] == reference_move_numbers[:-1])
    )
    corrected_angle_rad = angle_rad.copy()
    for first, last in zip(*runs_of_true(is_alternating_change), strict=True):
        if last - first + 1 >= _MIN_ALTERNATING_CHANGES:
            start, end = change_indices[[first, last]] + 1
            corrected_angle_rad[start:end] = (angle_rad[start - 1] + angle_rad[start]) / 2
    return corrected_angle_rad
