"""Motion of the beam's free end, predicted from the motor's angle.

The boundary value problem of the beam, clamped on the shaft and free at its tip, gives the tip's
displacement and slope over the angle, with ``z = beta L`` as in `rigd.beam._model`::

    Y(L)  = L (sin z + sinh z) / (z (1 + cos z cosh z))
    Y'(L) = (cos z + cosh z) / (1 + cos z cosh z)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.beam._model import Beam, Damping
from rigd.beam._tip_mass import LoadedBeam

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

SMALL_SLOPE_RAD = 0.14
"""Slope of the tip against the root up to which the linear model holds.

No part of a clamped beam slopes more than its tip. In the first mode this is a deflection of 10 %
of the length, in the second of 3 %. The error of the linear model grows with the square: the tip
approaches the axis by up to a third of it in lengths, here 0.6 %, and curvature and inertia differ
from the linear ones by fractions of that size, the accuracy of a careful session.
"""

_PADDED = 1.125
_DECAY = 7.0
_BLOCK = 1 << 15
"""Frequencies evaluated at once: an hour at 1 kHz would take a gigabyte."""


def linear_model_error(slope_rad: float) -> float:
    """Return a bound of the linear model's relative error, from the largest slope of the tip.

    Parameters
    ----------
    slope_rad
        Largest slope of the tip against the root.

    Returns
    -------
    float
        A third of the slope squared: see `SMALL_SLOPE_RAD`. From 1 on the model is useless.

    Examples
    --------
    >>> from rigd.beam.tip import linear_model_error
    >>> print(f"{100 * linear_model_error(0.6):.0f} %")
    12 %
    """
    return slope_rad * slope_rad / 3.0  # infinite, not an error, for an absurd slope


@dataclass(frozen=True, slots=True)
class TipMotion:
    """Largest motion of the free end."""

    deflection_m: float
    """Relative to the tangent at the root."""
    slope_rad: float
    """Relative to the same line."""
    speed_m_s: float
    """Through still air, including the rotation of the root."""


def tip_motion(
    beam: Beam,
    damping: Damping,
    angle_rad: Real,
    rate_hz: float,
    *,
    tip_mass_kg: float = 0.0,
    root_compliance_rad_per_nm: float = 0.0,
) -> TipMotion:
    """Predict the largest motion of the tip.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model, without air drag.
    angle_rad
        Motor angle from rest, shape (n,).
    rate_hz
        Samples a second.
    tip_mass_kg, root_compliance_rad_per_nm
        Point mass at the tip, and rotation of the clamp per torque.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping
    >>> from rigd.beam.tip import tip_motion
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> angle_rad = 0.02 * np.sin(2 * np.pi * np.arange(5000) / 1000)
    >>> motion = tip_motion(beam, Damping(zeta=7e-5), angle_rad, rate_hz=1000)
    >>> print(f"{1e3 * motion.deflection_m:.1f} mm, {motion.slope_rad:.4f} rad")
    14.2 mm, 0.0201 rad
    """
    n = angle_rad.size
    padded = _quick_length(int(np.ceil(_PADDED * n)))
    # On s = sigma + j omega the wrap-around has decayed.
    sigma = _DECAY * rate_hz / padded
    s = np.asarray(2j * np.pi * np.fft.rfftfreq(padded, 1 / rate_hz), np.complex128)
    s += sigma
    # The angle stays at its final value: a jump back would ring at the last samples.
    angle = np.full(padded, angle_rad[-1] - angle_rad[0])
    np.subtract(angle_rad, angle_rad[0], out=angle[:n])
    for start in range(0, padded, _BLOCK):
        ticks = np.arange(start, min(start + _BLOCK, padded))
        angle[start : start + _BLOCK] *= np.exp(-sigma * ticks / rate_hz)
    deflected = np.fft.rfft(angle)
    del angle
    sloped, speeding = np.empty((2, s.size), dtype=np.complex128)
    loaded = LoadedBeam(beam, damping, tip_mass_kg, root_compliance_rad_per_nm)
    # Block by block and without copies: these arrays have the record's length.
    for start in range(0, s.size, _BLOCK):
        some = slice(start, start + _BLOCK)
        turned = deflected[some].copy()
        root: Complex = turned  # turns like the motor, except for a compliant clamp
        if loaded.plain:
            displaced, slope = tip_response(beam, damping, s[some])
            displaced -= beam.length_m
            slope -= 1
        else:
            displaced, slope = loaded.tip_response(s[some])
            root = turned * (1 - root_compliance_rad_per_nm * loaded.transfer(s[some]))
        deflected[some] = displaced * turned
        sloped[some] = slope * turned
        speeding[some] = s[some] * (deflected[some] + beam.length_m * root)
    del s

    def largest(spectrum: Complex) -> float:
        motion = np.fft.irfft(spectrum, padded)[:n]
        peaks = []
        for start in range(0, n, _BLOCK):
            block = motion[start : start + _BLOCK]
            growth = np.exp(sigma * np.arange(start, start + block.size) / rate_hz)
            peaks.append(float(np.max(np.abs(block * growth))))
        return float(np.max(peaks))  # NaN stays NaN

    return TipMotion(
        deflection_m=largest(deflected), slope_rad=largest(sloped), speed_m_s=largest(speeding)
    )


def tip_response(beam: Beam, damping: Damping, s: Complex) -> tuple[Complex, Complex]:
    """Return the transfer functions from the angle to the tip's displacement and slope.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    s
        Laplace variable in rad/s, not 0.

    Returns
    -------
    displacement
        In m/rad, of the shape of `s`.
    slope
        Slope at the tip over the angle, dimensionless, same shape.
    """
    external = damping.gamma * s**damping.lambda_
    internal = 1 + damping.zeta * s**damping.alpha
    fourth = -(beam.density_over_stiffness * s * s + external) / internal
    z = beam.length_m * np.sqrt(np.sqrt(fourth))
    # Numerators and denominator over exp(z - j sign z): nothing overflows.
    sign = np.where(z.imag < 0, -1.0, 1.0)
    turn, fade = np.exp(1j * sign * z), np.exp(-z)
    a, b = fade * fade, turn * turn
    reciprocal = 1 / (4 * turn * fade + (1 + b) * (1 + a))
    sines = 2 * turn * (1 - a) + 2j * sign * fade * (1 - b)
    cosines = 2 * turn * (1 + a) + 2 * fade * (1 + b)
    displacement: Complex = beam.length_m * sines * reciprocal / z
    slope: Complex = cosines * reciprocal
    return displacement, slope


def _quick_length(least: int) -> int:
    """Return a length with a fast transform, at most an eighth above the least one."""
    unit = 1 << max(0, least.bit_length() - 4)
    return -(-least // unit) * unit
