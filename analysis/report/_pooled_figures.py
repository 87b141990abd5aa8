"""Figures of a campaign's pooled estimate: damping over frequency, frequency response."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.specimen_sentences import pooled_title
from analysis.models import ESTIMATOR_NAMES, STRUCTURES
from analysis.report import _style as style
from analysis.report._campaign_figures import (
    INTERVAL_COLOR,
    SESSION_COLOR,
    draw_session,
    shown_sessions,
)
from analysis.report._pooled_tables import exact_condition_text, session_count_text
from analysis.report.bands import dense_grid, loss_factors, response_band
from analysis.statistics import NORMAL_95, student_t_quantile
from rigd.spectral import magnitude_db, phase_deg

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.campaigns import CampaignResult
    from analysis.campaigns.pooling import PooledEstimate, PooledMode
    from analysis.identify import ModeEstimate
    from analysis.models import Structure
    from rigd.beam import Plant

_FREEST_TYPE: Final = "VI"
"""Damping structure with internal and external damping, both of free order."""

_LOSS_FACTOR_POINTS: Final = 400
"""Number of frequencies at which the pooled loss factor is drawn."""
_RESPONSE_DECIMATION_COLUMNS: Final = 1500
"""Number of columns into which the sessions' responses are decimated."""
_AXIS_END_RATIO: Final = 1.6
"""Ratio by which the frequency axis extends beyond the first and the last mode."""


@dataclass(frozen=True, slots=True)
class _PooledFit:
    """Pooled estimate of a campaign in the form of a `FittedPlant`, from which bands are drawn."""

    structure: Structure
    plant: Plant
    parameters: Mapping[str, float]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]

    @classmethod
    def from_campaign(cls, campaign: CampaignResult) -> _PooledFit | None:
        """Return the pooled estimate whose parameters a campaign reports; None if there is none."""
        modal_result, pooled_estimate = campaign.modal, campaign.freest
        tolerant_estimate = modal_result.tolerant if modal_result else None
        if tolerant_estimate is None:
            return None if pooled_estimate is None else cls.from_estimate(pooled_estimate)
        if tolerant_estimate.basis == "none":
            return None
        return cls(
            structure=STRUCTURES[_FREEST_TYPE],
            plant=tolerant_estimate.plant,
            parameters=tolerant_estimate.values,
            determined=tuple(tolerant_estimate.std),
            covariance=tolerant_estimate.covariance,
        )

    @classmethod
    def from_estimate(cls, pooled_estimate: PooledEstimate) -> _PooledFit:
        """Return a pooled estimate whose covariance is enlarged for the number of sessions.

        Intervals of 1.96 standard deviations are then as wide as those of Student's t distribution.
        """
        # Bands are 1.96 standard deviations wide, but Student's t of a few sessions is larger.
        interval_ratio = student_t_quantile(0.95, pooled_estimate.sessions - 1) / NORMAL_95
        return cls(
            structure=STRUCTURES[pooled_estimate.structure],
            plant=pooled_estimate.plant,
            parameters={
                **pooled_estimate.plant.parameters,
                **{parameter.name: parameter.value for parameter in pooled_estimate.parameters},
            },
            determined=tuple(parameter.name for parameter in pooled_estimate.parameters),
            covariance=interval_ratio**2 * pooled_estimate.covariance,
        )  # fmt: skip


# Damping


def damping_figure(campaign: CampaignResult) -> Figure:
    """Draw the damping ratios of all sessions' modes over frequency, with the pooled values.

    The upper panel shows all modes, and between them half the loss factor of the pooled estimate
    with its 95 % band. The lower panels show each mode enlarged.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    pooled_estimate = campaign.freest
    assert pooled_estimate is not None
    pooled_modes, session_count = campaign.modes, _session_count_of_modes(campaign, pooled_estimate)
    width_in, height_in = 11.0, 6.6
    figure = style.new_figure(
        width_in, height_in,
        pooled_title(
            f"Damping against frequency, {session_count_text(pooled_estimate, campaign)}",
            campaign.homogeneity,
        ),
        f"{_source_of_modes(campaign, pooled_estimate)}  ·  curve: half the pooled loss factor "
        "between the modes  ·  below: each mode, frequency from the pooled mean",
    )  # fmt: skip
    grid = figure.add_gridspec(
        2, len(pooled_modes), left=0.075, right=0.985, top=1 - 0.95 / height_in,
        bottom=0.5 / height_in,
        height_ratios=(1.25, 1.0), hspace=0.32, wspace=0.28,
    )  # fmt: skip
    upper_axes = figure.add_subplot(grid[0, :])
    _draw_loss_factor(upper_axes, pooled_modes, _PooledFit.from_campaign(campaign))
    for panel_number, pooled_mode in enumerate(pooled_modes):
        session_modes = _session_estimates_of_mode(campaign, pooled_estimate, pooled_mode)
        upper_axes.plot(
            [session_mode.frequency_hz for session_mode in session_modes],
            [100 * session_mode.damping_ratio for session_mode in session_modes], "o",
            color=style.INK, markersize=3.0,
        )  # fmt: skip
        _draw_pooled_mode(upper_axes, pooled_mode, session_count)
        _draw_enlarged_mode(
            figure.add_subplot(grid[1, panel_number]), pooled_mode, session_modes, session_count
        )
    figure.axes[1].set_ylabel("Damping ratio (%)")
    style.set_frequency_axis(
        upper_axes,
        (
            pooled_modes[0].frequency_hz / _AXIS_END_RATIO,
            pooled_modes[-1].frequency_hz * _AXIS_END_RATIO,
        ),
    )
    upper_axes.set_ylim(bottom=0.0)
    upper_axes.margins(y=0.1)
    upper_axes.set_ylabel("Damping ratio (%)")
    upper_axes.set_xlabel("Frequency (Hz)", labelpad=1)
    legend_handles = [
        Line2D([], [], color=style.INK, marker="o", markersize=3, linewidth=0.9,
               label="session, ± 1.96 of its standard deviation"),
        Line2D([], [], color=style.BLUE, marker="D", markersize=4, label="pooled"),
        Patch(facecolor=INTERVAL_COLOR, label="its 95 % interval"),
    ]  # fmt: skip
    style.add_legend(figure, legend_handles, column_count=3)
    return figure


def _source_of_modes(campaign: CampaignResult, pooled_estimate: PooledEstimate) -> str:
    """Return the name of the model from which the modes are computed."""
    is_modal = campaign.modal is not None and campaign.modal.replaces_beam_modes
    return "modal model" if is_modal else f"type {pooled_estimate.name}"


def _session_count_of_modes(campaign: CampaignResult, pooled_estimate: PooledEstimate) -> int:
    """Return the number of sessions from which the modes are pooled."""
    modal_result = campaign.modal
    return (
        modal_result.sessions
        if modal_result is not None and modal_result.replaces_beam_modes
        else pooled_estimate.sessions
    )


def _session_estimates_of_mode(
    campaign: CampaignResult, pooled_estimate: PooledEstimate, mode: PooledMode
) -> list[ModeEstimate]:
    """Return each session's estimate of one mode, from the same model as the pooled mode."""
    if mode.source == "modal":
        modal_fits = (session.modal for session in campaign.sessions)
        return [
            modal_fit.mode(mode.number)
            for modal_fit in modal_fits
            if modal_fit and mode.number in modal_fit.visible_mode_numbers
        ]
    return [
        mode_estimate
        for session in campaign.sessions
        for estimate in session.record_estimates
        for mode_estimate in estimate.fit.modes
        if estimate.name == pooled_estimate.name and mode_estimate.number == mode.number
    ]


def _draw_loss_factor(
    axes: Axes, pooled_modes: Sequence[PooledMode], fit: _PooledFit | None
) -> None:
    """Draw the damping ratio (half the pooled loss factor) between the first and the last mode."""
    if len(pooled_modes) < 2 or fit is None:
        return
    frequency_hz = np.geomspace(
        pooled_modes[0].frequency_hz, pooled_modes[-1].frequency_hz, _LOSS_FACTOR_POINTS
    )
    total_loss_factor = loss_factors(fit, frequency_hz).total
    lower_limit, upper_limit = total_loss_factor.limits()
    axes.fill_between(
        frequency_hz, 50 * lower_limit, 50 * upper_limit, color=INTERVAL_COLOR, linewidth=0
    )
    axes.plot(frequency_hz, 50 * total_loss_factor.value, color=style.BLUE)


def _draw_pooled_mode(axes: Axes, mode: PooledMode, session_count: int) -> None:
    """Draw a pooled mode with the 95 % interval of its damping ratio."""
    half_width_percent = 100 * student_t_quantile(0.95, session_count - 1) * mode.damping_ratio_std
    axes.errorbar(
        [mode.frequency_hz], [100 * mode.damping_ratio], yerr=[half_width_percent], fmt="D",
        color=style.BLUE, markersize=4.0, capsize=3.0, elinewidth=1.0, zorder=4,
    )  # fmt: skip


def _draw_enlarged_mode(
    axes: Axes, mode: PooledMode, session_modes: Sequence[ModeEstimate], session_count: int
) -> None:
    """Draw a mode's estimates from all sessions on top of the pooled 95 % intervals."""
    from matplotlib.patches import Rectangle

    t = student_t_quantile(0.95, session_count - 1)
    half_width_mhz, half_width_percent = (
        1e3 * t * mode.frequency_std_hz,
        100 * t * mode.damping_ratio_std,
    )
    axes.add_patch(
        Rectangle(
            (-half_width_mhz, 100 * mode.damping_ratio - half_width_percent),
            2 * half_width_mhz, 2 * half_width_percent, facecolor=INTERVAL_COLOR,
            edgecolor="none", zorder=1,
        )
    )  # fmt: skip
    axes.errorbar(
        [1e3 * (session_mode.frequency_hz - mode.frequency_hz) for session_mode in session_modes],
        [100 * session_mode.damping_ratio for session_mode in session_modes],
        xerr=[1e3 * NORMAL_95 * session_mode.frequency_std_hz for session_mode in session_modes],
        yerr=[100 * NORMAL_95 * session_mode.damping_ratio_std for session_mode in session_modes],
        fmt="o", color=style.INK, markersize=2.6, linewidth=0.8, zorder=3,
    )  # fmt: skip
    axes.plot([0.0], [100 * mode.damping_ratio], "D", color=style.BLUE, markersize=4.0, zorder=4)
    axes.ticklabel_format(axis="both", useOffset=False)
    axes.locator_params(nbins=4)
    axes.set_facecolor("#FCFAF4")
    axes.set_title(f"Mode {mode.number}", fontweight="normal", fontsize=8.5)
    axes.set_xlabel(f"Frequency less {mode.frequency_hz:.6g} Hz (mHz)", labelpad=1)


# Frequency response


def response_figure(campaign: CampaignResult) -> Figure:
    """Draw the pooled frequency response and its 95 % band on top of the sessions' responses.

    The sessions' responses are the measured ones if Welch's method is applicable to the sessions,
    otherwise those of the sessions' own whole-record fits.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    pooled_estimate = campaign.freest
    assert pooled_estimate is not None
    peaks_hz = [pooled_mode.frequency_hz for pooled_mode in campaign.modes]
    first_hz, last_hz = _response_band_hz(campaign, peaks_hz)
    pooled_response_band = response_band(
        _PooledFit.from_estimate(pooled_estimate), dense_grid(first_hz, last_hz, peaks_hz)
    )
    is_measured = bool(campaign.sessions[0].frequency_hz.size)
    width_in, height_in = 11.0, 6.6
    figure = style.new_figure(
        width_in, height_in,
        pooled_title(
            f"Pooled frequency response, {session_count_text(pooled_estimate, campaign)}",
            campaign.homogeneity,
        ),
        "coupling torque over motor angle, without delays  ·  pooled: type "
        f"{pooled_estimate.name}{exact_condition_text(campaign)}"
        + (
            f"  ·  sessions: {ESTIMATOR_NAMES[campaign.settings.estimator]}, which a fast sweep "
            "biases at the resonances"
            if is_measured
            else ""
        ),
    )  # fmt: skip
    grid = figure.add_gridspec(
        3, 1, left=0.075, right=0.985, top=1 - 0.95 / height_in, bottom=0.5 / height_in,
        height_ratios=(2.4, 1.0, 0.8), hspace=0.1,
    )  # fmt: skip
    magnitude_axes, phase_axes, width_axes = (figure.add_subplot(grid[row]) for row in range(3))
    lowest_db = _draw_sessions(
        campaign, pooled_estimate, magnitude_axes, phase_axes, pooled_response_band.frequency_hz
    )
    lower_db, upper_db = (
        magnitude_db(magnitude_limit.astype(complex))
        for magnitude_limit in pooled_response_band.magnitude_limits()
    )
    modelled_db = magnitude_db(pooled_response_band.response)
    magnitude_axes.fill_between(
        pooled_response_band.frequency_hz, lower_db, upper_db, color=INTERVAL_COLOR, linewidth=0
    )
    magnitude_axes.plot(pooled_response_band.frequency_hz, modelled_db, color=style.BLUE)
    magnitude_axes.set_ylim(min(lowest_db, float(np.quantile(modelled_db, 0.02))) - 5,
                       float(modelled_db.max()) + 5)  # fmt: skip
    phase_axes.plot(
        pooled_response_band.frequency_hz,
        phase_deg(pooled_response_band.response),
        color=style.BLUE,
    )
    style.set_response_axes(magnitude_axes, phase_axes)
    width_axes.plot(
        pooled_response_band.frequency_hz,
        100 * NORMAL_95 * pooled_response_band.log_magnitude_std,
        color=style.BLUE,
    )
    width_axes.set_ylim(bottom=0.0)
    width_axes.set_ylabel("Band (± %)")
    width_axes.set_xlabel("Frequency (Hz)", labelpad=1)
    for response_panel in (magnitude_axes, phase_axes, width_axes):
        style.set_frequency_axis(
            response_panel, (first_hz, last_hz), with_labels=response_panel is width_axes
        )
    figure.align_ylabels()
    legend_handles = [
        Line2D([], [], color=SESSION_COLOR, linewidth=1.5,
               label=f"sessions, {'measured' if is_measured else 'each by its own fit'}"),
        Line2D([], [], color=style.BLUE, label="pooled"),
        Patch(facecolor=INTERVAL_COLOR, label="its 95 % band"),
    ]  # fmt: skip
    style.add_legend(figure, legend_handles, column_count=3)
    return figure


def _response_band_hz(campaign: CampaignResult, peaks_hz: Sequence[float]) -> tuple[float, float]:
    """Return the lowest and highest frequency of the response figure.

    It is the band of the fits, but not below a quarter of the first mode's frequency.
    """
    first_hz, last_hz = campaign.record_band_hz
    lowest_hz = min([last_hz / 4, *(peak_hz / 4 for peak_hz in peaks_hz)])
    return max(first_hz, lowest_hz), last_hz


def _draw_sessions(
    campaign: CampaignResult,
    pooled_estimate: PooledEstimate,
    magnitude_axes: Axes,
    phase_axes: Axes,
    grid_hz: NDArray[np.float64],
) -> float:
    """Draw the sessions' responses; return the axis limit in dB below all their magnitudes."""
    from rigd.beam import ResponseGrid

    lowest_db = np.inf
    for session in shown_sessions(campaign):
        frequency_hz, response = session.frequency_hz, session.response
        if not frequency_hz.size:
            session_estimates = [
                estimate
                for estimate in session.record_estimates
                if estimate.name == pooled_estimate.name
            ]
            if not session_estimates:
                continue
            frequency_hz = grid_hz
            response = ResponseGrid(2j * np.pi * grid_hz).evaluate(
                session_estimates[0].fit.plant, ()
            )[0]
        lowest_db = min(lowest_db, float(np.quantile(magnitude_db(response), 0.005)))
        draw_session(
            magnitude_axes,
            phase_axes,
            frequency_hz,
            response,
            _RESPONSE_DECIMATION_COLUMNS,
            _RESPONSE_DECIMATION_COLUMNS,
        )
    return lowest_db
