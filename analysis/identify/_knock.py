"""Impacts (knocks): the beam was struck or touched once during the record, and rang freely.

During the contact the torque is unknown; afterwards it is the free decay of the beam's modes. So an
impact adds to the torque one unknown value at each sample of the contact, and a decay of unknown
amplitude and phase of each mode. Each decay may have a pole slightly off the model's, to first
order (a column that grows with the time in front of the decay): so a larger deflection than that of
the excitation, or inaccurate poles, cause no bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._data import MeasurementError, RecordedImpact
from analysis.identify._finding import Finding
from analysis.identify._fit import fit_record
from analysis.identify._refit import FEW, Refit
from analysis.identify.parametrization import Unknowns
from analysis.identify.residual_tests import largest_of, whiteness
from analysis.models import STRUCTURES
from analysis.statistics import chi_square_deviate

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._data import Measurement

_FREEST: Final = STRUCTURES["VI"]

MAX_KNOCKS: Final = 3
"""Limit of impacts in one record."""

_WINDOWS_S: Final = (0.08, 0.5)
"""Windows to either side of the instant from the scan: for a blow, and for a touch."""

_APART_S: Final = 0.1
_AT_ONCE_S: Final = 0.4
_RISES: Final = 0.5
"""Largest power of the residual before an impact, in that time and at that distance, relative to
the power after it."""

_ROUNDS: Final = 2
"""Rounds of estimates of poles and noise, each without the impact."""

_MOST: Final = 0.8
"""Least fraction of the unexplained squares that an impact has to explain."""

_WORTH: Final = 0.5
"""Least fraction that justifies a fit with the impact removed."""

_ALL: Final = 0.95
"""Fraction with which the impact is accepted before any other explanation is tested."""

_RINGS: Final = 0.5
"""Least fraction of the reduction by the decays after the impact, not during it."""

_OVERWHELMING: Final = 10.0
"""Squares over those of the noise above which the part that impact and beam could both explain is
attributed to the impact. Below it is attributed to the beam: the residual of a wrong model is at
most 3 times the noise, and decays would explain all of it."""

_QUIET_S: Final = 2.0
_LOUDER: Final = 1.5
"""Largest power of the residual in that time before an impact, relative to the noise."""


@dataclass(frozen=True, slots=True)
class DetectedImpact:
    """Impact, with the fraction of the record's residual that it explains.

    Attributes
    ----------
    knock : RecordedImpact
    explained_fraction : float
        Fraction of the unexplained squares that it explains.
    before : float
        Power of the residual in the two seconds before it, relative to the noise.
    """

    knock: RecordedImpact
    explained_fraction: float
    before: float

    @property
    def evident(self) -> bool:
        """Return whether it explains most of the residual and began abruptly."""
        return self.explained_fraction > _MOST and self.before < _LOUDER

    @property
    def obvious(self) -> bool:
        """Return whether no other effect needs to be tested first."""
        return self.explained_fraction > _ALL and self.before < _LOUDER


def knocks_in(candidate_set: CandidateSet, *, obvious: bool = False) -> Iterator[DetectedImpact]:
    """Search for one more impact; yield alternatives, the likeliest first.

    An impact may be larger than the response to the motor, so that a fit to the whole record fails.
    One half of the record then holds no impact, or only its free decay at the start. So the search
    also uses the residual of fits to either half. With `obvious` it is limited to obvious impacts.
    """
    if candidate_set.misread or len(candidate_set.comparison.measurement.knocks) == MAX_KNOCKS:
        return
    first = knock_in(candidate_set)
    if first is not None and first.obvious:
        yield first
        first = None
    if obvious:
        return
    for start in _from_halves(candidate_set):
        found = _knock_in(start)
        if found is not None:
            yield found
    if first is not None:
        yield first


def knock_in(candidate_set: CandidateSet) -> DetectedImpact | None:
    """Search for an impact in the residual of the likeliest candidate."""
    likeliest = min(candidate_set.candidates, key=lambda each: each.fit.cost)
    return _knock_in(candidate_set.refit(likeliest, 1))


def _knock_in(refit: Refit) -> DetectedImpact | None:
    """Search for an impact in the residual of a refit."""
    sample = _scan(refit)
    if sample is None:
        return None
    comparison = refit.objective.comparison
    for width_s in _WINDOWS_S:
        half = math.ceil(width_s * comparison.decimation.rate_hz)
        first, last = max(sample - half, 0), min(sample + half, comparison.samples)
        cleaned = _cleaned(refit, first, last)
        extent = _extent(cleaned, first, last)
        if extent is None:
            return None
        found = _sized(cleaned, *extent)
        if found.explained_fraction < _WORTH:
            return None
        if extent[0] > first:
            return found
        if found.explained_fraction < _MOST:
            return None
        # A touch that began before this window.
    return None


def _from_halves(candidate_set: CandidateSet) -> Iterator[Refit]:
    """Fit the freest structure to either half alone; return it for the record if it fits."""
    comparison = candidate_set.comparison
    measurement, hz = comparison.measurement, comparison.frequency_hz
    band_hz = (0.0 if comparison.bins.start == 1 else float(hz[0]), float(hz[-1]))
    middle = measurement.angle_rad.size // 2
    for half in (slice(0, middle), slice(middle, None)):
        part = replace(
            measurement,
            angle_rad=measurement.angle_rad[half],
            torque_nm=measurement.torque_nm[half],
            angle_known=measurement.angle_known[half],
            torque_known=measurement.torque_known[half],
            # What rings since the knock may be far louder than what the reference asks for: from
            # that alone, no beam is found.
            reference_rad=None,
            knocks=(),
        )
        try:
            analysis = fit_record(part, (_FREEST,), band_hz=band_hz)
        except MeasurementError:
            continue
        fit, counts = analysis.fits[0], analysis.noise.counts
        if not whiteness(fit.residual[counts], analysis.comparison.frequency_hz[counts]).white:
            continue
        plain = comparison.without_hum(()).recompute_incoherent_torque(fit.plant)
        unknowns = Unknowns.of(_FREEST, measurement.nominal, candidate_set.free)
        there = partial(
            Refit.descend, plain, unknowns, unknowns.vector(fit.plant), max_evaluations=1
        )
        loud = there(noise=candidate_set.noise)
        every = replace(loud.noise_here(), counts=np.ones(hz.size, dtype=bool), lines=())
        yield there(noise=every)


def with_knock(measurement: Measurement, found: DetectedImpact) -> Measurement:
    """Return the measurement with a known impact."""
    return replace(measurement, knocks=(*measurement.knocks, found.knock))


def of_knocks(knocks: tuple[RecordedImpact, ...], *, explained: bool) -> Iterator[Finding]:
    """Yield the findings of the impacts of a record.

    `explained` states whether the remaining record is explained.
    """
    for knock in knocks:
        within_s = knock.resolution_s
        yield Finding(
            kind="knock",
            sentence=(
                f"The beam was struck at {knock.first_s:.2f} s (to within {within_s:.2g} s): "
                f"{1e3 * knock.largest_nm:.3g} mN·m in the torque, and from then on the free "
                "decay of its modes. "
                + (
                    "It was fitted too, and biases nothing."
                    if explained
                    else "It was fitted too, but is not all that is in the record."
                )
            ),
            value=knock.first_s,
            interval=(knock.first_s - within_s, knock.first_s + within_s),
            unit="s",
            remedy="Keep clear of the beam while it is recorded.",
        )


# Search


def _scan(refit: Refit) -> int | None:
    """Return the sample at which decays of all modes explain most; None if chance may do so.

    This takes one correlation per column: the sums for a decay from the first sample on, reversed
    in time, give those for all samples at once.
    """
    comparison, weight = refit.objective.comparison, refit.noise.weight
    poles = comparison.poles(refit.plant)
    if not poles:
        return None
    residual = refit.objective.project(refit.objective.linearise(refit.x), weight).residual
    decays = comparison.decays.columns(poles) * weight
    along = np.array([comparison.in_time(decay.conj() * residual) for decay in decays])
    along *= comparison.samples / 2
    scale = np.sqrt(np.sum(np.abs(decays) ** 2, axis=1))
    if not scale.all():
        return None
    gram = (decays.conj() @ decays.T).real / np.outer(scale, scale)
    along /= scale[:, None]
    saved = np.sum(along * np.linalg.solve(gram + 1e-9 * np.eye(scale.size), along), axis=0)
    sample = int(np.argmax(saved))
    deviate = chi_square_deviate(float(saved[sample]), scale.size)
    if deviate < math.sqrt(2 * largest_of(comparison.samples)):
        return None
    # What a wrong model leaves at a resonance rises and falls with the sweep; a knock does not.
    power = comparison.in_time(residual) ** 2
    rate_hz = comparison.decimation.rate_hz
    apart, until = (math.ceil(each * rate_hz) for each in (_APART_S, _APART_S + _AT_ONCE_S))
    earlier = power[max(sample - until, 0) : max(sample - apart, 0)]
    later = power[sample : sample + until]
    at_once = earlier.size == 0 or earlier.mean() < _RISES * later.mean()
    return sample if at_once else None


def _cleaned(refit: Refit, first: int, last: int) -> Refit:
    """Fit with an impact between two samples, under the noise of the new residual."""
    comparison, before = refit.objective.comparison, refit.columns
    for _ in range(_ROUNDS):
        knock = _knock(refit, first, last)
        columns = np.concatenate([before, comparison.spectrum(_in_time(comparison, knock))])
        refit = Refit.descend(
            comparison, refit.objective.unknowns, refit.x, refit.noise, columns,
            max_evaluations=FEW,
        )  # fmt: skip
        refit = replace(refit, noise=refit.noise_here())
    return Refit.descend(
        comparison, refit.objective.unknowns, refit.x, refit.noise, before, max_evaluations=1
    )


def _knock(refit: Refit, first: int, last: int) -> RecordedImpact:
    """Return an impact of no size between two samples, with the poles of the fit."""
    comparison = refit.objective.comparison
    rate_hz = comparison.decimation.rate_hz
    poles = comparison.poles(refit.plant)
    return RecordedImpact(
        first_s=comparison.first_s + first / rate_hz,
        last_s=comparison.first_s + last / rate_hz,
        # A touch that begins softly is seen when it has grown.
        resolution_s=max(2, last - first) / rate_hz,
        poles_rad_s=tuple(pole.at_rad_s for pole in poles),
    )


def _in_time(comparison: Comparison, knock: RecordedImpact) -> NDArray[np.float64]:
    """Return the columns of an impact at the compared samples, shape (c, samples)."""
    return knock.columns(comparison.times_s(), comparison.decimation.rate_hz)


def _sums(refit: Refit, columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cost reduction by each column in addition to those before it, shape (c,).

    All free parameters stay free, to first order. The columns are torques at the compared samples.
    """
    free, residual = refit.unexplained_columns(refit.objective.comparison.spectrum(columns))
    free /= np.maximum(np.linalg.norm(free, axis=1), np.finfo(float).tiny)[:, None]
    # One after the other (Gram and Schmidt's method): each of what the former have left.
    basis, upper = np.linalg.qr(np.ascontiguousarray(free).view(np.float64).T)
    along = basis.T @ residual.view(np.float64)
    along[np.abs(np.diag(upper)) < _DEPENDENT] = 0.0
    saved: NDArray[np.float64] = along**2
    return saved


_DEPENDENT: Final = 1e-6
"""Length, relative to its own, of what of a column the former ones leave, if it is one of them."""


def _extent(refit: Refit, first: int, last: int) -> tuple[int, int] | None:
    """Return first sample and end of an impact within a window; None if there is none.

    Each sample of unknown torque has to save the BIC penalty of a parameter. There is no impact if
    the samples suffice without the decays: then the sensor was disturbed.
    """
    price = math.log(2 * np.count_nonzero(refit.noise.counts))
    comparison = refit.objective.comparison
    # From behind: decays from the window's end on, then one sample after the other before it.
    knock = _knock(refit, last, last)
    decays = _in_time(comparison, knock)
    single = np.zeros((last - first, comparison.samples))
    single[np.arange(last - first), np.arange(first, last)] = 1.0
    saved = _sums(refit, np.concatenate([decays, single[::-1]]))[len(decays) :]
    gained = np.concatenate([[0.0], np.cumsum(saved - price)])
    begins = last - max(int(np.argmax(gained)), 1)
    # From its beginning on: how long it lasts.
    knock = _knock(refit, begins, begins)
    decays = _in_time(comparison, knock)
    saved = _sums(refit, np.concatenate([decays, single[begins - first :]]))[len(decays) :]
    gained = np.concatenate([[0.0], np.cumsum(saved - price)])
    ends = begins + int(np.argmax(gained))
    alone = _sums(refit, np.concatenate([single[begins - first : ends - first], decays]))
    rings = float(alone[ends - begins :].sum())
    deviate = chi_square_deviate(rings, len(decays))
    sure = deviate > math.sqrt(2 * largest_of(comparison.samples))
    return (begins, ends) if sure and rings > _RINGS * float(alone.sum()) else None


def _sized(refit: Refit, first: int, last: int) -> DetectedImpact:
    """Return an impact with its size and the fraction that it explains."""
    comparison = refit.objective.comparison
    knock = _knock(refit, first, last)
    in_time = _in_time(comparison, knock)
    cost, expected = refit.cost, refit.expected_cost
    shared = bool(cost < _OVERWHELMING * expected)
    whitened, residual = refit.unexplained_columns(comparison.spectrum(in_time), beam_free=shared)
    free = whitened.view(np.float64)
    scale = np.linalg.norm(free, axis=1)
    scale[scale == 0] = 1.0
    free /= scale[:, None]
    sizes = -np.linalg.lstsq(free.T, residual.view(np.float64), rcond=1e-10)[0]
    left = (residual.view(np.float64) + sizes @ free).view(np.complex128)
    explained = float(np.vdot(left, left).real)
    sizes /= scale
    torque_nm = sizes @ in_time
    after = slice(first, first + math.ceil(comparison.decimation.rate_hz))
    before = comparison.in_time(left)
    quiet = before[max(first - math.ceil(_QUIET_S * comparison.decimation.rate_hz), 0) : first]
    return DetectedImpact(
        knock=replace(
            knock,
            sizes=tuple(sizes.tolist()),
            largest_nm=float(np.abs(torque_nm[after]).max()),
        ),
        explained_fraction=float((cost - explained) / max(cost - expected, 1.0)),
        before=float(np.mean(quiet**2) / np.mean(before**2)) if quiet.size else 0.0,
    )
