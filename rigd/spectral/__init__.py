"""Frequency response estimates from sampled records: Welch (H1, H2, Hv, Hiv), whole-record FFT.

Welch's also while the record grows (`rigd.spectral.running`), and a spectrogram that does
(`rigd.spectral.spectrogram`).
"""

from rigd.spectral.frf import (
    PAPER_NFFT,
    PAPER_OVERLAP,
    PAPER_OVERLAP_FRACTION,
    PAPER_RATE_HZ,
    PAPER_SEGMENT_LENGTH,
    PAPER_SEGMENTS,
    Estimator,
    FrequencyResponse,
    Segmentation,
    SpectralError,
    fft_response,
    instrumental_response,
    segment_count,
    segment_lengths,
    segmentation_of,
    welch_response,
)
from rigd.spectral.running import RunningEstimate, RunningResponse
from rigd.spectral.spectrogram import RunningSpectrogram

__all__ = [
    "PAPER_NFFT",
    "PAPER_OVERLAP",
    "PAPER_OVERLAP_FRACTION",
    "PAPER_RATE_HZ",
    "PAPER_SEGMENTS",
    "PAPER_SEGMENT_LENGTH",
    "Estimator",
    "FrequencyResponse",
    "RunningEstimate",
    "RunningResponse",
    "RunningSpectrogram",
    "Segmentation",
    "SpectralError",
    "fft_response",
    "instrumental_response",
    "segment_count",
    "segment_lengths",
    "segmentation_of",
    "welch_response",
]
