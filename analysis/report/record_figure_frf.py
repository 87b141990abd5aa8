"""Frequency response: what the whole record shows, and the fitted beam with its 95 % band."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report import style
from analysis.report.record_figure_axes import plain_logarithmic
from analysis.report.record_figure_bands import NORMAL_95, response_band

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify import ModeEstimate, RecordFit
    from analysis.report.record_figure_bands import ResponseBand
    from rigd.spectral import FrequencyResponse

_BAND: Final = "#8CC4E8"
_PALE: Final = "#BDBDBD"
_POINTS: Final = 900
_DETAIL_POINTS: Final = 161
_DETAIL_WIDTHS: Final = 6.0
"""Half-widths of a resonance that its detail shows to either side."""

_NARROWEST: Final = 0.006
"""Least half of a detail, relative to the mode's frequency."""


def frf_figure(name: str, measured: FrequencyResponse, fit: RecordFit) -> Figure:
    """Draw magnitude, phase, the band's width, and a detail of every mode.

    Parameters
    ----------
    name : str
        What the title calls the record.
    measured : FrequencyResponse
        Ratio of the whole record's transforms, with the delay between the channels in it.
    fit : RecordFit
    """
    first_hz, last_hz = float(measured.frequency_hz[0]), float(measured.frequency_hz[-1])
    shown = [mode for mode in fit.modes if first_hz < mode.frequency_hz < last_hz]
    grid_hz = _grid(first_hz, last_hz, [mode.frequency_hz for mode in shown])
    band = response_band(fit, grid_hz)
    seen = measured.response * np.exp(
        2j * np.pi * fit.parameters["delay_s"] * measured.frequency_hz
    )
    figure = style.new_figure(
        11.0, 8.2, f"{name} — frequency response",
        f"coupling torque over motor angle  ·  measured: ratio of the whole record's transforms, "
        f"delay removed  ·  model: type {fit.structure.name}",
    )  # fmt: skip
    count = max(len(shown), 1)
    grid = figure.add_gridspec(
        2, count, left=0.075, right=0.985, top=0.885, bottom=0.06, hspace=0.25, wspace=0.2,
        height_ratios=(3.4, 1.0),
    )  # fmt: skip
    whole = grid[0, :].subgridspec(3, 1, height_ratios=(2.4, 1.0, 0.8), hspace=0.1)
    magnitude, phase, width = (figure.add_subplot(whole[row]) for row in range(3))
    _magnitude(magnitude, measured.frequency_hz, seen, band, _PALE)
    magnitude.set_ylabel("Magnitude (dB re 1 N·m/rad)")
    modelled_db = _db(band.response)
    bottom = min(float(np.quantile(_db(seen), 0.005)), float(np.quantile(modelled_db, 0.05)))
    magnitude.set_ylim(bottom - 5, float(modelled_db.max()) + 5)
    few = style.spread(measured.frequency_hz, _POINTS)
    phase.plot(
        measured.frequency_hz[few], _phase_deg(seen[few]), ".", markersize=2.0, color=style.GREY
    )
    phase.plot(band.frequency_hz, _phase_deg(band.response), color=style.BLUE)
    phase.set_ylabel("Phase (°)")
    phase.set_ylim(-60, 240)
    phase.set_yticks((0, 90, 180))
    half_percent = 100 * NORMAL_95 * band.log_magnitude_std
    width.plot(band.frequency_hz, half_percent, color=style.BLUE, linewidth=1.0)
    plain_logarithmic(width, 0.8 * half_percent.min(), 1.4 * half_percent.max())
    width.set_ylabel("Band (± %)")
    width.set_xlabel("Frequency (Hz)", labelpad=1)
    for axes in (magnitude, phase, width):
        style.frequency_axis(axes, (first_hz, last_hz), labels=axes is width)
    for column, mode in enumerate(shown):
        detail = figure.add_subplot(grid[1, column])
        limits = _detail(mode, measured.frequency_hz)
        near = (measured.frequency_hz >= limits[0]) & (measured.frequency_hz <= limits[1])
        close = response_band(fit, np.linspace(*limits, _DETAIL_POINTS))
        _magnitude(detail, measured.frequency_hz[near], seen[near], close, style.GREY)
        detail.set_xlim(limits)
        detail.set_ylim(style.limits(_db(seen[near]), _db(close.response)))
        detail.set_title(f"Mode {mode.number}", fontweight="normal", fontsize=8.5)
        detail.set_facecolor("#FCFAF4")
        detail.set_xlabel("Frequency (Hz)", labelpad=1)
        if column == 0:
            detail.set_ylabel("Magnitude (dB)")
    figure.legend(
        *magnitude.get_legend_handles_labels(), loc="upper right", bbox_to_anchor=(0.985, 0.925),
        ncols=3, borderaxespad=0.0,
    )  # fmt: skip
    return figure


def _magnitude(
    axes: Axes,
    frequency_hz: NDArray[np.float64],
    measured: NDArray[np.complex128],
    band: ResponseBand,
    color: str,
) -> None:
    """Draw the measured magnitude, the model's over it, and its band."""
    axes.plot(
        *style.envelope(frequency_hz, _db(measured), _POINTS, logarithmic=True),
        color=color, linewidth=0.8, label="measured",
    )  # fmt: skip
    low, high = band.magnitude_limits()
    axes.fill_between(
        band.frequency_hz, _db(low), _db(high), color=_BAND, linewidth=0, alpha=0.6,
        label="95 % band of the model",
    )  # fmt: skip
    axes.plot(band.frequency_hz, _db(band.response), color=style.BLUE, linewidth=1.1, label="model")


def _detail(mode: ModeEstimate, frequency_hz: NDArray[np.float64]) -> tuple[float, float]:
    """Choose what is shown of a mode: so much that a bin of a short record lies inside, too."""
    spacing_hz = float(np.diff(frequency_hz).max())
    share = max(_DETAIL_WIDTHS * mode.damping_ratio, _NARROWEST)
    half_hz = max(share * mode.frequency_hz, spacing_hz)
    lowest_hz = float(frequency_hz[0]) / 2
    return max(mode.frequency_hz - half_hz, lowest_hz), mode.frequency_hz + half_hz


def _grid(first_hz: float, last_hz: float, peaks_hz: list[float]) -> NDArray[np.float64]:
    """Frequencies that are dense over the band and denser at the peaks, which are narrow."""
    everywhere = np.geomspace(first_hz, last_hz, _POINTS)
    offsets = np.geomspace(1e-4, 0.1, 40)
    near = [peak * (1 + np.r_[-offsets, 0.0, offsets]) for peak in peaks_hz]
    grid = np.unique(np.concatenate([everywhere, *near]))
    return np.asarray(grid[(grid >= first_hz) & (grid <= last_hz)])


def _db(values: NDArray[np.complex128] | NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(20 * np.log10(np.maximum(np.abs(values), 1e-300)))


def _phase_deg(response: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Phase from −90° to 270°: a torque over an angle lies between 0 and 180°, well inside."""
    return np.asarray(np.degrees(np.angle(response * -1j)) + 90.0)
