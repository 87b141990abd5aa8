"""The antenna as it is drawn, against the shape that is computed of it."""

import dataclasses

import numpy as np
import pytest
from cases import further

from rigd.beam import DeflectionFilter
from rigd.view import Scene

pytestmark = pytest.mark.process

ANTENNA = "/antenna"
BEAM, TRAIL, LABEL, TOUCH = (f"{ANTENNA}/{name}" for name in ("beam", "trail", "label", "touch"))
ENLARGEMENT = 2.0
DRAWN_HZ = 20.0
TRAIL_S = 0.5
STRIPS = "LineStrips3D:strips"


def angle_rad(n: int) -> np.ndarray:
    time_s = np.arange(n) * 1e-3
    return 0.3 + 0.025 * np.sin(2 * np.pi * (0.5 + 2 * time_s) * time_s)


def moments(batches) -> list[tuple[int, np.ndarray]]:
    """Times in ns and lines (n, points, 3) sent to an entity, in order of time."""
    found = []
    for batch in batches:
        if STRIPS in batch.schema.names:
            times = batch.column("session_time").cast("int64").to_pylist()
            found += zip(times, batch.column(STRIPS).to_pylist(), strict=True)
    found.sort(key=lambda moment: moment[0])
    return [(t_ns, np.array(strips)) for t_ns, strips in found]


def blocks(samples, size: int):
    return [samples[i : i + size] for i in range(0, len(samples), size)]


@pytest.fixture
def follow(description, drawn):
    """Feed a scene with blocks of samples; return its output by entity."""

    def run(blocks_of_samples, of=description):
        scene = Scene(of)
        drawings = [d for block in blocks_of_samples for d in scene.sample_drawings(block)]
        return drawn([*drawings, *scene.final_drawings()])

    return run


@pytest.fixture
def samples(make_samples):
    return make_samples(3000, angle_rad=angle_rad(3000))


def test_drawn_shape_is_the_computed_one_times_the_factor(description, samples, follow):
    beams = moments(follow(blocks(samples, 50))[BEAM])
    assert len(beams) == 60
    bends = DeflectionFilter(description.beam, description.damping, description.rate_hz)
    largest_m = 0.0
    for (t_ns, (line, beam)), block in zip(beams, blocks(samples, 50), strict=True):
        deflection_m = bends.feed(block["angle_rad"])
        largest_m = max(largest_m, abs(deflection_m[-1]))
        assert t_ns == block["t_ns"][-1]
        length_m = description.beam.length_m
        np.testing.assert_allclose(beam[:, 0] * length_m, bends.x_m, atol=1e-6)
        # Its motion across its line at rest: the angle, and the deflection from there.
        np.testing.assert_allclose(
            beam[:, 1] * length_m / ENLARGEMENT,
            block["angle_rad"][-1] * bends.x_m + deflection_m,
            atol=1e-6,
        )
        np.testing.assert_allclose(
            (beam - line)[:, 1] * length_m / ENLARGEMENT, deflection_m, atol=1e-6
        )
        assert np.all(beam[:, 2] == 0)
    assert largest_m > 0.05


def test_factor_is_shown_at_the_tip(samples, follow):
    sent = follow(blocks(samples, 50))[LABEL]
    labels = [label for batch in sent for label in batch.column("Points3D:labels").to_pylist()]
    assert all(f"drawn × {ENLARGEMENT:g}" in label[0] for label in labels)
    assert 10 <= len(labels) <= 15  # readable: four a second


def label(tip_m, drawn=f"drawn × {ENLARGEMENT:g}"):
    """Return the text of a deflection: two figures, but no less than tenths of a mm."""
    tip_mm = 1e3 * tip_m
    text = f"{tip_mm:.1f}" if tip_mm < 10 else f"{float(f'{tip_mm:.2g}'):.0f}"
    return f"tip deflection ± {text} mm, {drawn}"


def last_label(batches):
    times = [t for b in batches for t in b.column("session_time").cast("int64").to_pylist()]
    texts = [text for b in batches for text in b.column("Points3D:labels").to_pylist()]
    time_ns, (text,) = max(zip(times, texts, strict=True))
    return time_ns, text


@pytest.mark.parametrize("excitation", ["move", further("touch")])
def test_large_motion_is_drawn_to_scale(description, samples, drawn, excitation):
    scene = Scene(dataclasses.replace(description, excitation=excitation))
    turned = samples.copy()
    turned["angle_rad"] += 1.0
    bends = DeflectionFilter(description.beam, description.damping, description.rate_hz)
    for block in blocks(turned, 100):
        sent = drawn(scene.sample_drawings(block))
        deflection = bends.feed(block["angle_rad"]) / description.beam.length_m
        line, beam = moments(sent[BEAM])[-1][1]
        angle_rad = block["angle_rad"][-1]
        assert line[-1] == pytest.approx([np.cos(angle_rad), np.sin(angle_rad), 0.0], abs=1e-6)
        bent = beam - line
        assert np.linalg.norm(bent, axis=1) == pytest.approx(np.abs(deflection), abs=1e-6)
        assert bent @ line[-1] == pytest.approx(0.0, abs=1e-6)
        if LABEL in sent:
            assert last_label(sent[LABEL])[1].endswith(" mm, drawn to scale")


@pytest.mark.parametrize("amplitude", [further(0.0), 0.01, further(0.1), 1.0])
def test_label_shows_the_largest_recent_deflection(description, samples, follow, amplitude):
    samples = samples[:1500]
    samples["angle_rad"] = amplitude * (samples["angle_rad"] - 0.3)
    last_ns, last = last_label(follow(blocks(samples, 50))[LABEL])
    bends = DeflectionFilter(description.beam, description.damping, description.rate_hz)
    tips_m = np.array([abs(bends.feed(block["angle_rad"])[-1]) for block in blocks(samples, 1)])
    lately = (samples["t_ns"] <= last_ns) & (samples["t_ns"] > last_ns - 1e9 * TRAIL_S)
    assert last == label(tips_m[lately][9::10].max())


def test_trail_shows_earlier_shapes_of_the_beam(samples, follow):
    sent = follow(blocks(samples, 50))
    beams, trail = moments(sent[BEAM]), moments(sent[TRAIL])
    assert 55 <= len(trail) <= 60  # it follows a quarter of a second behind
    for (t_ns, lines), (trail_ns, (past,)) in zip(beams, trail, strict=False):
        assert trail_ns == t_ns
        np.testing.assert_array_equal(past, lines[1])


@pytest.mark.parametrize("size", [further(1), 7, further(64), 3000])
def test_drawing_does_not_depend_on_blocks(size, samples, follow):
    expected = moments(follow(blocks(samples, 50))[BEAM])
    found = moments(follow(blocks(samples, size))[BEAM])
    assert [t_ns for t_ns, _ in found] == [t_ns for t_ns, _ in expected]
    for (_, lines), (_, expected_lines) in zip(found, expected, strict=True):
        np.testing.assert_allclose(lines, expected_lines, atol=1e-6)


def test_missing_samples_are_bridged(samples, follow):
    expected = moments(follow(blocks(samples, 50))[BEAM])
    present = np.ones(3000, dtype=bool)
    present[1000:1020] = present[1500] = present[2037:2061] = False
    found = moments(follow(blocks(samples[present], 50))[BEAM])
    assert [t_ns for t_ns, _ in found] == [t_ns for t_ns, _ in expected]
    largest = max(np.abs(lines[1, :, 1] - lines[0, :, 1]).max() for _, lines in expected)
    for (_, lines), (_, expected_lines) in zip(found, expected, strict=True):
        np.testing.assert_allclose(lines, expected_lines, atol=0.05 * largest)


def test_drawing_continues_after_a_gap_of_hours(make_samples, follow):
    blocks_of_samples = [
        make_samples(100, angle_rad=angle_rad(100)),
        make_samples(100, first_tick=30_000_000, angle_rad=angle_rad(100)),
    ]
    beams = moments(follow(blocks_of_samples)[BEAM])
    assert len(beams) < 250
    assert beams[-1][0] > 30_000 * 10**9


@pytest.mark.parametrize("rate_hz", [10.0, further(250.0), 4000.0])
def test_other_rates_are_drawn_at_most_20_times_a_second(
    rate_hz, description, make_samples, follow
):
    n = int(4 * rate_hz)
    samples = make_samples(n, angle_rad=0.02 * np.sin(np.arange(n) / rate_hz))
    samples["t_ns"] = np.arange(n) * round(1e9 / rate_hz)
    of = dataclasses.replace(description, rate_hz=rate_hz)
    beams = moments(follow(blocks(samples, 500), of)[BEAM])
    assert 0.85 <= len(beams) / (4 * min(rate_hz, DRAWN_HZ)) <= 1.0
    assert all(np.isfinite(lines).all() for _, lines in beams)


def test_beam_without_damping_continues_to_swing(description, make_samples, follow):
    n = 4000
    step = make_samples(n, angle_rad=np.where(np.arange(n) < 500, 0.0, 0.02))
    unknown = dataclasses.replace(description, damping=None)
    beams = moments(follow(blocks(step, 50), unknown)[BEAM])
    bends = np.array([lines[1, -1, 1] - lines[0, -1, 1] for _, lines in beams])
    assert np.abs(bends[:9]).max() < 1e-6
    assert 0.5 < np.abs(bends[-20:]).max() / np.abs(bends[10:30]).max() < 1.0


def test_no_samples_give_no_drawing(description, make_samples):
    assert Scene(description).sample_drawings(make_samples(0)) == []


def test_frame_draws_the_motor_and_the_shape_of_the_beam(description, drawn):
    sent = drawn(Scene(description).initial_drawings())
    assert {f"{ANTENNA}/motor", f"{ANTENNA}/positive", BEAM, TRAIL, LABEL} <= sent.keys()
    # Nothing of it moves, so nothing of it has a time.
    of_antenna = [b for entity in sent if entity.startswith(ANTENNA) for b in sent[entity]]
    assert all("session_time" not in batch.schema.names for batch in of_antenna)
    (styles,) = sent[BEAM]
    assert len(styles.column("LineStrips3D:colors")[0]) == 2


def test_view_shows_the_antenna_and_its_trail(layout_of):
    def leaves(part):
        parts = getattr(part, "contents", None)
        inner = isinstance(parts, list | tuple) and not isinstance(parts[0], str)
        return [leaf for each in parts for leaf in leaves(each)] if inner else [part]

    (view,) = [each for each in leaves(layout_of()) if each.class_identifier == "3D"]
    assert (view.name, view.origin) == ("Antenna", ANTENNA)
    assert TRAIL in view.visualizer_overrides


def known(value, half):
    return {"value": value, "std": half / 2, "interval_95": [value - half, value + half]}


TOUCH_AT_2_S = {
    "number": 3,
    "x_m": known(0.49, 0.02),
    "time_s": known(2.0123, 0.001),
    "force_n": known(0.5, 0.1),
}


def values_of(batches, component):
    (batch,) = [each for each in batches if component in each.schema.names]
    times = batch.column("session_time").cast("int64").to_pylist()
    return times, np.array(batch.column(component).to_pylist()[0])


def test_touch_is_drawn_at_the_beam_against_its_motion(description, samples, drawn):
    scene = Scene(description)
    for block in blocks(samples, 100):
        scene.sample_drawings(block)
    sent = drawn(scene.touch_drawings([TOUCH_AT_2_S]))
    times, (point,) = values_of(sent[f"{TOUCH}/3/point"], "Points3D:positions")
    assert times == [2_012_300_000]
    # The exact shape of that very tick.
    filter_ = DeflectionFilter(description.beam, description.damping, description.rate_hz)
    deflection_m = filter_.feed(samples["angle_rad"][:2013])
    position = 0.49 / description.beam.length_m
    across = np.interp(0.49, filter_.x_m, deflection_m) / description.beam.length_m
    y = ENLARGEMENT * (samples["angle_rad"][2012] * position + across)
    # Between two drawn shapes, at 50 ms, it is interpolated.
    assert point == pytest.approx([position, y, 0.0], abs=4e-3)
    _, (interval,) = values_of(sent[f"{TOUCH}/3/interval"], STRIPS)
    assert interval[:, 0] * description.beam.length_m == pytest.approx([0.47, 0.51], abs=1e-6)
    _, (force,) = values_of(sent[f"{TOUCH}/3/force"], "Arrows3D:vectors")
    _, (origin,) = values_of(sent[f"{TOUCH}/3/force"], "Arrows3D:origins")
    before = DeflectionFilter(description.beam, description.damping, description.rate_hz)
    then = np.interp(0.49, before.x_m, before.feed(samples["angle_rad"][:1970]))
    forward = y - ENLARGEMENT * (
        samples["angle_rad"][1969] * position + then / description.beam.length_m
    )
    assert force[1] * forward < 0
    assert origin + force == pytest.approx(point, abs=1e-6)
    _, labels = values_of(sent[f"{TOUCH}/label"], "Points3D:labels")
    assert labels.tolist() == ["touch 3: 0.490 ± 0.020 m"]


@pytest.mark.parametrize(
    "changes", [{"x_m": None}, {"time_s": None}, {"time_s": known(0.01, 0.001)}]
)
def test_touch_of_unknown_position_or_time_is_not_drawn(description, samples, changes):
    scene = Scene(description)
    scene.sample_drawings(samples)
    assert scene.touch_drawings([TOUCH_AT_2_S | changes]) == []
    assert scene.touch_drawings([TOUCH_AT_2_S])


def test_touch_before_the_first_shape_is_not_drawn(description):
    assert Scene(description).touch_drawings([TOUCH_AT_2_S]) == []
