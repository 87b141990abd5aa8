"""What an analyst chooses about estimate and fits; the defaults are the paper's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rigd.spectral import (
    PAPER_NFFT,
    PAPER_OVERLAP,
    PAPER_OVERLAP_FRACTION,
    PAPER_RATE_HZ,
    PAPER_SEGMENT_LENGTH,
    Segmentation,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rigd.spectral import Estimator

RECORD_BAND_HZ: Final = (0.0, 50.0)
"""Of the whole-record fits, where the record's rate holds it."""

LARGEST_SHARE_OF_RATE: Final = 0.4
"""Highest frequency that is fitted, over the sampling rate: filters need room up to half of it."""

PAPER_BAND_HZ: Final = (0.5875, 50.0)
PAPER_TYPES: Final = ("I", "II", "III", "IV", "V", "VI")
PAPER_WEIGHTINGS: Final = ("const", "omega")

ESTIMATOR_WORDS: Final[Mapping[Estimator, str]] = {
    "h1": "Welch's H1",
    "h2": "Welch's H2",
    "hv": "Welch's Hv",
    "iv": "Welch's Hiv",
    "fft": "whole-record FFT",
}
"""What reports and figures call an estimator."""


@dataclass(frozen=True, slots=True)
class WelchSettings:
    """How the frequency response is estimated and what is fitted to it.

    Attributes
    ----------
    estimator : {"h1", "h2", "hv", "iv", "fft"}
        "iv" is Hiv, with the reference as instrument; "fft" is the ratio of two
        transforms of the whole record.
    segment_length, overlap, nfft : int, optional
        In samples; None takes the paper's durations at the record's rate, or with a segment given
        15 % of it as overlap and a transform no shorter than it.
    band_hz : tuple of float
        First and last frequency fitted, both included.
    types : tuple of str
        Names of `analysis.structures.STRUCTURES`.
    weightings : tuple of str
        Names that `analysis.weights.weights` knows.
    """

    estimator: Estimator = "h1"
    segment_length: int | None = None
    overlap: int | None = None
    nfft: int | None = None
    band_hz: tuple[float, float] = PAPER_BAND_HZ
    types: tuple[str, ...] = PAPER_TYPES
    weightings: tuple[str, ...] = PAPER_WEIGHTINGS

    @property
    def are_usual(self) -> bool:
        """Whether estimator and segments are the paper's, not chosen for one record."""
        chosen = self.segment_length or self.overlap or self.nfft
        return self.estimator == "h1" and not chosen

    def segmentation(self, rate_hz: float) -> Segmentation:
        """Fill in what was left open: the paper's durations, in samples at this rate."""
        scale = rate_hz / PAPER_RATE_HZ
        length, overlap, nfft = self.segment_length, self.overlap, self.nfft
        if overlap is None:
            overlap = round(
                PAPER_OVERLAP * scale if length is None else PAPER_OVERLAP_FRACTION * length
            )
        if length is None:
            length = round(PAPER_SEGMENT_LENGTH * scale)
        if nfft is None:
            nfft = max(round(PAPER_NFFT * scale), length)
        return Segmentation(length, overlap, nfft)
