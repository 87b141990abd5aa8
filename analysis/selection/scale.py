"""A sign reversed or a unit mistaken, from torque over angle against the beam that the file states.

The median over the band sees neither where the modes are exactly, nor how they are damped.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.selection.finding import Finding
from rigd.beam import Damping, transfer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.whole_record.comparison import Comparison

_LOSS_S: Final = 1e-4
"""Internal damping of order 1, in s: of some per cent, for want of a better."""

_DRIVEN: Final = 1e-3
"""Power of the angle over its largest from which a frequency counts."""

_ALIGNED: Final = 0.7
"""Median cosine of the phase against the beam's from which a sign is certain."""

_FACTORS: Final = (
    (180 / math.pi, "degrees for radians"),
    (1000.0, "thousandths (m, mm or N·m, mN·m)"),
    (9.80665, "kilograms or kilopond for newtons"),
    (4.4482216, "pounds-force for newtons"),
    (1 / 0.11298483, "pound-force inches for N·m"),
    (1 / 1.3558179, "pound-force feet for N·m"),
    (2 * math.pi, "turns for radians"),
)
_NEAR: Final = math.log(1.1)
_OFF: Final = math.log(2.0)
"""Below a factor of 2 it is the beam's data that are wrong."""

_BEYOND: Final = math.log(5.0)
"""Above a factor of 5 it is not: no fit searches for a stiffness so far from the file's."""


def wrong_scale(comparison: Comparison) -> Iterator[Finding]:
    """Find a reversed sign, or a factor between units, in torque over angle."""
    angle = comparison.spectrum(comparison.angle_rad[comparison.kept])
    torque = comparison.spectrum(comparison.torque_nm[comparison.kept])
    power = np.abs(angle) ** 2
    driven = power > _DRIVEN * power.max()
    beam = comparison.measurement.nominal.beam
    expected = transfer(2j * np.pi * comparison.frequency_hz[driven], beam, Damping(zeta=_LOSS_S))
    share = torque[driven] / (angle[driven] * expected)
    size = np.abs(share)
    cosine = float(np.median(share.real / np.maximum(size, np.finfo(float).tiny)))
    if abs(cosine) < _ALIGNED:
        return
    if cosine < 0:
        yield Finding(
            kind="sign",
            sentence=(
                "Torque or angle has the wrong sign: the torque opposes what the beam asks for at "
                "nearly all frequencies. No number here is the antenna's."
            ),
            value=None,
            interval=None,
            unit="1",
            remedy=(
                "Reverse the sign of one channel: the torque is positive where the motor pushes "
                "the beam towards positive angles."
            ),
        )
    factor = float(np.median(size))
    if not factor > 0 or abs(math.log(factor)) < _OFF:
        return
    named = [
        words
        for ratio, words in _FACTORS
        if abs(abs(math.log(factor)) - abs(math.log(ratio))) < _NEAR
    ]
    if not named and abs(math.log(factor)) < _BEYOND:
        return
    which = (
        f"which is the factor of {named[0]}: a wrong unit"
        if named
        else "more than any beam is off its data: a wrong unit or gain, or the data of another beam"
    )
    yield Finding(
        kind="unit",
        sentence=(
            f"Torque over angle is {factor:.3g} times what the beam in the file gives, {which}. "
            "No number here is the antenna's."
        ),
        value=factor,
        interval=None,
        unit="1",
        remedy="Check the units of angle and torque, and import the record again.",
    )
