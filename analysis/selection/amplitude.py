"""Damping of a mode against its amplitude, where the air brakes the beam.

In free vibration of one mode, the tip moving by ``A sin(omega t)``, a force per metre
``rho_air/2 C v^p`` takes from each cycle as much as linear damping of the ratio::

    rho_air/2 C (A omega)^(p - 1) m_p kappa_p / (2 rho omega)

rho being the mass per length, ``m_p`` the mean of ``2 |sin|^(p + 1)`` and ``kappa_p`` that of
``|psi|^(p + 1)`` over that of ``psi²`` along the beam, psi being the mode with 1 at the tip. This
adds to the ratio of the beam without air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.whole_record.drag import HALF_DENSITY
from rigd.beam import mode_shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.selection.candidates import Field

_MODES: Final = (1, 2)
_DEFLECTIONS: Final = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1)
"""Of the tip, relative to the length, as far as slopes are small."""

_POWERS: Final = (2.0, 4 / 3)
"""Of the speed, for the two numbers of a `DragLaw`."""

_POINTS: Final = 64


@dataclass(frozen=True, slots=True)
class DampingAt:
    """Damping ratio of a mode that vibrates freely.

    Attributes
    ----------
    mode : int
    tip_amplitude_m : float
    damping_ratio, std : float
        That of the beam and that of the air, whose uncertainties are added as if they were
        independent: one makes up for the other, so that the sum is known better than that.
    """

    mode: int
    tip_amplitude_m: float
    damping_ratio: float
    std: float


def damping_with_amplitude(field: Field) -> tuple[DampingAt, ...]:
    """Damping of the first modes that show at several amplitudes; nothing without drag.

    Parameters
    ----------
    field : Field
    """
    drag = field.drag
    if drag is None:
        return ()
    fit = field.best.fit
    numbers = np.array([drag.law.constant_m, drag.law.slowing])[: len(drag.covariance)]
    covariance = np.array(drag.covariance)
    found = []
    for mode in fit.modes:
        if mode.number not in _MODES or mode.frequency_hz <= 0:
            continue
        for share in _DEFLECTIONS:
            amplitude = share * fit.plant.beam.length_m
            slopes = by_law(
                mode.number,
                2 * math.pi * mode.frequency_hz,
                amplitude,
                fit.plant.beam.density_kg_per_m,
            )[: numbers.size]
            variance = mode.damping_ratio_std**2 + float(slopes @ covariance @ slopes)
            found.append(
                DampingAt(
                    mode=mode.number,
                    tip_amplitude_m=amplitude,
                    damping_ratio=mode.damping_ratio + float(slopes @ numbers),
                    std=math.sqrt(variance),
                )
            )
    return tuple(found)


def by_law(
    mode: int, omega_rad_s: float, tip_amplitude_m: float, density_kg_per_m: float
) -> NDArray[np.float64]:
    """Damping ratio by the air over the two numbers of a `DragLaw`, shape (2,).

    Parameters
    ----------
    mode : int
    omega_rad_s, tip_amplitude_m, density_kg_per_m : float
    """
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    shape = np.abs(mode_shape(mode, 0.5 * (node + 1)) / mode_shape(mode, 1.0))
    speed = tip_amplitude_m * omega_rad_s
    slopes = []
    for power in _POWERS:
        mean = 2 / math.sqrt(math.pi) * math.gamma(power / 2 + 1) / math.gamma(power / 2 + 1.5)
        along = float(weight @ shape ** (power + 1)) / float(weight @ shape**2)
        viscous = HALF_DENSITY * speed ** (power - 1) * mean * along
        slopes.append(viscous / (2 * density_kg_per_m * omega_rad_s))
    return np.array(slopes)
