"""Results of one record, as computing hands them to all that shows them: text, page, files.

`record_result` makes a `RecordResult` from a session file. A campaign retains the parts of each
that it needs (`analysis.campaigns.SessionAnalysis`) and combines them in an
`analysis.campaigns.CampaignResult`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from analysis.identify import (
        Headline,
        OrderVerdict,
        Quantity,
        RecordAnalysis,
        RecordFit,
        Selection,
        Setting,
        Verdict,
    )
    from analysis.models import WelchSettings
    from analysis.paper import WelchAnalysis
    from analysis.record import Record
    from rigd.beam import Beam, Damping
    from rigd.session import Validity

_ORDERS: Final = frozenset({"alpha", "lambda"})


FigureFormat = Literal["png", "svg", "pdf"]
FIGURE_FORMATS: Final[tuple[FigureFormat, ...]] = ("png", "svg", "pdf")
DEFAULT_FORMATS: Final[tuple[FigureFormat, ...]] = ("png", "svg")
"""Formats of the figures unless asked for: PDF takes as long as PNG and SVG together."""


@dataclass(frozen=True, slots=True)
class Routes:
    """What is done with a record: Welch's fits, by these settings, and those of the whole record.

    Attributes
    ----------
    settings : WelchSettings
    paper, whole_record : bool
        Which of the two.
    fixed : tuple of str
        Settings of rig and specimen that stay at the file's values.
    band_hz : tuple of float or None
        Band of both; None takes what suits the record.
    figures : tuple of str
        Formats of the report's figures.
    uniformity : float or None
        Relative standard deviation of each mode's frequency from that of a uniform beam; None takes
        the file's.
    """

    settings: WelchSettings
    paper: bool
    whole_record: bool
    fixed: tuple[Setting, ...]
    band_hz: tuple[float, float] | None = None
    figures: tuple[FigureFormat, ...] = DEFAULT_FORMATS
    uniformity: float | None = None


@dataclass(frozen=True, slots=True)
class WholeRecord:
    """What the whole record gave: all structures fitted to it, and which of them it supports.

    Attributes
    ----------
    record : Record
    selection : Selection
    band_hz : tuple of float
        Band of the fits.
    fixed : tuple of str
        Settings that stayed at the file's values in them.
    validity : Validity
        How exact the linear model is for the record.
    """

    record: Record
    selection: Selection
    band_hz: tuple[float, float]
    fixed: tuple[Setting, ...] = ()
    validity: Validity = field(init=False)

    def __post_init__(self) -> None:
        plant = self.fit.plant
        validity = _validity(self.record, (plant.beam, plant.damping))
        if (test := self.headline.uniform_beam) is not None:
            validity = replace(validity, uniform_beam=test.summary)
        object.__setattr__(self, "validity", validity)

    @property
    def analysis(self) -> RecordAnalysis:
        """The fits with the noise, the lines and the bins that are theirs."""
        return self.selection.analysis

    @property
    def fits(self) -> Mapping[str, RecordFit]:
        """Fits by the name that tables call them, the lowest BIC first."""
        return {each.name: each.fit for each in self.selection.candidates}

    @property
    def delta_bic(self) -> Mapping[str, float]:
        """BIC above the lowest by the name of the fit."""
        best, *_ = self.selection.candidates
        return {each.name: each.bic - best.bic for each in self.selection.candidates}

    @property
    def headline(self) -> Headline:
        """The numbers that are told first; its fit is one of `fits`."""
        return self.selection.headline

    @property
    def verdict(self) -> Verdict:
        """What can be told from the data and what cannot, in the operator's words.

        Its second sentence is on the validity of the numbers.
        """
        verdict = self.selection.verdict
        first, others = verdict.sentences[:1], verdict.sentences[1:]
        return replace(verdict, sentences=(*first, self.validity.sentence, *others))

    @property
    def orders(self) -> tuple[OrderVerdict, OrderVerdict]:
        """What is known of each order."""
        return self.verdict.alpha, self.verdict.lambda_

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
    def combined(self) -> dict[str, Quantity]:
        """The headline's parameters that a scale acts on whose uncertainty the file states.

        With standard uncertainties and intervals that include it.
        """
        from analysis.identify import scales_absorbed, with_scales

        if not scales_absorbed(self.fit):
            return {}
        return with_scales(self.headline.parameters, self.record.uncertainty)

    def headline_json(self) -> dict[str, Any]:
        """Write the headline as the JSON document has it."""
        from analysis.identify import headline_json
        from analysis.record_checks import SCALES

        file, findings = str(self.record.path), self.verdict.findings
        content = headline_json(file, self.headline, self.orders, findings, self.validity)
        exact = content["exact_geometry"]  # None: the parameters are those of an exact geometry
        (content if exact is None else exact)["covariance"] = self._covariance_json()
        return {
            **content,
            "scale_uncertainty": {
                name: value for name, value in self.record.uncertainty.items() if name in SCALES
            },
            "combined": {name: each.as_json() for name, each in self.combined.items()},
        }

    def _covariance_json(self) -> dict[str, Any]:
        """Return the covariance of the fit, with ``ln_`` before the names of logarithms."""
        from analysis.identify import LOGARITHMIC

        return {
            "names": [
                f"ln_{each}" if each in LOGARITHMIC else each for each in self.fit.determined
            ],
            "matrix": self.fit.covariance.tolist(),
        }

    @property
    def unsupported(self) -> frozenset[str]:
        """Orders flagged on an exactly uniform beam, or of absent damping."""
        exact = (self.headline.exact or self.headline).parameters
        flagged = {name for name in _ORDERS & exact.keys() if exact[name].flag is not None}
        return frozenset(flagged | {each.order for each in self.orders if each.value is None})


@dataclass(frozen=True, slots=True)
class RecordResult:
    """One record with everything that was found in it.

    Attributes
    ----------
    record : Record
    whole : WholeRecord or None
        Fits to the whole record; None if they were not run.
    welch : WelchAnalysis or None
        Fits to Welch's estimate, as in the paper; None if they were not run.
    validity : Validity
        How exact the linear model is for the record.
    """

    record: Record
    whole: WholeRecord | None = None
    welch: WelchAnalysis | None = None
    validity: Validity = field(init=False)

    def __post_init__(self) -> None:
        if self.whole is not None:
            validity = self.whole.validity
        else:
            # Welch's fits differ: the slope is up to the largest of theirs.
            models = () if self.welch is None else self.welch.models
            dampings = [each.fit.damping for each in models]
            validity = _validity(self.record, *((self.record.beam, each) for each in dampings))
        object.__setattr__(self, "validity", validity)

    @property
    def name(self) -> str:
        """What titles call the record."""
        return self.record.path.name

    @property
    def unsupported(self) -> frozenset[str]:
        """Orders that the whole record does not support; none are known without its fits."""
        return frozenset() if self.whole is None else self.whole.unsupported

    @property
    def warnings(self) -> tuple[str, ...]:
        """What an analyst should read beside the results."""
        return self.record.warnings if self.welch is None else self.welch.warnings


def _validity(record: Record, *models: tuple[Beam, Damping]) -> Validity:
    from analysis.validity import record_validity

    return record_validity(record.metadata, record.angle_rad, record.rate_hz, *models)


def whole_record(
    record: Record, fixed: tuple[Setting, ...] = (), band_hz: tuple[float, float] | None = None
) -> WholeRecord:
    """Fit every structure to a whole record, and select the one that its data support.

    Parameters
    ----------
    record : Record
    fixed : tuple of str
        Settings that stay at the file's values.
    band_hz : tuple of float, optional
        By default what suits the record.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    """
    from analysis.identify import Measurement, select
    from analysis.suited import record_band_hz

    band_hz = record_band_hz(record, band_hz)
    selection = select(Measurement.of_record(record), fixed=fixed, band_hz=band_hz)
    return WholeRecord(record, selection, band_hz, fixed)


def record_result(
    path: Path,
    routes: Routes,
    *,
    on_step: Callable[[str], None] = lambda _done: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> RecordResult:
    """Analyse a session file.

    Parameters
    ----------
    path : Path
    routes : Routes
    on_step : callable, optional
        Called with a few words after each step.
    warn : callable, optional
        Called with a sentence on what was left out.

    Raises
    ------
    SessionError, RecordError
        The file cannot be read, or holds no record that can be analysed.
    EstimateError, MeasurementError
        No route suits the record, or the settings do not.
    """
    from analysis.identify import MeasurementError
    from analysis.record import load_record
    from analysis.suited import check_record_band, remarks, welch_analysis

    record = with_uniformity(load_record(path), routes.uniformity)
    record = _with_warnings(record, remarks(record, routes.band_hz))
    on_step("read")
    if not routes.paper:
        check_record_band(record, routes.band_hz)
    welch, left_out = None, None
    if routes.paper:
        welch, left_out = welch_analysis(
            record, routes.settings, routes.band_hz,
            optional=routes.whole_record, on_step=on_step,
        )  # fmt: skip
    if left_out:
        warn(f"{path}: {left_out}")
        record = _with_warnings(record, (left_out,))
    whole = None
    if routes.whole_record:
        on_step("whole record")
        try:
            whole = whole_record(record, routes.fixed, routes.band_hz)
        except MeasurementError as error:
            if welch is None:
                raise
            warn(f"{error} Only the Welch fits were run.")
    return RecordResult(record, whole, welch)


def with_uniformity(record: Record, uniformity: float | None) -> Record:
    """Replace the uniformity of a record by a stated one; None leaves the file's.

    Parameters
    ----------
    record : Record
    uniformity : float or None
    """
    return record if uniformity is None else replace(record, uniformity=uniformity)


def _with_warnings(record: Record, more: tuple[str, ...]) -> Record:
    return replace(record, warnings=(*record.warnings, *more)) if more else record


def finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Copy a JSON value with null for numbers that are not finite and plain numbers for numpy's.

    Keys lose the underscore by which an attribute is told from a word of Python (``lambda_``).
    """
    from numpy import generic

    def copy(value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, dict):
            return {str(key).rstrip("_"): copy(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [copy(item) for item in value]
        if isinstance(value, generic):
            value = value.item()
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return copy(value)
