"""The page on a campaign: verdict, figures, tables, and how it was computed, in one file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.report._campaign_tables import sessions_table, shown_tables
from analysis.report._campaign_text import campaign_sentences
from analysis.report._page import page, versions
from analysis.report._paper_tables import paper_tables

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime

    from analysis.campaigns import CampaignResult
    from analysis.report._page import Facts
    from analysis.report._style import Picture

_OF_RECORDS: Final = ("damping", "pooled_response", "pooled", "validation")
"""Figures that go with the verdict; the others are the paper's."""


def campaign_page(
    campaign: CampaignResult, pictures: Sequence[Picture], made_at: datetime, *, with_paper: bool
) -> str:
    """Put a campaign's report together.

    Parameters
    ----------
    campaign : CampaignResult
    pictures : sequence of Picture
    made_at : datetime
        When, with a time zone.
    with_paper : bool
        Whether the paper's numbers stand beside these.

    Returns
    -------
    str
        An HTML document that refers to nothing outside it.
    """
    paths = [each.path for each in campaign.sessions]
    sentences = campaign_sentences(campaign)
    return page(
        "campaign.html",
        title=f"Campaign of {len(paths)} sessions",
        files=f"{paths[0].name} to {paths[-1].name}, in {paths[0].absolute().parent}",
        first=sentences[:1],
        sentences=sentences[1:],
        experiments=campaign.verdict.experiments if campaign.verdict else (),
        warnings=_warnings(campaign),
        pictures=[each for each in pictures if each.name in _OF_RECORDS],
        tables=(*shown_tables(campaign), sessions_table(campaign)),
        paper_pictures=[each for each in pictures if each.name not in _OF_RECORDS],
        paper_tables=paper_tables(campaign, with_paper=with_paper),
        how=_how(campaign, made_at),
    )


def _warnings(campaign: CampaignResult) -> list[str]:
    return [
        *(f"Left out: {each.message}" for each in campaign.failures),
        *(
            f"Not predicted from the others: {each.path}: {each.reason}"
            for each in campaign.lost_trials
        ),
        *(
            f"{session.path.name}: {warning}"
            for session in campaign.sessions
            for warning in session.warnings
        ),
    ]


def _how(campaign: CampaignResult, made_at: datetime) -> list[Facts]:
    """Collect what is known of specimen, estimators and versions."""
    settings, (first_hz, last_hz) = campaign.settings, campaign.record_band_hz
    beam = campaign.sessions[0].beam
    parts = [
        (
            "Specimen, as the files state it",
            [
                ("beam length", f"{beam.length_m:g} m"),
                ("beam density", f"{beam.density_kg_per_m:g} kg/m"),
                ("bending stiffness", f"{beam.bending_stiffness_n_m2:g} N·m²"),
            ],
        ),
        (
            "Whole records",
            [
                (
                    "estimator",
                    "output error: the torque that the exact model (Eq. 25) predicts from the "
                    "measured angle minus the measured torque, whitened by the noise model",
                ),
                ("band", f"{first_hz:g} to {last_hz:g} Hz"),
                (
                    "pooled",
                    "random effects: sessions with their own covariances, and a between-session "
                    "variance of each parameter (DerSimonian and Laird); Student's t",
                ),
                (
                    "structure",
                    "the freest on the beam of the lowest Bayesian information criterion of all "
                    "sessions together, the same for all sessions",
                ),
            ],
        ),
        (
            "Welch method (as in the paper)",
            [
                ("estimator", settings.estimator),
                ("band", f"{settings.band_hz[0]:g} to {settings.band_hz[1]:g} Hz"),
                ("types", ", ".join(settings.types)),
                ("weights", ", ".join(settings.weightings)),
            ],
        ),
        versions(made_at),
    ]
    if not campaign.nominal:
        del parts[2]
    if not campaign.sessions[0].record_estimates:
        del parts[1]
    return parts
