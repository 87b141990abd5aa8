"""Which experiment would tell more."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.selection.visible import driven

if TYPE_CHECKING:
    from analysis.selection.candidate import Candidate
    from analysis.selection.candidates import Field
    from analysis.selection.finding import Finding
    from analysis.selection.orders import OrderVerdict

_ENOUGH: Final = 2
_SECOND: Final = 6.267
"""Frequency of the second mode of a uniform beam over that of the first."""

_ORDINALS: Final = {1: "first", 2: "second"}


def experiments(
    field: Field,
    orders: tuple[OrderVerdict, ...],
    visible: tuple[int, ...],
    found: tuple[Finding, ...],
    close: tuple[Candidate, ...],
) -> list[str]:
    """Say what would tell more, each piece of advice once."""
    advice = []
    unknown = [o for o in orders if o.status == "not identifiable"]
    if unknown:
        names = " and ".join(o.order for o in unknown)
        if len(visible) < _ENOUGH:
            advice.append(f"To find {names}, {_for_two_modes(field, visible)}")
        else:
            advice.append(
                f"To find {names}, measure longer where it counts: narrow, slow sweeps round "
                "the modes, or a wider sweep that reaches one more mode."
            )
    unexplained = any(finding.kind == "unexplained" for finding in found)
    if close or (not unexplained and any(o.status == "open" for o in orders)):
        advice.append(
            "To tell the structures apart, excite one more mode (a wider sweep), or sweep longer."
        )
    advice += [finding.remedy for finding in found if finding.remedy]
    return list(dict.fromkeys(advice))


def _for_two_modes(field: Field, visible: tuple[int, ...]) -> str:
    """Say how both of the first two modes would show."""
    modes = {mode.number: mode.frequency_hz for mode in field.best.fit.modes}
    first_hz = modes.get(1, 0.0)
    at_hz = {1: first_hz, 2: modes.get(2, _SECOND * first_hz)}
    missing = next(number for number in (1, 2) if number not in visible)
    other = 3 - missing
    last_hz = float(field.comparison.frequency_hz[-1])
    if at_hz[missing] > last_hz:
        return (
            f"analyse and excite the {_ORDINALS[missing]} mode as well: band and sweep up to at "
            f"least {1.3 * at_hz[missing]:.0f} Hz (the band ends at {last_hz:.0f} Hz)."
        )
    if not driven(field.comparison, at_hz[missing], relative_to_hz=at_hz[other]):
        return f"excite the {_ORDINALS[missing]} mode as well: sweep " + (
            f"up to at least {1.3 * at_hz[2]:.0f} Hz."
            if missing == 2
            else f"from below {0.7 * at_hz[1]:.1f} Hz."
        )
    return (
        f"let the {_ORDINALS[missing]} mode stand out of the noise: the motor was driven at its "
        f"{at_hz[missing]:.1f} Hz, so sweep louder (twice the amplitude), slower, or several "
        "times, not wider."
    )
