"""Selection of a structure for one record: candidates, tests, profiles, verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from analysis.selection import sentences
from analysis.selection.along_time import along_time, changing
from analysis.selection.amplitude import damping_with_amplitude
from analysis.selection.candidates import Field
from analysis.selection.drag import with_air_drag
from analysis.selection.experiments import experiments
from analysis.selection.finding import doubted
from analysis.selection.findings import findings, unexplained
from analysis.selection.harmonics import harmonics, in_time
from analysis.selection.headline import MISREAD, UNEXPLAINED, Headline, headline
from analysis.selection.nonlinear_search import nonlinear_forces
from analysis.selection.orders import EVEN, STRONG, order_verdict, rivals, untold_reason
from analysis.selection.profile import Profile
from analysis.selection.profiles import profiled
from analysis.selection.verdict import Row, Verdict
from analysis.selection.visible import visible_modes
from analysis.selection.whiteness import InputRelation, Whiteness, input_relation, whiteness
from analysis.whole_record import RecordAnalysis
from analysis.whole_record.estimate import BAND_HZ

if TYPE_CHECKING:
    from collections.abc import Iterable

    from analysis.selection.along_time import Change
    from analysis.selection.candidate import Candidate
    from analysis.selection.finding import Finding
    from analysis.whole_record import Measurement, RecordFit, Setting

_CLIPPED: Final = "the torque is clipped"
_MISREAD_KINDS: Final = frozenset({"sign", "unit", "implausible"})
_OF_CHANNELS: Final = _MISREAD_KINDS | {"clipping", "stop"}
"""All that is said where the record and its file do not fit each other."""


@dataclass(frozen=True, slots=True)
class Selection:
    """A verdict with what it rests on.

    Attributes
    ----------
    verdict : Verdict
    headline : Headline
        The numbers to be told first, with flags.
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
        """The fit that the headline's numbers are of."""
        return self.headline.fit


def select(
    measurement: Measurement,
    *,
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
) -> Selection:
    """Choose the structure that a record supports, and say what is known.

    All structures are fitted under one spectrum of the noise, on a uniform beam, and those of
    integer internal order also with the modes' stiffness free; where it promises something, also
    with an elastic clamp, a tip mass, a filter or another clock. On the kind of rig with the lowest
    BIC the orders are freed as well, and kinds of rig are told apart by these freest structures.
    The numbers told are theirs, so that intervals hold whichever simpler one is true. If drag of
    the air along the beam makes the lowest lower, all are fitted with it. If restoring forces that
    are not linear, or a change along the record, save far more than chance would, all are fitted
    again with these beside the beam.

    Parameters
    ----------
    measurement : Measurement
    fixed : iterable of str
        Settings that stay as the file states them.
    band_hz : tuple of float

    Raises
    ------
    MeasurementError
        The record cannot be used.
    ValueError
        There is no such setting.
    """
    linear = Field.of(measurement, tuple(fixed), band_hz)
    visible = visible_modes(linear.comparison, linear.noise, linear.best.fit)
    field, forces = (
        (linear, ()) if linear.misread else nonlinear_forces(with_air_drag(linear), visible)
    )
    field, changes = along_time(field.with_orders_free())
    if untold_reason(field, visible) is None:
        field, of_alpha, of_lambda = profiled(field)
    else:
        of_alpha, of_lambda = (
            Profile.unwalked(field.freest, "alpha"),
            Profile.unwalked(field.freest, "lambda"),
        )
    told = field.led_by(field.freest)
    white, related = _tests(told)
    comparison, fit = field.comparison, told.best.fit
    multiples = harmonics(
        comparison.angle_rad[comparison.kept],
        in_time(fit.residual, comparison.bins, comparison.samples),
        comparison.decimation.rate_hz,
        band_hz,
    )
    explained = white.white and not related.related
    found = findings(told, forces, multiples, visible)
    kinds = {finding.kind for finding in found}
    wrong = (
        MISREAD
        if kinds & _MISREAD_KINDS
        else UNEXPLAINED
        if "harmonics" in kinds or not explained
        else None
    )
    doubt = wrong or _doubt(changes, clipped="clipping" in kinds)
    orders = (
        order_verdict(field, of_alpha, visible, doubt=doubt),
        order_verdict(field, of_lambda, visible, doubt=doubt),
    )
    close = rivals(field, EVEN)
    if wrong == MISREAD:
        found = tuple(each for each in found if each.kind in _OF_CHANNELS)
    else:
        found = _as_sure(found, tuple(changing(changes)), wrong, doubt, explained=explained)
        if not explained:
            found = (*found, unexplained(white, related, fit.modes))
    numbers = headline(field, orders, visible, unexplained=wrong)
    if doubt is not None:
        numbers = numbers.doubted(doubt)
    if "nonlinear stiffness" in kinds:
        numbers = numbers.with_law_assumed()
    best = field.best
    of_numbers = sentences.of_headline(
        numbers, orders, alone=doubt is None and not field.other_kinds(STRONG)
    )
    advice = (
        dict.fromkeys(each.remedy for each in found if each.remedy)
        if wrong == MISREAD
        else experiments(field, orders, visible, found, close)
    )
    return Selection(
        candidates=field.candidates,
        headline=numbers,
        analysis=_analysis(field),
        verdict=Verdict(
            name=measurement.name,
            structure=best.structure.name,
            uniform=best.uniform,
            rivals=tuple(c.name for c in close),
            parameters={k: q.value for k, q in numbers.parameters.items() if q.flag is None},
            adequate=wrong is None,
            alpha=orders[0],
            lambda_=orders[1],
            visible_modes=visible,
            findings=found,
            table=_table(field),
            whiteness=white,
            input_relation=related,
            harmonics=multiples,
            sentences=(
                *(() if wrong == MISREAD else of_numbers),
                *(each.sentence for each in found),
            ),
            experiments=tuple(advice),
            damping_with_amplitude=damping_with_amplitude(told),
        ),
    )


def _doubt(changes: tuple[Change, ...], *, clipped: bool) -> str | None:
    """Say why no number is to be believed though all of the record is explained; None: it may."""
    if clipped:
        return _CLIPPED
    if len(changes) == 1 and changes[0].certain:
        return None
    return next((f"{change.name} would explain the record as well" for change in changes), None)


def _as_sure(
    beside: tuple[Finding, ...],
    along: tuple[Finding, ...],
    wrong: str | None,
    doubt: str | None,
    *,
    explained: bool,
) -> tuple[Finding, ...]:
    """Tell as facts only what is sure.

    Parameters
    ----------
    beside, along : tuple of Finding
        Beside the beam, and what changes along the record, which says itself how sure it is.
    wrong, doubt : str or None
        Why the model is not to be believed, and why no number of it.
    explained : bool
        Whether harmonics are all that remains: then they are what they seem to be.
    """
    if doubt is not None:
        beside = tuple(
            each if each.kind == "harmonics" and explained else doubted(each, doubt)
            for each in beside
        )
    if wrong is not None:
        along = tuple(doubted(each, wrong) for each in along)
    return (*beside, *along)


def _analysis(field: Field) -> RecordAnalysis:
    comparison, noise = field.comparison, field.noise
    return RecordAnalysis(
        fits=tuple(candidate.fit for candidate in field.candidates),
        frequency_hz=comparison.frequency_hz,
        compared=noise.counts,
        noise_nm2_per_hz=2 * noise.power / (comparison.samples * comparison.decimation.rate_hz),
        lines=noise.lines,
        comparison=comparison,
    )


def _tests(field: Field) -> tuple[Whiteness, InputRelation]:
    comparison, residual = field.comparison, field.best.fit.residual
    counts = field.noise.counts
    angle = comparison.spectrum(comparison.angle_rad[comparison.kept])
    return (
        whiteness(residual[counts], comparison.frequency_hz[counts]),
        input_relation(residual, angle, comparison.frequency_hz),
    )


def _table(field: Field) -> tuple[Row, ...]:
    best, least_aic = field.best, min(c.aic for c in field.candidates)
    return tuple(
        Row(
            structure=c.structure.name,
            uniform=c.uniform,
            parameters=c.parameters,
            cost=c.fit.cost,
            delta_bic=c.bic - best.bic,
            delta_aic=c.aic - least_aic,
        )
        for c in field.candidates
    )
