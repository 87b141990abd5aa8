"""Coupling torque that the beam exerts at the measured angle, predicted tick by tick."""

from cmath import exp as cexp
from math import pi

import numpy as np

from rigd.beam import Beam, Damping, clamped_free_eigenvalues, poles_for_eigenvalues

_MODES = 4
_FASTEST = 0.25
"""Fastest mode of the prediction, as a fraction of the rate."""
_OBSERVER_RAD_S = 6.0
"""Bandwidth of the observer for vibration that the angle does not explain, as of a beam that was
not at rest. Slow against a shaft that runs away, fast against the phase drift of modes whose
frequencies are wrong by a few per cent."""
_OFFSET_RAD_S = 0.5
"""The same for the zero of the sensor."""


class BeamPrediction:
    """Coupling torque of a beam whose root turns by the measured angle, from its first modes.

    On a root that turns by θ each clamped–free mode acts like a mass on a torsion spring:
    ``φ'' + 2 ζ ω φ' + ω² (φ - θ) = 0``, and the root exerts ``k (θ - φ)``, where the stiffness
    ``k = 4 E I/L`` is the same for all modes. A Luenberger observer slowly follows the remaining
    measured torque.

    Parameters
    ----------
    beam, damping
        Beam and its damping.
    rate_hz
        Ticks a second.

    Attributes
    ----------
    first_rad_s
        Frequency of the first mode.

    References
    ----------
    L. Meirovitch, Fundamentals of Vibrations: base excitation of a cantilever. The modal inertias
    about the root are ``4 ρ L³/λ⁴``, of which the first is 97 % of ``ρ L³/3``.
    """

    __slots__ = ("_dot", "_gain", "_rest_rad", "_size", "_vectors", "first_rad_s")

    def __init__(self, beam: Beam, damping: Damping, rate_hz: float) -> None:
        period_s = 1.0 / rate_hz
        eigenvalues = clamped_free_eigenvalues(_MODES)
        poles = poles_for_eigenvalues(eigenvalues, beam, damping)[:, 0]
        ringing = [complex(p) for p in poles if 0.0 < p.imag < 2 * pi * _FASTEST * rate_hz]
        self.first_rad_s = abs(ringing[0]) if ringing else 2 * pi * _FASTEST * rate_hz
        stiffness_nm = 4.0 * beam.bending_stiffness_n_m2 / beam.length_m
        m = len(ringing)
        # Input [modes, offset, angle before, angle, torque], output [modes, offset, angle, error].
        size = 2 * m + 2
        a = np.zeros((size + 1, size + 2))
        error = np.zeros(size + 2)
        gain = np.zeros(size + 1)
        a[2 * m, 2 * m] = 1.0
        a[2 * m + 1, 2 * m + 2] = 1.0
        error[-1], error[2 * m] = 1.0, -1.0
        gain[2 * m] = _OFFSET_RAD_S * period_s
        for number, pole in enumerate(ringing):
            # φ = 2 Re(r z) with z' = p z + θ, and θ is linear between two ticks.
            rows = slice(2 * number, 2 * number + 2)
            turned = cexp(pole * period_s)
            now = (turned - 1.0 - pole * period_s) / (pole**2 * period_s)
            before = (turned - 1.0) / pole - now
            a[rows, rows] = (turned.real, -turned.imag), (turned.imag, turned.real)
            a[rows, 2 * m + 1] = before.real, before.imag
            a[rows, 2 * m + 2] = now.real, now.imag
            factor = stiffness_nm * abs(pole) ** 2 / (2j * pole.imag)
            error += 2.0 * np.array([factor.real, -factor.imag]) @ a[rows]
            error[2 * m + 2] -= stiffness_nm
            gain_of_mode = -_OBSERVER_RAD_S * period_s / factor
            gain[rows] = gain_of_mode.real, gain_of_mode.imag
        matrix = a + np.outer(gain, error)
        matrix[-1] = error
        self._size = size
        self._gain = gain[:size]
        self._dot = np.asfortranarray(matrix).dot
        self._vectors = tuple(np.zeros((2, size + 2)))
        self.reset(0.0)

    def reset(self, angle_rad: float) -> None:
        """Start from rest at an angle."""
        for vector in self._vectors:
            vector[:] = 0.0
        self._rest_rad = angle_rad

    def step(self, angle_rad: float, torque_nm: float) -> float:
        """Return the measured minus the predicted coupling torque, in N·m.

        Parameters
        ----------
        angle_rad, torque_nm
            Angle and coupling torque as measured.
        """
        size = self._size
        input_, output = self._vectors
        input_[size] = angle_rad - self._rest_rad
        input_[size + 1] = torque_nm
        self._dot(input_, output[:-1])
        self._vectors = output, input_
        return float(output[size])

    def skip(self, angle_rad: float) -> None:
        """Step by a tick without a measured torque."""
        error_nm = self.step(angle_rad, 0.0)
        self._vectors[0][: self._size] -= self._gain * error_nm
