"""The paper's indices of whole-record fits: against both measured responses, delays and all."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.paper.welch_analysis import fit_indices
from analysis.report import document
from rigd.beam import transfer

pytestmark = pytest.mark.fit


def indices_of_selected(result):
    """The indices of the selected fit in the document: of Welch's response, of the whole record."""
    (fit,) = [fit for fit in document([result])["fits"] if fit.get("selected")]
    return fit["indices"], fit["indices_whole_record"]


def with_fit(result, fit):
    """Return a result whose selected fit is another one."""
    selection = result.whole.selection
    candidates = tuple(
        replace(each, fit=fit) if each.fit is selection.headline.fit else each
        for each in selection.candidates
    )
    selection = replace(selection, candidates=candidates)
    return replace(result, whole=replace(result.whole, selection=selection))


def plain(fit, record, measured, delay_s):
    """The same, straight from Eq. 25."""
    s = 2j * np.pi * measured.frequency_hz
    plant = fit.plant
    model = transfer(s, plant.beam, plant.damping) + plant.tool_inertia_kg_m2 * s**2
    return fit_indices(s.imag, measured.response, model * np.exp(-s * delay_s))


def test_indices_use_eq_25_with_the_estimated_delay(record_result):
    welch, fit = record_result.welch, record_result.whole.fit
    found = indices_of_selected(record_result)
    for indices, measured in zip(found, (welch.response, welch.whole_record), strict=True):
        expected = plain(fit, welch.record, measured, fit.parameters["delay_s"])
        for name, value in indices.items():
            assert value == pytest.approx(getattr(expected, name), rel=1e-9)
    # A delay that the file states is in neither response: it must not count twice.
    stated = replace(welch.record, torque_delay_s=3e-4)
    later = replace(fit, plant=replace(fit.plant, delay_s=fit.plant.delay_s + 3e-4))
    again = indices_of_selected(
        with_fit(replace(record_result, welch=replace(welch, record=stated)), later)
    )
    assert again[0]["mse"] == pytest.approx(found[0]["mse"], rel=1e-9)


def test_document_has_both_indices_of_every_fit(record_result):
    content = document([record_result])
    for fit in content["fits"]:
        for key in ("indices", "indices_whole_record"):
            assert all(value > 0 for value in fit[key].values()), (fit["type"], key)
    by_welch = [fit for fit in content["fits"] if fit["estimator"] == "welch"]
    of_welch = [fit["indices_whole_record"] for fit in by_welch]
    welch = record_result.welch
    for indices, model in zip(of_welch, welch.models, strict=True):
        s = 2j * np.pi * welch.whole_record.frequency_hz
        curve = transfer(s, welch.record.beam, model.fit.damping)
        curve += welch.record.tool_inertia_kg_m2 * s**2
        expected = fit_indices(s.imag, welch.whole_record.response, curve)
        for name, value in indices.items():
            assert value == pytest.approx(getattr(expected, name), rel=1e-9)
    # Welch's estimate is biased: its best fit is not the true structure.
    paper = min(of_welch, key=lambda each: each["wmse"])
    (record,) = [fit for fit in content["fits"] if fit.get("selected")]
    assert record["indices_whole_record"]["wmse"] < paper["wmse"]
    best = min(f["indices"]["wmse"] for f in content["fits"] if f["estimator"] == "welch")
    assert record["indices"]["wmse"] > best


def test_indices_are_null_without_the_paper_method(record_result):
    alone = replace(record_result, welch=None)
    content = document([alone])
    assert {value for fit in content["fits"] for value in fit["indices"].values()} == {None}
