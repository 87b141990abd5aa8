"""Verdict on one record: modal model, uniform-beam test, damping orders, candidate structures.

The sentences of the verdict are written in `analysis.identify.sentences`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from analysis.identify._candidates import CandidateSet
from analysis.identify._channel_checks import sign_and_unit_findings
from analysis.identify._comparison import Comparison
from analysis.identify._drag import (
    damping_with_amplitude,
)
from analysis.identify._explanations import explanations
from analysis.identify._explanations import finding as explanation_finding
from analysis.identify._fit import BAND_HZ
from analysis.identify._impacts import (
    MAX_IMPACTS,
    add_known_impact,
    find_impacts,
    with_fitted_impact_poles,
)
from analysis.identify._model_check import (
    MODES_WITHOUT_REDUNDANCY,
    ModelCheck,
    visible_mode_numbers,
)
from analysis.identify._record_model import (
    add_further_effects,
    fit_drag_with_modes,
    fit_linear_model,
    fit_modal_model,
)
from analysis.identify._result import RecordAnalysis
from analysis.identify._step_in_time import best_stiffness_step
from analysis.identify._time_varying import (
    temporal_change_findings,
)
from analysis.identify.beam_uniformity import UniformBeamTest, uniform_beam_test
from analysis.identify.headline import (
    TILTED_AXIS_REASON,
    Headline,
    headline,
    headline_of_fit,
)
from analysis.identify.modal_headline import (
    flag_contradicted_damping,
    flag_modes_changed_by_drag,
    order_verdict_with_geometry_tolerance,
    replace_by_modal_model,
)
from analysis.identify.profile_likelihood import MAX_IDENTIFIABLE_FRACTION, profile_both_orders
from analysis.identify.sentences import experiments, headline_sentences
from analysis.identify.tolerant_estimate import tolerant_estimate
from analysis.identify.verdict import (
    ORDER_NOT_DETERMINED_REASON,
    CandidateRow,
    Verdict,
    not_reported_reason,
    order_verdict,
    rivals,
)
from analysis.models import ORDER_RANGE, STRUCTURES
from analysis.statistics import BIC_TIE, NORMAL_95
from rigd.beam import COEFFICIENT_OF

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from analysis.identify._candidate import Candidate
    from analysis.identify._data import Measurement
    from analysis.identify._explanations import CauseFit
    from analysis.identify._finding import Finding
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._result import RecordFit
    from analysis.identify._settings import Setting
    from analysis.identify.profile_likelihood import OrderName


_ONLINE_DRAG_COMPUTATIONS: Final = 4
"""Number of computations of the drag torque in a fit of the freest structure alone, which a running
session repeats."""

ORDER_ONE_STRUCTURE: Final = STRUCTURES["III"]
"""Structure with internal and external damping of order 1. It is fitted from every start: it has no
local minima by undetermined orders, and no damping that is in fact a stiffness or an inertia."""

_MAX_IMPACT_POLE_UPDATES: Final = 4
"""Maximum number of updates of the poles of the decays after an impact."""

_FINDING_KINDS_AGAINST_IMPACT_SEARCH: Final = frozenset({"sign", "unit", "clipping", "stop"})
"""Findings that make a search for impacts useless. "implausible" is not one of them, since a large
impact may drive settings to an edge."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Verdict on one record of angle and torque, with the fits from which it is drawn.

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
    linear_candidates : tuple of Candidate
        Fits without drag and other effects, from which the selection of a longer record may start.
    """

    verdict: Verdict
    headline: Headline
    candidates: tuple[Candidate, ...]
    analysis: RecordAnalysis
    linear_candidates: tuple[Candidate, ...]

    @property
    def fit(self) -> RecordFit:
        """Return the whole-record fit whose parameter values are reported."""
        return self.headline.fit

    @property
    def determined_orders(self) -> frozenset[OrderName]:
        """Return the damping orders, "alpha" or "lambda", that the record determines precisely."""
        order_verdicts = (self.verdict.alpha, self.verdict.lambda_)
        return frozenset(
            verdict_of_order.order
            for verdict_of_order in order_verdicts
            if verdict_of_order.profile.identifiable
        )


def select(
    measurement: Measurement,
    *,
    fixed_settings: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
    earlier: Selection | None = None,
) -> Selection:
    """Select the model of beam and damping that a record supports, and report its parameters.

    The modal model is fitted to the record without hum, impacts and gaps. Its modes are reported.
    If its residual is noise, the beam is linear and time-invariant. Otherwise drag, nonlinear
    forces, changes along the record and impacts are tested. The constants of the modes show
    whether the beam is uniform. Orders, coefficients and stiffness are estimated from these
    constants, with the stated tolerance of the geometry. All structures are also fitted to the
    record on an exactly uniform beam; their values are conditional on it.

    Parameters
    ----------
    measurement : Measurement
        Angle and torque of the record, with the rig and specimen that the file states.
    fixed_settings : iterable of str
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
        If a name in `fixed_settings` is no setting.
    """
    fixed_settings = tuple(fixed_settings)
    return _assess_with_impacts(
        measurement,
        lambda measurement_with_impacts: _select_with_known_impacts(
            measurement_with_impacts, fixed_settings, band_hz, earlier
        ),
    ).result


_ResultT = TypeVar("_ResultT")
"""Type of the result of an assessment."""


@dataclass(frozen=True, slots=True)
class _Assessment(Generic[_ResultT]):
    """Result of the model selection on one record, with the fitted candidates it is based on.

    A candidate is one structure of beam and damping, fitted to the record.

    Attributes
    ----------
    result : _ResultT
        Selection, or the result of `fit_freest_alone`.
    model_check : ModelCheck
        Check of the model against the record.
    """

    result: _ResultT
    model_check: ModelCheck

    @property
    def residual_is_noise(self) -> bool:
        """Whether the residual is noise only."""
        return self.model_check.residual_tests.is_noise


def _assess_with_impacts(
    measurement: Measurement, assess_measurement: Callable[[Measurement], _Assessment[_ResultT]]
) -> _Assessment[_ResultT]:
    """Select the model of a record; add impacts one by one while they explain its residual.

    An impact is added if it is evident, or if the residual is noise with it. `assess_measurement`
    is the selection for a measurement whose known impacts are fitted. Return its result with all
    added impacts, or that without impacts if none was added.
    """
    assess_with_fitted_poles = partial(_assess_with_fitted_poles, assess_measurement)
    assessment = assess_with_fitted_poles(measurement)
    for _ in range(MAX_IMPACTS):
        if assessment.residual_is_noise or not _FINDING_KINDS_AGAINST_IMPACT_SEARCH.isdisjoint(
            assessment.model_check.finding_kinds
        ):
            break
        better_assessment = None
        # Harmonics last through the whole sweep, but a strong impact may be mistaken for them.
        candidate_set = assessment.model_check.candidate_set
        for impact in find_impacts(
            candidate_set, only_obvious="harmonics" in assessment.model_check.finding_kinds
        ):
            impact_assessment = assess_with_fitted_poles(
                add_known_impact(candidate_set.comparison.measurement, impact)
            )
            if impact_assessment.residual_is_noise or impact.is_evident:
                better_assessment = impact_assessment
            if impact_assessment.residual_is_noise:
                break
        if better_assessment is None:
            break
        assessment = better_assessment
    return assessment


def _assess_with_fitted_poles(
    assess_measurement: Callable[[Measurement], _Assessment[_ResultT]], measurement: Measurement
) -> _Assessment[_ResultT]:
    """Select the model of a record; the decays after its impacts get the poles of the modes.

    An impact is found with the poles of a fit that it biased.
    """
    assessment = assess_measurement(measurement)
    for _ in range(_MAX_IMPACT_POLE_UPDATES):
        modal_fit = assessment.model_check.modal_fit
        # The poles of a model that does not explain the record may be any.
        if modal_fit is None or not assessment.residual_is_noise:
            break
        # The assessment may have found an impact itself.
        measurement = assessment.model_check.candidate_set.comparison.measurement
        updated_measurement = with_fitted_impact_poles(measurement, modal_fit)
        if updated_measurement is None:
            break
        assessment = assess_measurement(updated_measurement)
    return assessment


def _select_with_known_impacts(
    measurement: Measurement,
    fixed_settings: tuple[Setting, ...],
    band_hz: tuple[float, float],
    earlier_selection: Selection | None,
) -> _Assessment[Selection]:
    """Select the structure of a record. The impacts that the measurement states are fitted, too."""
    earlier_candidates = earlier_selection.linear_candidates if earlier_selection else ()
    refitted_candidates = (
        CandidateSet.refit_from_earlier(earlier_candidates, measurement, fixed_settings, band_hz)
        if earlier_candidates
        else None
    )
    linear_candidates = refitted_candidates or CandidateSet.from_measurement(
        measurement, fixed_settings, band_hz
    )
    model = fit_linear_model(linear_candidates, band_hz)
    if not (model.explains_record or measurement.impacts):
        for impact in find_impacts(linear_candidates, only_obvious=True):
            impact_assessment = _select_with_known_impacts(
                add_known_impact(measurement, impact), fixed_settings, band_hz, None
            )
            if impact_assessment.residual_is_noise:
                return impact_assessment
    model = add_further_effects(model, band_hz)
    modal_fit = model.modal_fit
    candidate_set = model.candidate_set.fit_with_free_orders()
    visible_numbers = visible_mode_numbers(candidate_set, modal_fit)
    beam_test = _uniform_beam_test(measurement, modal_fit)
    is_uniform_beam_refused = beam_test is not None and beam_test.status == "refused"
    # A local minimum that a part of the record excludes is excluded by the whole record.
    determined_orders = (
        earlier_selection.determined_orders if earlier_selection and refitted_candidates else ()
    )
    are_profiles_computed = (
        not_reported_reason(candidate_set, visible_numbers) is None and not is_uniform_beam_refused
    )
    candidate_set, *order_profiles = profile_both_orders(
        candidate_set, determined_orders, compute=are_profiles_computed
    )
    leading_candidates = candidate_set.with_leading_candidate(candidate_set.freest)
    model_check = ModelCheck.of_candidates(
        leading_candidates, modal_fit, band_hz, model.nonlinear_forces, model.temporal_changes
    )
    alpha_verdict, lambda_verdict = (
        order_verdict(candidate_set, each, visible_numbers, doubt_reason=model_check.doubt_reason)
        for each in order_profiles
    )
    order_verdicts = alpha_verdict, lambda_verdict
    reported_headline = headline(
        candidate_set,
        order_verdicts,
        visible_numbers,
        unexplained_reason=model_check.model_rejection_reason,
    )
    if model_check.doubt_reason is not None:
        reported_headline = reported_headline.with_flag_on_all(model_check.doubt_reason)
    reported_headline = _add_modal_model(reported_headline, measurement, beam_test, model_check)
    reported_headline = flag_modes_changed_by_drag(reported_headline, model.modes_changed_by_drag)
    effect_findings = model.findings
    if is_uniform_beam_refused and model_check.model_rejection_reason is None:
        assert modal_fit is not None
        assert beam_test is not None
        causes, cause_findings = _explain_deviations(
            measurement, leading_candidates, modal_fit, beam_test
        )
        effect_findings += cause_findings
        reported_headline = flag_contradicted_damping(reported_headline, causes)
    if reported_headline.tolerant is not None:
        reported_flags = reported_headline.flags
        alpha_verdict, lambda_verdict = (
            order_verdict_with_geometry_tolerance(
                each.order,
                reported_headline.tolerant,
                each,
                model_check.doubt_reason or reported_flags.get(each.order),
                refused=is_uniform_beam_refused,
            )
            for each in order_profiles
        )
        order_verdicts = alpha_verdict, lambda_verdict
    if "nonlinear stiffness" in model_check.finding_kinds:
        reported_headline = reported_headline.with_stiffness_law_flag()
    all_findings = model_check.reported_findings(
        reported_headline,
        effect_findings,
        tuple(
            temporal_change_findings(
                model.temporal_changes,
                is_single_sweep=measurement.is_single_sweep,
                explained=model_check.residual_tests.is_noise,
            )
        ),
        model.stiffness_step,
    )
    close_rival_candidates = rivals(candidate_set, BIC_TIE)
    verdict_sentences, experiment_texts = [], []
    if not model_check.contradicts_file:
        verdict_sentences = headline_sentences(
            reported_headline, order_verdicts, doubt_reason=model_check.doubt_reason
        )
        experiment_texts = experiments(
            candidate_set, order_verdicts, visible_numbers, all_findings, close_rival_candidates
        )
    experiment_texts += [each.remedy for each in all_findings if each.remedy]
    selection = Selection(
        candidates=candidate_set.candidates,
        linear_candidates=linear_candidates.candidates,
        headline=reported_headline,
        analysis=RecordAnalysis.from_fits(
            (c.fit for c in candidate_set.candidates), candidate_set.noise, candidate_set.comparison
        ),
        verdict=Verdict(
            name=measurement.name,
            structure=candidate_set.best.structure.name,
            rivals=tuple(c.name for c in close_rival_candidates),
            parameters={
                k: q.value for k, q in reported_headline.parameters.items() if q.flag is None
            },
            adequate=model_check.model_rejection_reason is None,
            alpha=alpha_verdict,
            lambda_=lambda_verdict,
            visible_modes=visible_numbers,
            findings=all_findings,
            table=_candidate_table(candidate_set),
            whiteness=model_check.residual_tests.whiteness,
            input_relation=model_check.residual_tests.input_relation,
            harmonics=model_check.residual_tests.harmonics,
            sentences=(*verdict_sentences, *(each.sentence for each in all_findings)),
            experiments=tuple(dict.fromkeys(experiment_texts)),
            damping_with_amplitude=damping_with_amplitude(leading_candidates),
        ),
    )
    return _Assessment(selection, model_check)


def _uniform_beam_test(
    measurement: Measurement, modal_fit: ModalFit | None
) -> UniformBeamTest | None:
    """Test whether a uniform beam predicts the measured modes; None if there is no modal model."""
    if modal_fit is None:
        return None
    if not modal_fit.determines_response or modal_fit.has_damping_at_limit:
        return UniformBeamTest.not_made(modal_fit)
    return uniform_beam_test(modal_fit, measurement.nominal_plant, measurement.axis_tilt_deg)


def _explain_deviations(
    measurement: Measurement,
    candidate_set: CandidateSet,
    modal_fit: ModalFit,
    beam_test: UniformBeamTest,
) -> tuple[tuple[CauseFit, ...], tuple[Finding, ...]]:
    """Return simple causes of the deviations from a uniform beam, and the finding that names them.

    Both are empty with only two modes, which leave no degree of freedom for a test of causes.
    """
    if len(modal_fit.visible_mode_numbers) <= MODES_WITHOUT_REDUNDANCY:
        return (), ()
    causes = explanations(beam_test)
    stiffness_step = (
        best_stiffness_step(candidate_set.comparison, modal_fit)
        if measurement.is_single_sweep
        else None
    )
    return causes, (explanation_finding(beam_test, causes, stiffness_step),)


def _add_modal_model(
    exact_headline: Headline,
    measurement: Measurement,
    beam_test: UniformBeamTest | None,
    model_check: ModelCheck,
) -> Headline:
    """Add the modal model and the estimates with tolerance to the headline for a uniform beam.

    Return `exact_headline` if there is no modal model.
    """
    if model_check.modal_fit is None or beam_test is None:
        return exact_headline
    estimate_with_tolerance = None
    if measurement.axis_tilt_deg:
        exact_headline = exact_headline.with_flag_on_all(TILTED_AXIS_REASON)
    if measurement.uniformity or beam_test.status == "refused" or measurement.axis_tilt_deg:
        estimate_with_tolerance = tolerant_estimate(
            model_check.modal_fit,
            measurement.nominal_plant,
            measurement.uniformity,
            measurement.axis_tilt_deg,
            is_uniform=beam_test.status != "refused",
        )
    return replace_by_modal_model(
        exact_headline,
        model_check.modal_fit,
        beam_test,
        estimate_with_tolerance,
        model_check.doubt_reason,
        model_check.mode_doubt_reason,
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
        measurement,
        lambda measurement_with_impacts: _fit_freest_with_known_impacts(
            measurement_with_impacts, band_hz
        ),
    ).result


def _fit_freest_with_known_impacts(
    measurement: Measurement, band_hz: tuple[float, float]
) -> _Assessment[tuple[Headline, tuple[Finding, ...], RecordAnalysis]]:
    """Fit the structure with most free parameters, with the impacts that the measurement states."""
    misread_findings = tuple(
        sign_and_unit_findings(Comparison.from_measurement(measurement, band_hz))
    )
    additional_structures = () if misread_findings else (ORDER_ONE_STRUCTURE,)
    candidate_set = replace(
        CandidateSet.fit_freest_structure(measurement, (), band_hz, additional_structures),
        misread_findings=misread_findings,
    )
    if not misread_findings:
        candidate_set = candidate_set.fit_special_cases()
    modal_fit, modes_with_drag = fit_modal_model(candidate_set), None
    modes_changed_by_drag: tuple[int, ...] = ()
    if modal_fit is not None and not measurement.is_single_sweep:
        modes_with_drag, modes_changed_by_drag = fit_drag_with_modes(
            candidate_set, modal_fit, max_computations=_ONLINE_DRAG_COMPUTATIONS
        )
    if modes_with_drag is not None:
        modal_fit = modes_with_drag.modal_fit
    visible_numbers = visible_mode_numbers(candidate_set, modal_fit)
    model_check = ModelCheck.of_candidates(candidate_set, modal_fit, band_hz)
    reported_headline = headline_of_fit(
        candidate_set.best.name,
        candidate_set.best.fit,
        visible_numbers,
        {} if misread_findings else _unidentifiable_orders(candidate_set, visible_numbers),
        unexplained_reason=model_check.model_rejection_reason,
        fit_with_both_dampings=None
        if misread_findings
        else candidate_set.fit_with_both_dampings(candidate_set.best),
    )
    beam_test = _uniform_beam_test(measurement, modal_fit)
    reported_headline = _add_modal_model(reported_headline, measurement, beam_test, model_check)
    reported_headline = flag_modes_changed_by_drag(reported_headline, modes_changed_by_drag)
    all_findings = model_check.reported_findings(
        reported_headline, () if modes_with_drag is None else (modes_with_drag.finding(),)
    )
    if model_check.clipped_torque_reason is not None:
        reported_headline = reported_headline.with_flag_on_all(model_check.clipped_torque_reason)
    other_fits = (
        candidate.fit
        for candidate in candidate_set.candidates
        if candidate.structure is ORDER_ONE_STRUCTURE
    )
    record_analysis = RecordAnalysis.from_fits(
        (reported_headline.fit, *other_fits), candidate_set.noise, candidate_set.comparison
    )
    return _Assessment((reported_headline, all_findings, record_analysis), model_check)


def _unidentifiable_orders(
    candidate_set: CandidateSet, visible_numbers: tuple[int, ...]
) -> dict[str, str]:
    """Return the reason why each undetermined damping order is not determined, by order name.

    The orders are those of the fit with most free parameters.
    """
    freest_candidate, *other_candidates = candidate_set.candidates
    common_reason = not_reported_reason(candidate_set, visible_numbers)
    order_reasons = {}
    for order_name in COEFFICIENT_OF.keys() & set(freest_candidate.structure.free):
        low, high = freest_candidate.fit.interval[order_name] or (-math.inf, math.inf)
        is_interval_too_wide = high - low > MAX_IDENTIFIABLE_FRACTION * (
            ORDER_RANGE[1] - ORDER_RANGE[0]
        )
        # A narrow interval without 1, although order 1 fits as well, is that of a local minimum.
        has_other_minimum = not low <= 1 <= high and any(
            other_candidate.structure.fixed.get(order_name) == 1.0
            and other_candidate.deviance - freest_candidate.deviance < NORMAL_95**2
            for other_candidate in other_candidates
        )
        if (
            common_reason
            or is_interval_too_wide
            or has_other_minimum
            or freest_candidate.fit.interval[COEFFICIENT_OF[order_name]] is None
        ):
            order_reasons[order_name] = common_reason or ORDER_NOT_DETERMINED_REASON
    return order_reasons


def _candidate_table(candidate_set: CandidateSet) -> tuple[CandidateRow, ...]:
    """Return the table of candidates: cost, BIC and AIC of each, the lowest BIC first."""
    best_candidate, least_aic = candidate_set.best, min(c.aic for c in candidate_set.candidates)
    return tuple(
        CandidateRow(
            structure=c.structure.name,
            parameters=c.parameter_count,
            cost=c.fit.cost,
            delta_bic=c.bic - best_candidate.bic,
            delta_aic=c.aic - least_aic,
        )
        for c in candidate_set.candidates
    )
