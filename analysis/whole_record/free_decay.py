"""Free decay of the beam's modes, as its spectrum over a record, and how the poles move.

A beam that already rings when the record begins adds to the torque a sum of decays whose amplitudes
nobody knows but whose poles are the model's own. Their spectra over the samples compared are
geometric sums, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.whole_record.response import FIRST_OFFSET, offset_name
from rigd.beam import clamped_free_eigenvalues
from rigd.beam.modes import poles_for_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.whole_record.plant import Plant


@dataclass(frozen=True, slots=True)
class Pole:
    """One pole of one mode: of a conjugate pair the upper, or a real one.

    Attributes
    ----------
    mode : int
        From 1.
    at_rad_s : complex
    derivative : ndarray of complex, shape (k,)
        By the parameters asked for.
    """

    mode: int
    at_rad_s: complex
    derivative: NDArray[np.complex128]

    @property
    def oscillates(self) -> bool:
        """Whether the decay is an oscillation: two columns, else one."""
        return self.at_rad_s.imag != 0


def mode_poles(plant: Plant, count: int, wrt: Sequence[str]) -> tuple[Pole, ...]:
    """Poles of the first `count` modes with their derivatives, without modes that have none.

    Parameters
    ----------
    plant : Plant
    count : int
    wrt : sequence of str
        Names that `ResponseGrid` knows; some do not move a pole.
    """
    z = clamped_free_eigenvalues(count)
    for mode, offset in enumerate(plant.stiffness_offsets[: count - 1], start=FIRST_OFFSET):
        z[mode - 1] *= (1 + offset) ** 0.25
    found = []
    for i, pair in enumerate(poles_for_eigenvalues(z, plant.beam, plant.damping)):
        if np.isnan(pair[0]):
            continue
        stiffness = float((z[i] / plant.beam.length_m) ** 4)
        for pole in pair[: 1 if pair[0].imag else 2]:
            moved = _pole_derivative(complex(pole), stiffness, i + 1, plant, wrt)
            found.append(Pole(i + 1, complex(pole), moved))
    return tuple(found)


def _pole_derivative(
    s: complex, stiffness: float, mode: int, plant: Plant, wrt: Sequence[str]
) -> NDArray[np.complex128]:
    """Differentiate a root of ``rho/EI s² + gamma s^lambda + k⁴ (1 + zeta s^alpha) = 0``.

    By implicit differentiation, `stiffness` being k⁴. Shape (len(wrt),).
    """
    damping, ratio = plant.damping, plant.beam.density_over_stiffness
    log_s = np.log(complex(s))
    internal = stiffness * np.exp(damping.alpha * log_s)
    external = np.exp(damping.lambda_ * log_s)
    slope = (
        2 * ratio * s
        + damping.gamma * damping.lambda_ * external / s
        + damping.zeta * damping.alpha * internal / s
    )
    by: dict[str, complex] = {
        "zeta": internal,
        "alpha": damping.zeta * log_s * internal,
        "gamma": external,
        "lambda": damping.gamma * log_s * external,
        "ln_density_over_stiffness": ratio * s * s,
    }
    if FIRST_OFFSET <= mode < FIRST_OFFSET + len(plant.stiffness_offsets):
        elastic = stiffness + damping.zeta * internal
        by[offset_name(mode)] = elastic / (1 + plant.stiffness_offsets[mode - FIRST_OFFSET])
    return np.array([-by.get(name, 0.0) / slope for name in wrt], dtype=np.complex128)


class DecaySpectra:
    """Discrete Fourier transforms of decays over ``samples`` samples, at some of its bins.

    Parameters
    ----------
    samples : int
        The decays start at the first of them.
    rate_hz : float
    omega_rad_s : ndarray, shape (K,)
        Bins of the transform, multiples of ``2 pi rate_hz / samples``.
    """

    __slots__ = ("_duration_s", "_period_s", "_turn")

    def __init__(self, samples: int, rate_hz: float, omega_rad_s: NDArray[np.float64]) -> None:
        self._period_s = 1 / rate_hz
        self._duration_s = samples / rate_hz
        self._turn = np.exp(-1j * omega_rad_s * self._period_s)

    def columns(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Spectra of ``Re exp(p t)`` and, if it oscillates, ``Im exp(p t)``: shape (m, K)."""
        rows = []
        for pole in poles:
            upper = self._sum(pole.at_rad_s)
            if pole.oscillates:
                lower = self._sum(pole.at_rad_s.conjugate())
                rows += [(upper + lower) / 2, (upper - lower) / 2j]
            else:
                rows.append(upper)
        return np.array(rows, dtype=np.complex128).reshape(len(rows), self._turn.size)

    def gradient(
        self, poles: Sequence[Pole], amplitudes: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Differentiate ``amplitudes @ columns(poles)`` through the poles, shape (k, K)."""
        total = np.zeros((poles[0].derivative.size, self._turn.size), dtype=np.complex128)
        place = 0
        for pole in poles:
            upper = self._sum_of_time(pole.at_rad_s)
            if pole.oscillates:
                moved = complex(amplitudes[place], -amplitudes[place + 1]) * pole.derivative
                lower = self._sum_of_time(pole.at_rad_s.conjugate())
                total += (np.outer(moved, upper) + np.outer(moved.conj(), lower)) / 2
                place += 2
            else:
                total += np.outer(amplitudes[place] * pole.derivative.real, upper)
                place += 1
        return total

    def _sum(self, pole: complex) -> NDArray[np.complex128]:
        """Sum of ``exp(p t)`` over the samples, turned to each bin."""
        ratio = np.exp(pole * self._period_s) * self._turn
        total: NDArray[np.complex128] = (1 - np.exp(pole * self._duration_s)) / (1 - ratio)
        return total

    def _sum_of_time(self, pole: complex) -> NDArray[np.complex128]:
        """Sum of ``t exp(p t)``: the derivative of `_sum` by the pole."""
        ratio = np.exp(pole * self._period_s) * self._turn
        over = np.exp(pole * self._duration_s)
        rest = 1 - ratio
        total: NDArray[np.complex128] = (
            (1 - over) * self._period_s * ratio / rest - self._duration_s * over
        ) / rest
        return total
