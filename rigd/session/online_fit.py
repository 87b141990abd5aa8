"""Text for the estimates of a session's fit while it runs, and for those of a quick look."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from rigd.printable import listed
from rigd.session._validity import Validity
from rigd.units import decimals, with_half_width

_KG_MM2_PER_KG_M2: Final = 1e6
"""Conversion factor from kg m² to kg mm²."""


def mode_line(mode: Mapping[str, Any]) -> str:
    """Return one line of text with frequency, damping and inertia of an estimated mode.

    Parameters
    ----------
    mode
        Mode in the format of quick looks and online fits.

    Examples
    --------
    >>> from rigd.session.online_fit import mode_line
    >>> hz = {"value": 2.5699, "interval_95": [2.5687, 2.5711]}
    >>> print(mode_line({"mode": 1, "frequency_hz": hz,
    ...                  "damping_ratio": {"value": 0.00909, "interval_95": None}}))
    mode 1: 2.5699 ± 0.0012 Hz, damping 0.909 %
    """
    hz, damping_estimate = mode["frequency_hz"], mode["damping_ratio"]
    mode_text = (
        f"mode {mode['mode']}: {with_half_width(hz['value'], hz['interval_95'])} Hz, "
        "damping "
        f"{with_half_width(damping_estimate['value'], damping_estimate['interval_95'], 100.0)} %"
    )
    inertia_estimate = mode.get("participation")
    if inertia_estimate is None:
        return mode_text
    inertia_text = with_half_width(
        inertia_estimate["value"], inertia_estimate["interval_95"], _KG_MM2_PER_KG_M2
    )
    return f"{mode_text}, inertia {inertia_text} kg·mm²"


def estimate_lines(
    fit_document: Mapping[str, Any], earlier_document: Mapping[str, Any] | None = None
) -> list[str]:
    """Return lines of text that report an estimate of the online fit to the operator.

    Parameters
    ----------
    fit_document
        Estimate in the format of docs/online_fit.md.
    earlier_document
        Earlier estimate with which the modes are compared, or None for no comparison.
    """
    findings = [f"  {finding_sentence}" for finding_sentence in fit_document["findings"]]
    if fit_document["problem"]:
        return [f"After {fit_document['duration_s']:.1f} s: {fit_document['problem']}", *findings]
    validity = Validity.of_document(fit_document.get("validity")).short
    heading = f"± 95 %, statistical only; tip slope {validity}"
    report_lines = [f"After {fit_document['duration_s']:.1f} s ({heading}):"]
    earlier_modes = {
        mode["mode"]: mode for mode in (earlier_document or {}).get("modes", ()) if mode["shown"]
    }
    for mode in fit_document["modes"]:
        if mode["shown"]:
            change_text = (
                _change_text(earlier_modes[mode["mode"]], mode)
                if mode["mode"] in earlier_modes
                else ""
            )
            doubt_text = mode["damping_ratio"]["flag"] or mode["frequency_hz"]["flag"]
            report_lines.append(
                f"  {mode_line(mode)}{change_text}"
                f"{f' (doubtful: {doubt_text})' if doubt_text else ''}"
            )
    unseen_text = unseen_modes(fit_document["modes"])
    if unseen_text:
        report_lines.append(f"  not visible so far: {unseen_text}")
    if uniform_beam := Validity.of_document(fit_document.get("validity")).uniform_beam:
        report_lines.append(f"  {uniform_beam.sentence}")
    return [*report_lines, *findings]


def unseen_modes(modes: Iterable[Mapping[str, Any]]) -> str:
    """Return text that names the modes that are not visible in the record so far.

    It is empty if the record shows all modes.

    Parameters
    ----------
    modes
        Modes in the format of the online fit's estimates.

    Examples
    --------
    >>> from rigd.session.online_fit import unseen_modes
    >>> unseen_modes([{"mode": n, "shown": n == 1} for n in (1, 2, 3)])
    'modes 2 and 3'
    """
    unseen_numbers = [str(mode["mode"]) for mode in modes if not mode.get("shown", True)]
    return (
        f"mode{'s' if len(unseen_numbers) > 1 else ''} {listed(unseen_numbers)}"
        if unseen_numbers
        else ""
    )


def _change_text(earlier_mode: Mapping[str, Any], mode: Mapping[str, Any]) -> str:
    """Return text with the change of a mode's frequency in Hz and of its damping in percent."""
    hz, damping_estimate = mode["frequency_hz"], mode["damping_ratio"]
    shift_hz = hz["value"] - earlier_mode["frequency_hz"]["value"]
    earlier_damping = earlier_mode["damping_ratio"]["value"]
    decimal_digits = decimals(hz["std"]) if hz["std"] else 4
    relative_change = (
        f", {100 * (damping_estimate['value'] / earlier_damping - 1):+.2g} %"
        if earlier_damping
        else ""
    )
    return f"; change {shift_hz:+.{decimal_digits}f} Hz{relative_change}"
