"""Notes of tables on the scales that no session determines: torque scale, length and density."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.identify.scales import SCALE_EXPONENTS, density_check, parameters_compensate_scales
from analysis.models import QUANTITIES
from analysis.report.table import estimate_cells

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from analysis.results import WholeRecord

_SCALE_NAMES: Final = {"torque_scale": "torque scale", "length": "length"}
"""Names of the scales in notes, by key."""
_SUPERSCRIPTS: Final = str.maketrans("-123456789", "⁻¹²³⁴⁵⁶⁷⁸⁹")
"""Translation table from digits and the minus sign to superscripts."""


def scale_notes(whole_record: WholeRecord) -> Iterator[str]:
    """Yield notes on the scales: which uncertainties the intervals include, and which not."""
    if not parameters_compensate_scales(whole_record.fit):
        held_parameters = ", ".join(QUANTITIES[name][0] for name in whole_record.fixed)
        yield (
            f"Intervals are statistical only: the file's values of {held_parameters}, "
            "which were held, the torque scale and the length are assumed exact."
        )
        return
    stated_uncertainty = whole_record.record.uncertainty
    known_scales = [
        f"{scale_name} {100 * stated_uncertainty[name]:.3g} %"
        for name, scale_name in _SCALE_NAMES.items()
        if name in stated_uncertainty
    ]
    unknown_scales = [
        scale_name for name, scale_name in _SCALE_NAMES.items() if name not in stated_uncertainty
    ]
    if known_scales:
        yield (
            "With scales: 95 % intervals that include the relative standard uncertainty of "
            f"{' and '.join(known_scales)}, in quadrature; the others are statistical only."
        )
    if unknown_scales:
        yield (
            f"{'Not included' if known_scales else 'Intervals are statistical only. Not included'}"
            f": the uncertainty of {' and '.join(unknown_scales)}, which the file does not state."
        )
    yield (
        f"A wrong scale shows as {_scale_dependence(whole_record)}; no other parameter depends on "
        "these, and none on the stated density."
    )
    density = density_check(
        whole_record.fit, whole_record.record.beam.density_kg_per_m, stated_uncertainty
    )
    if density is None:
        return
    pairs = (
        (density.found_kg_per_m, density.found_std_kg_per_m),
        (density.stated_kg_per_m, density.stated_std_kg_per_m),
    )
    (value, std), (stated_value, stated_std) = (
        estimate_cells(pair, pair[1], 1e3) for pair in pairs
    )
    yield (
        f"Mass per length from the record, ρ/EI times EI: {value.text} ± {std.text} g/m (std); "
        f"stated: {stated_value.text} ± {stated_std.text} g/m. "
        + (
            "They agree."
            if density.agree
            else "The difference is significant (95 %): check torque scale and length."
        )
    )


def _scale_dependence(whole_record: WholeRecord) -> str:
    """Return how each parameter depends on the scales, as a list of powers."""
    return ", ".join(
        f"{QUANTITIES[name][0]} ∝ {_product_text(SCALE_EXPONENTS[name])}"
        for name in whole_record.headline.parameters
        if name in SCALE_EXPONENTS
    )


def _product_text(exponents: Mapping[str, int]) -> str:
    """Return a product of powers of scales as text."""
    return " · ".join(
        _SCALE_NAMES[scale] + ("" if power == 1 else str(power).translate(_SUPERSCRIPTS))
        for scale, power in exponents.items()
    )
