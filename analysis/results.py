"""Results of the analyses of one record, from which texts, pages and files are made.

`record_result` analyses a session file and returns a `RecordResult`. A campaign retains part of
each result (`analysis.campaigns.SessionAnalysis`) and combines these in an
`analysis.campaigns.CampaignResult`.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from analysis.identify import (
        Measurement,
        RecordAnalysis,
        RecordFit,
        Selection,
        Setting,
        StructureFit,
    )
    from analysis.identify.headline import Headline
    from analysis.identify.verdict import OrderVerdict, Verdict
    from analysis.models import WelchSettings
    from analysis.paper.welch_analysis import WelchAnalysis
    from analysis.record import Record
    from analysis.record_part import PartOption
    from analysis.structures import AddedStructure
    from rigd.beam import Plant
    from rigd.estimates import Estimate
    from rigd.session import Validity

_ORDER_NAMES: Final = frozenset({"alpha", "lambda"})
"""Names of the orders of the damping."""


FigureFormat = Literal["png", "svg", "pdf"]
"""File format of figures."""
FIGURE_FORMATS: Final[tuple[FigureFormat, ...]] = ("png", "svg", "pdf")
"""File formats in which figures can be written."""
ImagesByName = dict[str, dict[FigureFormat, bytes]]
"""Image files of figures, by the figure's name and the file format."""
DEFAULT_FORMATS: Final[tuple[FigureFormat, ...]] = ("svg",)
"""Default file formats of figures: that of the page. PNG and PDF would each double the time."""


@dataclass(frozen=True, slots=True)
class AnalysisOptions:
    """Selected analyses of a record, with their settings.

    Attributes
    ----------
    settings : WelchSettings
        Settings of the Welch fits.
    with_welch_fits, whole_record : bool
        Whether the Welch fits of the paper, and the fits to the whole record, are run.
    fixed_parameters : tuple of str
        Parameters of rig and specimen that stay at the file's values.
    band_hz : tuple of float or None
        Frequency band of all fits; None selects the largest suitable band.
    figures : tuple of str
        File formats of the report's figures.
    uniformity : float or None
        Relative standard deviation of mode frequencies from those of a uniform beam; None uses the
        value in the file.
    structures : tuple of AddedStructure
        Damping structures of installed packages that are fitted to the whole record as well.
    part_s : tuple of float or None, optional
        Part of the session that is analysed, as for `load_record`; None selects the whole session.
    """

    settings: WelchSettings
    with_welch_fits: bool
    whole_record: bool
    fixed_parameters: tuple[Setting, ...]
    band_hz: tuple[float, float] | None = None
    figures: tuple[FigureFormat, ...] = DEFAULT_FORMATS
    uniformity: float | None = None
    structures: tuple[AddedStructure, ...] = ()
    part_s: PartOption | None = None


@dataclass(frozen=True, slots=True)
class WholeRecord:
    """Fits of all damping structures to a whole record, and the selected structure.

    Attributes
    ----------
    record : Record
        Analysed record.
    selection : Selection
        Candidates, selected fit and verdict.
    band_hz : tuple of float
        Frequency band of the fits.
    fixed_parameters : tuple of str
        Parameters that stayed at the file's values.
    added_fits : tuple of StructureFit
        Fits of damping structures of installed packages, in addition to the selection.
    validity : Validity
        Validity of the linear model for the record.
    """

    record: Record
    selection: Selection
    band_hz: tuple[float, float]
    fixed_parameters: tuple[Setting, ...] = ()
    added_fits: tuple[StructureFit, ...] = ()
    validity: Validity = field(init=False)

    def __post_init__(self) -> None:
        plant = self.fit.plant
        validity = _record_validity(self.record, plant)
        if (beam_test := self.headline.uniform_beam) is not None:
            validity = replace(validity, uniform_beam=beam_test.summary)
        object.__setattr__(self, "validity", validity)

    @property
    def analysis(self) -> RecordAnalysis:
        """Fits with the noise spectrum, the disturbing lines and the frequency bins."""
        return self.selection.analysis

    @property
    def fits(self) -> Mapping[str, RecordFit]:
        """Fits of all damping structures by the structure's name, the lowest BIC first."""
        return {candidate.name: candidate.fit for candidate in self.selection.candidates}

    @property
    def delta_bic(self) -> Mapping[str, float]:
        """Difference of each fit's BIC from the lowest BIC, by the name of its structure."""
        best_candidate, *_ = self.selection.candidates
        return {
            candidate.name: candidate.bic - best_candidate.bic
            for candidate in self.selection.candidates
        }

    @property
    def headline(self) -> Headline:
        """Reported estimates (modes, parameters, loss factors), which follow from one of `fits`."""
        return self.selection.headline

    @property
    def verdict(self) -> Verdict:
        """Verdict on the record, in sentences for the operator.

        The second sentence states the validity of the estimates. If only a part of the session was
        analysed, an additional first sentence states which part.
        """
        verdict = self.selection.verdict
        first_sentence, other_sentences = verdict.sentences[:1], verdict.sentences[1:]
        added_sentences = (structure_fit.sentence for structure_fit in self.added_fits)
        part_text = self.record.part_text
        part_sentences = () if part_text is None else (f"All results are for {part_text}.",)
        return replace(
            verdict,
            sentences=(
                *part_sentences, *first_sentence, self.validity.sentence, *other_sentences,
                *added_sentences,
            ),
        )  # fmt: skip

    @property
    def orders(self) -> tuple[OrderVerdict, OrderVerdict]:
        """Verdicts on the orders of internal and external damping."""
        return self.verdict.alpha, self.verdict.lambda_

    @property
    def fit(self) -> RecordFit:
        """Fit from which the reported estimates follow."""
        return self.headline.fit

    @property
    def visible_modes(self) -> tuple[int, ...]:
        """Numbers of the modes that are visible in the record."""
        return self.headline.visible_modes

    @property
    def withheld_orders(self) -> frozenset[str]:
        """Orders of the damping whose estimate must not be reported, because it has a flag."""
        return frozenset(_ORDER_NAMES & self.headline.flags.keys())

    @property
    def parameters_with_scales(self) -> dict[str, Estimate]:
        """Reported parameters that depend on a scale whose uncertainty the file states.

        Their standard uncertainties and intervals include the uncertainty of the scale.
        """
        from analysis.identify.scales import parameters_compensate_scales, with_scale_uncertainty

        if not parameters_compensate_scales(self.fit):
            return {}
        return with_scale_uncertainty(self.headline.parameters, self.record.uncertainty)

    def headline_json(self) -> dict[str, Any]:
        """Return the reported estimates of the record as the content of a JSON document."""
        from analysis.identify import headline_json
        from analysis.record_checks import SCALE_QUANTITIES

        file_name, findings = str(self.record.path), self.verdict.findings
        json_content = headline_json(file_name, self.headline, self.orders, findings, self.validity)
        exact_geometry = json_content["exact_geometry"]  # None if the parameters assume it
        (json_content if exact_geometry is None else exact_geometry)["covariance"] = (
            self._covariance_json()
        )
        return {
            **json_content,
            "part": self.record.part_json,
            "scale_uncertainty": {
                parameter_name: relative_std
                for parameter_name, relative_std in self.record.uncertainty.items()
                if parameter_name in SCALE_QUANTITIES
            },
            "combined": {
                parameter_name: reported_value.as_json()
                for parameter_name, reported_value in self.parameters_with_scales.items()
            },
        }

    def _covariance_json(self) -> dict[str, Any]:
        """Return the covariance matrix of the fit's parameters, and their names, for JSON.

        A name with the prefix ``ln_`` denotes the logarithm of a parameter.
        """
        from rigd.beam import LOGARITHMIC_PARAMETERS

        return {
            "names": [
                f"ln_{parameter}" if parameter in LOGARITHMIC_PARAMETERS else parameter
                for parameter in self.fit.determined
            ],
            "matrix": self.fit.covariance.tolist(),
        }

    @property
    def unsupported_orders(self) -> frozenset[str]:
        """Orders of damping that the record does not support.

        Their estimate for an exactly uniform beam has a flag, or their damping was not found.
        """
        exact_parameters = (self.headline.exact or self.headline).parameters
        flagged_orders = {
            order_name
            for order_name in _ORDER_NAMES & exact_parameters.keys()
            if exact_parameters[order_name].flag is not None
        }
        return frozenset(
            flagged_orders
            | {order_verdict.order for order_verdict in self.orders if order_verdict.value is None}
        )


@dataclass(frozen=True, slots=True)
class RecordResult:
    """Results of all analyses of one record.

    Attributes
    ----------
    record : Record
        Analysed record.
    whole : WholeRecord or None
        Fits to the whole record; None if they were not run.
    welch : WelchAnalysis or None
        Fits to Welch's estimate, as in the reference paper; None if they were not run.
    validity : Validity
        Validity of the linear model for the record.
    """

    record: Record
    whole: WholeRecord | None = None
    welch: WelchAnalysis | None = None
    validity: Validity = field(init=False)

    def __post_init__(self) -> None:
        if self.whole is not None:
            validity = self.whole.validity
        else:
            # The Welch fits differ, and the largest slope of the tip among them is used.
            fitted_models = () if self.welch is None else self.welch.models
            from rigd.beam import Plant

            fitted_dampings = [model.fit.damping for model in fitted_models]
            validity = _record_validity(
                self.record, *(Plant(self.record.beam, damping) for damping in fitted_dampings)
            )
        object.__setattr__(self, "validity", validity)

    @property
    def name(self) -> str:
        """Name of the session file, and the analysed part of the session, for titles."""
        part_text = self.record.part_text
        return f"{self.record.path.name}{'' if part_text is None else f', {part_text}'}"

    @property
    def unsupported_orders(self) -> frozenset[str]:
        """Orders of damping that the record does not support; empty without whole-record fits."""
        return frozenset() if self.whole is None else self.whole.unsupported_orders

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on weaknesses of the record, and of the Welch fits if there are any."""
        return self.record.warnings if self.welch is None else self.welch.warnings


def _record_validity(record: Record, *plants: Plant) -> Validity:
    """Return the validity of the linear model for a record and plants estimated from it."""
    from analysis.validity import record_validity

    return record_validity(record.metadata, record.angle_rad, record.rate_hz, *plants)


def whole_record(
    record: Record,
    fixed_parameters: tuple[Setting, ...] = (),
    band_hz: tuple[float, float] | None = None,
) -> WholeRecord:
    """Fit every damping structure to a whole record, and select the best supported one.

    The fits are stored in the user's cache, and read there if they were computed before (see
    `analysis.identify.fit_cache`).

    Parameters
    ----------
    record : Record
        Record of a session.
    fixed_parameters : tuple of str
        Parameters that stay at the file's values.
    band_hz : tuple of float, optional
        Frequency band, by default the largest suitable one.

    Raises
    ------
    MeasurementError
        The record cannot be used, or not in this band.
    """
    from analysis.identify import select
    from analysis.identify.fit_cache import FitCache

    measurement, band_hz = _fitted_measurement(record, band_hz)
    fit_cache = FitCache.of_user()
    selection = (
        None if fit_cache is None else fit_cache.find(measurement, fixed_parameters, band_hz)
    )
    if selection is None:
        selection = select(measurement, fixed_settings=fixed_parameters, band_hz=band_hz)
        if fit_cache is not None:
            fit_cache.store(selection, measurement, fixed_parameters, band_hz)
    return WholeRecord(record, selection, band_hz, fixed_parameters)


def stored_whole_record(
    record: Record,
    fixed_parameters: tuple[Setting, ...] = (),
    band_hz: tuple[float, float] | None = None,
) -> WholeRecord | None:
    """Return the result of `whole_record` if the user's cache has these fits, else None.

    Parameters
    ----------
    record, fixed_parameters, band_hz
        Arguments of :func:`whole_record`.

    Raises
    ------
    MeasurementError
        The record cannot be used, or not in this band.
    """
    from analysis.identify.fit_cache import FitCache

    measurement, band_hz = _fitted_measurement(record, band_hz)
    if (fit_cache := FitCache.of_user()) is None:
        return None
    selection = fit_cache.find(measurement, fixed_parameters, band_hz)
    if selection is None:
        return None
    return WholeRecord(record, selection, band_hz, fixed_parameters)


def _fitted_measurement(
    record: Record, band_hz: tuple[float, float] | None
) -> tuple[Measurement, tuple[float, float]]:
    """Return the measurement of a record to which structures are fitted, and the fits' band."""
    from analysis.applicability import check_excited_band, record_band_hz
    from analysis.identify import Measurement

    check_excited_band(record, band_hz)
    return Measurement.from_record(record), record_band_hz(record, band_hz)


def record_result(
    path: Path,
    options: AnalysisOptions,
    *,
    on_step: Callable[[str], None] = lambda _step_text: None,
    warn: Callable[[str], None] = lambda _warning_text: None,
    on_welch: Callable[[WelchAnalysis], None] = lambda _welch_analysis: None,
    on_whole: Callable[[WholeRecord], None] = lambda _whole_fits: None,
) -> RecordResult:
    """Run the selected analyses of a session file.

    Parameters
    ----------
    path : Path
        Session file.
    options : AnalysisOptions
        Selected analyses and their settings.
    on_step : callable, optional
        Called after each step with the step's name.
    warn : callable, optional
        Called with a sentence on each omitted analysis.
    on_welch : callable, optional
        Called with the Welch fits while another process fits the whole record.
    on_whole : callable, optional
        Called with the fits to the whole record while another process makes the Welch fits, which
        take longer if the former are stored in the user's cache.

    Raises
    ------
    SessionError, RecordError
        The file cannot be read, or contains no record that can be analysed.
    FrequencyResponseError, MeasurementError
        No analysis is applicable to the record, or the settings are not.
    """
    from analysis.applicability import (
        analysis_remarks,
        check_record_band,
        highest_frequency_hz,
        welch_analysis,
        welch_exclusion_reason,
    )
    from analysis.identify import MeasurementError
    from analysis.record import load_record
    from rigd.runtime.computations import computed_in_parallel

    record = load_record(path, options.part_s, highest_hz=highest_frequency_hz(options.band_hz))
    record = with_uniformity(record, options.uniformity)
    record = _add_warnings(record, analysis_remarks(record, options.band_hz))
    on_step("read")
    whole_fits: WholeRecord | None = None
    warning_texts: list[str] = []
    if not options.with_welch_fits:
        check_record_band(record, options.band_hz)
        on_step("whole record")
        whole_fits, warning_texts = _fit_whole_record(record, options)
        for warning_text in warning_texts:
            warn(warning_text)
        return RecordResult(record, whole_fits)
    fit_welch = cache(
        partial(
            welch_analysis,
            record,
            options.settings,
            options.band_hz,
            is_optional=options.whole_record,
        )
    )
    if not options.whole_record:
        on_step("Welch fits")
        return RecordResult(record, None, fit_welch()[0])
    on_step("Welch fits and whole record")
    if not options.settings.are_from_paper:
        fit_welch()  # chosen settings may not suit the record, which is reported at once
    measurement_error = None
    # Another process takes memory, and this one would only wait for it without Welch fits.
    are_omitted = options.settings.are_from_paper and welch_exclusion_reason(
        record, options.band_hz
    )
    computed_meanwhile = nullcontext if are_omitted else computed_in_parallel
    if (stored_fits := _stored_fits(record, options)) is not None:
        with computed_meanwhile(fit_welch) as welch_fits:
            whole_fits = _add_structure_fits(stored_fits, options.structures, warning_texts.append)
            on_whole(whole_fits)
            welch_results, omission_remark = welch_fits()
    else:
        fit_whole = partial(_fit_whole_record, record, options)
        with computed_meanwhile(fit_whole) as whole_fits_with_warnings:
            welch_results, omission_remark = fit_welch()
            if welch_results is not None:
                on_welch(welch_results)
            try:
                whole_fits, warning_texts = whole_fits_with_warnings()
            except MeasurementError as error:
                measurement_error = error
    for warning_text in warning_texts:
        warn(warning_text)
    if omission_remark is not None:
        warn(f"{path}: {omission_remark}")
        record = _add_warnings(record, (omission_remark,))
    if measurement_error is not None:
        if welch_results is None:
            raise measurement_error
        warn(f"{measurement_error} Only the Welch fits were run.")
    return RecordResult(
        record,
        None if whole_fits is None else replace(whole_fits, record=record),
        None if welch_results is None else replace(welch_results, record=record),
    )


def _stored_fits(record: Record, options: AnalysisOptions) -> WholeRecord | None:
    """Return the fits to a whole record if they are stored; None also if it cannot be used."""
    from analysis.identify import MeasurementError

    try:
        return stored_whole_record(record, options.fixed_parameters, options.band_hz)
    except MeasurementError:
        return None  # the fits raise this error, after the Welch fits


def _fit_whole_record(record: Record, options: AnalysisOptions) -> tuple[WholeRecord, list[str]]:
    """Fit all structures to a whole record, including the selected ones of installed packages.

    Return the fits, and warnings of structures that cannot be fitted.
    """
    whole_fits = whole_record(record, options.fixed_parameters, options.band_hz)
    warning_texts: list[str] = []
    return _add_structure_fits(whole_fits, options.structures, warning_texts.append), warning_texts


def _add_structure_fits(
    whole_fits: WholeRecord,
    structures: tuple[AddedStructure, ...],
    warn: Callable[[str], None],
) -> WholeRecord:
    """Return the fits with those of added structures; warn of each that cannot be fitted."""
    if not structures:
        return whole_fits
    from analysis.identify import fit_structure
    from rigd.plugins import PluginError

    structure_fits = []
    for added_structure in structures:
        try:
            structure_fit = fit_structure(
                added_structure, whole_fits.selection, whole_fits.fixed_parameters
            )
        except PluginError as error:
            warn(f"{whole_fits.record.path}: {error}")
            continue
        if structure_fit is None:
            warn(
                f"{whole_fits.record.path}: the record shows an effect beyond the damping of a "
                f"beam, with which the structure {added_structure.structure.name} is not fitted."
            )
        else:
            structure_fits.append(structure_fit)
    return replace(whole_fits, added_fits=tuple(structure_fits))


def with_uniformity(record: Record, uniformity: float | None) -> Record:
    """Return a record whose stated uniformity of the beam is replaced.

    Parameters
    ----------
    record : Record
        Record with the uniformity stated in its file.
    uniformity : float or None
        Relative standard deviation of mode frequencies; None retains the record's value.
    """
    return record if uniformity is None else replace(record, uniformity=uniformity)


def _add_warnings(record: Record, warnings: tuple[str, ...]) -> Record:
    """Return a record with additional warnings."""
    return replace(record, warnings=(*record.warnings, *warnings)) if warnings else record


def finite_json(json_value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Return a copy of a JSON value with null for non-finite numbers, and without NumPy types.

    A trailing underscore, which distinguishes an attribute from a Python keyword (``lambda_``), is
    removed from keys.
    """
    from numpy import generic

    def copy_value(json_value: Any) -> Any:  # noqa: ANN401
        """Return a deep copy of a JSON value."""
        if isinstance(json_value, dict):
            return {
                str(key).rstrip("_"): copy_value(json_item) for key, json_item in json_value.items()
            }
        if isinstance(json_value, list | tuple):
            return [copy_value(json_item) for json_item in json_value]
        if isinstance(json_value, generic):
            json_value = json_value.item()
        return (
            None if isinstance(json_value, float) and not math.isfinite(json_value) else json_value
        )

    return copy_value(json_value)
