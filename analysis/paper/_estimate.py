"""Estimate of a record's frequency response by Welch's method or another estimator."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from rigd.beam import undamped_frequencies_rad_s
from rigd.spectral import (
    PAPER_OVERLAP_FRACTION,
    PAPER_SEGMENTS,
    FrequencyResponse,
    SpectralError,
    fft_response,
    instrumental_response,
    segment_count,
    segment_lengths,
    welch_response,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.models import WelchSettings
    from analysis.record import Record
    from rigd.spectral import Segmentation


class FrequencyResponseError(ValueError):
    """Error if the requested frequency response cannot be estimated from a record."""


class SettingsError(FrequencyResponseError):
    """Error if settings are inconsistent, or not applicable at a record's sampling rate."""


def estimate(
    record: Record, settings: WelchSettings
) -> tuple[FrequencyResponse, FrequencyResponse]:
    """Estimate the frequency response for the fits, and one without segments for comparison.

    Parameters
    ----------
    record : Record
        One session on its time grid.
    settings : WelchSettings
        Estimator, segments and band.

    Returns
    -------
    response_to_fit, whole_record_response : FrequencyResponse
        Responses in the band of the settings, without the channels' delays. With the estimator
        "fft", both are the same.

    Raises
    ------
    SettingsError
        The segments or the band are not valid at the record's sampling rate.
    FrequencyResponseError
        The record is too short for the segments, or its angle does not move.
    """
    segmentation = settings.segmentation(record.rate_hz)
    _check_band(record, settings.band_hz)
    if settings.estimator != "fft":
        _check_segmentation(record, segmentation)
    # A constant angle causes no torque, but would leak into the lowest bins of both responses.
    relative_angle_rad = record.angle_rad - (record.rest_angle_rad or 0.0)
    try:
        whole_record_response = fft_response(
            relative_angle_rad,
            record.torque_nm,
            record.rate_hz,
            max(segmentation.nfft, len(relative_angle_rad)),
        )
        if settings.estimator == "fft":
            response_to_fit = whole_record_response
        elif settings.estimator == "iv":
            response_to_fit = instrumental_response(
                _relative_reference_rad(record)[record.first_sweep],
                relative_angle_rad[record.first_sweep],
                record.torque_nm[record.first_sweep],
                record.rate_hz,
                **asdict(segmentation),
            )
        else:
            response_to_fit = welch_response(
                relative_angle_rad[record.first_sweep],
                record.torque_nm[record.first_sweep],
                record.rate_hz,
                **asdict(segmentation),
                estimator=settings.estimator,
            )
    except SpectralError as error:
        raise FrequencyResponseError(f"{record.path}: {error}") from error
    try:
        response_to_fit, whole_record_response = (
            estimated_response.band(*settings.band_hz).without_delays(
                input_delay_s=record.angle_delay_s, output_delay_s=record.torque_delay_s
            )
            for estimated_response in (response_to_fit, whole_record_response)
        )
    except SpectralError as error:
        raise SettingsError(f"{record.path}: {error}") from error
    not_finite_bins = np.flatnonzero(~np.isfinite(response_to_fit.response))
    if not_finite_bins.size:
        raise FrequencyResponseError(
            f"{record.path}: the angle has no power at "
            f"{response_to_fit.frequency_hz[not_finite_bins[0]]:g} Hz, so there is no frequency "
            "response there; choose a --band that was excited."
        )
    return response_to_fit, whole_record_response


def _relative_reference_rad(record: Record) -> NDArray[np.float64]:
    """Return the reference angle relative to its start in rad, shape (n,).

    Raise `FrequencyResponseError` if the reference does not move, as in some imported records.
    """
    reference_rad: NDArray[np.float64] = record.reference_rad - record.reference_rad[0]
    if not reference_rad[record.first_sweep].any():
        raise FrequencyResponseError(
            f"{record.path}: the record has no reference that moves, which --frf iv needs; "
            "choose --frf h1."
        )
    return reference_rad


def _check_band(record: Record, band_hz: tuple[float, float]) -> None:
    """Raise if the band exceeds the Nyquist frequency."""
    nyquist_hz = record.rate_hz / 2
    if band_hz[1] > nyquist_hz:
        raise SettingsError(
            f"{record.path}: the band reaches {band_hz[1]:g} Hz, but samples at "
            f"{record.rate_hz:g} Hz contain nothing above {nyquist_hz:g} Hz; lower --band."
        )


def _check_segmentation(record: Record, segmentation: Segmentation) -> None:
    """Raise if `welch_response` would not accept the segments; the message names the options."""
    segment_length, overlap_samples, fft_length = (
        segmentation.segment_length,
        segmentation.overlap,
        segmentation.nfft,
    )
    if overlap_samples >= segment_length:
        raise SettingsError(
            f"The overlap of {overlap_samples} samples must be shorter than a segment of "
            f"{segment_length}; lower --overlap."
        )
    if fft_length < segment_length:
        raise SettingsError(
            f"nfft of {fft_length} samples is shorter than a segment of {segment_length}, which is "
            "padded and never cut; raise --nfft."
        )
    sweep_samples = record.first_sweep_samples
    if segment_count(sweep_samples, segment_length, overlap_samples) == 0:
        raise FrequencyResponseError(
            f"{record.path}: the sweep has {sweep_samples} samples "
            f"({sweep_samples / record.rate_hz:g} s), "
            "fewer than one Welch segment of "
            f"{segment_length}{_segment_length_remedy(sweep_samples)}"
        )


def _segment_length_remedy(sweep_samples: int) -> str:
    """Return the end of a sentence with options that suit a sweep of this many samples."""
    try:
        segment_length, overlap_samples = segment_lengths(
            sweep_samples, PAPER_SEGMENTS, PAPER_OVERLAP_FRACTION
        )
    except SpectralError:
        return "; that is too short for any estimate."
    return (
        f"; --segment {segment_length} --overlap {overlap_samples} makes {PAPER_SEGMENTS} segments "
        "of it, and --frf fft needs none."
    )


def estimate_warnings(
    record: Record, settings: WelchSettings, response: FrequencyResponse
) -> tuple[str, ...]:
    """Return sentences on weaknesses of an estimate, such as few segments or a low resolution."""
    warning_sentences = []
    is_welch = settings.estimator != "fft"
    segment_length = (
        settings.segmentation(record.rate_hz).segment_length if is_welch else len(record.time_s)
    )
    if is_welch and response.segments < PAPER_SEGMENTS:
        warning_sentences.append(
            f"Only {response.segments} Welch segment(s) of {segment_length} samples fit the sweep "
            f"of {record.first_sweep_samples}{_segment_length_remedy(record.first_sweep_samples)}"
        )
    resolution_hz = record.rate_hz / segment_length
    first_mode_hz = undamped_frequencies_rad_s(record.beam, 1)[0] / (2 * np.pi)
    if resolution_hz > first_mode_hz:
        warning_sentences.append(
            f"A transform of {1 / resolution_hz:.3g} s resolves {resolution_hz:.3g} Hz and cannot "
            f"show the first mode, at {first_mode_hz:.3g} Hz; take longer segments, or record "
            "longer."
        )
    excited_hz = record.excited_hz
    first_hz, last_hz = settings.band_hz
    if excited_hz is not None and (excited_hz[0] > first_hz or excited_hz[1] < last_hz):
        warning_sentences.append(
            f"The band {first_hz:g} to {last_hz:g} Hz reaches beyond the excitation "
            f"({excited_hz[0]:g} to {excited_hz[1]:g} Hz): what was not excited is noise; "
            "narrow --band."
        )
    return tuple(warning_sentences)
