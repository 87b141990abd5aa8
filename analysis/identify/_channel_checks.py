"""Checks of the recorded channels: clipping, stopped motor, wrong sign or unit, sensor drift.

Sign and unit are checked by the ratio of torque and angle to the response of the beam that the
file states, as a median over the band. The median depends neither on the exact mode frequencies
nor on the damping.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._finding import Finding
from analysis.record_checks import longest_run
from rigd.beam import Damping, transfer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._data import Measurement


# Clipping and stops

_FEWEST_FLAT: Final = 4
"""Number of adjacent values at the extreme: noise does not repeat its largest value."""

_STILL_S: Final = 0.5
_STILL: Final = 0.02
"""Shortest standstill that is reported, and the motion during it relative to the reference."""


def clipping(measurement: Measurement) -> Iterator[Finding]:
    """Yield a finding if the torque stays at its extreme values."""
    torque, known = measurement.torque_nm, measurement.torque_known
    flat = []
    for limit in (torque[known].max(), torque[known].min()):
        at = known & (torque == limit)
        repeated = at & (np.roll(at, 1) | np.roll(at, -1))
        if limit != 0 and np.count_nonzero(repeated) >= _FEWEST_FLAT:
            flat.append((float(limit), int(np.count_nonzero(at))))
    if not flat:
        return
    limits = " and ".join(f"{limit:+.3g} N·m" for limit, _ in flat)
    count = sum(ticks for _, ticks in flat)
    yield Finding(
        kind="clipping",
        sentence=(
            f"The torque is clipped at {limits}: {count} values lie exactly there and none "
            "beyond, and no flag says so."
        ),
        value=max(abs(limit) for limit, _ in flat),
        unit="N·m",
        remedy="Use a larger range of the sensor, or a smaller amplitude; flag clipped values.",
    )


def stops(measurement: Measurement) -> Iterator[Finding]:
    """Yield a finding if the motor is at rest although the reference moves."""
    reference_rad = measurement.reference_rad
    if reference_rad is None:
        return
    length = max(round(_STILL_S * measurement.rate_hz), 2)
    blocks = reference_rad.size // length
    if blocks == 0:
        return
    moved, wanted = (
        np.ptp(values[: blocks * length].reshape(blocks, length), axis=1)
        for values in (measurement.angle_rad, reference_rad)
    )
    still = (wanted > np.median(wanted)) & (moved < _STILL * wanted)
    if not still.any():
        return
    count, first = longest_run(still)
    yield Finding(
        kind="stop",
        sentence=(
            f"The motor does not move from {first * _STILL_S:.1f} to "
            f"{(first + count) * _STILL_S:.1f} s of the record, although its reference does."
        ),
        value=count * _STILL_S,
        unit="s",
        remedy="Find what held the shaft or switched the drive off, and sweep again.",
    )


# Sign and unit

_LOSS_S: Final = 1e-4
"""Assumed internal damping of order 1, in s: some per cent."""

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
    """Yield a finding if torque over angle has the wrong sign or a wrong unit."""
    angle = comparison.spectrum(comparison.angle_rad[comparison.retained])
    torque = comparison.spectrum(comparison.torque_nm[comparison.retained])
    power = np.abs(angle) ** 2
    driven = power > _DRIVEN * power.max()
    beam = comparison.measurement.nominal.beam
    expected = transfer(2j * np.pi * comparison.frequency_hz[driven], beam, Damping(zeta=_LOSS_S))
    torque_ratio = torque[driven] / (angle[driven] * expected)
    size = np.abs(torque_ratio)
    cosine = float(np.median(torque_ratio.real / np.maximum(size, np.finfo(float).tiny)))
    if abs(cosine) < _ALIGNED:
        return
    if cosine < 0:
        yield Finding(
            kind="sign",
            sentence=(
                "Torque or angle has the wrong sign: the torque is opposite to that of the beam at "
                "nearly all frequencies. No number here is valid for the antenna."
            ),
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
        else "more than a beam may deviate from its data: a wrong unit or gain, or another beam"
    )
    yield Finding(
        kind="unit",
        sentence=(
            f"Torque over angle is {factor:.3g} times what the beam in the file gives, {which}. "
            "No number here is valid for the antenna."
        ),
        value=factor,
        remedy="Check the units of angle and torque, and import the record again.",
    )


# Drift of the zero

_PARTS: Final = 16
_BEYOND_CHANCE: Final = 10.0
"""Scatter of the means relative to the scatter that noise alone causes."""


def drift_of_zero(candidate_set: CandidateSet) -> float:
    """Return the range of the means over parts of the record in N·m; 0 if noise explains it."""
    comparison = candidate_set.comparison
    torque, _ = comparison.prediction.torque(candidate_set.best.fit.plant)
    left = comparison.torque_nm[comparison.retained] - torque
    length = left.size // _PARTS
    means = left[: _PARTS * length].reshape(_PARTS, length).mean(axis=1)
    # White noise as loud as that of the band's upper half.
    upper = candidate_set.noise.power[candidate_set.noise.power.size // 2 :]
    chance = math.sqrt(float(np.median(upper)) / comparison.samples / length)
    return float(np.ptp(means)) if float(means.std()) > _BEYOND_CHANCE * chance else 0.0
