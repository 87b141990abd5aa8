"""Reference signals: chirp, hold, step and multisine, and the segments of every excitation."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite, pi
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
from annotated_types import doc
from numpy.typing import NDArray

from rigd.errors import UserError
from rigd.excitation._options import RestS, RingDownS, documented
from rigd.session import linear_sweep_band_hz, sweep_frequency_hz
from rigd.session.limits import MAX_RECORDED_SAMPLES, MAX_SAMPLES
from rigd.units import is_usable_size

if TYPE_CHECKING:
    from rigd.identified_beam import IdentifiedBeam

FloatArray = NDArray[np.float64]

MIN_SAMPLES_PER_PERIOD = 4
"""Smallest number of samples in a period of the reference; with fewer samples the reference no
longer resembles a sine."""

MAX_PLANNED_LIMIT_FRACTION = 0.9
"""Largest fraction of each of the rig's limits that the predicted motion may use. The remainder is
for a beam that differs from the predicted beam."""

_BLOCK_TICKS: Final = 1 << 16
"""Number of ticks of a sweep that are computed at once."""


class ExcitationError(UserError, ValueError):
    """Error of an invalid option of an excitation.

    The message states option, value, unit and remedy.
    """


@dataclass(frozen=True, slots=True)
class Excitation:
    """Excitation of a session: the reference angle at each tick, with its options and segments.

    Attributes
    ----------
    kind
        ``chirp``, ``hold``, ``step``, ``multisine``, ``file``, ``modes``, ``move``, ``touch`` or
        ``until``.
    parameters
        The options, and quantities derived from them, with units in the names.
    rate_hz
        Ticks a second.
    reference_rad
        Reference angle at each tick, relative to the start angle; shape (n,), read-only.
    segments
        First tick and end (exclusive) of ``rest``, ``sweep`` and ``ring_down``. A chirp there and
        back also has ``there`` and ``back``, the two sweeps in ``sweep``.
    stays
        Whether the motor stays at the end of the reference. Otherwise it returns to the start
        angle.
    model
        Beam of an analysis for which the excitation was planned; None: the profile's beam.
    motion
        Motion of the motor in the sweep, as a clause for the operator; empty if `kind` states it.
    """

    kind: str
    parameters: Mapping[str, float | int | str]
    rate_hz: float
    reference_rad: FloatArray
    segments: Mapping[str, tuple[int, int]]
    stays: bool = False
    model: "IdentifiedBeam | None" = None
    motion: str = ""

    @property
    def shows_modes(self) -> bool:
        """Whether a record of the excitation can show the beam's modes; that of a move cannot."""
        return not self.stays

    @property
    def limits_force(self) -> bool:
        """Whether too large a contact force, derived from the base shear, ends the session."""
        return False

    @property
    def planned_ticks(self) -> int | None:
        """Number of ticks of the reference that are planned before the session; None: all."""
        return None

    @property
    def ends_itself(self) -> bool:
        """Whether the end of the session is determined during the session."""
        return self.planned_ticks is not None

    @property
    def later_tip_slope_rad(self) -> float:
        """Largest slope of the beam's free end in segments planned during the session; 0: none."""
        return 0.0


def present_frequency_hz(excitation: Excitation, tick: int) -> float | None:
    """Return the frequency in Hz of a chirp at a tick.

    Return None outside the sweep, and for all other excitations.

    Parameters
    ----------
    excitation
        Any excitation.
    tick
        Tick of the record.

    Examples
    --------
    >>> from rigd.excitation import chirp, present_frequency_hz
    >>> sweep = chirp(rate_hz=1000, start_hz=0, stop_hz=50, duration_s=100, rest_s=1)
    >>> present_frequency_hz(sweep, 51_000), present_frequency_hz(sweep, 0)
    (25.0, None)
    """
    sweep_ends_hz = linear_sweep_band_hz(excitation.kind, excitation.parameters)
    if sweep_ends_hz is None:
        return None
    return sweep_frequency_hz(excitation.segments, sweep_ends_hz, tick)


# Checks of options


def to_whole_ticks(option_name: str, option_value_s: float, rate_hz: float) -> int:
    """Convert a time in s to ticks; raise `ExcitationError` unless it is a whole number of ticks.

    `option_name` is the name of the option in the message.
    """
    tick_count = round(option_value_s * rate_hz)
    if tick_count < 2 or abs(tick_count / rate_hz - option_value_s) > 1e-9 * option_value_s:
        raise ExcitationError(
            f"{option_name} = {option_value_s:g} s is not a whole number of ticks at "
            f"{rate_hz:g} Hz; choose "
            f"for example {max(tick_count, 2) / rate_hz:g} s."
        )
    return tick_count


def require_finite(option_name: str, option_value: float, unit: str) -> None:
    """Raise `ExcitationError` if an option's value is not finite, or implausible for any rig."""
    if not isfinite(option_value):
        raise ExcitationError(
            f"{option_name} = {option_value} {unit} is not a finite number; give one."
        )
    if not is_usable_size(option_value):
        raise ExcitationError(
            f"{option_name} = {option_value:g} {unit} is not plausible for a rig; check its unit."
        )


def require_positive(option_name: str, option_value: float, unit: str) -> None:
    """Raise `ExcitationError` unless an option's value is a finite number above 0."""
    require_finite(option_name, option_value, unit)
    if option_value <= 0.0:
        raise ExcitationError(
            f"{option_name} = {option_value:g} {unit} must be more than 0 {unit}."
        )


def require_not_negative(option_name: str, option_value: float) -> None:
    """Raise `ExcitationError` unless an option's time is finite and at least 0 s."""
    require_finite(option_name, option_value, "s")
    if option_value < 0.0:
        raise ExcitationError(f"{option_name} = {option_value:g} s must not be negative.")


def require_within_turn(option_name: str, option_value_rad: float) -> None:
    """Raise `ExcitationError` if an option's angle is more than a full turn to either side."""
    if abs(option_value_rad) > 2.0 * pi:
        raise ExcitationError(
            f"{option_name} = {option_value_rad:g} rad is more than a full turn; give an angle in "
            f"rad of at most {2.0 * pi:.3f}."
        )


def require_frequency(
    option_name: str, option_value: float, rate_hz: float, *, zero_allowed: bool = False
) -> None:
    """Raise `ExcitationError` unless a frequency is above 0 Hz and at most a quarter of the rate.

    With `zero_allowed`, 0 Hz is valid as well.
    """
    require_finite(option_name, option_value, "Hz")
    max_frequency_hz = rate_hz / MIN_SAMPLES_PER_PERIOD
    if not (option_value > 0.0 or (zero_allowed and option_value == 0.0)):
        bound_text = "must not be negative" if zero_allowed else "must be more than 0 Hz"
        raise ExcitationError(f"{option_name} = {option_value:g} Hz {bound_text}.")
    if option_value > max_frequency_hz:
        raise ExcitationError(
            f"{option_name} = {option_value:g} Hz leaves fewer than {MIN_SAMPLES_PER_PERIOD} "
            f"samples per period at {rate_hz:g} Hz; choose at most {max_frequency_hz:g} Hz."
        )


# Segments


def lay_out_segments(
    rate_hz: float,
    rest_s: float,
    duration_s: float,
    ring_down_s: float,
    *,
    max_samples: int = MAX_SAMPLES,
) -> dict[str, tuple[int, int]]:
    """Return the first tick and the tick after the last of rest, sweep and ring-down, by name.

    The times are rounded to ticks, and the rounding changes the length of the ring-down only. More
    than `max_samples` are refused.
    """
    require_not_negative("rest_s", rest_s)
    require_positive("duration_s", duration_s, "s")
    require_not_negative("ring_down_s", ring_down_s)
    rest_and_ring_down_s = rest_s + ring_down_s
    check_ticks(
        "The session",
        (duration_s + rest_and_ring_down_s) * rate_hz,
        rate_hz,
        rest_and_ring_down_s,
        max_samples=max_samples,
    )
    sweep_begin = round(rate_hz * rest_s)
    sweep_end = sweep_begin + round(rate_hz * duration_s)
    record_end = max(sweep_end, round(rate_hz * (rest_s + duration_s + ring_down_s)))
    if sweep_end - sweep_begin < 2:
        raise ExcitationError(
            f"duration_s = {duration_s:g} s is less than two ticks at {rate_hz:g} Hz; choose at "
            f"least {2 / rate_hz:g} s."
        )
    return {
        "rest": (0, sweep_begin),
        "sweep": (sweep_begin, sweep_end),
        "ring_down": (sweep_end, record_end),
    }


def check_ticks(
    message_start: str,
    tick_count: float,
    rate_hz: float,
    rest_and_ring_down_s: float = 0.0,
    *,
    max_samples: int = MAX_SAMPLES,
) -> None:
    """Raise `ExcitationError` if a record has more ticks than can be analysed.

    `message_start` is the subject of the message, and `rest_and_ring_down_s` the total duration of
    rest and ring-down.
    """
    if tick_count > max_samples:
        max_duration_s = max_samples / rate_hz
        limit_text = (
            f" ({max_duration_s - rest_and_ring_down_s:g} s between rest and ring-down)"
            if 0.0 < rest_and_ring_down_s < max_duration_s
            else ""
        )
        raise ExcitationError(
            f"{message_start} would take {tick_count / rate_hz:g} s; {max_duration_s:g} s is the "
            f"most at {rate_hz:g} Hz{limit_text}, because no more than {max_samples} samples of it "
            "can be analysed: shorten it or run several sessions."
        )


def assemble_excitation(
    kind: str,
    parameters: Mapping[str, float | int | str],
    rate_hz: float,
    segments: Mapping[str, tuple[int, int]],
    sweep_rad: FloatArray,
    *,
    motion: str = "",
) -> Excitation:
    """Return an excitation with a sweep, shape (n,) in rad, between rest and ring-down."""
    reference_rad = assemble_reference(segments, sweep_rad)
    return Excitation(kind, parameters, rate_hz, reference_rad, segments, motion=motion)


def assemble_reference(
    segments: Mapping[str, tuple[int, int]], sweep_rad: FloatArray
) -> FloatArray:
    """Return the reference in rad at each tick of rest, sweep and ring-down, read-only."""
    reference_rad = np.zeros(segments["ring_down"][1])
    reference_rad[slice(*segments["sweep"])] = sweep_rad
    reference_rad[slice(*segments["ring_down"])] = sweep_rad[-1]
    reference_rad.flags.writeable = False
    return reference_rad


# Signals


@documented
def chirp(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    amplitude_rad: Annotated[float, doc("Amplitude A.")] = 0.025,
    start_hz: Annotated[float, doc("Frequency f0 at the sweep's first tick.")] = 0.05,
    stop_hz: Annotated[
        float, doc("Frequency f1 at the sweep's end; f1 < f0 sweeps downwards.")
    ] = 50.0,
    duration_s: Annotated[
        float,
        doc("Duration T of a sweep in s; with ``there_and_back``, of each of the two sweeps."),
    ] = 120.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
    taper_s: Annotated[
        float,
        doc(
            "Duration in s of the raised-cosine fade at both ends of the sweep; 0, as in the "
            "paper: no fade."
        ),
    ] = 0.0,
    there_and_back: Annotated[
        int,
        doc(
            "1: two sweeps, the second from f1 to f0, so that each mode is passed twice and a "
            "change over time is visible; 0: one sweep."
        ),
    ] = 0,
) -> Excitation:
    """Return a chirp: a sine whose frequency changes linearly with time.

    The sweep is ``A sin 2π(f0 t + (f1 - f0) t²/(2 T))``, with t from its first tick. The defaults
    are the paper's experiment (Section 5). With ``there_and_back`` the frequency returns to f0 in
    the same time, with continuous angle and speed at the turn.

    Raises
    ------
    ExcitationError
        If an option is not finite, out of range, or does not fit the rate.

    Examples
    --------
    >>> from rigd.excitation import chirp
    >>> sweep = chirp(rate_hz=1000)  # the paper's
    >>> sweep.segments
    {'rest': (0, 1000), 'sweep': (1000, 121000), 'ring_down': (121000, 136000)}
    """
    require_positive("amplitude_rad", amplitude_rad, "rad")
    require_within_turn("amplitude_rad", amplitude_rad)
    require_frequency("start_hz", start_hz, rate_hz, zero_allowed=True)
    require_frequency("stop_hz", stop_hz, rate_hz)
    if there_and_back not in (0, 1):
        raise ExcitationError(
            f"there_and_back = {there_and_back} must be 0 (one sweep) or 1 (two sweeps)."
        )
    segment_ticks = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    if there_and_back:
        outward_ticks = segment_ticks["sweep"]
        segment_ticks = lay_out_segments(rate_hz, rest_s, 2.0 * duration_s, ring_down_s)
        return_ticks = outward_ticks[1], segment_ticks["sweep"][1]
        segment_ticks |= {"there": outward_ticks, "back": return_ticks}

    def angle_at(t: FloatArray) -> FloatArray:
        # Time on the way there and on the way back, where the phase goes on from the turn.
        outward_s, return_s = np.minimum(t, duration_s), np.maximum(t - duration_s, 0.0)
        phase_rad = (
            2.0
            * pi
            * (start_hz * outward_s + (stop_hz - start_hz) * outward_s**2 / (2.0 * duration_s))
        )
        phase_rad += (
            2.0
            * pi
            * (stop_hz * return_s - (stop_hz - start_hz) * return_s**2 / (2.0 * duration_s))
        )
        taper_factors = _taper_factors(t, (1 + there_and_back) * duration_s, taper_s)
        angle_rad: FloatArray = amplitude_rad * np.sin(phase_rad) * taper_factors
        return angle_rad

    sweep_rad = _sweep_in_blocks(segment_ticks, rate_hz, angle_at)
    parameters = {
        "amplitude_rad": amplitude_rad,
        "start_hz": start_hz,
        "stop_hz": stop_hz,
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "taper_s": taper_s,
        **({"there_and_back": 1} if there_and_back else {}),
    }
    direction_text = " down" if stop_hz < start_hz else ""
    return_text = f" and back, {duration_s:g} s each way" if there_and_back else ""
    motion = f"sweeps{direction_text} from {start_hz:g} to {stop_hz:g} Hz{return_text}"
    return assemble_excitation(
        "chirp", parameters, rate_hz, segment_ticks, sweep_rad, motion=motion
    )


@documented
def hold(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    duration_s: Annotated[float, doc("Duration of the segment ``sweep`` in s.")] = 10.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 0.0,
) -> Excitation:
    """Return an excitation that holds the start angle, to record noise and drift of the sensor.

    Raises
    ------
    ExcitationError
        If an option is not finite or out of range.

    Examples
    --------
    >>> from rigd.excitation import hold
    >>> hold(rate_hz=1000, duration_s=2.0).segments
    {'rest': (0, 1000), 'sweep': (1000, 3000), 'ring_down': (3000, 3000)}
    """
    segment_ticks = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    parameters = {"duration_s": duration_s, "rest_s": rest_s, "ring_down_s": ring_down_s}
    sweep_rad = np.zeros(segment_ticks["sweep"][1] - segment_ticks["sweep"][0])
    return assemble_excitation("hold", parameters, rate_hz, segment_ticks, sweep_rad)


@documented
def step(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    amplitude_rad: Annotated[float, doc("Angle of the step, of either sign and not 0.")] = 0.025,
    duration_s: Annotated[float, doc("Duration of the segment ``sweep`` in s.")] = 10.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
) -> Excitation:
    """Return an excitation with a step of the reference angle at the sweep's first tick.

    Raises
    ------
    ExcitationError
        If an option is not finite or out of range.

    Examples
    --------
    >>> from rigd.excitation import step
    >>> step(rate_hz=1000, amplitude_rad=0.01).reference_rad[[999, 1000, -1]]
    array([0.  , 0.01, 0.01])
    """
    require_finite("amplitude_rad", amplitude_rad, "rad")
    if amplitude_rad == 0.0:
        raise ExcitationError(
            "amplitude_rad = 0 rad is not a step; give an angle other than zero, or use hold."
        )
    require_within_turn("amplitude_rad", amplitude_rad)
    segment_ticks = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    parameters = {
        "amplitude_rad": amplitude_rad,
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
    }
    sweep_rad = np.full(segment_ticks["sweep"][1] - segment_ticks["sweep"][0], amplitude_rad)
    return assemble_excitation("step", parameters, rate_hz, segment_ticks, sweep_rad)


@documented
def multisine(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    amplitude_rad: Annotated[float, doc("Largest magnitude of the reference.")] = 0.025,
    start_hz: Annotated[float, doc("Lowest frequency of the band.")] = 0.05,
    stop_hz: Annotated[float, doc("Highest frequency of the band.")] = 50.0,
    period_s: Annotated[
        float,
        doc("Period in s, a whole number of ticks. ``duration_s`` is a whole number of periods."),
    ] = 20.0,
    duration_s: Annotated[float, doc("Duration of the segment ``sweep`` in s.")] = 120.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
    taper_s: Annotated[
        float,
        doc(
            "Duration in s of the raised-cosine fade at both ends of the whole sweep. The "
            "periods with a fade differ from the others."
        ),
    ] = 0.0,
    seed: Annotated[int, doc("Seed of the phases: equal seeds give equal references.")] = 0,
) -> Excitation:
    """Return a random-phase multisine: equal amplitudes on every harmonic of 1/period in a band.

    The period is shifted so that it begins at its smallest magnitude (the spectrum's magnitude
    stays flat), and scaled to the peak ``amplitude_rad``. ``parameters["crest_factor"]`` is its
    crest factor, peak over rms.

    Raises
    ------
    ExcitationError
        If an option is not finite, out of range, or does not fit the others.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.excitation import multisine
    >>> signal = multisine(rate_hz=1000, amplitude_rad=0.01, stop_hz=20, period_s=10, duration_s=20)
    >>> print(f"peak {np.abs(signal.reference_rad).max():.3f} rad")
    peak 0.010 rad
    >>> print(f"crest factor {signal.parameters['crest_factor']:.2f}")
    crest factor 3.30
    """
    require_positive("amplitude_rad", amplitude_rad, "rad")
    require_within_turn("amplitude_rad", amplitude_rad)
    require_frequency("start_hz", start_hz, rate_hz, zero_allowed=True)
    require_frequency("stop_hz", stop_hz, rate_hz)
    require_positive("period_s", period_s, "s")
    if seed < 0:
        raise ExcitationError(f"seed = {seed} is negative; give a whole number from 0 on.")
    # Its periods are equal, so a long record is analysed in blocks.
    segment_ticks = lay_out_segments(
        rate_hz, rest_s, duration_s, ring_down_s, max_samples=MAX_RECORDED_SAMPLES
    )
    period_ticks = to_whole_ticks("period_s", period_s, rate_hz)
    period_count = round(duration_s / period_s)
    if period_count < 1 or abs(period_count * period_s - duration_s) > 1e-9 * duration_s:
        raise ExcitationError(
            f"duration_s = {duration_s:g} s is not a whole number of periods of "
            f"period_s = {period_s:g} s; choose for example {max(period_count, 1) * period_s:g} s."
        )
    period_rad = amplitude_rad * _random_phase_period(
        period_ticks, period_s, (start_hz, stop_hz), seed
    )
    crest_factor = amplitude_rad / float(np.sqrt(np.mean(period_rad**2)))
    sweep_rad = _sweep_in_blocks(
        segment_ticks,
        rate_hz,
        lambda t: (
            period_rad[np.rint(t * rate_hz).astype(np.intp) % period_ticks]
            * _taper_factors(t, duration_s, taper_s)
        ),
    )
    parameters = {
        "amplitude_rad": amplitude_rad,
        "start_hz": start_hz,
        "stop_hz": stop_hz,
        "period_s": period_s,
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "taper_s": taper_s,
        "seed": seed,
        "crest_factor": crest_factor,
    }
    return assemble_excitation("multisine", parameters, rate_hz, segment_ticks, sweep_rad)


def _random_phase_period(
    tick_count: int, period_s: float, band_hz: tuple[float, float], seed: int
) -> FloatArray:
    """Return one period of the multisine with peak 1, which starts near 0, (tick_count,)."""
    frequency_hz = np.arange(1, tick_count // 2) / period_s
    tolerance_hz = 1e-9 * band_hz[1]
    is_in_band = (frequency_hz >= band_hz[0] - tolerance_hz) & (
        frequency_hz <= band_hz[1] + tolerance_hz
    )
    harmonics = 1 + np.flatnonzero(is_in_band)
    if harmonics.size == 0:
        raise ExcitationError(
            f"No harmonic of period_s = {period_s:g} s lies between start_hz = {band_hz[0]:g} Hz "
            f"and stop_hz = {band_hz[1]:g} Hz; take a longer period or a wider band."
        )
    spectrum = np.zeros(tick_count // 2 + 1, dtype=complex)
    phases_rad = 2 * pi * np.random.default_rng(seed).random(harmonics.size)
    spectrum[harmonics] = np.exp(1j * phases_rad)
    unit_period: FloatArray = np.fft.irfft(spectrum, tick_count)
    unit_period = np.roll(unit_period, -int(np.argmin(np.abs(unit_period))))
    unit_period /= np.max(np.abs(unit_period))
    return unit_period


def _sweep_in_blocks(
    segments: Mapping[str, tuple[int, int]],
    rate_hz: float,
    angle_at: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Return the angles in rad at all ticks of the sweep, from a function of times in s.

    The function is called for blocks of ticks, because its intermediate results would take several
    times the memory of a long sweep.
    """
    sweep_begin, sweep_end = segments["sweep"]
    sweep_rad = np.empty(sweep_end - sweep_begin)
    for first_tick in range(0, sweep_rad.size, _BLOCK_TICKS):
        block_rad = sweep_rad[first_tick : first_tick + _BLOCK_TICKS]
        block_rad[:] = angle_at(np.arange(first_tick, first_tick + block_rad.size) / rate_hz)
    return sweep_rad


def _taper_factors(t: FloatArray, duration_s: float, taper_s: float) -> FloatArray | float:
    """Return the factors at times `t` that fade a sweep in and out, each within `taper_s`."""
    require_not_negative("taper_s", taper_s)
    if taper_s == 0.0:
        return 1.0
    if 2.0 * taper_s > duration_s:
        raise ExcitationError(
            f"taper_s = {taper_s:g} s at both ends does not fit into duration_s = "
            f"{duration_s:g} s; choose at most {duration_s / 2:g} s."
        )
    edge_fractions = np.minimum(t, duration_s - t) / taper_s
    return 0.5 - 0.5 * np.cos(pi * np.minimum(edge_fractions, 1.0))
