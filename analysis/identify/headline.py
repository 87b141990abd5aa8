"""Headline numbers of a record: from the freest structure that it supports, with flags.

A structure that fixes an order gives narrow intervals which hold only if that order is right, and
the criterion that selected it forgives an error of 2.7 standard deviations. So the reported numbers
are those of the structure with every order free: its intervals are valid whichever simpler one is
true. The numbers of a simpler structure are reported in addition, as a conditional estimate.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, Self

from analysis.identify._plant import OF_BEAM
from analysis.identify.verdict import ANOTHER_DAMPING, BIC_DECISIVE, EXCLUDED, WITH_DRAG
from analysis.models import COEFFICIENT_OF
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._modal_model import ModalEstimate
    from analysis.identify._result import DampingSize, ModeEstimate, RecordFit
    from analysis.identify.uniform_beam import TolerantEstimate, UniformBeamTest
    from analysis.identify.verdict import OrderVerdict

EXACT_CONDITION: Final = "if the beam is uniform to 1e-5"
UNEXPLAINED: Final = "part of the record is unexplained"
MISREAD: Final = "the record contradicts its file"
_NONE: Final[Mapping[str, Any]] = MappingProxyType({})
_NOT_DETERMINED: Final = "not identifiable from this record"
_AT_EDGE: Final = "at the edge of the range searched"

_MODES_TO_SEPARATE_DAMPINGS: Final = 2
_NOT_APART: Final = "not separable from a damping of unknown order"
"""Damping of a low order is a stiffness, of an order near 2 an inertia."""

ONE_MODE: Final = "one mode alone does not separate internal from external damping"

_LAW_ASSUMED: Final = (
    "the stiffness depends on the deflection, and only its lowest power was fitted"
)
StructureStatus = Literal["selected", "compatible", "excluded"]
Damping = Literal["internal", "external"]
NAMES: Final[Mapping[Damping, tuple[str, str]]] = {
    "internal": ("zeta", "alpha"),
    "external": ("gamma", "lambda"),
}
"""Coefficient and order of either damping."""

_DAMPINGS: Final[tuple[Damping, Damping]] = ("internal", "external")


@dataclass(frozen=True, slots=True)
class ReportedValue:
    """Value with its uncertainty.

    Attributes
    ----------
    value : float
        In SI units.
    std : float or None
        Standard deviation, None if the data do not determine it.
    interval_95 : tuple of float or None
        95 % interval, None as above.
    flag : str or None
        Reason why it is not a property of the antenna or the rig; None if it is one.
    """

    value: float
    std: float | None
    interval_95: tuple[float, float] | None
    flag: str | None = None

    def flagged(self, flag: str | None) -> ReportedValue:
        """Return the value with a flag, unless it already has one.

        Parameters
        ----------
        flag : str or None
        """
        return self if flag is None else replace(self, flag=self.flag or flag)

    def as_json(self) -> dict[str, Any]:
        """Return the value as `json.dumps` takes it."""
        ends = None if self.interval_95 is None else list(self.interval_95)
        return {
            "value": self.value,
            "std": self.std,
            "interval_95": ends,
            "flag": self.flag,
        }


@dataclass(frozen=True, slots=True)
class ReportedLossFactor:
    """Loss factor of a damping at the frequency where it depends least on its order.

    Attributes
    ----------
    damping : str
        "internal" or "external".
    omega_rad_s : float or None
        That frequency; None if the order is fixed: then it is the coefficient itself.
    size : ReportedValue
        Value of the loss factor, as in `DampingSize`.
    """

    damping: Damping
    omega_rad_s: float | None
    size: ReportedValue

    @property
    def order(self) -> str:
        """Return the name of its order: "alpha" or "lambda"."""
        return NAMES[self.damping][1]

    def flagged(self, flag: str | None) -> ReportedLossFactor:
        """Return the loss factor with a flag, unless it already has one.

        Parameters
        ----------
        flag : str or None
        """
        return replace(self, size=self.size.flagged(flag))


@dataclass(frozen=True, slots=True)
class ReportedMode:
    """One mode of the beam with locked hub (clamped–free)."""

    number: int
    """From 1 on."""
    frequency_hz: ReportedValue
    """Frequency of the free decay."""
    damping_ratio: ReportedValue
    """Fraction of the critical damping."""
    shown: bool
    """Whether the record shows it; else it is computed from the model."""
    source: Literal["modal", "beam"] = "beam"
    """Model behind the numbers: the modal one, or the beam."""
    participation: ReportedValue | None = None
    """Effective inertia about the motor axis, in kg m²; None for a mode from the beam."""


@dataclass(frozen=True, slots=True)
class ConditionalEstimate:
    """Estimates of a simpler structure, on condition that this structure is true.

    Attributes
    ----------
    name : str
        Name in tables.
    fixed : mapping of str to float
        Assumed values: orders by name.
    parameters : mapping of str to ReportedValue
    """

    name: str
    fixed: Mapping[str, float]
    parameters: Mapping[str, ReportedValue]


@dataclass(frozen=True, slots=True)
class Estimates:
    """Estimates from one record or a campaign, without an assumption on the orders.

    Attributes
    ----------
    name : str
        Name in tables of the freest structure that the data support.
    parameters : mapping of str to ReportedValue
        Parameters of the structure, by the names of `RecordFit`.
    sizes : tuple of ReportedLossFactor
    modes : tuple of ReportedMode
    structures : tuple of (str, str)
        Every structure fitted, by its name in tables, and its status: "selected" for the reported
        one; "compatible"; "excluded".
    simpler : ConditionalEstimate or None
        Estimates of the simplest sufficient structure, if it is another.
    drag_speed_m_s : float or None
        Speed at which the parameter ``drag`` is reported; None without drag.
    exact : Estimates or None
        Estimates on condition that the beam is uniform to 1e-5; None if these assume that already.
    uniform_beam : UniformBeamTest or None
        Whether a uniform beam predicts the modal constants; None if no mode shows.
    tolerant : TolerantEstimate or None
        Source of parameters and sizes, if they include a tolerance of the geometry.
    modal : ModalEstimate or None
        Fit of the modal model.
    """

    name: str
    parameters: Mapping[str, ReportedValue]
    sizes: tuple[ReportedLossFactor, ...]
    modes: tuple[ReportedMode, ...]
    structures: tuple[tuple[str, StructureStatus], ...]
    simpler: ConditionalEstimate | None
    drag_speed_m_s: float | None
    _: KW_ONLY
    exact: Estimates | None = None
    uniform_beam: UniformBeamTest | None = None
    tolerant: TolerantEstimate | None = None
    modal: ModalEstimate | None = None

    def doubted(self, flag: str) -> Self:
        """Return the estimates with a flag on every number that has none.

        Parameters
        ----------
        flag : str
            The reason.
        """
        return replace(
            self,
            parameters={name: each.flagged(flag) for name, each in self.parameters.items()},
            sizes=tuple(each.flagged(flag) for each in self.sizes),
            modes=tuple(
                replace(
                    each,
                    frequency_hz=each.frequency_hz.flagged(flag),
                    damping_ratio=each.damping_ratio.flagged(flag),
                )
                for each in self.modes
            ),
        )


@dataclass(frozen=True, slots=True)
class Headline(Estimates):
    """Reported numbers of one record, and the fit that they come from.

    Attributes
    ----------
    fit : RecordFit
        Fit of the freest structure that the record supports.
    explained : bool
        Whether its residual is noise only; else every number carries a flag.
    with_both : RecordFit
        That fit with the damping that it may lack; the modes come from this fit.
    modal : ModalFit or None
    """

    fit: RecordFit
    explained: bool
    with_both: RecordFit
    modal: ModalFit | None = field(default=None, kw_only=True)

    @property
    def flags(self) -> dict[str, str]:
        """Return the flags by parameter."""
        return {name: each.flag for name, each in self.parameters.items() if each.flag}

    @property
    def visible_modes(self) -> tuple[int, ...]:
        """Return the numbers of the modes that the record shows."""
        return tuple(mode.number for mode in self.modes if mode.shown)

    def with_law_assumed(self) -> Headline:
        """Flag the parameters that rest on the assumed law of stiffness against deflection."""
        return replace(
            self,
            parameters={
                name: each.flagged(_LAW_ASSUMED) if name == "density_over_stiffness" else each
                for name, each in self.parameters.items()
            },
            modes=tuple(
                replace(each, frequency_hz=each.frequency_hz.flagged(_LAW_ASSUMED))
                for each in self.modes
            ),
        )

    def with_status(self, status: StructureStatus) -> tuple[str, ...]:
        """Return the names of the structures with a status.

        Parameters
        ----------
        status : str
        """
        return tuple(name for name, its in self.structures if its == status)


def headline(
    candidate_set: CandidateSet,
    orders: tuple[OrderVerdict, OrderVerdict],
    visible: tuple[int, ...],
    *,
    unexplained: str | None,
) -> Headline:
    """Return the headline from the freest structure of a candidate set.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    orders : tuple of OrderVerdict
        Verdicts on alpha and lambda.
    visible : tuple of int
        Numbers of the visible modes.
    unexplained : str or None
        Reason against every number; None if only noise remains.
    """
    freest = candidate_set.freest
    fractional = frozenset(each.order for each in orders if each.status == "fractional")
    reasons: dict[str, str] = {
        each.order: each.reason for each in orders if each.reason is not None
    }
    intervals: dict[str, tuple[float, float]] = {
        each.order: each.profile.interval
        for each in orders
        if each.profile.is_computed and each.order in freest.structure.free
    }
    result = of_fit(
        freest.name, freest.fit, visible, reasons, intervals, unexplained,
        candidate_set.with_both_dampings(freest),
    )  # fmt: skip
    if candidate_set.drag is not None:
        drag = candidate_set.drag
        at = ReportedValue(drag.value_m, drag.std_m, drag.interval_95_m, unexplained)
        sizes = (
            each.flagged(WITH_DRAG) if each.damping == "external" else each for each in result.sizes
        )
        result = replace(
            result,
            parameters={**result.parameters, "drag": at},
            sizes=tuple(sizes),
            drag_speed_m_s=drag.speed_m_s,
        )
    simpler = _simpler(candidate_set, fractional) if unexplained is None else None
    return replace(result, structures=structures(candidate_set, fractional), simpler=simpler)


def of_fit(
    name: str,
    fit: RecordFit,
    visible: Collection[int],
    reasons: Mapping[str, str] = _NONE,
    intervals: Mapping[str, tuple[float, float]] = _NONE,
    unexplained: str | None = None,
    both: tuple[RecordFit, bool] | None = None,
) -> Headline:
    """Return the headline of one fit, with flags on the numbers that need them.

    Parameters
    ----------
    name : str
        Name in tables.
    fit : RecordFit
    visible : collection of int
        Modes that the record shows.
    reasons : mapping of str to str
        Reasons against the orders; they also hold for the coefficients.
    intervals : mapping of str to (float, float)
        95 % intervals of orders, used instead of those of the fit.
    unexplained : str, optional
        Reason against all numbers.
    both : tuple of (RecordFit, bool), optional
        The fit with both dampings (`CandidateSet.with_both_dampings`), for the modes.
    """
    with_both, bounded = both or (fit, False)
    few = ONE_MODE if len(visible) < _MODES_TO_SEPARATE_DAMPINGS else None
    if ANOTHER_DAMPING in reasons.values():
        few = ANOTHER_DAMPING
    flags: dict[str, str] = {
        name: reason for order, reason in reasons.items() for name in (order, COEFFICIENT_OF[order])
    }
    if few or not COEFFICIENT_OF.keys().isdisjoint(fit.at_bounds):
        flags |= dict.fromkeys(OF_BEAM, _NOT_APART)
    return Headline(
        name=name,
        fit=fit,
        parameters={
            each: _parameter(fit, each, unexplained or flags.get(each), intervals.get(each))
            for each in fit.parameters
            if fit.structure.has(each)
        },
        sizes=tuple(
            # A loss factor is known without its order; a coefficient alone belongs to it.
            size_of(
                each,
                size,
                unexplained
                or (reasons.get(NAMES[each][1]) if size.omega_rad_s is None else None)
                or few,
            )
            for each, size in zip(_DAMPINGS, (fit.internal, fit.external), strict=True)
            if size is not None
        ),
        modes=tuple(
            _mode(mode, visible, unexplained)
            for mode in (_bounded(fit, with_both) if bounded else with_both.modes)
        ),
        with_both=with_both,
        structures=((name, "selected"),),
        simpler=None,
        drag_speed_m_s=None,
        explained=unexplained is None,
    )


def structures(
    candidate_set: CandidateSet, fractional: frozenset[str]
) -> tuple[tuple[str, StructureStatus], ...]:
    """Return the status of every structure: which ones the record excludes.

    A special case of the freest structure is excluded by the likelihood ratio. Any other structure
    is excluded if its likelihood is lower by as much and its BIC exceeds the lowest by 10. A
    structure that explains the record with unnecessary parameters is not excluded. A structure that
    fixes an order at 1 is excluded if the order is in `fractional`: the record excludes 1 for it.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    fractional : frozenset of str
        Orders for which the record excludes 1.
    """
    return tuple(
        (each.name, _status(candidate_set, each, fractional)) for each in candidate_set.candidates
    )


def _status(
    candidate_set: CandidateSet, candidate: Candidate, fractional: frozenset[str]
) -> StructureStatus:
    freest = candidate_set.freest
    if candidate is freest:
        return "selected"
    simpler = set(candidate.structure.free) < set(freest.structure.free)
    if not simpler:
        behind = candidate.deviance - freest.deviance > EXCLUDED[0]
        worse = candidate.bic > candidate_set.best.bic + BIC_DECISIVE
        return "excluded" if behind and worse else "compatible"
    if any(
        candidate.structure.fixed.get(order) == 1.0  # type: ignore[call-overload]
        for order in fractional
    ):
        return "excluded"
    lacks = freest.parameters - candidate.parameters
    limit = EXCLUDED[min(lacks, len(EXCLUDED)) - 1]
    return "excluded" if candidate.deviance - freest.deviance > limit else "compatible"


def _simpler(candidate_set: CandidateSet, fractional: frozenset[str]) -> ConditionalEstimate | None:
    """Return the estimates of the simplest sufficient structure."""
    freest = candidate_set.freest
    would_do = [
        each
        for each in candidate_set.candidates
        if each.parameters < freest.parameters
        and _status(candidate_set, each, fractional) == "compatible"
    ]
    if not would_do:
        return None
    best = min(would_do, key=lambda each: each.bic)
    fixed = {
        order: best.structure.fixed[order]  # type: ignore[index]
        for order, coefficient in COEFFICIENT_OF.items()
        if order in best.structure.fixed and coefficient in best.structure.free
    }
    return ConditionalEstimate(
        name=best.name,
        fixed=fixed,
        parameters={
            name: _parameter(best.fit, name, None, None)
            for name in best.fit.parameters
            if best.structure.has(name) and name not in fixed
        },
    )


def _parameter(
    fit: RecordFit, name: str, reason: str | None, interval: tuple[float, float] | None
) -> ReportedValue:
    free = name in fit.interval
    ends = interval or fit.interval.get(name)
    flag = reason
    if flag is None and name in fit.at_bounds and ends is None:
        flag = _AT_EDGE
    if flag is None and free and ends is None:
        flag = _NOT_DETERMINED
    return ReportedValue(fit.parameters[name], fit.std[name] if free else 0.0, ends, flag)


def size_of(damping: Damping, size: DampingSize, reason: str | None) -> ReportedLossFactor:
    """Return a loss factor with its 95 % interval.

    Parameters
    ----------
    damping : str
    size : DampingSize
    reason : str or None
        Its flag.
    """
    # Positive, and uncertain by a factor.
    spread = NORMAL_95 * size.std / size.value
    ends = (size.value * math.exp(-spread), size.value * math.exp(min(spread, 300.0)))
    return ReportedLossFactor(
        damping, size.omega_rad_s, ReportedValue(size.value, size.std, ends, reason)
    )


def _bounded(fit: RecordFit, with_both: RecordFit) -> Iterator[ModeEstimate]:
    """Return the modes of a fit with the uncertainty that includes the other damping."""
    theirs = {mode.number: mode for mode in with_both.modes}
    for mode in fit.modes:
        wider = theirs.get(mode.number, mode)
        yield replace(
            mode,
            frequency_std_hz=wider.frequency_std_hz,
            damping_ratio_std=wider.damping_ratio_std,
        )


def _mode(mode: ModeEstimate, visible: Collection[int], reason: str | None) -> ReportedMode:
    shown = mode.number in visible
    if reason is None and not shown:
        reason = "computed from the model: the record does not show this mode"
    return ReportedMode(
        mode.number,
        symmetric(mode.frequency_hz, mode.frequency_std_hz, reason),
        symmetric(mode.damping_ratio, mode.damping_ratio_std, reason),
        shown,
    )


def symmetric(
    value: float, std: float, reason: str | None, half_width: float = NORMAL_95
) -> ReportedValue:
    """Return a value with a symmetric 95 % interval.

    Parameters
    ----------
    value, std : float
    reason : str or None
        Its flag.
    half_width : float
        Half width of the interval, in standard deviations.
    """
    half = half_width * std
    return ReportedValue(value, std, (value - half, value + half), reason)
