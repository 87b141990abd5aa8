"""Figures of a campaign: indices of the models, pooled estimates, responses, validation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.campaigns import best_models, group_errors_by_model
from analysis.campaigns.labels import format_p_value, label_and_unit, symbol_with_unit
from analysis.campaigns.specimen_sentences import MIXTURE_MARK, pooled_title
from analysis.models import STRUCTURES
from analysis.report import _style as style
from analysis.report._frf_figure import line_styles
from analysis.report._paper_tables import welch_method_text
from analysis.report._pooled_tables import exact_condition_text, session_count_text
from analysis.report.table import NOT_REPORTED_MARK, unreported_parameters
from analysis.statistics import NORMAL_95
from rigd.spectral import magnitude_db, phase_deg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

    from analysis.campaigns import CampaignResult, NominalModel, SessionAnalysis
    from analysis.campaigns.pooling import PooledParameter

_FIT_INDEX_PANELS: Final = (
    ("mse", "(a) Mean square error", "MSE ((N·m/rad)²)"),
    ("wmse", "(b) Mean square error, weighted with 1/ω", "WMSE ((N·m/rad)²)"),
    ("md", "(c) Maximum deviation", "MD (N·m/rad)"),
)
"""Index, heading and axis label of each panel of the figure of indices."""
_MARKER_SIZE_PT: Final = 3.0
"""Size of the markers for means and outliers, in points."""


def fit_index_figure(campaign: CampaignResult) -> Figure:
    """Draw how far each session is from each nominal model: MSE, WMSE and MD (Eqs. 28-30)."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    type_names = list(dict.fromkeys(model.structure for model in campaign.nominal))
    weightings = list(dict.fromkeys(model.weighting for model in campaign.nominal))
    color_by_weighting = {
        weighting_name: line_style["color"]
        for weighting_name, line_style in line_styles(tuple(weightings)).items()
    }
    width_in, height_in = 13.0, 4.9
    figure = style.new_figure(
        width_in, height_in,
        f"{len(campaign.sessions)} sessions — distance from the nominal models",
        "boxes: quartiles over the sessions, whiskers to 1.5 times the interquartile range",
    )  # fmt: skip
    grid = figure.add_gridspec(
        1, 3, left=0.055, right=0.99, top=1 - 1.2 / height_in, bottom=0.45 / height_in, wspace=0.2
    )
    box_width = 0.72 / len(weightings)
    for panel_number, (index_name, panel_title, axis_label) in enumerate(_FIT_INDEX_PANELS):
        axes = figure.add_subplot(grid[panel_number])
        for model in campaign.nominal:
            box_offset = weightings.index(model.weighting) - (len(weightings) - 1) / 2
            box_position = type_names.index(model.structure) + box_offset * box_width
            index_values = np.array(
                [getattr(session_indices, index_name) for session_indices in model.indices]
            )
            box_color = color_by_weighting[model.weighting]
            axes.boxplot(
                [index_values], positions=[box_position], widths=0.8 * box_width, patch_artist=True,
                showmeans=True, manage_ticks=False,
                boxprops={"facecolor": "white", "edgecolor": box_color},
                whiskerprops={"color": box_color}, capprops={"color": box_color},
                medianprops={"color": "#C00000", "linewidth": 1.2},
                meanprops={
                    "marker": "o", "markerfacecolor": style.GREEN, "markeredgecolor": style.GREEN,
                    "markersize": _MARKER_SIZE_PT,
                },
                flierprops={
                    "marker": "x", "markeredgecolor": box_color, "markersize": _MARKER_SIZE_PT,
                },
            )  # fmt: skip
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xticks(range(len(type_names)), [f"Type {type_name}" for type_name in type_names])
        axes.grid(visible=False, axis="x")
        axes.set_title(panel_title)
        axes.set_ylabel(axis_label)
    weighting_handles = [
        Patch(facecolor="white", edgecolor=color_by_weighting[w], label=f"weights {w}")
        for w in weightings
    ]
    mark_handles = [
        Line2D([], [], color="#C00000", label="median"),
        Line2D([], [], color=style.GREEN, marker="o", linestyle="", markersize=4, label="mean"),
    ]
    style.add_legend(
        figure, [*weighting_handles, *mark_handles], column_count=len(weighting_handles) + 2
    )
    return figure


_PANELS_PER_ROW: Final = 4
"""Number of panels in a row of the pooled figure."""
INTERVAL_COLOR: Final = "#C3DCED"
"""Colour of a pooled value's interval: opaque light blue, like the line of the value."""


def pooled_parameters_figure(campaign: CampaignResult) -> Figure:
    """Draw the sessions' estimates of each parameter, with the pooled value in the background.

    All have 95 % intervals. The parameters are those of the reported pooled estimate.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    headline_estimate = campaign.freest
    assert headline_estimate is not None
    unsupported_orders = campaign.verdict.withheld_orders if campaign.verdict else ()
    unreported_names = unreported_parameters(
        STRUCTURES[headline_estimate.structure], unsupported_orders
    )
    subtitle_note = (
        f"  ·  {NOT_REPORTED_MARK} not reported: not supported by the data"
        if unreported_names
        else ""
    )
    if any(
        campaign.homogeneity.is_mixed(parameter.name) for parameter in headline_estimate.parameters
    ):
        subtitle_note += f"  ·  {MIXTURE_MARK} mean of a mixture"
    row_count = -(-len(headline_estimate.parameters) // _PANELS_PER_ROW)
    width_in, height_in = 13.0, 2.6 * row_count + 1.35
    figure = style.new_figure(
        width_in, height_in,
        pooled_title(
            f"{session_count_text(headline_estimate, campaign)} — pooled whole-record estimate, "
            f"type {headline_estimate.name}",
            campaign.homogeneity,
        ),
        f"freest type that the sessions support{exact_condition_text(campaign)}  ·  "
        f"residual {headline_estimate.misfit:.3g} times the noise  ·  p: p-value of Cochran's Q"
        f"{subtitle_note}",
    )  # fmt: skip
    grid = figure.add_gridspec(
        row_count, _PANELS_PER_ROW, left=0.06, right=0.99, top=1 - 1.2 / height_in,
        bottom=0.5 / height_in, wspace=0.42, hspace=0.4,
    )  # fmt: skip
    for panel_number, parameter in enumerate(headline_estimate.parameters):
        panel_axes = figure.add_subplot(
            grid[panel_number // _PANELS_PER_ROW, panel_number % _PANELS_PER_ROW]
        )
        _draw_parameter_panel(
            campaign,
            headline_estimate.name,
            parameter,
            panel_axes,
            is_reported=parameter.name not in unreported_names,
        )
        if panel_number + _PANELS_PER_ROW >= len(headline_estimate.parameters):
            panel_axes.set_xlabel("Session", labelpad=1)
    legend_handles = [
        Line2D([], [], color=style.INK, marker="o", markersize=3, linewidth=0.9,
               label="session, ± 1.96 of its standard deviation"),
        Line2D([], [], color=style.BLUE, label="pooled"),
        Patch(facecolor=INTERVAL_COLOR, label="its 95 % interval"),
        Patch(facecolor=style.SHADE_COLOR, label="95 % prediction interval"),
    ]  # fmt: skip
    style.add_legend(figure, legend_handles, column_count=4)
    return figure


def _draw_parameter_panel(
    campaign: CampaignResult,
    structure_name: str,
    parameter: PooledParameter,
    panel_axes: Axes,
    *,
    is_reported: bool,
) -> None:
    """Draw the sessions' estimates of one parameter, and the pooled value.

    In the background are the interval of the pooled value and the interval in which the next
    session's estimate is expected. `is_reported`: whether the parameter is a reported result.
    """
    parameter_symbol, display_factor, _ = label_and_unit(parameter.name)
    session_positions, session_values, half_widths = [], [], []
    for session_number, session in enumerate(campaign.sessions, start=1):
        for estimate in session.record_estimates:
            std = estimate.fit.std.get(parameter.name)
            if estimate.name == structure_name and std is not None:
                session_positions.append(session_number)
                session_values.append(display_factor * estimate.fit.parameters[parameter.name])
                half_widths.append(NORMAL_95 * display_factor * std)
    panel_axes.axhspan(
        *(display_factor * end for end in parameter.next_session_interval),
        color=style.SHADE_COLOR,
        zorder=0.5,
    )
    panel_axes.axhspan(
        *(display_factor * end for end in parameter.interval),
        color=INTERVAL_COLOR if is_reported else style.LIGHT_GREY,
        zorder=0.6,
    )
    session_color, pooled_color = (
        (style.INK, style.BLUE) if is_reported else (style.GREY, style.GREY)
    )
    panel_axes.axhline(display_factor * parameter.value, color=pooled_color)
    panel_axes.errorbar(
        session_positions,
        session_values,
        yerr=half_widths,
        fmt="o",
        markersize=2.6,
        color=session_color,
        linewidth=0.8,
    )
    mark_text = "" if is_reported else NOT_REPORTED_MARK
    mark_text += MIXTURE_MARK if campaign.homogeneity.is_mixed(parameter.name) else ""
    p_value_text = f"p = {format_p_value(parameter.heterogeneity_p_value)}".replace("= <", "<")
    panel_axes.set_title(f"{parameter_symbol}{mark_text}   {p_value_text}")
    panel_axes.set_ylabel(symbol_with_unit(parameter.name))
    panel_axes.set_xlim(0.3, len(campaign.sessions) + 0.7)
    panel_axes.set_xticks(np.unique(np.linspace(1, len(campaign.sessions), 6).round().astype(int)))
    panel_axes.ticklabel_format(axis="y", useOffset=False)


_PANEL_DECIMATION_COLUMNS: Final = 500
"""Number of columns into which a response is decimated in a small panel."""
_WIDE_DECIMATION_COLUMNS: Final = 1500
"""Number of columns into which a response is decimated in a wide panel."""
_MAX_DRAWN_SESSIONS: Final = 40
"""Largest number of sessions whose responses are drawn: more would not be distinguishable."""
SESSION_COLOR: Final = "#A8A8A8"
"""Colour of a single session's response."""
_BEST_MODEL_STYLES: Final[tuple[dict[str, Any], ...]] = (
    {"color": style.BLUE, "linestyle": "-"},
    {"color": style.VERMILION, "linestyle": (0, (4, 2))},
)
"""Line styles of the two best models."""


def nominal_models_figure(campaign: CampaignResult) -> Figure:
    """Draw the nominal models of each type on top of all measured responses (as in Figure 6)."""
    type_names = list(dict.fromkeys(model.structure for model in campaign.nominal))
    panel_columns = min(len(type_names), 4 if len(type_names) > 6 else 3)
    panel_rows = -(-len(type_names) // panel_columns)
    width_in, height_in = max(4.4 * panel_columns, 9.0), 3.75 * panel_rows + 1.35
    figure = _new_response_figure(
        campaign, width_in, height_in, "frequency responses and nominal models"
    )
    grid = figure.add_gridspec(
        panel_rows, panel_columns, left=0.62 / width_in, right=1 - 0.2 / width_in,
        top=1 - 1.15 / height_in, bottom=0.55 / height_in, wspace=0.12, hspace=0.24,
    )  # fmt: skip
    style_by_weighting = line_styles(campaign.settings.weightings)
    line_by_label: dict[str, Line2D] = {}
    panel_axes = style.type_panels(
        figure,
        grid,
        type_names,
        campaign.settings.band_hz,
        _magnitude_limits_db(campaign, campaign.nominal),
    )
    for type_name, magnitude_axes, phase_axes in panel_axes:
        type_models = [model for model in campaign.nominal if model.structure == type_name]
        model_styles = [
            (f"nominal, weights {m.weighting}", style_by_weighting[m.weighting])
            for m in type_models
        ]
        line_by_label |= _draw_responses(
            campaign,
            magnitude_axes,
            phase_axes,
            type_models,
            model_styles,
            _PANEL_DECIMATION_COLUMNS,
        )
    for phase_axes in figure.axes[1::2][-panel_columns:]:
        phase_axes.set_xlabel("Frequency (Hz)", labelpad=1)
    _add_legend(figure, line_by_label)
    return figure


def best_models_figure(campaign: CampaignResult) -> Figure:
    """Draw the two best nominal models on top of all measured responses (as in Figure 8)."""
    drawn_models = best_models(campaign.nominal)
    width_in, height_in = 10.0, 6.6
    model_names = " and ".join(f"type {m.structure} ({m.weighting})" for m in drawn_models)
    figure = _new_response_figure(campaign, width_in, height_in, f"nominal models of {model_names}")
    grid = figure.add_gridspec(
        2, 1, left=0.62 / width_in, right=1 - 0.2 / width_in, top=1 - 0.95 / height_in,
        bottom=0.55 / height_in, height_ratios=(2.2, 1.0), hspace=0.07,
    )  # fmt: skip
    magnitude_axes, phase_axes = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    model_styles = [
        (f"nominal type {m.structure}, weights {m.weighting}", line_style)
        for m, line_style in zip(drawn_models, _BEST_MODEL_STYLES, strict=False)
    ]
    line_by_label = _draw_responses(
        campaign, magnitude_axes, phase_axes, drawn_models, model_styles, _WIDE_DECIMATION_COLUMNS
    )
    magnitude_axes.set_ylim(_magnitude_limits_db(campaign, drawn_models))
    style.set_response_axes(magnitude_axes, phase_axes)
    style.set_frequency_axis(magnitude_axes, campaign.settings.band_hz, with_labels=False)
    style.set_frequency_axis(phase_axes, campaign.settings.band_hz)
    phase_axes.set_xlabel("Frequency (Hz)", labelpad=1)
    _add_legend(figure, line_by_label)
    return figure


def _new_response_figure(
    campaign: CampaignResult, width_in: float, height_in: float, figure_heading: str
) -> Figure:
    """Return an empty figure whose title states the sessions and the response estimator."""
    session_count = len(campaign.sessions)
    drawn_sessions_text = (
        "" if session_count <= _MAX_DRAWN_SESSIONS else f", {_MAX_DRAWN_SESSIONS} of them drawn"
    )
    return style.new_figure(
        width_in, height_in, f"{session_count} sessions — {figure_heading}",
        f"coupling torque over motor angle, {welch_method_text(campaign)}{drawn_sessions_text}  ·  "
        "a nominal model has the mean of the sessions' parameters",
    )  # fmt: skip


def _draw_responses(
    campaign: CampaignResult,
    magnitude_axes: Axes,
    phase_axes: Axes,
    models: Sequence[NominalModel],
    model_styles: Sequence[tuple[str, dict[str, Any]]],
    decimation_columns: int,
) -> dict[str, Line2D]:
    """Draw the sessions' responses with models on top; return the lines by legend label."""
    line_by_label: dict[str, Line2D] = {}
    frequency_hz = campaign.sessions[0].frequency_hz
    for session in shown_sessions(campaign):
        line_by_label["measured, every session"] = draw_session(
            magnitude_axes,
            phase_axes,
            frequency_hz,
            session.response,
            decimation_columns,
            2 * decimation_columns,
            opacity=0.7,
        )
    for model, (line_label, line_style) in zip(models, model_styles, strict=True):
        (line_by_label[line_label],) = magnitude_axes.plot(
            *_decimated_line(frequency_hz, magnitude_db(model.response), decimation_columns),
            **line_style,
            linewidth=1.3,
        )
        phase_axes.plot(
            *_decimated_line(frequency_hz, phase_deg(model.response), decimation_columns),
            **line_style,
            linewidth=1.3,
        )
    return line_by_label


def shown_sessions(campaign: CampaignResult) -> list[SessionAnalysis]:
    """Return the sessions whose responses are drawn: if there are many, evenly spread ones."""
    last_index = len(campaign.sessions) - 1
    session_indices = np.unique(np.linspace(0, last_index, _MAX_DRAWN_SESSIONS).round().astype(int))
    return [campaign.sessions[session_index] for session_index in session_indices]


def draw_session(
    magnitude_axes: Axes,
    phase_axes: Axes,
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    decimation_columns: int,
    max_dots: int,
    opacity: float = 1.0,
) -> Line2D:
    """Draw one session's response in the background and return the line of its magnitude."""
    (magnitude_line,) = magnitude_axes.plot(
        *_decimated_line(frequency_hz, magnitude_db(response), decimation_columns),
        color=SESSION_COLOR,
        linewidth=0.5, alpha=opacity, rasterized=True,
    )  # fmt: skip
    point_indices = style.log_spaced_indices(frequency_hz, max_dots)
    # Dots, because a line would jump wherever noise wraps the phase.
    phase_axes.plot(
        frequency_hz[point_indices], phase_deg(response[point_indices]), ".", markersize=0.8,
        color=SESSION_COLOR, rasterized=True,
    )  # fmt: skip
    return magnitude_line


def _decimated_line(
    frequency_hz: NDArray[np.float64], curve_values: NDArray[np.float64], decimation_columns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a curve decimated to a number of pixel columns of a logarithmic axis."""
    return style.envelope(frequency_hz, curve_values, decimation_columns, logarithmic=True)


def _add_legend(figure: Figure, line_by_label: dict[str, Line2D]) -> None:
    """Add a legend to a figure and thicken the line of the measured responses in it."""
    figure_legend = style.add_legend(
        figure, list(line_by_label.values()), list(line_by_label), column_count=len(line_by_label)
    )
    figure_legend.get_lines()[0].set_linewidth(1.5)


def _magnitude_limits_db(
    campaign: CampaignResult, models: Sequence[NominalModel]
) -> tuple[float, float]:
    """Return axis limits in dB that contain all sessions' responses and the models' peaks."""
    measured_responses = [session.response for session in campaign.sessions]
    return style.db_limits(
        measured_responses, [model.response for model in models], headroom_db=3.0
    )


_ROW_HEIGHT_IN: Final = 0.27
"""Height of a model's row in the validation figure, in inches."""


def validation_figure(campaign: CampaignResult) -> Figure:
    """Draw each model's errors in predicting left-out sessions, the best model at the top."""
    from matplotlib.lines import Line2D

    ranked_models = group_errors_by_model(campaign.validation)
    weightings = campaign.settings.weightings
    color_by_weighting = {
        w: line_style["color"] for w, line_style in line_styles(weightings).items()
    }
    width_in, height_in = 9.0, _ROW_HEIGHT_IN * len(ranked_models) + 1.75
    figure = style.new_figure(
        width_in, height_in,
        f"{_predicted_sessions_text(campaign)} sessions — leave-one-out validation",
        "rms of predicted minus measured torque over that of the measured torque, "
        f"{campaign.record_band_hz[0]:g} to {campaign.record_band_hz[1]:g} Hz",
    )  # fmt: skip
    axes = figure.add_axes(
        (
            2.0 / width_in,
            0.5 / height_in,
            1 - 2.2 / width_in,
            _ROW_HEIGHT_IN * len(ranked_models) / height_in,
        )
    )
    rng = np.random.default_rng(0)  # random offsets put equal errors side by side
    for row, (_, _, weighting, model_errors) in enumerate(ranked_models):
        color = style.GREEN if weighting is None else color_by_weighting[weighting]
        session_errors = 100 * np.array([session_error.error for session_error in model_errors])
        axes.plot(
            session_errors, row + rng.uniform(-0.18, 0.18, session_errors.size), "o", color=color,
            markersize=2.6,
            alpha=0.6,
        )  # fmt: skip
        own_errors = [
            session_error.own_error
            for session_error in model_errors
            if session_error.own_error is not None
        ]
        if own_errors:
            axes.plot(
                [100 * float(np.mean(own_errors))], [row], "|", color=style.INK, markersize=11
            )
    axes.set_yticks(
        range(len(ranked_models)), [_model_label(*model[:3]) for model in ranked_models]
    )
    axes.set_ylim(len(ranked_models) - 0.4, -0.6)
    axes.set_xscale("log")
    lower_limit, upper_limit = axes.get_xlim()
    error_ticks = [
        t
        for t in (d * 10.0**e for e in range(-3, 4) for d in (1, 2, 5))
        if lower_limit <= t <= upper_limit
    ]
    axes.set_xticks(error_ticks, [f"{tick_value:g}" for tick_value in error_ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("Error (%)", labelpad=1)
    legend_handles = [
        Line2D([], [], color=style.GREEN, marker="o", linestyle="", markersize=3.5,
               label="pooled whole-record estimate"),
        Line2D([], [], color=style.INK, marker="|", linestyle="", markersize=9,
               label="mean of the sessions' own fits"),
        *(Line2D([], [], color=color_by_weighting[w], marker="o", linestyle="", markersize=3.5,
                 label=f"nominal model, weights {w}") for w in weightings),
    ]  # fmt: skip
    style.add_legend(figure, legend_handles, column_count=2)
    return figure


def _predicted_sessions_text(campaign: CampaignResult) -> str:
    """Return how many of the sessions were predicted, as text."""
    completed_trials = campaign.trials - len(campaign.failed_predictions)
    return (
        f"{completed_trials} of {campaign.trials}"
        if campaign.failed_predictions
        else str(completed_trials)
    )


def _model_label(_method: str, structure: str, weighting: str | None) -> str:
    """Return the label of a fitted model in the validation figure: its type and weighting."""
    return f"{structure}: {'whole record' if weighting is None else f'Welch, {weighting}'}"
