"""Results of one session's Welch fits and whole-record fits that a campaign retains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from analysis.identify import Candidate, ModeEstimate
    from analysis.paper.welch_analysis import FitIndices, FittedModel
    from rigd.beam import Damping, Plant


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
    """Fit of one damping structure to one whole record (see `analysis.identify.RecordFit`).

    Attributes
    ----------
    structure : str
        Name of the structure, "I" to "VII".
    plant : Plant
        Fitted plant.
    parameters : dict of str to float
        Values of all parameters, fixed parameters included.
    std : dict of str to (float or None)
        Standard deviations: 0 of a fixed parameter, None of a parameter at a bound.
    determined : tuple of str
        The k free parameters in the order of `covariance`, without those at a bound.
    covariance : ndarray, shape (k, k)
        Covariance of the determined parameters, of the logarithms of positive ones.
    at_bounds : tuple of str
        Free parameters at a bound of their range.
    modes : tuple of ModeEstimate
        Frequencies and damping ratios of the modes in the band.
    cost : float
        Sum of squares of the whitened residual.
    degrees_of_freedom : int
        Expectation of `cost` if the residual is only noise.
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

    structure: str
    plant: Plant
    parameters: Mapping[str, float]
    std: Mapping[str, float | None]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]
    at_bounds: tuple[str, ...]
    modes: tuple[ModeEstimate, ...]
    cost: float
    degrees_of_freedom: int
    deviance: float
    bic: float
    values: int
    indices: FitIndices

    @property
    def name(self) -> str:
        """Name of the damping structure as shown in tables."""
        return self.structure

    @property
    def free(self) -> frozenset[str]:
        """Names of the free parameters, determined or at a bound."""
        return frozenset((*self.determined, *self.at_bounds))

    @classmethod
    def from_candidate(cls, candidate: Candidate, indices: FitIndices) -> RecordEstimate:
        """Return the results of a whole-record fit that a campaign retains: all but the residual.

        Parameters
        ----------
        candidate : Candidate
            Fit of one session.
        indices : FitIndices
            Fit indices relative to the measured response.
        """
        fit = candidate.fit
        return cls(
            structure=fit.structure.name,
            plant=fit.plant,
            parameters=dict(fit.parameters),
            std=dict(fit.std),
            determined=fit.determined,
            covariance=fit.covariance,
            at_bounds=fit.at_bounds,
            modes=fit.modes,
            cost=fit.cost,
            degrees_of_freedom=fit.degrees_of_freedom,
            deviance=candidate.deviance,
            bic=candidate.bic,
            values=candidate.values,
            indices=indices,
        )
