"""Contact with a springy obstacle, integrated in time for many candidates at once.

The obstacle presses with the force ``N = max(0, k · penetration)``, and the beam yields by its
displacement kernel, its response to a triangular pulse ("hat") of force. Steps begin at the instant
of touch, so that the prediction depends smoothly on it. The force of a step is implicit, so that
the integration is as stable with a stiff obstacle as with a soft one.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
_Precision = TypeVar("_Precision", np.float32, np.float64)

_BLOCK, _SHORT_BLOCK = 16, 6
"""Numbers of steps in a block, for which the effects of all earlier forces are summed at once.
Within a block a step takes three operations on the remaining steps, so that shorter blocks are
faster with many candidates."""
_MANY = 1000
"""Number of candidates from which shorter blocks are used."""
_SAMPLES = 16
"""Number of samples that are convolved at once, all with the history of the last of them."""


def integrate_contact(
    kernel: NDArray[_Precision],
    approach: NDArray[_Precision],
    stiffness_n_per_m: NDArray[_Precision],
    step_s: float,
    rate_m_per_s: Real | float = 0.0,
    mobility_m_per_n_s: Real | float = 0.0,
) -> NDArray[_Precision]:
    """Return the force with which the beam presses on an obstacle, at each step since the touch.

    Parameters
    ----------
    kernel
        Displacement in the direction of the force per hat of force, shape (k, n).
    approach
        Distance by which the beam would be beyond the point of touch without the force, shape
        (k, n), or (k, g, n) for g candidates of each kernel. It is 0 at the first step.
    stiffness_n_per_m
        Stiffness of the obstacle, shape (k,) or (k, g).
    step_s
        Time between two steps.
    rate_m_per_s
        Speed of the obstacle away from the beam, shape (k,) or a number.
    mobility_m_per_n_s
        Speed at which the obstacle yields per force, shape (k,) or a number.

    Returns
    -------
    ndarray, shape of `approach`
        Magnitude of the force in N, 0 without contact.
    """
    shape = approach.shape
    kernels, steps = kernel.shape
    # An obstacle that moves away is a shorter approach; one that yields is a softer beam.
    if np.any(rate_m_per_s):
        obstacle_motion_m = np.multiply.outer(np.asarray(rate_m_per_s) * step_s, np.arange(steps))
        approach = approach - obstacle_motion_m.astype(approach.dtype)
    if np.any(mobility_m_per_n_s):
        yield_per_step = np.asarray(mobility_m_per_n_s, kernel.dtype) * step_s
        kernel = kernel + yield_per_step[..., None]
    stiffness = stiffness_n_per_m.reshape(kernels, -1)
    # Force of a step without earlier ones: (n, k, g).
    effective_stiffness = stiffness / (1 + stiffness * kernel[:, :1])
    free_force_n = approach.reshape(kernels, -1, steps).transpose(2, 0, 1) * effective_stiffness
    group_size = stiffness.shape[1]
    force = np.zeros((kernels, steps, group_size), free_force_n.dtype)
    # The latest lag comes first, so that a product of two rows is the convolution.
    reversed_kernel = np.ascontiguousarray(kernel[:, ::-1])
    row, column = reversed_kernel.strides
    # Within a block each force is subtracted from the later steps. All views are made once.
    width = _BLOCK if kernels * group_size < _MANY else _SHORT_BLOCK
    block_forces, block_reductions = np.zeros((2, width, kernels * group_size), free_force_n.dtype)
    block_lags = np.zeros((width - 1, kernels * group_size), free_force_n.dtype)
    lags = kernel[:, 1:width].T[:, :, None] * effective_stiffness
    block_lags[: len(lags)] = lags.reshape(len(lags), -1)
    views = [
        (
            block_forces[i],
            block_lags[: width - 1 - i],
            block_reductions[: width - 1 - i],
            block_forces[i + 1 :],
        )
        for i in range(width)
    ]
    zeros = np.zeros(kernels * group_size, free_force_n.dtype)
    first_contact_step = steps
    for begin in range(1, steps, width):
        end = min(begin + width, steps)
        block_force_n = free_force_n[begin:end]
        if first_contact_step < begin:
            # Element (k, i, j): effect of the force touched + j at step begin + i.
            effect = np.ndarray(
                (kernels, end - begin, begin - first_contact_step),
                reversed_kernel.dtype,
                buffer=reversed_kernel,
                offset=(steps - 1 - begin + first_contact_step) * column,
                strides=(row, -column, column),
            )
            earlier_force_n = force[:, first_contact_step:begin]
            if group_size == 1:
                earlier_effect = np.vecdot(effect, earlier_force_n.transpose(0, 2, 1))[:, :, None]
            else:
                earlier_effect = np.ascontiguousarray(effect) @ earlier_force_n
            block_force_n = block_force_n - earlier_effect.transpose(1, 0, 2) * effective_stiffness
        if not block_force_n.max() > 0:
            continue  # no candidate is in contact
        first_contact_step = min(first_contact_step, begin)
        block_forces[: end - begin] = block_force_n.reshape(end - begin, -1)
        for now, lag, product, later in views:
            np.maximum(now, zeros, out=now)
            np.multiply(lag, now, out=product)
            np.subtract(later, product, out=later)
        block = block_forces[: end - begin].reshape(-1, kernels, group_size)
        force[:, begin:end] = block.transpose(1, 0, 2)
    return np.ascontiguousarray(force.transpose(0, 2, 1)).reshape(shape)


def integrate_two_contacts(
    own_kernels: tuple[Real, Real],
    cross_kernel: Real,
    approach: tuple[Real, Real],
    stiffness_n_per_m: tuple[Real, Real],
) -> tuple[Real, Real]:
    """Return the forces with which the beam presses on two obstacles at rest, at each step.

    Parameters
    ----------
    own_kernels
        Displacement at each obstacle's position per hat of force there, shape (k, n).
    cross_kernel
        Displacement at one position per hat of force at the other, in the directions of the forces;
        shape (k, n).
    approach
        Distance by which the beam would be beyond each obstacle without any force, shape (k, n).
        It is not positive at the first step.
    stiffness_n_per_m
        Stiffness of each obstacle, shape (k,).

    Returns
    -------
    tuple of ndarray, shape (k, n)
        Magnitude of each force in N, 0 without contact.
    """
    count, steps = cross_kernel.shape
    # Force of a step without all others, (n, 2, k).
    effective_stiffness = np.stack(
        [
            k / (1 + k * kernel[:, 0])
            for k, kernel in zip(stiffness_n_per_m, own_kernels, strict=True)
        ]
    )
    free_force_n = np.stack([each.T for each in approach], axis=1) * effective_stiffness
    # Reduction of one force by another, by the lag; axes: lag, reduced, reducing.
    kernel = np.empty((steps, 2, 2, count))
    kernel[:, 0, 0], kernel[:, 1, 1] = own_kernels[0].T, own_kernels[1].T
    kernel[:, 0, 1] = kernel[:, 1, 0] = cross_kernel.T
    kernel *= effective_stiffness[:, None]
    by_second, by_first = kernel[0, 0, 1], kernel[0, 1, 0]
    coupling = 1 / (1 - by_second * by_first)
    # The latest lag comes first, so that a product of two rows is the convolution.
    reversed_kernel = np.ascontiguousarray(kernel[::-1].transpose(3, 1, 2, 0))
    *outer, column = reversed_kernel.strides
    force = np.zeros((count, 2, steps))
    block_forces = np.empty((_BLOCK, 2, count))
    product = np.empty((_BLOCK, 2, 2, count))
    for begin in range(1, steps, _BLOCK):
        end = min(begin + _BLOCK, steps)
        block_force_n = block_forces[: end - begin]
        block_force_n[:] = free_force_n[begin:end]
        if begin > 1:
            # Element (k, a, b, i, j): effect of the force of step 1 + j at b on a, step begin + i.
            effect = np.ndarray(
                (count, 2, 2, end - begin, begin - 1),
                buffer=reversed_kernel,
                offset=(steps - begin) * column,
                strides=(*outer, -column, column),
            )
            earlier_effect = np.vecdot(effect, force[:, None, :, None, 1:begin]).sum(axis=2)
            block_force_n -= earlier_effect.transpose(2, 1, 0)
        for i, now in enumerate(block_force_n):
            first, second = now
            # The second force if both press; then the first one, which is right in any case.
            pressing = np.maximum((second - by_first * first) * coupling, 0.0)
            np.maximum(first - by_second * pressing, 0.0, out=first)
            np.maximum(second - by_first * first, 0.0, out=second)
            later = block_force_n[i + 1 :]
            reductions = np.multiply(
                kernel[1 : len(later) + 1], now[None, None], out=product[: len(later)]
            )
            later -= reductions[:, :, 0]
            later -= reductions[:, :, 1]
        force[..., begin:end] = block_force_n.transpose(2, 1, 0)
    return force[:, 0], force[:, 1]


def shift_rows(table: Real, begin: Real, count: int) -> Real:
    """Shift each row of a table by a fraction of columns, by cubic interpolation.

    The result has the shape (k, count). Before the first column the values are 0, and after the
    last column they are constant.

    Parameters
    ----------
    table
        Rows of values, shape (k, n).
    begin
        Column of each row's first value in the result, shape (k,); it may be between two columns.
    count
        Number of values of the result, one column apart.
    """
    first_column = np.floor(begin).astype(np.intp)
    u = (begin - first_column)[:, None]
    rows, columns = table.shape
    first_column = np.clip(
        first_column, -count - 2, columns + 1
    )  # farther off the result is the same
    padding_before = max(0, 1 - int(first_column.min()))
    padding_after = max(0, int(first_column.max()) + count + 2 - columns)
    padded = np.empty((rows, padding_before + columns + padding_after))
    padded[:, :padding_before], padded[:, padding_before : padding_before + columns] = 0.0, table
    padded[:, padding_before + columns :] = table[:, -1:]
    # Row k of the result: held[k, begin : begin + count + 3], copied as one block.
    step, row = padded.strides[1], padded.strides[0]
    blocks = np.ndarray(
        (rows, padded.shape[1] - count - 2, count + 3), buffer=padded, strides=(row, step, step)
    )
    neighbours = blocks[np.arange(rows), first_column - 1 + padding_before]
    value = neighbours[:, :count] * (-u * (u - 1) * (u - 2) / 6)
    value += neighbours[:, 1 : count + 1] * ((u + 1) * (u - 1) * (u - 2) / 2)
    value += neighbours[:, 2 : count + 2] * (-(u + 1) * u * (u - 2) / 2)
    value += neighbours[:, 3:] * ((u + 1) * u * (u - 1) / 6)
    return value


def contact_responses(kernels: tuple[Real, ...], force: Real, every: int, samples: int) -> Real:
    """Return the responses to a force at some of its time steps, shape (k, kernels, samples).

    They are the convolution of the force with the kernels.

    Parameters
    ----------
    kernels
        Responses to a hat of force, each of shape (k, n) or (1, n), which are 0 from column n on.
    force
        Force at each step, shape (k, (samples - 1) · every + 1).
    every
        Number of steps from one sample to the next; the first sample is at the first step.
    samples
        Number of samples.
    """
    candidates, steps = force.shape
    tables = np.stack(kernels, axis=1)
    length = min(tables.shape[2], steps)
    if len(tables) == 1 and candidates > _SAMPLES:  # one matrix for all
        lag = every * np.arange(samples) - np.arange(steps)[:, None]
        table = np.where((lag >= 0) & (lag < length), tables[0][:, np.clip(lag, 0, length - 1)], 0)
        return (force @ table).transpose(1, 0, 2)
    # The latest force first, and zeros before the first one: each sample uses one block.
    reversed_force = np.zeros((candidates, steps + length))
    reversed_force[:, :steps] = force[:, ::-1]
    row, column = reversed_force.strides
    summed = np.empty((candidates, len(kernels), samples))
    for first in range(0, samples, _SAMPLES):
        end = min(first + _SAMPLES, samples)
        history_steps = min(length, (end - 1) * every + 1)
        view = np.ndarray(
            (candidates, 1, end - first, history_steps),
            buffer=reversed_force,
            offset=(steps - 1 - first * every) * column,
            strides=(row, 0, -every * column, column),
        )
        summed[:, :, first:end] = np.vecdot(tables[:, :, None, :history_steps], view)
    return summed
