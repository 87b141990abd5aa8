"""Verdicts on sessions of known plants: the structure, its orders, and other effects."""

import json
from dataclasses import replace

import numpy as np
import pytest

from analysis.identify import fit_record, headline_json, select
from analysis.identify.deviance_curve import CHI_SQUARE_95
from analysis.identify.verdict import SECOND_DAMPING_REASON, too_few_modes
from analysis.models import STRUCTURES
from analysis.statistics import BIC_TIE
from rigd.beam import Beam, Plant, clamped_free_eigenvalues
from rigd.session import Validity

pytestmark = pytest.mark.fit

OTHER = Beam(0.98, 4.7e-3 * 1.01 * 1.02, 0.090275 * 1.02)
"""rho/EI off by 1 %, EI by 2 %."""

NOISE_NM = 1e-2


def kinds(verdict):
    return {found.kind for found in verdict.findings}


@pytest.fixture(scope="module")
def type_iii(sessions):
    return select(sessions("III").measured(noise_nm=NOISE_NM, seed=41))


def test_verdict_on_a_plant_of_type_iii(type_iii):
    verdict = type_iii.verdict
    assert (verdict.structure, verdict.adequate) == ("III", True)
    assert verdict.findings == ()
    assert verdict.visible_modes == (1, 2, 3)
    for order in (verdict.alpha, verdict.lambda_):
        assert (order.status, order.value) == ("compatible", order.profile.estimate)
        assert order.interval[0] < 1 < order.interval[1]


def test_numbers_are_those_of_the_freest_structure(type_iii):
    headline = type_iii.headline
    assert headline.fit is type_iii.fit
    assert headline.fit.structure is STRUCTURES["VI"]
    assert headline.flags == {}
    status = dict(headline.structures)
    assert [name for name, its in headline.structures if its == "selected"] == ["VI"]
    assert (status["III"], status["VII"]) == ("compatible", "compatible")
    assert {status[name] for name in ("I", "II", "IV", "V")} == {"excluded"}
    truth = {"zeta": 0.54e-4, "alpha": 1.0, "gamma": 0.02, "lambda": 1.0, "delay_s": 0.0}
    for name, value in truth.items():
        quantity = headline.parameters[name]
        assert abs(quantity.value - value) < 4 * quantity.std, name
        low, high = quantity.interval_95
        assert low < quantity.value < high
    assert headline.parameters["alpha"].interval_95 == type_iii.verdict.alpha.interval


def test_loss_factor_is_more_accurate_than_its_coefficient(type_iii, link):
    headline = type_iii.headline
    internal, external = headline.sizes
    for size, coefficient, truth in (
        (internal, "zeta", 0.54e-4 * internal.omega_rad_s),
        (external, "gamma", 0.02 / (link.density_over_stiffness * external.omega_rad_s)),
    ):
        quantity, known = size.size, headline.parameters[coefficient]
        assert quantity.std / quantity.value < 0.7 * known.std / known.value
        assert abs(quantity.value - truth) < 4 * quantity.std


def test_result_of_a_simpler_structure_is_conditional(type_iii):
    simpler = type_iii.headline.simpler
    assert (simpler.name, simpler.fixed) == ("III", {"alpha": 1.0, "lambda": 1.0})
    assert simpler.parameters["zeta"].value == pytest.approx(0.54e-4, rel=0.02)
    assert simpler.parameters["zeta"].std < 0.5 * type_iii.headline.parameters["zeta"].std
    (sentence,) = [each for each in type_iii.verdict.sentences if "if true" in each]
    assert sentence.startswith("Alpha = 1 and lambda = 1 are not excluded; if true (type III)")


@pytest.fixture(scope="module")
def nearly_one(sessions):
    """Type VI of Table 5, where alpha is 0.996: no record distinguishes that from 1."""
    return select(sessions("VI").measured(noise_nm=NOISE_NM, seed=3))


@pytest.mark.further  # as two orders of 1 above
def test_order_close_to_1_flags_no_number(nearly_one):
    headline, (low, high) = nearly_one.headline, nearly_one.verdict.alpha.interval
    assert nearly_one.verdict.structure == "VII"
    assert low < 0.996 < high
    low, high = headline.parameters["zeta"].interval_95
    assert low < 7.1e-5 < high
    assert nearly_one.verdict.lambda_.status == "fractional"
    assert dict(headline.structures)["VII"] == "compatible"
    low, high = headline.simpler.parameters["zeta"].interval_95
    assert not low < 7.1e-5 < high  # which is why it is reported as a condition only


def test_the_headline_is_json(type_iii):
    verdict = type_iii.verdict
    content = headline_json(
        "x.mcap", type_iii.headline, (verdict.alpha, verdict.lambda_), verdict.findings,
        Validity(0.6, 0.12),
    )  # fmt: skip
    back = json.loads(json.dumps(content, allow_nan=False))
    assert back["file"] == "x.mcap"
    assert back["validity"]["predicted_peak_tip_slope_rad"] == 0.6
    assert {"zeta", "alpha", "gamma", "lambda", "density_over_stiffness", "delay_s",
            "bending_stiffness_n_m2", "tool_inertia_kg_m2"} == set(back["parameters"])  # fmt: skip
    for each in back["parameters"].values():
        assert set(each) == {"value", "std", "interval_95", "flag"}
    assert back["orders"]["lambda"]["status"] == "compatible"
    assert {"type": "VI", "status": "selected"} in back["structures"]
    assert [mode["mode"] for mode in back["modes"]] == [1, 2, 3]
    assert back["conditional"]["on"] == {"alpha": 1.0, "lambda": 1.0}


def test_the_table_ranks_the_structures(type_iii):
    verdict = type_iii.verdict
    assert sorted(row.structure for row in verdict.table) == sorted(STRUCTURES)
    bic = [row.delta_bic for row in verdict.table]
    assert bic[0] == 0
    assert bic == sorted(bic)
    assert min(row.delta_aic for row in verdict.table) == 0
    at = {row.structure: row for row in verdict.table}
    freed = at["VII"]
    count = type_iii.candidates[0].compared_value_count
    gained = count * np.log(at["III"].cost / freed.cost)
    assert freed.delta_bic == pytest.approx(np.log(count) - gained)
    assert at["II"].delta_bic > 1000
    assert [c.fit.cost for c in type_iii.candidates] == [row.cost for row in verdict.table]


def test_the_verdict_is_json(type_iii):
    verdict = type_iii.verdict
    text = json.dumps(verdict.as_json(), allow_nan=False)
    back = json.loads(text)
    assert back["structure"] == "III"
    assert back["lambda"]["status"] == "compatible"
    assert back["alpha"]["profile"]["values"] == list(verdict.alpha.profile.values)
    assert back["sentences"] == list(verdict.sentences)


@pytest.fixture(scope="module")
def undeclared(sessions):
    made = sessions("IV", beam=OTHER, delay_s=3e-4, tool_inertia_kg_m2=1e-5)
    return select(made.measured(noise_nm=NOISE_NM, seed=43)).verdict


def test_a_fractional_order_that_the_data_support(undeclared):
    assert (undeclared.structure, undeclared.rivals) == ("IV", ())
    alpha, lambda_ = undeclared.alpha, undeclared.lambda_
    assert alpha.status == "fractional"
    low, high = alpha.interval
    assert low < alpha.value < high < 1
    assert abs(alpha.value - 0.8) < 4 * (high - low) / (2 * 1.96)  # 95 % miss one in twenty
    assert (lambda_.status, lambda_.value) == ("absent", None)


def test_delay_clamp_and_beam_data_are_reported(undeclared):
    assert kinds(undeclared) == {"delay", "tool inertia", "beam data"}
    found = {finding.kind: finding for finding in undeclared.findings}
    assert found["delay"].value == pytest.approx(3e-4, abs=2e-5)
    low, high = found["delay"].interval
    assert abs(found["delay"].value - 3e-4) < 4 * (high - low) / (2 * 1.96)
    assert "Declare the delay" in found["delay"].remedy
    assert found["tool inertia"].value == pytest.approx(1e-5, rel=0.1)
    off = [f.value for f in undeclared.findings if f.kind == "beam data"]
    assert off == pytest.approx([0.01, 0.02], abs=4e-3)


@pytest.fixture(scope="module")
def one_mode(sessions):
    return select(sessions("III").measured(noise_nm=NOISE_NM, seed=44), band_hz=(0.0, 10.0))


def test_one_mode_does_not_determine_order(one_mode):
    headline, one_mode = one_mode.headline, one_mode.verdict
    assert one_mode.visible_modes == (1,)
    assert one_mode.alpha.status == "not identifiable"
    assert one_mode.alpha.value is None
    assert one_mode.alpha.interval is None
    assert one_mode.lambda_.status == "not identifiable"
    assert one_mode.lambda_.value is None
    for name in ("alpha", "lambda"):
        assert any(
            name in sentence and "not identifiable" in sentence for sentence in one_mode.sentences
        )
        assert name not in one_mode.parameters
    for name in headline.parameters.keys() & {"zeta", "alpha", "gamma", "lambda"}:
        assert "a single mode determines" in headline.parameters[name].flag
    assert all("one mode alone" in each.size.flag for each in headline.sizes)
    # A low order of damping resembles a stiffness, a high order an inertia.
    for name in ("density_over_stiffness", "bending_stiffness_n_m2"):
        assert "damping of unknown order" in headline.parameters[name].flag
        assert headline.parameters[name].interval_95 is not None
    assert headline.modes[0].frequency_hz.flag is None
    (mode,) = headline.modes
    assert mode.damping_ratio.flag is None
    assert mode.damping_ratio.value == pytest.approx(0.01245, rel=0.03)
    assert any("excite the second mode" in what for what in one_mode.experiments)
    assert kinds(one_mode) <= {"air drag"}  # from which one mode hardly differs


@pytest.mark.parametrize(
    ("structure", "modes", "reason"),
    [
        ("IV", 1, "a single mode"),
        ("IV", 2, SECOND_DAMPING_REASON),
        ("IV", 3, None),
        ("VI", 2, None),
    ],
)
def test_orders_determined_by_number_of_modes(structure, modes, reason):
    found = too_few_modes(STRUCTURES[structure], modes)
    assert found is reason if reason is None else found.startswith(reason)


@pytest.mark.further  # the consequences for the numbers are above, for one mode
def test_two_modes_with_one_damping_do_not_determine_order(sessions):
    """Its two numbers explain any two loss factors, those of two dampings too.

    The result of three modes is above.
    """
    done = select(sessions("IV").measured(noise_nm=NOISE_NM, seed=44), band_hz=(0.0, 30.0))
    verdict, headline = done.verdict, done.headline
    assert verdict.visible_modes == (1, 2)
    assert headline.fit.structure.name == "IV"
    for order in (verdict.alpha, verdict.lambda_):
        assert (order.status, order.reason) == ("not identifiable", SECOND_DAMPING_REASON)
    assert (
        headline.parameters["zeta"].flag
        == headline.parameters["alpha"].flag
        == SECOND_DAMPING_REASON
    )
    assert all(each.size.flag for each in headline.sizes)
    assert all(mode.damping_ratio.flag is None for mode in headline.modes)
    assert any(
        each.startswith("Internal damping alone is sufficient.") for each in verdict.sentences
    )


def test_indistinguishable_structures_are_reported(one_mode):
    verdict = one_mode.verdict
    close = [row.structure for row in verdict.table[1:] if row.delta_bic < BIC_TIE]
    assert close
    assert list(verdict.rivals) == close
    status = dict(one_mode.headline.structures)
    assert all(status[name] in ("compatible", "selected") for name in close)
    assert "does not separate internal from external damping" in verdict.sentences[0]


@pytest.mark.further  # as each alone
def test_hum_and_rising_stiffness_do_not_appear_as_damping(sessions, stiffening):
    made = sessions("III", sweep_s=60)
    t = np.arange(made.torque_nm.size) / 1000
    hum = 0.03 * np.sin(2 * np.pi * 50.02 * t)  # beyond the band, and leaking into it
    torque = made.torque_nm + stiffening("III", 0.02, 60) + hum
    spoilt = type(made)(made.angle_rad, torque)
    selection = select(spoilt.measured(noise_nm=NOISE_NM, seed=45))
    verdict, headline = selection.verdict, selection.headline
    assert all("depends on the deflection" in mode.frequency_hz.flag for mode in headline.modes)
    assert all(mode.damping_ratio.flag is None for mode in headline.modes)
    assert set(headline.flags) == {"density_over_stiffness"}
    assert (verdict.structure, verdict.adequate) == ("III", True)
    assert kinds(verdict) == {"hum", "nonlinear stiffness"}
    line, force = verdict.findings
    assert line.value == pytest.approx(0.03, rel=0.1)
    assert "the mains" in line.sentence
    assert force.value == pytest.approx(0.02, rel=0.15)
    assert "mode 1" in force.sentence
    assert verdict.alpha.status == verdict.lambda_.status == "compatible"


@pytest.fixture(scope="module")
def field(sessions, candidates_of):
    made = sessions("III", offsets=(0.006, -0.013)).cut(0, 12_500)
    return candidates_of(made.measured(noise_nm=NOISE_NM, seed=46))


@pytest.mark.further  # as an elastic clamp in test_rig_findings.py
def test_nonuniform_beam_is_no_fractional_order(sessions, link, plants):
    offsets = (0.006, -0.013)
    made = sessions("III", offsets=offsets)
    selection = select(made.measured(noise_nm=NOISE_NM, seed=46))
    headline, verdict = selection.headline, selection.verdict
    assert headline.uniform_beam.status == "refused"
    assert verdict.adequate
    assert kinds(verdict) <= {"rival explanations"}
    assert "fractional" not in (verdict.alpha.status, verdict.lambda_.status)
    loaded = Plant(link, plants["III"], stiffness_offsets=offsets)
    poles = loaded.poles(clamped_free_eigenvalues(3))[:, 0]
    for mode, pole in zip(headline.modes, poles, strict=True):
        for quantity, value in (
            (mode.frequency_hz, pole.imag / (2 * np.pi)),
            (mode.damping_ratio, -pole.real / abs(pole)),
        ):
            assert quantity.flag is None
            assert abs(quantity.value - value) < 4 * quantity.std


@pytest.mark.further  # each by itself is above
def test_fractional_order_on_a_nonuniform_beam(sessions):
    made = sessions("IV", offsets=(0.006, -0.013))
    selection = select(made.measured(noise_nm=NOISE_NM, seed=47))
    verdict = selection.verdict
    assert verdict.adequate
    assert selection.headline.uniform_beam.status == "refused"
    assert kinds(verdict) <= {"rival explanations"}
    low, high = verdict.alpha.interval
    assert abs(verdict.alpha.value - 0.8) < 4 * (high - low) / (2 * 1.96)
    assert verdict.lambda_.status == "not identifiable"


def test_unknowns_of_a_plant_lead_back_to_it(field):
    for candidate in field.candidates:
        unknowns = field.unknowns(candidate.structure)
        back = unknowns.plant(unknowns.vector(candidate.fit.plant)).parameters
        for name, value in candidate.fit.parameters.items():
            assert back[name] == pytest.approx(value, rel=1e-9, abs=1e-15), name


def test_a_refit_at_the_minimum_stays_there(field):
    best = field.best
    assert field.refit(best).cost == pytest.approx(best.fit.cost, rel=1e-7)


def test_profile_agrees_with_a_fit_of_fixed_order(type_iii, sessions):
    profile = type_iii.verdict.alpha.profile
    held = [
        replace(STRUCTURES["VI"], fixed={"alpha": value})
        for value in (profile.estimate, *profile.interval)
    ]
    analysis = fit_record(sessions("III").measured(noise_nm=NOISE_NM, seed=41), held)
    costs = np.array([each.cost for each in analysis.fits])
    deviance = type_iii.candidates[0].compared_value_count * np.log(costs / costs[0])
    assert deviance[1:] == pytest.approx(CHI_SQUARE_95, rel=0.05)
    assert profile.identifiable
    assert profile.relative_width < 0.02
    assert min(profile.deviance) == 0


def test_candidates_start_from_those_of_a_part(
    sessions, candidates_of, true_parameters, monkeypatch
):
    """Without a search, and to the truth; where that leaves more than noise, not at all."""
    made = sessions("III")
    part, whole = (made.cut(0, end).measured(NOISE_NM, 41) for end in (11_000, 13_000))
    candidates = candidates_of(part)

    def search(*_, **__):
        raise AssertionError("nothing was to be searched for")

    monkeypatch.setattr("analysis.identify._candidates.fit_record", search)
    earlier = candidates.candidates
    again = candidates.refit_from_earlier(earlier, whole, (), (0.0, 50.0))
    assert sorted(each.name for each in again.candidates) == sorted(STRUCTURES)
    truth = true_parameters("III")
    fit = again.likeliest_fit
    assert {"zeta", "gamma"} <= set(fit.determined)
    for name in fit.determined:
        assert abs(fit.parameters[name] - truth[name]) < 4 * fit.std[name], name
    hum_nm = 2e-2 * np.sin(2 * np.pi * 16.4 * np.arange(13_000) / 1000)  # near mode 2
    humming = replace(whole, torque_nm=whole.torque_nm + hum_nm)
    assert candidates.refit_from_earlier(earlier, humming, (), (0.0, 50.0)) is None
