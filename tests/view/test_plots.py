"""Units and signs of plots over time, and their statement in titles and legends."""

import re
import subprocess
import sys

import numpy as np
import pytest

from rigd.view import Health, Scene
from rigd.view.plots import HEALTH, READINGS, SIGNALS, send_columns

SOURCES = (SIGNALS, READINGS, HEALTH)
PLOTS = [plot for source in SOURCES for plot in source.plots]

UNITS = {"mrad": "mrad", "nm": "N·m", "n": "N", "us": "µs", "ms": "ms", "gb": "GB", "percent": "%"}


def test_signals_have_the_unit_their_name_ends_in(make_samples):
    samples = make_samples(
        3,
        angle_reference_rad=[0.025, 0.0, -0.001],
        angle_rad=[0.024, 0.0, 0.001],
        coupling_torque_nm=[0.5, -0.5, 0.0],
        torque_command_nm=[1.5, 0.0, -1.5],
        fx_n=1.0, fy_n=2.0, fz_n=3.0, tx_nm=0.1, ty_nm=0.2, tz_nm=0.3,
        lateness_ns=[40_000, 0, 1_000_000],
        work_ns=200_000,
    )  # fmt: skip
    shown = SIGNALS.values_by_component(samples)
    assert shown["angle_mrad"] == pytest.approx(np.array([[25.0, 24.0], [0.0, 0.0], [-1.0, 1.0]]))
    assert shown["tracking_error_mrad"][:, 0] == pytest.approx([1.0, 0.0, -2.0])
    assert shown["coupling_torque_nm"][:, 0] == pytest.approx([0.5, -0.5, 0.0])
    assert shown["torque_command_nm"][:, 0] == pytest.approx([1.5, 0.0, -1.5])
    assert shown["forces_n"] == pytest.approx(np.array([[1.0, 2.0, 3.0]] * 3))
    assert shown["torques_nm"] == pytest.approx(np.array([[0.1, 0.2, 0.3]] * 3))
    assert shown["loop_us"] == pytest.approx(
        np.array([[40.0, 200.0], [0.0, 200.0], [1000.0, 200.0]])
    )
    assert len(shown) == 7


def test_ages_have_the_unit_their_name_ends_in(make_timings):
    shown = READINGS.values_by_component(make_timings(2, angle_age_s=1e-3, wrench_age_s=2.5e-4))
    assert shown["ages_ms"] == pytest.approx(np.array([[1.0, 0.25]] * 2))


@pytest.fixture
def health_values(description, shown):
    """Return the data of a reading for the plots of the health, by component."""

    def values(health):
        found = shown(Scene(description).health_drawings(5, health))["/health"]
        assert set(map(tuple, found.times_ns.values())) == {(5,)}
        return {name: column[0] for name, column in found.values.items()}

    return values


@pytest.mark.process
def test_health_has_the_unit_its_name_ends_in(health_values):
    health = Health(
        missed_ticks=3, late_ticks=7, lost_ticks=0, recorder_lag_ticks=80, disk_free_mb=51_234.0,
        view_dropped=1500, bus_load_percent=31.5, bus_errors=2, sensor_status=0x41, rate_hz=999.9,
    )  # fmt: skip
    assert health_values(health) == {
        "faulty_ticks": [3.0, 7.0, 0.0],
        "backlog_samples": [80.0, 1500.0],
        "bus_load_percent": [31.5],
        "bus_errors": [2.0],
        "sensor_status": [65.0],
        "disk_free_gb": [51.234],
    }


@pytest.mark.process
def test_unknown_values_are_not_drawn(health_values):
    shown = health_values(Health(missed_ticks=0))
    assert shown["faulty_ticks"] == pytest.approx([0.0, np.nan, np.nan], nan_ok=True)
    assert np.isnan(shown["bus_load_percent"]).all()


@pytest.mark.parametrize("plot", PLOTS, ids=lambda plot: plot.component)
def test_titles_and_legends_state_the_unit(plot):
    units = [
        re.search(r"\((.*)\)$", text)[1] for text in (plot.title, *(c.label for c in plot.curves))
    ]
    unit = UNITS.get(plot.component.rsplit("_", 1)[1])
    if unit is not None:
        assert set(units) == {unit}
    else:  # counts and words
        assert all(units)


@pytest.mark.parametrize("plot", PLOTS, ids=lambda plot: plot.component)
def test_colours_differ_and_contrast_with_the_background(plot):
    def luminance(color) -> float:  # relative, WCAG 2
        value = np.array(color) / 255.0
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    colors = [curve.color for curve in plot.curves]
    assert len(set(colors)) == len(colors)
    for color in colors:
        assert (luminance(color) + 0.05) / 0.05 > 2.0
        assert 1.05 / (luminance(color) + 0.05) > 2.0


def test_rerun_gets_the_columns_at_the_time_of_the_session(shown, make_samples):
    samples = make_samples(50, first_tick=100, angle_rad=np.linspace(-1e-3, 1e-3, 50))
    expected = SIGNALS.values_by_component(samples)
    found = shown([lambda stream: send_columns(stream, "/signals", samples["t_ns"], expected)])
    signals = found["/signals"]
    assert signals.batches == 1
    assert signals.times_ns["angle_mrad"] == samples["t_ns"].tolist()
    assert np.array(signals.values["angle_mrad"]) == pytest.approx(expected["angle_mrad"])
    assert signals.kinds["angle_mrad"] == "rerun.components.Scalar"


@pytest.mark.process
def test_views_are_imported_without_the_viewer():
    code = "import sys; from rigd.view import Scene; sys.exit('rerun' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
