"""What a fit leaves of the torque: its spectrum, whether it is white, and when it is large.

A model that is right leaves noise. What is left at a resonance, or while the sweep passes one, is
what the model lacks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report import style
from analysis.report.record_figure_axes import plain_logarithmic
from analysis.report.record_figure_bands import NORMAL_95

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify import RecordAnalysis, RecordFit

_KOLMOGOROV_95: Final = 1.358
"""95 % quantile of Kolmogorov's distribution: the bounds' half-width is that over √bins."""

_BINS_A_POINT: Final = 24
_SMOOTH_POINTS: Final = 600
_STRETCHES: Final = 120
"""At most: a short record has fewer independent values."""


def residual_figure(name: str, analysis: RecordAnalysis, fit: RecordFit) -> Figure:
    """Draw the residual's spectrum, its cumulative periodogram, and its power in time.

    Parameters
    ----------
    name : str
        What the title calls the record.
    analysis : RecordAnalysis
        That the fit belongs to.
    fit : RecordFit
    """
    figure = style.new_figure(
        11.0, 6.4, f"{name} — residual",
        f"measured torque minus that of the model, type {fit.structure.name}  ·  sum of squares "
        f"{fit.cost:.6g} for {fit.degrees_of_freedom} degrees of freedom",
    )  # fmt: skip
    grid = figure.add_gridspec(
        2, 2, left=0.075, right=0.985, top=0.855, bottom=0.075, hspace=0.42, wspace=0.17,
    )  # fmt: skip
    _spectrum(figure.add_subplot(grid[0, :]), analysis, fit)
    _cumulative(figure.add_subplot(grid[1, 0]), analysis, fit)
    _in_time(figure.add_subplot(grid[1, 1]), analysis, fit)
    return figure


def _spectrum(axes: Axes, analysis: RecordAnalysis, fit: RecordFit) -> None:
    frequency_hz = analysis.frequency_hz
    density = analysis.noise_nm2_per_hz * np.abs(fit.residual) ** 2 / 2
    counted = analysis.compared
    bins = np.flatnonzero(counted)
    blocks = np.array_split(bins, max(bins.size // _BINS_A_POINT, 1))
    middle_hz = [float(frequency_hz[block].mean()) for block in blocks]
    rms = [1e3 * float(np.sqrt(density[block].mean())) for block in blocks]
    axes.plot(
        middle_hz, rms, ".", color=style.VERMILION, markersize=3.5,
        label=f"residual, mean of {_BINS_A_POINT} bins",
    )  # fmt: skip
    few = slice(None, None, max(frequency_hz.size // _SMOOTH_POINTS, 1))
    axes.plot(
        frequency_hz[few], 1e3 * np.sqrt(analysis.noise_nm2_per_hz[few]), color=style.BLUE,
        label="taken for noise",
    )  # fmt: skip
    for mode in fit.modes:
        axes.axvline(mode.frequency_hz, color="#B8B8B8", linewidth=0.8, zorder=0.5)
    for line in analysis.lines:
        axes.annotate(
            f"{line.frequency_hz:.4g} Hz hum", (line.frequency_hz, 1.0),
            xycoords=("data", "axes fraction"), xytext=(0, 2), textcoords="offset points",
            ha="center", fontsize=7.5, color=style.PURPLE,
        )  # fmt: skip
        axes.axvline(line.frequency_hz, color=style.PURPLE, linewidth=1.0, linestyle=":")
    plain_logarithmic(axes, min(rms) / 1.6, max(rms) * 1.6)
    axes.set_xlim(0.0, frequency_hz[-1])
    axes.set_title("Spectrum (grey: modes)")
    axes.set_ylabel("Torque (mN·m/√Hz)")
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)


def _cumulative(axes: Axes, analysis: RecordAnalysis, fit: RecordFit) -> None:
    counted = analysis.compared
    power = np.abs(fit.residual[counted]) ** 2
    share = np.cumsum(power) / power.sum()
    uniform = np.arange(1, power.size + 1) / power.size
    frequency_hz = analysis.frequency_hz[counted]
    half = 100 * _KOLMOGOROV_95 / np.sqrt(power.size)
    axes.axhspan(-half, half, color=style.SHADE, linewidth=0, zorder=0, label="95 % of white noise")
    difference = 100 * (share - uniform)
    axes.plot(*style.envelope(frequency_hz, difference, 400), color=style.VERMILION)
    axes.axhline(0.0, color="#9A9A9A", linewidth=0.7)
    for mode in fit.modes:
        axes.axvline(mode.frequency_hz, color="#B8B8B8", linewidth=0.8, zorder=0.5)
    reach = 1.25 * max(half, float(np.abs(difference).max()))
    axes.set_ylim(-reach, reach)
    axes.set_xlim(0.0, frequency_hz[-1])
    axes.set_title("Cumulative periodogram less that of white noise")
    axes.set_ylabel("Difference (% of power)")
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    axes.legend(loc="lower right", borderaxespad=0.1)


def _in_time(axes: Axes, analysis: RecordAnalysis, fit: RecordFit) -> None:
    times_s, power = residual_power(analysis, fit)
    half = NORMAL_95 * np.sqrt(times_s.size / np.count_nonzero(analysis.compared))
    axes.axhspan(
        max(1 - half, 0.0), 1 + half, color=style.SHADE, linewidth=0, zorder=0,
        label="95 % of white noise",
    )  # fmt: skip
    axes.plot(times_s, power, ".-", color=style.VERMILION, linewidth=0.7, markersize=3.0)
    axes.set_xlim(0.0, times_s[-1] + times_s[0])
    axes.set_ylim(0.0, 1.15 * max(float(power.max()), 1 + half))
    axes.set_title("Power in time, whitened")
    axes.set_ylabel("Over the mean of noise (1)")
    axes.set_xlabel("Time from the record's start (s)", labelpad=1)
    axes.legend(loc="lower right", borderaxespad=0.1)


def residual_power(
    analysis: RecordAnalysis, fit: RecordFit
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power of the whitened residual in stretches of the record, 1 if chance is all that remains.

    The residual's spectrum in the band, transformed back, is the complex envelope of the whitened
    residual; K bins give K independent values over the record.

    Returns
    -------
    times_s, power : ndarray, shape (stretches,)
        Middles of the stretches from the first sample compared on, and mean power in them.
    """
    spacing_hz = float(analysis.frequency_hz[1] - analysis.frequency_hz[0])
    bins = fit.residual.size
    envelope = np.abs(np.fft.ifft(fit.residual)) ** 2 * bins / 2
    envelope *= bins / np.count_nonzero(analysis.compared)
    stretches = min(_STRETCHES, bins)
    power: NDArray[np.float64] = np.array(
        [part.mean() for part in np.array_split(envelope, stretches)]
    )
    times_s = (np.arange(stretches, dtype=np.float64) + 0.5) / (stretches * spacing_hz)
    return times_s, power
