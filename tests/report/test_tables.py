import math
from dataclasses import replace

import pytest

from analysis.models import WelchSettings
from analysis.paper.welch_analysis import analyse
from analysis.record import load_record
from analysis.report import result_text, summary_table
from analysis.report.table import (
    TEXT_FORMAT,
    Cell,
    Column,
    Table,
    csv_text,
    estimate_cells,
    json_rows,
    terminal_table,
)
from analysis.results import RecordResult
from rigd.beam import modes


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (8.5023, 0.6679, "8.50 ±0.67"),
        (0.9718662, 0.0138, "0.972 ±0.014"),
        (95.2, 42.6, "95 ±43"),
        (1234.5, 300.0, "1234 ±300"),
        (1.0, 0.0, "1"),
        (0.123456789, None, "0.12346"),
        (2.0, 1e-9, "2 ±1e−09"),
        (3.0, float("nan"), "3"),
    ],
)
def test_digits_of_a_value_follow_its_spread(value, std, text, as_text):
    columns = (Column("value", "value"), Column("std", "std", std_of_previous=True))
    table = Table.from_rows("name", "", columns, [estimate_cells((value, std), std)])
    assert as_text(terminal_table(table)).split("\n")[2].strip() == text


def by_welch(analysis):
    return RecordResult(analysis.record, welch=analysis)


@pytest.fixture(scope="module")
def tables_text(as_text):
    """Return the complete terminal output of Welch fits."""
    return lambda analysis: as_text(result_text(by_welch(analysis), verbose=True))


def rows(text, *starts):
    return [
        line.split() for line in text.splitlines() if tuple(line.split()[: len(starts)]) == starts
    ]


@pytest.mark.fit
def test_tables_contain_every_fit_with_its_numbers(paper_analysis, tables_text):
    text = tables_text(paper_analysis)
    for model in paper_analysis.models:
        fits, peaks, modes = rows(text, model.fit.structure.name, model.fit.weighting)
        assert fits[-3:] == [
            f"{x:.4g}" for x in (model.indices.mse, model.indices.wmse, model.indices.md)
        ]
        assert peaks[2] == f"{model.deviations[0].frequency_rad_s:.3f}"
        assert modes[2] == f"{model.modes[0].frequency_hz:.4f}"
    (measured,) = rows(text, "measured")
    assert [float(cell) for cell in measured[1:4]] == pytest.approx(
        [2 * math.pi * peak.frequency_hz for peak in paper_analysis.peaks], abs=1e-3
    )
    assert [float(cell) for cell in measured[4:]] == pytest.approx(
        [peak.magnitude_db for peak in paper_analysis.peaks], abs=1e-3
    )
    assert "standard deviation" in " ".join(text.split())


@pytest.mark.fit
def test_absent_and_fixed_parameters_are_distinguished(paper_analysis, tables_text):
    text = tables_text(paper_analysis)
    internal_only = rows(text, "I", "const")[0]
    assert internal_only[4:7] == ["1", "–", "–"]


@pytest.mark.fit
def test_warnings_and_parameters_on_the_edge_are_shown(paper_analysis, tables_text):
    model = paper_analysis.models[0]
    edge = replace(model, fit=replace(model.fit, std=None, at_bounds=("zeta",)))
    text = tables_text(
        replace(paper_analysis, models=(edge,), warnings=("Mind the gap [b]of[/b] 3 ticks.",))
    )
    assert "* at the limit of the search range" in text
    assert "Warning: Mind the gap [b]of[/b] 3 ticks." in text


@pytest.mark.fit
def test_the_summary_is_mean_and_standard_deviation(paper_analysis, as_text):
    model = paper_analysis.models[0]
    others = []
    for zeta in (1e-4, 2e-4, 4e-4):
        fit = replace(model.fit, parameters={**model.fit.parameters, "zeta": zeta})
        others.append(replace(paper_analysis, models=(replace(model, fit=fit),)))
    text = as_text(summary_table([by_welch(each) for each in others]))
    assert "over 3 files" in text
    (row,) = rows(text, "I", "const")
    assert row[2:5] == ["23", "±15", "1"]


def modes_rows(text):
    return text, [row[2:] for row in (rows(text, "I", "const")[2], rows(text, "VI", "omega")[2])]


@pytest.mark.fit
def test_overdamped_modes_are_left_out(write_session, short_signals, tmp_path, tables_text):
    """One segment of a short sweep, to which type II answers with a damping ratio of 8."""
    record = load_record(write_session(tmp_path / "a.mcap", short_signals))
    settings = WelchSettings(segment_length=4000, types=("II",), weightings=("const",))
    (model,) = analyse(record, settings).models
    damping = replace(model.fit.damping, gamma=14.0)
    found = modes(record.beam, damping, 3)
    assert found[0].damping_ratio > 1 > found[2].damping_ratio
    strong = replace(model, modes=found, are_near_undamped=(False, False, True))
    text = tables_text(replace(analyse(record, settings), models=(strong,)))
    shown = rows(text, "II", "const")[2][2:]
    assert shown[:2] == shown[3:5] == ["–", "–"]
    assert shown[2] == f"{found[2].frequency_hz:.4f}"
    assert "overdamped in this fit" in text
    none = replace(strong, modes=(), are_near_undamped=())
    assert "overdamped in this fit" in tables_text(
        replace(analyse(record, settings), models=(model, none))
    )


@pytest.mark.fit
def test_shifted_modes_are_marked(paper_analysis, tables_text):
    text, (first, last) = modes_rows(tables_text(paper_analysis))
    assert "‡" not in text
    assert [float(hz) for hz in last[:3]] == sorted(float(hz) for hz in last[:3])
    *others, model = paper_analysis.models
    slow = replace(model.modes[2], frequency_hz=8.5)
    left = replace(model, modes=(*model.modes[:2], slow), are_near_undamped=(True, True, False))
    text, (unmarked, marked) = modes_rows(
        tables_text(replace(paper_analysis, models=(*others, left)))
    )
    assert unmarked == first
    assert marked[2] == "8.5000‡"
    assert marked[5] == f"{last[5]}‡"
    assert "‡ more than 10 % off" in " ".join(text.split())


def test_table_is_shown_in_its_units_and_written_in_full(as_text):
    """A file's name may resemble markup, a value may be missing, unknown or for programs only."""
    columns = (
        Column("file", "file", TEXT_FORMAT), Column("ζ (1e-5)", "zeta", ".2f", 1e5),
        Column("std", "zeta_std", ".2f", 1e5, std_of_previous=True),
        Column("used", "used", TEXT_FORMAT),
    )  # fmt: skip
    rows = (
        {"file": Cell("/a/[b]x[/b]", "[b]x[/b]"), "zeta": 1.23456789e-5, "zeta_std": 1e-7,
         "used": True, "cost": 3},
        {"file": "y", "zeta": math.nan, "used": False, "cost": 4},
    )  # fmt: skip
    table = Table("name", "A table", columns, rows, ("[i] note",))
    _, head, _, first, second, note, *_ = as_text(terminal_table(table)).split("\n")
    assert head.split() == ["file", "ζ", "(1e-5)", "used"]
    assert first.split() == ["[b]x[/b]", "1.23", "±0.01", "yes"]
    assert second.split() == ["y", "–", "no"]
    assert note.strip() == "[i] note"
    assert csv_text(table).splitlines() == [
        "file,zeta,zeta_std,used,cost", "/a/[b]x[/b],1.23456789e-05,1e-07,True,3", "y,,,False,4",
    ]  # fmt: skip
    assert json_rows(table) == [
        {"file": "/a/[b]x[/b]", "zeta": 1.23456789e-5, "zeta_std": 1e-7, "used": True, "cost": 3},
        {"file": "y", "zeta": None, "used": False, "cost": 4},
    ]


def test_groups_of_rows_are_separated(as_text):
    columns = (Column("type", "type", TEXT_FORMAT), Column("n", "n"))
    table = Table.from_rows("name", "", columns, [("I", 1), ("I", 2), ("II", 3)], is_grouped=True)
    lines = [line.strip() for line in as_text(terminal_table(table)).splitlines()]
    assert [line.split() for line in lines[2:]] == [["I", "1"], ["I", "2"], [], ["II", "3"]]
