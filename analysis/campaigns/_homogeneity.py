"""Homogeneity of a campaign: whether its sessions are of one specimen, by files and by estimates.

Cochran's Q and I², the fraction of the variance between sessions that their own uncertainties do
not explain [1]_, of each mode and of each parameter by itself.

References
----------
.. [1] J. P. T. Higgins and S. G. Thompson, Quantifying heterogeneity in a meta-analysis, Statistics
   in Medicine 21 (2002) 1539-1558.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns._orders import common_structure, freest_estimate
from analysis.campaigns.pooling import random_effects
from analysis.identify import LOGARITHMIC
from analysis.statistics import chi_square_p_value

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._estimates import RecordEstimate
    from analysis.campaigns._experiment import StatedSpecimen
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate

Values = tuple[tuple[str, float, float], ...]
"""File, estimate and its standard deviation, session by session."""

SIGNIFICANT: Final = 0.01
"""Level of all quantities together: one alarm in a hundred campaigns that repeat is false."""

_LARGE: Final = 0.9
"""I² from which sessions count as a mixture: a scatter of three own standard deviations."""

_CLEAR: Final = 5.0
"""Gap from which groups are distinguished, in standard deviations within groups."""

_FEWEST: Final = 2
_OF_MODES: Final = {"frequency_hz": "frequency_std_hz", "damping_ratio": "damping_ratio_std"}
_OF_RIG: Final = frozenset({"delay_s", "tool_inertia_kg_m2"})


@dataclass(frozen=True, slots=True)
class Heterogeneity:
    """One mode's or parameter's scatter between sessions.

    Attributes
    ----------
    quantity : str
        Parameter, or ``frequency_hz_1``, ``damping_ratio_1`` and so on by the number of the mode.
    values : tuple of (str, float, float)
        File, estimate and its standard deviation, session by session.
    mean : float
        Pooled; of a positive parameter the geometric mean.
    between_std : float
        Scatter between sessions beyond their own uncertainties, tau.
    cochran_q : float
        About `degrees_of_freedom` without such scatter.
    chance : float
        Probability of that Q without such scatter.
    mixed : bool
        Whether sessions differ so much that the mean is that of a mixture.
    groups : tuple of tuple of str
        Files of each group, the lowest first; empty without clear gaps.
    """

    quantity: str
    values: Values
    mean: float
    between_std: float
    cochran_q: float
    chance: float
    mixed: bool
    groups: tuple[tuple[str, ...], ...]

    @property
    def degrees_of_freedom(self) -> int:
        """Sessions less one."""
        return len(self.values) - 1

    @property
    def own_stds(self) -> float:
        """Scatter between sessions, tau, in standard deviations that a typical session states."""
        return math.sqrt(max(self.cochran_q / self.degrees_of_freedom - 1, 0.0))

    @property
    def i_squared(self) -> float:
        """Fraction of the variance between sessions that their own uncertainty does not explain."""
        return self.own_stds**2 / (1 + self.own_stds**2)

    @property
    def of_rig(self) -> bool:
        """Whether it is the rig's, and says nothing of the specimen."""
        return self.quantity in _OF_RIG


@dataclass(frozen=True, slots=True)
class Homogeneity:
    """Evidence for and against one specimen.

    Attributes
    ----------
    specimens : tuple of StatedSpecimen
        That the files state, the one of this campaign first.
    quantities : tuple of Heterogeneity
        Modes, then parameters, all by the structure by which sessions are compared.
    structure : str or None
        Its name, as tables call it; None without whole-record fits.
    """

    specimens: tuple[StatedSpecimen, ...]
    quantities: tuple[Heterogeneity, ...]
    structure: str | None = None

    @property
    def leading(self) -> Heterogeneity | None:
        """Quantity in which sessions differ most, modes before parameters; None if they do not."""
        found = [each for each in self.quantities if each.mixed and not each.of_rig]
        of_modes = [each for each in found if each.quantity.startswith(tuple(_OF_MODES))]
        return max(of_modes or found, key=lambda each: each.own_stds, default=None)

    @property
    def mixed(self) -> bool:
        """Whether the pooled values are means of a mixture."""
        return self.leading is not None

    @property
    def one_specimen(self) -> bool:
        """Whether neither the files nor the estimates contradict one specimen."""
        return len(self.specimens) < _FEWEST and not self.mixed

    def of(self, quantity: str) -> Heterogeneity | None:
        """Return the between-session scatter of one quantity, None if it is not known."""
        return next((each for each in self.quantities if each.quantity == quantity), None)

    def is_mixed(self, quantity: str) -> bool:
        """Whether one pooled value is the mean of a mixture."""
        found = self.of(quantity)
        return found is not None and found.mixed


def homogeneity(
    sessions: Sequence[SessionAnalysis],
    pooled: Sequence[PooledEstimate],
    specimens: Sequence[StatedSpecimen],
) -> Homogeneity:
    """Test whether sessions are of one specimen, all by one structure (`common_structure`).

    Parameters
    ----------
    sessions : sequence of SessionResult
    pooled : sequence of PooledEstimate
        The lowest BIC first.
    specimens : sequence of StatedSpecimen
    """
    name = common_structure(sessions)
    by_name = [
        (session.name, each)
        for session in sessions
        for each in session.record_estimates
        if each.name == name
    ]
    every = dict(_of_modes(by_name))
    shared = freest_estimate(pooled)
    if shared is not None:
        every |= dict(_of_parameters(sessions, shared))
    every = {quantity: values for quantity, values in every.items() if len(values) >= _FEWEST}
    level = SIGNIFICANT / max(len(every), 1)
    return Homogeneity(
        tuple(specimens),
        tuple(_judged(quantity, values, level) for quantity, values in every.items()),
        name,
    )


def _of_modes(estimates: Sequence[tuple[str, RecordEstimate]]) -> Iterator[tuple[str, Values]]:
    """Yield frequencies and damping ratios of the modes that all sessions have."""
    count = min((len(each.modes) for _, each in estimates), default=0)
    for quantity, std in _OF_MODES.items():
        for index in range(count):
            values = (
                (file, getattr(each.modes[index], quantity), getattr(each.modes[index], std))
                for file, each in estimates
            )
            yield f"{quantity}_{index + 1}", _known(values)


def _of_parameters(
    sessions: Sequence[SessionAnalysis], shared: PooledEstimate
) -> Iterator[tuple[str, Values]]:
    for parameter in shared.parameters:
        name = parameter.name
        values = (
            (session.name, each.parameters[name], each.std[name] or 0.0)
            for session in sessions
            for each in session.record_estimates
            if each.name == shared.name and name in each.determined
        )
        yield name, _known(values)


def _known(values: Iterator[tuple[str, float, float]]) -> Values:
    return tuple(each for each in values if math.isfinite(each[2]) and each[2] > 0)


def _judged(quantity: str, values: Values, level: float) -> Heterogeneity:
    estimate, std = np.array([each[1:] for each in values]).T
    logarithmic = quantity in LOGARITHMIC
    if logarithmic:
        estimate, std = np.log(estimate), std / estimate
    effects = random_effects(estimate[:, None], (std**2)[:, None, None])
    chance = float(chi_square_p_value(effects.cochran_q[0], len(values) - 1))
    mean = math.exp(effects.mean[0]) if logarithmic else float(effects.mean[0])
    significant = chance < level
    apart = groups(estimate, std) if significant else ()
    q = float(effects.cochran_q[0])
    return Heterogeneity(
        quantity=quantity,
        values=values,
        mean=mean,
        between_std=float(effects.between_std[0]) * (mean if logarithmic else 1.0),
        cochran_q=q,
        chance=chance,
        mixed=significant and (bool(apart) or q * (1 - _LARGE) >= len(values) - 1),
        groups=tuple(tuple(values[index][0] for index in sorted(part)) for part in apart),
    )


def groups(estimate: NDArray[np.float64], std: NDArray[np.float64]) -> tuple[tuple[int, ...], ...]:
    """Split estimates at clear gaps into groups of indices, lowest first; empty without gaps.

    No more groups than half the sessions, so that one at least has two members, and gaps of
    `_CLEAR` standard deviations within the groups, or of single sessions where these are larger.

    Parameters
    ----------
    estimate, std : ndarray, shape (K,)
    """
    order = np.argsort(estimate)
    gaps = np.diff(estimate[order])
    floor = math.sqrt(float(np.mean(std**2)))
    found: tuple[tuple[int, ...], ...] = ()
    clearest = _CLEAR
    for count in range(2, (order.size + 1) // 2 + 1):
        cuts = np.sort(np.argsort(gaps)[1 - count :]) + 1
        parts = np.split(order, cuts)
        squares = sum(float(((estimate[p] - estimate[p].mean()) ** 2).sum()) for p in parts)
        within = max(math.sqrt(squares / (order.size - count)), floor)
        apart = float(gaps[cuts - 1].min()) / within
        if apart > clearest:
            clearest, found = apart, tuple(tuple(part.tolist()) for part in parts)
    return found
