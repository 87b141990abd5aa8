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
    small_drag_spectrum,
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
from analysis.identify._modes_with_drag import fit_modes_with_drag
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
from analysis.models import ORDER_RANGE, STRUCTURES
from analysis.statistics import NORMAL_95
from rigd.beam import COEFFICIENT_OF, clamped_free_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._data import Measurement
    from analysis.identify._estimates import ModeEstimate
    from analysis.identify._finding import Finding
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._nonlinear import NonlinearForce
    from analysis.identify._result import RecordFit
    from analysis.identify._settings import Setting
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


_ONLINE_DRAG_COMPUTATIONS: Final = 3
"""Number of computations of the drag torque in a fit of the freest structure alone, which a running
session repeats."""

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
        """Return the fit of a beam to the record whose parameter values are reported."""
        return self.headline.fit

    @property
    def determined(self) -> frozenset[Order]:
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
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
    earlier: Selection | None = None,
) -> Selection:
    """Select the model of beam and damping that a record supports, and report its parameters.

    The modal model is fitted to the record without hum, impacts and gaps. Its modes are reported.
    If its residual is noise, the beam is linear and constant. Otherwise drag, nonlinear forces,
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
    """Result of the model selection on one record, with the fitted candidates it is based on.

    A candidate is one structure of beam and damping, fitted to the record.

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
    measurement: Measurement, assess_measurement: Callable[[Measurement], _Assessment[_ResultT]]
) -> _Assessment[_ResultT]:
    """Select the model of a record, and again with each impact that may explain its residual.

    `assess_measurement` is the selection for a measurement whose known impacts are fitted. Return
    the last result that was improved by an impact.
    """
    assessment = assess_measurement(measurement)
    for _ in range(MAX_IMPACTS):
        if assessment.explained or not _KINDS_AGAINST_IMPACT_SEARCH.isdisjoint(assessment.kinds):
            break
        better_assessment = None
        # Harmonics last through the whole sweep, but a strong impact may be mistaken for them.
        for impact in find_impacts(
            assessment.candidate_set, obvious="harmonics" in assessment.kinds
        ):
            impact_assessment = assess_measurement(
                add_known_impact(assessment.candidate_set.comparison.measurement, impact)
            )
            if impact_assessment.explained or impact.evident:
                better_assessment = impact_assessment
            if impact_assessment.explained:
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
    """Select the structure of a record. The impacts that the measurement states are fitted, too."""
    earlier_candidates = earlier.linear_candidates if earlier else ()
    refitted_candidates = (
        CandidateSet.refit_from_earlier(earlier_candidates, measurement, fixed, band_hz)
        if earlier_candidates
        else None
    )
    linear_candidates = refitted_candidates or CandidateSet.of(measurement, fixed, band_hz)
    modal_fit = _fit_modal_model(linear_candidates)
    candidate_set, small_linear_effect = linear_candidates, None
    nonlinear_forces: tuple[NonlinearForce, ...] = ()
    temporal_changes: tuple[TemporalChange, ...] = ()
    is_linear_and_constant = modal_fit is not None and _is_linear_and_constant(
        linear_candidates, modal_fit, band_hz
    )
    modes_with_drag = None
    if modal_fit is not None:
        plant = modal_fit.plant_with_modal_frequencies(linear_candidates.likeliest.plant)
        [drag_spectrum] = small_drag_spectrum(
            linear_candidates.comparison, plant, modal_fit.poles_rad_s
        )
        small_linear_effect = small_effect(
            linear_candidates.comparison, modal_fit, plant, drag_spectrum
        )
        # In a single sweep another effect, or large drag, has a model of its own.
        if (
            small_linear_effect is None
            or not measurement.is_single_sweep
            or (small_linear_effect.kind == "air drag" and not small_linear_effect.large)
        ):
            modes_with_drag = fit_modes_with_drag(linear_candidates, modal_fit, drag_spectrum)
    modal_fit_with_effect, small_effect_suffices = modal_fit, is_linear_and_constant
    if modes_with_drag is not None and _is_linear_and_constant(
        linear_candidates, modes_with_drag.modal_fit, band_hz
    ):
        is_linear_and_constant, modal_fit_with_effect = True, modes_with_drag.modal_fit
        if small_linear_effect is not None and (
            small_linear_effect.kind == "air drag"
            or not small_linear_effect.significant_with(modes_with_drag.modal_fit)
        ):
            small_linear_effect = None
    else:
        modes_with_drag = None
    if small_linear_effect is not None:
        modal_fit_with_effect = (
            _fit_modal_model(linear_candidates, small_linear_effect.column[None])
            if modes_with_drag is None
            else modes_with_drag.fit_with_effect(linear_candidates, small_linear_effect.column)
        )
        small_effect_suffices = modal_fit_with_effect is not None and _is_linear_and_constant(
            linear_candidates, modal_fit_with_effect, band_hz
        )
    if not (is_linear_and_constant or small_effect_suffices or measurement.knocks):
        for impact in find_impacts(linear_candidates, obvious=True):
            impact_assessment = _select_with_known_impacts(
                add_known_impact(measurement, impact), fixed, band_hz, None
            )
            if impact_assessment.explained:
                return impact_assessment
    needs_further_effects = not (is_linear_and_constant or small_effect_suffices) or (
        small_linear_effect is not None and small_linear_effect.large
    )
    stiffness_step = None
    if needs_further_effects and modal_fit is not None and measurement.is_single_sweep:
        stiffness_step = _likely_stiffness_step(linear_candidates, modal_fit, small_linear_effect)
        if stiffness_step is not None:
            small_linear_effect, modal_fit_with_effect = None, modal_fit
            small_effect_suffices = is_linear_and_constant
            needs_further_effects = not is_linear_and_constant
    if needs_further_effects:
        candidate_set, nonlinear_forces, temporal_changes = _fit_further_effects(
            linear_candidates, test_amplitude_effects=stiffness_step is None
        )
        modal_fit = _fit_modal_model(candidate_set)
        if small_effect_suffices and not (
            modal_fit is not None and _is_linear_and_constant(candidate_set, modal_fit, band_hz)
        ):
            candidate_set, nonlinear_forces, temporal_changes, modal_fit = (
                linear_candidates,
                (),
                (),
                modal_fit_with_effect,
            )
        else:
            small_linear_effect = None
    elif modes_with_drag is not None:
        modal_fit = modal_fit_with_effect
        candidate_set = replace(
            linear_candidates, comparison=modes_with_drag.comparison
        ).refit_with_additional_effect(modes_with_drag.drag_spectra)
    elif small_linear_effect is not None and small_linear_effect.saved > LARGE_DEVIANCE_REDUCTION:
        candidate_set = linear_candidates.refit_with_additional_effect(
            small_linear_effect.column[None]
        )
        modal_fit = _fit_modal_model(candidate_set)
    else:
        modal_fit = modal_fit_with_effect
    candidate_set = candidate_set.fit_with_free_orders()
    visible_numbers = _visible_mode_numbers(candidate_set, modal_fit)
    beam_test = _uniform_beam_test(measurement, modal_fit)
    uniform_beam_refused = beam_test is not None and beam_test.status == "refused"
    # A local minimum that a part of the record excludes is excluded by the whole record.
    determined_orders = earlier.determined if earlier and refitted_candidates else ()
    should_compute_profiles = (
        not_reported_reason(candidate_set, visible_numbers) is None and not uniform_beam_refused
    )
    candidate_set, *order_profiles = profile_both_orders(
        candidate_set, determined_orders, compute=should_compute_profiles
    )
    leading_candidates = candidate_set.with_leading_candidate(candidate_set.freest)
    whiteness_test, input_test, harmonic_tests = _test_residual(
        leading_candidates, modal_fit, band_hz
    )
    residual_explained = whiteness_test.white and not input_test.related
    all_findings = findings(leading_candidates, nonlinear_forces, harmonic_tests)
    finding_kinds = {finding.kind for finding in all_findings}
    model_reason = _wrong_model_reason(finding_kinds, residual_explained=residual_explained)
    clipped_reason = _CLIPPED_TORQUE_REASON if "clipping" in finding_kinds else None
    doubt_reason = (
        model_reason
        or clipped_reason
        or _doubt_reason(temporal_changes, is_single_sweep=measurement.is_single_sweep)
    )
    alpha_verdict, lambda_verdict = (
        order_verdict(candidate_set, each, visible_numbers, doubt_reason=doubt_reason)
        for each in order_profiles
    )
    order_verdicts, close_rivals = (alpha_verdict, lambda_verdict), rivals(candidate_set, BIC_TIE)
    reported_headline = headline(
        candidate_set, order_verdicts, visible_numbers, unexplained=model_reason
    )
    if doubt_reason is not None:
        reported_headline = reported_headline.doubted(doubt_reason)
    # With a fitted change the modes are those at the middle of the record.
    mode_doubt_reason = (
        doubt_reason
        if temporal_changes and temporal_changes[0].certain
        else model_reason or clipped_reason
    )
    reported_headline = _add_modal_model(
        reported_headline, measurement, modal_fit, beam_test, doubt_reason, mode_doubt_reason
    )
    if reported_headline.tolerant is not None:
        alpha_verdict, lambda_verdict = (
            order_verdict_with_geometry_tolerance(
                each.order,
                reported_headline.tolerant,
                each,
                doubt_reason,
                refused=uniform_beam_refused,
            )
            for each in order_profiles
        )
        order_verdicts = alpha_verdict, lambda_verdict
    if "nonlinear stiffness" in finding_kinds:
        reported_headline = reported_headline.with_stiffness_law_flag()
    verdict_sentences, experiment_texts = [], []
    if model_reason == CONTRADICTED_FILE_REASON:
        all_findings = tuple(each for each in all_findings if each.kind in _CHANNEL_KINDS)
    else:
        change_findings = tuple(
            temporal_change_findings(temporal_changes, is_single_sweep=measurement.is_single_sweep)
        )
        all_findings += _setting_findings(leading_candidates, reported_headline, finding_kinds)
        all_findings += () if small_linear_effect is None else (small_linear_effect.finding(),)
        all_findings += () if modes_with_drag is None else (modes_with_drag.finding(),)
        if (
            modal_fit is not None
            and beam_test is not None
            and uniform_beam_refused
            and model_reason is None
        ):
            all_findings += _explain_deviations(
                measurement, leading_candidates, modal_fit, beam_test
            )
        all_findings = _mark_doubtful_findings(
            all_findings,
            change_findings,
            model_reason,
            doubt_reason,
            reported_headline.flags,
            only_harmonics_remain=residual_explained,
        )
        all_findings = _add_impacts_and_unexplained(
            leading_candidates, all_findings, whiteness_test, input_test, stiffness_step
        )
        verdict_sentences = headline_sentences(
            reported_headline, order_verdicts, without_rival=doubt_reason is None
        )
        experiment_texts = experiments(
            candidate_set, order_verdicts, visible_numbers, all_findings, close_rivals
        )
    experiment_texts += [each.remedy for each in all_findings if each.remedy]
    best_candidate = candidate_set.best
    selection = Selection(
        candidates=candidate_set.candidates,
        linear_candidates=linear_candidates.candidates,
        headline=reported_headline,
        analysis=RecordAnalysis.of(
            (c.fit for c in candidate_set.candidates), candidate_set.noise, candidate_set.comparison
        ),
        verdict=Verdict(
            name=measurement.name,
            structure=best_candidate.structure.name,
            rivals=tuple(c.name for c in close_rivals),
            parameters={
                k: q.value for k, q in reported_headline.parameters.items() if q.flag is None
            },
            adequate=model_reason is None,
            alpha=alpha_verdict,
            lambda_=lambda_verdict,
            visible_modes=visible_numbers,
            findings=all_findings,
            table=_candidate_table(candidate_set),
            whiteness=whiteness_test,
            input_relation=input_test,
            harmonics=harmonic_tests,
            sentences=(*verdict_sentences, *(each.sentence for each in all_findings)),
            experiments=tuple(dict.fromkeys(experiment_texts)),
            damping_with_amplitude=damping_with_amplitude(leading_candidates),
        ),
    )
    return _Assessment(selection, leading_candidates, residual_explained, finding_kinds)


def _fit_modal_model(
    candidate_set: CandidateSet, added_spectra: NDArray[np.complex128] | None = None
) -> ModalFit | None:
    """Fit the modal model to the record of a candidate set, or return None if no mode is visible.

    `added_spectra`, shape (c, K), are torque spectra of unknown size in addition to those of the
    candidates.
    """
    if candidate_set.misread:
        return None
    mode_starts = _mode_starts(candidate_set.likeliest.modes)
    torque_spectra, drag_expansion = candidate_set.columns, candidate_set.comparison.drag
    if added_spectra is not None:
        torque_spectra = np.concatenate([torque_spectra, added_spectra])
    if drag_expansion is not None:  # the size of the drag is not known exactly
        torque_spectra = np.concatenate([torque_spectra, drag_expansion.by_law])
    return fit_modes(candidate_set.comparison, candidate_set.noise, mode_starts, torque_spectra)


def _mode_starts(modes: Iterable[ModeEstimate]) -> list[tuple[int, float, float]]:
    """Return number, frequency in hertz and damping ratio at which the search for a mode starts.

    A beam that fits badly may have an overdamped mode below one that oscillates. The search for the
    overdamped mode starts at the frequency ratio of a uniform beam.
    """
    oscillating_modes = {mode.number: mode for mode in modes if mode.frequency_hz > 0}
    if not oscillating_modes:
        return []
    mode_numbers = range(1, max(oscillating_modes) + 1)
    beam_eigenvalues = clamped_free_eigenvalues(len(mode_numbers)).tolist()
    mode_starts = []
    for mode_number in mode_numbers:
        mode = oscillating_modes.get(mode_number)
        if mode is not None:
            mode_starts.append((mode_number, mode.frequency_hz, mode.damping_ratio))
            continue
        nearest_mode = min(
            oscillating_modes.values(), key=lambda each: abs(each.number - mode_number)
        )
        frequency_ratio = (
            beam_eigenvalues[mode_number - 1] / beam_eigenvalues[nearest_mode.number - 1]
        ) ** 2
        mode_starts.append(
            (mode_number, nearest_mode.frequency_hz * frequency_ratio, _ROUGH_DAMPING_RATIO)
        )
    return mode_starts


def _visible_mode_numbers(
    candidate_set: CandidateSet, modal_fit: ModalFit | None
) -> tuple[int, ...]:
    """Return the numbers of the beam modes that are visible in a record, from 1."""
    if modal_fit is None:
        return visible_modes(candidate_set.comparison, candidate_set.noise, candidate_set.best.fit)
    return modal_fit.visible


def _add_modal_model(
    exact_headline: Headline,
    measurement: Measurement,
    modal_fit: ModalFit | None,
    uniform_beam_result: UniformBeamTest | None,
    doubt_reason: str | None,
    mode_doubt_reason: str | None,
) -> Headline:
    """Add the modal model and the estimates with tolerance to the headline of a uniform beam.

    Return `exact_headline` if there is no modal model. `doubt_reason` is the reason against every
    number, and `mode_doubt_reason` the reason against every mode. They are None if there is no such
    reason.
    """
    if modal_fit is None or uniform_beam_result is None:
        return exact_headline
    estimate_with_tolerance = None
    if measurement.axis_tilt_deg:
        exact_headline = exact_headline.doubted(_TILTED_AXIS_REASON)
    if (
        measurement.uniformity
        or uniform_beam_result.status == "refused"
        or measurement.axis_tilt_deg
    ):
        estimate_with_tolerance = tolerant_estimate(
            modal_fit, measurement.nominal, measurement.uniformity, measurement.axis_tilt_deg
        )
    return replace_by_modal_model(
        exact_headline,
        modal_fit,
        uniform_beam_result,
        estimate_with_tolerance,
        doubt_reason,
        mode_doubt_reason,
    )


def _uniform_beam_test(
    measurement: Measurement, modal_fit: ModalFit | None
) -> UniformBeamTest | None:
    """Test whether a uniform beam predicts the measured modes. Return None without modal model."""
    if modal_fit is None:
        return None
    return uniform_beam_test(modal_fit, measurement.nominal, measurement.axis_tilt_deg)


def _explain_deviations(
    measurement: Measurement,
    candidate_set: CandidateSet,
    modal_fit: ModalFit,
    beam_test: UniformBeamTest,
) -> tuple[Finding, ...]:
    """Return a finding that names simple causes of the deviations from a uniform beam.

    Return no finding with only two modes, which leave no degree of freedom for this test.
    """
    if len(modal_fit.visible) <= _MODES_WITHOUT_REDUNDANCY:
        return ()
    deviation_causes = explanations(modal_fit, measurement.nominal, measurement.axis_tilt_deg)
    stiffness_step = (
        best_stiffness_step(candidate_set.comparison, modal_fit)
        if measurement.is_single_sweep
        else None
    )
    return (explanation_finding(beam_test, deviation_causes, stiffness_step),)


def _setting_findings(
    candidate_set: CandidateSet, reported_headline: Headline, finding_kinds: Collection[str]
) -> tuple[Finding, ...]:
    """Return findings on fitted settings, such as the delay, that differ from those in the file.

    Return none if the record cannot show such a difference.
    """
    if (
        "implausible" in finding_kinds
        or len(reported_headline.visible_modes) < _MODES_WITHOUT_REDUNDANCY
    ):
        return ()
    return tuple(setting_findings(candidate_set, reported_headline))


def _is_linear_and_constant(
    candidate_set: CandidateSet, modal_fit: ModalFit, band_hz: tuple[float, float]
) -> bool:
    """Return whether the residual of the modal model is noise without harmonics of the sweep.

    Then no nonlinear or time-varying effect need be tested.
    """
    _, _, harmonic_tests = _test_residual(candidate_set, modal_fit, band_hz)
    return modal_fit.explained and not any(
        harmonic_test.present for harmonic_test in harmonic_tests
    )


def _fit_further_effects(
    linear_candidates: CandidateSet, *, test_amplitude_effects: bool
) -> tuple[CandidateSet, tuple[NonlinearForce, ...], tuple[TemporalChange, ...]]:
    """Test a record for nonlinear and time-varying effects.

    Nonlinear effects are only tested with `test_amplitude_effects`. Return the candidate set with
    the best explanation, its nonlinear forces, and its changes along the record.
    """
    if not test_amplitude_effects:
        candidate_set, temporal_changes = find_temporal_changes(
            linear_candidates.fit_with_free_orders()
        )
        return candidate_set, (), temporal_changes
    candidate_set = (
        linear_candidates if linear_candidates.misread else refit_with_air_drag(linear_candidates)
    )
    visible_numbers = visible_modes(
        linear_candidates.comparison, linear_candidates.noise, linear_candidates.best.fit
    )
    candidate_set, nonlinear_forces = (
        (candidate_set, ())
        if candidate_set.misread
        else add_nonlinear_forces(candidate_set, visible_numbers)
    )
    if nonlinear_forces and candidate_set.drag is not None:
        # A stiffness that depends on the deflection may have been mistaken for weak drag.
        drag_free_candidates, drag_free_forces = add_nonlinear_forces(
            linear_candidates, visible_numbers
        )
        if drag_free_forces and drag_free_candidates.bic < candidate_set.bic:
            candidate_set, nonlinear_forces = drag_free_candidates, drag_free_forces
    candidate_set, temporal_changes = find_temporal_changes(candidate_set.fit_with_free_orders())
    is_single_sweep = linear_candidates.comparison.measurement.is_single_sweep
    if not is_single_sweep and (nonlinear_forces or candidate_set.drag is not None):
        # A change along the record may have been mistaken for a dependence on the amplitude.
        candidates_with_changes, other_changes = find_temporal_changes(
            linear_candidates.fit_with_free_orders(), rival_bic=candidate_set.bic
        )
        if other_changes and candidates_with_changes.bic < candidate_set.bic:
            return candidates_with_changes, (), other_changes
    return candidate_set, nonlinear_forces, temporal_changes


def _likely_stiffness_step(
    linear_candidates: CandidateSet, modal_fit: ModalFit, small_linear_effect: SmallEffect | None
) -> StiffnessStep | None:
    """Return the step of the stiffness in time that best explains the residual.

    Return None if the small nonlinear effect explains more.
    """
    stiffness_step = best_stiffness_step(linear_candidates.comparison, modal_fit)
    rival_deviance_reduction = 0.0 if small_linear_effect is None else small_linear_effect.saved
    return (
        stiffness_step
        if stiffness_step.score > max(rival_deviance_reduction, LARGE_DEVIANCE_REDUCTION)
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
    """Fit the structure with most free parameters, with the impacts that the measurement states."""
    misread_findings = tuple(sign_and_unit_findings(Comparison.of(measurement, band_hz)))
    additional_structures = () if misread_findings else (ORDER_ONE_STRUCTURE,)
    candidate_set = replace(
        CandidateSet.fit_freest_structure(measurement, (), band_hz, additional_structures),
        misread=misread_findings,
    )
    if not misread_findings:
        candidate_set = candidate_set.fit_special_cases()
    modal_fit = _fit_modal_model(candidate_set)
    modes_with_drag = None
    if modal_fit is not None and not measurement.is_single_sweep:
        plant = modal_fit.plant_with_modal_frequencies(candidate_set.likeliest.plant)
        [drag_spectrum] = small_drag_spectrum(
            candidate_set.comparison, plant, modal_fit.poles_rad_s
        )
        modes_with_drag = fit_modes_with_drag(
            candidate_set, modal_fit, drag_spectrum, max_computations=_ONLINE_DRAG_COMPUTATIONS
        )
    if modes_with_drag is not None and modes_with_drag.modal_fit.explained:
        modal_fit = modes_with_drag.modal_fit
    else:
        modes_with_drag = None
    visible_numbers = _visible_mode_numbers(candidate_set, modal_fit)
    whiteness_test, input_test, harmonic_tests = _test_residual(candidate_set, modal_fit, band_hz)
    all_findings = findings(candidate_set, (), harmonic_tests)
    finding_kinds = {finding.kind for finding in all_findings}
    residual_explained = whiteness_test.white and not input_test.related
    model_reason = _wrong_model_reason(finding_kinds, residual_explained=residual_explained)
    reported_headline = headline_of_fit(
        candidate_set.best.name,
        candidate_set.best.fit,
        visible_numbers,
        {} if misread_findings else _unidentifiable_orders(candidate_set, visible_numbers),
        unexplained=model_reason,
        both=None if misread_findings else candidate_set.fit_with_both_dampings(candidate_set.best),
    )
    doubt_reason = model_reason or (_CLIPPED_TORQUE_REASON if "clipping" in finding_kinds else None)
    beam_test = _uniform_beam_test(measurement, modal_fit)
    reported_headline = _add_modal_model(
        reported_headline, measurement, modal_fit, beam_test, doubt_reason, doubt_reason
    )
    if model_reason == CONTRADICTED_FILE_REASON:
        all_findings = tuple(
            candidate for candidate in all_findings if candidate.kind in _CHANNEL_KINDS
        )
    else:
        all_findings += _setting_findings(candidate_set, reported_headline, finding_kinds)
        all_findings += () if modes_with_drag is None else (modes_with_drag.finding(),)
        all_findings = _mark_doubtful_findings(
            all_findings,
            (),
            model_reason,
            doubt_reason,
            reported_headline.flags,
            only_harmonics_remain=residual_explained,
        )
        all_findings = _add_impacts_and_unexplained(
            candidate_set, all_findings, whiteness_test, input_test
        )
    reported_headline = (
        reported_headline.doubted(_CLIPPED_TORQUE_REASON)
        if "clipping" in finding_kinds
        else reported_headline
    )
    other_fits = (
        candidate.fit
        for candidate in candidate_set.candidates
        if candidate.structure is ORDER_ONE_STRUCTURE
    )
    record_analysis = RecordAnalysis.of(
        (reported_headline.fit, *other_fits), candidate_set.noise, candidate_set.comparison
    )
    return _Assessment(
        (reported_headline, all_findings, record_analysis),
        candidate_set,
        residual_explained,
        finding_kinds,
    )


def _unidentifiable_orders(
    candidate_set: CandidateSet, visible_numbers: tuple[int, ...]
) -> dict[str, str]:
    """Return why an order is not determined, for each order that the record does not determine.

    The fit is that of the structure with most free parameters.
    """
    freest_candidate, *other_candidates = candidate_set.candidates
    common_reason = not_reported_reason(candidate_set, visible_numbers)
    order_reasons = {}
    for order_name in COEFFICIENT_OF.keys() & set(freest_candidate.structure.free):
        low, upper_end = freest_candidate.fit.interval[order_name] or (-math.inf, math.inf)
        is_interval_too_wide = upper_end - low > MAX_IDENTIFIABLE_FRACTION * (
            ORDER_RANGE[1] - ORDER_RANGE[0]
        )
        # A narrow interval without 1, although order 1 fits as well, is that of a local minimum.
        has_other_minimum = not low <= 1 <= upper_end and any(
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


def _wrong_model_reason(finding_kinds: Collection[str], *, residual_explained: bool) -> str | None:
    """Return why the findings or the residual refute the fitted model, or None if they do not."""
    if not _CONTRADICTING_KINDS.isdisjoint(finding_kinds):
        return CONTRADICTED_FILE_REASON
    return UNEXPLAINED_REASON if "harmonics" in finding_kinds or not residual_explained else None


def _doubt_reason(
    temporal_changes: tuple[TemporalChange, ...], *, is_single_sweep: bool
) -> str | None:
    """Return why changes along the record make every parameter doubtful, or None if they do not.

    With a change along the record, the mode parameters are those at the time when the sweep passed
    each mode.
    """
    if established(temporal_changes, is_single_sweep=is_single_sweep):
        return None
    return next(
        (
            f"{first_change.name} would explain the record as well"
            for first_change in temporal_changes
        ),
        None,
    )


def _mark_doubtful_findings(
    fitted_findings: tuple[Finding, ...],
    change_findings: tuple[Finding, ...],
    model_reason: str | None,
    doubt_reason: str | None,
    parameter_flags: Mapping[str, str],
    *,
    only_harmonics_remain: bool,
) -> tuple[Finding, ...]:
    """Return all findings, with the doubtful ones marked as not established.

    `fitted_findings` are effects that were fitted with the beam. `change_findings` are changes
    along the record, which already state their certainty. `model_reason` is the reason against the
    model, `doubt_reason` the reason against all numbers, and `parameter_flags` are the reasons
    against single parameters. With `only_harmonics_remain` the finding on harmonics is established.
    """

    def qualified(finding: Finding) -> Finding:
        """Mark a finding as not established if a reason against it exists."""
        parameter_flag = next(
            (
                parameter_flags[parameter_name]
                for parameter_name in finding.parameters
                if parameter_name in parameter_flags
            ),
            None,
        )
        finding_reason = doubt_reason or parameter_flag
        if finding_reason is None or (finding.kind == "harmonics" and only_harmonics_remain):
            return finding
        return doubted(finding, finding_reason)

    fitted_findings = tuple(map(qualified, fitted_findings))
    if model_reason is not None:
        change_findings = tuple(doubted(finding, model_reason) for finding in change_findings)
    return (*fitted_findings, *change_findings)


def _add_impacts_and_unexplained(
    candidate_set: CandidateSet,
    findings_of_model: tuple[Finding, ...],
    whiteness_test: Whiteness,
    input_test: InputRelation,
    stiffness_step: StiffnessStep | None = None,
) -> tuple[Finding, ...]:
    """Return the findings on impacts, those of the model, and that on an unexplained residual."""
    residual_explained = whiteness_test.white and not input_test.related
    findings_of_impacts = impact_findings(
        candidate_set.comparison.measurement.knocks, explained=residual_explained
    )
    unexplained_findings = (
        ()
        if residual_explained
        else (
            unexplained(whiteness_test, input_test, candidate_set.best.fit.modes, stiffness_step),
        )
    )
    return (*findings_of_impacts, *findings_of_model, *unexplained_findings)


def _test_residual(
    candidate_set: CandidateSet, modal_fit: ModalFit | None, band_hz: tuple[float, float]
) -> tuple[Whiteness, InputRelation, tuple[Harmonic, ...]]:
    """Test whether the residual is white, follows the angle, or has harmonics of the sweep.

    This is the residual of the modal model, or that of the first candidate without such a model.
    """
    comparison, compared_bins = candidate_set.comparison, candidate_set.noise.counts
    modal_residual = candidate_set.best.fit.residual if modal_fit is None else modal_fit.residual
    angle_rad = comparison.angle_rad[comparison.retained]
    unit_variance_residual = comparison.in_time(modal_residual) * math.sqrt(comparison.samples / 2)
    harmonic_tests = harmonics(
        angle_rad, unit_variance_residual, comparison.decimation.rate_hz, band_hz
    )
    if modal_fit is not None:
        return modal_fit.whiteness, modal_fit.input_relation, harmonic_tests
    return (
        whiteness(modal_residual[compared_bins], comparison.frequency_hz[compared_bins]),
        input_relation(modal_residual, comparison.spectrum(angle_rad), comparison.frequency_hz),
        harmonic_tests,
    )


def _candidate_table(candidate_set: CandidateSet) -> tuple[CandidateRow, ...]:
    """Return the table of candidates: cost, BIC and AIC of each, the lowest BIC first."""
    best_candidate, least_aic = candidate_set.best, min(c.aic for c in candidate_set.candidates)
    return tuple(
        CandidateRow(
            structure=c.structure.name,
            parameters=c.parameters,
            cost=c.fit.cost,
            delta_bic=c.bic - best_candidate.bic,
            delta_aic=c.aic - least_aic,
        )
        for c in candidate_set.candidates
    )
