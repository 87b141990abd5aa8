"""Prediction of the beam's coupling torque from the measured angle, one tick at a time."""

from cmath import exp as cexp
from math import pi

import numpy as np

from rigd.beam import Beam, Damping, clamped_free_eigenvalues, poles_for_eigenvalues

_MAX_MODES = 4
"""Largest number of modes in the prediction."""
_MAX_FREQUENCY_FRACTION = 0.25
"""Highest modal frequency in the prediction, as a fraction of the loop rate."""
_OBSERVER_BANDWIDTH_RAD_S = 6.0
"""Bandwidth in rad/s with which the observer corrects the modes.

The observer follows vibration that the angle does not explain, such as that of a beam that was not
at rest. It is slow compared with a shaft that runs away, and fast compared with the phase drift of
modes whose frequencies are wrong by a few per cent."""
_OFFSET_BANDWIDTH_RAD_S = 0.5
"""Bandwidth in rad/s with which the observer follows the sensor's zero."""


class BeamPrediction:
    """Predicts the coupling torque of the beam from the measured angle, with its first modes.

    On a root that turns by θ each clamped–free mode acts like a mass on a torsion spring:
    ``φ'' + 2 ζ ω φ' + ω² (φ - θ) = 0``, and the root exerts ``k (θ - φ)``, where the stiffness
    ``k = 4 E I/L`` is the same for all modes. A Luenberger observer slowly follows the remaining
    measured torque.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    rate_hz
        Loop rate in ticks per second.

    Attributes
    ----------
    first_rad_s
        Angular frequency of the first mode.

    References
    ----------
    L. Meirovitch, Fundamentals of Vibrations: base excitation of a cantilever. The modal inertias
    about the root are ``4 ρ L³/λ⁴``, of which the first is 97 % of ``ρ L³/3``.
    """

    __slots__ = ("_gain", "_matrix_product", "_start_rad", "_state_size", "_vectors", "first_rad_s")

    def __init__(self, beam: Beam, damping: Damping, rate_hz: float) -> None:
        period_s = 1.0 / rate_hz
        eigenvalues = clamped_free_eigenvalues(_MAX_MODES)
        poles = poles_for_eigenvalues(eigenvalues, beam, damping)[:, 0]
        oscillating_poles = [
            complex(p) for p in poles if 0.0 < p.imag < 2 * pi * _MAX_FREQUENCY_FRACTION * rate_hz
        ]
        self.first_rad_s = (
            abs(oscillating_poles[0])
            if oscillating_poles
            else 2 * pi * _MAX_FREQUENCY_FRACTION * rate_hz
        )
        stiffness_nm_per_rad = 4.0 * beam.bending_stiffness_n_m2 / beam.length_m
        mode_count = len(oscillating_poles)
        # Input [modes, offset, angle before, angle, torque], output [modes, offset, angle, error].
        state_size = 2 * mode_count + 2
        a = np.zeros((state_size + 1, state_size + 2))
        error_row = np.zeros(state_size + 2)
        observer_gain = np.zeros(state_size + 1)
        a[2 * mode_count, 2 * mode_count] = 1.0
        a[2 * mode_count + 1, 2 * mode_count + 2] = 1.0
        error_row[-1], error_row[2 * mode_count] = 1.0, -1.0
        observer_gain[2 * mode_count] = _OFFSET_BANDWIDTH_RAD_S * period_s
        for mode_index, mode_pole in enumerate(oscillating_poles):
            # φ = 2 Re(r z) with z' = p z + θ, and θ is linear between two ticks.
            mode_rows = slice(2 * mode_index, 2 * mode_index + 2)
            step_factor = cexp(mode_pole * period_s)
            present_angle_gain = (step_factor - 1.0 - mode_pole * period_s) / (
                mode_pole**2 * period_s
            )
            previous_angle_gain = (step_factor - 1.0) / mode_pole - present_angle_gain
            a[mode_rows, mode_rows] = (
                (step_factor.real, -step_factor.imag),
                (step_factor.imag, step_factor.real),
            )
            a[mode_rows, 2 * mode_count + 1] = previous_angle_gain.real, previous_angle_gain.imag
            a[mode_rows, 2 * mode_count + 2] = present_angle_gain.real, present_angle_gain.imag
            mode_residue = stiffness_nm_per_rad * abs(mode_pole) ** 2 / (2j * mode_pole.imag)
            error_row += 2.0 * np.array([mode_residue.real, -mode_residue.imag]) @ a[mode_rows]
            error_row[2 * mode_count + 2] -= stiffness_nm_per_rad
            observer_gain_of_mode = -_OBSERVER_BANDWIDTH_RAD_S * period_s / mode_residue
            observer_gain[mode_rows] = observer_gain_of_mode.real, observer_gain_of_mode.imag
        update_matrix = a + np.outer(observer_gain, error_row)
        update_matrix[-1] = error_row
        self._state_size = state_size
        self._gain = observer_gain[:state_size]
        self._matrix_product = np.asfortranarray(update_matrix).dot
        # Input and output in turn; the last element is not part of an output.
        self._vectors = tuple((vector, vector[:-1]) for vector in np.zeros((2, state_size + 2)))
        self.reset(0.0)

    def reset(self, angle_rad: float) -> None:
        """Start again with the beam at rest at an angle."""
        for state_vector, _ in self._vectors:
            state_vector[:] = 0.0
        self._start_rad = angle_rad

    def step(self, angle_rad: float, torque_nm: float) -> float:
        """Return the measured minus the predicted coupling torque, in N·m.

        Parameters
        ----------
        angle_rad, torque_nm
            Measured angle and coupling torque.
        """
        state_size = self._state_size
        present_vectors, next_vectors = self._vectors
        input_, output = present_vectors[0], next_vectors[1]
        input_[state_size] = angle_rad - self._start_rad
        input_[state_size + 1] = torque_nm
        self._matrix_product(input_, output)
        self._vectors = next_vectors, present_vectors
        return output.item(state_size)

    def skip(self, angle_rad: float) -> None:
        """Advance the prediction by a tick without a measured torque."""
        prediction_error_nm = self.step(angle_rad, 0.0)
        self._vectors[0][0][: self._state_size] -= self._gain * prediction_error_nm
