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
    rivals,
    tolerant_pooled_order,
)
from analysis.identify import refused_reason, tolerant_sizes
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

_FIGURE: Final = re.compile(r"(?<!mode )[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""A number, but not that of a mode, which identifies what is meant."""

_SHOWN: Final = {"s": (1e3, "ms"), "N·m": (1e3, "mN·m"), "1": (100.0, "%"),
                 "kg·m²": (1e6, "10⁻⁶ kg·m²")}  # fmt: skip


@dataclass(frozen=True, slots=True)
class CommonFinding:
    """Effect other than the beam that one or more sessions show.

    Attributes
    ----------
    example : Finding
        Finding of the session in the middle, by size.
    files : tuple of str
        Names of the sessions that have it.
    sessions : int
        Number of sessions examined.
    span : tuple of float or None
        Least and largest size, in the finding's unit.
    """

    example: Finding
    files: tuple[str, ...]
    sessions: int
    span: tuple[float, float] | None

    @property
    def sentence(self) -> str:
        """The finding in words, with the number of sessions and the range of its size."""
        count = len(self.files)
        which = f" ({', '.join(self.files)})" if count < min(self.sessions, 3) else ""
        words = f"In {count} of {self.sessions} sessions{which}: {self.example.sentence}"
        if self.span is None or count == 1:
            return words
        factor, unit = _SHOWN.get(self.example.unit, (1.0, self.example.unit))
        span = interval_text(self.span, factor)
        return f"{words} (Median session; range over all sessions: {span} {unit}.)"


def common_findings(sessions: Sequence[SessionAnalysis]) -> tuple[CommonFinding, ...]:
    """Count the findings of all sessions, the most common first.

    Two findings are of the same thing if their sentences are the same but for the figures in them.
    """
    found: dict[tuple[str, str], list[tuple[str, Finding]]] = {}
    judged = [session for session in sessions if session.verdict is not None]
    for session in judged:
        for finding in session.verdict.findings if session.verdict else ():
            kind = finding.kind, _FIGURE.sub("#", finding.sentence)
            found.setdefault(kind, []).append((session.name, finding))
    counted = [_counted(group, len(judged)) for group in found.values()]
    return tuple(sorted(counted, key=lambda each: -len(each.files)))


def _counted(group: list[tuple[str, Finding]], sessions: int) -> CommonFinding:
    files = tuple(dict.fromkeys(name for name, _ in group))
    sizes = [finding.value for _, finding in group if finding.value is not None]
    if len(sizes) < len(group):
        return CommonFinding(group[0][1], files, sessions, None)
    middle = median_low(sizes)
    example = next(finding for _, finding in group if finding.value == middle)
    return CommonFinding(example, files, sessions, (min(sizes), max(sizes)))


# Verdict


@dataclass(frozen=True, slots=True)
class Dissent:
    """A session that by itself dismisses what all together select.

    Attributes
    ----------
    file : str
        Name.
    structure : str
        What it selects, as tables call it.
    margin : float
        By how much its own BIC is lower so.
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
        Structure that the numbers are of, as tables call it: the freest on the beam selected.
    structure : str
        Structure of the lowest BIC: "I" to "VII".
    rivals : tuple of str
        Structures, by their names in tables, that all data together do not distinguish from it.
    sessions : int
        Those with their own verdict, on which this one rests.
    alone : mapping of str to int
        How many sessions select which structure by themselves.
    adequate : int
        Sessions in which what it leaves is noise.
    alpha, lambda_ : PooledOrder
    findings : tuple of CommonFinding
        What else is in the records.
    dissent : tuple of Dissent
    sweeps : OppositeSweeps or None
        Whether rising and falling sweeps show the same modes; None without both.
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
        """Orders that are not to be reported of an exactly uniform beam."""
        return _withheld(self.alpha, self.lambda_)


def campaign_verdict(
    sessions: Sequence[SessionAnalysis],
    pooled: Sequence[PooledEstimate],
    alike: Homogeneity,
    validation: Sequence[LeftOutError],
    lost: Sequence[LostTrial],
    biases: Sequence[WelchBias] = (),
    modal: PooledModal | None = None,
) -> CampaignVerdict | None:
    """Return the verdict; None if fewer than two sessions determine any structure's damping.

    Parameters
    ----------
    sessions : sequence of SessionResult
    pooled : sequence of PooledEstimate
        The lowest BIC first.
    alike : Homogeneity
        Whether they are of one specimen.
    validation : sequence of LeftOutError
    lost : sequence of LostTrial
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
        _order(pooled_order(order, pooled, verdicts, alike), verdicts, modal)
        for order in ("alpha", "lambda")
    )
    sweeps = opposite_sweeps(sessions)
    refused = modal is not None and modal.uniform_beam.status == "refused"
    found = common_findings(sessions)
    close = rivals(pooled, BIC_TIE)
    alone = dict(Counter(each.selected for each in sessions if each.selected).most_common())
    adequate = sum(verdict.adequate for verdict in verdicts)
    dissent = _dissent(sessions, best)
    counted = Counter(advice for verdict in verdicts for advice in verdict.experiments)
    advice = [what for what, count in counted.most_common() if 2 * count > len(verdicts)]
    return CampaignVerdict(
        headline=freest.name,
        structure=best.structure,
        rivals=tuple(each.name for each in close),
        sessions=len(verdicts),
        alone=alone,
        adequate=adequate,
        alpha=alpha,
        lambda_=lambda_,
        findings=found,
        dissent=dissent,
        sweeps=sweeps,
        sentences=(
            *specimen_sentences.specimens(alike),
            sentences.describe_orders(freest, alpha, lambda_, validation),
            *_numbers(freest, best, modal, adequate, len(verdicts)),
            *_modes(freest, modal, mixed=alike.mixed),
            *_slopes(alpha, lambda_, modal),
            *geometry.describe_sweeps(sweeps),
            *geometry.describe_orders_if_exact(freest, (alpha, lambda_), modal),
            *sentences.describe_welch_bias(
                freest, biases, _withheld(alpha, lambda_), comparable=not (alike.mixed or refused)
            ),
            sentences.describe_selection(pooled, close, alone, len(verdicts)),
            *(finding.sentence for finding in found),
            *sentences.describe_dissent([(each.file, each.structure) for each in dissent], best),
            *([] if alike.mixed else [sentences.describe_scatter(freest)]),
            *sentences.describe_prediction_errors(freest, validation, len(sessions)),
            *sentences.lost_trials(lost, len(sessions)),
        ),
        experiments=(*geometry.recommend_sweeps(sweeps, modal, sessions), *advice),
    )


def _order(
    exact: PooledOrder, verdicts: Sequence[Verdict], modal: PooledModal | None
) -> PooledOrder:
    """Return the order by the modal constants if these determine more than an exact beam."""
    if modal is None:
        return exact
    if modal.tolerant is not None:
        refused = modal.uniform_beam.status == "refused"
        return tolerant_pooled_order(exact, modal.tolerant, verdicts, refused=refused)
    reason = refused_reason(modal.uniform_beam)
    return exact if reason is None else exact.doubted(reason)


def _numbers(
    freest: PooledEstimate,
    best: PooledEstimate,
    modal: PooledModal | None,
    adequate: int,
    sessions: int,
) -> tuple[str, ...]:
    """Describe the model of the numbers, whether it explains the records, and the losses."""
    gate = uniformity(modal.uniform_beam if modal else None)
    if modal is None or modal.tolerant is None:
        left = sentences.describe_residual(freest, adequate, sessions)
        return (
            sentences.describe_structure(freest, best),
            *gate,
            left,
            *sentences.describe_loss_factors(freest.sizes),
        )
    left = sentences.describe_noise_sessions(adequate, sessions)
    return (
        geometry.describe_tolerance(modal, modal.tolerant),
        *gate,
        left,
        *sentences.describe_loss_factors(tolerant_sizes(modal.uniform_beam, modal.tolerant)),
    )


def _modes(freest: PooledEstimate, modal: PooledModal | None, *, mixed: bool) -> list[str]:
    if modal is not None and modal.leads:
        return sentences.describe_modes(modal.modes, modal.sessions, mixed=mixed)
    return sentences.describe_modes(freest.modes, freest.sessions, mixed=mixed)


def _slopes(alpha: PooledOrder, lambda_: PooledOrder, modal: PooledModal | None) -> tuple[str, str]:
    if modal is None or modal.tolerant is None:
        return sentences.describe_order(alpha), sentences.describe_order(lambda_)
    return geometry.describe_slope(alpha, modal), geometry.describe_slope(lambda_, modal)


def _withheld(*orders: PooledOrder) -> frozenset[str]:
    return frozenset(each.order for each in orders if (each.exact or each).reason is not None)


def _dissent(sessions: Sequence[SessionAnalysis], best: PooledEstimate) -> tuple[Dissent, ...]:
    found = []
    for session in sessions:
        by_name = {each.name: each for each in session.record_estimates}
        if by_name:
            own = min(by_name.values(), key=lambda each: each.bic)
            margin = by_name[best.name].bic - own.bic
            if margin > BIC_DECISIVE:
                found.append(Dissent(session.name, own.name, margin))
    return tuple(sorted(found, key=lambda each: -each.margin))
