"""Drift of the simulated beam's bending stiffness: step matrices that are updated now and then.

The matrices are computed at a few stiffnesses (Chebyshev points) and interpolated by a polynomial.
This requires that the state has the same meaning at all stiffnesses. A mode's states in a
realisation are those of ``x' = p x + θ''`` for its two poles p, which change with the stiffness and
may become real. Displacement and speed of the oscillator ``q'' - (p + p*) q' + p p* q = -θ''`` are
continuous when the stiffness changes, so they are the mode's states here. The states of the branch
cut have constant poles. The mode shapes are assumed constant, which is true for a rigid clamp.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam.realisation import CoupledModel, Realisation

RealArray = NDArray[np.float64]
"""Array of real numbers."""

MAX_STIFFNESS_DRIFT = 0.05
"""Relative change of the stiffness at which the drift ends."""
_UPDATE_INTERVAL_S = 0.02
"""Time in seconds between two updates of the matrices."""
_LARGEST_INTERPOLATION_ERROR = 1e-10
"""Largest error of the interpolation, for the step matrix of a mode without damping."""


class StiffnessDrift:
    """Step matrices that depend on the beam's bending stiffness, interpolated for the present time.

    `rate_per_s` is the relative change of the stiffness per second, not 0, `period_s` the duration
    of a step, and `highest_mode_rad_s` the largest natural frequency of the modelled modes.
    `arrays_at_stiffness_ratio` returns the arrays for a stiffness relative to the initial one.

    Attributes
    ----------
    arrays : tuple of ndarray
        Arrays for the present stiffness, in column-major order.
    """

    __slots__ = (
        "_coefficients",
        "_drift_fraction_per_period",
        "_flat_arrays",
        "_periods_per_update",
        "arrays",
    )

    def __init__(
        self,
        rate_per_s: float,
        period_s: float,
        highest_mode_rad_s: float,
        arrays_at_stiffness_ratio: Callable[[float], Sequence[RealArray]],
    ) -> None:
        # The phase of the fastest mode in a step, from the middle of the drift to its ends.
        half_phase_range_rad = 0.25 * MAX_STIFFNESS_DRIFT * highest_mode_rad_s * period_s
        chebyshev_point_count = 3
        while (
            2
            * (0.5 * half_phase_range_rad) ** chebyshev_point_count
            / math.factorial(chebyshev_point_count)
            > _LARGEST_INTERPOLATION_ERROR
        ):
            chebyshev_point_count += 1
        chebyshev_points = -np.cos(
            np.pi * np.arange(chebyshev_point_count) / (chebyshev_point_count - 1)
        )
        end_stiffness_drift = math.copysign(MAX_STIFFNESS_DRIFT, rate_per_s)
        arrays_at_points = [
            arrays_at_stiffness_ratio(1 + end_stiffness_drift * 0.5 * (1 + chebyshev_point))
            for chebyshev_point in chebyshev_points.tolist()
        ]
        array_shapes = [start_array.shape for start_array in arrays_at_points[0]]
        stacked_values = np.stack(
            [
                np.concatenate([a.ravel("F") for a in point_arrays])
                for point_arrays in arrays_at_points
            ]
        )
        self._coefficients = np.linalg.solve(
            np.polynomial.chebyshev.chebvander(chebyshev_points, chebyshev_point_count - 1),
            stacked_values,
        )
        self._flat_arrays = stacked_values[0].copy()
        array_sizes = [math.prod(array_shape) for array_shape in array_shapes]
        flat_parts = np.split(self._flat_arrays, np.cumsum(array_sizes[:-1]))
        self.arrays = tuple(
            flat_part.reshape(array_shape, order="F")
            for flat_part, array_shape in zip(flat_parts, array_shapes, strict=True)
        )
        self._periods_per_update = max(1, round(_UPDATE_INTERVAL_S / period_s))
        self._drift_fraction_per_period = abs(rate_per_s) * period_s / MAX_STIFFNESS_DRIFT

    def refresh_if_due(self, elapsed_periods: int) -> bool:
        """Update the step matrices for the coming periods if due; return whether they have changed.

        Call this method in every period, with the number of periods since the drift began.
        """
        if elapsed_periods < 0 or elapsed_periods % self._periods_per_update:
            return False
        drift_fraction = (
            elapsed_periods + 0.5 * self._periods_per_update
        ) * self._drift_fraction_per_period
        if drift_fraction - self._periods_per_update * self._drift_fraction_per_period > 1:
            return False  # the drift has ended
        chebyshev_angle_rad = math.acos(1 - 2 * min(drift_fraction, 1.0))
        # The k-th polynomial is cos(k arccos x); x runs from -1 to 1.
        polynomial_values = np.cos(
            (math.pi - chebyshev_angle_rad) * np.arange(len(self._coefficients))
        )
        polynomial_values.dot(self._coefficients, self._flat_arrays)
        return True


def with_modal_displacements(
    model: CoupledModel, beam_realisation: Realisation, initial_realisation: Realisation
) -> CoupledModel:
    """Return a coupled model with displacements and speeds of the modes as its states.

    The states of `model` after angle and speed are those of `beam_realisation`.
    `initial_realisation`, at the start of the drift, defines the units of the displacements.
    """
    n, beam_state_count = model.b.size, beam_realisation.b.size
    states_per_displacement = np.eye(n)
    states_per_displacement[2 : 2 + beam_state_count, 2 : 2 + beam_state_count] = (
        _states_from_displacements(beam_realisation, initial_realisation)
    )
    displacements_per_state = np.linalg.inv(states_per_displacement)

    def transformed_row(old_row: RealArray) -> RealArray:
        new_row: RealArray = old_row @ states_per_displacement
        return new_row

    return replace(
        model,
        a=displacements_per_state @ model.a @ states_per_displacement,
        b=displacements_per_state @ model.b,
        angle_output_row=transformed_row(model.angle_output_row),
        velocity_output_row=transformed_row(model.velocity_output_row),
        acceleration_output_row=transformed_row(model.acceleration_output_row),
        beam_torque_output_row=transformed_row(model.beam_torque_output_row),
        sensor_torque_output_row=transformed_row(model.sensor_torque_output_row),
        sensed_torque_output_row=None
        if model.sensed_torque_output_row is None
        else transformed_row(model.sensed_torque_output_row),
        shear_output_row=transformed_row(model.shear_output_row),
        sensed_shear_output_row=None
        if model.sensed_shear_output_row is None
        else transformed_row(model.sensed_shear_output_row),
    )


def _states_from_displacements(
    beam_realisation: Realisation, initial_realisation: Realisation
) -> RealArray:
    """Return the matrix that computes the realisation's states from modal displacements and speeds.

    States that belong to no mode are unchanged.
    """
    initial_rate_by_mode = {
        beam_mode: abs(pole)
        for beam_mode, pole in zip(
            initial_realisation.mode_indices.tolist(),
            initial_realisation.poles_rad_s.tolist(),
            strict=True,
        )
    }
    poles, pole_modes = beam_realisation.poles_rad_s, beam_realisation.mode_indices
    first_state_of_pole = np.cumsum([0, *np.where(poles.imag > 0, 2, 1)])  # state of each pole
    state_matrix = np.zeros((beam_realisation.b.size, beam_realisation.b.size))
    column_index = 0
    unchanged_states: list[int] = []
    for beam_mode in np.unique(pole_modes):
        mode_poles = np.flatnonzero(pole_modes == beam_mode)
        mode_states = first_state_of_pole[mode_poles]
        if beam_mode >= 0 and poles[mode_poles[0]].imag > 0:
            pole = poles[mode_poles[0]]
            # With x - i y of the realisation: x - i y = p* q - q'.
            state_rows = [[pole.real, -1.0], [pole.imag, 0.0]]
            mode_states = np.array([mode_states[0], mode_states[0] + 1])
        elif beam_mode >= 0 and mode_poles.size == 2:
            state_rows = [[pole.real, -1.0] for pole in poles[mode_poles[::-1]]]
        else:
            unchanged_states += mode_states.tolist()
            continue
        column_scales = np.array([1 / initial_rate_by_mode[int(beam_mode)], 1.0])
        state_matrix[mode_states, column_index : column_index + 2] = (
            np.array(state_rows) * column_scales
        )
        column_index += 2
    state_matrix[unchanged_states, np.arange(column_index, beam_realisation.b.size)] = 1.0
    return state_matrix
