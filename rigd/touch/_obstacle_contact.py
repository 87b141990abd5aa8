"""Contact with one obstacle: predicted effects, and fit of position, instant and stiffness.

A candidate is a set of parameter values. The contact of each candidate of a grid is integrated for
the first samples, that of the best candidates at each position for more samples. The best of these
are refined by least squares (Levenberg and Marquardt, numerical derivatives, all candidates in one
batch). There are many candidates because a bouncing contact has many local minima.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigd.touch._contact import contact_responses, integrate_contact, shift_rows
from rigd.touch._free_motion import FreeMotion
from rigd.touch._kernels import ContactKernels, cubic_weights, interpolate_rows

RealArray = NDArray[np.float64]

OBSTACLE_PARAMETERS = ("x_m", "time_s", "ln_stiffness", "rate_m_per_s", "mobility_m_per_n_s")
"""Names of an obstacle's parameters, in the order of a candidate's columns; the last two are
omitted for an obstacle at rest."""

MAX_LN_STIFFNESS = log(1e6)
"""Logarithm of the largest stiffness of an obstacle in N/m."""
MIN_LN_STIFFNESS = log(10.0)
"""Logarithm of the smallest stiffness of an obstacle in N/m."""

EffectPredictor = Callable[[RealArray, "WhitenedWindow"], RealArray]
"""Function that predicts the effects (k, c, samples) of candidates (k, p) on torque and base shear
in a window of samples."""


@dataclass(frozen=True, slots=True)
class ParameterRanges:
    """Bounds and step sizes of the p parameters of one kind of obstacle; arrays of shape (p,)."""

    lower_limits: RealArray
    """Smallest value of each parameter."""
    upper_limits: RealArray
    """Largest value of each parameter."""
    derivative_step: RealArray
    """Change of each parameter for a numerical derivative."""
    significant_change: RealArray
    """Significant change of each parameter; an iteration changes it by at most eight times this."""
    smallest_std: RealArray
    """Lower limit of the standard deviation with which values of each parameter are drawn."""
    largest_std: RealArray
    """Upper limit of the standard deviation with which values of each parameter are drawn."""


@dataclass(frozen=True, slots=True)
class WhitenedWindow:
    """Whitened innovations of successive samples, with which predicted effects are compared."""

    motion: FreeMotion
    """Motion of the beam without a touch in the record."""
    first_sample: int
    """Index of the first sample."""
    end_sample: int
    """Index of the sample after the last."""
    whitening_matrix: RealArray
    """Inverse Cholesky factor of the covariance that noise and uncertainties cause, shape (n,
    n)."""
    whitened_innovations: RealArray
    """Whitened innovations of torque and base shear, shape (n,)."""

    @classmethod
    def from_motion(
        cls,
        motion_without_touch: FreeMotion,
        first_sample: int,
        end_sample: int,
        effects_per_std: RealArray | None = None,
    ) -> "WhitenedWindow":
        """Return the whitened innovations of a range of samples; `end_sample` is exclusive.

        `effects_per_std` is the effect of one standard deviation of each of r uncertainties on
        torque and shear, shape (c, n, r) from `first_sample` on. Without it only the uncertainty of
        the free motion is used, without its effect on the contact.
        """
        if effects_per_std is None:
            effects_per_std = (
                motion_without_touch.design_matrices[:, first_sample:end_sample]
                @ motion_without_touch.amplitude_cholesky
            )
        noise_stds = motion_without_touch.noise_stds[:, None, None]
        scaled_effects = (effects_per_std[:, : end_sample - first_sample] / noise_stds).reshape(
            -1, effects_per_std.shape[2]
        )
        covariance = np.eye(scaled_effects.shape[0]) + scaled_effects @ scaled_effects.T
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        scaled_innovations = (
            motion_without_touch.innovations[:, first_sample:end_sample]
            / motion_without_touch.noise_stds[:, None]
        ).ravel()
        return cls(
            motion_without_touch,
            first_sample,
            end_sample,
            whitening,
            whitening @ scaled_innovations,
        )

    def residuals(self, predicted_effects: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Return the whitened innovations minus the whitened predicted effects, shape (k, n).

        Predicted effects have the shape (k, c, samples); the result has their floating-point
        precision.
        """
        noise_stds, whitening, whitened_data = (
            float_array.astype(predicted_effects.dtype, copy=False)
            for float_array in (
                self.motion.noise_stds,
                self.whitening_matrix,
                self.whitened_innovations,
            )
        )
        scaled_predictions = (predicted_effects / noise_stds[:, None]).reshape(
            predicted_effects.shape[0], -1
        )
        return whitened_data - scaled_predictions @ whitening.T


class ObstacleContact:
    """Model of the beam's contact with an obstacle, for the record of one touch.

    The kernels have the time steps of the integration; `x_m` are the positions of the displacements
    in `motion_without_touch`, the motion of the beam without a touch.
    """

    __slots__ = ("_kernels", "_motion", "_x_m")

    def __init__(
        self, kernels: ContactKernels, x_m: RealArray, motion_without_touch: FreeMotion
    ) -> None:
        self._kernels, self._x_m, self._motion = kernels, x_m, motion_without_touch

    def predict(
        self,
        parameters: RealArray,
        sample_window: WhitenedWindow,
        pressing_sign: float | None = None,
        kernels: ContactKernels | None = None,
    ) -> tuple[RealArray, RealArray]:
        """Return the effect of obstacles on torque and shear, and the contact forces.

        Candidates have at least the first three columns of `OBSTACLE_PARAMETERS`. Effects have the
        shape (k, c, samples), forces are in N at the time steps from the touch on, shape (k, n).
        The beam presses in the direction `pressing_sign`, 1 or -1, by default that of its motion at
        the touch. `kernels` are those at the position of a single candidate, by default
        interpolated ones.
        """
        motion_without_touch = self._motion
        x, instants_s = parameters[:, 0], parameters[:, 1]
        step_s = self._kernels.step_s
        step_count = self.step_count(instants_s, sample_window)
        local_kernels = self._kernels.at_positions(x, step_count) if kernels is None else kernels
        approaches_m, pressing_signs = self.motion_beyond_obstacle(
            x, instants_s, step_count, pressing_sign
        )
        motion_parameters = parameters[:, 3:].T
        pressing_force_n = integrate_contact(
            np.broadcast_to(local_kernels.displacement_m_per_n[:, :step_count], approaches_m.shape),
            approaches_m,
            np.exp(parameters[:, 2]),
            step_s,
            *(pressing_signs * motion_parameters[0],) if len(motion_parameters) else (),
            *motion_parameters[1:2],
        )
        forces_n = -pressing_signs[:, None] * pressing_force_n
        kernel_tables = (local_kernels.torque_nm_per_n, local_kernels.shear_per_n)[
            : motion_without_touch.innovations.shape[0]
        ]
        return self.force_effects(kernel_tables, forces_n, instants_s, sample_window), forces_n

    def effect_of_changed_motion(
        self,
        parameters: RealArray,
        sample_window: WhitenedWindow,
        displacement_changes_m: RealArray,
    ) -> RealArray:
        """Return the effects of changed free motions on torque and shear through the contact.

        The shape is (r, c, samples). A change of the free motion changes the instant of touch, and
        thereby the contact force. The parameters are position, instant and logarithm of the
        stiffness of an obstacle at rest. The changes are of the displacement in m at its position,
        at the time steps of the free motion, shape (r, steps).
        """
        x, instant_s = parameters[:1], parameters[1:2]
        step_count = self.step_count(instant_s, sample_window)
        local_kernels = self._kernels.at_positions(x, step_count)
        approach_m, pressing_sign = self.motion_beyond_obstacle(x, instant_s, step_count)
        repeated_instants_s = np.repeat(instant_s, len(displacement_changes_m))
        added_approach_m = pressing_sign * self._interpolate_to_steps(
            displacement_changes_m, repeated_instants_s, step_count
        )
        all_approaches = np.vstack(
            [approach_m, approach_m + added_approach_m - added_approach_m[:, :1]]
        )
        stiffnesses_n_per_m = np.full((1, len(all_approaches)), np.exp(parameters[2]))
        pressing_force_n = integrate_contact(
            local_kernels.displacement_m_per_n,
            all_approaches[None],
            stiffnesses_n_per_m,
            self._kernels.step_s,
        )[0]
        kernel_tables = (local_kernels.torque_nm_per_n, local_kernels.shear_per_n)[
            : self._motion.innovations.shape[0]
        ]
        return self.force_effects(
            kernel_tables,
            -pressing_sign * (pressing_force_n[1:] - pressing_force_n[0]),
            repeated_instants_s,
            sample_window,
        )

    def step_count(self, instants_s: RealArray, sample_window: WhitenedWindow) -> int:
        """Return the number of time steps from the earliest touch to the end of the window."""
        step_s = self._kernels.step_s
        required_step_count = (
            int(np.ceil((self._motion.t[sample_window.end_sample - 1] - instants_s.min()) / step_s))
            + 3
        )
        return min(max(required_step_count, 4), self._kernels.step_count)

    def pressing_sign(self, parameters: RealArray) -> float:
        """Return the direction of the free beam's motion at the touch of one candidate, 1 or -1."""
        return float(self.motion_beyond_obstacle(parameters[:1], parameters[1:2], 1)[1][0])

    def force_effects(
        self,
        kernel_tables: tuple[RealArray, ...],
        forces_n: RealArray,
        instants_s: RealArray,
        sample_window: WhitenedWindow,
    ) -> RealArray:
        """Return the effect of contact forces on torque and base shear, shape (k, c, samples).

        The tables are the kernel of torque, and of shear if measured, with k rows or one. Forces
        are given at the time steps of the kernels from each instant on, shape (k, n).
        """
        motion_without_touch = self._motion
        step_s = self._kernels.step_s
        steps_per_sample = round((motion_without_touch.t[1] - motion_without_touch.t[0]) / step_s)
        sample_count = sample_window.end_sample - sample_window.first_sample
        begin_steps = (motion_without_touch.t[sample_window.first_sample] - instants_s) / step_s
        # Convolution and shift commute: shifting first puts the steps of all at the samples.
        aligned_forces = shift_rows(
            forces_n, begin_steps, (sample_count - 1) * steps_per_sample + 1
        )
        return contact_responses(kernel_tables, aligned_forces, steps_per_sample, sample_count)

    def motion_beyond_obstacle(
        self,
        positions_m: RealArray,
        instants_s: RealArray,
        step_count: int,
        given_pressing_sign: float | None = None,
    ) -> tuple[RealArray, RealArray]:
        """Return the free beam's distance beyond each obstacle over time, and its direction.

        The distance is the displacement in m since the instant of touch, shape (k, steps), positive
        in the direction of the motion. The direction is 1 or -1, by default that at the instant of
        touch.
        """
        motion_without_touch = self._motion
        first_rows, weights = cubic_weights(positions_m, self._x_m)
        displacement_m = interpolate_rows(motion_without_touch.displacement_m, first_rows, weights)
        free_motion_m = self._interpolate_to_steps(displacement_m, instants_s, step_count)
        if given_pressing_sign is None:
            position_before_m = shift_rows(
                displacement_m,
                (instants_s - motion_without_touch.first_s) / motion_without_touch.step_s - 1.0,
                1,
            )
            pressing_signs = np.where(free_motion_m[:, 0] >= position_before_m[:, 0], 1.0, -1.0)
        else:
            pressing_signs = np.full(positions_m.size, given_pressing_sign)
        return pressing_signs[:, None] * (free_motion_m - free_motion_m[:, :1]), pressing_signs

    def _interpolate_to_steps(
        self, displacement_m: RealArray, instants_s: RealArray, step_count: int
    ) -> RealArray:
        """Return displacements at the time steps of the contact, each row from its instant on."""
        motion_without_touch = self._motion
        begin_steps = (instants_s - motion_without_touch.first_s) / motion_without_touch.step_s
        substeps = max(1, round(motion_without_touch.step_s / self._kernels.step_s))
        interpolated_m = np.empty((begin_steps.size, substeps * -(-step_count // substeps)))
        for i in range(substeps):
            substep_columns = interpolated_m[:, i::substeps]
            substep_columns[:] = shift_rows(
                displacement_m, begin_steps + i / substeps, substep_columns.shape[1]
            )
        return interpolated_m[:, :step_count]


@dataclass(frozen=True, slots=True)
class LocalMinima:
    """Local minima of the sum of squared residuals, found by least squares."""

    parameters: RealArray
    """Parameters of each minimum, with the columns of `OBSTACLE_PARAMETERS`; shape (k, p)."""
    chi2: RealArray
    """Sum of squared residuals at each minimum, shape (k,)."""
    jacobian: RealArray
    """Derivatives of the residuals with respect to the parameters, shape (k, n, p)."""


_MIN_CHI2_REDUCTION = 0.1
"""Reduction of the sum of squared residuals below which an iteration is the last one. If the sum
increases, the reduction predicted by the linearised model is compared."""


def find_minima(
    predict_effect: EffectPredictor,
    sample_window: WhitenedWindow,
    start_candidates: RealArray,
    parameter_ranges: ParameterRanges,
    max_iterations: int = 12,
    is_free_parameter: NDArray[np.bool_] | None = None,
) -> LocalMinima:
    """Return the local minima of the sum of squared residuals that are reached from given starts.

    Starts have the shape (k, p). `is_free_parameter` states whether each parameter of each start is
    varied, shape (k, p); by default all are.
    """
    best_parameters = np.clip(
        start_candidates, parameter_ranges.lower_limits, parameter_ranges.upper_limits
    )
    damping_factors = np.full(len(best_parameters), 1e-2)
    current_residuals, jacobians = _linearise(
        predict_effect, sample_window, best_parameters, parameter_ranges
    )
    chi2 = np.einsum("kn,kn->k", current_residuals, current_residuals)
    is_active = np.ones(len(best_parameters), dtype=bool)
    regularisation = 1e-6 / parameter_ranges.significant_change**2
    for _ in range(max_iterations):
        active_rows = np.flatnonzero(is_active)
        jacobian, r = jacobians[active_rows], current_residuals[active_rows]
        if is_free_parameter is not None:
            jacobian = jacobian * is_free_parameter[active_rows, None]
        normal_matrices = np.einsum("knp,knq->kpq", jacobian, jacobian)
        gradients = np.einsum("knp,kn->kp", jacobian, r)
        normal_diagonals = (
            np.einsum("kpp->kp", normal_matrices) * damping_factors[active_rows, None]
            + regularisation
        )
        normal_matrices += normal_diagonals[:, :, None] * np.eye(best_parameters.shape[1])
        parameter_steps = -np.linalg.solve(normal_matrices, gradients[:, :, None])[:, :, 0]
        parameter_steps = np.clip(
            parameter_steps,
            -8 * parameter_ranges.significant_change,
            8 * parameter_ranges.significant_change,
        )
        trial_parameters = np.clip(
            best_parameters[active_rows] + parameter_steps,
            parameter_ranges.lower_limits,
            parameter_ranges.upper_limits,
        )
        predicted_residual = r + np.einsum(
            "knp,kp->kn", jacobian, trial_parameters - best_parameters[active_rows]
        )
        predicted_reduction = chi2[active_rows] - np.einsum(
            "kn,kn->k", predicted_residual, predicted_residual
        )
        new_residuals, new_jacobian = _linearise(
            predict_effect, sample_window, trial_parameters, parameter_ranges
        )
        new_chi2 = np.einsum("kn,kn->k", new_residuals, new_residuals)
        chi2_reduction = chi2[active_rows] - new_chi2
        is_improved = chi2_reduction > 0
        accepted_rows = active_rows[is_improved]
        best_parameters[accepted_rows], chi2[accepted_rows] = (
            trial_parameters[is_improved],
            new_chi2[is_improved],
        )
        current_residuals[accepted_rows], jacobians[accepted_rows] = (
            new_residuals[is_improved],
            new_jacobian[is_improved],
        )
        damping_factors[active_rows] = np.where(
            is_improved, damping_factors[active_rows] / 6, damping_factors[active_rows] * 8
        )
        # Residuals have kinks where contacts begin and end: short steps may fail to reduce them.
        is_active[
            active_rows[
                np.where(is_improved, chi2_reduction, predicted_reduction) < _MIN_CHI2_REDUCTION
            ]
        ] = False
        if not is_active.any():
            break
    return LocalMinima(best_parameters, chi2, jacobians)


def _linearise(
    predict_effect: EffectPredictor,
    sample_window: WhitenedWindow,
    current_candidates: RealArray,
    parameter_ranges: ParameterRanges,
) -> tuple[RealArray, RealArray]:
    """Return the candidates' residuals (k, n) and the derivatives by their parameters (k, n, p)."""
    parameter_count = current_candidates.shape[1]
    parameter_shifts = np.where(
        current_candidates + parameter_ranges.derivative_step > parameter_ranges.upper_limits,
        -parameter_ranges.derivative_step,
        parameter_ranges.derivative_step,
    )
    shifted_candidates = np.concatenate(
        [
            current_candidates,
            *(
                current_candidates + np.eye(parameter_count)[i] * parameter_shifts
                for i in range(parameter_count)
            ),
        ]
    )
    residuals = sample_window.residuals(predict_effect(shifted_candidates, sample_window)).reshape(
        parameter_count + 1, len(current_candidates), -1
    )
    derivatives = (residuals[1:] - residuals[0]) / parameter_shifts.T[:, :, None]
    return residuals[0], np.moveaxis(derivatives, 0, -1)


class CandidateGrid:
    """Grid of candidate obstacles at rest: positions, instants and stiffnesses to start a search.

    The contacts of all candidates are integrated together, in coarse time steps, and compared with
    `sample_count` samples. The grid has every `position_stride`-th position of the kernels, whose
    time step is an integer fraction of the sampling period.
    """

    __slots__ = (
        "_displacement_kernels",
        "_lag_kernels",
        "_position_stride",
        "_sample_count",
        "_step_s",
        "_steps_per_sample",
        "_x_m",
    )

    def __init__(
        self, kernels: ContactKernels, position_stride: int, rate_hz: float, sample_count: int
    ) -> None:
        self._steps_per_sample = round(1 / (rate_hz * kernels.step_s))
        self._sample_count, self._position_stride, self._step_s = (
            sample_count,
            position_stride,
            kernels.step_s,
        )
        time_steps = self._steps_per_sample * sample_count
        self._x_m = kernels.x_m[::position_stride]
        # Single precision suffices for choosing starts, and is twice as fast.
        self._displacement_kernels = kernels.displacement_m_per_n[
            ::position_stride, :time_steps
        ].astype(np.float32)
        lag_steps = self._steps_per_sample * np.arange(sample_count)[:, None] - np.arange(
            time_steps
        )
        self._lag_kernels = [
            np.where(
                lag_steps >= 0, kernel_table[::position_stride][:, np.maximum(lag_steps, 0)], 0.0
            )
            .transpose(0, 2, 1)
            .astype(np.float32)
            for kernel_table in (kernels.torque_nm_per_n, kernels.shear_per_n)
        ]  # (positions, steps, samples)

    def integrate(
        self, motion_without_touch: FreeMotion, sample_window: WhitenedWindow, latest_sample: int
    ) -> tuple[RealArray, RealArray]:
        """Return all candidates of the grid (k, 3), and their sums of squared residuals (k,).

        `latest_sample` is the index of the last sample at which the touch may begin.
        """
        touch_samples = np.arange(sample_window.first_sample + 1, latest_sample + 1)
        sample_batches = np.array_split(touch_samples, -(-touch_samples.size // _INSTANTS_AT_ONCE))
        chi2 = [
            self._sums_of_squared_residuals(motion_without_touch, sample_window, sample_batch)
            for sample_batch in sample_batches
        ]
        grid_axes = np.meshgrid(
            self._x_m,
            motion_without_touch.t[touch_samples],
            np.log(GRID_STIFFNESSES_N_PER_M),
            indexing="ij",
        )
        return np.stack(grid_axes, axis=-1).reshape(-1, 3), np.concatenate(chi2, axis=1).ravel()

    def _sums_of_squared_residuals(
        self,
        motion_without_touch: FreeMotion,
        sample_window: WhitenedWindow,
        sample_indices: NDArray[np.intp],
    ) -> RealArray:
        """Return the sums of squared residuals of the candidates that touch at given samples.

        The shape is (positions, samples, stiffnesses).
        """
        position_count, stiffness_count = self._x_m.size, GRID_STIFFNESSES_N_PER_M.size
        sample_count = sample_window.end_sample - int(sample_indices[0])
        time_steps = self._steps_per_sample * sample_count
        begin_steps = np.round(
            (motion_without_touch.t[sample_indices] - motion_without_touch.first_s)
            / motion_without_touch.step_s
        ).astype(np.intp)
        step_columns = begin_steps[:, None] + np.arange(-1, time_steps)
        last_column = motion_without_touch.displacement_m.shape[1] - 1
        displacement_m = motion_without_touch.displacement_m[:: self._position_stride][
            :, np.minimum(step_columns, last_column)
        ]
        # Axes: position, instant, step.
        pressing_signs = np.where(displacement_m[:, :, 1] >= displacement_m[:, :, 0], 1, -1)[
            :, :, None
        ].astype(np.float32)
        approaches_m = (
            pressing_signs * (displacement_m[:, :, 1:] - displacement_m[:, :, 1:2])
        ).astype(np.float32)
        pressing_force_n = integrate_contact(
            self._displacement_kernels[:, :time_steps],
            np.repeat(approaches_m, stiffness_count, axis=1),
            np.tile(
                GRID_STIFFNESSES_N_PER_M.astype(np.float32), (position_count, sample_indices.size)
            ),
            self._step_s,
        )
        forces_n = -np.repeat(pressing_signs, stiffness_count, axis=1) * pressing_force_n
        predicted_effects = np.zeros(
            (
                position_count,
                sample_indices.size,
                stiffness_count,
                motion_without_touch.noise_stds.size,
                sample_window.end_sample - sample_window.first_sample,
            ),
            dtype=np.float32,
        )
        for channel_index in range(motion_without_touch.noise_stds.size):
            channel_effect = (
                forces_n @ self._lag_kernels[channel_index][:, :time_steps, :sample_count]
            )
            channel_effect = channel_effect.reshape(
                position_count, sample_indices.size, stiffness_count, sample_count
            )
            for i, touch_sample in enumerate(sample_indices):
                later_samples = sample_window.end_sample - touch_sample
                predicted_effects[:, i, :, channel_index, -later_samples:] = channel_effect[
                    :, i, :, :later_samples
                ]
        sample_residuals = sample_window.residuals(
            predicted_effects.reshape(-1, *predicted_effects.shape[3:])
        )
        chi2: RealArray = np.einsum("kn,kn->k", sample_residuals, sample_residuals)
        return chi2.reshape(position_count, sample_indices.size, stiffness_count)


_INSTANTS_AT_ONCE = 16
"""Number of instants of touch whose candidates are integrated at once."""
GRID_STIFFNESSES_N_PER_M = np.array([60.0, 300.0, 1000.0, 3000.0, 10000.0, 100000.0])
"""Stiffnesses of the grid's candidates in N/m."""


def chi2_of(
    predict_effect: EffectPredictor, sample_window: WhitenedWindow, candidates: RealArray
) -> RealArray:
    """Return the sum of squared residuals of each candidate obstacle, shape (k,)."""
    candidate_residuals = sample_window.residuals(predict_effect(candidates, sample_window))
    chi2: RealArray = np.einsum("kn,kn->k", candidate_residuals, candidate_residuals)
    return chi2
