"""A tone's colour is at its time and frequency, and means the level of the colour bar."""

import numpy as np
import pytest

from rigd.spectral import RunningSpectrogram
from rigd.view.frequency_charts import (
    HIGHEST_DB,
    LOWEST_DB,
    MAX_SPECTROGRAM_COLUMNS,
    SPECTROGRAM_ENTITY,
    SpectrogramChart,
)

STEP_S = 0.5


def pixels(shown) -> np.ndarray:
    form = shown.last("DepthImage:format")
    buffer = shown.last("DepthImage:buffer")
    return np.array(buffer, np.uint8).reshape(form["height"], form["width"])


def corner_and_size(shown) -> tuple[np.ndarray, np.ndarray]:
    """Top left corner and size of a pixel, on the canvas."""
    corner, size = (shown.last(f"Transform3D:{name}") for name in ("translation", "scale"))
    return np.array(corner[:2]), np.array(size[:2])


@pytest.fixture
def tone(description, shown):
    """A tone of 0.1 N·m at 25 Hz from 20 to 30 s, as it is drawn at 40 s."""
    spectrogram = RunningSpectrogram(1000.0, step_s=STEP_S)
    chart = SpectrogramChart(description, spectrogram.frequency_hz, STEP_S)
    t_s = np.arange(40_000) / 1000.0
    torque_nm = 1e-3 + 0.1 * np.sin(2 * np.pi * 25.0 * t_s) * ((t_s >= 20.0) & (t_s < 30.0))
    chart.update(40_000_000_000, spectrogram.feed(np.arange(40_000), torque_nm))
    return chart.chart, shown([chart.draw_frame, chart.draw])


def test_tone_has_its_frequency_time_and_level(tone):
    chart, found = tone
    image = pixels(found[f"{SPECTROGRAM_ENTITY}/levels"])
    corner, size = corner_and_size(found[f"{SPECTROGRAM_ENTITY}/levels"])
    rows, columns = np.nonzero(image > 128)
    at = corner + size * np.column_stack([columns + 0.5, rows + 0.5])
    assert at[:, 1] == pytest.approx(chart.to_canvas(0.0, 25.0)[1], abs=45.0)
    loudest_row = int(image.max(axis=1).argmax())
    assert corner[1] + size[1] * (loudest_row + 0.5) == pytest.approx(
        chart.to_canvas(0.0, 25.0)[1], abs=size[1]
    )
    assert at[:, 0].min() == pytest.approx(chart.to_canvas(20.0, 0.0)[0], abs=1.1 * size[0])
    assert at[:, 0].max() == pytest.approx(chart.to_canvas(30.0, 0.0)[0], abs=1.1 * size[0])
    level_db = LOWEST_DB + (HIGHEST_DB - LOWEST_DB) * image.max() / 255.0
    assert level_db == pytest.approx(-20.0, abs=0.6)  # of an amplitude of 0.1 N·m
    # The image ends where the session is, and inside the frame.
    left, top, _, bottom = chart.frame_edges
    assert corner == pytest.approx([left, top])
    assert corner[1] + size[1] * image.shape[0] < bottom
    assert corner[0] + size[0] * image.shape[1] == pytest.approx(
        chart.to_canvas(39.5, 0.0)[0], abs=5.0
    )


def test_the_bar_has_the_colours_of_the_levels(tone):
    _, found = tone
    levels, bar = found[f"{SPECTROGRAM_ENTITY}/levels"], found[f"{SPECTROGRAM_ENTITY}/colors"]
    for name in ("colormap", "depth_range"):
        assert levels.last(f"DepthImage:{name}") == bar.last(f"DepthImage:{name}")
    assert pixels(bar)[:, 0].tolist() == list(range(255, -1, -1))
    _, size = corner_and_size(bar)
    (labels,) = found[f"{SPECTROGRAM_ENTITY}/bar/labels"].values["Points2D:labels"]
    (points,) = found[f"{SPECTROGRAM_ENTITY}/bar/labels"].values["Points2D:positions"]
    heights = {text: y for text, (_, y) in zip(labels, points, strict=True)}
    assert heights["−80"] - heights["0"] == pytest.approx(256 * size[1])
    assert "dB re 1 N·m" in labels


def test_a_long_session_has_no_larger_image(description):
    from dataclasses import replace

    spectrogram = RunningSpectrogram(1000.0, step_s=STEP_S)
    hour = replace(description, scheduled_ticks=3_600_000)
    chart = SpectrogramChart(hour, spectrogram.frequency_hz, STEP_S)
    levels = np.full(spectrogram.frequency_hz.size, -40.0)
    chart.update(0, [(t_s, levels) for t_s in np.arange(0.5, 3600.0, STEP_S)])
    assert chart.image.shape[1] == MAX_SPECTROGRAM_COLUMNS
    assert np.all(chart.image == chart.image[0, 0])
