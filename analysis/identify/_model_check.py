"""Check of a fitted model against its record: residual, findings, reasons to doubt its numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._diagnostics import findings, setting_findings, unexplained_residual_finding
from analysis.identify._finding import with_doubt
from analysis.identify._impacts import impact_findings
from analysis.identify._record_model import test_residual
from analysis.identify._time_varying import is_single_change_established
from analysis.identify._visible_modes import visible_modes
from analysis.identify.headline import (
    COARSE_ENCODER_REASON,
    CONTRADICTED_FILE_REASON,
    DAMPING_AT_LIMIT_REASON,
    HIDDEN_RESPONSE_REASON,
    UNEXPLAINED_REASON,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._finding import Finding
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._nonlinear import NonlinearForce
    from analysis.identify._record_model import ResidualTests
    from analysis.identify._step_in_time import StiffnessStep
    from analysis.identify._time_varying import TemporalChange
    from analysis.identify.headline import Headline

MODES_WITHOUT_REDUNDANCY: Final = 2
"""Number of visible modes up to which deviations from a uniform beam leave no degree of freedom."""

_CLIPPED_TORQUE_REASON: Final = "the torque is clipped"
"""Reason against all numbers if the torque is clipped."""

_MAX_ENCODER_TO_TORQUE_NOISE: Final = 10.0
"""Power of the torque by the steps of the encoder, relative to that of all other noise, above which
every number is doubtful. In simulated records, errors reach 15 standard deviations at ratios of 20,
and 2.3 at ratios up to 10. The shipped rig has 0.03."""

_PEAK_REACH: Final = 0.01
"""Distance from the frequency of a mode, relative to it, within which its peak is searched for."""

_KINDS_CONTRADICTING_FILE: Final = frozenset({"sign", "unit", "implausible"})
"""Kinds of findings which show that the record contradicts its file."""

_KINDS_OF_CHANNEL_FAULTS: Final = _KINDS_CONTRADICTING_FILE | {"clipping", "stop"}
"""Kinds of findings that are reported even if the record contradicts its file."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelCheck:
    """Result of the check of a model against its record: residual tests, findings, doubts.

    Attributes
    ----------
    candidate_set : CandidateSet
        Candidates of the model, the one of the reported numbers first.
    modal_fit : ModalFit or None
        Modal model; None if no mode is visible.
    residual_tests : ResidualTests
        Tests of the residual of the modal model, or of the first candidate without such a model.
    findings : tuple of Finding
        Findings on the record that need no comparison with reported numbers.
    temporal_changes : tuple of TemporalChange
        Changes along the record that are part of the model.
    """

    candidate_set: CandidateSet
    modal_fit: ModalFit | None
    residual_tests: ResidualTests
    findings: tuple[Finding, ...]
    temporal_changes: tuple[TemporalChange, ...] = ()

    @classmethod
    def of_candidates(
        cls,
        candidate_set: CandidateSet,
        modal_fit: ModalFit | None,
        band_hz: tuple[float, float],
        nonlinear_forces: tuple[NonlinearForce, ...] = (),
        temporal_changes: tuple[TemporalChange, ...] = (),
    ) -> ModelCheck:
        """Check a model, including its nonlinear forces and changes along the record."""
        residual_tests = test_residual(candidate_set, modal_fit, band_hz)
        model_findings = findings(
            candidate_set, modal_fit, nonlinear_forces, residual_tests.harmonics
        )
        return cls(candidate_set, modal_fit, residual_tests, model_findings, temporal_changes)

    @property
    def finding_kinds(self) -> frozenset[str]:
        """Return the kinds of all findings."""
        return frozenset(finding.kind for finding in self.findings)

    @property
    def contradicts_file(self) -> bool:
        """Return whether a recorded signal has another sign, unit or scale than the file states."""
        return not _KINDS_CONTRADICTING_FILE.isdisjoint(self.finding_kinds)

    @property
    def model_rejection_reason(self) -> str | None:
        """Return the reason why the record refutes the model; None if it does not."""
        if self.contradicts_file:
            return CONTRADICTED_FILE_REASON
        if "harmonics" in self.finding_kinds or not self.residual_tests.is_noise:
            return UNEXPLAINED_REASON
        return None

    @property
    def clipped_torque_reason(self) -> str | None:
        """Return the reason to doubt all numbers if the torque is clipped, else None."""
        return _CLIPPED_TORQUE_REASON if "clipping" in self.finding_kinds else None

    @property
    def _data_doubt_reason(self) -> str | None:
        """Return the reason to doubt every number that lies in the data, or None."""
        other_reason = self.model_rejection_reason or self.clipped_torque_reason
        if other_reason is not None or self.modal_fit is None:
            return other_reason
        if not self.modal_fit.determines_response:
            return HIDDEN_RESPONSE_REASON
        if self.modal_fit.has_damping_at_limit:
            return DAMPING_AT_LIMIT_REASON
        if _is_encoder_coarse(self.candidate_set.comparison, self.modal_fit):
            return COARSE_ENCODER_REASON
        return None

    @property
    def doubt_reason(self) -> str | None:
        """Return the reason to doubt every number; None if there is none."""
        return self._data_doubt_reason or self._change_reason

    @property
    def mode_doubt_reason(self) -> str | None:
        """Return the reason to doubt every mode; None if there is none.

        A change along the record is such a reason only if it is part of the model: the modes then
        are those at the middle of the record.
        """
        if self.temporal_changes and self.temporal_changes[0].is_certain:
            return self.doubt_reason
        return self._data_doubt_reason

    @property
    def _change_reason(self) -> str | None:
        """Return the reason if a change along the record makes every parameter doubtful, else None.

        With such a change, the parameters of a mode are those at the time when the sweep passed it.
        """
        is_single_sweep = self.candidate_set.comparison.measurement.is_single_sweep
        if not self.temporal_changes or is_single_change_established(
            self.temporal_changes, is_single_sweep=is_single_sweep
        ):
            return None
        return f"{self.temporal_changes[0].name} would explain the record as well"

    def reported_findings(
        self,
        headline: Headline,
        effect_findings: tuple[Finding, ...] = (),
        change_findings: tuple[Finding, ...] = (),
        stiffness_step: StiffnessStep | None = None,
    ) -> tuple[Finding, ...]:
        """Return all findings, with the doubtful ones marked as not established.

        `effect_findings` are on effects that are fitted with the modes, and on causes of
        deviations. `change_findings` are on changes along the record; they state their certainty
        themselves. `stiffness_step` may explain the residual.
        """
        if self.contradicts_file:
            return tuple(
                finding for finding in self.findings if finding.kind in _KINDS_OF_CHANNEL_FAULTS
            )
        marked_findings = mark_doubtful_findings(
            (*self.findings, *self._setting_findings(headline), *effect_findings),
            change_findings,
            self.model_rejection_reason,
            self.doubt_reason,
            headline.flags,
            only_harmonics_remain=self.residual_tests.is_noise,
        )
        findings_on_impacts = impact_findings(
            self.candidate_set.comparison.measurement.impacts,
            is_explained=self.residual_tests.is_noise,
        )
        if self.residual_tests.is_noise:
            return (*findings_on_impacts, *marked_findings)
        residual_finding = unexplained_residual_finding(
            self.residual_tests.whiteness,
            self.residual_tests.input_relation,
            self.candidate_set.best.fit.modes,
            stiffness_step,
        )
        return (*findings_on_impacts, *marked_findings, residual_finding)

    def _setting_findings(self, headline: Headline) -> tuple[Finding, ...]:
        """Return findings on fitted settings, such as the delay, that differ from the file's.

        The result is empty if the record cannot show such a difference.
        """
        if (
            "implausible" in self.finding_kinds
            or len(headline.visible_modes) < MODES_WITHOUT_REDUNDANCY
        ):
            return ()
        return tuple(setting_findings(self.candidate_set, headline))


def _is_encoder_coarse(comparison: Comparison, modal_fit: ModalFit) -> bool:
    """Return whether the steps of the encoder are by far the largest noise at a mode."""
    encoder_power = comparison.encoder_noise_power(modal_fit.model)
    other_power = np.maximum(modal_fit.noise.power - encoder_power, np.finfo(float).tiny)
    frequency_hz = comparison.frequency_hz
    return any(
        np.max(
            (encoder_power / other_power)[np.abs(frequency_hz / mode_hz - 1) < _PEAK_REACH],
            initial=0.0,
        )
        > _MAX_ENCODER_TO_TORQUE_NOISE
        for mode_hz in (abs(pole) / (2 * math.pi) for pole in modal_fit.poles_rad_s.values())
    )


def visible_mode_numbers(
    candidate_set: CandidateSet, modal_fit: ModalFit | None
) -> tuple[int, ...]:
    """Return the numbers of the beam modes that are visible in a record, from 1."""
    if modal_fit is None:
        return visible_modes(candidate_set.comparison, candidate_set.noise, candidate_set.best.fit)
    return modal_fit.visible_mode_numbers


def mark_doubtful_findings(
    fitted_findings: tuple[Finding, ...],
    change_findings: tuple[Finding, ...],
    model_rejection_reason: str | None,
    doubt_reason: str | None,
    parameter_flags: Mapping[str, str],
    *,
    only_harmonics_remain: bool,
) -> tuple[Finding, ...]:
    """Return all findings, with the doubtful ones marked as not established.

    `fitted_findings` are effects that were fitted with the beam. `change_findings` are changes
    along the record, which already state their certainty. `model_rejection_reason` is the reason
    against the model, `doubt_reason` the reason against all numbers, and `parameter_flags` are the
    reasons against single parameters. With `only_harmonics_remain` the finding on harmonics is
    established.
    """

    def with_reason_of_doubt(finding: Finding) -> Finding:
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
        return with_doubt(finding, finding_reason)

    fitted_findings = tuple(map(with_reason_of_doubt, fitted_findings))
    if model_rejection_reason is not None:
        change_findings = tuple(
            with_doubt(finding, model_rejection_reason) for finding in change_findings
        )
    return (*fitted_findings, *change_findings)
