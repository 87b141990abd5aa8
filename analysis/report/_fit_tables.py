"""Tables of fits: all structures on the whole record, and the Welch method's fits."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Final

from analysis.identify.headline import EXACT_CONDITION
from analysis.models import QUANTITIES
from analysis.paper import LARGEST_SHIFT
from analysis.report._document import response_fit_percent
from analysis.report.table import (
    ABSENT,
    WORDS,
    Cell,
    Column,
    Entry,
    Table,
    estimate,
    footnotes,
    greyed,
    marked,
    number,
    unreported,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from analysis.models import Structure
    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.results import WholeRecord

_DAMPING: Final = ("zeta", "alpha", "gamma", "lambda")
_ON_THE_EDGE: Final = "* at the limit of the search range: not determined by the data."


def structures_table(whole: WholeRecord) -> Table:
    """Return the comparison of all fits; orders that the data do not support are marked."""
    lowest = min(fit.cost for fit in whole.fits.values())
    withheld = whole.unsupported
    delta_bic = whole.delta_bic
    status = dict(whole.headline.structures)
    rows: list[tuple[Entry, ...]] = []
    for name, fit in whole.fits.items():
        its = status.get(name, "")
        damping = _damping_cells(
            fit.structure, fit.parameters, fit.std, withheld=withheld, at_bounds=fit.at_bounds
        )
        rows.append(
            (
                name,
                its,
                *(map(_left_out, damping) if its == "excluded" else damping),
                *([delta_bic[name]] if delta_bic else []),
                whole.analysis.fit_percent(fit),
                fit.cost / fit.degrees_of_freedom,
                fit.free_parameters,
                fit.cost,
                fit.cost - lowest,
                fit.degrees_of_freedom,
                " ".join(sorted(unreported(fit.structure, withheld))),
            )
        )
    return Table.of(
        "structures",
        "All structures on the whole record",
        (
            Column("Type", "type", WORDS),
            Column("", "status", WORDS),
            *_damping_columns(),
            *([Column("ΔBIC", "delta_bic")] if delta_bic else []),
            Column("Fit (%)", "nrmse_percent", ".2f"),
            Column("Residual", "cost_per_degree_of_freedom"),
            Column("Free", "free_parameters"),
            Column("", "cost"),
            Column("", "cost_above_lowest"),
            Column("", "degrees_of_freedom"),
            Column("", "not_reported", WORDS),
        ),
        rows,
        (
            *footnotes(withheld),
            "ΔBIC: Bayesian information criterion above the lowest; 10 = decisive. Fit: NRMSE "
            "of the torque in the band, 100 (1 − ‖y − ŷ‖ / ‖y − mean of y‖). Residual: its power "
            "over that of the noise, 1 if nothing but noise is left. Free: number of free "
            "parameters, those of rig and beam included. * rests on the edge of the range "
            f"searched. The marked row is {_marked_row(whole)}. What the record excludes "
            "has numbers in the CSV file only, beside the sums of squares.",
        ),
        selected=list(whole.fits).index(whole.headline.name),
    )


def _marked_row(whole: WholeRecord) -> str:
    return (
        "the one reported" if whole.headline.exact is None else f"of the values {EXACT_CONDITION}"
    )


def _left_out(cell: Cell) -> Cell:
    """Return a cell that shows a number to programs only."""
    return cell if cell.value is None else replace(cell, text=ABSENT, doubtful=True)


def _damping_columns() -> list[Column]:
    """Value and standard deviation of each parameter of the damping."""
    return [
        column
        for name in _DAMPING
        for column in (
            Column(_heading(name), name), Column("std", f"{name}_std", spread=True),
        )
    ]  # fmt: skip


def _damping_cells(
    structure: Structure,
    parameters: Mapping[str, float],
    std: Mapping[str, float | None] | None,
    *,
    withheld: Collection[str] = (),
    at_bounds: Collection[str] = (),
) -> list[Cell]:
    """Fill these columns: fixed values have no standard deviation, absent ones a dash."""
    doubtful = unreported(structure, withheld)
    shown: list[Cell] = []
    for name in _DAMPING:
        if not structure.has(name):
            shown += [number(None), number(None)]
            continue
        its_std = std[name] if std is not None and name in structure.free else None
        value, spread = estimate((parameters[name], its_std), its_std, QUANTITIES[name][3])
        if name in at_bounds:
            value = replace(value, text=f"{value.text}*")
        shown += [marked(value), greyed(spread)] if name in doubtful else [value, spread]
    return shown


def _heading(name: str) -> str:
    """Symbol with its power of ten; the units, which depend on the orders, would be too long."""
    symbol, _meaning, unit, factor = QUANTITIES[name]
    return symbol if factor == 1.0 else f"{symbol} ({unit.split()[0]})"


_NAMES: Final = (Column("Type", "type", WORDS), Column("Weights", "weighting", WORDS))
_INDICES: Final = ("mse", "wmse", "md")
_INDEX_UNITS: Final = "MSE and WMSE in (N·m/rad)², MD in N·m/rad."


def welch_fits_table(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> Table:
    """Parameters and indices of every Welch fit.

    Parameters
    ----------
    analysis : WelchAnalysis
    withheld : collection of str
        Orders that the whole record does not support: they are marked.
    """
    fits = [model.fit for model in analysis.models]
    return Table.of(
        "welch_fits",
        "Fits to Welch's estimate, as in the paper",
        (
            *_NAMES,
            *_damping_columns(),
            Column("Fit (%)", "nrmse_percent", ".2f"),
            *(Column(name.upper(), name) for name in _INDICES),
        ),
        (
            (
                *_names(model),
                *_damping_cells(
                    fit.structure, fit.parameters, fit.std, withheld=withheld,
                    at_bounds=fit.at_bounds,
                ),
                response_fit_percent(analysis, model),
                *(getattr(model.indices, name) for name in _INDICES),
            )
            for fit, model in zip(fits, analysis.models, strict=True)
        ),
        (
            *footnotes(withheld),
            f"Fit: NRMSE of the complex response in the band. {_INDEX_UNITS} std (±): one standard "
            "deviation, from the scatter of the response about the model. The bias of Welch's "
            "estimate on a chirp, which the window smears at the resonances, is not in it and is "
            "often larger: whole-record fits do not have it.",
            *([_ON_THE_EDGE] if any(fit.at_bounds for fit in fits) else []),
        ),
        grouped=True,
    )  # fmt: skip


def summary_table(analyses: Sequence[WelchAnalysis]) -> Table:
    """Mean and standard deviation over the files of each fit's parameters and indices."""
    rows: list[tuple[Entry, ...]] = []
    for models in zip(*(analysis.models for analysis in analyses), strict=True):
        fits = [model.fit for model in models]
        parameters, indices = (
            {key: [values[key] for values in of_files] for key in keys}
            for keys, of_files in (
                (_DAMPING, [fit.parameters for fit in fits]),
                (_INDICES, [asdict(model.indices) for model in models]),
            )
        )
        rows.append(
            (
                *_names(models[0]),
                *_damping_cells(
                    fits[0].structure,
                    {name: fmean(values) for name, values in parameters.items()},
                    {name: _stdev(values) for name, values in parameters.items()},
                ),
                *(
                    cell
                    for values in indices.values()
                    for cell in estimate((fmean(values), _stdev(values)), _stdev(values))
                ),
            )
        )
    return Table.of(
        "welch_summary",
        f"Mean ± standard deviation over {len(analyses)} files",
        (
            *_NAMES,
            *_damping_columns(),
            *(
                column
                for name in _INDICES
                for column in (
                    Column(name.upper(), name), Column("std", f"{name}_std", spread=True),
                )
            ),
        ),
        rows,
        (_INDEX_UNITS,),
        grouped=True,
    )  # fmt: skip


def _stdev(values: list[float]) -> float:
    return stdev(values) if len(values) > 1 else math.nan


def _names(model: FittedModel) -> tuple[str, str]:
    return model.fit.structure.name, model.fit.weighting


def peaks_table(analysis: WelchAnalysis) -> Table:
    """Return the measured resonant peaks, and the deviations of each model's peaks."""
    modes = range(1, len(analysis.peaks) + 1)
    measured = (
        *(2 * math.pi * p.frequency_hz if p else None for p in analysis.peaks),
        *(p.magnitude_db if p else None for p in analysis.peaks),
    )
    return Table.of(
        "welch_peaks",
        "Resonant peaks of Welch's estimate, and deviations of the models' peaks from them",
        (
            *_NAMES,
            *(Column(f"ω{n} (rad/s)", f"omega_{n}_rad_s", ".3f") for n in modes),
            *(Column(f"M{n} (dB)", f"magnitude_{n}_db", ".3f") for n in modes),
        ),
        (
            ("measured", "", *measured),
            *(
                (
                    *_names(model),
                    *(d.frequency_rad_s if d else None for d in model.deviations),
                    *(d.magnitude_db if d else None for d in model.deviations),
                )
                for model in analysis.models
            ),
        ),
        ("First row: the peaks; below: absolute deviations, as in the paper's Table 4.",),
        selected=0,
        grouped=True,
    )


_LEFT: Final = "‡"


def welch_modes_table(analysis: WelchAnalysis) -> Table | None:
    """Frequencies and damping ratios of the modes from each model's poles; None without any.

    Modes that are not the antenna's are marked, or left out.
    """
    models = analysis.models
    modes = max((len(model.modes) for model in models), default=0)
    if not modes:
        return None

    def cells(model: FittedModel, name: str, form: str, factor: float = 1.0) -> list[Cell]:
        made = []
        for mode, followed in zip(model.modes, model.followed, strict=True):
            cell = number(getattr(mode, name) if mode.damping_ratio < 1 else None, form, factor)
            if cell.value is not None and not followed:
                cell = greyed(replace(cell, text=cell.text + _LEFT))
            made.append(cell)
        return made or [number(None)] * modes

    shown = [each for model in models for each in zip(model.modes, model.followed, strict=True)]
    vibrates = [mode.damping_ratio < 1 for mode, _ in shown]
    notes = ["From the poles of the fitted model; ξ is the damping ratio."]
    if any(not followed and mode.damping_ratio < 1 for mode, followed in shown):
        notes.append(
            f"{_LEFT} more than {100 * LARGEST_SHIFT:g} % off the undamped beam's: the fit does "
            "not follow this resonance. The number only describes the fitted curve."
        )
    if not all(vibrates) or not all(model.modes for model in models):
        notes.append(f"{ABSENT} overdamped in this fit.")
    return Table.of(
        "welch_modes",
        "Modes of the fits to Welch's estimate",
        (
            *_NAMES,
            *(Column(f"f{n} (Hz)", f"frequency_{n}_hz") for n in range(1, modes + 1)),
            *(Column(f"ξ{n} (%)", f"damping_ratio_{n}") for n in range(1, modes + 1)),
        ),
        (
            (
                *_names(model),
                *cells(model, "frequency_hz", ".4f"),
                *cells(model, "damping_ratio", ".4g", 100.0),
            )
            for model in models
        ),
        notes,
        grouped=True,
    )
