"""Springy obstacle at rest: point, instant and stiffness from the march of the contact.

A grid of starts over all three is marched for the first samples, the best of each place for some
more, and the best of those descend by least squares (Levenberg and Marquardt, derivatives by
differences, all candidates in one batch). A bouncing contact has many local minima: the starts
are there for that.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from rigd.touch._contact import march, responses
from rigd.touch._free_motion import FreeMotion
from rigd.touch._kernels import ContactKernels, lagrange, mixed

Real = NDArray[np.float64]

PARAMETERS = ("x_m", "time_s", "ln_stiffness", "rate_m_per_s", "mobility_m_per_n_s")
"""Columns of candidates: the last two are left out for an obstacle at rest."""

STIFFEST = log(1e6)
SOFTEST = log(10.0)

Prediction = Callable[[Real, "Window"], Real]
"""Effect of candidates (k, p) on the channels in a window, shape (k, c, samples)."""


@dataclass(frozen=True, slots=True)
class Space:
    """Ranges of the parameters of a kind of candidate."""

    low: Real
    """Least value of each, shape (p,)."""
    high: Real
    """Greatest value."""
    difference: Real
    """By how much each is changed for a derivative."""
    scale: Real
    """A change that matters: the most an iteration changes is eight times it."""


@dataclass(frozen=True, slots=True)
class Window:
    """The innovations that candidates are compared with, whitened."""

    motion: FreeMotion
    """Free motion of the record."""
    first: int
    """First sample."""
    end: int
    """Sample after the last."""
    whitening: Real
    """Inverse Cholesky factor of the covariance, noise and what is unknown of the free motion."""
    data: Real
    """Whitened innovations, shape (n,)."""

    @classmethod
    def of(
        cls, motion: FreeMotion, first: int, end: int, deviations: Real | None = None
    ) -> "Window":
        """Whiten the samples from `first` on.

        Parameters
        ----------
        motion
            Free motion of the record.
        first, end
            Its samples.
        deviations
            Effects on the channels of all that is uncertain, one standard deviation each, shape
            (c, n, r) from sample `first` on; None: what is unknown of the free motion, as far as no
            touch passes it on.
        """
        if deviations is None:
            deviations = motion.design[:, first:end] @ motion.spread
        noise = motion.noise[:, None, None]
        columns = (deviations[:, : end - first] / noise).reshape(-1, deviations.shape[2])
        whole = np.eye(columns.shape[0]) + columns @ columns.T
        whitening = np.linalg.inv(np.linalg.cholesky(whole))
        raw = (motion.innovations[:, first:end] / motion.noise[:, None]).ravel()
        return cls(motion, first, end, whitening, whitening @ raw)

    def residuals(self, predicted: Real) -> Real:
        """Whitened residuals.

        Parameters
        ----------
        predicted
            Effect of a touch on the channels, shape (k, c, samples).
        """
        scaled = (predicted / self.motion.noise[:, None]).reshape(predicted.shape[0], -1)
        difference: Real = self.data - scaled @ self.whitening.T
        return difference


class Touching:
    """Marches candidates of one record.

    Parameters
    ----------
    kernels
        Contact kernels on the steps wanted, at places.
    x_m
        Places of the free motion's displacement.
    motion
        Free motion of the record.
    """

    __slots__ = ("_kernels", "_motion", "_x_m")

    def __init__(self, kernels: ContactKernels, x_m: Real, motion: FreeMotion) -> None:
        self._kernels, self._x_m, self._motion = kernels, x_m, motion

    def predicted(
        self,
        parameters: Real,
        window: Window,
        side: float | None = None,
        kernels: ContactKernels | None = None,
        more_m: Real | None = None,
    ) -> tuple[Real, Real]:
        """Effect on the channels in the window, and the force.

        Parameters
        ----------
        parameters
            Rows of `PARAMETERS`, at least the first three, shape (k, p).
        window
            Which samples.
        side
            Direction in which the beam presses, 1 or -1; None: the one in which it goes.
        kernels
            Kernels at the only place there is, one row; interpolated if None.
        more_m
            What is added to the displacement of the free motion, shape (k, its columns).

        Returns
        -------
        channels : ndarray, shape (k, c, samples)
        force : ndarray, shape (k, n)
            On the beam, at the steps from the touch on, in N.
        """
        motion = self._motion
        x, instant = parameters[:, 0], parameters[:, 1]
        step_s = self._kernels.step_s
        last = motion.t[window.end - 1]
        steps = int(np.ceil((last - instant.min()) / step_s)) + 3
        steps = min(max(steps, 4), self._kernels.steps)
        local = self._kernels.at(x, steps) if kernels is None else kernels
        approach, sides = self._approach(x, instant, steps, side, more_m)
        extra = parameters[:, 3:].T
        pressing = march(
            np.broadcast_to(local.displacement[:, :steps], approach.shape),
            approach,
            np.exp(parameters[:, 2]),
            step_s,
            *(sides * extra[0],) if len(extra) else (),
            *extra[1:2],
        )
        force = -sides[:, None] * pressing
        tables = (local.torque, local.shear)[: motion.innovations.shape[0]]
        return self.effects(tables, force, instant, window), force

    def effects(self, tables: tuple[Real, ...], force: Real, instant: Real, window: Window) -> Real:
        """Effect of forces on the channels in the window, shape (k, c, samples).

        Parameters
        ----------
        tables
            Kernel of each channel, rows as the force has or one.
        force
            On the beam, on the kernels' steps, shape (k, n).
        instant
            Instant of the first step of each, shape (k,).
        window
            Which samples.
        """
        on_steps = responses(tables, force)
        t = self._motion.t[window.first : window.end]
        position = (t[None, :] - instant[:, None]) / self._kernels.step_s
        return np.stack([_sampled(each, position) for each in on_steps], axis=1)

    def _approach(
        self, x: Real, instant: Real, steps: int, given: float | None, more_m: Real | None
    ) -> tuple[Real, Real]:
        """How far the free beam is beyond the point of touch, and to which side it goes."""
        motion = self._motion
        first, weights = lagrange(x, self._x_m)
        moved = mixed(motion.displacement_m, first, weights)
        if more_m is not None:
            moved = moved + more_m
        begins = (instant - motion.first_s) / motion.step_s
        ratio = self._kernels.step_s / motion.step_s
        position = begins[:, None] + ratio * np.arange(steps)
        free = _sampled(moved, np.minimum(position, moved.shape[1] - 2.0))
        before = _sampled(moved, begins[:, None] - 1.0)
        side = np.where(free[:, 0] >= before[:, 0], 1.0, -1.0)
        if given is not None:
            side[:] = given
        return side[:, None] * (free - free[:, :1]), side


def _sampled(table: Real, position: Real) -> Real:
    """Values between the columns of a table (cubic, four points), 0 before the first."""
    columns = table.shape[1]
    whole = np.floor(position).astype(np.intp)
    u = position - whole
    padded = np.pad(table, ((0, 0), (1, 2)))
    index = np.clip(whole, -1, columns - 1)
    rows = np.arange(table.shape[0])[:, None]
    a, b, c, d = (padded[rows, np.clip(index + i, 0, columns + 2)] for i in range(4))
    value = (
        a * (-u * (u - 1) * (u - 2) / 6)
        + b * ((u + 1) * (u - 1) * (u - 2) / 2)
        + c * (-(u + 1) * u * (u - 2) / 2)
        + d * ((u + 1) * u * (u - 1) / 6)
    )
    return np.where(whole >= 0, value, 0.0)


@dataclass(frozen=True, slots=True)
class Descended:
    """Where candidates have come to."""

    parameters: Real
    """Rows of `PARAMETERS`, shape (k, p)."""
    chi2: Real
    """Sum of squared residuals of each, shape (k,)."""
    jacobian: Real
    """Derivatives of the residuals, shape (k, n, p)."""


def descend(
    predict: Prediction, window: Window, starts: Real, space: Space, rounds: int = 12
) -> Descended:
    """Minimise the residuals from each start.

    Parameters
    ----------
    predict
        Effect of candidates.
    window
        The samples.
    starts
        Candidates, shape (k, p).
    space
        Ranges of their parameters.
    rounds
        Most iterations.
    """
    at = np.clip(starts, space.low, space.high)
    damping = np.full(len(at), 1e-2)
    residual, jacobian = _linearised(predict, window, at, space)
    chi2 = np.einsum("kn,kn->k", residual, residual)
    active = np.ones(len(at), dtype=bool)
    loose = 1e-6 / space.scale**2
    for _ in range(rounds):
        rows = np.flatnonzero(active)
        j, r = jacobian[rows], residual[rows]
        normal = np.einsum("knp,knq->kpq", j, j)
        gradient = np.einsum("knp,kn->kp", j, r)
        diagonal = np.einsum("kpp->kp", normal) * damping[rows, None] + loose
        normal += diagonal[:, :, None] * np.eye(at.shape[1])
        move = -np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        move = np.clip(move, -8 * space.scale, 8 * space.scale)
        trial = np.clip(at[rows] + move, space.low, space.high)
        new_residual, new_jacobian = _linearised(predict, window, trial, space)
        new = np.einsum("kn,kn->k", new_residual, new_residual)
        gain = chi2[rows] - new
        better = gain > 0
        taken = rows[better]
        at[taken], chi2[taken] = trial[better], new[better]
        residual[taken], jacobian[taken] = new_residual[better], new_jacobian[better]
        damping[rows] = np.where(better, damping[rows] / 6, damping[rows] * 8)
        active[rows[(better & (gain < 0.02)) | (damping[rows] > 1e6)]] = False
        if not active.any():
            break
    return Descended(at, chi2, jacobian)


def _linearised(predict: Prediction, window: Window, at: Real, space: Space) -> tuple[Real, Real]:
    """Residuals (k, n) and their derivatives (k, n, p)."""
    width = at.shape[1]
    shifts = np.where(at + space.difference > space.high, -space.difference, space.difference)
    rows = np.concatenate([at, *(at + np.eye(width)[i] * shifts for i in range(width))])
    residuals = window.residuals(predict(rows, window)).reshape(width + 1, len(at), -1)
    derivatives = (residuals[1:] - residuals[0]) / shifts.T[:, :, None]
    return residuals[0], np.moveaxis(derivatives, 0, -1)


class Starts:
    """Grid of starts over place, instant and stiffness, marched together in coarse steps.

    Parameters
    ----------
    kernels
        Contact kernels whose step divides the sampling period.
    every
        Every so many of their places is a start.
    rate_hz
        Samples a second.
    samples
        How many samples are compared.
    """

    __slots__ = ("_channels", "_every", "_kernel", "_ratio", "_samples", "_step_s", "_x_m")

    def __init__(self, kernels: ContactKernels, every: int, rate_hz: float, samples: int) -> None:
        self._ratio = round(1 / (rate_hz * kernels.step_s))
        self._samples, self._every, self._step_s = samples, every, kernels.step_s
        steps = self._ratio * samples
        self._x_m = kernels.x_m[::every]
        self._kernel = np.repeat(kernels.displacement[::every, :steps], STIFFNESSES.size, axis=0)
        lag = self._ratio * np.arange(samples)[:, None] - np.arange(steps)
        self._channels = [
            np.where(lag >= 0, table[::every][:, np.maximum(lag, 0)], 0.0).transpose(0, 2, 1)
            for table in (kernels.torque, kernels.shear)
        ]  # (places, steps, samples)

    def marched(self, motion: FreeMotion, window: Window, latest: int) -> tuple[Real, Real]:
        """March all starts, and return them with their sums of squared residuals.

        Parameters
        ----------
        motion
            Free motion of the record.
        window
            The samples.
        latest
            Last sample at which the touch may be; the window's first is the earliest.
        """
        places, kinds = self._x_m.size, STIFFNESSES.size
        starts, found = [], []
        for sample in range(window.first + 1, latest + 1):
            count = window.end - sample
            steps = self._ratio * count
            instant = motion.t[sample]
            begin = round((instant - motion.first_s) / motion.step_s)
            moved = motion.displacement_m[:: self._every, begin - 1 : begin + steps]
            side = np.where(moved[:, 1] >= moved[:, 0], 1.0, -1.0)
            approach = side[:, None] * (moved[:, 1:] - moved[:, 1:2])
            pressing = march(
                self._kernel[:, :steps],
                np.repeat(approach, kinds, axis=0),
                np.tile(STIFFNESSES, places),
                self._step_s,
            ).reshape(places, kinds, steps)
            force = -side[:, None, None] * pressing
            predicted = np.zeros((places * kinds, motion.noise.size, window.end - window.first))
            for i in range(motion.noise.size):
                effect = force @ self._channels[i][:, :steps, :count]
                predicted[:, i, sample - window.first :] = effect.reshape(-1, count)
            residual = window.residuals(predicted)
            found.append(np.einsum("kn,kn->k", residual, residual))
            starts.append(
                np.stack(
                    [
                        np.repeat(self._x_m, kinds),
                        np.full(places * kinds, instant),
                        np.tile(np.log(STIFFNESSES), places),
                    ],
                    axis=1,
                )
            )
        return np.concatenate(starts), np.concatenate(found)


STIFFNESSES = np.array([60.0, 300.0, 1000.0, 3000.0, 10000.0, 100000.0])
"""Stiffnesses of the starts, in N/m."""


def chi2_of(predict: Prediction, window: Window, candidates: Real) -> Real:
    """Sum of squared residuals of candidates, shape (k,).

    Parameters
    ----------
    predict
        Their effect.
    window
        The samples.
    candidates
        Shape (k, p).
    """
    residual = window.residuals(predict(candidates, window))
    chi2: Real = np.einsum("kn,kn->k", residual, residual)
    return chi2
