"""Tables of a campaign as rows of plain values, beside the paper's own numbers.

The paper's own numbers, to be put beside a campaign's.

"Fractional-Order Models of Damping Phenomena in a Flexible Sensing Antenna Used for Haptic Robot
Navigation", Tables 3 and 4, and the WMSE of Table 5: twenty sessions of a carbon fibre link.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from analysis.campaigns import best_models
from analysis.models import STRUCTURES
from analysis.report._campaign_tables import session_list_rows
from analysis.report._paper_numbers import table3, table4, table5_wmse
from analysis.report._table import unreported

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from analysis.campaigns import Campaign, PooledEstimate


Row = dict[str, Any]

_STATISTICS = ("mean", "median", "std", "min", "max")


def table3_rows(campaign: Campaign, *, with_paper: bool = False) -> list[Row]:
    """Statistics of the parameters."""
    rows = []
    for each in campaign.statistics:
        row: Row = {
            "type": each.structure,
            "weighting": each.weighting,
            "parameter": each.parameter,
            **{name: getattr(each, name) for name in _STATISTICS},
            "at_bounds": each.at_bounds,
        }
        if with_paper:
            told = table3().get((each.structure, each.weighting, each.parameter))
            row |= {f"paper_{name}": told and getattr(told, name) for name in _STATISTICS}
        rows.append(row)
    return rows


def table4_rows(campaign: Campaign, *, with_paper: bool = False) -> list[Row]:
    """Mean deviation of the resonant peaks; types in columns, as in the paper."""
    found: dict[tuple[str, int, str], Row] = {}
    for quantity in ("frequency_rad_s", "magnitude_db"):
        for model in campaign.nominal:
            for deviation in model.deviations:
                key = (quantity, deviation.mode, model.weighting)
                row = found.setdefault(
                    key, dict(zip(("quantity", "mode", "weighting"), key, strict=True))
                )
                row[model.structure] = getattr(deviation, quantity)
    for (quantity, mode, weighting), row in found.items():
        if with_paper:
            for structure in [name for name in row if name in STRUCTURES]:
                told = table4().get((structure, weighting, quantity, mode))
                row[f"paper_{structure}"] = told
    order = list(dict.fromkeys(model.weighting for model in campaign.nominal))
    return [found[key] for key in sorted(found, key=lambda k: (k[0], k[1], order.index(k[2])))]


def table5_rows(campaign: Campaign, *, with_paper: bool = False) -> list[Row]:
    """Parameters and performance of the two best nominal models."""
    rows = []
    for model in best_models(campaign.nominal):
        row: Row = {"type": model.structure, "weighting": model.weighting}
        row |= dict(model.parameters.items())
        row["wmse"] = model.mean_wmse
        for deviation in model.deviations:
            row[f"mdr_omega{deviation.mode}_rad_s"] = deviation.frequency_rad_s
            row[f"mdr_magnitude{deviation.mode}_db"] = deviation.magnitude_db
        if with_paper:
            row["paper_wmse"] = table5_wmse().get((model.structure, model.weighting))
        rows.append(row)
    return rows


def session_rows(campaign: Campaign) -> list[Row]:
    """Every session's fits by the paper's route, and the nominal models' distance from it."""
    return [
        {
            "file": str(session.path),
            "type": fit.structure,
            "weighting": fit.weighting,
            **fit.parameters,
            "cost": fit.cost,
            "at_bounds": " ".join(fit.at_bounds),
            **{f"nominal_{name}": value for name, value in asdict(model.indices[number]).items()},
        }
        for number, session in enumerate(campaign.sessions)
        for fit, model in zip(session.welch_fits, campaign.nominal, strict=True)
    ]


def record_rows(campaign: Campaign) -> list[Row]:
    """Every session's whole-record fits."""
    return [
        {
            "file": str(session.path),
            "type": each.structure,
            "uniform": each.uniform,
            **each.parameters,
            **{
                f"{name}_std": value if name in each.free else None
                for name, value in each.std.items()
            },
            "cost": each.cost,
            "degrees_of_freedom": each.degrees_of_freedom,
            "bic": each.bic,
            "at_bounds": " ".join(each.at_bounds),
        }
        for session in campaign.sessions
        for each in session.record_estimates
    ]


def candidate_rows(campaign: Campaign) -> list[Row]:
    """Structures on all whole records together, those pooled first, the lowest BIC first."""
    return [
        {
            "type": each.structure,
            "uniform": each.uniform,
            "fitted": each.fitted,
            "sessions": each.determined,
            "bic_above_lowest": each.bic_above_lowest,
            "misfit": each.misfit,
            "selected_alone": each.selected_alone,
            "pooled": each.pooled,
        }
        for each in campaign.structures
    ]


def mode_rows(campaign: Campaign) -> list[Row]:
    """Modes over all sessions, of the structure that the numbers are of."""
    mixed = campaign.homogeneity.is_mixed
    return [
        asdict(mode)
        | {
            "frequency_mixture": mixed(f"frequency_hz_{mode.number}"),
            "damping_ratio_mixture": mixed(f"damping_ratio_{mode.number}"),
        }
        for mode in (campaign.headline.modes if campaign.headline else ())
    ]


def homogeneity_rows(campaign: Campaign) -> list[Row]:
    """Scatter of modes and parameters between sessions."""
    return [
        {
            "quantity": each.quantity,
            "sessions": len(each.values),
            "mean": each.mean,
            "between_std": each.between_std,
            "between_in_own_std": each.own_stds,
            "cochran_q": each.cochran_q,
            "i_squared": each.i_squared,
            "chance": each.chance,
            "mixture": each.mixed,
        }
        for each in campaign.homogeneity.quantities
    ]


def specimen_rows(campaign: Campaign) -> list[Row]:
    """Specimens as the files state them, if these are several; that of the campaign first."""
    specimens = campaign.homogeneity.specimens
    if len(specimens) == 1:
        return []
    return [
        {
            **each.facts,
            "files": len(each.paths),
            "here": each is specimens[0],
            "names": " ".join(path.name for path in each.paths),
        }
        for each in specimens
    ]


def pooled_rows(campaign: Campaign) -> list[Row]:
    """Pooled whole-record estimates, the headline's first; empty values of what is not pooled."""
    return _pooled_rows(campaign) + [
        {
            "type": each.structure,
            "uniform": each.uniform,
            "name": each.name,
            "headline": False,
            "sessions": each.determined,
            "misfit": each.misfit,
            "parameter": parameter,
            "reported": False,
        }
        for each in campaign.structures
        if not each.pooled
        for parameter in STRUCTURES[each.structure].free
    ]


def headline_first(campaign: Campaign) -> list[PooledEstimate]:
    """Pooled estimates: the one that the numbers are of, then the lowest BIC first."""
    return sorted(campaign.pooled, key=lambda each: each is not campaign.headline)


def _pooled_rows(campaign: Campaign) -> list[Row]:
    withheld = campaign.verdict.withheld if campaign.verdict else ()
    mixed = campaign.homogeneity.is_mixed
    return [
        {
            "type": estimate.structure,
            "uniform": estimate.uniform,
            "name": estimate.name,
            "headline": estimate is campaign.headline,
            "sessions": estimate.sessions,
            "bic": estimate.bic,
            "misfit": estimate.misfit,
            "parameter": each.name,
            "value": each.value,
            "std": each.std,
            "low_95": each.interval[0],
            "high_95": each.interval[1],
            "within_std": each.within_std,
            "between_std": each.between_std,
            "chance": each.chance,
            "next_low_95": each.next_interval[0],
            "next_high_95": each.next_interval[1],
            "reported": each.name not in unreported(STRUCTURES[estimate.structure], withheld),
            "mixture": mixed(each.name),
        }
        for estimate in headline_first(campaign)
        for each in estimate.parameters
    ]


def validation_rows(campaign: Campaign) -> list[Row]:
    """Errors of each session predicted from the others, then the trials that were lost."""
    return [
        {
            "file": str(each.path),
            "method": each.method,
            "type": each.name,
            "weighting": each.weighting,
            "error": each.error,
            "own_error": each.own_error,
            "lost": None,
        }
        for each in campaign.validation
    ] + [{"file": str(each.path), "lost": each.reason} for each in campaign.lost_trials]


def all_tables(campaign: Campaign, *, with_paper: bool = False) -> dict[str, list[Row]]:
    """Every table by name, without those that are empty."""
    with_numbers: Mapping[str, Callable[..., list[Row]]] = {
        "table3": table3_rows,
        "table4": table4_rows,
        "table5": table5_rows,
    }
    mixture = {"mixture": campaign.homogeneity.mixed}
    found = {
        name: [row | mixture for row in make(campaign, with_paper=with_paper)]
        for name, make in with_numbers.items()
    }
    found |= {
        "session_list": session_list_rows(campaign),
        "sessions_welch": session_rows(campaign),
        "sessions_record": record_rows(campaign),
        "structures": candidate_rows(campaign),
        "specimens": specimen_rows(campaign),
        "homogeneity": homogeneity_rows(campaign),
        "pooled": pooled_rows(campaign),
        "pooled_modes": mode_rows(campaign),
        "validation": validation_rows(campaign),
    }
    return {name: [_known_row(row) for row in rows] for name, rows in found.items() if rows}


def csv_text(rows: Sequence[Row]) -> str:
    """Rows as CSV with a heading; what is not known is an empty field."""
    stream = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(stream, list(names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def _known_row(row: Row) -> Row:
    """Put None for numbers that are not finite."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.items()
    }
