"""Segments of a record of which only the length is known, against those of `analyze`."""

import pytest

from analysis.models import WelchSettings
from rigd.spectral import Segmentation, segment_count, segment_lengths, segmentation_of


@pytest.mark.parametrize("rate_hz", [200.0, 1000.0, 2000.0])
@pytest.mark.parametrize("duration_s", [17.3, 20.0, 60.0, 120.0, 500.0])
def test_long_records_are_divided_as_analyze_does_by_default(rate_hz, duration_s):
    analysts = WelchSettings().segmentation(rate_hz)
    chosen = segmentation_of(round(duration_s * rate_hz), rate_hz)
    assert (chosen.segment_length, chosen.overlap, chosen.nfft) == (
        analysts.segment_length,
        analysts.overlap,
        analysts.nfft,
    )


@pytest.mark.parametrize("samples", [30, 1000, 10_000, 17_265])
def test_short_records_are_divided_as_analyze_advises(samples):
    length, overlap = segment_lengths(samples, 8, 0.15)
    analysts = WelchSettings(segment_length=length, overlap=overlap).segmentation(1000.0)
    assert segmentation_of(samples, 1000.0) == Segmentation(length, overlap, analysts.nfft)
    assert segment_count(samples, length, overlap) >= 8


@pytest.mark.parametrize("samples", [2, 3, 5, 7])
def test_shortest_records_are_one_segment(samples):
    assert segmentation_of(samples, 1000.0) == Segmentation(samples, 0, 160_000)
    assert segmentation_of(samples, 1e-3).segment_length == samples


def test_record_of_the_paper():
    assert segmentation_of(120_000, 1000.0) == Segmentation() == Segmentation(17_266, 2590, 160_000)
