"""Whether the sessions are of one specimen, in the operator's words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.experiment import in_dispute, told
from analysis.campaigns.labels import label

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns.experiment import StatedSpecimen
    from analysis.campaigns.homogeneity import Heterogeneity, Homogeneity, Values

MIXTURE_MARK: Final = "‡"
_OF_MIXTURE: Final = "of a mixture"
MIXTURE_NOTE: Final = (
    f"{MIXTURE_MARK} sessions differ in it in kind, not by their uncertainties: the mean of a "
    "mixture, which may belong to none of them."
)
_MANY: Final = 5
_SLIGHT: Final = 2e-3
"""Scatter of frequencies that one beam may have: ten kelvin change steel's stiffness by 0.3 %."""


def specimens(found: Homogeneity) -> list[str]:
    """Say first that sessions are not of one specimen; nothing if they are."""
    said = _stated(found.specimens) if len(found.specimens) > 1 else []
    leading = found.leading
    return said if leading is None else [*said, *_differing(found, leading)]


def _stated(found: Sequence[StatedSpecimen]) -> list[str]:
    keys = in_dispute(found)
    each = "; ".join(
        f"{', '.join(f'{key} {told(key, one.facts[key])}' for key in keys if key in one.facts)} "
        f"in {_files([path.name for path in one.paths])}"
        for one in found
    )
    first = ", ".join(f"{key} {told(key, found[0].facts[key])}" for key in keys)
    return [
        f"The files are not of one specimen, they state {len(found)}: {each}. Nothing is pooled "
        f"over different specimens: all that follows is of {first}. Give analyze the files of "
        "each of the others by themselves, or correct the metadata where they are wrong."
    ]


def _differing(found: Homogeneity, leading: Heterogeneity) -> list[str]:
    others = [
        label(each.quantity)[0]
        for each in found.quantities
        if each.mixed and not each.of_rig and each is not leading
    ]
    also = f" The same holds of {', '.join(others)}." if others else ""
    return [
        f"The sessions are not of one specimen in one state: {_scatter(leading)}.{also}",
        f"{_where(leading)} So what is pooled here is the mean of a mixture (marked "
        f"{MIXTURE_MARK} where sessions differ in it so), and may belong to none of them: analyse "
        "the sessions of each specimen by themselves, or find what changed between sessions "
        f"(clamp, temperature, wear).{_slight(found)}",
    ]


def _slight(found: Homogeneity) -> str:
    """Say where a scatter is many standard deviations only because these are so small."""
    frequencies = [each for each in found.quantities if each.quantity.startswith("frequency_hz")]
    mixed = [each for each in frequencies if each.mixed]
    if not mixed or any(each.between_std > _SLIGHT * each.mean for each in mixed):
        return ""
    return (
        f" Frequencies scatter by less than {100 * _SLIGHT:g} %: one beam may do so whose "
        "temperature or clamp changes."
    )


def _scatter(each: Heterogeneity) -> str:
    """Say by how much one quantity scatters, of its own uncertainty and of its size."""
    percents = percent(each.i_squared)
    equals = "" if percents.startswith(">") else "= "
    size = _told([each.between_std], each)
    share = f"{size}, {100 * each.between_std / abs(each.mean):.2g} %; " if each.mean else ""
    return (
        f"{label(each.quantity)[0]} scatters between sessions by {each.own_stds:.3g} of its own "
        f"standard deviations ({share}Cochran's Q = {each.cochran_q:.3g} where "
        f"{each.degrees_of_freedom} is expected, I² {equals}{percents})"
    )


def percent(share: float) -> str:
    """Write a share that may be next to 1, but is not 1."""
    return "> 99.9 %" if share > 0.999 else f"{100 * share:.3g} %"


def title(text: str, found: Homogeneity) -> str:
    """Say in a title that what is under it is pooled over a mixture."""
    return f"{text}, {_OF_MIXTURE}" if found.mixed else text


def _where(each: Heterogeneity) -> str:
    """Say which sessions lie together, or where the outermost are."""
    name, _, _ = label(each.quantity)
    values = {file: (value, std) for file, value, std in each.values}
    if each.groups:
        parts = "; ".join(
            f"{_told([values[file][0] for file in part], each)} in {_files(part)}"
            for part in each.groups
        )
        return f"By the {name} they are {len(each.groups)} groups: {parts}."
    low, high = _ends(each.values)
    return (
        f"There are no clear groups: the {name} goes from {_told([low[1]], each)} in {low[0]} to "
        f"{_told([high[1]], each)} in {high[0]}."
    )


def _ends(values: Values) -> tuple[tuple[str, float, float], tuple[str, float, float]]:
    ordered = sorted(values, key=lambda each: each[1])
    return ordered[0], ordered[-1]


def _told(values: Sequence[float], each: Heterogeneity) -> str:
    """Write a mean with the digits that tell it from the others."""
    _, factor, unit = label(each.quantity)
    digits = max(1 - int(np.floor(np.log10(factor * max(each.between_std, 1e-300)))), 0)
    times = "·" if unit.startswith("10") else " "
    return f"{factor * float(np.mean(values)):.{min(digits, 9)}f}{times}{unit}".rstrip()


def _files(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MANY]) + (
        f" and {len(names) - _MANY} more" if len(names) > _MANY else ""
    )
    return f"{len(names)} file{'' if len(names) == 1 else 's'} ({shown})"
