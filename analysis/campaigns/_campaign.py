"""Analysis of a campaign: all sessions in parallel, then their combined results."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.campaigns._experiment import (
    CampaignError,
    complete_labels,
    distinct_names,
    most_common_index,
    stated_specimens,
)
from analysis.campaigns._homogeneity import Homogeneity, homogeneity
from analysis.campaigns._modal import PooledModal, pooled_modal
from analysis.campaigns._orders import freest_estimate
from analysis.campaigns._session import (
    SessionAnalysis,
    SessionFailure,
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
from analysis.campaigns._validation import FEWEST_SESSIONS, LeftOutError, LostTrial, validate
from analysis.campaigns._verdict import CampaignVerdict, campaign_verdict
from analysis.campaigns._welch_bias import WelchBias, welch_biases
from analysis.campaigns.pooling import PooledEstimate, PooledMode, pooled_estimates
from analysis.campaigns.workers import LostTask, available_cores, dask_cluster, process_pool
from analysis.models import STRUCTURES, WelchSettings
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
    modal : PooledModal or None
        Modal model of all sessions, and the nearly uniform beam estimated from it; None unless two
        sessions show a common mode.
    verdict : CampaignVerdict or None
        Structure that the data support, and further findings; None without pooled estimates.
    validation : tuple of LeftOutError
        Errors of each session predicted from the others; empty with fewer than three sessions.
    lost_trials : tuple of LostTrial
        Sessions that could not be predicted from the others. With three sessions or more, each
        session is in `validation` or in `lost_trials`.
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
    modal: PooledModal | None
    verdict: CampaignVerdict | None
    validation: tuple[LeftOutError, ...]
    lost_trials: tuple[LostTrial, ...]

    @property
    def headline(self) -> PooledEstimate | None:
        """Pooled estimate whose parameters are reported (`freest_estimate`); None without one."""
        return freest_estimate(self.pooled)

    @property
    def modes(self) -> tuple[PooledMode, ...]:
        """Modes pooled over all sessions, of the modal model or of an exactly uniform beam."""
        if self.modal is not None and self.modal.leads:
            return self.modal.modes
        return self.headline.modes if self.headline else ()

    @property
    def validity(self) -> Validity:
        """Validity of the linear model for the campaign: the combined_validity of its sessions."""
        return combined_validity(session.validity for session in self.sessions)

    @property
    def trials(self) -> int:
        """Number of sessions that were to be predicted from the others."""
        return len(self.sessions) if len(self.sessions) >= FEWEST_SESSIONS else 0


def campaign(
    paths: Sequence[Path],
    settings: WelchSettings | None = None,
    *,
    structures: Sequence[str] = tuple(STRUCTURES),
    fixed: Sequence[Setting] = (),
    band_hz: tuple[float, float] | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    uniformity: float | None = None,
    workers: Workers | None = None,
    on_progress: Callable[[int, int, str], None] = lambda _done, _total, _what: None,
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
    structures : sequence of str
        Structures of the whole-record fits to choose from. An empty sequence omits these fits,
        the verdict and the validation of the fits.
    fixed : sequence of str
        Parameters of rig and specimen that stay at the file's values in the whole-record fits.
    band_hz : tuple of float, optional
        Frequency band of all fits and of the validation; by default chosen for each record.
    jobs : int, optional
        Number of worker processes, by default one per core.
    dask : str, optional
        Address of a Dask scheduler whose workers are used instead of processes on this machine.
        These workers need the files under the same absolute paths.
    uniformity : float, optional
        Relative standard deviation of each mode's frequency from the frequency of a uniform beam,
        instead of the value stated in the files.
    workers : Workers, optional
        Existing workers, used instead of `jobs` and `dask`. They remain open.
    on_progress : callable, optional
        Called after each step with the number of finished steps, the number of all steps, and the
        name of the file.

    Raises
    ------
    CampaignError
        No session could be analysed, or no workers are available.

    Notes
    -----
    Worker processes import the calling script again, so a script has to call this under
    ``if __name__ == "__main__":``.
    """
    if not paths:
        raise CampaignError("A campaign needs session files, and none was given.")
    if dask is not None:
        paths = [path.absolute() for path in paths]
    settings = settings or WelchSettings()
    task = SessionTask(settings, tuple(structures), tuple(fixed), band_hz, uniformity)
    done, total = 0, 2 * len(paths)

    def report_step(name: str) -> None:
        """Report the completion of a step for a file."""
        nonlocal done
        done += 1
        on_progress(done, total, name)

    worker_context: AbstractContextManager[Workers]
    if workers is not None:
        worker_context = nullcontext(workers)
    elif dask is not None:
        worker_context = dask_cluster(dask)
    else:
        worker_context = process_pool(min(jobs or available_cores(), len(paths)))
    with worker_context as ready_workers:
        results = ready_workers.run(
            analyse_session, [(path, task) for path in paths], lambda i: report_step(paths[i].name)
        )
        sessions, failures = _separate_experiments(
            [
                SessionFailure(path, f"{path}: {result.reason}; analyse it by itself.")
                if isinstance(result, LostTask)
                else result
                for path, result in zip(paths, results, strict=True)
            ]
        )
        if not sessions:
            raise CampaignError(
                "No session could be analysed:\n" + "\n".join(f.message for f in failures)
            )
        validation: tuple[LeftOutError, ...] = ()
        lost: tuple[LostTrial, ...] = ()
        if len(sessions) >= FEWEST_SESSIONS:
            total = len(paths) + len(sessions)
            names = [session.path.name for session in sessions]
            validation, lost = validate(
                ready_workers, sessions, band_hz, lambda i: report_step(names[i])
            )
    return campaign_result(sessions, failures, validation, lost)


def campaign_result(
    sessions: Sequence[SessionAnalysis],
    failures: Sequence[SessionFailure] = (),
    validation: Sequence[LeftOutError] = (),
    lost: Sequence[LostTrial] = (),
) -> CampaignResult:
    """Return the combined result of sessions of one experiment.

    Parameters
    ----------
    sessions : sequence of SessionAnalysis
        Results of the sessions, at least one.
    failures : sequence of SessionFailure, optional
        Sessions that are not used.
    validation : sequence of LeftOutError, optional
        Errors of the sessions that were predicted from the others.
    lost : sequence of LostTrial, optional
        Sessions that could not be predicted from the others.
    """
    names = distinct_names(
        [*(session.path for session in sessions), *(session.path for session in failures)]
    )
    sessions = [replace(session, name=name) for session, name in zip(sessions, names, strict=False)]
    failures = [
        replace(session, name=name)
        for session, name in zip(failures, names[len(sessions) :], strict=True)
    ]
    pooled = pooled_estimates(sessions)
    usable = [(session.name, session.experiment) for session in sessions]
    left_out = [(session.name, session.experiment) for session in failures]
    specimens = stated_specimens([*usable, *left_out], sessions[0].experiment)
    homogeneity_test = homogeneity(sessions, pooled, specimens)
    biases = welch_biases(sessions, pooled)
    modal = pooled_modal(sessions)
    return CampaignResult(
        settings=sessions[0].settings,
        record_band_hz=sessions[0].record_band_hz,
        sessions=tuple(sessions),
        failures=tuple(failures),
        statistics=parameter_statistics(sessions),
        nominal=nominal_models(sessions),
        welch_biases=biases,
        homogeneity=homogeneity_test,
        structures=ranked_structures(sessions, pooled),
        pooled=pooled,
        modal=modal,
        verdict=campaign_verdict(
            sessions, pooled, homogeneity_test, validation, lost, biases, modal
        ),
        validation=tuple(validation),
        lost_trials=tuple(lost),
    )


def _separate_experiments(
    results: Sequence[SessionAnalysis | SessionFailure],
) -> tuple[list[SessionAnalysis], list[SessionFailure]]:
    """Separate the usable sessions of the most common experiment from all other sessions."""
    usable = [result for result in results if isinstance(result, SessionAnalysis)]
    if not usable:
        return [], [result for result in results if isinstance(result, SessionFailure)]
    results = _complete_labels(results)
    usable = [result for result in results if isinstance(result, SessionAnalysis)]
    common = usable[most_common_index([session.experiment for session in usable])]
    stated = [result.experiment for result in results if result.experiment]
    agreeing = sum(common.experiment.difference(experiment) is None for experiment in stated)
    majority_text = ", as in most" if 2 * agreeing > len(stated) else ""
    sessions: list[SessionAnalysis] = []
    failures: list[SessionFailure] = []
    for result in results:
        reason = _exclusion_reason(result, common, majority_text, sessions)
        if reason is None and isinstance(result, SessionAnalysis):
            sessions.append(result)
        elif reason is None and isinstance(result, SessionFailure):
            failures.append(result)
        else:
            failures.append(
                SessionFailure(result.path, f"{result.path}: {reason}", result.experiment)
            )
    return _equalize_welch_fits(sessions, failures)


def _equalize_welch_fits(
    sessions: list[SessionAnalysis], failures: list[SessionFailure]
) -> tuple[list[SessionAnalysis], list[SessionFailure]]:
    """Use Welch's method for all sessions or for none.

    If only a few sessions have no Welch fits, these sessions are excluded; otherwise, the fits of
    all sessions are omitted. A session that planned its own excitation is never excluded, because
    its record is as informative as any other.
    """
    without_fits = [session for session in sessions if not session.frequency_hz.size]
    if not without_fits:
        return sessions, failures
    any_searched = any(session.experiment.planned_itself for session in without_fits)
    if any_searched or 2 * len(without_fits) >= len(sessions):
        return [session.without_welch() for session in sessions], failures
    excluded = [
        SessionFailure(
            session.path,
            f"{session.path}: {session.warnings[-1]} Most others have them: analyse this one by "
            "itself.",
            session.experiment,
        )
        for session in without_fits
    ]
    return [session for session in sessions if session.frequency_hz.size], [*failures, *excluded]


def _complete_labels(
    results: Sequence[SessionAnalysis | SessionFailure],
) -> list[SessionAnalysis | SessionFailure]:
    """Return the results with the specimens' labels completed (see `complete_labels`)."""
    stated = iter(complete_labels([result.experiment for result in results if result.experiment]))
    return [
        replace(result, experiment=next(stated)) if result.experiment else result
        for result in results
    ]


def _exclusion_reason(
    result: SessionAnalysis | SessionFailure,
    common: SessionAnalysis,
    majority_text: str,
    accepted: Sequence[SessionAnalysis],
) -> str | None:
    """Return why a session does not belong to the campaign, or None if it does.

    `common` is a session of the most common experiment, `accepted` are the sessions accepted so
    far. `majority_text` says in words whether most sessions agree with `common`.
    """
    experiment = result.experiment
    difference = experiment and common.experiment.difference(experiment)
    if difference:
        return (
            f"{difference} in {common.path}{majority_text}; a campaign repeats one experiment on "
            "one "
            "specimen: analyse this one by itself, or correct the metadata."
        )
    if isinstance(result, SessionFailure):
        return None
    for other in accepted:
        if result.path == other.path:
            return "the file is given more than once, and counts once."
        if result.experiment.identity == other.experiment.identity:
            return f"it is the same session as {other.path}, which would count twice."
        if result.digests & other.digests:
            return (
                f"it has samples of {other.path}, noise included, which would count twice: a copy "
                "or a part of that file, or a simulation with the same seed; analyse this one by "
                "itself."
            )
    both_have_welch = common.frequency_hz.size and result.frequency_hz.size
    if both_have_welch and not np.array_equal(common.frequency_hz, result.frequency_hz):
        return (
            f"its estimate has {len(result.frequency_hz)} bins from {result.frequency_hz[0]:g} Hz, "
            f"but that of {common.path} {len(common.frequency_hz)} from "
            f"{common.frequency_hz[0]:g} Hz, so they cannot be averaged: their rates differ; "
            "analyse this one by itself, or leave --segment and --nfft to the defaults."
        )
    return None
