"""Report of a record: modal model first, whether the beam is uniform, conditions of parameters."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.identify import MODE_CONSTANT_NAMES, ModalModel
from analysis.report import FIGURES, ShownModel, document, illustrations, result_text
from analysis.report.bands import loss_estimate, modal_response_band
from analysis.report.record_report import record_page, report_tables, uniformity_tables

pytestmark = pytest.mark.fit

EXACT = "if the beam is uniform to 1e-5"
TOLERANT = "if the mode frequencies are those of a uniform beam to 0.1 %"


@pytest.fixture(scope="module")
def unexplained_losses(modal_result, with_selection):
    """The same, were its losses those of no beam with two orders."""
    headline = modal_result.whole.headline
    reason = "no beam explains the losses"
    test = replace(headline.uniform_beam, status="refused", p_value=2e-18)
    parameters = {name: each.with_flag(reason) for name, each in headline.parameters.items()}
    tolerant = replace(headline.tolerant, basis="none")
    return with_selection(
        modal_result,
        headline=replace(headline, uniform_beam=test, tolerant=tolerant, parameters=parameters),
    )


def drawn(result):
    return {each.name: each for each in illustrations(result.whole)}


def model_of(constants, background):
    """Modal model of its real constants."""
    poles, residues = [], []
    for ln_hz, ln_ratio, ln_residue, phase in constants.reshape(-1, len(MODE_CONSTANT_NAMES)):
        omega, ratio = 2 * np.pi * np.exp(ln_hz), np.exp(ln_ratio)
        poles.append(omega * (1j - ratio / np.sqrt(1 - ratio**2)))
        residues.append(1j * np.exp(ln_residue + 1j * phase))
    return ModalModel(tuple(poles), tuple(residues), tuple(background))


def test_band_of_the_modal_model_matches_scatter_of_draws(modal_result):
    modal = modal_result.whole.headline.modal
    frequency_hz = np.array([1.5, 2.55, 5.0, 11.0, 16.0, 30.0, 44.0, 48.0])
    band = modal_response_band(modal, frequency_hz)
    count = modal.mode_constants.size
    at = np.concatenate([modal.mode_constants, modal.model.background])
    factor = np.linalg.cholesky(
        modal.joint_covariance / np.outer(*[np.sqrt(np.diag(modal.joint_covariance))] * 2)
    )
    rng = np.random.default_rng(5)
    spread = np.sqrt(np.diag(modal.joint_covariance))
    logs = []
    for _ in range(400):
        draw = at + spread * (factor @ rng.standard_normal(at.size))
        response = model_of(draw[:count], draw[count:]).response(2j * np.pi * frequency_hz)
        logs.append(np.log(response / band.response))
    scatter = np.array(logs)
    assert scatter.real.std(axis=0) == pytest.approx(band.log_magnitude_std, rel=0.2)
    assert scatter.imag.std(axis=0) == pytest.approx(band.phase_std_rad, rel=0.2)


def test_modal_model_is_shown_first(modal_result):
    whole = modal_result.whole
    model = ShownModel.from_headline(whole.headline, whole.record)
    assert model.transfer_function is whole.headline.modal.model
    assert model.fit_percent(whole.analysis) == pytest.approx(
        whole.analysis.fit_percent(whole.fit), abs=0.2
    )
    figures = drawn(modal_result)
    assert "of the modal model" in figures["record_frf"].description
    assert "of the modal model" in figures["residual"].description
    assert "as the modal model predicts" in figures["record_signals"].description
    (modes, *_) = report_tables(modal_result)
    assert modes.caption.endswith("modal model")
    assert {row["source"] for row in modes.rows} == {"modal"}
    inertia = [row["participation_kg_m2"].value for row in modes.rows]
    beam = whole.record.beam
    assert 0.9 < sum(inertia) / (beam.density_kg_per_m * beam.length_m**3 / 3) < 1.0


def test_parameters_state_their_condition(modal_result, as_text):
    tables = {each.name: each for each in report_tables(modal_result)[1]}
    assert tables["parameters"].caption == f"Parameters {TOLERANT}"
    assert tables["exact_geometry"].caption == f"Parameters {EXACT}: type VI"
    tolerant, exact = (
        {row["parameter"].value: row for row in tables[name].rows}
        for name in ("parameters", "exact_geometry")
    )
    assert tolerant["alpha"]["std"].value > 2 * exact["alpha"]["std"].value
    assert list(tolerant) == list(exact)
    brief = as_text(result_text(modal_result, verbose=False))
    assert TOLERANT in " ".join(brief.split())
    complete = as_text(result_text(modal_result, verbose=True))
    assert f"Parameters {EXACT}" in complete
    assert f"Modes {EXACT}" in complete


def test_constants_are_compared_with_those_of_a_uniform_beam(modal_result):
    test = modal_result.whole.headline.uniform_beam
    constants, narrower = uniformity_tables(modal_result.whole)
    assert (len(constants.rows), len(narrower.rows)) == (12, 3)
    away = np.array([row["deviation_std"].value for row in constants.rows])
    assert np.abs(away).max() < 4
    figure = drawn(modal_result)["uniform_beam"]
    axes = figure.draw().axes
    assert len(axes) == 2 * len(MODE_CONSTANT_NAMES)
    for column, name in enumerate(MODE_CONSTANT_NAMES):
        (points,) = [line for line in axes[2 * column].get_lines() if line.get_marker() == "o"]
        of_name = [row for row in constants.rows if row["constant"].value == name]
        np.testing.assert_allclose(
            points.get_ydata(), [row["deviation_std"].value for row in of_name]
        )
    assert test.summary.sentence in figure.description


@pytest.fixture(scope="module")
def page(modal_result):
    """The page without drawing its figures."""
    pictures = [
        SimpleNamespace(name=name, description="A figure.", source="data:image/png;base64,")
        for name in FIGURES
    ]
    modes, tables, _ = report_tables(modal_result)
    return record_page(modal_result, pictures, modes, tables, datetime(2026, 1, 1, tzinfo=UTC))


def test_the_page_has_a_section_on_the_uniformity(modal_result, page):
    text = page
    figures, uniformity = text.index('id="figures"'), text.index('id="uniformity"')
    assert figures < uniformity < text.index('id="figure-uniform_beam"') < text.index('id="model"')
    assert text.count('id="figure-uniform_beam"') == text.count('id="modal_constants"') == 1
    assert modal_result.whole.headline.uniform_beam.summary.sentence in text


def test_full_turn_of_a_phase_is_no_deviation(modal_result, with_selection):
    headline = modal_result.whole.headline
    at = MODE_CONSTANT_NAMES.index("residue_phase_rad")
    measured = headline.uniform_beam.measured_constants.copy()
    measured[at] += 2 * np.pi
    test = replace(headline.uniform_beam, measured_constants=measured)
    turned = with_selection(modal_result, headline=replace(headline, uniform_beam=test))
    one, other = (
        uniformity_tables(each.whole)[0].rows[at]["deviation_std"].value
        for each in (modal_result, turned)
    )
    assert one == pytest.approx(other, abs=1e-6)


def test_unexplained_losses_are_points_without_a_curve(unexplained_losses):
    assert loss_estimate(unexplained_losses.whole) is None
    figures = drawn(unexplained_losses)
    labels = [handle.get_label() for handle in figures["loss_factor"].draw().axes[0].get_lines()]
    assert not {"total", "internal (material and clamp)", "external (surroundings)"} & set(labels)
    assert "There is no curve" in figures["loss_factor"].description
    assert "not properties of the material" in figures["uniform_beam"].description
    content = document([unexplained_losses])
    assert content["records"][0]["curves"]["loss_factor"] is None
    assert uniformity_tables(unexplained_losses.whole)[1:] == ()
    tables = {each.name: each for each in report_tables(unexplained_losses)[1]}
    assert all(row["remark"] for row in tables["parameters"].rows if row["value"].is_doubtful)


def test_no_curve_of_losses_with_an_order_fitted_to_frequencies(modal_result, with_selection):
    headline = modal_result.whole.headline
    test = replace(headline.uniform_beam, status="refused", p_value=2e-18)
    tolerant = replace(
        headline.tolerant,
        interval={**headline.tolerant.interval, "alpha": (1.2, 1.6)},
        deviance_of_order_one={"alpha": 0.5, "lambda": 0.0},
    )
    result = with_selection(
        modal_result, headline=replace(headline, uniform_beam=test, tolerant=tolerant)
    )
    assert document([result])["records"][0]["curves"]["loss_factor"] is None
    assert "an order of the beam was fitted" in drawn(result)["loss_factor"].description


def test_the_document_has_source_participation_and_the_test(modal_result):
    (headline,) = document([modal_result])["headlines"]
    found = headline["validity"]["uniform_beam"]
    assert found["status"] == "passed"
    assert found["sentence"].startswith("A uniform beam predicts the modes (p = 0.")
    assert len(found["constants"]) == 12
    for mode in headline["modes"]:
        assert (mode["source"], mode["frequency_hz"]["flag"]) == ("modal", None)
        assert mode["participation"]["value"] > 0
    assert headline["exact_geometry"]["condition"] == EXACT
    names, matrix = headline["covariance"]["names"], headline["covariance"]["matrix"]
    assert np.shape(matrix) == (len(names), len(names))
    alpha = headline["parameters"]["alpha"]
    at = names.index("alpha")
    assert alpha["std"] == pytest.approx(np.sqrt(matrix[at][at]))
    (curves,) = [record["curves"] for record in document([modal_result])["records"]]
    assert curves["model"] == "modal"
    assert curves["loss_factor"] is not None


def test_the_modal_model_is_written_as_an_equation(page):
    formulas = [ET.fromstring(each) for each in re.findall(r"<math.*?</math>", page, re.DOTALL)]
    first, *others = (formula.find("semantics/annotation").text for formula in formulas)
    assert r"\sum_{k}" in first
    assert r"\frac{\bar{R}_{k}}{s - \bar{p}_{k}}" in first
    assert r"\sum_{n = 0}^{4} b_{n} s^{n}" in first
    assert len(others) == 3
    assert "modal model, with a pole p and a residue R" in page
