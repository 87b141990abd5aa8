"""Realisation of a response by fixed poles: residues and direct terms by linear least squares.

The coupling torque per angular acceleration is approximated by a sum over poles::

    H(s) / s² ≈ sum_k c_k(s) + D + V / s + K / s²

with a pair of poles for each mode, some real poles for the branch cut of fractional orders, the
inertia D, and the integrals of the acceleration (velocity and angle) with V and K. The residual is
relative. Poles are where the exact ones are, or negative and real, so every fit is stable; D, V and
K of a beam are not negative, and a motor with the realised beam is not unstable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.linear_model._state_space import SignalNames, StateSpace, with_filter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.linear_model._dynamics import Dynamics

    Real = NDArray[np.float64]

Input = Literal["acceleration", "angle"]
INPUTS: Final[tuple[Input, ...]] = ("acceleration", "angle")

_MOTION: Final = SignalNames(
    ("motor_angle", "motor_velocity", "motor_acceleration"), ("rad", "rad/s", "rad/s^2")
)
_TORQUE: Final = SignalNames(("coupling_torque",), ("N.m",))

_FIT_POINTS: Final = (200, 10)
_CHECK_POINTS: Final = (1200, 34)
"""Points over the band, and at each pole and zero, of a fit and of its check."""
_BEYOND_BAND: Final = 1.1
_TAIL: Final = (500.0, 10.0)
"""How far the tails go below and above the band, as factors."""
_TAIL_POINTS: Final = 25
_TAIL_WEIGHT: Final = 1e-5
_CLOSEST: Final = 3e-7
"""Relative distance from a pole or zero below which a relative error has no meaning."""
_SCAN_POINTS: Final = 4000
_NEWTON_STEPS: Final = 30
_RCOND: Final = 1e-10
_NEAR: Final = 0.3
"""How far Newton's method may move a zero, relatively."""
_MAX_GROWTH_PER_S: Final = 1e-2


@dataclass(frozen=True, slots=True)
class PoleStructure:
    """States of a realisation, whatever the parameters.

    Attributes
    ----------
    pairs : int
        Number of pairs of poles.
    ladder_rad_s : tuple of float
        Negative real poles in addition to those of over-damped modes.
    integrators : int
        0; 1: the velocity; 2: velocity and angle.
    """

    pairs: int
    ladder_rad_s: tuple[float, ...]
    integrators: int


class PoleFit:
    """Fits of one response by any structure.

    Parameters
    ----------
    dynamics : Dynamics
    near : PoleFit, optional
        Fit of dynamics that differ little, whose zeros lie near.
    """

    def __init__(self, dynamics: Dynamics, near: PoleFit | None = None) -> None:
        self.dynamics = dynamics
        low, high = dynamics.band_hz
        starts = self._minima() if near is None else near.zeros
        self.zeros: NDArray[np.complex128] = self._roots(starts)
        wide = (low / _BEYOND_BAND, high * _BEYOND_BAND)
        band = self._crowded(wide, _FIT_POINTS)
        tails = np.concatenate(
            [
                np.geomspace(low / _TAIL[0], wide[0], _TAIL_POINTS),
                np.geomspace(wide[1], high * _TAIL[1], _TAIL_POINTS),
            ]
        )
        if dynamics.motor_inertia_kg_m2 is None:  # a modal model is meant for its band alone
            tails = tails[:0]
        frequency_hz = np.concatenate([band, tails])
        apart = self._apart(frequency_hz)
        self._s = imaginary_axis(frequency_hz[apart])
        self._in_band = (np.arange(frequency_hz.size) < band.size)[apart]
        weight = np.where(self._in_band, 1.0, _TAIL_WEIGHT)
        per_acceleration = dynamics.response(self._s) / self._s**2
        self._scale = weight / np.abs(per_acceleration)
        self._target = (per_acceleration - dynamics.tool_inertia_kg_m2) * self._scale
        self._of_pairs = [self._pair_columns(pole) for pole in dynamics.pairs]

    @cached_property
    def check_s(self) -> NDArray[np.complex128]:
        """Return the points of the band for the error, in rad/s."""
        frequency_hz = self._crowded(self.dynamics.band_hz, _CHECK_POINTS)
        return imaginary_axis(frequency_hz[self._apart(frequency_hz)])

    @cached_property
    def exact(self) -> NDArray[np.complex128]:
        """Return the response there with filters, without delay, in N·m/rad."""
        return self.dynamics.filtered(self.check_s)

    def real_poles(self, structure: PoleStructure) -> tuple[float, ...]:
        """Return all real poles of a realisation, in rad/s.

        Parameters
        ----------
        structure : PoleStructure
        """
        return (*self.dynamics.real_poles, *structure.ladder_rad_s)

    def solve(self, structure: PoleStructure) -> tuple[NDArray[np.float64], float]:
        """Fit a structure.

        Parameters
        ----------
        structure : PoleStructure

        Returns
        -------
        coefficients : ndarray
            Residues, then those of D, V and K that the structure has.
        error : float
            Largest relative error in the band, on the points of the fit.
        """
        real = self.real_poles(structure)
        direct = 1 + structure.integrators
        columns = np.concatenate(
            [
                *self._of_pairs[: structure.pairs],
                [1 / (self._s - pole) for pole in real] or np.empty((0, self._s.size)),
                [self._s**-power for power in range(direct)],
            ]
        )
        columns = columns * self._scale
        bounded = direct if self.dynamics.motor_inertia_kg_m2 is not None else 0
        coefficients = _least_squares(columns, self._target, bounded)
        residual = coefficients @ columns - self._target
        return coefficients, float(np.abs(residual[self._in_band]).max())

    def system(
        self, structure: PoleStructure, coefficients: NDArray[np.float64], given: Input
    ) -> StateSpace:
        """Return the state space of a fit, with tool inertia, filters and delay.

        Parameters
        ----------
        structure : PoleStructure
        coefficients : ndarray
            As `solve` returned them.
        given : str
            Input: "acceleration", or "angle" for angle, velocity and acceleration.
        """
        system = self._unfiltered(structure, coefficients, given)
        for constant_s, order in self.dynamics.filters:
            system = with_filter(system, constant_s, order)
        return replace(system, delay_s=self.dynamics.delay_s)

    def error(self, system: StateSpace) -> NDArray[np.float64]:
        """Return the relative error of a state space in continuous time at `check_s`.

        Parameters
        ----------
        system : StateSpace
        """
        return np.abs(angle_response(system, self.check_s) / self.exact - 1)

    def stable_on_motor(self, structure: PoleStructure, coefficients: NDArray[np.float64]) -> bool:
        """Return whether a motor without friction, as heavy as the beam, is stable with it.

        Parameters
        ----------
        structure : PoleStructure
        coefficients : ndarray
            As `solve` returned them.
        """
        inertia = self.dynamics.motor_inertia_kg_m2
        if inertia is None:
            return True
        system = self._unfiltered(structure, coefficients, "acceleration")
        coupled = system.a - system.b @ system.c / (inertia + system.d.item())
        return bool(np.linalg.eigvals(coupled).real.max(initial=0.0) <= _MAX_GROWTH_PER_S)

    def _unfiltered(
        self, structure: PoleStructure, coefficients: NDArray[np.float64], given: Input
    ) -> StateSpace:
        upper, real = self.dynamics.pairs[: structure.pairs], self.real_poles(structure)
        poles = 2 * upper.size + len(real)
        a = np.zeros((poles, poles))
        even = np.arange(0, 2 * upper.size, 2)
        a[even, even] = a[even + 1, even + 1] = upper.real
        a[even, even + 1] = upper.imag
        a[even + 1, even] = -upper.imag
        others = np.arange(2 * upper.size, poles)
        a[others, others] = real
        b = np.ones((poles, 1))
        b[even + 1] = 0.0
        c = coefficients[None, :poles]
        inertia, viscosity, stiffness = np.append(coefficients[poles:], np.zeros(2))[:3].tolist()
        inertia += self.dynamics.tool_inertia_kg_m2
        names = [f"{name}_{part}" for name in self.dynamics.names[: upper.size] for part in "ab"]
        names += [f"relaxation_{number}" for number in range(1, len(real) + 1)]
        if given == "angle":
            # s² / (s - p) = s + p + p² / (s - p)
            stiffness += (c @ a @ b).item()
            viscosity += (c @ b).item()
            return StateSpace(
                a,
                np.pad(b, ((0, 0), (0, 2))),
                c @ a @ a,
                np.array([[stiffness, viscosity, inertia]]),
                _MOTION,
                _TORQUE,
                SignalNames(tuple(names), ("rad.s",) * poles),
            )
        # The velocity and the angle are integrals of the input: v' = u, q' = v.
        k = structure.integrators
        a = np.pad(a, (0, k))
        if k == 2:
            a[poles + 1, poles] = 1.0
        b = np.append(b, np.eye(k, 1), axis=0)
        return StateSpace(
            a,
            b,
            np.append(c, np.array([[viscosity, stiffness]])[:, :k], axis=1),
            np.array([[inertia]]),
            SignalNames(_MOTION.names[2:], _MOTION.units[2:]),
            _TORQUE,
            SignalNames(
                (*names, *("motor_velocity", "motor_angle")[:k]),
                (*("rad/s",) * poles, *("rad/s", "rad")[:k]),
            ),
        )

    def _pair_columns(self, pole: complex) -> NDArray[np.complex128]:
        """Return both columns of a conjugate pair, shape (2, points)."""
        shifted = self._s - pole.real
        return np.array([shifted, np.full_like(shifted, -pole.imag)]) / (
            shifted * shifted + pole.imag**2
        )

    # Points

    def _landmarks(self) -> NDArray[np.complex128]:
        return np.concatenate([self.dynamics.pairs, self.zeros])

    def _crowded(self, band_hz: tuple[float, float], points: tuple[int, int]) -> Real:
        """Return frequencies over a band, crowded within three half-widths of poles and zeros."""
        marks = self._landmarks()
        half_width = np.maximum(np.abs(marks.real), 1e-4 * np.abs(marks))
        offsets = np.linspace(-3, 3, points[1])
        near = (marks.imag[:, None] + half_width[:, None] * offsets).ravel() / (2 * np.pi)
        found = np.concatenate([np.geomspace(*band_hz, points[0]), near])
        return np.sort(found[(found >= band_hz[0]) & (found <= band_hz[1])])

    def _apart(self, frequency_hz: Real) -> NDArray[np.bool_]:
        """Return which frequencies are not practically at a pole or zero."""
        omega = 2 * np.pi * frequency_hz
        distance = np.abs(1j * omega[:, None] - self._landmarks()).min(axis=1, initial=np.inf)
        apart: NDArray[np.bool_] = distance > _CLOSEST * omega
        return apart

    def _minima(self) -> NDArray[np.complex128]:
        """Return where the response per acceleration is smaller than on both sides."""
        low, high = self.dynamics.band_hz
        s = imaginary_axis(np.geomspace(low / 2, high * 2, _SCAN_POINTS))
        size = np.abs(self.dynamics.response(s) / s**2)
        inner = np.flatnonzero((size[1:-1] < size[:-2]) & (size[1:-1] < size[2:])) + 1
        return s[inner]

    def _roots(self, starts: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the zeros of the response that Newton's method finds near by."""
        s, response = starts.copy(), self.dynamics.response
        if not s.size:
            return s
        for _ in range(_NEWTON_STEPS):
            step = 1e-6 * np.abs(s)
            above, below = response(np.concatenate([s + step, s - step])).reshape(2, -1)
            change = step * (above + below) / np.where(above == below, 1.0, above - below)
            s = s - change
            lost = np.abs(s / starts - 1) > _NEAR
            s[lost] = starts[lost]
            if (np.abs(change)[~lost] < 1e-9 * np.abs(s)[~lost]).all():
                break
        return s


def imaginary_axis(frequency_hz: Real) -> NDArray[np.complex128]:
    """Return s in rad/s at frequencies, of their shape.

    Parameters
    ----------
    frequency_hz : ndarray
    """
    return np.asarray(2j * np.pi * frequency_hz, dtype=np.complex128)


def angle_response(system: StateSpace, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the response of a state space to the motor angle, without its delay.

    Parameters
    ----------
    system : StateSpace
        In continuous time; its inputs are the acceleration, or angle, velocity and acceleration.
    s : ndarray of complex
        In rad/s.
    """
    motion = np.array([np.ones_like(s), s, s * s])[-system.d.shape[1] :]
    total: NDArray[np.complex128] = np.einsum("km,mk->k", system.response(s)[:, 0], motion)
    return total


def _least_squares(
    columns: NDArray[np.complex128], target: NDArray[np.complex128], bounded: int
) -> NDArray[np.float64]:
    """Solve for real coefficients, the last ones of them not negative."""
    matrix = np.concatenate([columns.real, columns.imag], axis=1).T
    wanted = np.concatenate([target.real, target.imag])
    scale = np.linalg.norm(matrix, axis=0)
    matrix = matrix / scale
    used = np.arange(scale.size)
    first_bounded = scale.size - bounded
    while True:
        solution = np.zeros(scale.size)
        solution[used] = np.linalg.lstsq(matrix[:, used], wanted, rcond=_RCOND)[0]
        last = solution[first_bounded:]
        if not (last < 0).any():
            found: NDArray[np.float64] = solution / scale
            return found
        used = used[used != first_bounded + np.argmin(last)]
