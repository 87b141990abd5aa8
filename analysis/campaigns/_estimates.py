"""Results of one session's Welch fits and whole-record fits that a campaign retains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.identify import Candidate, RecordFit
    from analysis.paper.welch_analysis import FitIndices, FittedModel
    from rigd.beam import Damping


@dataclass(frozen=True, slots=True)
class WelchFit:
    """Fit of one damping structure and weighting to a session's response by the Welch method.

    Attributes
    ----------
    structure, weighting : str
        Names of damping structure and weighting.
    damping : Damping
        Fitted damping.
    parameters : dict
        Values of zeta, alpha, gamma and lambda, fixed parameters included.
    cost : float
        Minimum of the cost function (Eq. 26), in (N·m/rad)².
    at_bounds : tuple of str
        Free parameters at a bound of the range searched.
    std : dict or None
        Standard deviations of the free parameters, as in `analysis.paper.FrfFit`.
    indices : FitIndices or None
        Fit indices relative to the session's response.
    """

    structure: str
    weighting: str
    damping: Damping
    parameters: Mapping[str, float]
    cost: float
    at_bounds: tuple[str, ...]
    std: Mapping[str, float] | None = None
    indices: FitIndices | None = None

    @classmethod
    def from_model(cls, model: FittedModel) -> WelchFit:
        """Return the results of a fitted model that a campaign retains."""
        fit = model.fit
        return cls(
            structure=fit.structure.name,
            weighting=fit.weighting,
            damping=fit.damping,
            parameters=dict(fit.parameters),
            cost=fit.cost,
            at_bounds=fit.at_bounds,
            std=None if fit.std is None else dict(fit.std),
            indices=model.indices,
        )


@dataclass(frozen=True, slots=True)
class RecordEstimate:
    """Fit of one damping structure to one whole record, and how well it explains the session.

    Attributes
    ----------
    fit : RecordFit
        Fit without its residual, which would take most of the memory of a campaign.
    deviance : float
        ``-2 ln`` likelihood, up to a constant common to all estimates of the session.
    bic : float
        Bayesian information criterion of this session alone.
    values : int
        Number of real values compared.
    indices : FitIndices
        Fit indices relative to the session's response by Welch's method, on the same bins as for
        the Welch fits. They contain the bias of that method.
    """

    fit: RecordFit
    deviance: float
    bic: float
    values: int
    indices: FitIndices

    @property
    def name(self) -> str:
        """Name of the damping structure as shown in tables."""
        return self.fit.structure.name

    @classmethod
    def from_candidate(cls, candidate: Candidate, indices: FitIndices) -> RecordEstimate:
        """Return what a campaign retains of a whole-record fit.

        Parameters
        ----------
        candidate : Candidate
            Fit of one session.
        indices : FitIndices
            Fit indices relative to the measured response.
        """
        return cls(
            fit=replace(candidate.fit, residual=np.empty(0, np.complex128)),
            deviance=candidate.deviance,
            bic=candidate.bic,
            values=candidate.values,
            indices=indices,
        )
