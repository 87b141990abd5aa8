"""What a worker does to one session, and the little it sends back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.campaigns.errors import task_errors

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from analysis.fit_frf import FrfFit
    from analysis.indices import Peak
    from analysis.settings import WelchSettings
    from analysis.whole_record import Plant, RecordFit, Setting
    from rigd.beam import Beam, Damping


@dataclass(frozen=True, slots=True)
class SessionFailure:
    """A session of which nothing is used, and why, in the operator's words."""

    path: Path
    message: str


@dataclass(frozen=True, slots=True)
class WelchFit:
    """One structure fitted to one session by the paper's route, with one weighting.

    Attributes
    ----------
    structure, weighting : str
        Names.
    damping : Damping
    parameters : dict
        zeta, alpha, gamma and lambda, the fixed ones included.
    cost : float
        Eq. (26) at the minimum, in (N·m/rad)².
    at_bounds : tuple of str
        Free parameters that rest on the edge of the range searched.
    """

    structure: str
    weighting: str
    damping: Damping
    parameters: Mapping[str, float]
    cost: float
    at_bounds: tuple[str, ...]

    @classmethod
    def of(cls, fit: FrfFit) -> WelchFit:
        """Keep of a fit what a campaign needs."""
        return cls(
            structure=fit.structure.name,
            weighting=fit.weighting,
            damping=fit.damping,
            parameters=dict(fit.parameters),
            cost=fit.cost,
            at_bounds=fit.at_bounds,
        )


@dataclass(frozen=True, slots=True)
class RecordEstimate:
    """One structure fitted to one whole record.

    Attributes
    ----------
    structure : str
        Name.
    plant : Plant
    parameters : dict of str to float
        See `analysis.whole_record.RecordFit`, as for the following.
    std : dict of str to (float or None)
    determined : tuple of str
    covariance : ndarray, shape (k, k)
    at_bounds : tuple of str
    cost : float
    degrees_of_freedom : int
    """

    structure: str
    plant: Plant
    parameters: Mapping[str, float]
    std: Mapping[str, float | None]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]
    at_bounds: tuple[str, ...]
    cost: float
    degrees_of_freedom: int

    @classmethod
    def of(cls, fit: RecordFit) -> RecordEstimate:
        """Keep of a fit what a campaign needs: all but the residual."""
        return cls(
            structure=fit.structure.name,
            plant=fit.plant,
            parameters=dict(fit.parameters),
            std=dict(fit.std),
            determined=fit.determined,
            covariance=fit.covariance,
            at_bounds=fit.at_bounds,
            cost=fit.cost,
            degrees_of_freedom=fit.degrees_of_freedom,
        )


@dataclass(frozen=True, slots=True)
class SessionResult:
    """One session of a campaign: some 200 kB for the paper's settings.

    Attributes
    ----------
    path : Path
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
        By type; empty if none was asked for, or the record could not be used.
    warnings : tuple of str
    """

    path: Path
    beam: Beam
    tool_inertia_kg_m2: float
    delay_s: float
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    peaks: tuple[Peak | None, ...]
    welch_fits: tuple[WelchFit, ...]
    record_estimates: tuple[RecordEstimate, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SessionTask:
    """What is to be done with every session.

    Attributes
    ----------
    settings : WelchSettings
    structures : tuple of str
        Names of those fitted to the whole record.
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
    """Read a session, estimate and fit by both routes.

    A session that cannot be analysed is told, not raised: it is one of many.
    """
    from analysis.record import load_record
    from analysis.structures import STRUCTURES
    from analysis.welch_route import analyse
    from analysis.whole_record import Measurement, fit_record

    failures = task_errors()
    try:
        record = load_record(path)
        welch = analyse(record, task.settings)
    except failures as error:
        return SessionFailure(path, str(error))
    except MemoryError:
        return SessionFailure(
            path, f"{path}: there is not memory enough to analyse it; use fewer --jobs."
        )
    warnings = welch.warnings
    estimates: tuple[RecordEstimate, ...] = ()
    if task.structures:
        try:
            fits = fit_record(
                Measurement.of_record(record),
                [STRUCTURES[name] for name in task.structures],
                fixed=task.fixed,
                band_hz=task.record_band_hz,
            ).fits
            estimates = tuple(RecordEstimate.of(fit) for fit in fits)
        except failures as error:
            warnings = (*warnings, f"Not in the whole-record estimate: {error}")
    return SessionResult(
        path=path,
        beam=record.beam,
        tool_inertia_kg_m2=record.tool_inertia_kg_m2,
        delay_s=record.torque_delay_s - record.angle_delay_s,
        frequency_hz=welch.response.frequency_hz,
        response=welch.response.response,
        peaks=welch.peaks,
        welch_fits=tuple(WelchFit.of(model.fit) for model in welch.models),
        record_estimates=estimates,
        warnings=warnings,
    )
