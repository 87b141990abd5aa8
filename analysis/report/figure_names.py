"""Names of the figures in a record's report, which are known before any figure is drawn."""

from typing import Final

UNIFORMITY_FIGURE: Final = "uniform_beam"
"""Name of the file with the figure of the test of the beam's uniformity, without suffix."""
FIGURES: Final = ("record_frf", UNIFORMITY_FIGURE, "loss_factor", "residual", "record_signals")
"""File names of a whole record's figures.

The second figure is omitted if too few modes are visible for the test."""
WELCH_FIGURES: Final = ("welch_signals", "welch_frf", "welch_torque")
"""Names of the Welch fits' figures."""
_WELCH_FIGURES_WITH_RECORD: Final = ("welch_frf",)
"""Names of the Welch fits' figures in a report with whole-record fits.

The whole-record fits have their own figures of signals and torque."""


def welch_figure_names(*, with_paper_figures: bool, has_whole_record: bool) -> tuple[str, ...]:
    """Return the names of the Welch fits' figures in a report.

    Parameters
    ----------
    with_paper_figures : bool
        Whether the Welch fits were run.
    has_whole_record : bool
        Whether the whole-record fits were run.
    """
    if not with_paper_figures:
        return ()
    return _WELCH_FIGURES_WITH_RECORD if has_whole_record else WELCH_FIGURES
