"""How a record is divided into the segments of Welch's estimate, the paper's way by default."""

from dataclasses import dataclass
from typing import Final

from rigd.spectral.response import SpectralError

PAPER_RATE_HZ: Final = 1000.0
PAPER_SEGMENT_LENGTH: Final = 17266
PAPER_OVERLAP: Final = 2590
PAPER_NFFT: Final = 160_000
PAPER_SEGMENTS: Final = 8
PAPER_OVERLAP_FRACTION: Final = 0.15


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Lengths of Welch's segments, their overlap and their transform, all in samples."""

    segment_length: int = PAPER_SEGMENT_LENGTH
    overlap: int = PAPER_OVERLAP
    nfft: int = PAPER_NFFT


def segmentation_of(samples: int, rate_hz: float) -> Segmentation:
    """Segments for a record of which nothing but the length is known.

    They last as long as the paper's, whose transform they share. A record too short for one of
    those is divided like the paper's, into eight with 15 % of overlap; one too short even for that
    is a single segment.

    Parameters
    ----------
    samples
        Length of the record.
    rate_hz
        Sampling rate.
    """
    scale = rate_hz / PAPER_RATE_HZ
    length, overlap = round(PAPER_SEGMENT_LENGTH * scale), round(PAPER_OVERLAP * scale)
    if length < 2 or segment_count(samples, length, overlap) == 0:
        try:
            length, overlap = segment_lengths(samples, PAPER_SEGMENTS, PAPER_OVERLAP_FRACTION)
        except SpectralError:
            length, overlap = max(samples, 2), 0
    return Segmentation(length, overlap, max(round(PAPER_NFFT * scale), length))


def segment_count(samples: int, segment_length: int, overlap: int) -> int:
    """Whole segments that fit a record; what is left over at its end goes unused."""
    return max(0, (samples - overlap) // (segment_length - overlap))


def segment_lengths(samples: int, segments: int, overlap_fraction: float) -> tuple[int, int]:
    """Longest segments that fit a record `segments` times, and their overlap in samples.

    The overlap is rounded to the nearest sample. Rounding it down, as is usual, makes eight
    segments of 15 % overlap miss a record of 120 000 samples by five: seven are then averaged
    without a word, the record ends at 105.3 s and the third resonance of a 120 s chirp is lost.

    Returns
    -------
    (segment_length, overlap) : tuple of int
        ``segment_lengths(120_000, 8, 0.15) == (17266, 2590)``, the paper's.

    Raises
    ------
    SpectralError
        If the record is too short for that many segments.
    """
    if segments < 1 or not 0 <= overlap_fraction < 1:
        raise SpectralError(
            "Welch needs at least one segment and an overlap from 0 to below 1 (a fraction of the "
            f"segment), not {segments} segments with an overlap of {overlap_fraction:g}."
        )

    def end_of_last(length: int) -> int:
        return length + (segments - 1) * (length - round(overlap_fraction * length))

    # The end grows with the length but for jumps of rounding, so start above and walk down.
    length = int(samples / (1 + (segments - 1) * (1 - overlap_fraction))) + segments + 1
    while length > 1 and end_of_last(length) > samples:
        length -= 1
    overlap = round(overlap_fraction * length)
    if length < 2 or overlap >= length or end_of_last(length) > samples:
        raise SpectralError(
            f"A record of {samples} samples is too short for {segments} segments "
            f"with an overlap of {overlap_fraction:.0%}; ask for fewer segments."
        )
    return length, overlap


def check_segmentation(segment_length: int, overlap: int, nfft: int) -> None:
    """Refuse lengths that make no sense together.

    Raises
    ------
    SpectralError
        Naming which, and why.
    """
    if segment_length < 2 or not 0 <= overlap < segment_length:
        raise SpectralError(
            "A Welch segment needs at least 2 samples and an overlap from 0 to below its length, "
            f"not a length of {segment_length} with an overlap of {overlap} samples."
        )
    if nfft < segment_length:
        raise SpectralError(
            f"nfft = {nfft} samples is shorter than a segment of {segment_length}: "
            "segments are padded to nfft, never cut; choose it at least as long."
        )
