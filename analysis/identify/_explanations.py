"""Simple causes that would explain modes which no plain uniform beam has: named, and never facts.

Each is fitted to the modal constants with the seven parameters of the beam, at exact geometry. A
dozen constants admit several causes, so none of those that explain them is established.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify._altered_beam import GRAVITY_M_S2, Alteration, mode_terms
from analysis.identify._finding import Finding
from analysis.identify._uniform_beam import REFUSED_BELOW, ConstantsProblem
from analysis.statistics import chi_square_p_value

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from analysis.identify._altered_beam import ModeTerms, Profile
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._plant import Plant
    from analysis.identify._step_in_time import Step
    from analysis.identify._uniform_beam import UniformBeamTest
    from rigd.beam import Beam

_TOLERANCES: Final = (0.03, 3e-3, 3e-4, 0.0)
"""Of all constants, one after the other: frequencies are known so well that without any the way to
a minimum would be long and narrow."""

_HOPELESS: Final = 20.0
"""Chi-square a degree of freedom, with a tolerance, from which a cause is given up."""

_STEP: Final = 1e-6
"""Of unknowns, for derivatives; those of a cause relative to their scale."""

_MANY: Final = 12
_LONGEST: Final = 1.0
_RISE: Final = 10.0
_HALVINGS: Final = 3
_CLOSE: Final = 1e-3
"""Share of chi-square below which no step is taken."""

_RELUCTANCE: Final = 1e-3
"""Keeps an unknown without effect where it is; one determined is moved all the same."""

_NEAR: Final = 6.0
"""Chi-square above the best from which a cause is not named unless its p-value is `_GOOD`."""

_GOOD: Final = 0.05
_MOST_NAMED: Final = 5
_BUTTERWORTH: Final = 2**0.5
RELAXATION: Final = "relaxation"
"""It may be all of the internal damping."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """One cause that would explain the modes.

    Attributes
    ----------
    name : str
        Kind of cause.
    words : str
        The same with its size, as sentences take it.
    size : float
        In `unit`.
    unit : str
    chi_square, p_value : float
        Of the modal constants with it.
    plant : Plant or None
        Rig with it, where a `Plant` has such a thing.
    """

    name: str
    words: str
    size: float
    unit: str
    chi_square: float
    p_value: float
    plant: Plant | None = None

    def as_json(self) -> dict[str, Any]:
        """As `json.dumps` takes it."""
        return {
            "name": self.name,
            "size": self.size,
            "unit": self.unit,
            "chi_square": self.chi_square,
            "p_value": self.p_value,
        }


@dataclass(frozen=True, slots=True)
class _Cause:
    """A kind of cause, with one or two unknowns of its own.

    Attributes
    ----------
    name : str
    starts : sequence of tuple of float
        Unknowns from which searches begin.
    lower, upper : tuple of float
        What is plausible; nothing that rests on an outer bound counts.
    altered : callable
        Alteration by unknowns, from what is stated and the beam.
    told : callable
        Size, unit and words, from unknowns and the beam found.
    plant : callable, optional
        Rig with it, from unknowns and the rig with the beam found.
    special : tuple of str
        Names of causes that are special cases of this one.
    """

    name: str
    starts: Sequence[tuple[float, ...]]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    altered: Callable[[Alteration, Sequence[float], Beam], Alteration]
    told: Callable[[Sequence[float], Beam], tuple[float, str, str]]
    plant: Callable[[Sequence[float], Plant], Plant] | None = None
    special: tuple[str, ...] = ()


def explanations(
    fit: ModalFit, nominal: Plant, tilt_deg: float | None = None
) -> tuple[Explanation, ...]:
    """Find causes that explain the modes, each alone; the best first.

    Parameters
    ----------
    fit : ModalFit
    nominal : Plant
        Rig and specimen as the file states them; with a mass at the tip, if it states one.
    tilt_deg : float, optional
        Inclination of the plane of motion along the beam at rest as the file states it.
    """
    modes = fit.visible
    if not modes:
        return ()
    problem = ConstantsProblem(fit, modes, nominal, tilt_deg=tilt_deg)
    found = problem.minima()[0].x
    straight = problem.starts()[len(problem.starts()) // 2]
    without = np.where(np.arange(found.size) == 0, problem.lower, straight)
    explained_by: dict[str, Explanation] = {}
    for cause in _CAUSES:
        bases = (found, straight, without) if cause.name == RELAXATION else (found, straight)
        explained = _explained(problem, cause, bases)
        if explained is None:
            continue
        # One of each name, and no general cause where a special case of it suffices.
        simpler = [explained_by[name].chi_square for name in cause.special if name in explained_by]
        margin = _NEAR
        if cause.name in explained_by:
            simpler, margin = [explained_by[cause.name].chi_square], 0.0
        if not simpler or explained.chi_square < min(simpler) - margin:
            explained_by[cause.name] = explained
    least = min((each.chi_square for each in explained_by.values()), default=0.0)
    named = [
        each
        for each in explained_by.values()
        if each.p_value >= _GOOD or each.chi_square <= least + _NEAR
    ]
    named.sort(key=lambda each: -each.p_value)
    return tuple(named[:_MOST_NAMED])


def _explained(
    problem: ConstantsProblem, cause: _Cause, bases: Sequence[NDArray[np.float64]]
) -> Explanation | None:
    """Fit one cause; None if it is not to be tested, explains nothing or is not plausible."""
    count = problem.lower.size
    freedom = problem.compared - count - len(cause.lower)
    if freedom <= 0:
        return None
    begun = []
    for x in bases:
        begun.append((*_Search(problem, cause, x).begun(), x))
    for _, start, x in sorted(begun, key=lambda each: each[0]):
        cost, y = _fitted(problem, cause, x, start, freedom)
        p_value = float(chi_square_p_value(cost, freedom))
        if p_value >= REFUSED_BELOW:
            break
    else:
        return None
    own = y[count:]
    rests = (own <= cause.lower) | (own >= cause.upper)
    rests[1:] &= own[1:] != 0  # a loss may be none
    if rests.any():
        return None
    plant = problem.plant(y[:count])
    size, unit, words = cause.told(own.tolist(), plant.beam)
    return Explanation(
        name=cause.name,
        words=words,
        size=size,
        unit=unit,
        chi_square=cost,
        p_value=p_value,
        plant=cause.plant(own.tolist(), plant) if cause.plant else None,
    )


def _fitted(
    problem: ConstantsProblem,
    cause: _Cause,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    freedom: int,
) -> tuple[float, NDArray[np.float64]]:
    """Descend from y, first with a tolerance; chi-square and unknowns."""
    cost = math.inf
    for tolerance in _TOLERANCES:
        cost, y = _Search(problem, cause, x, tolerance).descended(y)
        if cost > _HOPELESS * freedom:
            break
    return cost, y


class _Search:
    """Search for beam and cause, with one tolerance.

    Parameters
    ----------
    problem : ConstantsProblem
    cause : _Cause
    x : ndarray, shape (7,)
        Unknowns of the beam without it. A damping that is none in them stays so.
    tolerance : float
        Standard deviation of every constant, beside what the record leaves uncertain.
    """

    def __init__(
        self,
        problem: ConstantsProblem,
        cause: _Cause,
        x: NDArray[np.float64],
        tolerance: float = _TOLERANCES[0],
    ) -> None:
        self._problem, self._cause, self._x = problem, cause, x
        self._plain = mode_terms(Alteration(), problem.nominal.beam, problem.modes)
        self._lower = np.concatenate([problem.lower, cause.lower])
        upper = np.where(x <= problem.lower, problem.lower, problem.upper)
        self._upper = np.concatenate([upper, cause.upper])
        own = np.max(np.abs([cause.lower, cause.upper]), axis=0)
        self._scale = np.concatenate([np.ones(x.size), own])
        covariance = problem.covariance + tolerance**2 * np.eye(problem.compared)
        self._whitener = np.linalg.inv(np.linalg.cholesky(covariance))

    def begun(self) -> tuple[float, NDArray[np.float64]]:
        """Best point a step of the beam's unknowns away from a start of the cause."""
        x, rows = self._x, None
        low, high = (ends[: x.size] - x for ends in (self._lower, self._upper))
        found = []
        for start in self._cause.starts:
            y = np.concatenate([x, start])
            terms = self._terms(y)
            if rows is None:
                _, rows = self._slopes(y)
            step = _step(self._whitened(x[None], terms)[0], rows, low, high)[0]
            there = self._whitened((x + step)[None], terms)[0]
            found.append((float(there @ there), np.concatenate([x + step, start])))
        return min(found, key=lambda pair: pair[0])

    def descended(self, y: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Take Gauss-Newton steps; the least chi-square, and its unknowns.

        Whole ones as a rule, also where chi-square rises a little: along a curved valley it does,
        and then falls the more.
        """
        scale, least, best = self._scale, math.inf, y
        for _ in range(_MANY):
            deviation, rows = self._jacobian(y)
            cost = float(deviation @ deviation)
            if cost < least:
                least, best = cost, y
            step, promised = _step(
                deviation,
                rows * scale[:, None],
                (self._lower - y) / scale,
                (self._upper - y) / scale,
            )
            if cost - promised < _CLOSE * max(cost, 1.0):
                break
            step = step * scale * min(1.0, _LONGEST / float(np.abs(step).max()))
            for _ in range(_HALVINGS):
                there = self._deviations(np.clip(y + step, self._lower, self._upper))
                if there @ there < _RISE * cost:
                    break
                step /= 2
            y = np.clip(y + step, self._lower, self._upper)
        return least, best

    def _terms(self, y: NDArray[np.float64]) -> ModeTerms:
        x, own = y[: self._x.size], y[self._x.size :].tolist()
        beam = self._problem.plant(x).beam
        altered = self._cause.altered(self._problem.stated, own, beam)
        if altered.same_shapes(Alteration()):
            return replace(self._plain, alteration=altered)
        terms = mode_terms(altered, beam, self._problem.modes)
        # A cause's mass is a share of the beam's: while that is varied, shapes stay as they are.
        return terms if self._problem.stated.lumps else replace(terms, density_kg_per_m=None)

    def _whitened(self, x: NDArray[np.float64], terms: ModeTerms) -> NDArray[np.float64]:
        """Deviations of beams, (m, 7), with one cause: (m, 4 n)."""
        off = self._problem.differences(x, terms)
        return np.nan_to_num(off @ self._whitener.T, nan=1e6)

    def _deviations(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._whitened(y[None, : self._x.size], self._terms(y))[0]

    def _slopes(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Deviations, and their derivatives by the beam's unknowns."""
        count = self._x.size
        steps = np.concatenate([np.zeros((1, count)), _STEP * np.eye(count)])
        every = self._whitened(y[:count] + steps, self._terms(y))
        return every[0], (every[1:] - every[0]) / _STEP

    def _jacobian(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Deviations, and their derivatives by all unknowns."""
        deviation, rows = self._slopes(y)
        steps = _STEP * np.diag(self._scale)[self._x.size :]
        own_rows = [
            (self._deviations(y + step) - deviation) / step.sum() for step in steps
        ]
        return deviation, np.concatenate([rows, own_rows])


def _step(
    deviation: NDArray[np.float64],
    rows: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Gauss-Newton step within limits, and the chi-square that it promises.

    By least squares of the deviations themselves: frequencies are known a thousand times better
    than residues, and normal equations would square that.
    """
    step, moving = np.zeros(len(rows)), np.arange(len(rows))
    while moving.size:
        step[moving] = 0.0
        left = deviation + step @ rows
        matrix = np.concatenate([rows[moving].T, _RELUCTANCE * np.eye(moving.size)])
        target = np.concatenate([-left, np.zeros(moving.size)])
        wanted, *_ = np.linalg.lstsq(matrix, target)
        step[moving] = np.clip(wanted, low[moving], high[moving])
        beyond = step[moving] != wanted
        if not beyond.any():
            break
        moving = moving[~beyond]
    left = deviation + step @ rows
    return step, float(left @ left)


# Causes


def _with_tilt(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
    return replace(stated, gravity_m_s2=GRAVITY_M_S2 * math.sin(math.radians(own[0])))


def _tilt(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    lower = "lower" if own[0] > 0 else "higher"
    words = f"an axis {_digits(abs(own[0]))}° off plumb (the tip at rest {lower} than the axis)"
    return own[0], "deg", words


def _mass_kg(share: float, beam: Beam) -> float:
    return share * beam.density_kg_per_m * beam.length_m


def _with_tip_mass(stated: Alteration, own: Sequence[float], beam: Beam) -> Alteration:
    return replace(stated, lumps=((1.0, _mass_kg(own[0], beam)),))


def _tip_mass(own: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    mass_kg = _mass_kg(own[0], beam)
    return mass_kg, "kg", f"a mass of {_digits(1e3 * mass_kg)} g at the tip"


def _with_lump(stated: Alteration, own: Sequence[float], beam: Beam) -> Alteration:
    return replace(stated, lumps=(*stated.lumps, (own[0], _mass_kg(own[1], beam))))


def _lump(own: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    mass_kg = _mass_kg(own[1], beam)
    at = f"{100 * own[0]:.0f} % of the length"
    return mass_kg, "kg", f"a mass of {_digits(1e3 * mass_kg)} g on the beam at {at}"


def _compliance(own: Sequence[float], beam: Beam) -> float:
    return own[0] * beam.length_m / beam.bending_stiffness_n_m2


def _with_clamp(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
    return replace(stated, clamp_compliance=own[0], clamp_loss=own[1] if len(own) > 1 else 0.0)


def _clamp(own: Sequence[float], beam: Beam) -> tuple[float, str, str]:
    stiffness = 1 / _compliance(own, beam)
    loss = f" and a loss factor of {_digits(own[1])}" if len(own) > 1 else ""
    return (
        stiffness,
        "N·m/rad",
        f"a clamp with a stiffness of {_digits(stiffness)} N·m/rad{loss}",
    )


def _corner(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    hz = _hz(own)
    return hz, "Hz", f"a low-pass filter of first order at {_digits(hz)} Hz in the torque channel"


def _second_corner(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    hz = _hz(own)
    return hz, "Hz", f"a low-pass filter of second order at {_digits(hz)} Hz in the torque channel"


def _resonance(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    hz = _hz(own)
    return hz, "Hz", f"a resonance of sensor or mount near {_digits(hz)} Hz"


def _hz(own: Sequence[float]) -> float:
    return 1e3 / (2 * math.pi * own[0])


def _relaxation(own: Sequence[float], _: Beam) -> tuple[float, str, str]:
    time_s = math.exp(own[0])
    words = (
        f"a relaxation of the material in {_digits(1e3 * time_s)} ms that stiffens it by "
        f"{_digits(100 * own[1])} %"
    )
    return own[1], "1", words


def _digits(value: float) -> str:
    """Two digits: no interval is known."""
    return f"{value:.2g}" if abs(value) < 100 else f"{float(f'{value:.2g}'):.0f}"  # noqa: PLR2004


def _uneven_mass(profile: Profile, words: str) -> _Cause:
    def altered(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
        return replace(stated, density=((profile, own[0]),))

    return _Cause("uneven mass", _EITHER, (-0.3,), (0.3,), altered, _deviation(words))


def _uneven_stiffness(profile: Profile, words: str) -> _Cause:
    def altered(stated: Alteration, own: Sequence[float], _: Beam) -> Alteration:
        return replace(stated, stiffness=((profile, own[0]),))

    return _Cause("uneven stiffness", _EITHER, (-0.3,), (0.3,), altered, _deviation(words))


def _deviation(words: str) -> Callable[[Sequence[float], Beam], tuple[float, str, str]]:
    return lambda own, _: (own[0], "1", words.format(f"{float(f'{100 * own[0]:.2g}'):+g} %"))


_EITHER: Final = ((-0.05,), (-0.01,), (0.01,), (0.05,))
_CAUSES: Final = (
    _Cause("tilt", ((-4.0,), (-1.0,), (1.0,), (4.0,)), (-10.0,), (10.0,), _with_tilt, _tilt),
    _Cause(
        "tip mass", ((0.003,), (0.02,), (0.1,), (0.25,)), (0.0,), (1.0,), _with_tip_mass, _tip_mass,
        lambda own, plant: replace(plant, tip_mass_kg=_mass_kg(own[0], plant.beam)),
    ),
    _Cause(
        "lump", tuple((0.05 * place, size) for place in range(3, 20, 2) for size in (0.003, 0.03)),
        (0.02, 0.0), (0.99, 0.5), _with_lump, _lump, special=("tip mass",),
    ),
    _uneven_mass("taper", "a mass per length that changes by {} from root to tip"),
    _uneven_mass("outer half", "an outer half with {} mass per length"),
    _uneven_mass("wave", "a mass per length with {} at both ends and the opposite in the middle"),
    _uneven_stiffness("taper", "a bending stiffness that changes by {} from root to tip"),
    _uneven_stiffness("outer half", "an outer half with {} bending stiffness"),
    _uneven_stiffness(
        "wave", "a bending stiffness with {} at both ends and the opposite in the middle"
    ),
    _Cause(
        "elastic clamp", ((1e-4,), (1e-3,), (1e-2,)), (0.0,), (0.2,), _with_clamp, _clamp,
        lambda own, plant: replace(plant, root_compliance_rad_per_nm=_compliance(own, plant.beam)),
    ),
    _Cause(
        "lossy clamp",
        tuple((size, loss) for size in (1e-4, 1e-3, 1e-2) for loss in (0.02, 0.1)),
        (0.0, 0.0), (0.2, 0.5), _with_clamp, _clamp, special=("elastic clamp",),
    ),
    _Cause(
        "torque filter of first order", ((0.2,), (0.6,), (2.0,)), (0.0,), (20.0,),
        lambda stated, own, _: replace(stated, lag_s=1e-3 * own[0]), _corner,
        lambda own, plant: replace(plant, filter_time_constant_s=1e-3 * own[0]),
    ),
    _Cause(
        "torque filter of second order", ((0.2,), (0.6,), (2.0,)), (0.0,), (10.0,),
        lambda stated, own, _: replace(stated, sensor=(1e-3 * own[0], _BUTTERWORTH)),
        _second_corner,
        lambda own, plant: replace(plant, second_order_filter_time_constant_s=1e-3 * own[0]),
    ),
    _Cause(
        "sensor resonance",
        tuple((size, loss) for size in (0.3, 0.6, 1.0, 1.6) for loss in (0.05, 0.5)),
        (0.0, 0.0), (3.0, 2.0),
        lambda stated, own, _: replace(stated, sensor=(1e-3 * own[0], own[1])), _resonance,
        special=("torque filter of second order",),
    ),
    _Cause(
        RELAXATION,
        tuple(
            (math.log(time_s), strength)
            for time_s in (5e-4, 1.5e-3, 4e-3, 1e-2, 3e-2, 0.1, 0.3)
            for strength in (0.003, 0.01, 0.03, 0.1)
        ),
        (math.log(1e-4), 0.0), (math.log(3.0), 0.5),
        lambda stated, own, _: replace(stated, relaxation=(own[1], math.exp(own[0]))), _relaxation,
    ),
)  # fmt: skip


# Words


def finding(
    test: UniformBeamTest, found: Sequence[Explanation], step: Step | None = None
) -> Finding:
    """Put in words what would explain the modes.

    Parameters
    ----------
    test : UniformBeamTest
        That refused the plain uniform beam.
    found : sequence of Explanation
        As `explanations` gives them.
    step : Step, optional
        Of the stiffness, if one would explain what the modes leave.
    """
    named = [each.words for each in found]
    if step is not None and step.named:
        named.append(step.words)
    refused = f"A plain uniform beam does not predict the modes (p = {test.p_value:.1g})."
    if not named:
        return Finding(
            kind="rival explanations",
            sentence=(
                f"{refused} None of the simple causes tried explains them alone: tilt, a mass at "
                "the tip or elsewhere, an uneven or tapered beam, a soft or lossy clamp, a filter "
                "or resonance of the sensor, a relaxation of the material."
            ),
            remedy="Check the beam and its clamp for several of these at once.",
        )
    if len(named) == 1:
        sentence = f"{refused} This would: {named[0]}. It is not established by this record."
    else:
        sentence = (
            f"{refused} Each of these alone would: {'; '.join(named)}. None is established by this "
            "record."
        )
    return Finding(
        kind="rival explanations",
        sentence=sentence,
        remedy="Weigh, measure or change one of them, state it in the file, and sweep again.",
    )
