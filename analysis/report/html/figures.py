"""The figures of a report with what is said of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.identify import fast_length
from analysis.report.supported_band import supported_band_hz
from rigd.beam import undamped_frequencies_rad_s
from rigd.spectral import fft_response

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.figure import Figure

    from analysis.report.html.subject import Subject
    from rigd.spectral import FrequencyResponse


@dataclass(frozen=True, slots=True)
class Illustration:
    """A figure, the name of its files, and what is seen in it."""

    name: str
    figure: Figure
    description: str


NAMES = ("record_frf", "loss_factor", "residual", "record_signals")


def illustrations(subject: Subject) -> Iterator[Illustration]:
    """Draw the figures one after the other; within `style.styled`."""
    from analysis.report.record_figure_frf import frf_figure
    from analysis.report.record_figure_loss import loss_figure
    from analysis.report.record_figure_residual import residual_figure
    from analysis.report.record_figure_signals import signals_figure

    name, highest_hz, shown = subject.name, subject.band_hz[1], subject.visible_modes
    # Details and lines are of modes that the record shows, not of what the model adds.
    fit = replace(subject.fit, modes=tuple(m for m in subject.fit.modes if m.number in shown))
    modes = ", ".join(f"{mode.frequency_hz:.3g}" for mode in subject.fit.modes)
    frf, loss, residual, signals = NAMES
    measured = measured_response(subject)
    yield Illustration(
        frf,
        frf_figure(name, measured, subject.fit),
        f"Frequency response from motor angle to coupling torque: magnitude and phase as measured "
        f"and of the model, half-width of the model's 95 % band, and details of the modes ({modes} "
        "Hz). The band is narrower than the line where it is not seen.",
    )
    yield Illustration(
        loss,
        loss_figure(
            name,
            fit,
            (float(measured.frequency_hz[0]), highest_hz),
            supported_band_hz(subject),
            withheld=subject.withheld,
        ),
        _loss_description(subject),
    )
    yield Illustration(
        residual,
        residual_figure(name, subject.analysis, fit),
        "What the model leaves of the torque: its spectrum beside what was taken for noise; its "
        "cumulative periodogram, which stays in the shaded range in 95 of 100 records or more if "
        "only noise is left; and its power through the record. Excess at a mode or at one time "
        "is what the model lacks.",
    )
    yield Illustration(
        signals,
        signals_figure(subject.record, fit, highest_hz),
        "Motor angle, coupling torque as measured and as the model makes it of the measured angle, "
        "and their difference; below, where each mode rings most.",
    )


def _loss_description(subject: Subject) -> str:
    if subject.withheld:
        return (
            "Loss factor of all damping against frequency with its 95 % band, and at each mode "
            "that shows (points: twice its damping ratio). It is drawn between these modes only, "
            "and not split into internal and external: elsewhere, and for either part, the result "
            "would follow from an order that the data do not support."
        )
    return (
        "Loss factor of internal, external and all damping against frequency with 95 % bands; at a "
        "mode it is about twice the damping ratio (points). Between the modes the model "
        "interpolates, outside them it extrapolates; where the torque does not stand out of the "
        "noise nothing is drawn."
    )


def measured_response(subject: Subject) -> FrequencyResponse:
    """Ratio of the whole record's transforms, from well below the first mode to the band's end.

    The delay between the channels is still in it.
    """
    record = subject.record
    angle = record.angle_rad - (record.rest_angle_rad or 0.0)
    response = fft_response(angle, record.torque_nm, record.rate_hz, fast_length(len(angle)))
    first_mode_hz = float(undamped_frequencies_rad_s(subject.fit.plant.beam, 1)[0]) / (2 * np.pi)
    first_hz, last_hz = subject.band_hz
    response = response.band(max(first_hz, min(first_mode_hz / 4, last_hz / 4)), last_hz)
    known = np.isfinite(response.response)
    return replace(
        response,
        frequency_hz=response.frequency_hz[known],
        response=response.response[known],
    )
