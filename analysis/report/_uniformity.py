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

    from analysis.identify.uniform_beam import UniformBeamTest
    from analysis.report.table import Entry

UNIFORMITY: Final = "uniform_beam"
"""File name of the figure of the test, without suffix."""

_CONSTANT_TITLES: Final = {
    "ln_frequency": "Frequency",
    "ln_damping_ratio": "Damping ratio",
    "ln_residue": "Residue, magnitude",
    "residue_phase_rad": "Residue, phase",
}
"""Titles of the modal constants.

All but the phase are compared by their logarithms."""

_PERCENT: Final = 100.0
"""Factor from fractions to percent."""


def _deviations(test: UniformBeamTest) -> NDArray[np.float64]:
    """Return measured minus predicted constants, shape (modes, 4); phases within half a turn."""
    deviations = (test.measured - test.predicted).reshape(-1, len(MODE_CONSTANT_NAMES))
    phase = MODE_CONSTANT_NAMES.index("residue_phase_rad")
    deviations[:, phase] -= 2 * np.pi * np.round(deviations[:, phase] / (2 * np.pi))
    return deviations


def uniformity_figure(test: UniformBeamTest) -> Figure:
    """Draw the deviations of the modal constants from those of a uniform beam, by mode.

    Parameters
    ----------
    test : UniformBeamTest
        Result of the test, with at least one degree of freedom.
    """
    deviations, std = _deviations(test), test.std.reshape(-1, len(MODE_CONSTANT_NAMES))
    figure = style.new_figure(9.0, 4.0)
    grid = figure.add_gridspec(
        2, len(MODE_CONSTANT_NAMES), left=0.075, right=0.985, top=0.87, bottom=0.115, hspace=0.28,
        wspace=0.34,
    )  # fmt: skip
    for column, name in enumerate(MODE_CONSTANT_NAMES):
        std_axes, percent_axes = (figure.add_subplot(grid[row, column]) for row in range(2))
        std_axes.set_title(_CONSTANT_TITLES[name], fontsize=8.5)
        std_axes.axhspan(
            -NORMAL_95, NORMAL_95, color=style.SHADE_COLOR, linewidth=0, zorder=0,
            label="95 % of uniform beams",
        )  # fmt: skip
        values = deviations[:, column] / std[:, column]
        std_axes.plot(test.modes, values, "o", color=style.BLUE, markersize=5.0)
        _set_axes(std_axes, test.modes, float(np.abs(values).max()), least_limit=3.0)
        half_width_percent = NORMAL_95 * _PERCENT * std[:, column]
        percent = _PERCENT * deviations[:, column]
        percent_axes.errorbar(
            test.modes, percent, half_width_percent, fmt="o", color=style.INK, markersize=4.0,
            capsize=3.0, elinewidth=1.0, label="measured, 95 %",
        )  # fmt: skip
        _set_axes(percent_axes, test.modes, float((np.abs(percent) + half_width_percent).max()))
        percent_axes.set_xlabel("Mode", labelpad=1)
        std_axes.tick_params(labelbottom=False)
        if column == 0:
            std_axes.set_ylabel("Deviation (std)")
            percent_axes.set_ylabel("Deviation (%)")
    handles = [
        handle_or_label
        for axes in (std_axes, percent_axes)
        for handle_or_label in axes.get_legend_handles_labels()[0]
    ]
    labels = [
        handle_or_label
        for axes in (std_axes, percent_axes)
        for handle_or_label in axes.get_legend_handles_labels()[1]
    ]
    figure.align_ylabels()
    figure.legend(
        handles, labels, loc="upper right", bbox_to_anchor=(0.985, 0.995), ncols=2,
        borderaxespad=0.0,
    )  # fmt: skip
    return figure


def _set_axes(
    axes: Axes, modes: tuple[int, ...], largest_value: float, *, least_limit: float = 0.0
) -> None:
    """Set symmetric limits about zero, and a tick at each mode."""
    axes.axhline(0.0, color="#9A9A9A", linewidth=0.7, zorder=1)
    limit = max(1.2 * largest_value, least_limit)
    axes.set_ylim(-limit, limit)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlim(modes[0] - 0.5, modes[-1] + 0.5)
    axes.set_xticks(modes)


def uniformity_description(test: UniformBeamTest) -> str:
    """Return the description of the test's figure, with the result of the test."""
    return (
        "Modal constants measured, less those of the uniform beam that fits them best, by mode: "
        "above in standard deviations of the measured value (shaded: where 95 of 100 values of a "
        "uniform beam are), below in per cent with the 95 % interval (phase: per cent of 1 rad). "
        f"Chi-square {test.chi_square:.4g} for {test.degrees_of_freedom} degrees of freedom. "
        f"{test.summary.sentence}"
    )


def uniformity_table(test: UniformBeamTest) -> Table:
    """Return the table of measured and predicted modal constants with their deviations."""
    rows: list[tuple[Entry, ...]] = []
    deviations = _deviations(test).ravel()
    for index, (measured_value, std, predicted_value, deviation) in enumerate(
        zip(
            test.measured.tolist(), test.std.tolist(), test.predicted.tolist(), deviations.tolist(),
            strict=True,
        )
    ):  # fmt: skip
        name = MODE_CONSTANT_NAMES[index % len(MODE_CONSTANT_NAMES)]
        name_cell = Cell(name, name.removesuffix("_rad").replace("_", " "))
        cells = estimate_cells((measured_value, std, predicted_value), std)
        rows.append(
            (
                test.modes[index // len(MODE_CONSTANT_NAMES)], name_cell, *cells,
                number_cell(deviation / std, "+.1f"), number_cell(deviation, "+#.2g", _PERCENT),
            )
        )  # fmt: skip
    return Table.of(
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
        rows,
        (
            "ln of the frequency in Hz, of the damping ratio, and of the residue's magnitude in "
            "N·m/s; phase of the residue over j, in rad.",
            test.summary.sentence,
        ),
        grouped=True,
    )
