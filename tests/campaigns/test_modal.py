"""Modal constants of all sessions: the tolerance of the geometry does not average out."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cases import further
from cauchy_residues import modal_constants

from analysis.identify import MODE_CONSTANT_NAMES, ModalEstimate, ModalModel
from analysis.identify.sentences import uniformity
from analysis.identify.uniform_beam import UniformBeamProblem
from rigd.beam import Plant
from rigd.testing import PAPER_BEAM, PAPER_DAMPING

pytestmark = pytest.mark.fit

PLANT = Plant(PAPER_BEAM, PAPER_DAMPING)
MODES = (1, 2, 3)
TRUE = modal_constants(PLANT, MODES)
STD = np.tile([3e-5, 2e-3, 1e-3, 1e-3], len(MODES))
"""About those of a record of two minutes."""

UNEVEN = np.zeros(TRUE.size)
UNEVEN[:: len(MODE_CONSTANT_NAMES)] = 0.7e-3, -0.3e-3, -0.4e-3


@pytest.fixture
def pooled_modal_model(campaign_of):
    """Return the modal model of all sessions."""
    return lambda sessions: campaign_of(sessions).modal


@pytest.fixture
def sessions_of(make_session, make_experiment):
    """Sessions that show these constants, each with its own noise."""

    def make(count, constants=TRUE, *, first=0, uniformity=1e-3, std=STD, **facts):
        found = []
        for number in range(first, first + count):
            own = constants + std * np.random.default_rng(number).normal(size=std.size)
            modal = ModalEstimate(
                ModalModel.from_constants(own, (0.0,) * 5),
                MODES,
                own,
                np.diag(np.concatenate([std**2, np.ones(5)])),
            )
            name = f"{number}.mcap"
            found.append(
                replace(
                    make_session(name), modal=modal, nominal=Plant(PAPER_BEAM, PAPER_DAMPING),
                    uniformity=uniformity, experiment=make_experiment(name, **facts),
                )
            )  # fmt: skip
        return found

    return make


def test_noise_averages_out_but_nonuniformity_does_not(sessions_of, pooled_modal_model):
    five, forty = (pooled_modal_model(sessions_of(count, uniformity=3e-3)) for count in (5, 40))
    for few, many in zip(five.modes, forty.modes, strict=True):
        assert many.frequency_std_hz < 0.5 * few.frequency_std_hz
    stiffness = [each.tolerant.std["bending_stiffness_n_m2"] for each in (five, forty)]
    assert stiffness[1] == pytest.approx(stiffness[0], rel=0.1)
    # Three modes whose frequencies are uncertain by 0.3 % each
    assert stiffness[1] > 2e-3 * PAPER_BEAM.bending_stiffness_n_m2


def test_modes_are_those_of_the_sessions(sessions_of, pooled_modal_model):
    found = pooled_modal_model(sessions_of(20, TRUE + UNEVEN, uniformity=0.0))
    rows = (TRUE + UNEVEN).reshape(-1, len(MODE_CONSTANT_NAMES))
    for mode, (ln_frequency, ln_ratio, *_) in zip(found.modes, rows, strict=True):
        assert mode.source == "modal"
        assert abs(mode.frequency_hz - np.exp(ln_frequency)) < 4 * mode.frequency_std_hz
        assert abs(mode.damping_ratio - np.exp(ln_ratio)) < 4 * mode.damping_ratio_std
        assert 0 < mode.participation_std_kg_m2 < 0.01 * mode.participation_kg_m2


def test_only_a_uniform_beam_passes(sessions_of, pooled_modal_model):
    even, uneven = (pooled_modal_model(sessions_of(12, each)) for each in (TRUE, TRUE + UNEVEN))
    assert even.uniform_beam.status == "passed"
    assert even.replaces_beam_modes
    assert "A uniform beam predicts" in uniformity(even.uniform_beam)[0]
    assert uneven.uniform_beam.status == "refused"
    assert uneven.uniform_beam.p_value < 1e-10
    assert "does not predict" in uniformity(uneven.uniform_beam)[0]
    # Losses are the same, and the tolerance covers the differences of the mode frequencies.
    for name, true in PLANT.parameters.items():
        if name in ("alpha", "lambda"):
            low, high = uneven.tolerant.interval[name]
            assert low < true < high


def test_largest_stated_uniformity_is_used_and_reported(
    sessions_of, pooled_modal_model, verdict_of
):
    zero = pooled_modal_model(sessions_of(4, uniformity=0.0))
    assert zero.tolerant is None
    assert not zero.replaces_beam_modes
    every = [*sessions_of(3, uniformity=0.0), *sessions_of(3, first=3)]
    assert pooled_modal_model(every).tolerant.uniformity == 1e-3
    sentences = " ".join(verdict_of(every).sentences)
    assert "to 0.1 %, the largest of the 0 and 0.1 % that the files state" in sentences
    # An uneven beam stated to be exact: no order is reported on that condition.
    uneven = pooled_modal_model(sessions_of(4, TRUE + UNEVEN, uniformity=0.0))
    assert uneven.tolerant is None
    assert uneven.replaces_beam_modes


TILT_DEG = 5.0


def tilted():
    """Exact constants of the beam with gravity along it, from the prediction of a test."""
    estimate = ModalEstimate(
        ModalModel.from_constants(TRUE, (0.0,) * 5), MODES, TRUE, np.diag([1e-8] * (TRUE.size + 5))
    )
    problem = UniformBeamProblem(estimate, MODES, PLANT, tilt_deg=TILT_DEG)
    return problem.constants(UniformBeamProblem(estimate, MODES, PLANT).minima()[0].x)


def test_stated_tilt_is_part_of_the_beam(sessions_of, pooled_modal_model):
    unknown, stated, zero = (
        pooled_modal_model(sessions_of(8, tilted(), **facts)).uniform_beam
        for facts in ({}, {"axis_tilt_deg": TILT_DEG}, {"axis_tilt_deg": 0.0})
    )
    assert stated.status == "passed"
    assert (unknown.status, zero.status) == ("refused", "refused")


def test_parameters_include_the_stated_tilt(sessions_of, pooled_modal_model):
    """If only some of the files state it, too; and a tolerance of 0 does not omit gravity."""
    some = [*sessions_of(4, tilted()), *sessions_of(4, tilted(), first=4, axis_tilt_deg=TILT_DEG)]
    exact = sessions_of(8, tilted(), uniformity=0.0, axis_tilt_deg=TILT_DEG)
    for sessions in (some, exact):
        found = pooled_modal_model(sessions)
        assert found.uniform_beam.status == "passed"
        key = "density_over_stiffness"
        value, std = found.tolerant.values[key], found.tolerant.std[key]
        assert abs(value - PLANT.parameters[key]) < 4 * std


def test_mode_visible_in_few_sessions_is_left_out(sessions_of, pooled_modal_model):
    first, *others = sessions_of(4, uniformity=0.0)
    two = replace(
        first, modal=replace(first.modal, mode_numbers=(1, 2, 0)).restrict_to_visible_modes()
    )
    assert two.modal.mode_constants.size == 2 * len(MODE_CONSTANT_NAMES)
    assert two.modal.joint_covariance.shape == (13, 13)
    found = pooled_modal_model([two, *others])
    assert found.visible_mode_numbers == (1, 2)
    many = pooled_modal_model([two, *sessions_of(12, first=1, uniformity=0.0)])
    assert (many.visible_mode_numbers, many.sessions) == (MODES, 12)
    assert pooled_modal_model([first]) is None
    assert pooled_modal_model([replace(first, modal=None), others[0]]) is None


def test_phases_are_pooled_modulo_whole_turns(sessions_of, pooled_modal_model):
    plain = sessions_of(4, uniformity=0.0)
    turn = np.zeros(TRUE.size)
    turn[MODE_CONSTANT_NAMES.index("residue_phase_rad")] = 2 * np.pi
    modal = plain[2].modal
    turned = replace(plain[2], modal=replace(modal, mode_constants=modal.mode_constants - turn))
    one, other = pooled_modal_model(plain), pooled_modal_model([*plain[:2], turned, plain[3]])
    assert other.mode_constants == pytest.approx(one.mode_constants, abs=1e-9)
    assert other.uniform_beam.chi_square == pytest.approx(one.uniform_beam.chi_square, rel=1e-6)


# Rising and falling sweeps

UP = {"excitation": "chirp", "start_hz": 0.05, "stop_hz": 50.0}
DOWN = {"excitation": "chirp", "start_hz": 50.0, "stop_hz": 0.05}


def test_a_falling_sweep_is_the_same_experiment(make_experiment):
    up, down = make_experiment(**UP), make_experiment(**DOWN)
    assert (up.is_rising, down.is_rising, make_experiment().is_rising) == (True, False, None)
    assert up.difference(down) is None
    assert down.difference(up) is None
    assert "start_hz" in up.difference(make_experiment(**{**DOWN, "stop_hz": 0.5}))
    assert make_experiment(**{**UP, "excitation": "multisine"}).is_rising is None
    assert make_experiment(**UP, there_and_back=1.0).is_rising is None


@pytest.mark.parametrize("count", [further(1), 3])
def test_agreeing_opposite_sweeps_exclude_a_change(sessions_of, verdict_of, count):
    found = verdict_of([*sessions_of(count, **UP), *sessions_of(count, first=50, **DOWN)])
    sweeps = found.sweeps
    assert (sweeps.rising, sweeps.falling, sweeps.changed) == (count, count, ())
    (sentence,) = [each for each in found.sentences if "along the records" in each]
    assert sentence.startswith("No significant change along the records was found: ")
    # The limits are those of the noise of a few sessions, each with STD.
    frequency_percent, damping_percent = map(float, re.findall(r"([\d.e-]+) % in a", sentence))
    assert max(abs(100 * mode.frequency) for mode in sweeps.modes) < frequency_percent < 0.03
    assert max(abs(100 * mode.damping) for mode in sweeps.modes) < damping_percent < 2
    assert found.experiments == ()


def test_sweeps_of_one_direction_do_not_exclude_changes(sessions_of, verdict_of):
    found = verdict_of(sessions_of(3, **UP))
    assert found.sweeps is None
    assert not any("changed along" in each for each in found.sentences)


@pytest.mark.parametrize("count", [further(1), 3])
def test_opposite_sweeps_report_the_changed_mode(sessions_of, verdict_of, count):
    """The stiffness of mode 2 falls by 0.4 % after the rising sweep has passed it."""
    later = TRUE.copy()
    later[len(MODE_CONSTANT_NAMES)] -= 2e-3
    every = [*sessions_of(count, **UP), *sessions_of(count, later, first=50, **DOWN)]
    found = verdict_of(every)
    (changed,) = found.sweeps.changed
    assert changed.mode == 2
    assert abs(changed.frequency + 2e-3) < 4 * changed.frequency_std
    sentences = " ".join(found.sentences)
    assert re.search(r"mode 2 \(falling: frequency 0\.(19|20)\d* ± 0\.0\d+ % lower", sentences)
    (advice,) = found.experiments
    assert "half the amplitude" in advice


def test_refused_beam_in_one_direction_suggests_the_other(sessions_of, verdict_of):
    every = sessions_of(4, TRUE + UNEVEN, uniformity=0.0, **UP)
    (advice,) = verdict_of(every).experiments
    assert advice.startswith("Add falling sweeps")
    assert verdict_of(sessions_of(4, TRUE + UNEVEN, uniformity=0.0)).experiments == ()


# Verdict

VERDICT = SimpleNamespace(
    structure="VI", adequate=True, visible_modes=MODES, findings=(), experiments=(),
    alpha=SimpleNamespace(status="compatible"), lambda_=SimpleNamespace(status="fractional"),
)  # fmt: skip


@pytest.fixture
def verdict_of(make_estimate, campaign_of):
    """Verdict on sessions with narrow estimates of type VI, as an exactly uniform beam has them."""
    names = ("zeta", "alpha", "gamma", "lambda")
    values = {name: PLANT.parameters[name] for name in names}
    estimate = make_estimate("VI", values, np.diag([1e-6] * 4), names)

    def campaign_verdict(sessions):
        every = [replace(each, record_estimates=(estimate,), verdict=VERDICT) for each in sessions]
        return campaign_of(every).verdict

    return campaign_verdict


def test_orders_of_an_exactly_uniform_beam_omit_the_tilt(sessions_of, verdict_of):
    found = verdict_of(sessions_of(8, tilted(), axis_tilt_deg=TILT_DEG))
    for order in (found.alpha, found.lambda_):
        assert order.interval is not None
        assert "the axis is tilted" in order.exact.reason
    assert not any(each.startswith("If the beam is uniform to 1e-5") for each in found.sentences)
    assert found.withheld_orders == {"alpha", "lambda"}


def test_order_is_the_slope_of_a_loss(sessions_of, verdict_of):
    found = verdict_of(sessions_of(8))
    for order, exact in ((found.alpha, found.alpha.exact), (found.lambda_, found.lambda_.exact)):
        low, high = order.interval
        assert low < PLANT.parameters[order.order] < high
        assert high - low > 5 * (exact.interval[1] - exact.interval[0])
    text = " ".join(found.sentences)
    assert "Between 2.57 and 44.8 Hz the internal loss grows as f^" in text
    assert "if frequencies are those of a uniform beam to 0.1 %: consistent with order 1." in text
    (condition,) = (each for each in found.sentences if each.startswith("If the beam is uniform"))
    assert "to 1e-5 (type VI): alpha 0.99" in condition
    assert "lambda 0.59" in condition
    assert "which would exclude 1" in condition
    assert "; 1 is excluded" not in text
    assert found.withheld_orders == frozenset()


def test_exact_values_are_withheld_where_a_uniform_beam_is_refused(sessions_of, verdict_of):
    found = verdict_of(sessions_of(8, TRUE + UNEVEN))
    assert not any("uniform to 1e-5" in each for each in found.sentences)
    assert found.alpha.interval[1] - found.alpha.interval[0] > 0.02
    exact = verdict_of(sessions_of(8, TRUE + UNEVEN, uniformity=0.0))
    assert exact.lambda_.status == "open"
    assert "does not predict the modal constants" in exact.lambda_.reason
    assert "1 is excluded" not in " ".join(exact.sentences)


def test_numbers_of_strongly_nonuniform_beam_follow_its_losses(sessions_of, verdict_of):
    text = " ".join(verdict_of(sessions_of(4, TRUE + 40 * UNEVEN)).sentences)
    assert "by damping ratios and residue phases alone: the frequencies are not those of" in text
    assert "the mode frequencies are those of" not in text


def test_numbers_are_narrow_for_uniformity_0(sessions_of, verdict_of):
    found = verdict_of(sessions_of(8, uniformity=0.0))
    assert found.lambda_.exact is None
    assert found.lambda_.status == "fractional"
    assert found.lambda_.interval[1] - found.lambda_.interval[0] < 0.003
    assert found.sentences[1].startswith("The numbers are those of type VI")
    assert not any(each.startswith("If the beam") for each in found.sentences)
