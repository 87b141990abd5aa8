"""Figures of a record's angle and torque, with the torque that the fitted model predicts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.ticker import MaxNLocator

from analysis.identify import Measurement, TorquePredictor
from analysis.paper.welch_analysis import band_limited, largest_oscillation_time_s, modelled_torque
from analysis.report import _style as style
from rigd.beam import undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify import ModalModel
    from analysis.paper.welch_analysis import FittedModel, WelchAnalysis
    from analysis.record import Record
    from analysis.report._shown_model import ShownModel
    from rigd.beam import Plant

    # Matplotlib's properties of a line.
    LineStyle = dict[str, Any]
    # Values of a signal with the style of its line.
    StyledSignal = tuple[NDArray[np.float64], LineStyle]

_PERIODS_SHOWN: Final = 12
"""Number of a mode's periods that its enlarged panel shows."""
_MIN_DETAIL_S: Final = 0.3
"""Least duration that an enlarged panel shows, in seconds."""
_MAX_DETAIL_FRACTION: Final = 1 / 8
"""Largest duration that an enlarged panel shows, as a fraction of the record."""


@dataclass(frozen=True, slots=True)
class RecordInterval:
    """Time interval of a record that an enlarged panel of a figure shows.

    Attributes
    ----------
    name
        Name of the interval.
    samples
        Range of the interval's samples.
    first_s, last_s
        Time of the first and last sample in the record.
    """

    name: str
    samples: slice
    first_s: float
    last_s: float


def resonance_intervals(record: Record, mode_count: int) -> tuple[RecordInterval, ...]:
    """Return for each mode below the Nyquist frequency the interval of its largest oscillation."""
    duration_s = len(record.time_s) / record.rate_hz
    intervals = []
    modes_hz = undamped_frequencies_rad_s(record.beam, mode_count) / (2 * math.pi)
    for mode_number, frequency_hz in enumerate(modes_hz.tolist(), start=1):
        if frequency_hz >= record.rate_hz / 2:
            break
        interval_centre_s = largest_oscillation_time_s(
            record.torque_nm, record.rate_hz, frequency_hz
        )
        interval_length_s = min(_PERIODS_SHOWN / frequency_hz, _MAX_DETAIL_FRACTION * duration_s)
        interval_length_s = max(interval_length_s, _MIN_DETAIL_S)
        sample_count = min(round(interval_length_s * record.rate_hz), len(record.time_s))
        first_sample = round((interval_centre_s - interval_length_s / 2) * record.rate_hz)
        first_sample = min(max(first_sample, 0), len(record.time_s) - sample_count)
        sample_range = slice(first_sample, first_sample + sample_count)
        times_s = record.time_s[sample_range]
        intervals.append(
            RecordInterval(
                name=f"Mode {mode_number}, {frequency_hz:.3g} Hz",
                samples=sample_range,
                first_s=float(times_s[0]),
                last_s=float(times_s[-1]),
            )
        )
    return tuple(intervals)


def shade_intervals(axes: Axes, intervals: tuple[RecordInterval, ...]) -> None:
    """Shade intervals in the panel of the whole record, and label them with numbers from 1."""
    for interval_number, interval in enumerate(intervals, start=1):
        axes.axvspan(
            interval.first_s, interval.last_s, color=style.SHADE_COLOR, linewidth=0, zorder=0
        )
        axes.text(
            (interval.first_s + interval.last_s) / 2, 1.01, str(interval_number),
            transform=axes.get_xaxis_transform(), ha="center", va="bottom", fontsize=7.5,
            color="#8A7A4A",
        )  # fmt: skip


def set_up_detail_axes(axes: Axes, interval_number: int, interval: RecordInterval) -> None:
    """Set the title (with the interval's number) and the time axis of an enlarged panel."""
    axes.set_title(f"{interval_number}  {interval.name}", fontsize=8.5, fontweight="normal")
    axes.set_xlim(interval.first_s, interval.last_s)
    axes.set_facecolor("#FCFAF4")


@dataclass(frozen=True, slots=True)
class TorqueInBand:
    """Measured and modelled coupling torque in the band of a fit, in N·m, shape (n,) each."""

    measured_nm: NDArray[np.float64]
    modelled_nm: NDArray[np.float64]

    @property
    def residual_nm(self) -> NDArray[np.float64]:
        """Measured minus modelled torque in N·m, shape (n,)."""
        return self.measured_nm - self.modelled_nm


def torque_in_band(record: Record, plant: Plant | ModalModel, highest_hz: float) -> TorqueInBand:
    """Return measured and modelled torque, both limited to frequencies up to `highest_hz`.

    The modelled torque is computed from the measured angle. At higher frequencies the measured
    torque is noise, and the modelled torque is due to the encoder's quantisation.
    """
    angle_rad = Measurement.from_record(record).angle_from_rest_rad(highest_hz)
    band_hz = (0.0, highest_hz)
    # Followed by its mirror image, the angle has no step at its end, to which the model would
    # respond before it in so narrow a band.
    mirrored_angle_rad = np.concatenate([angle_rad, angle_rad[::-1]])
    modelled_nm, _ = TorquePredictor(
        band_limited(mirrored_angle_rad, record.rate_hz, band_hz),
        record.rate_hz,
        slice(0, angle_rad.size),
    ).torque(plant)
    offset_nm = float(np.mean(record.torque_nm - modelled_nm))
    return TorqueInBand(
        measured_nm=band_limited(record.torque_nm - offset_nm, record.rate_hz, band_hz),
        modelled_nm=modelled_nm,
    )


def signals_figure(record: Record, model: ShownModel, highest_hz: float) -> Figure:
    """Draw the angle, the measured and modelled torque, and the difference of the torques.

    Panels below enlarge the torques and their difference at each mode of the model. `highest_hz` is
    the highest frequency of the fit's band.
    """
    shown_torque = torque_in_band(record, model.transfer_function, highest_hz)
    record_of_fitted_beam = replace(record, beam=model.beam_fit.plant.beam)
    mode_by_number = {mode.number: mode for mode in model.modes}
    intervals = tuple(
        replace(
            interval, name=f"Mode {mode_number}, {mode_by_number[mode_number].frequency_hz:.4g} Hz"
        )
        for mode_number, interval in enumerate(
            resonance_intervals(record_of_fitted_beam, max(mode_by_number, default=0)), start=1
        )
        if mode_number in mode_by_number
    )
    figure = style.new_figure(9.0, 6.8)
    grid = figure.add_gridspec(
        2, len(intervals) or 1, left=0.095, right=0.965, top=0.91, bottom=0.07, hspace=0.3,
        wspace=0.25, height_ratios=(4.0, 1.2),
    )  # fmt: skip
    upper_grid = grid[0, :].subgridspec(3, 1, hspace=0.4, height_ratios=(1.1, 1.3, 0.8))
    angle_axes, torque_axes, residual_axes = (
        figure.add_subplot(upper_grid[row]) for row in range(3)
    )
    angle_lines = (
        (1e3 * record.reference_rad, {"color": style.ORANGE, "label": "reference angle"}),
        (1e3 * record.angle_rad, _ANGLE_LINE | {"color": style.PURPLE, "label": "measured angle"}),
    )
    torque_lines = (
        (shown_torque.measured_nm, _MEASURED_LINE | {"label": "measured torque"}),
        (shown_torque.modelled_nm, _MODELLED_LINE | {"label": "modelled torque"}),
    )
    _draw_whole_record(angle_axes, record, angle_lines, "Motor angle", _ANGLE_LABEL, title_pad=14)
    _draw_whole_record(torque_axes, record, torque_lines, "Coupling torque", _TORQUE_LABEL)
    _draw_whole_record(
        residual_axes,
        record,
        ((shown_torque.residual_nm, _RESIDUAL_LINE),),
        _RESIDUAL_TITLE,
        _TORQUE_LABEL,
    )
    residual_axes.set_xlabel("Time (s)", labelpad=1)
    for axes in (angle_axes, torque_axes, residual_axes):
        axes.tick_params(labelbottom=axes is residual_axes)
    shade_intervals(angle_axes, intervals)
    detail_signals = (shown_torque.measured_nm, shown_torque.modelled_nm, shown_torque.residual_nm)
    for panel_number, interval in enumerate(intervals):
        axes = figure.add_subplot(grid[1, panel_number])
        axes.xaxis.set_major_locator(MaxNLocator(4))
        _draw_detail(
            axes,
            record,
            zip(detail_signals, _DETAIL_LINES, strict=True),
            panel_number,
            interval,
            _TORQUE_LABEL,
        )
        axes.set_xlabel("Time (s)", labelpad=1)
    legend_handles = [
        legend_handle
        for axes in (angle_axes, torque_axes, residual_axes)
        for legend_handle in axes.get_lines()
    ]
    figure.legend(
        legend_handles, [str(legend_handle.get_label()) for legend_handle in legend_handles],
        loc="upper right",
        bbox_to_anchor=(0.985, 0.995), ncols=5, borderaxespad=0.0,
    )  # fmt: skip
    return figure


_ANGLE_LABEL: Final = "Angle (mrad)"
"""Label of the angle's axis."""
_TORQUE_LABEL: Final = "Torque (N·m)"
"""Label of the torque's axis."""
_RESIDUAL_TITLE: Final = "Residual, measured − modelled"
"""Title of the residual's panel."""
_ANGLE_LINE: Final[LineStyle] = {"linewidth": 0.7}
"""Style of the measured angle."""
_MEASURED_LINE: Final[LineStyle] = {"color": style.GREY, "linewidth": 1.0}
"""Style of the measured torque over the whole record."""
_MODELLED_LINE: Final[LineStyle] = {"color": style.BLUE, "linewidth": 0.6}
"""Style of the modelled torque over the whole record."""
_RESIDUAL_LINE: Final[LineStyle] = {"color": style.VERMILION, "linewidth": 0.7, "label": "residual"}
"""Style of the residual over the whole record."""
_DETAIL_LINES: Final[tuple[LineStyle, ...]] = (
    {"color": style.GREY, "linewidth": 2.6},
    {"color": style.BLUE, "linewidth": 1.0},
    {"color": style.VERMILION, "linewidth": 0.8},
)
"""Styles of measured torque, modelled torque and residual in an enlarged panel."""


def _draw_whole_record(
    axes: Axes,
    record: Record,
    styled_signals: Iterable[StyledSignal],
    panel_title: str,
    axis_label: str,
    title_pad: float | None = None,
) -> None:
    """Draw signals over the whole record, each in its line style."""
    signal_list = tuple(styled_signals)
    for signal_values, line_style in signal_list:
        axes.plot(*style.envelope(record.time_s, signal_values), **line_style)
    axes.set_title(panel_title, pad=title_pad)
    axes.set_ylabel(axis_label)
    axes.set_ylim(style.axis_limits(*(signal_values for signal_values, _ in signal_list)))
    axes.set_xlim(record.time_s[0], record.time_s[-1])


def _draw_detail(
    axes: Axes,
    record: Record,
    styled_signals: Iterable[StyledSignal],
    panel_number: int,
    interval: RecordInterval,
    axis_label: str,
) -> None:
    """Draw signals in the enlarged panel of one interval. The first panel of a row has a legend."""
    for signal_values, line_style in styled_signals:
        axes.plot(record.time_s[interval.samples], signal_values[interval.samples], **line_style)
    set_up_detail_axes(axes, panel_number + 1, interval)
    if panel_number == 0:
        axes.set_ylabel(axis_label)


def paper_signals_figure(analysis: WelchAnalysis) -> Figure:
    """Draw angles (a) and torque (b): over the whole record, and enlarged at each mode."""
    record = analysis.record
    intervals = resonance_intervals(record, len(analysis.peaks))
    sweep_s = record.sweep_samples / record.rate_hz
    subtitle_parts = [
        record.metadata.get("excitation", "record"),
        f"sweep {sweep_s:.6g} s of {len(record.time_s) / record.rate_hz:.6g} s at "
        f"{record.rate_hz:g} Hz",
        f"outcome {record.outcome}",
    ]
    if record.gaps.missing_ticks:
        subtitle_parts.append(f"{record.gaps.missing_ticks} missing ticks interpolated")
    figure = style.new_figure(13.0, 8.0, "Signals", "  ·  ".join(subtitle_parts))
    panel_columns = max(len(intervals), 1)
    grid = figure.add_gridspec(
        4, panel_columns, left=0.06, right=0.985, top=0.88, bottom=0.065, hspace=0.58, wspace=0.17,
        height_ratios=(1.25, 1.0, 1.25, 1.0),
    )  # fmt: skip
    reference_mrad, angle_mrad = 1e3 * record.reference_rad, 1e3 * record.angle_rad
    angle_axes, torque_axes = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[2, :])
    angle_lines = (
        (reference_mrad, {"color": style.ORANGE, "label": "reference"}),
        (angle_mrad, _ANGLE_LINE | {"color": style.BLUE, "label": "measured"}),
    )
    _draw_whole_record(
        angle_axes, record, angle_lines, "(a) Motor angle", _ANGLE_LABEL, title_pad=14
    )
    angle_axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.07), ncols=2, borderaxespad=0.0)
    green_line_style = {"color": style.GREEN}
    torque_lines = ((record.torque_nm, _ANGLE_LINE | green_line_style),)
    _draw_whole_record(
        torque_axes, record, torque_lines, "(b) Coupling torque", _TORQUE_LABEL, title_pad=14
    )
    for axes in (angle_axes, torque_axes):
        axes.set_xlabel("Time (s)", labelpad=1)
        shade_intervals(axes, intervals)
    detail_angle_lines = (
        (reference_mrad, {"color": style.ORANGE}),
        (angle_mrad, {"color": style.BLUE}),
    )
    for panel_number, interval in enumerate(intervals):
        angle_detail_axes = figure.add_subplot(grid[1, panel_number])
        _draw_detail(
            angle_detail_axes, record, detail_angle_lines, panel_number, interval, _ANGLE_LABEL
        )
        torque_detail_axes = figure.add_subplot(grid[3, panel_number])
        line_style = green_line_style | {"linewidth": 0.9}
        _draw_detail(
            torque_detail_axes,
            record,
            ((record.torque_nm, line_style),),
            panel_number,
            interval,
            _TORQUE_LABEL,
        )
        torque_detail_axes.set_xlabel("Time (s)", labelpad=1)
    return figure


def best_model(analysis: WelchAnalysis) -> FittedModel:
    """Return the fitted model with the lowest weighted mean square error (WMSE)."""
    return min(analysis.models, key=lambda model: model.indices.wmse)


def torque_figure(analysis: WelchAnalysis) -> Figure:
    """Draw measured and modelled torque and their difference, also enlarged at each mode.

    All three are limited to frequencies up to the end of the band. At higher frequencies the
    measured torque is noise, and the modelled torque is due to the encoder's quantisation.
    """
    record = analysis.record
    fitted_model = best_model(analysis)
    band_hz = (0.0, analysis.settings.band_hz[1])
    modelled_nm = band_limited(
        modelled_torque(record, fitted_model.fit.damping), record.rate_hz, band_hz
    )
    measured_nm = band_limited(record.torque_nm, record.rate_hz, band_hz)
    residual_nm = measured_nm - modelled_nm
    residual_fraction = _rms(residual_nm) / _rms(measured_nm) if measured_nm.any() else np.nan
    figure = style.new_figure(
        13.0, 8.0, "Torque, measured and modelled",
        f"type {fitted_model.fit.structure.name}, weights {fitted_model.fit.weighting} (lowest "
        f"WMSE)  ·  exact model's response to the measured angle  ·  0 to {band_hz[1]:g} Hz  ·  "
        f"residual {1e3 * _rms(residual_nm):.3g} mN·m rms, {100 * residual_fraction:.3g} % of the "
        "torque, the bias of Welch's estimate included",
    )  # fmt: skip
    intervals = resonance_intervals(record, len(analysis.peaks))
    grid = figure.add_gridspec(
        2, max(len(intervals), 1), left=0.06, right=0.985, top=0.87, bottom=0.065, hspace=0.28,
        wspace=0.17, height_ratios=(1.7, 1.0),
    )  # fmt: skip
    upper_grid = grid[0, :].subgridspec(2, 1, hspace=0.2, height_ratios=(1.7, 1.0))
    torque_axes, residual_axes = (
        figure.add_subplot(upper_grid[0]),
        figure.add_subplot(upper_grid[1]),
    )
    torque_lines = ((measured_nm, _MEASURED_LINE), (modelled_nm, _MODELLED_LINE))
    _draw_whole_record(
        torque_axes, record, torque_lines, "Whole record", _TORQUE_LABEL, title_pad=14
    )
    torque_axes.tick_params(labelbottom=False)
    _draw_whole_record(
        residual_axes, record, ((residual_nm, _RESIDUAL_LINE),), _RESIDUAL_TITLE, _TORQUE_LABEL
    )
    residual_axes.set_xlabel("Time (s)", labelpad=1)
    shade_intervals(torque_axes, intervals)
    detail_styles = (_DETAIL_LINES[0], _DETAIL_LINES[1] | {"linewidth": 1.1}, _DETAIL_LINES[2])
    detail_lines = tuple(zip((measured_nm, modelled_nm, residual_nm), detail_styles, strict=True))
    for panel_number, interval in enumerate(intervals):
        axes = figure.add_subplot(grid[1, panel_number])
        _draw_detail(axes, record, detail_lines, panel_number, interval, _TORQUE_LABEL)
        axes.set_xlabel("Time (s)", labelpad=1)
    legend_handles = [*torque_axes.get_lines()[:2], residual_axes.get_lines()[0]]
    figure.legend(
        legend_handles, ["measured", "modelled", "residual"], loc="upper right",
        bbox_to_anchor=(0.985, 0.925), ncols=3, borderaxespad=0.0,
    )  # fmt: skip
    return figure


def _rms(signal_values: np.ndarray) -> float:
    """Return the root mean square of a signal, in the unit of the signal."""
    return float(np.sqrt(np.mean(signal_values**2)))
