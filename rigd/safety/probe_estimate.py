"""Estimate of scales and friction from the record of a probing move, and its assessment."""

from dataclasses import asdict, dataclass, replace
from math import hypot, log, sqrt

import numpy as np
from numpy.typing import NDArray

from rigd.beam import CausalTransform, transfer
from rigd.safety.probing_move import ProbedRig, ProbeEnd, ProbingMove

RealArray = NDArray[np.float64]

RATIO_BAND = (0.7, 1.42)
"""Smallest and largest accepted ratio of a measured scale or inertia to the profile's value.

They are half-way between 25 %, which is usual, and 50 % too much or too little."""
WARNING_BAND = (0.8, 1.25)
"""Ratios of a measured scale or inertia to the profile's value outside of which there is a warning.
"""

_FREQUENCY_FACTORS = tuple(float(x) for x in np.linspace(0.9, 1.1, 21))
"""Candidate factors by which the beam's frequencies are multiplied in the estimate.

Without them a stiffer beam would count as a wrong scale."""
_SMOOTHING_STD_S = 0.008
"""Standard deviation in seconds of the Gaussian window that smooths all signals."""
_MIN_SPEED_FRACTION = 0.1
"""Fraction of the largest speed below which the sign of the friction is uncertain."""
_MIN_SAMPLE_COUNT = 50
"""Smallest number of samples of an estimate; the motor's equation requires twice as many."""
_WINDOW_CUTOFF_HZ = 100.0
"""Frequency in Hz above which the smoothing window passes nothing."""
_TRANSFORM_DECAY_EXPONENT = 12.0
"""Exponent of the transform's damping."""
_MAX_CONDITION_NUMBER = 1e6
"""Largest condition number of the normal equations that gives an estimate."""
_MAX_RELATIVE_STD = 0.1
"""Relative standard deviation of a ratio above which it counts as unknown."""
_SAME_RATIO_FACTOR = 1.3
"""Factor by which two ratios may differ and still count as the same."""
_NO_TORQUE_RATIO = 0.15
"""Ratio of measured torque to beam's torque below which the sensor counts as dead."""
_MEASURED_VALUE_ADVICE = (
    'A value that was measured by other means and is marked source = "measured" (docs/safety.md) '
    "is not probed."
)
_CONTRADICTION_ADVICE = f"Correct the profile or the rig. {_MEASURED_VALUE_ADVICE}"
_UNDETERMINED_ADVICE = (
    "Start the session again while the computer does nothing else: late ticks, for example, make "
    f"the estimate uncertain. {_MEASURED_VALUE_ADVICE}"
)


@dataclass(frozen=True, slots=True)
class ProbeEstimate:
    """Scales and friction estimated from a probing move, relative to the profile's values."""

    coupling_ratio: float | None
    """Ratio of the measured coupling torque to that of the profile's beam at the measured angle.

    None if it is unknown."""
    coupling_std: float | None
    """Standard deviation of `coupling_ratio`, or None if it is unknown."""
    torque_ratio: float | None
    """Ratio of the motor's torque, on the sensor's scale, to the commanded torque.

    None if it is unknown."""
    torque_std: float | None
    """Standard deviation of `torque_ratio`, or None if it is unknown."""
    inertia_ratio: float | None
    """Ratio of the motor's inertia to that of the profile, or None if it is unknown."""
    inertia_std: float | None
    """Standard deviation of `inertia_ratio`, or None if it is unknown."""
    coulomb_nm: float | None
    """Coulomb friction of the motor, or None if it is unknown."""
    viscous_nm_s_per_rad: float | None
    """Viscous friction of the motor, or None if it is unknown."""
    travel_rad: float
    """Range of the angle measured in the move."""
    speed_rad_s: float
    """Largest speed measured in the move."""

    def as_dict(self) -> dict[str, float | None]:
        """Return the fields of the estimate by name, for a JSON document."""
        return asdict(self)


def estimate_probe(rig: ProbedRig, move: ProbingMove) -> ProbeEstimate:
    """Estimate scales and friction of a rig from the record of its probing move.

    Parameters
    ----------
    rig
        Values of the profile that the move verifies.
    move
        Probing move that has ended.

    Returns
    -------
    ProbeEstimate
        Ratios of the measured values to those of the profile, and friction.
    """
    angle_rad = np.array(move.angles_rad)
    smoothing_window = _smoothing_window(rig.rate_hz)
    if angle_rad.size < smoothing_window.size + _MIN_SAMPLE_COUNT:
        return ProbeEstimate(*(None,) * 8, travel_rad=float(np.ptp(angle_rad)), speed_rad_s=0.0)

    def smooth(signal: RealArray) -> RealArray:
        return np.convolve(signal, smoothing_window, "valid")

    speed_rad_s = np.gradient(smooth(angle_rad)) * rig.rate_hz
    acceleration_rad_s2 = np.gradient(speed_rad_s) * rig.rate_hz
    max_speed_rad_s = float(np.max(np.abs(speed_rad_s)))
    coupling_ratio, ratio_std, beam_nm = _coupling_ratio(
        rig, angle_rad, smooth(np.array(move.coupling_nm)), smoothing_window
    )
    delay_ticks = max(0, round(rig.command_delay_s * rig.rate_hz))
    command_torque_nm = np.concatenate([np.zeros(delay_ticks), move.torques_nm])[: angle_rad.size]
    is_moving: NDArray[np.bool_] = np.abs(speed_rad_s) > _MIN_SPEED_FRACTION * max_speed_rad_s
    motor_fit = _fit_motor_equation(
        smooth(command_torque_nm),
        acceleration_rad_s2,
        speed_rad_s,
        beam_nm,
        is_moving,
        smoothing_window.size,
    )
    torque_scale, scale_std, inertia, inertia_std, coulomb_nm, viscous_nm_s_per_rad = motor_fit
    if coupling_ratio and ratio_std and torque_scale and scale_std and inertia and inertia_std:
        # Both uncertainties enter the fitted torque of the beam.
        relative_std = ratio_std / coupling_ratio
        scale_std = hypot(scale_std, relative_std * torque_scale)
        inertia_std = hypot(inertia_std, relative_std * inertia)
    return ProbeEstimate(
        coupling_ratio,
        ratio_std,
        torque_scale,
        scale_std,
        None if inertia is None else inertia / rig.inertia_kg_m2,
        None if inertia_std is None else inertia_std / rig.inertia_kg_m2,
        coulomb_nm,
        viscous_nm_s_per_rad,
        float(np.ptp(angle_rad)),
        max_speed_rad_s,
    )


def _smoothing_window(rate_hz: float) -> RealArray:
    """Return the Gaussian smoothing window, of unit sum, odd length and at least three ticks."""
    window_std_ticks = max(1.0, _SMOOTHING_STD_S * rate_hz)
    half_width = int(3.0 * window_std_ticks)
    window_weights: RealArray = np.exp(
        -0.5 * (np.arange(-half_width, half_width + 1) / window_std_ticks) ** 2
    )
    window_weights /= window_weights.sum()
    return window_weights


def _coupling_ratio(
    rig: ProbedRig, angle_rad: RealArray, measured_torque_nm: RealArray, smoothing_window: RealArray
) -> tuple[float | None, float | None, RealArray]:
    """Fit the measured coupling torque by the torque of the profile's beam at the measured angle.

    Returns the ratio of measured to expected torque, its standard deviation, and the fitted
    coupling torque in N·m without noise.
    """
    best_fit: tuple[float, float, float, RealArray] | None = None
    for beam_nm in _beam_torques(rig, angle_rad):
        expected_torque_nm = np.convolve(beam_nm, smoothing_window, "valid")
        torque_squares = float(expected_torque_nm @ expected_torque_nm)
        if torque_squares == 0.0:
            continue
        coupling_ratio = float(expected_torque_nm @ measured_torque_nm) / torque_squares
        residual_squares_nm2 = float(
            np.sum((measured_torque_nm - coupling_ratio * expected_torque_nm) ** 2)
        )
        if best_fit is None or residual_squares_nm2 < best_fit[0]:
            # Smoothed samples within a window are not independent.
            ratio_variance = (
                residual_squares_nm2
                / expected_torque_nm.size
                * _samples_per_independent_sample(smoothing_window)
                / torque_squares
            )
            best_fit = (
                residual_squares_nm2,
                coupling_ratio,
                sqrt(ratio_variance),
                coupling_ratio * expected_torque_nm,
            )
    return (None, None, np.zeros_like(measured_torque_nm)) if best_fit is None else best_fit[1:]


def _samples_per_independent_sample(smoothing_window: RealArray) -> float:
    """Return the number of smoothed samples with the information of one independent sample."""
    return 1.0 / float(smoothing_window @ smoothing_window)


def _beam_torques(rig: ProbedRig, angle_rad: RealArray) -> RealArray:
    """Return the exact beam's torque in N·m at the measured angle, shape (factors, n).

    There is a row for each candidate factor of the beam's frequencies.
    """
    n = angle_rad.size
    transform = CausalTransform(
        1 << (2 * n - 1).bit_length(),
        rig.rate_hz,
        _TRANSFORM_DECAY_EXPONENT,
        highest_hz=_WINDOW_CUTOFF_HZ,
    )
    s = transform.s
    angle_spectrum = transform.forward(angle_rad, holds_last_value=True)
    torques_nm = np.empty((len(_FREQUENCY_FACTORS), n))
    for row, frequency_factor in zip(torques_nm, _FREQUENCY_FACTORS, strict=True):
        bending_stiffness_n_m2 = rig.beam.bending_stiffness_n_m2 * frequency_factor**2
        scaled_beam = replace(rig.beam, bending_stiffness_n_m2=bending_stiffness_n_m2)
        torque_per_angle = transfer(s, scaled_beam, rig.damping) + rig.tool_inertia_kg_m2 * s * s
        row[:] = transform.inverse(torque_per_angle * angle_spectrum, n)
    return torques_nm


def _fit_motor_equation(
    command_torque_nm: RealArray,
    acceleration_rad_s2: RealArray,
    speed_rad_s: RealArray,
    beam_torque_nm: RealArray,
    is_moving: NDArray[np.bool_],
    window_ticks: float,
) -> tuple[float | None, ...]:
    """Fit the motor's equation of motion to the samples in which the shaft moves.

    Returns the torque scale and its standard deviation, the inertia and its standard deviation,
    Coulomb and viscous friction. All are None if they cannot be estimated.
    """
    equation_columns = np.stack(
        [beam_torque_nm, acceleration_rad_s2, np.sign(speed_rad_s), speed_rad_s], axis=1
    )[is_moving]
    column_norms = np.linalg.norm(equation_columns, axis=0)
    if len(equation_columns) < 2 * _MIN_SAMPLE_COUNT or not column_norms.all():
        return (None,) * 6
    equation_columns = equation_columns / column_norms
    normal_matrix = equation_columns.T @ equation_columns
    if np.linalg.cond(normal_matrix) > _MAX_CONDITION_NUMBER:
        return (None,) * 6
    inverse_matrix = np.linalg.inv(normal_matrix)
    solution = inverse_matrix @ (equation_columns.T @ command_torque_nm[is_moving])
    residual_nm = command_torque_nm[is_moving] - equation_columns @ solution
    variances = (
        float(residual_nm @ residual_nm) / len(residual_nm) * window_ticks * np.diag(inverse_matrix)
    )
    per_scale, inertia, coulomb_nm, viscous_nm_s_per_rad = (solution / column_norms).tolist()
    per_scale_std, inertia_std = (np.sqrt(variances) / column_norms)[:2].tolist()
    if per_scale <= 0.0:
        return (None,) * 6
    torque_scale = 1.0 / per_scale
    relative_std = per_scale_std * torque_scale
    return (
        torque_scale,
        relative_std * torque_scale,
        inertia * torque_scale,
        torque_scale * sqrt(inertia_std**2 + (inertia * relative_std) ** 2),
        coulomb_nm * torque_scale,
        viscous_nm_s_per_rad * torque_scale,
    )


# Assessment


def contradiction(
    rig: ProbedRig, end: ProbeEnd | None, estimate: ProbeEstimate, *, with_motor: bool = True
) -> str:
    """Describe a contradiction between a probing move and the profile, for the operator.

    Parameters
    ----------
    rig
        Values of the profile that the move verifies.
    end
        Reason for the end of the move.
    estimate
        Estimate from the record of the move, as returned by `estimate_probe`.
    with_motor
        Whether to check the motor's torque and inertia too, not only the quantities on which the
        bounds of travel and speed depend.

    Returns
    -------
    str
        Message with advice, or an empty string if there is no contradiction.
    """
    description = _motion_contradiction(rig, end)
    if not description and (
        end is ProbeEnd.PULLED or not _is_ratio_accepted(estimate.coupling_ratio)
    ):
        description = _coupling_contradiction(estimate, with_motor=with_motor)
    if not description and with_motor:
        description = _motor_contradiction(estimate)
    if not description and end is ProbeEnd.AWAY and with_motor:
        description = (
            f"The shaft left the bounds of the probing move after {estimate.travel_rad:.2g} rad at "
            f"up to {estimate.speed_rad_s:.2g} rad/s: check motor.inertia_kg_m2, "
            "motor.rated_torque_nm and encoder.resolution_rad."
        )
    if description:
        return f"Probing move: {description} {_CONTRADICTION_ADVICE}"
    undetermined = _undetermined_motor(estimate) if with_motor else ""
    return f"Probing move: {undetermined} {_UNDETERMINED_ADVICE}" if undetermined else ""


def doubts(estimate: ProbeEstimate) -> list[str]:
    """Return a warning for each estimated ratio that is accepted but outside `WARNING_BAND`."""
    lowest_ratio, highest_ratio = WARNING_BAND
    return [
        f"Probing move: {quantity} is {ratio:.2f} times what the profile states ({profile_keys})."
        for quantity, ratio, profile_keys in (
            (
                "the beam's torque at the measured angle",
                estimate.coupling_ratio,
                _COUPLING_RATIO_KEYS,
            ),
            ("the motor's torque", estimate.torque_ratio, "motor.rated_torque_nm"),
            ("the motor's inertia", estimate.inertia_ratio, "motor.inertia_kg_m2"),
        )
        if ratio is not None and not lowest_ratio <= ratio <= highest_ratio
    ]


_COUPLING_RATIO_KEYS = "encoder.resolution_rad, sensor.projection and calibration, [beam]"
"""Keys of the profile on which the ratio of the coupling torques depends, for messages."""


def _is_ratio_accepted(ratio: float | None) -> bool:
    """Return whether a ratio is known and within `RATIO_BAND`."""
    lowest_ratio, highest_ratio = RATIO_BAND
    return ratio is not None and lowest_ratio <= ratio <= highest_ratio


def _motion_contradiction(rig: ProbedRig, end: ProbeEnd | None) -> str:
    """Describe a shaft or encoder that did not move or moved the wrong way; "" otherwise."""
    if end is ProbeEnd.REVERSED:
        return (
            "the encoder counts against the torque: one of both has the wrong sign. Check "
            "cia402.direction, the drive's polarity (object 607E) and the wiring of motor and "
            "encoder."
        )
    if end is ProbeEnd.BLOCKED:
        return (
            f"the encoder shows no motion, and the sensor no torque of the beam, at half the rated "
            f"torque ({0.5 * rig.rated_torque_nm:.3g} N·m). The shaft is blocked or its friction "
            "far above motor.coulomb_nm, or the motor is weaker than motor.rated_torque_nm says."
        )
    if end is ProbeEnd.STILL:
        return (
            "the encoder stands still while the coupling torque shows that the beam is moved. "
            "Check the encoder and its cable, then the sensor."
        )
    return ""


def _coupling_contradiction(estimate: ProbeEstimate, *, with_motor: bool) -> str:
    """Describe a coupling torque that contradicts the profile's beam, or return ""."""
    coupling_ratio, std = estimate.coupling_ratio, estimate.coupling_std
    if coupling_ratio is None or std is None:
        return (
            f"the coupling torque is not the beam's at the measured angle ({_COUPLING_RATIO_KEYS})."
        )
    if abs(coupling_ratio) < _NO_TORQUE_RATIO:
        if not with_motor:
            return ""  # no antenna: the shaft moves no farther than the encoder shows
        return (
            f"the coupling torque is {coupling_ratio:.2f} times that of the profile's beam at the "
            "measured angle. Check that the antenna is mounted and the sensor works, and "
            "encoder.resolution_rad."
        )
    if not with_motor and 0.0 < coupling_ratio < 1.0:
        return ""  # the shaft moves less than the encoder shows: its bounds hold
    ratio_text = f"{coupling_ratio:.2g} ± {std:.1g}"
    if coupling_ratio < 0.0:
        return (
            f"the coupling torque is {ratio_text} times that of the profile's beam at the measured "
            "angle. Its sign is wrong (sensor.projection, mounting of the sensor), or those of "
            "encoder and motor torque both are (cia402.direction)."
        )
    return (
        f"the coupling torque is {ratio_text} times that of the profile's beam at the measured "
        f"angle: {_likely_cause(estimate, coupling_ratio)}."
    )


def _likely_cause(estimate: ProbeEstimate, ratio: float) -> str:
    """Describe the probable cause of a wrong ratio of the coupling torques."""
    torque_ratio, inertia_ratio = estimate.torque_ratio, estimate.inertia_ratio
    if torque_ratio is None or inertia_ratio is None:
        return f"one of {_COUPLING_RATIO_KEYS} is wrong by that ratio"
    if _is_same_ratio(torque_ratio, 1.0) and _is_same_ratio(inertia_ratio, ratio):
        return (
            "the motor's inertia shows the same ratio, so encoder.resolution_rad is probably too "
            f"{'small' if ratio > 1.0 else 'large'} by it"
        )
    if _is_same_ratio(torque_ratio, ratio):
        return (
            "the motor's torque shows the same ratio, so the sensor's calibration or "
            "sensor.projection is probably wrong by it"
        )
    if _is_same_ratio(torque_ratio, 1.0) and _is_same_ratio(inertia_ratio, 1.0):
        return "the motor agrees, so the data of the beam are probably wrong by it"
    return f"one of {_COUPLING_RATIO_KEYS} is wrong by that ratio"


def _motor_contradiction(estimate: ProbeEstimate) -> str:
    """Describe a torque or inertia of the motor that contradicts the profile, or return ""."""
    for verb, ratio, std, quantity in _motor_ratios(estimate):
        if ratio is not None and std is not None and not _is_ratio_accepted(ratio):
            return f"the motor {verb} {ratio:.2g} ± {std:.1g} times {quantity}."
    return ""


def _undetermined_motor(estimate: ProbeEstimate) -> str:
    """Describe which properties of the motor the move did not determine, or return ""."""
    undetermined = [
        quantity
        for _, ratio, std, quantity in _motor_ratios(estimate)
        if ratio is None or std is None or std > _MAX_RELATIVE_STD * ratio
    ]
    if not undetermined:
        return ""
    return f"it could not be determined whether the motor agrees with {' and '.join(undetermined)}."


def _motor_ratios(
    estimate: ProbeEstimate,
) -> tuple[tuple[str, float | None, float | None, str], ...]:
    """Return verb, ratio, its standard deviation and quantity of the profile for messages."""
    return (
        ("exerts", estimate.torque_ratio, estimate.torque_std,
         "the torque commanded (motor.rated_torque_nm, or the drive's rated torque)"),
        ("has", estimate.inertia_ratio, estimate.inertia_std,
         "the inertia of the profile (motor.inertia_kg_m2)"),
    )  # fmt: skip


def _is_same_ratio(first_ratio: float, second_ratio: float) -> bool:
    """Return whether two ratios are positive and differ by less than `_SAME_RATIO_FACTOR`."""
    return first_ratio > 0.0 < second_ratio and abs(log(first_ratio / second_ratio)) < log(
        _SAME_RATIO_FACTOR
    )
