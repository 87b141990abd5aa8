"""Bias of the Welch fits: their means over the sessions less the pooled whole-record estimates.

Windows and leakage shift the parameters of a fit to Welch's response by the same amount in every
session. The scatter between sessions does not show this shift, and more sessions do not reduce it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns._statistics import fits_by_model
from analysis.models import STRUCTURES
from analysis.statistics import student_t_quantile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate

MAX_REFERENCE_MISFIT: Final = 1.5
"""Largest misfit (residual power relative to the noise) of a structure that describes the
records."""

_CONFIDENCE_LEVEL: Final = 0.999
"""Confidence level at which a bias is significant."""
_MIN_WELCH_SESSIONS: Final = 2
"""Smallest number of sessions with Welch fits for which a bias is estimated."""


@dataclass(frozen=True, slots=True)
class ParameterBias:
    """Difference of a parameter's Welch fits from its pooled whole-record estimate.

    Attributes
    ----------
    parameter : str
        Name of the parameter.
    welch_mean, welch_std : float
        Mean of the Welch fits, and their standard deviation between sessions.
    record_estimate, record_std : float
        Pooled whole-record estimate, and its standard deviation.
    bias : float
        `welch_mean` minus `record_estimate`.
    bias_std : float
        Standard deviation of `bias`.
    is_significant : bool
        Whether `bias` differs from zero at the level of 0.1 % (Student's t).
    at_bounds : int
        Number of sessions whose Welch fit has the parameter at a bound of the range searched.
    """

    parameter: str
    welch_mean: float
    welch_std: float
    record_estimate: float
    record_std: float
    bias: float
    bias_std: float
    is_significant: bool
    at_bounds: int


@dataclass(frozen=True, slots=True)
class WelchBias:
    """Bias of the Welch fits of one damping structure and weighting.

    Attributes
    ----------
    structure, weighting : str
        Names of damping structure and weighting.
    parameters : tuple of ParameterBias
        Biases of the free parameters.
    wmse : float
        Mean over the sessions of the weighted mean square error of the Welch fits, in (N·m/rad)².
    record_wmse : float
        The same error of the whole-record fits. Both are relative to Welch's response, which has
        the same bias as the Welch fits.
    """

    structure: str
    weighting: str
    parameters: tuple[ParameterBias, ...]
    wmse: float
    record_wmse: float

    @property
    def significant_parameters(self) -> tuple[ParameterBias, ...]:
        """Parameters whose bias is significant."""
        return tuple(parameter for parameter in self.parameters if parameter.is_significant)


def welch_biases(
    sessions: Sequence[SessionAnalysis], pooled: Sequence[PooledEstimate]
) -> tuple[WelchBias, ...]:
    """Compare the Welch fits with the pooled estimates that describe the records.

    The pooled estimates serve as references. The biases are in the order of damping structure, then
    of weighting. A structure with a misfit above `MAX_REFERENCE_MISFIT` is left out, because its
    pooled estimate is no reference.
    """
    biases = []
    pooled_by_name = {
        pooled_estimate.name: pooled_estimate
        for pooled_estimate in pooled
        if pooled_estimate.misfit <= MAX_REFERENCE_MISFIT
    }
    for (structure, weighting), welch_models in fits_by_model(sessions).items():
        pooled_estimate = pooled_by_name.get(structure)
        if pooled_estimate is None or len(welch_models) < _MIN_WELCH_SESSIONS:
            continue
        significance_limit = student_t_quantile(_CONFIDENCE_LEVEL, len(welch_models) - 1)
        parameter_biases = []
        for parameter_name in STRUCTURES[structure].free:
            if parameter_name not in pooled_estimate.parameters_by_name:
                continue
            pooled_parameter = pooled_estimate.parameters_by_name[parameter_name]
            welch_values = np.array(
                [model.fit.parameters[parameter_name] for model in welch_models]
            )
            welch_mean, std = float(welch_values.mean()), float(welch_values.std(ddof=1))
            bias, bias_std = (
                welch_mean - pooled_parameter.value,
                math.hypot(std / len(welch_models) ** 0.5, pooled_parameter.std),
            )
            parameter_biases.append(
                ParameterBias(
                    parameter=parameter_name,
                    welch_mean=welch_mean,
                    welch_std=std,
                    record_estimate=pooled_parameter.value,
                    record_std=pooled_parameter.std,
                    bias=bias,
                    bias_std=bias_std,
                    is_significant=abs(bias) > significance_limit * bias_std,
                    at_bounds=sum(parameter_name in model.fit.at_bounds for model in welch_models),
                )
            )
        biases.append(
            WelchBias(
                structure,
                weighting,
                tuple(parameter_biases),
                _mean_or_nan([model.indices.wmse for model in welch_models]),
                _mean_or_nan(
                    [
                        record_estimate.indices.wmse
                        for session in sessions
                        for record_estimate in session.record_estimates
                        if record_estimate.name == structure
                    ]
                ),
            )
        )
    return tuple(biases)


def _mean_or_nan(numbers: Sequence[float]) -> float:
    """Return the mean of numbers, or NaN if there are none."""
    return float(np.mean(numbers)) if numbers else math.nan
