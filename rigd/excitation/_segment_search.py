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
from rigd.excitation._fisher_information import (
    RecordSoFar,
    TorqueModel,
    covariance_of,
    responses,
    whitened_kernels,
)
from rigd.excitation._shortest_move import MovePlant
from rigd.excitation._signals import LIMIT_FRACTION, ExcitationError
from rigd.excitation.moves import quintic
from rigd.excitation.targets import Precision, Quantities

Real = NDArray[np.float64]

DURATIONS_S: Final = (1.0, 1.5, 2.0, 3.0)
"""Durations in s of the candidate segments."""
SHORTEST_S: Final = DURATIONS_S[0]
"""Duration in s of the shortest segment."""

_FADE_S: Final = 0.25
"""Shortest duration in s of a sweep's fade at either end."""
_SETTLING_S: Final = 0.25
"""Time in s after a segment for which its response is checked against the limits."""
_TAIL_S: Final = 1.0
"""Time in s after a segment over which the vibration of the modes is separated, and the modes that
the segment does not excite are brought to rest."""
HORIZON_S: Final = 8.0
"""Planning horizon in s from the start of a segment. A mode gives information on its damping only
after it has rung for a while."""
_HALF_WIDTH_HZ: Final = 0.5
"""Half the width in Hz of a narrow sweep through a mode."""
_RESONANCE_HALF_WIDTHS: Final = 2.0
"""Half the width of a sweep over a whole resonance, in half-power half-widths of the mode."""
_SIDE_OFFSET: Final = 0.06
"""Distance of the off-resonance sweeps from a mode, relative to its frequency. They determine
stiffness and tool inertia, without which the height of a resonance does not give the damping."""
_SINE_OFFSETS: Final = (-4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0)
"""Distances of the forecast's steady sines from a mode, in half-power half-widths of the mode."""
_PHASE_COUNT: Final = 8
"""Number of phases of a sweep that are compared."""
_BASE_AMPLITUDE_FACTORS: Final = (1.0, 0.8, 0.5)
"""Factors by which a segment's amplitude is multiplied when a further band is added to it."""
_MIXTURE_STEPS: Final = 60
"""Number of multiplicative steps in the search for a mixture of steady sines."""
_MIXTURE_EFFICIENCY: Final = 0.7
"""Time of a mixture of steady sines over the time of segments with the same information, whose
modes have to ring up (measured)."""
_UNREACHABLE_S: Final = 1e5
"""Time in s above which the targets count as never reached."""
_MAX_RELAXATIONS: Final = 3
"""Largest number of times that the targets are relaxed to fit into the remaining time."""
_LIMIT_CHECK_TICKS: Final = 4
"""Number of ticks from one check of the limits to the next while candidates are compared."""


@dataclass(frozen=True, slots=True)
class PrecisionForecast:
    """Forecast of the time until all target precisions are reached."""

    seconds: float
    """Time in s until all targets are reached with the best segments; infinite: never."""
    reason: str
    """Reason why the targets are not reached in the remaining time; empty if they are reached."""


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Planned segment of excitation, with the precision expected from it.

    It begins and ends with angle, speed and acceleration zero.
    """

    name: str
    """Modes, frequencies, duration and amplitudes, as text for the operator."""
    reference_rad: Real
    """Reference angle at each tick, relative to the start angle; shape (n,)."""
    angle_rad: Real
    """Predicted angle of the motor at each tick; shape (n,)."""
    names: tuple[str, ...]
    """Names of the free parameters, in the order of the covariance."""
    covariance: Real
    """Covariance of the free parameters that is expected at the end of the segment, shape (k, k);
    see `information` for their units."""
    now: tuple[Precision, ...]
    """Precision of each target that is expected at the beginning of the segment."""
    expected: tuple[Precision, ...]
    """Precision of each target that is expected at the end of the segment."""
    forecast: PrecisionForecast
    """Forecast of the time from the beginning of the segment until all targets are reached."""
    fraction_of_limits: float
    """Largest predicted fraction of a limit, or of the largest slope of the tip, including the
    vibration from before the segment."""


# Sweeps of which segments consist


@dataclass(frozen=True, slots=True)
class _SweepBand:
    """Band of frequencies that a candidate sweep covers, and the mode that it excites."""

    mode_number: int
    """Number of the mode, from 1."""
    middle_hz: float
    """Centre of the band in Hz."""
    half_width_hz: float
    """Half the width of the band in Hz; 0: a sine."""
    fade_s: float
    """Duration in s of the fade at either end of the sweep."""
    at_mode: bool = True
    """Whether the band is centred at the mode, not on one side of it."""


@dataclass(frozen=True, slots=True, eq=False)
class _UnitSweep:
    """Reference and predicted response of a sweep of amplitude 1 rad in one phase."""

    reference_rad: Real
    """Reference angle at each tick of the segment; shape (n,)."""
    angle_rad: Real
    """Predicted angle of the motor at each tick of the segment; shape (n,)."""
    rows: Real
    """Whitened derivatives of the torque by the free parameters from the beginning of the segment;
    shape (k, samples)."""
    weighted: Real
    """Combinations of these derivatives with the weights of the mixture; shape (q, samples)."""
    channels: Real
    """Limited quantities, such as speed and torque, as fractions of their limits; shape
    (6, ticks)."""
    slope: Real
    """Slope of the tip up to the planning horizon, as a fraction of its limit; shape (samples,)."""


@dataclass(frozen=True, slots=True, eq=False)
class _SegmentCandidate:
    """Candidate for the next segment, at the largest amplitude that the limits allow."""

    duration_s: float
    """Duration of the segment in s."""
    parts: tuple[tuple[_SweepBand, float], ...]
    """Bands of the segment, and their amplitudes in rad."""
    terms: tuple[tuple[float, _UnitSweep], ...]
    """Amplitudes in rad and unit sweeps, whose sum of products is the segment."""
    channels: Real
    """Limited quantities as fractions of their limits, at one tick in `_LIMIT_CHECK_TICKS`; shape
    (6, ticks)."""
    weighted: Real
    """Combinations of the torque's derivatives with the weights of the mixture; shape
    (q, samples)."""
    tip_slope: Real
    """Slope of the tip as a fraction of its limit; shape (samples,)."""
    value: float
    """Information up to the planning horizon if the first band is driven on after the segment, as
    the time in s in which the best mixture would give it."""

    def weighted_sum(self, name: str) -> Real:
        """Return an array of the whole segment: the weighted sum of an attribute of its sweeps.

        `name` is an attribute of `_UnitSweep`.
        """
        values: Real = sum(factor * getattr(sweep, name) for factor, sweep in self.terms)
        return values


@dataclass(frozen=True, slots=True, eq=False)
class _ContinuedDrive:
    """Response to driving a mode further after a segment, in two phases of the sine."""

    weighted: Real
    """Weighted derivatives of the torque for a sine of amplitude 1 rad in either phase; shape
    (2, q, samples)."""
    per_amplitude: Real
    """Amplitudes of the two sines that hold the mode's vibration constant, per real and imaginary
    part of its amplitude; shape (2, 2)."""


class SegmentSearch:
    """Search for the best next segment, with the quantities that all candidates have in common."""

    def __init__(
        self,
        estimate: BeamEstimate,
        quantities: Quantities,
        plant: MovePlant,
        start_rad: float,
        record: RecordSoFar,
        tip_slope_rad: float,
        time_left_s: float = inf,
    ) -> None:
        self.estimate, self.quantities, self.plant = estimate, quantities, plant
        self.record = record
        self.modes = estimate.modes()
        if not self.modes:
            raise ExcitationError(
                f"The estimated beam has no mode below {BAND_HZ:g} Hz that could be driven."
            )
        self.model = TorqueModel.for_records(estimate, plant.rate_hz, record.ringing.shape[1])
        self.samples = record.ahead.shape[1]
        self.limits = LIMIT_FRACTION * np.array(
            [
                max(plant.angle_rad - abs(start_rad), 1e-6),
                plant.velocity_rad_s,
                plant.tracking_error_rad,
                plant.peak_torque_nm - plant.friction_nm,
                plant.coupling_torque_nm,
                tip_slope_rad,
            ]
        )
        # The torque of the remaining vibration acts on the motor that holds, and on the sensor.
        torque_nm, slope_rad = record.ringing
        zeros = np.zeros_like(torque_nm)
        ringing = np.stack([zeros, zeros, zeros, torque_nm, torque_nm, slope_rad])
        self.ringing = ringing / self.limits[:, None]
        self.line_hz, line_rad = self.steady_sines()
        known = record.information_after(None, 0)
        self.mixture = best_mixture(known, estimate, quantities, self.line_hz, line_rad)
        self.needed_s = self.time_with_ring_up() / _MIXTURE_EFFICIENCY
        # With too little time all targets are missed by one factor, not the last mode alone.
        relaxation, needed_s = 1.0, self.needed_s
        for _ in range(_MAX_RELAXATIONS):
            if not time_left_s < needed_s < _UNREACHABLE_S:
                break
            relaxation *= (needed_s / time_left_s) ** 0.5
            self.mixture = best_mixture(
                known, estimate, quantities, self.line_hz, line_rad, relaxation
            )
            needed_s = self.time_with_ring_up() / _MIXTURE_EFFICIENCY
        self.weighted_if_held = self.mixture.weights @ record.nuisance_projection @ record.ahead
        self._continued_drives: dict[float, _ContinuedDrive] = {}
        self.tip_slope = self.ringing[-1, :: self.model.factor][: self.samples]

    def candidate_bands(self) -> list[_SweepBand]:
        """Return the bands that candidate sweeps cover: through every mode, and on either side."""
        bands = []
        for mode in self.modes:
            hz = mode.frequency_hz
            # A sine, a narrow sweep, and one over the whole resonance where that is wider.
            narrow_half_width_hz = min(_HALF_WIDTH_HZ, 0.2 * hz)
            resonance_half_width_hz = min(
                _RESONANCE_HALF_WIDTHS * mode.damping_ratio * hz, 0.2 * hz
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
            bands += [_SweepBand(mode.number, hz, each, _FADE_S) for each in widths_hz]
            # Fades as long as the beat with the mode: a shorter one excites the mode as well.
            bands += [
                _SweepBand(
                    mode.number,
                    (1.0 + step) * hz,
                    0.0,
                    max(_FADE_S, 1.0 / (_SIDE_OFFSET * hz)),
                    False,
                )
                for step in (-_SIDE_OFFSET, _SIDE_OFFSET)
                if (1.0 + step) * hz < BAND_HZ
            ]
        return bands

    def steady_sines(self) -> tuple[Real, Real]:
        """Return the steady sines of the forecast, at the largest amplitudes that limits allow.

        The results are frequencies in Hz and amplitudes of the angle in rad, each of shape (m,).
        """
        steps = [
            (*(mode.damping_ratio * np.array(_SINE_OFFSETS)), -_SIDE_OFFSET, _SIDE_OFFSET)
            for mode in self.modes
        ]
        frequency_hz = np.array(
            [
                mode.frequency_hz * (1.0 + step)
                for mode, of_mode in zip(self.modes, steps, strict=True)
                for step in of_mode
            ]
        )
        frequency_hz = frequency_hz[(frequency_hz > 0.0) & (frequency_hz < BAND_HZ)]
        s = 2j * pi * frequency_hz
        _, response, slope = responses(self.estimate, s)
        # The response to a short pulse gives the torque for the motor's own inertia, and its lag.
        pulse = np.zeros(round(self.plant.rate_hz))
        rise = quintic(0.01, self.plant.rate_hz)
        pulse[: 2 * rise.size] = 1e-3 * np.concatenate([rise, rise[::-1]])
        pulse_response = self.plant.respond(pulse)
        transform = np.exp(-np.outer(s, np.arange(pulse.size) / self.plant.rate_hz))
        angle = transform @ pulse_response.angle_rad
        lag = transform @ (pulse - pulse_response.angle_rad) / angle
        motor_torque = (
            transform @ (pulse_response.torque_nm - pulse_response.coupling_torque_nm) / angle
        )
        fractions = np.abs([np.ones_like(s), s, lag, motor_torque + response, response, slope])
        return frequency_hz, 1.0 / (fractions / self.limits[:, None]).max(axis=0)

    def best_candidate(
        self, time_left_s: float, through: Collection[int] = ()
    ) -> _SegmentCandidate:
        """Return the most informative candidate that fits into `time_left_s`.

        It drives one of the modes in `through`, or any mode if `through` is empty.
        """
        durations_s = [d for d in DURATIONS_S if d <= time_left_s + 1e-9]
        if not durations_s:
            raise ExcitationError(
                f"No segment of excitation fits into {time_left_s:g} s: the shortest takes "
                f"{DURATIONS_S[0]:g} s."
            )
        return max(
            (self.best_of_duration(d, through) for d in durations_s), key=lambda each: each.value
        )

    def best_of_duration(self, duration_s: float, through: Collection[int]) -> _SegmentCandidate:
        """Return the most informative candidate of a given duration.

        The best band comes first; bands of further modes are added if they give more information.
        """
        sweep_pairs = [(band, self.sweep_pair(band, duration_s)) for band in self.candidate_bands()]
        empty_candidate = _SegmentCandidate(
            duration_s,
            (),
            (),
            self.ringing[:, : self.ticks(duration_s + _SETTLING_S) : _LIMIT_CHECK_TICKS],
            self.weighted_if_held,
            self.tip_slope,
            0.0,
        )
        mode_sweeps = {
            band.mode_number: sweep_pair
            for band, sweep_pair in reversed(sweep_pairs)
            if band.at_mode
        }
        # A single line does not show a mode: any smooth response could produce it.
        resonance_bands = {
            band.mode_number: band
            for band, _ in sweep_pairs
            if band.at_mode and band.mode_number in through
        }
        candidates_at_rest = {
            mode_number: self.with_modes_at_rest(empty_candidate, mode_number, mode_sweeps)
            for mode_number in mode_sweeps
        }
        best = max(
            (
                self.with_band(start, 1.0, band, sweep_pair, phase_index)
                for band, sweep_pair in sweep_pairs
                if band.at_mode and (not through or band is resonance_bands.get(band.mode_number))
                for start in (empty_candidate, candidates_at_rest[band.mode_number])
                for phase_index in range(_PHASE_COUNT)
            ),
            key=lambda each: each.value,
        )
        for _ in range(2):
            driven_modes = {band.mode_number for band, _ in best.parts}
            extended_candidates = [
                self.with_band(best, fraction, band, sweep_pair, phase_index)
                for band, sweep_pair in sweep_pairs
                if band.mode_number not in driven_modes
                for fraction in _BASE_AMPLITUDE_FACTORS
                for phase_index in range(0, _PHASE_COUNT, 2)
            ]
            better_candidate = max(extended_candidates, key=lambda each: each.value, default=best)
            if better_candidate.value <= best.value:
                break
            best = better_candidate
        return best

    def ticks(self, time_s: float) -> int:
        """Return a time in s as a number of ticks of the rig."""
        return round(time_s * self.plant.rate_hz)

    def model_samples(self, time_s: float) -> int:
        """Return a time in s as a number of samples of the torque model."""
        return round(time_s * self.model.sample_hz)

    def with_modes_at_rest(
        self,
        start: _SegmentCandidate,
        mode_number: int,
        mode_sweeps: dict[int, tuple[_UnitSweep, _UnitSweep]],
    ) -> _SegmentCandidate:
        """Return a candidate that also brings all modes but one to rest by the segment's end.

        If the limits do not allow that, the modes' vibration is reduced as far as they allow.
        """
        sweeps = [
            sweep
            for other, sweep_pair in mode_sweeps.items()
            if other != mode_number
            for sweep in sweep_pair
        ]
        if not sweeps:
            return start
        first = self.model_samples(start.duration_s)
        tail = slice(first, first + self.model_samples(_TAIL_S))
        # One second of the tip's slope suffices to separate the modes.
        tip_slopes = np.stack([sweep.slope[tail] for sweep in sweeps], axis=1)
        present_slope = self.tip_slope[tail]
        factors = -np.linalg.lstsq(tip_slopes, present_slope)[0]
        unit = sum(
            f * sweep.channels[:, ::_LIMIT_CHECK_TICKS]
            for f, sweep in zip(factors, sweeps, strict=True)
        )
        fraction = min(1.0, largest_factor(start.channels, unit))
        weighted = sum(f * sweep.weighted for f, sweep in zip(factors, sweeps, strict=True))
        return _SegmentCandidate(
            start.duration_s,
            (),
            tuple((fraction * f, sweep) for f, sweep in zip(factors, sweeps, strict=True)),
            start.channels + fraction * unit,
            start.weighted + fraction * weighted,
            start.tip_slope
            + fraction * sum(f * sweep.slope for f, sweep in zip(factors, sweeps, strict=True)),
            0.0,
        )

    def sweep_pair(self, band: _SweepBand, duration_s: float) -> tuple[_UnitSweep, _UnitSweep]:
        """Return two unit sweeps through a band, whose phases differ by a quarter of a period."""
        rate_hz = self.plant.rate_hz
        n = self.ticks(duration_s)
        from_middle_s = np.arange(1, n + 1) / rate_hz - 0.5 * duration_s
        phase = 2 * pi * band.middle_hz * from_middle_s
        phase += 2 * pi * band.half_width_hz * from_middle_s**2 / duration_s
        fade = quintic(min(band.fade_s, 0.4 * duration_s), rate_hz)
        # The motor comes to rest as well before the segment ends.
        last = n - self.ticks(self.plant.settling_s)
        window = np.zeros(n)
        window[:last] = 1.0
        window[: fade.size] = fade
        window[last - fade.size : last] = np.minimum(window[last - fade.size : last], 1.0 - fade)
        return self.unit_sweep(window * np.sin(phase)), self.unit_sweep(window * np.cos(phase))

    def unit_sweep(self, reference_rad: Real) -> _UnitSweep:
        """Return the predicted response to a reference of amplitude 1 rad from rest, shape (n,)."""
        n = reference_rad.size
        extended_reference_rad = np.concatenate(
            [reference_rad, np.zeros(round(_SETTLING_S * self.plant.rate_hz))]
        )
        response = self.plant.respond(extended_reference_rad)
        spectrum = self.model.spectrum(response.angle_rad)
        rows = self.model.whitened_derivatives(spectrum)[:, : self.samples]
        slope_rad = self.model.torque_and_slope(spectrum)[1]
        channels = np.stack(
            [
                response.angle_rad,
                response.velocity_rad_s,
                extended_reference_rad - response.angle_rad,
                response.torque_nm,
                response.coupling_torque_nm,
                slope_rad[: extended_reference_rad.size],
            ]
        )
        return _UnitSweep(
            reference_rad=reference_rad,
            angle_rad=response.angle_rad[:n],
            rows=rows,
            weighted=self.mixture.weights @ rows,
            slope=slope_rad[:: self.model.factor][: self.samples] / self.limits[-1],
            channels=channels / self.limits[:, None],
        )

    def with_band(
        self,
        base: _SegmentCandidate,
        fraction: float,
        band: _SweepBand,
        sweep_pair: tuple[_UnitSweep, _UnitSweep],
        phase_index: int,
    ) -> _SegmentCandidate:
        """Return a candidate with a further band, at the largest amplitude that limits allow.

        The amplitudes of the candidate `base` are multiplied by `fraction`. The phase of the new
        sweep is ``phase_index / _PHASE_COUNT`` of a turn.
        """
        phase_rad = 2 * pi * phase_index / _PHASE_COUNT
        sine, cosine = float(np.cos(phase_rad)), float(np.sin(phase_rad))
        first, second = sweep_pair
        ringing = self.ringing[:, : first.channels.shape[1] : _LIMIT_CHECK_TICKS]
        unit = (
            sine * first.channels[:, ::_LIMIT_CHECK_TICKS]
            + cosine * second.channels[:, ::_LIMIT_CHECK_TICKS]
        )
        before = ringing + fraction * (base.channels - ringing)
        amplitude_rad = largest_factor(before, unit)
        tip_slope = self.tip_slope + fraction * (base.tip_slope - self.tip_slope)
        tip_slope += amplitude_rad * (sine * first.slope + cosine * second.slope)
        weighted = self.weighted_if_held + fraction * (base.weighted - self.weighted_if_held)
        weighted += amplitude_rad * (sine * first.weighted + cosine * second.weighted)
        leading = base.parts[0][0] if base.parts else band
        value = self.information_to_horizon(leading, weighted, tip_slope, base.duration_s)
        return _SegmentCandidate(
            base.duration_s,
            (*((other, fraction * size) for other, size in base.parts), (band, amplitude_rad)),
            (
                *((fraction * factor, sweep) for factor, sweep in base.terms),
                (amplitude_rad * sine, first),
                (amplitude_rad * cosine, second),
            ),
            before + amplitude_rad * unit,
            weighted,
            tip_slope,
            value,
        )

    def information_to_horizon(
        self, band: _SweepBand, weighted: Real, tip_slope: Real, duration_s: float
    ) -> float:
        """Return the information up to the planning horizon if a mode is driven after a segment.

        The motor then holds the amplitude that the mode has at the end of the segment.
        """
        first = self.model_samples(duration_s)
        remaining_samples = self.samples - first
        continued_drive = self.continued_drive(band)
        amplitudes = (
            self.amplitude_matrix @ tip_slope[first : first + self.amplitude_matrix.shape[1]]
        )
        index = 2 * [mode.number for mode in self.modes].index(band.mode_number)
        factors = continued_drive.per_amplitude @ amplitudes[index : index + 2]
        before = weighted[:, :first]
        after = weighted[:, first:] + np.tensordot(
            factors, continued_drive.weighted[:, :, :remaining_samples], axes=1
        )
        return float(np.vdot(before, before) + np.vdot(after, after))

    @cached_property
    def amplitude_matrix(self) -> Real:
        """Matrix from one second of the tip's slope to the modes' complex amplitudes.

        The shape is (2 m, n), with a row each for real and imaginary part of the m amplitudes.
        """
        time_s = np.arange(self.model_samples(_TAIL_S)) / self.model.sample_hz
        free = np.exp(np.outer([mode.pole_rad_s for mode in self.modes], time_s))
        columns = np.stack([free.real, -free.imag], axis=1).reshape(-1, time_s.size)
        return np.linalg.pinv(columns.T)

    def continued_drive(self, band: _SweepBand) -> _ContinuedDrive:
        """Return the response to driving the mode of a band by a sine up to the horizon."""
        if band.middle_hz not in self._continued_drives:
            duration_s = HORIZON_S - DURATIONS_S[0]
            sweeps = self.sweep_pair(replace(band, half_width_hz=0.0), duration_s)
            weighted = np.stack([sweep.weighted for sweep in sweeps])
            mode = next(each for each in self.modes if each.number == band.mode_number)
            last = self.model_samples(duration_s - _FADE_S)
            window = slice(last - self.model_samples(_TAIL_S), last)
            time_s = np.arange(window.start, window.stop) / self.model.sample_hz
            # Fraction of the steady amplitude that the mode has reached by then.
            ring_up_fraction = 1.0 - np.exp(mode.pole_rad_s.real * (time_s - 0.5 * _FADE_S))
            oscillation = np.exp(1j * mode.pole_rad_s.imag * time_s)
            columns = (
                np.stack([oscillation.real, -oscillation.imag], axis=1) * ring_up_fraction[:, None]
            )
            slopes = np.stack([sweep.slope[window] for sweep in sweeps], axis=1)
            per_amplitude = np.linalg.inv(np.linalg.lstsq(columns, slopes)[0])
            self._continued_drives[band.middle_hz] = _ContinuedDrive(weighted, per_amplitude)
        return self._continued_drives[band.middle_hz]

    def segment(self, chosen: _SegmentCandidate, time_left_s: float) -> Segment:
        """Return the chosen candidate as a segment, with the precisions expected from it."""
        estimate, quantities = self.estimate, self.quantities
        samples = self.model_samples(chosen.duration_s)
        channels = chosen.weighted_sum("channels")
        ringing = self.ringing[:, : channels.shape[1]]
        # Between the checked ticks a peak is a little higher.
        fraction = min(1.0, largest_factor(ringing, channels))
        now = covariance_of(self.record.information_after(None, 0), estimate)
        after = covariance_of(
            self.record.information_after(fraction * chosen.weighted_sum("rows"), samples), estimate
        )
        return Segment(
            name=_describe_candidate(chosen),
            reference_rad=fraction * chosen.weighted_sum("reference_rad"),
            angle_rad=fraction * chosen.weighted_sum("angle_rad"),
            names=estimate.names,
            covariance=after,
            now=quantities.precisions(now),
            expected=quantities.precisions(after),
            forecast=self.forecast(time_left_s),
            fraction_of_limits=LIMIT_FRACTION * float(np.abs(ringing + fraction * channels).max()),
        )

    def time_with_ring_up(self) -> float:
        """Return the time in s of the best mixture, plus the time in which its modes ring up.

        The information on the damping grows as ``1 - exp(-t / tau)`` at a constant amplitude.
        """
        times_s = self.mixture.times_s
        needed_s = float(times_s.sum())
        grid = np.geomspace(1e-3, 1e3, 400)
        information_gain = grid - 2.0 * (1.0 - np.exp(-grid)) + 0.5 * (1.0 - np.exp(-2.0 * grid))
        for mode in self.modes:
            range_hz = 1.5 * _SINE_OFFSETS[-1] * mode.damping_ratio * mode.frequency_hz
            at_mode_s = float(times_s[np.abs(self.line_hz - mode.frequency_hz) < range_hz].sum())
            decay_s = -1.0 / mode.pole_rad_s.real
            if at_mode_s > 0.01 * needed_s:
                needed_s += (
                    decay_s * float(np.interp(at_mode_s / decay_s, information_gain, grid))
                    - at_mode_s
                )
        return needed_s

    def forecast(self, time_left_s: float) -> PrecisionForecast:
        """Forecast the time until all targets are reached."""
        impossible = [each.impossible for each in self.quantities.items if each.impossible]
        if impossible:
            return PrecisionForecast(inf, impossible[0])
        seconds = self.needed_s
        if not seconds < _UNREACHABLE_S:
            return PrecisionForecast(inf, "the motor cannot excite the modes that determine it")
        if seconds <= time_left_s:
            return PrecisionForecast(seconds, "")
        return PrecisionForecast(
            seconds, f"about {seconds:.0f} s are needed, and {time_left_s:.0f} s are left"
        )


# Best mixture of steady sines


@dataclass(frozen=True, slots=True, eq=False)
class SineMixture:
    """Mixture of steady sines that reaches all targets in the shortest time, without ring-up."""

    times_s: Real
    """Time in s for which each sine lasts; shape (m,)."""
    weights: Real
    """Combinations of the torque's derivatives by the parameters, the sum of whose squares is the
    information that brings the targets closer; shape (q, k)."""


def best_mixture(
    information: Real,
    estimate: BeamEstimate,
    quantities: Quantities,
    frequency_hz: Real,
    angle_rad: Real,
    relaxation: float = 1.0,
) -> SineMixture:
    """Return the times of steady sines that together reach all targets soonest.

    Uses multiplicative steps, as `time_fractions`, with a multiplier for each quantity. By the
    equivalence theorem all sines of the best mixture give the same information per second on the
    returned combinations, and no other sine gives more (V. V. Fedorov, Theory of optimal
    experiments, 1972).

    Parameters
    ----------
    information
        Information that the record contains already, shape (k, k).
    estimate
        Beam, damping and noise.
    quantities
        The q target quantities.
    frequency_hz, angle_rad
        Frequencies of the sines and amplitudes of the angle, each of shape (m,).
    relaxation
        Factor by which all standard deviations may exceed their targets.
    """
    rates = _information_rates(estimate, frequency_hz, angle_rad)
    target_stds = np.array(
        [inf if each.impossible else each.target_std for each in quantities.items]
    )
    scaled_gradients = quantities.gradients / (relaxation * target_stds[:, None])
    if not scaled_gradients.any():
        return SineMixture(np.zeros(frequency_hz.size), scaled_gradients)
    multipliers = np.ones(len(scaled_gradients))
    times_s = np.full(frequency_hz.size, 1.0 / frequency_hz.size)
    for _ in range(_MIXTURE_STEPS):
        covariance = covariance_of(information + np.tensordot(times_s, rates, axes=1), estimate)
        lines = scaled_gradients @ covariance
        variances = np.einsum("qi,qi->q", lines, scaled_gradients)
        multipliers = multipliers * np.maximum(variances, 1e-12) ** 0.5
        multipliers /= max(float(multipliers.sum()), 1e-300)
        gain_rates = np.einsum("q,qi,fij,qj->f", multipliers, lines, rates, lines)
        times_s = times_s * np.sqrt(
            gain_rates / max(float(times_s @ gain_rates / times_s.sum()), 1e-300)
        )
        # Scale the total time towards the targets, until they are met or the time is too long.
        times_s *= float(np.clip(np.sqrt(variances.max()), 0.5, 2.0))
        if times_s.sum() > _UNREACHABLE_S:
            break
    scale = np.sqrt(multipliers / max(float(times_s @ gain_rates / times_s.sum()), 1e-300))
    return SineMixture(times_s, scale[:, None] * lines)


def _information_rates(estimate: BeamEstimate, frequency_hz: Real, angle_rad: Real) -> Real:
    """Return the Fisher information per second of each steady sine, shape (m, k, k)."""
    kernels = whitened_kernels(estimate, 2j * pi * frequency_hz, 1.0) * (angle_rad / 2.0**0.5)
    rates: Real = np.einsum("if,jf->fij", kernels, kernels.conj()).real
    return rates


def least_deviations(
    information: Real,
    estimate: BeamEstimate,
    quantities: Quantities,
    frequency_hz: Real,
    angle_rad: Real,
    duration_s: float,
) -> Real:
    """Return the smallest standard deviation that each quantity can have in a record.

    For each quantity the mixture of sines is the best for this quantity alone.

    Parameters
    ----------
    information, estimate, quantities, frequency_hz, angle_rad
        As for `best_mixture`.
    duration_s
        Total duration of all sines in s.

    Returns
    -------
    ndarray, shape (q,)
        Lower bound of each standard deviation for a record of this duration.
    """
    rates = _information_rates(estimate, frequency_hz, angle_rad)
    deviations = np.empty(len(quantities.gradients))
    for row, gradient in enumerate(quantities.gradients):
        times_s = np.full(frequency_hz.size, duration_s / frequency_hz.size)
        for _ in range(_MIXTURE_STEPS):
            total = information + np.tensordot(times_s, rates, axes=1)
            line = gradient @ covariance_of(total, estimate)
            deviations[row] = np.sqrt(max(float(line @ gradient), 0.0))
            times_s = times_s * np.sqrt(np.einsum("i,fij,j->f", line, rates, line))
            times_s *= duration_s / max(float(times_s.sum()), 1e-300)
    return deviations


def largest_factor(before: Real, unit: Real) -> float:
    """Return the largest factor by which a motion can be added without exceeding the limits.

    All quantities are fractions of their limits, so the sum must be between -1 and 1. If the
    existing motion exceeds this range by itself, the sum may be as large, but no larger.

    Parameters
    ----------
    before, unit
        Quantities of the existing motion and of the added motion, shape (c, n).
    """
    size = np.abs(unit)
    margin = np.maximum(1.0, np.abs(before)) - np.sign(unit) * before
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(size > 1e-9 * size.max(), margin / size, inf)
    return max(float(factor.min()), 0.0)


def _describe_candidate(chosen: _SegmentCandidate) -> str:
    """Return a text for the operator with modes, bands, duration and amplitudes of a segment."""
    parts = sorted(chosen.parts, key=lambda part: part[0].middle_hz)
    bands = [
        f"{band.middle_hz - band.half_width_hz:.3g}–{band.middle_hz + band.half_width_hz:.3g}"
        if band.half_width_hz
        else f"{band.middle_hz:.4g}"
        for band, _ in parts
    ]
    return (
        f"mode{'s' if len(parts) > 1 else ''} "
        f"{' + '.join(str(band.mode_number) for band, _ in parts)}, "
        f"{' + '.join(bands)} Hz, {chosen.duration_s:g} s, "
        f"{' + '.join(f'{size:.2g}' for _, size in parts)} rad"
    )
