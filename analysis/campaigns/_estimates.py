"""Results of one session's whole-record fits that a campaign retains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from analysis.identify import Candidate, RecordFit
    from analysis.paper.welch_analysis import FitIndices


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
    compared_values : int
        Number of real values of the record that the fit is compared with.
    indices : FitIndices
        Fit indices relative to the session's response by Welch's method, on the same bins as for
        the Welch fits. They contain the bias of that method.
    """

    fit: RecordFit
    deviance: float
    bic: float
    compared_values: int
    indices: FitIndices

    @property
    def name(self) -> str:
        """Name of the damping structure as shown in tables."""
        return self.fit.structure.name

    @classmethod
    def from_candidate(cls, candidate: Candidate, indices: FitIndices) -> RecordEstimate:
        """Return a candidate's whole-record fit without its residual, and its statistics.

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
            compared_values=candidate.compared_value_count,
            indices=indices,
        )
