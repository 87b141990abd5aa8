"""Verdict on a campaign: one structure for the specimen, and its damping."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from statistics import median_low
from typing import TYPE_CHECKING, Final

from analysis.campaigns import _geometry_sentences as geometry
from analysis.campaigns import sentences, specimen_sentences
from analysis.campaigns._modal import OppositeSweeps, opposite_sweeps
from analysis.campaigns._orders import (
    PooledOrder,
    pooled_order,
    pooled_order_with_tolerance,
    rival_estimates,
)
from analysis.campaigns.pooling import freest_estimate
from analysis.identify.headline import TILTED_AXIS_REASON
from analysis.identify.modal_headline import (
    loss_factors_with_geometry_tolerance,
    uniform_beam_refusal_reason,
)
from analysis.identify.sentences import uniformity
from analysis.statistics import BIC_DECISIVE, BIC_TIE
from rigd.units import interval_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.campaigns._homogeneity import Homogeneity
    from analysis.campaigns._modal import PooledModalModel
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns._validation import FailedPrediction, LeaveOneOutResult
    from analysis.campaigns._welch_bias import WelchBias
    from analysis.campaigns.pooling import PooledEstimate
    from analysis.identify import Finding
    from analysis.identify.verdict import Verdict


# Findings in common

_NUMBER_PATTERN: Final = re.compile(r"(?<!mode )[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""Pattern of a number, except the number of a mode, which is part of the effect's identity."""

_DISPLAY_UNITS: Final = {"s": (1e3, "ms"), "N·m": (1e3, "mN·m"), "1": (100.0, "%"),
                 "kg·m²": (1e6, "10⁻⁶ kg·m²")}  # fmt: skip
"""Display factor and display unit of the size of a finding, by its unit."""


@dataclass(frozen=True, slots=True)
class CommonFinding:
    """Effect other than the beam (such as drag) that is found in one or more sessions.

    Attributes
    ----------
    example : Finding
        Finding of the session with the median size of the effect.
    files : tuple of str
        Names of the sessions that show the effect.
    sessions : int
        Number of sessions examined.
    span : tuple of float or None
        Smallest and largest size of the effect, in the finding's unit; None if a size is missing.
    """

    example: Finding
    files: tuple[str, ...]
    sessions: int
    span: tuple[float, float] | None

    @property
    def sentence(self) -> str:
        """Sentence that states the effect, the number of sessions, and the range of its size."""
        file_count = len(self.files)
        files_text = f" ({', '.join(self.files)})" if file_count < min(self.sessions, 3) else ""
        statement = (
            f"In {file_count} of {self.sessions} sessions{files_text}: {self.example.sentence}"
        )
        if self.span is None or file_count == 1:
            return statement
        display_factor, display_unit = _DISPLAY_UNITS.get(
            self.example.unit, (1.0, self.example.unit)
        )
        span_text = interval_text(self.span, display_factor)
        return f"{statement} (Median session; range over all sessions: {span_text} {display_unit}.)"


def common_findings(sessions: Sequence[SessionAnalysis]) -> tuple[CommonFinding, ...]:
    """Group the findings of all sessions by effect, the most common effect first.

    Two findings describe the same effect if their sentences differ only in numbers.
    """
    findings_by_effect: dict[tuple[str, str], list[tuple[str, Finding]]] = {}
    examined_sessions = [session for session in sessions if session.verdict is not None]
    for session in examined_sessions:
        for finding in session.verdict.findings if session.verdict else ():
            effect_key = finding.kind, _NUMBER_PATTERN.sub("#", finding.sentence)
            findings_by_effect.setdefault(effect_key, []).append((session.name, finding))
    counted_findings = [
        _common_finding(effect_findings, len(examined_sessions))
        for effect_findings in findings_by_effect.values()
    ]
    return tuple(sorted(counted_findings, key=lambda finding: -len(finding.files)))


def _common_finding(
    effect_findings: list[tuple[str, Finding]], session_count: int
) -> CommonFinding:
    """Return one effect with all sessions that show it."""
    file_names = tuple(dict.fromkeys(file_name for file_name, _ in effect_findings))
    effect_sizes = [finding.value for _, finding in effect_findings if finding.value is not None]
    if len(effect_sizes) < len(effect_findings):
        return CommonFinding(effect_findings[0][1], file_names, session_count, None)
    median_size = median_low(effect_sizes)
    median_finding = next(finding for _, finding in effect_findings if finding.value == median_size)
    return CommonFinding(
        median_finding, file_names, session_count, (min(effect_sizes), max(effect_sizes))
    )


# Verdict


@dataclass(frozen=True, slots=True)
class DissentingSession:
    """A session that alone excludes the damping structure selected by all sessions together.

    Attributes
    ----------
    file : str
        Name of the session.
    structure : str
        Structure that the session selects, as named in tables.
    margin : float
        BIC of the common structure in this session less the BIC of the session's own structure.
    """

    file: str
    structure: str
    margin: float


@dataclass(frozen=True, slots=True)
class CampaignVerdict:
    """Verdict on a specimen from all its sessions.

    Attributes
    ----------
    headline : str
        Structure whose parameters are reported, as named in tables: the freest structure that
        nearly all sessions determine.
    structure : str
        Structure of the lowest BIC: "I" to "VII".
    rivals : tuple of str
        Structures, as named in tables, whose BIC is not distinguishable from the lowest.
    sessions : int
        Number of sessions with a verdict of their own, on which this verdict is based.
    alone : mapping of str to int
        Number of sessions that select each structure by themselves.
    adequate : int
        Number of sessions whose residual is noise.
    alpha, lambda_ : PooledOrder
        Orders of internal and external damping.
    findings : tuple of CommonFinding
        Other effects found in the records.
    dissent : tuple of DissentingSession
        Sessions that exclude `structure` by themselves.
    sweeps : OppositeSweeps or None
        Comparison of the modes of rising and falling sweeps; None without both directions.
    sentences : tuple of str
        The verdict in words, the most important first.
    experiments : tuple of str
        Recommended further experiments.
    """

    headline: str
    structure: str
    rivals: tuple[str, ...]
    sessions: int
    alone: Mapping[str, int]
    adequate: int
    alpha: PooledOrder
    lambda_: PooledOrder
    findings: tuple[CommonFinding, ...]
    dissent: tuple[DissentingSession, ...]
    sweeps: OppositeSweeps | None
    sentences: tuple[str, ...]
    experiments: tuple[str, ...]

    @property
    def withheld_orders(self) -> frozenset[str]:
        """Orders whose estimate for an exactly uniform beam must not be reported."""
        return _withheld_orders(self.alpha, self.lambda_)


def campaign_verdict(
    sessions: Sequence[SessionAnalysis],
    pooled: Sequence[PooledEstimate],
    homogeneity: Homogeneity,
    validation: Sequence[LeaveOneOutResult],
    failed_predictions: Sequence[FailedPrediction],
    biases: Sequence[WelchBias] = (),
    modal_model: PooledModalModel | None = None,
) -> CampaignVerdict | None:
    """Return the verdict on a campaign, or None if no damping structure could be pooled.

    The pooled estimates are in the order of rising BIC. `validation` are the errors of the sessions
    that were predicted from the others, and `failed_predictions` the sessions that could not be.
    `biases` are differences of the Welch fits from the pooled estimates.
    """
    verdicts = [session.verdict for session in sessions if session.verdict is not None]
    if not pooled or not verdicts:
        return None
    lowest_bic_estimate, freest_fit = pooled[0], freest_estimate(pooled)
    assert freest_fit is not None
    alpha, lambda_ = (
        _reported_order(
            _doubt_if_tilted(pooled_order(order, pooled, verdicts, homogeneity), sessions),
            verdicts,
            modal_model,
        )
        for order in ("alpha", "lambda")
    )
    sweep_comparison = opposite_sweeps(sessions)
    is_beam_refused = modal_model is not None and modal_model.uniform_beam.status == "refused"
    findings = common_findings(sessions)
    close_rivals = rival_estimates(pooled, BIC_TIE)
    selections_by_structure = dict(
        Counter(
            session.selected_structure for session in sessions if session.selected_structure
        ).most_common()
    )
    adequate_session_count = sum(verdict.adequate for verdict in verdicts)
    dissenting_sessions = _dissenting_sessions(sessions, lowest_bic_estimate)
    recommendation_counts = Counter(
        experiment for verdict in verdicts for experiment in verdict.experiments
    )
    common_recommendations = [
        experiment
        for experiment, advice_count in recommendation_counts.most_common()
        if 2 * advice_count > len(verdicts)
    ]
    return CampaignVerdict(
        headline=freest_fit.name,
        structure=lowest_bic_estimate.structure,
        rivals=tuple(rival.name for rival in close_rivals),
        sessions=len(verdicts),
        alone=selections_by_structure,
        adequate=adequate_session_count,
        alpha=alpha,
        lambda_=lambda_,
        findings=findings,
        dissent=dissenting_sessions,
        sweeps=sweep_comparison,
        sentences=(
            *specimen_sentences.describe_specimens(homogeneity),
            sentences.describe_orders(freest_fit, alpha, lambda_, validation),
            *specimen_sentences.describe_blocks(homogeneity, len(sessions)),
            *specimen_sentences.describe_trends(homogeneity),
            *_describe_parameters(
                freest_fit, lowest_bic_estimate, modal_model, adequate_session_count, len(verdicts)
            ),
            *_describe_modes(freest_fit, modal_model, is_mixture=homogeneity.is_mixture),
            *_describe_loss_slopes(alpha, lambda_, modal_model),
            *geometry.describe_sweeps(sweep_comparison),
            *geometry.describe_orders_if_exact(freest_fit, (alpha, lambda_), modal_model),
            *sentences.describe_welch_bias(
                freest_fit,
                biases,
                _withheld_orders(alpha, lambda_),
                has_reference=not (homogeneity.is_mixture or is_beam_refused),
            ),
            sentences.describe_selection(
                pooled, close_rivals, selections_by_structure, len(verdicts)
            ),
            *(finding.sentence for finding in findings),
            *sentences.describe_dissent(
                [
                    (dissenting_session.file, dissenting_session.structure)
                    for dissenting_session in dissenting_sessions
                ],
                lowest_bic_estimate,
            ),
            *([] if homogeneity.is_mixture else sentences.describe_scatter(homogeneity)),
            *sentences.describe_prediction_errors(freest_fit, validation, len(sessions)),
            *sentences.describe_failed_predictions(failed_predictions, len(sessions)),
        ),
        experiments=(
            *geometry.recommend_sweeps(sweep_comparison, modal_model, sessions),
            *common_recommendations,
        ),
    )


def _doubt_if_tilted(exact_order: PooledOrder, sessions: Sequence[SessionAnalysis]) -> PooledOrder:
    """Return an order on an exactly uniform beam, doubted if its fits omit a stated tilt."""
    if not any(session.experiment.axis_tilt_deg for session in sessions):
        return exact_order
    return exact_order.with_doubt(TILTED_AXIS_REASON)


def _reported_order(
    exact_order: PooledOrder, verdicts: Sequence[Verdict], modal_model: PooledModalModel | None
) -> PooledOrder:
    """Return an order estimated from the modal constants or, without them, for a uniform beam."""
    if modal_model is None:
        return exact_order
    if modal_model.tolerant is not None:
        is_beam_refused = modal_model.uniform_beam.status == "refused"
        return pooled_order_with_tolerance(
            exact_order, modal_model.tolerant, verdicts, is_beam_refused=is_beam_refused
        )
    refusal_reason = uniform_beam_refusal_reason(modal_model.uniform_beam)
    return exact_order if refusal_reason is None else exact_order.with_doubt(refusal_reason)


def _describe_parameters(
    freest_fit: PooledEstimate,
    lowest_bic_estimate: PooledEstimate,
    modal_model: PooledModalModel | None,
    adequate_session_count: int,
    session_count: int,
) -> tuple[str, ...]:
    """Describe the model of the reported parameters, how well it fits, and the loss factors."""
    uniformity_sentences = uniformity(modal_model.uniform_beam if modal_model else None)
    if modal_model is None or modal_model.tolerant is None:
        residual_sentence = sentences.describe_residual(
            freest_fit, adequate_session_count, session_count
        )
        return (
            sentences.describe_structure(freest_fit, lowest_bic_estimate),
            *uniformity_sentences,
            residual_sentence,
            *sentences.describe_loss_factors(freest_fit.sizes),
        )
    residual_sentence = sentences.describe_noise_sessions(adequate_session_count, session_count)
    return (
        geometry.describe_tolerance(modal_model, modal_model.tolerant),
        *uniformity_sentences,
        residual_sentence,
        *sentences.describe_loss_factors(
            loss_factors_with_geometry_tolerance(modal_model.uniform_beam, modal_model.tolerant)
        ),
    )


def _describe_modes(
    freest_fit: PooledEstimate, modal_model: PooledModalModel | None, *, is_mixture: bool
) -> list[str]:
    """Describe the modes of the modal model if these are reported, else of the uniform beam."""
    if modal_model is not None and modal_model.replaces_beam_modes:
        return sentences.describe_modes(
            modal_model.modes, modal_model.sessions, is_mixture=is_mixture
        )
    return sentences.describe_modes(freest_fit.modes, freest_fit.sessions, is_mixture=is_mixture)


def _describe_loss_slopes(
    alpha: PooledOrder, lambda_: PooledOrder, modal_model: PooledModalModel | None
) -> tuple[str, str]:
    """Describe both orders of the damping, as slopes of the losses if the beam may be uneven."""
    if modal_model is None or modal_model.tolerant is None:
        return sentences.describe_order(alpha), sentences.describe_order(lambda_)
    return geometry.describe_loss_slope(alpha, modal_model), geometry.describe_loss_slope(
        lambda_, modal_model
    )


def _withheld_orders(*orders: PooledOrder) -> frozenset[str]:
    """Return the orders with a reason to doubt their estimate for an exactly uniform beam."""
    return frozenset(order.order for order in orders if (order.exact or order).reason is not None)


def _dissenting_sessions(
    sessions: Sequence[SessionAnalysis], lowest_bic_estimate: PooledEstimate
) -> tuple[DissentingSession, ...]:
    """Return the sessions that alone exclude the structure of the lowest BIC over all sessions."""
    dissenting_sessions = []
    for session in sessions:
        estimates_by_name = {estimate.name: estimate for estimate in session.record_estimates}
        if estimates_by_name:
            own_estimate = min(estimates_by_name.values(), key=lambda estimate: estimate.bic)
            bic_margin = estimates_by_name[lowest_bic_estimate.name].bic - own_estimate.bic
            if bic_margin > BIC_DECISIVE:
                dissenting_sessions.append(
                    DissentingSession(session.name, own_estimate.name, bic_margin)
                )
    return tuple(
        sorted(dissenting_sessions, key=lambda dissenting_session: -dissenting_session.margin)
    )
