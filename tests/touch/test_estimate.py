"""Estimates of simulated touches: within a millimetre or two, and within their intervals."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import further
from struck_beam import ALIKE, MISTAKEN, NOTICED, OBSTACLES, begin_s, cut
from touch_records import Obstacle, Slew, simulate

from rigd.touch import TouchRecord, estimate_touch
from rigd.touch._explanations import ExplanationSearch
from rigd.touch._tables import DETECTION_DELAYS_S

AT_REST = [further("soft"), "middle", further("hard")]


@pytest.fixture(scope="module")
def told(estimator, struck, computed_once):
    """Estimate from 0.1 s after the detection, on a record by its name."""

    @cache
    def estimate(name):
        return computed_once(
            f"touch_told_{name}", lambda: estimator.estimate(cut(struck[name], 100))
        )

    return estimate


@pytest.fixture(scope="module")
def first_told(estimator, struck):
    """Estimate from 50 ms after the detection, on a record by its name."""
    return cache(lambda name: estimator.estimate(cut(struck[name], 50), scan=False))


@pytest.mark.parametrize("name", AT_REST)
def test_point_instant_and_force_of_an_obstacle_at_rest(told, struck, name):
    estimate, truth = told(name), struck[name]
    assert estimate.kind == "rigid"
    assert estimate.x_m.value == pytest.approx(OBSTACLES[name].x_m, abs=3e-3)
    assert abs(estimate.x_m.value - OBSTACLES[name].x_m) < 4 * estimate.x_m.std
    assert 1e-4 < estimate.x_m.std < 3e-3
    touch = estimate.time_s.value + begin_s(truth)
    assert touch == pytest.approx(truth.touch_s, abs=5e-4)
    assert estimate.force_n.value == pytest.approx(truth.peak_n, rel=0.35)
    low, high = estimate.stiffness_n_per_m.interval_95
    assert low < OBSTACLES[name].stiffness_n_per_m < high


@pytest.mark.parametrize("name", AT_REST)
def test_first_answer_after_50_ms(first_told, name):
    estimate = first_told(name)
    assert estimate.samples == 50
    assert estimate.x_m.value == pytest.approx(OBSTACLES[name].x_m, abs=0.01)


def test_what_follows_counts_only_if_it_is_explained_as_well(estimator, told, first_told, struck):
    """Bounces make much of small errors of the model: then the first answer is the better one."""
    record = cut(struck["middle"], 100)
    later = np.arange(record.torque_nm.size) >= record.detected + 55
    off_nm = np.random.default_rng(1).normal(0.0, 8e-3, later.size) * later
    estimate = estimator.estimate(replace(record, torque_nm=record.torque_nm + off_nm))
    assert told("middle").samples == 100
    assert estimate.samples == 50
    first = first_told("middle")
    assert estimate.x_m.value == pytest.approx(first.x_m.value, abs=first.x_m.std)
    assert estimate.x_m.std > told("middle").x_m.std


def test_torque_alone_tells_less(estimator, told, struck):
    alone = estimator.estimate(cut(struck["middle"], 100, shear=False))
    assert alone.channels == 1
    assert alone.x_m.value == pytest.approx(OBSTACLES["middle"].x_m, abs=8e-3)
    assert alone.x_m.std > told("middle").x_m.std


@pytest.mark.parametrize("name", [further("fleeing"), "knock"])
def test_what_is_no_obstacle_at_rest_is_not_called_one(told, name):
    estimate = told(name)
    assert estimate.kind in ({"fleeing": "moving", "knock": "knock"}[name], "unknown")
    if estimate.x_m is not None:
        low, high = estimate.x_m.interval_95
        assert low - 2e-3 < OBSTACLES[name].x_m < high + 2e-3


EARLY, LATE = 4, 6


@pytest.mark.parametrize(
    ("name", "noticed"),
    [
        ("gives way slowly", LATE),
        # What flees is below, and two obstacles.
        *(
            further(name, noticed)
            for name in MISTAKEN
            for noticed in (EARLY, LATE)
            if (name, noticed) != ("gives way slowly", LATE)
        ),
    ],
)
def test_never_sure_of_a_wrong_point_or_kind(estimator, mistaken, name, noticed):
    """Bounces of what gives way, moves or comes in pairs fit an obstacle at rest elsewhere, too."""
    estimate = estimator.estimate(cut(mistaken[name], 190, noticed=noticed), scan=False)
    kind = {"gives": "yielding", "flees": "moving", "two": "unknown"}[name.split()[0]]
    assert estimate.kind in (kind, "unknown")
    obstacles, _ = MISTAKEN[name]
    met = obstacles if isinstance(obstacles, tuple) else (obstacles,)
    x = estimate.x_m
    assert x is None or min(abs(x.value - each.x_m) for each in met) < 4 * x.std

    if name == "two":  # the second is met 65 ms after the first, 285 mm from it
        assert_first_obstacle(estimate)


def assert_first_obstacle(estimate):
    """Check that the first of two is estimated, from what precedes the second."""
    assert estimate.samples == 50
    assert estimate.x_m.value == pytest.approx(MISTAKEN["two"][0][0].x_m, abs=0.01)
    assert estimate.x_m.std < 5e-3


def test_two_soft_obstacles_are_not_one_between_them(estimator, mistaken):
    """One at 0.11 m leaves in the first 50 ms about what noise leaves."""
    (first, second), _ = ALIKE["two alike"]
    two = mistaken["two alike"]
    early = estimator.estimate(cut(two, 50), scan=False)
    assert abs(early.x_m.value - first.x_m) < 4 * early.x_m.std
    estimate = estimator.estimate(cut(two, 190), scan=False)
    assert estimate.kind == "unknown"
    assert estimate.chi2_per_degree < 1.3
    low, high = estimate.x_m.interval_95
    assert low < first.x_m < high < second.x_m
    touch_s = estimate.time_s.value + begin_s(two)
    assert touch_s == pytest.approx(two.touch_s, abs=2e-3)
    assert 0 < estimate.force_n.value < 2 * two.peak_n


@pytest.mark.fit
def test_what_two_explain_as_well_as_one_is_in_the_first_interval(estimator):
    """With this noise two obstacles explain the first 50 ms only a little better than one."""
    (first, second), slew = ALIKE["two alike"]
    [two] = simulate([(first, second)], [slew], duration_s=0.62, steps=20, modes=20, seed=7)
    estimate = estimator.follow().update(cut(two, 50), scan=False, first=True)
    low, high = estimate.x_m.interval_95
    assert low < first.x_m < high < second.x_m
    assert abs(estimate.x_m.value - first.x_m) < 4 * estimate.x_m.std


@pytest.mark.parametrize("after", [further(50), 190])
def test_one_that_is_like_two_is_one(estimator, mistaken, after):
    estimate = estimator.estimate(cut(mistaken["one alike"], after), scan=False)
    one, _ = ALIKE["one alike"]
    assert estimate.kind == "rigid"
    assert abs(estimate.x_m.value - one.x_m) < 4 * estimate.x_m.std
    assert estimate.x_m.std < 5e-3


# While the record grows


def grown(estimator, struck, *, noticed=NOTICED):
    """First and last answer, as the touch process asks for them."""
    growing = estimator.follow()
    growing.preview(cut(struck, 25, noticed=noticed))
    first = growing.update(cut(struck, 50, noticed=noticed), scan=False, first=True)
    return first, growing.update(cut(struck, 190, noticed=noticed), scan=False)


@pytest.fixture(scope="module")
def grown_of(estimator, struck):
    """First and last answer on a record by its name."""
    return cache(lambda name: grown(estimator, struck[name]))


@pytest.mark.parametrize("name", [*map(further, ("soft", "middle", "fleeing", "knock")), "hard"])
def test_what_goes_on_from_the_first_answer_tells_the_same(estimator, struck, grown_of, name):
    at_once = estimator.estimate(cut(struck[name], 190), scan=False)
    _, last = grown_of(name)
    assert (last.kind, last.samples) == (at_once.kind, at_once.samples)
    assert abs(last.x_m.value - at_once.x_m.value) < 0.5 * at_once.x_m.std
    assert last.x_m.std == pytest.approx(at_once.x_m.std, rel=0.5)


@pytest.mark.parametrize("name", [further("soft"), further("middle"), "hard"])
def test_the_first_answer_is_that_of_its_samples(first_told, grown_of, name):
    first, _ = grown_of(name)
    alone = first_told(name)
    assert first.kind == alone.kind == "rigid"
    assert first.x_m.value == pytest.approx(alone.x_m.value, abs=0.1 * alone.x_m.std)


@pytest.mark.parametrize("name", ["fleeing", further("knock")])
def test_the_first_answer_leaves_open_what_an_obstacle_at_rest_does_not_explain(grown_of, name):
    first, last = grown_of(name)
    assert first.kind == "unknown"
    assert last.kind in ({"fleeing": "moving", "knock": "knock"}[name], "unknown")
    low, high = first.x_m.interval_95
    assert low < OBSTACLES[name].x_m < high
    assert last.x_m.std < first.x_m.std


def test_a_record_that_does_not_grow_is_told_again(estimator, struck):
    growing = estimator.follow()
    told = [growing.update(cut(struck["middle"], after), scan=False) for after in (50, 50, 200)]
    assert [each.samples for each in told] == [50, 50, 100]
    assert {each.kind for each in told} == {"rigid"}


@pytest.mark.further  # as the hard one
def test_a_stiff_obstacle_near_the_tip_is_told_at_once(estimator):
    """Its contacts are the shortest; in steps of 0.1 ms their minimum is missed."""
    obstacle = Obstacle(x_m=0.93, stiffness_n_per_m=1e5)
    [record] = simulate([obstacle], [Slew(1.0)], duration_s=0.8, steps=20, modes=20, seed=4)
    estimate = estimator.estimate(cut(record, 50), scan=False)
    assert estimate.kind == "rigid"
    assert abs(estimate.x_m.value - obstacle.x_m) < 4 * estimate.x_m.std


@pytest.mark.parametrize("name", ["soft", further("middle"), further("hard")])
def test_a_touch_that_is_noticed_late_is_looked_for_in_what_precedes(estimator, struck, name):
    first, last = grown(estimator, struck[name], noticed=24)
    for told in (first, last):
        assert told.kind == "rigid"
        assert abs(told.x_m.value - OBSTACLES[name].x_m) < 4 * told.x_m.std
        touch_s = told.time_s.value + begin_s(struck[name], 24)
        assert touch_s == pytest.approx(struck[name].touch_s, abs=5e-4)


@pytest.mark.further  # as after 24 ms
def test_a_touch_that_is_noticed_a_tenth_of_a_second_late_is_looked_for_as_well(estimator, struck):
    """In the longest time before a detection in which a touch is looked for."""
    noticed = 90
    record = cut(struck["middle"], 50, noticed=noticed)
    estimate = estimator.estimate(record, scan=False)
    touch_s = estimate.time_s.value + begin_s(struck["middle"], noticed)
    assert estimate.kind == "rigid"
    assert abs(estimate.x_m.value - OBSTACLES["middle"].x_m) < 4 * estimate.x_m.std
    assert touch_s == pytest.approx(struck["middle"].touch_s, abs=5e-4)


def test_the_same_record_gives_the_same_answer(estimator, first_told, struck):
    again = estimator.estimate(cut(struck["middle"], 50), scan=False)
    assert again.as_dict() == first_told("middle").as_dict()


def test_a_document_of_json_types(told):
    document = json.loads(json.dumps(told("middle").as_dict(start_s=2.0)))
    assert set(document) == {"x_m", "time_s", "force_n", "stiffness_n_per_m", "kind", "model"}
    assert document["model"] == "profile"
    assert set(document["x_m"]) == {"value", "std", "interval_95"}
    assert document["time_s"]["value"] == pytest.approx(told("middle").time_s.value + 2.0)


def test_force_history_peaks_at_the_force_told(told):
    estimate = told("middle")
    assert estimate.force_history_n.shape == estimate.force_times_s.shape
    assert estimate.force_history_n.max() == pytest.approx(estimate.force_n.value, rel=0.2)
    assert estimate.force_times_s[0] == pytest.approx(estimate.time_s.value, abs=1e-3)


def test_innovations_are_noise_before_the_touch(told):
    before = told("middle").innovations[:, :380]
    assert np.std(before, axis=1) == pytest.approx([1.0, 1.0], abs=0.12)


def test_without_samples_before_the_touch_nothing_is_told(estimator, struck):
    record = cut(struck["middle"], 60)
    late = slice(340, None)
    short = TouchRecord(
        1000.0, record.angle_rad[late], record.torque_nm[late], record.shear_n[late], 60
    )
    estimate = estimator.estimate(short)
    assert (estimate.x_m, estimate.kind) == (None, "unknown")


@pytest.mark.slow
def test_once_is_the_same_as_prepared(model, struck, told):
    estimate = estimate_touch(cut(struck["hard"], 100), model)
    assert estimate.x_m == told("hard").x_m


def test_a_second_obstacle_is_sought_beyond_one_that_is_not_reached(estimator, struck):
    """Its parameters have no effect in the first samples."""
    search = ExplanationSearch(estimator._tables, cut(struck["middle"], 50), DETECTION_DELAYS_S[0])
    pairing, window = search.two_obstacle_contact(), search.window(0.05)
    not_reached = np.array([0.62, window.end_sample / 1000, np.log(3000.0)])
    no_effect = pairing.predict_channels(np.tile(not_reached, (1, 2)), window)
    assert not no_effect.any()
    starts = pairing.start_pairs(
        not_reached, window, pairing.parameter_ranges(search.parameter_ranges(3)), 2
    )
    assert np.isfinite(starts).all()
