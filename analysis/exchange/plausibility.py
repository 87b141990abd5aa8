"""Do the numbers make sense? The beam itself tells wrong units and a wrong sign."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rigd.beam import Damping, transfer, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.exchange.specimen import Specimen

_BANDS: Final = ((0.25, 0.6), (1.5, 3.5))
"""In first natural frequencies: on either side of the first resonance, far enough from it and from
the first antiresonance (at 4.4) for damping not to matter, and above the frequencies at which the
paper's external damping outweighs the inertia."""

_CERTAIN: Final = 6.0
"""Standard deviations from zero that the factor between torque and model must have to judge at
all: a motion that does not reach these frequencies tells nothing."""

_TAPER: Final = 0.05
"""Share of the record at either end over which it is faded: a record may begin and end in motion,
and the paper's chirp passes these frequencies early."""

_FACTOR: Final = 3.0
"""Largest factor between torque and model that damping and a wrong mass may account for. The units
that are easily mixed up differ by more than ten."""


def unlikely_torque(
    angle_rad: NDArray[np.float64],
    torque_nm: NDArray[np.float64],
    rate_hz: float,
    specimen: Specimen,
) -> str | None:
    """Compare the torque with what the undamped beam would ask for, beside its first resonance.

    Parameters
    ----------
    angle_rad, torque_nm : ndarray of float, shape (n,)
        Of the whole record, finite.
    rate_hz : float
    specimen : Specimen

    Returns
    -------
    str or None
        What is odd and what to check; None if nothing is, or the motion does not tell.
    """
    frequency_hz = np.fft.rfftfreq(len(angle_rad), 1 / rate_hz)
    first_hz = undamped_frequencies_rad_s(specimen.beam, 1)[0] / (2 * np.pi)
    band = np.zeros(frequency_hz.shape, dtype=np.bool_)
    for low, high in _BANDS:
        band |= (frequency_hz >= low * first_hz) & (frequency_hz <= high * first_hz)
    s = 2j * np.pi * frequency_hz[band]
    place = np.abs(np.linspace(-1.0, 1.0, len(angle_rad)))  # 0 in the middle, 1 at either end
    window = np.sin(np.pi / 2 * np.minimum((1 - place) / (2 * _TAPER), 1)) ** 2
    with np.errstate(over="ignore", invalid="ignore"):
        angle, torque = (
            np.fft.rfft(window * (values - values.mean()))[band]
            for values in (angle_rad, torque_nm)
        )
        model = (transfer(s, specimen.beam, Damping()) + specimen.tool_inertia_kg_m2 * s**2) * angle
        power, total = (float(np.vdot(each, each).real) for each in (model, torque))
        if not (0.0 < power < np.inf and 0.0 < total < np.inf):
            return None
        ratio = complex(np.vdot(model, torque) / power)
    size = abs(ratio)
    explained = size**2 * power
    unexplained_per_bin = max(total - explained, 0.0) / np.count_nonzero(band)
    if explained < _CERTAIN**2 * unexplained_per_bin:
        return None
    if not 1 / _FACTOR < size < _FACTOR:
        return (
            f"The torque is {size:.3g} times what this beam asks for: check the units of "
            "angle and torque, and the beam's length and density."
        )
    if ratio.real < 0.0:
        return (
            "The torque has the opposite sign of what this beam asks for: a sensor that reports "
            "the reaction is imported with --reverse-torque."
        )
    return None
