"""Measured angle and torque for the estimators: gaps interpolated, decimated to the band.

A missing angle is interpolated, since the convolution with the response needs an angle at every
tick. A missing torque is not compared. After a longer gap of the angle the beam may ring because
the motor moved during the gap. This ringing is estimated like the free decay at the beginning of a
record. Both channels are decimated to the band (`analysis.decimation`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.decimation import MAX_GAP_PERIODS, interpolate_gaps, runs_of_true
from analysis.identify._encoder import angle_without_alternating_counts
from analysis.record_checks import MAX_GAP_S, longest_run, unknown_fraction_message
from rigd.beam import Damping, Plant

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.record import Record
    from analysis.record_ticks import TorqueExtreme
    from rigd.beam import Beam


# Measurement

_IMPACT_START_TOLERANCE_S: Final = 1e-7
"""Rounding tolerance in seconds: a sample at most this long before an impact already belongs to the
free decay after it."""

MAX_LONG_GAPS: Final = 8
"""Maximum number of gaps of the angle that are too long to interpolate. Each adds an unknown
amplitude and phase of every mode."""

_FILTER_SETTLING_TIME_CONSTANTS: Final = 5.0
"""Settling time of a filter of the torque channel, in multiples of its time constant."""

_MOTION_FRACTIONS: Final = (0.02, 0.2)
"""Fractions of the largest distance from the first angle, between which a motion is sudden or slow.
"""

MAX_TORQUE_GAP_S: Final = 1.0
"""Longest tolerated gap of the torque: a longer gap may hide a whole resonance."""


class MeasurementError(ValueError):
    """Error for a record that the estimator cannot use; the message states reason and remedy."""


@dataclass(frozen=True, slots=True)
class RecordedImpact:
    """Impact on the beam during a record.

    The torque is unknown while the contact lasts. The free decays of the modes start with the
    contact.

    Attributes
    ----------
    start_s, end_s : float
        Beginning and end of the contact, since the record's first tick.
    start_uncertainty_s : float
        Uncertainty of the beginning.
    poles_rad_s : tuple of complex
        Poles of the ringing modes: the upper pole of a conjugate pair, or a real pole.
    component_amplitudes : tuple of float
        Estimated amplitude of each row of `unit_torques`; empty before they are estimated.
    largest_torque_nm : float
        Largest torque within one second from the beginning.
    """

    start_s: float
    end_s: float
    start_uncertainty_s: float
    poles_rad_s: tuple[complex, ...]
    component_amplitudes: tuple[float, ...] = ()
    largest_torque_nm: float = 0.0

    def free_decays(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the free decays of all modes after the impact, shape (d, n).

        The rows come in pairs: a real decay of unit amplitude, and this decay multiplied by the
        time in seconds since the impact. The second row allows for a small error of the pole. The n
        times are relative to the record's first tick.
        """
        time_since_start_s = time_s - self.start_s
        has_begun = time_since_start_s > -_IMPACT_START_TOLERANCE_S
        time_since_start_s = np.where(has_begun, time_since_start_s, 0.0)
        decay_rows = []
        for pole_rad_s in self.poles_rad_s:
            complex_decay = np.where(has_begun, np.exp(pole_rad_s * time_since_start_s), 0.0)
            for real_decay in (complex_decay.real, complex_decay.imag)[
                : 1 + (pole_rad_s.imag != 0)
            ]:
                decay_rows += [real_decay, real_decay * time_since_start_s]
        return np.array(decay_rows).reshape(len(decay_rows), time_s.size)

    def unit_torques(self, time_s: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
        """Return the time series, shape (c, n), that multiply the unknown amplitudes of the impact.

        The sum of the products is the torque of the impact. The rows are the free decays, then a
        single sample of 1 for each sample of the contact. The times of the n samples are relative
        to the record's first tick.
        """
        half_period_s = 0.5 / rate_hz
        is_in_contact = (time_s > self.start_s - half_period_s) & (
            time_s < self.end_s - half_period_s
        )
        contact_indices = np.flatnonzero(is_in_contact)
        single_sample_pulses = np.zeros((contact_indices.size, time_s.size))
        single_sample_pulses[np.arange(contact_indices.size), contact_indices] = 1.0
        return np.concatenate([self.free_decays(time_s), single_sample_pulses])

    def torque(
        self, time_s: NDArray[np.float64], sample_times_s: NDArray[np.float64], rate_hz: float
    ) -> NDArray[np.float64]:
        """Return the estimated torque of the impact in N·m at given times, shape (n,).

        The times are relative to the record's first tick. `sample_times_s` and `rate_hz` are the
        times and the sampling rate of the samples for which `component_amplitudes` was estimated.
        """
        if not self.component_amplitudes:
            return np.zeros(time_s.size)
        free_decays = self.free_decays(time_s)
        amplitudes = np.array(self.component_amplitudes)
        contact_torque_nm = (
            amplitudes[len(free_decays) :]
            @ self.unit_torques(sample_times_s, rate_hz)[len(free_decays) :]
        )
        decay_torque_nm: NDArray[np.float64] = amplitudes[: len(free_decays)] @ free_decays
        return decay_torque_nm + np.interp(time_s, sample_times_s, contact_torque_nm)


@dataclass(frozen=True, slots=True)
class Measurement:
    """Angle and torque of one session, with the stated properties of rig and specimen.

    Attributes
    ----------
    name : str
        Name in messages: the path of the file.
    angle_rad, torque_nm : ndarray, shape (n,)
        Motor angle and coupling torque, one value per tick.
    rate_hz : float
        Ticks per second.
    beam : Beam
        Beam that the file states: start of the search for density and stiffness.
    angle_known, torque_known : ndarray of bool, shape (n,)
        False where a tick was missed or its value is flagged (held, saturated). Such a torque is
        not compared. Such an angle is interpolated, since the convolution needs one at every tick.
    rest_angle_rad : float or None
        Angle at which the beam rested before the record; None if unknown, and the first angle is
        used.
    delay_s : float
        Age of the torque relative to the angle with the same time stamp, as the file states it.
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam, as the file states it.
    filter_time_constant_s, second_order_filter_time_constant_s : float
        Low-pass filters of the torque channel, as the file states them: see `Plant`.
    reference_rad : ndarray, shape (n,), or None
        Reference of the motor's controller; None without a controller. The part of the angle that
        does not follow the reference is attributed to the noise.
    impacts : tuple of RecordedImpact
        Known impacts on the beam. Their amplitudes are estimated in each fit.
    uniformity : float
        Relative standard deviation of each mode's frequency from that of a uniform beam.
    tip_mass_kg : float or None
        Point mass at the beam's tip as the file states it; None if it is not known.
    axis_tilt_deg : float or None
        Angle between the beam at rest and the horizontal as the file states it, positive if the
        tip is lower than the root; None if it was not measured.
    is_single_sweep : bool
        Whether the motor passed each frequency once, in rising or falling order. An effect of time
        then cannot be distinguished from an effect of frequency.
    is_later_part : bool
        Whether the record is a part of a session that begins after its rest.
    torque_extremes : tuple of TorqueExtreme
        Largest and smallest torque before a decimation of the record; empty without one.
    """

    name: str
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    rate_hz: float
    beam: Beam
    angle_known: NDArray[np.bool_]
    torque_known: NDArray[np.bool_]
    rest_angle_rad: float | None = None
    delay_s: float = 0.0
    tool_inertia_kg_m2: float = 0.0
    reference_rad: NDArray[np.float64] | None = None
    filter_time_constant_s: float = 0.0
    second_order_filter_time_constant_s: float = 0.0
    impacts: tuple[RecordedImpact, ...] = ()
    uniformity: float = 1e-3
    tip_mass_kg: float | None = None
    axis_tilt_deg: float | None = None
    is_single_sweep: bool = True
    is_later_part: bool = False
    torque_extremes: tuple[TorqueExtreme, ...] = ()

    @classmethod
    def from_record(cls, record: Record) -> Measurement:
        """Return the measurement in a record that was read from a session file.

        Raises
        ------
        MeasurementError
            The motor was held.
        """
        if record.metadata.get("excitation") == "hold":
            raise MeasurementError(
                f"{record.path}: the motor was held, and moved with no more than the noise of its "
                "sensors; record an excitation, such as rigd run chirp."
            )
        return cls(
            name=str(record.path),
            angle_rad=angle_without_alternating_counts(record.angle_rad, record.reference_rad),
            torque_nm=record.torque_nm,
            rate_hz=record.rate_hz,
            beam=record.beam,
            angle_known=record.angle_known,
            torque_known=record.torque_known,
            rest_angle_rad=record.rest_angle_rad,
            delay_s=record.torque_delay_s - record.angle_delay_s,
            tool_inertia_kg_m2=record.tool_inertia_kg_m2,
            reference_rad=record.reference_rad,
            filter_time_constant_s=record.torque_filter_s[0],
            second_order_filter_time_constant_s=record.torque_filter_s[1],
            uniformity=record.uniformity,
            tip_mass_kg=record.tip_mass_kg,
            axis_tilt_deg=record.axis_tilt_deg,
            is_single_sweep=record.metadata.get("excitation", "chirp") == "chirp"
            and record.outward_sweep is None,
            is_later_part=record.part_s is not None and record.rest_angle_rad is None,
            torque_extremes=record.torque_extremes,
        )

    def check_channels(self, highest_hz: float) -> None:
        """Raise an error if the measurement cannot be used in a band that ends at `highest_hz`.

        Raises
        ------
        MeasurementError
            Shapes differ, values are not finite, too many values are unknown in total or in one
            gap, or the angle never moves.
        """
        tick_count = len(self.angle_rad)
        for channel_array in (self.torque_nm, self.angle_known, self.torque_known):
            if len(channel_array) != tick_count:
                raise MeasurementError(
                    f"{self.name}: angle, torque and their masks hold {tick_count} and "
                    f"{len(channel_array)} values, but must be of one length."
                )
        for channel, unit_name, channel_values, is_known in (
            ("angle", "rad", self.angle_rad, self.angle_known),
            ("torque", "N·m", self.torque_nm, self.torque_known),
        ):
            bad_indices = np.flatnonzero(is_known & ~np.isfinite(channel_values))
            if bad_indices.size:
                raise MeasurementError(
                    f"{self.name}: the {channel} is {channel_values[bad_indices[0]]} {unit_name} "
                    f"at tick {bad_indices[0]} and not finite at {bad_indices.size} of "
                    f"{tick_count} ticks; mask them as unknown or record the session again."
                )
            error_text = unknown_fraction_message(
                f"the {channel}", int(np.count_nonzero(~is_known)), tick_count
            )
            if error_text:
                raise MeasurementError(f"{self.name}: {error_text}")
        for channel, is_known, allowed_s in (
            ("angle", self.angle_known, MAX_GAP_S),
            ("torque", self.torque_known, MAX_TORQUE_GAP_S),
        ):
            gap_ticks, gap_start = longest_run(~is_known)
            if gap_ticks > allowed_s * self.rate_hz:
                raise MeasurementError(
                    f"{self.name}: the {channel} is missing or flagged for {gap_ticks} ticks from "
                    f"tick {gap_start} on ({1e3 * gap_ticks / self.rate_hz:.3g} ms), longer than "
                    f"the {1e3 * allowed_s:.3g} ms that an analysis tolerates; record the session "
                    "again."
                )
        long_gap_count = len(self.long_gaps(highest_hz))
        if long_gap_count > MAX_LONG_GAPS:
            raise MeasurementError(
                f"{self.name}: the angle is missing or flagged {long_gap_count} times for longer "
                f"than the {1e3 * MAX_GAP_PERIODS / highest_hz:.3g} ms that a band up to "
                f"{highest_hz:g} Hz interpolates, more often than the {MAX_LONG_GAPS} times that "
                "an analysis tolerates; record the session again or lower --band."
            )
        known_angles_rad = self.angle_rad[self.angle_known]
        if known_angles_rad.size == 0 or np.ptp(known_angles_rad) == 0:
            raise MeasurementError(
                f"{self.name}: the angle never changes, so nothing was excited; check the encoder "
                "and that the motor moved."
            )

    def long_gaps(self, highest_hz: float) -> tuple[tuple[int, int], ...]:
        """Return the gaps of the motor angle that are too long to interpolate, as ranges of ticks.

        The beam may ring after such a gap.

        Parameters
        ----------
        highest_hz : float
            Highest frequency of the band.

        Returns
        -------
        tuple of (int, int)
            First tick of each gap, and the first tick after it at which the filters of the torque
            channel have settled.
        """
        longest_gap_ticks = MAX_GAP_PERIODS / highest_hz * self.rate_hz
        settling_s = abs(self.delay_s) + _FILTER_SETTLING_TIME_CONSTANTS * (
            self.filter_time_constant_s + self.second_order_filter_time_constant_s
        )
        settling_ticks = int(np.ceil(settling_s * self.rate_hz))
        return tuple(
            (int(gap_start), min(int(gap_end) + settling_ticks, len(self.angle_rad)))
            for gap_start, gap_end in zip(*runs_of_true(~self.angle_known), strict=True)
            if gap_end - gap_start > longest_gap_ticks
        )

    def without_torque_in(self, tick_ranges: Iterable[tuple[int, int]]) -> Measurement:
        """Return the measurement with its torque marked as unknown in given ranges of ticks.

        Parameters
        ----------
        tick_ranges : iterable of (int, int)
            First tick of each range, and the first tick after it.
        """
        is_torque_known = self.torque_known.copy()
        for first_tick, end_tick in tick_ranges:
            is_torque_known[first_tick:end_tick] = False
        return replace(self, torque_known=is_torque_known)

    def sudden_motion_s(self) -> float:
        """Return the time in seconds from the first tick at which the motor suddenly moves.

        Return infinity if it moves from the first tick on, or slowly at first, as in a sweep.
        """
        known_ticks = np.flatnonzero(self.angle_known)
        distance_rad = np.abs(self.angle_rad[known_ticks] - self.angle_rad[known_ticks[0]])
        first_tick, later_tick = (
            int(known_ticks[np.argmax(distance_rad > fraction * distance_rad.max())])
            for fraction in _MOTION_FRACTIONS
        )
        return first_tick / self.rate_hz if later_tick < 2 * first_tick else math.inf

    @property
    def nominal_plant(self) -> Plant:
        """Return the beam and rig with the properties that the session file states, undamped."""
        return Plant(
            beam=self.beam,
            damping=Damping(),
            delay_s=self.delay_s,
            tool_inertia_kg_m2=self.tool_inertia_kg_m2,
            tip_mass_kg=self.tip_mass_kg or 0.0,
            filter_time_constant_s=self.filter_time_constant_s,
            second_order_filter_time_constant_s=self.second_order_filter_time_constant_s,
        )

    @property
    def known_torque_fraction(self) -> float:
        """Return the fraction of the ticks at which the torque is known."""
        return float(np.mean(self.torque_known))

    def angle_from_rest_rad(self, highest_hz: float) -> NDArray[np.float64]:
        """Return the motor angle in rad relative to its rest position, gaps interpolated, (n,).

        `highest_hz` is the highest frequency that the angle contains. If the rest position is
        unknown, the first angle is used.
        """
        filled_angle_rad = interpolate_gaps(
            self.angle_rad, self.angle_known, highest_hz / self.rate_hz
        )
        rest_angle_rad = filled_angle_rad[0] if self.rest_angle_rad is None else self.rest_angle_rad
        return filled_angle_rad - rest_angle_rad
