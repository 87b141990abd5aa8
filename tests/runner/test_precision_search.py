"""What a search for a precision decides, estimate by estimate."""

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


class Bench:
    """A search with what it writes to, and no process."""

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

    def told(self, share, held=0, before=None, **more):
        document = answer(self.profile, self.search.due_tick + held, share, **more)
        return list(self.search.plan_next(document, held, held if before is None else before))

    def problem(self, text="Nothing is excited yet."):
        return list(self.search.plan_next({"tick": self.search.due_tick, "problem": text}, 0, 0))


def test_a_search_may_state_the_uniformity_of_the_beam():
    def stated(**given):
        excitation = until(rate_hz=RATE_HZ, targets="alpha 0.01", **given)
        return excitation.parameters.get("uniformity_percent")

    assert (stated(), stated(uniformity_percent=0.0)) == (None, 0.0)
    for wrong in (-1.0, 10.1, np.nan):
        with pytest.raises(ExcitationError, match=r"uniformity_percent = \S+ % must lie between"):
            stated(uniformity_percent=wrong)


def designed_at_once(monkeypatch, std):
    """Pieces of a second of rest, in place of a design that takes its time.

    Return the list of options with which each is asked for.
    """
    rest, planned = np.zeros(RATE_HZ), []

    def design(estimate, angle_rad, targets, rig, time_left_s, **options):
        planned.append({"targets": targets, **options})
        k = len(estimate.names)
        now = (Precision(targets[0], 1.0, std, 0.1),)
        return Segment(
            "rest", rest, rest, estimate.names, np.eye(k), now, now, PrecisionForecast(1e4, ""), 0
        )

    monkeypatch.setattr("rigd.runner._precision_search.next_segment", design)
    return planned


@pytest.fixture
def quick_pieces(monkeypatch):
    """None of them is expected to suffice."""
    designed_at_once(monkeypatch, std=1.0)


@pytest.fixture
def quick_pauses(monkeypatch):
    """What is planned is always expected to suffice."""
    designed_at_once(monkeypatch, std=0.01)


@pytest.fixture
def bench(profile):
    return Bench(profile)


def test_a_piece_follows_where_more_is_to_be_known(bench):
    planned = bench.writer.ticks
    assert bench.search.due_tick == planned - 500  # the end of the scan, not that of the pause
    fit, piece = bench.told(ON_THE_WAY)
    assert isinstance(fit, FitReport)
    assert isinstance(piece, PlannedSegment)
    assert bench.search.due_tick == planned
    assert bench.writer.ticks - planned == round(RATE_HZ * piece.document["duration_s"])
    assert bench.shared_state[StateField.PLANNED] == bench.writer.ticks
    assert not bench.search.may_be_last
    heads, row = fit.document["text"]
    assert heads.split()[:5] == ["time", "damping", "of", "mode", "1"]
    assert row.startswith("  6.0 s 0.9")


def test_air_drag_is_told_from_damping_by_two_amplitudes(bench, monkeypatch):
    planned = designed_at_once(monkeypatch, std=1.0)
    for with_air_drag in (False, False, *8 * (True,)):
        bench.told(ON_THE_WAY, with_air_drag=with_air_drag)
    fractions = [options["limit_fraction"] for options in planned]
    reduced = fractions[3]
    assert 0.3 < reduced < 0.5
    assert fractions == [1.0, 1.0, *2 * (reduced, reduced, 1.0, reduced)]


def test_a_value_below_its_uncertainty_does_not_put_a_relative_precision_out_of_reach(profile):
    [estimate] = target_estimates(answer(profile, 0, 50.0), [parse_target("damping", "1:10%")])
    assert estimate.ratio == pytest.approx(10.0)


def test_what_is_certain_is_looked_at_once_more_with_all_structures(bench, monkeypatch):
    """Only after a pause, and a fit of every structure, does anything count as reached."""
    designed_at_once(monkeypatch, std=1.0)
    bench.told(ON_THE_WAY)
    designed_at_once(monkeypatch, std=0.01)
    planned = bench.writer.ticks
    while not bench.search.may_be_last:
        *_, last = bench.told(CERTAIN)
        assert bench.writer.ticks < 60 * RATE_HZ
    assert isinstance(last, FitReport | PlannedSegment)
    assert bench.search.due_tick == bench.writer.ticks >= planned + 500
    _, end = bench.told(CERTAIN)
    assert isinstance(end, SearchEnded)
    assert end.reached
    assert end.reason.startswith("Reached: damping of mode 1 0.00")
    assert end.segments["scan"] == (1000, 6000)
    assert end.segments["piece_1"][0] == 6500
    assert bench.search.due_tick is None


def test_before_the_first_judgement_all_structures_are_fitted_to_what_there_is(
    profile, quick_pauses
):
    """So that it has a start; later ones have that of the one before."""
    bench = Bench(profile)
    assert not bench.search.needs_early_fit
    bench.told(CERTAIN)
    assert bench.search.may_be_last
    assert bench.search.needs_early_fit
    bench.told(CERTAIN, flag="part of the record is unexplained")
    while not bench.search.may_be_last:
        bench.told(CERTAIN)
    assert not bench.search.needs_early_fit
    bench.told(CERTAIN)
    assert bench.search.due_tick is None
    assert not bench.search.needs_early_fit


@pytest.mark.further  # as a doubtful record
def test_a_doubted_number_is_not_reached(bench):
    while not bench.search.may_be_last:
        bench.told(CERTAIN)
    fit, *more = bench.told(CERTAIN, flag="part of the record is unexplained")
    assert not any(isinstance(message, SearchEnded) for message in more)
    assert {target["std"] for target in fit.document["search"]["targets"]} == {None}


@pytest.mark.further  # as one never certain
def test_a_record_that_stays_doubtful_is_given_up_with_its_findings(bench):
    ends = []
    while not ends:
        told = bench.told(ON_THE_WAY, flag="part of the record is unexplained")
        ends = [message for message in told if isinstance(message, SearchEnded)]
        assert bench.writer.ticks < 50 * RATE_HZ
    assert not ends[0].reached
    assert ends[0].reason == (
        "The record is doubtful: part of the record is unexplained. Something struck the beam. "
        "Record a chirp instead: rigd run chirp."
    )
    assert told[0].document["text"][-1].count("doubtful") == 3


def test_ticks_that_were_held_shift_what_follows(bench, quick_pieces):
    bench.told(ON_THE_WAY)
    bench.told(ON_THE_WAY, held=300)
    end = bench.search.end_of_record(9000, 300, bench.writer.ticks)
    first, last = end.segments["piece_1"]
    assert first == 6800
    assert last > first
    assert not end.reached


def test_ticks_that_were_held_after_a_piece_do_not_shift_it(bench, quick_pieces):
    """As where a decision takes longer than what is planned: the scan was played at once."""
    bench.told(ON_THE_WAY, held=1200, before=0)
    bench.told(ON_THE_WAY, held=2000, before=1700)
    segments = bench.search.end_of_record(14000, 2050, bench.writer.ticks).segments
    assert segments["scan"] == (1000, 6000)
    assert segments["sweep"][0] == 1000
    first, end = segments["piece_1"]
    assert first == 6500 + 1700
    assert segments["piece_2"][0] == end - 1700 + 2050


def test_a_piece_that_was_not_begun_is_no_segment(bench, quick_pieces):
    assert bench.search.has_last_segment_begun(0)
    bench.told(ON_THE_WAY)
    place = bench.search.due_tick
    assert bench.search.has_last_segment_begun(bench.writer.ticks)
    assert not bench.search.has_last_segment_begun(0)
    segments = bench.search.end_of_record(place + 400, 0, 0).segments
    assert segments.keys() == {"scan", "sweep"}


def test_a_scan_that_told_nothing_is_repeated_and_then_given_up(bench):
    planned = bench.writer.ticks
    for number in (1, 2):
        (message,) = bench.problem()
        assert message.name == "the scan once more"
        assert bench.writer.ticks == planned + number * 5000
    (end,) = bench.problem()
    assert (end.reached, end.reason) == (False, "Given up: Nothing is excited yet.")


def test_a_record_that_cannot_be_fitted_any_more_is_given_up_at_once(bench, quick_pieces):
    bench.told(ON_THE_WAY)
    (end,) = bench.problem("The angle is missing for 16 ms.")
    assert (end.reached, end.reason) == (False, "Given up: The angle is missing for 16 ms.")


def test_the_time_that_is_allowed_is_kept(profile, quick_pieces):
    bench = Bench(profile, "damping 0.01%", at_most_s=12.0)
    ends = []
    while not ends:
        ends = [m for m in bench.told(ON_THE_WAY) if isinstance(m, SearchEnded)]
        assert bench.writer.ticks <= 12 * RATE_HZ
    assert not ends[0].reached
    assert "--at-most" in ends[0].reason


@pytest.mark.parametrize("over_ticks", [-1, 0, 700])
def test_a_decision_that_took_long_may_leave_no_time(profile, quick_pieces, over_ticks):
    """The angle was held before the last piece, so that it ends with the record, or after it."""
    bench = Bench(profile, "damping 0.01%", at_most_s=12.0)
    bench.told(ON_THE_WAY)
    held = 12 * RATE_HZ - bench.writer.ticks + over_ticks
    told = bench.told(ON_THE_WAY, held=held)
    if over_ticks < 0:
        assert bench.search.may_be_last
        assert bench.writer.ticks + held == 12 * RATE_HZ
    else:
        assert isinstance(told[-1], SearchEnded)
        assert told[-1].reason == "Not reached within 12 s (--at-most)."


@pytest.mark.parametrize(
    ("ratio_of_std", "reason"),
    [(0.98, "it would take about"), (0.999, "it would take more than a day")],
)
def test_what_goes_too_slowly_is_out_of_reach(profile, quick_pieces, ratio_of_std, reason):
    """The information grows by so little that an hour would not do: the reason has a remedy."""
    bench = Bench(profile, "damping 0.1%", at_most_s=60.0)
    share, ends = ON_THE_WAY, []
    while not ends:
        messages = bench.told(share)
        ends = [m for m in messages if isinstance(m, SearchEnded)]
        share *= ratio_of_std
    assert ends[0].reason.startswith(f"Out of reach: {reason}")
    assert (messages[0].document["search"]["left_s"] is None) == ("day" in reason)
    assert bench.writer.ticks < 40 * RATE_HZ


def test_damping_that_is_absent_cannot_be_told(profile, monkeypatch):
    monkeypatch.setattr("rigd.runner._precision_search._MAX_UNREACHABLE_FORECASTS", 1)
    bench = Bench(profile, "zeta 15%")
    ends = []
    while not ends:
        document = answer(profile, bench.search.due_tick, ON_THE_WAY)
        document["plant"]["damping"] |= {"zeta": 0.0}
        document["covariance"]["names"].remove("zeta")
        document["parameters"] = {}
        found = bench.search.plan_next(document, 0, 0)
        ends = [m for m in found if isinstance(m, SearchEnded)]
    assert ends[0].reason.startswith("Out of reach: internal damping is absent")


def test_an_absent_mode_is_not_stated(profile):
    (found,) = target_estimates(answer(profile, 1, CERTAIN), [parse_target("damping", "7:1%")])
    assert found.ratio == np.inf
    assert estimates_text([found]) == "damping of mode 7: no such mode was found in the band"
    none = answer(profile, 1, CERTAIN) | {"modes": []}
    (found,) = target_estimates(none, [parse_target("frequency", "1%")])
    assert estimates_text([found]) == "frequency of any mode: no such mode was found in the band"


def test_a_flag_on_what_is_asked_never_counts_as_reached(profile, quick_pauses):
    """However precise; after some judgements the search says why and ends."""
    bench = Bench(profile, "damping 1%")
    ends = []
    while not ends:
        document = answer(profile, bench.search.due_tick, CERTAIN)
        damping = document["modes"][1]["damping_ratio"]
        damping["flag"] = "part of the record is unexplained"
        told = list(bench.search.plan_next(document, 0, 0))
        ends = [m for m in told if isinstance(m, SearchEnded)]
    assert not ends[0].reached
    assert "damping of mode 2: part of the record is unexplained" in ends[0].reason


def test_modes_that_are_not_those_of_a_uniform_beam_are_excited_where_they_are(profile):
    """Each by a stiffness of its own: the design drives them at their frequencies."""
    bench = Bench(profile, "damping 2:0.1%", at_most_s=40.0)
    document = answer(profile, bench.search.due_tick, ON_THE_WAY)
    document["plant"]["stiffness_offsets"] = [0.04, 0.0]
    *_, piece = bench.search.plan_next(document, 0, 0)
    bands_hz = [
        (float(low) + float(high)) / 2 for low, high in re.findall(r"([\d.]+)–([\d.]+)", piece.name)
    ]
    assert pytest.approx(16.01 * np.sqrt(1.04), abs=0.06) in bands_hz


def test_deviations_are_designed_for_as_fits_state_them(profile, monkeypatch):
    """A fit that states more than the design expects needs more information."""
    planned = designed_at_once(monkeypatch, std=1.0)
    for share in (0.01, 0.02):
        bench = Bench(profile, "damping 1:0.2%")
        *_, piece = bench.told(share)
        (target,), (one,) = planned[-1]["targets"], piece.document["expected"]
        # What the design is asked for is told as fits state it: of its deviation of 0.1.
        assert target.std * one["asked_std"] / 0.1 == pytest.approx(0.002)
    less, more = (each["targets"][0].std for each in planned)
    assert less > 1.1 * more


def parameter_floor(targets, **given):
    rig = RigPreview(load_profile("sim"))
    return until(rate_hz=RATE_HZ, targets=targets, rig=rig, **given)


@pytest.mark.parametrize("targets", ["alpha 0.002", "lambda 0.01", "damping 1%; gamma 1%"])
def test_a_precision_below_what_the_geometry_leaves_is_refused(targets):
    """Before anything moves, with the floor; of an exactly uniform beam it can be reached."""
    with pytest.raises(ExcitationError, match="is below the floor of") as refused:
        parameter_floor(targets)
    for word in ("uniformity_percent", "--uniformity 0", "--damping", "120 s"):
        assert word in str(refused.value)
    assert "damping to 1 %" not in str(refused.value)
    assert parameter_floor(targets, uniformity_percent=0.0).search.targets


def test_what_the_geometry_leaves_may_be_asked(profile):
    for targets in ("alpha 0.03; lambda 0.1", "damping 0.01%; frequency 0.0001%"):
        assert parameter_floor(targets).search.targets
    with pytest.raises(ExcitationError, match="by 1 %"):
        parameter_floor("alpha 0.03", uniformity_percent=1.0)


def test_modes_above_the_band_are_not_asked_for(profile):
    document = answer(profile, 1, CERTAIN)
    document["modes"][2]["frequency_hz"]["value"] = 51.0
    document["modes"][2]["shown"] = False
    found = target_estimates(document, [parse_target("damping", "1%")])
    assert [each.mode for each in found] == [1, 2]


def test_an_absolute_deviation_is_not_a_share(profile):
    targets = [parse_target("frequency", "1:0.002Hz"), parse_target("damping", "2:1%")]
    found = frequency, damping = target_estimates(answer(profile, 1, 0.02), targets)
    told = [(each["name"], each["quantity"], each["mode"]) for each in targets_json(found)]
    assert told == [("frequency of mode 1", "frequency", 1), ("damping of mode 2", "damping", 2)]
    assert frequency.target_std == 0.002
    assert damping.ratio == pytest.approx(2.0)
