"""Homogeneity of a campaign: whether files and estimates agree with a single specimen.

Each mode and each parameter is tested by itself with Cochran's Q and with I², the fraction of the
variance between sessions that their own uncertainties do not explain [1]_.

References
----------
.. [1] J. P. T. Higgins and S. G. Thompson, Quantifying heterogeneity in a meta-analysis, Statistics
   in Medicine 21 (2002) 1539-1558.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.pooling import common_structure, freest_estimate, random_effects
from analysis.campaigns.trend import Trend, linear_trend
from analysis.statistics import chi_square_p_value
from rigd.beam import LOGARITHMIC_PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._estimates import RecordEstimate
    from analysis.campaigns._experiment import StatedSpecimen
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate

SessionEstimates = tuple[tuple[str, float, float], ...]
"""File, estimate, and standard deviation of the estimate; one entry for each session."""

SIGNIFICANCE_LEVEL: Final = 0.01
"""Significance level of all quantities together: one false alarm in a hundred campaigns of one
specimen."""

_MIN_MIXTURE_I_SQUARED: Final = 0.9
"""Smallest I² at which sessions count as a mixture: they scatter by three times a session's own
standard deviation."""

_MIN_GROUP_GAP_STDS: Final = 5.0
"""Smallest gap that separates two groups, in units of the standard deviation within a group."""

_MIN_COMPARED_SESSIONS: Final = 2
"""Smallest number of sessions that can be compared."""
_MODE_QUANTITIES: Final = {"frequency_hz": "frequency_std_hz", "damping_ratio": "damping_ratio_std"}
"""Quantities of a mode that are tested, with the names of their standard deviations."""
_RIG_PARAMETERS: Final = frozenset({"delay_s", "tool_inertia_kg_m2"})
"""Parameters of the rig, whose scatter does not indicate different specimens."""


@dataclass(frozen=True, slots=True)
class Heterogeneity:
    """Scatter of one parameter or of one mode's quantity between sessions.

    Attributes
    ----------
    quantity : str
        Name of the parameter, or ``frequency_hz_N`` or ``damping_ratio_N`` of mode N.
    session_estimates : tuple of (str, float, float)
        File, estimate and its standard deviation, one entry for each session.
    mean : float
        Pooled mean; the geometric mean of a positive parameter.
    between_session_std : float
        Standard deviation between sessions that their own uncertainties do not explain, tau.
    cochran_q : float
        Cochran's Q; about `degrees_of_freedom` if tau is 0.
    p_value : float
        p-value of `cochran_q`.
    is_mixture : bool
        Whether the sessions differ so much that the mean is that of a mixture of specimens.
    session_groups : tuple of tuple of str
        Files of each group of sessions, by increasing value; empty without clear gaps.
    trend : Trend or None
        Change with time; None if there are too few sessions, or their times are unknown.
    has_significant_trend : bool
        Whether the change with time is significant.
    """

    quantity: str
    session_estimates: SessionEstimates
    mean: float
    between_session_std: float
    cochran_q: float
    p_value: float
    is_mixture: bool
    session_groups: tuple[tuple[str, ...], ...]
    trend: Trend | None = None
    has_significant_trend: bool = False

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of Cochran's Q: the number of sessions less one."""
        return len(self.session_estimates) - 1

    @property
    def relative_between_session_std(self) -> float:
        """Scatter between sessions, tau, divided by the standard deviation of a typical session."""
        return math.sqrt(max(self.cochran_q / self.degrees_of_freedom - 1, 0.0))

    @property
    def i_squared(self) -> float:
        """Fraction of the variance between sessions that their uncertainties do not explain."""
        return self.relative_between_session_std**2 / (1 + self.relative_between_session_std**2)

    @property
    def is_of_rig(self) -> bool:
        """Whether the quantity is a property of the rig and not of the specimen."""
        return self.quantity in _RIG_PARAMETERS


@dataclass(frozen=True, slots=True)
class Homogeneity:
    """Result of the test of whether the sessions of a campaign are of one specimen.

    Attributes
    ----------
    specimens : tuple of StatedSpecimen
        Different specimens stated in the files, the specimen of this campaign first.
    quantities : tuple of Heterogeneity
        Scatter of the modes, then of the parameters.
    structure : str or None
        Damping structure whose parameters are compared between sessions, as named in tables; None
        if there are no whole-record fits.
    is_one_session : bool
        Whether the sessions are blocks of one session, which cannot be of different specimens.
    """

    specimens: tuple[StatedSpecimen, ...]
    quantities: tuple[Heterogeneity, ...]
    structure: str | None = None
    is_one_session: bool = False

    @property
    def significance_level(self) -> float:
        """Significance level of a single quantity."""
        return _level_of_each(len(self.quantities))

    @property
    def leading_scatter(self) -> Heterogeneity | None:
        """Quantity that shows most clearly that the sessions differ; None if they do not differ.

        Modes take precedence over parameters.
        """
        mixed_scatters = [
            scatter for scatter in self.quantities if scatter.is_mixture and not scatter.is_of_rig
        ]
        mode_scatters = [
            scatter
            for scatter in mixed_scatters
            if scatter.quantity.startswith(tuple(_MODE_QUANTITIES))
        ]
        return max(
            mode_scatters or mixed_scatters,
            key=lambda scatter: scatter.relative_between_session_std,
            default=None,
        )

    @property
    def is_mixture(self) -> bool:
        """Whether the pooled values are means of a mixture of specimens."""
        return self.leading_scatter is not None

    @property
    def is_one_specimen(self) -> bool:
        """Whether neither the files nor the estimates contradict a single specimen."""
        return len(self.specimens) < _MIN_COMPARED_SESSIONS and not self.is_mixture

    def scatter_of(self, quantity: str) -> Heterogeneity | None:
        """Return the between-session scatter of a quantity, or None if it was not tested."""
        return next((scatter for scatter in self.quantities if scatter.quantity == quantity), None)

    def is_mixed(self, quantity: str) -> bool:
        """Return whether the pooled value of a quantity is the mean of a mixture."""
        scatter = self.scatter_of(quantity)
        return scatter is not None and scatter.is_mixture


def homogeneity(
    sessions: Sequence[SessionAnalysis],
    pooled_fits: Sequence[PooledEstimate],
    specimens: Sequence[StatedSpecimen],
) -> Homogeneity:
    """Test whether sessions are of one specimen by comparing their fits of one damping structure.

    The pooled estimates are in the order of rising BIC. `specimens` are the different specimens
    that the files state.
    """
    structure_name = common_structure(sessions)
    common_estimates = [
        (session.name, estimate)
        for session in sessions
        for estimate in session.record_estimates
        if estimate.name == structure_name
    ]
    modal_values = dict(_modal_values(sessions))
    values_by_quantity = modal_values or dict(_mode_values(common_estimates))
    freest_fit = freest_estimate(pooled_fits)
    if freest_fit is not None:
        values_by_quantity |= dict(_parameter_values(sessions, freest_fit))
    values_by_quantity = {
        quantity: quantity_values
        for quantity, quantity_values in values_by_quantity.items()
        if len(quantity_values) >= _MIN_COMPARED_SESSIONS
    }
    significance_level = _level_of_each(len(values_by_quantity))
    times_s = {session.name: session.experiment.middle_utc_s for session in sessions}
    return Homogeneity(
        tuple(specimens),
        tuple(
            _with_trend(
                _test_heterogeneity(quantity, quantity_values, significance_level),
                times_s,
                significance_level,
            )
            for quantity, quantity_values in values_by_quantity.items()
        ),
        structure_name,
        is_one_session=all(session.source.part_s is not None for session in sessions)
        and len({session.path for session in sessions}) == 1,
    )


def _level_of_each(quantity_count: int) -> float:
    """Return the significance level of each of several quantities (Bonferroni)."""
    return SIGNIFICANCE_LEVEL / max(quantity_count, 1)


def _modal_values(sessions: Sequence[SessionAnalysis]) -> Iterator[tuple[str, SessionEstimates]]:
    """Yield name and session values of each quantity of the modes that sessions show.

    They are of the modal model, which assumes no damping structure.
    """
    session_modes = [
        (session.name, mode_number, session.modal.mode(mode_number))
        for session in sessions
        if session.modal is not None
        for mode_number in session.modal.visible_mode_numbers
    ]
    for quantity, std in _MODE_QUANTITIES.items():
        for visible_number in sorted({mode_number for _, mode_number, _ in session_modes}):
            session_estimates = (
                (file_name, getattr(mode, quantity), getattr(mode, std))
                for file_name, mode_number, mode in session_modes
                if mode_number == visible_number
            )
            yield f"{quantity}_{visible_number}", _drop_unknown_std(session_estimates)


def _mode_values(
    estimates: Sequence[tuple[str, RecordEstimate]],
) -> Iterator[tuple[str, SessionEstimates]]:
    """Yield name and session values of each quantity of the modes that all sessions have.

    They are of a uniform beam, for sessions without a modal model.
    """
    mode_count = min((len(estimate.fit.modes) for _, estimate in estimates), default=0)
    for quantity, std in _MODE_QUANTITIES.items():
        for mode_index in range(mode_count):
            session_estimates = (
                (
                    file_name,
                    getattr(estimate.fit.modes[mode_index], quantity),
                    getattr(estimate.fit.modes[mode_index], std),
                )
                for file_name, estimate in estimates
            )
            yield f"{quantity}_{mode_index + 1}", _drop_unknown_std(session_estimates)


def _parameter_values(
    sessions: Sequence[SessionAnalysis], freest_fit: PooledEstimate
) -> Iterator[tuple[str, SessionEstimates]]:
    """Yield name and session values of each pooled parameter.

    Values that a session's own report does not give, or gives with a flag, are not compared.
    """
    for parameter in freest_fit.parameters:
        parameter_name = parameter.name
        session_estimates = (
            (
                session.name,
                estimate.fit.parameters[parameter_name],
                estimate.fit.std[parameter_name] or 0.0,
            )
            for session in sessions
            if _is_reported(session, freest_fit.name, parameter_name)
            for estimate in session.record_estimates
            if estimate.name == freest_fit.name and parameter_name in estimate.fit.determined
        )
        yield parameter_name, _drop_unknown_std(session_estimates)


def _is_reported(session: SessionAnalysis, structure_name: str, parameter_name: str) -> bool:
    """Return whether a session's own report gives a parameter of a structure without a flag.

    If an order is not identifiable, the other parameters of the structure depend on its value.
    """
    headline = session.headline
    if headline is None or headline["type"] != structure_name:
        return True
    if any(order["status"] == "not identifiable" for order in headline["orders"].values()):
        return False
    return not any(
        estimates["parameters"][parameter_name]["flag"]
        for estimates in (headline, headline["exact_geometry"])
        if estimates is not None and parameter_name in estimates["parameters"]
    )


def _drop_unknown_std(session_estimates: Iterator[tuple[str, float, float]]) -> SessionEstimates:
    """Return the entries whose standard deviation is finite and positive."""
    return tuple(entry for entry in session_estimates if math.isfinite(entry[2]) and entry[2] > 0)


def _test_heterogeneity(
    quantity: str, session_estimates: SessionEstimates, significance_level: float
) -> Heterogeneity:
    """Return the between-session scatter of a quantity, tested at a significance level."""
    estimates, std = np.array([entry[1:] for entry in session_estimates]).T
    is_logarithmic = quantity in LOGARITHMIC_PARAMETERS
    if is_logarithmic:
        estimates, std = np.log(estimates), std / estimates
    pooled_effects = random_effects(estimates[:, None], (std**2)[:, None, None])
    p_value = float(chi_square_p_value(pooled_effects.cochran_q[0], len(session_estimates) - 1))
    mean = math.exp(pooled_effects.mean[0]) if is_logarithmic else float(pooled_effects.mean[0])
    is_significant = p_value < significance_level
    session_groups = split_groups(estimates, std) if is_significant else ()
    q = float(pooled_effects.cochran_q[0])
    return Heterogeneity(
        quantity=quantity,
        session_estimates=session_estimates,
        mean=mean,
        between_session_std=float(pooled_effects.between_session_std[0])
        * (mean if is_logarithmic else 1.0),
        cochran_q=q,
        p_value=p_value,
        is_mixture=is_significant
        and (
            bool(session_groups) or q * (1 - _MIN_MIXTURE_I_SQUARED) >= len(session_estimates) - 1
        ),
        session_groups=tuple(
            tuple(session_estimates[session_index][0] for session_index in sorted(group))
            for group in session_groups
        ),
    )


def _with_trend(
    scatter: Heterogeneity, times_s: Mapping[str, float | None], significance_level: float
) -> Heterogeneity:
    """Return the scatter of a quantity with its change with time, tested at a level."""
    file_names, estimates, stds = zip(*scatter.session_estimates, strict=True)
    trend = linear_trend([times_s[file_name] for file_name in file_names], estimates, stds)
    return replace(
        scatter,
        trend=trend,
        has_significant_trend=trend is not None and trend.p_value < significance_level,
    )


def split_groups(
    estimates: NDArray[np.float64], std: NDArray[np.float64]
) -> tuple[tuple[int, ...], ...]:
    """Split estimates at clear gaps into groups of session indices, the lowest values first.

    The estimates of the sessions and their standard deviations have the shape (K,). There are at
    most half as many groups as sessions, rounded up, so that one group or more has two members. A
    gap is clear if it exceeds `_MIN_GROUP_GAP_STDS` times the standard deviation within the groups,
    or the standard deviation of a single session if this is larger. Without clear gaps, there are
    no groups.
    """
    sorted_indices = np.argsort(estimates)
    value_gaps = np.diff(estimates[sorted_indices])
    rms_session_std = math.sqrt(float(np.mean(std**2)))
    best_groups: tuple[tuple[int, ...], ...] = ()
    largest_relative_gap = _MIN_GROUP_GAP_STDS
    for group_count in range(2, (sorted_indices.size + 1) // 2 + 1):
        cut_indices = np.sort(np.argsort(value_gaps)[1 - group_count :]) + 1
        candidate_groups = np.split(sorted_indices, cut_indices)
        squared_deviations = sum(
            float(((estimates[group] - estimates[group].mean()) ** 2).sum())
            for group in candidate_groups
        )
        group_std = max(
            math.sqrt(squared_deviations / (sorted_indices.size - group_count)), rms_session_std
        )
        smallest_relative_gap = float(value_gaps[cut_indices - 1].min()) / group_std
        if smallest_relative_gap > largest_relative_gap:
            largest_relative_gap, best_groups = (
                smallest_relative_gap,
                tuple(tuple(group.tolist()) for group in candidate_groups),
            )
    return best_groups
