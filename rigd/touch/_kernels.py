"""Responses of the beam over time to a force: displacement, torque and base shear.

A force that is linear between two time steps is a sum of triangular pulses, here called hats, with
one hat per step. A kernel is the response to a hat of 1 N, at the time steps from its peak on.
Kernels are inverse Laplace transforms of the exact model (`CausalTransform`). By reciprocity,
torque and base shear per force at x are minus the displacement at x per angle and per displacement
of the root.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    Beam,
    CausalTransform,
    Damping,
    PointForceGrid,
    clamped_free_eigenvalues,
    mode_shape,
)
from rigd.touch._sensor_filter import NO_FILTER, SensorFilter

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

TRANSFORM_DECAY_EXPONENT = 14.0
"""Exponent by which the transforms damp signals over their period; values that wrap round from the
end of the period are reduced to 1e-6."""

_TRANSFORM_OVERSAMPLING = 2
"""Number of steps of the inverse transform per step of the kernels. Two suffice, because the
spectrum of a hat is small at higher frequencies."""

_CROSS_MODE_COUNT = 20
"""Number of modes whose sum is the displacement at one position by a force at another."""

_FIRST_POSITION_M = 0.003
"""Distance in m of the first kernel position from the root; the last position is the tip."""


class ForcePulse:
    """Triangular pulse of 1 N, whose responses over time are computed from transfer functions.

    Its half width is `step_s`, which is also the time between the `step_count` values of a kernel.
    """

    __slots__ = ("_delayed_pulse", "_steps", "transform")

    def __init__(self, step_s: float, step_count: int) -> None:
        from scipy.fft import next_fast_len

        self._steps = step_count
        fine_step_s = step_s / _TRANSFORM_OVERSAMPLING
        fine_steps = next_fast_len(2 * _TRANSFORM_OVERSAMPLING * step_count, real=True)
        self.transform = CausalTransform(fine_steps, 1 / fine_step_s, TRANSFORM_DECAY_EXPONENT)
        s = self.transform.s
        pulse_transform = (2 * (np.cosh(s * step_s) - 1) / (step_s * s) ** 2) * step_s / fine_step_s
        # Two steps later than the force, so that the hat begins within the period.
        self._delayed_pulse = pulse_transform * np.exp(-s * step_s)

    def kernels(self, laplace_response: ComplexArray) -> RealArray:
        """Return the responses over time to the pulse, shape (k, steps).

        The transfer functions from force, shape (k, points), are given at the points `s` of the
        transform.
        """
        oversampled_kernels = self.transform.inverse(
            self._delayed_pulse * laplace_response, _TRANSFORM_OVERSAMPLING * (self._steps + 1)
        )
        return oversampled_kernels[:, _TRANSFORM_OVERSAMPLING::_TRANSFORM_OVERSAMPLING][
            :, : self._steps
        ]


@dataclass(frozen=True, slots=True)
class ContactKernels:
    """Responses over time to a triangular pulse of contact force, at positions along the beam."""

    x_m: RealArray
    """Positions of the force along the beam, shape (m,)."""
    step_s: float
    """Time step of the kernels, which is half the width of the pulse."""
    displacement_m_per_n: RealArray
    """Displacement at the position of the force in m/N, shape (m, n), from the peak of the pulse
    on."""
    torque_nm_per_n: RealArray
    """Coupling torque in N·m/N, shape (m, n)."""
    shear_per_n: RealArray
    """Base shear in N/N, shape (m, n)."""

    @property
    def step_count(self) -> int:
        """Number of time steps of the responses."""
        return int(self.displacement_m_per_n.shape[1])

    def at_positions(self, x_m: RealArray, step_count: int) -> "ContactKernels":
        """Return the responses at positions within the present range, by cubic interpolation."""
        first_rows, weights = cubic_weights(x_m, self.x_m)
        kernel_tables = (
            self.displacement_m_per_n[:, :step_count],
            self.torque_nm_per_n[:, :step_count],
            self.shear_per_n[:, :step_count],
        )
        return ContactKernels(
            x_m, self.step_s, *(interpolate_rows(t, first_rows, weights) for t in kernel_tables)
        )

    def with_wider_pulses(self, widening_factor: int, step_count: int) -> "ContactKernels":
        """Return the responses to wider triangular pulses of force, with longer time steps.

        `widening_factor` is the ratio of the longer time step to the present one.
        """
        pulse_weights = (
            1 - np.abs(np.arange(1 - widening_factor, widening_factor)) / widening_factor
        )
        wide_tables = []
        for kernel_table in (self.displacement_m_per_n, self.torque_nm_per_n, self.shear_per_n):
            padded_table = np.pad(
                kernel_table, ((0, 0), (widening_factor - 1, widening_factor - 1))
            )
            # A wide hat with its peak at 0 is a sum of narrow ones from 1 - factor to factor - 1.
            wide_response = sum(
                pulse_weight
                * padded_table[
                    :,
                    widening_factor - 1 - i : widening_factor
                    - 1
                    - i
                    + (step_count - 1) * widening_factor
                    + 1 : widening_factor,
                ]
                for i, pulse_weight in zip(
                    range(1 - widening_factor, widening_factor), pulse_weights, strict=True
                )
            )
            wide_tables.append(np.ascontiguousarray(wide_response))
        return ContactKernels(self.x_m, widening_factor * self.step_s, *wide_tables)


def contact_kernels(
    beam: Beam,
    damping: Damping,
    x_m: RealArray,
    step_s: float,
    step_count: int,
    sensor_filter: SensorFilter = NO_FILTER,
) -> ContactKernels:
    """Return the responses of the exact model to a triangular pulse of force at some positions."""
    force_pulse = ForcePulse(step_s, step_count)
    s = force_pulse.transform.s
    force_grid = PointForceGrid(s, beam, damping)
    filter_response = sensor_filter.response(s)
    complex_stiffness = beam.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    kernel_tables = np.empty((3, x_m.size, step_count))
    for i in range(0, x_m.size, _POSITIONS_PER_BLOCK):
        x = x_m[i : i + _POSITIONS_PER_BLOCK]
        responses = (
            force_grid.displacement_per_force(x, x).T,
            -filter_response * force_grid.displacement_per_angle(x).T,
            filter_response
            * complex_stiffness
            * force_grid.displacement_per_force(np.zeros_like(x), x, 3).T,
        )
        for kernel_table, laplace_response in zip(kernel_tables, responses, strict=True):
            kernel_table[i : i + _POSITIONS_PER_BLOCK] = force_pulse.kernels(laplace_response)
    return ContactKernels(x_m, step_s, *kernel_tables)


@dataclass(frozen=True, slots=True)
class CrossKernels:
    """Displacement over time at one position for a pulse of contact force at another position.

    It is computed as a sum over the modes.
    """

    x_m: RealArray
    """Positions at which the mode shapes are given, shape (m,)."""
    mode_shapes: RealArray
    """Mode shapes at the positions, shape (m, modes)."""
    kernels: RealArray
    """Response over time of each mode to the pulse, for mode shapes of 1 at both positions, in m/N;
    shape (modes, n)."""

    def between_positions(
        self, x_m: RealArray, second_positions_m: RealArray, step_count: int
    ) -> RealArray:
        """Return the displacement in m/N for each pair of positions, shape (k, step_count).

        It is symmetric in the positions of force and displacement.
        """
        first_shapes, second_shapes = (
            interpolate_rows(self.mode_shapes, *cubic_weights(x, self.x_m))
            for x in (x_m, second_positions_m)
        )
        cross_kernels_of_pairs: RealArray = (first_shapes * second_shapes) @ self.kernels[
            :, :step_count
        ]
        return cross_kernels_of_pairs


def cross_kernels(
    beam: Beam, damping: Damping, x_m: RealArray, step_s: float, step_count: int
) -> CrossKernels:
    """Return the kernels from a force at one position to the displacement at another.

    The arguments are those of `contact_kernels`.
    """
    force_pulse = ForcePulse(step_s, step_count)
    s = force_pulse.transform.s
    inertial_factor = beam.density_over_stiffness * s * s + damping.gamma * s**damping.lambda_
    stiffness_factor = 1 + damping.zeta * s**damping.alpha
    wave_numbers = clamped_free_eigenvalues(_CROSS_MODE_COUNT) / beam.length_m
    stiffness_scale = beam.bending_stiffness_n_m2 * beam.length_m
    mode_response_per_force = 1 / (
        stiffness_scale * (inertial_factor + stiffness_factor * wave_numbers[:, None] ** 4)
    )
    mode_shapes = np.stack(
        [mode_shape(i + 1, x_m / beam.length_m) for i in range(_CROSS_MODE_COUNT)], axis=1
    )
    return CrossKernels(x_m, mode_shapes, force_pulse.kernels(mode_response_per_force))


_POSITIONS_PER_BLOCK = 8
"""Number of positions that are evaluated at once, so that temporary arrays stay in the cache."""


def beam_positions(length_m: float, spacing_m: float) -> RealArray:
    """Return equally spaced positions in m up to the tip of the beam, at most `spacing_m` apart."""
    position_count = int(np.ceil((length_m - _FIRST_POSITION_M) / spacing_m)) + 1
    return np.linspace(_FIRST_POSITION_M, length_m, position_count)


def chebyshev_nodes(x_m: RealArray, node_count: int) -> tuple[RealArray, RealArray]:
    """Return Chebyshev nodes, and the matrix that interpolates from nodes to positions.

    The matrix has the shape (positions, nodes) and multiplies values at the nodes; positions
    increase.
    """
    from numpy.polynomial import chebyshev

    unit_nodes = chebyshev.chebpts1(node_count)
    unit_positions = 2 * (x_m - x_m[0]) / (x_m[-1] - x_m[0]) - 1
    at_nodes, at_positions = (
        chebyshev.chebvander(unit_points, node_count - 1)
        for unit_points in (unit_nodes, unit_positions)
    )
    interpolation_matrix: RealArray = at_positions @ np.linalg.inv(at_nodes)
    return x_m[0] + (x_m[-1] - x_m[0]) * (unit_nodes + 1) / 2, interpolation_matrix


def cubic_weights(points: RealArray, grid_points: RealArray) -> tuple[NDArray[np.intp], RealArray]:
    """Return the indices and weights of a cubic interpolation on an equally spaced grid.

    For each of k points these are the index of the first of four grid points, and their weights,
    shape (k, 4). The grid has at least four increasing points.
    """
    grid_positions = (np.asarray(points) - grid_points[0]) / (grid_points[1] - grid_points[0])
    first_indices = np.clip(np.floor(grid_positions).astype(np.intp) - 1, 0, grid_points.size - 4)
    u = grid_positions - first_indices
    weights = np.stack(
        [
            -(u - 1) * (u - 2) * (u - 3) / 6,
            u * (u - 2) * (u - 3) / 2,
            -u * (u - 1) * (u - 3) / 2,
            u * (u - 1) * (u - 2) / 6,
        ],
        axis=-1,
    )
    return first_indices, weights


def interpolate_rows(
    value_table: RealArray, first_rows: NDArray[np.intp], weights: RealArray
) -> RealArray:
    """Return interpolated rows (k, n) of a table (m, n), with the results of `cubic_weights`."""
    weighted_sum = weights[:, 0, None] * value_table[first_rows]
    for i in range(1, 4):
        weighted_sum += weights[:, i, None] * value_table[first_rows + i]
    return weighted_sum
