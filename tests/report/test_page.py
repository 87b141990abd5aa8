"""The report as a browser takes it: well-formed, complete, self-contained, harmless."""

import base64
import csv
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.identify.headline import ConditionalEstimate, headline_of_fit
from analysis.report import FIGURES, document, illustrations
from analysis.report.folder import OutputExistsError
from analysis.report.record_report import record_page, report_tables, write_report

pytestmark = pytest.mark.fit

WITHOUT_TEST = [name for name in FIGURES if name != "uniform_beam"]
"""Figures of a record without a test of uniformity, as that of these tests."""

SHOWN = [*WITHOUT_TEST, "welch_frf"]
"""Figures of its page, in their order."""

VOID = {"meta", "br", "img"}
LIMIT_BYTES = 2_000_000
IMAGES = ("data:image/png;base64,", "data:image/svg+xml;base64,")


class Reader(HTMLParser):
    """Checks that elements nest and collects the contents that the tests check."""

    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.attributes, self.text = [], [], [], []
        self.rows, self._row, self._cell = {}, None, None

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes.append((tag, dict(attrs)))
        assert len(dict(attrs)) == len(attrs), f"{tag} has an attribute twice"
        if tag not in VOID:
            self.open.append((tag, dict(attrs)))
        if tag == "tr":
            self._row = []
        if tag == "data":
            self._row.append(float(dict(attrs)["value"]))

    def handle_startendtag(self, tag, attrs):
        raise AssertionError(f"{tag} closes itself")

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        opened, _ = self.open.pop()
        assert opened == tag, f"</{tag}> closes <{opened}>"
        if tag == "tr":
            tables = [attributes.get("id") for name, attributes in self.open if name == "table"]
            self.rows.setdefault(tables[-1], []).append(self._row)

    def handle_data(self, data):
        if not any(name == "style" for name, _ in self.open):
            self.text.append(data)


def read(text):
    reader = Reader()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    return reader


@pytest.fixture(scope="session")
def source(report):
    return (report / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def read_page(source):
    return read(source)


def test_page_is_well_formed(source, read_page):
    assert source.startswith('<!DOCTYPE html>\n<html lang="en">')
    assert read_page.tags.count("main") == 1
    assert next(tag for tag in read_page.tags if re.fullmatch("h[1-6]", tag)) == "h1"
    identifiers = [a["id"] for _, a in read_page.attributes if "id" in a]
    assert len(identifiers) == len(set(identifiers))
    used = {a["href"].removeprefix("#") for _, a in read_page.attributes if "href" in a}
    assert used == {"verdict", "figures", "model", "tables", "paper", "how"}
    assert used <= set(identifiers)


def test_page_loads_and_runs_nothing(source, read_page):
    assert "://" not in source
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(read_page.tags)
    for _, attributes in read_page.attributes:
        assert not [name for name in attributes if name.startswith("on")]
        assert attributes.get("href", "#").startswith("#")
        assert attributes.get("src", IMAGES[0]).startswith(IMAGES)
    assert "@import" not in source
    assert len(source.encode()) < LIMIT_BYTES


def test_operator_input_stays_text(read_page, record_result, hostile_note):
    text = "".join(read_page.text)
    assert f"Note: {hostile_note}" in text
    assert text.count(hostile_note) == 2
    assert "operator: <i>Rossi</i>" in text
    assert "Less than noise <b> remains." in text
    assert record_result.record.path.name == "a <b> & $c$.mcap"
    assert read_page.tags.count("b") == read_page.tags.count("i") == 0


def test_page_is_accessible_and_printable(source, read_page):
    figures = [a for tag, a in read_page.attributes if tag == "img"]
    assert len(figures) == len(SHOWN)
    assert all(len(figure["alt"]) > 60 for figure in figures)
    assert read_page.tags.count("figcaption") == read_page.tags.count("figure")
    assert read_page.tags.count("table") == read_page.tags.count("caption") > 10
    assert all(a.get("scope") in ("row", "col") for tag, a in read_page.attributes if tag == "th")
    printed = source.partition("@media print")[2].partition("</style>")[0]
    assert set(re.findall(r"break-\w+: (\w+)", printed)) == {"avoid"}
    (undivided,) = re.findall(r"([^{}]+)\{ break-inside: avoid", printed)
    assert ".table" not in undivided  # a long one would leave half a page empty
    assert "prefers-color-scheme: dark" in source


@pytest.mark.process
@pytest.mark.further  # nothing begins a page
@pytest.mark.skipif(not shutil.which("chromium"), reason="no browser to print with")
def test_printed_pages_are_not_half_empty(report, tmp_path):
    """All of it fits on six pages; with a break before every part it takes nine."""
    printed = tmp_path / "report.pdf"
    subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer",
         f"--user-data-dir={tmp_path / 'profile'}", f"--print-to-pdf={printed}",
         (report / "report.html").as_uri()],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    pages = len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes()))
    assert 4 <= pages <= 6


def test_page_shows_the_figure_files_with_text(report, read_page):
    sources = [a["src"] for tag, a in read_page.attributes if tag == "img"]
    words = set()
    for name, source in zip(SHOWN, sources, strict=True):
        kind, content = source.split(";base64,")
        svg = base64.b64decode(content)
        assert kind == "data:image/svg+xml"
        assert svg == (report / "figures" / f"{name}.svg").read_bytes()
        words |= {each.text for each in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")}
    assert {"Coupling torque", "Frequency (Hz)", "total", "Mode 1"} <= words


def test_verdict_with_intervals_comes_first(read_page, record_result):
    text = " ".join("".join(read_page.text).split())
    first_mode = record_result.whole.fit.modes[0]
    assert f"The antenna's damping ratio is {100 * first_mode.damping_ratio:.2f}"[:-1] in text
    positions = [
        text.index(word) for word in ("Both orders", "Sweep round mode 1 & 2", "Parameters,")
    ]
    assert positions == sorted(positions)
    assert text.index("damping ratio is") < positions[0]
    assert "Only 3 Welch segment(s)" in text  # the warning
    for fact in ("SHA-256", "report made", "output error", "numpy"):
        assert fact in text


def test_numbers_are_those_of_the_json_document(report, read_page):
    entries = json.loads((report / "analysis.json").read_text())
    from_record = [fit for fit in entries["fits"] if fit["estimator"] == "record"]
    (fit,) = [fit for fit in from_record if fit["type"] == "VI"]
    rows = read_page.rows["parameters"][1:]
    assert len(rows) == len(fit["parameters"]) == 8
    for row, (name, value) in zip(rows, fit["parameters"].items(), strict=True):
        expected = [value, fit["std"][name], *(fit["interval_95"][name] or ())]
        assert row == [number for number in expected if number is not None]
    modes = [
        mode for mode in entries["modes"] if (mode["estimator"], mode["type"]) == ("record", "VI")
    ]
    keys = ("mode", "frequency_hz", "frequency_std_hz", "damping_ratio", "damping_ratio_std")
    assert [row[:5] for row in read_page.rows["modes"][1:]] == [
        [mode[key] for key in keys] for mode in modes
    ]
    assert [row[0] for row in read_page.rows["damping_sizes"][1:]] == [
        fit["internal_size"]["omega_rad_s"],
        fit["external_size"]["omega_rad_s"],
    ]
    covariance = np.array(fit["covariance"])
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        read_page.rows["correlations"][1:], covariance / np.outer(std, std), rtol=1e-12
    )
    by_type = {row["type"]: row for row in csv.DictReader(open_table(report, "structures"))}
    for each in from_record:
        assert float(by_type[each["type"]]["cost"]) == each["cost"]


def open_table(report, name):
    return (report / "tables" / f"{name}.csv").read_text(encoding="utf-8").splitlines()


def test_csv_and_page_hold_the_same_numbers(report, read_page, record_result):
    modes, tables, of_paper = report_tables(record_result)
    assert {path.stem for path in (report / "tables").glob("*.csv")} == {
        table.name for table in (modes, *tables, *of_paper)
    }
    for table in (modes, *tables, *of_paper):
        header, *rows = csv.reader(open_table(report, table.name))
        of_validity = ["predicted_peak_tip_slope_rad", "linear_model_error"]
        assert header == [*(column.column_key for column in table.columns), *of_validity]
        numeric = [
            i for i, column in enumerate(table.columns) if column.is_numeric and column.heading
        ]
        in_csv = [[float(row[i]) for i in numeric if row[i]] for row in rows]
        assert any(in_csv)
        assert in_csv == read_page.rows[table.name][1:]


def test_shown_number_is_the_rounded_one(record_result):
    modes, tables, of_paper = report_tables(record_result)
    shown = {"modes": (1.0, 1.0, 1.0, 100.0, 100.0, 100.0, 100.0)}
    for row in modes.shown_rows:
        for cell, factor in zip(row, shown["modes"], strict=True):
            assert float(cell.text) == pytest.approx(factor * cell.value, rel=0.06)
    (zeta, alpha, *_) = tables[1].rows
    assert zeta["value"].text == f"{1e5 * zeta['value'].value:.2f}"
    assert alpha["value"].text == f"{alpha['value'].value:.4f}"
    assert len(alpha["std"].text.lstrip("0.")) == 2  # significant digits of a deviation
    welch = {(row["type"], row["weighting"]): row for row in of_paper[0].rows}
    for model in record_result.welch.models:
        row = welch[model.fit.structure.name, model.fit.weighting]
        assert row["zeta"].value == model.fit.parameters["zeta"]
        assert row["mse"] == model.indices.mse


def picture(name):
    """A figure as the page takes it, without drawing it."""
    return SimpleNamespace(name=name, description="A figure.", source="data:image/png;base64,")


@pytest.fixture
def page_of(record_result, with_selection):
    """Return the text of the page with another headline."""

    def text(headline):
        result = with_selection(record_result, headline=headline)
        modes, tables, _ = report_tables(result)
        made_at = datetime(2026, 1, 1, tzinfo=UTC)
        page = record_page(result, [picture("one")], modes, tables, made_at)
        # The damping is reported before the sentences of the verdict.
        return "".join(read(page).text).partition("Both orders are fractional.")[0]

    return text


def test_unsupported_orders_are_not_reported(record_result, with_selection):
    reason = "the record does not determine the order"
    careful = with_selection(
        record_result,
        headline=headline_of_fit("VI", record_result.whole.fit, (1, 2, 3), {"alpha": reason}),
        verdict=replace(record_result.whole.verdict, sentences=("Nothing is sure.",)),
    )
    modes, tables, _ = report_tables(careful)
    pictures = [picture(name) for name in ("one", "two")]
    text = record_page(careful, pictures, modes, tables, datetime(2026, 1, 1, tzinfo=UTC))
    content = "".join(read(text).text)
    assert "its order α is not known" in content
    assert reason in content
    (row,) = [row for row in tables[1].shown_rows if row[0].text == "α"]
    assert all(cell.is_doubtful and cell.value is not None for cell in row[3:7])
    assert 'href="#paper"' not in text


def test_loss_factor_of_an_assumed_order_is_not_reported(record_result, page_of):
    fit = record_result.whole.fits["VII"]
    flagged = headline_of_fit(
        "VII", fit, (1, 2, 3), {"alpha": "the record does not determine the order"}
    )
    content = page_of(flagged)
    assert "internal damping" not in content
    assert "The external damping has a loss factor of" in content
    known = page_of(headline_of_fit("VII", fit, (1, 2, 3)))
    assert "of the fixed order α\u00a0=\u00a01." in known


def test_unexplained_residual_makes_numbers_conditional(record_result, with_selection, page_of):
    spoilt = headline_of_fit(
        "VI", record_result.whole.fit, (1, 2, 3), unexplained_reason="part is unexplained"
    )
    content = page_of(spoilt).partition("the antenna's damping ratio would be ")[2]
    assert content
    assert "(" not in content[:60]  # no interval
    modes, tables, _ = report_tables(with_selection(record_result, headline=spoilt))
    for table in (modes, tables[0], tables[1]):
        for row in table.shown_rows:
            shown = [cell for cell in row if cell.is_number]
            assert sum(cell.is_doubtful for cell in shown) >= len(shown) - 1


def test_simpler_structure_is_shown_with_the_freest(record_result, with_selection):
    taken = headline_of_fit("VII", record_result.whole.fits["VII"], (1, 2, 3)).parameters
    simpler = ConditionalEstimate("VII", {"alpha": 1.0}, taken)
    headline = replace(record_result.whole.headline, simpler=simpler)
    _modes, tables, _ = report_tables(with_selection(record_result, headline=headline))
    (table,) = [table for table in tables if table.name == "on_condition"]
    assert "If α = 1 is assumed: type VII" in table.caption
    row = {row["parameter"].text: row for row in table.rows}["ζ"]
    assert row["value"].value == record_result.whole.fits["VII"].parameters["zeta"]
    assert row["free_value"].value == record_result.whole.fits["VI"].parameters["zeta"]


def test_band_that_begins_above_a_mode_is_drawn(record_result):
    found = [each.name for each in illustrations(replace(record_result.whole, band_hz=(5.0, 50.0)))]
    assert found == WITHOUT_TEST


def test_figures_are_svg_files_with_text(report):
    assert {path.suffix for path in (report / "figures").iterdir()} == {".svg"}
    for name in SHOWN:
        svg = (report / "figures" / f"{name}.svg").read_text(encoding="utf-8")
        assert svg.lstrip().startswith("<?xml")
        assert "<text" in svg


def test_existing_name_is_reported_and_preserved(report, record_result, without_drawing):
    before = (report / "report.html").stat().st_mtime_ns
    with without_drawing(), pytest.raises(OutputExistsError, match=r"welch_frf\.svg exists"):
        write_report(record_result, report)
    assert (report / "report.html").stat().st_mtime_ns == before


def test_bands_surround_their_curves(record_result):
    (record,) = document([record_result])["records"]
    curves = record["curves"]
    assert record["selected"] == "VI"
    low, value, high = (
        np.array(curves[f"magnitude{end}_nm_per_rad"]) for end in ("_low", "", "_high")
    )
    assert np.all((low < value) & (value < high))
    total = curves["loss_factor"]
    assert np.all(np.array(total["low"]) < np.array(total["value"]))
    np.testing.assert_allclose(
        total["value"],
        np.add(curves["internal_loss_factor"]["value"], curves["external_loss_factor"]["value"]),
    )
