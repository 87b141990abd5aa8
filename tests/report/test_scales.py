"""The scales and the fit in per cent in a report."""

import json
from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.scales import with_scale_uncertainty
from analysis.report import document
from analysis.report.record_report import report_tables
from analysis.results import RecordResult

pytestmark = pytest.mark.fit

ALL = {"torque_scale": 0.005, "length": 0.0005, "density": 0.003}


def parameters_table(whole):
    _modes, tables, _of_paper = report_tables(RecordResult(whole.record, whole))
    (table,) = [each for each in tables if each.name == "parameters"]
    return table


def notes_of(whole):
    return " ".join(parameters_table(whole).notes)


@pytest.fixture
def stated(record_result):
    """Whole record whose file states some uncertainties."""

    def made(**uncertainty):
        whole = record_result.whole
        return replace(whole, record=replace(whole.record, uncertainty=uncertainty))

    return made


def test_intervals_without_scales_are_called_statistical(stated):
    table = parameters_table(stated())
    assert "combined_low_95" not in table.keys
    notes = " ".join(table.notes)
    assert (
        "Intervals are statistical only. Not included: the uncertainty of torque scale and" in notes
    )
    assert "γ ∝ length⁻⁴, ρ/EI ∝ length⁻⁴, EI ∝ torque scale · length, J ∝ torque scale" in notes
    assert "Mass per length" not in notes
    whole = stated()
    modes, *_ = report_tables(RecordResult(whole.record, whole))
    assert "statistical only" in modes.notes[0]


def test_stated_uncertainties_are_shown_with_statistical_intervals(stated):
    whole = stated(**ALL)
    table = parameters_table(whole)
    rows = {row["parameter"].text: row for row in table.rows}
    combined = with_scale_uncertainty(whole.headline.parameters, ALL)
    stiffness = combined["bending_stiffness_n_m2"]
    ends = rows["EI"]["combined_low_95"].value, rows["EI"]["combined_high_95"].value
    assert ends == stiffness.interval_95
    assert rows["EI"]["combined_std"].value == stiffness.std
    assert ends[1] - ends[0] > 2 * (rows["EI"]["high_95"].value - rows["EI"]["low_95"].value)
    for end in ("low_95", "high_95"):
        assert rows["ζ"][f"combined_{end}"].value == rows["ζ"][end].value
    notes = " ".join(table.notes)
    assert "torque scale 0.5 % and length 0.05 %, in quadrature" in notes
    assert "Not included" not in notes
    assert "Mass per length from the record" in notes
    assert "They agree." in notes


def test_unstated_uncertainties_are_listed(stated):
    notes = notes_of(stated(torque_scale=0.01))
    assert "relative standard uncertainty of torque scale 1 %" in notes
    assert "Not included: the uncertainty of length, which the file does not state" in notes


def test_contradicting_density_is_reported(stated):
    whole = stated(**ALL)
    beam = replace(whole.record.beam, density_kg_per_m=1.05 * whole.record.beam.density_kg_per_m)
    whole = replace(whole, record=replace(whole.record, beam=beam))
    notes = notes_of(whole)
    assert "check torque scale, length and stated density" in notes
    assert "a tip mass or a soft clamp acts alike" in notes


def test_fixed_parameter_has_no_combined_interval(stated):
    whole = stated(**ALL)
    fit = whole.fit
    interval = {k: v for k, v in fit.interval.items() if k != "bending_stiffness_n_m2"}
    headline = replace(whole.headline, fit=replace(fit, interval=interval))
    held = replace(
        whole,
        selection=replace(whole.selection, headline=headline),
        fixed_parameters=("bending_stiffness_n_m2",),
    )
    assert held.parameters_with_scales == {}
    assert "the file's values of EI, which were held" in notes_of(held)


def test_document_has_both_intervals(stated):
    def headline(whole):
        (found,) = document([RecordResult(whole.record, whole)])["headlines"]
        return json.loads(json.dumps(found, allow_nan=False))

    content = headline(stated(**ALL))
    assert content["scale_uncertainty"] == ALL
    assert content["combined"].keys() == {
        "gamma", "density_over_stiffness", "bending_stiffness_n_m2", "tool_inertia_kg_m2",
    }  # fmt: skip
    for name, each in content["combined"].items():
        low, high = content["parameters"][name]["interval_95"]
        assert each["interval_95"][0] <= low < high < each["interval_95"][1]
        assert each["value"] == content["parameters"][name]["value"]
    assert headline(stated())["combined"] == {}


def test_units_of_a_file_are_those_of_its_numbers(record_result):
    rows = {row["parameter"].text: row for row in parameters_table(record_result.whole).rows}
    units = {symbol: (row["unit"].value, row["unit"].text) for symbol, row in rows.items()}
    assert units["ζ"] == ("s^α", "1e-5 s^α")
    assert units["γ"] == ("s^λ/m⁴", "1e-2 s^λ/m⁴")
    assert units["τ"] == ("s", "µs")
    assert units["EI"] == ("N·m²", "N·m²")
    assert units["α"] == ("1", "1")


def test_the_structures_have_their_fit_in_per_cent(record_result):
    whole = record_result.whole
    (table,) = [each for each in report_tables(record_result)[1] if each.name == "structures"]
    by_type = {row["type"]: row["nrmse_percent"] for row in table.rows}
    assert by_type["VI"] == whole.analysis.fit_percent(whole.fit) > by_type["I"]
    assert any("NRMSE" in note for note in table.notes)


def test_every_fit_of_the_document_has_its_per_cent(record_result):
    content = document([record_result])
    by_name = {
        (fit["estimator"], fit["type"], fit["weighting"]): fit["nrmse_percent"]
        for fit in content["fits"]
    }
    assert len(by_name) == len(content["fits"])
    assert all(value < 100 for value in by_name.values())
    for model in record_result.welch.models:
        found = by_name["welch", model.fit.structure.name, model.fit.weighting]
        square = model.indices.mse / np.mean(
            np.abs(
                record_result.welch.response.response - record_result.welch.response.response.mean()
            )
            ** 2
        )
        assert found == pytest.approx(100 * (1 - square**0.5))
