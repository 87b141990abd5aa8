"""Leave-one-out validation: each session predicted from the others, as data not seen before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns._experiment import CampaignError, session_error_types
from analysis.campaigns._statistics import mean_damping
from analysis.campaigns.pooling import pooled_estimates
from analysis.campaigns.workers import FailedTask
from analysis.identify import Measurement
from rigd.beam import Plant

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.workers import Workers
    from analysis.record_part import RecordSource

MIN_VALIDATED_SESSIONS: Final = 3
"""Smallest number of sessions for which each can be predicted from the others, as pooling needs
two."""


@dataclass(frozen=True, slots=True)
class LeaveOneOutResult:
    """Prediction error of a model for a session that was not used to estimate the model.

    Attributes
    ----------
    source : RecordSource
        File of the session, and the part of it that was predicted.
    method : {"record", "welch"}
        Source of the parameters: pooled whole-record estimates of the other sessions, or their
        nominal model by the Welch method.
    name : str
        Damping structure, as named in tables.
    weighting : str or None
        Weighting of the Welch fits; None with "record".
    error : float
        Root mean square of predicted minus measured torque, divided by that of the measured
        torque, in the band and without means.
    own_error : float or None
        Error of the session's own whole-record fit of that structure; None with "welch". Both
        errors include the noise, so the sessions agree if `error` is no larger than `own_error`.
    """

    source: RecordSource
    method: str
    name: str
    weighting: str | None
    error: float
    own_error: float | None


@dataclass(frozen=True, slots=True)
class FailedPrediction:
    """A session that could not be predicted from the other sessions, and the reason."""

    source: RecordSource
    """Session file, and the part of it that was not predicted."""
    reason: str
    """Reason, as the end of a sentence."""


@dataclass(frozen=True, slots=True)
class PlantPrediction:
    """Model of the other sessions that is to predict one session, and that session's own model."""

    method: str
    name: str
    weighting: str | None
    plant: Plant
    own_plant: Plant | None


def models_without_session(
    sessions: Sequence[SessionAnalysis], left_out_index: int
) -> tuple[PlantPrediction, ...]:
    """Return the models estimated from all sessions but one, to predict that session."""
    session = sessions[left_out_index]
    other_sessions = [*sessions[:left_out_index], *sessions[left_out_index + 1 :]]
    own_plants = {estimate.name: estimate.fit.plant for estimate in session.record_estimates}
    predictions = [
        PlantPrediction("record", estimate.name, None, estimate.plant, own_plants[estimate.name])
        for estimate in pooled_estimates(other_sessions)
        if estimate.name in own_plants
    ]
    for model_index, model in enumerate(session.welch_models):
        damping = mean_damping(
            [other_session.welch_models[model_index] for other_session in other_sessions]
        )
        plant = Plant(session.beam, damping, session.delay_s, session.tool_inertia_kg_m2)
        predictions.append(
            PlantPrediction("welch", model.fit.structure.name, model.fit.weighting, plant, None)
        )
    return tuple(predictions)


def validate(
    workers: Workers,
    sessions: Sequence[SessionAnalysis],
    band_hz: tuple[float, float] | None,
    on_done: Callable[[int], None],
) -> tuple[tuple[LeaveOneOutResult, ...], tuple[FailedPrediction, ...]]:
    """Predict every session from the others; return prediction errors and sessions not predicted.

    If all workers are lost, all sessions count as not predicted.
    """
    prediction_tasks = [
        (session.source, models_without_session(sessions, i), band_hz)
        for i, session in enumerate(sessions)
    ]
    try:
        task_results = workers.run(leave_one_out_results, prediction_tasks, on_done)
    except CampaignError as error:
        return (), tuple(FailedPrediction(session.source, str(error)) for session in sessions)
    prediction_errors: list[LeaveOneOutResult] = []
    failed_predictions: list[FailedPrediction] = []
    for session, task_result in zip(sessions, task_results, strict=True):
        if isinstance(task_result, FailedTask):
            failed_predictions.append(FailedPrediction(session.source, task_result.reason))
        elif isinstance(task_result, FailedPrediction):
            failed_predictions.append(task_result)
        else:
            prediction_errors.extend(task_result)
    return tuple(prediction_errors), tuple(failed_predictions)


def leave_one_out_results(
    source: RecordSource,
    predictions: Sequence[PlantPrediction],
    band_hz: tuple[float, float] | None,
) -> tuple[LeaveOneOutResult, ...] | FailedPrediction:
    """Return the error of each model in predicting a session's torque from its angle.

    A session that cannot be predicted raises no error, because the others are still usable.
    """
    from analysis.applicability import highest_frequency_hz, record_band_hz
    from analysis.identify import Comparison
    from analysis.record import load_record

    try:
        record = load_record(
            source.path,
            source.part_s,
            highest_hz=highest_frequency_hz(band_hz),
        )
        band_hz = record_band_hz(record, band_hz)
        comparison = Comparison.from_measurement(Measurement.from_record(record), band_hz)
    except session_error_types() as why:
        return FailedPrediction(source, str(why))
    except MemoryError:
        return FailedPrediction(source, "not enough memory to predict it; use fewer --jobs")
    measured_torque_nm = comparison.torque_nm[comparison.retained_samples]
    torque_norm = np.linalg.norm(comparison.spectrum(measured_torque_nm))

    def prediction_error(plant: Plant) -> float:
        """Return the relative error of the torque that a plant predicts."""
        predicted_torque_nm, _ = comparison.torque_predictor.torque(plant)
        return float(
            np.linalg.norm(comparison.spectrum(predicted_torque_nm - measured_torque_nm))
            / torque_norm
        )

    return tuple(
        LeaveOneOutResult(
            source=source,
            method=prediction.method,
            name=prediction.name,
            weighting=prediction.weighting,
            error=prediction_error(prediction.plant),
            own_error=None
            if prediction.own_plant is None
            else prediction_error(prediction.own_plant),
        )
        for prediction in predictions
    )


def group_errors_by_model(
    errors: Sequence[LeaveOneOutResult],
) -> list[tuple[str, str, str | None, tuple[LeaveOneOutResult, ...]]]:
    """Group prediction errors by method, damping structure and weighting.

    The group of the smallest mean error comes first.
    """
    errors_by_model: dict[tuple[str, str, str | None], list[LeaveOneOutResult]] = {}
    for left_out_error in errors:
        errors_by_model.setdefault(
            (left_out_error.method, left_out_error.name, left_out_error.weighting), []
        ).append(left_out_error)
    error_groups = [(*key, tuple(group_errors)) for key, group_errors in errors_by_model.items()]
    return sorted(
        error_groups,
        key=lambda error_group: float(
            np.mean([left_out_error.error for left_out_error in error_group[3]])
        ),
    )
