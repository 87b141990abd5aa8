"""Springy obstacle at rest: point, instant and stiffness from the integration of the contact.

A candidate is a set of values for the three parameters. A grid of candidates is integrated for the
first samples, and the best candidates of each position for more samples. The best of these are
refined by least squares (Levenberg and Marquardt, derivatives by differences, all candidates in one
batch). A bouncing contact has many local minima, which is why there are so many candidates.
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

Real = NDArray[np.float64]

OBSTACLE_PARAMETERS = ("x_m", "time_s", "ln_stiffness", "rate_m_per_s", "mobility_m_per_n_s")
"""Names of the parameters of an obstacle, in the order of a candidate's columns; the last two are
omitted for an obstacle at rest."""

MAX_LN_STIFFNESS = log(1e6)
"""Logarithm of the largest stiffness of an obstacle in N/m."""
MIN_LN_STIFFNESS = log(10.0)
"""Logarithm of the smallest stiffness of an obstacle in N/m."""

Prediction = Callable[[Real, "WhitenedWindow"], Real]
"""Function that predicts the effect of candidates, shape (k, p), on torque and base shear in a
window of samples, shape (k, c, samples)."""


@dataclass(frozen=True, slots=True)
class ParameterRanges:
    """Ranges and step sizes of the p parameters of one kind of obstacle; arrays of shape (p,)."""

    low: Real
    """Smallest value of each parameter."""
    high: Real
    """Largest value of each parameter."""
    difference: Real
    """Change of each parameter for a numerical derivative."""
    scale: Real
    """Significant change of each parameter; an iteration changes it by at most eight times this."""
    smallest_std: Real
    """Smallest standard deviation of each parameter for drawing samples."""
    largest_std: Real
    """Largest standard deviation of each parameter for drawing samples."""


@dataclass(frozen=True, slots=True)
class WhitenedWindow:
    """Whitened innovations in a range of samples, with which predictions are compared."""

    motion: FreeMotion
    """Motion of the beam without a touch in the record."""
    first: int
    """Index of the first sample."""
    end: int
    """Index of the sample after the last."""
    whitening: Real
    """Inverse Cholesky factor of the covariance of noise and uncertainties of the free motion."""
    data: Real
    """Whitened innovations of torque and base shear, shape (n,)."""

    @classmethod
    def from_motion(
        cls, motion: FreeMotion, first: int, end: int, deviations: Real | None = None
    ) -> "WhitenedWindow":
        """Return the whitened innovations of the samples from `first` to `end`.

        Parameters
        ----------
        motion
            Motion of the beam without a touch in the record.
        first, end
            Index of the first sample, and of the sample after the last.
        deviations
            Effects of all uncertainties on torque and shear, for one standard deviation each, shape
            (c, n, r) from sample `first`. None: the effects of the free motion's uncertainty are
            used, without those that the touch transmits.
        """
        if deviations is None:
            deviations = motion.design[:, first:end] @ motion.spread
        noise = motion.noise[:, None, None]
        columns = (deviations[:, : end - first] / noise).reshape(-1, deviations.shape[2])
        covariance = np.eye(columns.shape[0]) + columns @ columns.T
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        raw = (motion.innovations[:, first:end] / motion.noise[:, None]).ravel()
        return cls(motion, first, end, whitening, whitening @ raw)

    def residuals(self, predicted: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Return the whitened innovations minus predicted effects of touches, shape (k, n).

        The result has the floating-point precision of the prediction.

        Parameters
        ----------
        predicted
            Effect of each touch on torque and base shear, shape (k, c, samples).
        """
        noise, whitening, data = (
            each.astype(predicted.dtype, copy=False)
            for each in (self.motion.noise, self.whitening, self.data)
        )
        scaled = (predicted / noise[:, None]).reshape(predicted.shape[0], -1)
        return data - scaled @ whitening.T


class ObstacleContact:
    """Integration in time of the contact with obstacles, for the record of one touch.

    Parameters
    ----------
    kernels
        Contact kernels at some positions, on the time steps of the integration.
    x_m
        Positions at which the displacement of the free motion is given.
    motion
        Motion of the beam without a touch in the record.
    """

    __slots__ = ("_kernels", "_motion", "_x_m")

    def __init__(self, kernels: ContactKernels, x_m: Real, motion: FreeMotion) -> None:
        self._kernels, self._x_m, self._motion = kernels, x_m, motion

    def predict(
        self,
        parameters: Real,
        window: WhitenedWindow,
        side: float | None = None,
        kernels: ContactKernels | None = None,
    ) -> tuple[Real, Real]:
        """Return the effect of obstacles on torque and shear, and the contact forces.

        Parameters
        ----------
        parameters
            Candidates with the columns of `OBSTACLE_PARAMETERS`, at least the first three; shape
            (k, p).
        window
            Samples for which the effect is predicted.
        side
            Direction in which the beam presses, 1 or -1; None: the direction of its motion.
        kernels
            Kernels with one row for the only position; None: they are interpolated.

        Returns
        -------
        channels : ndarray, shape (k, c, samples)
            Effect on torque and base shear.
        force : ndarray, shape (k, n)
            Force on the beam in N, at the steps from the touch on.
        """
        motion = self._motion
        x, instant = parameters[:, 0], parameters[:, 1]
        step_s = self._kernels.step_s
        steps = self.step_count(instant, window)
        local_kernels = self._kernels.at_positions(x, steps) if kernels is None else kernels
        approach, sides = self.motion_beyond_obstacle(x, instant, steps, side)
        motion_parameters = parameters[:, 3:].T
        pressing_force_n = integrate_contact(
            np.broadcast_to(local_kernels.displacement[:, :steps], approach.shape),
            approach,
            np.exp(parameters[:, 2]),
            step_s,
            *(sides * motion_parameters[0],) if len(motion_parameters) else (),
            *motion_parameters[1:2],
        )
        force = -sides[:, None] * pressing_force_n
        tables = (local_kernels.torque, local_kernels.shear)[: motion.innovations.shape[0]]
        return self.effects(tables, force, instant, window), force

    def effect_of_changed_motion(
        self, parameters: Real, window: WhitenedWindow, displacement_changes_m: Real
    ) -> Real:
        """Return how changes of the free motion act on torque and shear through the contact.

        Another free motion meets the obstacle at another instant, which changes the contact force.
        The shape is (r, c, samples).

        Parameters
        ----------
        parameters
            Position, instant and logarithm of the stiffness of an obstacle at rest.
        window
            Samples for which the effect is predicted.
        displacement_changes_m
            Changes of the displacement at the obstacle's position, on the free motion's steps from
            its first step on, shape (r, columns).
        """
        x, instant = parameters[:1], parameters[1:2]
        steps = self.step_count(instant, window)
        local_kernels = self._kernels.at_positions(x, steps)
        approach, side = self.motion_beyond_obstacle(x, instant, steps)
        instants = np.repeat(instant, len(displacement_changes_m))
        added_approach_m = side * self._on_kernel_steps(displacement_changes_m, instants, steps)
        all_approaches = np.vstack(
            [approach, approach + added_approach_m - added_approach_m[:, :1]]
        )
        stiffness = np.full((1, len(all_approaches)), np.exp(parameters[2]))
        pressing_force_n = integrate_contact(
            local_kernels.displacement, all_approaches[None], stiffness, self._kernels.step_s
        )[0]
        tables = (local_kernels.torque, local_kernels.shear)[: self._motion.innovations.shape[0]]
        return self.effects(
            tables, -side * (pressing_force_n[1:] - pressing_force_n[0]), instants, window
        )

    def step_count(self, instant: Real, window: WhitenedWindow) -> int:
        """Return the number of time steps from the earliest touch to the end of the window.

        Parameters
        ----------
        instant
            Instants of touch, shape (k,).
        window
            Samples at whose end the integration ends.
        """
        step_s = self._kernels.step_s
        steps = int(np.ceil((self._motion.t[window.end - 1] - instant.min()) / step_s)) + 3
        return min(max(steps, 4), self._kernels.steps)

    def pressing_direction(self, parameters: Real) -> float:
        """Return the direction of the beam's motion at a touch, 1 or -1.

        Parameters
        ----------
        parameters
            One candidate with at least position and instant.
        """
        return float(self.motion_beyond_obstacle(parameters[:1], parameters[1:2], 1)[1][0])

    def effects(
        self, tables: tuple[Real, ...], force: Real, instant: Real, window: WhitenedWindow
    ) -> Real:
        """Return the effect of contact forces on torque and base shear, shape (k, c, samples).

        Parameters
        ----------
        tables
            Kernel of torque, and of shear if it is measured, with as many rows as `force` or one.
        force
            Forces on the beam at the steps of the kernels, shape (k, n).
        instant
            Instant of each force's first step, shape (k,).
        window
            Samples for which the effect is predicted.
        """
        motion = self._motion
        step_s = self._kernels.step_s
        stride = round((motion.t[1] - motion.t[0]) / step_s)
        samples = window.end - window.first
        begin = (motion.t[window.first] - instant) / step_s
        # Convolution and shift commute: shifting first puts the steps of all at the samples.
        aligned = shift_rows(force, begin, (samples - 1) * stride + 1)
        return contact_responses(tables, aligned, stride, samples)

    def motion_beyond_obstacle(
        self, x: Real, instant: Real, steps: int, given_direction: float | None = None
    ) -> tuple[Real, Real]:
        """Return how far the free beam would move beyond the obstacle, and in which direction.

        Parameters
        ----------
        x, instant
            Positions and instants of touches, shape (k,).
        steps
            Number of time steps from the instants on.
        given_direction
            Direction of the motion, 1 or -1; None: the direction at the instant of touch.

        Returns
        -------
        beyond : ndarray, shape (k, steps)
            Displacement of the free beam from its displacement at the touch, in m, positive in the
            direction of the motion.
        side : ndarray, shape (k,)
            Direction of the motion, 1 or -1.
        """
        motion = self._motion
        first, weights = cubic_weights(x, self._x_m)
        displacement_m = interpolate_rows(motion.displacement_m, first, weights)
        free = self._on_kernel_steps(displacement_m, instant, steps)
        if given_direction is None:
            before = shift_rows(displacement_m, (instant - motion.first_s) / motion.step_s - 1.0, 1)
            side = np.where(free[:, 0] >= before[:, 0], 1.0, -1.0)
        else:
            side = np.full(x.size, given_direction)
        return side[:, None] * (free - free[:, :1]), side

    def _on_kernel_steps(self, displacement_m: Real, instant: Real, steps: int) -> Real:
        """Interpolate displacements to the kernels' time steps, each row from its instant on."""
        motion = self._motion
        begin = (instant - motion.first_s) / motion.step_s
        substeps = max(1, round(motion.step_s / self._kernels.step_s))
        interpolated = np.empty((begin.size, substeps * -(-steps // substeps)))
        for i in range(substeps):
            part = interpolated[:, i::substeps]
            part[:] = shift_rows(displacement_m, begin + i / substeps, part.shape[1])
        return interpolated[:, :steps]


@dataclass(frozen=True, slots=True)
class Minima:
    """Local minima of the sum of squared residuals that least squares found."""

    parameters: Real
    """Parameters of each minimum, with the columns of `OBSTACLE_PARAMETERS`; shape (k, p)."""
    chi2: Real
    """Sum of squared residuals at each minimum, shape (k,)."""
    jacobian: Real
    """Derivatives of the residuals by the parameters, shape (k, n, p)."""


_MIN_CHI2_REDUCTION = 0.1
"""Reduction of the sum of squared residuals below which a step of least squares is the last. For a
step that fails, the predicted reduction counts."""


def find_minima(
    predict: Prediction,
    window: WhitenedWindow,
    starts: Real,
    space: ParameterRanges,
    rounds: int = 12,
    free: NDArray[np.bool_] | None = None,
) -> Minima:
    """Minimise the sum of squared residuals from each start by least squares; return the minima.

    Parameters
    ----------
    predict
        Function that predicts the effect of candidates.
    window
        Whitened innovations with which the predictions are compared.
    starts
        Candidates from which the iterations start, shape (k, p).
    space
        Ranges of the parameters.
    rounds
        Largest number of iterations.
    free
        Whether each parameter of each start is free, shape (k, p); None: all are free.
    """
    current = np.clip(starts, space.low, space.high)
    damping = np.full(len(current), 1e-2)
    residual, jacobian = _linearise(predict, window, current, space)
    chi2 = np.einsum("kn,kn->k", residual, residual)
    active = np.ones(len(current), dtype=bool)
    regularisation = 1e-6 / space.scale**2
    for _ in range(rounds):
        rows = np.flatnonzero(active)
        j, r = jacobian[rows], residual[rows]
        if free is not None:
            j = j * free[rows, None]
        normal = np.einsum("knp,knq->kpq", j, j)
        gradient = np.einsum("knp,kn->kp", j, r)
        diagonal = np.einsum("kpp->kp", normal) * damping[rows, None] + regularisation
        normal += diagonal[:, :, None] * np.eye(current.shape[1])
        step = -np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        step = np.clip(step, -8 * space.scale, 8 * space.scale)
        trial = np.clip(current[rows] + step, space.low, space.high)
        predicted_residual = r + np.einsum("knp,kp->kn", j, trial - current[rows])
        predicted_gain = chi2[rows] - np.einsum("kn,kn->k", predicted_residual, predicted_residual)
        new_residual, new_jacobian = _linearise(predict, window, trial, space)
        new_chi2 = np.einsum("kn,kn->k", new_residual, new_residual)
        gain = chi2[rows] - new_chi2
        is_improved = gain > 0
        accepted_rows = rows[is_improved]
        current[accepted_rows], chi2[accepted_rows] = trial[is_improved], new_chi2[is_improved]
        residual[accepted_rows], jacobian[accepted_rows] = (
            new_residual[is_improved],
            new_jacobian[is_improved],
        )
        damping[rows] = np.where(is_improved, damping[rows] / 6, damping[rows] * 8)
        # Residuals have kinks where contacts begin and end: short steps may fail to reduce them.
        active[rows[np.where(is_improved, gain, predicted_gain) < _MIN_CHI2_REDUCTION]] = False
        if not active.any():
            break
    return Minima(current, chi2, jacobian)


def _linearise(
    predict: Prediction, window: WhitenedWindow, current: Real, space: ParameterRanges
) -> tuple[Real, Real]:
    """Return the residuals of candidates, (k, n), and derivatives by the parameters, (k, n, p)."""
    width = current.shape[1]
    shifts = np.where(current + space.difference > space.high, -space.difference, space.difference)
    rows = np.concatenate([current, *(current + np.eye(width)[i] * shifts for i in range(width))])
    residuals = window.residuals(predict(rows, window)).reshape(width + 1, len(current), -1)
    derivatives = (residuals[1:] - residuals[0]) / shifts.T[:, :, None]
    return residuals[0], np.moveaxis(derivatives, 0, -1)


class CandidateGrid:
    """Grid of candidates over position, instant and stiffness, from which the search starts.

    All candidates are integrated together in coarse time steps.

    Parameters
    ----------
    kernels
        Contact kernels whose step divides the sampling period.
    stride
        Number of the kernels' positions from one position of the grid to the next.
    rate_hz
        Samples a second.
    samples
        Number of samples that are compared.
    """

    __slots__ = ("_channels", "_kernel", "_ratio", "_samples", "_step_s", "_stride", "_x_m")

    def __init__(self, kernels: ContactKernels, stride: int, rate_hz: float, samples: int) -> None:
        self._ratio = round(1 / (rate_hz * kernels.step_s))
        self._samples, self._stride, self._step_s = samples, stride, kernels.step_s
        steps = self._ratio * samples
        self._x_m = kernels.x_m[::stride]
        # Single precision suffices for choosing starts, and is twice as fast.
        self._kernel = kernels.displacement[::stride, :steps].astype(np.float32)
        lag = self._ratio * np.arange(samples)[:, None] - np.arange(steps)
        self._channels = [
            np.where(lag >= 0, table[::stride][:, np.maximum(lag, 0)], 0.0)
            .transpose(0, 2, 1)
            .astype(np.float32)
            for table in (kernels.torque, kernels.shear)
        ]  # (positions, steps, samples)

    def integrate(
        self, motion: FreeMotion, window: WhitenedWindow, latest: int
    ) -> tuple[Real, Real]:
        """Return all candidates of the grid, and their sums of squared residuals.

        Parameters
        ----------
        motion
            Motion of the beam without a touch in the record.
        window
            Whitened innovations with which the candidates are compared.
        latest
            Index of the last sample at which the touch may begin. The earliest is the first sample
            of the window.
        """
        samples = np.arange(window.first + 1, latest + 1)
        batches = np.array_split(samples, -(-samples.size // _INSTANTS_AT_ONCE))
        chi2 = [self._sums_of_squares(motion, window, batch) for batch in batches]
        starts = np.meshgrid(
            self._x_m, motion.t[samples], np.log(GRID_STIFFNESSES_N_PER_M), indexing="ij"
        )
        return np.stack(starts, axis=-1).reshape(-1, 3), np.concatenate(chi2, axis=1).ravel()

    def _sums_of_squares(
        self, motion: FreeMotion, window: WhitenedWindow, samples: NDArray[np.intp]
    ) -> Real:
        """Return sums of squared residuals for touches at some samples.

        The shape is (positions, instants, stiffnesses).
        """
        positions, stiffness_count = self._x_m.size, GRID_STIFFNESSES_N_PER_M.size
        length = window.end - int(samples[0])
        steps = self._ratio * length
        begins = np.round((motion.t[samples] - motion.first_s) / motion.step_s).astype(np.intp)
        columns = begins[:, None] + np.arange(-1, steps)
        last = motion.displacement_m.shape[1] - 1
        displacement_m = motion.displacement_m[:: self._stride][:, np.minimum(columns, last)]
        # Axes: position, instant, step.
        side = np.where(displacement_m[:, :, 1] >= displacement_m[:, :, 0], 1, -1)[
            :, :, None
        ].astype(np.float32)
        approach = (side * (displacement_m[:, :, 1:] - displacement_m[:, :, 1:2])).astype(
            np.float32
        )
        pressing_force_n = integrate_contact(
            self._kernel[:, :steps],
            np.repeat(approach, stiffness_count, axis=1),
            np.tile(GRID_STIFFNESSES_N_PER_M.astype(np.float32), (positions, samples.size)),
            self._step_s,
        )
        force = -np.repeat(side, stiffness_count, axis=1) * pressing_force_n
        predicted = np.zeros(
            (
                positions,
                samples.size,
                stiffness_count,
                motion.noise.size,
                window.end - window.first,
            ),
            dtype=np.float32,
        )
        for channel in range(motion.noise.size):
            effect = force @ self._channels[channel][:, :steps, :length]
            effect = effect.reshape(positions, samples.size, stiffness_count, length)
            for i, sample in enumerate(samples):
                count = window.end - sample
                predicted[:, i, :, channel, -count:] = effect[:, i, :, :count]
        residual = window.residuals(predicted.reshape(-1, *predicted.shape[3:]))
        chi2: Real = np.einsum("kn,kn->k", residual, residual)
        return chi2.reshape(positions, samples.size, stiffness_count)


_INSTANTS_AT_ONCE = 16
"""Number of instants of touch in the grid that are integrated at once."""
GRID_STIFFNESSES_N_PER_M = np.array([60.0, 300.0, 1000.0, 3000.0, 10000.0, 100000.0])
"""Stiffnesses of the grid's candidates in N/m."""


def chi2_of(predict: Prediction, window: WhitenedWindow, candidates: Real) -> Real:
    """Return the sum of squared residuals of each candidate, shape (k,).

    Parameters
    ----------
    predict
        Function that predicts the effect of candidates.
    window
        Whitened innovations with which the predictions are compared.
    candidates
        Parameters of the candidates, shape (k, p).
    """
    residual = window.residuals(predict(candidates, window))
    chi2: Real = np.einsum("kn,kn->k", residual, residual)
    return chi2
