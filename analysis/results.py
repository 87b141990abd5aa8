"""Results of one record, for all outputs: text, page, files.

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

    from analysis.identify import RecordAnalysis, RecordFit, Selection, Setting
    from analysis.identify.headline import Headline, ReportedValue
    from analysis.identify.verdict import OrderVerdict, Verdict
    from analysis.models import WelchSettings
    from analysis.paper import WelchAnalysis
    from analysis.record import Record
    from rigd.beam import Beam, Damping
    from rigd.session import Validity

_ORDERS: Final = frozenset({"alpha", "lambda"})


FigureFormat = Literal["png", "svg", "pdf"]
FIGURE_FORMATS: Final[tuple[FigureFormat, ...]] = ("png", "svg", "pdf")
DEFAULT_FORMATS: Final[tuple[FigureFormat, ...]] = ("png", "svg")
"""Default formats of the figures: PDF takes as long as PNG and SVG together."""


@dataclass(frozen=True, slots=True)
class Routes:
    """Selection of analyses of a record: Welch's fits, and those of the whole record.

    Attributes
    ----------
    settings : WelchSettings
    paper, whole_record : bool
        Selected analyses.
    fixed : tuple of str
        Settings of rig and specimen that stay at the file's values.
    band_hz : tuple of float or None
        Band of both; None selects the largest suitable band.
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
    """Results of the whole record: all structures fitted, and the selected one.

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
        """Return the fits with their noise, lines and bins."""
        return self.selection.analysis

    @property
    def fits(self) -> Mapping[str, RecordFit]:
        """Return the fits by their names in tables, the lowest BIC first."""
        return {each.name: each.fit for each in self.selection.candidates}

    @property
    def delta_bic(self) -> Mapping[str, float]:
        """Return the BIC above the lowest by the name of the fit."""
        best, *_ = self.selection.candidates
        return {each.name: each.bic - best.bic for each in self.selection.candidates}

    @property
    def headline(self) -> Headline:
        """Return the reported numbers; their fit is one of `fits`."""
        return self.selection.headline

    @property
    def verdict(self) -> Verdict:
        """Return the verdict in sentences for the operator.

        Its second sentence states the validity of the numbers.
        """
        verdict = self.selection.verdict
        first, others = verdict.sentences[:1], verdict.sentences[1:]
        return replace(verdict, sentences=(*first, self.validity.sentence, *others))

    @property
    def orders(self) -> tuple[OrderVerdict, OrderVerdict]:
        """Return the verdicts on both orders."""
        return self.verdict.alpha, self.verdict.lambda_

    @property
    def fit(self) -> RecordFit:
        """Return the fit behind the numbers of the headline."""
        return self.headline.fit

    @property
    def visible_modes(self) -> tuple[int, ...]:
        """Return the numbers of the modes that the record shows."""
        return self.headline.visible_modes

    @property
    def withheld(self) -> frozenset[str]:
        """Return the orders of that fit whose numbers carry a flag."""
        return frozenset(_ORDERS & self.headline.flags.keys())

    @property
    def combined(self) -> dict[str, ReportedValue]:
        """Return the headline's parameters that depend on a scale of stated uncertainty.

        Their standard uncertainties and intervals include that of the scale.
        """
        from analysis.identify.scales import scales_absorbed, with_scales

        if not scales_absorbed(self.fit):
            return {}
        return with_scales(self.headline.parameters, self.record.uncertainty)

    def headline_json(self) -> dict[str, Any]:
        """Return the headline as the content of the JSON document."""
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
        """Return the orders with a flag on an exactly uniform beam, or of absent damping."""
        exact = (self.headline.exact or self.headline).parameters
        flagged = {name for name in _ORDERS & exact.keys() if exact[name].flag is not None}
        return frozenset(flagged | {each.order for each in self.orders if each.value is None})


@dataclass(frozen=True, slots=True)
class RecordResult:
    """Results of all analyses of one record.

    Attributes
    ----------
    record : Record
    whole : WholeRecord or None
        Fits to the whole record; None if they were not run.
    welch : WelchAnalysis or None
        Fits to Welch's estimate, as in the reference paper; None if they were not run.
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
        """Return the name of the record for titles."""
        return self.record.path.name

    @property
    def unsupported(self) -> frozenset[str]:
        """Return the orders that the whole record does not support; none without its fits."""
        return frozenset() if self.whole is None else self.whole.unsupported

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the warnings for the analyst."""
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
        By default the largest suitable band.

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
        Called with a sentence on an omitted analysis.

    Raises
    ------
    SessionError, RecordError
        The file cannot be read, or holds no record that can be analysed.
    FrequencyResponseError, MeasurementError
        No analysis suits the record, or the settings do not.
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
    """Return a record with a stated uniformity; None retains that of the file.

    Parameters
    ----------
    record : Record
    uniformity : float or None
    """
    return record if uniformity is None else replace(record, uniformity=uniformity)


def _with_warnings(record: Record, more: tuple[str, ...]) -> Record:
    return replace(record, warnings=(*record.warnings, *more)) if more else record


def finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Return a copy of a JSON value with null for non-finite numbers, and without numpy types.

    Keys lose the underscore that distinguishes an attribute from a Python keyword (``lambda_``).
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
