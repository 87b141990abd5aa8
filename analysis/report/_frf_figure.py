"""Figure of the measured and fitted frequency responses, one panel per type, as in Figure 6."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.models import ESTIMATOR_NAMES, estimate_text
from analysis.report import _style as style
from rigd.view.frequency_charts import magnitude_db, phase_deg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

    from analysis.paper import FittedModel, WelchAnalysis

_CURVE_COLUMNS: Final = 500
"""Number of columns into which the curves of a panel are decimated."""
_LEGEND_COLUMNS: Final = 4
"""Number of columns of the legend."""
_LINES_BY_WEIGHTING: Final[dict[str, dict[str, Any]]] = {
    "const": {"color": style.BLUE, "linestyle": "-"},
    "omega": {"color": style.VERMILION, "linestyle": (0, (4, 2))},
}
"""Colour and dash of the models with the paper's two weightings, as in the paper."""
_FURTHER_LINES: Final[tuple[dict[str, Any], ...]] = (
    {"color": style.GREEN, "linestyle": (0, (1, 1.2))},
    {"color": style.PURPLE, "linestyle": (0, (5, 1.5, 1, 1.5))},
    {"color": style.ORANGE, "linestyle": "-"},
)
"""Colours and dashes of the models with further weightings."""


def frf_figure(analysis: WelchAnalysis) -> Figure:
    """Draw the measured response, every fitted model's response, and the coherence."""
    settings = analysis.settings
    types = settings.types
    columns = min(len(types), 4 if len(types) > 6 else 3)
    rows = -(-len(types) // columns)
    legend_row_count = -(-(len(settings.weightings) + 2) // _LEGEND_COLUMNS)
    width_in = max(3.2 * columns, 8.0)
    header_height_in = 1.0 + 0.2 * legend_row_count
    height_in = 2.9 * rows + 1.0 + header_height_in
    figure = style.new_figure(
        width_in, height_in, "Frequency response by Welch's method",
        f"coupling torque over motor angle  ·  {_estimate_text(analysis)}  ·  "
        "MSE, WMSE in (N·m/rad)²",
    )  # fmt: skip
    grid = figure.add_gridspec(
        rows + 1, columns, left=0.62 / width_in, right=1 - 0.2 / width_in,
        top=1 - header_height_in / height_in, bottom=0.5 / height_in, wspace=0.12, hspace=0.26,
        height_ratios=(*(1.0,) * rows, 0.22),
    )  # fmt: skip
    lines = line_styles(settings.weightings)
    # The scores need room above the highest peak.
    limits_db = style.db_limits(
        [analysis.response.response], [model.response for model in analysis.models],
        headroom_db=5.0 * len(settings.weightings),
    )  # fmt: skip
    handles: dict[str, Line2D] = {}
    panels = style.type_panels(figure, grid, types, settings.band_hz, limits_db)
    for name, magnitude, phase in panels:
        models = [m for m in analysis.models if m.fit.structure.name == name]
        handles |= _draw_type_panel(analysis, models, magnitude, phase, lines)
        _write_scores(magnitude, models, lines)
    coherence_axes = figure.add_subplot(grid[rows, :])
    _draw_coherence(coherence_axes, analysis)
    columns = min(len(handles), _LEGEND_COLUMNS)
    style.legend(figure, list(handles.values()), list(handles), columns=columns)
    return figure


def line_styles(weightings: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return colour and dash of the fitted models' lines, by the weighting of the fit.

    The paper's two weightings have the styles of the paper.
    """
    further_lines = cycle(_FURTHER_LINES)
    return {name: _LINES_BY_WEIGHTING.get(name) or next(further_lines) for name in weightings}


def _estimate_text(analysis: WelchAnalysis) -> str:
    """Return a description of the response estimate: method, segments, band and bins."""
    settings, response = analysis.settings, analysis.response
    band = f"{settings.band_hz[0]:g} to {settings.band_hz[1]:g} Hz, {len(response.response)} bins"
    how = estimate_text(settings.estimator, analysis.segmentation, response.segments)
    return f"{how}  ·  {band}"


def _draw_type_panel(
    analysis: WelchAnalysis,
    models: list[FittedModel],
    magnitude: Axes,
    phase: Axes,
    lines: dict[str, dict[str, Any]],
) -> dict[str, Line2D]:
    """Draw the measured and modelled curves of one type, and return their lines by label."""
    handles = {}
    curves: list[tuple[str, NDArray[np.float64], NDArray[np.complex128], dict[str, Any]]] = []
    if analysis.settings.estimator != "fft":
        whole_record = analysis.whole_record
        curves.append(
            (
                f"measured, {ESTIMATOR_NAMES['fft']}", whole_record.frequency_hz,
                whole_record.response, {"color": style.FAINT, "linewidth": 0.6},
            )
        )  # fmt: skip
    measured_frf = analysis.response
    curves.append(
        (
            f"measured, {ESTIMATOR_NAMES[analysis.settings.estimator]}", measured_frf.frequency_hz,
            measured_frf.response, {"color": style.GREY, "linewidth": 1.3},
        )
    )  # fmt: skip
    curves.extend(
        (
            f"model, weights {model.fit.weighting}", measured_frf.frequency_hz, model.response,
            {**lines[model.fit.weighting], "linewidth": 1.2},
        )
        for model in models
    )  # fmt: skip
    for label, frequency_hz, response, line_style in curves:
        is_drawable = np.isfinite(response) & (response != 0)
        at_hz, values = frequency_hz[is_drawable], response[is_drawable]
        (handles[label],) = magnitude.plot(
            *style.envelope(at_hz, magnitude_db(values), _CURVE_COLUMNS, logarithmic=True),
            **line_style,
        )
        if label.startswith("measured"):
            # Dots, because a line would jump wherever noise wraps the phase.
            point_indices = style.log_spaced_indices(at_hz, 2 * _CURVE_COLUMNS)
            style.dots(
                phase,
                at_hz[point_indices],
                phase_deg(values[point_indices]),
                size_pt=1.8,
                color=line_style["color"],
            )
        else:
            phase.plot(
                *style.envelope(at_hz, phase_deg(values), _CURVE_COLUMNS, logarithmic=True),
                **line_style,
            )
    for peak in analysis.peaks:
        if peak is not None:
            for axes in (magnitude, phase):
                axes.axvline(peak.frequency_hz, color="#B8B8B8", linewidth=0.6, zorder=0.5)
    return handles


def _write_scores(axes: Axes, models: list[FittedModel], lines: dict[str, dict[str, Any]]) -> None:
    """Write MSE and WMSE of each model into the panel, in the colour of its line."""
    for number, model in enumerate(models):
        axes.annotate(
            f"MSE {model.indices.mse:.3g}  WMSE {model.indices.wmse:.3g}",
            (1.0, 1.0), xycoords="axes fraction", xytext=(-3, -3 - 9.5 * number),
            textcoords="offset points", ha="right", va="top", fontsize=7,
            color=lines[model.fit.weighting]["color"],
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
        )  # fmt: skip


def _draw_coherence(axes: Axes, analysis: WelchAnalysis) -> None:
    """Draw the coherence of the measured response, or a note that there is none."""
    response = analysis.response
    axes.set_title("Coherence")
    style.frequency_axis(axes, analysis.settings.band_hz)
    axes.set_ylim(0.0, 1.05)
    axes.set_yticks((0.0, 0.5, 1.0))
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    if response.coherence is None:
        axes.text(
            0.5, 0.5, "none: it takes at least two segments", transform=axes.transAxes,
            ha="center", va="center", color="#606060",
        )  # fmt: skip
        return
    axes.plot(
        *style.envelope(response.frequency_hz, response.coherence, 1200, logarithmic=True),
        color=style.GREY, linewidth=0.8,
    )  # fmt: skip
