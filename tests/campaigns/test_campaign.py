"""A small campaign from files to figures, with two files that do not belong to it."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from analysis.campaigns import CampaignError, SessionTask, analyse_session, campaign
from analysis.campaigns._validation import leave_one_out_results, models_without_session
from analysis.campaigns.workers import process_pool
from analysis.exchange import export_model
from analysis.identify import BAND_HZ, Measurement, fit_record
from analysis.linear_model import ModelOptions
from analysis.models import STRUCTURES
from analysis.record import load_record
from analysis.record_part import RecordSource
from analysis.report import campaign_document, document_text
from analysis.report._campaign_tables import (
    all_tables,
    headline_tables,
    session_list_table,
    sessions_table,
    validation_summary,
)
from analysis.report.campaign_report import campaign_tables, campaign_text, write_campaign
from analysis.report.table import csv_text, json_rows
from rigd.beam import Plant, modes, transfer

pytestmark = pytest.mark.fit


def test_order_of_sessions_and_failures_are_reported(done, short_sessions, other_beam):
    found, progress = done
    assert [each.path for each in found.sessions] == short_sessions
    torn, other = found.failures
    assert "torn.mcap" in torn.message
    assert other.path == other_beam
    assert "beam_length_m is 1 m, but 0.98 m in" in other.message
    assert [step[0] for step in progress] == list(range(1, 11))
    assert progress[-1][:2] == (10, 10)
    assert {step[2] for step in progress} >= {path.name for path in short_sessions}


@pytest.mark.process
@pytest.mark.further  # as test_validation.py, where workers predict sessions
def test_workers_agree_with_this_process(done, short_sessions, settings):
    task = SessionTask(settings, ("I", "III"), (), None)
    with process_pool(1) as pool:
        (there,) = pool.run(analyse_session, [(RecordSource(short_sessions[2]), task)])
    here = done[0].sessions[2]
    assert np.array_equal(here.response, there.response)
    for one, two in zip(here.welch_models, there.welch_models, strict=True):
        assert one.fit.parameters == pytest.approx(two.fit.parameters, rel=1e-9)
    for one, two in zip(here.record_estimates, there.record_estimates, strict=True):
        assert one.fit.parameters == pytest.approx(two.fit.parameters, rel=1e-6, abs=1e-12)


def test_the_pooled_estimate_is_the_truth_within_its_interval(done, truth):
    found, _ = done
    _, damping = truth
    estimates = {each.name: each for each in found.pooled}
    three = estimates["III"]
    values = {each.name: each for each in three.parameters}
    assert abs(values["zeta"].value - damping.zeta) < 4 * values["zeta"].std
    assert abs(values["gamma"].value - damping.gamma) < 4 * values["gamma"].std
    assert three.misfit == pytest.approx(1.0, abs=0.1)
    assert estimates["I"].misfit > 2
    assert values["zeta"].heterogeneity_p_value > 1e-3


def test_left_out_sessions_are_predicted_to_within_noise(done):
    found, _ = done
    right = [e for e in found.validation if (e.method, e.name) == ("record", "III")]
    assert len(right) == len(found.sessions)
    for each in right:
        assert each.error < 1.05 * each.own_error
    wrong = [e.error for e in found.validation if (e.method, e.name) == ("record", "I")]
    assert min(wrong) > 1.5 * max(e.error for e in right)


def test_left_out_session_does_not_affect_its_prediction(done):
    """With another last session, its prediction stays the same."""
    found, _ = done
    sessions = list(found.sessions)
    strange = replace(
        sessions[-1],
        welch_models=tuple(
            replace(each, fit=replace(each.fit, parameters=dict.fromkeys(each.fit.parameters, 9.0)))
            for each in sessions[-1].welch_models
        ),
        record_estimates=tuple(
            replace(each, fit=replace(each.fit, covariance=9 * each.fit.covariance))
            for each in sessions[-1].record_estimates
        ),
    )
    before = models_without_session(sessions, len(sessions) - 1)
    after = models_without_session([*sessions[:-1], strange], len(sessions) - 1)
    assert [each.plant for each in before] == [each.plant for each in after]


def test_error_of_a_prediction_is_that_of_the_torque(done, short_sessions, truth):
    """The true plant leaves the noise, a plant without torque leaves everything."""
    found, _ = done
    (forecast, *_) = models_without_session(found.sessions, 0)
    link, damping = truth
    true = replace(forecast, plant=Plant(link, damping), own_plant=None)
    light = replace(link, density_kg_per_m=1e-12, bending_stiffness_n_m2=1e-12)
    none = replace(true, plant=Plant(light, damping))
    exact, nothing = leave_one_out_results(RecordSource(short_sessions[0]), [true, none], BAND_HZ)
    best = min(e.own_error for e in found.validation if e.own_error is not None)
    assert exact.error == pytest.approx(best, rel=0.1)
    assert nothing.error == pytest.approx(1.0, abs=1e-6)


FIGURES = (
    "figure5_signals", "figure6_nominal", "figure7_indices", "figure8_best", "pooled",
    "validation", "damping", "pooled_response",
)  # fmt: skip


def test_document_is_exported_as_a_linear_model_with_the_pooled_modes(done, truth, tmp_path):
    found, _ = done
    source = tmp_path / "campaign.json"
    source.write_text(document_text(campaign_document(found)))
    (*_, pooled) = json.loads(source.read_text())["headlines"]
    assert pooled["file"] is None
    beam = export_model(
        source, tmp_path / "beam.npz", ModelOptions(beam=True, posterior_sample_count=2)
    )
    assert beam.identified.length_m == truth[0].length_m
    with np.load(tmp_path / "beam.npz") as file:
        states, resonances = np.linalg.eigvals(file["A"]), file["poles_rad_s"]
    assert len(pooled["modes"]) == len(resonances) == 3
    for mode in pooled["modes"]:
        frequency_hz, damping = mode["frequency_hz"]["value"], mode["damping_ratio"]
        for poles, accuracy in ((states, 1e-3), (resonances, 1e-9)):  # 1e-3: not quite uniform
            pole = poles[np.argmin(np.abs(poles.imag - 2 * np.pi * frequency_hz))]
            assert pole.imag / (2 * np.pi) == pytest.approx(frequency_hz, rel=accuracy)
            low, high = damping["interval_95"]
            assert low < -pole.real / abs(pole) < high
        assert -pole.real / abs(pole) == pytest.approx(damping["value"], rel=1e-9)


@pytest.mark.further  # as figures of a report
def test_every_figure_is_filled(done, tmp_path):
    found, _ = done
    write_campaign(found, tmp_path, with_paper_values=True, formats=("png",))
    for figure in FIGURES:
        image = Image.open(tmp_path / "figures" / f"{figure}.png")
        assert np.asarray(image.convert("L")).std() > 5


def test_the_folder_holds_every_figure_and_table(done, tmp_path, without_drawing):
    found, _ = done
    steps = []
    with without_drawing():
        write_campaign(
            found, tmp_path, with_paper_values=True, on_step=steps.append, formats=("png",)
        )
    figures, tables = tmp_path / "figures", tmp_path / "tables"
    for figure in FIGURES:
        assert (figures / f"{figure}.png").exists()
        assert f"figure {figure}" in steps
    with (tables / "table3.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["mean"]) for row in rows] == [each.mean for each in found.statistics]
    assert rows[0]["paper_mean"] == "0.000133"
    with (tables / "table4.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 3 * 2
    first = {(row["quantity"], row["mode"], row["weighting"]): row for row in rows}
    deviation = found.nominal[2].deviations[0]
    row = first["magnitude_db", "1", "const"]
    assert float(row["III"]) == deviation.magnitude_db
    assert row["paper_III"] == "3.635"
    content = json.loads((tmp_path / "campaign.json").read_text())
    assert content["pooled"][0].keys() >= {"type", "parameter", "value", "between_std"}
    assert len(content["errors"]) == 2
    assert len(content["sessions_welch"]) == len(found.sessions) * 4
    settings, used = content["settings"], found.sessions[0].settings
    for name in ("segment_length", "overlap", "nfft"):
        assert settings[name] == getattr(used, name) > 0
    assert [file["welch_segments"] for file in content["files"]] == [
        session.segments for session in found.sessions
    ]
    indices = {(row["type"], row["weighting"]): row for row in content["nominal_indices"]}
    model = found.nominal[0]
    row = indices[model.structure, model.weighting]
    assert row["wmse"] == pytest.approx(model.mean_wmse)
    assert row["md_median"] == pytest.approx(np.median([each.md for each in model.indices]))
    page = (tmp_path / "report.html").read_text()
    how = f"Hamming segments of {used.segment_length}, overlap {used.overlap}, nfft {used.nfft}"
    assert how in page
    assert how in " ".join((tmp_path / "tables.txt").read_text().split())
    assert (
        page.index("the internal loss grows as f^")
        < page.index("<figure")
        < page.index('id="table3"')
    )
    assert "torn.mcap" in page
    assert "://" not in page.replace("http://www.w3.org", "")
    text = (tmp_path / "tables.txt").read_text()
    # No number without its validity: that of the worst session.
    slope_rad = max(each.validity.predicted_peak_tip_slope_rad for each in found.sessions)
    assert found.validity.predicted_peak_tip_slope_rad == slope_rad > 0.14
    assert found.validity.sentence in text
    assert found.validity.sentence in page
    of_beam = content["headlines"][-1]["validity"].pop("uniform_beam")
    from_campaign = found.validity.as_json()
    assert content["validity"].pop("uniform_beam") is from_campaign.pop("uniform_beam") is None
    assert content["validity"] == content["headlines"][-1]["validity"] == from_campaign
    assert of_beam["status"] == found.modal.uniform_beam.status == "passed"
    assert len(content["uniform_beam"]) == len(of_beam["constants"]) == 12
    alpha = next(row for row in content["parameters"] if row["parameter"] == "alpha")
    assert (alpha["value"], alpha["basis"]) == (found.verdict.alpha.value, "geometry")
    assert alpha["exact"] == found.verdict.alpha.exact.value
    for of_file in (*content["headlines"][:-1], *content["files"]):
        assert of_file["validity"]["predicted_peak_tip_slope_rad"] > 0.14
    for words in ("Table 3", "Table 4", "Table 5", "Pooled", "Leave-one-out", "torn"):
        assert words in text
    for name in ("table5", "nominal_indices", "welch_bias", "pooled", "validation", "session_list"):
        assert (tables / f"{name}.csv").stat().st_size > 100


def test_structures_state_what_all_sessions_have_in_common(done):
    """Density and stiffness are free in each session, as the fits of the sessions show."""
    found, _ = done
    (note,) = all_tables(found)["structures"].notes
    assert note.startswith("Each damping parameter has one value for all sessions")
    assert note.endswith("delay, tool inertia, ρ/EI and EI have one per session.")
    for key in ("density_over_stiffness", "bending_stiffness_n_m2"):
        values = {each.record_estimates[0].fit.parameters[key] for each in found.sessions}
        assert len(values) == len(found.sessions)


def flags_of(table):
    return [row["flag"] for row in csv.DictReader(csv_text(table).splitlines())]


def test_tables_have_no_flag_without_a_doubt(done):
    tables = all_tables(done[0])
    for name in ("pooled_modes", "pooled"):
        assert set(flags_of(tables[name])) == {""}
        assert "†" not in str(tables[name].shown_rows) + str(tables[name].notes)
    assert [flag for flag in flags_of(tables["parameters"]) if flag] == [
        "the unweighted mean: at its bound in at least one session"
    ]


def test_numbers_of_unexplained_records_have_their_flag(done):
    found, _ = done
    few = replace(found, verdict=replace(found.verdict, adequate=2))
    flag = "part of the records is unexplained"
    tables = all_tables(few)
    assert set(flags_of(tables["pooled_modes"])) == set(flags_of(tables["parameters"])) == {flag}
    assert set(flags_of(tables["pooled"])) == {flag}
    for table in headline_tables(few):
        assert f"† {flag}." in table.notes
        assert all("†" in str(row) for row in table.shown_rows)
    (row, *_) = json_rows(tables["pooled_modes"])
    assert list(row)[-2:] == ["damping_ratio_mixture", "flag"]
    assert [row["exact_flag"] for row in json_rows(tables["parameters"])] == [flag] * 8


def test_exact_values_of_a_refused_beam_have_its_flag(done):
    found, _ = done
    test = replace(found.modal.uniform_beam, status="refused", p_value=1e-9)
    tables = all_tables(replace(found, modal=replace(found.modal, uniform_beam=test)))
    reason = "a uniform beam does not predict the modal constants (p = 1e-09)"
    assert set(flags_of(tables["pooled"])) == {reason}
    assert set(flags_of(tables["pooled_modes"])) == {""}
    for row in tables["parameters"].rows:
        is_mean = row["parameter"].value == "tool_inertia_kg_m2"
        assert (
            row["exact_flag"].startswith("the unweighted mean")
            if is_mean
            else (row["exact_flag"] == reason)
        )
        assert row["exact"].text.endswith("†")


def test_the_verdict_names_the_structure_and_comes_first(done, truth):
    found, _ = done
    verdict = found.verdict
    assert (verdict.structure, verdict.sessions) == ("III", 4)
    assert verdict.adequate == 4
    # Of the requested types III has the lowest BIC; the numbers are the freest structure's.
    assert verdict.headline == "VI"
    for order in (verdict.alpha, verdict.lambda_):
        assert order.status == "compatible"
        assert order.interval[0] < 1 < order.interval[1]
    assert verdict.dissent == ()
    stated, answer, structure, *_ = verdict.sentences
    assert stated.startswith("The files state 2 different specimens: beam_length_m 0.98")
    assert answer.startswith("Internal loss growing as f^(")
    assert "external damping torque growing as f^(" in answer
    assert answer.count("consistent with order 1") == 2
    assert "for an unseen session: types III and VI with " in answer
    assert "from the modal constants of 4 sessions; the mode frequencies are those of" in structure
    assert "to 0.1 % as the files state it" in structure
    (condition,) = (each for each in verdict.sentences if each.startswith("If the beam is"))
    assert condition.startswith("If the beam is uniform to 1e-5 (type VI): alpha ")
    assert condition.count("consistent with 1") == 2
    assert not found.homogeneity.is_mixture
    assert any(
        "No significant between-session variance" in sentence for sentence in verdict.sentences
    )
    assert "\nParameters are those of a beam with both dampings" in campaign_text(found)
    document = campaign_document(found)
    assert document["verdict"]["structure"] == "III"
    *each, shared = document["headlines"]
    assert [one["file"] for one in each] == [str(session.path) for session in found.sessions]
    assert (shared["file"], shared["type"]) == (None, "VI")
    alpha = shared["parameters"]["alpha"]
    assert alpha["interval_95"] == list(verdict.alpha.interval)
    assert alpha["flag"] is None
    assert {*each[0], *shared} - {*shared} == {"scale_uncertainty", "combined", "part"}
    assert (shared["uniformity_percent"], shared["basis"]) == (0.1, "geometry")
    exact = shared["exact_geometry"]
    assert exact["condition"] == "if the beam is uniform to 1e-5"
    for name, quantity in exact["parameters"].items():
        if quantity["interval_95"] is not None:
            own = found.freest.parameters_by_name[name]
            assert quantity["interval_95"] == list(own.interval)
            assert shared["parameters"][name]["std"] >= 0.9 * quantity["std"]
    assert shared["covariance"]["names"][0] == "ln_zeta"
    assert np.shape(shared["covariance"]["matrix"]) == (7, 7)
    assert shared["modal_model"]["modes"] == [1, 2, 3]
    statuses = {one["type"]: one["status"] for one in shared["structures"]}
    expected = {"VI": "selected", "III": "compatible", "I": "excluded"}
    assert statuses.items() >= expected.items()
    internal, external = shared["sizes"]
    beam, damping = truth
    for size, loss in (
        (internal, lambda omega: damping.zeta * omega),
        (external, lambda omega: damping.gamma / (beam.density_over_stiffness * omega)),
    ):
        low, high = size["interval_95"]
        assert low < loss(size["omega_rad_s"]) < high
        assert high / low < 1.5
    true = modes(*truth, 3)
    for mode, own in zip(shared["modes"], true, strict=True):
        assert (mode["source"], mode["shown"]) == ("modal", True)
        for name in ("frequency_hz", "damping_ratio"):
            low, high = mode[name]["interval_95"]
            assert low < getattr(own, name) < high
        assert mode["participation"]["std"] < 0.05 * mode["participation"]["value"]
    assert document["files"][0]["verdict"]["structure"]
    fits = {(fit["file"], fit["estimator"], fit["type"], fit["weighting"]) for fit in
            document["fits"]}  # fmt: skip
    assert (str(found.sessions[0].path), "record", "III", None) in fits
    three = next(f for f in document["fits"] if (f["estimator"], f["type"]) == ("record", "III"))
    assert three["std"]["zeta"] > 0
    assert three["std"]["alpha"] is None
    assert {mode["mode"] for mode in document["modes"]} == {1, 2, 3}


def test_indices_of_a_whole_record_estimate_are_of_its_response(done):
    found, _ = done
    session = found.sessions[0]
    for each in session.record_estimates:
        plant = each.fit.plant
        s = 2j * np.pi * session.frequency_hz
        response = transfer(s, plant.beam, plant.damping) + plant.tool_inertia_kg_m2 * s**2
        away = np.abs(response * np.exp(-s * plant.delay_s) - session.response)
        assert each.indices.mse == pytest.approx(np.mean(away**2), rel=1e-6)
        assert each.indices.md == pytest.approx(away.max(), rel=1e-6)


def test_terminal_shows_pooled_results_only_by_default(done, as_text):
    found, _ = done
    short = as_text(campaign_tables(found, verbose=False))
    assert found.verdict.sentences[2][:60] in short
    assert "Modes with locked hub" in short
    assert "Pooled over 4 sessions: type VI" in short
    for more in ("Table 3", "Leave-one-out validation", "Sessions, as their files"):
        assert more not in short
        assert more in as_text(campaign_tables(found))


def test_fit_and_leave_one_out_error_are_in_one_table(done):
    found, _ = done
    of_three = [e for e in found.validation if (e.method, e.name) == ("record", "III")]
    (row,) = (
        row
        for row in validation_summary(found).rows
        if (row["method"], row["type"]) == ("record", "III")
    )
    own = np.mean([each.own_error for each in of_three])
    assert row["nrmse_percent"] == pytest.approx(100 * (1 - own))
    assert row["error"] == pytest.approx(np.mean([each.error for each in of_three]))
    # The nominal model of the type that the numbers are of is another one.
    nominal = [replace(each, method="welch", name="VI", own_error=None) for each in of_three]
    more = replace(found, validation=(*found.validation, *nominal))
    session, *_ = sessions_table(more).rows
    (trial,) = (
        e for e in found.validation if (e.source, e.name) == (found.sessions[0].source, "VI")
    )
    assert session["nrmse_percent"] == pytest.approx(100 * (1 - trial.own_error))
    assert session["error"] == trial.error


def test_fit_equals_that_of_a_single_report(done, short_sessions):
    """But for hum and free decay, which a report counts as explained: here are none."""
    found, _ = done
    measured = Measurement.from_record(load_record(short_sessions[0]))
    analysis = fit_record(measured, [STRUCTURES["III"]])
    (trial,) = (
        each
        for each in found.validation
        if (each.source.path, each.method, each.name) == (short_sessions[0], "record", "III")
    )
    (fit,) = analysis.fits
    assert 100 * (1 - trial.own_error) == pytest.approx(analysis.fit_percent(fit), abs=0.2)


def test_added_metadata_are_in_the_table_of_sessions(done):
    found, _ = done
    first, *others = found.sessions
    added = {"temperature_c": 21.5, "batch": "B 7"}
    warm = replace(first, experiment=replace(first.experiment, added_metadata=added))
    table = session_list_table(replace(found, sessions=(warm, *others)))
    headings = {column.column_key: column.heading for column in table.columns}
    assert headings["meta_temperature_c"] == "temperature (°C)"
    assert headings["meta_batch"] == "batch"
    one, two, *_ = json_rows(table)
    assert (one["meta_temperature_c"], one["meta_batch"]) == (21.5, "B 7")
    assert (two["meta_temperature_c"], two["meta_batch"]) == (None, None)
    assert table.rows[0]["meta_temperature_c"].text == "21.5"


def test_numbers_of_the_paper_are_shown_on_request_only(done):
    found, _ = done
    assert campaign_tables(found)
    assert "the paper's" not in campaign_text(found)
    assert "(1.33)" in campaign_text(found, with_paper_values=True)


def test_error_without_any_usable_session(tmp_path, settings, in_this_process):
    no_session = pytest.raises(CampaignError, match=r"(?s)No session could be.*none\.mcap")
    with in_this_process(), no_session:
        campaign([tmp_path / "none.mcap"], settings)
    with pytest.raises(CampaignError, match="none was given"):
        campaign([], settings)
