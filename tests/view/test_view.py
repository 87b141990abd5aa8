"""Units and signs of what is shown, and that the layout shows all of it."""

import subprocess
import sys

import numpy as np
import pytest

from rigd.session.format import SAMPLE_DTYPE
from rigd.view import PLOTS, TIMELINE, WINDOW_S, blueprint, columns


@pytest.fixture
def samples():
    samples = np.zeros(3, SAMPLE_DTYPE)
    samples["t_ns"] = [0, 1_000_000, 2_000_000]
    samples["angle_reference_rad"] = [0.025, 0.0, -0.001]
    samples["angle_rad"] = [0.024, 0.0, 0.001]
    samples["coupling_torque_nm"] = [0.5, -0.5, 0.0]
    samples["torque_command_nm"] = [1.5, 0.0, -1.5]
    samples["lateness_ns"] = [40_000, 0, 1_000_000]
    return samples


def test_columns_have_the_unit_their_name_ends_in(samples):
    shown = columns(samples)
    assert shown.keys() == {plot.entity for plot in PLOTS}
    assert shown["/angle_mrad"] == pytest.approx(np.array([[25.0, 24.0], [0.0, 0.0], [-1.0, 1.0]]))
    assert shown["/tracking_error_mrad"][:, 0] == pytest.approx([1.0, 0.0, -2.0])
    assert shown["/coupling_torque_nm"][:, 0] == pytest.approx([0.5, -0.5, 0.0])
    assert shown["/torque_command_nm"][:, 0] == pytest.approx([1.5, 0.0, -1.5])
    assert shown["/loop_lateness_us"][:, 0] == pytest.approx([40.0, 0.0, 1000.0])


def test_titles_and_legends_state_the_unit_of_the_column():
    units = {"mrad": "(mrad)", "nm": "(N·m)", "us": "(µs)"}
    for plot in PLOTS:
        unit = units[plot.entity.rsplit("_", 1)[1]]
        assert plot.title.endswith(unit)
        assert all(curve.label.endswith(unit) for curve in plot.curves)


def test_colours_differ_and_stand_out_from_dark_and_light():
    colors = [curve.color for plot in PLOTS for curve in plot.curves]
    assert len(set(colors)) == len(colors)

    def luminance(color) -> float:  # relative, WCAG 2
        value = np.array(color) / 255.0
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    for color in colors:
        assert (luminance(color) + 0.05) / 0.05 > 2.0
        assert 1.05 / (luminance(color) + 0.05) > 2.0


@pytest.fixture
def views():
    """Return the views of the layout, made with errors that Rerun otherwise only logs."""
    import rerun as rr

    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        return leaves(blueprint().root_container)
    finally:
        rr.set_strict_mode(before)


def leaves(part):
    children = getattr(part, "contents", None)
    if isinstance(children, list | tuple):
        return [leaf for child in children for leaf in leaves(child)]
    return [part]


def component(batches, name: str) -> list:
    (batch,) = [b for b in batches if b.component_descriptor().component.endswith(f":{name}")]
    return batch.as_arrow_array().to_pylist()


def test_each_plot_has_one_view_with_all_its_curves(views):
    from rerun.components import AggregationPolicy

    by_origin = {view.origin: view for view in views}
    assert len(views) == len(PLOTS)
    assert by_origin.keys() == {plot.entity for plot in PLOTS}
    for plot in PLOTS:
        view = by_origin[plot.entity]
        assert view.name == plot.title
        assert view.visualizer_overrides.keys() == {plot.entity}
        lines = view.visualizer_overrides[plot.entity]
        batches = lines.as_component_batches()
        assert component(batches, "names") == [curve.label for curve in plot.curves]
        assert component(batches, "aggregation_policy") == [AggregationPolicy.MinMax.value]
        packed = [int.from_bytes(bytes((*curve.color, 255)), "big") for curve in plot.curves]
        assert component(batches, "colors") == packed


def test_views_are_imported_without_the_viewer():
    code = "import sys, rigd.view; sys.exit('rerun' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_views_show_a_window_up_to_the_cursor(views):
    for view in views:
        (window,) = component(view.properties["VisibleTimeRanges"].as_component_batches(), "ranges")
        assert window["timeline"] == TIMELINE
        assert str(-round(WINDOW_S * 1e9)) in str(window["range"])
