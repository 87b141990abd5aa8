"""Estimate of a motor's inertia, friction, torque scale and delay from windows of its motion.

Windows with the same key are repeats of the same motion. The motor's equation, with a torque that
is constant between commands,

    ``s u(t - D) = J θ'' + B θ' + C sign(θ') + z + τ_c``,

is multiplied by smooth test functions ``w(t) exp(-iωt)`` and integrated by parts, so that no
reading is differentiated. Each frequency gives a linear equation between moments of the readings
(`_motion_equations`). All integrals are exact for a command that changes at any moment of a
period. The measured coupling torque τ_c is the left side of the equations, because it carries the
noise.

The equations are solved by weighted least squares (`_fit_equation`). The mean of the repeats is
fitted, because the loop feeds the noise of a reading back into the command, which would bias a fit
of single repeats. The scatter of the repeats gives the weights, the bias that remains in the mean,
and the standard deviations.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from rigd.errors import FailureError

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


# The motor's equation as linear rows

SCALE_INDEX, INERTIA_INDEX, VISCOUS_INDEX, COULOMB_INDEX, DELAY_INDEX, ZERO_INDEX = range(6)
"""Indices of the unknowns in the solution vector.

From `ZERO_INDEX` on, there is one torque offset (zero of the sensor) for each session."""

_WINDOW_RISE_FRACTION = 0.15
"""Duration of the rise, and of the fall, of the test functions as a fraction of the window."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Rate and delays of the readings, and a first guess of the command's delay."""

    rate_hz: float
    """Rate of the samples."""
    angle_delay_s: float
    """Age in s of an angle when it is read."""
    torque_delay_s: float
    """Age in s of a coupling torque when it is read."""
    actuation_delay_s: float
    """Start value of the search for the delay from a command to its torque."""


@dataclass(frozen=True, slots=True, eq=False)
class _MotionRepeats:
    """Readings of all repeats of the same motion, in arrays of shape (repeats, samples)."""

    angle_rad: RealArray
    """Measured angle."""
    torque_command_nm: RealArray
    """Commanded torque."""
    coupling_torque_nm: RealArray
    """Measured coupling torque."""
    speed_sign: float
    """Sign of the speed."""
    highest_frequency_hz: float
    """Highest frequency of the motion."""
    session: int
    """Index of the session in which the motion was recorded."""


@dataclass(frozen=True, slots=True, eq=False)
class _MotionEquations:
    """Linear equations of the coupling torque's moments, one for each repeat and frequency."""

    torque_moments: ComplexArray
    """Moments of the coupling torque, shape (repeats, frequencies)."""
    unknown_coefficients: ComplexArray
    """Coefficients of the unknowns, shape (repeats, frequencies, unknowns)."""


def _motion_equations(
    motion_repeats: _MotionRepeats,
    timing: Timing,
    delay_s: float,
    torque_scale: float,
    unknown_count: int,
) -> _MotionEquations:
    """Return the motor's equation for repeats of a motion, integrated with the test functions.

    `delay_s` and `torque_scale` are the present estimates of the command's delay and torque scale.
    Times count from the window's first angle.
    """
    period_s = 1.0 / timing.rate_hz
    repeat_count, n = motion_repeats.angle_rad.shape
    length_s = n * period_s
    bin_count = int(motion_repeats.highest_frequency_hz * length_s) + 1
    omega = 2.0 * pi / length_s * np.arange(bin_count)
    tick_times_s: RealArray = np.arange(n, dtype=np.float64) * period_s

    def transform(window_weight: RealArray, signal: RealArray, time_shift_s: float) -> ComplexArray:
        spectrum = np.fft.rfft(window_weight * signal, axis=-1)[..., :bin_count]
        shifted_spectrum: ComplexArray = period_s * np.exp(-1j * omega * time_shift_s) * spectrum
        return shifted_spectrum

    angle_rad = motion_repeats.angle_rad - motion_repeats.angle_rad.mean(axis=1, keepdims=True)
    w, w1, w2 = _test_window(tick_times_s, length_s)
    angle_0, angle_1, angle_2 = (
        transform(window_weight, angle_rad, 0.0) for window_weight in (w, w1, w2)
    )
    speed_spectrum = -(angle_1 - 1j * omega * angle_0)
    acceleration_spectrum = angle_2 - 2j * omega * angle_1 - omega**2 * angle_0
    constant_spectrum = np.broadcast_to(transform(w, np.ones(n), 0.0), (repeat_count, bin_count))

    relative_angle_age_s = timing.angle_delay_s - timing.torque_delay_s
    torque_moments = transform(
        _test_window(tick_times_s + relative_angle_age_s, length_s)[0],
        motion_repeats.coupling_torque_nm,
        relative_angle_age_s,
    )

    # A command lasts a period: it is integrated over the period around its middle.
    command_middle_s = delay_s + 0.5 * period_s
    w, w1, _ = _test_window(tick_times_s + command_middle_s, length_s)
    hold_response = np.sinc(omega * period_s / (2.0 * pi))
    command_spectrum = hold_response * transform(
        w, motion_repeats.torque_command_nm, command_middle_s
    )
    delay_slope = (
        hold_response * transform(w1, motion_repeats.torque_command_nm, command_middle_s)
        - 1j * omega * command_spectrum
    )

    unknown_coefficients = np.zeros((repeat_count, bin_count, unknown_count), dtype=complex)
    unknown_coefficients[..., SCALE_INDEX] = command_spectrum
    unknown_coefficients[..., INERTIA_INDEX] = -acceleration_spectrum
    unknown_coefficients[..., VISCOUS_INDEX] = -speed_spectrum
    unknown_coefficients[..., COULOMB_INDEX] = -motion_repeats.speed_sign * constant_spectrum
    unknown_coefficients[..., DELAY_INDEX] = torque_scale * delay_slope
    unknown_coefficients[..., ZERO_INDEX + motion_repeats.session] = -constant_spectrum
    return _MotionEquations(torque_moments, unknown_coefficients)


def _test_window(t: RealArray, length_s: float) -> tuple[RealArray, RealArray, RealArray]:
    """Return the window of the test functions at times `t`, and its first two derivatives.

    The window is smooth to its third derivative and zero outside of 0 to `length_s`.
    """
    rise_s = _WINDOW_RISE_FRACTION * length_s
    edge_distance_s = np.minimum(t, length_s - t)
    x = np.clip(edge_distance_s / rise_s, 0.0, 1.0)
    slope_sign = np.where(t < 0.5 * length_s, 1.0, -1.0)
    w = x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)
    w1 = slope_sign * 140.0 * (x * (1.0 - x)) ** 3 / rise_s
    w2 = 420.0 * (x * (1.0 - x)) ** 2 * (1.0 - 2.0 * x) / rise_s**2
    return w, w1, w2


# Weighted least squares

_STD_WIDENING_FACTOR = 1.25
"""Factor by which all standard deviations are widened.

They are known to some 15 % only, and the model neglects the filter of the readings and the beam's
part in a jump of torque."""
_MAX_FIT_ITERATIONS = 30
"""Largest number of iterations for delay and weights."""
_DELAY_TOLERANCE_S = 1e-9
"""Change of the delay in seconds below which the iteration has converged."""
_MAX_COMMAND_DELAY_S = 0.05
"""Largest delay in seconds that the search accepts."""
_SMOOTHED_BINS = 9
"""Number of neighbouring frequencies over which the noise variance is averaged."""


@dataclass(frozen=True, slots=True, eq=False)
class _MotorFit:
    """Estimated unknowns of the motor's equation, with standard deviations and diagnostics."""

    unknown_values: RealArray
    """Estimates: torque scale, inertia, viscous and Coulomb friction, delay from command to angle,
    and the sessions' zeros of the torque."""
    unknown_stds: RealArray
    """Standard deviations of `unknown_values`; 0 for a scale that is not estimated."""
    misfit: float
    """Ratio of the residual's mean square to that expected from the scatter of the repeats."""
    friction_departure_nm: float
    """Largest departure of a pass's mean torque from viscous and Coulomb friction."""


def _fit_equation(
    repeated_motions: Sequence[_MotionRepeats], timing: Timing, *, fixes_torque_scale: bool
) -> _MotorFit | None:
    """Return the weighted fit of the motor's equation to all motions, or None if it diverges.

    The fit is iterated for the delay and the weights. Each of `repeated_motions` has at least two
    repeats. With `fixes_torque_scale`, the torque scale is fixed at 1.
    """
    unknown_count = (
        ZERO_INDEX + 1 + max(motion_repeats.session for motion_repeats in repeated_motions)
    )
    is_estimated = (
        np.arange(unknown_count) != SCALE_INDEX
        if fixes_torque_scale
        else np.full(unknown_count, fill_value=True)
    )
    delay_s, torque_scale = timing.actuation_delay_s + timing.angle_delay_s, 1.0
    bin_weights: list[RealArray] = []
    for _ in range(_MAX_FIT_ITERATIONS):
        equations_by_motion = [
            _motion_equations(motion_repeats, timing, delay_s, torque_scale, unknown_count)
            for motion_repeats in repeated_motions
        ]
        bin_weights = bin_weights or [
            np.ones(equations.torque_moments.shape[1]) for equations in equations_by_motion
        ]
        solution = _solve_mean_equations(equations_by_motion, bin_weights, is_estimated)
        fit_residuals = [
            equations.torque_moments - equations.unknown_coefficients @ solution
            for equations in equations_by_motion
        ]
        delay_change_s = float(solution[DELAY_INDEX])
        if abs(delay_change_s) < _DELAY_TOLERANCE_S:
            try:
                return _finish_fit(
                    equations_by_motion, bin_weights, fit_residuals, is_estimated, solution, delay_s
                )
            except np.linalg.LinAlgError:  # an unknown has no effect in the record
                return None
        delay_s, torque_scale = delay_s + delay_change_s, float(solution[SCALE_INDEX])
        if not (abs(delay_s) < _MAX_COMMAND_DELAY_S and torque_scale > 0.0):
            return None
        bin_weights = _inverse_variances(fit_residuals, repeated_motions)
    return None


def _solve_mean_equations(
    equations_by_motion: Sequence[_MotionEquations],
    weights: Sequence[RealArray],
    is_estimated: NDArray[np.bool_],
) -> RealArray:
    """Return the least-squares solution of the equations, averaged over the repeats of each motion.

    `is_estimated` is a mask of the unknowns to solve for; the torque scale is 1 if not among them.
    """
    solution = np.zeros(is_estimated.size)
    solution[SCALE_INDEX] = 1.0
    weighted_blocks, weighted_targets = [], []
    for equations, bin_weights in zip(equations_by_motion, weights, strict=True):
        weight_root = np.sqrt(bin_weights)
        x, y = equations.unknown_coefficients.mean(axis=0), equations.torque_moments.mean(axis=0)
        if not is_estimated[SCALE_INDEX]:
            y = y - x[:, SCALE_INDEX]
        weighted_blocks += [
            weight_root[:, None] * x[:, is_estimated].real,
            weight_root[:, None] * x[:, is_estimated].imag,
        ]
        weighted_targets += [weight_root * y.real, weight_root * y.imag]
    equation_columns = np.concatenate(weighted_blocks)
    column_norms = np.maximum(np.linalg.norm(equation_columns, axis=0), np.finfo(float).tiny)
    solution[is_estimated] = (
        np.linalg.lstsq(
            equation_columns / column_norms, np.concatenate(weighted_targets), rcond=None
        )[0]
        / column_norms
    )
    return solution


def _inverse_variances(
    residuals: Sequence[ComplexArray], repeated_motions: Sequence[_MotionRepeats]
) -> list[RealArray]:
    """Return the weight of each motion's mean equation at each frequency.

    A weight is the inverse variance of the mean of the repeats. The variance of single repeats is
    pooled over the stacks of a session, which have the same noise, and over neighbouring
    frequencies.
    """
    variances_by_session: dict[int, RealArray] = {}
    for session_number in {motion_repeats.session for motion_repeats in repeated_motions}:
        session_residuals = [
            r
            for r, s in zip(residuals, repeated_motions, strict=True)
            if s.session == session_number
        ]
        repeat_deviations = sum(
            np.sum(np.abs(r - r.mean(axis=0)) ** 2, axis=0) for r in session_residuals
        )
        bin_variances = np.asarray(repeat_deviations) / sum(len(r) - 1 for r in session_residuals)
        kernel_width = min(_SMOOTHED_BINS, bin_variances.size)
        smoothing_kernel = np.ones(kernel_width)
        edge_counts = np.convolve(np.ones(bin_variances.size), smoothing_kernel, "same")
        variances_by_session[session_number] = (
            np.convolve(bin_variances, smoothing_kernel, "same") / edge_counts
        )
    return [
        len(r) / np.maximum(variances_by_session[motion_repeats.session], np.finfo(float).tiny)
        for r, motion_repeats in zip(residuals, repeated_motions, strict=True)
    ]


def _finish_fit(
    equations_by_motion: Sequence[_MotionEquations],
    weights: Sequence[RealArray],
    residuals: Sequence[ComplexArray],
    is_estimated: NDArray[np.bool_],
    solution: RealArray,
    delay_s: float,
) -> _MotorFit:
    """Remove the bias that the noise causes from the solution, and estimate its uncertainty."""
    free_indices = np.flatnonzero(is_estimated)
    normal_matrix = np.zeros((free_indices.size, free_indices.size))
    noise_bias = np.zeros(free_indices.size)
    for equations, bin_weight, bin_residuals in zip(
        equations_by_motion, weights, residuals, strict=True
    ):
        repeat_count = len(equations.torque_moments)
        x = equations.unknown_coefficients[..., free_indices]
        mean_equation = x.mean(axis=0)
        normal_matrix += np.einsum(
            "mp,m,mq->pq", mean_equation.conj(), bin_weight, mean_equation
        ).real
        repeat_deviation = x - mean_equation
        bias_weight = bin_weight / (repeat_count * (repeat_count - 1))
        noise_bias += np.einsum(
            "rmp,m,rm->p", repeat_deviation.conj(), bias_weight, bin_residuals
        ).real
    inverse_matrix = np.linalg.inv(normal_matrix)

    # Each stack's part in the variance, from the scatter of its repeats' effects on the solution.
    variance_parts, stack_degrees_of_freedom = [], []
    weighted_squares, term_count = 0.0, 0
    friction_departure_nm = 0.0
    for equations, bin_weight, bin_residuals in zip(
        equations_by_motion, weights, residuals, strict=True
    ):
        repeat_count = len(equations.torque_moments)
        mean_equation = equations.unknown_coefficients[..., free_indices].mean(axis=0)
        noise_effects = (
            np.einsum("mp,m,rm->rp", mean_equation.conj(), bin_weight, bin_residuals).real
            @ inverse_matrix
        )
        variance_parts.append(noise_effects.var(axis=0, ddof=1) / repeat_count)
        stack_degrees_of_freedom.append(repeat_count - 1)
        mean_residual = bin_residuals.mean(axis=0)
        weighted_squares += float(np.sum(bin_weight * np.abs(mean_residual) ** 2))
        term_count += mean_residual.size
        constant_column = abs(equations.unknown_coefficients[0, 0, COULOMB_INDEX])
        friction_departure_nm = max(
            friction_departure_nm, abs(float(mean_residual[0].real)) / float(constant_column)
        )
    variances_by_motion = np.array(variance_parts)
    unknown_variances = variances_by_motion.sum(axis=0)
    degrees_of_freedom = unknown_variances**2 / np.sum(
        variances_by_motion**2 / np.array(stack_degrees_of_freedom)[:, None], axis=0
    )
    misfit = weighted_squares / max(1.0, term_count - 0.5 * free_indices.size)
    std_widening = (
        _STD_WIDENING_FACTOR * _student_factor(degrees_of_freedom) * sqrt(max(1.0, misfit))
    )

    unbiased_values, stds = solution.copy(), np.zeros(is_estimated.size)
    unbiased_values[free_indices] -= inverse_matrix @ noise_bias
    unbiased_values[DELAY_INDEX] += delay_s
    stds[free_indices] = std_widening * np.sqrt(unknown_variances)
    return _MotorFit(unbiased_values, stds, misfit, friction_departure_nm)


def _student_factor(degrees_of_freedom: RealArray) -> RealArray:
    """Return the ratio of Student's t to 3 at the probability of three standard deviations.

    It is exact to second order in the inverse degrees of freedom.
    """
    return 1.0 + (7.5 / degrees_of_freedom + 17.25 / degrees_of_freedom**2) / 3.0


# Estimate of a motor

MIN_REPEATS = 4
"""Smallest number of repeats of a motion; fewer do not determine the scatter."""

_MIN_SPEED_FRACTION = 0.1
"""Fraction of the nominal speed below which the shaft may have stood still."""
_HALF_SPEED_WINDOW_S = 0.01
"""Half the time in seconds over which the shaft's speed is measured to detect a standstill."""
_MAX_TORQUE_SCALE_STD = 0.05
"""Largest standard deviation of an accepted torque scale: the accuracy of a datasheet's value."""
_PLAUSIBLE_TORQUE_SCALES = (0.5, 2.0)
"""Smallest and largest plausible torque scale.

Without a beam, a scale of 0 with no inertia and no friction solves the equation, too."""


class MotorEstimateError(FailureError, ValueError):
    """Error if the windows do not determine the motor's data; the message states the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class PassReadings:
    """Readings in the evaluated window of a pass at constant nominal speed, n samples of each."""

    angle_rad: RealArray
    """Measured angle of the shaft."""
    torque_command_nm: RealArray
    """Commanded torque."""
    coupling_torque_nm: RealArray
    """Measured torque between motor and beam."""
    speed_rad_s: float
    """Nominal speed of the pass, with its sign."""
    highest_frequency_hz: float
    """Highest frequency of the motion."""
    session: int
    """Number of the session, since each session has its own zero of the torque."""
    motion_key: Hashable
    """Key of the motion: repeats of the same motion have equal keys."""


@dataclass(frozen=True, slots=True)
class MotorQuantity:
    """Estimated quantity of a motor with its standard deviation."""

    value: float
    """Estimate of the quantity; its assumed value if it was not estimated."""
    std: float | None
    """Standard deviation of the estimate, or None if the quantity was not estimated."""


@dataclass(frozen=True, slots=True)
class MotorEstimate:
    """Estimated parameters of a motor at its output shaft."""

    inertia_kg_m2: MotorQuantity
    """Inertia of the motor without the tool."""
    viscous_nm_s_per_rad: MotorQuantity
    """Viscous friction of the motor."""
    coulomb_nm: MotorQuantity
    """Coulomb friction of the motor."""
    torque_scale: MotorQuantity
    """Ratio of true to commanded torque.

    If it could not be estimated, it is 1 without a standard deviation, and the other quantities are
    relative to the torque as the drive states it."""
    actuation_delay_s: MotorQuantity
    """Delay from the command to the torque."""
    window_count: int
    """Number of windows in which the shaft never stood still."""
    dropped_window_count: int
    """Number of windows that were dropped because the shaft may have stood still."""
    misfit: float
    """Ratio of the residual's mean square to that expected from scatter; 1 if the equation holds.
    """
    friction_departure_nm: float
    """Largest departure of a pass's mean torque from viscous and Coulomb friction."""


def estimate_motor(
    windows: Sequence[PassReadings], timing: Timing, *, tool_inertia_kg_m2: float = 0.0
) -> MotorEstimate:
    """Estimate a motor's parameters from windows in which its speed does not change sign.

    Parameters
    ----------
    windows
        Windows of equal length; at least `MIN_REPEATS` of each key, and both directions.
    timing
        Timing of the readings. The windows determine only the delay from command to measured angle,
        from which the angle's own delay is subtracted.
    tool_inertia_kg_m2
        Inertia between sensor and beam. It makes the coupling torque jump with each command. The
        moment within a period at which the sensor measures the jump is unknown, which widens the
        standard deviation of the delay.

    Returns
    -------
    MotorEstimate
        Estimates with standard deviations. These follow from the scatter between repeats, and are
        widened for the number of repeats (so that an interval of three of them has a probability of
        99.7 %), for the part of the readings that the equation does not explain, and by a margin.

    Raises
    ------
    MotorEstimateError
        If there are too few windows, or the fit does not converge.
    """
    moving_windows = [
        pass_readings
        for pass_readings in windows
        if _moves_throughout(pass_readings, timing.rate_hz)
    ]
    repeated_motions = _group_repeats(moving_windows, len(windows))
    motor_fit = _fit_equation(repeated_motions, timing, fixes_torque_scale=False)
    is_scale_known = (
        motor_fit is not None
        and motor_fit.unknown_stds[SCALE_INDEX] < _MAX_TORQUE_SCALE_STD
        and _PLAUSIBLE_TORQUE_SCALES[0]
        < motor_fit.unknown_values[SCALE_INDEX]
        < _PLAUSIBLE_TORQUE_SCALES[1]
    )
    if not is_scale_known:
        motor_fit = _fit_equation(repeated_motions, timing, fixes_torque_scale=True)
    if motor_fit is None:
        raise MotorEstimateError(
            "The motor's data are not identifiable from the record: the fit does not converge. "
            "Check actuation.delay_s of the profile, from which the search begins, and the "
            "record."
        )
    fitted_values, stds = motor_fit.unknown_values, motor_fit.unknown_stds
    inertia_kg_m2 = float(fitted_values[INERTIA_INDEX])
    if inertia_kg_m2 <= 0.0:
        raise MotorEstimateError(
            f"The fit ends at an inertia of {inertia_kg_m2:.3g} kg·m²: the record does not show "
            "the motor's own motion. Check sensor.projection, encoder.delay_s and sensor.delay_s."
        )
    torque_jump_fraction = tool_inertia_kg_m2 / (inertia_kg_m2 + tool_inertia_kg_m2)
    jump_instant_std_s = torque_jump_fraction / timing.rate_hz / sqrt(12.0)
    return MotorEstimate(
        inertia_kg_m2=MotorQuantity(inertia_kg_m2, float(stds[INERTIA_INDEX])),
        viscous_nm_s_per_rad=MotorQuantity(
            float(fitted_values[VISCOUS_INDEX]), float(stds[VISCOUS_INDEX])
        ),
        coulomb_nm=MotorQuantity(float(fitted_values[COULOMB_INDEX]), float(stds[COULOMB_INDEX])),
        torque_scale=MotorQuantity(
            float(fitted_values[SCALE_INDEX]), float(stds[SCALE_INDEX]) if is_scale_known else None
        ),
        actuation_delay_s=MotorQuantity(
            float(fitted_values[DELAY_INDEX]) - timing.angle_delay_s,
            sqrt(float(stds[DELAY_INDEX]) ** 2 + jump_instant_std_s**2),
        ),
        window_count=len(moving_windows),
        dropped_window_count=len(windows) - len(moving_windows),
        misfit=motor_fit.misfit,
        friction_departure_nm=motor_fit.friction_departure_nm,
    )


def _moves_throughout(pass_readings: PassReadings, rate_hz: float) -> bool:
    """Return whether the shaft moves in the nominal direction during the whole window."""
    half_window_ticks = max(1, round(_HALF_SPEED_WINDOW_S * rate_hz))
    angle_rad = pass_readings.angle_rad
    speed_rad_s = (
        (angle_rad[2 * half_window_ticks :] - angle_rad[: -2 * half_window_ticks])
        * rate_hz
        / (2 * half_window_ticks)
    )
    forward_speed_rad_s = speed_rad_s * np.sign(pass_readings.speed_rad_s)
    return bool(np.min(forward_speed_rad_s) > _MIN_SPEED_FRACTION * abs(pass_readings.speed_rad_s))


def _group_repeats(windows: Sequence[PassReadings], window_count: int) -> list[_MotionRepeats]:
    """Group windows into stacks of repeats, or raise MotorEstimateError if there are too few.

    `window_count` is the number of windows before those with a standstill were removed.
    """
    windows_by_motion: dict[Hashable, list[PassReadings]] = {}
    for pass_readings in windows:
        windows_by_motion.setdefault(pass_readings.motion_key, []).append(pass_readings)
    complete_groups = [
        repeat_group
        for repeat_group in windows_by_motion.values()
        if len(repeat_group) >= MIN_REPEATS
    ]
    if {np.sign(repeat_group[0].speed_rad_s) for repeat_group in complete_groups} != {1.0, -1.0}:
        raise MotorEstimateError(
            f"Too few passes: {len(windows)} of {window_count} have neither gaps nor a standstill, "
            f"but an estimate takes at least {MIN_REPEATS} of the same kind in each direction."
        )
    session_index_by_number = {
        session_number: session_index
        for session_index, session_number in enumerate(
            sorted({repeat_group[0].session for repeat_group in complete_groups})
        )
    }
    return [
        _MotionRepeats(
            np.array([pass_readings.angle_rad for pass_readings in repeat_group]),
            np.array([pass_readings.torque_command_nm for pass_readings in repeat_group]),
            np.array([pass_readings.coupling_torque_nm for pass_readings in repeat_group]),
            float(np.sign(repeat_group[0].speed_rad_s)),
            repeat_group[0].highest_frequency_hz,
            session_index_by_number[repeat_group[0].session],
        )
        for repeat_group in complete_groups
    ]
