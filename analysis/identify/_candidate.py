"""Candidate: one structure fitted to one record, with its information criteria."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.identify._result import RecordFit
    from analysis.models import Structure


Kind = tuple[bool, tuple[str, ...]]
"""Kind of rig: whether the beam is uniform, and what else is free."""

PLAIN: Final[Kind] = (True, ())
"""A uniform beam, and nothing beside it."""


MODES_FREE: Final = "modes free"
"""What tables call a beam whose modes have stiffnesses of their own."""

EXTRA_WORDS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "root_compliance_rad_per_nm": "elastic clamp",
        "tip_mass_kg": "tip mass",
        "filter_time_constant_s": "first-order filter",
        "second_order_filter_time_constant_s": "second-order filter",
        "clock_rate_difference": "clock rate difference",
    }
)
"""What tables call the extras of a candidate."""


FAR_BEHIND: Final = 1000.0
"""Difference of BIC from which a candidate stays behind wherever exactly its minimum is."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One structure on one kind of beam, fitted.

    Attributes
    ----------
    structure : Structure
    uniform : bool
        Whether all modes follow from one stiffness.
    fit : RecordFit
    columns : int
        Parameters of what is not linear, beside those of the fit.
    extras : tuple of str
        What else of `analysis.identify.EXTRAS` was free.
    """

    structure: Structure
    uniform: bool
    fit: RecordFit
    columns: int = 0
    extras: tuple[str, ...] = ()

    @property
    def parameters(self) -> int:
        """Number of free parameters; the free decay's amplitudes, common to all, do not count."""
        return len(self.fit.interval) + self.columns

    @property
    def values(self) -> int:
        """Number of real values compared."""
        fit = self.fit
        decays = fit.ringing.degrees_of_freedom
        return fit.degrees_of_freedom + len(fit.interval) + decays + self.columns

    @property
    def deviance(self) -> float:
        """``-2 ln`` likelihood but for a constant: noise of known shape and free level."""
        return self.values * math.log(self.fit.cost / self.values)

    @property
    def bic(self) -> float:
        """Schwarz, Annals of Statistics 6 (1978) 461-464."""
        return self.deviance + self.parameters * math.log(self.values)

    @property
    def aic(self) -> float:
        """Akaike, IEEE Trans. Automatic Control 19 (1974) 716-723."""
        return self.deviance + 2 * self.parameters

    @property
    def kind(self) -> Kind:
        """Kind of rig: whether the beam is uniform, and what else was free."""
        return self.uniform, self.extras

    @property
    def name(self) -> str:
        """As tables call it."""
        beside = [] if self.uniform else [MODES_FREE]
        beside += [EXTRA_WORDS[name] for name in self.extras]
        return ", ".join([self.structure.name, *beside])
