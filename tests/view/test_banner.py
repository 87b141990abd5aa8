"""The overview shows the state of a session, and its values relative to their limits."""

from dataclasses import replace

import pytest

from rigd.gauges import Gauge
from rigd.sweep_response import sweep_ticks
from rigd.view import Health, Note, Scene
from rigd.view.banner import (
    GAUGES_ENTITY,
    RUNNING,
    STATE_ENTITY,
    SUPERVISOR_LOST,
    banner,
    ended_state,
    gauge_color,
    gauge_text,
    preparing_state,
)
from rigd.view.plots import GREEN, GREY, ORANGE, RED, SKY_BLUE

FAULT = ended_state("fault", "The disk is full.")


@pytest.fixture
def sweep(description):
    """The paper's session with everything that a banner shows."""
    return replace(
        description,
        excitation="chirp",
        sweep_hz=(0.05, 50.0),
        specimen="A_3",
        limits={"angle": 1.0},
    )


def packed(color) -> int:
    return int.from_bytes(bytes((*color, 255)), "big")


def test_running_session_shows_excitation_and_time_left(sweep):
    text = banner(sweep, RUNNING, 61_000_000_000, Health(missed_ticks=0))
    heading, what = text.split("\n\n")
    assert heading == "# RUNNING · 75 s left"
    assert what == (
        "**chirp** 0.05 → 50 Hz, now **25 Hz**, specimen **A\\_3**, session 20261121-101500-chirp"
    )


def test_an_overloaded_computer_is_named(sweep):
    text = banner(sweep, RUNNING, 10_000_000_000, Health(missed_ticks=50))
    assert "Computer overloaded: 50 ticks missed (0.5 %)." in text
    assert "overloaded" not in banner(sweep, FAULT, 10_000_000_000, Health(missed_ticks=50))


@pytest.mark.parametrize(
    ("state", "heading"),
    [
        (preparing_state("Taring."), "# PREPARING\n\nTaring."),
        (ended_state("complete", ""), "# COMPLETE\n\n**chirp**"),
        (
            ended_state("stopped", "Stopped by the operator."),
            "# STOPPED\n\nStopped by the operator.",
        ),
        (FAULT, "# FAULT\n\n**The disk is full.**"),
        (SUPERVISOR_LOST, "# SUPERVISOR LOST\n\n**The supervising process ended."),
    ],
)
def test_every_state_shows_its_name_and_reason(sweep, state, heading):
    text = banner(sweep, state, 30_000_000_000, Health())
    assert text.startswith(heading)
    assert "left" not in text.split("\n")[0]
    if state.is_over:
        assert "now" not in text


def test_recorded_session_is_not_shown_as_running(sweep):
    text = banner(replace(sweep, is_recorded=True), FAULT, 0, Health())
    assert text.startswith("# Recorded: FAULT")


def test_only_a_linear_sweep_has_a_frequency(description, sweep):
    assert sweep.frequency_hz(999) is None
    assert sweep.frequency_hz(1000) == pytest.approx(0.05)
    assert sweep.frequency_hz(121_000) is None
    assert description.frequency_hz(5000) is None
    down = replace(sweep, sweep_hz=(60.0, 50.0))
    assert down.frequency_hz(61_000) == pytest.approx(55.0)


def test_a_sweep_there_and_back_has_a_frequency_on_both_ways(sweep):
    both = replace(
        sweep, sweep_hz=(0.0, 50.0), return_sweep=(121_000, 241_000), scheduled_ticks=256_000
    )
    frequencies = [both.frequency_hz(tick) for tick in (61_000, 121_000, 181_000, 241_000)]
    assert frequencies == [25.0, 50.0, 25.0, None]
    text = banner(both, RUNNING, 181_000_000_000, Health())
    assert "0 → 50 → 0 Hz, now **25 Hz**" in text
    segments = {"sweep": (1000, 241_000), "there": (1000, 121_000), "back": (121_000, 241_000)}
    assert sweep_ticks(segments) == (1000, 121_000)


@pytest.mark.parametrize(
    ("value", "color"), [(None, GREY), (0.79, GREEN), (0.81, ORANGE), (1.0, RED)]
)
def test_a_gauge_turns_orange_near_its_limit_and_red_at_it(value, color):
    assert gauge_color(Gauge(value, 1.0, "rad")) == color


@pytest.mark.parametrize(
    ("gauge", "text"),
    [
        (Gauge(1.0512, 15.0, "rad/s"), "speed 1.05 of 15 rad/s"),
        (Gauge(0.00012, 0.5, "rad"), "speed 0.0001 of 0.5 rad"),
        (Gauge(0.2, None, "N·m"), "speed 0.2 N·m"),
        (Gauge(None, 1.0, "N"), "speed unknown"),
    ],
)
def test_gauge_is_shown_to_a_thousandth_of_its_limit(gauge, text):
    assert gauge_text("speed", gauge) == text


@pytest.mark.process
def test_state_and_values_are_drawn_on_arrival(sweep, make_samples, shown):
    scene = Scene(sweep)
    drawings = scene.initial_drawings()
    drawings += scene.state_drawings(0, RUNNING)
    assert scene.state_drawings(0, RUNNING) == []
    drawings += scene.sample_drawings(make_samples(1000, angle_rad=0.9))
    drawings += scene.health_drawings(1_000_000_000, Health(missed_ticks=0))
    drawings += scene.state_drawings(1_000_000_000, FAULT)
    found = shown(drawings)
    words = [text.split("\n")[0] for (text,) in found[STATE_ENTITY].values["TextDocument:text"]]
    assert words == ["# PREPARING", "# RUNNING · 136 s left", "# RUNNING · 135 s left", "# FAULT"]
    bands = [colors[0] for colors in found[f"{GAUGES_ENTITY}/bars"].values["LineStrips2D:colors"]]
    assert bands == [packed(color) for color in (ORANGE, SKY_BLUE, SKY_BLUE, RED)]
    assert "angle 0.900 of 1 rad" in found[f"{GAUGES_ENTITY}/texts"].values["Points2D:labels"][-1]
    colors = found[f"{GAUGES_ENTITY}/bars"].values["LineStrips2D:colors"][-1]
    assert packed(ORANGE) in colors  # the bar of the angle


@pytest.mark.process
def test_a_peak_between_two_drawings_is_not_lost(sweep, make_samples, shown):
    scene = Scene(sweep)
    samples = make_samples(1000)
    samples["angle_rad"][50] = 0.5
    for i in range(0, 1000, 100):
        scene.sample_drawings(samples[i : i + 100])
    found = shown(scene.health_drawings(1_000_000_000, Health()))
    assert "angle 0.500 of 1 rad" in found[f"{GAUGES_ENTITY}/texts"].values["Points2D:labels"][-1]


@pytest.mark.process
def test_events_are_shown_in_full_the_newest_first(sweep, shown):
    scene = Scene(sweep)
    long = "The *torque* command " + 40 * "is above its warning level " + "now."
    found = shown(
        scene.event_drawings(
            [Note(0, "info", "Record starts."), Note(2_500_000_000, "warning", long)]
        )
    )
    newest, first = found["/recent_events"].last("TextDocument:text").split("\n\n")
    assert newest.startswith("**2.5 s** ⚠ The \\*torque\\* command is above")
    assert newest.endswith("level now.")
    assert first == "**0.0 s** Record starts."
    # A log cuts texts longer than its view.
    assert max(map(len, found["/events"].last("TextLog:text").split("\n"))) <= 150
