"""Sentences on the specimens of a campaign: whether its sessions agree, or change with time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns._experiment import differing_fact_keys, fact_text
from analysis.campaigns.labels import (
    format_hours,
    format_p_value,
    format_percent,
    join_first_texts,
    label_and_unit,
)
from rigd.units import decimals, rounded_to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns._experiment import StatedSpecimen
    from analysis.campaigns._homogeneity import Heterogeneity, Homogeneity, SessionEstimates
    from analysis.campaigns.trend import Trend

MIXTURE_MARK: Final = "‡"
"""Mark of values in tables and figures that are pooled over different specimens."""
_MIXTURE_TITLE: Final = "of a mixture"
"""Addition to the title of a table whose values are pooled over different specimens."""
MIXTURE_NOTE: Final = (
    f"{MIXTURE_MARK} sessions differ by more than their uncertainties: the mean of a "
    "mixture, which may be valid for none of them."
)
"""Footnote that explains `MIXTURE_MARK`."""
WRONG_METADATA_REMEDY: Final = (
    "If the metadata of a file are wrong, export its record and import it again with the right "
    "ones (analyze export record, analyze import)."
)
"""What to do about a file that states a wrong specimen or experiment."""
_SLIGHT_FREQUENCY_SCATTER: Final = 2e-3
"""Largest relative scatter of a frequency that a single beam may show: ten kelvin change the
stiffness of steel by 0.3 %."""

_MIN_SESSIONS_WITH_CERTAIN_GROUPS: Final = 12
"""Smallest number of sessions whose groups are stated as a fact: of fewer than twelve sessions from
one normal distribution, 3 to 38 % have clear gaps."""


_MIN_RATE_DURATION_H: Final = 1.0
"""Duration in hours from which a change is stated per hour. A change within a shorter time is
stated as such: per hour it would be an extrapolation."""


def describe_specimens(homogeneity: Homogeneity) -> list[str]:
    """Return sentences about different specimens; an empty list if the sessions agree."""
    sentences = (
        _describe_stated_specimens(homogeneity.specimens) if len(homogeneity.specimens) > 1 else []
    )
    leading_scatter = homogeneity.leading_scatter
    return (
        sentences
        if leading_scatter is None
        else [*sentences, *_describe_different_specimens(homogeneity, leading_scatter)]
    )


def describe_blocks(homogeneity: Homogeneity, block_count: int) -> list[str]:
    """Return a sentence that the sessions are blocks of one session, or an empty list.

    Parameters
    ----------
    homogeneity : Homogeneity
        Comparison of the sessions.
    block_count : int
        Number of sessions.
    """
    if not homogeneity.is_one_session:
        return []
    return [f"The session is divided into {block_count} blocks. Here, each block is a session."]


def describe_trends(homogeneity: Homogeneity) -> list[str]:
    """Return a sentence on the quantities that change with time, or an empty list.

    That nothing changes is stated of the blocks of one session only.
    """
    trends = [
        (scatter.quantity, scatter.trend, scatter.has_significant_trend)
        for scatter in homogeneity.quantities
        if scatter.trend is not None
    ]
    significant_trends = [trend for trend in trends if trend[-1]]
    if not (significant_trends or (trends and homogeneity.is_one_session)):
        return []
    covered_h = max(trend.covered_h for _, trend, _ in significant_trends or trends)
    if significant_trends:
        changes_text = "; ".join(
            _change_text(name, trend, covered_h) for name, trend, _ in significant_trends
        )
        return [
            f"Change with time over {format_hours(covered_h)} (straight lines, 95 %): "
            f"{changes_text}. Pooled values are means over this time."
        ]
    lowest_p_value = min(trend.p_value for _, trend, _ in trends)
    return [
        f"No significant change with time over {format_hours(covered_h)} (straight lines, lowest "
        f"p of {len(trends)}: {format_p_value(lowest_p_value)}): "
        f"{_change_text(*trends[0][:2], covered_h)}."
    ]


def _change_text(quantity: str, trend: Trend, covered_h: float) -> str:
    """Describe the change of a quantity over a time in hours, with its 95 % half width.

    The change is per hour if the time is `_MIN_RATE_DURATION_H` or more.
    """
    quantity_label, factor, display_unit = label_and_unit(quantity)
    is_rate = covered_h >= _MIN_RATE_DURATION_H
    change_h = 1.0 if is_rate else covered_h
    half_width = change_h * (trend.interval_95_per_h[1] - trend.interval_95_per_h[0]) / 2
    change_text, half_width_text = rounded_to_uncertainty(
        (change_h * trend.slope_per_h, half_width), half_width, factor
    )
    sign_text = "+" if trend.slope_per_h > 0 else ""
    unit_text = f" {display_unit}" if display_unit else ""
    rate_text = " per hour" if is_rate else ""
    return f"{quantity_label} by {sign_text}{change_text} ± {half_width_text}{unit_text}{rate_text}"


def pooled_title(title_text: str, homogeneity: Homogeneity) -> str:
    """Return the title of a table or figure, with an addition for values of several specimens.

    Parameters
    ----------
    title_text : str
        Title without the addition.
    homogeneity : Homogeneity
        Whether the sessions are of one specimen.
    """
    return f"{title_text}, {_MIXTURE_TITLE}" if homogeneity.is_mixture else title_text


def _describe_stated_specimens(specimens: Sequence[StatedSpecimen]) -> list[str]:
    """Describe the different specimens that the session files state."""
    differing_keys = differing_fact_keys(specimens)
    specimen_texts = "; ".join(
        ", ".join(
            f"{key} {fact_text(key, specimen.facts[key])}"
            for key in differing_keys
            if key in specimen.facts
        )
        + f" in {_list_files(specimen.file_names)}"
        for specimen in specimens
    )
    first_specimen = ", ".join(
        f"{key} {fact_text(key, specimens[0].facts[key])}" for key in differing_keys
    )
    return [
        f"The files state {len(specimens)} different specimens: {specimen_texts}. Specimens are "
        f"never pooled: all results below are for {first_specimen}. Analyse the files of the "
        f"others separately. {WRONG_METADATA_REMEDY}"
    ]


def _describe_different_specimens(
    homogeneity: Homogeneity, leading_scatter: Heterogeneity
) -> list[str]:
    """Describe how the estimates show that the sessions are of different specimens."""
    other_labels = [
        label_and_unit(scatter.quantity)[0]
        for scatter in homogeneity.quantities
        if scatter.is_mixture and not scatter.is_of_rig and scatter is not leading_scatter
    ]
    other_quantities_sentence = (
        f" The same holds for {', '.join(other_labels)}." if other_labels else ""
    )
    groups_sentence = _describe_groups(
        leading_scatter, "block" if homogeneity.is_one_session else "file"
    )
    if homogeneity.is_one_session:
        return [
            "The antenna did not stay in one state during the session: "
            f"{_describe_heterogeneity(leading_scatter)}.{other_quantities_sentence}",
            f"{groups_sentence} Pooled values are then means over several states (marked "
            f"{MIXTURE_MARK}): find what changed during the session (clamp, temperature, "
            f"wear).{_small_scatter_remark(homogeneity)}",
        ]
    return [
        "The sessions are not of one specimen in one state: "
        f"{_describe_heterogeneity(leading_scatter)}.{other_quantities_sentence}",
        f"{groups_sentence} Pooled values are then means of a mixture (marked "
        f"{MIXTURE_MARK}) that "
        "may hold for none of the specimens: analyse the sessions of each specimen separately, or "
        "find what changed between sessions (clamp, temperature, "
        f"wear).{_small_scatter_remark(homogeneity)}",
    ]


def _small_scatter_remark(homogeneity: Homogeneity) -> str:
    """Return a remark that the frequencies vary little in relative terms, or an empty text."""
    frequency_scatters = [
        scatter for scatter in homogeneity.quantities if scatter.quantity.startswith("frequency_hz")
    ]
    mixed_scatters = [scatter for scatter in frequency_scatters if scatter.is_mixture]
    if not mixed_scatters or any(
        scatter.between_session_std > _SLIGHT_FREQUENCY_SCATTER * scatter.mean
        for scatter in mixed_scatters
    ):
        return ""
    return (
        f" Frequencies vary by less than {100 * _SLIGHT_FREQUENCY_SCATTER:g} %, as those of one "
        "beam may when its temperature or clamp changes."
    )


def _describe_heterogeneity(scatter: Heterogeneity) -> str:
    """Describe the between-session scatter of a quantity, relative to its uncertainty and size."""
    i_squared_text = format_percent(scatter.i_squared)
    equals_sign = "" if i_squared_text.startswith(">") else "= "
    between_std_text = _mean_text([scatter.between_session_std], scatter)
    scatter_text = (
        f"{between_std_text}, {100 * scatter.between_session_std / abs(scatter.mean):.2g} %; "
        if scatter.mean
        else ""
    )
    return (
        f"{label_and_unit(scatter.quantity)[0]} varies between sessions by "
        f"{scatter.relative_between_session_std:.3g} of its own "
        f"standard deviations ({scatter_text}Cochran's Q = {scatter.cochran_q:.3g} where "
        f"{scatter.degrees_of_freedom} is expected, I² {equals_sign}{i_squared_text})"
    )


def _describe_groups(scatter: Heterogeneity, kind_text: str) -> str:
    """Describe the groups of sessions or, if there are none, the sessions with extreme values.

    `kind_text` is what a session is called: a file or a block.
    """
    quantity_label, _, _ = label_and_unit(scatter.quantity)
    values_by_file = {
        file_name: (session_value, std)
        for file_name, session_value, std in scatter.session_estimates
    }
    if scatter.session_groups:
        groups_text = "; ".join(
            f"{_mean_text([values_by_file[file_name][0] for file_name in group], scatter)} in "
            f"{_list_files(group, kind_text)}"
            for group in scatter.session_groups
        )
        group_count, session_count = len(scatter.session_groups), len(scatter.session_estimates)
        if session_count < _MIN_SESSIONS_WITH_CERTAIN_GROUPS:
            return (
                f"By the {quantity_label} they may be {group_count} groups: {groups_text}; with "
                f"{session_count} {kind_text}s, one continuous scatter can leave such gaps, too."
            )
        return f"By the {quantity_label} they are {group_count} groups: {groups_text}."
    lowest_session, highest_session = _extreme_sessions(scatter.session_estimates)
    return (
        f"There are no clear groups: the {quantity_label} goes from "
        f"{_mean_text([lowest_session[1]], scatter)} in {lowest_session[0]} "
        f"to {_mean_text([highest_session[1]], scatter)} in {highest_session[0]}."
    )


def _extreme_sessions(
    session_estimates: SessionEstimates,
) -> tuple[tuple[str, float, float], tuple[str, float, float]]:
    """Return the entries of the sessions with the lowest and the highest value."""
    sorted_estimates = sorted(session_estimates, key=lambda session_estimate: session_estimate[1])
    return sorted_estimates[0], sorted_estimates[-1]


def _mean_text(session_values: Sequence[float], scatter: Heterogeneity) -> str:
    """Format the mean of values with its unit, and enough digits to distinguish the groups."""
    _, factor, display_unit = label_and_unit(scatter.quantity)
    decimal_digits = min(decimals(factor * max(scatter.between_session_std, 1e-300)), 9)
    separator = "·" if display_unit.startswith("10") else " "
    return (
        f"{factor * float(np.mean(session_values)):.{decimal_digits}f}{separator}{display_unit}"
    ).rstrip()


def _list_files(file_names: Sequence[str], kind_text: str = "file") -> str:
    """Return the number of files, or of another kind, and the names of the first few."""
    return (
        f"{len(file_names)} {kind_text}{'' if len(file_names) == 1 else 's'} "
        f"({join_first_texts(file_names)})"
    )
