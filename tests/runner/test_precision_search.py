"""Decisions of a search for a precision, estimate by estimate."""

import re

import numpy as np
import pytest
from known_beam import CERTAIN, ON_THE_WAY, answer

from rigd.engine import shared_memory_fd
from rigd.engine.messages import FitReport, PlannedSegment, SearchEnded
from rigd.engine.reference import ReferenceWriter, write_reference
from rigd.engine.shared_state import SharedState, StateField
from rigd.excitation import ExcitationError, PrecisionForecast, Segment, until
from rigd.excitation.targets import Precision, parse_target
from rigd.profile import load_profile
from rigd.runner._precision_search import (
    ExcitationPlanner,
    estimates_text,
    target_estimates,
    targets_json,
)
from rigd.runner.planning import RigPreview

RATE_HZ = 1000


@pytest.fixture(scope="module")
def profile():
    return load_profile("sim")


class SearchBench:
    """A search with its outputs, without processes."""

    def __init__(self, profile, targets="damping 1%", at_most_s=60.0):
        self.profile = profile
        excitation = until(
            rate_hz=RATE_HZ, targets=targets, at_most_s=at_most_s, rig=RigPreview(profile)
        )
        planned = excitation.search.planned_ticks
        spec = write_reference(shared_memory_fd(), excitation.reference_rad, planned)
        self.shared_state = SharedState.create(shared_memory_fd())
        self.writer = ReferenceWriter(spec, self.shared_state)
        self.search = ExcitationPlanner(excitation.search, profile, self.writer)

    def plan(self, relative_std, held=0, before=None, **more):
        document = answer(self.profile, self.search.due_tick + held, relative_std, **more)
        return list(
            self.search.plan_next_segment(document, held, held if before is None else before)
        )

    def problem(self, text="Nothing is excited yet."):
        return list(
            self.search.plan_next_segment({"tick": self.search.due_tick, "problem": text}, 0, 0)
        )


def test_a_search_may_state_the_uniformity_of_the_beam():
    def uniformity_percent(**given):
        excitation = until(rate_hz=RATE_HZ, targets="alpha 0.01", **given)
        return excitation.parameters.get("uniformity_percent")

    assert (uniformity_percent(), uniformity_percent(uniformity_percent=0.0)) == (None, 0.0)
    for wrong in (-1.0, 10.1, np.nan):
        with pytest.raises(ExcitationError, match=r"uniformity_percent = \S+ % must lie between"):
            uniformity_percent(uniformity_percent=wrong)


def use_rest_segments(monkeypatch, std, driven=()):
    """Replace the slow design by segments of a second of rest; return the options of each call.

    The first segments are given: those for which `driven` is True move the motor.
    """
    planned = []

    def design(estimate, angle_rad, targets, rig, time_left_s, **options):
        is_driven = len(planned) < len(driven) and driven[len(planned)]
        rest = (1e-3 if is_driven else 0.0) * np.sin(np.linspace(0, np.pi, RATE_HZ)) ** 4
        planned.append({"targets": targets, **options})
        k = len(estimate.free_parameters)
        now = (Precision(targets[0], 1.0, std, 0.1),)
        return Segment(
            "rest",
            rest,
            rest,
            estimate.free_parameters,
            np.eye(k),
            now,
            now,
            PrecisionForecast(1e4, ""),
            0,
        )

    monkeypatch.setattr("rigd.runner._precision_search.next_segment", design)
    return planned


@pytest.fixture
def insufficient_segments(monkeypatch):
    """Make rest segments that are never expected to suffice."""
    use_rest_segments(monkeypatch, std=1.0)


@pytest.fixture
def sufficient_segments(monkeypatch):
    """Make rest segments that are always expected to suffice."""
    use_rest_segments(monkeypatch, std=0.01)


@pytest.fixture
def bench(profile):
    return SearchBench(profile)


def test_next_segment_follows_an_uncertain_estimate(bench):
    planned = bench.writer.ticks
    assert bench.search.due_tick == planned - 500  # the end of the scan, not that of the pause
    fit, segment = bench.plan(ON_THE_WAY)
    assert isinstance(fit, FitReport)
    assert isinstance(segment, PlannedSegment)
    assert bench.search.due_tick == planned
    assert bench.writer.ticks - planned == round(RATE_HZ * segment.document["duration_s"])
    assert bench.shared_state[StateField.PLANNED_TICKS] == bench.writer.ticks
    assert not bench.search.may_be_last
    heads, row = fit.document["text"]
    assert heads.split()[:5] == ["time", "damping", "of", "mode", "1"]
    assert row.startswith("  6.0 s 0.9")


def test_two_amplitudes_distinguish_air_drag_from_damping(bench, monkeypatch):
    planned = use_rest_segments(monkeypatch, std=1.0, driven=10 * [True])
    for with_air_drag in (False, False, *8 * (True,)):
        bench.plan(ON_THE_WAY, with_air_drag=with_air_drag)
    fractions = [options["limit_fraction"] for options in planned]
    reduced = fractions[3]
    assert 0.3 < reduced < 0.5
    assert fractions == [1.0, 1.0, *2 * (reduced, reduced, 1.0, reduced)]


def test_waiting_for_a_decay_is_no_segment_of_reduced_amplitude(bench, monkeypatch):
    """Else the vibration would never fall to the reduced amplitude."""
    driven = [True, False, False, False, False, True, False, True, True, True]
    planned = use_rest_segments(monkeypatch, std=1.0, driven=driven)
    for _ in driven:
        bench.plan(ON_THE_WAY, with_air_drag=True)
    fractions = [options["limit_fraction"] for options in planned]
    assert [fraction == 1.0 for fraction in fractions] == [True, *8 * [False], True]


def test_ratio_of_a_value_below_its_uncertainty(profile):
    [estimate] = target_estimates(answer(profile, 0, 50.0), [parse_target("damping", "1:10%")])
    assert estimate.std_ratio == pytest.approx(10.0)


def test_certain_estimate_is_confirmed_with_all_structures(bench, monkeypatch):
    """A target counts as reached only after a pause and a fit of every structure."""
    use_rest_segments(monkeypatch, std=1.0)
    bench.plan(ON_THE_WAY)
    use_rest_segments(monkeypatch, std=0.01)
    planned = bench.writer.ticks
    while not bench.search.may_be_last:
        *_, last = bench.plan(CERTAIN)
        assert bench.writer.ticks < 60 * RATE_HZ
    assert isinstance(last, FitReport | PlannedSegment)
    assert bench.search.due_tick == bench.writer.ticks >= planned + 500
    _, end = bench.plan(CERTAIN)
    assert isinstance(end, SearchEnded)
    assert end.reached
    assert end.reason.startswith("Reached: damping of mode 1 0.00")
    assert end.segments["scan"] == (1000, 6000)
    assert end.segments["piece_1"][0] == 6500
    assert bench.search.due_tick is None


def test_all_structures_are_fitted_before_the_first_judgement(profile, sufficient_segments):
    """The early fit gives a start; later fits start from the one before."""
    bench = SearchBench(profile)
    assert not bench.search.needs_early_fit
    bench.plan(CERTAIN)
    assert bench.search.may_be_last
    assert bench.search.needs_early_fit
    bench.plan(CERTAIN, flag="part of the record is unexplained")
    while not bench.search.may_be_last:
        bench.plan(CERTAIN)
    assert not bench.search.needs_early_fit
    bench.plan(CERTAIN)
    assert bench.search.due_tick is None
    assert not bench.search.needs_early_fit


@pytest.mark.further  # as a doubtful record
def test_flagged_value_is_not_reached(bench):
    while not bench.search.may_be_last:
        bench.plan(CERTAIN)
    fit, *more = bench.plan(CERTAIN, flag="part of the record is unexplained")
    assert not any(isinstance(message, SearchEnded) for message in more)
    assert {target["std"] for target in fit.document["search"]["targets"]} == {None}


@pytest.mark.further  # as one never certain
def test_search_gives_up_on_a_doubtful_record(bench):
    ends = []
    while not ends:
        messages = bench.plan(ON_THE_WAY, flag="part of the record is unexplained")
        ends = [message for message in messages if isinstance(message, SearchEnded)]
        assert bench.writer.ticks < 50 * RATE_HZ
    assert not ends[0].reached
    assert ends[0].reason == (
        "The record is doubtful: part of the record is unexplained. Something struck the beam. "
        "Record a chirp instead: rigd run chirp."
    )
    assert messages[0].document["text"][-1].count("doubtful") == 3


def test_held_ticks_shift_the_next_segments(bench, insufficient_segments):
    bench.plan(ON_THE_WAY)
    bench.plan(ON_THE_WAY, held=300)
    end = bench.search.record_end_message(9000, 300, bench.writer.ticks)
    first, last = end.segments["piece_1"]
    assert first == 6800
    assert last > first
    assert not end.reached


def test_ticks_held_after_a_segment_do_not_shift_it(bench, insufficient_segments):
    """As if a decision takes longer than the planned segment: the scan began at once."""
    bench.plan(ON_THE_WAY, held=1200, before=0)
    bench.plan(ON_THE_WAY, held=2000, before=1700)
    segments = bench.search.record_end_message(14000, 2050, bench.writer.ticks).segments
    assert segments["scan"] == (1000, 6000)
    assert segments["sweep"][0] == 1000
    first, end = segments["piece_1"]
    assert first == 6500 + 1700
    assert segments["piece_2"][0] == end - 1700 + 2050


def test_planned_segment_without_a_start_is_omitted(bench, insufficient_segments):
    assert bench.search.has_last_segment_begun(0)
    bench.plan(ON_THE_WAY)
    due_tick = bench.search.due_tick
    assert bench.search.has_last_segment_begun(bench.writer.ticks)
    assert not bench.search.has_last_segment_begun(0)
    segments = bench.search.record_end_message(due_tick + 400, 0, 0).segments
    assert segments.keys() == {"scan", "sweep"}


def test_scan_without_information_is_repeated_then_given_up(bench):
    planned = bench.writer.ticks
    for number in (1, 2):
        (message,) = bench.problem()
        assert message.name == "the scan once more"
        assert bench.writer.ticks == planned + number * 5000
    (end,) = bench.problem()
    assert (end.reached, end.reason) == (False, "Given up: Nothing is excited yet.")


def test_search_gives_up_without_a_possible_fit(bench, insufficient_segments):
    bench.plan(ON_THE_WAY)
    (end,) = bench.problem("The angle is missing for 16 ms.")
    assert (end.reached, end.reason) == (False, "Given up: The angle is missing for 16 ms.")


def test_search_ends_within_the_allowed_time(profile, insufficient_segments):
    bench = SearchBench(profile, "damping 0.01%", at_most_s=12.0)
    ends = []
    while not ends:
        ends = [m for m in bench.plan(ON_THE_WAY) if isinstance(m, SearchEnded)]
        assert bench.writer.ticks <= 12 * RATE_HZ
    assert not ends[0].reached
    assert "--at-most" in ends[0].reason


@pytest.mark.parametrize("over_ticks", [-1, 0, 700])
def test_slow_decision_may_leave_no_time(profile, insufficient_segments, over_ticks):
    """The angle was held before the last segment, which ends with the record or after it."""
    bench = SearchBench(profile, "damping 0.01%", at_most_s=12.0)
    bench.plan(ON_THE_WAY)
    held = 12 * RATE_HZ - bench.writer.ticks + over_ticks
    messages = bench.plan(ON_THE_WAY, held=held)
    if over_ticks < 0:
        assert bench.search.may_be_last
        assert bench.writer.ticks + held == 12 * RATE_HZ
    else:
        assert isinstance(messages[-1], SearchEnded)
        assert messages[-1].reason == "Not reached within 12 s (--at-most)."


@pytest.mark.parametrize(
    ("ratio_of_std", "reason"),
    [(0.98, "it would take about"), (0.999, "it would take more than a day")],
)
def test_slow_progress_is_out_of_reach(profile, insufficient_segments, ratio_of_std, reason):
    """The information grows so slowly that an hour would not suffice; the reason states it."""
    bench = SearchBench(profile, "damping 0.1%", at_most_s=60.0)
    relative_std, ends = ON_THE_WAY, []
    while not ends:
        messages = bench.plan(relative_std)
        ends = [m for m in messages if isinstance(m, SearchEnded)]
        relative_std *= ratio_of_std
    assert ends[0].reason.startswith(f"Out of reach: {reason}")
    assert (messages[0].document["search"]["left_s"] is None) == ("day" in reason)
    assert bench.writer.ticks < 40 * RATE_HZ


def test_absent_damping_is_out_of_reach(profile, monkeypatch):
    monkeypatch.setattr("rigd.runner._precision_search._MAX_UNREACHABLE_FORECASTS", 1)
    bench = SearchBench(profile, "zeta 15%")
    ends = []
    while not ends:
        document = answer(profile, bench.search.due_tick, ON_THE_WAY)
        document["plant"]["damping"] |= {"zeta": 0.0}
        document["covariance"]["names"].remove("zeta")
        document["parameters"] = {}
        found = bench.search.plan_next_segment(document, 0, 0)
        ends = [m for m in found if isinstance(m, SearchEnded)]
    assert ends[0].reason.startswith("Out of reach: internal damping is absent")


def test_absent_mode_has_no_estimate(profile):
    (found,) = target_estimates(answer(profile, 1, CERTAIN), [parse_target("damping", "7:1%")])
    assert found.std_ratio == np.inf
    assert estimates_text([found]) == "damping of mode 7: no such mode was found in the band"
    none = answer(profile, 1, CERTAIN) | {"modes": []}
    (found,) = target_estimates(none, [parse_target("frequency", "1%")])
    assert estimates_text([found]) == "frequency of any mode: no such mode was found in the band"


def test_flagged_target_is_never_reached(profile, sufficient_segments):
    """However precise; after some judgements the search ends with the reason."""
    bench = SearchBench(profile, "damping 1%")
    ends = []
    while not ends:
        document = answer(profile, bench.search.due_tick, CERTAIN)
        damping = document["modes"][1]["damping_ratio"]
        damping["flag"] = "part of the record is unexplained"
        messages = list(bench.search.plan_next_segment(document, 0, 0))
        ends = [m for m in messages if isinstance(m, SearchEnded)]
    assert not ends[0].reached
    assert "damping of mode 2: part of the record is unexplained" in ends[0].reason


def test_excitation_of_modes_of_a_nonuniform_beam(profile):
    """Each mode has its own stiffness, and the design drives it at its frequency."""
    bench = SearchBench(profile, "damping 2:0.1%", at_most_s=40.0)
    document = answer(profile, bench.search.due_tick, ON_THE_WAY)
    document["plant"]["stiffness_offsets"] = [0.04, 0.0]
    *_, segment = bench.search.plan_next_segment(document, 0, 0)
    bands_hz = [
        (float(low) + float(high)) / 2
        for low, high in re.findall(r"([\d.]+)–([\d.]+)", segment.name)
    ]
    assert pytest.approx(16.01 * np.sqrt(1.04), abs=0.06) in bands_hz


def test_design_uses_the_deviations_of_the_fits(profile, monkeypatch):
    """A fit with larger deviations than the design expects needs more information."""
    planned = use_rest_segments(monkeypatch, std=1.0)
    for relative_std in (0.01, 0.02):
        bench = SearchBench(profile, "damping 1:0.2%")
        *_, segment = bench.plan(relative_std)
        (target,), (one,) = planned[-1]["targets"], segment.document["expected"]
        # The requested deviation is reported on the scale of the fits: 0.1 of the design's.
        assert target.std * one["asked_std"] / 0.1 == pytest.approx(0.002)
    less, more = (each["targets"][0].std for each in planned)
    assert less > 1.1 * more


def make_search(targets, **given):
    rig = RigPreview(load_profile("sim"))
    return until(rate_hz=RATE_HZ, targets=targets, rig=rig, **given)


@pytest.mark.parametrize("targets", ["alpha 0.002", "lambda 0.01", "damping 1%; gamma 1%"])
def test_precision_below_the_floor_of_the_geometry_is_refused(targets):
    """Refused before motion, with the floor; an exactly uniform beam has none."""
    with pytest.raises(ExcitationError, match="is below the floor of") as refused:
        make_search(targets)
    for words in ("uniformity_percent", "--uniformity 0 on a simulated rig", "--damping", "120 s"):
        assert words in str(refused.value)
    assert "damping to 1 %" not in str(refused.value)
    assert make_search(targets, uniformity_percent=0.0).search.targets


def test_precision_above_the_floor_is_accepted(profile):
    for targets in ("alpha 0.03; lambda 0.1", "damping 0.01%; frequency 0.0001%"):
        assert make_search(targets).search.targets
    with pytest.raises(ExcitationError, match="by 1 %"):
        make_search("alpha 0.03", uniformity_percent=1.0)


def test_modes_above_the_band_are_no_targets(profile):
    document = answer(profile, 1, CERTAIN)
    document["modes"][2]["frequency_hz"]["value"] = 51.0
    document["modes"][2]["shown"] = False
    found = target_estimates(document, [parse_target("damping", "1%")])
    assert [each.mode for each in found] == [1, 2]


def test_absolute_and_relative_targets(profile):
    targets = [parse_target("frequency", "1:0.002Hz"), parse_target("damping", "2:1%")]
    found = frequency, damping = target_estimates(answer(profile, 1, 0.02), targets)
    names = [(each["name"], each["quantity"], each["mode"]) for each in targets_json(found)]
    assert names == [("frequency of mode 1", "frequency", 1), ("damping of mode 2", "damping", 2)]
    assert frequency.target_std == 0.002
    assert damping.std_ratio == pytest.approx(2.0)
