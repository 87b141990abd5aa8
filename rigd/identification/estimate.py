"""Inertia, friction, torque scale and delay of a motor from windows of its motion.

Windows of one key are repeats of the same motion. The motor's equation, with the torque held
between commands,

    ``s u(t - D) = J θ'' + B θ' + C sign(θ') + z + τ_c``,

is multiplied by smooth test functions ``w(t) exp(-iωt)`` and integrated by parts, so that no
reading is differentiated; frequency by frequency this gives linear rows, moments of the readings
(`_moments`). All integrals are exact for a command that changes at any moment of a period. The
measured coupling torque τ_c is alone on its side because it carries the noise.

The rows are fitted by weighted least squares (`_fit`). The mean of repeats is fitted, because the
loop feeds the noise of a reading back into the command and so biases a fit of single ones; their
scatter gives the weights, the remainder of that bias, and the standard deviations.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from rigd.errors import FailureError

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


# The motor's equation as linear rows

SCALE, INERTIA, VISCOUS, COULOMB, DELAY, ZERO = range(6)
"""Indices of the unknowns; from the last on, one zero of the torque for each session."""

_FLANK = 0.15
"""Part of a window over which the test functions rise, and fall."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Rate and delays of the readings, and where the search for the command's delay begins."""

    rate_hz: float
    """Rate of the samples."""
    angle_delay_s: float
    """Age of an angle when it is read."""
    torque_delay_s: float
    """Age of a torque when it is read."""
    actuation_delay_s: float
    """Start value of the search."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """Repeats of one motion, each array (r, n)."""

    angle_rad: Real
    torque_command_nm: Real
    coupling_torque_nm: Real
    direction: float
    top_hz: float
    session: int


@dataclass(frozen=True, slots=True, eq=False)
class _StackMoments:
    """Moments of a stack: ``y = x p``, a row a repeat and frequency."""

    y: Complex
    """(r, m), of the coupling torque."""
    x: Complex
    """(r, m, p), of what belongs to each unknown."""


def _moments(
    stack: _Stack, timing: Timing, delay_s: float, scale: float, unknowns: int
) -> _StackMoments:
    """Integrate a stack with the test functions; times count from the window's first angle."""
    period_s = 1.0 / timing.rate_hz
    repeats, n = stack.angle_rad.shape
    length_s = n * period_s
    bins = int(stack.top_hz * length_s) + 1
    omega = 2.0 * pi / length_s * np.arange(bins)
    tick_s: Real = np.arange(n, dtype=np.float64) * period_s

    def transform(weight: Real, signal: Real, shift_s: float) -> Complex:
        spectrum = np.fft.rfft(weight * signal, axis=-1)[..., :bins]
        result: Complex = period_s * np.exp(-1j * omega * shift_s) * spectrum
        return result

    angle = stack.angle_rad - stack.angle_rad.mean(axis=1, keepdims=True)
    w, w1, w2 = _test_window(tick_s, length_s)
    angle_0, angle_1, angle_2 = (transform(weight, angle, 0.0) for weight in (w, w1, w2))
    speed = -(angle_1 - 1j * omega * angle_0)
    acceleration = angle_2 - 2j * omega * angle_1 - omega**2 * angle_0
    constant = np.broadcast_to(transform(w, np.ones(n), 0.0), (repeats, bins))

    age_s = timing.angle_delay_s - timing.torque_delay_s
    y = transform(_test_window(tick_s + age_s, length_s)[0], stack.coupling_torque_nm, age_s)

    # A command lasts a period: its middle, and the integral over the period around it.
    middle_s = delay_s + 0.5 * period_s
    w, w1, _ = _test_window(tick_s + middle_s, length_s)
    held = np.sinc(omega * period_s / (2.0 * pi))
    command = held * transform(w, stack.torque_command_nm, middle_s)
    slope = held * transform(w1, stack.torque_command_nm, middle_s) - 1j * omega * command

    x = np.zeros((repeats, bins, unknowns), dtype=complex)
    x[..., SCALE] = command
    x[..., INERTIA] = -acceleration
    x[..., VISCOUS] = -speed
    x[..., COULOMB] = -stack.direction * constant
    x[..., DELAY] = scale * slope
    x[..., ZERO + stack.session] = -constant
    return _StackMoments(y, x)


def _test_window(t: Real, length_s: float) -> tuple[Real, Real, Real]:
    """Window of a length, smooth to its third derivative, and its first two; zero outside."""
    flank_s = _FLANK * length_s
    nearest = np.minimum(t, length_s - t)
    x = np.clip(nearest / flank_s, 0.0, 1.0)
    sign = np.where(t < 0.5 * length_s, 1.0, -1.0)
    w = x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)
    w1 = sign * 140.0 * (x * (1.0 - x)) ** 3 / flank_s
    w2 = 420.0 * (x * (1.0 - x)) ** 2 * (1.0 - 2.0 * x) / flank_s**2
    return w, w1, w2


# Weighted least squares

_MARGIN = 1.25
"""On all deviations: they are themselves known to some 15 %, and the filter of the readings and the
beam's part in a jump of torque are not in the model."""
_MAX_ITERATIONS = 30
_CONVERGED_S = 1e-9
_LONGEST_DELAY_S = 0.05
_SMOOTHED_BINS = 9


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Solution in the order of `_moments`, with diagnostics."""

    values: Real
    """Scale, inertia, viscous, Coulomb, delay from command to angle, zeros of the sessions."""
    stds: Real
    misfit: float
    friction_departure_nm: float


def _fit(stacks: Sequence[_Stack], timing: Timing, *, hold_scale: bool) -> _Fit | None:
    """Fit by least squares, iterated for delay and weights; None if it does not converge.

    Parameters
    ----------
    stacks
        At least two repeats in each.
    timing
        Timing of the readings; the search for the delay starts at its value.
    hold_scale
        Whether the commanded torque counts as the true one.
    """
    unknowns = ZERO + 1 + max(stack.session for stack in stacks)
    free = np.arange(unknowns) != SCALE if hold_scale else np.full(unknowns, fill_value=True)
    delay_s, scale = timing.actuation_delay_s + timing.angle_delay_s, 1.0
    weights: list[Real] = []
    for _ in range(_MAX_ITERATIONS):
        rows = [_moments(stack, timing, delay_s, scale, unknowns) for stack in stacks]
        weights = weights or [np.ones(row.y.shape[1]) for row in rows]
        solution = _solve(rows, weights, free)
        residuals = [row.y - row.x @ solution for row in rows]
        change_s = float(solution[DELAY])
        if abs(change_s) < _CONVERGED_S:
            try:
                return _with_uncertainty(rows, weights, residuals, free, solution, delay_s)
            except np.linalg.LinAlgError:  # an unknown has no effect in the record
                return None
        delay_s, scale = delay_s + change_s, float(solution[SCALE])
        if not (abs(delay_s) < _LONGEST_DELAY_S and scale > 0.0):
            return None
        weights = _weights(residuals, stacks)
    return None


def _solve(rows: Sequence[_StackMoments], weights: Sequence[Real], free: NDArray[np.bool_]) -> Real:
    """Fit the means of the repeats; the scale, if it is not free, is 1."""
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


def _weights(residuals: Sequence[Complex], stacks: Sequence[_Stack]) -> list[Real]:
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


def _with_uncertainty(
    rows: Sequence[_StackMoments],
    weights: Sequence[Real],
    residuals: Sequence[Complex],
    free: NDArray[np.bool_],
    solution: Real,
    delay_s: float,
) -> _Fit:
    """Remove the bias by noise from the solution, and estimate its uncertainty."""
    chosen = np.flatnonzero(free)
    normal = np.zeros((chosen.size, chosen.size))
    bias = np.zeros(chosen.size)
    for row, weight, residual in zip(rows, weights, residuals, strict=True):
        repeats = len(row.y)
        x = row.x[..., chosen]
        mean = x.mean(axis=0)
        normal += np.einsum("mp,m,mq->pq", mean.conj(), weight, mean).real
        apart = x - mean
        part = weight / (repeats * (repeats - 1))
        bias += np.einsum("rmp,m,rm->p", apart.conj(), part, residual).real
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
    parts_of_variance = np.array(parts)
    variance = parts_of_variance.sum(axis=0)
    freedom = variance**2 / np.sum(parts_of_variance**2 / np.array(degrees)[:, None], axis=0)
    misfit = left / max(1.0, terms - 0.5 * chosen.size)
    widening = _MARGIN * _coverage(freedom) * sqrt(max(1.0, misfit))

    values, stds = solution.copy(), np.zeros(free.size)
    values[chosen] -= inverse @ bias
    values[DELAY] += delay_s
    stds[chosen] = widening * np.sqrt(variance)
    return _Fit(values, stds, misfit, departure_nm)


def _coverage(freedom: Real) -> Real:
    """Return Student's t over the normal quantile at 3 deviations, to second order in 1/freedom."""
    return 1.0 + (7.5 / freedom + 17.25 / freedom**2) / 3.0


# Estimate of a motor

LEAST_REPEATS = 4
"""Fewer repeats do not determine the scatter."""

_LEAST_SPEED_PART = 0.1
"""Fraction of the nominal speed below which a window may contain a standstill."""
_SPEED_S = 0.01
"""Half the time over which that speed is taken."""
_MAX_SCALE_STD = 0.05
"""Accuracy of a torque constant from a datasheet."""
_SCALES = (0.5, 2.0)
"""Without a beam the equation is solved by no torque and no motor too: a scale beyond these is no
torque constant."""


class MotorEstimateError(FailureError, ValueError):
    """The windows do not determine the motor's data; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class PassReadings:
    """Readings during one pass at constant nominal speed, each of shape (n,)."""

    angle_rad: Real
    """Angle of the shaft."""
    torque_command_nm: Real
    """Torque commanded."""
    coupling_torque_nm: Real
    """Torque between motor and beam."""
    speed_rad_s: float
    """Nominal, signed."""
    top_hz: float
    """Highest frequency of the motion."""
    session: int
    """Each session has its own zero of the torque."""
    key: Hashable
    """Repeats of the same motion have equal keys."""


@dataclass(frozen=True, slots=True)
class MotorQuantity:
    """An estimate and its standard deviation; None: it was not estimated."""

    value: float
    """The estimate."""
    std: float | None
    """Its standard deviation."""


@dataclass(frozen=True, slots=True)
class MotorEstimate:
    """Estimate of the motor, at its output shaft."""

    inertia_kg_m2: MotorQuantity
    """Inertia of the motor without the tool."""
    viscous_nm_s_per_rad: MotorQuantity
    """Viscous friction."""
    coulomb_nm: MotorQuantity
    """Coulomb friction."""
    torque_scale: MotorQuantity
    """True torque over commanded torque; without a standard deviation it is held at 1, and the
    other quantities count in the drive's own torque."""
    actuation_delay_s: MotorQuantity
    """From the command to the torque."""
    windows: int
    """Windows of the records that count."""
    dropped: int
    """Windows in which the shaft may have stood still."""
    misfit: float
    """Mean square of the residual over that expected from scatter: 1 if the equation holds."""
    friction_departure_nm: float
    """Largest departure of a pass's mean torque from viscous and Coulomb friction."""


def estimate_motor(
    windows: Sequence[PassReadings], timing: Timing, *, tool_inertia_kg_m2: float = 0.0
) -> MotorEstimate:
    """Fit the motor's equation to windows in which its speed does not change sign.

    Parameters
    ----------
    windows
        Windows of equal length; at least `LEAST_REPEATS` of each key, and both directions.
    timing
        Timing of the readings. They show only the delay from command to angle: that of the angle is
        taken off it.
    tool_inertia_kg_m2
        Between sensor and beam: it makes the coupling torque jump with each command, and where
        within a period the sensor sees that is not known; the delay's deviation allows for it.

    Returns
    -------
    MotorEstimate
        Standard deviations hold the scatter between repeats, widened for their finite number so
        that three of them cover 99.7 %, for what the equation does not explain, and by a margin.

    Raises
    ------
    MotorEstimateError
        If there are too few windows, or the fit does not converge.
    """
    moving = [window for window in windows if _never_stops(window, timing.rate_hz)]
    stacks = _stack(moving, len(windows))
    found = _fit(stacks, timing, hold_scale=False)
    scale_known = (
        found is not None
        and found.stds[SCALE] < _MAX_SCALE_STD
        and _SCALES[0] < found.values[SCALE] < _SCALES[1]
    )
    if not scale_known:
        found = _fit(stacks, timing, hold_scale=True)
    if found is None:
        raise MotorEstimateError(
            "The motor's data are not identifiable from the record: the fit does not converge. "
            "Check actuation.delay_s of the profile, from which the search begins, and the "
            "record."
        )
    values, stds = found.values, found.stds
    inertia = float(values[INERTIA])
    if inertia <= 0.0:
        raise MotorEstimateError(
            f"The fit ends at an inertia of {inertia:.3g} kg·m²: the record does not show the "
            "motor's own motion. Check sensor.projection, encoder.delay_s and sensor.delay_s."
        )
    jump = tool_inertia_kg_m2 / (inertia + tool_inertia_kg_m2)
    sampled_s = jump / timing.rate_hz / sqrt(12.0)
    return MotorEstimate(
        inertia_kg_m2=MotorQuantity(inertia, float(stds[INERTIA])),
        viscous_nm_s_per_rad=MotorQuantity(float(values[VISCOUS]), float(stds[VISCOUS])),
        coulomb_nm=MotorQuantity(float(values[COULOMB]), float(stds[COULOMB])),
        torque_scale=MotorQuantity(
            float(values[SCALE]), float(stds[SCALE]) if scale_known else None
        ),
        actuation_delay_s=MotorQuantity(
            float(values[DELAY]) - timing.angle_delay_s,
            sqrt(float(stds[DELAY]) ** 2 + sampled_s**2),
        ),
        windows=len(moving),
        dropped=len(windows) - len(moving),
        misfit=found.misfit,
        friction_departure_nm=found.friction_departure_nm,
    )


def _never_stops(window: PassReadings, rate_hz: float) -> bool:
    half = max(1, round(_SPEED_S * rate_hz))
    angle = window.angle_rad
    speed = (angle[2 * half :] - angle[: -2 * half]) * rate_hz / (2 * half)
    along = speed * np.sign(window.speed_rad_s)
    return bool(np.min(along) > _LEAST_SPEED_PART * abs(window.speed_rad_s))


def _stack(windows: Sequence[PassReadings], given: int) -> list[_Stack]:
    groups: dict[Hashable, list[PassReadings]] = {}
    for window in windows:
        groups.setdefault(window.key, []).append(window)
    full = [group for group in groups.values() if len(group) >= LEAST_REPEATS]
    if {np.sign(group[0].speed_rad_s) for group in full} != {1.0, -1.0}:
        raise MotorEstimateError(
            f"Of {given} passes {len(windows)} can be used, and that is too few: it takes at least "
            f"{LEAST_REPEATS} of the same kind in both directions, without gaps and without a "
            "standstill."
        )
    sessions = {number: index for index, number in enumerate(sorted({g[0].session for g in full}))}
    return [
        _Stack(
            np.array([window.angle_rad for window in group]),
            np.array([window.torque_command_nm for window in group]),
            np.array([window.coupling_torque_nm for window in group]),
            float(np.sign(group[0].speed_rad_s)),
            group[0].top_hz,
            sessions[group[0].session],
        )
        for group in full
    ]
