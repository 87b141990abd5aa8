"""Estimates of one session that a campaign retains: Welch fits and whole-record fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from analysis.identify import Candidate, ModeEstimate, Plant
    from analysis.paper import FittedModel, Indices
    from rigd.beam import Damping


@dataclass(frozen=True, slots=True)
class WelchFit:
    """One structure fitted to one session by the Welch method, with one weighting.

    Attributes
    ----------
    structure, weighting : str
        Names.
    damping : Damping
    parameters : dict
        zeta, alpha, gamma and lambda, the fixed ones included.
    cost : float
        Eq. (26) at the minimum, in (N·m/rad)².
    at_bounds : tuple of str
        Free parameters at the bounds of the range searched.
    std : dict or None
        See `analysis.paper._fit.FrfFit`.
    indices : Indices or None
        Distance of this fit from the session's own response.
    """

    structure: str
    weighting: str
    damping: Damping
    parameters: Mapping[str, float]
    cost: float
    at_bounds: tuple[str, ...]
    std: Mapping[str, float] | None = None
    indices: Indices | None = None

    @classmethod
    def of(cls, model: FittedModel) -> WelchFit:
        """Return the part of a fit that a campaign needs."""
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
    """One structure, fitted to one whole record.

    Attributes
    ----------
    structure : str
        Its name.
    plant : Plant
    parameters : dict of str to float
        See `analysis.identify.RecordFit`, as for the following.
    std : dict of str to (float or None)
    determined : tuple of str
    covariance : ndarray, shape (k, k)
    at_bounds : tuple of str
    modes : tuple of ModeEstimate
    cost : float
    degrees_of_freedom : int
    deviance : float
        ``-2 ln`` likelihood, up to a constant common to all estimates of the session.
    bic : float
        Criterion of the session by itself.
    values : int
        Real values compared.
    indices : Indices
        Distance of its response from the session's by Welch's method: on the same bins as for the
        paper's fits, and so with the bias of that method in it.
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
    indices: Indices

    @property
    def name(self) -> str:
        """Name in tables."""
        return self.structure

    @property
    def free(self) -> frozenset[str]:
        """Parameters that were sought, found or not."""
        return frozenset((*self.determined, *self.at_bounds))

    @classmethod
    def of(cls, candidate: Candidate, indices: Indices) -> RecordEstimate:
        """Return the part of a fit that a campaign needs: all but the residual.

        Parameters
        ----------
        candidate : Candidate
            Fit of one session.
        indices : Indices
            Its indices against the measured response.
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
