"""Statistics of the Welch fits over the sessions: parameters, nominal models, ranking.

The scatter of the parameters is Table 3 of the paper. A nominal model has the mean parameters. The
distance of each session's response from it is in Figure 7 (mean square error, weighted mean square
error, maximum deviation: Eqs. 28-30) and Table 4 (mean deviation of the resonant peaks: Eqs. 31 and
32).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.pooling import determines_damping, estimates_by_structure, pooled_bic
from analysis.paper.welch_analysis import fit_indices, peak_deviation, resonant_peaks
from rigd.beam import DAMPING_PARAMETERS, Plant, ResponseGrid, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate
    from analysis.paper.welch_analysis import FitIndices, FittedModel, Peak
    from rigd.beam import Damping


# Parameters


@dataclass(frozen=True, slots=True)
class ParameterStatistics:
    """Statistics over all sessions of one free parameter, with one structure and weighting.

    Attributes
    ----------
    structure, weighting, parameter : str
        Names of damping structure, weighting and parameter.
    mean, median, std, min, max : float
        Statistics of the parameter; `std` has K − 1 in the denominator and is NaN for one session.
    at_bounds : int
        Number of sessions in which the parameter is at a bound of the range searched.
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
) -> dict[tuple[str, str], tuple[FittedModel, ...]]:
    """Return the Welch fits of all sessions, keyed by damping structure and weighting."""
    fits_per_model = zip(*(session.welch_models for session in sessions), strict=True)
    return {
        (model_fits[0].fit.structure.name, model_fits[0].fit.weighting): model_fits
        for model_fits in fits_per_model
    }


def parameter_statistics(sessions: Sequence[SessionAnalysis]) -> tuple[ParameterStatistics, ...]:
    """Return statistics of the free parameters of all Welch fits (Table 3 of the paper)."""
    all_statistics = []
    for (structure, weighting), model_fits in fits_by_model(sessions).items():
        for parameter in model_fits[0].fit.structure.free:
            parameter_values = np.array([model.fit.parameters[parameter] for model in model_fits])
            all_statistics.append(
                ParameterStatistics(
                    structure=structure,
                    weighting=weighting,
                    parameter=parameter,
                    mean=float(parameter_values.mean()),
                    median=float(np.median(parameter_values)),
                    std=float(parameter_values.std(ddof=1))
                    if parameter_values.size > 1
                    else float("nan"),
                    min=float(parameter_values.min()),
                    max=float(parameter_values.max()),
                    at_bounds=sum(parameter in model.fit.at_bounds for model in model_fits),
                )
            )
    return tuple(all_statistics)


# Nominal models

PAPER_BEST_MODELS: Final = (("III", "omega"), ("VI", "omega"))
"""Structure and weighting of the paper's two best models (its Table 5 and Figure 8)."""


@dataclass(frozen=True, slots=True)
class MeanPeakDeviation:
    """Mean absolute deviation of a model's resonant peak from the sessions' (paper, Eqs. 31, 32).

    Attributes
    ----------
    mode : int
        Number of the mode, from 1.
    frequency_rad_s, magnitude_db : float
        Mean deviation of the peak's frequency and magnitude; NaN if the model or every session
        lacks the peak.
    sessions : int
        Number of sessions that have the peak.
    """

    mode: int
    frequency_rad_s: float
    magnitude_db: float
    sessions: int


@dataclass(frozen=True, slots=True)
class NominalModel:
    """Model with the means of the parameters of the sessions' Welch fits.

    Attributes
    ----------
    structure, weighting : str
        Names of damping structure and weighting.
    damping : Damping
        Damping with the mean parameters.
    parameters : dict
        Mean of zeta, alpha, gamma and lambda, fixed parameters included.
    response : ndarray of complex, shape (n,)
        Response of the model, with the tool inertia, in N·m/rad.
    peaks : tuple of Peak or None
        Peaks of that response, one for each mode.
    indices : tuple of FitIndices
        Distance of the model from the response of each session.
    deviations : tuple of MeanPeakDeviation
        Mean deviation of each mode's resonant peak.
    """

    structure: str
    weighting: str
    damping: Damping
    parameters: Mapping[str, float]
    response: NDArray[np.complex128]
    peaks: tuple[Peak | None, ...]
    indices: tuple[FitIndices, ...]
    deviations: tuple[MeanPeakDeviation, ...]

    @property
    def mean_wmse(self) -> float:
        """Weighted mean square error in (N·m/rad)², averaged over the sessions."""
        return float(np.mean([index_set.wmse for index_set in self.indices]))


def mean_damping(welch_models: Sequence[FittedModel]) -> Damping:
    """Return the damping whose parameters are the means over the sessions' fits."""
    return welch_models[0].fit.structure.damping(_mean_parameters(welch_models))


def nominal_models(sessions: Sequence[SessionAnalysis]) -> tuple[NominalModel, ...]:
    """Return the nominal model for each damping structure and weighting."""
    first_session = sessions[0]
    if not first_session.frequency_hz.size:
        return ()
    response_grid = ResponseGrid(2j * np.pi * first_session.frequency_hz)
    return tuple(
        _nominal_model(structure, weighting, model_fits, sessions, response_grid)
        for (structure, weighting), model_fits in fits_by_model(sessions).items()
    )


def best_models(models: Sequence[NominalModel]) -> tuple[NominalModel, ...]:
    """Return the models of Table 5 and Figure 8 of the paper.

    These are the paper's two best models if they were fitted, else the two of lowest mean WMSE.
    """
    paper_models = tuple(m for m in models if (m.structure, m.weighting) in PAPER_BEST_MODELS)
    return (
        paper_models
        if len(paper_models) == len(PAPER_BEST_MODELS)
        else tuple(sorted(models, key=_mean_wmse_sort_key)[:2])
    )


def mean_deviations(
    measured_peaks: Sequence[Sequence[Peak | None]], model_peaks: Sequence[Peak | None]
) -> tuple[MeanPeakDeviation, ...]:
    """Return the deviation of each resonant peak, averaged over the sessions (paper, Eqs. 31, 32).

    The model and each session have one peak, or None, for each mode.
    """
    deviations = []
    for mode_number, (model_peak, session_peaks) in enumerate(
        zip(model_peaks, zip(*measured_peaks, strict=True), strict=True), start=1
    ):
        peak_deviations = [
            peak_deviation(peak, model_peak)
            for peak in session_peaks
            if peak is not None and model_peak is not None
        ]
        deviations.append(
            MeanPeakDeviation(
                mode=mode_number,
                frequency_rad_s=_mean_or_nan(
                    [peak_term.frequency_rad_s for peak_term in peak_deviations]
                ),
                magnitude_db=_mean_or_nan(
                    [peak_term.magnitude_db for peak_term in peak_deviations]
                ),
                sessions=len(peak_deviations),
            )
        )
    return tuple(deviations)


def _nominal_model(
    structure: str,
    weighting: str,
    welch_models: Sequence[FittedModel],
    sessions: Sequence[SessionAnalysis],
    response_grid: ResponseGrid,
) -> NominalModel:
    """Return the nominal model of one damping structure and weighting."""
    mean_damping_model = mean_damping(welch_models)
    first_session = sessions[0]
    frequency_hz, beam = first_session.frequency_hz, first_session.beam
    plant = Plant(beam, mean_damping_model, tool_inertia_kg_m2=first_session.tool_inertia_kg_m2)
    (model_response,) = response_grid.evaluate(plant)
    mode_count = len(first_session.peaks)
    peaks = resonant_peaks(
        frequency_hz, model_response, undamped_frequencies_rad_s(beam, mode_count) / (2 * np.pi)
    )
    omega = 2 * np.pi * frequency_hz
    return NominalModel(
        structure=structure,
        weighting=weighting,
        damping=mean_damping_model,
        parameters=_mean_parameters(welch_models),
        response=model_response,
        peaks=peaks,
        indices=tuple(fit_indices(omega, session.response, model_response) for session in sessions),
        deviations=mean_deviations([session.peaks for session in sessions], peaks),
    )


def _mean_parameters(welch_models: Sequence[FittedModel]) -> dict[str, float]:
    """Return the mean of each damping parameter over the sessions' fits."""
    return {
        parameter_name: float(
            np.mean([model.fit.parameters[parameter_name] for model in welch_models])
        )
        for parameter_name in DAMPING_PARAMETERS
    }


def _mean_wmse_sort_key(model: NominalModel) -> float:
    """Return the sorting key of a model: its weighted mean square error, averaged over sessions."""
    return model.mean_wmse


def _mean_or_nan(values: Sequence[float]) -> float:
    """Return the mean of values, or NaN if there are none."""
    return float(np.mean(values)) if values else float("nan")


# Ranking of structures


@dataclass(frozen=True, slots=True)
class RankedStructure:
    """One damping structure with its BIC over all sessions, for the ranking of structures.

    Attributes
    ----------
    structure : str
        Name of the structure.
    fitted_sessions : int
        Number of sessions to which the structure was fitted.
    determining_sessions : int
        Number of the sessions fitted that determine the structure's damping.
    selecting_sessions : int
        Number of sessions that select the structure by themselves.
    misfit : float
        Misfit of the pooled estimate (see `PooledEstimate`). If the structure is not pooled, the
        median misfit of the sessions to which it was fitted.
    bic_above_lowest : float or None
        BIC of all sessions together less the lowest BIC of a pooled structure; None if the
        structure was fitted to some sessions only. Negative if the structure fits better, but too
        few sessions determine it.
    is_pooled : bool
        Whether the structure was fitted to all sessions, and at least two determine it.
    """

    structure: str
    fitted_sessions: int
    determining_sessions: int
    selecting_sessions: int
    misfit: float
    bic_above_lowest: float | None
    is_pooled: bool

    @property
    def name(self) -> str:
        """Name of the damping structure as shown in tables."""
        return self.structure


def ranked_structures(
    sessions: Sequence[SessionAnalysis], pooled_fits: Sequence[PooledEstimate]
) -> tuple[RankedStructure, ...]:
    """Rank all fitted damping structures: first the pooled ones by BIC, then the others.

    The pooled estimates are in the order of rising BIC.
    """
    estimates_by_name = estimates_by_structure(sessions)
    fitted_sessions = max(map(len, estimates_by_name.values()), default=0)
    bic_by_name = {
        structure_name: pooled_bic(estimates)
        for structure_name, estimates in estimates_by_name.items()
        if len(estimates) == fitted_sessions
    }
    selections_by_structure = Counter(session.selected_structure for session in sessions)
    misfit_by_name = {
        pooled_estimate.name: pooled_estimate.misfit for pooled_estimate in pooled_fits
    }
    lowest_bic = pooled_fits[0].bic if pooled_fits else min(bic_by_name.values(), default=0.0)
    ranked_list = [
        RankedStructure(
            structure=structure_name,
            fitted_sessions=len(estimates),
            determining_sessions=sum(map(determines_damping, estimates)),
            selecting_sessions=selections_by_structure[structure_name],
            misfit=misfit_by_name.get(structure_name)
            or float(
                np.median(
                    [estimate.fit.cost / estimate.fit.degrees_of_freedom for estimate in estimates]
                )
            ),
            bic_above_lowest=bic_by_name[structure_name] - lowest_bic
            if structure_name in bic_by_name
            else None,
            is_pooled=structure_name in misfit_by_name,
        )
        for structure_name, estimates in estimates_by_name.items()
    ]
    return tuple(sorted(ranked_list, key=_rank_sort_key))


def _rank_sort_key(structure: RankedStructure) -> tuple[bool, bool, float]:
    """Return the sorting key of a damping structure: pooled ones first, then by BIC."""
    bic = structure.bic_above_lowest
    return not structure.is_pooled, bic is None, bic or 0.0
