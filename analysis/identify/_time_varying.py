"""Changes along the record (damping, stiffness, gain), clocks of different rates, and backlash.

The columns have a known shape and unknown size, as for `analysis.identify._refit`: the change of
the torque if damping, stiffness or gain rise in proportion to time, and the effect of a hub that
follows the shaft with backlash. In one sweep time and frequency go together, so a damping that
drifts competes with an order of the damping, and a gain that drifts with a filter. Where torque and
angle were sampled by clocks of different rates, the torque's delay changes along the record.

A mode that rings for seconds depends on its damping and stiffness in the past: with 0.4 % of
stiffness in 22 s, a mode of 2.6 Hz is 0.03 rad out of phase with a mode of its present frequency.
With ``p = rho/EI s² + gamma s^lambda``, ``c = 1 + zeta s^alpha``, ``R = p / (c k⁴ + p)``, its
position u (the rigid part a angle plus the vibration q) and a stress D of the stiffness or damping
that changes as ``1 + e w(t)``::

    D = o k⁴ q + gamma s^lambda u,    q = -R a angle - e (c k⁴ + p)^-1 w D

the torque gains ``e a EI (w gamma s^lambda u - R w D)``, where w multiplies the term to its right
in time; o is ``zeta s^alpha`` for a damping that changes, and c for the stiffness of a beam whose
mass stays. The second equation put into the first, again and again, gives D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify._data import fast_length
from analysis.identify._finding import Finding
from analysis.identify._predictor import ResponseGrid, eigenvalues, torque_channel
from analysis.identify._refit import MANY, Refit
from analysis.identify.residual_tests import SIGNIFICANT_STD
from analysis.identify.verdict import BIC_DECISIVE
from analysis.models import STRUCTURES
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._finding import Kind
    from analysis.identify._plant import Plant


# Search for changes

What = Literal["damping", "stiffness", "gain", "clock", "play"]

_LEADS: Final = tuple(STRUCTURES[name] for name in ("III", "VII", "VI"))
_GRADIENT: Final = ("zeta", "gamma", "ln_stiffness", "ln_density_over_stiffness")
_GAIN: Final = SIGNIFICANT_STD**2 + 2 * math.log(20)
"""Deviance that a column must save: five of them are tried on four candidates."""

_IN_SIGHT: Final = 0.75
"""Fraction of a rival's lower BIC that a column has to reach by prediction. The first order
predicts it to a tenth."""

UNIT_PLAY_RAD: Final = 1e-4
_CLOCK_UNIT: Final = 1e-5
_UNITS: Final[Mapping[What, float]] = {"play": UNIT_PLAY_RAD, "clock": _CLOCK_UNIT}
_TERMS: Final = 16
"""Terms of a Taylor series in time: enough for three radians."""

_ROUNDS: Final = 8
_CONVERGED: Final = 0.01


@dataclass(frozen=True, slots=True)
class TemporalChange:
    """Change of one property along the record, or the backlash.

    Attributes
    ----------
    what : str
    size, std : float
        Relative change from the first sample to the last; for clocks the relative difference of
        their rates; the backlash in rad.
    behind : float
        BIC with it minus the lowest BIC without it.
    """

    what: What
    size: float
    std: float
    behind: float

    @property
    def name(self) -> str:
        """Return the name, as the beginning of a sentence."""
        return _NAMES[self.what]

    @property
    def certain(self) -> bool:
        """Return whether nothing else explains the record as well."""
        return self.behind < -BIC_DECISIVE


def along_time(
    candidate_set: CandidateSet, rival_bic: float = math.inf
) -> tuple[CandidateSet, tuple[TemporalChange, ...]]:
    """Find changes along the record; refit all candidates with a certain one.

    Only columns that may come near `rival_bic`, the BIC of another explanation
    (`CandidateSet.bic`), are fitted. Returns the candidates and the changes that explain the record
    best or equally well.
    """
    if candidate_set.misread:
        return candidate_set, ()
    lag = _lag_of_play(candidate_set.comparison)
    most = candidate_set.best.bic + min(BIC_DECISIVE, _IN_SIGHT * (rival_bic - candidate_set.bic))
    tried: dict[What, tuple[float, Refit]] = {}
    for lead in _leads(candidate_set):
        for what, predicted in _promising(candidate_set, lead, lag, most):
            if predicted < tried.get(what, (math.inf,))[0]:
                refit, bic = _fitted(candidate_set, lead, what, lag)
                if bic < tried.get(what, (math.inf,))[0]:
                    tried[what] = (bic, refit)
    found = []
    for what, (bic, refit) in tried.items():
        sizes, std = refit.amplitudes()
        unit = _UNITS.get(what, 1.0)
        change = TemporalChange(
            what, unit * float(sizes[-1]), unit * float(std[-1]), bic - candidate_set.best.bic
        )
        if change.behind < BIC_DECISIVE and _possible(change):
            found.append((change, refit))
    found.sort(key=lambda pair: pair[0].behind)
    if not found:
        return candidate_set, ()
    first, refit = found[0]
    changes = tuple(c for c, _ in found if c.behind < first.behind + BIC_DECISIVE)
    if not first.certain or len(changes) > 1:
        return candidate_set, changes
    return candidate_set.with_columns(refit.columns, refit.noise_here()), changes


def _possible(change: TemporalChange) -> bool:
    """Return whether a size is possible: backlash is positive, and no change exceeds 100 %."""
    return change.size > 0 if change.what == "play" else abs(change.size) < 1


def _leads(candidate_set: CandidateSet) -> Iterator[Candidate]:
    """Return the best candidate, and simple ones that a change may explain instead."""
    yield candidate_set.best
    for candidate in candidate_set.candidates[1:]:
        if candidate.structure in _LEADS:
            yield candidate


def _promising(
    candidate_set: CandidateSet, lead: Candidate, lag: NDArray[np.float64], most_bic: float
) -> Iterator[tuple[What, float]]:
    """Return the columns whose predicted BIC would make a candidate the best, with the BIC."""
    refit = candidate_set.refit(lead, 1)
    columns = _columns(candidate_set.comparison, lead.fit.plant, lag)
    saved = refit.saved_by(np.array(list(columns.values())))
    for what, squares in zip(columns, saved.tolist(), strict=True):
        left = max(refit.cost - squares, 1e-3 * refit.cost)
        gain = lead.values * math.log(refit.cost / left)
        bic = lead.bic - gain + math.log(lead.values)
        if gain > _GAIN and bic < most_bic:
            yield what, bic


def _fitted(
    candidate_set: CandidateSet, lead: Candidate, what: What, lag: NDArray[np.float64]
) -> tuple[Refit, float]:
    """Fit a candidate with one additional column; return its BIC as well."""
    refit = candidate_set.refit(lead, 1)
    unknowns = refit.objective.unknowns
    size = 0.0
    for _ in range(_ROUNDS):
        column = _column(candidate_set.comparison, refit.plant, lag, what, size)
        columns = np.concatenate([candidate_set.columns, column[None]])
        before = refit.cost
        refit = Refit.descend(
            candidate_set.comparison,
            unknowns,
            refit.x,
            candidate_set.noise,
            columns,
            max_evaluations=MANY,
        )
        moved, size = size, float(refit.amplitudes()[0][-1])
        converged = abs(size - moved) < _CONVERGED * abs(size)
        if converged and abs(lead.values * math.log(before / refit.cost)) < 1:
            break
    deviance = lead.values * math.log(refit.cost / lead.values)
    return refit, deviance + (lead.parameters + 1) * math.log(lead.values)


def _columns(
    comparison: Comparison, plant: Plant, lag: NDArray[np.float64]
) -> dict[What, NDArray[np.complex128]]:
    """Return spectra of the torque by a change of 1 over the record, each of (K,)."""
    slopes = _slopes(comparison, plant)
    return {what: _column(comparison, plant, lag, what, 0.0, slopes) for what in _NAMES}


def _slopes(comparison: Comparison, plant: Plant) -> dict[What, NDArray[np.float64]]:
    """Return the torque per relative change of each property, each of shape (samples,)."""
    _, (zeta, gamma, gain, ratio) = comparison.prediction.torque(plant, _GRADIENT)
    return {
        "damping": plant.damping.zeta * zeta + plant.damping.gamma * gamma,
        "stiffness": gain - ratio,  # EI rises, rho stays
        "gain": gain,
    }


def _column(
    comparison: Comparison,
    plant: Plant,
    lag: NDArray[np.float64],
    what: What,
    size: float,
    slopes: Mapping[What, NDArray[np.float64]] | None = None,
) -> NDArray[np.complex128]:
    """Return the column at a finite size, divided by the size, shape (K,).

    `slopes` are the results of `_slopes`, if known.
    """
    if what == "play":
        return comparison.spectrum(comparison.prediction.of_other(lag).torque(plant)[0])
    if what == "clock":
        return comparison.spectrum(_sampled_late(comparison, plant, size))
    ramp = np.linspace(-0.5, 0.5, comparison.samples)
    change = ramp * (slopes or _slopes(comparison, plant))[what]
    if what != "gain":
        change += memory_torque(comparison, plant, ramp, what, size)
    return comparison.spectrum(change)


def _sampled_late(comparison: Comparison, plant: Plant, size: float) -> NDArray[np.float64]:
    """Return the torque by a faster clock per difference of the rates, shape (samples,).

    The torque with time stamp t is that of t plus the difference times the time since the middle of
    the record, by its Taylor series. `size` is in `_CLOCK_UNIT`.
    """
    prediction, time_s = comparison.prediction, comparison.times_s()
    since_s = _CLOCK_UNIT * (time_s - time_s.mean())
    grid = ResponseGrid(prediction.s)
    derivative = grid.evaluate(plant)[0]
    factor = since_s
    added = np.zeros(since_s.size)
    for number in range(1, _TERMS + 1 if size else 2):
        derivative = derivative * grid.s
        added += factor * prediction.in_time(derivative)
        factor = factor * size * since_s / (number + 1)
    return added


def play(comparison: Comparison, plant: Plant) -> NDArray[np.complex128]:
    """Return the spectrum of the torque by a backlash of `UNIT_PLAY_RAD`, shape (K,)."""
    return _column(comparison, plant, _lag_of_play(comparison), "play", 0.0)


def _lag_of_play(comparison: Comparison) -> NDArray[np.float64]:
    """Return the angle of the hub less that of the shaft with backlash, at the decimated rate."""
    highest_hz = float(comparison.frequency_hz[-1])
    half, here, hub = UNIT_PLAY_RAD / 2, 0.0, []
    shaft = comparison.measurement.angle_from_rest(highest_hz)
    for angle in shaft.tolist():
        # A comparison each: min and max take three times as long, at every tick of the record.
        if here < angle - half:
            here = angle - half
        elif here > angle + half:
            here = angle + half
        hub.append(here)
    lag: NDArray[np.float64] = comparison.decimation.apply(np.array(hub) - shaft)
    return lag


# What a mode remembers

_PADDED: Final = 1.5
_DECAY: Final = 9.0
"""As in `analysis.identify._nonlinear`: on s = sigma + j omega what wraps round has decayed."""

_ORDERS: Final = 12
_SMALL: Final = 1e-4
"""Highest order of the size, and smallest fraction of the stress that is significant."""


def memory_torque(
    comparison: Comparison,
    plant: Plant,
    change: NDArray[np.float64],
    what: Literal["damping", "stiffness"],
    size: float = 0.0,
) -> NDArray[np.float64]:
    """Return the torque by the past of a change, per unit size, shape (samples,).

    This is the torque beyond the instantaneous derivative. `change`, shape (samples,), is w at the
    retained samples, constant before and after. With `what` of "stiffness" the mass stays. `size`
    is e.
    """
    n, rate_hz = comparison.angle_rad.size, comparison.decimation.rate_hz
    length = fast_length(int(np.ceil(_PADDED * n)))
    sigma = _DECAY * rate_hz / length
    s = sigma + 2j * np.pi * rate_hz / length * np.arange(length // 2 + 1)
    growth = np.exp(sigma * np.arange(n) / rate_hz)
    retained = comparison.retained
    w = np.interp(np.arange(n), np.arange(retained.start, retained.stop), change)
    damping, beam = plant.damping, plant.beam
    internal = damping.zeta * s**damping.alpha
    external = damping.gamma * s**damping.lambda_
    inertial = beam.density_over_stiffness * s * s + external
    own = internal + 1 if what == "stiffness" else internal
    angle = np.fft.rfft(comparison.angle_rad / growth, length) * torque_channel(plant, s)
    total = np.zeros(n)

    def in_time(spectrum: NDArray[np.complex128]) -> NDArray[np.float64]:
        values: NDArray[np.float64] = np.fft.irfft(spectrum, length)[:n] * growth
        return values

    def weighted(spectrum: NDArray[np.complex128]) -> NDArray[np.complex128]:
        found: NDArray[np.complex128] = np.fft.rfft(w * in_time(spectrum) / growth, length)
        return found

    of_modes = (eigenvalues(comparison.visible_modes) / beam.length_m) ** 4
    stiffnesses = 4 * beam.bending_stiffness_n_m2 / (beam.length_m * of_modes)
    for stiffness, k in zip(stiffnesses.tolist(), of_modes.tolist(), strict=True):
        compliance = 1 / ((1 + internal) * k + inertial)
        follows = inertial * compliance
        at_first = own * k * -follows + external * (1 - follows)
        steady = stress = at_first * angle
        moved = np.zeros_like(stress)
        for _ in range(_ORDERS if size else 1):
            moved = -compliance * weighted(stress)
            before, stress = stress, steady + size * (own * k + external) * moved
            if np.abs(stress - before).max() < _SMALL * np.abs(steady).max():
                break
        deflection = (1 - follows) * angle + size * moved
        late = in_time(inertial * moved) + w * in_time(external * deflection)
        total += stiffness * (
            late - w * in_time(external * (1 - follows) * angle - follows * steady)
        )
    return total[retained]


# Words

_NAMES: Final[dict[What, str]] = {
    "damping": "Damping that changes along the record",
    "stiffness": "Stiffness that changes along the record",
    "gain": "A torque gain that changes along the record",
    "clock": "Clocks of different rates",
    "play": "Backlash between encoder and beam",
}
_KINDS: Final[dict[What, Kind]] = {
    "damping": "drifting damping",
    "stiffness": "drifting stiffness",
    "gain": "drifting gain",
    "clock": "clock rate difference",
    "play": "play",
}


def established(changes: tuple[TemporalChange, ...], *, one_sweep: bool) -> bool:
    """Return whether one change, and nothing else, explains the record.

    A change with time is never established by one sweep: it may depend on frequency instead.
    Backlash may be established.

    Parameters
    ----------
    changes : tuple of TemporalChange
    one_sweep : bool
        As `Measurement` has it.
    """
    if len(changes) != 1 or not changes[0].certain:
        return False
    return changes[0].what == "play" or not one_sweep


def changing(changes: tuple[TemporalChange, ...], *, one_sweep: bool) -> Iterator[Finding]:
    """Yield findings on the changes along the record.

    Parameters
    ----------
    changes : tuple of TemporalChange
    one_sweep : bool
        As `Measurement` has it.
    """
    for change in changes:
        finding = _finding(change)
        if established(changes, one_sweep=one_sweep):
            yield finding
        else:
            others = "the others named" if len(changes) > 1 else "any other model"
            yield replace(
                finding,
                sentence=(
                    f"{_NAMES[change.what]} ({_size(change)}) would explain the record as well as "
                    f"{others}: in one sweep, time and frequency vary together."
                ),
                value=None,
                interval=None,
            )


def _size(change: TemporalChange) -> str:
    if change.what == "play":
        return f"{1e3 * change.size:.2g} mrad"
    if change.what == "clock":
        return f"the torque's by {1e6 * change.size:+.3g} ppm"
    return f"{100 * change.size:+.2g} % from beginning to end"


_SHOWN: Final[Mapping[What, float]] = {"play": 1e3, "clock": 1e6}
"""Factor in which a size is shown; that of a change in % otherwise."""

_THERE_AND_BACK: Final = (
    "weep up and down in one session (rigd run chirp --there-and-back): that separates changes "
    "with time from those with frequency."
)


def _finding(change: TemporalChange) -> Finding:
    half = NORMAL_95 * change.std
    of_play = change.what == "play"
    remedy = f"S{_THERE_AND_BACK}"
    if of_play:
        remedy = "Remove the backlash in gear and clamp."
    elif change.what == "clock":
        remedy = f"Sample angle and torque by one clock, or s{_THERE_AND_BACK}"
    return Finding(
        kind=_KINDS[change.what],
        sentence=(
            f"{_NAMES[change.what]}: {_size(change)} "
            f"(± {_SHOWN.get(change.what, 100.0) * half:.1g}; 95 %). It was fitted too"
            + (
                ", to first order in its size."
                if of_play
                else "; all parameters are those at the middle of the record."
            )
        ),
        value=change.size,
        interval=(change.size - half, change.size + half),
        unit="rad" if of_play else "1",
        remedy=remedy,
    )
