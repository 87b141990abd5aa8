"""Checks of a session before its analysis: values that its file states, and samples.

These checks report the key of a value that is in a wrong unit or written by another program. An
estimator would report it less clearly, or overflow. Samples that cannot be analysed raise an error:
a span that is almost empty or too long, a clock that contradicts the rate, values that are not
finite, a sensor without data, and gaps that are too long for interpolation.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.decimation import runs_of_true
from rigd.beam import Beam
from rigd.session.limits import MAX_SAMPLES
from rigd.units import unit_of

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from rigd.session import Session


class RecordError(ValueError):
    """Error if a session was read but cannot be analysed; the message states the remedy."""


# Values that the file states

_BEAM_RANGES: Final = {
    "beam_length_m": (1e-3, 1e3),
    "beam_density_kg_per_m": (1e-6, 1e6),
    "beam_bending_stiffness_n_m2": (1e-9, 1e15),
}
"""Plausible range of each property of the beam, by its key."""
_MAX_INERTIA_KG_M2: Final = 1e3
"""Largest plausible tool inertia."""
_MAX_DELAY_S: Final = 1.0
"""Largest plausible delay of a channel."""
MAX_TIP_MASS_KG: Final = 1e3
"""Largest plausible mass at the tip."""
MAX_AXIS_TILT_DEG: Final = 90.0
"""Largest angle by which the resting beam may point downhill or uphill."""
MAX_UNCERTAINTY_PERCENT: Final = 50.0
"""Largest relative standard uncertainty that a file may state."""
MAX_UNIFORMITY_PERCENT: Final = 10.0
"""Largest deviation of mode frequencies from a uniform beam's for which its model is used."""
_DEFAULT_UNIFORMITY_PERCENT: Final = 0.1
"""Deviation of mode frequencies of a carefully made antenna."""
_FIRST_CLAMPED_FREE_EIGENVALUE: Final = 1.8751040687119611
"""First root of 1 + cos z cosh z: mode 1 is at (root / length)² √(EI/rho) rad/s."""

_MIN_PERIODS_OF_FIRST_MODE: Final = 0.1
"""Least number of periods of the stated beam's first mode in a record. It is so small because the
stated beam's frequency may be wrong by a factor of ten."""


def stated_rate_hz(session: Session) -> float:
    """Return the sampling rate that a session states, in Hz.

    Raises
    ------
    RecordError
        The rate is not positive.
    """
    rate_hz = session.number("rate_hz")
    if not rate_hz > 0.0:
        raise _invalid_value_error(session, "rate_hz", rate_hz, "must be positive")
    return rate_hz


def stated_beam(session: Session, rate_hz: float, tick_count: int) -> Beam:
    """Return the beam that a session states, after checking that its first mode can be measured.

    Parameters
    ----------
    session : Session
        Session as read.
    rate_hz : float
        Sampling rate.
    tick_count : int
        Length of the record in ticks.

    Raises
    ------
    RecordError
        A property of the beam, or the frequency of its first mode, is impossible.
    """
    beam_values = []
    for key, (low, upper_limit) in _BEAM_RANGES.items():
        beam_value = session.number(key)
        if not beam_value > 0.0:
            raise _invalid_value_error(session, key, beam_value, "must be positive")
        if not low <= beam_value <= upper_limit:
            raise _invalid_value_error(
                session, key, beam_value, f"must lie between {low:g} and {upper_limit:g}"
            )
        beam_values.append(beam_value)
    length_m, density_kg_per_m, stiffness_n_m2 = beam_values
    beam = Beam(
        length_m=length_m, density_kg_per_m=density_kg_per_m, bending_stiffness_n_m2=stiffness_n_m2
    )
    first_hz, lowest_hz = first_mode_hz(beam), _MIN_PERIODS_OF_FIRST_MODE * rate_hz / tick_count
    if not lowest_hz < first_hz < rate_hz / 2:
        raise RecordError(
            f"{session.path}: with beam_length_m {length_m:g} m, beam_density_kg_per_m "
            f"{density_kg_per_m:g} "
            f"kg/m and beam_bending_stiffness_n_m2 {stiffness_n_m2:g} N·m² the first mode would be "
            f"at {first_hz:.3g} Hz, which {tick_count / rate_hz:.3g} s at {rate_hz:g} Hz cannot "
            "show; "
            + (
                "record longer, or correct the file's metadata if these are wrong."
                if first_hz <= lowest_hz
                else "correct the file's metadata, or import the record again if its time was "
                "taken in the wrong unit."
            )
        )
    return beam


def first_mode_hz(beam: Beam) -> float:
    """Return the frequency in Hz of the first mode of an undamped clamped–free beam.

    Parameters
    ----------
    beam : Beam
        Beam with a locked hub.
    """
    return (
        (_FIRST_CLAMPED_FREE_EIGENVALUE / beam.length_m) ** 2
        / math.sqrt(beam.density_over_stiffness)
        / math.tau
    )


def stated_tool_inertia_kg_m2(session: Session) -> float:
    """Return the moment of inertia between torque sensor and beam in kg·m², 0 if not stated.

    Raises
    ------
    RecordError
        The inertia is negative, or implausibly large.
    """
    key = "tool_inertia_kg_m2"
    inertia_kg_m2 = session.number(key, 0.0)
    if inertia_kg_m2 < 0.0:
        raise _invalid_value_error(session, key, inertia_kg_m2, "an inertia cannot be negative")
    if inertia_kg_m2 > _MAX_INERTIA_KG_M2:
        raise _invalid_value_error(
            session, key, inertia_kg_m2, f"must not exceed {_MAX_INERTIA_KG_M2:g}"
        )
    return inertia_kg_m2


def stated_tip_mass_kg(session: Session) -> float | None:
    """Return the point mass at the beam's tip in kg, or None if not stated.

    Raises
    ------
    RecordError
        If the mass is negative, or implausibly large.
    """
    return _stated_in_range(session, "tip_mass_kg", 0.0, MAX_TIP_MASS_KG)


def stated_axis_tilt_deg(session: Session) -> float | None:
    """Return the angle in degrees by which the resting beam points downhill; None if not stated.

    It is positive if the tip is lower than the motor's axis. The beam moves in a plane that is
    inclined by this angle along the resting beam.

    Raises
    ------
    RecordError
        The inclination is more than a right angle.
    """
    return _stated_in_range(session, "axis_tilt_deg", -MAX_AXIS_TILT_DEG, MAX_AXIS_TILT_DEG)


def _stated_in_range(session: Session, metadata_key: str, low: float, high: float) -> float | None:
    """Return the number of a metadata key, or None if not stated; raise if not in a range."""
    if metadata_key not in session.metadata:
        return None
    stated_number = session.number(metadata_key)
    if not low <= stated_number <= high:
        raise _invalid_value_error(
            session, metadata_key, stated_number, f"must lie between {low:g} and {high:g}"
        )
    return stated_number


def stated_delay_s(session: Session, metadata_key: str) -> float:
    """Return the age of a channel's values at their time stamps in seconds, 0 if not stated.

    Parameters
    ----------
    session : Session
        Session as read.
    metadata_key : str
        Key of the delay in the metadata.

    Raises
    ------
    RecordError
        The delay is longer than that of any device.
    """
    delay_s = session.number(metadata_key, 0.0)
    if abs(delay_s) > _MAX_DELAY_S:
        raise _invalid_value_error(
            session, metadata_key, delay_s, f"must lie within ±{_MAX_DELAY_S:g}"
        )
    return delay_s


def stated_torque_filter_s(session: Session) -> tuple[float, float]:
    """Return the time constants in seconds of the torque channel's first- and second-order filter.

    The filter of the stated order (`torque_filter_order`, by default 1) has the time constant
    ``1 / (2 pi torque_filter_hz)``, the other filter has 0. Both are 0 if no filter is stated.

    Raises
    ------
    RecordError
        The corner frequency is not positive, or the order is neither 1 nor 2.
    """
    corner_hz = session.number("torque_filter_hz", math.inf)
    filter_order = session.number("torque_filter_order", 1.0)
    if not corner_hz > 0.0:
        raise _invalid_value_error(session, "torque_filter_hz", corner_hz, "must be positive")
    if filter_order not in (1.0, 2.0):
        raise _invalid_value_error(
            session, "torque_filter_order", filter_order, "must be 1 or 2 (Butterworth)"
        )
    time_constant_s = 1 / (2 * math.pi * corner_hz)
    return (time_constant_s, 0.0) if filter_order == 1.0 else (0.0, time_constant_s)


SCALE_QUANTITIES: Final = ("torque_scale", "length", "density")
"""Quantities that no session can determine, and whose uncertainty a file may state."""

UNCERTAIN_QUANTITIES: Final = (*SCALE_QUANTITIES, "tip_mass")
"""All quantities whose uncertainty a file may state."""


def stated_uncertainty(session: Session) -> dict[str, float]:
    """Return the relative standard uncertainties that a session states, by quantity.

    The quantities are those of `UNCERTAIN_QUANTITIES`.

    Raises
    ------
    RecordError
        An uncertainty is negative, or so large that the value would be unknown.
    """
    uncertainties = {}
    for quantity in UNCERTAIN_QUANTITIES:
        key = f"uncertainty_{quantity}_percent"
        uncertainty_percent = session.number(key, 0.0)
        if not 0.0 <= uncertainty_percent <= MAX_UNCERTAINTY_PERCENT:
            range_rule = f"must lie between 0 and {MAX_UNCERTAINTY_PERCENT:g}"
            raise _invalid_value_error(session, key, uncertainty_percent, range_rule)
        if uncertainty_percent:
            uncertainties[quantity] = uncertainty_percent / 100
    return uncertainties


def stated_uniformity(session: Session) -> float:
    """Return the standard deviation of mode frequencies from a uniform beam's, relative to these.

    If not stated, it is 0.001, which is typical of a carefully made antenna.

    Raises
    ------
    RecordError
        The value is negative, or larger than a model of a uniform beam allows.
    """
    key = "uniformity_percent"
    uniformity_percent = session.number(key, _DEFAULT_UNIFORMITY_PERCENT)
    if not 0.0 <= uniformity_percent <= MAX_UNIFORMITY_PERCENT:
        range_rule = f"must lie between 0 and {MAX_UNIFORMITY_PERCENT:g}"
        raise _invalid_value_error(session, key, uniformity_percent, range_rule)
    return uniformity_percent / 100


def _invalid_value_error(
    session: Session, metadata_key: str, stated_value: float, violated_rule: str
) -> RecordError:
    """Return the error for an invalid number of the session's metadata, with the violated rule."""
    return RecordError(
        f"{session.path}: {metadata_key} is "
        f"{f'{stated_value:g} {unit_of(metadata_key)}'.rstrip()}, but "
        f"{violated_rule}; correct the file's metadata."
    )


# Samples

MAX_UNKNOWN_FRACTION = 0.05
"""Largest fraction of a channel's samples that may be missing or flagged, in import, loading and
estimation. With 4.5 %, whole-record fits were still correct within their stated uncertainty."""

MAX_GAP_S = 0.1
"""Longest gap in the sweep that is interpolated, in seconds; a longer one raises an error."""

MAX_TICKS_PER_SAMPLE = 10
"""Largest mean number of ticks per recorded sample. A file with almost no samples in its span would
only fill the memory, and no sweep in it could be analysed."""

MAX_TICKS = MAX_SAMPLES
"""Longest record in ticks, including missing ones, which are interpolated."""

MAX_ABSOLUTE_VALUE = 1e9
"""Largest angle in rad or torque in N·m; the squares of much larger values would overflow."""

MAX_RELATIVE_CLOCK_ERROR = 1e-3
"""Largest relative difference between the stated rate and the rate of the time stamps."""


def check_span(path: Path, ticks: NDArray[np.int64]) -> None:
    """Raise if a record's span of ticks is almost empty, or too long.

    Parameters
    ----------
    path : Path
        File that messages name.
    ticks : ndarray of int, shape (n,)
        Numbers of the recorded ticks.

    Raises
    ------
    RecordError
        The span is unusable.
    """
    tick_span = int(ticks[-1] - ticks[0]) + 1
    if tick_span > MAX_TICKS_PER_SAMPLE * len(ticks):
        raise RecordError(
            f"{path}: only {len(ticks)} of the {tick_span} ticks from {ticks[0]} to {ticks[-1]} "
            "have a sample, too few to analyse; record the session again."
        )
    if tick_span > MAX_TICKS:
        raise RecordError(
            f"{path}: the record spans {tick_span} ticks, and no more than {MAX_TICKS} fit into "
            "the memory that an analysis may take; analyse a part of it (--from, --to), or record "
            "shorter sessions, which can be analysed together."
        )


def check_clock(
    path: Path, ticks: NDArray[np.int64], t_ns: NDArray[np.int64], rate_hz: float
) -> None:
    """Raise if time stamps do not increase, or contradict the sampling rate.

    Parameters
    ----------
    path : Path
        File that messages name.
    ticks : ndarray of int, shape (n,)
        Numbers of the recorded ticks.
    t_ns : ndarray of int, shape (n,)
        Time stamps of these ticks in nanoseconds.
    rate_hz : float
        Sampling rate that the file states.

    Raises
    ------
    RecordError
        The time stamps are unusable.
    """
    if len(ticks) < 2:
        return
    # The values are compared, because a difference of values from a file may overflow.
    not_increasing_indices = np.flatnonzero(t_ns[1:] <= t_ns[:-1])
    if not_increasing_indices.size:
        first_not_increasing_index = int(not_increasing_indices[0])
        raise RecordError(
            f"{path}: the time stamp t_ns goes from {t_ns[first_not_increasing_index]} ns at tick "
            f"{ticks[first_not_increasing_index]} to {t_ns[first_not_increasing_index + 1]} ns at "
            f"tick {ticks[first_not_increasing_index + 1]}, but time must go forward; it does not "
            f"at {not_increasing_indices.size} of {len(ticks)} samples. Correct the program that "
            "wrote the file."
        )
    elapsed_ns = max(int(t_ns[-1]) - int(t_ns[0]), 1)
    rate_of_stamps_hz = 1e9 * int(ticks[-1] - ticks[0]) / elapsed_ns
    if abs(rate_of_stamps_hz / rate_hz - 1.0) > MAX_RELATIVE_CLOCK_ERROR:
        raise RecordError(
            f"{path}: rate_hz is {rate_hz:g} Hz, but the time stamps t_ns advance at "
            f"{rate_of_stamps_hz:g} ticks per second; correct whichever is wrong."
        )


def check_finite(
    path: Path, field_name: str, field_values: NDArray[np.float64], ticks: NDArray[np.int64]
) -> None:
    """Raise if values of a channel are not finite, or implausible for any rig.

    Parameters
    ----------
    path : Path
        File that messages name.
    field_name : str
        Name of the channel.
    field_values : ndarray, shape (n,)
        Values in rad or N·m.
    ticks : ndarray of int, shape (n,)
        Numbers of the recorded ticks.

    Raises
    ------
    RecordError
        Some values are not finite or implausible.
    """
    too_large_indices = np.flatnonzero(np.abs(field_values) > MAX_ABSOLUTE_VALUE)
    not_finite_indices = np.flatnonzero(~np.isfinite(field_values))
    if not_finite_indices.size:
        raise RecordError(
            f"{path}: {field_name} is {field_values[not_finite_indices[0]]} at tick "
            f"{ticks[not_finite_indices[0]]} and not finite in "
            f"{not_finite_indices.size} of {len(field_values)} samples; such a record cannot be "
            "analysed."
        )
    if too_large_indices.size:
        raise RecordError(
            f"{path}: {field_name} is {field_values[too_large_indices[0]]:g} at tick "
            f"{ticks[too_large_indices[0]]} and beyond ±{MAX_ABSOLUTE_VALUE:g} in "
            f"{too_large_indices.size} of {len(field_values)} samples; no rig has such values; "
            "correct the program that wrote the file."
        )


def check_sensor(path: Path, torque_nm: NDArray[np.float64]) -> None:
    """Raise if the torque is constant, because noise alone would change it.

    Parameters
    ----------
    path : Path
        File that messages name.
    torque_nm : ndarray, shape (n,)
        Coupling torque.

    Raises
    ------
    RecordError
        The torque is constant.
    """
    if torque_nm.size > 1 and np.ptp(torque_nm) == 0.0:
        raise RecordError(
            f"{path}: coupling_torque_nm is {torque_nm[0] + 0.0:g} N·m in every sample, so the "
            "sensor delivered no data; check its connection and record the session again."
        )


def check_fillable(
    path: Path, channel_name: str, is_unknown: NDArray[np.bool_], first_tick: int, rate_hz: float
) -> None:
    """Raise if too many samples of a channel in the sweep would have to be interpolated.

    The limits are `MAX_UNKNOWN_FRACTION` for all samples and `MAX_GAP_S` for a single gap.

    Parameters
    ----------
    path : Path
        File that messages name.
    channel_name : str
        Name of the channel in messages.
    is_unknown : ndarray of bool, shape (n,)
        Whether each sample of the sweep has no new value.
    first_tick : int
        First tick of the sweep.
    rate_hz : float
        Sampling rate.
    """
    fraction_message = unknown_fraction_message(
        f"the {channel_name} in the sweep", int(is_unknown.sum()), len(is_unknown)
    )
    if fraction_message:
        raise RecordError(f"{path}: {fraction_message}")
    gap_ticks, gap_start = longest_run(is_unknown)
    if gap_ticks > MAX_GAP_S * rate_hz:
        raise RecordError(
            f"{path}: {gap_ticks} ticks of the {channel_name} in a row are missing or stale from "
            f"tick {first_tick + gap_start} on ({1e3 * gap_ticks / rate_hz:.0f} ms), longer than "
            f"the {1e3 * MAX_GAP_S:g} ms that are interpolated; record the session again."
        )


def unknown_fraction_message(
    channel_text: str, unknown_samples: int, total_samples: int
) -> str | None:
    """Return an error message if too many samples of a channel are unknown, or None.

    The limit is the fraction `MAX_UNKNOWN_FRACTION`.

    Parameters
    ----------
    channel_text : str
        Name of the channel in the message.
    unknown_samples, total_samples : int
        Number of samples without a new value, and number of all samples.
    """
    if unknown_samples <= MAX_UNKNOWN_FRACTION * total_samples:
        return None
    return (
        f"{unknown_samples} of {total_samples} samples "
        f"({100 * unknown_samples / total_samples:.2g} %) of {channel_text} are "
        "missing or flagged, "
        f"more than the {100 * MAX_UNKNOWN_FRACTION:g} % that an analysis tolerates; record the "
        "session again."
    )


def longest_run(run_mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Return length and start index of the longest run of True; (0, 0) if no element is True.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.record_checks import longest_run
    >>> longest_run(np.array([True, False, True, True]))
    (2, 2)
    """
    run_starts, run_ends = runs_of_true(run_mask)
    if run_starts.size == 0:
        return 0, 0
    longest_run_index = int(np.argmax(run_ends - run_starts))
    return int(run_ends[longest_run_index] - run_starts[longest_run_index]), int(
        run_starts[longest_run_index]
    )
