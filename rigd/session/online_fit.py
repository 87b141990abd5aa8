"""Text that reports the estimates of the fit during a session."""

from collections.abc import Mapping
from math import isnan
from typing import Any

from rigd.estimates import ReportedMode, modes_from_json, unseen_modes_text
from rigd.session._validity import Validity


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
    validity_text = Validity.from_document(fit_document.get("validity")).short_text
    heading = f"± 95 %, statistical only; tip slope {validity_text}"
    report_lines = [f"After {fit_document['duration_s']:.1f} s ({heading}):"]
    modes = modes_from_json(fit_document["modes"])
    earlier_modes = {
        mode.number: mode
        for mode in modes_from_json((earlier_document or {}).get("modes"))
        if mode.shown
    }
    for mode in modes:
        if mode.shown:
            earlier_mode = earlier_modes.get(mode.number)
            change_text = "" if earlier_mode is None else _change_text(earlier_mode, mode)
            doubt_text = f" (doubtful: {mode.flag})" if mode.flag else ""
            report_lines.append(f"  {mode.summary_line()}{change_text}{doubt_text}")
    if unseen_text := unseen_modes_text(modes):
        report_lines.append(f"  not visible so far: {unseen_text}")
    if uniform_beam := Validity.from_document(fit_document.get("validity")).uniform_beam:
        report_lines.append(f"  {uniform_beam.sentence}")
    return [*report_lines, *findings]


def _change_text(earlier_mode: ReportedMode, mode: ReportedMode) -> str:
    """Return text with the changes of a mode's frequency in Hz and of its damping in percent."""
    change_percent = mode.damping_ratio.percent_above(earlier_mode.damping_ratio)
    percent_text = "" if isnan(change_percent) else f", {change_percent:+.2g} %"
    return f"; change {mode.frequency_change_text(earlier_mode)}{percent_text}"
