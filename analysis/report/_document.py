"""The results as one JSON document, without NaN: unknown values are null.

The paper's indices, Eqs. (28) to (30), of any fit against either measured response.

A fit on the whole record was never made to suit Welch's estimate, and the truth does not suit it
either: that estimate is biased at the resonances. So each fit is also compared with the whole
record's ratio of transforms, which is noisy but not biased.
"""

from __future__ import annotations

import json
import platform
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np

import rigd
from analysis.identify import ResponseGrid
from analysis.models import FrequencyResponseModel
from analysis.paper import fit_indices
from analysis.report._shown_model import ShownModel
from analysis.report.bands import loss_estimate, loss_factors, supported_band_hz
from analysis.report.table import unreported
from analysis.results import finite
from analysis.statistics import nrmse_percent

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify import DampingSize, RecordFit
    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.record import Record
    from analysis.report.bands import LossFactor
    from analysis.results import RecordResult, WholeRecord
    from rigd.spectral import FrequencyResponse

    IndexValues = dict[str, float | None]

NOT_COMPARED: dict[str, float | None] = {"mse": None, "wmse": None, "md": None}
"""Indices of a fit without a measured response to compare with."""


def indices_of_record_fit(fit: RecordFit, welch: WelchAnalysis) -> tuple[IndexValues, IndexValues]:
    """Compute the indices of a whole-record fit in the band of the Welch fits.

    Parameters
    ----------
    fit : RecordFit
    welch : WelchAnalysis
        Welch fits of the same record.

    Returns
    -------
    welch, whole_record : dict
        ``mse`` and ``wmse`` in (N·m/rad)², ``md`` in N·m/rad: against Welch's estimate, on the
        bins of the paper's fits, and against the empirical transfer function estimate.
    """
    record = welch.record
    # The delay stated in the file has been removed from the responses.
    stated_s = record.torque_delay_s - record.angle_delay_s
    plant = replace(fit.plant, delay_s=fit.plant.delay_s - stated_s)

    def against(measured: FrequencyResponse) -> IndexValues:
        (model,) = ResponseGrid(2j * np.pi * measured.frequency_hz).evaluate(plant, ())
        return _indices(measured, model)

    return against(welch.response), against(welch.whole_record)


def whole_record_indices(welch: WelchAnalysis) -> list[IndexValues]:
    """Compute the paper's fits' against the whole record's ratio, in their order."""
    measured, record = welch.whole_record, welch.record
    grid = FrequencyResponseModel(measured.frequency_hz, record.beam, record.tool_inertia_kg_m2)
    return [_indices(measured, grid.evaluate(model.fit.damping)) for model in welch.models]


def _indices(measured: FrequencyResponse, model: NDArray[np.complex128]) -> IndexValues:
    known = np.isfinite(measured.response)
    if not known.any():
        return NOT_COMPARED
    omega = 2 * np.pi * measured.frequency_hz[known]
    return asdict(fit_indices(omega, measured.response[known], model[known]))


def response_fit_percent(analysis: WelchAnalysis, model: FittedModel) -> float:
    """Fit of a Welch fit's model to the response that it was fitted to (`nrmse_percent`).

    Parameters
    ----------
    analysis : WelchAnalysis
    model : FittedModel
        One of its models.
    """
    measured = analysis.response.response
    known = np.isfinite(measured)
    measured, modelled = measured[known], model.response[known]
    return nrmse_percent(measured - modelled, measured - measured.mean())


_CURVE_POINTS = 200


def record_entries(whole: WholeRecord, welch: WelchAnalysis | None) -> dict[str, Any]:
    """Collect the whole-record results of one record.

    Returns
    -------
    dict
        ``headline``: what the record says, with flags; ``fits`` and ``modes``: lists of objects as
        the document has them of the Welch fits,
        with ``estimator`` "record"; ``records``: one object with verdict, noise, hum, and response
        and loss factors with their 95 % bands. Numbers may be numpy's or
        not finite, as `finite` takes them. What is not reported is flagged, not
        left out: ``withheld`` of a fit names its parameters that the data do not support,
        ``visible`` of a mode says whether the record shows it. ``indices`` are against Welch's
        response, as those of the paper's fits, ``indices_whole_record`` against the ratio of the
        whole record's transforms.
    """
    names = [
        (
            {
                "file": str(whole.record.path),
                "estimator": "record",
                "type": fit.structure.name,
                "weighting": None,
                "candidate": name,
                "selected": name == whole.headline.name,
            },
            fit,
        )
        for name, fit in whole.fits.items()
    ]
    indices = [
        (NOT_COMPARED, NOT_COMPARED) if welch is None else indices_of_record_fit(fit, welch)
        for _, fit in names
    ]
    return {
        "headline": whole.headline_json(),
        "fits": [
            {
                **name,
                "free": [*fit.interval],
                "parameters": dict(fit.parameters),
                "withheld": sorted(unreported(fit.structure, whole.unsupported)),
                "std": {key: std if key in fit.interval else None for key, std in fit.std.items()},
                "interval_95": {
                    key: None if ends is None else list(ends) for key, ends in fit.interval.items()
                },
                "cost": fit.cost,
                "degrees_of_freedom": fit.degrees_of_freedom,
                "at_bounds": list(fit.at_bounds),
                "nrmse_percent": whole.analysis.fit_percent(fit),
                "determined": list(fit.determined),
                "covariance": fit.covariance.tolist(),
                "internal_size": _size(fit.internal),
                "external_size": _size(fit.external),
                "ringing": {**asdict(fit.ringing), "significant": fit.ringing.significant},
                "indices": of_welch,
                "indices_whole_record": of_record,
            }
            for (name, fit), (of_welch, of_record) in zip(names, indices, strict=True)
        ],
        "modes": [
            {
                **name,
                "mode": mode.number,
                "visible": mode.shown,
                "source": mode.source,
                "frequency_hz": mode.frequency_hz.value,
                "frequency_std_hz": mode.frequency_hz.std,
                "damping_ratio": mode.damping_ratio.value,
                "damping_ratio_std": mode.damping_ratio.std,
            }
            # Those reported first: they are what narrow sweeps are planned by.
            for name, _ in names
            if name["selected"]
            for mode in whole.headline.modes
        ],
        "records": [
            {
                "file": str(whole.record.path),
                "selected": whole.headline.name,
                "verdict": list(whole.verdict.sentences),
                "experiments": list(whole.verdict.experiments),
                "withheld": sorted(whole.withheld),
                "orders": {
                    each.order: {
                        "status": each.status,
                        "value": each.value,
                        "interval_95": None if each.interval is None else list(each.interval),
                    }
                    for each in whole.orders
                },
                "band_hz": list(whole.band_hz),
                "fixed": list(whole.fixed),
                "hum": [asdict(line) for line in whole.analysis.lines],
                "curves": _curves(whole),
            }
        ],
    }


def _size(size: DampingSize | None) -> dict[str, Any] | None:
    return None if size is None else asdict(size)


def _curves(whole: WholeRecord) -> dict[str, Any]:
    """Tabulate the response of the model shown first, and loss factors, over the band."""
    first_hz, last_hz = whole.band_hz
    frequency_hz = np.geomspace(max(first_hz, last_hz / 200), last_hz, _CURVE_POINTS)
    model, beam = ShownModel.of(whole.headline, whole.record), loss_estimate(whole)
    band = model.band(frequency_hz)
    low, high = band.magnitude_limits()
    factors = None if beam is None else loss_factors(beam, frequency_hz)
    supported_hz = supported_band_hz(whole)
    return {
        "model": "beam" if model.modal is None else "modal",
        "frequency_hz": frequency_hz.tolist(),
        "magnitude_nm_per_rad": np.abs(band.response).tolist(),
        "magnitude_low_nm_per_rad": low.tolist(),
        "magnitude_high_nm_per_rad": high.tolist(),
        "phase_rad": np.angle(band.response).tolist(),
        "phase_std_rad": band.phase_std_rad.tolist(),
        "loss_factor_supported_hz": None if supported_hz is None else list(supported_hz),
        "loss_factor": None if factors is None else _factor(factors.total),
        "internal_loss_factor": None if factors is None else _factor(factors.internal),
        "external_loss_factor": None if factors is None else _factor(factors.external),
    }


def _factor(factor: LossFactor | None) -> dict[str, list[float]] | None:
    if factor is None:
        return None
    low, high = factor.limits()
    return {"value": factor.value.tolist(), "low": low.tolist(), "high": high.tolist()}


def document(
    results: Sequence[RecordResult], errors: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Collect the results of all files.

    Parameters
    ----------
    results : sequence of RecordResult
        The entries of whole records follow those of the Welch method.
    errors : mapping of str to str, optional
        Message for each file that could not be analysed.

    Returns
    -------
    dict
        ``versions``, ``headlines`` (what each whole record says, with flags), ``files`` (what was
        read, how exact the linear model is for it, and how the Welch method estimated it),
        ``fits``, ``modes``, ``peaks``, ``records``, ``errors``: lists of objects that name their
        file. Finite numbers only.
    """
    of_records = [record_entries(each.whole, each.welch) for each in results if each.whole]
    by_welch = [(each.welch, each.unsupported) for each in results if each.welch]
    content: dict[str, Any] = finite(
        {
            "versions": versions(),
            "files": [
                {**facts, "validity": each.validity.as_json()}
                for each, facts in (
                    *((each, _file(each.welch)) for each in results if each.welch),
                    *(
                        (each, _record_facts(each.record, each.warnings))
                        for each in results
                        if each.welch is None
                    ),
                )
            ],
            "fits": [
                *(fit for analysis, withheld in by_welch for fit in _fits(analysis, withheld)),
                *(fit for entries in of_records for fit in entries["fits"]),
            ],
            "modes": [
                *(
                    mode
                    for analysis, _ in by_welch
                    for model in analysis.models
                    for mode in _modes(analysis, model)
                ),
                *(mode for entries in of_records for mode in entries["modes"]),
            ],
            "headlines": [entries["headline"] for entries in of_records],
            "records": [record for entries in of_records for record in entries["records"]],
            "peaks": [
                {
                    "file": str(analysis.record.path),
                    "mode": number,
                    "frequency_hz": None if peak is None else peak.frequency_hz,
                    "magnitude_db": None if peak is None else peak.magnitude_db,
                }
                for analysis, _ in by_welch
                for number, peak in enumerate(analysis.peaks, start=1)
            ],
            "errors": [
                {"file": file, "message": message} for file, message in (errors or {}).items()
            ],
        }
    )
    return content


def document_text(content: Mapping[str, Any], *, ascii_only: bool = False) -> str:
    """Write a document as JSON, with a newline at its end.

    Parameters
    ----------
    content : mapping
    ascii_only : bool
        Whether other characters are escaped, for a stream that may have any encoding.
    """
    return json.dumps(content, indent=2, ensure_ascii=ascii_only, allow_nan=False) + "\n"


def _file(analysis: WelchAnalysis) -> dict[str, Any]:
    settings, response = analysis.settings, analysis.response
    return {
        **_record_facts(analysis.record, analysis.warnings),
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


def _record_facts(record: Record, warnings: Sequence[str]) -> dict[str, Any]:
    return {
        "file": str(record.path),
        "outcome": record.outcome,
        "rate_hz": record.rate_hz,
        "samples": len(record.time_s),
        "sweep_first": record.sweep.start,
        "sweep_end": record.sweep.stop,
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


def _fits(analysis: WelchAnalysis, withheld: Collection[str]) -> list[dict[str, Any]]:
    indices = whole_record_indices(analysis)
    return [
        {**_fit(analysis, model, withheld), "indices_whole_record": of_record}
        for model, of_record in zip(analysis.models, indices, strict=True)
    ]


def _fit(analysis: WelchAnalysis, model: FittedModel, withheld: Collection[str]) -> dict[str, Any]:
    fit = model.fit
    return {
        **_name(analysis, model),
        "frf": analysis.settings.estimator,
        "free": list(fit.structure.free),
        "parameters": dict(fit.parameters),
        "withheld": sorted(unreported(fit.structure, withheld)),
        # Fixed parameters have no standard deviation: they were not estimated.
        "std": None
        if fit.std is None
        else {name: std if name in fit.structure.free else None for name, std in fit.std.items()},
        "cost": fit.cost,
        "at_bounds": list(fit.at_bounds),
        "nrmse_percent": response_fit_percent(analysis, model),
        "indices": asdict(model.indices),
    }


def _modes(analysis: WelchAnalysis, model: FittedModel) -> list[dict[str, Any]]:
    """Return the modes from the poles, each with its peak and that peak's deviation."""
    found = []
    for number, (peak, deviation) in enumerate(
        zip(model.peaks, model.deviations, strict=True), start=1
    ):
        mode = model.modes[number - 1] if model.modes else None
        found.append(
            {
                **_name(analysis, model),
                "mode": number,
                "frequency_hz": None if mode is None else mode.frequency_hz,
                "natural_frequency_rad_s": None if mode is None else mode.natural_frequency_rad_s,
                "damping_ratio": None if mode is None else mode.damping_ratio,
                "peak_frequency_hz": None if peak is None else peak.frequency_hz,
                "peak_magnitude_db": None if peak is None else peak.magnitude_db,
                "peak_frequency_deviation_rad_s": (
                    None if deviation is None else deviation.frequency_rad_s
                ),
                "peak_magnitude_deviation_db": (
                    None if deviation is None else deviation.magnitude_db
                ),
            }
        )
    return found


def _name(analysis: WelchAnalysis, model: FittedModel) -> dict[str, Any]:
    return {
        "file": str(analysis.record.path),
        "estimator": "welch",
        "type": model.fit.structure.name,
        "weighting": model.fit.weighting,
    }


def versions() -> dict[str, str]:
    """Versions of what computed the results."""
    return {
        "rigd": rigd.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
