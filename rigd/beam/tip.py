"""Motion of the beam's free end, predicted from the motor's angle.

The boundary value problem of the beam, clamped on the shaft and free at its tip, gives the tip's
displacement and slope per motor angle, with ``z = beta L`` as in `rigd.beam._model`::

    Y(L)  = L (sin z + sinh z) / (z (1 + cos z cosh z))
    Y'(L) = (cos z + cosh z) / (1 + cos z cosh z)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.beam._causal_transform import CausalTransform, fast_transform_length
from rigd.beam._plant import Plant

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

SMALL_TIP_SLOPE_RAD = 0.14
"""Largest slope of the tip relative to the root, in rad, for which the linear model holds.

No part of a clamped beam slopes more than its tip. In the first mode this is a deflection of 10 %
of the length, in the second of 3 %. The error of the linear model grows with the square: the tip
approaches the axis by up to a third of the squared slope, as a fraction of the length: here 0.6 %.
Curvature and inertia differ from the linear ones by similar fractions, about the accuracy of a
careful session.
"""

_EXTENDED_RECORD_RATIO = 1.125
"""Length of the extended record relative to the record."""
_TRANSFORM_DECAY_EXPONENT = 7.0
"""Exponent of the transform's damping."""
_MAX_CHUNK_SAMPLES = 720_000
"""Maximum number of samples whose motion is computed at once. A longer record is divided into
chunks, each with the motion before it that the beam still remembers, because an hour at 1 kHz would
take 0.3 GB."""
_NEGLIGIBLE_DECAY_EXPONENT = 12.0
"""Exponent of the decay after which earlier motion is neglected: exp(-12)."""
_SEARCHED_MODE_COUNT = 3
"""Number of modes, from the first on, among which the slowest decay is searched for."""
_FREQUENCIES_PER_BLOCK = 1 << 15
"""Number of frequencies evaluated at once: those of an hour at 1 kHz would take a gigabyte."""


def linear_model_error(slope_rad: float) -> float:
    """Return an upper bound of the linear model's relative error for a slope of the tip.

    Parameters
    ----------
    slope_rad
        Largest slope of the tip relative to the root.

    Returns
    -------
    float
        A third of the slope squared: see `SMALL_TIP_SLOPE_RAD`. The model is useless if it is 1 or
        more.

    Examples
    --------
    >>> from rigd.beam.tip import linear_model_error
    >>> print(f"{100 * linear_model_error(0.6):.0f} %")
    12 %
    """
    return slope_rad * slope_rad / 3.0  # infinite, not an error, for an absurd slope


@dataclass(frozen=True, slots=True)
class TipMotion:
    """Largest deflection, slope and speed of the beam's tip during a motion."""

    deflection_m: float
    """Largest distance of the tip from the tangent at the root."""
    slope_rad: float
    """Largest slope of the tip relative to the tangent at the root."""
    speed_m_s: float
    """Largest speed of the tip in still air, including the rotation of the root."""


def tip_motion(plant: Plant, angle_rad: RealArray, rate_hz: float) -> TipMotion:
    """Predict the tip's largest deflection, slope and speed from a record of the motor angle.

    Parameters
    ----------
    plant
        Beam with its damping and ends, without air drag.
    angle_rad
        Motor angle from rest, shape (n,).
    rate_hz
        Sampling rate of the angle.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, Plant
    >>> from rigd.beam.tip import tip_motion
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> angle_rad = 0.02 * np.sin(2 * np.pi * np.arange(5000) / 1000)
    >>> motion = tip_motion(Plant(beam, Damping(zeta=7e-5)), angle_rad, rate_hz=1000)
    >>> print(f"{1e3 * motion.deflection_m:.1f} mm, {motion.slope_rad:.4f} rad")
    14.2 mm, 0.0201 rad
    """
    if angle_rad.size <= _MAX_CHUNK_SAMPLES:
        return _tip_motion_from_rest(plant, angle_rad - angle_rad[0], rate_hz)
    lead_in_samples = _memory_samples(plant, rate_hz)
    chunk_length = max(_MAX_CHUNK_SAMPLES - lead_in_samples, _MAX_CHUNK_SAMPLES // 2)
    largest_motion = np.zeros(3)
    for chunk_begin in range(0, angle_rad.size, chunk_length):
        lead_in_begin = max(chunk_begin - lead_in_samples, 0)
        chunk_angle_rad = (
            angle_rad[lead_in_begin : chunk_begin + chunk_length] - angle_rad[lead_in_begin]
        )
        if lead_in_begin:  # no jump of the speed, which would let the beam ring
            chunk_angle_rad[: lead_in_samples // 4] *= 0.5 - 0.5 * np.cos(
                np.linspace(0, np.pi, lead_in_samples // 4)
            )
        motion = _tip_motion_from_rest(plant, chunk_angle_rad, rate_hz, chunk_begin - lead_in_begin)
        largest_motion = np.maximum(
            largest_motion, [motion.deflection_m, motion.slope_rad, motion.speed_m_s]
        )
    return TipMotion(*largest_motion.tolist())


def _memory_samples(plant: Plant, rate_hz: float) -> int:
    """Return the number of samples after which a free decay of the beam is negligible."""
    decay_rates_per_s = [-pole.at_rad_s.real for pole in plant.mode_poles(_SEARCHED_MODE_COUNT)]
    slowest_decay_per_s = min([rate for rate in decay_rates_per_s if rate > 0], default=0.0)
    max_memory_s = _MAX_CHUNK_SAMPLES / 2 / rate_hz
    memory_s = (
        _NEGLIGIBLE_DECAY_EXPONENT / slowest_decay_per_s if slowest_decay_per_s else max_memory_s
    )
    return int(min(memory_s, max_memory_s) * rate_hz)


def _tip_motion_from_rest(
    plant: Plant, angle_rad: RealArray, rate_hz: float, first_sample: int = 0
) -> TipMotion:
    """Return the tip's largest motion from `first_sample` on, for an angle from rest at 0."""
    n = angle_rad.size
    transform = CausalTransform(
        fast_transform_length(int(np.ceil(_EXTENDED_RECORD_RATIO * n))),
        rate_hz,
        _TRANSFORM_DECAY_EXPONENT,
    )
    s = transform.s
    # The angle stays at its final value: a jump back would ring at the last samples.
    deflection_spectrum = transform.forward(angle_rad, holds_last_value=True)
    tip_slope, tip_speed = np.empty((2, s.size), dtype=np.complex128)
    # Block by block and without copies: these arrays have the record's length.
    for block_start in range(0, s.size, _FREQUENCIES_PER_BLOCK):
        block_slice = slice(block_start, block_start + _FREQUENCIES_PER_BLOCK)
        angle_spectrum = deflection_spectrum[block_slice].copy()
        root_angle_spectrum: ComplexArray = (
            angle_spectrum  # turns like the motor, except for a compliant clamp
        )
        tip_displacement, slope_per_angle = plant.tip_response(s[block_slice])
        if plant.root_compliance_rad_per_nm:
            root_angle_spectrum = angle_spectrum * (
                1 - plant.root_compliance_rad_per_nm * plant.transfer(s[block_slice])
            )
        deflection_spectrum[block_slice] = tip_displacement * angle_spectrum
        tip_slope[block_slice] = slope_per_angle * angle_spectrum
        tip_speed[block_slice] = s[block_slice] * (
            deflection_spectrum[block_slice] + plant.beam.length_m * root_angle_spectrum
        )

    def largest_magnitude(spectrum: ComplexArray) -> float:
        motion = transform.inverse(spectrum, slice(first_sample, n))
        return float(max(motion.max(), -motion.min()))  # NaN stays NaN

    return TipMotion(
        deflection_m=largest_magnitude(deflection_spectrum),
        slope_rad=largest_magnitude(tip_slope),
        speed_m_s=largest_magnitude(tip_speed),
    )
