"""Measured angle and torque for the estimators: gaps interpolated, decimated to the band.

A missing angle is interpolated, since the convolution with the response needs one at every tick; a
missing torque is not compared. After a longer gap of the angle the beam may ring from the motor's
motion in the gap. This ringing is estimated like the free decay at the beginning of a record.
Decimation is by a linear-phase FIR filter (Kaiser window), so that the whole band is retained and
neither channel is delayed against the other.

References
----------
N. Wiener, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949).
J. F. Kaiser, Nonrecursive digital filter design using the I0-sinh window function, Proc. IEEE Int.
Symp. Circuits and Systems (1974) 20-23.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._plant import Plant
from analysis.record_checks import MAX_GAP_S, longest_run, too_much_unknown
from rigd.beam import Damping

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.record import Record
    from rigd.beam import Beam


# Measurement

_SAME_INSTANT_S: Final = 1e-7

MAX_ANGLE_GAP_PERIODS: Final = 0.4
"""Longest gap of the angle that is interpolated, in periods of the band's upper end."""

MOST_LONG_GAPS: Final = 8
"""Limit of longer gaps: after each of them every mode has an unknown amplitude and phase."""

_FILTERS_FORGET: Final = 5.0
"""Time constants after which a filter has forgotten what was before."""

MAX_TORQUE_GAP_S: Final = 1.0
"""Longest gap of the torque: a longer one may swallow a resonance."""


class MeasurementError(ValueError):
    """A record that the whole-record estimator cannot use; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class RecordedImpact:
    """Impact on the beam: any torque while it lasts, and free decays from its beginning.

    Attributes
    ----------
    first_s, last_s : float
        Its first instant, and the first one after it, since the record's first tick.
    resolution_s : float
        Uncertainty of the first instant.
    poles_rad_s : tuple of complex
        Poles of the ringing modes: the upper one of a conjugate pair, or a real one.
    sizes : tuple of float
        Estimated size of each column (`columns`).
    largest_nm : float
        Largest torque within a second.
    """

    first_s: float
    last_s: float
    resolution_s: float
    poles_rad_s: tuple[complex, ...]
    sizes: tuple[float, ...] = ()
    largest_nm: float = 0.0

    def decays(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the decays of all modes, then the decays times the time since the impact.

        Parameters
        ----------
        time_s : ndarray, shape (n,)
            Since the record's first tick.
        """
        since_s = time_s - self.first_s
        later = since_s > -_SAME_INSTANT_S
        since_s = np.where(later, since_s, 0.0)
        rows = []
        for pole in self.poles_rad_s:
            decay = np.where(later, np.exp(pole * since_s), 0.0)
            for part in (decay.real, decay.imag)[: 1 + (pole.imag != 0)]:
                rows += [part, part * since_s]
        return np.array(rows).reshape(len(rows), time_s.size)

    def columns(self, time_s: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
        """Return the torque per unknown size: decays, then single samples of the contact.

        Parameters
        ----------
        time_s : ndarray, shape (n,)
            Instants of samples, since the record's first tick.
        rate_hz : float
            Their rate.

        Returns
        -------
        ndarray, shape (c, n)
        """
        half_s = 0.5 / rate_hz
        touched = (time_s > self.first_s - half_s) & (time_s < self.last_s - half_s)
        indices = np.flatnonzero(touched)
        single = np.zeros((indices.size, time_s.size))
        single[np.arange(indices.size), indices] = 1.0
        return np.concatenate([self.decays(time_s), single])

    def torque(
        self, time_s: NDArray[np.float64], grid_s: NDArray[np.float64], rate_hz: float
    ) -> NDArray[np.float64]:
        """Return the estimated torque at some times, shape (n,).

        Parameters
        ----------
        time_s : ndarray, shape (n,)
            Since the record's first tick.
        grid_s : ndarray, shape (m,)
            Instants of the samples to which `sizes` refers.
        rate_hz : float
            Their rate.
        """
        if not self.sizes:
            return np.zeros(time_s.size)
        decays = self.decays(time_s)
        sizes = np.array(self.sizes)
        single = sizes[len(decays) :] @ self.columns(grid_s, rate_hz)[len(decays) :]
        torque: NDArray[np.float64] = sizes[: len(decays)] @ decays
        return torque + np.interp(time_s, grid_s, single)


@dataclass(frozen=True, slots=True)
class Measurement:
    """Angle and torque of one session, with the stated data of rig and specimen.

    Attributes
    ----------
    name : str
        Name in messages: the path of the file.
    angle_rad, torque_nm : ndarray, shape (n,)
        Motor angle and coupling torque, one value per tick.
    rate_hz : float
        Ticks per second.
    beam : Beam
        Beam in the file: the start of the search for density and stiffness.
    angle_known, torque_known : ndarray of bool, shape (n,)
        False where a tick was missed or its value is flagged (held, saturated). Such a torque is
        not compared; such an angle is bridged, since the convolution needs one.
    rest_angle_rad : float or None
        Angle at which the beam rested before the record, None if not known: then the first angle.
    delay_s : float
        Age of the torque relative to the angle at one time stamp, as the file states it.
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam, as the file states it.
    filter_time_constant_s, second_order_filter_time_constant_s : float
        Low-pass filter of the torque's channel, as the file states it: see `Plant`.
    reference_rad : ndarray, shape (n,), or None
        Reference of the motor's controller, if there was one: the part of the angle that does
        not follow it is attributed to the noise.
    knocks : tuple of RecordedImpact
                    Known impacts on the beam. Their sizes stay free.
    uniformity : float
        Relative standard deviation of each mode's frequency from that of a uniform beam.
    tip_mass_kg : float or None
        Point mass at the beam's tip as the file states it, None if it is not known.
    axis_tilt_deg : float or None
        Inclination of the plane of motion along the beam at rest as the file states it, positive
        where the tip is lower than the motor's axis; None if it was not measured.
    one_sweep : bool
        Whether the motor passed each frequency once, in their order: changes with time and with
        frequency are then not distinguishable.
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
    knocks: tuple[RecordedImpact, ...] = ()
    uniformity: float = 1e-3
    tip_mass_kg: float | None = None
    axis_tilt_deg: float | None = None
    one_sweep: bool = True

    @classmethod
    def of_record(cls, record: Record) -> Measurement:
        """Return the measurement of a record that was read from a session file.

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
            angle_rad=record.angle_rad,
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
            one_sweep=record.metadata.get("excitation", "chirp") == "chirp"
            and record.there is None,
        )

    def check(self, highest_hz: float) -> None:
        """Raise if the measurement cannot be used in a band that ends at `highest_hz`.

        Raises
        ------
        MeasurementError
            Shapes differ, values are not finite, too many values are unknown in total or in one
            gap, or the angle never moves.
        """
        n = len(self.angle_rad)
        for other in (self.torque_nm, self.angle_known, self.torque_known):
            if len(other) != n:
                raise MeasurementError(
                    f"{self.name}: angle, torque and their masks hold {n} and {len(other)} values, "
                    "but must be of one length."
                )
        for channel, unit, values, known in (
            ("angle", "rad", self.angle_rad, self.angle_known),
            ("torque", "N·m", self.torque_nm, self.torque_known),
        ):
            bad = np.flatnonzero(known & ~np.isfinite(values))
            if bad.size:
                raise MeasurementError(
                    f"{self.name}: the {channel} is {values[bad[0]]} {unit} at tick {bad[0]} and "
                    f"not finite at {bad.size} of {n} ticks; mask them as unknown or record the "
                    "session again."
                )
            much = too_much_unknown(f"the {channel}", int(np.count_nonzero(~known)), n)
            if much:
                raise MeasurementError(f"{self.name}: {much}")
        for channel, known, allowed_s in (
            ("angle", self.angle_known, MAX_GAP_S),
            ("torque", self.torque_known, MAX_TORQUE_GAP_S),
        ):
            run, start = longest_run(~known)
            if run > allowed_s * self.rate_hz:
                raise MeasurementError(
                    f"{self.name}: the {channel} is missing or flagged for {run} ticks from tick "
                    f"{start} on ({1e3 * run / self.rate_hz:.3g} ms), longer than the "
                    f"{1e3 * allowed_s:.3g} ms that an analysis tolerates; record the session "
                    "again."
                )
        gaps = len(self.long_gaps(highest_hz))
        if gaps > MOST_LONG_GAPS:
            raise MeasurementError(
                f"{self.name}: the angle is missing or flagged {gaps} times for longer than the "
                f"{1e3 * MAX_ANGLE_GAP_PERIODS / highest_hz:.3g} ms that a band up to "
                f"{highest_hz:g} Hz interpolates, more often than the {MOST_LONG_GAPS} times that "
                "an analysis tolerates; record the session again or lower --band."
            )
        angles = self.angle_rad[self.angle_known]
        if angles.size == 0 or np.ptp(angles) == 0:
            raise MeasurementError(
                f"{self.name}: the angle never changes, so nothing was excited; check the encoder "
                "and that the motor moved."
            )

    def long_gaps(self, highest_hz: float) -> tuple[tuple[int, int], ...]:
        """Return the gaps of the angle that are too long to interpolate.

        The beam may ring after them.

        Parameters
        ----------
        highest_hz : float
            End of the band.

        Returns
        -------
        tuple of (int, int)
            First tick of each gap, and the first tick after it at which the filters of the torque
            channel have settled.
        """
        longest = MAX_ANGLE_GAP_PERIODS / highest_hz * self.rate_hz
        late_s = abs(self.delay_s) + _FILTERS_FORGET * (
            self.filter_time_constant_s + self.second_order_filter_time_constant_s
        )
        late = int(np.ceil(late_s * self.rate_hz))
        return tuple(
            (int(start), min(int(end) + late, len(self.angle_rad)))
            for start, end in zip(*_runs(~self.angle_known), strict=True)
            if end - start > longest
        )

    def without_torque_in(self, gaps: Iterable[tuple[int, int]]) -> Measurement:
        """Mark the torque as unknown in gaps, each from a first tick to one after its last.

        Parameters
        ----------
        gaps : iterable of (int, int)
        """
        known = self.torque_known.copy()
        for start, end in gaps:
            known[start:end] = False
        return replace(self, torque_known=known)

    @property
    def nominal(self) -> Plant:
        """Return rig and specimen as the file states them, without damping."""
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
        """Return the fraction of the samples whose torque is known."""
        return float(np.mean(self.torque_known))

    def angle_from_rest(self, highest_hz: float) -> NDArray[np.float64]:
        """Return the angle relative to rest, shape (n,), with unknown values interpolated."""
        angle = bridged(self.angle_rad, self.angle_known, highest_hz / self.rate_hz)
        origin = angle[0] if self.rest_angle_rad is None else self.rest_angle_rad
        return angle - origin


# Interpolation of gaps

_REACH_PERIODS: Final = 2.0
_MARGIN: Final = 1.2
_NOISE_POWER: Final = 1e-6


def bridged(
    values: NDArray[np.float64], known: NDArray[np.bool_], highest: float
) -> NDArray[np.float64]:
    """Estimate the unknown values of a band-limited signal from their known neighbours.

    The best linear estimate for a signal with a flat spectrum up to its highest frequency and a
    little white noise (N. Wiener; here over two periods to either side). A gap of a quarter of a
    period loses less than 1e-3 of the signal; a straight line would lose a third.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Unknown values are ignored.
    known : ndarray of bool, shape (n,)
    highest : float
        Highest frequency, in cycles per sample.

    Returns
    -------
    ndarray, shape (n,)
        The values themselves where known.
    """
    filled = np.where(known, values, 0.0)
    reach = int(np.ceil(_REACH_PERIODS / highest))
    for start, end in zip(*_runs(~known), strict=True):
        first = max(start - reach, 0)
        neighbours = first + np.flatnonzero(known[first : end + reach])
        if neighbours.size == 0:
            continue
        weights = _weights(tuple(neighbours - start), int(end - start), _MARGIN * highest)
        level = float(values[neighbours].mean())
        filled[start:end] = level + weights @ (values[neighbours] - level)
    return filled


@lru_cache(maxsize=64)
def _weights(neighbours: tuple[int, ...], length: int, highest: float) -> NDArray[np.float64]:
    """Return the weights of the neighbours in each of `length` values from index 0 on."""
    indices = np.array(neighbours)
    among = np.sinc(2 * highest * np.subtract.outer(indices, indices))
    among += _NOISE_POWER * np.eye(indices.size)
    across = np.sinc(2 * highest * np.subtract.outer(np.arange(length), indices))
    weights: NDArray[np.float64] = np.linalg.solve(among, across.T).T
    return weights


def _runs(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first indices of the runs of True, and the indices after their last."""
    edges = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


# Decimation

_ATTENUATION_DB: Final = 100.0
_RATE_OVER_BAND: Final = 2.4
"""Least decimated rate per highest frequency: below 2.4 the filter becomes long."""


@dataclass(frozen=True, slots=True)
class Decimation:
    """Linear-phase low-pass filter, centred, followed by downsampling.

    It does not use `scipy.signal` (`kaiserord`, `firwin` and `oaconvolve`), whose import takes 0.64
    s of processor time: a tenth of the analysis of a session of 76 s.

    Attributes
    ----------
    factor : int
        One sample in `factor` is retained.
    kernel : ndarray, shape (2 reach factor + 1,)
        The filter: passes `highest_hz`, and 100 dB less from half the new rate on.
    reach : int
        Half length of the filter, in samples of the new rate.
    rate_hz : float
        The new rate.
    """

    factor: int
    kernel: NDArray[np.float64]
    reach: int
    rate_hz: float

    @classmethod
    def to_band(cls, rate_hz: float, highest_hz: float) -> Decimation:
        """Return the decimation to the lowest rate that holds the band from 0 to `highest_hz`.

        Parameters
        ----------
        rate_hz : float
            Rate of the record.
        highest_hz : float
            Highest frequency that is retained, at most 0.4 `rate_hz`.
        """
        factor = max(int(rate_hz / (_RATE_OVER_BAND * highest_hz)), 1)
        new_rate_hz = rate_hz / factor
        stop_hz = new_rate_hz / 2
        # Kaiser's formulas for the length of the filter and the shape of its window.
        width = 2 * np.pi * (stop_hz - highest_hz) / rate_hz
        half = (_ATTENUATION_DB - 7.95) / (2 * 2.285 * width)
        reach = int(np.ceil(half / factor))
        ticks = np.arange(-reach * factor, reach * factor + 1)
        cutoff = (stop_hz + highest_hz) / rate_hz  # twice the middle of the transition
        kernel = cutoff * np.sinc(cutoff * ticks)
        kernel *= np.kaiser(ticks.size, 0.1102 * (_ATTENUATION_DB - 8.7))
        return cls(factor, kernel / kernel.sum(), reach, new_rate_hz)

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Filter and downsample.

        Parameters
        ----------
        values : ndarray, shape (n,)
            Taken as 0 before and after.

        Returns
        -------
        ndarray, shape (m,)
            Sample `reach` is the one at the first value; so many precede it.
        """
        length = values.size + self.kernel.size - 1
        padded = fast_length(length)
        spectrum = np.fft.rfft(values, padded) * np.fft.rfft(self.kernel, padded)
        return np.fft.irfft(spectrum, padded)[: length : self.factor].copy()

    def inside(self, ticks: int) -> slice:
        """Return the slice of samples of `apply` that depend on the record's `ticks` only."""
        return slice(2 * self.reach, (ticks - 1) // self.factor + 1)


def fast_length(at_least: int) -> int:
    """Return the least number not below `at_least` (1 or more) with prime factors up to 11.

    A transform of real values is a fifth faster with factors up to 5 (``real=True``), which makes
    no fit faster. The grid of the Laplace variable depends on the length (`TorquePredictor`), and
    with it the last digits of every estimate.

    Examples
    --------
    >>> from analysis.identify import fast_length
    >>> fast_length(1013)
    1024
    """
    from scipy.fft import next_fast_len

    return int(next_fast_len(at_least))


def fast_length_below(at_most: int) -> int:
    """Return the largest number not above `at_most` (1 or more) with prime factors up to 11."""
    from scipy.fft import prev_fast_len

    return int(prev_fast_len(at_most))
