"""Tables for LaTeX: every cell as on the page, and nothing that LaTeX would choke on."""

import re

import pytest
from matplotlib.mathtext import MathTextParser

from analysis.report.record_report import report_tables
from analysis.report.table import Cell, Column, Table, latex_table, latex_text, with_validity


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1e-2 s^λ/m⁴", r"$10^{-2}$ s$^{\lambda}$/m$^{4}$"),
        ("7.1e-05", r"$7.1 \cdot 10^{-5}$"),
        ("γ ω^λ sin(λπ/2) / (ρ/EI ω²)",
         r"$\gamma$ $\omega^{\lambda}$ sin($\lambda\pi$/2) / ($\rho$/$EI$ $\omega^{2}$)"),
        ("ΔBIC, δ2, length⁻⁴", r"$\Delta$BIC, $\delta_{2}$, length$^{-4}$"),
        ("50 % & a_b #1 {x} $y$ ~ \\", r"50 \% \& a\_b \#1 \{x\} \$y\$ \textasciitilde{} "
         r"\textbackslash{}"),
        ("−7.2† – 1‡", r"$-$7.2\dag{} -- 1\ddag{}"),
        ("µs", r"$\mu$s"),
    ],
)  # fmt: skip
def test_text_is_escaped_for_latex(text, expected):
    assert latex_text(text) == expected


def body(source):
    inside = source.partition(r"\midrule")[2].partition(r"\bottomrule")[0]
    return [line.strip() for line in inside.strip().splitlines()]


@pytest.mark.fit
def test_tables_of_a_report_match_the_page(record_result):
    modes, tables, of_paper = report_tables(record_result)
    for table in (modes, *tables, *of_paper):
        source = latex_table(table)
        assert source.count("{") == source.count("}")
        alignment = re.search(r"\\begin\{tabular\}\{@\{\}(\w+)@\{\}\}", source)[1]
        rows = body(source)
        assert len(rows) == len(table.rows)
        for line, cells in zip(rows, table.shown_rows, strict=True):
            assert line.endswith(r" \\")
            found = line.removesuffix(r" \\").split(" & ")
            assert len(found) == len(alignment)
            assert found == [latex_text(cell.text) for cell in cells]
        assert source.isascii() or not re.search("[α-ω⁰-⁹·−]", source)
        mathematics = re.findall(r"(?<!\\)\$[^$]+(?<!\\)\$", source)
        for each in mathematics:
            MathTextParser("path").parse(each)
        assert not re.sub(r"(?<!\\)\$[^$]+(?<!\\)\$", "", source).count(r"\alpha")


def test_a_column_without_an_entry_is_left_out():
    columns = (Column("A", "a"), Column("Remark", "remark", ""))
    table = Table.from_rows("some_name", "Caption 5 %", columns, [(1.0, ""), (2.0, "")], ("Note.",))
    source = latex_table(table)
    assert "Remark" not in source
    assert r"\caption{Caption 5 \%}" in source
    assert r"\label{tab:some_name}" in source
    assert r"\par\footnotesize Note." in source
    assert body(source) == [r"1 \\", r"2 \\"]
    filled = Table.from_rows("b", "c", columns, [(1.0, Cell("x", "x"))])
    assert "A & Remark" in latex_table(filled)


@pytest.mark.fit
def test_modes_and_parameters_are_written(report, record_result):
    modes, (_sizes, parameters, *_others), _ = report_tables(record_result)
    for table in (modes, parameters):
        assert (report / "tables" / f"{table.name}.tex").read_text("utf-8") == latex_table(
            with_validity(table, record_result.validity)
        )
    assert {path.name for path in (report / "tables").glob("*.tex")} == {
        "model.tex", "modes.tex", "parameters.tex",
    }  # fmt: skip
