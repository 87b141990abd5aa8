"""The results as one JSON document, without NaN: what is not known is null."""

from __future__ import annotations

import json
import math
import platform
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

import rigd
from analysis.report.html.reported import unreported
from analysis.report.record_indices import whole_record_indices

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.record import Record
    from analysis.report.html import Subject


def document(
    analyses: Sequence[WelchAnalysis],
    errors: Mapping[str, str] | None = None,
    subjects: Sequence[Subject] = (),
) -> dict[str, Any]:
    """Collect the results of all files.

    Parameters
    ----------
    analyses : sequence of WelchAnalysis
    errors : mapping of str to str, optional
        Message for each file that could not be analysed.
    subjects : sequence of Subject, optional
        Whole-record results, whose entries follow those of the paper's route.

    Returns
    -------
    dict
        ``versions``, ``headlines`` (what each whole record says, with flags), ``files`` (what was
        read, and how the paper's route estimated it), ``fits``, ``modes``, ``peaks``, ``records``,
        ``errors``: lists of objects that name their file.
        Finite numbers only.
    """
    of_records = [_record_entries(subject) for subject in subjects]
    withheld = {subject.record.path: subject.unsupported for subject in subjects}
    content: dict[str, Any] = _finite(
        {
            "versions": {
                "rigd": rigd.__version__,
                "python": platform.python_version(),
                "numpy": np.__version__,
            },
            "files": [
                *(_file(analysis) for analysis in analyses),
                *(
                    _record_facts(subject.record, subject.warnings)
                    for subject in subjects
                    if subject.welch is None
                ),
            ],
            "fits": [
                *(
                    fit
                    for analysis in analyses
                    for fit in _fits(analysis, withheld.get(analysis.record.path, ()))
                ),
                *(fit for entries in of_records for fit in entries["fits"]),
            ],
            "modes": [
                *(
                    mode
                    for analysis in analyses
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
                for analysis in analyses
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


def _record_entries(subject: Subject) -> dict[str, Any]:
    from analysis.report.html.record_entries import record_entries

    return record_entries(subject)


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
        # What a structure fixes is not known exactly: it was not asked for.
        "std": None
        if fit.std is None
        else {name: std if name in fit.structure.free else None for name, std in fit.std.items()},
        "cost": fit.cost,
        "at_bounds": list(fit.at_bounds),
        "indices": asdict(model.indices),
    }


def _modes(analysis: WelchAnalysis, model: FittedModel) -> list[dict[str, Any]]:
    """Modes from the poles, each beside the peak it makes and that peak's deviation."""
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


def _finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Copy a JSON value with null for numbers that are not finite and plain numbers for numpy's."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
