"""Checks of the recorded channels: clipping, stopped motor, wrong sign or unit.

Sign and unit are checked by the ratio of the measured response, torque over angle, to the response
of the beam that the file states. The median of this ratio over the band depends neither on the
exact mode frequencies nor on the damping. The magnitude of a noisy ratio is too large on average.
It is therefore averaged over adjacent frequencies, and where the expected torque is small it has a
smaller weight. Resonances have no larger weight than others: their frequencies may differ.

The torque of a tool inertia (between sensor and beam) that the file does not state is opposite to
that of the beam above each resonance, and larger at high frequencies. If the response of the beam
alone does not explain the torque, sign and unit are therefore those of the part of the beam, with
the tool inertia that explains the torque best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from analysis.identify._finding import Finding
from analysis.record_checks import longest_run
from analysis.record_ticks import torque_extremes
from rigd.beam import Damping, ResponseGrid

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._data import Measurement


# Clipping and stops

_MIN_CLIPPED_VALUES: Final = 4
"""Minimum number of samples at the extreme of the torque, each next to another one, that is
reported as clipping. Noise does not repeat its largest value."""

_MIN_CLIPPED_TO_INNER_RATIO: Final = 3.0
"""Minimum ratio of the number of samples at the extreme of a clipped torque to that at each of the
next two torques inside. For a coarse resolution alone it is at most 2.4, as in the crests of a sine
(1 / (sqrt(2) - 1)), and less than 1 for noise."""

_STANDSTILL_BLOCK_S: Final = 0.5
"""Duration in seconds of the blocks in which a standstill of the motor is searched for."""

_MAX_STANDSTILL_MOTION_RATIO: Final = 0.02
"""Largest motion of a motor at standstill within a block, relative to its reference."""


def clipping_findings(measurement: Measurement) -> Iterator[Finding]:
    """Yield a finding if the torque is clipped: many values lie exactly at its extremes.

    If the resolution of the torque is coarse, values at the extremes coincide, too. There are then
    as many or more at the next values inside.
    """
    known_torque_nm = np.where(measurement.torque_known, measurement.torque_nm, np.nan)
    clipped_extremes = [
        extreme
        for extreme in measurement.torque_extremes or torque_extremes(known_torque_nm)
        if extreme.limit_nm != 0
        and extreme.repeated_count >= _MIN_CLIPPED_VALUES
        and extreme.sample_count >= _MIN_CLIPPED_TO_INNER_RATIO * max(extreme.inner_counts)
    ]
    if not clipped_extremes:
        return
    limits_text = " and ".join(f"{extreme.limit_nm:+.3g} N·m" for extreme in clipped_extremes)
    clipped_tick_count = sum(extreme.sample_count for extreme in clipped_extremes)
    yield Finding(
        kind="clipping",
        sentence=(
            f"The torque is clipped at {limits_text}: {clipped_tick_count} values lie exactly "
            "there and none beyond, and no flag says so."
        ),
        value=max(abs(extreme.limit_nm) for extreme in clipped_extremes),
        unit="N·m",
        remedy="Use a larger range of the sensor, or a smaller amplitude; flag clipped values.",
    )


def standstill_findings(measurement: Measurement) -> Iterator[Finding]:
    """Yield a finding if the motor does not move while its reference moves."""
    reference_rad = measurement.reference_rad
    if reference_rad is None:
        return
    block_length = max(round(_STANDSTILL_BLOCK_S * measurement.rate_hz), 2)
    block_count = reference_rad.size // block_length
    if block_count == 0:
        return
    motion_rad, reference_motion_rad = (
        np.ptp(
            angle_values_rad[: block_count * block_length].reshape(block_count, block_length),
            axis=1,
        )
        for angle_values_rad in (measurement.angle_rad, reference_rad)
    )
    is_standstill_block = (reference_motion_rad > np.median(reference_motion_rad)) & (
        motion_rad < _MAX_STANDSTILL_MOTION_RATIO * reference_motion_rad
    )
    if not is_standstill_block.any():
        return
    longest_still_blocks, first_still_block = longest_run(is_standstill_block)
    yield Finding(
        kind="stop",
        sentence=(
            f"The motor does not move from {first_still_block * _STANDSTILL_BLOCK_S:.1f} to "
            f"{(first_still_block + longest_still_blocks) * _STANDSTILL_BLOCK_S:.1f} s of the "
            "record, although its reference does."
        ),
        value=longest_still_blocks * _STANDSTILL_BLOCK_S,
        unit="s",
        remedy="Find what held the shaft or switched the drive off, and sweep again.",
    )


# Sign and unit

_ASSUMED_INTERNAL_DAMPING_S: Final = 1e-4
"""Assumed coefficient of internal damping of order 1, in seconds: a loss of a few per cent."""

_MIN_DRIVEN_POWER_FRACTION: Final = 1e-3
"""Minimum power of the angle at a frequency that is used, relative to the largest power."""

_MAX_GROUP_SIZE: Final = 16
"""Largest number of adjacent frequencies over which the ratio of torque to angle is averaged."""

_MIN_GROUPS: Final = 64
"""Smallest number of such averages, if there are as many frequencies: in a short record, an average
over more of them would be that of a whole resonance."""

_CERTAIN_PHASE_COSINE: Final = 0.9
"""Median cosine of the phase at which a torque of plausible size needs no other explanation."""

_MIN_COMPARED_MOTION_FRACTION: Final = 0.5
"""Smallest part of the motor's squared speed that lies within the compared samples."""

_MIN_PHASE_COSINE: Final = 0.7
"""Minimum magnitude of the median cosine of the phase between measured and expected response at
which the sign of the ratio of torque to angle is certain."""

_UNIT_FACTORS: Final = (
    (180 / math.pi, "degrees for radians"),
    (1000.0, "thousandths (m, mm or N·m, mN·m)"),
    (9.80665, "kilograms or kilopond for newtons"),
    (4.4482216, "pounds-force for newtons"),
    (1 / 0.11298483, "pound-force inches for N·m"),
    (1 / 1.3558179, "pound-force feet for N·m"),
    (2 * math.pi, "turns for radians"),
)
"""Factors by which a wrong unit changes the ratio of torque to angle, with their descriptions."""

_LOG_UNIT_FACTOR_TOLERANCE: Final = math.log(1.1)
"""Largest difference between the logarithms of a measured factor and of a known unit factor that
are considered equal."""

_MIN_LOG_UNIT_FACTOR: Final = math.log(2.0)
"""Logarithm of the smallest factor that is attributed to a wrong unit. A smaller one is attributed
to wrong data of the beam."""

_CERTAIN_LOG_UNIT_FACTOR: Final = math.log(5.0)
"""Logarithm of the factor above which an unknown factor is attributed to a wrong unit, too: no fit
searches for a stiffness so far from that of the file."""


_MAX_TOOL_TO_BEAM_INERTIA: Final = 5.0
"""Largest tool inertia that is searched for, relative to the moment of inertia of the beam."""

_MIN_TOOL_TO_BEAM_INERTIA: Final = 1e-3
"""Smallest tool inertia other than 0 that is searched for, relative to that of the beam."""

_LOG_INERTIA_STEP: Final = 0.05
"""Largest step of the search for the tool inertia, as a difference of logarithms."""

_PLAUSIBLE_GAINS: Final = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Ratios of the beam's torque to that of the file that need no wrong unit, for the search."""

_MAX_RELATIVE_MISFIT: Final = 1.4
"""Largest ratio of the misfits of two explanations that fit equally well."""

_EQUAL_MISFIT_DIFFERENCE: Final = 0.05
"""Difference of misfits that is allowed in addition, for differences from the assumed damping."""

_MAX_CERTAIN_MISFIT: Final = 0.1
"""Largest misfit with a tool inertia that the file does not state at which sign or unit are wrong
with certainty. With a larger one, the torque may be that of another beam."""


@dataclass(frozen=True, slots=True)
class _Explanation:
    """Gain of the beam's torque for an assumed tool inertia, and how well it fits.

    Attributes
    ----------
    misfit : float
        Mean relative difference of the torque, from 0 to 2.
    gain : float
        Ratio of the measured torque to the expected one, negative for a wrong sign.
    phase_cosine : float
        Median cosine of the phase between measured and expected torque.
    """

    misfit: float
    gain: float
    phase_cosine: float

    def fits_as_well_as(self, other: _Explanation) -> bool:
        """Return whether the misfit is hardly larger than that of another explanation."""
        return self.misfit <= _MAX_RELATIVE_MISFIT * other.misfit + _EQUAL_MISFIT_DIFFERENCE


@dataclass(frozen=True, slots=True)
class _GroupedTorque:
    """Products of the spectra of torque, beam torque and torque of 1 kg m², summed over groups.

    Each group has adjacent frequencies, at which the motor moves. All arrays have shape (groups,).

    Attributes
    ----------
    torque_by_beam, torque_by_inertia : ndarray of complex
        Measured torque times the conjugate of the expected torque of the beam, or of the inertia.
    beam_by_inertia : ndarray of complex
        Expected torque of the beam times the conjugate of that of the inertia.
    beam_power, inertia_power : ndarray
        Powers of these expected torques.
    weights : ndarray
        Weights of the groups: the measured torque, at most its median.
    """

    torque_by_beam: NDArray[np.complex128]
    torque_by_inertia: NDArray[np.complex128]
    beam_by_inertia: NDArray[np.complex128]
    beam_power: NDArray[np.float64]
    inertia_power: NDArray[np.float64]
    weights: NDArray[np.float64]

    @classmethod
    def from_comparison(cls, comparison: Comparison) -> Self:
        """Return the products of a record, with the beam of its file."""
        angle_spectrum = comparison.spectrum(comparison.angle_rad[comparison.retained_samples])
        torque_spectrum = comparison.spectrum(comparison.torque_nm[comparison.retained_samples])
        angle_power = np.abs(angle_spectrum) ** 2
        is_driven_bin = angle_power > _MIN_DRIVEN_POWER_FRACTION * angle_power.max()
        torque = torque_spectrum[is_driven_bin]
        plant = replace(
            comparison.measurement.nominal_plant,
            damping=Damping(zeta=_ASSUMED_INTERNAL_DAMPING_S),
            tool_inertia_kg_m2=0.0,
        )
        beam_torque, inertia_torque = ResponseGrid(
            2j * np.pi * comparison.frequency_hz[is_driven_bin]
        ).evaluate(plant, ("tool_inertia_kg_m2",), angle_spectrum[is_driven_bin])
        group_size = max(1, min(_MAX_GROUP_SIZE, torque.size // _MIN_GROUPS))
        first_frequencies = np.arange(0, torque.size, group_size)
        torque_rms = np.sqrt(np.add.reduceat(np.abs(torque) ** 2, first_frequencies))
        return cls(
            np.add.reduceat(torque * beam_torque.conj(), first_frequencies),
            np.add.reduceat(torque * inertia_torque.conj(), first_frequencies),
            np.add.reduceat(beam_torque * inertia_torque.conj(), first_frequencies),
            np.add.reduceat(np.abs(beam_torque) ** 2, first_frequencies),
            np.add.reduceat(np.abs(inertia_torque) ** 2, first_frequencies),
            np.minimum(torque_rms, np.median(torque_rms)),
        )

    def explanations(
        self, tool_inertia_kg_m2: float
    ) -> tuple[_Explanation, _Explanation, _Explanation]:
        """Return the best explanations with a tool inertia.

        The first has any gain, which is the median, the second one of `_PLAUSIBLE_GAINS`, and the
        third one of these of the wrong sign.

        Parameters
        ----------
        tool_inertia_kg_m2 : float
            Assumed tool inertia.
        """
        expected_power = (
            self.beam_power
            + 2 * tool_inertia_kg_m2 * self.beam_by_inertia.real
            + tool_inertia_kg_m2**2 * self.inertia_power
        )
        torque_ratio = (
            self.torque_by_beam + tool_inertia_kg_m2 * self.torque_by_inertia
        ) / expected_power
        ratio_magnitude = np.maximum(np.abs(torque_ratio), np.finfo(float).tiny)
        phase_cosine = float(np.median(torque_ratio.real / ratio_magnitude))
        expected_rms = np.sqrt(expected_power)
        median_magnitude = np.quantile(
            ratio_magnitude,
            0.5,
            method="inverted_cdf",
            weights=np.minimum(expected_rms, np.median(expected_rms)),
        )

        median_gain = math.copysign(float(median_magnitude), phase_cosine)
        gains = np.array([median_gain, *_PLAUSIBLE_GAINS, *(-gain for gain in _PLAUSIBLE_GAINS)])
        differences = np.abs(torque_ratio - gains[:, None]) / np.maximum(
            ratio_magnitude, np.abs(gains[:, None])
        )
        explanations = [
            _Explanation(misfit, gain, phase_cosine)
            for misfit, gain in zip(
                np.average(differences, axis=1, weights=self.weights).tolist(),
                gains.tolist(),
                strict=True,
            )
        ]
        gain_count = len(_PLAUSIBLE_GAINS)
        return (
            explanations[0],
            _best(explanations[1 : 1 + gain_count]),
            _best(explanations[1 + gain_count :]),
        )


def _best(explanations: Iterable[_Explanation]) -> _Explanation:
    """Return the explanation with the smallest misfit."""
    return min(explanations, key=lambda explanation: explanation.misfit)


def _likeliest_explanation(comparison: Comparison) -> _Explanation:
    """Return the simplest explanation of the torque that fits about as well as any.

    The first is the tool inertia of the file with any gain. The others have a tool inertia that the
    file does not state: first with a plausible gain, then with such a gain of the wrong sign, then
    with any gain.
    """
    torque, measurement = _GroupedTorque.from_comparison(comparison), comparison.measurement
    stated_inertia_kg_m2, beam = measurement.tool_inertia_kg_m2, measurement.beam
    as_stated, _, _ = torque.explanations(stated_inertia_kg_m2)
    if (
        as_stated.phase_cosine > _CERTAIN_PHASE_COSINE
        and abs(math.log(as_stated.gain)) < _MIN_LOG_UNIT_FACTOR
    ):
        return as_stated  # saves the search, which takes 40 ms
    beam_inertia_kg_m2 = beam.inertia_kg_m2
    smallest_kg_m2, largest_kg_m2 = (
        _MIN_TOOL_TO_BEAM_INERTIA * beam_inertia_kg_m2,
        max(_MAX_TOOL_TO_BEAM_INERTIA * beam_inertia_kg_m2, 2 * stated_inertia_kg_m2),
    )
    step_count = math.ceil(math.log(largest_kg_m2 / smallest_kg_m2) / _LOG_INERTIA_STEP)
    tool_inertias_kg_m2 = (
        stated_inertia_kg_m2,
        0.0,
        *np.geomspace(smallest_kg_m2, largest_kg_m2, step_count + 1).tolist(),
    )
    explanations = [torque.explanations(inertia_kg_m2) for inertia_kg_m2 in tool_inertias_kg_m2]
    with_any_gain = _best(with_median for with_median, _, _ in explanations)
    with_plausible_gain = _best(plausible for _, plausible, _ in explanations)
    with_wrong_sign = _best(reversed_sign for _, _, reversed_sign in explanations)
    if as_stated.fits_as_well_as(with_any_gain):
        return as_stated
    if (
        with_plausible_gain.fits_as_well_as(with_any_gain)
        and _MAX_RELATIVE_MISFIT * with_plausible_gain.misfit < as_stated.misfit
    ):
        return replace(with_plausible_gain, gain=1.0, phase_cosine=1.0)
    if with_any_gain.misfit > _MAX_CERTAIN_MISFIT:
        return as_stated
    if with_wrong_sign.fits_as_well_as(with_any_gain):
        return replace(with_wrong_sign, gain=-1.0, phase_cosine=-1.0)
    return with_any_gain


def sign_and_unit_findings(comparison: Comparison) -> Iterator[Finding]:
    """Yield a finding if the ratio of torque to motor angle has a wrong sign or a wrong unit.

    There is none if most of the motion, such as a step, is before the first compared sample: the
    torque then is that of a beam that is still ringing.
    """
    first_sample, end_sample = (
        comparison.retained_samples.start,
        comparison.retained_samples.stop,
    )
    squared_steps = np.diff(comparison.angle_rad[:end_sample]) ** 2
    compared_fraction = squared_steps[first_sample:].sum() / squared_steps.sum()
    if compared_fraction < _MIN_COMPARED_MOTION_FRACTION:
        return
    explanation = _likeliest_explanation(comparison)
    if abs(explanation.phase_cosine) < _MIN_PHASE_COSINE:
        return
    if explanation.phase_cosine < 0:
        yield Finding(
            kind="sign",
            sentence=(
                "Torque or angle has the wrong sign: the torque is opposite to that of the beam "
                "at nearly all frequencies. No number here is valid for the antenna."
            ),
            remedy=(
                "Reverse the sign of one channel: the torque is positive where the motor pushes "
                "the beam towards positive angles."
            ),
        )
    median_magnitude = abs(explanation.gain)
    if not median_magnitude > 0 or abs(math.log(median_magnitude)) < _MIN_LOG_UNIT_FACTOR:
        return
    log_differences = {
        unit_description: abs(abs(math.log(median_magnitude)) - abs(math.log(unit_factor)))
        for unit_factor, unit_description in _UNIT_FACTORS
    }
    matching_units = [
        unit_description
        for unit_description in sorted(log_differences, key=log_differences.__getitem__)
        if log_differences[unit_description] < _LOG_UNIT_FACTOR_TOLERANCE
    ]
    if not matching_units and abs(math.log(median_magnitude)) < _CERTAIN_LOG_UNIT_FACTOR:
        return
    unit_text = (
        f"which is the factor of {' or of '.join(matching_units)}: a wrong unit"
        if matching_units
        else "more than a beam may deviate from its data: a wrong unit or gain, or another beam"
    )
    yield Finding(
        kind="unit",
        sentence=(
            f"Torque over angle is {median_magnitude:.3g} times what the beam in the file gives, "
            f"{unit_text}. No number here is valid for the antenna."
        ),
        value=median_magnitude,
        remedy="Check the units of angle and torque, and import the record again.",
    )
