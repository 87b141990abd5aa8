"""Everything that is shown of a session, from the samples of a whole one."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import further

from analysis.models import WelchSettings
from analysis.paper import estimate
from analysis.record import load_record
from rigd.beam import Damping
from rigd.session import read_session
from rigd.view import Health, Note, Scene, SessionDescription, draw_session
from rigd.view.frequency_charts import MAGNITUDE_ENTITY

pytestmark = pytest.mark.process

RIGD = Path(sys.executable).parent / "rigd"


@pytest.fixture(scope="module")
def path(paper_session):
    return paper_session[0]


@pytest.fixture(scope="module")
def record(path):
    return load_record(path)


def description_of(record) -> SessionDescription:
    return SessionDescription(
        name=record.path.stem,
        rate_hz=record.rate_hz,
        scheduled_ticks=len(record.time_s),
        sweep=(record.sweep.start, record.sweep.stop),
        beam=record.beam,
        damping=Damping(7.1e-5, 0.996, 5.5e-2, 0.594),
        tool_inertia_kg_m2=record.tool_inertia_kg_m2,
        angle_delay_s=record.angle_delay_s,
        torque_delay_s=record.torque_delay_s,
    )


def blocks(samples, size=50):
    return (samples[i : i + size] for i in range(0, len(samples), size))


@pytest.mark.further  # charts: test_response_charts.py
def test_final_response_is_that_of_the_analyser(path, record, shown):
    picture = Scene(description_of(record))
    for block in blocks(read_session(path).samples):
        picture.sample_drawings(block)
    drawings = picture.final_drawings()
    found = shown(drawings)
    # All of it is below the coherent values.
    (strip,) = found[f"{MAGNITUDE_ENTITY}/uncertain"].values["LineStrips2D:strips"][-1]
    points = np.array(strip)
    expected, _ = estimate(record, WelchSettings())
    expected_db = 20 * np.log10(abs(expected.response))
    chart = picture.response_charts.chart(MAGNITUDE_ENTITY)
    at = chart.to_canvas(expected.frequency_hz, expected_db)
    inside = (points[:, 0] > at[0, 0]) & (points[:, 0] < at[-1, 0])
    assert 300 < inside.sum() <= 400
    nearest = abs(at[:, 0] - points[inside, :1]).argmin(axis=1)
    _, top, _, bottom = chart.frame_edges
    decibels = (chart.y.end_value - chart.y.start_value) / (bottom - top)
    one_percent_db = 20 * np.log10(1.01)
    assert np.all(abs(at[nearest, 1] - points[inside, 1]) * decibels < one_percent_db)
    # All of the excited band is shown, and the peaks to their tops.
    assert points[:, 0].max() > at[expected.frequency_hz < 49.0, 0].max()
    assert points[inside, 1].min() == pytest.approx(at[:, 1].min(), abs=1e-3)


def test_all_entities_are_in_the_layout(description, make_samples, make_timings, shown):
    picture = Scene(description)
    frame = picture.initial_drawings()
    t_s = np.arange(3000) / 1000.0
    samples = make_samples(3000, angle_rad=0.01 * np.sin(t_s), coupling_torque_nm=0.1)
    timings = make_timings(3000)
    drawings = list(frame)
    for i in range(0, 3000, 50):
        drawings += picture.sample_drawings(samples[i : i + 50])
        drawings += picture.timing_drawings(timings[i : i + 50])
    drawings += picture.health_drawings(3_000_000_000, Health(missed_ticks=1, rate_hz=1000.0))
    drawings += picture.event_drawings([Note(1_000_000, "warning", "1 tick was missed.")])
    drawings += picture.final_drawings()
    found = shown(drawings)
    assert {entity for entity in found if entity.count("/") == 1} >= {
        "/signals",
        "/readings",
        "/health",
        "/summary",
        "/events",
    }
    # No sample is missing, none comes twice.
    for entity, component, records in (
        ("/signals", "angle_mrad", samples),
        ("/readings", "ages_ms", timings),
    ):
        assert found[entity].times_ns[component] == records["t_ns"].tolist()
        assert found[entity].batches <= 31
        assert found[f"{entity}/ticks"].batches <= 30
    assert found["/events"].last("TextLog:text") == "1 tick was missed."
    assert found["/events"].last("TextLog:level") == "WARN"
    assert found["/events"].times_ns["TextLog:text"] == [1_000_000]
    assert "3 of 136 s" in found["/summary"].last("TextDocument:text")


def test_new_connection_gets_the_earlier_drawings(short_chirps, shown):
    path = short_chirps[0]
    record = load_record(path)
    picture = Scene(description_of(record))
    for block in blocks(read_session(path).samples[:10_000], 1000):
        picture.sample_drawings(block)
    picture.event_drawings([Note(1_000_000, "info", "The record begins.")])
    found = shown(picture.initial_drawings())
    assert found[f"{MAGNITUDE_ENTITY}/measured"].values["LineStrips2D:strips"][-1][0]
    assert found["/spectrogram/levels"].last("DepthImage:buffer")
    assert found["/events"].values["TextLog:text"] == [["The record begins."]]


def known(value):
    return {"value": value, "std": 1e-3, "interval_95": [value - 2e-3, value + 2e-3]}


def test_new_connections_get_earlier_touches(description, make_samples, shown):
    picture = Scene(description)
    for block in blocks(make_samples(2000), 100):
        picture.sample_drawings(block)
    touch = {"number": 1, "x_m": known(0.4), "time_s": known(1.5), "force_n": None}
    picture.touch_drawings([touch])
    picture.touch_drawings([touch | {"x_m": known(0.5)}])  # with more data
    found = shown(picture.initial_drawings())["/antenna/touch/1/point"]
    ((position,),) = found.values["Points3D:positions"]
    assert position[0] == pytest.approx(0.5 / description.beam.length_m)


def test_a_recorded_session_shows_its_touches(touch_file, drawn, make_timings):
    outcome = {"touches": json.dumps([{"number": 1, "x_m": known(0.6), "time_s": known(1.3)}])}
    session = replace(read_session(touch_file.path), outcome=outcome)
    timings = make_timings(0)
    found = drawn([lambda stream: draw_session(stream, session, timings)])
    assert "/antenna/touch/1/point" in found
    lines = [
        text
        for batch in found["/events"]
        for texts in batch.column("TextLog:text").to_pylist()
        for text in texts
    ]
    assert any(text.startswith("Touch 1: 0.6000 ± 0.0020 m from the axis") for text in lines)


@pytest.mark.parametrize(
    "changes",
    [
        {"sweep": (1000, 1000)},
        further({"sweep": (1000, 1003)}),
        further({"rate_hz": 100.0, "scheduled_ticks": 3000, "sweep": (0, 3000)}),
        further({"damping": None}),
        further({"scheduled_ticks": 0, "sweep": (0, 0)}),
    ],
)
def test_any_session_can_be_shown(description, make_samples, shown, changes):
    picture = Scene(replace(description, **changes))
    drawings = [*picture.initial_drawings(), *picture.sample_drawings(make_samples(0))]
    for samples in blocks(make_samples(3000, angle_rad=np.nan, coupling_torque_nm=np.nan), 700):
        drawings += picture.sample_drawings(samples)
    for samples in blocks(make_samples(3000, first_tick=9000), 700):
        drawings += picture.sample_drawings(samples)
    assert shown([*drawings, *picture.final_drawings(), *picture.initial_drawings()])
