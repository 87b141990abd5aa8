"""Figure of the measured and fitted frequency responses, one panel per type, as in Figure 6."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.models import ESTIMATOR_NAMES, estimator_text
from analysis.report import _style as style
from rigd.spectral import magnitude_db, phase_deg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

    from analysis.paper.welch_analysis import FittedModel, WelchAnalysis

_CURVE_DECIMATION_COLUMNS: Final = 500
"""Number of columns into which the curves of a panel are decimated."""
_LEGEND_COLUMNS: Final = 4
"""Number of columns of the legend."""
_LINE_STYLE_BY_WEIGHTING: Final[dict[str, dict[str, Any]]] = {
    "const": {"color": style.BLUE, "linestyle": "-"},
    "omega": {"color": style.VERMILION, "linestyle": (0, (4, 2))},
}
"""Colour and dash of the models with the paper's two weightings, as in the paper."""
_FURTHER_LINE_STYLES: Final[tuple[dict[str, Any], ...]] = (
    {"color": style.GREEN, "linestyle": (0, (1, 1.2))},
    {"color": style.PURPLE, "linestyle": (0, (5, 1.5, 1, 1.5))},
    {"color": style.ORANGE, "linestyle": "-"},
)
"""Colours and dashes of models with weightings other than the paper's two."""


def frf_figure(analysis: WelchAnalysis) -> Figure:
    """Draw the measured frequency response, the responses of all models, and the coherence."""
    settings = analysis.settings
    type_names = settings.types
    panel_columns = min(len(type_names), 4 if len(type_names) > 6 else 3)
    panel_rows = -(-len(type_names) // panel_columns)
    legend_row_count = -(-(len(settings.weightings) + 2) // _LEGEND_COLUMNS)
    width_in = max(3.2 * panel_columns, 8.0)
    header_height_in = 1.0 + 0.2 * legend_row_count
    height_in = 2.9 * panel_rows + 1.0 + header_height_in
    figure = style.new_figure(
        width_in, height_in, "Frequency response by Welch's method",
        f"coupling torque over motor angle  ·  {_response_estimate_text(analysis)}  ·  "
        "MSE, WMSE in (N·m/rad)²",
    )  # fmt: skip
    grid = figure.add_gridspec(
        panel_rows + 1, panel_columns, left=0.62 / width_in, right=1 - 0.2 / width_in,
        top=1 - header_height_in / height_in, bottom=0.5 / height_in, wspace=0.12, hspace=0.26,
        height_ratios=(*(1.0,) * panel_rows, 0.22),
    )  # fmt: skip
    style_by_weighting = line_styles(settings.weightings)
    # The scores need room above the highest peak.
    limits_db = style.db_limits(
        [analysis.response.response], [model.response for model in analysis.models],
        headroom_db=5.0 * len(settings.weightings),
    )  # fmt: skip
    line_by_label: dict[str, Line2D] = {}
    panel_axes = style.type_panels(figure, grid, type_names, settings.band_hz, limits_db)
    for type_name, magnitude_axes, phase_axes in panel_axes:
        type_models = [m for m in analysis.models if m.fit.structure.name == type_name]
        line_by_label |= _draw_type_panel(
            analysis, type_models, magnitude_axes, phase_axes, style_by_weighting
        )
        _write_fit_errors(magnitude_axes, type_models, style_by_weighting)
    coherence_axes = figure.add_subplot(grid[panel_rows, :])
    _draw_coherence(coherence_axes, analysis)
    panel_columns = min(len(line_by_label), _LEGEND_COLUMNS)
    style.add_legend(
        figure, list(line_by_label.values()), list(line_by_label), column_count=panel_columns
    )
    return figure


def line_styles(weightings: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return colour and dash of the fitted models' lines, by the weighting of the fit.

    The paper's two weightings have the styles of the paper.
    """
    further_line_styles = cycle(_FURTHER_LINE_STYLES)
    return {
        weighting_name: _LINE_STYLE_BY_WEIGHTING.get(weighting_name) or next(further_line_styles)
        for weighting_name in weightings
    }


def _response_estimate_text(analysis: WelchAnalysis) -> str:
    """Return a description of the response estimate: method, segments, band and bins."""
    settings, response = analysis.settings, analysis.response
    band_text = (
        f"{settings.band_hz[0]:g} to {settings.band_hz[1]:g} Hz, {len(response.response)} bins"
    )
    method_text = estimator_text(settings.estimator, analysis.segmentation, response.segments)
    return f"{method_text}  ·  {band_text}"


def _draw_type_panel(
    analysis: WelchAnalysis,
    models: list[FittedModel],
    magnitude_axes: Axes,
    phase_axes: Axes,
    style_by_weighting: dict[str, dict[str, Any]],
) -> dict[str, Line2D]:
    """Draw measured and fitted responses of one damping type; return the lines by label."""
    line_by_label = {}
    type_curves: list[tuple[str, NDArray[np.float64], NDArray[np.complex128], dict[str, Any]]] = []
    if analysis.settings.estimator != "fft":
        whole_record = analysis.whole_record
        type_curves.append(
            (
                f"measured, {ESTIMATOR_NAMES['fft']}", whole_record.frequency_hz,
                whole_record.response, {"color": style.LIGHT_GREY, "linewidth": 0.6},
            )
        )  # fmt: skip
    measured_frf = analysis.response
    type_curves.append(
        (
            f"measured, {ESTIMATOR_NAMES[analysis.settings.estimator]}", measured_frf.frequency_hz,
            measured_frf.response, {"color": style.GREY, "linewidth": 1.3},
        )
    )  # fmt: skip
    type_curves.extend(
        (
            f"model, weights {model.fit.weighting}", measured_frf.frequency_hz, model.response,
            {**style_by_weighting[model.fit.weighting], "linewidth": 1.2},
        )
        for model in models
    )  # fmt: skip
    for curve_label, frequency_hz, response, line_style in type_curves:
        is_drawable = np.isfinite(response) & (response != 0)
        line_hz, plotted_values = frequency_hz[is_drawable], response[is_drawable]
        (line_by_label[curve_label],) = magnitude_axes.plot(
            *style.envelope(
                line_hz, magnitude_db(plotted_values), _CURVE_DECIMATION_COLUMNS, logarithmic=True
            ),
            **line_style,
        )
        if curve_label.startswith("measured"):
            # Dots, because a line would jump wherever noise wraps the phase.
            point_indices = style.log_spaced_indices(line_hz, _CURVE_DECIMATION_COLUMNS)
            style.draw_dots(
                phase_axes,
                line_hz[point_indices],
                phase_deg(plotted_values[point_indices]),
                size_pt=1.8,
                color=line_style["color"],
            )
        else:
            phase_axes.plot(
                *style.envelope(
                    line_hz, phase_deg(plotted_values), _CURVE_DECIMATION_COLUMNS, logarithmic=True
                ),
                **line_style,
            )
    for resonance_peak in analysis.peaks:
        if resonance_peak is not None:
            for panel_axes in (magnitude_axes, phase_axes):
                panel_axes.axvline(
                    resonance_peak.frequency_hz, color="#B8B8B8", linewidth=0.6, zorder=0.5
                )
    return line_by_label


def _write_fit_errors(
    panel_axes: Axes, models: list[FittedModel], style_by_weighting: dict[str, dict[str, Any]]
) -> None:
    """Write each model's errors (MSE, WMSE) into the panel, in the colour of the model's line."""
    for line_number, model in enumerate(models):
        panel_axes.annotate(
            f"MSE {model.indices.mse:.3g}  WMSE {model.indices.wmse:.3g}",
            (1.0, 1.0), xycoords="axes fraction", xytext=(-3, -3 - 9.5 * line_number),
            textcoords="offset points", ha="right", va="top", fontsize=7,
            color=style_by_weighting[model.fit.weighting]["color"],
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
        )  # fmt: skip


def _draw_coherence(axes: Axes, analysis: WelchAnalysis) -> None:
    """Draw the coherence of the measured response, or a note that there is none."""
    response = analysis.response
    axes.set_title("Coherence")
    style.set_frequency_axis(axes, analysis.settings.band_hz)
    axes.set_ylim(0.0, 1.05)
    axes.set_yticks((0.0, 0.5, 1.0))
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    if response.coherence is None:
        axes.text(
            0.5, 0.5, "none: at least two segments are required", transform=axes.transAxes,
            ha="center", va="center", color="#606060",
        )  # fmt: skip
        return
    axes.plot(
        *style.envelope(response.frequency_hz, response.coherence, 1200, logarithmic=True),
        color=style.GREY, linewidth=0.8,
    )  # fmt: skip
