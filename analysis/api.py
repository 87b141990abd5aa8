"""Functions of the analyser for scripts: `load`, `frf`, `fit`, `select` and `campaign`.

They run the steps of the command `analyze` and return arrays and plain objects. Error messages are
those of the command; nothing is printed, drawn or written.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from analysis.campaigns import CampaignResult
    from analysis.identify import RecordAnalysis, Selection, Setting
    from analysis.models import WelchSettings
    from analysis.paper.welch_analysis import WelchAnalysis
    from analysis.record import Record
    from analysis.record_part import PartOption
    from rigd.spectral import FrequencyResponse

__all__ = ["campaign", "fit", "frf", "load", "select"]


def load(path: Path | str, part_s: PartOption | None = None) -> Record:
    """Read a session file and return its record on a uniform time grid.

    Parameters
    ----------
    path : Path or str
        Session file (``.mcap``, see ``docs/session_format.md``).
    part_s : tuple of float or None, optional
        Beginning and end of the part to be read, in seconds since the session's start; None for
        the session's beginning or end. By default, the whole session is read.

    Returns
    -------
    Record
        Time in s, angles in rad, torque in N·m on a uniform grid; specimen, delays, metadata.

    Raises
    ------
    SessionError
        The file cannot be read.
    RecordError
        The file can be read, but not analysed.

    Examples
    --------
    >>> from analysis import api
    >>> record = api.load("session.mcap")
    >>> print(record.time_s.size, record.rate_hz, record.outcome)
    21500 1000.0 complete
    """
    from analysis.record import load_record

    return load_record(Path(path), part_s)


def frf(record: Record, settings: WelchSettings | None = None) -> FrequencyResponse:
    """Estimate the frequency response from motor angle to coupling torque.

    Parameters
    ----------
    record : Record
        Record of a session.
    settings : WelchSettings, optional
        Estimator, segments and band; by default those of the reference paper, limited by the
        record's rate.

    Returns
    -------
    FrequencyResponse
        Response in N·m/rad, without the channel delays stated in the file, and its coherence.

    Raises
    ------
    FrequencyResponseError
        The settings are not applicable to the record, or its angle does not move.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis import api
    >>> response = api.frf(api.load("session.mcap")).band(1, 5)
    >>> peak = np.argmax(np.abs(response.response))
    >>> print(f"{response.frequency_hz[peak]:.2f} Hz")
    2.56 Hz
    """
    from analysis.applicability import welch_settings
    from analysis.models import WelchSettings
    from analysis.paper import estimate

    return estimate(record, welch_settings(record, settings or WelchSettings()))[0]


@overload
def fit(
    record: Record,
    types: Sequence[str] | None = None,
    *,
    method: Literal["record"] = "record",
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] | None = None,
) -> RecordAnalysis: ...


@overload
def fit(
    record: Record,
    types: Sequence[str] | None = None,
    *,
    method: Literal["welch"],
    weightings: Sequence[str] | None = None,
    band_hz: tuple[float, float] | None = None,
) -> WelchAnalysis: ...


def fit(
    record: Record,
    types: Sequence[str] | None = None,
    *,
    method: Literal["record", "welch"] = "record",
    fixed: Iterable[Setting] = (),
    weightings: Sequence[str] | None = None,
    band_hz: tuple[float, float] | None = None,
) -> RecordAnalysis | WelchAnalysis:
    """Fit damping structures to a record.

    Parameters
    ----------
    record : Record
        Record of a session.
    types : sequence of str, optional
        Names of structures, "I" to "VII". The default is all seven, or the six of the reference
        paper with "welch".
    method : {"record", "welch"}
        Output-error fit to the whole record, or the reference paper's fit to Welch's estimate.
    fixed : iterable of str
        Parameters of beam and rig that stay at the file's values, from
        `analysis.identify.SETTINGS`; for "record" only.
    weightings : sequence of str, optional
        Weightings "const", "omega" and "omega^K", by default the first two; for "welch" only.
    band_hz : tuple of float, optional
        First and last frequency. The default is 0 to 50 Hz, or the reference paper's band with
        "welch", both limited to 0.4 of the record's sampling rate.

    Returns
    -------
    RecordAnalysis or WelchAnalysis
        Results of the method "record" or "welch".

    Raises
    ------
    ValueError
        A type, method or parameter does not exist. Its subclasses `MeasurementError` and
        `FrequencyResponseError` are raised if the record cannot be used.

    Examples
    --------
    >>> from analysis import api
    >>> found = api.fit(api.load("session.mcap"), ["III"], fixed=["delay_s"])
    >>> print(f"{found.fits[0].modes[0].frequency_hz:.2f} Hz")
    2.55 Hz
    """
    if isinstance(types, str) or isinstance(fixed, str) or isinstance(weightings, str):
        raise ValueError('Give names in a list, if only one: ["VI"] and not "VI".')
    from analysis.models import STRUCTURES

    unknown_types = [type_name for type_name in types or () if type_name not in STRUCTURES]
    if unknown_types:
        raise ValueError(
            f"There is no model type {', '.join(map(repr, unknown_types))}; choose from "
            f"{', '.join(STRUCTURES)}."
        )
    if method == "record":
        from analysis.applicability import check_excited_band, record_band_hz
        from analysis.identify import Measurement, fit_record

        check_excited_band(record, band_hz)
        return fit_record(
            Measurement.from_record(record),
            [STRUCTURES[type_name] for type_name in types or STRUCTURES],
            fixed_settings=fixed,
            band_hz=record_band_hz(record, band_hz),
        )
    if method == "welch":
        from analysis.applicability import welch_settings
        from analysis.models import PAPER_TYPES, PAPER_WEIGHTINGS, WelchSettings
        from analysis.paper.welch_analysis import analyse

        settings = WelchSettings(
            types=tuple(types or PAPER_TYPES),
            weightings=tuple(weightings or PAPER_WEIGHTINGS),
        )
        return analyse(record, welch_settings(record, settings, band_hz))
    raise ValueError(f"There is no method {method!r}; choose 'record' or 'welch'.")


def select(
    record: Record,
    *,
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] | None = None,
) -> Selection:
    """Fit every damping structure to a record, and select the best supported one.

    Parameters
    ----------
    record : Record
        Record of a session.
    fixed : iterable of str
        Parameters of beam and rig that stay at the file's values.
    band_hz : tuple of float, optional
        First and last frequency, by default 0 to 50 Hz, limited to 0.4 of the record's sampling
        rate.

    Returns
    -------
    Selection
        Selected fit, verdict in sentences, and all candidates.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    """
    from analysis.results import whole_record

    record_fits = whole_record(record, tuple(fixed), band_hz)
    return replace(record_fits.selection, verdict=record_fits.verdict)


def campaign(
    paths: Iterable[Path | str],
    settings: WelchSettings | None = None,
    *,
    block_s: float | None = None,
    types: Sequence[str] | None = None,
    fixed: Sequence[Setting] = (),
    jobs: int | None = None,
    dask: str | None = None,
) -> CampaignResult:
    """Analyse the sessions of one specimen together, in parallel.

    Parameters
    ----------
    paths : iterable of Path or str
        Session files.
    settings : WelchSettings, optional
        Settings of the Welch fits; by default those of the reference paper.
    block_s : float, optional
        Length in s of the blocks into which each session is divided. A block counts as a session,
        and ``homogeneity`` of the result has the changes with time.
    types : sequence of str, optional
        Structures fitted to the whole records; by default all seven.
    fixed : sequence of str
        Parameters of beam and rig that stay at the files' values in these fits.
    jobs : int, optional
        Number of worker processes, by default one per core.
    dask : str, optional
        Address of a Dask scheduler whose workers are used instead.

    Returns
    -------
    CampaignResult
        Results of the sessions, statistics, nominal models, pooled estimates and validation.

    Raises
    ------
    CampaignError
        No session could be analysed, or no workers are available.

    Notes
    -----
    A script must call this function under ``if __name__ == "__main__":``; a notebook need not.
    """
    from analysis.campaigns import campaign as run
    from analysis.models import STRUCTURES

    return run(
        [Path(path) for path in paths],
        settings,
        block_s=block_s,
        structures=tuple(types or STRUCTURES),
        fixed_parameters=fixed,
        jobs=jobs,
        dask_address=dask,
    )
