"""Verdict on one record: modal model, uniform-beam test, damping orders, candidate structures.

The sentences of the verdict are written in `analysis.identify.sentences`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Generic, TypeVar

import numpy as np

from analysis.identify._candidates import CandidateSet
from analysis.identify._channel_checks import sign_and_unit_findings
from analysis.identify._comparison import Comparison
from analysis.identify._diagnostics import findings, setting_findings, unexplained
from analysis.identify._drag import (
    damping_with_amplitude,
    refit_with_air_drag,
)
from analysis.identify._explanations import explanations
from analysis.identify._explanations import finding as explanation_finding
from analysis.identify._finding import doubted
from analysis.identify._fit import BAND_HZ
from analysis.identify._knock import MAX_IMPACTS, add_known_impact, find_impacts, impact_findings
from analysis.identify._modal_fit import fit_modes
from analysis.identify._modal_headline import (
    order_verdict_with_geometry_tolerance,
    replace_by_modal_model,
)
from analysis.identify._nonlinear import add_nonlinear_forces
from analysis.identify._result import RecordAnalysis
from analysis.identify._small_effects import LARGE_DEVIANCE_REDUCTION, small_effect
from analysis.identify._step_in_time import best_stiffness_step
from analysis.identify._time_varying import (
    established,
    find_temporal_changes,
    temporal_change_findings,
)
from analysis.identify._visible_modes import visible_modes
from analysis.identify.headline import (
    CONTRADICTED_FILE_REASON,
    UNEXPLAINED_REASON,
    Headline,
    headline,
    headline_of_fit,
)
from analysis.identify.profile_likelihood import MAX_IDENTIFIABLE_FRACTION, profile_both_orders
from analysis.identify.residual_tests import (
    InputRelation,
    Whiteness,
    harmonics,
    input_relation,
    whiteness,
)
from analysis.identify.sentences import experiments, headline_sentences
from analysis.identify.uniform_beam import tolerant_estimate, uniform_beam_test
from analysis.identify.verdict import (
    BIC_TIE,
    ORDER_NOT_DETERMINED_REASON,
    CandidateRow,
    Verdict,
    not_reported_reason,
    order_verdict,
    rivals,
)
from analysis.models import COEFFICIENT_OF, ORDER_RANGE, STRUCTURES
from analysis.statistics import NORMAL_95
from rigd.beam import clamped_free_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._data import Measurement
    from analysis.identify._finding import Finding
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._nonlinear import NonlinearForce
    from analysis.identify._plant import Setting
    from analysis.identify._result import ModeEstimate, RecordFit
    from analysis.identify._small_effects import SmallEffect
    from analysis.identify._step_in_time import StiffnessStep
    from analysis.identify._time_varying import TemporalChange
    from analysis.identify.profile_likelihood import Order
    from analysis.identify.residual_tests import Harmonic
    from analysis.identify.uniform_beam import UniformBeamTest


_MODES_WITHOUT_REDUNDANCY: Final = 2
"""Number of visible modes up to which deviations from a uniform beam leave no degree of freedom."""

_ROUGH_DAMPING_RATIO: Final = 0.01
"""Damping ratio from which the search for a mode begins if no beam provides one."""


_TILTED_AXIS_REASON: Final = (
    "the axis is tilted, and fits to the whole record are of one that is plumb"
)
"""Reason against the estimates on an exactly uniform beam if the axis is tilted."""

_CLIPPED_TORQUE_REASON: Final = "the torque is clipped"
"""Reason against all numbers if the torque is clipped."""

ORDER_ONE_STRUCTURE: Final = STRUCTURES["III"]
"""Structure with internal and external damping of order 1. It is fitted from every start: it has no
local minima by undetermined orders, and no damping that is in fact a stiffness or an inertia."""

_CONTRADICTING_KINDS: Final = frozenset({"sign", "unit", "implausible"})
"""Findings that show that the record contradicts its file."""

_KINDS_AGAINST_IMPACT_SEARCH: Final = frozenset({"sign", "unit", "clipping", "stop"})
"""Findings that make a search for impacts useless. "implausible" is not one of them, since a large
impact may drive settings to an edge."""
_CHANNEL_KINDS: Final = _CONTRADICTING_KINDS | {"clipping", "stop"}
"""Findings that are reported even if the record contradicts its file."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Verdict on a record, with the fits that support it.

    Attributes
    ----------
    verdict : Verdict
        Conclusions on the record.
    headline : Headline
        Reported numbers, with flags.
    candidates : tuple of Candidate
        Fits of all structures, the one with the lowest BIC first.
    analysis : RecordAnalysis
        The same fits with their noise spectrum and frequencies.
    """

    verdict: Verdict
    headline: Headline
    candidates: tuple[Candidate, ...]
    analysis: RecordAnalysis

    @property
    def fit(self) -> RecordFit:
        """Return the fit whose numbers are reported."""
        return self.headline.fit

    @property
    def determined(self) -> frozenset[Order]:
        """Return the orders, "alpha" or "lambda", that the record determines."""
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

    The modal model is fitted to the record without hum, impacts and gaps. Its modes are reported.
    If its residual is noise, the antenna is linear and constant. Otherwise drag, nonlinear forces,
    changes along the record and impacts are tested. A uniform beam is tested against the modal
    constants. Orders, coefficients and stiffness are estimated from these constants, with the
    tolerance of the geometry that the measurement states. All structures are also fitted to the
    record on an exactly uniform beam. Their values are conditional estimates.

    Parameters
    ----------
    measurement : Measurement
        Angle and torque of the record, with the rig and specimen that the file states.
    fixed : iterable of str
        Settings that keep the values of the file.
    band_hz : tuple of float
        First and last frequency of the comparison.
    earlier : Selection, optional
        Selection of an earlier part of the record. If its first candidate explains the whole
        record, all candidates start from the earlier ones, in a third of the time. One of several
        minima may be missed then.

    Returns
    -------
    Selection
        Verdict, reported numbers and fits.

    Raises
    ------
    MeasurementError
        If the record cannot be used.
    ValueError
        If a name in `fixed` is no setting.
    """
    fixed = tuple(fixed)
    return _assess_with_impacts(
        measurement, lambda each: _select_with_known_impacts(each, fixed, band_hz, earlier)
    ).result


_ResultT = TypeVar("_ResultT")
"""Type of the result of an assessment."""


@dataclass(frozen=True, slots=True)
class _Assessment(Generic[_ResultT]):
    """Result on a record, with the candidates that support it.

    Attributes
    ----------
    result : _ResultT
        Selection, or the result of `fit_freest_alone`.
    candidate_set : CandidateSet
        Candidates, the one of the reported numbers first.
    explained : bool
        Whether the residual of this candidate is noise only.
    kinds : collection of str
        Kinds of the findings on the record.
    """

    result: _ResultT
    candidate_set: CandidateSet
    explained: bool
    kinds: Collection[str]


def _assess_with_impacts(
    measurement: Measurement, assess: Callable[[Measurement], _Assessment[_ResultT]]
) -> _Assessment[_ResultT]:
    """Assess a record, and assess it again with each impact that explains its residual."""
    assessment = assess(measurement)
    for _ in range(MAX_IMPACTS):
        if assessment.explained or not _KINDS_AGAINST_IMPACT_SEARCH.isdisjoint(assessment.kinds):
            break
        better_assessment = None
        # Harmonics last through the whole sweep, but a strong impact may be mistaken for them.
        for impact in find_impacts(
            assessment.candidate_set, obvious="harmonics" in assessment.kinds
        ):
            with_impact = assess(
                add_known_impact(assessment.candidate_set.comparison.measurement, impact)
            )
            if with_impact.explained or impact.evident:
                better_assessment = with_impact
            if with_impact.explained:
                break
        if better_assessment is None:
            break
        assessment = better_assessment
    return assessment


def _select_with_known_impacts(
    measurement: Measurement,
    fixed: tuple[Setting, ...],
    band_hz: tuple[float, float],
    earlier: Selection | None,
) -> _Assessment[Selection]:
    """Select the structure of a record whose known impacts are part of the measurement."""
    earlier_candidates = earlier.candidates if earlier else ()
    refitted = (
        CandidateSet.refit_from_earlier(earlier_candidates, measurement, fixed, band_hz)
        if earlier_candidates
        else None
    )
    linear = refitted or CandidateSet.of(measurement, fixed, band_hz)
    modal = _fit_modal_model(linear)
    candidate_set, small_linear_effect = linear, None
    forces: tuple[NonlinearForce, ...] = ()
    changes: tuple[TemporalChange, ...] = ()
    is_linear = modal is not None and _is_linear_and_constant(linear, modal, band_hz)
    if modal is not None:
        small_linear_effect = small_effect(
            linear.comparison, modal, modal.plant_with_modal_frequencies(linear.likeliest.plant)
        )
    modal_with_effect, effect_suffices = modal, is_linear
    if small_linear_effect is not None:
        modal_with_effect = _fit_modal_model(linear, small_linear_effect.column[None])
        effect_suffices = modal_with_effect is not None and _is_linear_and_constant(
            linear, modal_with_effect, band_hz
        )
    if not (is_linear or effect_suffices or measurement.knocks):
        for impact in find_impacts(linear, obvious=True):
            with_impact = _select_with_known_impacts(
                add_known_impact(measurement, impact), fixed, band_hz, None
            )
            if with_impact.explained:
                return with_impact
    stiffness_step = None
    if modal is not None and measurement.is_single_sweep:
        if not (is_linear or effect_suffices) or (
            small_linear_effect is not None and small_linear_effect.large
        ):
            stiffness_step = _likely_stiffness_step(linear, modal, small_linear_effect)
        if stiffness_step is not None:
            small_linear_effect, modal_with_effect, effect_suffices = None, modal, is_linear
    if not (is_linear or effect_suffices) or (
        small_linear_effect is not None and small_linear_effect.large
    ):
        candidate_set, forces, changes = _fit_further_effects(
            linear, test_amplitude_effects=stiffness_step is None
        )
        modal = _fit_modal_model(candidate_set)
        if effect_suffices and not (
            modal is not None and _is_linear_and_constant(candidate_set, modal, band_hz)
        ):
            candidate_set, forces, changes, modal = linear, (), (), modal_with_effect
        else:
            small_linear_effect = None
    elif small_linear_effect is not None and small_linear_effect.saved > LARGE_DEVIANCE_REDUCTION:
        candidate_set = linear.refit_with_additional_effect(small_linear_effect.column[None])
        modal = _fit_modal_model(candidate_set)
    else:
        modal = modal_with_effect
    candidate_set = candidate_set.fit_with_free_orders()
    visible_numbers = _visible_mode_numbers(candidate_set, modal)
    beam_test = _uniform_beam_test(measurement, modal)
    uniform_beam_refused = beam_test is not None and beam_test.status == "refused"
    # A local minimum that a part of the record excludes is excluded by the whole record.
    determined = earlier.determined if earlier and refitted else ()
    compute_profiles = (
        not_reported_reason(candidate_set, visible_numbers) is None and not uniform_beam_refused
    )
    candidate_set, *profiles = profile_both_orders(
        candidate_set, determined, compute=compute_profiles
    )
    leading = candidate_set.with_leading_candidate(candidate_set.freest)
    whiteness_test, input_test, harmonic_tests = _test_residual(leading, modal, band_hz)
    explained = whiteness_test.white and not input_test.related
    all_findings = findings(leading, forces, harmonic_tests)
    kinds = {finding.kind for finding in all_findings}
    model_reason = _wrong_model_reason(kinds, explained=explained)
    clipped_reason = _CLIPPED_TORQUE_REASON if "clipping" in kinds else None
    doubt = (
        model_reason
        or clipped_reason
        or _doubt_reason(changes, is_single_sweep=measurement.is_single_sweep)
    )
    alpha, lambda_ = (
        order_verdict(candidate_set, each, visible_numbers, doubt=doubt) for each in profiles
    )
    orders, close_rivals = (alpha, lambda_), rivals(candidate_set, BIC_TIE)
    reported = headline(candidate_set, orders, visible_numbers, unexplained=model_reason)
    if doubt is not None:
        reported = reported.doubted(doubt)
    # With a fitted change the modes are those at the middle of the record.
    mode_doubt = doubt if changes and changes[0].certain else model_reason or clipped_reason
    reported = _add_modal_model(reported, measurement, modal, beam_test, doubt, mode_doubt)
    if reported.tolerant is not None:
        alpha, lambda_ = (
            order_verdict_with_geometry_tolerance(
                each.order, reported.tolerant, each, doubt, refused=uniform_beam_refused
            )
            for each in profiles
        )
        orders = alpha, lambda_
    if "nonlinear stiffness" in kinds:
        reported = reported.with_stiffness_law_flag()
    sentences, advice = [], []
    if model_reason == CONTRADICTED_FILE_REASON:
        all_findings = tuple(each for each in all_findings if each.kind in _CHANNEL_KINDS)
    else:
        change_findings = tuple(
            temporal_change_findings(changes, is_single_sweep=measurement.is_single_sweep)
        )
        all_findings += _setting_findings(leading, reported, kinds)
        all_findings += () if small_linear_effect is None else (small_linear_effect.finding(),)
        if (
            modal is not None
            and beam_test is not None
            and uniform_beam_refused
            and model_reason is None
        ):
            all_findings += _explain_deviations(measurement, leading, modal, beam_test)
        all_findings = _mark_doubtful_findings(
            all_findings, change_findings, model_reason, doubt, reported.flags, explained=explained
        )
        all_findings = _add_impacts_and_unexplained(
            leading, all_findings, whiteness_test, input_test, stiffness_step
        )
        sentences = headline_sentences(reported, orders, without_rival=doubt is None)
        advice = experiments(candidate_set, orders, visible_numbers, all_findings, close_rivals)
    advice += [each.remedy for each in all_findings if each.remedy]
    best_candidate = candidate_set.best
    selection = Selection(
        candidates=candidate_set.candidates,
        headline=reported,
        analysis=RecordAnalysis.of(
            (c.fit for c in candidate_set.candidates), candidate_set.noise, candidate_set.comparison
        ),
        verdict=Verdict(
            name=measurement.name,
            structure=best_candidate.structure.name,
            rivals=tuple(c.name for c in close_rivals),
            parameters={k: q.value for k, q in reported.parameters.items() if q.flag is None},
            adequate=model_reason is None,
            alpha=alpha,
            lambda_=lambda_,
            visible_modes=visible_numbers,
            findings=all_findings,
            table=_candidate_table(candidate_set),
            whiteness=whiteness_test,
            input_relation=input_test,
            harmonics=harmonic_tests,
            sentences=(*sentences, *(each.sentence for each in all_findings)),
            experiments=tuple(dict.fromkeys(advice)),
            damping_with_amplitude=damping_with_amplitude(leading),
        ),
    )
    return _Assessment(selection, leading, explained, kinds)


def _fit_modal_model(
    candidate_set: CandidateSet, added_spectra: NDArray[np.complex128] | None = None
) -> ModalFit | None:
    """Fit the modal model to the record of a candidate set, or return None if no mode is visible.

    `added_spectra`, shape (c, K), are torque spectra of unknown size in addition to those of the
    candidates.
    """
    if candidate_set.misread:
        return None
    starts = _mode_starts(candidate_set.likeliest.modes)
    columns, drag = candidate_set.columns, candidate_set.comparison.drag
    if added_spectra is not None:
        columns = np.concatenate([columns, added_spectra])
    if drag is not None:  # the size of the drag is not known exactly
        columns = np.concatenate([columns, drag.by_law])
    return fit_modes(candidate_set.comparison, candidate_set.noise, starts, columns)


def _mode_starts(modes: Iterable[ModeEstimate]) -> list[tuple[int, float, float]]:
    """Return number, frequency in hertz and damping ratio of each mode as start of its search.

    A beam that fits badly may have an overdamped mode below one that oscillates. The search for the
    overdamped mode starts at the frequency ratio of a uniform beam.
    """
    oscillating_modes = {mode.number: mode for mode in modes if mode.frequency_hz > 0}
    if not oscillating_modes:
        return []
    numbers = range(1, max(oscillating_modes) + 1)
    eigenvalues = clamped_free_eigenvalues(len(numbers)).tolist()
    starts = []
    for number in numbers:
        mode = oscillating_modes.get(number)
        if mode is not None:
            starts.append((number, mode.frequency_hz, mode.damping_ratio))
            continue
        nearest = min(oscillating_modes.values(), key=lambda each: abs(each.number - number))
        frequency_ratio = (eigenvalues[number - 1] / eigenvalues[nearest.number - 1]) ** 2
        starts.append((number, nearest.frequency_hz * frequency_ratio, _ROUGH_DAMPING_RATIO))
    return starts


def _visible_mode_numbers(candidate_set: CandidateSet, modal: ModalFit | None) -> tuple[int, ...]:
    """Return the numbers of the modes that a record shows."""
    if modal is None:
        return visible_modes(candidate_set.comparison, candidate_set.noise, candidate_set.best.fit)
    return modal.visible


def _add_modal_model(
    exact_headline: Headline,
    measurement: Measurement,
    modal: ModalFit | None,
    test: UniformBeamTest | None,
    doubt: str | None,
    mode_doubt: str | None,
) -> Headline:
    """Add the modal model and the estimates with tolerance to the headline of a uniform beam.

    Return `exact_headline` if there is no modal model. `doubt` is the reason against every number,
    and `mode_doubt` the reason against every mode. They are None if there is no such reason.
    """
    if modal is None or test is None:
        return exact_headline
    tolerant = None
    if measurement.axis_tilt_deg:
        exact_headline = exact_headline.doubted(_TILTED_AXIS_REASON)
    if measurement.uniformity or test.status == "refused" or measurement.axis_tilt_deg:
        tolerant = tolerant_estimate(
            modal, measurement.nominal, measurement.uniformity, measurement.axis_tilt_deg
        )
    return replace_by_modal_model(exact_headline, modal, test, tolerant, doubt, mode_doubt)


def _uniform_beam_test(measurement: Measurement, modal: ModalFit | None) -> UniformBeamTest | None:
    """Test whether a uniform beam predicts the modes. Return None without a modal model."""
    if modal is None:
        return None
    return uniform_beam_test(modal, measurement.nominal, measurement.axis_tilt_deg)


def _explain_deviations(
    measurement: Measurement, candidate_set: CandidateSet, modal: ModalFit, test: UniformBeamTest
) -> tuple[Finding, ...]:
    """Return a finding that names simple causes of the deviations from a uniform beam.

    Return no finding with only two modes, which leave no degree of freedom for this test.
    """
    if len(modal.visible) <= _MODES_WITHOUT_REDUNDANCY:
        return ()
    causes = explanations(modal, measurement.nominal, measurement.axis_tilt_deg)
    stiffness_step = (
        best_stiffness_step(candidate_set.comparison, modal)
        if measurement.is_single_sweep
        else None
    )
    return (explanation_finding(test, causes, stiffness_step),)


def _setting_findings(
    candidate_set: CandidateSet, result: Headline, kinds: Collection[str]
) -> tuple[Finding, ...]:
    """Return findings on settings that differ from the file, if the record can show them."""
    if "implausible" in kinds or len(result.visible_modes) < _MODES_WITHOUT_REDUNDANCY:
        return ()
    return tuple(setting_findings(candidate_set, result))


def _is_linear_and_constant(
    candidate_set: CandidateSet, modal: ModalFit, band_hz: tuple[float, float]
) -> bool:
    """Return whether noise and no harmonic remains, so that no other effect need be tested."""
    _, _, harmonic_tests = _test_residual(candidate_set, modal, band_hz)
    return modal.explained and not any(each.present for each in harmonic_tests)


def _fit_further_effects(
    linear: CandidateSet, *, test_amplitude_effects: bool
) -> tuple[CandidateSet, tuple[NonlinearForce, ...], tuple[TemporalChange, ...]]:
    """Test a record for nonlinear and time-varying effects, or for the latter alone.

    Return the candidate set with the best explanation, its nonlinear forces, and its changes along
    the record.
    """
    if not test_amplitude_effects:
        candidate_set, changes = find_temporal_changes(linear.fit_with_free_orders())
        return candidate_set, (), changes
    candidate_set = linear if linear.misread else refit_with_air_drag(linear)
    visible_numbers = visible_modes(linear.comparison, linear.noise, linear.best.fit)
    candidate_set, forces = (
        (candidate_set, ())
        if candidate_set.misread
        else add_nonlinear_forces(candidate_set, visible_numbers)
    )
    if forces and candidate_set.drag is not None:
        # A stiffness that depends on the deflection may have been mistaken for weak drag.
        without_drag, forces_without_drag = add_nonlinear_forces(linear, visible_numbers)
        if forces_without_drag and without_drag.bic < candidate_set.bic:
            candidate_set, forces = without_drag, forces_without_drag
    candidate_set, changes = find_temporal_changes(candidate_set.fit_with_free_orders())
    is_single_sweep = linear.comparison.measurement.is_single_sweep
    if not is_single_sweep and (forces or candidate_set.drag is not None):
        # A change along the record may have been mistaken for a dependence on the amplitude.
        with_changes, other_changes = find_temporal_changes(
            linear.fit_with_free_orders(), rival_bic=candidate_set.bic
        )
        if other_changes and with_changes.bic < candidate_set.bic:
            return with_changes, (), other_changes
    return candidate_set, forces, changes


def _likely_stiffness_step(
    linear: CandidateSet, modal: ModalFit, small_linear_effect: SmallEffect | None
) -> StiffnessStep | None:
    """Return the step of the stiffness if it explains more than any effect of the amplitude."""
    stiffness_step = best_stiffness_step(linear.comparison, modal)
    rival_reduction = 0.0 if small_linear_effect is None else small_linear_effect.saved
    return (
        stiffness_step
        if stiffness_step.score > max(rival_reduction, LARGE_DEVIANCE_REDUCTION)
        else None
    )


def fit_freest_alone(
    measurement: Measurement, band_hz: tuple[float, float] = BAND_HZ
) -> tuple[Headline, tuple[Finding, ...], RecordAnalysis]:
    """Fit only the freest structure on a uniform beam, in a quarter of `select`'s time.

    The modes are those of `select` if that selects such a beam with all orders free. If it selects
    another model (drag, nonlinear forces), the residual is not noise, and every number carries a
    flag. Orders are not profiled: the visible modes and the width of the interval decide whether an
    order is identifiable.

    Parameters
    ----------
    measurement : Measurement
        Angle and torque of the record, with the rig and specimen that the file states.
    band_hz : tuple of float
        First and last frequency of the comparison.

    Returns
    -------
    headline : Headline
        Reported numbers, with flags.
    findings : tuple of Finding
        Findings that need no comparison of candidates.
    analysis : RecordAnalysis
        Fit of the freest structure, then the fit of `ORDER_ONE_STRUCTURE`, with the noise spectrum.

    Raises
    ------
    MeasurementError
        If the record cannot be used.
    """
    return _assess_with_impacts(
        measurement, lambda each: _fit_freest_with_known_impacts(each, band_hz)
    ).result


def _fit_freest_with_known_impacts(
    measurement: Measurement, band_hz: tuple[float, float]
) -> _Assessment[tuple[Headline, tuple[Finding, ...], RecordAnalysis]]:
    """Fit only the freest structure to a record whose known impacts are part of the measurement."""
    misread = tuple(sign_and_unit_findings(Comparison.of(measurement, band_hz)))
    additional = () if misread else (ORDER_ONE_STRUCTURE,)
    candidate_set = replace(
        CandidateSet.fit_freest_structure(measurement, (), band_hz, additional), misread=misread
    )
    if not misread:
        candidate_set = candidate_set.fit_special_cases()
    modal = _fit_modal_model(candidate_set)
    visible_numbers = _visible_mode_numbers(candidate_set, modal)
    whiteness_test, input_test, harmonic_tests = _test_residual(candidate_set, modal, band_hz)
    all_findings = findings(candidate_set, (), harmonic_tests)
    kinds = {finding.kind for finding in all_findings}
    explained = whiteness_test.white and not input_test.related
    model_reason = _wrong_model_reason(kinds, explained=explained)
    result = headline_of_fit(
        candidate_set.best.name,
        candidate_set.best.fit,
        visible_numbers,
        {} if misread else _unidentifiable_orders(candidate_set, visible_numbers),
        unexplained=model_reason,
        both=None if misread else candidate_set.fit_with_both_dampings(candidate_set.best),
    )
    doubt = model_reason or (_CLIPPED_TORQUE_REASON if "clipping" in kinds else None)
    beam_test = _uniform_beam_test(measurement, modal)
    result = _add_modal_model(result, measurement, modal, beam_test, doubt, doubt)
    if model_reason == CONTRADICTED_FILE_REASON:
        all_findings = tuple(each for each in all_findings if each.kind in _CHANNEL_KINDS)
    else:
        all_findings += _setting_findings(candidate_set, result, kinds)
        all_findings = _mark_doubtful_findings(
            all_findings, (), model_reason, doubt, result.flags, explained=explained
        )
        all_findings = _add_impacts_and_unexplained(
            candidate_set, all_findings, whiteness_test, input_test
        )
    result = result.doubted(_CLIPPED_TORQUE_REASON) if "clipping" in kinds else result
    other_fits = (
        each.fit for each in candidate_set.candidates if each.structure is ORDER_ONE_STRUCTURE
    )
    analysis = RecordAnalysis.of(
        (result.fit, *other_fits), candidate_set.noise, candidate_set.comparison
    )
    return _Assessment((result, all_findings, analysis), candidate_set, explained, kinds)


def _unidentifiable_orders(
    candidate_set: CandidateSet, visible_numbers: tuple[int, ...]
) -> dict[str, str]:
    """Return the orders that the fit of the freest structure does not determine, with reasons."""
    freest, *other_candidates = candidate_set.candidates
    reason = not_reported_reason(candidate_set, visible_numbers)
    reasons = {}
    for name in COEFFICIENT_OF.keys() & set(freest.structure.free):
        low, high = freest.fit.interval[name] or (-math.inf, math.inf)
        interval_too_wide = high - low > MAX_IDENTIFIABLE_FRACTION * (
            ORDER_RANGE[1] - ORDER_RANGE[0]
        )
        # A narrow interval without 1, although order 1 fits as well, is that of a local minimum.
        at_local_minimum = not low <= 1 <= high and any(
            each.structure.fixed.get(name) == 1.0  # type: ignore[call-overload]
            and each.deviance - freest.deviance < NORMAL_95**2
            for each in other_candidates
        )
        if (
            reason
            or interval_too_wide
            or at_local_minimum
            or freest.fit.interval[COEFFICIENT_OF[name]] is None
        ):
            reasons[name] = reason or ORDER_NOT_DETERMINED_REASON
    return reasons


def _wrong_model_reason(kinds: Collection[str], *, explained: bool) -> str | None:
    """Return the reason why findings or residual refute the model, or None if they do not."""
    if not _CONTRADICTING_KINDS.isdisjoint(kinds):
        return CONTRADICTED_FILE_REASON
    return UNEXPLAINED_REASON if "harmonics" in kinds or not explained else None


def _doubt_reason(changes: tuple[TemporalChange, ...], *, is_single_sweep: bool) -> str | None:
    """Return why changes along the record make every parameter doubtful, or None if they do not.

    With a change along the record, the mode parameters are those at the time when the sweep passed
    each mode.
    """
    if established(changes, is_single_sweep=is_single_sweep):
        return None
    return next((f"{change.name} would explain the record as well" for change in changes), None)


def _mark_doubtful_findings(
    fitted_findings: tuple[Finding, ...],
    change_findings: tuple[Finding, ...],
    model_reason: str | None,
    doubt: str | None,
    flags: Mapping[str, str],
    *,
    explained: bool,
) -> tuple[Finding, ...]:
    """Return all findings, with the doubtful ones marked as not established.

    `fitted_findings` are effects that were fitted with the beam. `change_findings` are changes
    along the record, which already state their certainty. `model_reason` is the reason against the
    model, `doubt` the reason against all numbers, and `flags` are the reasons against single
    parameters. `explained` states that harmonics are all that remains.
    """

    def qualified(each: Finding) -> Finding:
        """Mark a finding as not established if a reason against it exists."""
        flag = next((flags[name] for name in each.parameters if name in flags), None)
        reason = doubt or flag
        if reason is None or (each.kind == "harmonics" and explained):
            return each
        return doubted(each, reason)

    fitted_findings = tuple(map(qualified, fitted_findings))
    if model_reason is not None:
        change_findings = tuple(doubted(each, model_reason) for each in change_findings)
    return (*fitted_findings, *change_findings)


def _add_impacts_and_unexplained(
    candidate_set: CandidateSet,
    findings_of_model: tuple[Finding, ...],
    whiteness_test: Whiteness,
    input_test: InputRelation,
    stiffness_step: StiffnessStep | None = None,
) -> tuple[Finding, ...]:
    """Add impacts before the other findings, and the unexplained residual after them."""
    explained = whiteness_test.white and not input_test.related
    findings_of_impacts = impact_findings(
        candidate_set.comparison.measurement.knocks, explained=explained
    )
    unexplained_findings = (
        ()
        if explained
        else (
            unexplained(whiteness_test, input_test, candidate_set.best.fit.modes, stiffness_step),
        )
    )
    return (*findings_of_impacts, *findings_of_model, *unexplained_findings)


def _test_residual(
    candidate_set: CandidateSet, modal: ModalFit | None, band_hz: tuple[float, float]
) -> tuple[Whiteness, InputRelation, tuple[Harmonic, ...]]:
    """Test the residual of the modal model, or of the first candidate if there is none."""
    comparison, compared_bins = candidate_set.comparison, candidate_set.noise.counts
    residual = candidate_set.best.fit.residual if modal is None else modal.residual
    angle_rad = comparison.angle_rad[comparison.retained]
    unit_variance_residual = comparison.in_time(residual) * math.sqrt(comparison.samples / 2)
    harmonic_tests = harmonics(
        angle_rad, unit_variance_residual, comparison.decimation.rate_hz, band_hz
    )
    if modal is not None:
        return modal.whiteness, modal.input_relation, harmonic_tests
    return (
        whiteness(residual[compared_bins], comparison.frequency_hz[compared_bins]),
        input_relation(residual, comparison.spectrum(angle_rad), comparison.frequency_hz),
        harmonic_tests,
    )


def _candidate_table(candidate_set: CandidateSet) -> tuple[CandidateRow, ...]:
    """Return one table row for each candidate, the one with the lowest BIC first."""
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
