"""Selection of a structure for one record: candidates, tests, profiles, verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.selection import sentences
from analysis.selection.amplitude import damping_with_amplitude
from analysis.selection.candidates import Field
from analysis.selection.drag import with_air_drag
from analysis.selection.experiments import experiments
from analysis.selection.findings import findings, unexplained
from analysis.selection.harmonics import harmonics, in_time
from analysis.selection.nonlinear_search import nonlinear_forces
from analysis.selection.orders import EVEN, order_verdict, rivals
from analysis.selection.profiles import profiled
from analysis.selection.verdict import Row, Verdict
from analysis.selection.visible import visible_modes
from analysis.selection.whiteness import InputRelation, Whiteness, input_relation, whiteness
from analysis.whole_record import RecordAnalysis
from analysis.whole_record.estimate import BAND_HZ

if TYPE_CHECKING:
    from collections.abc import Iterable

    from analysis.selection.candidate import Candidate
    from analysis.whole_record import Measurement, RecordFit, Setting


@dataclass(frozen=True, slots=True)
class Selection:
    """A verdict with what it rests on.

    Attributes
    ----------
    verdict : Verdict
    candidates : tuple of Candidate
        All fits, the lowest BIC first.
    analysis : RecordAnalysis
        The same fits with the noise and the bins that are theirs.
    """

    verdict: Verdict
    candidates: tuple[Candidate, ...]
    analysis: RecordAnalysis

    @property
    def fit(self) -> RecordFit:
        """The fit selected, for parameters with their uncertainty."""
        return self.candidates[0].fit


def select(
    measurement: Measurement,
    *,
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
) -> Selection:
    """Choose the structure that a record supports, and say what is known.

    All structures are fitted under one spectrum of the noise, on a uniform beam, and those of
    integer internal order also with the modes' stiffness free; if one of those is the best, its
    orders are freed as well. The lowest BIC is selected. If drag of the air along the beam makes
    the lowest lower, all are fitted with it. If restoring forces that are not linear
    save far more than chance would, all are fitted again with these beside the beam.

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
    field, forces = nonlinear_forces(with_air_drag(linear), visible)
    if not field.best.uniform:
        field = field.with_orders_free()
    field, of_alpha, of_lambda = profiled(field)
    white, related = _tests(field)
    comparison, fit = field.comparison, field.best.fit
    multiples = harmonics(
        comparison.angle_rad[comparison.kept],
        in_time(fit.residual, comparison.bins, comparison.samples),
        comparison.decimation.rate_hz,
        band_hz,
    )
    explained = white.white and not related.related
    adequate = explained and not any(h.present for h in multiples)
    alpha, lambda_ = (
        order_verdict(field, profile, visible, adequate=adequate)
        for profile in (of_alpha, of_lambda)
    )
    close = rivals(field, EVEN)
    found = findings(field, forces, multiples, visible)
    if not explained:
        found = (*found, unexplained(white, related, fit.modes))
    unsure = {
        o.order for o in (alpha, lambda_) if o.status in ("not identifiable", "not supported")
    }
    said = [
        *sentences.selected(field, close, (alpha, lambda_), adequate=adequate),
        sentences.order(alpha, visible, adequate=adequate),
        sentences.order(lambda_, visible, adequate=adequate),
        *(finding.sentence for finding in found),
    ]
    best = field.best
    return Selection(
        candidates=field.candidates,
        analysis=_analysis(field),
        verdict=Verdict(
            name=measurement.name,
            structure=best.structure.name,
            uniform=best.uniform,
            rivals=tuple(c.name for c in close),
            parameters={k: v for k, v in fit.parameters.items() if k not in unsure},
            adequate=adequate,
            alpha=alpha,
            lambda_=lambda_,
            visible_modes=visible,
            findings=found,
            table=_table(field),
            whiteness=white,
            input_relation=related,
            harmonics=multiples,
            sentences=tuple(said),
            experiments=tuple(experiments(field, (alpha, lambda_), visible, found, close)),
            damping_with_amplitude=damping_with_amplitude(field),
        ),
    )


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
