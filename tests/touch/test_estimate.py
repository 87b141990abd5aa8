"""Accuracy of estimates of simulated touches, and of their intervals."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import further
from struck_beam import ALIKE, MISTAKEN, NOTICED, OBSTACLES, begin_s, cut
from touch_records import Obstacle, Slew, simulate

from rigd.touch import TouchRecord, estimate_touch
from rigd.touch._obstacle_fit import ObstacleFit
from rigd.touch._tables import DETECTION_DELAYS_S

AT_REST = [further("soft"), "middle", further("hard")]


@pytest.fixture(scope="module")
def estimate_of(estimator, records_by_name, computed_once):
    """Function that estimates a record, given by name, from 0.1 s after the detection."""

    @cache
    def estimate(name):
        return computed_once(
            f"touch_told_{name}", lambda: estimator.estimate(cut(records_by_name[name], 100))
        )

    return estimate


@pytest.fixture(scope="module")
def first_estimate_of(estimator, records_by_name):
    """Function that estimates a record, given by name, from 50 ms after the detection."""
    return cache(
        lambda name: estimator.estimate(cut(records_by_name[name], 50), includes_likelihoods=False)
    )


@pytest.mark.parametrize("name", AT_REST)
def test_point_instant_and_force_of_an_obstacle_at_rest(estimate_of, records_by_name, name):
    estimate, truth = estimate_of(name), records_by_name[name]
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
def test_first_estimate_after_50_ms(first_estimate_of, name):
    estimate = first_estimate_of(name)
    assert estimate.samples == 50
    assert estimate.x_m.value == pytest.approx(OBSTACLES[name].x_m, abs=0.01)


def test_unexplained_later_samples_are_ignored(
    estimator, estimate_of, first_estimate_of, records_by_name
):
    """Bounces amplify small errors of the model, so that the first estimate is more accurate."""
    record = cut(records_by_name["middle"], 100)
    is_later = np.arange(record.torque_nm.size) >= record.detection_index + 55
    disturbance_nm = np.random.default_rng(1).normal(0.0, 8e-3, is_later.size) * is_later
    estimate = estimator.estimate(replace(record, torque_nm=record.torque_nm + disturbance_nm))
    assert estimate_of("middle").samples == 100
    assert estimate.samples == 50
    first = first_estimate_of("middle")
    assert estimate.x_m.value == pytest.approx(first.x_m.value, abs=first.x_m.std)
    assert estimate.x_m.std > estimate_of("middle").x_m.std


def test_torque_alone_is_less_accurate(estimator, estimate_of, records_by_name):
    torque_only = estimator.estimate(cut(records_by_name["middle"], 100, shear=False))
    assert torque_only.channels == 1
    assert torque_only.x_m.value == pytest.approx(OBSTACLES["middle"].x_m, abs=8e-3)
    assert torque_only.x_m.std > estimate_of("middle").x_m.std


@pytest.mark.parametrize("name", [further("fleeing"), "knock"])
def test_other_kinds_are_not_reported_as_rigid(estimate_of, name):
    estimate = estimate_of(name)
    assert estimate.kind in ({"fleeing": "moving", "knock": "knock"}[name], "unknown")
    if estimate.x_m is not None:
        low, high = estimate.x_m.interval_95
        assert low - 2e-3 < OBSTACLES[name].x_m < high + 2e-3


EARLY_SAMPLES, LATE_SAMPLES = 4, 6


@pytest.mark.parametrize(
    ("name", "noticed"),
    [
        ("gives way slowly", LATE_SAMPLES),
        # Moving obstacles and pairs are also tested below.
        *(
            further(name, noticed)
            for name in MISTAKEN
            for noticed in (EARLY_SAMPLES, LATE_SAMPLES)
            if (name, noticed) != ("gives way slowly", LATE_SAMPLES)
        ),
    ],
)
def test_no_wrong_position_or_kind(estimator, ambiguous_records, name, noticed):
    """Bounces on yielding, moving or two obstacles also fit one at rest at another position."""
    estimate = estimator.estimate(
        cut(ambiguous_records[name], 190, noticed=noticed), includes_likelihoods=False
    )
    kind = {"gives": "yielding", "flees": "moving", "two": "unknown"}[name.split()[0]]
    assert estimate.kind in (kind, "unknown")
    obstacles, _ = MISTAKEN[name]
    met_obstacles = obstacles if isinstance(obstacles, tuple) else (obstacles,)
    x = estimate.x_m
    assert x is None or min(abs(x.value - each.x_m) for each in met_obstacles) < 4 * x.std

    if name == "two":  # the second is met 65 ms after the first, 285 mm from it
        assert_first_obstacle(estimate)


def assert_first_obstacle(estimate):
    """Check that the first obstacle is estimated from the samples before the second touch."""
    assert estimate.samples == 50
    assert estimate.x_m.value == pytest.approx(MISTAKEN["two"][0][0].x_m, abs=0.01)
    assert estimate.x_m.std < 5e-3


def test_two_soft_obstacles_are_not_reported_as_one(estimator, ambiguous_records):
    """One obstacle at 0.11 m explains the first 50 ms up to noise."""
    (first, second), _ = ALIKE["two alike"]
    record = ambiguous_records["two alike"]
    early = estimator.estimate(cut(record, 50), includes_likelihoods=False)
    assert abs(early.x_m.value - first.x_m) < 4 * early.x_m.std
    estimate = estimator.estimate(cut(record, 190), includes_likelihoods=False)
    assert estimate.kind == "unknown"
    assert estimate.chi2_per_degree < 1.3
    low, high = estimate.x_m.interval_95
    assert low < first.x_m < high < second.x_m
    touch_s = estimate.time_s.value + begin_s(record)
    assert touch_s == pytest.approx(record.touch_s, abs=2e-3)
    assert 0 < estimate.force_n.value < 2 * record.peak_n


@pytest.mark.fit
def test_first_interval_includes_pairs_of_obstacles(estimator):
    """With this noise two obstacles explain the first 50 ms only a little better than one."""
    (first, second), slew = ALIKE["two alike"]
    [record] = simulate([(first, second)], [slew], duration_s=0.62, steps=20, modes=20, seed=7)
    estimate = estimator.growing_estimator().update(
        cut(record, 50), includes_likelihoods=False, is_first=True
    )
    low, high = estimate.x_m.interval_95
    assert low < first.x_m < high < second.x_m
    assert abs(estimate.x_m.value - first.x_m) < 4 * estimate.x_m.std


@pytest.mark.parametrize("after", [further(50), 190])
def test_one_obstacle_is_not_reported_as_two(estimator, ambiguous_records, after):
    estimate = estimator.estimate(
        cut(ambiguous_records["one alike"], after), includes_likelihoods=False
    )
    obstacle, _ = ALIKE["one alike"]
    assert estimate.kind == "rigid"
    assert abs(estimate.x_m.value - obstacle.x_m) < 4 * estimate.x_m.std
    assert estimate.x_m.std < 5e-3


# While the record grows


def growing_estimates(estimator, simulated, *, noticed=NOTICED):
    """Return first and last estimate, updated as in the process of the touch estimator."""
    growing_estimate = estimator.growing_estimator()
    growing_estimate.preview(cut(simulated, 25, noticed=noticed))
    first = growing_estimate.update(
        cut(simulated, 50, noticed=noticed), includes_likelihoods=False, is_first=True
    )
    return first, growing_estimate.update(
        cut(simulated, 190, noticed=noticed), includes_likelihoods=False
    )


@pytest.fixture(scope="module")
def estimates_of(estimator, records_by_name):
    """Function that returns first and last estimate of a record, given by name."""
    return cache(lambda name: growing_estimates(estimator, records_by_name[name]))


@pytest.mark.parametrize("name", [*map(further, ("soft", "middle", "fleeing", "knock")), "hard"])
def test_updated_estimate_equals_single_estimate(estimator, records_by_name, estimates_of, name):
    single_estimate = estimator.estimate(
        cut(records_by_name[name], 190), includes_likelihoods=False
    )
    _, last = estimates_of(name)
    assert (last.kind, last.samples) == (single_estimate.kind, single_estimate.samples)
    assert abs(last.x_m.value - single_estimate.x_m.value) < 0.5 * single_estimate.x_m.std
    assert last.x_m.std == pytest.approx(single_estimate.x_m.std, rel=0.5)


@pytest.mark.parametrize("name", [further("soft"), further("middle"), "hard"])
def test_first_estimate_equals_single_estimate(first_estimate_of, estimates_of, name):
    first, _ = estimates_of(name)
    single_estimate = first_estimate_of(name)
    assert first.kind == single_estimate.kind == "rigid"
    assert first.x_m.value == pytest.approx(
        single_estimate.x_m.value, abs=0.1 * single_estimate.x_m.std
    )


@pytest.mark.parametrize("name", ["fleeing", further("knock")])
def test_first_estimate_of_other_kinds_is_unknown(estimates_of, name):
    first, last = estimates_of(name)
    assert first.kind == "unknown"
    assert last.kind in ({"fleeing": "moving", "knock": "knock"}[name], "unknown")
    low, high = first.x_m.interval_95
    assert low < OBSTACLES[name].x_m < high
    assert last.x_m.std < first.x_m.std


def test_update_with_record_that_does_not_grow(estimator, records_by_name):
    growing_estimate = estimator.growing_estimator()
    estimates = [
        growing_estimate.update(cut(records_by_name["middle"], after), includes_likelihoods=False)
        for after in (50, 50, 200)
    ]
    assert [estimate.samples for estimate in estimates] == [50, 50, 100]
    assert {estimate.kind for estimate in estimates} == {"rigid"}


@pytest.mark.further  # as the hard one
def test_first_estimate_of_stiff_obstacle_near_tip(estimator):
    """Its contacts are the shortest; with steps of 0.1 ms the minimum is missed."""
    obstacle = Obstacle(x_m=0.93, stiffness_n_per_m=1e5)
    [record] = simulate([obstacle], [Slew(1.0)], duration_s=0.8, steps=20, modes=20, seed=4)
    estimate = estimator.estimate(cut(record, 50), includes_likelihoods=False)
    assert estimate.kind == "rigid"
    assert abs(estimate.x_m.value - obstacle.x_m) < 4 * estimate.x_m.std


@pytest.mark.parametrize("name", ["soft", further("middle"), further("hard")])
def test_touch_detected_after_24_ms(estimator, records_by_name, name):
    first, last = growing_estimates(estimator, records_by_name[name], noticed=24)
    for estimate in (first, last):
        assert estimate.kind == "rigid"
        assert abs(estimate.x_m.value - OBSTACLES[name].x_m) < 4 * estimate.x_m.std
        touch_s = estimate.time_s.value + begin_s(records_by_name[name], 24)
        assert touch_s == pytest.approx(records_by_name[name].touch_s, abs=5e-4)


@pytest.mark.further  # as after 24 ms
def test_touch_detected_after_90_ms(estimator, records_by_name):
    """The longest assumed time from touch to detection is 120 ms."""
    noticed = 90
    record = cut(records_by_name["middle"], 50, noticed=noticed)
    estimate = estimator.estimate(record, includes_likelihoods=False)
    touch_s = estimate.time_s.value + begin_s(records_by_name["middle"], noticed)
    assert estimate.kind == "rigid"
    assert abs(estimate.x_m.value - OBSTACLES["middle"].x_m) < 4 * estimate.x_m.std
    assert touch_s == pytest.approx(records_by_name["middle"].touch_s, abs=5e-4)


def test_estimate_is_reproducible(estimator, first_estimate_of, records_by_name):
    repeated = estimator.estimate(cut(records_by_name["middle"], 50), includes_likelihoods=False)
    assert repeated.as_dict() == first_estimate_of("middle").as_dict()


def test_estimate_as_json_document(estimate_of):
    document = json.loads(json.dumps(estimate_of("middle").as_dict(start_s=2.0)))
    assert set(document) == {"x_m", "time_s", "force_n", "stiffness_n_per_m", "kind", "model"}
    assert document["model"] == "profile"
    assert set(document["x_m"]) == {"value", "std", "interval_95"}
    assert document["time_s"]["value"] == pytest.approx(estimate_of("middle").time_s.value + 2.0)


def test_force_history_peaks_at_estimated_force(estimate_of):
    estimate = estimate_of("middle")
    assert estimate.force_history_n.shape == estimate.force_times_s.shape
    assert estimate.force_history_n.max() == pytest.approx(estimate.force_n.value, rel=0.2)
    assert estimate.force_times_s[0] == pytest.approx(estimate.time_s.value, abs=1e-3)


def test_innovations_are_noise_before_the_touch(estimate_of):
    before = estimate_of("middle").innovations[:, :380]
    assert np.std(before, axis=1) == pytest.approx([1.0, 1.0], abs=0.12)


def test_no_estimate_without_samples_before_touch(estimator, records_by_name):
    record = cut(records_by_name["middle"], 60)
    last_part = slice(340, None)
    short_record = TouchRecord(
        1000.0,
        record.angle_rad[last_part],
        record.torque_nm[last_part],
        record.shear_n[last_part],
        60,
    )
    estimate = estimator.estimate(short_record)
    assert (estimate.x_m, estimate.kind) == (None, "unknown")


@pytest.mark.slow
def test_estimate_touch_equals_prepared_estimator(model, records_by_name, estimate_of):
    estimate = estimate_touch(cut(records_by_name["hard"], 100), model)
    assert estimate.x_m == estimate_of("hard").x_m


def test_start_pairs_are_finite_without_contact(estimator, records_by_name):
    """The first obstacle is not reached, so that its parameters have no effect."""
    obstacle_fit = ObstacleFit(
        estimator._tables, cut(records_by_name["middle"], 50), DETECTION_DELAYS_S[0]
    )
    pair_contact, window = obstacle_fit.two_obstacle_contact(), obstacle_fit.window(0.05)
    not_reached = np.array([0.62, window.end_sample / 1000, np.log(3000.0)])
    no_effect = pair_contact.predict_channels(np.tile(not_reached, (1, 2)), window)
    assert not no_effect.any()
    starts = pair_contact.start_pairs(
        not_reached, window, pair_contact.parameter_ranges(obstacle_fit.parameter_ranges(3)), 2
    )
    assert np.isfinite(starts).all()
