"""Analysis of one session of a campaign by a worker, and its compact result."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.campaigns._estimates import RecordEstimate
from analysis.campaigns._experiment import Experiment, SessionFailure, session_error_types
from analysis.models import RECORD_BAND_HZ, WelchSettings
from analysis.paper.welch_analysis import FitIndices, fit_indices
from analysis.results import RecordResult, whole_record, with_uniformity
from rigd.session import Validity, sample_digests
from rigd.spectral import FrequencyResponse

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.identify import Candidate, ModalEstimate, Setting
    from analysis.identify.verdict import Verdict
    from analysis.paper.welch_analysis import FittedModel, Peak
    from analysis.record_part import RecordSource
    from analysis.results import WholeRecord
    from rigd.beam import Beam, Plant


_INVALIDATING_FINDING_KINDS: Final = ("sign", "unit")
"""Kinds of findings (wrong sign or unit of a channel) that invalidate all results of a session."""

_NO_RESPONSE: Final = FrequencyResponse(
    np.zeros(0), np.zeros(0, dtype=np.complex128), coherence=None, segments=0, estimator="h1"
)
"""Empty frequency response, for a session without Welch's method."""
_PAPER_SETTINGS: Final = WelchSettings()
"""Welch settings of the paper."""
_NO_FIT_INDICES: Final = FitIndices(math.nan, math.nan, math.nan)
"""Fit indices (NaN) of a model if there is no measured response to compare it with."""


@dataclass(frozen=True, slots=True)
class SessionAnalysis:
    """Results of one session of a campaign, about 200 kB with the paper's settings.

    Attributes
    ----------
    source : RecordSource
        Session file, and the part of it that was analysed.
    experiment : Experiment
        Specimen and excitation stated in the file.
    beam : Beam
        Beam stated in the file.
    tool_inertia_kg_m2, delay_s : float
        Tool inertia, and delay of the torque channel relative to the angle, stated in the file.
    frequency_hz : ndarray, shape (n,)
        Frequency bins in the band; empty if Welch's method is not applicable to the session.
    response : ndarray of complex, shape (n,)
        Measured torque per angle in N·m/rad, without the channels' delays.
    peaks : tuple of Peak or None
        Measured resonant peaks, one for each mode.
    welch_models : tuple of FittedModel
        Welch fits by damping structure, then by weighting, without their responses, which would
        take most of the memory of a campaign; empty if Welch's method is not applicable.
    record_estimates : tuple of RecordEstimate
        Whole-record fits by damping structure; empty if none was requested, or the record could
        not be used.
    verdict : Verdict or None
        Verdict on the whole record of this session alone; None without estimates.
    warnings : tuple of str
        Warnings for the operator.
    headline : mapping or None
        Headline of the session, as in the document of a single file; None without a verdict.
    settings : WelchSettings
        Welch settings as used, with segment lengths in samples.
    segments : int
        Number of segments averaged by Welch's method; 0 without a response.
    record_band_hz : tuple of float
        Frequency band of the whole-record fits.
    name : str
        Name in tables and sentences (see `distinct_names`); the name of the file by default.
    sample_digests : frozenset of bytes
        Digests of the session's samples (see `rigd.session.sample_digests`).
    validity : Validity
        Validity of the linear model for the session.
    modal : ModalEstimate or None
        Modal model of the modes visible in the whole record; None without visible modes.
    nominal : Plant or None
        Plant with rig and specimen as stated in the file; None without whole-record fits.
    uniformity : float
        Stated relative standard deviation of mode frequencies from those of a uniform beam.
    """

    source: RecordSource
    experiment: Experiment
    beam: Beam
    tool_inertia_kg_m2: float
    delay_s: float
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    peaks: tuple[Peak | None, ...]
    welch_models: tuple[FittedModel, ...]
    record_estimates: tuple[RecordEstimate, ...]
    verdict: Verdict | None
    warnings: tuple[str, ...]
    headline: Mapping[str, Any] | None = None
    settings: WelchSettings = _PAPER_SETTINGS
    segments: int = 0
    record_band_hz: tuple[float, float] = RECORD_BAND_HZ
    name: str = ""
    sample_digests: frozenset[bytes] = frozenset()
    validity: Validity = field(default_factory=Validity)
    modal: ModalEstimate | None = None
    nominal: Plant | None = None
    uniformity: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.source.name)

    @property
    def path(self) -> Path:
        """Path of the session file."""
        return self.source.path

    def without_welch(self) -> SessionAnalysis:
        """Return the session without results of Welch's method."""
        return replace(
            self,
            frequency_hz=_NO_RESPONSE.frequency_hz,
            response=_NO_RESPONSE.response,
            peaks=(),
            welch_models=(),
            segments=0,
        )

    @property
    def selected_structure(self) -> str | None:
        """Name of the damping structure that this session selects; None if it has no verdict."""
        if self.verdict is None:
            return None
        return min(self.record_estimates, key=lambda estimate: estimate.bic).name


@dataclass(frozen=True, slots=True)
class SessionTask:
    """Settings common to the analyses of all sessions of a campaign.

    Attributes
    ----------
    settings : WelchSettings
        Settings of the Welch fits.
    structure_names : tuple of str
        Structures of the whole-record fits to retain; empty for no such fits.
    fixed_parameters : tuple of str
        Parameters that stay at the file's values in the whole-record fits.
    band_hz : tuple of float or None
        Frequency band of all fits; None chooses it for each record.
    uniformity : float or None
        Relative standard deviation of mode frequencies from those of a uniform beam; None uses the
        value stated in each file.
    """

    settings: WelchSettings
    structure_names: tuple[str, ...]
    fixed_parameters: tuple[Setting, ...]
    band_hz: tuple[float, float] | None
    uniformity: float | None = None


def analyse_session(
    source: RecordSource, session_task: SessionTask
) -> SessionAnalysis | SessionFailure:
    """Read and analyse a session by a fit to the whole record, and by Welch's method if applicable.

    An error of one session is returned, not raised, because the others are still usable.

    Parameters
    ----------
    source : RecordSource
        Session file, or a part of it.
    session_task : SessionTask
        Settings of the analysis.
    """
    from analysis.applicability import analysis_remarks, highest_frequency_hz, welch_analysis
    from analysis.record import load_record

    session_errors = session_error_types()
    experiment = None
    try:
        record = with_uniformity(
            load_record(
                source.path,
                source.part_s,
                highest_hz=highest_frequency_hz(session_task.band_hz),
            ),
            session_task.uniformity,
        )
        experiment = Experiment.from_record(record)
        unfinished_reason = experiment.unfinished_sweep_reason(record.outcome)
        if unfinished_reason and source.part_s is None:
            return SessionFailure(source, f"{source}: {unfinished_reason}", experiment)
        welch_results, omission_remark = welch_analysis(
            record,
            session_task.settings,
            session_task.band_hz,
            is_optional=bool(session_task.structure_names),
        )
    except session_errors as error:
        return SessionFailure.from_error(source, error, experiment)
    except MemoryError:
        return SessionFailure(
            source, f"{source}: not enough memory to analyse it; use fewer --jobs."
        )
    warnings = record.warnings if welch_results is None else welch_results.warnings
    warnings = (
        *warnings,
        *analysis_remarks(record, session_task.band_hz),
        *((omission_remark,) if omission_remark else ()),
    )
    record_result = None
    if session_task.structure_names:
        try:
            record_result = whole_record(
                record, session_task.fixed_parameters, session_task.band_hz
            )
        except session_errors as error:
            if welch_results is None:
                return SessionFailure.from_error(source, error, experiment)
            warnings = (*warnings, f"Not in the whole-record estimate: {error}")
        except (MemoryError, np.linalg.LinAlgError) as error:
            failure_reason = "not enough memory" if isinstance(error, MemoryError) else error
            warnings = (*warnings, f"Not in the whole-record estimate: {source}: {failure_reason}")
    findings = record_result.verdict.findings if record_result else ()
    if invalidating_findings := next(
        (finding.sentence for finding in findings if finding.kind in _INVALIDATING_FINDING_KINDS),
        None,
    ):
        return SessionFailure(source, f"{source}: {invalidating_findings}", experiment)
    return _session_result(
        source,
        RecordResult(record, record_result, welch_results),
        session_task,
        experiment,
        warnings,
    )


def _session_result(
    source: RecordSource,
    record_result: RecordResult,
    session_task: SessionTask,
    experiment: Experiment,
    warnings: tuple[str, ...],
) -> SessionAnalysis:
    """Return the part of a session's results that a campaign stores."""
    from analysis.applicability import record_band_hz, welch_settings

    record, whole_fits, welch_results = (
        record_result.record,
        record_result.whole,
        record_result.welch,
    )
    measured_response = _NO_RESPONSE if welch_results is None else welch_results.response
    delay_s = record.torque_delay_s - record.angle_delay_s
    used_settings = welch_settings(record, session_task.settings, session_task.band_hz)
    modal_estimate = None if whole_fits is None else whole_fits.headline.modal
    if welch_results is not None:
        used_settings = replace(used_settings, **asdict(welch_results.segmentation))
    return SessionAnalysis(
        source=source,
        experiment=experiment,
        beam=record.beam,
        tool_inertia_kg_m2=record.tool_inertia_kg_m2,
        delay_s=delay_s,
        frequency_hz=measured_response.frequency_hz,
        response=measured_response.response,
        peaks=() if welch_results is None else welch_results.peaks,
        welch_models=()
        if welch_results is None
        else tuple(
            replace(model, response=_NO_RESPONSE.response) for model in welch_results.models
        ),
        record_estimates=()
        if whole_fits is None
        else _record_estimates(
            whole_fits, session_task.structure_names, measured_response, delay_s
        ),
        verdict=None if whole_fits is None else whole_fits.verdict,
        warnings=warnings,
        headline=None if whole_fits is None else whole_fits.headline_json(),
        settings=used_settings,
        segments=measured_response.segments,
        record_band_hz=record_band_hz(record, session_task.band_hz),
        sample_digests=sample_digests(record.angle_rad, record.torque_nm),
        validity=record_result.validity,
        modal=None
        if modal_estimate is None or not modal_estimate.visible_mode_numbers
        else modal_estimate.restrict_to_visible_modes(),
        nominal=None
        if whole_fits is None
        else whole_fits.analysis.comparison.measurement.nominal_plant,
        uniformity=record.uniformity,
    )


def _record_estimates(
    whole_record: WholeRecord,
    structure_names: Collection[str],
    measured_response: FrequencyResponse,
    delay_s: float,
) -> tuple[RecordEstimate, ...]:
    """Return the fits of the requested damping structures and of the selected one."""
    from analysis.models import STRUCTURES
    from rigd.beam import ResponseGrid

    omega = 2 * np.pi * measured_response.frequency_hz
    response_grid = ResponseGrid(1j * omega)

    def record_estimate(candidate: Candidate) -> RecordEstimate:
        """Return the results of a fit that the campaign stores, with their fit indices."""
        # The delay stated in the file is removed from the measured response.
        plant = candidate.fit.plant
        plant = replace(plant, delay_s=plant.delay_s - delay_s)
        if not omega.size:
            return RecordEstimate.from_candidate(candidate, _NO_FIT_INDICES)
        model_response = response_grid.evaluate(plant)[0]
        return RecordEstimate.from_candidate(
            candidate, fit_indices(omega, measured_response.response, model_response)
        )

    structure_order = list(STRUCTURES)
    requested_estimates = [
        record_estimate(candidate)
        for candidate in whole_record.selection.candidates
        if candidate.fit.structure.name in structure_names or candidate.fit is whole_record.fit
    ]
    return tuple(
        sorted(requested_estimates, key=lambda estimate: structure_order.index(estimate.name))
    )
