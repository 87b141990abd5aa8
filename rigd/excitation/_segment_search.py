"""Search for the next segment of excitation: its sweeps, information and limits.

`rigd.excitation.experiment_design` uses it.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.excitation._beam_estimate import BAND_HZ, BeamEstimate
from rigd.excitation._fisher_information import RecordSoFar, TorqueModel, covariance_of
from rigd.excitation._shortest_move import MovePlant
from rigd.excitation._signals import MAX_PLANNED_LIMIT_FRACTION, ExcitationError
from rigd.excitation._sine_mixture import (
    UNREACHABLE_TIME_S,
    best_mixture,
    steady_sines,
    time_with_ring_up,
)
from rigd.excitation._sweeps import (
    SWEEP_FADE_S,
    ContinuedDrive,
    SegmentCandidate,
    SweepBand,
    UnitSweep,
    candidate_bands,
    describe_candidate,
    largest_factor,
)
from rigd.excitation.moves import quintic
from rigd.excitation.targets import Precision, Quantities

RealArray = NDArray[np.float64]

SEGMENT_DURATIONS_S: Final = (1.0, 1.5, 2.0, 3.0)
"""Durations in s of the candidate segments."""

SHORTEST_SEGMENT_S: Final = SEGMENT_DURATIONS_S[0]
"""Duration in s of the shortest segment."""

_CHECKED_SETTLING_S: Final = 0.25
"""Time in s after a segment for which its response is checked against the limits."""

_MODE_OBSERVATION_S: Final = 1.0
"""Time in s after a segment from which the vibration of each mode is computed, to bring the modes
that the segment does not excite to rest."""

PLANNING_HORIZON_S: Final = 8.0
"""Planning horizon in s from the start of a segment. A mode gives information on its damping only
after it has rung for a while."""

_PHASE_COUNT: Final = 8
"""Number of phases of a sweep that are compared."""

_BASE_AMPLITUDE_FACTORS: Final = (1.0, 0.8, 0.5)
"""Factors by which a segment's amplitude is multiplied when a further band is added to it."""

_SINE_MIXTURE_EFFICIENCY: Final = 0.7
"""Ratio of the time of a mixture of steady sines to that of segments with the same information, in
which the modes have to ring up first; a measured value."""

_MAX_TARGET_RELAXATIONS: Final = 3
"""Largest number of times that the targets are relaxed to fit into the remaining time."""

_LIMIT_CHECK_TICKS: Final = 4
"""Number of ticks from one check of the limits to the next while candidates are compared."""


@dataclass(frozen=True, slots=True)
class PrecisionForecast:
    """Forecast of the time in s until all target standard deviations are reached."""

    time_to_targets_s: float
    """Time in s until all targets are reached with the best segments; infinite: never."""
    reason: str
    """Reason why the targets are not reached in the remaining time; empty if they are reached."""


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Planned segment of excitation, with the standard deviations expected after it.

    It begins and ends with angle, speed and acceleration zero.
    """

    name: str
    """Modes, frequencies, duration and amplitudes, as text for the operator."""
    reference_rad: RealArray
    """Reference angle at each tick, relative to the start angle; shape (n,)."""
    angle_rad: RealArray
    """Predicted angle of the motor at each tick; shape (n,)."""
    parameter_names: tuple[str, ...]
    """Names of the free parameters, in the order of the covariance."""
    covariance: RealArray
    """Covariance of the free parameters that is expected at the end of the segment, shape (k, k);
    see `information` for their units."""
    present_precisions: tuple[Precision, ...]
    """Precision of each target that is expected at the beginning of the segment."""
    expected_precisions: tuple[Precision, ...]
    """Precision of each target that is expected at the end of the segment."""
    forecast: PrecisionForecast
    """Forecast of the time from the beginning of the segment until all targets are reached."""
    fraction_of_limits: float
    """Largest predicted fraction of a limit, or of the largest slope of the tip, including the
    vibration from before the segment."""


class SegmentSearch:
    """Search for the next segment of excitation that improves the target precisions most."""

    def __init__(
        self,
        estimate: BeamEstimate,
        quantities: Quantities,
        plant: MovePlant,
        start_rad: float,
        record: RecordSoFar,
        tip_slope_rad: float,
        time_left_s: float = inf,
        limit_fraction: float = 1.0,
    ) -> None:
        self.estimate, self.quantities, self.plant = estimate, quantities, plant
        self.record, self.limit_fraction = record, limit_fraction
        self.modes = estimate.modes()
        if not self.modes:
            raise ExcitationError(
                f"The estimated beam has no mode below {BAND_HZ:g} Hz that could be driven."
            )
        self.model = TorqueModel.for_records(
            estimate, plant.rate_hz, record.ringing_motion.shape[1]
        )
        self.sample_count = record.future_derivatives.shape[1]
        self.limits = (
            MAX_PLANNED_LIMIT_FRACTION
            * limit_fraction
            * np.array(
                [
                    max(plant.max_angle_rad - abs(start_rad), 1e-6),
                    plant.max_velocity_rad_s,
                    plant.max_tracking_error_rad,
                    plant.peak_torque_nm - plant.friction_nm,
                    plant.max_coupling_torque_nm,
                    tip_slope_rad,
                ]
            )
        )
        # The torque of the remaining vibration acts on the motor that holds, and on the sensor.
        torque_nm, slope_rad = record.ringing_motion
        zero_channel = np.zeros_like(torque_nm)
        vibration_channels = np.stack(
            [zero_channel, zero_channel, zero_channel, torque_nm, torque_nm, slope_rad]
        )
        self.vibration_fractions = vibration_channels / self.limits[:, None]
        self.line_hz, self.line_amplitudes_rad = steady_sines(
            estimate, self.modes, plant, self.limits
        )
        known_information = record.information_after(None, 0)
        self.mixture = best_mixture(
            known_information, estimate, quantities, self.line_hz, self.line_amplitudes_rad
        )
        self.mixture_duration_s = self._mixture_time_s()
        # With too little time all targets are missed by one factor, not the last mode alone.
        relaxation, mixture_duration_s = 1.0, self.mixture_duration_s
        for _ in range(_MAX_TARGET_RELAXATIONS):
            if not time_left_s < mixture_duration_s < UNREACHABLE_TIME_S:
                break
            relaxation *= (mixture_duration_s / time_left_s) ** 0.5
            self.mixture = best_mixture(
                known_information,
                estimate,
                quantities,
                self.line_hz,
                self.line_amplitudes_rad,
                relaxation,
            )
            mixture_duration_s = self._mixture_time_s()
        self.rows_if_held = (
            self.mixture.weights @ record.nuisance_projection @ record.future_derivatives
        )
        self._continued_drives: dict[float, ContinuedDrive] = {}
        self.tip_slope = self.vibration_fractions[-1, :: self.model.ticks_per_model_sample][
            : self.sample_count
        ]

    def best_candidate(
        self, time_left_s: float, mode_numbers: Collection[int] = ()
    ) -> SegmentCandidate:
        """Return the most informative candidate segment that fits into `time_left_s`.

        It drives one of the modes in `mode_numbers`, or any mode if `mode_numbers` is empty.
        """
        durations_s = [d for d in SEGMENT_DURATIONS_S if d <= time_left_s + 1e-9]
        if not durations_s:
            raise ExcitationError(
                f"No segment of excitation fits into {time_left_s:g} s: the shortest takes "
                f"{SEGMENT_DURATIONS_S[0]:g} s."
            )
        return max(
            (self.best_of_duration(d, mode_numbers) for d in durations_s),
            key=lambda candidate: candidate.information_time_s,
        )

    def best_of_duration(
        self, duration_s: float, mode_numbers: Collection[int]
    ) -> SegmentCandidate:
        """Return the most informative candidate segment of a given duration.

        The best band comes first; bands of further modes are added if they give more information.
        """
        sweep_pairs = [
            (sweep_band, self.sweep_pair(sweep_band, duration_s))
            for sweep_band in candidate_bands(self.modes)
        ]
        empty_candidate = SegmentCandidate(
            duration_s,
            (),
            (),
            self.vibration_fractions[
                :, : self.to_ticks(duration_s + _CHECKED_SETTLING_S) : _LIMIT_CHECK_TICKS
            ],
            self.rows_if_held,
            self.tip_slope,
            0.0,
        )
        mode_sweeps = {
            sweep_band.mode_number: sweep_pair
            for sweep_band, sweep_pair in reversed(sweep_pairs)
            if sweep_band.is_at_mode
        }
        # A single line does not show a mode: any smooth response could produce it.
        resonance_bands = {
            sweep_band.mode_number: sweep_band
            for sweep_band, _ in sweep_pairs
            if sweep_band.is_at_mode and sweep_band.mode_number in mode_numbers
        }
        start_candidate_by_mode = {
            mode_number: self.with_modes_at_rest(empty_candidate, mode_number, mode_sweeps)
            for mode_number in mode_sweeps
        }
        leading_candidate = max(
            (
                self.with_band(start_candidate, 1.0, sweep_band, sweep_pair, phase_index)
                for sweep_band, sweep_pair in sweep_pairs
                if sweep_band.is_at_mode
                and (not mode_numbers or sweep_band is resonance_bands.get(sweep_band.mode_number))
                for start_candidate in (
                    empty_candidate,
                    start_candidate_by_mode[sweep_band.mode_number],
                )
                for phase_index in range(_PHASE_COUNT)
            ),
            key=lambda candidate: candidate.information_time_s,
        )
        for _ in range(2):
            driven_modes = {
                sweep_band.mode_number for sweep_band, _ in leading_candidate.bands_and_amplitudes
            }
            extended_candidates = [
                self.with_band(
                    leading_candidate, amplitude_fraction, sweep_band, sweep_pair, phase_index
                )
                for sweep_band, sweep_pair in sweep_pairs
                if sweep_band.mode_number not in driven_modes
                for amplitude_fraction in _BASE_AMPLITUDE_FACTORS
                for phase_index in range(0, _PHASE_COUNT, 2)
            ]
            better_candidate = max(
                extended_candidates,
                key=lambda candidate: candidate.information_time_s,
                default=leading_candidate,
            )
            if better_candidate.information_time_s <= leading_candidate.information_time_s:
                break
            leading_candidate = better_candidate
        return leading_candidate

    def to_ticks(self, time_s: float) -> int:
        """Return a time in s as a number of ticks of the rig."""
        return round(time_s * self.plant.rate_hz)

    def to_model_samples(self, time_s: float) -> int:
        """Return a time in s as a number of samples of the torque model."""
        return round(time_s * self.model.sample_hz)

    def with_modes_at_rest(
        self,
        start_candidate: SegmentCandidate,
        mode_number: int,
        mode_sweeps: dict[int, tuple[UnitSweep, UnitSweep]],
    ) -> SegmentCandidate:
        """Return a candidate segment that also brings all modes but one to rest by its end.

        If the limits do not allow that, the modes' vibration is reduced as far as they allow.
        """
        other_sweeps = [
            other_sweep
            for other_mode, sweep_pair in mode_sweeps.items()
            if other_mode != mode_number
            for other_sweep in sweep_pair
        ]
        if not other_sweeps:
            return start_candidate
        first_sample = self.to_model_samples(start_candidate.duration_s)
        tail_slice = slice(first_sample, first_sample + self.to_model_samples(_MODE_OBSERVATION_S))
        # One second of the tip's slope suffices to separate the modes.
        tip_slopes = np.stack(
            [other_sweep.tip_slope[tail_slice] for other_sweep in other_sweeps], axis=1
        )
        present_slope = self.tip_slope[tail_slice]
        sweep_factors = -np.linalg.lstsq(tip_slopes, present_slope)[0]
        summed_channels = sum(
            f * other_sweep.limit_fractions[:, ::_LIMIT_CHECK_TICKS]
            for f, other_sweep in zip(sweep_factors, other_sweeps, strict=True)
        )
        amplitude_fraction = min(
            1.0, largest_factor(start_candidate.limit_fractions, summed_channels)
        )
        summed_weighted_rows = sum(
            f * other_sweep.weighted_rows
            for f, other_sweep in zip(sweep_factors, other_sweeps, strict=True)
        )
        return SegmentCandidate(
            start_candidate.duration_s,
            (),
            tuple(
                (amplitude_fraction * f, other_sweep)
                for f, other_sweep in zip(sweep_factors, other_sweeps, strict=True)
            ),
            start_candidate.limit_fractions + amplitude_fraction * summed_channels,
            start_candidate.weighted_rows + amplitude_fraction * summed_weighted_rows,
            start_candidate.tip_slope
            + amplitude_fraction
            * sum(
                f * other_sweep.tip_slope
                for f, other_sweep in zip(sweep_factors, other_sweeps, strict=True)
            ),
            0.0,
        )

    def sweep_pair(self, sweep_band: SweepBand, duration_s: float) -> tuple[UnitSweep, UnitSweep]:
        """Return two sweeps of 1 rad through a band, a quarter of a period apart in phase."""
        rate_hz = self.plant.rate_hz
        n = self.to_ticks(duration_s)
        time_from_middle_s = np.arange(1, n + 1) / rate_hz - 0.5 * duration_s
        phase_rad = 2 * pi * sweep_band.middle_hz * time_from_middle_s
        phase_rad += 2 * pi * sweep_band.half_width_hz * time_from_middle_s**2 / duration_s
        fade_factors = quintic(min(sweep_band.fade_s, 0.4 * duration_s), rate_hz)
        # The motor comes to rest as well before the segment ends.
        end_tick = n - self.to_ticks(self.plant.settling_s)
        fade_window = np.zeros(n)
        fade_window[:end_tick] = 1.0
        fade_window[: fade_factors.size] = fade_factors
        fade_window[end_tick - fade_factors.size : end_tick] = np.minimum(
            fade_window[end_tick - fade_factors.size : end_tick], 1.0 - fade_factors
        )
        return self.unit_sweep(fade_window * np.sin(phase_rad)), self.unit_sweep(
            fade_window * np.cos(phase_rad)
        )

    def unit_sweep(self, reference_rad: RealArray) -> UnitSweep:
        """Return the predicted response to a reference of amplitude 1 rad from rest, shape (n,)."""
        n = reference_rad.size
        extended_reference_rad = np.concatenate(
            [reference_rad, np.zeros(round(_CHECKED_SETTLING_S * self.plant.rate_hz))]
        )
        loop_response = self.plant.respond(extended_reference_rad)
        spectrum = self.model.spectrum(loop_response.angle_rad)
        whitened_rows = self.model.whitened_derivatives(spectrum)[:, : self.sample_count]
        slope_rad = self.model.torque_and_slope(spectrum)[1]
        limit_channels = np.stack(
            [
                loop_response.angle_rad,
                loop_response.velocity_rad_s,
                extended_reference_rad - loop_response.angle_rad,
                loop_response.torque_nm,
                loop_response.coupling_torque_nm,
                slope_rad[: extended_reference_rad.size],
            ]
        )
        return UnitSweep(
            reference_rad=reference_rad,
            angle_rad=loop_response.angle_rad[:n],
            torque_derivatives=whitened_rows,
            weighted_rows=self.mixture.weights @ whitened_rows,
            tip_slope=slope_rad[:: self.model.ticks_per_model_sample][: self.sample_count]
            / self.limits[-1],
            limit_fractions=limit_channels / self.limits[:, None],
        )

    def with_band(
        self,
        base_candidate: SegmentCandidate,
        amplitude_fraction: float,
        sweep_band: SweepBand,
        sweep_pair: tuple[UnitSweep, UnitSweep],
        phase_index: int,
    ) -> SegmentCandidate:
        """Return a candidate segment with a further band, at the largest allowed amplitude.

        The amplitudes of `base_candidate` are multiplied by `amplitude_fraction`. The phase of the
        new sweep is ``phase_index / _PHASE_COUNT`` of a turn.
        """
        phase_rad = 2 * pi * phase_index / _PHASE_COUNT
        sine_factor, cosine_factor = float(np.cos(phase_rad)), float(np.sin(phase_rad))
        first_sweep, second_sweep = sweep_pair
        vibration_channels = self.vibration_fractions[
            :, : first_sweep.limit_fractions.shape[1] : _LIMIT_CHECK_TICKS
        ]
        unit_channels = (
            sine_factor * first_sweep.limit_fractions[:, ::_LIMIT_CHECK_TICKS]
            + cosine_factor * second_sweep.limit_fractions[:, ::_LIMIT_CHECK_TICKS]
        )
        base_channels = vibration_channels + amplitude_fraction * (
            base_candidate.limit_fractions - vibration_channels
        )
        amplitude_rad = largest_factor(base_channels, unit_channels)
        tip_slope_fractions = self.tip_slope + amplitude_fraction * (
            base_candidate.tip_slope - self.tip_slope
        )
        tip_slope_fractions += amplitude_rad * (
            sine_factor * first_sweep.tip_slope + cosine_factor * second_sweep.tip_slope
        )
        weighted_rows = self.rows_if_held + amplitude_fraction * (
            base_candidate.weighted_rows - self.rows_if_held
        )
        weighted_rows += amplitude_rad * (
            sine_factor * first_sweep.weighted_rows + cosine_factor * second_sweep.weighted_rows
        )
        leading_band = (
            base_candidate.bands_and_amplitudes[0][0]
            if base_candidate.bands_and_amplitudes
            else sweep_band
        )
        information_value = self.information_to_horizon(
            leading_band, weighted_rows, tip_slope_fractions, base_candidate.duration_s
        )
        return SegmentCandidate(
            base_candidate.duration_s,
            (
                *(
                    (base_part, amplitude_fraction * part_amplitude)
                    for base_part, part_amplitude in base_candidate.bands_and_amplitudes
                ),
                (sweep_band, amplitude_rad),
            ),
            (
                *(
                    (amplitude_fraction * sweep_factor, base_sweep)
                    for sweep_factor, base_sweep in base_candidate.amplitudes_and_sweeps
                ),
                (amplitude_rad * sine_factor, first_sweep),
                (amplitude_rad * cosine_factor, second_sweep),
            ),
            base_channels + amplitude_rad * unit_channels,
            weighted_rows,
            tip_slope_fractions,
            information_value,
        )

    def information_to_horizon(
        self,
        sweep_band: SweepBand,
        weighted_rows: RealArray,
        tip_slope_fractions: RealArray,
        duration_s: float,
    ) -> float:
        """Return the information up to the planning horizon from a segment and the time after it.

        After the segment the motor holds the amplitude that the band's mode has at its end.
        """
        first_sample = self.to_model_samples(duration_s)
        remaining_samples = self.sample_count - first_sample
        continued_drive = self.continued_drive(sweep_band)
        mode_amplitudes = (
            self.amplitude_matrix
            @ tip_slope_fractions[first_sample : first_sample + self.amplitude_matrix.shape[1]]
        )
        mode_row = 2 * [beam_mode.mode for beam_mode in self.modes].index(sweep_band.mode_number)
        drive_factors = (
            continued_drive.drive_per_amplitude @ mode_amplitudes[mode_row : mode_row + 2]
        )
        rows_within_segment = weighted_rows[:, :first_sample]
        rows_after_segment = weighted_rows[:, first_sample:] + np.tensordot(
            drive_factors, continued_drive.weighted_rows[:, :, :remaining_samples], axes=1
        )
        return float(
            np.vdot(rows_within_segment, rows_within_segment)
            + np.vdot(rows_after_segment, rows_after_segment)
        )

    @cached_property
    def amplitude_matrix(self) -> RealArray:
        """Matrix that maps one second of the tip's slope to the modes' complex amplitudes.

        The shape is (2 m, n), with a row each for real and imaginary part of the m amplitudes.
        """
        time_s = np.arange(self.to_model_samples(_MODE_OBSERVATION_S)) / self.model.sample_hz
        free_oscillations = np.exp(
            np.outer([beam_mode.at_rad_s for beam_mode in self.modes], time_s)
        )
        decay_rows = np.stack([free_oscillations.real, -free_oscillations.imag], axis=1).reshape(
            -1, time_s.size
        )
        return np.linalg.pinv(decay_rows.T)

    def continued_drive(self, sweep_band: SweepBand) -> ContinuedDrive:
        """Return the response to exciting a band's mode by a sine up to the planning horizon."""
        if sweep_band.middle_hz not in self._continued_drives:
            duration_s = PLANNING_HORIZON_S - SEGMENT_DURATIONS_S[0]
            sine_pair = self.sweep_pair(replace(sweep_band, half_width_hz=0.0), duration_s)
            weighted_rows = np.stack([sine_sweep.weighted_rows for sine_sweep in sine_pair])
            driven_mode = next(
                beam_mode for beam_mode in self.modes if beam_mode.mode == sweep_band.mode_number
            )
            end_sample = self.to_model_samples(duration_s - SWEEP_FADE_S)
            tail_slice = slice(end_sample - self.to_model_samples(_MODE_OBSERVATION_S), end_sample)
            time_s = np.arange(tail_slice.start, tail_slice.stop) / self.model.sample_hz
            # Fraction of the steady amplitude that the mode has reached by then.
            ring_up_fraction = 1.0 - np.exp(
                driven_mode.at_rad_s.real * (time_s - 0.5 * SWEEP_FADE_S)
            )
            oscillation = np.exp(1j * driven_mode.at_rad_s.imag * time_s)
            oscillation_columns = (
                np.stack([oscillation.real, -oscillation.imag], axis=1) * ring_up_fraction[:, None]
            )
            tip_slopes = np.stack(
                [sine_sweep.tip_slope[tail_slice] for sine_sweep in sine_pair], axis=1
            )
            drive_per_amplitude = np.linalg.inv(np.linalg.lstsq(oscillation_columns, tip_slopes)[0])
            self._continued_drives[sweep_band.middle_hz] = ContinuedDrive(
                weighted_rows, drive_per_amplitude
            )
        return self._continued_drives[sweep_band.middle_hz]

    def segment(self, chosen_candidate: SegmentCandidate, time_left_s: float) -> Segment:
        """Return a candidate as a segment, with the standard deviations expected after it."""
        estimate, quantities = self.estimate, self.quantities
        segment_samples = self.to_model_samples(chosen_candidate.duration_s)
        segment_channels = chosen_candidate.weighted_sum("limit_fractions")
        vibration_channels = self.vibration_fractions[:, : segment_channels.shape[1]]
        # Between the checked ticks a peak is a little higher.
        amplitude_fraction = min(1.0, largest_factor(vibration_channels, segment_channels))
        present_covariance = covariance_of(self.record.information_after(None, 0), estimate)
        later_covariance = covariance_of(
            self.record.information_after(
                amplitude_fraction * chosen_candidate.weighted_sum("torque_derivatives"),
                segment_samples,
            ),
            estimate,
        )
        return Segment(
            name=describe_candidate(chosen_candidate),
            reference_rad=amplitude_fraction * chosen_candidate.weighted_sum("reference_rad"),
            angle_rad=amplitude_fraction * chosen_candidate.weighted_sum("angle_rad"),
            parameter_names=estimate.free_parameters,
            covariance=later_covariance,
            present_precisions=quantities.precisions(present_covariance),
            expected_precisions=quantities.precisions(later_covariance),
            forecast=self.forecast(time_left_s),
            fraction_of_limits=MAX_PLANNED_LIMIT_FRACTION
            * self.limit_fraction
            * float(np.abs(vibration_channels + amplitude_fraction * segment_channels).max()),
        )

    def _mixture_time_s(self) -> float:
        """Return the time in s that segments need for the information of the best mixture."""
        ring_up_s = time_with_ring_up(self.mixture.times_s, self.line_hz, self.modes)
        return ring_up_s / _SINE_MIXTURE_EFFICIENCY

    def forecast(self, time_left_s: float) -> PrecisionForecast:
        """Return the forecast of the time in s until all target standard deviations are reached."""
        impossible_reasons = [
            precision.impossible_reason
            for precision in self.quantities.quantity_precisions
            if precision.impossible_reason
        ]
        if impossible_reasons:
            return PrecisionForecast(inf, impossible_reasons[0])
        forecast_s = self.mixture_duration_s
        if not forecast_s < UNREACHABLE_TIME_S:
            return PrecisionForecast(inf, "the motor cannot excite the modes that determine it")
        if forecast_s <= time_left_s:
            return PrecisionForecast(forecast_s, "")
        return PrecisionForecast(
            forecast_s, f"about {forecast_s:.0f} s are needed, and {time_left_s:.0f} s are left"
        )
