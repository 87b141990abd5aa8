"""Sweeps through bands of frequencies, and candidate segments that consist of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Pole
from rigd.excitation._beam_estimate import BAND_HZ

RealArray = NDArray[np.float64]

SWEEP_FADE_S: Final = 0.25
"""Shortest duration in s of a sweep's fade at either end."""

_NARROW_HALF_WIDTH_HZ: Final = 0.5
"""Half the width in Hz of a narrow sweep through a mode."""

_RESONANCE_HALF_WIDTHS: Final = 2.0
"""Half the width of a sweep over a whole resonance, in half-power half-widths of the mode."""

SIDE_BAND_OFFSET: Final = 0.06
"""Distance of the off-resonance sweeps from a mode, relative to its frequency. They determine
stiffness and tool inertia, without which the height of a resonance does not give the damping."""


@dataclass(frozen=True, slots=True)
class SweepBand:
    """Band of frequencies that a candidate sweep covers, and the mode that it excites."""

    mode_number: int
    """Number of the mode, from 1."""
    middle_hz: float
    """Centre of the band in Hz."""
    half_width_hz: float
    """Half the width of the band in Hz; 0: a sine."""
    fade_s: float
    """Duration in s of the fade at either end of the sweep."""
    is_at_mode: bool = True
    """Whether the band is centred at the mode, not on one side of it."""


@dataclass(frozen=True, slots=True, eq=False)
class UnitSweep:
    """Reference angle and predicted response of a sweep of amplitude 1 rad in one phase."""

    reference_rad: RealArray
    """Reference angle at each tick of the segment; shape (n,)."""
    angle_rad: RealArray
    """Predicted angle of the motor at each tick of the segment; shape (n,)."""
    torque_derivatives: RealArray
    """Whitened derivatives of the torque for the free parameters, from the segment's beginning on;
    shape (k, samples)."""
    weighted_rows: RealArray
    """Combinations of `torque_derivatives` with the weights of the mixture; shape (q, samples)."""
    limit_fractions: RealArray
    """Limited quantities, such as speed and torque, as fractions of their limits; shape
    (6, ticks)."""
    tip_slope: RealArray
    """Slope of the tip up to the planning horizon, as a fraction of its limit; shape (samples,)."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentCandidate:
    """Candidate for the next segment of excitation, as a sum of sweeps within the limits."""

    duration_s: float
    """Duration of the segment in s."""
    bands_and_amplitudes: tuple[tuple[SweepBand, float], ...]
    """Bands of the segment, and their amplitudes in rad."""
    amplitudes_and_sweeps: tuple[tuple[float, UnitSweep], ...]
    """Amplitudes in rad and unit sweeps, whose sum of products is the segment."""
    limit_fractions: RealArray
    """Limited quantities as fractions of their limits, at one tick in `_LIMIT_CHECK_TICKS`; shape
    (6, ticks)."""
    weighted_rows: RealArray
    """Combinations of the torque's derivatives with the weights of the mixture; shape
    (q, samples)."""
    tip_slope: RealArray
    """Slope of the tip as a fraction of its limit; shape (samples,)."""
    information_time_s: float
    """Information up to the planning horizon if the first band is still driven after the segment,
    expressed as the time in s in which the best mixture would give it."""

    def weighted_sum(self, attribute_name: str) -> RealArray:
        """Return the sum of an array attribute of the segment's sweeps, weighted by amplitude.

        `attribute_name` is an attribute of `UnitSweep`.
        """
        summed_values: RealArray = sum(
            sweep_factor * getattr(candidate_sweep, attribute_name)
            for sweep_factor, candidate_sweep in self.amplitudes_and_sweeps
        )
        return summed_values


@dataclass(frozen=True, slots=True, eq=False)
class ContinuedDrive:
    """Response to exciting a mode by a sine after a segment, in two phases of the sine."""

    weighted_rows: RealArray
    """Weighted derivatives of the torque for a sine of amplitude 1 rad in either phase; shape
    (2, q, samples)."""
    drive_per_amplitude: RealArray
    """Amplitudes of the two sines that hold the mode's vibration constant, per real and imaginary
    part of its amplitude; shape (2, 2)."""


def candidate_bands(modes: Sequence[Pole]) -> list[SweepBand]:
    """Return the frequency bands of candidate sweeps: at every mode, and on either side."""
    sweep_bands = []
    for beam_mode in modes:
        mode_hz = beam_mode.frequency_hz
        # A sine, a narrow sweep, and one over the whole resonance where that is wider.
        narrow_half_width_hz = min(_NARROW_HALF_WIDTH_HZ, 0.2 * mode_hz)
        resonance_half_width_hz = min(
            _RESONANCE_HALF_WIDTHS * beam_mode.damping_ratio * mode_hz, 0.2 * mode_hz
        )
        widths_hz = [
            0.0,
            narrow_half_width_hz,
            *(
                [resonance_half_width_hz]
                if resonance_half_width_hz > 1.5 * narrow_half_width_hz
                else []
            ),
        ]
        sweep_bands += [
            SweepBand(beam_mode.mode, mode_hz, offset_width, SWEEP_FADE_S)
            for offset_width in widths_hz
        ]
        # Fades as long as the beat with the mode: a shorter one excites the mode as well.
        sweep_bands += [
            SweepBand(
                beam_mode.mode,
                (1.0 + offset_step) * mode_hz,
                0.0,
                max(SWEEP_FADE_S, 1.0 / (SIDE_BAND_OFFSET * mode_hz)),
                False,
            )
            for offset_step in (-SIDE_BAND_OFFSET, SIDE_BAND_OFFSET)
            if (1.0 + offset_step) * mode_hz < BAND_HZ
        ]
    return sweep_bands


def largest_factor(existing_motion: RealArray, added_motion: RealArray) -> float:
    """Return the largest factor with which a motion can be added within the limits.

    All quantities are fractions of their limits, shape (c, n), so the sum must be between -1 and 1.
    If the existing motion exceeds this range by itself, the sum may be as large, but no larger.
    """
    unit_magnitude = np.abs(added_motion)
    limit_margin = (
        np.maximum(1.0, np.abs(existing_motion)) - np.sign(added_motion) * existing_motion
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        allowed_factor = np.where(
            unit_magnitude > 1e-9 * unit_magnitude.max(), limit_margin / unit_magnitude, inf
        )
    return max(float(allowed_factor.min()), 0.0)


def describe_candidate(chosen_candidate: SegmentCandidate) -> str:
    """Return a text for the operator with modes, bands, duration and amplitudes of a segment."""
    sorted_parts = sorted(
        chosen_candidate.bands_and_amplitudes,
        key=lambda band_and_amplitude: band_and_amplitude[0].middle_hz,
    )
    band_texts = [
        f"{band.middle_hz - band.half_width_hz:.3g}–{band.middle_hz + band.half_width_hz:.3g}"
        if band.half_width_hz
        else f"{band.middle_hz:.4g}"
        for band, _ in sorted_parts
    ]
    return (
        f"mode{'s' if len(sorted_parts) > 1 else ''} "
        f"{' + '.join(str(band.mode_number) for band, _ in sorted_parts)}, "
        f"{' + '.join(band_texts)} Hz, {chosen_candidate.duration_s:g} s, "
        f"{' + '.join(f'{amplitude:.2g}' for _, amplitude in sorted_parts)} rad"
    )
