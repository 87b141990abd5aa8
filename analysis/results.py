"""Result of the analysis of one record, as reports take it: fits, selection, verdict, warnings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.identify import (
        DampingAt,
        Finding,
        Headline,
        OrderVerdict,
        RecordAnalysis,
        RecordFit,
        Selection,
        Setting,
    )
    from analysis.paper import WelchAnalysis
    from analysis.record import Record

_ORDERS: Final = frozenset({"alpha", "lambda"})


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the selection of a structure came to, as a report shows it.

    Attributes
    ----------
    sentences : tuple of str
        What can be told from the data and what cannot, in the operator's words.
    experiments : tuple of str
        What would tell more.
    delta_bic : dict of str to float
        BIC above the lowest by the name of the fit; may be empty.
    orders : tuple of OrderVerdict
        What is known of each order; may be empty.
    findings : tuple of Finding
        What else is in the record.
    damping_with_amplitude : tuple of DampingAt
        Where the air brakes the beam; else empty.
    """

    sentences: tuple[str, ...]
    experiments: tuple[str, ...] = ()
    delta_bic: Mapping[str, float] = field(default_factory=dict)
    orders: tuple[OrderVerdict, ...] = ()
    findings: tuple[Finding, ...] = ()
    damping_with_amplitude: tuple[DampingAt, ...] = ()

    @classmethod
    def of(cls, selection: Selection) -> Verdict:
        """Take over what `analysis.identify` says."""
        said, best = selection.verdict, selection.candidates[0]
        return cls(
            sentences=said.sentences,
            experiments=said.experiments,
            delta_bic={each.name: each.bic - best.bic for each in selection.candidates},
            orders=(said.alpha, said.lambda_),
            findings=said.findings,
            damping_with_amplitude=said.damping_with_amplitude,
        )


@dataclass(frozen=True, slots=True)
class Subject:
    """One record with everything that was found in it.

    Attributes
    ----------
    record : Record
    analysis : RecordAnalysis
        Its noise, lines and bins are those of all `fits`.
    fits : dict of str to RecordFit
        Whole-record fits by the name that tables call them, in the order of the tables.
    headline : Headline
        The numbers that are told first; its fit is one of `fits`.
    verdict : Verdict
    band_hz : tuple of float
        Band of the whole-record fits.
    fixed : tuple of str
        Settings that stayed at the file's values in them.
    welch : WelchAnalysis or None
        Welch fits of the same record; None if they were not run.
    """

    record: Record
    analysis: RecordAnalysis
    fits: Mapping[str, RecordFit]
    headline: Headline
    verdict: Verdict
    band_hz: tuple[float, float]
    fixed: tuple[Setting, ...] = ()
    welch: WelchAnalysis | None = None

    @classmethod
    def of(
        cls,
        record: Record,
        selection: Selection,
        band_hz: tuple[float, float],
        fixed: tuple[Setting, ...] = (),
        welch: WelchAnalysis | None = None,
    ) -> Subject:
        """Take what was selected for a record.

        Parameters
        ----------
        record : Record
            One session on its time grid.
        selection : Selection
            Fits, headline and verdict.
        band_hz : tuple of float
            Band of the fits.
        fixed : tuple of str
            Settings that stayed at the file's values.
        welch : WelchAnalysis, optional
            Welch fits of the same record.
        """
        return cls(
            record=record,
            analysis=selection.analysis,
            fits={candidate.name: candidate.fit for candidate in selection.candidates},
            headline=selection.headline,
            verdict=Verdict.of(selection),
            band_hz=band_hz,
            fixed=fixed,
            welch=welch,
        )

    @property
    def fit(self) -> RecordFit:
        """The fit that the headline's numbers are of."""
        return self.headline.fit

    @property
    def visible_modes(self) -> tuple[int, ...]:
        """Numbers of its modes that the record shows."""
        return self.headline.visible_modes

    @property
    def withheld(self) -> frozenset[str]:
        """Orders of that fit whose numbers carry a flag."""
        return frozenset(_ORDERS & self.headline.flags.keys())

    @property
    def unsupported(self) -> frozenset[str]:
        """Orders that no fit of this record can tell: those withheld, and of absent damping."""
        return self.withheld | {each.order for each in self.verdict.orders if each.value is None}

    @property
    def name(self) -> str:
        """What titles call the record."""
        return self.record.path.name

    @property
    def warnings(self) -> tuple[str, ...]:
        """What an analyst should read beside the results."""
        return self.record.warnings if self.welch is None else self.welch.warnings
