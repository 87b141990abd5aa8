"""The verdict on a campaign from invented estimates: statements that it may and must not make."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.campaigns import Heterogeneity, Homogeneity, sentences
from analysis.campaigns._orders import pooled_order
from analysis.campaigns.pooling import freest_estimate, pool_estimates
from analysis.identify import Finding
from analysis.statistics import student_t_quantile

ALIKE = Homogeneity((), ())


def session_verdict(
    structure="VI", alpha="fractional", adequate=True, modes=(1, 2, 3), findings=()
):
    return SimpleNamespace(
        structure=structure, adequate=adequate, visible_modes=modes,
        findings=findings, experiments=("Sweep longer.",),
        alpha=SimpleNamespace(status=alpha), lambda_=SimpleNamespace(status="fractional"),
    )  # fmt: skip


@pytest.fixture
def estimates_of(make_estimate):
    """Type by type: the same estimate of each of four sessions, alpha and its std as wanted."""

    def make(structure, deviance, alpha=0.8, std=0.01):
        values = {"zeta": 1e-4, "alpha": alpha, "gamma": 0.1, "lambda": 0.6}
        fixed = {"I": {"alpha": 1.0}, "IV": {}, "VI": {}, "VII": {"alpha": 1.0}}[structure]
        available = ("zeta", "alpha") if structure in ("I", "IV") else tuple(values)
        names = [name for name in available if name not in fixed]
        covariance = np.diag([(std if n == "alpha" else 0.01) ** 2 for n in names])
        return [
            make_estimate(
                structure, {n: values[n] for n in names}, covariance, names, cost=deviance,
                bic=deviance,
            )
        ] * 4  # fmt: skip

    return make


def ranked(*groups):
    return sorted(map(pool_estimates, groups), key=lambda each: each.bic)


def test_modes_have_the_student_interval_of_the_figure(estimates_of):
    """Of four sessions it is 3.18 standard deviations to either side, and not 1.96."""
    found = pool_estimates(estimates_of("VI", 100.0))
    std = found.modes[0].damping_ratio_std
    (sentence,) = sentences.describe_modes(found.modes, found.sessions, is_mixture=False)
    half = float(sentence.split("± ")[1].split(" %")[0]) / 100
    assert half == pytest.approx(student_t_quantile(0.95, 3) * std, rel=0.05)


def test_common_fractional_order_is_reported(estimates_of):
    order = pooled_order(
        "alpha",
        ranked(estimates_of("VI", 100.0), estimates_of("VII", 150.0)),
        [session_verdict()] * 4,
        ALIKE,
    )
    assert order.status == "fractional"
    assert order.value == pytest.approx(0.8)
    assert order.interval[0] < 0.8 < order.interval[1] < 1
    assert order.alone == {"fractional": 4}


@pytest.mark.parametrize(
    ("rival", "verdict", "status", "reason"),
    [
        (
            101.5,
            session_verdict(),
            "open",
            None,
        ),  # an integer explains as much: 6 in BIC, less one ln 400
        (150.0, session_verdict(adequate=False), "open", "unexplained"),
        (150.0, session_verdict(modes=(1,)), "not identifiable", "a single mode determines"),
    ],
)
def test_uncertain_order_is_not_called_fractional(estimates_of, rival, verdict, status, reason):
    order = pooled_order(
        "alpha", ranked(estimates_of("VI", 100.0), estimates_of("VII", rival)), [verdict] * 4, ALIKE
    )
    assert order.status == status
    assert reason in order.reason if reason else order.reason is None
    assert "1 is excluded" not in sentences.describe_order(order)


def mixed_in(quantity):
    files = (("a.mcap", 0.8, 0.01), ("b.mcap", 1.0, 0.01))
    return Homogeneity((), (Heterogeneity(quantity, files, 0.9, 0.14, 200.0, 0.0, True, ()),))


@pytest.mark.parametrize("alpha", [0.8, 1.0])
def test_order_that_differs_between_sessions_is_withheld(estimates_of, alpha):
    groups = ranked(estimates_of("VI", 100.0, alpha), estimates_of("VII", 150.0))
    order = pooled_order("alpha", groups, [session_verdict()] * 4, mixed_in("alpha"))
    assert (order.status, order.mixture) == ("open", True)
    assert "not of one specimen, and it differs" in sentences.describe_order(order)


def test_common_order_of_a_mixture_is_reported(estimates_of):
    """Beams of several lengths of one material; but not if one of them does not determine it."""
    groups = ranked(estimates_of("VI", 100.0), estimates_of("VII", 150.0))
    mixed = mixed_in("frequency_hz_1")
    assert pooled_order("alpha", groups, [session_verdict()] * 4, mixed).status == "fractional"
    assert pooled_order("alpha", groups, [session_verdict()] * 5, mixed).reason is not None


def test_one_session_in_ten_may_differ(estimates_of):
    groups = ranked(estimates_of("VI", 100.0), estimates_of("VII", 150.0))
    verdicts = [*[session_verdict()] * 9, session_verdict(adequate=False)]
    assert pooled_order("alpha", groups, verdicts, ALIKE).status == "fractional"


def test_undetermined_order_is_not_identifiable(estimates_of):
    groups = ranked(estimates_of("VI", 100.0, std=0.5), estimates_of("VII", 101.0))
    order = pooled_order("alpha", groups, [session_verdict()] * 4, ALIKE)
    assert (order.status, order.value, order.interval) == ("not identifiable", None, None)
    assert "not identifiable" in sentences.describe_order(order)


@pytest.mark.parametrize(
    ("alpha", "rival", "status"),
    [(1.005, 99.0, "compatible"), (0.97, 101.0, "open"), (0.97, 97.5, "open")],
)
def test_order_that_excludes_1_is_not_reported_as_1(estimates_of, alpha, rival, status):
    """1 inside the interval; outside, though VII has the lower BIC; outside, and VI has it."""
    groups = ranked(estimates_of("VI", rival, alpha), estimates_of("VII", 100.0))
    order = pooled_order("alpha", groups, [session_verdict("VII", "integer")] * 4, ALIKE)
    assert order.status == status
    assert order.value == pytest.approx(alpha)
    assert order.interval[0] < alpha < order.interval[1]
    assert ("consistent with 1" in sentences.describe_order(order)) == (status == "compatible")


@pytest.mark.fit
def test_numbers_are_those_of_the_freest_structure(estimates_of, make_session, campaign_of):
    six, seven = estimates_of("VI", 100.0, 0.996), estimates_of("VII", 95.0)
    sessions = [
        make_session(f"{n}.mcap", estimates=pair, verdict=session_verdict("VII", "integer"))
        for n, pair in enumerate(zip(six, seven, strict=True))
    ]
    found = campaign_of(sessions).verdict
    assert (found.headline, found.structure) == ("VI", "VII")
    first, second, *_ = found.sentences
    assert "(alpha = 0.9960 ± 0.0159)" in first
    assert "and external damping of fractional order (lambda = 0.6000 ± 0.0159)" in first
    assert second.startswith("The numbers are those of type VI: internal damping (")
    assert "Type VII has the lowest BIC" in second
    assert found.alpha.value == pytest.approx(0.996)
    # Not if it is of two sessions where the other is of all.
    few = replace(pool_estimates(six), sessions=2)
    assert freest_estimate([pool_estimates(seven), few]).structure == "VII"


def test_unneeded_damping_is_absent(estimates_of):
    order = pooled_order(
        "lambda", ranked(estimates_of("IV", 100.0)), [session_verdict("IV")] * 4, ALIKE
    )
    assert (order.status, order.value) == ("absent", None)
    assert "No external damping was found" in sentences.describe_order(order)


def delay(value):
    return Finding(
        kind="delay", sentence=f"The torque comes {1e3 * value:.3f} ms later than the file says.",
        value=value, interval=None, unit="s", remedy="Declare it.",
    )  # fmt: skip


def stiffening(mode):
    return Finding(
        kind="nonlinear stiffness", sentence=f"The stiffness of mode {mode} rises by 1.0 %.",
        value=0.01, interval=None, unit="1", remedy="",
    )  # fmt: skip


@pytest.mark.fit
def test_findings_are_counted_over_sessions(make_session, estimates_of, campaign_of):
    six = estimates_of("VI", 100.0)
    sessions = [
        make_session(
            f"{number}.mcap",
            estimates=six[:1],
            verdict=session_verdict(findings=(delay(value), *more)),
        )
        for number, (value, more) in enumerate(
            [(0.29e-3, ()), (0.31e-3, (stiffening(1),)), (0.30e-3, (stiffening(2),))]
        )
    ]
    found = campaign_of([*sessions, make_session("none.mcap")]).verdict
    late, first, second = found.findings
    assert late.files == ("0.mcap", "1.mcap", "2.mcap")
    assert late.span == pytest.approx((0.29e-3, 0.31e-3))
    assert late.sentence.startswith("In 3 of 3 sessions: The torque comes 0.300 ms later")
    assert "0.290 to 0.310 ms" in late.sentence
    # Of two modes: two things, though the sentences differ by a figure only.
    assert {first.files, second.files} == {("1.mcap",), ("2.mcap",)}
    assert first.sentence.startswith("In 1 of 3 sessions (1.mcap):")


@pytest.mark.fit
def test_dissenting_session_is_reported(make_session, estimates_of, campaign_of):
    six, seven = estimates_of("VI", 100.0), estimates_of("VII", 150.0)
    sessions = [
        make_session(f"{n}.mcap", estimates=pair, verdict=session_verdict())
        for n, pair in enumerate(zip(six, seven, strict=True))
    ]
    other = (replace(six[0], bic=180.0), seven[0])
    sessions[2] = make_session("2.mcap", estimates=other, verdict=session_verdict("VII"))
    found = campaign_of(sessions).verdict
    assert found.structure == "VI"
    assert found.alone == {"VI": 3, "VII": 1}
    ((name, structure, margin),) = [(d.file, d.structure, d.margin) for d in found.dissent]
    assert (name, structure, margin) == ("2.mcap", "VII", 30.0)
    (sentence,) = (s for s in found.sentences if "is excluded by" in s)
    assert "2.mcap (type VII)" in sentence
    assert found.experiments == ("Sweep longer.",)
    assert campaign_of([make_session(f"{n}.mcap") for n in range(2)]).verdict is None


def scattered(p_value, between_session_std=0.0):
    return Homogeneity(
        (), (Heterogeneity("zeta", (), 1e-4, between_session_std, 1.0, p_value, False, ()),)
    )


def test_sentences_on_scatter_and_misfit(estimates_of):
    (best,) = ranked(estimates_of("VI", 100.0))
    (agreeing,) = sentences.describe_scatter(scattered(0.5))
    assert "No significant between-session variance" in agreeing
    assert "τ" not in agreeing
    (by_chance,) = sentences.describe_scatter(scattered(0.2, between_session_std=0.1))
    assert "lowest p of 1: 0.2; the τ above zero are within chance" in by_chance
    (shaken,) = sentences.describe_scatter(scattered(1e-4))
    assert "Between-session variance in ζ" in shaken
    assert sentences.describe_scatter(Homogeneity((), ())) == []
    assert "no structure fitted" in sentences.describe_residual(replace(best, misfit=9.0), 4, 4)
    assert "noise in 3 of 4 sessions" in sentences.describe_residual(best, 3, 4)
