"""Whole-record results for the JSON document: entries beside those of the paper's route."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.identify import headline_json
from analysis.report.html.reported import unreported
from analysis.report.record_figure_bands import loss_factors, response_band
from analysis.report.record_indices import NOT_COMPARED, indices_of_record_fit
from analysis.report.supported_band import supported_band_hz

if TYPE_CHECKING:
    from analysis.identify import DampingSize
    from analysis.report.html.subject import Subject
    from analysis.report.record_figure_bands import LossFactor

_CURVE_POINTS = 200


def record_entries(subject: Subject) -> dict[str, Any]:
    """Collect the whole-record results of one record.

    Returns
    -------
    dict
        ``headline``: what the record says, with flags; ``fits`` and ``modes``: lists of objects as
        the document has them of the paper's route,
        with ``estimator`` "record"; ``records``: one object with verdict, noise, hum and, of the
        selected fit, response and loss factors with their 95 % bands. Numbers may be numpy's or
        not finite, as `analysis.report.document` takes them. What is not reported is flagged, not
        left out: ``withheld`` of a fit names its parameters that the data do not support,
        ``visible`` of a mode says whether the record shows it. ``indices`` are against Welch's
        response, as those of the paper's fits, ``indices_whole_record`` against the ratio of the
        whole record's transforms.
    """
    names = [
        (
            {
                "file": str(subject.record.path),
                "estimator": "record",
                "type": fit.structure.name,
                "weighting": None,
                "candidate": name,
                "selected": name == subject.headline.name,
            },
            fit,
        )
        for name, fit in subject.fits.items()
    ]
    welch = subject.welch
    indices = [
        (NOT_COMPARED, NOT_COMPARED) if welch is None else indices_of_record_fit(fit, welch)
        for _, fit in names
    ]
    file = str(subject.record.path)
    verdict = subject.verdict
    return {
        "headline": headline_json(file, subject.headline, verdict.orders, verdict.findings),
        "fits": [
            {
                **name,
                "free": [*fit.interval],
                "parameters": dict(fit.parameters),
                "withheld": sorted(unreported(fit.structure, subject.unsupported)),
                "std": {key: std if key in fit.interval else None for key, std in fit.std.items()},
                "interval_95": {
                    key: None if ends is None else list(ends) for key, ends in fit.interval.items()
                },
                "cost": fit.cost,
                "degrees_of_freedom": fit.degrees_of_freedom,
                "at_bounds": list(fit.at_bounds),
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
                "visible": mode.number in subject.visible_modes,
                "frequency_hz": mode.frequency_hz,
                "frequency_std_hz": mode.frequency_std_hz,
                "damping_ratio": mode.damping_ratio,
                "damping_ratio_std": mode.damping_ratio_std,
            }
            # Of the fit that is believed: they are what narrow sweeps are planned by.
            for name, fit in names
            if name["selected"]
            for mode in fit.modes
        ],
        "records": [
            {
                "file": str(subject.record.path),
                "selected": subject.headline.name,
                "verdict": list(subject.verdict.sentences),
                "experiments": list(subject.verdict.experiments),
                "withheld": sorted(subject.withheld),
                "orders": {
                    each.order: {
                        "status": each.status,
                        "value": each.value,
                        "interval_95": None if each.interval is None else list(each.interval),
                    }
                    for each in subject.verdict.orders
                },
                "band_hz": list(subject.band_hz),
                "fixed": list(subject.fixed),
                "hum": [asdict(line) for line in subject.analysis.lines],
                "curves": _curves(subject),
            }
        ],
    }


def _size(size: DampingSize | None) -> dict[str, Any] | None:
    return None if size is None else asdict(size)


def _curves(subject: Subject) -> dict[str, Any]:
    """Tabulate the selected fit's response and loss factors over the band."""
    first_hz, last_hz = subject.band_hz
    frequency_hz = np.geomspace(max(first_hz, last_hz / 200), last_hz, _CURVE_POINTS)
    band = response_band(subject.fit, frequency_hz)
    low, high = band.magnitude_limits()
    factors = loss_factors(subject.fit, frequency_hz)
    supported_hz = supported_band_hz(subject)
    return {
        "frequency_hz": frequency_hz.tolist(),
        "magnitude_nm_per_rad": np.abs(band.response).tolist(),
        "magnitude_low_nm_per_rad": low.tolist(),
        "magnitude_high_nm_per_rad": high.tolist(),
        "phase_rad": np.angle(band.response).tolist(),
        "phase_std_rad": band.phase_std_rad.tolist(),
        "loss_factor_supported_hz": None if supported_hz is None else list(supported_hz),
        "loss_factor": _factor(factors.total),
        "internal_loss_factor": _factor(factors.internal),
        "external_loss_factor": _factor(factors.external),
    }


def _factor(factor: LossFactor | None) -> dict[str, list[float]] | None:
    if factor is None:
        return None
    low, high = factor.limits()
    return {"value": factor.value.tolist(), "low": low.tolist(), "high": high.tolist()}
