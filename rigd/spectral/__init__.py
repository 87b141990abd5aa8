"""Frequency response estimates from sampled records: Welch (H1, H2, Hv, Hiv), whole-record FFT.

Welch's also while the record grows (`rigd.spectral.running`), and a spectrogram that does
(`rigd.spectral.spectrogram`).
"""

from rigd.spectral.instrumental import instrumental_response
from rigd.spectral.response import Estimator, FrequencyResponse, SpectralError
from rigd.spectral.running import RunningEstimate, RunningResponse
from rigd.spectral.segmentation import (
    PAPER_NFFT,
    PAPER_OVERLAP,
    PAPER_OVERLAP_FRACTION,
    PAPER_RATE_HZ,
    PAPER_SEGMENT_LENGTH,
    PAPER_SEGMENTS,
    Segmentation,
    segment_count,
    segment_lengths,
    segmentation_of,
)
from rigd.spectral.spectrogram import RunningSpectrogram
from rigd.spectral.welch import welch_response
from rigd.spectral.whole_record import fft_response

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
