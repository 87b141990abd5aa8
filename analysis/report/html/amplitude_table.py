"""Table of the damping against the amplitude."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.report.html.table import Column, Table, count, estimate, number
from analysis.report.record_figure_bands import NORMAL_95

if TYPE_CHECKING:
    from analysis.report.html.subject import Subject


def amplitude_tables(subject: Subject) -> tuple[Table, ...]:
    """Damping ratios of free vibration by amplitude, if the record tells; else no table."""
    found = subject.verdict.damping_with_amplitude
    if not found:
        return ()
    rows = tuple(
        (
            count(at.mode),
            number(at.tip_amplitude_m, ".3g", 1e3),
            *estimate(
                (
                    at.damping_ratio,
                    at.std,
                    at.damping_ratio - NORMAL_95 * at.std,
                    at.damping_ratio + NORMAL_95 * at.std,
                ),
                at.std,
                100.0,
            ),
        )
        for at in found
    )
    return (
        Table(
            "damping_with_amplitude",
            "Damping of free vibration against the amplitude, air drag included",
            (
                Column("Mode", "mode"),
                Column("Tip amplitude (mm)", "tip_amplitude_m"),
                Column("Damping ratio (%)", "damping_ratio"),
                Column("std (%)", "damping_ratio_std"),
                Column("95 % from (%)", "damping_ratio_low"),
                Column("to (%)", "damping_ratio_high"),
            ),
            rows,
            ("Amplitude 0 is the beam without air, as in the table of the modes.",),
        ),
    )
