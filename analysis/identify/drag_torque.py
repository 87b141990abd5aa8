"""Torque by air drag along the beam, and its derivatives by the parameters of beam and drag law.

A force f per metre on a beam that moves relative to its root acts on mode i with
``F_i = ∫ phi_i f dx / L``. With p, c and k of `analysis.identify._predictor`,
``Z_i = p + c k_i⁴`` and ``b_i = ∫ x phi_i dx / L``::

    q_i = (F_i / EI - p b_i angle) / Z_i
    v(x) = x angle' + sum_i phi_i(x) q_i'
    f = -rho_air/2 (C |v| v + S |v|^(1/3) v)
    torque added = sum_i L b_i F_i p / Z_i - ∫ x f dx

The moment of the force is exact. The sum over the modes is the whole contribution of inertia. C is
C_D d of a constant coefficient. S is the part of C_D d that falls with the speed as in White's law
for a cylinder, ``C_D = 1 + 10 Re^(-2/3)`` [1]_.

The speeds caused by the motor's motion are exact (by transforms over the whole record, as in
`TorquePredictor`). The effect of drag on these speeds is computed in time steps, since drag halves
a resonance peak and repeated substitution does not converge there. The two poles of each mode, with
their residues, are stepped. Between the steps the force is the cubic through the last four forces.
From the resulting forces the torque again follows by transforms, exactly.

This torque is not linear in the motion, so no frequency response function describes it. In a fit it
is removed from the measured torque (`analysis.identify._drag_expansion`).

References
----------
.. [1] F. M. White, Viscous Fluid Flow, McGraw-Hill.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._predictor import eigenvalues
from rigd.beam import (
    AIR_DENSITY_KG_PER_M3,
    CausalTransform,
    DragGrid,
    poles_for_eigenvalues,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._modal_model import ModalEstimate
    from rigd.beam import Plant

    RealArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]

DRAG_MODE_COUNT: Final = 5
"""Number of beam modes that the drag force can excite in the computation."""

DRAG_POINT_COUNT: Final = 16
"""Number of points along the beam at which the drag force is computed."""

_SPEED_OVERSAMPLING: Final = 3
"""Time steps per sample. The band ends at 0.4 of the rate, so up to three times its end nothing is
aliased into it."""

_PAST_FORCE_COUNT: Final = 3
"""Number of earlier forces that the interpolation polynomial passes through, in addition to the
present force."""

HALF_AIR_DENSITY_KG_PER_M3: Final = 0.5 * AIR_DENSITY_KG_PER_M3
"""Half the density of air, in kg/m³."""

LOWEST_MODE_INDICES: Final = [0, 1]
"""Indices of the modes on which external damping acts noticeably: relative to inertia, its force
decreases with frequency."""

_DIVERGED_SPEED_RATIO: Final = 10.0
"""Speed, relative to the highest one without drag, that no beam with drag can reach."""

_STEPS_PER_CHUNK: Final = 4096
"""Number of time steps whose matrices are computed together."""

_MAX_UNDIVIDED_STEPS: Final = 300_000
"""Maximum number of time steps for which the forces at all points are computed at once: those of a
record that is analysed at its full rate. Chunks would change the last digits."""

_STEP_QUADRATURE_POINTS: Final = 12
"""Number of Gauss-Legendre points for the integral over one time step."""

_DECREASING_DRAG_EXPONENT: Final = 1 / 3
"""Power of the speed in the drag force per speed if C_D falls as the power -2/3."""


# Drag torque of one beam with one drag law


class DragError(ArithmeticError):
    """Error if drag is too large, or the beam too light, for a stable simulation in time steps."""


@dataclass(frozen=True, slots=True)
class DragLaw:
    """Drag coefficient times diameter, C_D d, as a function of the speed.

    Attributes
    ----------
    constant_m : float
        Part of C_D d that does not depend on the speed, in m.
    decreasing_coefficient : float
        Part of C_D d that falls with the speed: its value at 1 m/s, in m (m/s)^(2/3).
    """

    constant_m: float
    decreasing_coefficient: float = 0.0

    def drag_at_speed_m(self, speed_m_s: float) -> float:
        """Return drag coefficient times diameter, C_D d, in m at a speed in m/s."""
        return float(
            self.constant_m
            + self.decreasing_coefficient * speed_m_s ** (_DECREASING_DRAG_EXPONENT - 1)
        )


@dataclass(frozen=True, slots=True, eq=False)
class DragTorque:
    """Drag torque of one beam and drag law with its derivatives, at the samples of the angle.

    Attributes
    ----------
    law : DragLaw
        Drag law of the computation.
    torque_nm : ndarray, shape (m,)
        Torque by drag in N·m.
    pole_derivatives : dict of int to ndarray, shape (2, m)
        Derivatives by the real and the imaginary part of the upper pole of each mode.
    external_damping_derivatives : ndarray, shape (2, 2, m)
        Derivatives by c_0 and c_1 of an external damping ``c_0 + c_1 s`` that drives each of the
        two lowest modes, with constant poles.
    law_derivatives : ndarray, shape (2, m)
        Derivatives by `DragLaw.constant_m` and `DragLaw.decreasing_coefficient`.
    delay_derivative : ndarray, shape (m,)
        Derivative by the delay of the torque, in N·m/s.
    mean_speed_m_s : float
        Mean speed over beam and record, weighted with the power dissipated by drag.
    top_speed_m_s : float
        Highest speed of any point of the beam.
    """

    law: DragLaw
    torque_nm: RealArray
    pole_derivatives: dict[int, RealArray]
    external_damping_derivatives: RealArray
    law_derivatives: RealArray
    delay_derivative: RealArray
    mean_speed_m_s: float
    top_speed_m_s: float

    @property
    def ln_density_derivative(self) -> RealArray:
        """Return the derivative of the drag torque by ln(mass per length), in N·m, shape (m,).

        Poles and drag law are held constant.
        """
        law_coefficients = np.array([self.law.constant_m, self.law.decreasing_coefficient])
        torque_derivative: RealArray = self.torque_nm - law_coefficients @ self.law_derivatives
        return torque_derivative


class DragResponse:
    """Computation of the torque by air drag on one beam whose root follows a given angle.

    Parameters
    ----------
    angle_rad : ndarray, shape (m,)
        Motor angle, which starts at rest and has no content at half the rate.
    rate_hz : float
        Sampling rate of the angle.
    plant : Plant
        Rig with the linear beam.
    measured_modes : ModalEstimate, optional
        Modes of the beam whose poles and phases replace those of the plant, so that the torque is
        right on a beam that is not uniform.

    Attributes
    ----------
    s : ndarray of complex, shape (bins,)
        Points of the transforms, on a line parallel to the imaginary axis, in rad/s.
    """

    def __init__(
        self,
        angle_rad: RealArray,
        rate_hz: float,
        plant: Plant,
        measured_modes: ModalEstimate | None = None,
    ) -> None:
        self.plant, self._samples, self._rate_hz = plant, angle_rad.size, rate_hz
        self._transform = CausalTransform.for_record(angle_rad.size, rate_hz)
        self.s = s = self._transform.s
        beam, damping = plant.beam, plant.damping
        self._grid = DragGrid.along_beam(beam, DRAG_MODE_COUNT, DRAG_POINT_COUNT)
        wavenumber_fourth_powers = (eigenvalues(DRAG_MODE_COUNT) / beam.length_m) ** 4
        log_s, inertia = np.log(s), beam.density_over_stiffness * s * s
        inertial_term = inertia + damping.gamma * np.exp(damping.lambda_ * log_s)
        modal_impedances = inertial_term + wavenumber_fourth_powers[:, None] * (
            1 + damping.zeta * np.exp(damping.alpha * log_s)
        )
        self._pole_pairs = _pole_pairs(wavenumber_fourth_powers * beam.length_m**4, plant)
        self._impedance_slopes = _impedance_slopes(self._pole_pairs, plant)
        self._inertia_terms = [inertial_term] * DRAG_MODE_COUNT
        self._phase_factors: list[ComplexArray | float] = [1.0] * DRAG_MODE_COUNT
        measured_poles = measured_modes.poles_rad_s if measured_modes else {}
        for mode_index in range(DRAG_MODE_COUNT):
            pole = measured_poles.get(mode_index + 1)
            if pole is None or measured_modes is None:
                continue
            # The external damping of a fit without drag is arbitrary; pole and phase contain it.
            self._inertia_terms[mode_index] = inertia
            modal_impedances[mode_index] = (
                beam.density_over_stiffness * (s - pole) * (s - pole.conjugate())
            )
            self._pole_pairs[mode_index] = pole_pair = np.array([pole, pole.conjugate()])
            self._impedance_slopes[mode_index] = beam.density_over_stiffness * (
                pole_pair - pole_pair.conjugate()
            )
            residue = measured_modes.residue(mode_index + 1)
            self._phase_factors[mode_index] = self._phase_factor(pole, residue)
        # Response p over Z of each mode, one row for each
        self._inertial_response = np.array(
            [
                inertia_term / row
                for inertia_term, row in zip(self._inertia_terms, modal_impedances, strict=True)
            ]
        )
        self._speed_per_force = s / modal_impedances / beam.bending_stiffness_n_m2
        self._torque_channel = plant.channel_response(s)
        angle_transform = self._transform.forward(angle_rad)
        self._modal_speed_by_angle = -self._grid.shape_moment_m[:, None] * (
            self._inertial_response * s * angle_transform
        )
        self._speed_transform = s * angle_transform

    def first_order_torque(self) -> RealArray:
        """Return the drag torque divided by C_D d in the limit of small drag, in N, shape (m,).

        C_D d is drag coefficient times diameter.
        """
        modal_speeds = self._oversampled_modal_speeds()
        step_count = modal_speeds.shape[1]
        chunk_length = step_count if step_count <= _MAX_UNDIVIDED_STEPS else _STEPS_PER_CHUNK
        for first_step in range(0, step_count, chunk_length):
            # The forces replace the speeds: the rows of a long record take much memory.
            speed_chunk = modal_speeds[:, first_step : first_step + chunk_length]
            speed_chunk[:] = self._modal_forces(
                _drag_force(self._point_speed(speed_chunk), DragLaw(1.0))
            )
        return self._torque_over_time(modal_speeds)

    def torque(self, law: DragLaw, mode_numbers: Sequence[int] = ()) -> DragTorque:
        """Return the torque by air drag in N·m, and its derivatives by poles, damping and law.

        Parameters
        ----------
        law : DragLaw
            Drag law of the air.
        mode_numbers : sequence of int
            Numbers of the modes whose poles the torque is differentiated by.

        Raises
        ------
        DragError
            If the simulated speeds diverge.
        """
        point_speed_m_s = self._point_speed_without_drag()
        top_speed_without_drag_m_s = float(np.abs(point_speed_m_s).max())
        with np.errstate(over="ignore", invalid="ignore"):
            self._add_drag_to_speeds(point_speed_m_s, law)
            top_speed_m_s = float(np.abs(point_speed_m_s).max())
        if not top_speed_m_s <= _DIVERGED_SPEED_RATIO * top_speed_without_drag_m_s:
            raise DragError(f"drag of {law.constant_m:g} m cannot be followed.")
        modal_forces = self._modal_forces(_drag_force(point_speed_m_s, law))
        mode_numbers = [
            mode_number
            for mode_number in mode_numbers
            if mode_number <= DRAG_MODE_COUNT and self._pole_pairs[mode_number - 1][0].imag > 0
        ]
        force_spectra = self._transform_forces(modal_forces)
        modal_speeds = self._modal_speed_by_angle + self._speed_per_force * force_spectra[:-1]
        speed_sources: list[tuple[int, RealArray]] = []
        direct_torques = []
        modal_torques = self._modal_torques(force_spectra)
        for mode_number in mode_numbers:
            upper_pole = self._pole_pairs[mode_number - 1][0]
            pole_term, conjugate_term = (
                1 / (self.s - upper_pole),
                1 / (self.s - upper_pole.conjugate()),
            )
            for pole_factor in (pole_term + conjugate_term, 1j * (pole_term - conjugate_term)):
                speed_sources.append(
                    (
                        mode_number - 1,
                        self._oversampled_values(modal_speeds[mode_number - 1] * pole_factor),
                    )
                )
                direct_torques.append(
                    self.to_time_series(modal_torques[mode_number - 1] * pole_factor)
                )
        for mode_index in LOWEST_MODE_INDICES:
            inertia_term = self._inertia_terms[mode_index]
            for pole_factor in (1 / inertia_term, self.s / inertia_term):
                speed_sources.append(
                    (
                        mode_index,
                        self._oversampled_values(
                            self._modal_speed_by_angle[mode_index] * pole_factor
                        ),
                    )
                )
                direct_torques.append(self.to_time_series(modal_torques[mode_index] * pole_factor))
        force_changes = self._modal_force_changes(point_speed_m_s, law, speed_sources)
        torque_derivatives = [
            self._torque_over_time(force_change) for force_change in force_changes
        ]
        torque_derivatives[: len(direct_torques)] = [
            force_torque + direct_torque
            for force_torque, direct_torque in zip(torque_derivatives, direct_torques, strict=False)
        ]
        external_derivatives, law_derivatives = (
            torque_derivatives[2 * len(mode_numbers) : len(direct_torques)],
            torque_derivatives[len(direct_torques) :],
        )
        torque_transform = modal_torques.sum(axis=0) - force_spectra[-1]
        return DragTorque(
            law=law,
            torque_nm=self.to_time_series(torque_transform),
            pole_derivatives={
                mode_number: np.array(torque_derivatives[2 * i : 2 * i + 2])
                for i, mode_number in enumerate(mode_numbers)
            },
            external_damping_derivatives=np.reshape(
                external_derivatives, (len(LOWEST_MODE_INDICES), 2, self._samples)
            ),
            law_derivatives=np.array(law_derivatives),
            delay_derivative=self.to_time_series(-self.s * torque_transform),
            mean_speed_m_s=self._mean_speed(point_speed_m_s),
            top_speed_m_s=top_speed_m_s,
        )

    @property
    def poles(self) -> ComplexArray:
        """Return the pole with positive imaginary part of each mode, in rad/s, shape (modes,)."""
        upper_poles: ComplexArray = self._pole_pairs[:, 0]
        return upper_poles

    @property
    def _mode_leverage(self) -> RealArray:
        """Return ``L b_i`` in m², the first moment of the shape of each mode i about the root."""
        return self.plant.beam.length_m * self._grid.shape_moment_m

    def _mean_speed(self, speed_m_s: RealArray) -> float:
        """Return the mean speed of the beam in m/s, weighted with the power dissipated by drag."""
        speed_cubed = np.abs(speed_m_s) ** 3
        total_power = float(speed_cubed.sum(axis=0) @ self._grid.quadrature_weight_m)
        speed_times_power = float(
            np.einsum("tg,tg->g", speed_cubed, np.abs(speed_m_s)) @ self._grid.quadrature_weight_m
        )
        return speed_times_power / total_power if total_power > 0 else 0.0

    def _point_speed_without_drag(self) -> RealArray:
        """Return the speeds of the beam points without drag in m/s, shape (3 m, points)."""
        return self._point_speed(self._oversampled_modal_speeds())

    def _oversampled_modal_speeds(self) -> RealArray:
        """Return the speeds of rotation and of each mode without drag, shape (1 + modes, 3 m)."""
        modal_speeds = np.empty((1 + DRAG_MODE_COUNT, _SPEED_OVERSAMPLING * self._samples))
        speed_transforms = (self._speed_transform, *self._modal_speed_by_angle)
        for modal_speed, speed_transform in zip(modal_speeds, speed_transforms, strict=True):
            modal_speed[:] = self._oversampled_values(speed_transform)
        return modal_speeds

    def _point_speed(self, modal_speeds: RealArray) -> RealArray:
        """Return the speeds of the beam points in m/s, shape (n, points).

        `modal_speeds`, shape (1 + modes, n), are the speeds of rotation and of each mode.
        """
        point_speed_m_s: RealArray = np.outer(modal_speeds[0], self._grid.x_m)
        for mode_shape, modal_speed in zip(self._grid.mode_shapes, modal_speeds[1:], strict=True):
            point_speed_m_s += np.outer(modal_speed, mode_shape)
        return point_speed_m_s

    def _add_drag_to_speeds(self, speed_m_s: RealArray, law: DragLaw) -> None:
        """Add the effect of drag to the speeds of the beam points in m/s, shape (3 m, points).

        The array is changed in place.
        """
        speed_per_state, state_transition, state_per_modal_force = self._time_step_matrices()
        step_matrix = np.concatenate([self._grid.mode_shapes.T @ speed_per_state, state_transition])
        state_per_force = state_per_modal_force @ self._grid.modal_force_matrix
        modal_state, force_per_m, speed_magnitude = (
            np.zeros(len(state_transition)),
            *np.zeros((2, DRAG_POINT_COUNT)),
        )
        step_output = np.zeros(len(step_matrix))
        drag_speed_change, free_state = (
            step_output[:DRAG_POINT_COUNT],
            step_output[DRAG_POINT_COUNT:],
        )
        constant_factor, decreasing_factor = (
            -HALF_AIR_DENSITY_KG_PER_M3 * law.constant_m,
            -HALF_AIR_DENSITY_KG_PER_M3 * law.decreasing_coefficient,
        )
        multiply_step, multiply_force = step_matrix.dot, state_per_force.dot
        add, multiply, take_absolute, take_cube_root = np.add, np.multiply, np.absolute, np.cbrt
        for point_speed in speed_m_s:
            multiply_step(modal_state, step_output)
            add(point_speed, drag_speed_change, point_speed)
            take_absolute(point_speed, speed_magnitude)
            if decreasing_factor:
                take_cube_root(speed_magnitude, force_per_m)
                multiply(force_per_m, decreasing_factor, force_per_m)
                multiply(speed_magnitude, constant_factor, speed_magnitude)
                add(force_per_m, speed_magnitude, speed_magnitude)
            else:
                multiply(speed_magnitude, constant_factor, speed_magnitude)
            multiply(speed_magnitude, point_speed, force_per_m)
            multiply_force(force_per_m, modal_state)
            add(modal_state, free_state, modal_state)

    def _modal_force_changes(
        self, speed_m_s: RealArray, law: DragLaw, speed_sources: list[tuple[int, RealArray]]
    ) -> list[RealArray]:
        """Return the first-order changes of the modal forces, each of shape (modes + 1, 3 m).

        First come the changes due to each of `speed_sources`: the index of a mode, and a speed,
        shape (3 m,), that is added to this mode. The last two are those per unit of each
        coefficient of the drag law. To first order the force on a mode is a sum over the modal
        speeds, with one factor for each pair of modes at each time step. `speed_m_s`, shape
        (3 m, points), includes the effect of drag.
        """
        speed_per_state, state_transition, state_per_modal_force = self._time_step_matrices()
        step_matrix = np.concatenate([speed_per_state, state_transition])
        state_per_force = np.hstack(
            [state_per_modal_force, np.zeros((len(state_per_modal_force), 1))]
        )  # the moment is no input
        run_count, force_weights = len(speed_sources) + 2, self._point_to_modal_forces
        mode_pair_weights = (
            (force_weights[:, None] * self._grid.mode_shapes).reshape(-1, DRAG_POINT_COUNT).T
        )
        force_changes = np.empty((len(speed_m_s), len(force_weights), run_count))
        modal_state, step_output = (
            np.zeros((len(state_transition), run_count)),
            np.zeros((len(step_matrix), run_count)),
        )
        modal_speed, free_state = step_output[:DRAG_MODE_COUNT], step_output[DRAG_MODE_COUNT:]
        coupled_force, dot, add = np.empty(force_changes.shape[1:]), np.dot, np.add
        for first_step in range(0, len(speed_m_s), _STEPS_PER_CHUNK):
            step_range = slice(first_step, first_step + _STEPS_PER_CHUNK)
            force_changes_in_chunk, speed_magnitude = (
                force_changes[step_range],
                np.abs(speed_m_s[step_range]),
            )
            cube_root = np.cbrt(speed_magnitude)
            force_slope = -2 * HALF_AIR_DENSITY_KG_PER_M3 * law.constant_m * speed_magnitude
            if law.decreasing_coefficient:
                force_slope -= (
                    (1 + _DECREASING_DRAG_EXPONENT)
                    * HALF_AIR_DENSITY_KG_PER_M3
                    * law.decreasing_coefficient
                    * cube_root
                )
            force_per_mode_speed = (force_slope @ mode_pair_weights).reshape(
                -1, len(force_weights), DRAG_MODE_COUNT
            )
            for run_index, (mode_index, added_speed) in enumerate(speed_sources):
                np.multiply(
                    force_per_mode_speed[:, :, mode_index],
                    added_speed[step_range, None],
                    out=force_changes_in_chunk[:, :, run_index],
                )
            for run_index, law_power in (-2, speed_magnitude), (-1, cube_root):
                force_changes_in_chunk[:, :, run_index] = (
                    -HALF_AIR_DENSITY_KG_PER_M3 * law_power * speed_m_s[step_range]
                ) @ force_weights.T
            for force_row, coupling_matrix in zip(
                force_changes_in_chunk, force_per_mode_speed, strict=True
            ):
                dot(step_matrix, modal_state, step_output)
                dot(coupling_matrix, modal_speed, coupled_force)
                add(force_row, coupled_force, force_row)
                dot(state_per_force, force_row, modal_state)
                add(modal_state, free_state, modal_state)
        return list(np.ascontiguousarray(force_changes.transpose(2, 1, 0)))

    def _time_step_matrices(self) -> tuple[RealArray, RealArray, RealArray]:
        """Return the matrices of one time step of the modes under drag.

        They multiply the state to give the modal speeds, the state to give its part of the next
        state, and the modal forces to give the other part. The state holds two numbers for each
        mode, then the modal forces of the last three steps.
        """
        n, step_s = DRAG_MODE_COUNT, 1 / (_SPEED_OVERSAMPLING * self._rate_hz)
        state_count = 2 * n + _PAST_FORCE_COUNT * n
        state_transition, state_per_modal_force = (
            np.zeros((state_count, state_count)),
            np.zeros((state_count, n)),
        )
        speed_output = np.zeros((n, state_count))
        for i, (pole_pair, impedance_slope_pair) in enumerate(
            zip(self._pole_pairs, self._impedance_slopes, strict=True)
        ):
            state_rows = slice(2 * i, 2 * i + 2)
            step_decay = np.exp(pole_pair * step_s)
            force_weights = _force_weights_of_step(
                pole_pair, step_s
            )  # (2, 1 + _PAST), the newest first
            force_gain = pole_pair / impedance_slope_pair / self.plant.beam.bending_stiffness_n_m2
            if pole_pair[0].imag > 0:
                a, b = step_decay[0].real, step_decay[0].imag
                state_transition[state_rows, state_rows] = [[a, -b], [b, a]]
                real_weights = np.array([force_weights[0].real, force_weights[0].imag])
                speed_output[i, state_rows] = 2 * force_gain[0].real, -2 * force_gain[0].imag
            elif np.isnan(pole_pair[0]):
                continue
            else:
                state_transition[state_rows, state_rows] = np.diag(step_decay.real)
                real_weights = force_weights.real
                speed_output[i, state_rows] = force_gain.real
            state_per_modal_force[state_rows, i] = real_weights[:, 0]
            state_transition[state_rows, 2 * n + i :: n] = real_weights[:, 1:]
        # Shift the stored forces by one step.
        state_per_modal_force[2 * n : 3 * n] = np.eye(n)
        state_transition[3 * n :, 2 * n : -n] = np.eye((_PAST_FORCE_COUNT - 1) * n)
        # The new force is not known yet: it is extrapolated from the last three for the speed.
        extrapolating_matrix = state_transition[: 2 * n].copy()
        for steps_back, extrapolation_factor in enumerate((3.0, -3.0, 1.0)):
            force_columns = slice((2 + steps_back) * n, (3 + steps_back) * n)
            extrapolating_matrix[:, force_columns] += (
                extrapolation_factor * state_per_modal_force[: 2 * n]
            )
        return (
            speed_output[:, : 2 * n] @ extrapolating_matrix,
            state_transition,
            state_per_modal_force,
        )

    @property
    def _point_to_modal_forces(self) -> RealArray:
        """Return the matrix that converts forces at the beam points to modal forces.

        Its last row gives the moment about the root.
        """
        return np.vstack([self._grid.modal_force_matrix, self._grid.moment_weights_m2])

    def _modal_forces(self, point_force: RealArray) -> RealArray:
        """Convert forces at the beam points to modal forces and, last, the moment about the root.

        The result has the shape (modes + 1, 3 m).
        """
        modal_forces: RealArray = self._point_to_modal_forces @ point_force.T
        return modal_forces

    def _transform_forces(self, modal_forces: RealArray) -> ComplexArray:
        """Return the Laplace transform of modal forces and root moment at the points `s`.

        Its shape is (modes + 1, bins).
        """
        # One row after another: the transforms at the higher rate take three times their result.
        return np.array(
            [
                self._transform.forward(modal_force, oversampling=_SPEED_OVERSAMPLING)
                for modal_force in modal_forces
            ]
        )

    def _modal_torques(self, force_spectra: ComplexArray) -> ComplexArray:
        """Return the transforms of the torque that each modal force causes, shape (modes, bins)."""
        return np.array(
            [
                leverage * (response * phase_factor) * force_spectrum
                for leverage, response, phase_factor, force_spectrum in zip(
                    self._mode_leverage,
                    self._inertial_response,
                    self._phase_factors,
                    force_spectra[:-1],
                    strict=True,
                )
            ]
        )

    def _torque_over_time(self, modal_forces: RealArray) -> RealArray:
        """Return the torque in N·m, shape (m,), that modal forces and root moment cause."""
        force_spectra = self._transform_forces(modal_forces)
        return self.to_time_series(
            self._modal_torques(force_spectra).sum(axis=0) - force_spectra[-1]
        )

    def to_time_series(self, torque_transform: ComplexArray) -> RealArray:
        """Convert the Laplace transform of a torque to samples in N·m, shape (..., m).

        The samples include delay and filters of the torque channel.

        Parameters
        ----------
        torque_transform : ndarray of complex, shape (..., bins)
            Transform of the torque at the points `s`.
        """
        return self._transform.inverse(torque_transform * self._torque_channel, self._samples)

    def modal_torque(self, mode_number: int) -> ComplexArray:
        """Return the transform of the linear torque by one mode, without the delay, shape (bins,).

        Modes are numbered from 1. This part of the linear torque contains its whole dependence on
        the poles of the mode.
        """
        torque_factor = (
            self.plant.beam.bending_stiffness_n_m2 * self._mode_leverage[mode_number - 1]
        )
        torque_spectrum: ComplexArray = (
            torque_factor
            * self._inertia_terms[mode_number - 1]
            * self._modal_speed_by_angle[mode_number - 1]
            / self.s
            * self._phase_factors[mode_number - 1]
        )
        return torque_spectrum

    def _phase_factor(self, pole: complex, residue: complex) -> ComplexArray:
        """Return the factor that gives the torque of a mode its measured phase, shape (bins,).

        Drag adds damping to a mode, whatever changes the phase of its residue: external damping,
        delay or clamp. A drag torque without this phase would change the frequency instead.
        """
        # The residue of -s⁴ / Z, through the torque channel, is j times a multiple of this.
        phasor = residue / (1j * pole**4 * self.plant.channel_response(pole))
        phasor /= abs(phasor)
        phase_factor: ComplexArray = phasor.real + phasor.imag * (self.s - pole.real) / pole.imag
        return phase_factor

    def _oversampled_values(self, laplace_transform: ComplexArray) -> RealArray:
        """Convert a Laplace transform to a time series at three times the sampling rate.

        The shape is (..., 3 m).
        """
        return self._transform.inverse(
            laplace_transform, _SPEED_OVERSAMPLING * self._samples, oversampling=_SPEED_OVERSAMPLING
        )


def _drag_force(speed_m_s: RealArray, law: DragLaw) -> RealArray:
    """Return the drag force per length of the beam in N/m, of the shape of the speeds in m/s."""
    speed_magnitude = np.abs(speed_m_s)
    force_per_speed = law.constant_m * speed_magnitude
    if law.decreasing_coefficient:
        force_per_speed += law.decreasing_coefficient * np.cbrt(speed_magnitude)
    force_n_per_m: RealArray = -HALF_AIR_DENSITY_KG_PER_M3 * force_per_speed * speed_m_s
    return force_n_per_m


def _pole_pairs(k_of_length: RealArray, plant: Plant) -> ComplexArray:
    """Return both poles of each mode in rad/s, shape (modes, 2), from its ``(k L)^4``."""
    pole_pairs = poles_for_eigenvalues(k_of_length**0.25, plant.beam, plant.damping)
    return pole_pairs.astype(np.complex128)


def _impedance_slopes(pole_pairs: ComplexArray, plant: Plant) -> ComplexArray:
    """Return the derivative of the modal impedance Z_i by s at both poles, shape (modes, 2)."""
    s, damping = pole_pairs, plant.damping
    density_over_stiffness = plant.beam.density_over_stiffness
    log_s = np.log(s)
    external_damping = damping.gamma * np.exp(damping.lambda_ * log_s)
    internal_damping = damping.zeta * np.exp(damping.alpha * log_s)
    k = -(density_over_stiffness * s * s + external_damping) / (
        1 + internal_damping
    )  # since Z = 0 at the poles
    impedance_slopes: ComplexArray = (
        2 * density_over_stiffness * s
        + (damping.lambda_ * external_damping + damping.alpha * k * internal_damping) / s
    )
    return impedance_slopes


def _force_weights_of_step(poles_per_s: ComplexArray, step_s: float) -> ComplexArray:
    """Return the weights of the last forces F in one time step of the equation ``z' = p z + F``.

    p are the given poles. The weights have the shape (poles, 1 + `_PAST_FORCE_COUNT`), with that of
    the newest force first. Between the time steps F is the polynomial through the last forces.
    """
    quadrature_node, quadrature_weight = np.polynomial.legendre.leggauss(_STEP_QUADRATURE_POINTS)
    step_fraction = 0.5 * (quadrature_node + 1)
    force_instants = 1.0 - np.arange(1 + _PAST_FORCE_COUNT)
    lagrange_values = np.array(
        [
            np.prod(
                [
                    (step_fraction - other_instant) / (own_instant - other_instant)
                    for other_instant in force_instants
                    if other_instant != own_instant
                ],
                axis=0,
            )
            for own_instant in force_instants
        ]
    )
    remaining_decay = np.exp(poles_per_s[:, None] * (step_s * (1 - step_fraction)))
    force_weights: ComplexArray = (
        remaining_decay * (0.5 * step_s * quadrature_weight) @ lagrange_values.T
    )
    return force_weights
