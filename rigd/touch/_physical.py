"""Springy obstacle at rest: point, instant and stiffness from the integration of the contact.

A grid of starts over all three is integrated for the first samples, the best of each position for
some more, and the best of those are refined by least squares (Levenberg and Marquardt, derivatives
by differences, all candidates in one batch). A bouncing contact has many local minima, hence the
many starts.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigd.touch._contact import march, responses, shifted
from rigd.touch._free_motion import FreeMotion
from rigd.touch._kernels import ContactKernels, lagrange, mixed

Real = NDArray[np.float64]

PARAMETERS = ("x_m", "time_s", "ln_stiffness", "rate_m_per_s", "mobility_m_per_n_s")
"""Columns of candidates: the last two are omitted for an obstacle at rest."""

STIFFEST = log(1e6)
SOFTEST = log(10.0)

Prediction = Callable[[Real, "WhitenedWindow"], Real]
"""Effect of candidates (k, p) on the channels in a window, shape (k, c, samples)."""


@dataclass(frozen=True, slots=True)
class Space:
    """Ranges of the parameters of a kind of candidate."""

    low: Real
    """Least value of each, shape (p,)."""
    high: Real
    """Greatest value."""
    difference: Real
    """Change of each for a derivative."""
    scale: Real
    """Significant change: an iteration changes a parameter by at most eight times it."""
    smallest: Real
    """Least standard deviation for drawing samples."""
    loose: Real
    """Greatest standard deviation for drawing samples."""


@dataclass(frozen=True, slots=True)
class WhitenedWindow:
    """Whitened innovations of some samples, to compare candidates with."""

    motion: FreeMotion
    """Free motion of the record."""
    first: int
    """First sample."""
    end: int
    """Sample after the last."""
    whitening: Real
    """Inverse Cholesky factor of the covariance of noise and uncertainties of the free motion."""
    data: Real
    """Whitened innovations, shape (n,)."""

    @classmethod
    def of(
        cls, motion: FreeMotion, first: int, end: int, deviations: Real | None = None
    ) -> "WhitenedWindow":
        """Whiten the samples from `first` on.

        Parameters
        ----------
        motion
            Free motion of the record.
        first, end
            Its samples.
        deviations
            Effects of all uncertainties on the channels, one standard deviation each, shape
            (c, n, r) from sample `first`; None: those of the free motion, without their
            transmission by a touch.
        """
        if deviations is None:
            deviations = motion.design[:, first:end] @ motion.spread
        noise = motion.noise[:, None, None]
        columns = (deviations[:, : end - first] / noise).reshape(-1, deviations.shape[2])
        whole = np.eye(columns.shape[0]) + columns @ columns.T
        whitening = np.linalg.inv(np.linalg.cholesky(whole))
        raw = (motion.innovations[:, first:end] / motion.noise[:, None]).ravel()
        return cls(motion, first, end, whitening, whitening @ raw)

    def residuals(self, predicted: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Return the whitened residuals, in the precision of the prediction.

        Parameters
        ----------
        predicted
            Effect of a touch on the channels, shape (k, c, samples).
        """
        noise, whitening, data = (
            each.astype(predicted.dtype, copy=False)
            for each in (self.motion.noise, self.whitening, self.data)
        )
        scaled = (predicted / noise[:, None]).reshape(predicted.shape[0], -1)
        return data - scaled @ whitening.T


class Touching:
    """Integrates the contact of candidates for one record.

    Parameters
    ----------
    kernels
        Contact kernels on the steps of the integration, at positions.
    x_m
        Positions of the free motion's displacement.
    motion
        Free motion of the record.
    """

    __slots__ = ("_kernels", "_motion", "_x_m")

    def __init__(self, kernels: ContactKernels, x_m: Real, motion: FreeMotion) -> None:
        self._kernels, self._x_m, self._motion = kernels, x_m, motion

    def predicted(
        self,
        parameters: Real,
        window: WhitenedWindow,
        side: float | None = None,
        kernels: ContactKernels | None = None,
    ) -> tuple[Real, Real]:
        """Return the effect on the channels in the window, and the force.

        Parameters
        ----------
        parameters
            Rows of `PARAMETERS`, at least the first three, shape (k, p).
        window
            The samples.
        side
            Direction in which the beam presses, 1 or -1; None: that of its motion.
        kernels
            Kernels at the only position, one row; None: they are interpolated.

        Returns
        -------
        channels : ndarray, shape (k, c, samples)
        force : ndarray, shape (k, n)
            On the beam, at the steps from the touch on, in N.
        """
        motion = self._motion
        x, instant = parameters[:, 0], parameters[:, 1]
        step_s = self._kernels.step_s
        steps = self.steps(instant, window)
        local = self._kernels.at(x, steps) if kernels is None else kernels
        approach, sides = self.approach(x, instant, steps, side)
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

    def passed_on(self, parameters: Real, window: WhitenedWindow, moved_m: Real) -> Real:
        """Return the effect of other free motions through the contact, (r, c, samples).

        Parameters
        ----------
        parameters
            Position, instant and logarithm of the stiffness of an obstacle at rest.
        window
            The samples.
        moved_m
            Change of the displacement at its position, on the free motion's steps from its first
            on, shape (r, columns).
        """
        x, instant = parameters[:1], parameters[1:2]
        steps = self.steps(instant, window)
        local = self._kernels.at(x, steps)
        approach, side = self.approach(x, instant, steps)
        instants = np.repeat(instant, len(moved_m))
        further = side * self._on_steps(moved_m, instants, steps)
        every = np.vstack([approach, approach + further - further[:, :1]])
        stiffness = np.full((1, len(every)), np.exp(parameters[2]))
        pressing = march(local.displacement, every[None], stiffness, self._kernels.step_s)[0]
        tables = (local.torque, local.shear)[: self._motion.innovations.shape[0]]
        return self.effects(tables, -side * (pressing[1:] - pressing[0]), instants, window)

    def steps(self, instant: Real, window: WhitenedWindow) -> int:
        """Return the number of steps from the earliest instant to the end of the window.

        Parameters
        ----------
        instant
            Instants of touch, shape (k,).
        window
            The samples.
        """
        step_s = self._kernels.step_s
        steps = int(np.ceil((self._motion.t[window.end - 1] - instant.min()) / step_s)) + 3
        return min(max(steps, 4), self._kernels.steps)

    def side(self, parameters: Real) -> float:
        """Return the direction of the beam's motion at a touch, 1 or -1.

        Parameters
        ----------
        parameters
            One row of `PARAMETERS`, at least the first two.
        """
        return float(self.approach(parameters[:1], parameters[1:2], 1)[1][0])

    def effects(
        self, tables: tuple[Real, ...], force: Real, instant: Real, window: WhitenedWindow
    ) -> Real:
        """Return the effect of forces on the channels in the window, shape (k, c, samples).

        Parameters
        ----------
        tables
            Kernel of each channel, rows as the force has or one.
        force
            On the beam, on the kernels' steps, shape (k, n).
        instant
            Instant of the first step of each, shape (k,).
        window
            The samples.
        """
        motion = self._motion
        step_s = self._kernels.step_s
        every = round((motion.t[1] - motion.t[0]) / step_s)
        samples = window.end - window.first
        begin = (motion.t[window.first] - instant) / step_s
        # Convolution and shift commute: shifting first puts the steps of all at the samples.
        aligned = shifted(force, begin, (samples - 1) * every + 1)
        return responses(tables, aligned, every, samples)

    def approach(
        self, x: Real, instant: Real, steps: int, given: float | None = None
    ) -> tuple[Real, Real]:
        """Return the motion of the free beam beyond its position at an instant, and its side.

        Parameters
        ----------
        x, instant
            Positions and instants, shape (k,).
        steps
            Number of steps from the instants on.
        given
            The side, 1 or -1; None: that of the motion at the instant.

        Returns
        -------
        beyond : ndarray, shape (k, steps)
            In m.
        side : ndarray, shape (k,)
        """
        motion = self._motion
        first, weights = lagrange(x, self._x_m)
        moved = mixed(motion.displacement_m, first, weights)
        free = self._on_steps(moved, instant, steps)
        if given is None:
            before = shifted(moved, (instant - motion.first_s) / motion.step_s - 1.0, 1)
            side = np.where(free[:, 0] >= before[:, 0], 1.0, -1.0)
        else:
            side = np.full(x.size, given)
        return side[:, None] * (free - free[:, :1]), side

    def _on_steps(self, moved: Real, instant: Real, steps: int) -> Real:
        """Return rows of displacements on the kernels' steps, each from its instant on."""
        motion = self._motion
        begin = (instant - motion.first_s) / motion.step_s
        between = max(1, round(motion.step_s / self._kernels.step_s))
        finer = np.empty((begin.size, between * -(-steps // between)))
        for i in range(between):
            part = finer[:, i::between]
            part[:] = shifted(moved, begin + i / between, part.shape[1])
        return finer[:, :steps]


@dataclass(frozen=True, slots=True)
class Descended:
    """Minima of the candidates."""

    parameters: Real
    """Rows of `PARAMETERS`, shape (k, p)."""
    chi2: Real
    """Sum of squared residuals of each, shape (k,)."""
    jacobian: Real
    """Derivatives of the residuals, shape (k, n, p)."""


_SETTLED = 0.1
"""The iteration ends with a step that reduces the cost by less, or is predicted to and fails."""


def descend(
    predict: Prediction,
    window: WhitenedWindow,
    starts: Real,
    space: Space,
    rounds: int = 12,
    free: NDArray[np.bool_] | None = None,
) -> Descended:
    """Minimise the residuals from each start.

    Parameters
    ----------
    predict
        Function that predicts the effect of candidates.
    window
        The samples.
    starts
        Candidates, shape (k, p).
    space
        Ranges of their parameters.
    rounds
        Most iterations.
        Which parameters of each start are free, shape (k, p); None: all.
        Which parameters of each start are to be changed, shape (k, p); None: all.
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
        if free is not None:
            j = j * free[rows, None]
        normal = np.einsum("knp,knq->kpq", j, j)
        gradient = np.einsum("knp,kn->kp", j, r)
        diagonal = np.einsum("kpp->kp", normal) * damping[rows, None] + loose
        normal += diagonal[:, :, None] * np.eye(at.shape[1])
        move = -np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        move = np.clip(move, -8 * space.scale, 8 * space.scale)
        trial = np.clip(at[rows] + move, space.low, space.high)
        linear = r + np.einsum("knp,kp->kn", j, trial - at[rows])
        predicted_gain = chi2[rows] - np.einsum("kn,kn->k", linear, linear)
        new_residual, new_jacobian = _linearised(predict, window, trial, space)
        new = np.einsum("kn,kn->k", new_residual, new_residual)
        gain = chi2[rows] - new
        better = gain > 0
        taken = rows[better]
        at[taken], chi2[taken] = trial[better], new[better]
        residual[taken], jacobian[taken] = new_residual[better], new_jacobian[better]
        damping[rows] = np.where(better, damping[rows] / 6, damping[rows] * 8)
        # Residuals have kinks where contacts begin and end: short steps may fail to reduce them.
        active[rows[np.where(better, gain, predicted_gain) < _SETTLED]] = False
        if not active.any():
            break
    return Descended(at, chi2, jacobian)


def _linearised(
    predict: Prediction, window: WhitenedWindow, at: Real, space: Space
) -> tuple[Real, Real]:
    """Return residuals (k, n) and their derivatives (k, n, p)."""
    width = at.shape[1]
    shifts = np.where(at + space.difference > space.high, -space.difference, space.difference)
    rows = np.concatenate([at, *(at + np.eye(width)[i] * shifts for i in range(width))])
    residuals = window.residuals(predict(rows, window)).reshape(width + 1, len(at), -1)
    derivatives = (residuals[1:] - residuals[0]) / shifts.T[:, :, None]
    return residuals[0], np.moveaxis(derivatives, 0, -1)


class Starts:
    """Grid of starts over position, instant and stiffness, integrated together in coarse steps.

    Parameters
    ----------
    kernels
        Contact kernels whose step divides the sampling period.
    every
        One in so many of their positions is a start.
    rate_hz
        Samples a second.
    samples
        Number of samples to compare.
    """

    __slots__ = ("_channels", "_every", "_kernel", "_ratio", "_samples", "_step_s", "_x_m")

    def __init__(self, kernels: ContactKernels, every: int, rate_hz: float, samples: int) -> None:
        self._ratio = round(1 / (rate_hz * kernels.step_s))
        self._samples, self._every, self._step_s = samples, every, kernels.step_s
        steps = self._ratio * samples
        self._x_m = kernels.x_m[::every]
        # Single precision suffices for choosing starts, and is twice as fast.
        self._kernel = kernels.displacement[::every, :steps].astype(np.float32)
        lag = self._ratio * np.arange(samples)[:, None] - np.arange(steps)
        self._channels = [
            np.where(lag >= 0, table[::every][:, np.maximum(lag, 0)], 0.0)
            .transpose(0, 2, 1)
            .astype(np.float32)
            for table in (kernels.torque, kernels.shear)
        ]  # (positions, steps, samples)

    def marched(self, motion: FreeMotion, window: WhitenedWindow, latest: int) -> tuple[Real, Real]:
        """Integrate all starts, and return them with their sums of squared residuals.

        Parameters
        ----------
        motion
            Free motion of the record.
        window
            The samples.
        latest
            Last sample at which the touch may begin; the window's first is the earliest.
        """
        samples = np.arange(window.first + 1, latest + 1)
        batches = np.array_split(samples, -(-samples.size // _INSTANTS))
        chi2 = [self._chi2(motion, window, batch) for batch in batches]
        starts = np.meshgrid(self._x_m, motion.t[samples], np.log(STIFFNESSES), indexing="ij")
        return np.stack(starts, axis=-1).reshape(-1, 3), np.concatenate(chi2, axis=1).ravel()

    def _chi2(self, motion: FreeMotion, window: WhitenedWindow, samples: NDArray[np.intp]) -> Real:
        """Return the sums of squared residuals, shape (positions, instants, kinds)."""
        positions, kinds = self._x_m.size, STIFFNESSES.size
        length = window.end - int(samples[0])
        steps = self._ratio * length
        begins = np.round((motion.t[samples] - motion.first_s) / motion.step_s).astype(np.intp)
        columns = begins[:, None] + np.arange(-1, steps)
        last = motion.displacement_m.shape[1] - 1
        moved = motion.displacement_m[:: self._every][:, np.minimum(columns, last)]
        # Axes: position, instant, step.
        side = np.where(moved[:, :, 1] >= moved[:, :, 0], 1, -1)[:, :, None].astype(np.float32)
        approach = (side * (moved[:, :, 1:] - moved[:, :, 1:2])).astype(np.float32)
        pressing = march(
            self._kernel[:, :steps],
            np.repeat(approach, kinds, axis=1),
            np.tile(STIFFNESSES.astype(np.float32), (positions, samples.size)),
            self._step_s,
        )
        force = -np.repeat(side, kinds, axis=1) * pressing
        predicted = np.zeros(
            (positions, samples.size, kinds, motion.noise.size, window.end - window.first),
            dtype=np.float32,
        )
        for channel in range(motion.noise.size):
            effect = force @ self._channels[channel][:, :steps, :length]
            effect = effect.reshape(positions, samples.size, kinds, length)
            for i, sample in enumerate(samples):
                count = window.end - sample
                predicted[:, i, :, channel, -count:] = effect[:, i, :, :count]
        residual = window.residuals(predicted.reshape(-1, *predicted.shape[3:]))
        chi2: Real = np.einsum("kn,kn->k", residual, residual)
        return chi2.reshape(positions, samples.size, kinds)


_INSTANTS = 16
"""Instants of the starts that are integrated at once."""
STIFFNESSES = np.array([60.0, 300.0, 1000.0, 3000.0, 10000.0, 100000.0])
"""Stiffnesses of the starts, in N/m."""


def chi2_of(predict: Prediction, window: WhitenedWindow, candidates: Real) -> Real:
    """Return the sum of squared residuals of candidates, shape (k,).

    Parameters
    ----------
    predict
        Function that predicts their effect.
    window
        The samples.
    candidates
        Shape (k, p).
    """
    residual = window.residuals(predict(candidates, window))
    chi2: Real = np.einsum("kn,kn->k", residual, residual)
    return chi2
