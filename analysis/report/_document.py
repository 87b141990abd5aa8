"""Results of an analysis as one JSON document, without NaN: unknown values are null.

The document also contains the paper's indices, Eqs. (28) to (30), of every fit.

A whole-record fit does not minimise the distance to Welch's estimate, and that estimate is biased
at the resonances, so that even the true model differs from it. Each fit is therefore also compared
with the ratio of the whole record's transforms, which is noisy but not biased.
"""

from __future__ import annotations

import json
import platform
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np

import rigd
from analysis.paper.welch_analysis import fit_indices
from analysis.report._shown_model import ShownModel
from analysis.report.bands import loss_estimate, loss_factors, supported_band_hz
from analysis.report.table import unreported_parameters
from analysis.results import finite_json
from analysis.statistics import nrmse_percent
from rigd.beam import Plant, ResponseGrid

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify import PivotLossFactor, RecordFit, StructureFit
    from analysis.paper.welch_analysis import FittedModel, WelchAnalysis
    from analysis.record import Record
    from analysis.report.bands import LossFactor
    from analysis.results import RecordResult, WholeRecord
    from rigd.spectral import FrequencyResponse

    # Values of the paper's indices by name: mse, wmse, md.
    IndexValues = dict[str, float | None]

NO_INDEX_VALUES: dict[str, float | None] = {"mse": None, "wmse": None, "md": None}
"""Indices MSE, WMSE and MD of a fit if there is no measured response to compare it with."""


def indices_of_record_fit(
    fit: RecordFit, welch_analysis: WelchAnalysis
) -> tuple[IndexValues, IndexValues]:
    """Return MSE, WMSE and MD of a whole-record fit against two measured responses.

    These are Welch's estimate and the ratio of the whole record's Fourier transforms, in the band
    of the Welch fits. Both have the keys ``mse`` and ``wmse`` in (N·m/rad)², and ``md`` in N·m/rad.
    """
    record = welch_analysis.record
    # The delay stated in the file has been removed from the responses.
    stated_delay_s = record.torque_delay_s - record.angle_delay_s
    delayed_plant = replace(fit.plant, delay_s=fit.plant.delay_s - stated_delay_s)

    def indices_against(measured_frf: FrequencyResponse) -> IndexValues:
        (model_response,) = ResponseGrid(2j * np.pi * measured_frf.frequency_hz).evaluate(
            delayed_plant, ()
        )
        return _fit_indices(measured_frf, model_response)

    return indices_against(welch_analysis.response), indices_against(welch_analysis.whole_record)


def whole_record_indices(welch_analysis: WelchAnalysis) -> list[IndexValues]:
    """Return MSE, WMSE and MD of each Welch fit against the ratio of the record's transforms."""
    measured_frf, record = welch_analysis.whole_record, welch_analysis.record
    response_grid = ResponseGrid(2j * np.pi * measured_frf.frequency_hz)
    plants = (
        Plant(record.beam, model.fit.damping, tool_inertia_kg_m2=record.tool_inertia_kg_m2)
        for model in welch_analysis.models
    )
    return [_fit_indices(measured_frf, response_grid.evaluate(plant)[0]) for plant in plants]


def _fit_indices(
    measured_frf: FrequencyResponse, model_response: NDArray[np.complex128]
) -> IndexValues:
    """Return the errors MSE, WMSE and MD of a model's response against a measured response."""
    is_finite = np.isfinite(measured_frf.response)
    if not is_finite.any():
        return NO_INDEX_VALUES
    omega_rad_s = 2 * np.pi * measured_frf.frequency_hz[is_finite]
    return asdict(
        fit_indices(omega_rad_s, measured_frf.response[is_finite], model_response[is_finite])
    )


def response_fit_percent(welch_analysis: WelchAnalysis, model: FittedModel) -> float:
    """Return how well a Welch fit reproduces the measured response, in percent (100 % = exact).

    `model` is one of the fitted models of `welch_analysis`.
    """
    measured_frf = welch_analysis.response.response
    is_finite = np.isfinite(measured_frf)
    measured_frf, modelled_frf = measured_frf[is_finite], model.response[is_finite]
    return nrmse_percent(measured_frf - modelled_frf, measured_frf - measured_frf.mean())


_CURVE_POINTS = 200
"""Number of frequencies at which the document states response and loss factors."""


def record_entries(
    whole_record: WholeRecord, welch_analysis: WelchAnalysis | None
) -> dict[str, Any]:
    """Return the entries of the JSON document for one whole record.

    ``headline``: reported estimates with flags. ``fits`` and ``modes``: lists of objects like those
    of the Welch fits, with ``estimator`` "record". ``records``: one object with verdict, noise,
    hum, and response and loss factors with their 95 % bands. Numbers may have NumPy's types or be
    infinite or NaN (see `finite_json`).

    Values that are not reported are flagged instead of omitted: ``withheld`` of a fit names the
    parameters that the data do not support, ``visible`` of a mode states whether the record shows
    it. ``indices`` are distances from Welch's response, as for the paper's fits, and
    ``indices_whole_record`` are distances from the ratio of the whole record's transforms.
    """
    fits_with_keys = [
        (
            {
                "file": str(whole_record.record.path),
                "estimator": "record",
                "type": fit.structure.name,
                "weighting": None,
                "candidate": fit_name,
                "selected": fit_name == whole_record.headline.name,
            },
            fit,
        )
        for fit_name, fit in whole_record.fits.items()
    ]
    index_values = [
        (NO_INDEX_VALUES, NO_INDEX_VALUES)
        if welch_analysis is None
        else indices_of_record_fit(fit, welch_analysis)
        for _, fit in fits_with_keys
    ]
    return {
        "headline": whole_record.headline_json(),
        "fits": [
            {
                **fit_key,
                "free": [*fit.interval],
                "parameters": dict(fit.parameters),
                "withheld": sorted(
                    unreported_parameters(fit.structure, whole_record.unsupported_orders)
                ),
                "std": fit.std_of_free_parameters,
                "interval_95": {
                    key: None if order_interval is None else list(order_interval)
                    for key, order_interval in fit.interval.items()
                },
                "cost": fit.cost,
                "degrees_of_freedom": fit.degrees_of_freedom,
                "at_bounds": list(fit.at_bounds),
                "nrmse_percent": whole_record.analysis.fit_percent(fit),
                "determined": list(fit.determined),
                "covariance": fit.covariance.tolist(),
                "internal_size": _pivot_loss_factor_json(fit.internal),
                "external_size": _pivot_loss_factor_json(fit.external),
                "ringing": {**asdict(fit.ringing), "significant": fit.ringing.is_significant},
                "indices": welch_indices,
                "indices_whole_record": record_indices,
            }
            for (fit_key, fit), (welch_indices, record_indices) in zip(
                fits_with_keys, index_values, strict=True
            )
        ],
        "modes": [
            {
                **fit_key,
                "mode": mode.number,
                "visible": mode.shown,
                "source": mode.source,
                "frequency_hz": mode.frequency_hz.value,
                "frequency_std_hz": mode.frequency_hz.std,
                "damping_ratio": mode.damping_ratio.value,
                "damping_ratio_std": mode.damping_ratio.std,
            }
            # The reported modes come first, because narrow sweeps are planned from them.
            for fit_key, _ in fits_with_keys
            if fit_key["selected"]
            for mode in whole_record.headline.modes
        ],
        "records": [
            {
                "file": str(whole_record.record.path),
                "selected": whole_record.headline.name,
                "verdict": list(whole_record.verdict.sentences),
                "experiments": list(whole_record.verdict.experiments),
                "withheld": sorted(whole_record.withheld_orders),
                "orders": {
                    order_estimate.order: {
                        "status": order_estimate.status,
                        "value": order_estimate.value,
                        "interval_95": None
                        if order_estimate.interval is None
                        else list(order_estimate.interval),
                    }
                    for order_estimate in whole_record.orders
                },
                "band_hz": list(whole_record.band_hz),
                "fixed": list(whole_record.fixed_parameters),
                "hum": [asdict(spectral_line) for spectral_line in whole_record.analysis.lines],
                "curves": _curves_json(whole_record),
                "added_structures": [
                    _added_structure_json(structure_fit, whole_record)
                    for structure_fit in whole_record.added_fits
                ],
            }
        ],
    }


def _added_structure_json(structure_fit: StructureFit, whole_record: WholeRecord) -> dict[str, Any]:
    """Return the JSON object of the fit of a package's damping structure."""
    return {
        "structure": structure_fit.structure.name,
        "description": structure_fit.structure.description,
        "package": structure_fit.package,
        "free": list(structure_fit.std),
        "parameters": dict(structure_fit.parameters),
        "units": {each.name: each.unit for each in structure_fit.structure.parameters},
        "std": dict(structure_fit.std),
        "at_bounds": list(structure_fit.at_bounds),
        "loss_factors": [
            {"frequency_hz": frequency_hz, "loss_factor": loss_factor}
            for frequency_hz, loss_factor in structure_fit.loss_factors
        ],
        "cost": structure_fit.cost,
        "degrees_of_freedom": structure_fit.degrees_of_freedom,
        "nrmse_percent": whole_record.analysis.fit_percent(structure_fit),
        "delta_bic": structure_fit.delta_bic,
        "compared_with": structure_fit.compared_with,
    }


def _pivot_loss_factor_json(pivot_loss_factor: PivotLossFactor | None) -> dict[str, Any] | None:
    """Return the loss factor (or coefficient) of a damping for JSON; None if unknown."""
    return None if pivot_loss_factor is None else asdict(pivot_loss_factor)


def _curves_json(whole_record: WholeRecord) -> dict[str, Any]:
    """Return the displayed model's response and the loss factors over the band, as JSON lists."""
    first_hz, last_hz = whole_record.band_hz
    frequency_hz = np.geomspace(max(first_hz, last_hz / 200), last_hz, _CURVE_POINTS)
    model, loss_model = (
        ShownModel.from_headline(whole_record.headline, whole_record.record),
        loss_estimate(whole_record),
    )
    model_band = model.band(frequency_hz)
    lower_magnitude, upper_magnitude = model_band.magnitude_limits()
    loss_factors_over_frequency = (
        None if loss_model is None else loss_factors(loss_model, frequency_hz)
    )
    supported_limits_hz = supported_band_hz(whole_record)
    return {
        "model": "beam" if model.modal is None else "modal",
        "frequency_hz": frequency_hz.tolist(),
        "magnitude_nm_per_rad": np.abs(model_band.response).tolist(),
        "magnitude_low_nm_per_rad": lower_magnitude.tolist(),
        "magnitude_high_nm_per_rad": upper_magnitude.tolist(),
        "phase_rad": np.angle(model_band.response).tolist(),
        "phase_std_rad": model_band.phase_std_rad.tolist(),
        "loss_factor_supported_hz": None
        if supported_limits_hz is None
        else list(supported_limits_hz),
        "loss_factor": None
        if loss_factors_over_frequency is None
        else _loss_factor_json(loss_factors_over_frequency.total),
        "internal_loss_factor": None
        if loss_factors_over_frequency is None
        else _loss_factor_json(loss_factors_over_frequency.internal),
        "external_loss_factor": None
        if loss_factors_over_frequency is None
        else _loss_factor_json(loss_factors_over_frequency.external),
    }


def _loss_factor_json(loss_factor: LossFactor | None) -> dict[str, list[float]] | None:
    """Return a loss factor over frequency with its 95 % band as lists; None for no loss factor."""
    if loss_factor is None:
        return None
    lower_limit, upper_limit = loss_factor.limits()
    return {
        "value": loss_factor.value.tolist(),
        "low": lower_limit.tolist(),
        "high": upper_limit.tolist(),
    }


def document(
    record_results: Sequence[RecordResult], error_messages: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the results of all files as one JSON document.

    Parameters
    ----------
    record_results : sequence of RecordResult
        Results of each file.
    error_messages : mapping of str to str, optional
        Message for each file that could not be analysed.

    Returns
    -------
    dict
        Lists of objects that name their file: ``headlines`` (result of each whole record, with
        flags), ``files`` (properties of the record, validity of the linear model, and settings of
        the Welch method), ``fits`` and ``modes`` (first those of the Welch method, then those of
        the whole records), ``peaks``, ``records`` and ``errors``; and ``versions``. All numbers are
        finite.
    """
    record_entries_by_file = [
        record_entries(result.whole, result.welch) for result in record_results if result.whole
    ]
    welch_analyses = [
        (result.welch, result.unsupported_orders) for result in record_results if result.welch
    ]
    document_content: dict[str, Any] = finite_json(
        {
            "versions": program_versions(),
            "files": [
                {**file_facts, "validity": result.validity.as_json()}
                for result, file_facts in (
                    *(
                        (result, _welch_file_json(result.welch))
                        for result in record_results
                        if result.welch
                    ),
                    *(
                        (result, _record_json(result.record, result.warnings))
                        for result in record_results
                        if result.welch is None
                    ),
                )
            ],
            "fits": [
                *(
                    fit
                    for analysis, unsupported_orders in welch_analyses
                    for fit in _welch_fits_json(analysis, unsupported_orders)
                ),
                *(fit for file_entries in record_entries_by_file for fit in file_entries["fits"]),
            ],
            "modes": [
                *(
                    mode
                    for analysis, _ in welch_analyses
                    for model in analysis.models
                    for mode in _welch_modes_json(analysis, model)
                ),
                *(
                    mode
                    for file_entries in record_entries_by_file
                    for mode in file_entries["modes"]
                ),
            ],
            "headlines": [file_entries["headline"] for file_entries in record_entries_by_file],
            "records": [
                record_entry
                for file_entries in record_entries_by_file
                for record_entry in file_entries["records"]
            ],
            "peaks": [
                {
                    "file": str(analysis.record.path),
                    "mode": mode_number,
                    "frequency_hz": None if resonance_peak is None else resonance_peak.frequency_hz,
                    "magnitude_db": None if resonance_peak is None else resonance_peak.magnitude_db,
                }
                for analysis, _ in welch_analyses
                for mode_number, resonance_peak in enumerate(analysis.peaks, start=1)
            ],
            "errors": [
                {"file": file, "message": message}
                for file, message in (error_messages or {}).items()
            ],
        }
    )
    return document_content


def document_text(document_content: Mapping[str, Any], *, ascii_only: bool = False) -> str:
    """Return a document as JSON text with a newline at its end.

    Parameters
    ----------
    document_content : mapping
        Document, without NaN and infinite numbers.
    ascii_only : bool
        Whether characters outside ASCII are escaped, for a stream of unknown encoding.
    """
    return json.dumps(document_content, indent=2, ensure_ascii=ascii_only, allow_nan=False) + "\n"


def _welch_file_json(analysis: WelchAnalysis) -> dict[str, Any]:
    """Return the JSON object of a file with a Welch analysis, including the settings."""
    settings, response = analysis.settings, analysis.response
    return {
        **_record_json(analysis.record, analysis.warnings),
        "settings": {
            **asdict(settings),
            **asdict(analysis.segmentation),
            "band_hz": list(settings.band_hz),
            "types": list(settings.types),
            "weightings": list(settings.weightings),
            "segments": response.segments,
            "bins": len(response.frequency_hz),
        },
    }


def _record_json(record: Record, warnings: Sequence[str]) -> dict[str, Any]:
    """Return the JSON object of a record: rate, samples, beam, delays, gaps and warnings."""
    return {
        "file": str(record.path),
        "outcome": record.outcome,
        "rate_hz": record.full_rate.rate_hz,
        "analysed_rate_hz": record.rate_hz,
        "part": record.part_json,
        "samples": record.full_rate.samples,
        "sweep_first": record.full_rate.sweep.start,
        "sweep_end": record.full_rate.sweep.stop,
        "beam_length_m": record.beam.length_m,
        "beam_density_kg_per_m": record.beam.density_kg_per_m,
        "beam_bending_stiffness_n_m2": record.beam.bending_stiffness_n_m2,
        "tool_inertia_kg_m2": record.tool_inertia_kg_m2,
        "angle_delay_s": record.angle_delay_s,
        "torque_delay_s": record.torque_delay_s,
        "gaps": asdict(record.gaps),
        "flags": dict(record.flags),
        "warnings": list(warnings),
    }


def _welch_fits_json(
    analysis: WelchAnalysis, unsupported_orders: Collection[str]
) -> list[dict[str, Any]]:
    """Return the JSON objects of the models that are fitted to a record's Welch response."""
    record_indices = whole_record_indices(analysis)
    return [
        {
            **_welch_fit_json(analysis, model, unsupported_orders),
            "indices_whole_record": indices_of_record,
        }
        for model, indices_of_record in zip(analysis.models, record_indices, strict=True)
    ]


def _welch_fit_json(
    analysis: WelchAnalysis, model: FittedModel, unsupported_orders: Collection[str]
) -> dict[str, Any]:
    """Return the JSON object of one model that is fitted to a record's Welch response."""
    fit = model.fit
    return {
        **_fit_identity_json(analysis, model),
        "frf": analysis.settings.estimator,
        "free": list(fit.structure.free),
        "parameters": dict(fit.parameters),
        "withheld": sorted(unreported_parameters(fit.structure, unsupported_orders)),
        "std": fit.std_of_free_parameters,
        "cost": fit.cost,
        "at_bounds": list(fit.at_bounds),
        "nrmse_percent": response_fit_percent(analysis, model),
        "indices": asdict(model.indices),
    }


def _welch_modes_json(analysis: WelchAnalysis, model: FittedModel) -> list[dict[str, Any]]:
    """Return the JSON objects of a Welch fit's modes and of the resonance peaks near them.

    A mode is computed from the poles of the fitted model. Each object also states the deviation of
    the model's peak from the measured one.
    """
    mode_objects = []
    for mode_number, (measured_peak, peak_deviation) in enumerate(
        zip(model.peaks, model.deviations, strict=True), start=1
    ):
        mode = model.modes[mode_number - 1] if model.modes else None
        mode_objects.append(
            {
                **_fit_identity_json(analysis, model),
                "mode": mode_number,
                "frequency_hz": None if mode is None else mode.frequency_hz,
                "natural_frequency_rad_s": None if mode is None else mode.natural_frequency_rad_s,
                "damping_ratio": None if mode is None else mode.damping_ratio,
                "peak_frequency_hz": None if measured_peak is None else measured_peak.frequency_hz,
                "peak_magnitude_db": None if measured_peak is None else measured_peak.magnitude_db,
                "peak_frequency_deviation_rad_s": (
                    None if peak_deviation is None else peak_deviation.frequency_rad_s
                ),
                "peak_magnitude_deviation_db": (
                    None if peak_deviation is None else peak_deviation.magnitude_db
                ),
            }
        )
    return mode_objects


def _fit_identity_json(analysis: WelchAnalysis, model: FittedModel) -> dict[str, Any]:
    """Return the entries that identify a Welch fit: file, estimator, type and weighting."""
    return {
        "file": str(analysis.record.path),
        "estimator": "welch",
        "type": model.fit.structure.name,
        "weighting": model.fit.weighting,
    }


def program_versions() -> dict[str, str]:
    """Return the versions of rigd, Python and NumPy that computed the results."""
    return {
        "rigd": rigd.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
