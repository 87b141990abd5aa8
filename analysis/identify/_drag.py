"""Air drag on the beam: whether it is there, how large C_D d is, and the damping by amplitude.

Drag along the whole beam is one number, or two where the coefficient falls with the speed. Without
it a fit finds a fractional order, a delay, deviating mode frequencies and another density
instead: drag damps each mode in proportion to its speed.

In free vibration of one mode, the tip moving by ``A sin(omega t)``, a force per metre
``rho_air/2 C v^p`` takes from each cycle as much as linear damping of the ratio::

    rho_air/2 C (A omega)^(p - 1) m_p kappa_p / (2 rho omega)

rho being the mass per length, ``m_p`` the mean of ``2 |sin|^(p + 1)`` and ``kappa_p`` that of
``|psi|^(p + 1)`` over that of ``psi²`` along the beam, psi being the mode with 1 at the tip. This
adds to the ratio of the beam without air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._refit import MISSED, Refit
from analysis.identify.drag_torque import HALF_DENSITY, DragError, DragLaw, DragResponse
from analysis.models import STRUCTURES
from analysis.statistics import NORMAL_95
from rigd.beam import mode_shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._plant import Plant
    from analysis.identify.noise import NoiseSpectrum
    from analysis.models import Structure


# Search for drag

_SCORED: Final = ("III", "VI", "VII")
"""Structures with which drag is tested: those that have either damping."""

_EVIDENT: Final = 100.0
_ALL_BUT_NOISE: Final = 0.8
"""Squares, and fraction of the unexplained squares, by which a small drag reduces the cost where it
is evident. In records with other defects of a rig (`benchmarks/wrong_models.py`) the column
removes less than a third, or its size is negative. With drag it removes more than all, since a
part of the residual by drag counts as noise."""

_PROMISE: Final = 6.0
"""Error of the deviance reduction that the first order predicts."""

_ROUNDS: Final = 15
_FEW: Final = 12
"""Evaluations of a descent before the drag is recomputed."""

_EARLY_EVALUATIONS: Final = 4
"""Evaluations that show whether a structure is hopeless."""

_MANY: Final = 40
_HOPELESS: Final = 50.0
"""Deviance above the structure with drag from which the descent of another ends early."""

_CONVERGED: Final = 2.0
_ROUGHLY: Final = 500.0
"""Predicted reduction of squares below which the drag is not recomputed: the step itself is taken,
by all fits at this drag (`_fit_all`).

The two numbers of a law and external damping can compensate each other along a flat direction.
There each recomputation predicted a step of half a standard deviation in the same direction, for
ten rounds and more: away from the true value, at a second a round.
"""

_IN_VAIN: Final = 20.0
"""Reduction of squares with which a step may be the last, if the step before reduced them by no
more than twice as much. Where external damping has vanished, or is an inertia, each step along its
order predicts a reduction that the recomputed drag does not confirm.
"""

_LEAD: Final = "III"
_FREEST: Final = "VI"

_ONE_NUMBER: Final = 0.1
"""Relative deviation of the drag above which one number has to do.

A cylinder's coefficient falls with the speed. Taken for constant it is up to 7 % off on rods and
wires between 0.2 and 2 mm, and makes up for the rest with external damping: what is known better
has two numbers, whether or not the second differs from nought, or its interval would be too narrow.
"""

_SLOWEST: Final = 0.02
"""Lowest speed with any information, relative to the highest."""


@dataclass(frozen=True, slots=True)
class DragEstimate:
    """Estimate of the air drag.

    Attributes
    ----------
    value_m : float
        C_D d at `speed_m_s`; the density of the air is assumed to be 1.2 kg/m³.
    std_m : float
    interval_95_m : tuple of float
        Not below 0.
    speed_m_s : float
        The speed at which it is known best; if the record determines only a mean, the speed with
        the largest weight.
    law : DragLaw
        For all speeds.
    covariance : tuple of tuple of float
        Covariance of the law's numbers that were free: of the first, or of both.
    """

    value_m: float
    std_m: float
    interval_95_m: tuple[float, float]
    speed_m_s: float
    law: DragLaw
    covariance: tuple[tuple[float, ...], ...]


def with_evident_drag(uniform: CandidateSet) -> CandidateSet:
    """Refit with air drag if it is evident before any other explanation has been tested.

    To first order it explains the whole residual of a uniform beam, which no other defect of a rig
    does. With drag only noise remains.

    Parameters
    ----------
    uniform : CandidateSet
        Without drag, on a uniform beam only.

    Returns
    -------
    CandidateSet
        The one given, unless drag is evident; else with `drag` in all candidates.
    """
    if uniform.misread or not _is_evident(uniform):
        return uniform
    found = _with_drag(uniform)
    return found if found.drag is not None and found.all_but_white(found.likeliest) else uniform


def _is_evident(uniform: CandidateSet) -> bool:
    """Return whether a small drag with the freest structure would explain its residual."""
    freest = next(c for c in uniform.candidates if c.structure.name == _FREEST)
    refit = uniform.refit(freest, 1)
    size, saved = _first_amplitude(refit)
    return size > 0 and saved > max(_EVIDENT, _ALL_BUT_NOISE * (refit.cost - refit.expected_cost))


def with_air_drag(candidate_set: CandidateSet) -> CandidateSet:
    """Refit all candidates with air drag, if that explains the record better.

    To first order a column of known shape predicts by how much drag reduces the cost of each of a
    few structures. Drag is fitted only if one of them could then be the best of all.

    Parameters
    ----------
    candidate_set : CandidateSet
        Without drag.

    Returns
    -------
    CandidateSet
        The one given, if there is no drag; else with `drag`, the lowest BIC first.
    """
    return _with_drag(candidate_set) if _promising(candidate_set) else candidate_set


def _with_drag(candidate_set: CandidateSet) -> CandidateSet:
    """Fit all structures with drag; return the given set if that is no better."""
    lead = next((c for c in candidate_set.candidates if c.structure.name == _LEAD), None)
    start = None if lead is None else _start(candidate_set, lead)
    if start is None:
        return candidate_set
    converged = _converged(candidate_set, start, STRUCTURES[_LEAD], tolerance=_ROUGHLY)
    if converged is None:
        return candidate_set
    # Thence to the freest damping; without drag its fit may be that of no beam at all.
    known, point = converged.objective.comparison, _DragPoint.of(converged)
    for name in (_FREEST, _LEAD):
        converged = _converged(candidate_set, point, STRUCTURES[name], known=known)
        if converged is not None:
            break
    else:
        return candidate_set
    found = _fit_all(candidate_set, converged)
    assert found.drag is not None
    return found if found.drag.value_m > 0 and found.bic < candidate_set.bic else candidate_set


@dataclass(frozen=True, slots=True)
class _DragPoint:
    """State of a search with drag."""

    plant: Plant
    structure: Structure
    law: DragLaw
    noise: NoiseSpectrum
    two: bool = False

    @classmethod
    def of(cls, refit: Refit) -> _DragPoint:
        structure = refit.objective.unknowns.structure
        two = len(refit.columns) > 1
        return cls(refit.plant, structure, _law_at(refit), refit.noise, two)


def _promising(candidate_set: CandidateSet) -> bool:
    """Return whether some structure with drag could be better than the best without."""
    best = candidate_set.best
    for candidate in candidate_set.candidates:
        if candidate is not best and candidate.structure.name not in _SCORED:
            continue
        refit = candidate_set.refit(candidate, 1)
        size, saved = _first_amplitude(refit)
        before = refit.cost
        cost = max(before - saved, 1e-3 * before)
        gain = candidate.values * math.log(before / cost)
        if size > 0 and candidate.bic - gain + math.log(candidate.values) < best.bic + _PROMISE:
            return True
    return False


def small_drag(comparison: Comparison, plant: Plant) -> NDArray[np.complex128]:
    """Return the spectrum of the torque by a small drag over C_D d, shape (1, K)."""
    moved_rad = comparison.angle_rad + comparison.incoherent_rad
    response = DragResponse(moved_rad, comparison.decimation.rate_hz, plant)
    return comparison.spectrum(response.first_order()[None, comparison.retained])


def _first_amplitude(refit: Refit) -> tuple[float, float]:
    """Return the size of a small drag added to a fit, all else free, and the cost reduction."""
    (column,), residual = refit.unexplained_columns(
        small_drag(refit.objective.comparison, refit.plant)
    )
    square = float(np.vdot(column, column).real)
    if square <= 0:
        return 0.0, 0.0
    along = float(np.vdot(column, residual).real)
    return -along / square, along**2 / square


def _start(candidate_set: CandidateSet, lead: Candidate) -> _DragPoint | None:
    """Fit with the first order of the drag; return None if the drag would be negative."""
    column = small_drag(candidate_set.comparison, lead.fit.plant)
    refit = replace(candidate_set, columns=column).refit(lead, _FEW)
    size = float(refit.amplitudes()[0][0])
    return (
        _DragPoint(refit.plant, lead.structure, DragLaw(size), candidate_set.noise)
        if size > 0
        else None
    )


def _converged(
    candidate_set: CandidateSet,
    point: _DragPoint,
    structure: Structure,
    *,
    tolerance: float = _CONVERGED,
    known: Comparison | None = None,
) -> Refit | None:
    """Fit one structure with drag, from `point`; recompute the drag until the fit converges.

    `tolerance` is the largest reduction of squares by a further step, `known` the comparison with
    the drag of the start. Return None if the drag is negative, unstable or does not converge.
    """
    unknowns = candidate_set.unknowns(structure)
    x = unknowns.vector(point.plant)
    law, noise, two = point.law, point.noise, point.two
    comparison, roughly, saved = known, tolerance > _CONVERGED, math.inf
    for _ in range(_ROUNDS):
        if comparison is None:
            plant = unknowns.plant(x)
            # Without drag the beam seemed to be another, and so what the rest of the angle did.
            try:
                comparison = candidate_set.comparison.recompute_incoherent_torque(plant).with_drag(
                    plant, law
                )
            except DragError:
                return None
        drag = comparison.drag
        assert drag is not None
        descent = partial(Refit.descend, comparison, unknowns, noise=noise)
        at_first = descent(x, columns=drag.by_law[: 1 + two], max_evaluations=1)
        here = at_first.further(_FEW)
        if two or roughly or _relative_std(here) > _ONE_NUMBER:
            before, saved = saved, at_first.cost - max(at_first.predicted_cost, here.cost)
            if saved < tolerance or before / 2 < saved < _IN_VAIN:
                return at_first
        else:
            # With damping that is not the beam's, a second number would be its stopgap.
            two = True
            here = descent(here.x, columns=drag.by_law, max_evaluations=_FEW)
        x, law, noise = here.x, _law_at(here), here.noise_here()
        if law.at(drag.speed_m_s) <= 0:
            return None
        comparison = None
    return None


def _relative_std(refit: Refit) -> float:
    """Return the relative standard deviation of a drag law of one number."""
    law, (_, std) = _law_at(refit), refit.amplitudes()
    return float(std[0]) / max(float(law.constant_m), float(np.finfo(float).tiny))


def _law_at(refit: Refit) -> DragLaw:
    """Return the drag law at a minimum: the law of the last computation plus the step."""
    expansion = refit.objective.comparison.drag
    assert expansion is not None
    step = refit.amplitudes()[0].tolist()
    slowing = expansion.law.slowing + (step[1] if len(step) > 1 else 0.0)
    return DragLaw(expansion.law.constant_m + step[0], slowing)


def _fit_all(candidate_set: CandidateSet, converged: Refit) -> CandidateSet:
    """Fit all structures with the drag of a converged fit, and estimate its size."""
    other = replace(
        candidate_set,
        comparison=converged.objective.comparison,
        columns=converged.columns,
        noise=converged.noise_here(),
    )
    least = other.descent(converged.objective.unknowns, converged.x, 1).cost
    most = least * math.exp(_HOPELESS / candidate_set.best.values)
    begun = []
    for each in candidate_set.candidates:
        unknowns = other.unknowns(each.structure)
        refit = Refit.descend(
            other.comparison,
            unknowns,
            unknowns.vector(converged.plant),
            other.noise,
            other.columns,
            max_evaluations=_FEW,
            relative_tolerance=MISSED,
            hopeless=(_EARLY_EVALUATIONS, most),
        )
        begun.append((refit.candidate(), refit))
    candidates = [
        refit.further(_MANY).candidate() if refit.predicted_cost < most else candidate
        for candidate, refit in begun
    ]
    found = other.ranked(candidates).cross_check()
    return replace(found, drag=_estimate(found))


def _estimate(candidate_set: CandidateSet) -> DragEstimate:
    """Return the drag with its standard deviation, with all possible damping of the best beam."""
    freest = max(candidate_set.candidates, key=lambda c: (len(c.structure.free), -c.bic))
    refit = candidate_set.refit(freest)
    law, covariance = _law_at(refit), refit.amplitude_covariance()[1]
    covariance = covariance * freest.fit.cost / freest.fit.degrees_of_freedom
    expansion = refit.objective.comparison.drag
    assert expansion is not None
    speed = expansion.speed_m_s
    slope = np.ones(1)
    if len(covariance) > 1:
        pivot = max(-covariance[0, 1] / covariance[1, 1], np.finfo(float).tiny)
        top = expansion.top_speed_m_s
        speed = min(max(float(pivot**-1.5), _SLOWEST * top), top)
        slope = np.array([1.0, speed ** (-2 / 3)])
    value, std = law.at(speed), math.sqrt(float(slope @ covariance @ slope))
    return DragEstimate(
        value_m=value,
        std_m=std,
        interval_95_m=(max(value - NORMAL_95 * std, 0.0), value + NORMAL_95 * std),
        speed_m_s=speed,
        law=law,
        covariance=tuple(tuple(row) for row in covariance.tolist()),
    )


# Damping of a mode against its amplitude

_MODES: Final = (1, 2)
_DEFLECTIONS: Final = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1)
"""Deflections of the tip relative to the length, as far as slopes are small."""

_POWERS: Final = (2.0, 4 / 3)
"""Powers of the speed, for the two numbers of a `DragLaw`."""

_POINTS: Final = 64


@dataclass(frozen=True, slots=True)
class DampingAt:
    """Damping ratio of a mode in free vibration at one amplitude.

    Attributes
    ----------
    mode : int
    tip_amplitude_m : float
    damping_ratio, std : float
        Sum of the ratios of beam and air. Their uncertainties are added as if independent;
        they are anticorrelated, so this is an upper limit.
    """

    mode: int
    tip_amplitude_m: float
    damping_ratio: float
    std: float


def damping_with_amplitude(candidate_set: CandidateSet) -> tuple[DampingAt, ...]:
    """Return the damping of the first visible modes at several amplitudes; empty without drag."""
    drag = candidate_set.drag
    if drag is None:
        return ()
    fit = candidate_set.best.fit
    numbers = np.array([drag.law.constant_m, drag.law.slowing])[: len(drag.covariance)]
    covariance = np.array(drag.covariance)
    found = []
    for mode in fit.modes:
        if mode.number not in _MODES or mode.frequency_hz <= 0:
            continue
        for fraction in _DEFLECTIONS:
            amplitude = fraction * fit.plant.beam.length_m
            slopes = by_law(
                mode.number,
                2 * math.pi * mode.frequency_hz,
                amplitude,
                fit.plant.beam.density_kg_per_m,
            )[: numbers.size]
            variance = mode.damping_ratio_std**2 + float(slopes @ covariance @ slopes)
            found.append(
                DampingAt(
                    mode=mode.number,
                    tip_amplitude_m=amplitude,
                    damping_ratio=mode.damping_ratio + float(slopes @ numbers),
                    std=math.sqrt(variance),
                )
            )
    return tuple(found)


def by_law(
    mode: int, omega_rad_s: float, tip_amplitude_m: float, density_kg_per_m: float
) -> NDArray[np.float64]:
    """Return the damping ratio by the air per number of a `DragLaw`, shape (2,)."""
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    shape = np.abs(mode_shape(mode, 0.5 * (node + 1)) / mode_shape(mode, 1.0))
    speed = tip_amplitude_m * omega_rad_s
    slopes = []
    for power in _POWERS:
        mean = 2 / math.sqrt(math.pi) * math.gamma(power / 2 + 1) / math.gamma(power / 2 + 1.5)
        along = float(weight @ shape ** (power + 1)) / float(weight @ shape**2)
        viscous = HALF_DENSITY * speed ** (power - 1) * mean * along
        slopes.append(viscous / (2 * density_kg_per_m * omega_rad_s))
    return np.array(slopes)
