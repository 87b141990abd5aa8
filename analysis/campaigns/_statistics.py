"""Statistics of the Welch fits over the sessions: parameters, nominal models, ranking.

Scatter of the parameters (the paper's Table 3); nominal models, of the mean parameters, and how far
each session's response is from them: Figure 7 (mean square error, its weighted kind, maximum
deviation: Eqs. 28-30) and Table 4 (mean deviation of the resonant peaks: Eqs. 31 and 32).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.pooling import by_structure, determines_damping, pooled_bic
from analysis.models import PARAMETERS, STRUCTURES, FrequencyResponseModel
from analysis.paper import fit_indices, peak_deviation, resonant_peaks
from rigd.beam import undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._estimates import WelchFit
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate
    from analysis.models import Parameter
    from analysis.paper import Indices, Peak
    from rigd.beam import Beam, Damping


# Parameters


@dataclass(frozen=True, slots=True)
class ParameterStatistics:
    """One free parameter of one type and weighting, over all sessions.

    Attributes
    ----------
    structure, weighting, parameter : str
    mean, median, std, min, max : float
        std with K − 1 in the denominator, NaN of a single session.
    at_bounds : int
        Sessions in which it is at a bound of the range searched.
    """

    structure: str
    weighting: str
    parameter: str
    mean: float
    median: float
    std: float
    min: float
    max: float
    at_bounds: int


def fits_by_model(
    sessions: Sequence[SessionAnalysis],
) -> dict[tuple[str, str], tuple[WelchFit, ...]]:
    """All sessions' fits by type and weighting, session by session."""
    rows = zip(*(session.welch_fits for session in sessions), strict=True)
    return {(row[0].structure, row[0].weighting): row for row in rows}


def parameter_statistics(sessions: Sequence[SessionAnalysis]) -> tuple[ParameterStatistics, ...]:
    """Statistics of the free parameters of every type and weighting (Table 3)."""
    found = []
    for (structure, weighting), fits in fits_by_model(sessions).items():
        for parameter in STRUCTURES[structure].free:
            values = np.array([fit.parameters[parameter] for fit in fits])
            found.append(
                ParameterStatistics(
                    structure=structure,
                    weighting=weighting,
                    parameter=parameter,
                    mean=float(values.mean()),
                    median=float(np.median(values)),
                    std=float(values.std(ddof=1)) if values.size > 1 else float("nan"),
                    min=float(values.min()),
                    max=float(values.max()),
                    at_bounds=sum(parameter in fit.at_bounds for fit in fits),
                )
            )
    return tuple(found)


# Nominal models

BEST: Final = (("III", "omega"), ("VI", "omega"))
"""Types and weightings of the paper's two best models: its Table 5 and Figure 8."""


@dataclass(frozen=True, slots=True)
class MeanPeakDeviation:
    """Mean deviation of one resonance (MDR), Eqs. (31) and (32).

    Attributes
    ----------
    mode : int
        From 1 on.
    frequency_rad_s, magnitude_db : float
        NaN if no session or the model has no such peak.
    sessions : int
        How many have the peak.
    """

    mode: int
    frequency_rad_s: float
    magnitude_db: float
    sessions: int


@dataclass(frozen=True, slots=True)
class NominalModel:
    """Model with the mean of the sessions' parameters.

    Attributes
    ----------
    structure, weighting : str
    damping : Damping
    parameters : dict
        zeta, alpha, gamma and lambda, the fixed ones included.
    response : ndarray of complex, shape (n,)
        With the tool inertia, in N·m/rad.
    peaks : tuple of Peak or None
        Peaks of that response, mode by mode.
    indices : tuple of Indices
        Its distance from each session's response, session by session.
    deviations : tuple of MeanPeakDeviation
        Mode by mode.
    """

    structure: str
    weighting: str
    damping: Damping
    parameters: Mapping[Parameter, float]
    response: NDArray[np.complex128]
    peaks: tuple[Peak | None, ...]
    indices: tuple[Indices, ...]
    deviations: tuple[MeanPeakDeviation, ...]

    @property
    def mean_wmse(self) -> float:
        """Mean over the sessions of the weighted mean square error, in (N·m/rad)²."""
        return float(np.mean([each.wmse for each in self.indices]))


def mean_damping(structure: str, fits: Sequence[WelchFit]) -> Damping:
    """Damping with the mean of each free parameter."""
    return STRUCTURES[structure].damping(_means(fits))


def nominal_models(sessions: Sequence[SessionAnalysis]) -> tuple[NominalModel, ...]:
    """Nominal model of every type and weighting, compared with every session."""
    first = sessions[0]
    if not first.frequency_hz.size:
        return ()
    frequency_hz, beam = first.frequency_hz, first.beam
    model = FrequencyResponseModel(frequency_hz, beam, first.tool_inertia_kg_m2)
    return tuple(
        _nominal(structure, weighting, fits, sessions, model, frequency_hz, beam)
        for (structure, weighting), fits in fits_by_model(sessions).items()
    )


def best_models(models: Sequence[NominalModel]) -> tuple[NominalModel, ...]:
    """Return the models of Table 5 and Figure 8: the paper's two, else the two of least WMSE."""
    named = tuple(m for m in models if (m.structure, m.weighting) in BEST)
    return named if len(named) == len(BEST) else tuple(sorted(models, key=_wmse)[:2])


def mean_deviations(
    measured: Sequence[Sequence[Peak | None]], modelled: Sequence[Peak | None]
) -> tuple[MeanPeakDeviation, ...]:
    """Mean deviation of each resonant peak over the sessions, Eqs. (31) and (32).

    Parameters
    ----------
    measured : sequence of sequence of Peak or None
        Peaks of each session, mode by mode.
    modelled : sequence of Peak or None
        Mode by mode.
    """
    found = []
    for number, (model, seen) in enumerate(
        zip(modelled, zip(*measured, strict=True), strict=True), start=1
    ):
        terms = [
            peak_deviation(peak, model) for peak in seen if peak is not None and model is not None
        ]
        found.append(
            MeanPeakDeviation(
                mode=number,
                frequency_rad_s=_mean([term.frequency_rad_s for term in terms]),
                magnitude_db=_mean([term.magnitude_db for term in terms]),
                sessions=len(terms),
            )
        )
    return tuple(found)


def _nominal(
    structure: str,
    weighting: str,
    fits: Sequence[WelchFit],
    sessions: Sequence[SessionAnalysis],
    model: FrequencyResponseModel,
    frequency_hz: NDArray[np.float64],
    beam: Beam,
) -> NominalModel:
    damping = mean_damping(structure, fits)
    response = model.evaluate(damping)
    count = len(sessions[0].peaks)
    peaks = resonant_peaks(
        frequency_hz, response, undamped_frequencies_rad_s(beam, count) / (2 * np.pi)
    )
    omega = 2 * np.pi * frequency_hz
    return NominalModel(
        structure=structure,
        weighting=weighting,
        damping=damping,
        parameters=_means(fits),
        response=response,
        peaks=peaks,
        indices=tuple(fit_indices(omega, session.response, response) for session in sessions),
        deviations=mean_deviations([session.peaks for session in sessions], peaks),
    )


def _means(fits: Sequence[WelchFit]) -> dict[Parameter, float]:
    return {name: float(np.mean([fit.parameters[name] for fit in fits])) for name in PARAMETERS}


def _wmse(model: NominalModel) -> float:
    return model.mean_wmse


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


# Ranking of structures


@dataclass(frozen=True, slots=True)
class RankedStructure:
    """Rank of one structure over all sessions.

    Attributes
    ----------
    structure : str
    fitted : int
        Sessions to which it was fitted.
    determined : int
        Those of them that determine its damping.
    selected_alone : int
        Those that select it by themselves.
    misfit : float
        As of `PooledEstimate`, over the sessions to which it was fitted if it is not pooled.
    bic_above_lowest : float or None
        BIC of all sessions together above the lowest of those pooled; None if it was fitted to
        some sessions only. Below zero where it would fit better, but too few determine it.
    pooled : bool
        Whether two sessions or more determine it, and all tried it.
    """

    structure: str
    fitted: int
    determined: int
    selected_alone: int
    misfit: float
    bic_above_lowest: float | None
    pooled: bool

    @property
    def name(self) -> str:
        """Name in tables."""
        return self.structure


def ranked_structures(
    sessions: Sequence[SessionAnalysis], pooled: Sequence[PooledEstimate]
) -> tuple[RankedStructure, ...]:
    """Rank every structure fitted: those pooled, by BIC, then the others.

    Parameters
    ----------
    sessions : sequence of SessionResult
    pooled : sequence of PooledEstimate
        The lowest BIC first.
    """
    fits = by_structure(sessions)
    tried = max(map(len, fits.values()), default=0)
    bic = {name: pooled_bic(each) for name, each in fits.items() if len(each) == tried}
    alone = Counter(session.selected for session in sessions)
    misfit = {each.name: each.misfit for each in pooled}
    lowest = pooled[0].bic if pooled else min(bic.values(), default=0.0)
    found = [
        RankedStructure(
            structure=each[0].structure,
            fitted=len(each),
            determined=sum(map(determines_damping, each)),
            selected_alone=alone[name],
            misfit=misfit.get(name)
            or float(np.median([one.cost / one.degrees_of_freedom for one in each])),
            bic_above_lowest=bic[name] - lowest if name in bic else None,
            pooled=name in misfit,
        )
        for name, each in fits.items()
    ]
    return tuple(sorted(found, key=_rank))


def _rank(each: RankedStructure) -> tuple[bool, bool, float]:
    bic = each.bic_above_lowest
    return not each.pooled, bic is None, bic or 0.0
