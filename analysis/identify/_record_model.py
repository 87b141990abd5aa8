"""Model that explains a record: the modal model, with the effects that it needs in addition.

Effects are tried in the order of their cost. A linear beam that does not change suffices for most
records. Small nonlinear effects and drag of unknown size are torque spectra in addition to the
modes, so that they bias no mode. If these do not suffice, large drag, nonlinear forces and changes
along the record are fitted with the beam.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._drag import refit_with_air_drag, small_drag_spectrum
from analysis.identify._modal_fit import fit_modes
from analysis.identify._modes_with_drag import fit_modes_with_drag, mode_numbers_changed_by_drag
from analysis.identify._nonlinear import add_nonlinear_forces
from analysis.identify._small_effects import LARGE_EFFECT_DEVIANCE_REDUCTION, likeliest_small_effect
from analysis.identify._step_in_time import best_stiffness_step
from analysis.identify._time_varying import find_temporal_changes
from analysis.identify._visible_modes import visible_modes
from analysis.identify.residual_tests import harmonics, input_relation, whiteness
from rigd.beam import clamped_free_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._estimates import ModeEstimate
    from analysis.identify._finding import Finding
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._modes_with_drag import ModesWithDrag
    from analysis.identify._nonlinear import NonlinearForce
    from analysis.identify._small_effects import SmallEffect
    from analysis.identify._step_in_time import StiffnessStep
    from analysis.identify._time_varying import TemporalChange
    from analysis.identify.residual_tests import Harmonic, InputRelation, Whiteness

_ROUGH_DAMPING_RATIO: Final = 0.01
"""Damping ratio from which the search for a mode begins if no beam provides one."""


@dataclass(frozen=True, slots=True)
class ResidualTests:
    """Tests of the residual of a model.

    Attributes
    ----------
    whiteness : Whiteness
        Test of whether the residual is white.
    input_relation : InputRelation
        Test of whether the residual follows the angle.
    harmonics : tuple of Harmonic
        Residual at multiples of the sweep's frequency.
    """

    whiteness: Whiteness
    input_relation: InputRelation
    harmonics: tuple[Harmonic, ...]

    @property
    def is_noise(self) -> bool:
        """Return whether the residual is white and does not follow the angle."""
        return self.whiteness.is_white and not self.input_relation.related


def test_residual(
    candidate_set: CandidateSet, modal_fit: ModalFit | None, band_hz: tuple[float, float]
) -> ResidualTests:
    """Test whether the residual is white, follows the angle, or has harmonics of the sweep.

    The residual is that of the modal model or, if that is None, of the first candidate.
    """
    comparison, compared_bins = candidate_set.comparison, candidate_set.noise.is_compared
    modal_residual = candidate_set.best.fit.residual if modal_fit is None else modal_fit.residual
    angle_rad = comparison.angle_rad[comparison.retained_samples]
    unit_variance_residual = comparison.to_time_series(modal_residual) * math.sqrt(
        comparison.sample_count / 2
    )
    harmonic_tests = harmonics(
        angle_rad, unit_variance_residual, comparison.decimation.rate_hz, band_hz
    )
    if modal_fit is not None:
        return ResidualTests(modal_fit.whiteness, modal_fit.input_relation, harmonic_tests)
    return ResidualTests(
        whiteness(modal_residual[compared_bins], comparison.frequency_hz[compared_bins]),
        input_relation(modal_residual, comparison.spectrum(angle_rad), comparison.frequency_hz),
        harmonic_tests,
    )


@dataclass(frozen=True, slots=True, eq=False)
class RecordModel:
    """Modal model of a record, and the effects that were found in addition to it.

    Attributes
    ----------
    linear_candidates : CandidateSet
        Candidates without drag and other effects.
    linear_fit : ModalFit or None
        Modal model without any effect; None if no mode is visible.
    candidate_set : CandidateSet
        Candidates with the effects.
    modal_fit : ModalFit or None
        Modal model with the effects.
    explains_record : bool
        Whether the residual of `modal_fit` is noise without harmonics of the sweep.
    small_effect : SmallEffect or None
        Small nonlinear effect that is fitted with the modes.
    modes_with_drag : ModesWithDrag or None
        Modes with drag of unknown size.
    nonlinear_forces : tuple of NonlinearForce
        Nonlinear forces that are fitted with the beam.
    temporal_changes : tuple of TemporalChange
        Changes along the record; the first is the likeliest.
    stiffness_step : StiffnessStep or None
        Step of the stiffness in time that may explain the residual.
    modes_changed_by_drag : tuple of int
        Modes whose damping ratio depends on a drag that was not accepted.
    """

    linear_candidates: CandidateSet
    linear_fit: ModalFit | None
    candidate_set: CandidateSet
    modal_fit: ModalFit | None
    explains_record: bool
    small_effect: SmallEffect | None = None
    modes_with_drag: ModesWithDrag | None = None
    nonlinear_forces: tuple[NonlinearForce, ...] = ()
    temporal_changes: tuple[TemporalChange, ...] = ()
    stiffness_step: StiffnessStep | None = None
    modes_changed_by_drag: tuple[int, ...] = ()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return the findings on the effects that are fitted with the modes."""
        effects = (self.small_effect, self.modes_with_drag)
        return tuple(effect.finding() for effect in effects if effect is not None)


def fit_linear_model(linear_candidates: CandidateSet, band_hz: tuple[float, float]) -> RecordModel:
    """Fit the modal model of a record, with a small effect and drag if the record suggests them.

    The candidates remain those without effects.
    """
    linear_fit = fit_modal_model(linear_candidates)
    if linear_fit is None:
        return RecordModel(linear_candidates, None, linear_candidates, None, explains_record=False)
    if not linear_fit.determines_response:  # nor would it determine an effect
        return RecordModel(
            linear_candidates, linear_fit, linear_candidates, linear_fit,
            explains_record=_explains_record(linear_candidates, linear_fit, band_hz),
        )  # fmt: skip
    is_single_sweep = linear_candidates.comparison.measurement.is_single_sweep
    drag_spectrum = _small_drag_spectra(linear_candidates, linear_fit)
    likeliest_effect = likeliest_small_effect(
        linear_candidates.comparison,
        linear_fit,
        linear_fit.plant_with_modal_frequencies(linear_candidates.likeliest_fit.plant),
        drag_spectrum,
    )
    modes_with_drag, changed_by_drag = None, tuple[int, ...]()
    # In a single sweep another effect, or large drag, has a model of its own.
    if (
        likeliest_effect is None
        or not is_single_sweep
        or (likeliest_effect.kind == "air drag" and not likeliest_effect.is_large)
    ):
        modes_with_drag, changed_by_drag = _drag_fit_or_doubtful_modes(
            linear_fit,
            fit_modes_with_drag(linear_candidates, linear_fit, drag_spectrum),
            lambda modal_fit: _explains_record(linear_candidates, modal_fit, band_hz),
        )
    if modes_with_drag is None:
        modal_fit = linear_fit
        explains_record = _explains_record(linear_candidates, linear_fit, band_hz)
    else:
        modal_fit, explains_record = modes_with_drag.modal_fit, True
        if likeliest_effect is not None and (
            likeliest_effect.kind == "air drag"
            or not likeliest_effect.has_significant_amplitude_in(modal_fit)
        ):
            likeliest_effect = None
    model = RecordModel(
        linear_candidates, linear_fit, linear_candidates, modal_fit, explains_record,
        modes_with_drag=modes_with_drag,
        modes_changed_by_drag=changed_by_drag,
    )  # fmt: skip
    return (
        model if likeliest_effect is None else _add_small_effect(model, likeliest_effect, band_hz)
    )


def add_further_effects(model: RecordModel, band_hz: tuple[float, float]) -> RecordModel:
    """Add large effects if small ones do not explain the record, and fit the candidates with them.

    `model` is the result of `fit_linear_model`.
    """
    is_small_effect_large = model.small_effect is not None and model.small_effect.is_large
    if model.explains_record and not is_small_effect_large:
        return _fit_candidates(model)
    is_single_sweep = model.linear_candidates.comparison.measurement.is_single_sweep
    if model.linear_fit is not None and is_single_sweep:
        stiffness_step = _likely_stiffness_step(model, model.linear_fit)
        if stiffness_step is not None:
            model = replace(
                model,
                modal_fit=model.linear_fit,
                small_effect=None,
                stiffness_step=stiffness_step,
                explains_record=_explains_record(
                    model.linear_candidates, model.linear_fit, band_hz
                ),
            )
            if model.explains_record:
                return _fit_candidates(model)
    candidate_set, nonlinear_forces, temporal_changes = _fit_further_effects(
        model.linear_candidates, test_amplitude_effects=model.stiffness_step is None
    )
    modal_fit = fit_modal_model(candidate_set)
    # A small effect that explains the record is replaced only by effects that do so, too.
    if (
        model.explains_record
        and _explains_record(model.linear_candidates, model.modal_fit, band_hz)
        and not _explains_record(candidate_set, modal_fit, band_hz)
    ):
        return model
    return replace(
        model,
        candidate_set=candidate_set,
        modal_fit=modal_fit,
        small_effect=None,
        nonlinear_forces=nonlinear_forces,
        temporal_changes=temporal_changes,
    )


def fit_drag_with_modes(
    candidate_set: CandidateSet, modal_fit: ModalFit, *, max_computations: int
) -> tuple[ModesWithDrag | None, tuple[int, ...]]:
    """Return the modes fitted with drag if these explain the record, else None.

    Return also the modes whose damping ratio depends on a drag that is not accepted. Candidates and
    modes are those without drag. The drag torque is computed at most `max_computations` times.
    """
    modes_with_drag = fit_modes_with_drag(
        candidate_set,
        modal_fit,
        _small_drag_spectra(candidate_set, modal_fit),
        max_computations=max_computations,
    )
    return _drag_fit_or_doubtful_modes(
        modal_fit, modes_with_drag, lambda fit_with_drag: fit_with_drag.residual_is_noise
    )


def _drag_fit_or_doubtful_modes(
    modal_fit: ModalFit,
    modes_with_drag: ModesWithDrag | None,
    does_explain_record: Callable[[ModalFit], bool],
) -> tuple[ModesWithDrag | None, tuple[int, ...]]:
    """Return the modes with drag if they explain the record, else None and the modes in doubt.

    The modes in doubt are the numbers of those whose damping ratio depends on the drag.
    """
    if modes_with_drag is None:
        return None, ()
    if modes_with_drag.has_converged and does_explain_record(modes_with_drag.modal_fit):
        return modes_with_drag, ()
    return None, mode_numbers_changed_by_drag(modal_fit, modes_with_drag.modal_fit)


def fit_modal_model(
    candidate_set: CandidateSet, added_spectra: NDArray[np.complex128] | None = None
) -> ModalFit | None:
    """Fit the modal model to the record of a candidate set, or return None if no mode is visible.

    `added_spectra`, shape (c, K), are torque spectra of unknown size in addition to those of the
    candidates.
    """
    if candidate_set.misread_findings:
        return None
    mode_starts = _mode_starts(candidate_set.likeliest_fit.modes)
    torque_spectra = candidate_set.effect_spectra
    if added_spectra is not None:
        torque_spectra = np.concatenate([torque_spectra, added_spectra])
    return fit_modes(candidate_set.comparison, candidate_set.noise, mode_starts, torque_spectra)


def _mode_starts(modes: Iterable[ModeEstimate]) -> list[tuple[int, float, float]]:
    """Return number, frequency in hertz and damping ratio of each mode, as starts of a search.

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
            oscillating_modes.values(),
            key=lambda mode_estimate: abs(mode_estimate.number - mode_number),
        )
        frequency_ratio = (
            beam_eigenvalues[mode_number - 1] / beam_eigenvalues[nearest_mode.number - 1]
        ) ** 2
        mode_starts.append(
            (mode_number, nearest_mode.frequency_hz * frequency_ratio, _ROUGH_DAMPING_RATIO)
        )
    return mode_starts


def _explains_record(
    candidate_set: CandidateSet, modal_fit: ModalFit | None, band_hz: tuple[float, float]
) -> bool:
    """Return whether the residual of the modal model is noise without harmonics of the sweep.

    Then no further effect need be tested.
    """
    if modal_fit is None:
        return False
    residual_tests = test_residual(candidate_set, modal_fit, band_hz)
    return modal_fit.residual_is_noise and not any(
        each.present for each in residual_tests.harmonics
    )


def _small_drag_spectra(candidate_set: CandidateSet, modal_fit: ModalFit) -> NDArray[np.complex128]:
    """Return the torque spectrum of a small drag on a beam with the fitted modes, shape (K,)."""
    plant = modal_fit.uniform_plant(candidate_set.comparison.measurement.nominal_plant)
    drag_spectra = small_drag_spectrum(candidate_set.comparison, plant, modal_fit)
    return np.asarray(drag_spectra[0])


def _add_small_effect(
    model: RecordModel, effect: SmallEffect, band_hz: tuple[float, float]
) -> RecordModel:
    """Fit a small effect together with the modes, and with the drag if there is any."""
    modal_fit = (
        fit_modal_model(model.linear_candidates, effect.torque_spectrum[None])
        if model.modes_with_drag is None
        else model.modes_with_drag.fit_with_effect(model.linear_candidates, effect.torque_spectrum)
    )
    return replace(
        model,
        modal_fit=modal_fit,
        small_effect=effect,
        explains_record=model.explains_record
        or _explains_record(model.linear_candidates, modal_fit, band_hz),
    )


def _fit_candidates(model: RecordModel) -> RecordModel:
    """Refit the candidates with the drag of the model, or with its small effect if it is large."""
    linear_candidates, modes_with_drag = model.linear_candidates, model.modes_with_drag
    if modes_with_drag is not None:
        # Drag is known now, and so is the part of the angle that follows the reference.
        comparison = modes_with_drag.comparison.use_reference_coherent_angle(
            modes_with_drag.modal_fit.model
        )
        candidates_with_drag = replace(linear_candidates, comparison=comparison)
        return replace(
            model,
            candidate_set=candidates_with_drag.refit_with_additional_effect(
                modes_with_drag.drag_spectra
            ),
        )
    effect = model.small_effect
    if effect is None or effect.deviance_reduction <= LARGE_EFFECT_DEVIANCE_REDUCTION:
        return model
    candidate_set = linear_candidates.refit_with_additional_effect(effect.torque_spectrum[None])
    return replace(model, candidate_set=candidate_set, modal_fit=fit_modal_model(candidate_set))


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
        linear_candidates
        if linear_candidates.misread_findings
        else refit_with_air_drag(linear_candidates)
    )
    visible_numbers = visible_modes(
        linear_candidates.comparison, linear_candidates.noise, linear_candidates.best.fit
    )
    candidate_set, nonlinear_forces = (
        (candidate_set, ())
        if candidate_set.misread_findings
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


def _likely_stiffness_step(model: RecordModel, linear_fit: ModalFit) -> StiffnessStep | None:
    """Return the step of the stiffness in time that best explains the residual.

    Return None if the small nonlinear effect explains more.
    """
    stiffness_step = best_stiffness_step(model.linear_candidates.comparison, linear_fit)
    rival_deviance_reduction = (
        0.0 if model.small_effect is None else model.small_effect.deviance_reduction
    )
    is_likeliest = stiffness_step.score > max(
        rival_deviance_reduction, LARGE_EFFECT_DEVIANCE_REDUCTION
    )
    return stiffness_step if is_likeliest else None
