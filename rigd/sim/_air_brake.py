"""Air drag on the simulated beam, computed tick by tick.

The drag force per metre at the points of a `DragGrid` drives the beam's modes, whose poles are
those of its realisation, and the moment of the force acts on the shaft. The speeds at the points
follow from the state. The force over the coming period is unknown when the period starts, so it is
extrapolated: a parabola through the last three forces is averaged over the period.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    AIR_DENSITY_KG_PER_M3,
    Beam,
    Damping,
    DragGrid,
    clamped_free_eigenvalues,
    mode_shape_mean,
)
from rigd.beam.realisation import CoupledModel, Realisation

RealArray = NDArray[np.float64]
"""Array of real numbers."""
ComplexArray = NDArray[np.complex128]
"""Array of complex numbers."""

_DRAG_MODE_COUNT = 5
"""Number of modes of the beam on which the drag acts.

The fifth mode of the reference paper's beam is at 145 Hz, three times the highest frequency of its
sweep."""
_DRAG_POINT_COUNT = 16
"""Number of points along the beam at which the drag force is computed."""
_EXTRAPOLATION_WEIGHTS = (23 / 12, -16 / 12, 5 / 12)
"""Weights of the last three drag forces, newest first, in the extrapolated mean of the next period.

They are the weights of the third-order Adams-Bashforth method."""


class AirBrake:
    """Drag of still air on a simulated beam: its force, and its effect on motor and beam.

    The first oscillating poles of the realisation belong to the first modes. `drag_m` is the drag
    coefficient times the diameter of the beam in m, ``C_D d``.

    Attributes
    ----------
    speed_rows
        Matrix that gives the beam's speeds in m/s at the points of the grid from the state of the
        model that `extended_model` returns, shape (points, n).
    """

    __slots__ = (
        "_force_per_square_speed",
        "_forces",
        "_grid",
        "_magnitude",
        "_newest",
        "_poles",
        "_shear_of_mode",
        "_shear_per_force_m",
        "_torque_of_mode",
        "_torque_per_force_m2",
        "_weights",
        "speed_rows",
    )

    def __init__(
        self, beam: Beam, damping: Damping, realisation: Realisation, drag_m: float
    ) -> None:
        poles = realisation.poles_rad_s[realisation.poles_rad_s.imag > 0][:_DRAG_MODE_COUNT]
        mode_count = poles.size
        self._poles = poles
        self._grid = drag_grid = DragGrid.along_beam(beam, mode_count, _DRAG_POINT_COUNT)
        k_fourth = (clamped_free_eigenvalues(mode_count) / beam.length_m) ** 4
        inertial_terms = beam.density_over_stiffness * poles**2
        external_terms = damping.gamma * poles**damping.lambda_
        internal_terms = damping.zeta * poles**damping.alpha * k_fourth
        load_terms = inertial_terms + external_terms
        derivatives_at_poles = (
            2 * inertial_terms + damping.lambda_ * external_terms + damping.alpha * internal_terms
        ) / poles
        shape_moment_m2 = beam.length_m * drag_grid.shape_moment_m
        self._torque_of_mode = _real_part_rows(
            shape_moment_m2 * load_terms / derivatives_at_poles
        ).sum(axis=0)
        self._torque_per_force_m2 = (
            shape_moment_m2 @ drag_grid.modal_force_matrix - drag_grid.moment_weights_m2
        )
        mean_deflections_m = beam.length_m * mode_shape_mean(mode_count)
        self._shear_of_mode = _real_part_rows(
            mean_deflections_m * load_terms / derivatives_at_poles
        ).sum(axis=0)
        self._shear_per_force_m = (
            mean_deflections_m @ drag_grid.modal_force_matrix - drag_grid.quadrature_weight_m
        )

        coupled_state_count = 2 + realisation.b.size
        self.speed_rows: RealArray = np.zeros(
            (_DRAG_POINT_COUNT, coupled_state_count + 2 * mode_count)
        )
        self.speed_rows[:, 1] = drag_grid.x_m
        modal_rows = _real_part_rows(
            -drag_grid.shape_moment_m * load_terms / derivatives_at_poles / poles
        )
        self.speed_rows[:, 2 : 2 + 2 * mode_count] = drag_grid.mode_shapes.T @ modal_rows
        force_rows = _real_part_rows(poles / derivatives_at_poles / beam.bending_stiffness_n_m2)
        self.speed_rows[:, coupled_state_count:] = drag_grid.mode_shapes.T @ force_rows

        self._forces = np.zeros((3, _DRAG_POINT_COUNT))
        self._magnitude = np.zeros(_DRAG_POINT_COUNT)
        self._newest = 0
        # The forces are in a ring buffer: one set of weights for each position of the newest.
        ages_by_newest_index = (newest_index - np.arange(3) for newest_index in range(3))
        self._weights = [
            np.array(_EXTRAPOLATION_WEIGHTS)[force_ages % 3] for force_ages in ages_by_newest_index
        ]
        self._force_per_square_speed = -0.5 * AIR_DENSITY_KG_PER_M3 * drag_m

    def extended_model(self, model: CoupledModel) -> tuple[CoupledModel, RealArray]:
        """Return the model of motor and beam, extended by the effect of the drag on the modes.

        The model has two more states per mode, whose torque acts on the shaft. Return also the
        matrix that gives the derivative of the state from the drag force per metre at the points,
        shape (n, points).
        """
        n, added_state_count = model.b.size, 2 * self._poles.size
        a = np.zeros((n + added_state_count, n + added_state_count))
        a[:n, :n] = model.a
        a[:n, n:] = -np.outer(model.b, self._torque_of_mode)
        pole_state_indices = np.arange(n, n + added_state_count, 2)
        a[pole_state_indices, pole_state_indices] = a[
            pole_state_indices + 1, pole_state_indices + 1
        ] = self._poles.real
        a[pole_state_indices, pole_state_indices + 1] = self._poles.imag
        a[pole_state_indices + 1, pole_state_indices] = -self._poles.imag
        force_input = np.zeros((n + added_state_count, _DRAG_POINT_COUNT))
        force_input[:n] = -np.outer(model.b, self._torque_per_force_m2)
        force_input[pole_state_indices] = self._grid.modal_force_matrix

        def extended_row(
            model_row: RealArray, output_per_torque: float = 0.0, direct_effect: float = 0.0
        ) -> RealArray:
            return np.concatenate(
                [model_row, (direct_effect - output_per_torque) * self._torque_of_mode]
            )

        extended_coupled_model = replace(
            model,
            a=a,
            b=np.concatenate([model.b, np.zeros(added_state_count)]),
            angle_output_row=extended_row(model.angle_output_row),
            velocity_output_row=extended_row(model.velocity_output_row),
            acceleration_output_row=extended_row(
                model.acceleration_output_row, model.acceleration_per_torque
            ),
            beam_torque_output_row=extended_row(
                model.beam_torque_output_row, model.beam_torque_per_torque, 1.0
            ),
            sensor_torque_output_row=extended_row(
                model.sensor_torque_output_row, model.sensor_torque_per_torque, 1.0
            ),
            shear_output_row=np.append(
                model.shear_output_row,
                self._shear_of_mode - model.shear_per_torque * self._torque_of_mode,
            ),
        )
        return extended_coupled_model, force_input

    def update_force(self, speed_m_s: RealArray) -> tuple[float, float]:
        """Compute and store the drag force for given speeds in m/s; return its immediate effect.

        The effect is the change of the beam's torque in N·m and shear in N by the force before it
        has moved any mode.
        """
        self._newest = (self._newest + 1) % 3
        force_n_per_m = self._forces[self._newest]
        np.absolute(speed_m_s, self._magnitude)
        np.multiply(self._magnitude, speed_m_s, force_n_per_m)
        force_n_per_m *= self._force_per_square_speed
        return float(self._torque_per_force_m2.dot(force_n_per_m)), float(
            self._shear_per_force_m.dot(force_n_per_m)
        )

    def write_held_force(self, force_output: RealArray) -> None:
        """Write the drag force of the coming period, in N/m, into the array `force_output`."""
        self._weights[self._newest].dot(self._forces, force_output)


def _real_part_rows(gains: ComplexArray) -> RealArray:
    """Return rows that compute ``2 Re(gain z)`` for the complex state z of each pole, (m, 2 m).

    The model stores z as two real states: its real part, and minus its imaginary part.
    """
    real_part_matrix = np.zeros((gains.size, 2 * gains.size))
    pole_index = np.arange(gains.size)
    real_part_matrix[pole_index, 2 * pole_index] = 2 * gains.real
    real_part_matrix[pole_index, 2 * pole_index + 1] = 2 * gains.imag
    return real_part_matrix
