"""Test of the beam's uniformity: measured modal constants compared with a uniform beam's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.ticker import MaxNLocator

from analysis.identify import MODE_CONSTANT_NAMES
from analysis.report import _style as style
from analysis.report.table import TEXT_FORMAT, Cell, Column, Table, estimate_cells, number_cell
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify.beam_uniformity import UniformBeamTest
    from analysis.report.table import Entry

_MODAL_CONSTANT_TITLES: Final = {
    "ln_frequency": "Frequency",
    "ln_damping_ratio": "Damping ratio",
    "ln_residue": "Residue, magnitude",
    "residue_phase_rad": "Residue, phase",
}
"""Titles of the modal constants.

All but the phase are compared by their logarithms."""

_PERCENT: Final = 100.0
"""Factor from fractions to percent."""


def _modal_constant_deviations(uniformity_test: UniformBeamTest) -> NDArray[np.float64]:
    """Return measured minus predicted constants, (modes, 4), phases between -pi and pi."""
    deviations = (uniformity_test.measured_constants - uniformity_test.predicted_constants).reshape(
        -1, len(MODE_CONSTANT_NAMES)
    )
    phase_column = MODE_CONSTANT_NAMES.index("residue_phase_rad")
    deviations[:, phase_column] -= 2 * np.pi * np.round(deviations[:, phase_column] / (2 * np.pi))
    return deviations


def uniformity_figure(uniformity_test: UniformBeamTest) -> Figure:
    """Draw the deviations of the modal constants from those of a uniform beam, by mode.

    The test has at least one degree of freedom.
    """
    constant_deviations, std = (
        _modal_constant_deviations(uniformity_test),
        uniformity_test.constant_stds.reshape(-1, len(MODE_CONSTANT_NAMES)),
    )
    figure = style.new_figure(9.0, 4.0)
    grid = figure.add_gridspec(
        2, len(MODE_CONSTANT_NAMES), left=0.1, right=0.985, top=0.87, bottom=0.115, hspace=0.28,
        wspace=0.34,
    )  # fmt: skip
    for panel_number, constant_name in enumerate(MODE_CONSTANT_NAMES):
        std_axes, percent_axes = (figure.add_subplot(grid[row, panel_number]) for row in range(2))
        std_axes.set_title(_MODAL_CONSTANT_TITLES[constant_name], fontsize=8.5)
        std_axes.axhspan(
            -NORMAL_95, NORMAL_95, color=style.SHADE_COLOR, linewidth=0, zorder=0,
            label="95 % of uniform beams",
        )  # fmt: skip
        deviation_values = constant_deviations[:, panel_number] / std[:, panel_number]
        std_axes.plot(
            uniformity_test.mode_numbers, deviation_values, "o", color=style.BLUE, markersize=5.0
        )
        _set_axes(
            std_axes,
            uniformity_test.mode_numbers,
            float(np.abs(deviation_values).max()),
            min_limit=3.0,
        )
        half_width_percent = NORMAL_95 * _PERCENT * std[:, panel_number]
        percent_values = _PERCENT * constant_deviations[:, panel_number]
        percent_axes.errorbar(
            uniformity_test.mode_numbers, percent_values, half_width_percent, fmt="o",
            color=style.INK, markersize=4.0,
            capsize=3.0, elinewidth=1.0, label="measured, 95 %",
        )  # fmt: skip
        _set_axes(
            percent_axes,
            uniformity_test.mode_numbers,
            float((np.abs(percent_values) + half_width_percent).max()),
        )
        percent_axes.set_xlabel("Mode", labelpad=1)
        std_axes.tick_params(labelbottom=False)
        if panel_number == 0:
            std_axes.set_ylabel("Deviation (std)")
            percent_axes.set_ylabel("Deviation (%)")
    legend_handles = [
        handle_or_label
        for axes in (std_axes, percent_axes)
        for handle_or_label in axes.get_legend_handles_labels()[0]
    ]
    legend_labels = [
        handle_or_label
        for axes in (std_axes, percent_axes)
        for handle_or_label in axes.get_legend_handles_labels()[1]
    ]
    figure.align_ylabels()
    figure.legend(
        legend_handles, legend_labels, loc="upper right", bbox_to_anchor=(0.985, 0.995), ncols=2,
        borderaxespad=0.0,
    )  # fmt: skip
    return figure


def _set_axes(
    axes: Axes, mode_numbers: tuple[int, ...], largest_value: float, *, min_limit: float = 0.0
) -> None:
    """Set symmetric limits of the vertical axis, and a tick of the horizontal axis at each mode."""
    axes.axhline(0.0, color="#9A9A9A", linewidth=0.7, zorder=1)
    axis_limit = max(1.2 * largest_value, min_limit)
    axes.set_ylim(-axis_limit, axis_limit)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlim(mode_numbers[0] - 0.5, mode_numbers[-1] + 0.5)
    axes.set_xticks(mode_numbers)


def uniformity_description(uniformity_test: UniformBeamTest) -> str:
    """Return the caption of the test's figure, which states the result of the test."""
    return (
        "Measured modal constants minus those of the uniform beam that fits them best, by mode: "
        "above in standard deviations of the measured value (shaded: where 95 of 100 values of a "
        "uniform beam are), below in per cent with the 95 % interval (phase: per cent of 1 rad). "
        f"Chi-square {uniformity_test.chi_square:.4g} for {uniformity_test.degrees_of_freedom} "
        f"degrees of freedom. {uniformity_test.summary.sentence}"
    )


def uniformity_table(uniformity_test: UniformBeamTest) -> Table:
    """Return the table of measured and predicted modal constants with their deviations."""
    table_rows: list[tuple[Entry, ...]] = []
    constant_deviations = _modal_constant_deviations(uniformity_test).ravel()
    for constant_index, (measured_value, std, predicted_value, deviation) in enumerate(
        zip(
            uniformity_test.measured_constants.tolist(), uniformity_test.constant_stds.tolist(),
            uniformity_test.predicted_constants.tolist(), constant_deviations.tolist(),
            strict=True,
        )
    ):  # fmt: skip
        constant_name = MODE_CONSTANT_NAMES[constant_index % len(MODE_CONSTANT_NAMES)]
        name_cell = Cell(constant_name, constant_name.removesuffix("_rad").replace("_", " "))
        constant_cells = estimate_cells((measured_value, std, predicted_value), std)
        table_rows.append(
            (
                uniformity_test.mode_numbers[constant_index // len(MODE_CONSTANT_NAMES)], name_cell,
                *constant_cells,
                number_cell(deviation / std, "+.1f"), number_cell(deviation, "+#.2g", _PERCENT),
            )
        )  # fmt: skip
    return Table.from_rows(
        "modal_constants",
        "Modal constants measured and of a uniform beam",
        (
            Column("Mode", "mode"),
            Column("Constant", "constant", TEXT_FORMAT),
            Column("Measured", "measured"),
            Column("std", "std", std_of_previous=True),
            Column("Uniform beam", "uniform_beam"),
            Column("Deviation (std)", "deviation_std"),
            Column("Deviation (%)", "deviation"),
        ),
        table_rows,
        (
            "ln of the frequency in Hz, of the damping ratio, and of the residue's magnitude in "
            "N·m/s; phase of the residue over j, in rad.",
            uniformity_test.summary.sentence,
        ),
        is_grouped=True,
    )
