"""How a mode remembers the damping that it had: a correction to what is read off at each moment.

A damping that changes as ``1 + e w(t)`` puts, to first order in e, another force on mode i. With
``p = rho/EI s² + gamma s^lambda``, ``c = 1 + zeta s^alpha``, ``S = c k⁴ / (c k⁴ + p)`` and
``R = p / (c k⁴ + p)``, the torque gains e times::

    a² EI (S w gamma s^lambda S + k⁴ R w zeta s^alpha R) angle

where w multiplies in time what stands to its right. To read the derivative of the response off at
each moment is to put w in front of all; a mode that rings for seconds does not follow so soon.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.whole_record.decimation import fast_length
from analysis.whole_record.response import eigenvalues, torque_channel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record import Plant
    from analysis.whole_record.comparison import Comparison

_PADDED: Final = 1.5
_DECAY: Final = 9.0
"""As in `analysis.selection.nonlinear`: on s = sigma + j omega what wraps round has decayed."""


def late_damping(
    comparison: Comparison, plant: Plant, change: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Torque by damping that changes, less what is read off at each moment, shape (samples,).

    Parameters
    ----------
    comparison : Comparison
    plant : Plant
    change : ndarray, shape (samples,)
        w at the samples kept; before and after as at its ends.
    """
    n, rate_hz = comparison.angle_rad.size, comparison.decimation.rate_hz
    length = fast_length(int(np.ceil(_PADDED * n)))
    sigma = _DECAY * rate_hz / length
    s = sigma + 2j * np.pi * rate_hz / length * np.arange(length // 2 + 1)
    growth = np.exp(sigma * np.arange(n) / rate_hz)
    kept = comparison.kept
    w = np.interp(np.arange(n), np.arange(kept.start, kept.stop), change)
    damping, beam = plant.damping, plant.beam
    internal = damping.zeta * s**damping.alpha
    external = damping.gamma * s**damping.lambda_
    inertial = beam.density_over_stiffness * s * s + external
    angle = np.fft.rfft(comparison.angle_rad / growth, length) * torque_channel(plant, s)
    total = np.zeros(n)

    def in_time(spectrum: NDArray[np.complex128]) -> NDArray[np.float64]:
        values: NDArray[np.float64] = np.fft.irfft(spectrum, length)[:n] * growth
        return values

    uniform = (eigenvalues(comparison.visible_modes) / beam.length_m) ** 4
    offsets = np.zeros(uniform.size)
    offsets[1 : 1 + len(plant.stiffness_offsets)] = plant.stiffness_offsets
    shares = 4 * beam.bending_stiffness_n_m2 / (beam.length_m * uniform)
    for share, k in zip(shares.tolist(), (uniform * (1 + offsets)).tolist(), strict=True):
        resists = (1 + internal) * k + inertial
        ways = (
            ((1 + internal) * k / resists, external),
            (inertial / resists, k * internal),
        )
        for through, damper in ways:
            moved = damper * through * angle
            later = through * np.fft.rfft(w * in_time(moved) / growth, length)
            total += share * (in_time(later) - w * in_time(through * moved))
    return total[kept]
