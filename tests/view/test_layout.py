"""The layout shows all drawings, each at its entity."""

from dataclasses import replace

import pytest

from rigd.view import Scene, plots
from rigd.view.banner import GAUGES_CANVAS_SIZE as VALUES_SIZE
from rigd.view.banner import GAUGES_ENTITY
from rigd.view.frequency_charts import CHART_SIZES
from rigd.view.plots import TIMELINE

pytestmark = pytest.mark.process


def leaves(part):
    children = getattr(part, "contents", None)
    # Those of a view are entities.
    if isinstance(children, list | tuple) and not isinstance(children[0], str):
        return [leaf for child in children for leaf in leaves(child)]
    return [part]


def component(batches, name: str) -> list:
    (batch,) = [b for b in batches if b.component_descriptor().component.endswith(f":{name}")]
    return batch.as_arrow_array().to_pylist()


@pytest.fixture
def tabs(layout_of):
    return {tab.name: leaves(tab) for tab in layout_of().contents}


@pytest.fixture
def time_series(tabs):
    """Views of plots over time, with the visualizer of their curves."""
    return [
        (view, view.visualizer_overrides[view.origin])
        for views in tabs.values()
        for view in views
        if view.class_identifier == "TimeSeries"
    ]


def test_tabs_are_in_order_with_the_overview_in_front(tabs, layout_of):
    assert list(tabs) == [
        "Overview", "Signals", "Frequency response", "Spectrogram", "Health", "Events",
    ]  # fmt: skip
    assert layout_of().active_tab == 0


def test_every_plot_has_a_view_with_all_its_curves(time_series):
    from rerun.components import AggregationPolicy

    sources = {source.entity: source for source in (plots.SIGNALS, plots.READINGS, plots.HEALTH)}
    seen = set()
    for view, visualizer in time_series:
        source = sources[view.origin]
        assert {*view.visualizer_overrides} <= {source.entity, source.tick_entity}
        assert view.contents == list(view.visualizer_overrides)
        (mapping,) = visualizer.mappings
        (plot,) = [p for p in source.plots if p.component == mapping.source_component]
        seen.add(plot)
        assert view.name == plot.title
        batches = visualizer.overrides
        assert component(batches, "names") == [curve.label for curve in plot.curves]
        assert component(batches, "aggregation_policy") == [AggregationPolicy.MinMax.value]
        packed = [int.from_bytes(bytes((*curve.color, 255)), "big") for curve in plot.curves]
        assert component(batches, "colors") == packed
        legend = view.properties["PlotLegend"].as_component_batches()
        assert component(legend, "visible") == [len(plot.curves) > 1]
    assert seen == {plot for source in sources.values() for plot in source.plots}


def test_tick_values_are_sent_but_invisible(time_series, description, shown):
    seen = []
    for view, lines in time_series:
        for entity in {*view.visualizer_overrides} - {view.origin}:
            ticks = view.visualizer_overrides[entity]
            assert component(ticks.overrides, "marker_sizes") == [0.0]
            # The legend has one entry for equal names.
            for name in ("names", "colors"):
                assert component(ticks.overrides, name) == component(lines.overrides, name)[:1]
            (mapping,) = ticks.mappings
            seen.append((entity, mapping.source_component))
    # A view reports entities that it never got.
    sent = {
        (entity, name)
        for entity, found in shown(Scene(description).initial_drawings()).items()
        for name in found.values
        if entity.endswith("/ticks")
    }
    assert set(seen) == sent
    assert len(sent) == len(seen)


def test_plots_show_a_window_up_to_the_cursor(time_series):
    windows_s = set()
    for view, _ in time_series:
        (window,) = component(view.properties["VisibleTimeRanges"].as_component_batches(), "ranges")
        assert window["timeline"] == TIMELINE
        axis = view.properties["TimeAxis"].as_component_batches()
        assert component(axis, "view_range") == [window["range"]]
        windows_s |= {s for s in (2, 10, 60) if str(-round(s * 1e9)) in str(window["range"])}
    assert windows_s == {2, 10, 60}


def test_plots_without_data_are_left_out(description, layout_of):
    absent = plots.BUS_PLOT_COMPONENTS | plots.REAL_TIME_PLOT_COMPONENTS
    health = {
        view.name
        for tab in layout_of(replace(description, absent_components=absent)).contents
        if tab.name == "Health"
        for view in leaves(tab)
    }
    left = (plots.FAULTY_TICKS, plots.BACKLOG, plots.DISK)
    assert health == {plot.title for plot in left} | {"Health"}


def test_charts_fill_their_views(tabs):
    charts = {
        view.origin: view
        for views in tabs.values()
        for view in views
        if view.class_identifier == "2D"
    }
    sizes = {**CHART_SIZES, GAUGES_ENTITY: VALUES_SIZE}
    assert charts.keys() == {*sizes, "/spectrogram"}
    for entity, (width, height) in sizes.items():
        bounds = charts[entity].properties["VisualBounds2D"].as_component_batches()
        assert component(bounds, "range") == [{"x_range": [0.0, width], "y_range": [0.0, height]}]
