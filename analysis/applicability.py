"""Applicability of the analyses to a record: band of the fits, and use of Welch's method."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.models import (
    MAX_FREQUENCY_TO_RATE_RATIO,
    PAPER_BAND_HZ,
    RECORD_BAND_HZ,
    WelchSettings,
)

if TYPE_CHECKING:
    from analysis.paper.welch_analysis import WelchAnalysis
    from analysis.record import Record

FrequencyBand = tuple[float, float]
"""First and last frequency of a band in Hz."""

WELCH_OMITTED_TEXT: Final = "Welch fits left out: "
"""Start of the sentence that states why the Welch fits were omitted."""

_WELCH_EXCLUSIONS: Final = {
    "step": "a step excites all frequencies at one moment, which averaging over segments loses",
    "move": "a move excites all frequencies at one moment, which averaging over segments loses",
    "touch": "a touch excites little, and a beam in contact responds differently",
    "multisine": "a multisine excites single lines, and segments spread noise between them",
    "modes": "narrow sweeps excite the modes alone, and the response between them is noise",
    "until": "a search excites little except the modes, and the response between them is noise",
}
"""Reasons why Welch's method is not applicable to a session, by the name of its excitation."""

_TOUCH_REMARK: Final = (
    "The session is a touch, but the fits assume a free beam: they are valid only if it touched "
    "nothing. analyze touch estimates where, when and how hard it touched something."
)
"""Remark on a session with a planned touch."""

_TWO_SWEEPS_REMARK: Final = (
    "The session sweeps there and back: the Welch fits use the first sweep alone, those of the "
    "whole record use both."
)
"""Remark on a session with a sweep in both directions."""

COMPLETE_SWEEP_FRACTION: Final = 0.99
"""Fraction of the planned sweep from which it counts as complete, as samples may be missing at the
end."""

_BAND_LIMITED_EXCITATIONS: Final = ("chirp", "multisine", "modes")
"""Excitations that stay between the `start_hz` and `stop_hz` of their session file. A step, a move
or a touch has neither, and the sweeps of a search are planned while it runs."""

_EXCITED_BAND_MARGIN_FACTOR: Final = 1.1
"""Highest frequency of a requested band, relative to that of the excitation. The end of a sweep
excites a little beyond."""


def highest_frequency_hz(requested_band_hz: FrequencyBand | None = None) -> float:
    """Return the highest frequency in Hz that any analysis of a record uses.

    Parameters
    ----------
    requested_band_hz : tuple of float, optional
        Requested band in Hz.
    """
    return (requested_band_hz or RECORD_BAND_HZ)[1]


def record_band_hz(record: Record, requested_band_hz: FrequencyBand | None = None) -> FrequencyBand:
    """Return the frequency band in Hz of the whole-record fits.

    It is the requested band, or else the default band limited by the record's sampling rate and by
    the frequencies of a part of a sweep.

    Parameters
    ----------
    record : Record
        Record of a session.
    requested_band_hz : tuple of float, optional
        Requested band in Hz; used unchanged (see `check_excited_band`).
    """
    return requested_band_hz or _limit_band(RECORD_BAND_HZ, record)


def check_record_band(record: Record, requested_band_hz: FrequencyBand | None) -> None:
    """Raise if a record's sampling rate is too low for a band.

    Parameters
    ----------
    record : Record
        Record of a session.
    requested_band_hz : tuple of float or None
        Requested band, in Hz.

    Raises
    ------
    SettingsError
        The upper end of the band is too high.
    """
    from analysis.paper import SettingsError

    limit_hz = MAX_FREQUENCY_TO_RATE_RATIO * record.rate_hz
    if requested_band_hz is not None and requested_band_hz[1] > limit_hz:
        raise SettingsError(
            f"{record.path}: the band reaches {requested_band_hz[1]:g} Hz, but whole-record fits "
            f"end at {limit_hz:g} Hz, {MAX_FREQUENCY_TO_RATE_RATIO:g} of the rate of "
            f"{record.rate_hz:g} Hz; lower --band."
        )


def check_excited_band(record: Record, requested_band_hz: FrequencyBand | None) -> None:
    """Raise if a requested band of the whole-record fits reaches far beyond the excitation.

    The angle there is noise of its sensor, which the beam does not feel. Nothing is checked if the
    file does not state the band of the excitation.

    Parameters
    ----------
    record : Record
        Record of a session.
    requested_band_hz : tuple of float or None
        Requested band, in Hz.

    Raises
    ------
    MeasurementError
        The upper end of the band is too high.
    """
    from analysis.identify import MeasurementError

    is_band_limited = record.swept_hz is not None or (
        record.metadata.get("excitation") in _BAND_LIMITED_EXCITATIONS
    )
    excited_hz = record.excited_hz if is_band_limited else None
    if requested_band_hz is None or excited_hz is None:
        return
    if requested_band_hz[1] > _EXCITED_BAND_MARGIN_FACTOR * excited_hz[1]:
        raise MeasurementError(
            f"{record.path}: the band reaches {requested_band_hz[1]:g} Hz, but the excitation "
            f"covers {excited_hz[0]:.4g} to {excited_hz[1]:.4g} Hz, and beyond there is noise "
            f"alone; whole-record fits need a --band that ends at {excited_hz[1]:.4g} Hz or lower."
        )


def welch_settings(
    record: Record, settings: WelchSettings, requested_band_hz: FrequencyBand | None = None
) -> WelchSettings:
    """Return the settings of the Welch fits with the requested band or the default one.

    The default is the band of the reference paper, limited by the record's sampling rate. Another
    band in the settings counts as requested. A band from 0 Hz begins at the first frequency above
    it, because a constant contains no information.

    Parameters
    ----------
    record : Record
        Record of a session.
    settings : WelchSettings
        Requested settings.
    requested_band_hz : tuple of float, optional
        Requested band, in Hz.
    """
    if requested_band_hz is None and settings.band_hz != PAPER_BAND_HZ:
        requested_band_hz = settings.band_hz
    first_hz, last_hz = requested_band_hz or _limit_band(PAPER_BAND_HZ, record)
    settings = _scale_to_decimated_rate(settings, record)
    if first_hz == 0.0:
        first_hz = record.rate_hz / settings.segmentation(record.rate_hz).nfft
    return replace(settings, band_hz=(first_hz, last_hz))


def _scale_to_decimated_rate(settings: WelchSettings, record: Record) -> WelchSettings:
    """Convert segment, overlap and FFT length from samples of the file to samples of the record.

    They differ if the record was decimated while it was read.
    """
    rate_ratio = record.rate_hz / record.full_rate.rate_hz
    if rate_ratio == 1:
        return settings
    segment_length, overlap, nfft = (
        None if length is None else round(length * rate_ratio)
        for length in (settings.segment_length, settings.overlap, settings.nfft)
    )
    return replace(settings, segment_length=segment_length, overlap=overlap, nfft=nfft)


def analysis_remarks(
    record: Record, requested_band_hz: FrequencyBand | None = None
) -> tuple[str, ...]:
    """Return sentences on adaptations of the analysis to a record, such as a lower band.

    Parameters
    ----------
    record : Record
        Record of a session.
    requested_band_hz : tuple of float, optional
        Requested band, in Hz.
    """
    remark_sentences = (_TOUCH_REMARK,) if record.metadata.get("excitation") == "touch" else ()
    if record.outward_sweep is not None:
        remark_sentences = (*remark_sentences, _TWO_SWEEPS_REMARK)
    if record.decimated_from is not None:
        remark_sentences = (
            *remark_sentences,
            f"The record is long ({record.decimated_from.samples / record.full_rate.rate_hz:.0f} "
            f"s): it was decimated from {record.full_rate.rate_hz:g} to {record.rate_hz:g} Hz "
            f"while it was read, which preserves frequencies up to "
            f"{MAX_FREQUENCY_TO_RATE_RATIO * record.rate_hz:g} Hz.",
        )
    first_hz, last_hz = record_band_hz(record, requested_band_hz)
    if requested_band_hz is not None or (first_hz, last_hz) == RECORD_BAND_HZ:
        return remark_sentences
    if record.swept_hz is not None:
        return (
            *remark_sentences,
            f"Fits use {first_hz:.4g} to {last_hz:.4g} Hz, which this part of the sweep covers: "
            "there is only noise beyond.",
        )
    return (
        *remark_sentences,
        f"Fits end at {last_hz:g} Hz, {MAX_FREQUENCY_TO_RATE_RATIO:g} of the record's rate of "
        f"{record.rate_hz:g} Hz, instead of {RECORD_BAND_HZ[1]:g} Hz.",
    )


def welch_analysis(
    record: Record,
    settings: WelchSettings,
    requested_band_hz: FrequencyBand | None = None,
    *,
    is_optional: bool,
) -> tuple[WelchAnalysis | None, str | None]:
    """Run the Welch fits if they are applicable to a record.

    Parameters
    ----------
    record : Record
        Record of a session.
    settings : WelchSettings
        Requested settings.
    requested_band_hz : tuple of float, optional
        Requested band, in Hz.
    is_optional : bool
        Whether the Welch fits may be omitted. Fits with a chosen estimator or chosen segments are
        not omitted.

    Returns
    -------
    analysis : WelchAnalysis or None
        Results of the fits; None if they were omitted.
    left_out : str or None
        Sentence on the reason why they were omitted; None if they were run.

    Raises
    ------
    FrequencyResponseError
        The fits may not be omitted, and cannot be run.
    """
    from analysis.paper import FrequencyResponseError, SettingsError
    from analysis.paper.welch_analysis import analyse

    is_optional = is_optional and settings.are_from_paper
    exclusion_reason = welch_exclusion_reason(record, requested_band_hz) if is_optional else None
    if exclusion_reason is None:
        try:
            return analyse(record, welch_settings(record, settings, requested_band_hz)), None
        except FrequencyResponseError as error:
            if not is_optional or isinstance(error, SettingsError):
                raise
            exclusion_reason = str(error).removeprefix(f"{record.path}: ").removesuffix(".")
    return None, f"{WELCH_OMITTED_TEXT}{exclusion_reason}."


def welch_exclusion_reason(
    record: Record, requested_band_hz: FrequencyBand | None = None
) -> str | None:
    """Return why Welch's method is not applicable to a record, or None if it is.

    The reason is the end of a sentence.

    Parameters
    ----------
    record : Record
        Record of a session.
    requested_band_hz : tuple of float, optional
        Requested band, in Hz.
    """
    excitation = record.metadata.get("excitation", "")
    # A package that adds an excitation states the reason in the session file.
    exclusion = _WELCH_EXCLUSIONS.get(excitation) or record.metadata.get("welch_exclusion", "")
    if exclusion:
        paper_segmentation = WelchSettings().segmentation(record.rate_hz)
        is_long_enough = record.sweep_samples >= paper_segmentation.segment_length
        method_options = "--method welch" if is_long_enough else "--method welch --frf fft"
        return f"{exclusion} ({method_options} computes them nevertheless)"
    if record.part_s is not None:
        return None  # the default band is that of the part
    planned_duration_s = _metadata_number(record, "duration_s")
    swept_duration_s = record.first_sweep_samples / record.rate_hz
    if (
        requested_band_hz is not None
        or planned_duration_s is None
        or swept_duration_s >= COMPLETE_SWEEP_FRACTION * planned_duration_s
    ):
        return None
    reached_hz = _reached_frequency_hz(record, swept_duration_s / planned_duration_s)
    first_hz, last_hz = _limit_band(PAPER_BAND_HZ, record)
    if reached_hz is None or not first_hz < reached_hz < last_hz:
        return None
    return (
        f"the sweep ended after {swept_duration_s:.4g} of {planned_duration_s:g} s, at "
        f"{reached_hz:.3g} Hz, and "
        f"there is only noise beyond; --band {first_hz:g},{reached_hz:.3g} computes them up to "
        "there"
    )


def _reached_frequency_hz(record: Record, duration_fraction: float) -> float | None:
    """Return the frequency in Hz that a rising sweep reaches after a fraction of its duration.

    Return None if the sweep does not rise, or its ends are not stated.
    """
    start_hz, stop_hz = _metadata_number(record, "start_hz"), _metadata_number(record, "stop_hz")
    if start_hz is None or stop_hz is None or stop_hz <= start_hz:
        return None
    return start_hz + duration_fraction * (stop_hz - start_hz)


def _metadata_number(record: Record, metadata_key: str) -> float | None:
    """Return a number in the metadata of a record; None if it is not stated."""
    try:
        return float(record.metadata[metadata_key])
    except (KeyError, ValueError):
        return None


def _limit_band(band_hz: FrequencyBand, record: Record) -> FrequencyBand:
    """Restrict a band to frequencies below the limit of the rate and within the recorded sweep.

    The whole band is returned if nothing remains.
    """
    first_hz, last_hz = band_hz
    limit_hz = min(last_hz, MAX_FREQUENCY_TO_RATE_RATIO * record.rate_hz)
    if record.swept_hz is not None:
        lowest_hz, highest_hz = record.swept_hz
        limit_hz = min(limit_hz, highest_hz)
        if lowest_hz > PAPER_BAND_HZ[0]:  # else the part contains the beginning of the sweep
            first_hz = max(first_hz, lowest_hz)
    return (first_hz, limit_hz) if first_hz < limit_hz else band_hz
