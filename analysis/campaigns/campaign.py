"""A campaign: all sessions analysed in parallel, then what they say together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.campaigns.errors import CampaignError
from analysis.campaigns.nominal import NominalModel, nominal_models
from analysis.campaigns.parameter_statistics import ParameterStatistics, parameter_statistics
from analysis.campaigns.pooled import PooledEstimate, pooled_estimates
from analysis.campaigns.session import (
    SessionFailure,
    SessionResult,
    SessionTask,
    analyse_session,
)
from analysis.campaigns.validation import LeftOutError, forecasts, left_out_errors
from analysis.campaigns.workers import available_cores, dask_cluster, process_pool, run_all
from analysis.settings import WelchSettings
from analysis.structures import STRUCTURES
from analysis.whole_record import BAND_HZ

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from analysis.whole_record import Setting


@dataclass(frozen=True, slots=True)
class Campaign:
    """Results of all sessions, and of all together.

    Attributes
    ----------
    settings : WelchSettings
    record_band_hz : tuple of float
    sessions : tuple of SessionResult
        In the order of the paths.
    failures : tuple of SessionFailure
        Sessions of which nothing is used.
    statistics : tuple of ParameterStatistics
        Table 3.
    nominal : tuple of NominalModel
        By type, then by weighting: Table 4 and Figures 6 and 7.
    pooled : tuple of PooledEstimate
        Of the structures that two sessions or more determine; empty without whole-record fits.
    validation : tuple of LeftOutError
        Session by session; empty with fewer than three sessions.
    """

    settings: WelchSettings
    record_band_hz: tuple[float, float]
    sessions: tuple[SessionResult, ...]
    failures: tuple[SessionFailure, ...]
    statistics: tuple[ParameterStatistics, ...]
    nominal: tuple[NominalModel, ...]
    pooled: tuple[PooledEstimate, ...]
    validation: tuple[LeftOutError, ...]


def campaign(
    paths: Sequence[Path],
    settings: WelchSettings | None = None,
    *,
    structures: Sequence[str] = tuple(STRUCTURES),
    fixed: Sequence[Setting] = (),
    record_band_hz: tuple[float, float] = BAND_HZ,
    jobs: int | None = None,
    dask: str | None = None,
    on_progress: Callable[[int, int, str], None] = lambda _done, _total, _what: None,
) -> Campaign:
    """Analyse a campaign of sessions of one specimen on one rig.

    Every session goes by the paper's route (`analysis.welch_route`) and by the whole-record
    estimator (`analysis.whole_record`); each is then predicted from the others.

    Parameters
    ----------
    paths : sequence of Path
        Session files.
    settings : WelchSettings, optional
        Of the paper's route, by default the paper's.
    structures : sequence of str
        Types fitted to the whole records; none leaves those fits, pooling and their validation out.
    fixed : sequence of str
        Settings of rig and specimen that stay at the file's values in those fits.
    record_band_hz : tuple of float
        Band of those fits, and of the validation.
    jobs : int, optional
        Worker processes, by default one a core.
    dask : str, optional
        Address of a Dask scheduler whose workers are used instead; they find the files under the
        same absolute paths.
    on_progress : callable, optional
        Called with the steps done, their number and a file's name.

    Raises
    ------
    CampaignError
        No session could be analysed, or the workers could not be had.

    Notes
    -----
    Worker processes import the calling script anew, so a script has to call this under
    ``if __name__ == "__main__":``.
    """
    if not paths:
        raise CampaignError("A campaign needs session files, and none was given.")
    if dask is not None:
        paths = [path.absolute() for path in paths]
    settings = settings or WelchSettings()
    task = SessionTask(settings, tuple(structures), tuple(fixed), record_band_hz)
    done, total = 0, 2 * len(paths)

    def step(name: str) -> None:
        nonlocal done
        done += 1
        on_progress(done, total, name)

    workers = process_pool(min(jobs or available_cores(), len(paths)))
    with workers if dask is None else dask_cluster(dask) as executor:
        results = run_all(
            executor,
            analyse_session,
            [(path, task) for path in paths],
            lambda i: step(paths[i].name),
        )
        sessions, failures = _of_one_specimen(results)
        if not sessions:
            raise CampaignError(
                "No session could be analysed:\n" + "\n".join(f.message for f in failures)
            )
        validation: tuple[LeftOutError, ...] = ()
        if len(sessions) > 2:
            total = len(paths) + len(sessions)
            trials = [
                (session.path, forecasts(sessions, i), record_band_hz)
                for i, session in enumerate(sessions)
            ]
            names = [session.path.name for session in sessions]
            errors = run_all(executor, left_out_errors, trials, lambda i: step(names[i]))
            validation = tuple(error for each in errors for error in each)
    return Campaign(
        settings=settings,
        record_band_hz=record_band_hz,
        sessions=tuple(sessions),
        failures=tuple(failures),
        statistics=parameter_statistics(sessions),
        nominal=nominal_models(sessions),
        pooled=pooled_estimates(sessions),
        validation=validation,
    )


def _of_one_specimen(
    results: Sequence[SessionResult | SessionFailure],
) -> tuple[list[SessionResult], list[SessionFailure]]:
    """Set aside what failed, and what is not of the first session's specimen and bins."""
    sessions: list[SessionResult] = []
    failures: list[SessionFailure] = []
    for result in results:
        if isinstance(result, SessionFailure):
            failures.append(result)
            continue
        difference = _difference(sessions[0], result) if sessions else None
        if difference is None:
            sessions.append(result)
        else:
            failures.append(SessionFailure(result.path, f"{result.path}: {difference}"))
    return sessions, failures


def _difference(first: SessionResult, other: SessionResult) -> str | None:
    """Say why two sessions cannot be averaged, None if they can."""
    for key, one, two, unit in (
        ("beam_length_m", first.beam.length_m, other.beam.length_m, "m"),
        (
            "beam_density_kg_per_m",
            first.beam.density_kg_per_m,
            other.beam.density_kg_per_m,
            "kg/m",
        ),
        (
            "beam_bending_stiffness_n_m2",
            first.beam.bending_stiffness_n_m2,
            other.beam.bending_stiffness_n_m2,
            "N·m²",
        ),
        ("tool_inertia_kg_m2", first.tool_inertia_kg_m2, other.tool_inertia_kg_m2, "kg·m²"),
    ):
        if one != two:
            return (
                f"{key} is {two:g} {unit}, but {one:g} {unit} in {first.path}; a campaign is of "
                "one specimen: analyse this one by itself, or correct the metadata."
            )
    if not np.array_equal(first.frequency_hz, other.frequency_hz):
        return (
            f"its estimate has {len(other.frequency_hz)} bins from {other.frequency_hz[0]:g} Hz, "
            f"but that of {first.path} {len(first.frequency_hz)} from {first.frequency_hz[0]:g} "
            "Hz, so they cannot be averaged: their rates differ; analyse this one by itself, or "
            "leave --segment and --nfft to the defaults."
        )
    return None
