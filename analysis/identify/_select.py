"""Verdict on one record: modal model, test of uniformity, orders with a tolerance, candidates.

Sentences are in `analysis.identify.sentences`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Generic, TypeVar

import numpy as np

from analysis.identify._candidates import CandidateSet
from analysis.identify._channel_checks import wrong_scale
from analysis.identify._comparison import Comparison
from analysis.identify._diagnostics import findings, of_settings, unexplained
from analysis.identify._drag import (
    damping_with_amplitude,
    with_air_drag,
    with_evident_drag,
)
from analysis.identify._explanations import explanations
from analysis.identify._explanations import finding as explanation_finding
from analysis.identify._finding import doubted
from analysis.identify._fit import BAND_HZ
from analysis.identify._knock import MAX_KNOCKS, knocks_in, of_knocks, with_knock
from analysis.identify._modal_fit import fit_modes
from analysis.identify._modal_headline import tolerant_order, with_modal_model
from analysis.identify._nonlinear import nonlinear_forces
from analysis.identify._result import RecordAnalysis
from analysis.identify._small_effects import LARGE, small_effect
from analysis.identify._step_in_time import step_score
from analysis.identify._time_varying import along_time, changing, established
from analysis.identify._visible_modes import visible_modes
from analysis.identify.headline import MISREAD, UNEXPLAINED, Headline, headline, of_fit
from analysis.identify.profile_likelihood import WIDEST_FRACTION, profile_both_orders
from analysis.identify.residual_tests import (
    InputRelation,
    Whiteness,
    harmonics,
    input_relation,
    whiteness,
)
from analysis.identify.sentences import experiments, of_headline
from analysis.identify.uniform_beam import tolerant_estimate, uniform_beam_test
from analysis.identify.verdict import (
    BIC_TIE,
    NOT_DETERMINED,
    CandidateRow,
    Verdict,
    not_reported_reason,
    order_verdict,
    rivals,
)
from analysis.models import COEFFICIENT_OF, ORDER_RANGE, STRUCTURES
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._data import Measurement
    from analysis.identify._finding import Finding
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._nonlinear import NonlinearForce
    from analysis.identify._plant import Setting
    from analysis.identify._result import RecordFit
    from analysis.identify._time_varying import TemporalChange
    from analysis.identify.profile_likelihood import Order
    from analysis.identify.residual_tests import Harmonic
    from analysis.identify.uniform_beam import UniformBeamTest


_MODES_TO_TEST: Final = 2
_TILTED: Final = "the axis is tilted, and fits to the whole record are of one that is plumb"
_CLIPPED: Final = "the torque is clipped"
INTEGER: Final = STRUCTURES["III"]
"""Both dampings of order 1. It is fitted from every start: it has no local minima by undetermined
orders, and no damping that is in fact a stiffness or an inertia."""

_MISREAD_KINDS: Final = frozenset({"sign", "unit", "implausible"})
_NOT_SEARCHED: Final = frozenset({"sign", "unit", "clipping", "stop"})
"""Findings that make a search for impacts useless. A large impact may drive settings to an edge."""
_OF_CHANNELS: Final = _MISREAD_KINDS | {"clipping", "stop"}
"""Findings that are reported if the record contradicts its file."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Verdict on a record, with the fits that it rests on.

    Attributes
    ----------
    verdict : Verdict
    headline : Headline
        Reported numbers, with flags.
    candidates : tuple of Candidate
        All fits, the lowest BIC first.
    analysis : RecordAnalysis
        The same fits with the noise and the bins that are theirs.
    """

    verdict: Verdict
    headline: Headline
    candidates: tuple[Candidate, ...]
    analysis: RecordAnalysis

    @property
    def fit(self) -> RecordFit:
        """Return the fit behind the numbers of the headline."""
        return self.headline.fit

    @property
    def determined(self) -> frozenset[Order]:
        """Return the orders that the record determines: a single minimum along each."""
        orders = (self.verdict.alpha, self.verdict.lambda_)
        return frozenset(each.order for each in orders if each.profile.identifiable)


def select(
    measurement: Measurement,
    *,
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
    earlier: Selection | None = None,
) -> Selection:
    """Select the model that a record supports, and report its parameters.

    The modal model is fitted to the record without hum, impacts and gaps; the reported modes are
    its modes. If its residual is noise, the antenna is linear and constant. Otherwise drag,
    nonlinear forces, changes along the record and impacts are tested. A uniform beam is tested
    against the modal constants; orders, coefficients and stiffness are estimated from these with
    the tolerance of the geometry that the measurement states. All structures are also fitted to the
    record on an exactly uniform beam: their values are conditional estimates.

    Parameters
    ----------
    measurement : Measurement
    fixed : iterable of str
        Settings that stay as the file states them.
    band_hz : tuple of float
    earlier : Selection, optional
        Selection of an earlier part of the record. If its first candidate explains the whole
        record, all candidates start from the earlier ones, in a third of the time; one of several
        minima may be missed.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    ValueError
        There is no such setting.
    """
    fixed = tuple(fixed)
    return _with_knocks(measurement, lambda each: _selected(each, fixed, band_hz, earlier)).result


_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class _Assessment(Generic[_T]):
    """Result on a record, with the candidates that it rests on.

    Attributes
    ----------
    result : _T
    candidate_set : CandidateSet
        Set led by the candidate of the reported numbers.
    explained : bool
        Whether its residual is noise only.
    kinds : collection of str
        Kinds of the findings.
    """

    result: _T
    candidate_set: CandidateSet
    explained: bool
    kinds: Collection[str]


def _with_knocks(
    measurement: Measurement, assess: Callable[[Measurement], _Assessment[_T]]
) -> _Assessment[_T]:
    """Assess a record; if its residual is more than noise, with the impacts that explain it."""
    assessment = assess(measurement)
    for _ in range(MAX_KNOCKS):
        if assessment.explained or not _NOT_SEARCHED.isdisjoint(assessment.kinds):
            break
        better = None
        # A sweep with harmonics has them all along; but a loud knock may pass for some.
        for found in knocks_in(assessment.candidate_set, obvious="harmonics" in assessment.kinds):
            again = assess(with_knock(assessment.candidate_set.comparison.measurement, found))
            if again.explained or found.evident:
                better = again
            if again.explained:
                break
        if better is None:
            break
        assessment = better
    return assessment


def _selected(
    measurement: Measurement,
    fixed: tuple[Setting, ...],
    band_hz: tuple[float, float],
    earlier: Selection | None,
) -> _Assessment[Selection]:
    """Select the structure with the known impacts."""
    before = earlier.candidates if earlier else ()
    again = CandidateSet.from_earlier(before, measurement, fixed, band_hz) if before else None
    linear = again or CandidateSet.of(measurement, fixed, band_hz)
    modal = _modal(linear)
    candidate_set, small = linear, None
    forces: tuple[NonlinearForce, ...] = ()
    changes: tuple[TemporalChange, ...] = ()
    plain = modal is not None and _linear_and_constant(linear, modal, band_hz)
    if not (plain or measurement.knocks):
        for knock in knocks_in(linear, obvious=True):
            with_impact = _selected(with_knock(measurement, knock), fixed, band_hz, None)
            if with_impact.explained:
                return with_impact
    if modal is not None:
        small = small_effect(linear.comparison, modal, modal.plant_like(linear.likeliest.plant))
    alone, suffices = modal, plain
    if small is not None:
        alone = _modal(linear, small.column[None])
        suffices = alone is not None and _linear_and_constant(linear, alone, band_hz)
    if not (plain or suffices) or (small is not None and small.large):
        candidate_set, forces, changes = _with_effects(linear, again=again is not None)
        modal = _modal(candidate_set)
        if suffices and not (
            modal is not None and _linear_and_constant(candidate_set, modal, band_hz)
        ):
            candidate_set, forces, changes, modal = linear, (), (), alone
        else:
            small = None
    elif small is not None and small.saved > LARGE:
        candidate_set = linear.with_effect(small.column[None])
        modal = _modal(candidate_set)
    else:
        modal = alone
    candidate_set = candidate_set.with_orders_free()
    visible = _visible(candidate_set, modal)
    test = _uniform_beam_test(measurement, modal)
    refused = test is not None and test.status == "refused"
    # The whole record excludes every local minimum that a part of it excludes.
    determined = earlier.determined if earlier and again else ()
    walk = not_reported_reason(candidate_set, visible) is None and not refused
    candidate_set, *profiles = profile_both_orders(candidate_set, determined, compute=walk)
    leading = candidate_set.led_by(candidate_set.freest)
    white, related, multiples = _tests(leading, modal, band_hz)
    explained = white.white and not related.related
    found = findings(leading, forces, multiples)
    kinds = {finding.kind for finding in found}
    wrong = _wrong_model_reason(kinds, explained=explained)
    clipped = _CLIPPED if "clipping" in kinds else None
    doubt = wrong or clipped or _doubt_reason(changes, one_sweep=measurement.one_sweep)
    alpha, lambda_ = (order_verdict(candidate_set, each, visible, doubt=doubt) for each in profiles)
    orders, close = (alpha, lambda_), rivals(candidate_set, BIC_TIE)
    numbers = headline(candidate_set, orders, visible, unexplained=wrong)
    if doubt is not None:
        numbers = numbers.doubted(doubt)
    # A change that was fitted too moved the modes to the middle of the record.
    mode_doubt = doubt if changes and changes[0].certain else wrong or clipped
    numbers = _with_modes(numbers, measurement, modal, test, doubt, mode_doubt)
    if numbers.tolerant is not None:
        alpha, lambda_ = (
            tolerant_order(each.order, numbers.tolerant, each, doubt, refused=refused)
            for each in profiles
        )
        orders = alpha, lambda_
    if "nonlinear stiffness" in kinds:
        numbers = numbers.with_law_assumed()
    sentences, advice = [], []
    if wrong == MISREAD:
        found = tuple(each for each in found if each.kind in _OF_CHANNELS)
    else:
        along = tuple(changing(changes, one_sweep=measurement.one_sweep))
        found += _settings(leading, numbers, kinds)
        found += () if small is None else (small.finding(),)
        if modal is not None and test is not None and refused and wrong is None:
            found += _explanation(measurement, leading, modal, test)
        found = _with_doubts(found, along, wrong, doubt, numbers.flags, explained=explained)
        found = _with_knocks_and_unexplained(leading, found, white, related)
        sentences = of_headline(numbers, orders, alone=doubt is None)
        advice = experiments(candidate_set, orders, visible, found, close)
    advice += [each.remedy for each in found if each.remedy]
    best = candidate_set.best
    selection = Selection(
        candidates=candidate_set.candidates,
        headline=numbers,
        analysis=RecordAnalysis.of(
            (c.fit for c in candidate_set.candidates), candidate_set.noise, candidate_set.comparison
        ),
        verdict=Verdict(
            name=measurement.name,
            structure=best.structure.name,
            rivals=tuple(c.name for c in close),
            parameters={k: q.value for k, q in numbers.parameters.items() if q.flag is None},
            adequate=wrong is None,
            alpha=alpha,
            lambda_=lambda_,
            visible_modes=visible,
            findings=found,
            table=_table(candidate_set),
            whiteness=white,
            input_relation=related,
            harmonics=multiples,
            sentences=(*sentences, *(each.sentence for each in found)),
            experiments=tuple(dict.fromkeys(advice)),
            damping_with_amplitude=damping_with_amplitude(leading),
        ),
    )
    return _Assessment(selection, leading, explained, kinds)


def _modal(
    candidate_set: CandidateSet, further: NDArray[np.complex128] | None = None
) -> ModalFit | None:
    """Fit the modal model to the data of a candidate set; return None if no mode is visible.

    `further`, shape (c, K), are spectra of unknown size in addition to those of the candidates.
    """
    if candidate_set.misread:
        return None
    starts = [
        (mode.number, mode.frequency_hz, mode.damping_ratio)
        for mode in candidate_set.likeliest.modes
        if mode.frequency_hz > 0
    ]
    columns, drag = candidate_set.columns, candidate_set.comparison.drag
    if further is not None:
        columns = np.concatenate([columns, further])
    if drag is not None:  # its size is not known exactly
        columns = np.concatenate([columns, drag.by_law])
    return fit_modes(candidate_set.comparison, candidate_set.noise, starts, columns)


def _visible(candidate_set: CandidateSet, modal: ModalFit | None) -> tuple[int, ...]:
    """Return the numbers of the modes that a record shows."""
    if modal is None:
        return visible_modes(candidate_set.comparison, candidate_set.noise, candidate_set.best.fit)
    return modal.visible


def _with_modes(
    exact: Headline,
    measurement: Measurement,
    modal: ModalFit | None,
    test: UniformBeamTest | None,
    doubt: str | None,
    mode_doubt: str | None,
) -> Headline:
    """Add the modal model to a headline of a uniform beam, and apply the stated tolerance.

    Return `exact` if there is no modal model. `doubt` and `mode_doubt` are the reasons against
    every number and against every mode.
    """
    if modal is None or test is None:
        return exact
    tolerant = None
    if measurement.axis_tilt_deg:
        exact = exact.doubted(_TILTED)
    if measurement.uniformity or test.status == "refused" or measurement.axis_tilt_deg:
        tolerant = tolerant_estimate(
            modal, measurement.nominal, measurement.uniformity, measurement.axis_tilt_deg
        )
    return with_modal_model(exact, modal, test, tolerant, doubt, mode_doubt)


def _uniform_beam_test(measurement: Measurement, modal: ModalFit | None) -> UniformBeamTest | None:
    """Test whether a uniform beam with free parameters predicts the modes."""
    if modal is None:
        return None
    return uniform_beam_test(modal, measurement.nominal, measurement.axis_tilt_deg)


def _explanation(
    measurement: Measurement, candidate_set: CandidateSet, modal: ModalFit, test: UniformBeamTest
) -> tuple[Finding, ...]:
    """Name simple causes of the deviations from a uniform beam.

    Two modes leave no degree of freedom for this test.
    """
    if len(modal.visible) <= _MODES_TO_TEST:
        return ()
    causes = explanations(modal, measurement.nominal, measurement.axis_tilt_deg)
    step = step_score(candidate_set.comparison, modal) if measurement.one_sweep else None
    return (explanation_finding(test, causes, step),)


def _settings(
    candidate_set: CandidateSet, result: Headline, kinds: Collection[str]
) -> tuple[Finding, ...]:
    """Find settings that differ from the file, if at least two modes show and nothing is absurd."""
    if "implausible" in kinds or len(result.visible_modes) < _MODES_TO_TEST:
        return ()
    return tuple(of_settings(candidate_set, result))


def _linear_and_constant(
    candidate_set: CandidateSet, modal: ModalFit, band_hz: tuple[float, float]
) -> bool:
    """Return whether the residual of the modal model is noise: then no other effect is tested."""
    _, _, multiples = _tests(candidate_set, modal, band_hz)
    return modal.explained and not any(each.present for each in multiples)


def _with_effects(
    linear: CandidateSet, *, again: bool
) -> tuple[CandidateSet, tuple[NonlinearForce, ...], tuple[TemporalChange, ...]]:
    """Test for nonlinear and time-varying effects.

    Return the set with the best explanation, its nonlinear forces, and its changes along the
    record.
    """
    candidate_set = linear if again else with_evident_drag(linear)
    if candidate_set is linear:
        candidate_set = linear if linear.misread else with_air_drag(linear)
    visible = visible_modes(linear.comparison, linear.noise, linear.best.fit)
    candidate_set, forces = (
        (candidate_set, ()) if candidate_set.misread else nonlinear_forces(candidate_set, visible)
    )
    if forces and candidate_set.drag is not None:
        # A stiffness that depends on the deflection may have passed for a little drag.
        without, alone = nonlinear_forces(linear, visible)
        if alone and without.bic < candidate_set.bic:
            candidate_set, forces = without, alone
    candidate_set, changes = along_time(candidate_set.with_orders_free())
    one_sweep = linear.comparison.measurement.one_sweep
    if not one_sweep and (forces or candidate_set.drag is not None):
        # A change along the record may have been mistaken for a dependence on the amplitude.
        other, other_changes = along_time(linear.with_orders_free(), rival_bic=candidate_set.bic)
        if other_changes and other.bic < candidate_set.bic:
            return other, (), other_changes
    return candidate_set, forces, changes


def freest_alone(
    measurement: Measurement, band_hz: tuple[float, float] = BAND_HZ
) -> tuple[Headline, tuple[Finding, ...], RecordAnalysis]:
    """Fit the freest structure on a uniform beam, in a quarter of `select`'s time.

    The modes are those of `select` if that selects such a beam with all orders free. If it selects
    another model (drag, nonlinear forces), the residual is not noise, and every number carries a
    flag. Orders are not profiled: the visible modes and the width of the interval decide whether an
    order is identifiable.

    Parameters
    ----------
    measurement : Measurement
    band_hz : tuple of float

    Returns
    -------
    headline : Headline
    findings : tuple of Finding
        Findings that need no comparison of candidates.
    analysis : RecordAnalysis
        That fit, then one of `INTEGER`, with the noise.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    """
    return _with_knocks(measurement, lambda each: _freest_alone(each, band_hz)).result


def _freest_alone(
    measurement: Measurement, band_hz: tuple[float, float]
) -> _Assessment[tuple[Headline, tuple[Finding, ...], RecordAnalysis]]:
    """Fit the freest structure alone with the known impacts."""
    misread = tuple(wrong_scale(Comparison.of(measurement, band_hz)))
    additional = () if misread else (INTEGER,)
    candidate_set = replace(
        CandidateSet.of_freest(measurement, (), band_hz, additional), misread=misread
    )
    if not misread:
        candidate_set = candidate_set.with_special_cases()
    modal = _modal(candidate_set)
    visible = _visible(candidate_set, modal)
    white, related, multiples = _tests(candidate_set, modal, band_hz)
    found = findings(candidate_set, (), multiples)
    kinds = {finding.kind for finding in found}
    explained = white.white and not related.related
    wrong = _wrong_model_reason(kinds, explained=explained)
    result = of_fit(
        candidate_set.best.name,
        candidate_set.best.fit,
        visible,
        {} if misread else _unidentifiable_orders(candidate_set, visible),
        unexplained=wrong,
        both=None if misread else candidate_set.with_both_dampings(candidate_set.best),
    )
    doubt = wrong or (_CLIPPED if "clipping" in kinds else None)
    test = _uniform_beam_test(measurement, modal)
    result = _with_modes(result, measurement, modal, test, doubt, doubt)
    if wrong == MISREAD:
        found = tuple(each for each in found if each.kind in _OF_CHANNELS)
    else:
        found += _settings(candidate_set, result, kinds)
        found = _with_doubts(found, (), wrong, doubt, result.flags, explained=explained)
        found = _with_knocks_and_unexplained(candidate_set, found, white, related)
    result = result.doubted(_CLIPPED) if "clipping" in kinds else result
    others = (each.fit for each in candidate_set.candidates if each.structure is INTEGER)
    analysis = RecordAnalysis.of(
        (result.fit, *others), candidate_set.noise, candidate_set.comparison
    )
    return _Assessment((result, found, analysis), candidate_set, explained, kinds)


def _unidentifiable_orders(candidate_set: CandidateSet, visible: tuple[int, ...]) -> dict[str, str]:
    """Return the orders that are not identifiable by the fit alone, with reasons."""
    freest, *others = candidate_set.candidates
    reason = not_reported_reason(candidate_set, visible)
    found = {}
    for name in COEFFICIENT_OF.keys() & set(freest.structure.free):
        low, high = freest.fit.interval[name] or (-math.inf, math.inf)
        too_wide = high - low > WIDEST_FRACTION * (ORDER_RANGE[1] - ORDER_RANGE[0])
        # An interval that is too narrow for what lies between: a local minimum of its own.
        astray = not low <= 1 <= high and any(
            each.structure.fixed.get(name) == 1.0  # type: ignore[call-overload]
            and each.deviance - freest.deviance < NORMAL_95**2
            for each in others
        )
        if reason or too_wide or astray or freest.fit.interval[COEFFICIENT_OF[name]] is None:
            found[name] = reason or NOT_DETERMINED
    return found


def _wrong_model_reason(kinds: Collection[str], *, explained: bool) -> str | None:
    """Return why the findings refute the model; None if they do not."""
    if not _MISREAD_KINDS.isdisjoint(kinds):
        return MISREAD
    return UNEXPLAINED if "harmonics" in kinds or not explained else None


def _doubt_reason(changes: tuple[TemporalChange, ...], *, one_sweep: bool) -> str | None:
    """Return why no parameter is valid although the record is explained, or None.

    The mode parameters are those at the time when the sweep passed each mode.
    """
    if established(changes, one_sweep=one_sweep):
        return None
    return next((f"{change.name} would explain the record as well" for change in changes), None)


def _with_doubts(
    from_model: tuple[Finding, ...],
    along: tuple[Finding, ...],
    wrong: str | None,
    doubt: str | None,
    flags: Mapping[str, str],
    *,
    explained: bool,
) -> tuple[Finding, ...]:
    """Return all findings, with the doubtful ones marked as not established.

    `from_model` are effects that were fitted with the beam, `along` the changes along the record,
    which already state their certainty. `wrong` is the reason against the model, `doubt` the reason
    against all numbers and `flags` those against single parameters. `explained` states that
    harmonics are all that remains.
    """

    def qualified(each: Finding) -> Finding:
        flag = next((flags[name] for name in each.parameters if name in flags), None)
        reason = doubt or flag
        if reason is None or (each.kind == "harmonics" and explained):
            return each
        return doubted(each, reason)

    from_model = tuple(map(qualified, from_model))
    if wrong is not None:
        along = tuple(doubted(each, wrong) for each in along)
    return (*from_model, *along)


def _with_knocks_and_unexplained(
    candidate_set: CandidateSet,
    found: tuple[Finding, ...],
    white: Whiteness,
    related: InputRelation,
) -> tuple[Finding, ...]:
    """Add impacts before the other findings, and the unexplained residual after them."""
    explained = white.white and not related.related
    knocks = of_knocks(candidate_set.comparison.measurement.knocks, explained=explained)
    rest = () if explained else (unexplained(white, related, candidate_set.best.fit.modes),)
    return (*knocks, *found, *rest)


def _tests(
    candidate_set: CandidateSet, modal: ModalFit | None, band_hz: tuple[float, float]
) -> tuple[Whiteness, InputRelation, tuple[Harmonic, ...]]:
    """Test the residual of the modal model, or of the first candidate if there is none."""
    comparison, counts = candidate_set.comparison, candidate_set.noise.counts
    residual = candidate_set.best.fit.residual if modal is None else modal.residual
    angle_rad = comparison.angle_rad[comparison.retained]
    of_variance_1 = comparison.in_time(residual) * math.sqrt(comparison.samples / 2)
    multiples = harmonics(angle_rad, of_variance_1, comparison.decimation.rate_hz, band_hz)
    if modal is not None:
        return modal.whiteness, modal.input_relation, multiples
    return (
        whiteness(residual[counts], comparison.frequency_hz[counts]),
        input_relation(residual, comparison.spectrum(angle_rad), comparison.frequency_hz),
        multiples,
    )


def _table(candidate_set: CandidateSet) -> tuple[CandidateRow, ...]:
    best, least_aic = candidate_set.best, min(c.aic for c in candidate_set.candidates)
    return tuple(
        CandidateRow(
            structure=c.structure.name,
            parameters=c.parameters,
            cost=c.fit.cost,
            delta_bic=c.bic - best.bic,
            delta_aic=c.aic - least_aic,
        )
        for c in candidate_set.candidates
    )
