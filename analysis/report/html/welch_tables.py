"""Tables of the paper's route, beside those of the whole record."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from analysis.report.html.reported import footnotes, greyed, marked, unreported
from analysis.report.html.table import Cell, Column, Number, Table, estimate, number

if TYPE_CHECKING:
    from collections.abc import Collection

    from analysis.paper import FittedModel, WelchAnalysis

_FACTORS = {"zeta": 1e5, "alpha": 1.0, "gamma": 1e2, "lambda": 1.0}
_HEADINGS = {"zeta": "ζ (1e-5)", "alpha": "α", "gamma": "γ (1e-2)", "lambda": "λ"}
_COEFFICIENT = {"zeta": "zeta", "alpha": "zeta", "gamma": "gamma", "lambda": "gamma"}


def welch_fits_table(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> Table:
    """Parameters and indices of every fit of the paper's route.

    Parameters
    ----------
    analysis : WelchAnalysis
    withheld : collection of str
        Orders that the whole record does not support: they are marked.
    """
    return Table(
        "welch_fits",
        "Fits to Welch's estimate, as in the paper",
        (
            Column("Type", "type", numeric=False),
            Column("Weights", "weighting", numeric=False),
            *(
                column
                for name, heading in _HEADINGS.items()
                for column in (Column(heading, name), Column("std", f"{name}_std"))
            ),
            Column("MSE", "mse"),
            Column("WMSE", "wmse"),
            Column("MD", "md"),
        ),
        tuple(_fit_row(model, withheld) for model in analysis.models),
        (
            *footnotes(withheld),
            "MSE and WMSE in (N·m/rad)², MD in N·m/rad. std is the scatter of the measured "
            "response about the model. The bias of Welch's estimate on a chirp, which the window "
            "smears at the resonances, is not in it and is often larger: the whole-record fits "
            "above do not have it.",
        ),
    )


def peaks_table(analysis: WelchAnalysis) -> Table:
    """Measured resonant peaks, and by how much those of each model lie off them."""
    count = len(analysis.peaks)
    measured: tuple[Cell, ...] = (
        "measured",
        "",
        *(number(2 * math.pi * p.frequency_hz if p else None, ".3f") for p in analysis.peaks),
        *(number(p.magnitude_db if p else None, ".3f") for p in analysis.peaks),
    )
    rows: list[tuple[Cell, ...]] = [
        (
            model.fit.structure.name,
            model.fit.weighting,
            *(number(d.frequency_rad_s if d else None, ".3f") for d in model.deviations),
            *(number(d.magnitude_db if d else None, ".3f") for d in model.deviations),
        )
        for model in analysis.models
    ]
    return Table(
        "welch_peaks",
        "Resonant peaks of Welch's estimate, and deviations of the models' peaks from them",
        (
            Column("Type", "type", numeric=False),
            Column("Weights", "weighting", numeric=False),
            *(Column(f"ω{n} (rad/s)", f"omega_{n}_rad_s") for n in range(1, count + 1)),
            *(Column(f"M{n} (dB)", f"magnitude_{n}_db") for n in range(1, count + 1)),
        ),
        (measured, *rows),
        ("First row: the peaks; below: absolute deviations, as in the paper's Table 4.",),
    )


def _fit_row(model: FittedModel, withheld: Collection[str]) -> tuple[Cell, ...]:
    fit = model.fit
    doubtful = unreported(fit.structure, withheld)
    shown: list[Cell] = []
    for name, factor in _FACTORS.items():
        cells: tuple[Number, ...] = (number(None), number(None))
        if name in fit.structure.free:
            std = None if fit.std is None else fit.std[name]
            cells = estimate((fit.parameters[name], std), std, factor)
        elif _COEFFICIENT[name] in fit.structure.free:
            cells = (number(fit.parameters[name], "g", factor), number(None))
        shown += (marked(cells[0]), greyed(cells[1])) if name in doubtful else cells
    indices = model.indices
    return (
        fit.structure.name,
        fit.weighting,
        *shown,
        *(number(value) for value in (indices.mse, indices.wmse, indices.md)),
    )
