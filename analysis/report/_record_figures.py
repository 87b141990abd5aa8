"""Figures of a whole record: frequency response, uniformity, loss factor, residual.

The loss factor over frequency, with its 95 % band, shows the damping as a function. The parameters
of a fractional damping are correlated and hard to compare, but their joint effect at one frequency
is not.

The residual of the torque is shown by its spectrum, by a test for whiteness and over time. A
correct model leaves noise. A residual at a resonance, or while the sweep passes a resonance, shows
a deficiency of the model.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from analysis.decimation import fast_fft_length
from analysis.report import _style as style
from analysis.report._shown_model import ShownModel
from analysis.report._style import Illustration
from analysis.report._uniformity import uniformity_description, uniformity_figure
from analysis.report.bands import dense_grid, loss_estimate, loss_factors, supported_band_hz
from analysis.report.folder import FIGURES, UNIFORMITY_FIGURE
from analysis.statistics import KOLMOGOROV_95, NORMAL_95
from rigd.beam import undamped_frequencies_rad_s
from rigd.spectral import fft_response, magnitude_db, phase_deg

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify import ModeEstimate, RecordAnalysis
    from analysis.identify.headline import Headline
    from analysis.report.bands import FittedPlant, ResponseBand
    from analysis.results import WholeRecord
    from rigd.spectral import FrequencyResponse


_LABEL_HEIGHT_IN: Final = 0.15
"""Height of a tick label with the space around it, in inches."""
_MIN_LABELS_PER_DECADE: Final = 1 / math.log10(2.0)
"""Number of labels that must fit into a decade of an axis so that 1, 2 and 5 are labelled."""


def set_plain_logarithmic_axis(axes: Axes, lower_limit: float, upper_limit: float) -> None:
    """Make the vertical axis logarithmic within the limits, with as many labels as fit."""
    axes.set_yscale("log")
    axes.set_ylim(lower_limit, upper_limit)
    if upper_limit < 5 * lower_limit:
        axes.yaxis.set_major_locator(MaxNLocator(4))
    else:
        height_in = axes.bbox.height / axes.figure.dpi
        labels_per_decade = height_in / (_LABEL_HEIGHT_IN * math.log10(upper_limit / lower_limit))
        leading_digits = (
            (1.0, 2.0, 5.0)
            if upper_limit < 1000 * lower_limit and labels_per_decade > _MIN_LABELS_PER_DECADE
            else (1.0,)
        )
        axes.yaxis.set_major_locator(LogLocator(subs=leading_digits, numticks=12))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _position: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


_BAND_COLOR: Final = "#8CC4E8"
"""Colour of the 95 % band of a response."""
_MEASURED_COLOR: Final = "#BDBDBD"
"""Colour of the measured response behind the model."""
_RESPONSE_POINTS: Final = 900
"""Number of points of the measured response that the panel of the whole band shows."""
_DETAIL_POINTS: Final = 161
"""Number of points of the model's response in the enlarged panel of a mode."""
_DETAIL_HALF_WIDTHS: Final = 6.0
"""Frequency range on either side of a mode in its enlarged panel, in half-widths of the peak."""

_MIN_RELATIVE_DETAIL_WIDTH: Final = 0.006
"""Least frequency range on either side of a mode in its enlarged panel, relative to the mode."""


def frf_figure(measured_frf: FrequencyResponse, model: ShownModel) -> Figure:
    """Draw a record's response: magnitude, phase, 95 % band, and an enlarged panel of each mode.

    Parameters
    ----------
    measured_frf : FrequencyResponse
        Empirical transfer function estimate, which includes the delay between the channels.
    model : ShownModel
        Model of the record, with the modes that get an enlarged panel.
    """
    first_hz, last_hz = float(measured_frf.frequency_hz[0]), float(measured_frf.frequency_hz[-1])
    visible_modes = [
        visible_mode
        for visible_mode in model.modes
        if first_hz < visible_mode.frequency_hz < last_hz
    ]
    grid_hz = dense_grid(
        first_hz, last_hz, [visible_mode.frequency_hz for visible_mode in visible_modes]
    )
    model_band = model.band(grid_hz)
    measured_without_delay = measured_frf.response * np.exp(
        2j * np.pi * model.delay_s * measured_frf.frequency_hz
    )
    figure = style.new_figure(9.0, 6.4)
    panel_count = max(len(visible_modes), 1)
    grid = figure.add_gridspec(
        2, panel_count, left=0.085, right=0.985, top=0.95, bottom=0.075, hspace=0.27, wspace=0.22,
        height_ratios=(3.4, 1.0),
    )  # fmt: skip
    upper_grid = grid[0, :].subgridspec(3, 1, height_ratios=(2.4, 1.0, 0.8), hspace=0.1)
    magnitude_axes, phase_axes, width_axes = (
        figure.add_subplot(upper_grid[row]) for row in range(3)
    )
    _draw_magnitude(
        magnitude_axes,
        measured_frf.frequency_hz,
        measured_without_delay,
        model_band,
        _MEASURED_COLOR,
    )
    modelled_db = magnitude_db(model_band.response)
    lowest_db = min(
        float(np.quantile(magnitude_db(measured_without_delay), 0.005)),
        float(np.quantile(modelled_db, 0.05)),
    )
    magnitude_axes.set_ylim(lowest_db - 5, float(modelled_db.max()) + 5)
    point_indices = style.log_spaced_indices(measured_frf.frequency_hz, _RESPONSE_POINTS)
    style.draw_dots(
        phase_axes,
        measured_frf.frequency_hz[point_indices],
        phase_deg(measured_without_delay[point_indices]),
        size_pt=2.0,
        color=style.GREY,
    )
    phase_axes.plot(model_band.frequency_hz, phase_deg(model_band.response), color=style.BLUE)
    style.set_response_axes(magnitude_axes, phase_axes)
    half_width_percent = 100 * NORMAL_95 * model_band.log_magnitude_std
    width_axes.plot(model_band.frequency_hz, half_width_percent, color=style.BLUE, linewidth=1.0)
    set_plain_logarithmic_axis(
        width_axes, 0.8 * half_width_percent.min(), 1.4 * half_width_percent.max()
    )
    width_axes.set_ylabel("Band (± %)")
    width_axes.set_xlabel("Frequency (Hz)", labelpad=1)
    for response_panel in (magnitude_axes, phase_axes, width_axes):
        style.set_frequency_axis(
            response_panel, (first_hz, last_hz), with_labels=response_panel is width_axes
        )
    for panel_number, visible_mode in enumerate(visible_modes):
        detail_axes = figure.add_subplot(grid[1, panel_number])
        detail_limits_hz = _detail_range_hz(visible_mode, measured_frf.frequency_hz)
        is_in_detail = (measured_frf.frequency_hz >= detail_limits_hz[0]) & (
            measured_frf.frequency_hz <= detail_limits_hz[1]
        )
        detail_band = model.band(np.linspace(*detail_limits_hz, _DETAIL_POINTS))
        _draw_magnitude(
            detail_axes,
            measured_frf.frequency_hz[is_in_detail],
            measured_without_delay[is_in_detail],
            detail_band,
            style.GREY,
        )
        detail_axes.set_xlim(detail_limits_hz)
        detail_axes.set_ylim(
            style.axis_limits(
                magnitude_db(measured_without_delay[is_in_detail]),
                magnitude_db(detail_band.response),
            )
        )
        detail_axes.set_title(f"Mode {visible_mode.number}", fontweight="normal", fontsize=8.5)
        detail_axes.set_facecolor("#FCFAF4")
        detail_axes.set_xlabel("Frequency (Hz)", labelpad=1)
        if panel_number == 0:
            detail_axes.set_ylabel("Magnitude (dB)")
    figure.legend(
        *magnitude_axes.get_legend_handles_labels(), loc="upper right",
        bbox_to_anchor=(0.985, 0.995),
        ncols=3, borderaxespad=0.0,
    )  # fmt: skip
    return figure


def _draw_magnitude(
    axes: Axes,
    frequency_hz: NDArray[np.float64],
    measured_frf: NDArray[np.complex128],
    model_band: ResponseBand,
    curve_color: str,
) -> None:
    """Draw the measured magnitude, and on top the model's magnitude with its 95 % band."""
    axes.plot(
        *style.envelope(
            frequency_hz, magnitude_db(measured_frf), _RESPONSE_POINTS, logarithmic=True
        ),
        color=curve_color, linewidth=0.8, label="measured",
    )  # fmt: skip
    lower_db, upper_db = (
        magnitude_db(magnitude_limit.astype(complex))
        for magnitude_limit in model_band.magnitude_limits()
    )
    axes.fill_between(
        model_band.frequency_hz, lower_db, upper_db, color=_BAND_COLOR, linewidth=0, alpha=0.6,
        label="95 % band of the model",
    )  # fmt: skip
    axes.plot(
        model_band.frequency_hz, magnitude_db(model_band.response), color=style.BLUE, linewidth=1.1,
        label="model",
    )  # fmt: skip


def _detail_range_hz(mode: ModeEstimate, frequency_hz: NDArray[np.float64]) -> tuple[float, float]:
    """Return the frequency range of a mode's enlarged panel, with at least one bin."""
    bin_spacing_hz = float(np.diff(frequency_hz).max())
    relative_width = max(_DETAIL_HALF_WIDTHS * mode.damping_ratio, _MIN_RELATIVE_DETAIL_WIDTH)
    half_width_hz = max(relative_width * mode.frequency_hz, bin_spacing_hz)
    lowest_hz = float(frequency_hz[0]) / 2
    return max(mode.frequency_hz - half_width_hz, lowest_hz), mode.frequency_hz + half_width_hz


_LOSS_FACTOR_POINTS: Final = 400
"""Number of frequencies at which the loss factors are drawn."""
_CURVE_STYLES: Final = {
    "internal (material and clamp)": (style.VERMILION, (0, (4, 2))),
    "external (surroundings)": (style.GREEN, (0, (1, 1.2))),
    "total": (style.BLUE, "-"),
}
"""Colour and dash of each loss factor's curve by its label."""
_MAX_LOSS_AXIS_RATIO: Final = 300.0
"""Largest ratio of the ends of the loss factor's axis.

Smaller loss factors do not matter for the total."""


def loss_figure(
    mode_estimates: Sequence[ModeEstimate],
    loss_model: FittedPlant | None,
    axis_hz: tuple[float, float],
    supported_hz: tuple[float, float] | None,
    *,
    unsupported_orders: Collection[str] = (),
    flagged_modes: Collection[int] = (),
) -> Figure:
    """Draw internal, external and total loss factor, and twice the damping ratio of each mode.

    The modes are points, hollow for those whose damping ratio is flagged. The loss factors are
    those of `loss_model`, drawn only in the band `supported_hz`. There are no curves if
    `loss_model` is None, because no beam is known to explain the losses, or `supported_hz` is None,
    because the data do not support the curves at any frequency. If the data do not support one of
    the orders, the total is not split into its parts. The frequencies of the axis are positive.
    """
    figure = style.new_figure(9.0, 3.6)
    axes = figure.add_axes((0.085, 0.13, 0.90, 0.775))
    drawn_loss_factors = _draw_loss_factors(
        axes, loss_model, axis_hz, supported_hz, unsupported_orders
    )
    for legend_label, is_filled in (("modes", True), ("modes, doubtful", False)):
        drawn_modes = [
            mode_estimate
            for mode_estimate in mode_estimates
            if (mode_estimate.number not in flagged_modes) is is_filled
        ]
        if drawn_modes:
            axes.errorbar(
                [mode_estimate.frequency_hz for mode_estimate in drawn_modes],
                [2 * mode_estimate.damping_ratio for mode_estimate in drawn_modes],
                [2 * NORMAL_95 * mode_estimate.damping_ratio_std for mode_estimate in drawn_modes],
                fmt="o", color=style.INK, markersize=4.0, capsize=3.0, elinewidth=1.0,
                markerfacecolor=style.INK if is_filled else "white", label=legend_label, zorder=5,
            )  # fmt: skip
    modes_hz = [mode_estimate.frequency_hz for mode_estimate in mode_estimates]
    grey_bands_hz = (
        [] if loss_model is None else _unsupported_ranges_hz(axis_hz, supported_hz, modes_hz)
    )
    for band_edge_hz, band_end_hz in grey_bands_hz:
        axes.axvspan(band_edge_hz, band_end_hz, color="#F4F4F4", linewidth=0, zorder=0)
    style.set_frequency_axis(axes, axis_hz)
    mode_loss_factors = [2 * mode_estimate.damping_ratio for mode_estimate in mode_estimates]
    # A quantile of each curve, because a total may rise without bound towards an end.
    highest_loss = max(
        [
            *mode_loss_factors,
            *(float(np.nanquantile(loss_values, 0.98)) for loss_values in drawn_loss_factors),
        ],
        default=1.0,
    )
    lowest_loss = min(
        [
            *mode_loss_factors,
            *(float(np.nanmin(loss_values)) for loss_values in drawn_loss_factors),
        ],
        default=highest_loss,
    )
    set_plain_logarithmic_axis(
        axes, max(lowest_loss / 2, 3 * highest_loss / _MAX_LOSS_AXIS_RATIO), 3 * highest_loss
    )
    axes.set_ylabel("Loss factor (1)")
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    legend_handles, legend_labels = axes.get_legend_handles_labels()
    if legend_handles:
        figure.legend(
            legend_handles, legend_labels, loc="upper right", bbox_to_anchor=(0.985, 0.99), ncols=4,
            borderaxespad=0.0,
        )  # fmt: skip
    return figure


def _draw_loss_factors(
    axes: Axes,
    loss_model: FittedPlant | None,
    axis_hz: tuple[float, float],
    supported_hz: tuple[float, float] | None,
    unsupported_orders: Collection[str],
) -> list[NDArray[np.float64]]:
    """Draw the loss factors in the band in which the data determine them.

    Return the drawn values of each curve, for the limits of the axis.
    """
    if supported_hz is None or loss_model is None:
        return []
    first_hz, last_hz = max(axis_hz[0], supported_hz[0]), min(axis_hz[1], supported_hz[1])
    if first_hz >= last_hz:
        return []
    loss_factors_over_frequency = loss_factors(
        loss_model, np.geomspace(first_hz, last_hz, _LOSS_FACTOR_POINTS)
    )
    loss_curves = dict(
        zip(
            _CURVE_STYLES,
            (
                loss_factors_over_frequency.internal,
                loss_factors_over_frequency.external,
                loss_factors_over_frequency.total,
            ),
            strict=True,
        )
    )
    has_both_parts = None not in loss_curves.values()
    drawn_loss_factors = []
    for (curve_label, loss_factor), draw_order in zip(
        loss_curves.items(), ("alpha", "lambda", None), strict=True
    ):
        # If one part is unknown, the parts are not distinguished; alone, a part is the total.
        if loss_factor is None or (
            draw_order is not None and (not has_both_parts or unsupported_orders)
        ):
            continue
        curve_color, line_dash = _CURVE_STYLES[curve_label]
        axes.fill_between(
            loss_factors_over_frequency.frequency_hz,
            *loss_factor.limits(),
            color=curve_color,
            alpha=0.2,
            linewidth=0,
        )
        axes.plot(
            loss_factors_over_frequency.frequency_hz,
            loss_factor.value,
            color=curve_color,
            linestyle=line_dash,
            label=curve_label,
        )
        drawn_loss_factors.append(loss_factor.value)
    return drawn_loss_factors


def _unsupported_ranges_hz(
    axis_hz: tuple[float, float],
    supported_hz: tuple[float, float] | None,
    modes_hz: list[float],
) -> list[tuple[float, float]]:
    """Return the frequency ranges to be shaded: beyond the modes, and outside `supported_hz`."""
    if not modes_hz:
        return [axis_hz]
    first_hz, last_hz = modes_hz[0], modes_hz[-1]
    if supported_hz is not None:
        first_hz, last_hz = max(first_hz, supported_hz[0]), min(last_hz, supported_hz[1])
    return [(axis_hz[0], first_hz), (last_hz, axis_hz[1])]


_BINS_PER_POINT: Final = 24
"""Number of frequency bins that are averaged to one point of the residual's spectrum."""
_NOISE_MODEL_POINTS: Final = 600
"""Number of points of the noise model's curve."""
_MAX_TIME_INTERVALS: Final = 120
"""Largest number of intervals in which the residual's power over time is shown.

A short record has fewer independent values."""


def residual_figure(model: ShownModel, analysis: RecordAnalysis) -> Figure:
    """Draw the spectrum, cumulative periodogram and power over time of a model's residual."""
    figure = style.new_figure(9.0, 4.8)
    grid = figure.add_gridspec(
        2, 2, left=0.085, right=0.985, top=0.94, bottom=0.095, hspace=0.45, wspace=0.19,
    )  # fmt: skip
    _draw_spectrum(figure.add_subplot(grid[0, :]), model, analysis)
    _draw_cumulative_periodogram(figure.add_subplot(grid[1, 0]), model, analysis)
    _draw_power_over_time(figure.add_subplot(grid[1, 1]), model, analysis)
    return figure


def _draw_spectrum(axes: Axes, model: ShownModel, analysis: RecordAnalysis) -> None:
    """Draw the spectrum of the residual with the noise model, the modes and the hum."""
    frequency_hz = analysis.frequency_hz
    density_nm2_per_hz = analysis.noise_nm2_per_hz * np.abs(model.residual) ** 2 / 2
    is_compared = analysis.is_compared
    compared_bins = np.flatnonzero(is_compared)
    bin_blocks = np.array_split(compared_bins, max(compared_bins.size // _BINS_PER_POINT, 1))
    block_middle_hz = [float(frequency_hz[bin_block].mean()) for bin_block in bin_blocks]
    rms_mnm_values = [
        1e3 * float(np.sqrt(density_nm2_per_hz[bin_block].mean())) for bin_block in bin_blocks
    ]
    axes.plot(
        block_middle_hz, rms_mnm_values, ".", color=style.VERMILION, markersize=3.5,
        label=f"residual, mean of {_BINS_PER_POINT} bins",
    )  # fmt: skip
    point_slice = slice(None, None, max(frequency_hz.size // _NOISE_MODEL_POINTS, 1))
    axes.plot(
        frequency_hz[point_slice], 1e3 * np.sqrt(analysis.noise_nm2_per_hz[point_slice]),
        color=style.BLUE, label="noise model",
    )  # fmt: skip
    for mode in model.modes:
        axes.axvline(mode.frequency_hz, color="#B8B8B8", linewidth=0.8, zorder=0.5)
    for hum_line in analysis.lines:
        axes.annotate(
            f"{hum_line.frequency_hz:.4g} Hz disturbance", (hum_line.frequency_hz, 1.0),
            xycoords=("data", "axes fraction"), xytext=(0, 2), textcoords="offset points",
            ha="center", fontsize=7.5, color=style.PURPLE,
        )  # fmt: skip
        axes.axvline(hum_line.frequency_hz, color=style.PURPLE, linewidth=1.0, linestyle=":")
    set_plain_logarithmic_axis(axes, min(rms_mnm_values) / 1.6, max(rms_mnm_values) * 1.6)
    axes.set_xlim(0.0, frequency_hz[-1])
    axes.set_title("Spectrum (grey: modes)")
    axes.set_ylabel("Torque (mN·m/√Hz)")
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)


def _draw_cumulative_periodogram(axes: Axes, model: ShownModel, analysis: RecordAnalysis) -> None:
    """Draw the residual's cumulative periodogram minus white noise's, with the 95 % range."""
    is_compared = analysis.is_compared
    bin_power = np.abs(model.residual[is_compared]) ** 2
    cumulative_power = np.cumsum(bin_power) / bin_power.sum()
    uniform_distribution = np.arange(1, bin_power.size + 1) / bin_power.size
    frequency_hz = analysis.frequency_hz[is_compared]
    half_range_percent = 100 * KOLMOGOROV_95 / np.sqrt(bin_power.size)
    axes.axhspan(
        -half_range_percent,
        half_range_percent,
        color=style.SHADE_COLOR,
        linewidth=0,
        zorder=0,
        label="95 % of white noise",
    )
    difference_percent = 100 * (cumulative_power - uniform_distribution)
    axes.plot(*style.envelope(frequency_hz, difference_percent, 400), color=style.VERMILION)
    axes.axhline(0.0, color="#9A9A9A", linewidth=0.7)
    for mode in model.modes:
        axes.axvline(mode.frequency_hz, color="#B8B8B8", linewidth=0.8, zorder=0.5)
    axis_limit = 1.25 * max(half_range_percent, float(np.abs(difference_percent).max()))
    axes.set_ylim(-axis_limit, axis_limit)
    axes.set_xlim(0.0, frequency_hz[-1])
    axes.set_title("Cumulative periodogram less that of white noise")
    axes.set_ylabel("Difference (% of power)")
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    axes.legend(loc="lower right", borderaxespad=0.1)


def _draw_power_over_time(axes: Axes, model: ShownModel, analysis: RecordAnalysis) -> None:
    """Draw the power of the whitened residual over time, with the 95 % range of white noise."""
    times_s, interval_power = residual_power(analysis, model.residual)
    half_range = NORMAL_95 * np.sqrt(times_s.size / np.count_nonzero(analysis.is_compared))
    axes.axhspan(
        max(1 - half_range, 0.0), 1 + half_range, color=style.SHADE_COLOR, linewidth=0, zorder=0,
        label="95 % of white noise",
    )  # fmt: skip
    axes.plot(times_s, interval_power, ".-", color=style.VERMILION, linewidth=0.7, markersize=3.0)
    axes.set_xlim(0.0, times_s[-1] + times_s[0])
    axes.set_ylim(0.0, 1.15 * max(float(interval_power.max()), 1 + half_range))
    axes.set_title("Power in time, whitened")
    axes.set_ylabel("Over the mean of noise (1)")
    axes.set_xlabel("Time from the record's start (s)", labelpad=1)
    axes.legend(loc="lower right", borderaxespad=0.1)


def residual_power(
    analysis: RecordAnalysis, residual: NDArray[np.complex128]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the whitened residual's power in intervals of the record; it is 1 for pure noise.

    Return the time of the middle of each interval, in seconds since the first compared sample, and
    the mean power in the interval, both of the shape (intervals,).

    The envelope of the whitened residual is the inverse transform of its spectrum in the band. K
    frequency bins give K independent values over the record.
    """
    bin_spacing_hz = float(analysis.frequency_hz[1] - analysis.frequency_hz[0])
    bin_count = residual.size
    envelope_power = np.abs(np.fft.ifft(residual)) ** 2 * bin_count / 2
    envelope_power *= bin_count / np.count_nonzero(analysis.is_compared)
    interval_count = min(_MAX_TIME_INTERVALS, bin_count)
    interval_power: NDArray[np.float64] = np.array(
        [
            interval_envelope.mean()
            for interval_envelope in np.array_split(envelope_power, interval_count)
        ]
    )
    times_s = (np.arange(interval_count, dtype=np.float64) + 0.5) / (
        interval_count * bin_spacing_hz
    )
    return times_s, interval_power


def illustrations(whole_record: WholeRecord) -> Iterator[Illustration]:
    """Yield the figures of a whole record."""
    from analysis.report._signal_figures import signals_figure

    highest_hz, headline = whole_record.band_hz[1], whole_record.headline
    model = ShownModel.from_headline(headline, whole_record.record)
    analysis = model.analysis_of_residual(whole_record.analysis)
    modes_text = ", ".join(f"{mode.frequency_hz:.3g}" for mode in model.modes)
    frf, _, loss_name, residual_name, signals_name = FIGURES
    measured_frf = measured_response(whole_record)
    delay_text = "delay" if model.modal is None else "the delay that the file states"
    yield Illustration(
        frf,
        partial(frf_figure, measured_frf, model),
        "Frequency response from motor angle to coupling torque: magnitude and phase, measured "
        f"(empirical transfer function estimate, {delay_text} removed) and of {model.name}; "
        f"half-width of the model's 95 % band; details of the modes ({modes_text} Hz). Where no "
        "band is visible, it is narrower than the line.",
    )
    uniformity_test = headline.uniform_beam
    if uniformity_test is not None and uniformity_test.p_value is not None:
        yield Illustration(
            UNIFORMITY_FIGURE,
            partial(uniformity_figure, uniformity_test),
            uniformity_description(uniformity_test),
        )
    loss_model = loss_estimate(whole_record)
    flagged_modes = [mode.number for mode in headline.modes if mode.damping_ratio.flag is not None]
    yield Illustration(
        loss_name,
        partial(
            loss_figure,
            model.modes,
            loss_model,
            (float(measured_frf.frequency_hz[0]), highest_hz),
            supported_band_hz(whole_record),
            unsupported_orders=whole_record.withheld_orders,
            flagged_modes=flagged_modes,
        ),
        _loss_description(whole_record, has_curves=loss_model is not None),
    )
    mean_power_ratio = float(np.mean(np.abs(model.residual[analysis.is_compared]) ** 2)) / 2
    yield Illustration(
        residual_name,
        partial(residual_figure, model, analysis),
        f"Residual of the torque, measured minus that of {model.name}: its spectrum with the noise "
        "model; its cumulative periodogram, which stays in the shaded range in 95 of 100 records "
        "or more if only noise is left; and its power through the record. Excess power at a mode "
        f"or at one time shows an effect that the model lacks. Mean power {mean_power_ratio:.4g} "
        "times that of the noise.",
    )
    yield Illustration(
        signals_name,
        partial(signals_figure, whole_record.record, model, highest_hz),
        f"Motor angle; coupling torque from 0 to {highest_hz:g} Hz, measured and as {model.name} "
        "predicts it from the measured angle "
        f"(fit {model.fit_percent(whole_record.analysis):.2f} % NRMSE); residual; below, "
        "where each mode rings most.",
    )


def _loss_description(whole_record: WholeRecord, *, has_curves: bool) -> str:
    """Return the caption of the loss factor's figure."""
    points_text = "twice the damping ratio of each mode with its 95 % interval"
    reasons_text = _reasons_of_hollow_points(whole_record.headline)
    if not has_curves:
        estimate = whole_record.headline.tolerant
        cause_text = (
            "an order of the beam was fitted to the frequencies, which are not those of a uniform "
            "beam"
            if estimate is not None and estimate.basis != "none"
            else "no beam with one internal and one external order explains the losses"
        )
        return (
            f"Loss factor over frequency: {points_text}. There is no curve, because {cause_text}."
            f"{reasons_text}"
        )
    curves_text = (
        f"Loss factor over frequency with 95 % bands, {_describe_curve_model(whole_record)}; "
        f"points: {points_text}. "
    )
    if whole_record.withheld_orders:
        return curves_text + (
            "It is that of all damping, not split into internal and external, and is drawn between "
            "the visible modes only: elsewhere (grey), and for each of the two, it would depend on "
            f"an order that the data do not support.{reasons_text}"
        )
    return curves_text + (
        "At a mode the loss factor is about twice the damping ratio. Between the modes the model "
        "interpolates, outside them (grey) it extrapolates; where the torque is not above the "
        f"noise, nothing is drawn.{reasons_text}"
    )


def _describe_curve_model(whole_record: WholeRecord) -> str:
    """Return a text that states to which beam model the loss factor's curves belong."""
    tolerant_estimate = whole_record.headline.tolerant
    if tolerant_estimate is None:
        return f"type {whole_record.headline.name}"
    if tolerant_estimate.basis == "losses":
        return "of both dampings by damping ratios and residue phases alone"
    tolerance_percent = 100 * tolerant_estimate.uniformity
    return (
        f"of a beam whose mode frequencies are those of a uniform beam to {tolerance_percent:g} %"
    )


def _reasons_of_hollow_points(headline: Headline) -> str:
    """Return a sentence that states why some points are hollow; empty if there are none."""
    flag_texts = dict.fromkeys(
        mode.damping_ratio.flag for mode in headline.modes if mode.shown and mode.damping_ratio.flag
    )
    return f" Hollow points are doubtful: {'; '.join(map(str, flag_texts))}." if flag_texts else ""


def measured_response(whole_record: WholeRecord) -> FrequencyResponse:
    """Return the empirical transfer function estimate from below the first mode to the band's end.

    The delay between the channels is not removed from it.
    """
    record = whole_record.record
    angle_from_rest_rad = record.angle_rad - (record.rest_angle_rad or 0.0)
    response = fft_response(
        angle_from_rest_rad,
        record.torque_nm,
        record.rate_hz,
        fast_fft_length(len(angle_from_rest_rad)),
    )
    first_mode_hz = float(undamped_frequencies_rad_s(whole_record.fit.plant.beam, 1)[0]) / (
        2 * np.pi
    )
    first_hz, last_hz = whole_record.band_hz
    response = response.band(max(first_hz, min(first_mode_hz / 4, last_hz / 4)), last_hz)
    is_finite = np.isfinite(response.response)
    return replace(
        response,
        frequency_hz=response.frequency_hz[is_finite],
        response=response.response[is_finite],
    )
