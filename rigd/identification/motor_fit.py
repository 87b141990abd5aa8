"""Weighted least squares on the moments of repeats: the unknowns, and how far to trust them.

The mean of repeats is fitted, because the loop feeds the noise of a reading back into the command
and so biases a fit of single ones; their scatter gives the weights, what is left of that bias, and
the standard deviations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from rigd.identification.motor_moments import (
    COULOMB,
    DELAY,
    SCALE,
    ZERO,
    Complex,
    Real,
    Rows,
    Stack,
    Timing,
    moments,
)

_MARGIN = 1.25
"""On all deviations: they are themselves known to some 15 %, and the filter of the readings and the
beam's share in a jump of torque are not in the model."""
_MAX_ITERATIONS = 30
_CONVERGED_S = 1e-9
_LONGEST_DELAY_S = 0.05
_SMOOTHED_BINS = 9


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The unknowns in the order of `moments`, and what the fit says of itself."""

    values: Real
    """Scale, inertia, viscous, Coulomb, delay from command to angle, zeros of the sessions."""
    stds: Real
    misfit: float
    friction_departure_nm: float


def fit(stacks: Sequence[Stack], timing: Timing, *, hold_scale: bool) -> Fit | None:
    """Fit by least squares, iterated for delay and weights; None if it does not settle.

    Parameters
    ----------
    stacks
        At least two repeats in each.
    timing
        Of the readings; the search for the delay begins at what it states.
    hold_scale
        Take the commanded torque for the true one.
    """
    unknowns = ZERO + 1 + max(stack.session for stack in stacks)
    free = np.arange(unknowns) != SCALE if hold_scale else np.full(unknowns, fill_value=True)
    delay_s, scale = timing.actuation_delay_s + timing.angle_delay_s, 1.0
    weights: list[Real] = []
    for _ in range(_MAX_ITERATIONS):
        rows = [moments(stack, timing, delay_s, scale, unknowns) for stack in stacks]
        weights = weights or [np.ones(row.y.shape[1]) for row in rows]
        solution = _solve(rows, weights, free)
        residuals = [row.y - row.x @ solution for row in rows]
        change_s = float(solution[DELAY])
        if abs(change_s) < _CONVERGED_S:
            try:
                return _judge(rows, weights, residuals, free, solution, delay_s)
            except np.linalg.LinAlgError:  # something is not in the record at all
                return None
        delay_s, scale = delay_s + change_s, float(solution[SCALE])
        if not (abs(delay_s) < _LONGEST_DELAY_S and scale > 0.0):
            return None
        weights = _weights(residuals, stacks)
    return None


def _solve(rows: Sequence[Rows], weights: Sequence[Real], free: NDArray[np.bool_]) -> Real:
    """Fit the means of the repeats; the scale, where it is not free, is 1."""
    solution = np.zeros(free.size)
    solution[SCALE] = 1.0
    matrix, side = [], []
    for row, weight in zip(rows, weights, strict=True):
        root = np.sqrt(weight)
        x, y = row.x.mean(axis=0), row.y.mean(axis=0)
        if not free[SCALE]:
            y = y - x[:, SCALE]
        matrix += [root[:, None] * x[:, free].real, root[:, None] * x[:, free].imag]
        side += [root * y.real, root * y.imag]
    columns = np.concatenate(matrix)
    size = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    solution[free] = np.linalg.lstsq(columns / size, np.concatenate(side), rcond=None)[0] / size
    return solution


def _weights(residuals: Sequence[Complex], stacks: Sequence[Stack]) -> list[Real]:
    """Return 1 over the variance of the mean of repeats, for each stack and frequency (m,).

    The variance is that of single repeats, pooled over the stacks of a session (their noise is the
    same) and over neighbouring frequencies.
    """
    pooled: dict[int, Real] = {}
    for session in {stack.session for stack in stacks}:
        chosen = [r for r, s in zip(residuals, stacks, strict=True) if s.session == session]
        deviations = sum(np.sum(np.abs(r - r.mean(axis=0)) ** 2, axis=0) for r in chosen)
        variance = np.asarray(deviations) / sum(len(r) - 1 for r in chosen)
        width = min(_SMOOTHED_BINS, variance.size)
        kernel = np.ones(width)
        ends = np.convolve(np.ones(variance.size), kernel, "same")
        pooled[session] = np.convolve(variance, kernel, "same") / ends
    return [
        len(r) / np.maximum(pooled[stack.session], np.finfo(float).tiny)
        for r, stack in zip(residuals, stacks, strict=True)
    ]


def _judge(
    rows: Sequence[Rows],
    weights: Sequence[Real],
    residuals: Sequence[Complex],
    free: NDArray[np.bool_],
    solution: Real,
    delay_s: float,
) -> Fit:
    """Take the bias by noise off the solution, and say how far to trust it."""
    chosen = np.flatnonzero(free)
    normal = np.zeros((chosen.size, chosen.size))
    bias = np.zeros(chosen.size)
    for row, weight, residual in zip(rows, weights, residuals, strict=True):
        repeats = len(row.y)
        x = row.x[..., chosen]
        mean = x.mean(axis=0)
        normal += np.einsum("mp,m,mq->pq", mean.conj(), weight, mean).real
        apart = x - mean
        share = weight / (repeats * (repeats - 1))
        bias += np.einsum("rmp,m,rm->p", apart.conj(), share, residual).real
    inverse = np.linalg.inv(normal)

    # Each stack's part in the variance, from the scatter of what its repeats pull at the solution.
    parts, degrees = [], []
    left, terms = 0.0, 0
    departure_nm = 0.0
    for row, weight, residual in zip(rows, weights, residuals, strict=True):
        repeats = len(row.y)
        mean = row.x[..., chosen].mean(axis=0)
        pulls = np.einsum("mp,m,rm->rp", mean.conj(), weight, residual).real @ inverse
        parts.append(pulls.var(axis=0, ddof=1) / repeats)
        degrees.append(repeats - 1)
        rest = residual.mean(axis=0)
        left += float(np.sum(weight * np.abs(rest) ** 2))
        terms += rest.size
        constant = abs(row.x[0, 0, COULOMB])
        departure_nm = max(departure_nm, abs(float(rest[0].real)) / float(constant))
    shares = np.array(parts)
    variance = shares.sum(axis=0)
    freedom = variance**2 / np.sum(shares**2 / np.array(degrees)[:, None], axis=0)
    misfit = left / max(1.0, terms - 0.5 * chosen.size)
    widening = _MARGIN * _coverage(freedom) * sqrt(max(1.0, misfit))

    values, stds = solution.copy(), np.zeros(free.size)
    values[chosen] -= inverse @ bias
    values[DELAY] += delay_s
    stds[chosen] = widening * np.sqrt(variance)
    return Fit(values, stds, misfit, departure_nm)


def _coverage(freedom: Real) -> Real:
    """Three quantiles' worth: Student's t over the normal's at 3, to second order in 1/freedom."""
    return 1.0 + (7.5 / freedom + 17.25 / freedom**2) / 3.0
