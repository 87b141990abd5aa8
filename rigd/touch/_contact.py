"""Contact with a springy obstacle, marched in time for many candidates at once.

The obstacle presses with ``N = max(0, k · penetration)``; the beam gives way by its displacement
kernel. Steps begin at the instant of touch, so that what is predicted depends smoothly on it, and
the force of a step is found implicitly: a stiff obstacle is as stable as a soft one.
"""

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


def march(
    kernel: Real,
    approach: Real,
    stiffness_n_per_m: Real,
    step_s: float,
    rate_m_per_s: Real | float = 0.0,
    mobility_m_per_n_s: Real | float = 0.0,
) -> Real:
    """Force with which the beam presses, at each step since the touch.

    Parameters
    ----------
    kernel
        Displacement in the direction of the force per hat of force, shape (k, n).
    approach
        How far the beam would be beyond the place of touch without the force, shape (k, n); its
        first column is 0.
    stiffness_n_per_m
        Stiffness of the obstacle, shape (k,).
    step_s
        Time between two columns.
    rate_m_per_s
        Speed of the obstacle away from the beam, shape (k,) or a number.
    mobility_m_per_n_s
        Speed at which the obstacle gives way per force, likewise.

    Returns
    -------
    ndarray, shape (k, n)
        Magnitude in N, 0 where they are apart.
    """
    candidates, steps = approach.shape
    # Latest force first, so that a dot product of two rows is the convolution.
    reverse = np.zeros((candidates, steps))
    fled = np.zeros(candidates)
    moving = np.any(rate_m_per_s) or np.any(mobility_m_per_n_s)
    gives = stiffness_n_per_m / (
        1 + stiffness_n_per_m * (kernel[:, 0] + np.asarray(mobility_m_per_n_s) * step_s)
    )
    for i in range(1, steps):
        bent = np.einsum("kj,kj->k", kernel[:, 1:i], reverse[:, steps - i : steps - 1])
        inside = approach[:, i] - bent
        if moving:
            fled += rate_m_per_s * step_s
            inside -= fled
        np.maximum(inside, 0.0, out=inside)
        inside *= gives
        if moving:
            fled += mobility_m_per_n_s * step_s * inside
        reverse[:, steps - 1 - i] = inside
    return reverse[:, ::-1]


def responses(kernels: tuple[Real, ...], force: Real) -> tuple[Real, ...]:
    """Convolve a force with kernels, each of the force's shape (k, n).

    Parameters
    ----------
    kernels
        Responses to a hat of force, each of shape (k, n) or (1, n).
    force
        Force at each step, shape (k, n).
    """
    from scipy.fft import irfft, next_fast_len, rfft

    n = force.shape[1]
    length = next_fast_len(2 * n, real=True)
    spectrum = rfft(force, length, axis=1)
    return tuple(
        irfft(rfft(kernel[:, :n], length, axis=1) * spectrum, length, axis=1)[:, :n]
        for kernel in kernels
    )
