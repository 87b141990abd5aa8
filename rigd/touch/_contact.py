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


def march(
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
        fled = np.multiply.outer(np.asarray(rate_m_per_s) * step_s, np.arange(steps))
        approach = approach - fled.astype(approach.dtype)
    if np.any(mobility_m_per_n_s):
        given = np.asarray(mobility_m_per_n_s, kernel.dtype) * step_s
        kernel = kernel + given[..., None]
    stiffness = stiffness_n_per_m.reshape(kernels, -1)
    # Force of a step without earlier ones: (n, k, g).
    gives = stiffness / (1 + stiffness * kernel[:, :1])
    wanted = approach.reshape(kernels, -1, steps).transpose(2, 0, 1) * gives
    group = stiffness.shape[1]
    force = np.zeros((kernels, steps, group), wanted.dtype)
    # The latest lag comes first, so that a product of two rows is the convolution.
    reverse = np.ascontiguousarray(kernel[:, ::-1])
    row, column = reverse.strides
    # Within a block each force is subtracted from the later steps. All views are made once.
    width = _BLOCK if kernels * group < _MANY else _SHORT_BLOCK
    inside, bent = np.zeros((2, width, kernels * group), wanted.dtype)
    within = np.zeros((width - 1, kernels * group), wanted.dtype)
    lags = kernel[:, 1:width].T[:, :, None] * gives
    within[: len(lags)] = lags.reshape(len(lags), -1)
    views = [
        (inside[i], within[: width - 1 - i], bent[: width - 1 - i], inside[i + 1 :])
        for i in range(width)
    ]
    nothing = np.zeros(kernels * group, wanted.dtype)
    touched = steps
    for begin in range(1, steps, width):
        end = min(begin + width, steps)
        part = wanted[begin:end]
        if touched < begin:
            # Element (k, i, j): effect of the force touched + j at step begin + i.
            effect = np.ndarray(
                (kernels, end - begin, begin - touched),
                reverse.dtype,
                buffer=reverse,
                offset=(steps - 1 - begin + touched) * column,
                strides=(row, -column, column),
            )
            earlier = force[:, touched:begin]
            if group == 1:
                before = np.vecdot(effect, earlier.transpose(0, 2, 1))[:, :, None]
            else:
                before = np.ascontiguousarray(effect) @ earlier
            part = part - before.transpose(1, 0, 2) * gives
        if not part.max() > 0:
            continue  # no candidate is in contact
        touched = min(touched, begin)
        inside[: end - begin] = part.reshape(end - begin, -1)
        for now, lag, product, later in views:
            np.maximum(now, nothing, out=now)
            np.multiply(lag, now, out=product)
            np.subtract(later, product, out=later)
        block = inside[: end - begin].reshape(-1, kernels, group)
        force[:, begin:end] = block.transpose(1, 0, 2)
    return np.ascontiguousarray(force.transpose(0, 2, 1)).reshape(shape)


def march_two(
    own: tuple[Real, Real],
    cross: Real,
    approach: tuple[Real, Real],
    stiffness_n_per_m: tuple[Real, Real],
) -> tuple[Real, Real]:
    """Return the forces with which the beam presses on two obstacles at rest, at each step.

    Parameters
    ----------
    own
        Displacement at each obstacle's position per hat of force there, shape (k, n).
    cross
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
    count, steps = cross.shape
    # Force of a step without all others, (n, 2, k).
    gives = np.stack(
        [k / (1 + k * kernel[:, 0]) for k, kernel in zip(stiffness_n_per_m, own, strict=True)]
    )
    wanted = np.stack([each.T for each in approach], axis=1) * gives
    # Reduction of one force by another, by the lag; axes: lag, reduced, reducing.
    kernel = np.empty((steps, 2, 2, count))
    kernel[:, 0, 0], kernel[:, 1, 1] = own[0].T, own[1].T
    kernel[:, 0, 1] = kernel[:, 1, 0] = cross.T
    kernel *= gives[:, None]
    by_second, by_first = kernel[0, 0, 1], kernel[0, 1, 0]
    both = 1 / (1 - by_second * by_first)
    # The latest lag comes first, so that a product of two rows is the convolution.
    reverse = np.ascontiguousarray(kernel[::-1].transpose(3, 1, 2, 0))
    *outer, column = reverse.strides
    force = np.zeros((count, 2, steps))
    inside = np.empty((_BLOCK, 2, count))
    product = np.empty((_BLOCK, 2, 2, count))
    for begin in range(1, steps, _BLOCK):
        end = min(begin + _BLOCK, steps)
        part = inside[: end - begin]
        part[:] = wanted[begin:end]
        if begin > 1:
            # Element (k, a, b, i, j): effect of the force of step 1 + j at b on a, step begin + i.
            effect = np.ndarray(
                (count, 2, 2, end - begin, begin - 1),
                buffer=reverse,
                offset=(steps - begin) * column,
                strides=(*outer, -column, column),
            )
            before = np.vecdot(effect, force[:, None, :, None, 1:begin]).sum(axis=2)
            part -= before.transpose(2, 1, 0)
        for i, now in enumerate(part):
            first, second = now
            # The second force if both press; then the first one, which is right in any case.
            pressing = np.maximum((second - by_first * first) * both, 0.0)
            np.maximum(first - by_second * pressing, 0.0, out=first)
            np.maximum(second - by_first * first, 0.0, out=second)
            later = part[i + 1 :]
            lessened = np.multiply(
                kernel[1 : len(later) + 1], now[None, None], out=product[: len(later)]
            )
            later -= lessened[:, :, 0]
            later -= lessened[:, :, 1]
        force[..., begin:end] = part.transpose(2, 1, 0)
    return force[:, 0], force[:, 1]


def shifted(table: Real, begin: Real, count: int) -> Real:
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
    whole = np.floor(begin).astype(np.intp)
    u = (begin - whole)[:, None]
    rows, columns = table.shape
    whole = np.clip(whole, -count - 2, columns + 1)  # farther off the result is the same
    before = max(0, 1 - int(whole.min()))
    behind = max(0, int(whole.max()) + count + 2 - columns)
    held = np.empty((rows, before + columns + behind))
    held[:, :before], held[:, before : before + columns] = 0.0, table
    held[:, before + columns :] = table[:, -1:]
    # Row k of the result: held[k, begin : begin + count + 3], copied as one block.
    step, row = held.strides[1], held.strides[0]
    blocks = np.ndarray(
        (rows, held.shape[1] - count - 2, count + 3), buffer=held, strides=(row, step, step)
    )
    near = blocks[np.arange(rows), whole - 1 + before]
    value = near[:, :count] * (-u * (u - 1) * (u - 2) / 6)
    value += near[:, 1 : count + 1] * ((u + 1) * (u - 1) * (u - 2) / 2)
    value += near[:, 2 : count + 2] * (-(u + 1) * u * (u - 2) / 2)
    value += near[:, 3:] * ((u + 1) * u * (u - 1) / 6)
    return value


def responses(kernels: tuple[Real, ...], force: Real, every: int, samples: int) -> Real:
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
    reverse = np.zeros((candidates, steps + length))
    reverse[:, :steps] = force[:, ::-1]
    row, column = reverse.strides
    summed = np.empty((candidates, len(kernels), samples))
    for first in range(0, samples, _SAMPLES):
        end = min(first + _SAMPLES, samples)
        reach = min(length, (end - 1) * every + 1)
        view = np.ndarray(
            (candidates, 1, end - first, reach),
            buffer=reverse,
            offset=(steps - 1 - first * every) * column,
            strides=(row, 0, -every * column, column),
        )
        summed[:, :, first:end] = np.vecdot(tables[:, :, None, :reach], view)
    return summed
