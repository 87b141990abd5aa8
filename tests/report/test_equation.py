"""The model as an equation: the selected terms, in both languages, and their definitions."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace

import pytest
from cases import further
from matplotlib.mathtext import MathTextParser

from analysis.models import STRUCTURES
from analysis.report._equation import definitions, equations, latex, mathml, types_table

pytestmark = pytest.mark.fit


@pytest.fixture
def whole_record(record_result):
    """Whole record whose numbers are of one type, and maybe of more parameters."""

    def made(name, **extras):
        whole = record_result.whole
        fit = replace(
            whole.fit,
            structure=STRUCTURES[name],
            parameters={**whole.fit.parameters, **extras},
        )
        headline = SimpleNamespace(parameters=fit.parameters, modal=None, tolerant=None)
        return SimpleNamespace(fit=fit, headline=headline, record=whole.record)

    return made


@pytest.mark.parametrize(
    ("name", "elastic", "inertial"),
    [
        ("I", r"( 1 + \zeta s )", ""),
        ("II", "", r"+ \gamma s"),
        ("III", r"( 1 + \zeta s )", r"+ \gamma s"),
        ("IV", r"( 1 + \zeta s^{\alpha} )", ""),
        ("V", "", r"+ \gamma s^{\lambda}"),
        ("VI", r"( 1 + \zeta s^{\alpha} )", r"+ \gamma s^{\lambda}"),
        ("VII", r"( 1 + \zeta s )", r"+ \gamma s^{\lambda}"),
    ],
)
def test_terms_are_those_of_the_type(whole_record, name, elastic, inertial):
    _, response, beta = (each.tex for each in equations(whole_record(name)))
    assert response.startswith(f"G ( s ) = - E I {elastic}".rstrip() + r" \beta \frac{\sin")
    assert (r"\zeta" in response) == (r"\zeta" in beta) == bool(elastic)
    assert (r"\gamma" in beta) == bool(inertial)
    assert rf"\dfrac{{\rho}}{{E I}} s^{{2}} {inertial}".rstrip() in beta


@pytest.mark.parametrize(
    ("extra", "tex", "words"),
    [
        ("filter_time_constant_s", r"\frac{1}{1 + T s}", "torque channel's filter"),
        (
            "second_order_filter_time_constant_s",
            r"\frac{1}{1 + \sqrt{2} T s + T^{2} s^{2}}",
            "Butterworth",
        ),
        ("tip_mass_kg", "G ( s )", "mass m at its tip"),
        ("drag", "G ( s )", "½ ρ_air C_D d"),
    ],
)
def test_additional_parameters_are_in_the_equation(whole_record, extra, tex, words):
    found = whole_record("VI", **{extra: 1e-3})
    assert tex in equations(found)[0].tex
    assert words in definitions(found)
    assert words not in definitions(whole_record("VI"))


@pytest.mark.parametrize("name", [further(name) if name != "VI" else name for name in STRUCTURES])
def test_both_languages_are_readable(whole_record, name):
    extras = dict.fromkeys(
        ("filter_time_constant_s", "second_order_filter_time_constant_s", "tip_mass_kg"), 1e-3
    )
    for whole in (whole_record(name), whole_record(name, **extras)):
        found = equations(whole)
        for formula in found:
            root = ET.fromstring(mathml(formula))
            assert root.find("semantics/annotation").text == formula.tex
            fractions = [len(each) for each in root.iter("mfrac")]
            assert set(fractions) <= {2}
            assert len(fractions) == formula.tex.count("frac{")
            MathTextParser("path").parse(f"${formula.tex}$")
        assert latex(found).count("&=") == 3


def test_all_types_are_defined_and_the_selected_marked(record_result):
    table = types_table(record_result.whole)
    rows = {row["type"]: row for row in table.rows}
    assert list(rows) == list(STRUCTURES)
    assert (rows["I"]["internal"], rows["I"]["external"]) == ("ζ s", "–")
    assert (rows["VI"]["internal"], rows["VI"]["external"]) == ("ζ s^α", "γ s^λ")
    assert rows["VII"]["damping"] == "internal of integer order, external of fractional order"
    assert table.rows[table.highlighted_row]["type"] == "VI"


def test_the_page_shows_the_equations(report, record_result):
    source = (report / "report.html").read_text(encoding="utf-8")
    for formula in equations(record_result.whole):
        assert mathml(formula) in source
    assert (report / "tables" / "model.tex").read_text() == latex(equations(record_result.whole))
