"""Measured torque against what a fitted model makes of the measured angle, in time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.paper import band_limited, modelled_torque
from analysis.report import style
from analysis.report.moments import enlarge, mark, resonance_moments

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.paper import FittedModel, WelchAnalysis


def best_model(analysis: WelchAnalysis) -> FittedModel:
    """Model with the lowest WMSE, the index by which the paper prefers one."""
    return min(analysis.models, key=lambda model: model.indices.wmse)


def torque_figure(analysis: WelchAnalysis) -> Figure:
    """Draw the measured torque, the modelled one and their difference, with details at the modes.

    All three are limited to frequencies up to the band's end: beyond it the measured torque is
    noise and the modelled one the encoder's quantisation.
    """
    record = analysis.record
    model = best_model(analysis)
    band_hz = (0.0, analysis.settings.band_hz[1])
    modelled = band_limited(modelled_torque(record, model.fit.damping), record.rate_hz, band_hz)
    measured = band_limited(record.torque_nm, record.rate_hz, band_hz)
    residual = measured - modelled
    share = _rms(residual) / _rms(measured) if measured.any() else np.nan
    figure = style.new_figure(
        13.0, 8.0, f"{record.path.name} — torque, measured and modelled",
        f"type {model.fit.structure.name}, weights {model.fit.weighting} (lowest WMSE)  ·  exact "
        f"model's response to the measured angle  ·  0 to {band_hz[1]:g} Hz  ·  residual "
        f"{1e3 * _rms(residual):.3g} mN·m rms, {100 * share:.3g} % of the torque, the bias of "
        "Welch's estimate included",
    )  # fmt: skip
    moments = resonance_moments(record, len(analysis.peaks))
    grid = figure.add_gridspec(
        2, max(len(moments), 1), left=0.06, right=0.985, top=0.87, bottom=0.065, hspace=0.28,
        wspace=0.17, height_ratios=(1.7, 1.0),
    )  # fmt: skip
    whole = grid[0, :].subgridspec(2, 1, hspace=0.2, height_ratios=(1.7, 1.0))
    top = figure.add_subplot(whole[0])
    top.plot(
        *style.envelope(record.time_s, measured), color=style.GREY, linewidth=1.0, label="measured"
    )
    top.plot(
        *style.envelope(record.time_s, modelled), color=style.BLUE, linewidth=0.6,
        label="modelled",
    )  # fmt: skip
    top.set_title("Whole record", pad=14)
    top.set_ylabel("Torque (N·m)")
    top.set_ylim(style.limits(measured, modelled))
    top.tick_params(labelbottom=False)
    middle = figure.add_subplot(whole[1])
    middle.plot(*style.envelope(record.time_s, residual), color=style.VERMILION, linewidth=0.7)
    middle.set_title("Residual, measured − modelled")
    middle.set_ylabel("Torque (N·m)")
    middle.set_ylim(style.limits(residual))
    middle.set_xlabel("Time (s)", labelpad=1)
    for axes in (top, middle):
        axes.set_xlim(record.time_s[0], record.time_s[-1])
    mark(top, moments)
    for column, moment in enumerate(moments):
        axes = figure.add_subplot(grid[1, column])
        times_s = record.time_s[moment.samples]
        axes.plot(times_s, measured[moment.samples], color=style.GREY, linewidth=2.6)
        axes.plot(times_s, modelled[moment.samples], color=style.BLUE, linewidth=1.1)
        axes.plot(times_s, residual[moment.samples], color=style.VERMILION, linewidth=0.8)
        enlarge(axes, column + 1, moment)
        axes.set_xlabel("Time (s)", labelpad=1)
        if column == 0:
            axes.set_ylabel("Torque (N·m)")
    handles = [*top.get_lines()[:2], middle.get_lines()[0]]
    figure.legend(
        handles, ["measured", "modelled", "residual"], loc="upper right",
        bbox_to_anchor=(0.985, 0.925), ncols=3, borderaxespad=0.0,
    )  # fmt: skip
    return figure


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
