"""Candidate: one structure fitted to one record, with its information criteria; air drag."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from analysis.identify._result import RecordFit
    from analysis.identify.drag_torque import DragLaw
    from analysis.models import Structure


HOPELESS_BIC_DIFFERENCE: Final = 1000.0
"""Difference of BIC to the best candidate above which a candidate is only fitted roughly. It cannot
become the best one, however exactly its minimum is found."""


def deviance(cost: float, compared_value_count: int) -> float:
    """Return the deviance, ``-2 ln`` of the likelihood plus a constant, for noise of unknown level.

    `cost` is the sum of squares of the whitened residual, and `compared_value_count` the number of
    real values of the record.
    """
    return compared_value_count * math.log(cost / compared_value_count)


def bic(cost: float, compared_value_count: int, parameter_count: int) -> float:
    """Return the Bayesian information criterion of a fit.

    The cost and the number of values are as for `deviance`.
    """
    return deviance(cost, compared_value_count) + parameter_count * math.log(compared_value_count)


@dataclass(frozen=True, slots=True)
class Candidate:
    """Fit of one damping structure (a choice of free damping parameters) to one record.

    The beam is uniform.

    Attributes
    ----------
    structure : Structure
        Damping structure.
    fit : RecordFit
        Fit of this structure to the record.
    nonlinear_effect_count : int
        Number of nonlinear effects with a free amplitude, in addition to the parameters of the fit.
    """

    structure: Structure
    fit: RecordFit
    nonlinear_effect_count: int = 0

    @property
    def parameter_count(self) -> int:
        """Return the number of fitted parameters, except the amplitudes of the free decay.

        These amplitudes are common to all candidates.
        """
        return len(self.fit.interval) + self.nonlinear_effect_count

    @property
    def compared_value_count(self) -> int:
        """Return the number of real values of the record to which the candidate is fitted."""
        fit = self.fit
        decay_amplitude_count = fit.ringing.degrees_of_freedom
        return (
            fit.degrees_of_freedom
            + len(fit.interval)
            + decay_amplitude_count
            + self.nonlinear_effect_count
        )

    @property
    def deviance(self) -> float:
        """Return the deviance: ``-2 ln`` of the likelihood, up to a constant.

        The noise spectrum is known up to its level, which is estimated.
        """
        return deviance(self.fit.cost, self.compared_value_count)

    @property
    def bic(self) -> float:
        """Return the Bayesian information criterion (BIC) of the fit; a lower one is better.

        G. Schwarz, Annals of Statistics 6 (1978) 461-464.
        """
        return bic(self.fit.cost, self.compared_value_count, self.parameter_count)

    @property
    def aic(self) -> float:
        """Return Akaike's information criterion (AIC) of the fit; a lower one is better.

        H. Akaike, IEEE Trans. Automatic Control 19 (1974) 716-723.
        """
        return self.deviance + 2 * self.parameter_count

    @property
    def name(self) -> str:
        """Return the name of the damping structure, as tables show it: "III", for example."""
        return self.structure.name


@dataclass(frozen=True, slots=True)
class DragEstimate:
    """Estimate of the air drag on the beam: the drag coefficient C_D times the width d, in metres.

    Attributes
    ----------
    drag_m : float
        Drag coefficient times diameter, C_D d, at `pivot_speed_m_s`, for an assumed density of the
        air of 1.2 kg/m³.
    std_m : float
        Standard deviation of `drag_m`.
    interval_95_m : tuple of float
        95 % interval of `drag_m`, not below 0.
    pivot_speed_m_s : float
        Speed at which C_D d has the smallest uncertainty. If `law` is constant, the mean speed,
        weighted with the power dissipated by drag.
    law : DragLaw
        C_D d at all speeds.
    covariance : tuple of tuple of float
        Covariance of the coefficients of `law`: 2 by 2, or 1 by 1 if only the constant was
        estimated.
    """

    drag_m: float
    std_m: float
    interval_95_m: tuple[float, float]
    pivot_speed_m_s: float
    law: DragLaw
    covariance: tuple[tuple[float, ...], ...]
