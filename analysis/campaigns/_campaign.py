"""Analysis of a campaign: all sessions in parallel, then their combined results."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.campaigns._experiment import (
    CampaignError,
    SessionFailure,
    add_missing_facts,
    distinct_names,
    most_common_index,
    stated_specimens,
)
from analysis.campaigns._homogeneity import Homogeneity, homogeneity
from analysis.campaigns._modal import PooledModalModel, pooled_modal_model
from analysis.campaigns._session import (
    SessionAnalysis,
    SessionTask,
    analyse_session,
)
from analysis.campaigns._statistics import (
    NominalModel,
    ParameterStatistics,
    RankedStructure,
    nominal_models,
    parameter_statistics,
    ranked_structures,
)
from analysis.campaigns._validation import (
    MIN_VALIDATED_SESSIONS,
    FailedPrediction,
    LeaveOneOutResult,
    validate,
)
from analysis.campaigns._verdict import CampaignVerdict, campaign_verdict
from analysis.campaigns._welch_bias import WelchBias, welch_biases
from analysis.campaigns.pooling import PooledEstimate, PooledMode, freest_estimate, pooled_estimates
from analysis.campaigns.specimen_sentences import WRONG_METADATA_REMEDY
from analysis.campaigns.workers import FailedTask, available_cores, dask_cluster, process_pool
from analysis.models import STRUCTURES, WelchSettings
from analysis.record_part import RecordSource, blocks_of_session
from analysis.validity import combined_validity

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from analysis.campaigns.workers import Workers
    from analysis.identify import Setting
    from rigd.session import Validity


@dataclass(frozen=True, slots=True)
class CampaignResult:
    """Results of the single sessions of a campaign, and of all sessions together.

    Attributes
    ----------
    settings : WelchSettings
        Settings of the Welch fits.
    record_band_hz : tuple of float
        Frequency band of the whole-record fits of most sessions.
    sessions : tuple of SessionAnalysis
        Sessions that are used, in the order of the paths.
    failures : tuple of SessionFailure
        Sessions that are not used.
    statistics : tuple of ParameterStatistics
        Statistics of the Welch fits (Table 3 of the paper). Empty, like `nominal` and
        `welch_biases`, if Welch's method is not applicable to some session.
    nominal : tuple of NominalModel
        Nominal models by type, then by weighting (Table 4 and Figures 6 and 7 of the paper).
    welch_biases : tuple of WelchBias
        Differences of the Welch fits from the pooled estimates, by type, then by weighting.
    homogeneity : Homogeneity
        Whether the sessions are of one specimen.
    structures : tuple of RankedStructure
        Every structure fitted to the whole records, the pooled structures first.
    pooled : tuple of PooledEstimate
        Pooled estimates of the structures that two sessions or more determine, the lowest BIC
        first; empty without whole-record fits.
    modal : PooledModalModel or None
        Modal model of all sessions, and the nearly uniform beam estimated from it; None if no two
        sessions show a common mode.
    verdict : CampaignVerdict or None
        Structure that the data support, and further findings; None without pooled estimates.
    validation : tuple of LeaveOneOutResult
        Errors of each session predicted from the others; empty with fewer than three sessions.
    failed_predictions : tuple of FailedPrediction
        Sessions that could not be predicted from the others. With three sessions or more, each
        session is in `validation` or in `failed_predictions`.
    """

    settings: WelchSettings
    record_band_hz: tuple[float, float]
    sessions: tuple[SessionAnalysis, ...]
    failures: tuple[SessionFailure, ...]
    statistics: tuple[ParameterStatistics, ...]
    nominal: tuple[NominalModel, ...]
    welch_biases: tuple[WelchBias, ...]
    homogeneity: Homogeneity
    structures: tuple[RankedStructure, ...]
    pooled: tuple[PooledEstimate, ...]
    modal: PooledModalModel | None
    verdict: CampaignVerdict | None
    validation: tuple[LeaveOneOutResult, ...]
    failed_predictions: tuple[FailedPrediction, ...]

    @property
    def freest(self) -> PooledEstimate | None:
        """Pooled estimate of an exactly uniform beam with the freest structure, or None.

        It has no flags. `campaign_estimates` has the numbers to report.
        """
        return freest_estimate(self.pooled)

    @property
    def modes(self) -> tuple[PooledMode, ...]:
        """Modes pooled over all sessions, of the modal model or of an exactly uniform beam."""
        if self.modal is not None and self.modal.replaces_beam_modes:
            return self.modal.modes
        return self.freest.modes if self.freest else ()

    @property
    def validity(self) -> Validity:
        """Combined validity of the linear model for all sessions of the campaign."""
        return combined_validity(session.validity for session in self.sessions)

    @property
    def trials(self) -> int:
        """Number of sessions that were to be predicted from the others, failures included."""
        return len(self.sessions) if len(self.sessions) >= MIN_VALIDATED_SESSIONS else 0


def campaign(
    paths: Sequence[Path],
    settings: WelchSettings | None = None,
    *,
    block_s: float | None = None,
    structures: Sequence[str] = tuple(STRUCTURES),
    fixed_parameters: Sequence[Setting] = (),
    band_hz: tuple[float, float] | None = None,
    jobs: int | None = None,
    dask_address: str | None = None,
    uniformity: float | None = None,
    workers: Workers | None = None,
    on_progress: Callable[[int, int, str], None] = lambda _done_steps, _total_steps, _step_name: (
        None
    ),
) -> CampaignResult:
    """Analyse a campaign of sessions of one specimen on one rig.

    Every session is analysed by Welch's method (`analysis.paper`), if it is applicable to all
    sessions, and by a fit to the whole record (`analysis.identify`). Each session is then predicted
    from the others.

    Parameters
    ----------
    paths : sequence of Path
        Session files.
    settings : WelchSettings, optional
        Settings of the Welch fits, by default the paper's.
    block_s : float, optional
        Length in seconds of the blocks into which each session is divided. A block then counts as
        a session. By default, sessions are not divided.
    structures : sequence of str
        Structures of the whole-record fits to choose from. An empty sequence omits these fits,
        the verdict and the validation of the fits.
    fixed_parameters : sequence of str
        Parameters of rig and specimen that stay at the file's values in the whole-record fits.
    band_hz : tuple of float, optional
        Frequency band of all fits and of the validation; by default chosen for each record.
    jobs : int, optional
        Number of worker processes, by default one per core.
    dask_address : str, optional
        Address of a Dask scheduler whose workers are used instead of processes on this machine.
        These workers need the files under the same absolute paths.
    uniformity : float, optional
        Relative standard deviation of each mode's frequency from the frequency of a uniform beam,
        instead of the value stated in the files.
    workers : Workers, optional
        Existing workers, used instead of `jobs` and `dask_address`. They remain open.
    on_progress : callable, optional
        Called after each step with the number of finished steps, the number of all steps, and the
        name of the file.

    Raises
    ------
    CampaignError
        No session could be analysed, or no workers are available.
    SessionError, RecordError
        A session cannot be divided into blocks.

    Notes
    -----
    Worker processes import the calling script again, so a script has to call this under
    ``if __name__ == "__main__":``.
    """
    if not paths:
        raise CampaignError("A campaign needs session files, and none was given.")
    if dask_address is not None:
        paths = [path.absolute() for path in paths]
    if block_s is None:
        sources = [RecordSource(path) for path in paths]
    else:
        sources = [block for path in paths for block in blocks_of_session(path, block_s)]
    settings = settings or WelchSettings()
    session_task = SessionTask(
        settings, tuple(structures), tuple(fixed_parameters), band_hz, uniformity
    )
    done_steps, total_steps = 0, 2 * len(sources)

    def report_step(file_name: str) -> None:
        """Report the completion of a step for a file."""
        nonlocal done_steps
        done_steps += 1
        on_progress(done_steps, total_steps, file_name)

    workers_manager: AbstractContextManager[Workers]
    if workers is not None:
        workers_manager = nullcontext(workers)
    elif dask_address is not None:
        workers_manager = dask_cluster(dask_address)
    else:
        workers_manager = process_pool(min(jobs or available_cores(), len(sources)))
    with workers_manager as ready_workers:
        session_results = ready_workers.run(
            analyse_session,
            [(source, session_task) for source in sources],
            lambda i: report_step(sources[i].name),
        )
        sessions, failures = _separate_experiments(
            [
                SessionFailure(source, f"{source}: {session_result.reason}; analyse it by itself.")
                if isinstance(session_result, FailedTask)
                else session_result
                for source, session_result in zip(sources, session_results, strict=True)
            ]
        )
        if not sessions:
            raise CampaignError(
                "No session could be analysed:\n"
                + "\n".join(failure.message for failure in failures)
            )
        validation: tuple[LeaveOneOutResult, ...] = ()
        failed_predictions: tuple[FailedPrediction, ...] = ()
        if len(sessions) >= MIN_VALIDATED_SESSIONS:
            total_steps = len(sources) + len(sessions)
            session_names = [session.name for session in sessions]
            validation, failed_predictions = validate(
                ready_workers, sessions, band_hz, lambda i: report_step(session_names[i])
            )
    return campaign_result(sessions, failures, validation, failed_predictions)


def campaign_result(
    sessions: Sequence[SessionAnalysis],
    failures: Sequence[SessionFailure] = (),
    validation: Sequence[LeaveOneOutResult] = (),
    failed_predictions: Sequence[FailedPrediction] = (),
) -> CampaignResult:
    """Return the combined result of sessions of one experiment.

    There is at least one session. Those in `failures` are not used. `validation` are the errors of
    the sessions that were predicted from the others, and `failed_predictions` the sessions that
    could not be.
    """
    session_names = distinct_names(
        [*(session.source for session in sessions), *(session.source for session in failures)]
    )
    sessions = [
        replace(session, name=session_name)
        for session, session_name in zip(sessions, session_names, strict=False)
    ]
    failures = [
        replace(session, name=session_name)
        for session, session_name in zip(failures, session_names[len(sessions) :], strict=True)
    ]
    pooled_fits = pooled_estimates(sessions)
    used_experiments = [(session.name, session.experiment) for session in sessions]
    unused_experiments = [(session.name, session.experiment) for session in failures]
    specimens = stated_specimens([*used_experiments, *unused_experiments], sessions[0].experiment)
    homogeneity_test = homogeneity(sessions, pooled_fits, specimens)
    all_welch_biases = welch_biases(sessions, pooled_fits)
    modal_model = pooled_modal_model(sessions)
    return CampaignResult(
        settings=sessions[0].settings,
        record_band_hz=sessions[0].record_band_hz,
        sessions=tuple(sessions),
        failures=tuple(failures),
        statistics=parameter_statistics(sessions),
        nominal=nominal_models(sessions),
        welch_biases=all_welch_biases,
        homogeneity=homogeneity_test,
        structures=ranked_structures(sessions, pooled_fits),
        pooled=pooled_fits,
        modal=modal_model,
        verdict=campaign_verdict(
            sessions,
            pooled_fits,
            homogeneity_test,
            validation,
            failed_predictions,
            all_welch_biases,
            modal_model,
        ),
        validation=tuple(validation),
        failed_predictions=tuple(failed_predictions),
    )


def _separate_experiments(
    session_results: Sequence[SessionAnalysis | SessionFailure],
) -> tuple[list[SessionAnalysis], list[SessionFailure]]:
    """Separate the usable sessions of the most common experiment from all other sessions."""
    usable_sessions = [
        session_result
        for session_result in session_results
        if isinstance(session_result, SessionAnalysis)
    ]
    if not usable_sessions:
        return [], [
            session_result
            for session_result in session_results
            if isinstance(session_result, SessionFailure)
        ]
    session_results = _add_missing_facts(session_results)
    usable_sessions = [
        session_result
        for session_result in session_results
        if isinstance(session_result, SessionAnalysis)
    ]
    reference_session = usable_sessions[
        most_common_index([session.experiment for session in usable_sessions])
    ]
    stated_experiments = [
        session_result.experiment for session_result in session_results if session_result.experiment
    ]
    agreeing_experiment_count = sum(
        reference_session.experiment.difference(experiment) is None
        for experiment in stated_experiments
    )
    majority_text = (
        ", as in most" if 2 * agreeing_experiment_count > len(stated_experiments) else ""
    )
    sessions: list[SessionAnalysis] = []
    failures: list[SessionFailure] = []
    for session_result in session_results:
        reason = _exclusion_reason(session_result, reference_session, majority_text, sessions)
        if reason is None and isinstance(session_result, SessionAnalysis):
            sessions.append(session_result)
        elif reason is None and isinstance(session_result, SessionFailure):
            failures.append(session_result)
        else:
            failures.append(
                SessionFailure(
                    session_result.source,
                    f"{session_result.source}: {reason}",
                    session_result.experiment,
                )
            )
    return _unify_welch_fits(sessions, failures)


def _unify_welch_fits(
    sessions: list[SessionAnalysis], failures: list[SessionFailure]
) -> tuple[list[SessionAnalysis], list[SessionFailure]]:
    """Make all used sessions have Welch fits, or none of them.

    If fewer than half of the sessions have no Welch fits, these sessions become failures; otherwise
    the Welch fits of all sessions are dropped. A session that planned its own excitation is never
    excluded, because its record is as informative as any other.
    """
    sessions_without_fits = [session for session in sessions if not session.frequency_hz.size]
    if not sessions_without_fits:
        return sessions, failures
    is_any_planned_during_session = any(
        session.experiment.is_planned_during_session for session in sessions_without_fits
    )
    if is_any_planned_during_session or 2 * len(sessions_without_fits) >= len(sessions):
        return [session.without_welch() for session in sessions], failures
    excluded_sessions = [
        SessionFailure(
            session.source,
            f"{session.source}: {session.warnings[-1]} Most others have them: analyse this one by "
            "itself.",
            session.experiment,
        )
        for session in sessions_without_fits
    ]
    return [session for session in sessions if session.frequency_hz.size], [
        *failures,
        *excluded_sessions,
    ]


def _add_missing_facts(
    session_results: Sequence[SessionAnalysis | SessionFailure],
) -> list[SessionAnalysis | SessionFailure]:
    """Return the results with the facts of their experiments completed by `add_missing_facts`."""
    completed_experiments = iter(
        add_missing_facts(
            [
                session_result.experiment
                for session_result in session_results
                if session_result.experiment
            ]
        )
    )
    return [
        replace(session_result, experiment=next(completed_experiments))
        if session_result.experiment
        else session_result
        for session_result in session_results
    ]


def _exclusion_reason(
    session_result: SessionAnalysis | SessionFailure,
    reference_session: SessionAnalysis,
    majority_text: str,
    accepted_sessions: Sequence[SessionAnalysis],
) -> str | None:
    """Return why a session does not belong to the campaign, or None if it does.

    `reference_session` is a session of the most common experiment, `accepted_sessions` are the
    sessions accepted so far. The reason contains `majority_text`, which says so if most sessions
    agree with `reference_session`.
    """
    experiment = session_result.experiment
    difference = experiment and reference_session.experiment.difference(experiment)
    if difference:
        return (
            f"{difference} in {reference_session.path}{majority_text}; a campaign repeats one "
            f"experiment on one specimen: analyse this one by itself. {WRONG_METADATA_REMEDY}"
        )
    if isinstance(session_result, SessionFailure):
        return None
    for other_session in accepted_sessions:
        if session_result.source == other_session.source:
            return "the file is given more than once, and counts once."
        if (
            session_result.experiment.session_identifiers
            == other_session.experiment.session_identifiers
        ):
            return f"it is the same session as {other_session.path}, which would count twice."
        if session_result.sample_digests & other_session.sample_digests:
            return (
                f"it has samples of {other_session.path}, noise included, which would count twice: "
                "a copy or a part of that file, or a simulation with the same seed; analyse this "
                "one by itself."
            )
    both_have_welch_fits = reference_session.frequency_hz.size and session_result.frequency_hz.size
    if both_have_welch_fits and not np.array_equal(
        reference_session.frequency_hz, session_result.frequency_hz
    ):
        return (
            f"its estimate has {len(session_result.frequency_hz)} bins from "
            f"{session_result.frequency_hz[0]:g} Hz, but that of {reference_session.path} "
            f"{len(reference_session.frequency_hz)} from "
            f"{reference_session.frequency_hz[0]:g} Hz, so they cannot be averaged: their rates "
            "differ; analyse this one by itself, or leave --segment and --nfft to the defaults."
        )
    return None
