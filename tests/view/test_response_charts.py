"""Charts of the frequency response: units, delays, the model, unknown values."""

from dataclasses import replace

import numpy as np
import pytest

from rigd.beam import transfer
from rigd.spectral import FrequencyResponse, RunningEstimate, magnitude_db, phase_deg
from rigd.sweep_response import HIGHEST_SHOWN_HZ, LOWEST_SHOWN_HZ
from rigd.view.frequency_charts import (
    COHERENCE_ENTITY,
    MAGNITUDE_ENTITY,
    OVERVIEW_MAGNITUDE_ENTITY,
    PHASE_ENTITY,
    ResponseCharts,
)
from rigd.view.plots import GREY

GRID = np.arange(9601) / 160.0


def estimate(description, *, excited_up_to_hz=20.0, delays_s=(0.0, 0.0)) -> RunningEstimate:
    """Estimate that is the model as channels of such ages (angle, torque) show it."""
    s = 2j * np.pi * GRID
    exact = (
        transfer(s, description.beam, description.damping) + description.tool_inertia_kg_m2 * s * s
    )
    late = np.exp(-s * (delays_s[1] - delays_s[0]))
    response = FrequencyResponse(GRID, exact * late, np.full(GRID.shape, 0.9), 3, "h1")
    below, above = np.searchsorted(GRID, [0.1, excited_up_to_hz], side="right")
    excited = np.zeros(GRID.shape, bool)
    excited[below:above] = True
    return RunningEstimate(response, excited, is_final=False)


def strips(shown) -> list[np.ndarray]:
    return [np.array(strip) for strip in shown.values["LineStrips2D:strips"][-1]]


def values(charts: ResponseCharts, entity: str, strip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn a strip on the canvas back to frequency in Hz and value, by the chart's tick labels."""
    chart = charts.chart(entity)
    ticks = [(float(t.replace("−", "-")), x, y) for t, x, y in chart.tick_labels()]
    count = len(chart.x.ticks)
    (f0, x0, _), (f1, x1, _) = ticks[0], ticks[count - 1]
    (v0, _, y0), (v1, _, y1) = ticks[count], ticks[-1]
    frequency_hz = f0 * (f1 / f0) ** ((strip[:, 0] - x0) / (x1 - x0))
    return frequency_hz, v0 + (v1 - v0) * (strip[:, 1] - y0) / (y1 - y0)


@pytest.mark.parametrize("delays_s", [(0.0, 0.0), (1e-3, 0.2e-3), (0.0, 1.5e-3)])
@pytest.mark.parametrize("tool_inertia_kg_m2", [0.0, 1e-5])
def test_measured_response_lies_on_its_model(description, shown, delays_s, tool_inertia_kg_m2):
    description = replace(
        description,
        tool_inertia_kg_m2=tool_inertia_kg_m2,
        angle_delay_s=delays_s[0],
        torque_delay_s=delays_s[1],
    )
    charts = ResponseCharts(description)
    charts.update(20_000_000_000, estimate(description, delays_s=delays_s))
    found = shown([charts.draw_frames, charts.draw])
    for entity, of in (
        (MAGNITUDE_ENTITY, magnitude_db),
        (OVERVIEW_MAGNITUDE_ENTITY, magnitude_db),
        (PHASE_ENTITY, phase_deg),
    ):
        for name, last_hz in (("measured", 20.0), ("model", HIGHEST_SHOWN_HZ)):
            (strip,) = strips(found[f"{entity}/{name}"])
            frequency_hz, seen = values(charts, entity, strip)
            assert frequency_hz[0] == pytest.approx(LOWEST_SHOWN_HZ, rel=1e-3)
            assert frequency_hz[-1] == pytest.approx(last_hz, rel=5e-3)
            s = 2j * np.pi * frequency_hz
            exact = transfer(s, description.beam, description.damping) + tool_inertia_kg_m2 * s * s
            axis = charts.chart(entity).y
            expected = np.clip(of(exact), axis.start_value, axis.end_value)
            # Read off a canvas, at a frequency read off a canvas: where it is steep, not so well.
            assert np.median(abs(seen - expected)) < 1e-3 * (axis.end_value - axis.start_value)
            assert np.mean(abs(seen - expected) < 5e-3 * (axis.end_value - axis.start_value)) > 0.97
    (strip,) = strips(found[f"{COHERENCE_ENTITY}/measured"])
    assert values(charts, COHERENCE_ENTITY, strip)[1] == pytest.approx(
        np.full(len(strip), 0.9), abs=1e-5
    )


def test_peaks_of_the_model_are_drawn_at_their_height(description, shown):
    charts = ResponseCharts(description)
    (strip,) = strips(shown([charts.draw_frames])[f"{MAGNITUDE_ENTITY}/model"])
    frequency_hz, seen = values(charts, MAGNITUDE_ENTITY, strip)
    fine_hz = np.arange(0.5, 60.0, 1e-3)
    exact_db = magnitude_db(transfer(2j * np.pi * fine_hz, description.beam, description.damping))
    assert len(strip) <= 400
    for first_hz, last_hz in ((2.0, 4.0), (14.0, 18.0), (40.0, 50.0)):
        near = (frequency_hz > first_hz) & (frequency_hz < last_hz)
        peak_db = exact_db[(fine_hz > first_hz) & (fine_hz < last_hz)].max()
        assert seen[near].max() == pytest.approx(peak_db, abs=0.2)
    axis = charts.chart(MAGNITUDE_ENTITY).y
    assert axis.start_value <= exact_db.min()
    assert axis.end_value > exact_db.max()


def test_band_not_yet_excited_is_shaded_and_empty(description, shown):
    charts = ResponseCharts(description)
    before = shown([charts.draw_frames, charts.draw])
    assert strips(before[f"{MAGNITUDE_ENTITY}/measured"]) == []
    charts.update(20_000_000_000, estimate(description, excited_up_to_hz=20.0))
    after = shown([charts.draw])
    chart = charts.chart(MAGNITUDE_ENTITY)
    left, _, right, _ = chart.frame_edges
    at_20_hz = chart.to_canvas(20.0, chart.y.start_value)[0]

    def shaded(found, name) -> tuple[float, float]:
        shade = found[f"{MAGNITUDE_ENTITY}/not_estimated_{name}"]
        x, _, _ = shade.last("Transform3D:translation")
        width, _, _ = shade.last("Transform3D:scale")
        return x, x + width

    assert shaded(before, "below") == pytest.approx((left, right))
    assert shaded(after, "above") == pytest.approx((at_20_hz, right), abs=1e-3)
    assert shaded(after, "below") == pytest.approx((left, left))
    (strip,) = strips(after[f"{MAGNITUDE_ENTITY}/measured"])
    assert strip[:, 0].max() == pytest.approx(at_20_hz, abs=0.5)
    times_ns = after[f"{MAGNITUDE_ENTITY}/measured"].times_ns["LineStrips2D:strips"]
    assert times_ns == [20_000_000_000]


def test_response_with_low_coherence_is_grey(description, shown):
    charts = ResponseCharts(description)
    known = estimate(description)
    coherence = np.where((GRID > 5.0) & (GRID < 8.0), 0.5, 0.9)
    charts.update(0, replace(known, response=replace(known.response, coherence=coherence)))
    found = shown([charts.draw])
    for entity in (MAGNITUDE_ENTITY, OVERVIEW_MAGNITUDE_ENTITY, PHASE_ENTITY):
        below, above = strips(found[f"{entity}/measured"])
        assert values(charts, entity, below)[0].max() == pytest.approx(5.0, rel=0.02)
        assert values(charts, entity, above)[0].min() == pytest.approx(8.0, rel=0.02)
        (grey,) = strips(found[f"{entity}/uncertain"])
        ends_hz = values(charts, entity, grey)[0][[0, -1]]
        assert ends_hz == pytest.approx((LOWEST_SHOWN_HZ, 20.0), rel=5e-3)
        assert found[f"{entity}/uncertain"].last("LineStrips2D:colors") == packed(GREY)
    (whole,) = strips(found[f"{COHERENCE_ENTITY}/measured"])
    assert values(charts, COHERENCE_ENTITY, whole)[1].min() == pytest.approx(0.5, abs=1e-3)


def test_last_response_is_drawn_beneath(description, shown):
    before = ResponseCharts(replace(description, name="before", specimen="A"))
    assert before.as_last_response(description) is None
    before.update(0, estimate(description))
    last = before.as_last_response(replace(description, name="before", specimen="A"))
    assert (last.session, last.specimen) == ("before", "A")
    charts = ResponseCharts(description, last)
    found = shown([charts.draw_frames])
    for entity in (MAGNITUDE_ENTITY, OVERVIEW_MAGNITUDE_ENTITY, PHASE_ENTITY):
        (strip,) = strips(found[f"{entity}/last"])
        (model,) = strips(found[f"{entity}/model"])
        assert values(charts, entity, strip)[0][-1] == pytest.approx(20.0, rel=5e-3)
        inside = model[:, 0] < strip[:, 0].max()
        assert np.median(abs(np.interp(model[inside, 0], *strip.T) - model[inside, 1])) < 1.0
        assert "last session" in [key.label for key in charts.chart(entity).legend]
    assert f"{COHERENCE_ENTITY}/last" not in found


def packed(color) -> int:
    return int.from_bytes(bytes((*color, 255)), "big")


def test_empty_coherence_chart_states_the_reason(description, shown):
    charts = ResponseCharts(description)

    def note() -> list[str]:
        return shown([charts.draw])[f"{COHERENCE_ENTITY}/note"].values["Points2D:labels"][-1]

    assert note() == ["Coherence begins with the second segment"]
    known = estimate(description)
    single = replace(known, response=replace(known.response, coherence=None))
    charts.update(1_000_000_000, single)
    assert note() == ["Coherence begins with the second segment"]
    charts.update(2_000_000_000, replace(single, is_final=True))
    assert note() == ["A single segment gives no coherence"]
    charts.update(3_000_000_000, known)
    assert note() == []


def test_no_curve_without_a_nominal_model(description, shown):
    charts = ResponseCharts(replace(description, damping=None))
    found = shown([charts.draw_frames])
    assert not [entity for entity in found if entity.endswith("/model")]
    (labels,) = found[f"{MAGNITUDE_ENTITY}/labels"].values["Points2D:labels"]
    assert "nominal model" not in labels
    assert "measured" in labels


def test_axes_state_their_units(description, shown):
    found = shown([ResponseCharts(description).draw_frames])
    titles = {
        MAGNITUDE_ENTITY: "Magnitude (dB re 1 N·m/rad)",
        OVERVIEW_MAGNITUDE_ENTITY: "dB re 1 N·m/rad",  # the title of its view states the quantity
        PHASE_ENTITY: "Phase (degrees)",
        COHERENCE_ENTITY: "Coherence (1)",
    }
    for entity, title in titles.items():
        (labels,) = found[f"{entity}/labels"].values["Points2D:labels"]
        assert title in labels
        assert "Frequency (Hz)" in labels
