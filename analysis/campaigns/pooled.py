"""Whole-record estimates of all sessions pooled, type by type."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.random_effects import chance_of, random_effects, t_quantile_95
from analysis.structures import STRUCTURES
from analysis.whole_record import SETTINGS, Plant
from analysis.whole_record.plant import LOGARITHMIC
from rigd.beam import Beam

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.campaigns.session import RecordEstimate, SessionResult

_FEWEST: Final = 2


@dataclass(frozen=True, slots=True)
class PooledParameter:
    """One parameter over all sessions.

    Attributes
    ----------
    name : str
    value : float
        Of a positive parameter that is estimated by its logarithm: the geometric mean.
    std : float
        Of `value`.
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
        Where the parameter of one more session would lie with 95 % (J. P. T. Higgins et al.,
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

    @property
    def between_share(self) -> float:
        """Share of the estimates' variance that is between sessions (I²), 0 to 1."""
        return self.between_std**2 / (self.between_std**2 + self.within_std**2)


@dataclass(frozen=True, slots=True)
class PooledEstimate:
    """One structure over all sessions.

    Attributes
    ----------
    structure : str
        Name.
    plant : Plant
        Of the pooled parameters.
    parameters : tuple of PooledParameter
        Those that every session used determines.
    sessions : int
        Used: those that determine the structure's damping.
    misfit : float
        Median over the sessions of the whitened residual's mean square: 1 if the model leaves
        nothing but noise. Where it is far beyond 1 the structure is wrong, and its standard
        deviations mean little.
    bic : float
        Bayesian information criterion, summed over the sessions used; to be compared where these
        are the same.
    """

    structure: str
    plant: Plant
    parameters: tuple[PooledParameter, ...]
    sessions: int
    misfit: float
    bic: float


def pooled_estimates(sessions: Sequence[SessionResult]) -> tuple[PooledEstimate, ...]:
    """Pool every structure that two sessions or more determine."""
    by_structure: dict[str, list[RecordEstimate]] = {}
    for session in sessions:
        for estimate in session.record_estimates:
            by_structure.setdefault(estimate.structure, []).append(estimate)
    found = (pooled(estimates) for estimates in by_structure.values())
    return tuple(each for each in found if each is not None)


def best_estimate(estimates: Sequence[PooledEstimate]) -> PooledEstimate:
    """Return that of the lowest BIC, of those that most sessions determine."""
    most = max(each.sessions for each in estimates)
    return min((each for each in estimates if each.sessions == most), key=lambda each: each.bic)


def pooled(estimates: Sequence[RecordEstimate]) -> PooledEstimate | None:
    """Pool one structure; None if fewer than two sessions determine its damping.

    A setting of rig or specimen (the tool's inertia, mostly) that rests on its bound in some
    session has no place in the common covariance; the plant gets its plain mean.
    """
    free = STRUCTURES[estimates[0].structure].free
    used = [each for each in estimates if set(free) <= set(each.determined)]
    if len(used) < _FEWEST:
        return None
    names = [name for name in used[0].determined if all(name in e.determined for e in used)]
    values = np.array([[_coordinate(name, e.parameters[name]) for name in names] for e in used])
    covariances = np.array([_block(e, names) for e in used])
    effects = random_effects(values, covariances)
    std = np.sqrt(np.diag(effects.covariance))
    within = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0))
    t = t_quantile_95(len(used) - 1)
    chances = chance_of(effects.cochran_q, len(used))
    columns = (effects.mean, std, within, effects.between_std, chances)
    parameters = tuple(
        _parameter(name, t, *row)
        for name, row in zip(names, np.transpose(columns).tolist(), strict=True)
    )
    means = {name: float(np.mean([e.parameters[name] for e in used])) for name in SETTINGS}
    return PooledEstimate(
        structure=estimates[0].structure,
        plant=_plant(used[0], means | {each.name: each.value for each in parameters}),
        parameters=parameters,
        sessions=len(used),
        misfit=float(np.median([e.cost / e.degrees_of_freedom for e in used])),
        bic=sum(_bic(e) for e in used),
    )


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


def _bic(estimate: RecordEstimate) -> float:
    """Cost plus free parameters times the logarithm of the data's number.

    The cost is in units of the noise, so it is twice the negative log-likelihood.
    """
    free = len(estimate.determined) + len(estimate.at_bounds)
    return estimate.cost + free * math.log(estimate.degrees_of_freedom + free)


def _interval(name: str, mean: float, half: float) -> tuple[float, float]:
    if name in LOGARITHMIC:
        return math.exp(mean - half), math.exp(mean + half)
    return mean - half, mean + half


def _coordinate(name: str, value: float) -> float:
    return math.log(value) if name in LOGARITHMIC else value


def _block(estimate: RecordEstimate, names: Sequence[str]) -> NDArray[np.float64]:
    places = [estimate.determined.index(name) for name in names]
    return estimate.covariance[np.ix_(places, places)]


def _plant(like: RecordEstimate, values: dict[str, float]) -> Plant:
    stiffness = values["bending_stiffness_n_m2"]
    free = STRUCTURES[like.structure].free
    return Plant(
        beam=Beam(
            like.plant.beam.length_m, values["density_over_stiffness"] * stiffness, stiffness
        ),
        damping=STRUCTURES[like.structure].damping({name: values[name] for name in free}),
        delay_s=values["delay_s"],
        tool_inertia_kg_m2=values["tool_inertia_kg_m2"],
    )
