"""Every output with a number of a record has its validity; found by search.

The record of these tests states no slope: the tip slopes by 0.4 rad, which follows from its angle.
"""

import re
from dataclasses import replace

import pytest

from analysis.report import document, document_text, result_text, summary_table
from analysis.results import RecordResult
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD, linear_model_error
from rigd.session import Validity

pytestmark = pytest.mark.fit

NUMBER_OF_DAMPING = re.compile(r"damping|[ζγαλ]|zeta|gamma", re.IGNORECASE)


def with_stated(result, slope):
    """Let the file of a result state a slope."""
    record = replace(result.record, metadata=dict(result.record.metadata) | {
        "predicted_peak_tip_slope_rad": slope})  # fmt: skip
    whole = result.whole and replace(result.whole, record=record)
    return RecordResult(record, whole, result.welch)


def outputs(result, as_text):
    """Everything that is printed or written of results, but the files of a report."""
    return {
        "terminal": as_text(result_text(result, verbose=False)),
        "terminal, verbose": as_text(result_text(result, verbose=True)),
        "JSON": document_text(document([result])),
        "summary of several": as_text(summary_table([result, result])),
    }


def test_every_output_with_a_damping_has_its_validity(record_result, report, as_text):
    validity = record_result.validity
    assert validity.predicted_peak_tip_slope_rad > 2 * SMALL_TIP_SLOPE_RAD
    alone = {
        f"{n}, Welch alone": t
        for n, t in outputs(replace(record_result, whole=None), as_text).items()
    }
    written = {
        path.name: path.read_text("utf-8")
        for path in report.rglob("*")
        if path.suffix in (".html", ".tex", ".txt", ".json", ".csv") and path.name != "model.tex"
    }
    assert {
        "report.html",
        "modes.tex",
        "parameters.tex",
        "modes.csv",
        "tables.txt",
    } <= written.keys()
    searched = outputs(record_result, as_text) | alone | written
    found = {name for name, text in searched.items() if NUMBER_OF_DAMPING.search(text)}
    assert len(found) > 15
    # From Welch's fits alone the slope comes out larger: the largest of theirs counts.
    stated = re.compile(r"Tip slopes up to 0\.4\d rad|predicted_peak_tip_slope_rad\W+0\.4|"
                        r"predicted_peak_tip_slope_rad,linear_model_error")  # fmt: skip
    assert not [name for name in found if not stated.search(searched[name])]


def test_unstated_slope_is_computed_from_the_record(record_result):
    from_record = record_result.validity.predicted_peak_tip_slope_rad
    assert from_record == pytest.approx(0.41, rel=0.1)
    error = record_result.validity.linear_model_error
    assert error == linear_model_error(from_record)
    by_welch = replace(record_result, whole=None).validity.predicted_peak_tip_slope_rad
    assert by_welch == pytest.approx(from_record, rel=0.25)
    assert replace(record_result, whole=None, welch=None).validity == Validity()


@pytest.mark.parametrize("slope", ["", "none", "nan", "-1", "inf", "1e300"])
def test_invalid_slope_statement_is_ignored(record_result, slope):
    from_record = record_result.validity
    assert with_stated(record_result, slope).validity == from_record
    unknown = with_stated(RecordResult(record_result.record), slope)
    assert "unknown" in unknown.validity.sentence


@pytest.mark.parametrize(
    ("slope", "words"),
    [
        ("0.6029983975187319", "Tip slopes up to 0.6 rad; error of the linear model at most 12 %."),
        ("0.13", "Tip slopes up to 0.13 rad; error of the linear model at most 0.56 %."),
        ("0.01", "Tip slopes up to 0.01 rad; error of the linear model below 0.1 %."),
        ("1.8", "Tip slopes up to 1.8 rad: the linear model does not hold there (error above"),
    ],
)
def test_stated_slope_is_in_verdict_and_document(record_result, slope, words):
    result = with_stated(record_result, slope)
    assert result.whole.verdict.sentences[1].startswith(words)
    content = document([result])
    for each in (content["headlines"][0], content["files"][0]):
        assert each["validity"]["predicted_peak_tip_slope_rad"] == float(slope)
        assert each["validity"]["linear_model_error"] == linear_model_error(float(slope))
        assert each["validity"]["sentence"].startswith(words)
    assert content["records"][0]["verdict"][1].startswith(words)
