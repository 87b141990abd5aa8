"""Notes of tables on the scales that no session determines: torque scale, length and density."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.identify.scales import SCALE_EXPONENTS, density_check, parameters_compensate_scales
from analysis.report.table import estimate_cells
from rigd.beam import parameter_named

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
        held_parameters = ", ".join(
            parameter_named(scale_key).symbol for scale_key in whole_record.fixed
        )
        yield (
            f"Intervals are statistical only: the file's values of {held_parameters}, "
            "which were held, the torque scale and the length are assumed exact."
        )
        return
    stated_uncertainty = whole_record.record.uncertainty
    known_scales = [
        f"{scale_name} {100 * stated_uncertainty[scale_key]:.3g} %"
        for scale_key, scale_name in _SCALE_NAMES.items()
        if scale_key in stated_uncertainty
    ]
    unknown_scales = [
        scale_name
        for scale_key, scale_name in _SCALE_NAMES.items()
        if scale_key not in stated_uncertainty
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
    density_result = density_check(
        whole_record.fit, whole_record.record.beam.density_kg_per_m, stated_uncertainty
    )
    if density_result is None:
        return
    value_std_pairs = (
        (density_result.found_kg_per_m, density_result.found_std_kg_per_m),
        (density_result.stated_kg_per_m, density_result.stated_std_kg_per_m),
    )
    (found_value, found_std), (stated_value, stated_std) = (
        estimate_cells(value_std_pair, value_std_pair[1], 1e3) for value_std_pair in value_std_pairs
    )
    yield (
        f"Mass per length from the record, ρ/EI times EI: {found_value.text} ± {found_std.text} "
        f"g/m (std); stated: {stated_value.text} ± {stated_std.text} g/m. "
        + (
            "They agree."
            if density_result.agree
            else "The difference is significant (95 %): check torque scale and length."
        )
    )


def _scale_dependence(whole_record: WholeRecord) -> str:
    """Return as text how each parameter depends on the scales, as products of their powers."""
    return ", ".join(
        f"{parameter_named(name).symbol} ∝ {_product_text(SCALE_EXPONENTS[name])}"
        for name in whole_record.headline.parameters
        if name in SCALE_EXPONENTS
    )


def _product_text(exponents: Mapping[str, int]) -> str:
    """Return a product of powers of scales as text."""
    return " · ".join(
        _SCALE_NAMES[scale_name]
        + ("" if scale_power == 1 else str(scale_power).translate(_SUPERSCRIPTS))
        for scale_name, scale_power in exponents.items()
    )
