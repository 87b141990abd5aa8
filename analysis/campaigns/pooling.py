"""Pooled whole-record estimates of all sessions, by a random-effects model.

``y_k ~ N(mu, S_k + diag(tau²))``: S_k is the covariance that session k states for itself, tau the
scatter of each parameter between sessions, by the moments of DerSimonian and Laird [1]_. A full
matrix instead of ``diag(tau²)`` would have more numbers than a campaign has sessions: by maximum
likelihood, five sessions that do repeat then show two thirds of their own standard deviations as
scatter in each of eight parameters.

References
----------
.. [1] R. DerSimonian and N. Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 7
   (1986) 177-188.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify import LOGARITHMIC, SETTINGS, Plant, damping_size
from analysis.identify.headline import ReportedLossFactor, ReportedValue
from analysis.models import STRUCTURES
from analysis.statistics import chi_square_p_value, student_t_quantile
from rigd.beam import Beam, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._estimates import RecordEstimate
    from analysis.campaigns._session import SessionAnalysis
    from analysis.identify.headline import Damping
    from analysis.identify.profile_likelihood import Order


# Random effects


@dataclass(frozen=True, slots=True)
class RandomEffects:
    """Pooled estimate of k parameters over K sessions.

    Attributes
    ----------
    mean : ndarray, shape (k,)
    covariance : ndarray, shape (k, k)
        Covariance of the mean.
    between_std : ndarray, shape (k,)
        Scatter between sessions, tau; 0 where the sessions' own uncertainties explain all.
    cochran_q : ndarray, shape (k,)
        Squares of the deviations from the weighted mean over the sessions' variances, summed:
        about K − 1 without scatter between sessions.
    deviance : float
        ``-2 ln`` likelihood of the mean and tau, above that with a separate value for each
        session: ``sum_k ln|I + S_k⁻¹ diag(tau²)| + r_kᵀ (S_k + diag(tau²))⁻¹ r_k``. Of the tau by
        moments and of none, the one that is likelier: parameters that each session correlates
        closely do not scatter one by one, and a tau of a third of their standard deviations then
        makes forty sessions that repeat less likely by a factor of e⁶⁵.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    between_std: NDArray[np.float64]
    cochran_q: NDArray[np.float64]
    deviance: float


def random_effects(
    estimates: NDArray[np.float64], covariances: NDArray[np.float64]
) -> RandomEffects:
    """Pool estimates by the random-effects model.

    Parameters
    ----------
    estimates : ndarray, shape (K, k)
        Estimates of two sessions at least.
    covariances : ndarray, shape (K, k, k)
        Positive definite, of each estimate.
    """
    weight = 1 / np.diagonal(covariances, axis1=1, axis2=2)
    total = weight.sum(axis=0)
    q = (weight * (estimates - (weight * estimates).sum(axis=0) / total) ** 2).sum(axis=0)
    excess = q - (len(estimates) - 1)
    between = np.maximum(excess / (total - (weight**2).sum(axis=0) / total), 0.0)

    # In units of a typical standard deviation: parameters differ by orders of magnitude.
    unit = 1 / np.sqrt(weight.mean(axis=0))
    units = np.outer(unit, unit)
    origin = estimates.mean(axis=0)
    own, every = covariances / units, covariances / units + np.diag(between / unit**2)
    away = (estimates - origin) / unit
    shift, spread, squares = _combined(away, every)
    widening = float((np.linalg.slogdet(every)[1] - np.linalg.slogdet(own)[1]).sum())
    return RandomEffects(
        mean=origin + unit * shift,
        covariance=units * spread,
        between_std=np.sqrt(between),
        cochran_q=q,
        deviance=min(widening + squares, _combined(away, own)[2]),
    )


def _combined(
    values: NDArray[np.float64], covariances: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Weighted mean, its covariance, and the sum of squares of what values are off it."""
    precision = np.linalg.inv(covariances)
    spread = np.linalg.inv(precision.sum(axis=0))
    mean = spread @ np.einsum("kij,kj->i", precision, values)
    off = values - mean
    return mean, spread, float(np.einsum("ki,kij,kj->", off, precision, off))


# Modes


@dataclass(frozen=True, slots=True)
class PooledMode:
    """One mode over all sessions.

    Attributes
    ----------
    number : int
    frequency_hz, frequency_std_hz : float
        Mean over the sessions, and its standard deviation.
    frequency_between_std_hz : float
        Scatter between sessions beyond their own uncertainties.
    damping_ratio, damping_ratio_std, damping_ratio_between_std : float
        Likewise.
    source : str
        Model that it is of: "modal", or "beam".
    participation_kg_m2, participation_std_kg_m2 : float or None
        Inertia about the motor axis that takes part in it, of a mode of the modal model.
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


def pooled_modes(estimates: Sequence[RecordEstimate]) -> tuple[PooledMode, ...]:
    """Pool each mode that all sessions have, frequency and damping ratio each by itself."""
    found = []
    for modes in zip(*(each.modes for each in estimates), strict=False):
        frequency = _pooled([(mode.frequency_hz, mode.frequency_std_hz) for mode in modes])
        ratio = _pooled([(mode.damping_ratio, mode.damping_ratio_std) for mode in modes])
        if frequency is not None and ratio is not None:
            found.append(PooledMode(modes[0].number, *frequency, *ratio))
    return tuple(found)


def _pooled(estimates: Sequence[tuple[float, float]]) -> tuple[float, float, float] | None:
    """Mean, its standard deviation and the scatter between sessions; None if one has no std."""
    values, std = np.array(estimates).T
    if not (np.isfinite(std).all() and (std > 0).all()):
        return None
    effects = random_effects(values[:, None], (std**2)[:, None, None])
    mean, variance, between = effects.mean[0], effects.covariance[0, 0], effects.between_std[0]
    return float(mean), math.sqrt(variance), float(between)


# Structures

_FEWEST: Final = 2
_DAMPINGS: Final[tuple[tuple[Damping, str, Order], ...]] = (
    ("internal", "zeta", "alpha"),
    ("external", "gamma", "lambda"),
)


@dataclass(frozen=True, slots=True)
class PooledParameter:
    """One parameter over all sessions.

    Attributes
    ----------
    name : str
    value : float
        Mean; of a positive parameter that is estimated by its logarithm the geometric mean.
    std : float
        Standard deviation of `value`.
    interval : (float, float)
        95 % confidence interval of the value, by Student's t with K − 1 degrees of freedom.
    within_std : float
        What a typical session states as its own standard deviation (root mean square).
    between_std : float
        Scatter between sessions beyond that; 0 if that explains all.
    chance : float
        Probability that sessions without any such scatter differ as much as these (W. G. Cochran,
        Biometrics 10 (1954) 101-129), each parameter by itself.
    next_interval : (float, float)
        95 % prediction interval for one more session (J. P. T. Higgins et al.,
        J. R. Stat. Soc. A 172 (2009) 137-159), whatever the noise of its own estimate.
    """

    name: str
    value: float
    std: float
    interval: tuple[float, float]
    within_std: float
    between_std: float
    chance: float
    next_interval: tuple[float, float]


@dataclass(frozen=True, slots=True)
class PooledEstimate:
    """One structure over all sessions.

    Attributes
    ----------
    structure : str
        Name.
    plant : Plant
        Plant of the pooled parameters.
    parameters : tuple of PooledParameter
        Those that every session used determines.
    covariance : ndarray, shape (k, k)
        Covariance of these, positive ones as logarithms.
    modes : tuple of PooledMode
    sessions : int
        Used: those that determine the structure's damping.
    misfit : float
        Median over the sessions of the whitened residual's mean square: 1 if the model leaves
        nothing but noise. Where it is far beyond 1 the structure is wrong, and its standard
        deviations mean little.
    bic : float
        Criterion of all sessions together, see `pooled_bic`.
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
        """As tables call it."""
        return self.structure

    @property
    def sizes(self) -> tuple[ReportedLossFactor, ...]:
        """Sizes of the dampings that all sessions together determine."""
        names = tuple(each.name for each in self.parameters)
        t, found = student_t_quantile(0.95, self.sessions - 1), []
        values = self.plant.parameters
        first = float(undamped_frequencies_rad_s(self.plant.beam, 1)[0])
        for damping, coefficient, order in _DAMPINGS:
            size = damping_size(coefficient, order, values, names, self.covariance, first)
            if size is not None:
                factor = math.exp(t * size.std / size.value)
                ends = size.value / factor, size.value * factor
                quantity = ReportedValue(size.value, size.std, ends)
                found.append(ReportedLossFactor(damping, size.omega_rad_s, quantity))
        return tuple(found)

    @property
    def by_name(self) -> dict[str, PooledParameter]:
        """Parameters by name."""
        return {each.name: each for each in self.parameters}


def pooled_estimates(sessions: Sequence[SessionAnalysis]) -> tuple[PooledEstimate, ...]:
    """Pool every structure that all sessions tried and two or more determine; lowest BIC first."""
    by_name = by_structure(sessions)
    tried = max(map(len, by_name.values()), default=0)
    found = [pooled(estimates) for estimates in by_name.values() if len(estimates) == tried]
    return tuple(sorted((each for each in found if each is not None), key=lambda each: each.bic))


def by_structure(sessions: Sequence[SessionAnalysis]) -> dict[str, list[RecordEstimate]]:
    """Whole-record estimates of all sessions by the name of the structure."""
    found: dict[str, list[RecordEstimate]] = {}
    for session in sessions:
        for estimate in session.record_estimates:
            found.setdefault(estimate.name, []).append(estimate)
    return found


def determines_damping(estimate: RecordEstimate) -> bool:
    """Whether a session determines its structure's damping, and the modes' offsets if free."""
    return set(STRUCTURES[estimate.structure].free) <= set(estimate.determined)


def pooled(estimates: Sequence[RecordEstimate]) -> PooledEstimate | None:
    """Pool one structure; None if fewer than two sessions determine its damping.

    A setting of rig or specimen (mostly the tool inertia) that is at a bound in some session is not
    in the common covariance; the plant gets its plain mean.
    """
    used = list(filter(determines_damping, estimates))
    if len(used) < _FEWEST:
        return None
    names = [name for name in used[0].determined if all(name in e.determined for e in used)]
    values, covariances = _stacked(used, names)
    effects = random_effects(values, covariances)
    std = np.sqrt(np.diag(effects.covariance))
    within = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0))
    t = student_t_quantile(0.95, len(used) - 1)
    chances = chi_square_p_value(effects.cochran_q, len(used) - 1)
    columns = (effects.mean, std, within, effects.between_std, chances)
    parameters = tuple(
        _parameter(name, t, *row)
        for name, row in zip(names, np.transpose(columns).tolist(), strict=True)
    )
    means = {name: float(np.mean([e.parameters[name] for e in used])) for name in SETTINGS}
    return PooledEstimate(
        structure=used[0].structure,
        plant=_plant(used[0], means | {each.name: each.value for each in parameters}),
        parameters=parameters,
        covariance=effects.covariance,
        modes=pooled_modes(used),
        sessions=len(used),
        misfit=float(np.median([e.cost / e.degrees_of_freedom for e in used])),
        bic=pooled_bic(estimates),
    )


def pooled_bic(estimates: Sequence[RecordEstimate]) -> float:
    """Bayesian information criterion of one structure for all sessions together.

    Damping and offsets of the modes belong to the specimen: one value for all sessions, and a
    scatter between them if they differ by more than their uncertainties; each costs the logarithm
    of the number of all data. The likelihood lost by a common value follows from the sessions'
    estimates and covariances (the likelihood is taken to be normal about each). Settings of rig and
    beam are each session's own, with every structure alike, and so cost nothing here. A parameter
    that some session leaves undetermined cannot be common: it counts in every session. A single
    session loses nothing.
    """
    of_specimen = STRUCTURES[estimates[0].structure].free
    shared = [name for name in of_specimen if all(name in e.determined for e in estimates)]
    deviance = sum(e.deviance for e in estimates)
    if shared and len(estimates) >= _FEWEST:
        deviance += random_effects(*_stacked(estimates, shared)).deviance
    each_its_own = (len(of_specimen) - len(shared)) * sum(math.log(e.values) for e in estimates)
    return deviance + len(shared) * math.log(sum(e.values for e in estimates)) + each_its_own


def _stacked(
    estimates: Sequence[RecordEstimate], names: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Estimates, shape (K, k), and their covariances, (K, k, k)."""
    values = [[_coordinate(name, e.parameters[name]) for name in names] for e in estimates]
    return np.array(values), np.array([_block(e, names) for e in estimates])


def _parameter(
    name: str, t: float, mean: float, std: float, within: float, between: float, chance: float
) -> PooledParameter:
    value = math.exp(mean) if name in LOGARITHMIC else mean
    unit = value if name in LOGARITHMIC else 1.0
    return PooledParameter(
        name=name,
        value=value,
        std=unit * std,
        interval=_interval(name, mean, t * std),
        within_std=unit * within,
        between_std=unit * between,
        chance=chance,
        next_interval=_interval(name, mean, t * math.hypot(std, between)),
    )


def _interval(name: str, mean: float, half: float) -> tuple[float, float]:
    if name in LOGARITHMIC:
        return math.exp(mean - half), math.exp(mean + half)
    return mean - half, mean + half


def _coordinate(name: str, value: float) -> float:
    return math.log(value) if name in LOGARITHMIC else value


def _block(estimate: RecordEstimate, names: Sequence[str]) -> NDArray[np.float64]:
    indices = [estimate.determined.index(name) for name in names]
    return estimate.covariance[np.ix_(indices, indices)]


def _plant(like: RecordEstimate, values: dict[str, float]) -> Plant:
    stiffness = values["bending_stiffness_n_m2"]
    free = STRUCTURES[like.structure].free
    return replace(
        like.plant,
        beam=Beam(
            like.plant.beam.length_m, values["density_over_stiffness"] * stiffness, stiffness
        ),
        damping=STRUCTURES[like.structure].damping({name: values[name] for name in free}),
        delay_s=values["delay_s"],
        tool_inertia_kg_m2=values["tool_inertia_kg_m2"],
    )
