"""Candidate: one structure fitted to one record, with its information criteria."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from analysis.identify._result import RecordFit
    from analysis.models import Structure


FAR_BEHIND: Final = 1000.0
"""Difference of BIC from which a candidate stays behind wherever exactly its minimum is."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Fit of one structure on a uniform beam.

    Attributes
    ----------
    structure : Structure
    fit : RecordFit
    columns : int
        Number of nonlinear terms, in addition to the parameters of the fit.
    """

    structure: Structure
    fit: RecordFit
    columns: int = 0

    @property
    def parameters(self) -> int:
        """Return the number of free parameters, without the amplitudes of the free decay.

        These amplitudes are common to all candidates.
        """
        return len(self.fit.interval) + self.columns

    @property
    def values(self) -> int:
        """Return the number of real values compared."""
        fit = self.fit
        decays = fit.ringing.degrees_of_freedom
        return fit.degrees_of_freedom + len(fit.interval) + decays + self.columns

    @property
    def deviance(self) -> float:
        """Return ``-2 ln`` likelihood up to a constant, for noise of known shape and free level."""
        return self.values * math.log(self.fit.cost / self.values)

    @property
    def bic(self) -> float:
        """Return the BIC (Schwarz, Annals of Statistics 6 (1978) 461-464)."""
        return self.deviance + self.parameters * math.log(self.values)

    @property
    def aic(self) -> float:
        """Return Akaike's criterion (IEEE Trans. Automatic Control 19 (1974) 716-723)."""
        return self.deviance + 2 * self.parameters

    @property
    def name(self) -> str:
        """Return the name that tables show."""
        return self.structure.name
