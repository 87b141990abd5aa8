"""What a mode adds to the torque when its stiffness or its damping depends on the deflection.

Mode i, relative to its root, is driven by the angle; a further restoring force n acts on it::

    p r + k⁴ (c r + n) = -p angle        p = rho/EI s² + gamma s^lambda,  c = 1 + zeta s^alpha
    torque added = -a² EI p k⁴ n / (p + c k⁴)

with, relative to the largest deflection R and the largest speed V that the mode reaches,

* ``n = e r³ / R²``: stiffness that rises by the share e at R; acts at once and three times the
  drive's frequency (odd harmonics);
* ``n = e r² / R``: stiffness that differs from side to side; even harmonics;
* ``n = 2 e r'|r'| / (omega V)``: drag that grows with the square of the speed, as of air; the
  damping ratio rises by e at V.

To first order in e these are columns of known shape and unknown size. Where e is not small, r is
that of the mode with the force: found by repeated substitution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.whole_record.decimation import fast_length
from analysis.whole_record.response import torque_channel
from rigd.beam import clamped_free_eigenvalues, participation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record import Plant
    from analysis.whole_record.comparison import Comparison

Kind = Literal["cubic stiffness", "quadratic stiffness", "quadratic drag"]
KINDS: Final[tuple[Kind, ...]] = ("cubic stiffness", "quadratic stiffness", "quadratic drag")

_OVERSAMPLING: Final = 3
"""The band ends at 0.4 of the rate: up to three times its end nothing folds back into it."""

_PADDED: Final = 1.5
_DECAY: Final = 9.0
_SUBSTITUTIONS: Final = 12
_CONVERGED: Final = 1e-3


@dataclass(frozen=True, slots=True)
class Term:
    """One restoring force that is not linear, of one mode."""

    kind: Kind
    mode: int


class ModalForces:
    """Columns of a record: torque by restoring forces of unit size.

    Parameters
    ----------
    comparison : Comparison
    plant : Plant
        The linear part.
    """

    __slots__ = ("_comparison", "_growth", "_length", "_p", "_plant", "_s", "_samples")

    def __init__(self, comparison: Comparison, plant: Plant) -> None:
        n, rate_hz = comparison.angle_rad.size, comparison.decimation.rate_hz
        self._comparison, self._plant, self._samples = comparison, plant, n
        self._length = fast_length(int(np.ceil(_PADDED * n)))
        # On s = sigma + j omega what wraps round has decayed: see `Prediction`.
        sigma = _DECAY * rate_hz / self._length
        bins = np.arange(self._length // 2 + 1)
        self._s = sigma + 2j * np.pi * rate_hz / self._length * bins
        fine = np.arange(_OVERSAMPLING * n) / (_OVERSAMPLING * rate_hz)
        self._growth = np.exp(sigma * fine)
        damping, ratio = plant.damping, plant.beam.density_over_stiffness
        self._p = ratio * self._s**2 + damping.gamma * self._s**damping.lambda_

    def column(self, term: Term, size: float = 0.0) -> NDArray[np.complex128]:
        """Spectrum, shape (K,), of the torque by a force, divided by its `size`.

        Not finite where the repeated substitution leads nowhere: so large a force is not known.

        Parameters
        ----------
        term : Term
        size : float
            Size e at which the mode moves; 0 for the first order.
        """
        k, stiffness = self._stiffness(term.mode)
        resists = self._p + stiffness
        angle = self._comparison.angle_rad
        decayed = angle / self._growth[::_OVERSAMPLING]
        linear = -self._p / resists * np.fft.rfft(decayed, self._length)
        force = self._force(term.kind, linear, linear)
        if size:
            follows = -size * k / resists
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in range(_SUBSTITUTIONS):
                    again = self._force(term.kind, linear + follows * force, linear)
                    change, most = np.linalg.norm(again - force), np.linalg.norm(again)
                    force = again
                    if not np.isfinite(most):
                        return np.full(self._comparison.frequency_hz.size, np.nan + 0j)
                    if change < _CONVERGED * most:
                        break
        beam = self._plant.beam
        share = float(participation(beam, term.mode)[-1]) * beam.bending_stiffness_n_m2
        torque = -share * k * self._p / resists * force * torque_channel(self._plant, self._s)
        in_time = np.fft.irfft(torque, self._length)[: self._samples]
        in_time *= self._growth[::_OVERSAMPLING]
        spectrum: NDArray[np.complex128] = self._comparison.spectrum(in_time[self._comparison.kept])
        return spectrum

    def _stiffness(self, mode: int) -> tuple[float, NDArray[np.complex128]]:
        """k⁴ of a mode with its offset, and with its damping."""
        plant = self._plant
        k = float(clamped_free_eigenvalues(mode)[-1] / plant.beam.length_m) ** 4
        if 2 <= mode <= 1 + len(plant.stiffness_offsets):
            k *= 1 + plant.stiffness_offsets[mode - 2]
        damped = k * (1 + plant.damping.zeta * self._s**plant.damping.alpha)
        return k, damped.astype(np.complex128)

    def _force(
        self, kind: Kind, moved: NDArray[np.complex128], linear: NDArray[np.complex128]
    ) -> NDArray[np.complex128]:
        """Transform of n, shape (length // 2 + 1,), for a motion; the linear one sets R and V."""
        if kind == "quadratic drag":
            speed = self._fine(moved * self._s)
            fastest = np.abs(self._fine(linear * self._s)).max()
            middle = fastest / np.abs(self._fine(linear)).max()
            n = 2 * speed * np.abs(speed) / (fastest * middle)
        else:
            deflection = self._fine(moved)
            largest = np.abs(self._fine(linear)).max()
            power = 3 if kind == "cubic stiffness" else 2
            n = deflection**power / largest ** (power - 1)
        n /= self._growth
        spectrum = np.fft.rfft(n, _OVERSAMPLING * self._length)[: self._s.size]
        return spectrum / _OVERSAMPLING

    def _fine(self, spectrum: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Values over the record at the multiple of the rate."""
        fine = np.fft.irfft(_OVERSAMPLING * spectrum, _OVERSAMPLING * self._length)
        values: NDArray[np.float64] = fine[: self._growth.size] * self._growth
        return values
