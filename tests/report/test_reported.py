"""A number that the verdict withholds is nowhere shown as if it were the antenna's."""

import csv
import re
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.identify.headline import (
    CONTRADICTED_FILE_REASON,
    ConditionalEstimate,
    headline_of_fit,
)
from analysis.models import STRUCTURES
from analysis.report import document, illustrations, result_text
from analysis.report.bands import excited_band_hz, supported_band_hz
from analysis.report.record_report import record_page, report_tables
from analysis.report.table import (
    NOT_REPORTED_MARK,
    Cell,
    csv_text,
    latex_table,
    unreported_parameters,
    with_validity,
)

pytestmark = pytest.mark.fit

ALPHA = frozenset({"alpha"})
PICTURES = tuple(
    SimpleNamespace(name=name, description="A figure.", source="data:image/png;base64,")
    for name in ("one", "two")
)
REASON = "order 1 on another beam explains as much"


@pytest.fixture(scope="module")
def careful(record_result, with_selection):
    """Type VI whose alpha the data do not support, on a record that shows two modes."""
    order = SimpleNamespace(order="alpha", status="open", value=1.05, interval=(0.9, 1.2))
    headline = headline_of_fit(
        "VI", record_result.whole.fit, (1, 2), {"alpha": REASON}, {"alpha": (0.9, 1.2)}
    )
    verdict = replace(record_result.whole.verdict, alpha=order)
    return with_selection(record_result, headline=headline, verdict=verdict)


def test_flag_of_an_order_flags_its_coefficient():
    assert unreported_parameters(STRUCTURES["VI"], ALPHA) == {"alpha", "zeta"}
    assert unreported_parameters(STRUCTURES["III"], {"lambda", "alpha"}) == {
        "zeta", "alpha", "gamma", "lambda"
    }  # fmt: skip
    assert unreported_parameters(STRUCTURES["II"], ALPHA) == frozenset()
    assert unreported_parameters(STRUCTURES["VI"], ()) == frozenset()


def test_tables_mark_flagged_numbers_only(careful):
    modes, (_sizes, parameters, _correlations, structures), (welch, _peaks) = report_tables(careful)
    shown = {row["parameter"].text: row for row in parameters.rows}
    for symbol, name in (("ζ", "zeta"), ("α", "alpha")):
        number = shown[symbol]["value"]
        assert (number.value, number.is_doubtful) == (careful.whole.fit.parameters[name], True)
        assert NOT_REPORTED_MARK in number.text
        assert shown[symbol]["remark"] == REASON
    assert [shown["α"][end].value for end in ("low_95", "high_95")] == [0.9, 1.2]
    assert shown["λ"]["value"].value == careful.whole.fit.parameters["lambda"]
    assert NOT_REPORTED_MARK not in shown["λ"]["value"].text
    unsupported = ("zeta", "zeta_std", "alpha", "alpha_std")
    for table in (structures, welch):
        for row in table.rows:
            cells = {key: cell for key, cell in row.items() if isinstance(cell, Cell)}
            assert cells.keys() >= {*unsupported, "gamma", "lambda"}
            for key, cell in cells.items():
                assert cell.is_doubtful == (key in unsupported and cell.value is not None)
        assert any(
            NOT_REPORTED_MARK in note and "α" in note and "λ" not in note for note in table.notes
        )
    by_type = {row["type"]: row for row in csv.DictReader(csv_text(structures).splitlines())}
    assert by_type["VI"]["not_reported"] == "alpha zeta"
    assert float(by_type["VI"]["alpha"]) == careful.whole.fit.parameters["alpha"]
    assert [row[0].text for row in modes.shown_rows] == ["1", "2", f"3{NOT_REPORTED_MARK}"]
    assert "does not show" in modes.notes[-1]


def rows_of(table):
    return list(csv.DictReader(csv_text(table).splitlines()))


def test_files_state_the_flags(careful):
    modes, (sizes, *_others), (welch, _peaks) = report_tables(careful)
    reason = "computed from the model: the record does not show this mode"
    assert [row["remark"] for row in rows_of(modes)] == ["", "", reason]
    for table in (modes, sizes):
        last_two = ["predicted_peak_tip_slope_rad", "linear_model_error"]
        assert list(with_validity(table, careful.validity).keys[-3:]) == ["remark", *last_two]
        assert "Remark" not in {column.heading for column in table.shown_columns}
    for row in rows_of(welch):
        assert row["not_reported"] == ("" if row["type"] in ("II", "V") else "alpha zeta")


@pytest.mark.parametrize(
    ("key", "quantity", "column"),
    [("frequency_hz", "frequency", 1), ("damping_ratio", "damping ratio", 3)],
)
def test_mark_is_at_the_flagged_number_of_a_mode(
    record_result, with_selection, key, quantity, column
):
    headline = record_result.whole.headline
    first, *others = headline.modes
    flagged = replace(first, **{key: getattr(first, key).with_flag(REASON)})
    result = with_selection(record_result, headline=replace(headline, modes=(flagged, *others)))
    table, _, _ = report_tables(result)
    marked = [cell.text.endswith(NOT_REPORTED_MARK) for cell in table.shown_rows[0]]
    assert [index for index, is_marked in enumerate(marked) if is_marked] == [column]
    assert not any(cell.is_doubtful for row in table.shown_rows[1:] for cell in row)
    assert table.notes[-1] == f"{NOT_REPORTED_MARK} {REASON}."
    assert [row["remark"] for row in rows_of(table)] == [f"{quantity}: {REASON}", "", ""]
    source = latex_table(table)
    assert source.count(r"\dag{}") == 2
    assert rf"\dag{{}} {REASON}." in source


def test_loss_factor_of_an_assumed_order_has_its_reason(record_result, with_selection):
    fit = record_result.whole.fits["VII"]
    headline = headline_of_fit("VII", fit, (1, 2, 3), {"alpha": REASON})
    _, (sizes, parameters, *_others), _ = report_tables(
        with_selection(record_result, headline=headline)
    )
    internal, external = rows_of(sizes)
    assert (internal["remark"], external["remark"]) == (REASON, "")
    assert f"{NOT_REPORTED_MARK} {REASON}." in sizes.notes
    # A fixed number may have a flag as well.
    remarks = {row["parameter"]: row["remark"] for row in rows_of(parameters)}
    misread = with_selection(record_result, headline=headline.with_flag_on_all("a sign is wrong"))
    _, (_sizes, parameters, *_others), _ = report_tables(misread)
    fixed = [name for name, remark in remarks.items() if remark.startswith("fixed")]
    for row in rows_of(parameters):
        if row["parameter"] in fixed:
            assert row["remark"].startswith("fixed; ")
    assert fixed


def test_free_number_of_a_condition_has_its_flag(careful, with_selection):
    parameters = {
        name: replace(each, flag=None) for name, each in careful.whole.headline.parameters.items()
    }
    simpler = ConditionalEstimate("VII", {"alpha": 1.0}, parameters)
    headline = replace(careful.whole.headline, simpler=simpler)
    _, tables, _ = report_tables(with_selection(careful, headline=headline))
    (table,) = [table for table in tables if table.name == "on_condition"]
    for row in table.rows:
        is_flagged = row["parameter"].value in ("alpha", "zeta")
        assert row["remark"] == (REASON if is_flagged else "")
        assert row["free_value"].text.endswith(NOT_REPORTED_MARK) == is_flagged
        assert not row["value"].is_doubtful
    misread = headline.with_flag_on_all("a sign is wrong")
    _, tables, _ = report_tables(with_selection(careful, headline=misread))
    (table,) = [table for table in tables if table.name == "on_condition"]
    for row in table.rows:
        assert row["value"].is_doubtful
        assert row["remark"] == "a sign is wrong"
    inertias = [mode.participation for mode in misread.modes if mode.participation]
    assert {inertia.flag for inertia in inertias} <= {"a sign is wrong"}


def test_order_of_absent_damping_is_not_determined(record_result, with_selection):
    """Selected is a structure without external damping: types V, VI and VII have a lambda."""
    absent = SimpleNamespace(order="lambda", status="absent", value=None, interval=None)
    known = SimpleNamespace(order="alpha", status="fractional", value=0.8, interval=(0.7, 0.9))
    verdict = replace(record_result.whole.verdict, alpha=known, lambda_=absent)
    result = with_selection(record_result, verdict=verdict)
    assert not result.whole.withheld_orders
    assert result.unsupported_orders == {"lambda"}
    _modes, (*_others, structures), (welch, _peaks) = report_tables(result)
    for table in (structures, welch):
        assert any(NOT_REPORTED_MARK in note and "λ" in note for note in table.notes)
        for row in table.rows:
            marks = [
                NOT_REPORTED_MARK in row[name].text for name in ("zeta", "alpha", "gamma", "lambda")
            ]
            external = row["type"] not in ("I", "IV")
            assert marks == [False, False, external, external]
    for fit in document([result])["fits"]:
        assert fit["withheld"] == ([] if fit["type"] in ("I", "IV") else ["gamma", "lambda"])


def test_supported_numbers_are_not_marked(record_result):
    modes, tables, of_paper = report_tables(record_result)
    for table in (modes, *tables, *of_paper):
        assert NOT_REPORTED_MARK not in csv_text(table) + "".join(table.notes)
        assert not any(cell.is_doubtful for row in table.shown_rows for cell in row)


def test_page_terminal_and_text_tables_show_the_mark(careful, as_text):
    modes, tables, of_paper = report_tables(careful)
    made_at = datetime(2026, 1, 1, tzinfo=UTC)
    text = record_page(careful, PICTURES, modes, tables, made_at, (), of_paper)
    alpha = careful.whole.fits["VI"].parameters["alpha"]
    cells = re.findall(rf'<td class="number withheld"><data value="{alpha!r}">([^<]+)', text)
    assert len(cells) == 2  # among the parameters, and among the structures
    assert all(cell.endswith(NOT_REPORTED_MARK) for cell in cells)
    complete = as_text(result_text(replace(careful, welch=None), verbose=True))
    assert f"3{NOT_REPORTED_MARK}" in complete
    (row,) = [line.split() for line in complete.splitlines() if line.split()[:1] == ["α"]]
    assert row[4].endswith(NOT_REPORTED_MARK)
    assert " ".join(REASON.split()) in " ".join(complete.split())
    welch = as_text(result_text(careful, verbose=True)).partition("Welch method")[2]
    fits, *others = [line for line in welch.splitlines() if re.match(r"VI\s+omega", line)]
    assert fits.count(NOT_REPORTED_MARK) == 2
    assert NOT_REPORTED_MARK not in "".join(others)
    assert f"{NOT_REPORTED_MARK} not reported" in welch
    assert NOT_REPORTED_MARK not in as_text(result_text(replace(careful, whole=None), verbose=True))


def test_document_has_flags_and_numbers(careful):
    content = document([careful])
    for fit in content["fits"]:
        expected = [] if fit["type"] in ("II", "V") else ["alpha", "zeta"]
        assert fit["withheld"] == expected
        assert fit["parameters"]["alpha"] is not None
    selected = [fit["type"] for fit in content["fits"] if fit.get("selected")]
    assert selected == ["VI"]
    (record,) = content["records"]
    assert record["orders"] == {
        "alpha": {"status": "open", "value": 1.05, "interval_95": [0.9, 1.2]},
        "lambda": {"status": "fractional", "value": 0.9, "interval_95": [0.8, 1.0]},
    }
    first, last = record["curves"]["loss_factor_supported_hz"]
    assert (first, last) == (
        careful.whole.fit.modes[0].frequency_hz,
        careful.whole.fit.modes[1].frequency_hz,
    )
    visible = {m["mode"]: m["visible"] for m in content["modes"] if m["estimator"] == "record"}
    assert visible == {1: True, 2: True, 3: False}


def test_damping_of_invisible_modes_is_not_reported(careful, with_selection, as_text):
    def verdict(result):
        shown = as_text(result_text(replace(result, welch=None), verbose=True))
        return shown.partition("Modes with locked hub")[0]

    text = verdict(careful)
    assert "at 2.57 Hz and" in text
    assert "44.8" not in text
    none = headline_of_fit("VI", careful.whole.fit, ())
    assert "damping ratio is" in text
    assert "damping ratio" not in verdict(with_selection(careful, headline=none))
    misread = careful.whole.headline.with_flag_on_all(CONTRADICTED_FILE_REASON)
    assert "damping ratio" not in verdict(with_selection(careful, headline=misread))


def loss_axes(result):
    (found,) = [each for each in illustrations(result.whole) if each.name == "loss_factor"]
    return found.draw().axes[0], found.description


def test_loss_factor_is_drawn_in_the_supported_band(careful, record_result):
    axes, description = loss_axes(careful)
    labels = [line.get_label() for line in axes.get_lines()]
    assert "total" in labels
    assert "internal (material and clamp)" not in labels
    (total,) = [line for line in axes.get_lines() if line.get_label() == "total"]
    modes = careful.whole.fit.modes
    assert total.get_xdata()[0] == pytest.approx(modes[0].frequency_hz)
    assert total.get_xdata()[-1] == pytest.approx(modes[1].frequency_hz)
    assert "do not support" in description
    axes, description = loss_axes(record_result)
    assert {"total", "internal (material and clamp)"} <= {
        line.get_label() for line in axes.get_lines()
    }
    assert "do not support" not in description


def test_one_mode_has_a_point_and_no_curve(careful, with_selection):
    one = with_selection(
        careful, headline=headline_of_fit("VI", careful.whole.fit, (1,), {"alpha": REASON})
    )
    assert supported_band_hz(one.whole) is None
    axes, _ = loss_axes(one)
    (point,) = {float(x) for line in axes.get_lines() for x in line.get_xdata()}
    assert point == careful.whole.fit.modes[0].frequency_hz


def test_excited_band_ends_with_the_sweep(careful):
    """Of a chirp of 0.05 to 50 Hz nearly all; of noise alone nothing."""
    first_hz, last_hz = excited_band_hz(careful.record, careful.whole.analysis)
    assert first_hz < 2.0
    assert last_hz > 45.0
    noise = 5e-3 * np.random.default_rng(1).standard_normal(len(careful.record.torque_nm))
    assert excited_band_hz(replace(careful.record, torque_nm=noise), careful.whole.analysis) is None
