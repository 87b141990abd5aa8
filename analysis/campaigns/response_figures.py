"""Measured responses of all sessions with nominal models: the paper's Figures 6 and 8."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.campaigns.nominal import best_models
from analysis.models import ESTIMATOR_WORDS, STRUCTURES
from analysis.report import style
from analysis.report.frf_figure import line_styles
from rigd.view import magnitude_db, phase_deg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

    from analysis.campaigns.campaign import Campaign
    from analysis.campaigns.nominal import NominalModel

_COLUMNS: Final = 500
_WIDE_COLUMNS: Final = 1500
_MOST_LINES: Final = 40
"""Most sessions drawn: more would not be told apart."""
_SYMBOLS: Final = {"zeta": "ζ", "alpha": "α", "gamma": "γ", "lambda": "λ"}
_MEASURED: Final[dict[str, Any]] = {
    "color": "#A8A8A8", "linewidth": 0.5, "alpha": 0.7, "rasterized": True,
}  # fmt: skip
_PAIR: Final[tuple[dict[str, Any], ...]] = (
    {"color": style.BLUE, "linestyle": "-"},
    {"color": style.VERMILION, "linestyle": (0, (4, 2))},
)


def nominal_figure(campaign: Campaign) -> Figure:
    """Draw every type's nominal models over all measured responses (Figure 6)."""
    types = list(dict.fromkeys(model.structure for model in campaign.nominal))
    columns = min(len(types), 4 if len(types) > 6 else 3)
    rows = -(-len(types) // columns)
    width_in, height_in = max(4.4 * columns, 9.0), 3.75 * rows + 1.35
    figure = _figure(campaign, width_in, height_in, "frequency responses and nominal models")
    grid = figure.add_gridspec(
        rows, columns, left=0.62 / width_in, right=1 - 0.2 / width_in,
        top=1 - 1.15 / height_in, bottom=0.55 / height_in, wspace=0.12, hspace=0.24,
    )  # fmt: skip
    lines = line_styles(campaign.settings.weightings)
    limits = _db_limits(campaign, campaign.nominal)
    handles: dict[str, Line2D] = {}
    for number, name in enumerate(types):
        row, column = divmod(number, columns)
        cell = grid[row, column].subgridspec(2, 1, height_ratios=(2.3, 1.0), hspace=0.07)
        magnitude, phase = figure.add_subplot(cell[0]), figure.add_subplot(cell[1])
        models = [model for model in campaign.nominal if model.structure == name]
        looks = [(f"nominal, weights {m.weighting}", lines[m.weighting]) for m in models]
        handles |= _panel(campaign, magnitude, phase, models, looks, _COLUMNS)
        free = ", ".join(_SYMBOLS[p] for p in STRUCTURES[name].free)
        magnitude.set_title(f"Type {name}   {free}")
        _dress(campaign, magnitude, phase, limits, bottom=number >= len(types) - columns)
        for axes in (magnitude, phase):
            axes.tick_params(labelleft=column == 0)
            if column:
                axes.set_ylabel("")
    _legend(figure, handles, width_in, height_in)
    return figure


def best_figure(campaign: Campaign) -> Figure:
    """Draw the two best nominal models over all measured responses (Figure 8)."""
    models = best_models(campaign.nominal)
    width_in, height_in = 10.0, 6.6
    names = " and ".join(f"type {m.structure} ({m.weighting})" for m in models)
    figure = _figure(campaign, width_in, height_in, f"nominal models of {names}")
    grid = figure.add_gridspec(
        2, 1, left=0.62 / width_in, right=1 - 0.2 / width_in, top=1 - 0.95 / height_in,
        bottom=0.55 / height_in, height_ratios=(2.2, 1.0), hspace=0.07,
    )  # fmt: skip
    magnitude, phase = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    looks = [
        (f"nominal type {m.structure}, weights {m.weighting}", look)
        for m, look in zip(models, _PAIR, strict=False)
    ]
    handles = _panel(campaign, magnitude, phase, models, looks, _WIDE_COLUMNS)
    _dress(campaign, magnitude, phase, _db_limits(campaign, models), bottom=True)
    _legend(figure, handles, width_in, height_in)
    return figure


def _figure(campaign: Campaign, width_in: float, height_in: float, what: str) -> Figure:
    count = len(campaign.sessions)
    drawn = "" if count <= _MOST_LINES else f", {_MOST_LINES} of them drawn"
    estimator = ESTIMATOR_WORDS[campaign.settings.estimator]
    return style.new_figure(
        width_in, height_in, f"{count} sessions — {what}",
        f"coupling torque over motor angle, {estimator}{drawn}  ·  "
        "a nominal model has the mean of the sessions' parameters",
    )  # fmt: skip


def _panel(
    campaign: Campaign,
    magnitude: Axes,
    phase: Axes,
    models: Sequence[NominalModel],
    looks: Sequence[tuple[str, dict[str, Any]]],
    columns: int,
) -> dict[str, Line2D]:
    handles: dict[str, Line2D] = {}
    sessions = campaign.sessions
    frequency_hz = sessions[0].frequency_hz
    chosen = np.unique(np.linspace(0, len(sessions) - 1, _MOST_LINES).round().astype(int))
    few = style.spread(frequency_hz, 2 * columns)
    for number in chosen:
        response = sessions[number].response
        (handles["measured, every session"],) = magnitude.plot(
            *_line(frequency_hz, magnitude_db(response), columns), **_MEASURED
        )
        # Dots: a line would run up and down wherever noise wraps the phase.
        phase.plot(
            frequency_hz[few], phase_deg(response[few]), ".", markersize=0.8,
            color=_MEASURED["color"], rasterized=True,
        )  # fmt: skip
    for model, (label, look) in zip(models, looks, strict=True):
        (handles[label],) = magnitude.plot(
            *_line(frequency_hz, magnitude_db(model.response), columns), **look, linewidth=1.3
        )
        phase.plot(*_line(frequency_hz, phase_deg(model.response), columns), **look, linewidth=1.3)
    return handles


def _line(
    frequency_hz: NDArray[np.float64], values: NDArray[np.float64], columns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return style.envelope(frequency_hz, values, columns, logarithmic=True)


def _dress(
    campaign: Campaign,
    magnitude: Axes,
    phase: Axes,
    limits: tuple[float, float],
    *,
    bottom: bool,
) -> None:
    band = campaign.settings.band_hz
    magnitude.set_ylim(limits)
    phase.set_ylim(-60, 240)
    phase.set_yticks((0, 90, 180))
    style.frequency_axis(magnitude, band, labels=False)
    style.frequency_axis(phase, band, labels=bottom)
    magnitude.set_ylabel("Magnitude (dB re 1 N·m/rad)")
    phase.set_ylabel("Phase (°)")
    if bottom:
        phase.set_xlabel("Frequency (Hz)", labelpad=1)


def _legend(figure: Figure, handles: dict[str, Line2D], width_in: float, height_in: float) -> None:
    legend = figure.legend(
        list(handles.values()), list(handles), loc="upper left",
        bbox_to_anchor=(0.3 / width_in, 1 - 0.62 / height_in), ncols=len(handles),
        borderaxespad=0.0,
    )  # fmt: skip
    legend.get_lines()[0].set_linewidth(1.5)


def _db_limits(campaign: Campaign, models: Sequence[NominalModel]) -> tuple[float, float]:
    """Limits that hold the measured responses and the models' peaks, not every zero's depth."""
    measured = np.concatenate([magnitude_db(s.response) for s in campaign.sessions])
    peaks = max(float(magnitude_db(model.response).max()) for model in models)
    top = float(measured.max())
    return float(np.quantile(measured, 0.002)) - 4.0, min(max(peaks, top), top + 15.0) + 3.0
