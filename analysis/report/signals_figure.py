"""The record's signals, as the paper's Figure 5: reference and measured angle, coupling torque."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.report import style
from analysis.report.moments import enlarge, mark, resonance_moments

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.paper import WelchAnalysis


def signals_figure(analysis: WelchAnalysis) -> Figure:
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
