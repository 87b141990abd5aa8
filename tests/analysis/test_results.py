"""Results of a record: two processes make the Welch fits and fit the whole record."""

import os
from functools import partial
from types import MappingProxyType

import numpy as np
import pytest

import analysis.results
from analysis.identify import MeasurementError
from analysis.models import WelchSettings
from analysis.results import AnalysisOptions, record_result, whole_record
from rigd.runtime.computations import ForkedComputation, computed_in_parallel
from rigd.testing import chirp_signals

PAPER = AnalysisOptions(WelchSettings(), True, True, ())

needs_two_processors = pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="a single processor computes one after the other",
)


@pytest.fixture
def fitted_here(monkeypatch):
    """Have a list of the whole records that this process has fitted."""
    fitted = []

    def noted(record, *settings):
        fitted.append(record.path)
        return whole_record(record, *settings)

    monkeypatch.setattr(analysis.results, "whole_record", noted)
    return fitted


@needs_two_processors
@pytest.mark.fit
@pytest.mark.parametrize("most_bins", [65_536, 300], ids=["short", "long"])
def test_whole_record_is_fitted_in_another_process(
    most_bins, fitted_here, monkeypatch, write_session, tmp_path
):
    """A long record is one whose fits are not stored with their derivatives."""
    for module in ("_comparison", "_modal_problem"):
        monkeypatch.setattr(f"analysis.identify.{module}.MAX_BINS_OF_STORED_RESULTS", most_bins)
    path = write_session(tmp_path / "a.mcap", chirp_signals(sweep_s=30.0))
    welch = []
    result = record_result(path, PAPER, on_welch=welch.append)
    assert fitted_here == []
    assert result.whole.record is result.record is result.welch.record
    assert [each.models for each in welch] == [result.welch.models]
    expected = whole_record(result.record)
    assert result.whole.verdict.sentences == expected.verdict.sentences
    assert result.whole.headline_json() == expected.headline_json()
    np.testing.assert_array_equal(result.whole.fit.residual, expected.fit.residual)


@pytest.mark.fit
def test_welch_fits_alone_if_the_whole_record_cannot_be_fitted(
    monkeypatch, write_session, tmp_path
):
    def refused(*_):
        raise MeasurementError("Nothing is excited.")

    monkeypatch.setattr(analysis.results, "whole_record", refused)
    path = write_session(tmp_path / "a.mcap", chirp_signals(sweep_s=30.0))
    warnings = []
    result = record_result(path, PAPER, warn=warnings.append)
    assert result.whole is None
    assert result.welch is not None
    assert warnings[-1] == "Nothing is excited. Only the Welch fits were run."


def test_read_only_mapping_is_returned_by_another_process():
    mapping = MappingProxyType({"a": MappingProxyType({})})
    with ForkedComputation(lambda: mapping) as computation:
        value = computation.value()
    assert value == mapping
    assert isinstance(value["a"], MappingProxyType)


def test_value_that_cannot_be_returned_is_computed_again():
    with computed_in_parallel(partial(lambda: lambda: 2)) as value:
        assert value()() == 2
