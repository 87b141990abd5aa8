"""Verdict on a campaign: one structure for the specimen, and its damping."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from statistics import median_low
from typing import TYPE_CHECKING, Final

from analysis.campaigns import _geometry_sentences as geometry
from analysis.campaigns import sentences
from analysis.campaigns import sentences as specimen_sentences
from analysis.campaigns._modal import OppositeSweeps, opposite_sweeps
from analysis.campaigns._orders import (
    PooledOrder,
    freest_estimate,
    pooled_order,
    rival_estimates,
    tolerant_pooled_order,
)
from analysis.identify import loss_factors_with_geometry_tolerance, uniform_beam_refusal_reason
from analysis.identify.sentences import uniformity
from analysis.identify.verdict import BIC_DECISIVE, BIC_TIE
from rigd.units import interval_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.campaigns._homogeneity import Homogeneity
    from analysis.campaigns._modal import PooledModal
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns._validation import LeftOutError, LostTrial
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
        count = len(self.files)
        files_text = f" ({', '.join(self.files)})" if count < min(self.sessions, 3) else ""
        statement = f"In {count} of {self.sessions} sessions{files_text}: {self.example.sentence}"
        if self.span is None or count == 1:
            return statement
        factor, unit = _DISPLAY_UNITS.get(self.example.unit, (1.0, self.example.unit))
        span = interval_text(self.span, factor)
        return f"{statement} (Median session; range over all sessions: {span} {unit}.)"


def common_findings(sessions: Sequence[SessionAnalysis]) -> tuple[CommonFinding, ...]:
    """Group the findings of all sessions by effect, the most common effect first.

    Two findings describe the same effect if their sentences differ only in numbers.
    """
    findings_by_effect: dict[tuple[str, str], list[tuple[str, Finding]]] = {}
    examined = [session for session in sessions if session.verdict is not None]
    for session in examined:
        for finding in session.verdict.findings if session.verdict else ():
            effect_key = finding.kind, _NUMBER_PATTERN.sub("#", finding.sentence)
            findings_by_effect.setdefault(effect_key, []).append((session.name, finding))
    counted = [_common_finding(group, len(examined)) for group in findings_by_effect.values()]
    return tuple(sorted(counted, key=lambda effect: -len(effect.files)))


def _common_finding(group: list[tuple[str, Finding]], sessions: int) -> CommonFinding:
    """Return one effect with all sessions that show it."""
    files = tuple(dict.fromkeys(name for name, _ in group))
    sizes = [finding.value for _, finding in group if finding.value is not None]
    if len(sizes) < len(group):
        return CommonFinding(group[0][1], files, sessions, None)
    median_size = median_low(sizes)
    example = next(finding for _, finding in group if finding.value == median_size)
    return CommonFinding(example, files, sessions, (min(sizes), max(sizes)))


# Verdict


@dataclass(frozen=True, slots=True)
class Dissent:
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
    dissent : tuple of Dissent
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
    dissent: tuple[Dissent, ...]
    sweeps: OppositeSweeps | None
    sentences: tuple[str, ...]
    experiments: tuple[str, ...]

    @property
    def withheld(self) -> frozenset[str]:
        """Orders that are not to be reported for an exactly uniform beam."""
        return _withheld_orders(self.alpha, self.lambda_)


def campaign_verdict(
    sessions: Sequence[SessionAnalysis],
    pooled: Sequence[PooledEstimate],
    homogeneity: Homogeneity,
    validation: Sequence[LeftOutError],
    lost: Sequence[LostTrial],
    biases: Sequence[WelchBias] = (),
    modal: PooledModal | None = None,
) -> CampaignVerdict | None:
    """Return the verdict on a campaign, or None if no damping structure could be pooled.

    Parameters
    ----------
    sessions : sequence of SessionAnalysis
        Sessions of the campaign.
    pooled : sequence of PooledEstimate
        Pooled estimates, the lowest BIC first.
    homogeneity : Homogeneity
        Whether the sessions are of one specimen.
    validation : sequence of LeftOutError
        Errors of sessions predicted from the others.
    lost : sequence of LostTrial
        Sessions that could not be predicted from the others.
    biases : sequence of WelchBias, optional
        Differences of the Welch fits from the pooled estimates.
    modal : PooledModal, optional
        Modal model of all sessions.
    """
    verdicts = [session.verdict for session in sessions if session.verdict is not None]
    if not pooled or not verdicts:
        return None
    best, freest = pooled[0], freest_estimate(pooled)
    assert freest is not None
    alpha, lambda_ = (
        _final_order(pooled_order(order, pooled, verdicts, homogeneity), verdicts, modal)
        for order in ("alpha", "lambda")
    )
    sweeps = opposite_sweeps(sessions)
    refused = modal is not None and modal.uniform_beam.status == "refused"
    findings = common_findings(sessions)
    close_rivals = rival_estimates(pooled, BIC_TIE)
    single_selections = dict(
        Counter(session.selected for session in sessions if session.selected).most_common()
    )
    adequate = sum(verdict.adequate for verdict in verdicts)
    dissent = _dissenting_sessions(sessions, best)
    advice_counts = Counter(advice for verdict in verdicts for advice in verdict.experiments)
    advice = [what for what, count in advice_counts.most_common() if 2 * count > len(verdicts)]
    return CampaignVerdict(
        headline=freest.name,
        structure=best.structure,
        rivals=tuple(rival.name for rival in close_rivals),
        sessions=len(verdicts),
        alone=single_selections,
        adequate=adequate,
        alpha=alpha,
        lambda_=lambda_,
        findings=findings,
        dissent=dissent,
        sweeps=sweeps,
        sentences=(
            *specimen_sentences.specimens(homogeneity),
            sentences.describe_orders(freest, alpha, lambda_, validation),
            *_describe_parameters(freest, best, modal, adequate, len(verdicts)),
            *_describe_modes(freest, modal, mixed=homogeneity.mixed),
            *_describe_slopes(alpha, lambda_, modal),
            *geometry.describe_sweeps(sweeps),
            *geometry.describe_orders_if_exact(freest, (alpha, lambda_), modal),
            *sentences.describe_welch_bias(
                freest,
                biases,
                _withheld_orders(alpha, lambda_),
                comparable=not (homogeneity.mixed or refused),
            ),
            sentences.describe_selection(pooled, close_rivals, single_selections, len(verdicts)),
            *(finding.sentence for finding in findings),
            *sentences.describe_dissent(
                [(dissenter.file, dissenter.structure) for dissenter in dissent], best
            ),
            *([] if homogeneity.mixed else [sentences.describe_scatter(freest)]),
            *sentences.describe_prediction_errors(freest, validation, len(sessions)),
            *sentences.lost_trials(lost, len(sessions)),
        ),
        experiments=(*geometry.recommend_sweeps(sweeps, modal, sessions), *advice),
    )


def _final_order(
    exact: PooledOrder, verdicts: Sequence[Verdict], modal: PooledModal | None
) -> PooledOrder:
    """Return an order estimated from the modal constants, or from a uniform beam without them."""
    if modal is None:
        return exact
    if modal.tolerant is not None:
        refused = modal.uniform_beam.status == "refused"
        return tolerant_pooled_order(exact, modal.tolerant, verdicts, refused=refused)
    reason = uniform_beam_refusal_reason(modal.uniform_beam)
    return exact if reason is None else exact.doubted(reason)


def _describe_parameters(
    freest: PooledEstimate,
    best: PooledEstimate,
    modal: PooledModal | None,
    adequate: int,
    sessions: int,
) -> tuple[str, ...]:
    """Describe the model of the reported parameters, how well it fits, and the loss factors."""
    uniformity_sentences = uniformity(modal.uniform_beam if modal else None)
    if modal is None or modal.tolerant is None:
        residual_sentence = sentences.describe_residual(freest, adequate, sessions)
        return (
            sentences.describe_structure(freest, best),
            *uniformity_sentences,
            residual_sentence,
            *sentences.describe_loss_factors(freest.sizes),
        )
    residual_sentence = sentences.describe_noise_sessions(adequate, sessions)
    return (
        geometry.describe_tolerance(modal, modal.tolerant),
        *uniformity_sentences,
        residual_sentence,
        *sentences.describe_loss_factors(
            loss_factors_with_geometry_tolerance(modal.uniform_beam, modal.tolerant)
        ),
    )


def _describe_modes(freest: PooledEstimate, modal: PooledModal | None, *, mixed: bool) -> list[str]:
    """Describe the modes of the modal model if these are reported, else of the uniform beam."""
    if modal is not None and modal.leads:
        return sentences.describe_modes(modal.modes, modal.sessions, mixed=mixed)
    return sentences.describe_modes(freest.modes, freest.sessions, mixed=mixed)


def _describe_slopes(
    alpha: PooledOrder, lambda_: PooledOrder, modal: PooledModal | None
) -> tuple[str, str]:
    """Describe both orders of the damping, as slopes of the losses if a tolerance is used."""
    if modal is None or modal.tolerant is None:
        return sentences.describe_order(alpha), sentences.describe_order(lambda_)
    return geometry.describe_slope(alpha, modal), geometry.describe_slope(lambda_, modal)


def _withheld_orders(*orders: PooledOrder) -> frozenset[str]:
    """Return the orders with a reason against reporting them for an exactly uniform beam."""
    return frozenset(order.order for order in orders if (order.exact or order).reason is not None)


def _dissenting_sessions(
    sessions: Sequence[SessionAnalysis], best: PooledEstimate
) -> tuple[Dissent, ...]:
    """Return the sessions that alone exclude the damping structure of the lowest common BIC."""
    dissents = []
    for session in sessions:
        by_name = {estimate.name: estimate for estimate in session.record_estimates}
        if by_name:
            own = min(by_name.values(), key=lambda estimate: estimate.bic)
            margin = by_name[best.name].bic - own.bic
            if margin > BIC_DECISIVE:
                dissents.append(Dissent(session.name, own.name, margin))
    return tuple(sorted(dissents, key=lambda dissenter: -dissenter.margin))
