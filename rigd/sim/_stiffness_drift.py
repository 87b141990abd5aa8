"""A beam whose bending stiffness drifts: the matrices of a step, renewed now and then.

They are computed at a few stiffnesses, Chebyshev's points, and interpolated by a polynomial. The
state has to mean the same at all of them. A mode's states in a realisation are those of
``x' = p x + θ''`` for its two poles p, which the stiffness moves and perhaps makes real. The
displacement and the speed of the oscillator ``q'' - (p + p*) q' + p p* q = -θ''`` do not jump with
the stiffness, and are the mode's states here. The states of the branch cut have poles that stay.
The shapes of the modes are taken for unchanged, as they are on a clamp that does not give way.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam.realisation import CoupledModel, Realisation

Real = NDArray[np.float64]

MOST_DRIFT = 0.05
"""Relative change of the stiffness at which the drift ends."""
_RENEWED_EVERY_S = 0.02
_ERROR = 1e-10
"""Error of the interpolation, in the steps of a mode without damping."""


class StiffnessDrift:
    """Arrays that depend on the beam's stiffness, as it is now.

    Parameters
    ----------
    rate_per_s
        Relative change of the stiffness each second; not 0.
    period_s
        Length of a step.
    fastest_rad_s
        Largest natural frequency in the arrays.
    arrays_at
        Returns the arrays for a ratio of the stiffness to that at the start.

    Attributes
    ----------
    arrays : tuple of ndarray
        As they are now, in column order: at first those of the start.
    """

    __slots__ = ("_all", "_block", "_coefficients", "_per_period", "arrays")

    def __init__(
        self,
        rate_per_s: float,
        period_s: float,
        fastest_rad_s: float,
        arrays_at: Callable[[float], Sequence[Real]],
    ) -> None:
        # The phase of the fastest mode in a step, from the middle of the drift to its ends.
        half_rad = 0.25 * MOST_DRIFT * fastest_rad_s * period_s
        points = 3
        while 2 * (0.5 * half_rad) ** points / math.factorial(points) > _ERROR:
            points += 1
        positions = -np.cos(np.pi * np.arange(points) / (points - 1))
        end = math.copysign(MOST_DRIFT, rate_per_s)
        found = [arrays_at(1 + end * 0.5 * (1 + position)) for position in positions.tolist()]
        shapes = [array.shape for array in found[0]]
        values = np.stack([np.concatenate([a.ravel("F") for a in arrays]) for arrays in found])
        self._coefficients = np.linalg.solve(
            np.polynomial.chebyshev.chebvander(positions, points - 1), values
        )
        self._all = values[0].copy()
        sizes = [math.prod(shape) for shape in shapes]
        parts = np.split(self._all, np.cumsum(sizes[:-1]))
        self.arrays = tuple(
            part.reshape(shape, order="F") for part, shape in zip(parts, shapes, strict=True)
        )
        self._block = max(1, round(_RENEWED_EVERY_S / period_s))
        self._per_period = abs(rate_per_s) * period_s / MOST_DRIFT

    def renew(self, periods: int) -> bool:
        """Update the arrays for the coming periods, if an update is due.

        Parameters
        ----------
        periods
            Periods since the drift began; call it for every period.

        Returns
        -------
        bool
            Whether the arrays have changed.
        """
        if periods < 0 or periods % self._block:
            return False
        fraction = (periods + 0.5 * self._block) * self._per_period
        if fraction - self._block * self._per_period > 1:
            return False  # it stays as it is
        angle = math.acos(1 - 2 * min(fraction, 1.0))
        # The k-th polynomial is cos(k arccos x); x runs from -1 to 1.
        weights = np.cos((math.pi - angle) * np.arange(len(self._coefficients)))
        weights.dot(self._coefficients, self._all)
        return True


def in_displacements(model: CoupledModel, beam: Realisation, at_start: Realisation) -> CoupledModel:
    """Describe a coupled model by the displacements and speeds of its modes.

    Parameters
    ----------
    model
        Motor and beam, with the states of the realisation after angle and speed.
    beam
        The realisation.
    at_start
        That before the stiffness began to drift; displacements are in units that it fixes.
    """
    n, states = model.b.size, beam.b.size
    back = np.eye(n)
    back[2 : 2 + states, 2 : 2 + states] = _from_displacements(beam, at_start)
    to = np.linalg.inv(back)

    def row(own: Real) -> Real:
        turned: Real = own @ back
        return turned

    return replace(
        model,
        a=to @ model.a @ back,
        b=to @ model.b,
        angle=row(model.angle),
        velocity=row(model.velocity),
        acceleration=row(model.acceleration),
        beam_torque=row(model.beam_torque),
        sensor_torque=row(model.sensor_torque),
        sensed_torque=None if model.sensed_torque is None else row(model.sensed_torque),
        shear=row(model.shear),
        sensed_shear=None if model.sensed_shear is None else row(model.sensed_shear),
    )


def _from_displacements(beam: Realisation, at_start: Realisation) -> Real:
    """Matrix from displacements and speeds, mode by mode, then the other states, to the states."""
    rates_at_start = {
        mode: abs(pole)
        for mode, pole in zip(at_start.modes.tolist(), at_start.poles_rad_s.tolist(), strict=True)
    }
    poles, modes = beam.poles_rad_s, beam.modes
    first = np.cumsum([0, *np.where(poles.imag > 0, 2, 1)])  # state of each pole
    matrix = np.zeros((beam.b.size, beam.b.size))
    column = 0
    alone: list[int] = []
    for mode in np.unique(modes):
        of_mode = np.flatnonzero(modes == mode)
        states = first[of_mode]
        if mode >= 0 and poles[of_mode[0]].imag > 0:
            pole = poles[of_mode[0]]
            # With x - i y of the realisation: x - i y = p* q - q'.
            rows = [[pole.real, -1.0], [pole.imag, 0.0]]
            states = np.array([states[0], states[0] + 1])
        elif mode >= 0 and of_mode.size == 2:
            rows = [[pole.real, -1.0] for pole in poles[of_mode[::-1]]]
        else:
            alone += states.tolist()
            continue
        unit = np.array([1 / rates_at_start[int(mode)], 1.0])
        matrix[states, column : column + 2] = np.array(rows) * unit
        column += 2
    matrix[alone, np.arange(column, beam.b.size)] = 1.0
    return matrix
