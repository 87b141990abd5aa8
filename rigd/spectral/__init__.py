"""Frequency response estimates from sampled records: Welch (H1, H2, Hv) and whole-record FFT."""

from rigd.spectral.response import Estimator, FrequencyResponse, SpectralError
from rigd.spectral.welch import (
    PAPER_NFFT,
    PAPER_OVERLAP,
    PAPER_SEGMENT_LENGTH,
    segment_count,
    segment_lengths,
    welch_response,
)
from rigd.spectral.whole_record import fft_response

__all__ = [
    "PAPER_NFFT",
    "PAPER_OVERLAP",
    "PAPER_SEGMENT_LENGTH",
    "Estimator",
    "FrequencyResponse",
    "SpectralError",
    "fft_response",
    "segment_count",
    "segment_lengths",
    "welch_response",
]
