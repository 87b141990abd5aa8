"""Notes of tables on scales that no session determines: torque scale, length and density."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.identify.scales import SCALE_EXPONENTS, density_check, scales_absorbed
from analysis.models import QUANTITIES
from analysis.report.table import estimate_cells

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from analysis.results import WholeRecord

_WORDS: Final = {"torque_scale": "torque scale", "length": "length"}
_SUPERSCRIPTS: Final = str.maketrans("-123456789", "⁻¹²³⁴⁵⁶⁷⁸⁹")


def scale_notes(whole: WholeRecord) -> Iterator[str]:
    """Return the notes on what statistical intervals exclude, and those with scales include."""
    if not scales_absorbed(whole.fit):
        held = ", ".join(QUANTITIES[name][0] for name in whole.fixed)
        yield (
            f"Intervals are statistical only: the file's values of {held}, which were held, the "
            "torque scale and the length are assumed exact."
        )
        return
    stated = whole.record.uncertainty
    known = [
        f"{words} {100 * stated[name]:.3g} %" for name, words in _WORDS.items() if name in stated
    ]
    missing = [words for name, words in _WORDS.items() if name not in stated]
    if known:
        yield (
            "With scales: 95 % intervals that include the relative standard uncertainty of "
            f"{' and '.join(known)}, in quadrature; the others are statistical only."
        )
    if missing:
        yield (
            f"{'Not included' if known else 'Intervals are statistical only. Not included'}: the "
            f"uncertainty of {' and '.join(missing)}, which the file does not state."
        )
    yield (
        f"A wrong scale shows as {_powers(whole)}; no other parameter depends on these, and none "
        "on the stated density."
    )
    found = density_check(whole.fit, whole.record.beam.density_kg_per_m, stated)
    if found is None:
        return
    pairs = (
        (found.found_kg_per_m, found.found_std_kg_per_m),
        (found.stated_kg_per_m, found.stated_std_kg_per_m),
    )
    (value, std), (other, its) = (estimate_cells(pair, pair[1], 1e3) for pair in pairs)
    yield (
        f"Mass per length from the record, ρ/EI times EI: {value.text} ± {std.text} g/m (std); "
        f"stated: {other.text} ± {its.text} g/m. "
        + (
            "They agree."
            if found.agree
            else "The difference is significant (95 %): check torque scale and length."
        )
    )


def _powers(whole: WholeRecord) -> str:
    """Name the parameters that go with a scale, each with its powers."""
    return ", ".join(
        f"{QUANTITIES[name][0]} ∝ {_product(SCALE_EXPONENTS[name])}"
        for name in whole.headline.parameters
        if name in SCALE_EXPONENTS
    )


def _product(exponents: Mapping[str, int]) -> str:
    return " · ".join(
        _WORDS[scale] + ("" if power == 1 else str(power).translate(_SUPERSCRIPTS))
        for scale, power in exponents.items()
    )
