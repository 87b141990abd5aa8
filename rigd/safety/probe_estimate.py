"""Estimate of scales and friction from the record of a probing move, and its assessment."""

from dataclasses import asdict, dataclass, replace
from math import hypot, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from rigd.beam import transfer
from rigd.safety.probing_move import ProbedRig, ProbeEnd, ProbingMove

Real = NDArray[np.float64]

RATIO_BAND = (0.7, 1.42)
"""Accepted ratios: half-way between 25 %, which is usual, and 50 % too much or too little."""
WARNING_BAND = (0.8, 1.25)
"""Ratios beyond which there is a warning."""

_FREQUENCY_FACTORS = tuple(float(x) for x in np.linspace(0.9, 1.1, 21))
"""Candidate factors on the beam's frequencies: a stiffer beam must not count as a wrong scale."""
_SMOOTH_S = 0.008
"""Standard deviation of the window that smooths all signals."""
_LEAST_SPEED_PART = 0.1
"""Fraction of the largest speed below which friction has no certain sign."""
_LEAST_SAMPLES = 50
_TOP_HZ = 100.0
"""Frequency above which that window passes nothing."""
_DECAY = 12.0
_WORST_CONDITION = 1e6
_LARGEST_STD = 0.1
"""Relative uncertainty of a ratio beyond which it counts as unknown."""
_SAME_FACTOR = 1.3
"""Factor up to which two ratios count as the same."""
_NOTHING = 0.15
"""Fraction of the beam's torque below which the sensor counts as showing none."""
_REMEDY = (
    "Correct the profile or the rig. A value that was measured by other means and is marked "
    'source = "measured" (docs/safety.md) is not probed.'
)


@dataclass(frozen=True, slots=True)
class ProbeEstimate:
    """Scales and friction estimated from a probing move, in the profile's units."""

    coupling_ratio: float | None
    """Coupling torque over that of the profile's beam at the measured angle; None: unknown."""
    coupling_std: float | None
    """Its standard deviation."""
    torque_ratio: float | None
    """Torque of the motor, relative to the sensor, over the torque commanded; None: unknown."""
    torque_std: float | None
    """Its standard deviation."""
    inertia_ratio: float | None
    """Inertia that this torque accelerates, over the profile's; None: unknown."""
    inertia_std: float | None
    """Its standard deviation."""
    coulomb_nm: float | None
    """Coulomb friction."""
    viscous_nm_s_per_rad: float | None
    """Viscous friction."""
    travel_rad: float
    """Range of the measured angle."""
    speed_rad_s: float
    """Largest measured speed."""

    def as_dict(self) -> dict[str, float | None]:
        """Return the numbers by name for documents."""
        return asdict(self)


def estimate_probe(rig: ProbedRig, move: ProbingMove) -> ProbeEstimate:
    """Estimate the ratios and the friction from the record of a move.

    Parameters
    ----------
    rig
        Data of the profile.
    move
        The move, after its end.
    """
    angle = np.array(move.angles_rad)
    window = _window(rig.rate_hz)
    if angle.size < window.size + _LEAST_SAMPLES:
        return ProbeEstimate(*(None,) * 8, travel_rad=float(np.ptp(angle)), speed_rad_s=0.0)

    def smooth(signal: Real) -> Real:
        return np.convolve(signal, window, "valid")

    speed = np.gradient(smooth(angle)) * rig.rate_hz
    acceleration = np.gradient(speed) * rig.rate_hz
    fastest = float(np.max(np.abs(speed)))
    ratio, ratio_std, beam_nm = _coupling_ratio(
        rig, angle, smooth(np.array(move.coupling_nm)), window
    )
    late = max(0, round(rig.command_delay_s * rig.rate_hz))
    command = np.concatenate([np.zeros(late), move.torques_nm])[: angle.size]
    moving: NDArray[np.bool_] = np.abs(speed) > _LEAST_SPEED_PART * fastest
    found = _motor(smooth(command), acceleration, speed, beam_nm, moving, window.size)
    scale, scale_std, inertia, inertia_std, coulomb, viscous = found
    if ratio and ratio_std and scale and scale_std and inertia and inertia_std:
        # Both uncertainties enter the fitted torque of the beam.
        part = ratio_std / ratio
        scale_std = hypot(scale_std, part * scale)
        inertia_std = hypot(inertia_std, part * inertia)
    return ProbeEstimate(
        ratio,
        ratio_std,
        scale,
        scale_std,
        None if inertia is None else inertia / rig.inertia_kg_m2,
        None if inertia_std is None else inertia_std / rig.inertia_kg_m2,
        coulomb,
        viscous,
        float(np.ptp(angle)),
        fastest,
    )


def _window(rate_hz: float) -> Real:
    """Return a window of unit sum and odd length, at least three ticks wide."""
    spread = max(1.0, _SMOOTH_S * rate_hz)
    half = int(3.0 * spread)
    weights: Real = np.exp(-0.5 * (np.arange(-half, half + 1) / spread) ** 2)
    weights /= weights.sum()
    return weights


def _coupling_ratio(
    rig: ProbedRig, angle: Real, measured: Real, window: Real
) -> tuple[float | None, float | None, Real]:
    """Fit the coupling torque by that of the beam at the measured angle.

    Returns the ratio, its standard deviation, and the fitted coupling torque without noise.
    """
    best: tuple[float, float, float, Real] | None = None
    for beam_nm in _beam_torques(rig, angle):
        expected = np.convolve(beam_nm, window, "valid")
        squares = float(expected @ expected)
        if squares == 0.0:
            continue
        ratio = float(expected @ measured) / squares
        left = float(np.sum((measured - ratio * expected) ** 2))
        if best is None or left < best[0]:
            # Smoothed samples within a window are not independent.
            variance = left / expected.size * _correlated(window) / squares
            best = left, ratio, sqrt(variance), ratio * expected
    return (None, None, np.zeros_like(measured)) if best is None else best[1:]


def _correlated(window: Real) -> float:
    """Return the number of smoothed samples of white noise that count as one."""
    return 1.0 / float(window @ window)


def _beam_torques(rig: ProbedRig, angle: Real) -> Real:
    """Return the exact beam's torque at the measured angle, for each frequency factor: (f, n)."""
    n = angle.size
    padded = 1 << (2 * n - 1).bit_length()
    # On s = sigma + j omega the wrap-around has decayed.
    sigma = _DECAY * rig.rate_hz / padded
    frequency_hz = np.fft.rfftfreq(padded, 1.0 / rig.rate_hz)
    inside = frequency_hz <= _TOP_HZ
    s = sigma + 2j * pi * frequency_hz[inside]
    growth = np.exp(sigma * np.arange(padded) / rig.rate_hz)
    held = np.full(padded, angle[-1])
    held[:n] = angle
    turned = np.fft.rfft(held / growth)[inside]
    result = np.empty((len(_FREQUENCY_FACTORS), n))
    spectrum = np.zeros(frequency_hz.size, dtype=np.complex128)
    for row, factor in zip(result, _FREQUENCY_FACTORS, strict=True):
        stiffness = rig.beam.bending_stiffness_n_m2 * factor**2
        beam = replace(rig.beam, bending_stiffness_n_m2=stiffness)
        response = transfer(s, beam, rig.damping) + rig.tool_inertia_kg_m2 * s * s
        spectrum[inside] = response * turned
        row[:] = (np.fft.irfft(spectrum, padded) * growth)[:n]
    return result


def _motor(
    command: Real,
    acceleration: Real,
    speed: Real,
    beam_nm: Real,
    moving: NDArray[np.bool_],
    width: float,
) -> tuple[float | None, ...]:
    """Fit the motor's equation to the samples in which the shaft moves.

    Returns torque scale, inertia, each with its standard deviation, Coulomb and viscous friction;
    None: unknown.
    """
    columns = np.stack([beam_nm, acceleration, np.sign(speed), speed], axis=1)[moving]
    size = np.linalg.norm(columns, axis=0)
    if len(columns) < 2 * _LEAST_SAMPLES or not size.all():
        return (None,) * 6
    columns = columns / size
    normal = columns.T @ columns
    if np.linalg.cond(normal) > _WORST_CONDITION:
        return (None,) * 6
    inverse = np.linalg.inv(normal)
    solution = inverse @ (columns.T @ command[moving])
    left = command[moving] - columns @ solution
    variance = float(left @ left) / len(left) * width * np.diag(inverse)
    per_scale, inertia, coulomb, viscous = (solution / size).tolist()
    per_scale_std, inertia_std = (np.sqrt(variance) / size)[:2].tolist()
    if per_scale <= 0.0:
        return (None,) * 6
    scale = 1.0 / per_scale
    part = per_scale_std * scale
    return (
        scale,
        part * scale,
        inertia * scale,
        scale * sqrt(inertia_std**2 + (inertia * part) ** 2),
        coulomb * scale,
        viscous * scale,
    )


# Assessment


def contradiction(
    rig: ProbedRig, end: ProbeEnd | None, estimate: ProbeEstimate, *, motor: bool = True
) -> str:
    """Return a contradiction in a probing move, for the operator; empty if there is none.

    Parameters
    ----------
    rig
        Data of the profile.
    end
        Reason for the end of the move.
    estimate
        From `estimate_probe`.
    motor
        Whether to check the motor's torque and inertia too, not only the quantities on which the
        bounds of travel and speed depend.
    """
    found = _of_motion(rig, end)
    if not found and (end is ProbeEnd.PULLED or not _accepted(estimate.coupling_ratio)):
        found = _of_coupling(estimate, motor=motor)
    if not found and motor:
        found = _of_motor(estimate)
    if not found and end is ProbeEnd.AWAY and motor:
        found = (
            f"The shaft left the bounds of the probing move after {estimate.travel_rad:.2g} rad at "
            f"up to {estimate.speed_rad_s:.2g} rad/s: check motor.inertia_kg_m2, "
            "motor.rated_torque_nm and encoder.resolution_rad."
        )
    return f"Probing move: {found} {_REMEDY}" if found else ""


def doubts(estimate: ProbeEstimate) -> list[str]:
    """Return a warning for each accepted but unusual ratio."""
    low, high = WARNING_BAND
    return [
        f"Probing move: {what} is {ratio:.2f} times what the profile states ({keys})."
        for what, ratio, keys in (
            ("the beam's torque at the measured angle", estimate.coupling_ratio, _SCALES),
            ("the motor's torque", estimate.torque_ratio, "motor.rated_torque_nm"),
            ("the motor's inertia", estimate.inertia_ratio, "motor.inertia_kg_m2"),
        )
        if ratio is not None and not low <= ratio <= high
    ]


_SCALES = "encoder.resolution_rad, sensor.projection and calibration, [beam]"


def _accepted(ratio: float | None) -> bool:
    low, high = RATIO_BAND
    return ratio is not None and low <= ratio <= high


def _of_motion(rig: ProbedRig, end: ProbeEnd | None) -> str:
    """Describe a shaft that moves the wrong way or, as measured, not at all."""
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


def _of_coupling(estimate: ProbeEstimate, *, motor: bool) -> str:
    ratio, std = estimate.coupling_ratio, estimate.coupling_std
    if ratio is None or std is None:
        return f"the coupling torque is not the beam's at the measured angle ({_SCALES})."
    if abs(ratio) < _NOTHING:
        if not motor:
            return ""  # no antenna: the shaft moves no farther than the encoder shows
        return (
            f"the coupling torque is {ratio:.2f} times that of the profile's beam at the measured "
            "angle. Check that the antenna is mounted and the sensor works, and "
            "encoder.resolution_rad."
        )
    if not motor and 0.0 < ratio < 1.0:
        return ""  # the shaft moves less than the encoder shows: its bounds hold
    size = f"{ratio:.2g} ± {std:.1g}"
    if ratio < 0.0:
        return (
            f"the coupling torque is {size} times that of the profile's beam at the measured "
            "angle: it has the wrong sign (sensor.projection, mounting of the sensor)."
        )
    return (
        f"the coupling torque is {size} times that of the profile's beam at the measured angle: "
        f"{_likely_cause(estimate, ratio)}."
    )


def _likely_cause(estimate: ProbeEstimate, ratio: float) -> str:
    scale, inertia = estimate.torque_ratio, estimate.inertia_ratio
    if scale is None or inertia is None:
        return f"one of {_SCALES} is wrong by that ratio"
    if _same(scale, 1.0) and _same(inertia, ratio):
        return (
            "the motor's inertia shows the same ratio, so encoder.resolution_rad is probably too "
            f"{'small' if ratio > 1.0 else 'large'} by it"
        )
    if _same(scale, ratio):
        return (
            "the motor's torque shows the same ratio, so the sensor's calibration or "
            "sensor.projection is probably wrong by it"
        )
    if _same(scale, 1.0) and _same(inertia, 1.0):
        return "the motor agrees, so the data of the beam are probably wrong by it"
    return f"one of {_SCALES} is wrong by that ratio"


def _of_motor(estimate: ProbeEstimate) -> str:
    rows = (
        ("the motor exerts", estimate.torque_ratio, estimate.torque_std,
         "the torque commanded (motor.rated_torque_nm, or the drive's rated torque)"),
        ("the motor has", estimate.inertia_ratio, estimate.inertia_std,
         "the inertia of the profile (motor.inertia_kg_m2)"),
    )  # fmt: skip
    unknown = []
    for verb, ratio, std, what in rows:
        if ratio is None or std is None:
            unknown.append(what)
        elif not _accepted(ratio):
            return f"{verb} {ratio:.2g} ± {std:.1g} times {what}."
        elif std > _LARGEST_STD * ratio:
            unknown.append(what)
    if unknown:
        return f"it could not be determined how far the motor agrees with {' and '.join(unknown)}."
    return ""


def _same(first: float, second: float) -> bool:
    return first > 0.0 < second and abs(log(first / second)) < log(_SAME_FACTOR)
