"""Frequencies between which a record says something of the damping."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from analysis.identify import RecordAnalysis
    from analysis.record import Record
    from analysis.report.html.subject import Subject

    Band = tuple[float, float]

_BLOCK: Final = 24
_OVER_NOISE: Final = 4.0
"""Mean power of a block over the noise's. By chance it exceeds 2 in one of 10 000 blocks."""


def supported_band_hz(subject: Subject) -> Band | None:
    """Band in which the selected fit's loss factors rest on data.

    The modes show the damping. A model whose orders the data support is also right between and
    beyond them, as far as the beam was excited; one with an order that they do not support only
    interpolates between the modes that show.

    Parameters
    ----------
    subject : Subject

    Returns
    -------
    tuple of float or None
        First and last frequency in Hz; None if there is no such band.
    """
    if not subject.withheld:
        return excited_band_hz(subject.record, subject.analysis)
    shown = subject.visible_modes
    frequencies = [mode.frequency_hz for mode in subject.fit.modes if mode.number in shown]
    if len(frequencies) < 2:
        return None
    return min(frequencies), max(frequencies)


def excited_band_hz(record: Record, analysis: RecordAnalysis) -> Band | None:
    """Frequencies between which the measured torque stands out of the noise.

    Parameters
    ----------
    record : Record
    analysis : RecordAnalysis
        Whose noise is taken, and whose band limits the answer.

    Returns
    -------
    tuple of float or None
        In Hz; None if nothing stands out.
    """
    torque = record.torque_nm - record.torque_nm.mean()
    frequency_hz = np.fft.rfftfreq(torque.size, 1 / record.rate_hz)
    inside = (frequency_hz >= analysis.frequency_hz[0]) & (
        frequency_hz <= analysis.frequency_hz[-1]
    )
    # A line is no excitation, and what is compared has none.
    nearest = np.searchsorted(analysis.frequency_hz, frequency_hz[inside])
    inside[inside] = analysis.compared[np.minimum(nearest, analysis.compared.size - 1)]
    power = np.abs(np.fft.rfft(torque)[inside]) ** 2 * 2 / (torque.size * record.rate_hz)
    over = power / np.interp(frequency_hz[inside], analysis.frequency_hz, analysis.noise_nm2_per_hz)
    whole = over.size - over.size % _BLOCK
    loud = np.flatnonzero(over[:whole].reshape(-1, _BLOCK).mean(axis=1) > _OVER_NOISE)
    if loud.size == 0:
        return None
    edges_hz = frequency_hz[inside]
    return float(edges_hz[loud[0] * _BLOCK]), float(edges_hz[(loud[-1] + 1) * _BLOCK - 1])
