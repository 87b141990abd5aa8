"""The table of all structures fitted to a whole record."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from analysis.report.html.record_tables import PARAMETERS
from analysis.report.html.reported import footnotes, greyed, marked, unreported
from analysis.report.html.table import ABSENT, Cell, Column, Number, Table, count, estimate, number

if TYPE_CHECKING:
    from collections.abc import Collection

    from analysis.identify import RecordFit
    from analysis.report.html.subject import Subject

_DAMPING = ("zeta", "alpha", "gamma", "lambda")


def structures_table(subject: Subject) -> Table:
    """All fits beside each other; orders that the data do not support are marked in each."""
    lowest = min(fit.cost for fit in subject.fits.values())
    withheld = subject.unsupported
    delta_bic = subject.verdict.delta_bic
    status = dict(subject.headline.structures)
    rows: list[tuple[Cell, ...]] = []
    for name, fit in subject.fits.items():
        its = status.get(name, "")
        rows.append(
            (
                name,
                its,
                *_damping(fit, withheld, excluded=its == "excluded"),
                *([number(delta_bic[name], ".4g")] if delta_bic else []),
                number(fit.cost / fit.degrees_of_freedom, ".4g"),
                count(fit.free_parameters),
                number(fit.cost),
                number(fit.cost - lowest),
                count(fit.degrees_of_freedom),
                " ".join(sorted(unreported(fit.structure, withheld))),
            )
        )
    return Table(
        "structures",
        "All structures on the whole record",
        (
            Column("Type", "type", numeric=False),
            Column("", "status", numeric=False),
            *(
                column
                for parameter in _DAMPING
                for column in (
                    Column(_heading(parameter), parameter),
                    Column("std", f"{parameter}_std"),
                )
            ),
            *([Column("ΔBIC", "delta_bic")] if delta_bic else []),
            Column("Residual", "cost_per_degree_of_freedom"),
            Column("Free", "free_parameters"),
            Column("", "cost"),
            Column("", "cost_above_lowest"),
            Column("", "degrees_of_freedom"),
            Column("", "not_reported", numeric=False),
        ),
        tuple(rows),
        (
            *footnotes(withheld),
            "ΔBIC: Bayesian information criterion above the lowest; 10 is clear. Residual: its "
            "power over that of the noise, 1 if nothing but noise is left. Free: number of free "
            "parameters, those of rig and beam included. * rests on the edge of the range "
            "searched. The marked row is the one that the numbers are of. What the record excludes "
            "has numbers in the CSV file only, beside the sums of squares.",
        ),
        selected=list(subject.fits).index(subject.headline.name),
    )


def _damping(fit: RecordFit, withheld: Collection[str], *, excluded: bool) -> list[Number]:
    """Value and standard deviation of each parameter of the damping."""
    doubtful = unreported(fit.structure, withheld)
    shown: list[Number] = []
    for name in _DAMPING:
        if not fit.structure.has(name):
            shown += [number(None), number(None)]
            continue
        std = fit.std[name]
        free = name in fit.structure.free
        cells = estimate((fit.parameters[name], std if free else None), std, PARAMETERS[name][3])
        held = "*" if name in fit.at_bounds else ""
        value, spread = replace(cells[0], text=cells[0].text + held), cells[1]
        if excluded:
            shown += [replace(each, text=ABSENT, doubtful=True) for each in (value, spread)]
            continue
        shown += [marked(value), greyed(spread)] if name in doubtful else [value, spread]
    return shown


def _heading(name: str) -> str:
    """Symbol with its power of ten; the units, which depend on the orders, would be too long."""
    symbol, _meaning, unit, factor = PARAMETERS[name]
    return symbol if factor == 1.0 else f"{symbol} ({unit.split()[0]})"
