"""What a worker does to one session, and the little it sends back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.campaigns.errors import task_errors
from analysis.campaigns.estimates import RecordEstimate, WelchFit, structure_name
from analysis.campaigns.experiment import Experiment
from analysis.indices import fit_indices

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.indices import Peak
    from analysis.record import Record
    from analysis.selection import Candidate, Verdict
    from analysis.settings import WelchSettings
    from analysis.whole_record import Setting
    from rigd.beam import Beam
    from rigd.spectral import FrequencyResponse


@dataclass(frozen=True, slots=True)
class SessionFailure:
    """A session of which nothing is used, why, and what experiment it is as far as is known."""

    path: Path
    message: str
    experiment: Experiment | None = None


@dataclass(frozen=True, slots=True)
class SessionResult:
    """One session of a campaign: some 200 kB for the paper's settings.

    Attributes
    ----------
    path : Path
    experiment : Experiment
    beam : Beam
        As the file states it.
    tool_inertia_kg_m2, delay_s : float
        As the file states them; the delay is by how much the torque is older than the angle.
    frequency_hz : ndarray, shape (n,)
        Bins in the band.
    response : ndarray of complex, shape (n,)
        Measured torque per angle in N·m/rad, without the channels' delays.
    peaks : tuple of Peak or None
        Measured resonant peaks, mode by mode.
    welch_fits : tuple of WelchFit
        By type, then by weighting.
    record_estimates : tuple of RecordEstimate
        By type, those of a uniform beam first; empty if none was asked for, or the record could
        not be used.
    verdict : Verdict or None
        What the whole record says by itself, None without estimates.
    warnings : tuple of str
    """

    path: Path
    experiment: Experiment
    beam: Beam
    tool_inertia_kg_m2: float
    delay_s: float
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    peaks: tuple[Peak | None, ...]
    welch_fits: tuple[WelchFit, ...]
    record_estimates: tuple[RecordEstimate, ...]
    verdict: Verdict | None
    warnings: tuple[str, ...]

    @property
    def selected(self) -> str | None:
        """Name of the structure that the session selects by itself, None without a verdict."""
        if self.verdict is None:
            return None
        return structure_name(self.verdict.structure, self.verdict.uniform)


@dataclass(frozen=True, slots=True)
class SessionTask:
    """What is to be done with every session.

    Attributes
    ----------
    settings : WelchSettings
    structures : tuple of str
        Names of those that are kept of the whole-record fits; without any there are none.
    fixed : tuple of str
        Settings that stay at the file's values in those fits.
    record_band_hz : tuple of float
        Band of those fits.
    """

    settings: WelchSettings
    structures: tuple[str, ...]
    fixed: tuple[Setting, ...]
    record_band_hz: tuple[float, float]


def analyse_session(path: Path, task: SessionTask) -> SessionResult | SessionFailure:
    """Read a session, analyse it by both routes.

    A session that cannot be analysed is told, not raised: it is one of many.
    """
    from analysis.record import load_record
    from analysis.welch_route import analyse

    failures = task_errors()
    experiment = None
    try:
        record = load_record(path)
        experiment = Experiment.of(record)
        unfinished = experiment.unfinished(record.outcome)
        if unfinished:
            return SessionFailure(path, f"{path}: {unfinished}", experiment)
        welch = analyse(record, task.settings)
    except failures as error:
        return SessionFailure(path, str(error), experiment)
    except MemoryError:
        return SessionFailure(
            path, f"{path}: there is not memory enough to analyse it; use fewer --jobs."
        )
    warnings = welch.warnings
    estimates: tuple[RecordEstimate, ...] = ()
    verdict = None
    if task.structures:
        try:
            estimates, verdict = _whole_record(record, task, welch.response)
        except failures as error:
            warnings = (*warnings, f"Not in the whole-record estimate: {error}")
        except (MemoryError, np.linalg.LinAlgError) as error:
            why = "there is not memory enough" if isinstance(error, MemoryError) else error
            warnings = (*warnings, f"Not in the whole-record estimate: {path}: {why}")
    return SessionResult(
        path=path,
        experiment=experiment,
        beam=record.beam,
        tool_inertia_kg_m2=record.tool_inertia_kg_m2,
        delay_s=record.torque_delay_s - record.angle_delay_s,
        frequency_hz=welch.response.frequency_hz,
        response=welch.response.response,
        peaks=welch.peaks,
        welch_fits=tuple(map(WelchFit.of, welch.models)),
        record_estimates=estimates,
        verdict=verdict,
        warnings=warnings,
    )


def _whole_record(
    record: Record, task: SessionTask, measured: FrequencyResponse
) -> tuple[tuple[RecordEstimate, ...], Verdict]:
    """Select a structure on the whole record; of all fits, keep it and those asked for."""
    from analysis.selection import select
    from analysis.structures import STRUCTURES
    from analysis.whole_record import Measurement
    from analysis.whole_record.response import ResponseGrid

    measurement = Measurement.of_record(record)
    selection = select(measurement, fixed=task.fixed, band_hz=task.record_band_hz)
    omega = 2 * np.pi * measured.frequency_hz
    grid = ResponseGrid(1j * omega)

    def kept(candidate: Candidate) -> RecordEstimate:
        # The measured response is free of the delay that the file states.
        plant = candidate.fit.plant
        plant = replace(plant, delay_s=plant.delay_s - measurement.delay_s)
        response = grid.evaluate(plant)[0]
        return RecordEstimate.of(candidate, fit_indices(omega, measured.response, response))

    order = list(STRUCTURES)
    asked = [
        kept(each)
        for each in selection.candidates
        if each.fit.structure.name in task.structures or each.fit is selection.fit
    ]
    asked.sort(key=lambda each: (not each.uniform, order.index(each.structure)))
    return tuple(asked), selection.verdict
