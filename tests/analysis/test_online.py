"""Online fit: the same as the analysis of the file, honest before, and in the fit process."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cases import further
from processes import eventually

from analysis.applicability import record_band_hz
from analysis.identify import Measurement, fit_freest_alone, select
from analysis.identify.headline import CONTRADICTED_FILE_REASON
from analysis.online import OnlineEstimate, OnlineEstimator
from analysis.record import load_record
from analysis.results import whole_record
from rigd.beam import Beam, Damping, Plant, clamped_free_eigenvalues, modes
from rigd.runner.fit_process import EstimateRequest, EstimationError, EstimatorThread
from rigd.session import read_session
from rigd.testing import PAPER_BEAM, PAPER_DAMPING, chirp_signals

pytestmark = pytest.mark.process

MODAL = ("frequency_hz", "damping_ratio")


@pytest.fixture(scope="module")
def session(short_chirps):
    return read_session(short_chirps[0])


def fed(session, block=777) -> OnlineEstimator:
    fit = OnlineEstimator(session.metadata, session.segments, str(session.path))
    for first in range(0, len(session.samples), block):
        fit.feed(session.samples[first : first + block])
    return fit


def fed_with(signals, session, beam=PAPER_BEAM) -> OnlineEstimator:
    """Online fit of signals, with the metadata of a session but for the beam's."""
    samples = np.zeros(signals.angle_rad.size, session.samples.dtype)
    samples["tick"] = np.arange(samples.size)
    samples["t_ns"] = np.arange(samples.size) * 1_000_000
    samples["angle_reference_rad"] = signals.reference_rad
    samples["angle_rad"] = signals.angle_rad
    samples["coupling_torque_nm"] = signals.torque_nm
    stated = {
        "rate_hz": "1000",
        "beam_length_m": repr(beam.length_m),
        "beam_density_kg_per_m": repr(beam.density_kg_per_m),
        "beam_bending_stiffness_n_m2": repr(beam.bending_stiffness_n_m2),
    }
    fit = OnlineEstimator(stated, signals.segments)
    fit.feed(samples)
    return fit


def scan(**others):
    return chirp_signals(
        **{"sweep_s": 5.0, "ring_down_s": 1.0, "start_hz": 0.5, "noise_nm": 1e-2} | others
    )


@pytest.mark.further  # as in tests/cli/test_until.py
def test_last_estimate_equals_that_of_the_file(session):
    live = fed(session).estimate(whole=True)
    selection = whole_record(load_record(session.path)).selection
    assert live.headline.parameters == selection.headline.parameters
    assert live.headline.modes == selection.headline.modes
    assert live.findings == selection.verdict.findings
    np.testing.assert_array_equal(live.headline.fit.covariance, selection.fit.covariance)
    assert live.orders == (selection.verdict.alpha, selection.verdict.lambda_)
    assert live.tick == len(session.samples)
    assert live.doubt is None


def test_record_equals_that_of_the_file(session):
    live, record = fed(session).record(), load_record(session.path)
    for name in ("time_s", "angle_rad", "torque_nm", "reference_rad", "torque_known"):
        np.testing.assert_array_equal(getattr(live, name), getattr(record, name))
    assert (live.rate_hz, live.beam, live.sweep) == (record.rate_hz, record.beam, record.sweep)


@pytest.mark.further  # from the same record
def test_quick_estimate_equals_that_of_the_file(session):
    live = fed(session).estimate()
    record = load_record(session.path)
    headline, found, _ = fit_freest_alone(Measurement.from_record(record), record_band_hz(record))
    assert live.headline.parameters == headline.parameters
    assert live.headline.modes == headline.modes
    assert live.findings == found


@pytest.fixture(scope="module")
def of_four_seconds(session):
    return fed(session).estimate(4000)


def test_estimate_depends_on_earlier_ticks_only(session, of_four_seconds):
    early = OnlineEstimator(session.metadata, session.segments)
    early.feed(session.samples[:4000])
    requested, early = fed(session).record(4000), early.record()
    np.testing.assert_array_equal(requested.angle_rad, early.angle_rad)
    np.testing.assert_array_equal(requested.torque_nm, early.torque_nm)
    assert (of_four_seconds.tick, of_four_seconds.duration_s) == (4000, 4.0)


@pytest.mark.parametrize(
    ("tick", "problem"),
    [
        (0, "Nothing is excited yet"),
        further(500, "Nothing is excited yet"),
        further(1000, "are too short for the band"),
        (1600, "No mode has been excited enough yet"),
    ],
)
@pytest.mark.parametrize("whole", [False, further(True)])
def test_record_too_short_to_fit_has_a_reason(session, tick, problem, whole):
    estimate = fed(session).estimate(tick, whole=whole)
    assert problem in estimate.problem
    assert str(session.path) not in estimate.problem
    assert estimate.doubt == estimate.problem
    assert estimate.headline is None
    json.dumps(estimate.as_json(), allow_nan=False)


def test_failed_fit_affects_its_own_estimate_only(session, monkeypatch):
    fit = fed(session)

    def fails(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    with monkeypatch.context() as patched:
        patched.setattr("analysis.identify.fit_freest_alone", fails)
        estimate = fit.estimate()
    assert estimate.problem.startswith("The record so far cannot be fitted")
    assert "Singular matrix" in estimate.problem
    assert "are too short for the band" in fit.estimate(1000).problem


def test_record_that_contradicts_its_file_is_estimated(session, monkeypatch):
    """Its only candidate has other orders, and drag may be reported with its modes."""

    def select_of_wrong_unit(measurement, **options):
        selection = select(measurement, **options)
        assert [finding.kind for finding in selection.verdict.findings] == ["unit"]
        drag = replace(selection.verdict.findings[0], kind="air drag")
        verdict = replace(selection.verdict, findings=(*selection.verdict.findings, drag))
        return replace(selection, verdict=verdict)

    monkeypatch.setattr("analysis.identify.select", select_of_wrong_unit)
    signals = scan()
    estimator = fed_with(replace(signals, torque_nm=9 * signals.torque_nm), session)
    estimate = estimator.estimate(whole=True)
    assert not estimate.problem
    assert {mode.damping_ratio.flag for mode in estimate.headline.modes} == {
        CONTRADICTED_FILE_REASON
    }


def with_mass_at_tip(signals, tip_kg, damping=PAPER_DAMPING):
    n = signals.angle_rad.size
    decay = np.exp(-6.0 * np.arange(n) / n)
    s = 6.0 * 1000 / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1e-3)
    more = Plant(PAPER_BEAM, damping, tip_mass_kg=tip_kg).transfer(s)
    more -= Plant(PAPER_BEAM, damping).transfer(s)
    spectrum = np.fft.rfft(signals.angle_rad * decay, 4 * n) * np.where(s.imag < 600.0, more, 0.0)
    torque_nm = signals.torque_nm + np.fft.irfft(spectrum, 4 * n)[:n] / decay
    return replace(signals, torque_nm=torque_nm)


@pytest.mark.parametrize("whole", [False, further(True)])
def test_estimate_has_modes_of_nonuniform_beam(session, whole):
    """Those of the modal model, without a flag; and the plant to excite next has them."""
    beam = Plant(PAPER_BEAM, PAPER_DAMPING, tip_mass_kg=1.8e-4)
    poles = beam.poles(clamped_free_eigenvalues(3))[:, 0]
    fit = fed_with(with_mass_at_tip(scan(), 1.8e-4), session)
    estimate = fit.estimate(whole=whole)
    assert estimate.doubt is None
    headline = estimate.headline
    assert headline.uniform_beam.status == "refused"
    assert headline.parameters["density_over_stiffness"].flag
    for mode, pole in zip(headline.modes, poles, strict=True):
        assert (mode.source, mode.frequency_hz.flag, mode.damping_ratio.flag) == (
            "modal", None, None,
        )  # fmt: skip
        frequency_hz = pole.imag / (2 * np.pi)
        assert abs(mode.frequency_hz.value - frequency_hz) < 4 * mode.frequency_hz.std
        ratio = -pole.real / abs(pole)
        assert abs(mode.damping_ratio.value - ratio) < 4 * mode.damping_ratio.std
    plant = estimate.plant
    assert len(plant.stiffness_offsets) == 2
    found = Plant(plant.beam, plant.damping, stiffness_offsets=plant.stiffness_offsets)
    near = found.poles(clamped_free_eigenvalues(3))[:, 0]
    np.testing.assert_allclose(near.imag, poles.imag, rtol=1e-3)


def quantities(estimate):
    headline = estimate.headline
    found = dict(headline.parameters)
    for mode in headline.modes:
        found |= {f"f{mode.number}": mode.frequency_hz, f"xi{mode.number}": mode.damping_ratio}
    return found


def test_analysis_starts_from_the_last_on_request(session, monkeypatch):
    headline = SimpleNamespace(
        visible_modes=(),
        uniform_beam=None,
        fit=SimpleNamespace(plant=Plant(PAPER_BEAM, PAPER_DAMPING)),
    )
    verdict = SimpleNamespace(findings=(), alpha=None, lambda_=None)
    selected = SimpleNamespace(headline=headline, verdict=verdict, analysis=None)
    started_from = []

    def select(*_, earlier=None, **__):
        started_from.append(earlier)
        return selected

    monkeypatch.setattr("analysis.identify.select", select)
    fit = fed(session)
    for from_last in (True, False, True):
        fit.estimate(4000, whole=True, from_last=from_last)
    assert started_from == [None, None, selected]


@pytest.mark.further  # as the candidates in tests/identify/test_select.py
def test_analysis_from_the_last_has_the_same_result(session, monkeypatch):
    """Without a search, and to the same minimum."""
    fit = fed_with(scan(noise_nm=5e-3), session)
    alone = fit.estimate(whole=True)
    assert alone.doubt is None
    early = fit.estimate(6_000, whole=True)
    assert early.headline is not None

    def search(*_, **__):
        raise AssertionError("nothing was to be searched for")

    with monkeypatch.context() as patched:
        patched.setattr("analysis.identify._candidates.fit_record", search)
        again = fit.estimate(whole=True, from_last=True)
    assert again.headline.name == alone.headline.name
    expected = quantities(alone)
    assert quantities(again).keys() == expected.keys()
    for name, found in quantities(again).items():
        assert abs(found.value - expected[name].value) < 0.1 * expected[name].std, name
        assert found.std == pytest.approx(expected[name].std, rel=0.05), name
        assert (found.flag is None) == (expected[name].flag is None), name


@pytest.mark.fit
@pytest.mark.further  # as the candidates in tests/identify/test_select.py
def test_unexplained_changes_are_searched_for(session):
    """Here in vain, for it hums within the width of mode 2: as if nothing had been known."""
    signals = scan(ring_down_s=2.0)
    time_s = np.arange(signals.torque_nm.size) / 1000
    hum_nm = 2e-2 * np.sin(2 * np.pi * 16.4 * time_s)
    humming = replace(signals, torque_nm=signals.torque_nm + hum_nm)
    before = select(Measurement.from_record(fed_with(signals, session).record(6_000)))
    assert before.verdict.adequate
    record = Measurement.from_record(fed_with(humming, session).record())
    again, alone = (select(record, earlier=each) for each in (before, None))
    assert again.headline.parameters == alone.headline.parameters
    assert again.headline.modes == alone.headline.modes
    assert again.verdict.findings == alone.verdict.findings
    assert not again.verdict.adequate


@pytest.fixture(scope="module")
def of_nine_seconds(session):
    return fed(session).estimate(9000)


def test_running_session_is_not_reported_as_stopped(of_nine_seconds):
    estimate = of_nine_seconds
    assert estimate.warnings == ()
    assert [mode.shown for mode in estimate.headline.modes][:2] == [True, True]
    assert estimate.doubt is None
    assert estimate.as_json()["validity"]["uniform_beam"]["status"] == "passed"


def test_one_mode_does_not_determine_order(of_four_seconds):
    headline = of_four_seconds.headline
    assert headline.visible_modes == (1,)
    assert all(
        headline.parameters[n].flag for n in {"alpha", "lambda"} & headline.parameters.keys()
    )
    assert headline.modes[0].damping_ratio.flag is None


def test_hum_is_reported_without_flags(session):
    signals = scan()
    time_s = np.arange(signals.torque_nm.size) / 1000
    hum = signals.torque_nm + 5e-3 * np.sin(2 * np.pi * 33 * time_s)
    estimate = fed_with(replace(signals, torque_nm=hum), session).estimate()
    assert [finding.kind for finding in estimate.findings] == ["hum"]
    assert estimate.doubt is None


def test_impact_that_hides_a_mode_is_reported_without_bias(session):
    """The beam rings for so long that mode 1 loses its damping without the impact in the model."""
    signals = scan()
    time_s = np.arange(signals.torque_nm.size) / 1000
    since_s = np.maximum(time_s - 3.0, 0.0)
    ring = 0.2 * np.exp(-0.15 * since_s) * np.sin(2 * np.pi * 2.57 * since_s)
    struck = fed_with(replace(signals, torque_nm=signals.torque_nm + ring), session).estimate()
    [finding] = struck.findings
    assert finding.kind == "knock"
    assert finding.value == pytest.approx(3.0, abs=0.02)
    assert struck.doubt is None
    for mode, true in zip(
        struck.headline.modes[:2], modes(PAPER_BEAM, PAPER_DAMPING, 2), strict=True
    ):
        for quantity, value in (
            (mode.frequency_hz, true.frequency_hz),
            (mode.damping_ratio, true.damping_ratio),
        ):
            assert abs(quantity.value - value) < 4 * quantity.std


@pytest.mark.parametrize(("density", "stiffness"), [(1.2, 0.8), further(0.8, 1.2)])
@pytest.mark.further  # as in tests/identify/test_fit.py
def test_a_beam_20_percent_off_its_data_is_found(session, density, stiffness):
    beam = Beam(0.98, density * 4.7e-3, stiffness * 0.090275)
    headline = fed_with(scan(beam=beam), session).estimate().headline
    first, second, _ = headline.modes
    for mode, root in ((first, 1.875104), (second, 4.694091)):
        undamped_hz = (root / 0.98) ** 2 / np.sqrt(beam.density_over_stiffness) / (2 * np.pi)
        assert mode.shown
        assert mode.frequency_hz.value == pytest.approx(undamped_hz, rel=0.01)
        assert 0.003 < mode.damping_ratio.value < 0.011


def test_invisible_damping_counts_as_uncertainty(session):
    # 0.1 % of external damping at mode 1: in 5 s it decays by 8 %, and does not show.
    truth = Damping(zeta=2e-4, alpha=1.0, gamma=5e-4, lambda_=1.0)
    signals = scan(damping=truth, noise_nm=2e-2, seed=6)
    estimate = fed_with(signals, session).estimate()
    headline = estimate.headline
    assert headline.name == "IV"
    assert "gamma" in estimate.predictive_fit.determined
    mode, alone = headline.modes[0].damping_ratio, headline.fit.modes[0]
    assert mode.std > 3 * alone.damping_ratio_std
    true = 0.5 * (2e-4 * 16.1 + 5e-4 / (0.05206 * 16.1))
    assert mode.interval_95[0] < true < mode.interval_95[1]


# In the fit process


def next_estimate(thread):
    return eventually(thread.next_estimate)


def test_thread_responds_to_requests(session, of_four_seconds):
    thread = EstimatorThread()
    thread.feed(session.samples[:4500])
    thread.begin(session.metadata, session.segments, None)
    for number, (tick, whole) in enumerate([(300, False), (4000, False), (300, True)]):
        thread.request(EstimateRequest(number, tick, whole))
    answers = [next_estimate(thread) for _ in range(3)]
    assert [(each["id"], each["tick"], each["whole"]) for each in answers] == [
        (0, 300, False), (1, 4000, False), (2, 300, True),
    ]  # fmt: skip
    expected = json.loads(json.dumps(of_four_seconds.as_json()))
    took_s = answers[1].pop("took_s")
    assert 0 < took_s < 30
    assert answers[1] == {"id": 1} | {k: v for k, v in expected.items() if k != "took_s"}
    names = answers[1]["covariance"]["names"]
    assert np.array(answers[1]["covariance"]["matrix"]).shape == (len(names), len(names))
    assert {mode["source"] for mode in answers[1]["modes"] if mode["shown"]} == {"modal"}
    assert set(answers[1]["plant"]["damping"]) == {"zeta", "alpha", "gamma", "lambda"}
    noise = answers[1]["noise"]
    white = np.median(noise["nm2_per_hz"]) * 500
    assert white == pytest.approx(session_noise_nm2(session), rel=0.5)


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("from_last", [False, True])
def test_estimate_follows_requested_options(monkeypatch, whole, from_last):
    requests = []

    def estimate(_, tick, **how):
        requests.append((tick, how))
        if len(requests) > 1:
            raise LookupError("of the second")
        return OnlineEstimate(tick, 1.0, whole, 0.0, problem="None here.")

    monkeypatch.setattr(OnlineEstimator, "estimate", estimate)
    thread = EstimatorThread()
    thread.begin({}, {}, None)
    thread.request(EstimateRequest(7, 9000, whole, from_last))
    assert next_estimate(thread)["id"] == 7
    assert requests == [(9000, {"whole": whole, "from_last": from_last})]
    assert thread.next_estimate() is None
    thread.request(EstimateRequest(8, 9000, whole, from_last))
    with pytest.raises(EstimationError, match=r"fit has failed .*of the second"):
        next_estimate(thread)


def session_noise_nm2(session) -> float:
    """Variance of the torque at rest."""
    return float(np.var(session.samples["coupling_torque_nm"][:400]))


def test_thread_estimates_without_request(monkeypatch):
    fed_ticks = []

    def estimate(_, tick, **how):
        return OnlineEstimate(sum(fed_ticks), 1.0, how["whole"], 0.0, problem="None here.")

    monkeypatch.setattr(OnlineEstimator, "feed", lambda _, ticks: fed_ticks.append(ticks))
    monkeypatch.setattr(OnlineEstimator, "estimate", estimate)
    thread = EstimatorThread()
    thread.begin({}, {}, 0.05)
    assert [next_estimate(thread)["id"] for _ in range(2)] == [0, 1]
    thread.feed(5000)
    assert eventually(lambda: next_estimate(thread)["tick"] == 5000)
