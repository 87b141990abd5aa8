"""Notation of obstacles, and messages on mistakes in it."""

from dataclasses import replace
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.devices.obstacles import (
    ImpactSpecification,
    Obstacle,
    ObstacleError,
    describe_obstacle,
    parse_obstacle,
    with_obstacles,
)
from rigd.profile import load_profile

TIMES = st.floats(0, 1e6)
OBSTACLES = st.builds(
    Obstacle,
    x_m=st.floats(0, 100, exclude_min=True),
    angle_rad=st.floats(-10, 10),
    stiffness_n_per_m=st.one_of(st.just(inf), st.floats(1, 1e7)),
    damping_n_s_per_m=st.floats(0, 1e4),
    side=st.sampled_from([1, -1]),
    rate_rad_s=st.floats(-100, 100),
    from_s=TIMES,
    until_s=st.one_of(st.just(inf), TIMES),
).filter(lambda obstacle: obstacle.until_s > obstacle.from_s)
KNOCKS = st.builds(
    ImpactSpecification,
    x_m=st.floats(0, 100, exclude_min=True),
    force_n=st.floats(-1e3, 1e3),
    duration_s=st.floats(1e-4, 100),
    at_s=TIMES,
)


@given(st.one_of(OBSTACLES, KNOCKS))
def test_written_obstacles_are_read_back(disturbance):
    assert parse_obstacle(describe_obstacle(disturbance)) == disturbance


def test_defaults_of_an_obstacle():
    assert parse_obstacle("x=0.62, angle=0.6") == Obstacle(0.62, 0.6)
    assert parse_obstacle("x=0.62,angle=0.6,stiffness=rigid").stiffness_n_per_m == inf
    assert parse_obstacle("x=0.62,angle=-0.6").side == -1
    assert parse_obstacle("x=0.62,angle=-0.6,side=1").side == 1
    assert describe_obstacle(Obstacle(0.62, 0.6, 3000.0)) == "x=0.62,angle=0.6,stiffness=3000"
    assert parse_obstacle("at=3,x=0.5,force=-2,duration=0.02") == ImpactSpecification(
        0.5, -2.0, 0.02, 3.0
    )


@given(st.text(max_size=60))
def test_any_text_is_read_or_refused_in_a_sentence(text):
    try:
        parse_obstacle(text)
    except ObstacleError as error:
        assert str(error).startswith("Obstacle '")
        assert str(error).endswith(".")


NAMES = [
    "x",
    "angle",
    "stiffness",
    "damping",
    "side",
    "rate",
    "from",
    "until",
    "force",
    "duration",
    "at",
]


@given(st.lists(st.tuples(st.sampled_from(NAMES), st.floats().map(repr))))
def test_any_keys_are_read_or_refused(words):
    text = ",".join(f"{name}={value}" for name, value in words)
    try:
        disturbance = parse_obstacle(text)
    except ObstacleError:
        return
    assert parse_obstacle(describe_obstacle(disturbance)) == disturbance


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "unknown key ''; give x, angle, stiffness"),
        ("x=0.5", "'angle' is missing; give angle=…, an angle in rad"),
        ("angle=0.5", "'x' is missing; give x=…, a distance above 0 m"),
        ("x=0,angle=1", "x=0: give a distance above 0 m"),
        ("x=0.5,angle=1,stiffness=0.5", "give a stiffness of 1 to 10000000 N/m, or rigid"),
        ("x=0.5,angle=1,stiffness=hard", "stiffness=hard: give a stiffness"),
        ("x=0.5,angle=1,side=0", "side=0: give 1 or -1"),
        ("x=0.5,angle=1,x=0.6", "'x' is given twice"),
        ("x=0.5,angle=nan", "angle=nan: give an angle in rad"),
        ("x=0.5,angle=1,mass=3", "unknown key 'mass'"),
        ("x=0.5,angle=1,from=2,until=1", "until is not later than from"),
        ("x=0.5,force=2,at=1", "'duration' is missing"),
        ("x=0.5,force=2,at=1,duration=0", "duration=0: give a time in s"),
    ],
)
def test_mistakes(text, message):
    with pytest.raises(ObstacleError) as caught:
        parse_obstacle(text)
    assert message in str(caught.value)


def test_obstacles_of_a_rig():
    rig = load_profile("sim").rig
    more = with_obstacles(rig, ["x=0.5,angle=0.1", "x=0.98,angle=0.1"])
    assert more.simulation.obstacles == ("x=0.5,angle=0.1", "x=0.98,angle=0.1")
    assert with_obstacles(more, ["x=0.6,angle=0.1"]).simulation.obstacles[2:] == (
        "x=0.6,angle=0.1",
    )
    with pytest.raises(ObstacleError, match=r"x=0.99 m lies beyond the tip of the beam at 0\.98 m"):
        with_obstacles(rig, ["x=0.99,angle=0.1"])
    with pytest.raises(ObstacleError, match=r"\[simulation\]"):
        with_obstacles(replace(rig, simulation=None), ["x=0.5,angle=0.1"])
