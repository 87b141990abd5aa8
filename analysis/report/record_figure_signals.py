"""Signals of a record beside what the fitted plant makes of its angle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.identify import Measurement, Prediction
from analysis.paper import band_limited
from analysis.report import style
from analysis.report.moments import enlarge, mark, resonance_moments

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify import Plant, RecordFit
    from analysis.record import Record


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
