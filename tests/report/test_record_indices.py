"""The paper's indices of whole-record fits: against both measured responses, delays and all."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.paper import fit_indices
from analysis.report import document
from analysis.report._document import indices_of_record_fit, whole_record_indices
from rigd.beam import transfer


def plain(fit, record, measured, delay_s):
    """The same, straight from Eq. 25."""
    s = 2j * np.pi * measured.frequency_hz
    plant = fit.plant
    model = transfer(s, plant.beam, plant.damping) + plant.tool_inertia_kg_m2 * s**2
    return fit_indices(s.imag, measured.response, model * np.exp(-s * delay_s))


def test_they_are_those_of_eq_25_with_the_delay_that_was_found(record_result):
    welch, fit = record_result.welch, record_result.whole.fit
    found = indices_of_record_fit(fit, welch)
    for indices, measured in zip(found, (welch.response, welch.whole_record), strict=True):
        expected = plain(fit, welch.record, measured, fit.parameters["delay_s"])
        for name, value in indices.items():
            assert value == pytest.approx(getattr(expected, name), rel=1e-9)
    # A delay that the file states is in neither response: it must not count twice.
    stated = replace(welch.record, torque_delay_s=3e-4)
    later = replace(fit, plant=replace(fit.plant, delay_s=fit.plant.delay_s + 3e-4))
    again = indices_of_record_fit(later, replace(welch, record=stated))
    assert again[0]["mse"] == pytest.approx(found[0]["mse"], rel=1e-9)


def test_the_document_has_both_of_every_fit(record_result):
    content = document([record_result])
    for fit in content["fits"]:
        for key in ("indices", "indices_whole_record"):
            assert all(value > 0 for value in fit[key].values()), (fit["type"], key)
    of_welch = whole_record_indices(record_result.welch)
    assert [fit["indices_whole_record"] for fit in content["fits"][: len(of_welch)]] == of_welch
    # Welch's estimate is biased: what suits it best is not what was there.
    paper = min(of_welch, key=lambda each: each["wmse"])
    (record,) = [fit for fit in content["fits"] if fit.get("selected")]
    assert record["indices_whole_record"]["wmse"] < paper["wmse"]
    best = min(f["indices"]["wmse"] for f in content["fits"] if f["estimator"] == "welch")
    assert record["indices"]["wmse"] > best


def test_without_the_paper_s_route_they_are_null(record_result):
    alone = replace(record_result, welch=None)
    content = document([alone])
    assert {value for fit in content["fits"] for value in fit["indices"].values()} == {None}
