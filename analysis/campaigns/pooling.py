"""Pooled whole-record estimates of all sessions, by a random-effects model.

The estimates y_k of session k follow ``y_k ~ N(mu, S_k + diag(tau²))``. S_k is the covariance that
session k states for its estimates. tau is the scatter of each parameter between sessions, estimated
by the method of moments of DerSimonian and Laird [1]_. A full matrix instead of ``diag(tau²)``
would have more elements than a campaign has sessions; estimated by maximum likelihood, it would
show a scatter of two thirds of the standard deviation in each of eight parameters for five sessions
without any scatter.

References
----------
.. [1] R. DerSimonian and N. Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 7
   (1986) 177-188.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify import SETTINGS, pivot_loss_factor
from analysis.identify.headline import ReportedLossFactor
from analysis.models import STRUCTURES
from analysis.statistics import chi_square_p_value, student_t_quantile
from rigd.beam import LOGARITHMIC_PARAMETERS, Plant, undamped_frequencies_rad_s
from rigd.estimates import Estimate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._estimates import RecordEstimate
    from analysis.campaigns._session import SessionAnalysis
    from analysis.identify.headline import Damping
    from analysis.identify.profile_likelihood import OrderName


# Random effects


@dataclass(frozen=True, slots=True)
class RandomEffects:
    """Mean of k parameters over K sessions by the random-effects model, and its statistics.

    Attributes
    ----------
    mean : ndarray, shape (k,)
    covariance : ndarray, shape (k, k)
        Covariance of the mean.
    between_session_std : ndarray, shape (k,)
        Standard deviation of each parameter between sessions, tau; 0 where the sessions' own
        uncertainties explain the whole scatter.
    cochran_q : ndarray, shape (k,)
        Sum over the sessions of the squared deviation from the weighted mean, divided by the
        session's variance: about K − 1 without scatter between sessions.
    deviance : float
        ``-2 ln`` likelihood of the mean and tau, less that of a separate value for each session:
        ``sum_k ln|I + S_k⁻¹ diag(tau²)| + r_kᵀ (S_k + diag(tau²))⁻¹ r_k``. It is evaluated with
        the tau estimated by moments and with a tau of 0, and the lower value is taken: closely
        correlated parameters do not scatter independently, so that a tau of a third of their
        standard deviations makes forty sessions without scatter less likely by a factor of e⁶⁵.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    between_session_std: NDArray[np.float64]
    cochran_q: NDArray[np.float64]
    deviance: float


def random_effects(
    estimates: NDArray[np.float64], covariances: NDArray[np.float64]
) -> RandomEffects:
    """Pool the sessions' estimates of k parameters by the random-effects model.

    Parameters
    ----------
    estimates : ndarray, shape (K, k)
        Estimates of at least two sessions.
    covariances : ndarray, shape (K, k, k)
        Positive definite covariance of each session's estimates.
    """
    weights = 1 / np.diagonal(covariances, axis1=1, axis2=2)
    weight_sum = weights.sum(axis=0)
    q = (weights * (estimates - (weights * estimates).sum(axis=0) / weight_sum) ** 2).sum(axis=0)
    excess_q = q - (len(estimates) - 1)
    between_variance = np.maximum(
        excess_q / (weight_sum - (weights**2).sum(axis=0) / weight_sum), 0.0
    )

    # Values are in units of a typical standard deviation, as parameters differ by orders of
    # magnitude.
    typical_stds = 1 / np.sqrt(weights.mean(axis=0))
    std_products = np.outer(typical_stds, typical_stds)
    mean_estimate = estimates.mean(axis=0)
    own_covariances, total_covariances = (
        covariances / std_products,
        covariances / std_products + np.diag(between_variance / typical_stds**2),
    )
    deviations = (estimates - mean_estimate) / typical_stds
    mean_shift, mean_covariance, squared_deviations = _weighted_mean(deviations, total_covariances)
    log_determinants = float(
        (np.linalg.slogdet(total_covariances)[1] - np.linalg.slogdet(own_covariances)[1]).sum()
    )
    return RandomEffects(
        mean=mean_estimate + typical_stds * mean_shift,
        covariance=std_products * mean_covariance,
        between_session_std=np.sqrt(between_variance),
        cochran_q=q,
        deviance=min(
            log_determinants + squared_deviations, _weighted_mean(deviations, own_covariances)[2]
        ),
    )


def _weighted_mean(
    estimates: NDArray[np.float64], covariances: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the mean weighted by inverse covariances, its covariance, and a sum of squares.

    The sum of squares is that of the deviations from the mean, weighted in the same way.
    """
    precisions = np.linalg.inv(covariances)
    mean_covariance = np.linalg.inv(precisions.sum(axis=0))
    weighted_mean = mean_covariance @ np.einsum("kij,kj->i", precisions, estimates)
    deviations = estimates - weighted_mean
    return (
        weighted_mean,
        mean_covariance,
        float(np.einsum("ki,kij,kj->", deviations, precisions, deviations)),
    )


# Modes


@dataclass(frozen=True, slots=True)
class PooledMode:
    """Frequency and damping ratio of one mode, pooled over all sessions.

    Attributes
    ----------
    number : int
        Number of the mode, from 1.
    frequency_hz, frequency_std_hz : float
        Mean frequency over the sessions, and the standard deviation of this mean.
    frequency_between_std_hz : float
        Scatter of the frequency between sessions beyond their own uncertainties.
    damping_ratio, damping_ratio_std, damping_ratio_between_std : float
        The same three values for the damping ratio.
    source : str
        Model from which the mode is estimated: "modal" model, or uniform "beam".
    participation_kg_m2, participation_std_kg_m2 : float or None
        Inertia about the motor axis that takes part in the mode, and its standard deviation; None
        for a mode of a uniform beam.
    """

    number: int
    frequency_hz: float
    frequency_std_hz: float
    frequency_between_std_hz: float
    damping_ratio: float
    damping_ratio_std: float
    damping_ratio_between_std: float
    source: Literal["modal", "beam"] = "beam"
    participation_kg_m2: float | None = None
    participation_std_kg_m2: float | None = None


def pool_modes(estimates: Sequence[RecordEstimate]) -> tuple[PooledMode, ...]:
    """Pool the frequency and, separately, the damping ratio of each mode that all sessions have."""
    pooled_modes = []
    for session_modes in zip(*(estimate.fit.modes for estimate in estimates), strict=False):
        pooled_frequency = _pool_quantity(
            [(mode.frequency_hz, mode.frequency_std_hz) for mode in session_modes]
        )
        pooled_ratio = _pool_quantity(
            [(mode.damping_ratio, mode.damping_ratio_std) for mode in session_modes]
        )
        if pooled_frequency is not None and pooled_ratio is not None:
            pooled_modes.append(
                PooledMode(session_modes[0].number, *pooled_frequency, *pooled_ratio)
            )
    return tuple(pooled_modes)


def _pool_quantity(estimates: Sequence[tuple[float, float]]) -> tuple[float, float, float] | None:
    """Return the mean of a quantity, the mean's standard deviation, and the scatter of sessions.

    Return None if a session has no standard deviation.
    """
    session_values, std = np.array(estimates).T
    if not (np.isfinite(std).all() and (std > 0).all()):
        return None
    pooled_effects = random_effects(session_values[:, None], (std**2)[:, None, None])
    pooled_mean, mean_variance, between_std = (
        pooled_effects.mean[0],
        pooled_effects.covariance[0, 0],
        pooled_effects.between_session_std[0],
    )
    return float(pooled_mean), math.sqrt(mean_variance), float(between_std)


# Structures

_MIN_POOLED_SESSIONS: Final = 2
"""Smallest number of sessions that can be pooled."""
_DAMPING_PARAMETERS: Final[tuple[tuple[Damping, str, OrderName], ...]] = (
    ("internal", "zeta", "alpha"),
    ("external", "gamma", "lambda"),
)
"""Name, coefficient and order of each kind of damping."""


@dataclass(frozen=True, slots=True)
class PooledParameter:
    """One parameter, pooled over all sessions.

    Attributes
    ----------
    name : str
        Name of the parameter, such as "zeta".
    value : float
        Mean over the sessions; the geometric mean if the parameter's logarithm is estimated.
    std : float
        Standard deviation of `value`.
    interval : (float, float)
        95 % confidence interval of the value, by Student's t with K − 1 degrees of freedom.
    within_session_std : float
        Root mean square of the standard deviations that the sessions state for their estimates.
    between_session_std : float
        Scatter between sessions beyond `within_session_std`; 0 if `within_session_std` explains all
        of it.
    heterogeneity_p_value : float
        p-value of the scatter between sessions, for this parameter by itself (W. G. Cochran,
        Biometrics 10 (1954) 101-129).
    next_session_interval : (float, float)
        95 % prediction interval for the true value in one more session (J. P. T. Higgins et al.,
        J. R. Stat. Soc. A 172 (2009) 137-159), without the noise of that session's estimate.
    """

    name: str
    value: float
    std: float
    interval: tuple[float, float]
    within_session_std: float
    between_session_std: float
    heterogeneity_p_value: float
    next_session_interval: tuple[float, float]


@dataclass(frozen=True, slots=True)
class PooledEstimate:
    """Parameters and modes of one damping structure, pooled over all sessions.

    Attributes
    ----------
    structure : str
        Name of the structure, "I" to "VII".
    plant : Plant
        Plant with the pooled parameters.
    parameters : tuple of PooledParameter
        The k parameters that every session used determines.
    covariance : ndarray, shape (k, k)
        Covariance of these parameters; of the logarithm of a positive one.
    modes : tuple of PooledMode
        Pooled modes, the lowest first.
    sessions : int
        Number of sessions used: those that determine the structure's damping.
    misfit : float
        Median over the sessions of the whitened residual's mean square: 1 if the residual is only
        noise. Far beyond 1 the structure is wrong, and its standard deviations mean little.
    bic : float
        Bayesian information criterion of all sessions together, see `pooled_bic`.
    """

    structure: str
    plant: Plant
    parameters: tuple[PooledParameter, ...]
    covariance: NDArray[np.float64]
    modes: tuple[PooledMode, ...]
    sessions: int
    misfit: float
    bic: float

    @property
    def name(self) -> str:
        """Name of the damping structure as shown in tables."""
        return self.structure

    @property
    def sizes(self) -> tuple[ReportedLossFactor, ...]:
        """Loss factors of the kinds of damping that all sessions together determine."""
        parameter_names = tuple(parameter.name for parameter in self.parameters)
        t, loss_factors = student_t_quantile(0.95, self.sessions - 1), []
        plant_values = self.plant.parameters
        first_frequency_rad_s = float(undamped_frequencies_rad_s(self.plant.beam, 1)[0])
        for damping, coefficient, order in _DAMPING_PARAMETERS:
            loss_factor = pivot_loss_factor(
                coefficient,
                order,
                plant_values,
                parameter_names,
                self.covariance,
                first_frequency_rad_s,
            )
            if loss_factor is not None:
                interval_factor = math.exp(t * loss_factor.std / loss_factor.value)
                interval = loss_factor.value / interval_factor, loss_factor.value * interval_factor
                estimate = Estimate(loss_factor.value, loss_factor.std, interval)
                loss_factors.append(ReportedLossFactor(damping, loss_factor.omega_rad_s, estimate))
        return tuple(loss_factors)

    @property
    def parameters_by_name(self) -> dict[str, PooledParameter]:
        """Pooled parameters by their names."""
        return {parameter.name: parameter for parameter in self.parameters}


def pooled_estimates(sessions: Sequence[SessionAnalysis]) -> tuple[PooledEstimate, ...]:
    """Pool the estimates of each damping structure fitted to all sessions.

    A structure is left out if fewer than two sessions determine its damping.

    The estimates are sorted by BIC, the lowest first.
    """
    estimates_by_name = estimates_by_structure(sessions)
    fitted_session_count = max(map(len, estimates_by_name.values()), default=0)
    all_pooled_estimates = [
        pool_estimates(estimates)
        for estimates in estimates_by_name.values()
        if len(estimates) == fitted_session_count
    ]
    return tuple(
        sorted(
            (estimate for estimate in all_pooled_estimates if estimate is not None),
            key=lambda estimate: estimate.bic,
        )
    )


def estimates_by_structure(sessions: Sequence[SessionAnalysis]) -> dict[str, list[RecordEstimate]]:
    """Return the whole-record estimates of all sessions by the name of the damping structure."""
    estimates_by_name: dict[str, list[RecordEstimate]] = {}
    for session in sessions:
        for estimate in session.record_estimates:
            estimates_by_name.setdefault(estimate.name, []).append(estimate)
    return estimates_by_name


def determines_damping(estimate: RecordEstimate) -> bool:
    """Return whether an estimate determines all free parameters of its damping structure."""
    return set(estimate.fit.structure.free) <= set(estimate.fit.determined)


def pool_estimates(estimates: Sequence[RecordEstimate]) -> PooledEstimate | None:
    """Pool estimates of one damping structure; None if fewer than two determine its damping.

    A parameter of rig or specimen (mostly the tool inertia) that is at a bound in some session is
    not in the common covariance. The pooled plant has the unweighted mean of such a parameter.
    """
    used_estimates = list(filter(determines_damping, estimates))
    if len(used_estimates) < _MIN_POOLED_SESSIONS:
        return None
    common_parameters = [
        parameter_name
        for parameter_name in used_estimates[0].fit.determined
        if all(parameter_name in e.fit.determined for e in used_estimates)
    ]
    parameter_values, covariances = _stack_estimates(used_estimates, common_parameters)
    pooled_effects = random_effects(parameter_values, covariances)
    std = np.sqrt(np.diag(pooled_effects.covariance))
    within_session_std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0))
    t = student_t_quantile(0.95, len(used_estimates) - 1)
    p_values = chi_square_p_value(pooled_effects.cochran_q, len(used_estimates) - 1)
    pooled_statistics = (
        pooled_effects.mean,
        std,
        within_session_std,
        pooled_effects.between_session_std,
        p_values,
    )
    parameters = tuple(
        _pooled_parameter(parameter_name, t, *statistics)
        for parameter_name, statistics in zip(
            common_parameters, np.transpose(pooled_statistics).tolist(), strict=True
        )
    )
    mean_settings = {
        parameter_name: float(np.mean([e.fit.parameters[parameter_name] for e in used_estimates]))
        for parameter_name in SETTINGS
    }
    return PooledEstimate(
        structure=used_estimates[0].name,
        plant=_pooled_plant(
            used_estimates[0],
            mean_settings | {parameter.name: parameter.value for parameter in parameters},
        ),
        parameters=parameters,
        covariance=pooled_effects.covariance,
        modes=pool_modes(used_estimates),
        sessions=len(used_estimates),
        misfit=float(np.median([e.fit.cost / e.fit.degrees_of_freedom for e in used_estimates])),
        bic=pooled_bic(estimates),
    )


def pooled_bic(estimates: Sequence[RecordEstimate]) -> float:
    """Return the Bayesian information criterion of a damping structure for all sessions.

    Damping parameters belong to the specimen. Each has one common value, with a scatter between the
    sessions if these differ by more than their uncertainties, and costs the logarithm of the number
    of values in all sessions. The likelihood lost by a common value follows from the sessions'
    estimates and covariances, because the likelihood is taken to be normal about each estimate.
    Parameters of rig and beam are estimated in each session with every structure, so they are left
    out here. A parameter that some session does not determine cannot be common, and counts once for
    each session. A single session loses no likelihood.
    """
    damping_parameters = estimates[0].fit.structure.free
    common_parameters = [
        parameter_name
        for parameter_name in damping_parameters
        if all(parameter_name in e.fit.determined for e in estimates)
    ]
    common_deviance = sum(e.deviance for e in estimates)
    if common_parameters and len(estimates) >= _MIN_POOLED_SESSIONS:
        common_deviance += random_effects(*_stack_estimates(estimates, common_parameters)).deviance
    separate_parameter_penalty = (len(damping_parameters) - len(common_parameters)) * sum(
        math.log(e.compared_values) for e in estimates
    )
    return (
        common_deviance
        + len(common_parameters) * math.log(sum(e.compared_values for e in estimates))
        + separate_parameter_penalty
    )


def _stack_estimates(
    estimates: Sequence[RecordEstimate], parameter_names: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the estimates, shape (K, k), and their covariances, shape (K, k, k)."""
    coordinates = [
        [
            _parameter_coordinate(parameter_name, e.fit.parameters[parameter_name])
            for parameter_name in parameter_names
        ]
        for e in estimates
    ]
    return np.array(coordinates), np.array(
        [_covariance_block(e, parameter_names) for e in estimates]
    )


def _pooled_parameter(
    parameter_name: str,
    t_quantile: float,
    mean: float,
    std: float,
    within_session_std: float,
    between_session_std: float,
    p_value: float,
) -> PooledParameter:
    """Return a pooled parameter from the statistics of its value or of its logarithm."""
    pooled_value = math.exp(mean) if parameter_name in LOGARITHMIC_PARAMETERS else mean
    std_factor = pooled_value if parameter_name in LOGARITHMIC_PARAMETERS else 1.0
    return PooledParameter(
        name=parameter_name,
        value=pooled_value,
        std=std_factor * std,
        interval=_parameter_interval(parameter_name, mean, t_quantile * std),
        within_session_std=std_factor * within_session_std,
        between_session_std=std_factor * between_session_std,
        heterogeneity_p_value=p_value,
        next_session_interval=_parameter_interval(
            parameter_name, mean, t_quantile * math.hypot(std, between_session_std)
        ),
    )


def _parameter_interval(parameter_name: str, mean: float, half_width: float) -> tuple[float, float]:
    """Return an interval of a parameter from the mean and half width of its coordinate.

    The coordinate is the parameter or its logarithm (see `_parameter_coordinate`).
    """
    if parameter_name in LOGARITHMIC_PARAMETERS:
        return math.exp(mean - half_width), math.exp(mean + half_width)
    return mean - half_width, mean + half_width


def _parameter_coordinate(parameter_name: str, parameter_value: float) -> float:
    """Return the value of a parameter, or its logarithm if the logarithm is estimated."""
    return (
        math.log(parameter_value) if parameter_name in LOGARITHMIC_PARAMETERS else parameter_value
    )


def _covariance_block(
    estimate: RecordEstimate, parameter_names: Sequence[str]
) -> NDArray[np.float64]:
    """Return the covariance of some parameters of an estimate."""
    parameter_indices = [
        estimate.fit.determined.index(parameter_name) for parameter_name in parameter_names
    ]
    return estimate.fit.covariance[np.ix_(parameter_indices, parameter_indices)]


def _pooled_plant(estimate: RecordEstimate, parameter_values: dict[str, float]) -> Plant:
    """Return a plant with given parameters and all other properties of a session's plant."""
    structure = estimate.fit.structure
    plant_parameters: dict[str, float] = dict(structure.fixed.items())
    plant_parameters |= {name: parameter_values[name] for name in (*structure.free, *SETTINGS)}
    return estimate.fit.plant.with_parameters(plant_parameters)


# Freest structure that all sessions support
#
# All sessions are compared and pooled by it. The structure that a session selects by itself depends
# on its noise. If each session were compared by that one, the sessions would differ by the
# difference between structures, and forty sessions of one beam would seem to be of two beams. The
# intervals of the freest structure are valid for any simpler structure, too.

_MIN_DETERMINING_FRACTION: Final = 0.9
"""Smallest number of sessions that must determine the reported structure, as a fraction of those
that determine the structure of the lowest BIC."""


def freest_estimate(pooled_estimates: Sequence[PooledEstimate]) -> PooledEstimate | None:
    """Return the estimate of the freest damping structure that at least 90 % of sessions determine.

    The freest structure has the largest number of free parameters. The 90 %
    (`_MIN_DETERMINING_FRACTION`) are of the sessions that determine the structure of the lowest
    BIC.

    Parameters
    ----------
    pooled_estimates : sequence of PooledEstimate
        Pooled estimates, the lowest BIC first; None is returned if there are none.
    """
    if not pooled_estimates:
        return None
    lowest_bic_estimate = pooled_estimates[0]
    return max(
        (
            estimate
            for estimate in pooled_estimates
            if estimate.sessions >= _MIN_DETERMINING_FRACTION * lowest_bic_estimate.sessions
        ),
        key=lambda estimate: len(STRUCTURES[estimate.structure].free),
    )


def common_structure(sessions: Sequence[SessionAnalysis]) -> str | None:
    """Return the name of the damping structure by which all sessions are compared.

    Parameters
    ----------
    sessions : sequence of SessionAnalysis
        Sessions of the campaign.

    Returns
    -------
    str or None
        The freest structure that was fitted to every session. None without whole-record fits.
    """
    estimates_by_name = estimates_by_structure(sessions)
    fitted_session_count = max(map(len, estimates_by_name.values()), default=0)
    structure_estimates = [
        estimates[0]
        for estimates in estimates_by_name.values()
        if len(estimates) == fitted_session_count
    ]
    return max(structure_estimates, key=_free_parameter_count).name if structure_estimates else None


def _free_parameter_count(estimate: RecordEstimate) -> int:
    """Return the number of free parameters of an estimate's damping structure."""
    return len(estimate.fit.structure.free)
