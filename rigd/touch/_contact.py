"""Contact with a springy obstacle, integrated in time for many candidates at once.

The obstacle presses with the force ``N = max(0, k · penetration)``. The displacement of the beam is
the convolution of this force with a kernel: the response to a triangular pulse ("hat") of force.
Time steps begin at the instant of touch, so that the prediction depends smoothly on it. The force
of each step is computed implicitly, so that the integration is stable with stiff obstacles too.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

RealArray = NDArray[np.float64]
_Precision = TypeVar("_Precision", np.float32, np.float64)

_BLOCK_STEPS, _SHORT_BLOCK_STEPS = 16, 6
"""Numbers of time steps in a block: usual, and with many candidates. The effects of forces before
the block are summed for all its steps at once; within it, each step updates all later ones, so that
shorter blocks are faster with many candidates."""
_MIN_SHORT_BLOCK_CANDIDATES = 1000
"""Number of candidates above which shorter blocks are used."""
_SAMPLES_PER_BLOCK = 16
"""Number of samples whose convolution is computed at once, with as many earlier forces as the last
sample needs."""


def integrate_contact(
    kernel: NDArray[_Precision],
    approach_m: NDArray[_Precision],
    stiffness_n_per_m: NDArray[_Precision],
    step_s: float,
    obstacle_speed_m_per_s: RealArray | float = 0.0,
    mobility_m_per_n_s: RealArray | float = 0.0,
) -> NDArray[_Precision]:
    """Return the force with which the beam presses on an obstacle, at each step since the touch.

    The force is a magnitude in N, 0 without contact, with the shape of `approach_m`. `kernel` is
    the displacement in the direction of the force per hat of force, in m/N, shape (k, n).
    `approach_m` is the distance in m by which the beam would be beyond the point of touch if there
    were no force, 0 at the first step, shape (k, n), or (k, g, n) for g candidates of each kernel;
    the stiffness has the shape (k,) or (k, g). The obstacle moves away from the beam at
    `obstacle_speed_m_per_s` and yields at `mobility_m_per_n_s` times the force.
    """
    result_shape = approach_m.shape
    kernel_count, step_count = kernel.shape
    # An obstacle that moves away shortens the approach; one that yields acts as a softer beam.
    if np.any(obstacle_speed_m_per_s):
        obstacle_motion_m = np.multiply.outer(
            np.asarray(obstacle_speed_m_per_s) * step_s, np.arange(step_count)
        )
        approach_m = approach_m - obstacle_motion_m.astype(approach_m.dtype)
    if np.any(mobility_m_per_n_s):
        yield_per_step = np.asarray(mobility_m_per_n_s, kernel.dtype) * step_s
        kernel = kernel + yield_per_step[..., None]
    kernel_stiffness = stiffness_n_per_m.reshape(kernel_count, -1)
    # Force of a step without earlier ones: (n, k, g).
    effective_stiffness = kernel_stiffness / (1 + kernel_stiffness * kernel[:, :1])
    free_force_n = (
        approach_m.reshape(kernel_count, -1, step_count).transpose(2, 0, 1) * effective_stiffness
    )
    group_size = kernel_stiffness.shape[1]
    forces_n = np.zeros((kernel_count, step_count, group_size), free_force_n.dtype)
    # The latest lag comes first, so that a product of two rows is the convolution.
    reversed_kernel = np.ascontiguousarray(kernel[:, ::-1])
    row_stride, column_stride = reversed_kernel.strides
    # Within a block each force is subtracted from the later steps. All views are made once.
    block_steps = (
        _BLOCK_STEPS
        if kernel_count * group_size < _MIN_SHORT_BLOCK_CANDIDATES
        else _SHORT_BLOCK_STEPS
    )
    block_forces, block_reductions = np.zeros(
        (2, block_steps, kernel_count * group_size), free_force_n.dtype
    )
    block_lags = np.zeros((block_steps - 1, kernel_count * group_size), free_force_n.dtype)
    kernel_lags = kernel[:, 1:block_steps].T[:, :, None] * effective_stiffness
    block_lags[: len(kernel_lags)] = kernel_lags.reshape(len(kernel_lags), -1)
    block_views = [
        (
            block_forces[i],
            block_lags[: block_steps - 1 - i],
            block_reductions[: block_steps - 1 - i],
            block_forces[i + 1 :],
        )
        for i in range(block_steps)
    ]
    zero_forces = np.zeros(kernel_count * group_size, free_force_n.dtype)
    first_contact_step = step_count
    for block_begin in range(1, step_count, block_steps):
        block_end = min(block_begin + block_steps, step_count)
        block_force_n = free_force_n[block_begin:block_end]
        if first_contact_step < block_begin:
            # Element (k, i, j): effect of force first_contact_step + j at step block_begin + i.
            earlier_block_effect = np.ndarray(
                (kernel_count, block_end - block_begin, block_begin - first_contact_step),
                reversed_kernel.dtype,
                buffer=reversed_kernel,
                offset=(step_count - 1 - block_begin + first_contact_step) * column_stride,
                strides=(row_stride, -column_stride, column_stride),
            )
            earlier_force_n = forces_n[:, first_contact_step:block_begin]
            if group_size == 1:
                earlier_effect = np.vecdot(
                    earlier_block_effect, earlier_force_n.transpose(0, 2, 1)
                )[:, :, None]
            else:
                earlier_effect = np.ascontiguousarray(earlier_block_effect) @ earlier_force_n
            block_force_n = block_force_n - earlier_effect.transpose(1, 0, 2) * effective_stiffness
        if not block_force_n.max() > 0:
            continue  # no candidate is in contact
        first_contact_step = min(first_contact_step, block_begin)
        block_forces[: block_end - block_begin] = block_force_n.reshape(block_end - block_begin, -1)
        for step_forces_n, lag, lag_product, later_reductions in block_views:
            np.maximum(step_forces_n, zero_forces, out=step_forces_n)
            np.multiply(lag, step_forces_n, out=lag_product)
            np.subtract(later_reductions, lag_product, out=later_reductions)
        block_slice = block_forces[: block_end - block_begin].reshape(-1, kernel_count, group_size)
        forces_n[:, block_begin:block_end] = block_slice.transpose(1, 0, 2)
    return np.ascontiguousarray(forces_n.transpose(0, 2, 1)).reshape(result_shape)


def integrate_two_contacts(
    own_kernels: tuple[RealArray, RealArray],
    cross_kernel: RealArray,
    approaches_m: tuple[RealArray, RealArray],
    stiffness_n_per_m: tuple[RealArray, RealArray],
) -> tuple[RealArray, RealArray]:
    """Return the forces with which the beam presses on two obstacles at rest, at each step.

    The forces are magnitudes in N, 0 without contact, shape (k, n). Kernels are displacements per
    hat of force in m/N, shape (k, n): at each obstacle by its own force, and at one by the force of
    the other, positive in the directions of the two forces. `approaches_m` is the distance in m by
    which the beam would be beyond each obstacle if there were no force; it is not positive at the
    first step.
    """
    pair_count, step_count = cross_kernel.shape
    # Force of a step without all others, (n, 2, k).
    effective_stiffness = np.stack(
        [
            k / (1 + k * kernel[:, 0])
            for k, kernel in zip(stiffness_n_per_m, own_kernels, strict=True)
        ]
    )
    free_force_n = (
        np.stack([obstacle_approach.T for obstacle_approach in approaches_m], axis=1)
        * effective_stiffness
    )
    # Reduction of one force by another, by the lag; axes: lag, reduced, reducing.
    kernel = np.empty((step_count, 2, 2, pair_count))
    kernel[:, 0, 0], kernel[:, 1, 1] = own_kernels[0].T, own_kernels[1].T
    kernel[:, 0, 1] = kernel[:, 1, 0] = cross_kernel.T
    kernel *= effective_stiffness[:, None]
    effect_of_second, effect_of_first = kernel[0, 0, 1], kernel[0, 1, 0]
    coupling_factor = 1 / (1 - effect_of_second * effect_of_first)
    # The latest lag comes first, so that a product of two rows is the convolution.
    reversed_kernel = np.ascontiguousarray(kernel[::-1].transpose(3, 1, 2, 0))
    *outer_strides, column_stride = reversed_kernel.strides
    forces_n = np.zeros((pair_count, 2, step_count))
    block_forces = np.empty((_BLOCK_STEPS, 2, pair_count))
    reduction_buffer = np.empty((_BLOCK_STEPS, 2, 2, pair_count))
    for block_begin in range(1, step_count, _BLOCK_STEPS):
        block_end = min(block_begin + _BLOCK_STEPS, step_count)
        block_force_n = block_forces[: block_end - block_begin]
        block_force_n[:] = free_force_n[block_begin:block_end]
        if block_begin > 1:
            # Element (k, a, b, i, j): effect of the force of step 1 + j at b on a, step begin + i.
            later_effect = np.ndarray(
                (pair_count, 2, 2, block_end - block_begin, block_begin - 1),
                buffer=reversed_kernel,
                offset=(step_count - block_begin) * column_stride,
                strides=(*outer_strides, -column_stride, column_stride),
            )
            earlier_effect = np.vecdot(later_effect, forces_n[:, None, :, None, 1:block_begin]).sum(
                axis=2
            )
            block_force_n -= earlier_effect.transpose(2, 1, 0)
        for i, step_forces_n in enumerate(block_force_n):
            first_force_n, second_force_n = step_forces_n
            # The second force if both press; then the first one, which is right in any case.
            pressing_forces = np.maximum(
                (second_force_n - effect_of_first * first_force_n) * coupling_factor, 0.0
            )
            np.maximum(first_force_n - effect_of_second * pressing_forces, 0.0, out=first_force_n)
            np.maximum(second_force_n - effect_of_first * first_force_n, 0.0, out=second_force_n)
            later_reductions = block_force_n[i + 1 :]
            reductions = np.multiply(
                kernel[1 : len(later_reductions) + 1],
                step_forces_n[None, None],
                out=reduction_buffer[: len(later_reductions)],
            )
            later_reductions -= reductions[:, :, 0]
            later_reductions -= reductions[:, :, 1]
        forces_n[..., block_begin:block_end] = block_force_n.transpose(2, 1, 0)
    return forces_n[:, 0], forces_n[:, 1]


def shift_rows(value_table: RealArray, begin_columns: RealArray, column_count: int) -> RealArray:
    """Return each row of a table from a fractional column on, by cubic interpolation.

    The result has the shape (k, column_count). Before the first column of the table, values are 0;
    after the last column, they equal those of the last column.
    """
    first_column = np.floor(begin_columns).astype(np.intp)
    u = (begin_columns - first_column)[:, None]
    rows, columns = value_table.shape
    first_column = np.clip(
        first_column, -column_count - 2, columns + 1
    )  # farther off the result is the same
    padding_before = max(0, 1 - int(first_column.min()))
    padding_after = max(0, int(first_column.max()) + column_count + 2 - columns)
    padded_table = np.empty((rows, padding_before + columns + padding_after))
    padded_table[:, :padding_before], padded_table[:, padding_before : padding_before + columns] = (
        0.0,
        value_table,
    )
    padded_table[:, padding_before + columns :] = value_table[:, -1:]
    # Row k: padded_table[k, begin : begin + column_count + 3], copied as one block.
    column_stride, row_stride = padded_table.strides[1], padded_table.strides[0]
    column_blocks = np.ndarray(
        (rows, padded_table.shape[1] - column_count - 2, column_count + 3),
        buffer=padded_table,
        strides=(row_stride, column_stride, column_stride),
    )
    neighbours = column_blocks[np.arange(rows), first_column - 1 + padding_before]
    shifted_rows = neighbours[:, :column_count] * (-u * (u - 1) * (u - 2) / 6)
    shifted_rows += neighbours[:, 1 : column_count + 1] * ((u + 1) * (u - 1) * (u - 2) / 2)
    shifted_rows += neighbours[:, 2 : column_count + 2] * (-(u + 1) * u * (u - 2) / 2)
    shifted_rows += neighbours[:, 3:] * ((u + 1) * u * (u - 1) / 6)
    return shifted_rows


def contact_responses(
    kernels: tuple[RealArray, ...], forces_n: RealArray, steps_per_sample: int, sample_count: int
) -> RealArray:
    """Return the convolution of forces with kernels, shape (k, kernels, sample_count).

    Kernels are responses to a hat of force, of shape (k, n) or (1, n), and 0 from column n on.
    Forces have one column per time step, the responses one per sample; the first sample is at the
    first step.
    """
    candidate_count, step_count = forces_n.shape
    kernel_tables = np.stack(kernels, axis=1)
    kernel_steps = min(kernel_tables.shape[2], step_count)
    if len(kernel_tables) == 1 and candidate_count > _SAMPLES_PER_BLOCK:  # one matrix for all
        lag_steps = steps_per_sample * np.arange(sample_count) - np.arange(step_count)[:, None]
        lag_table = np.where(
            (lag_steps >= 0) & (lag_steps < kernel_steps),
            kernel_tables[0][:, np.clip(lag_steps, 0, kernel_steps - 1)],
            0,
        )
        return (forces_n @ lag_table).transpose(1, 0, 2)
    # The latest force first, and zeros before the first one: each sample uses one block.
    reversed_force = np.zeros((candidate_count, step_count + kernel_steps))
    reversed_force[:, :step_count] = forces_n[:, ::-1]
    row_stride, column_stride = reversed_force.strides
    summed_responses = np.empty((candidate_count, len(kernels), sample_count))
    for first_index in range(0, sample_count, _SAMPLES_PER_BLOCK):
        block_end = min(first_index + _SAMPLES_PER_BLOCK, sample_count)
        history_steps = min(kernel_steps, (block_end - 1) * steps_per_sample + 1)
        history_view = np.ndarray(
            (candidate_count, 1, block_end - first_index, history_steps),
            buffer=reversed_force,
            offset=(step_count - 1 - first_index * steps_per_sample) * column_stride,
            strides=(row_stride, 0, -steps_per_sample * column_stride, column_stride),
        )
        summed_responses[:, :, first_index:block_end] = np.vecdot(
            kernel_tables[:, :, None, :history_steps], history_view
        )
    return summed_responses
