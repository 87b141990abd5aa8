"""Figures of a record's signals, beside what the fitted plant makes of its angle."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify import Measurement, Prediction
from analysis.paper import band_limited, loudest_moment_s, modelled_torque
from analysis.report import _style as style
from rigd.beam import undamped_frequencies_rad_s

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify import Plant, RecordFit
    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.record import Record

_PERIODS_SHOWN: Final = 12
_SHORTEST_S: Final = 0.3
_LARGEST_SHARE: Final = 1 / 8


@dataclass(frozen=True, slots=True)
class Moment:
    """One stretch of the record.

    Attributes
    ----------
    name
        What is seen there.
    samples
        Range of samples.
    first_s, last_s
        Its ends in the record's time.
    """

    name: str
    samples: slice
    first_s: float
    last_s: float


def resonance_moments(record: Record, count: int) -> tuple[Moment, ...]:
    """Where the torque rings most at each of the first modes that the sampling can show."""
    duration_s = len(record.time_s) / record.rate_hz
    moments = []
    modes_hz = undamped_frequencies_rad_s(record.beam, count) / (2 * math.pi)
    for number, frequency_hz in enumerate(modes_hz.tolist(), start=1):
        if frequency_hz >= record.rate_hz / 2:
            break
        centre_s = loudest_moment_s(record.torque_nm, record.rate_hz, frequency_hz)
        length_s = min(_PERIODS_SHOWN / frequency_hz, _LARGEST_SHARE * duration_s)
        length_s = max(length_s, _SHORTEST_S)
        samples = min(round(length_s * record.rate_hz), len(record.time_s))
        first = round((centre_s - length_s / 2) * record.rate_hz)
        first = min(max(first, 0), len(record.time_s) - samples)
        stretch = slice(first, first + samples)
        times_s = record.time_s[stretch]
        moments.append(
            Moment(
                name=f"Mode {number}, {frequency_hz:.3g} Hz",
                samples=stretch,
                first_s=float(times_s[0]),
                last_s=float(times_s[-1]),
            )
        )
    return tuple(moments)


def mark(axes: Axes, moments: tuple[Moment, ...]) -> None:
    """Shade the stretches in the panel of the whole record, numbered from 1."""
    for number, moment in enumerate(moments, start=1):
        axes.axvspan(moment.first_s, moment.last_s, color=style.SHADE, linewidth=0, zorder=0)
        axes.text(
            (moment.first_s + moment.last_s) / 2, 1.01, str(number),
            transform=axes.get_xaxis_transform(), ha="center", va="bottom", fontsize=7.5,
            color="#8A7A4A",
        )  # fmt: skip


def enlarge(axes: Axes, number: int, moment: Moment) -> None:
    """Make a panel the enlargement of one stretch, which is numbered like its mark."""
    axes.set_title(f"{number}  {moment.name}", fontsize=8.5, fontweight="normal")
    axes.set_xlim(moment.first_s, moment.last_s)
    axes.set_facecolor("#FCFAF4")


@dataclass(frozen=True, slots=True)
class TorqueInBand:
    """Coupling torque in the band of a fit, in N·m, shape (n,) each."""

    measured: NDArray[np.float64]
    modelled: NDArray[np.float64]

    @property
    def residual(self) -> NDArray[np.float64]:
        """Measured minus modelled torque."""
        return self.measured - self.modelled


def torque_in_band(record: Record, plant: Plant, highest_hz: float) -> TorqueInBand:
    """Measured torque, and that of a plant for the measured angle, up to `highest_hz`.

    Beyond it the measured torque is noise and the modelled one the encoder's quantisation.
    """
    angle = Measurement.of_record(record).angle_from_rest(highest_hz)
    everything = slice(0, angle.size)
    band_hz = (0.0, highest_hz)
    modelled, _ = Prediction(
        band_limited(angle, record.rate_hz, band_hz), record.rate_hz, everything
    ).torque(plant)
    offset = float(np.mean(record.torque_nm - modelled))
    return TorqueInBand(
        measured=band_limited(record.torque_nm - offset, record.rate_hz, band_hz),
        modelled=modelled,
    )


def signals_figure(record: Record, fit: RecordFit, highest_hz: float) -> Figure:
    """Draw angle, torque (measured and modelled) and residual, with a detail of every mode.

    Parameters
    ----------
    record : Record
    fit : RecordFit
        With the modes that are enlarged.
    highest_hz : float
        End of the band that was compared.
    """
    torque = torque_in_band(record, fit.plant, highest_hz)
    found = replace(record, beam=fit.plant.beam)
    modes = {mode.number: mode for mode in fit.modes}
    moments = tuple(
        replace(moment, name=f"Mode {number}, {modes[number].frequency_hz:.4g} Hz")
        for number, moment in enumerate(resonance_moments(found, max(modes, default=0)), start=1)
        if number in modes
    )
    rms = float(np.sqrt(np.mean(torque.residual**2)))
    share = rms / float(np.sqrt(np.mean(torque.measured**2)) or np.nan)
    figure = style.new_figure(
        11.0, 8.4, f"{record.path.name} — signals",
        f"torque from 0 to {highest_hz:g} Hz  ·  model: type {fit.structure.name}, its response to "
        f"the measured angle  ·  residual {1e3 * rms:.3g} mN·m rms, {100 * share:.3g} % of the "
        "torque",
    )  # fmt: skip
    grid = figure.add_gridspec(
        4, len(moments) or 1, left=0.075, right=0.985, top=0.875, bottom=0.06, hspace=0.42,
        wspace=0.2, height_ratios=(1.1, 1.3, 0.8, 1.2),
    )  # fmt: skip
    angle, whole, rest = (figure.add_subplot(grid[row, :]) for row in range(3))
    reference_mrad, angle_mrad = 1e3 * record.reference_rad, 1e3 * record.angle_rad
    angle.plot(
        *style.envelope(record.time_s, reference_mrad), color=style.ORANGE, label="reference angle"
    )
    angle.plot(
        *style.envelope(record.time_s, angle_mrad), color=style.PURPLE, linewidth=0.7,
        label="measured angle",
    )  # fmt: skip
    angle.set_title("Motor angle", pad=14)
    angle.set_ylabel("Angle (mrad)")
    angle.set_ylim(style.limits(reference_mrad, angle_mrad))
    whole.plot(
        *style.envelope(record.time_s, torque.measured), color=style.GREY, linewidth=1.0,
        label="measured torque",
    )  # fmt: skip
    whole.plot(
        *style.envelope(record.time_s, torque.modelled), color=style.BLUE, linewidth=0.6,
        label="modelled torque",
    )  # fmt: skip
    whole.set_title("Coupling torque")
    whole.set_ylabel("Torque (N·m)")
    whole.set_ylim(style.limits(torque.measured, torque.modelled))
    rest.plot(
        *style.envelope(record.time_s, torque.residual), color=style.VERMILION, linewidth=0.7,
        label="residual",
    )  # fmt: skip
    rest.set_title("Residual, measured − modelled")
    rest.set_ylabel("Torque (N·m)")
    rest.set_ylim(style.limits(torque.residual))
    rest.set_xlabel("Time (s)", labelpad=1)
    for axes in (angle, whole, rest):
        axes.set_xlim(record.time_s[0], record.time_s[-1])
        axes.tick_params(labelbottom=axes is rest)
    mark(angle, moments)
    for column, moment in enumerate(moments):
        axes = figure.add_subplot(grid[3, column])
        times_s = record.time_s[moment.samples]
        axes.plot(times_s, torque.measured[moment.samples], color=style.GREY, linewidth=2.6)
        axes.plot(times_s, torque.modelled[moment.samples], color=style.BLUE, linewidth=1.0)
        axes.plot(times_s, torque.residual[moment.samples], color=style.VERMILION, linewidth=0.8)
        enlarge(axes, column + 1, moment)
        axes.set_xlabel("Time (s)", labelpad=1)
        if column == 0:
            axes.set_ylabel("Torque (N·m)")
    handles = [handle for axes in (angle, whole, rest) for handle in axes.get_lines()]
    figure.legend(
        handles, [str(handle.get_label()) for handle in handles], loc="upper right",
        bbox_to_anchor=(0.985, 0.93), ncols=5, borderaxespad=0.0,
    )  # fmt: skip
    return figure


def paper_signals_figure(analysis: WelchAnalysis) -> Figure:
    """Draw (a) angles and (b) torque: the whole record, and details where each mode rings most."""
    record = analysis.record
    moments = resonance_moments(record, len(analysis.peaks))
    sweep_s = record.sweep_samples / record.rate_hz
    parts = [
        record.metadata.get("excitation", "record"),
        f"sweep {sweep_s:.6g} s of {len(record.time_s) / record.rate_hz:.6g} s at "
        f"{record.rate_hz:g} Hz",
        f"outcome {record.outcome}",
    ]
    if record.gaps.missing_ticks:
        parts.append(f"{record.gaps.missing_ticks} missing ticks interpolated")
    figure = style.new_figure(13.0, 8.0, f"{record.path.name} — signals", "  ·  ".join(parts))
    columns = max(len(moments), 1)
    grid = figure.add_gridspec(
        4, columns, left=0.06, right=0.985, top=0.88, bottom=0.065, hspace=0.58, wspace=0.17,
        height_ratios=(1.25, 1.0, 1.25, 1.0),
    )  # fmt: skip

    reference_mrad, angle_mrad = 1e3 * record.reference_rad, 1e3 * record.angle_rad
    angle = figure.add_subplot(grid[0, :])
    angle.plot(
        *style.envelope(record.time_s, reference_mrad), color=style.ORANGE, label="reference"
    )
    angle.plot(
        *style.envelope(record.time_s, angle_mrad), color=style.BLUE, linewidth=0.7,
        label="measured",
    )  # fmt: skip
    angle.set_title("(a) Motor angle", pad=14)
    angle.set_ylabel("Angle (mrad)")
    angle.set_ylim(style.limits(reference_mrad, angle_mrad))
    angle.legend(loc="lower right", bbox_to_anchor=(1.0, 1.07), ncols=2, borderaxespad=0.0)
    torque = figure.add_subplot(grid[2, :])
    torque.plot(*style.envelope(record.time_s, record.torque_nm), color=style.GREEN, linewidth=0.7)
    torque.set_title("(b) Coupling torque", pad=14)
    torque.set_ylabel("Torque (N·m)")
    torque.set_ylim(style.limits(record.torque_nm))
    for axes in (angle, torque):
        axes.set_xlim(record.time_s[0], record.time_s[-1])
        axes.set_xlabel("Time (s)", labelpad=1)
        mark(axes, moments)

    for column, moment in enumerate(moments):
        times_s = record.time_s[moment.samples]
        above = figure.add_subplot(grid[1, column])
        above.plot(times_s, reference_mrad[moment.samples], color=style.ORANGE)
        above.plot(times_s, angle_mrad[moment.samples], color=style.BLUE)
        below = figure.add_subplot(grid[3, column])
        below.plot(times_s, record.torque_nm[moment.samples], color=style.GREEN, linewidth=0.9)
        for axes in (above, below):
            enlarge(axes, column + 1, moment)
        if column == 0:
            above.set_ylabel("Angle (mrad)")
            below.set_ylabel("Torque (N·m)")
        below.set_xlabel("Time (s)", labelpad=1)
    return figure


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
