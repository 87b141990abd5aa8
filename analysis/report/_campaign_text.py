"""A campaign as text, for the terminal and for text files: verdict, tables, warnings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.console import Group
from rich.text import Text

from analysis.campaigns import lost_trials, specimens
from analysis.report._campaign_tables import main_tables, shown_tables
from analysis.report._paper_tables import paper_tables
from analysis.report._text import as_text, spaced

if TYPE_CHECKING:
    from rich.console import RenderableType

    from analysis.campaigns import CampaignResult

_NO_VERDICT: Final = (
    "No verdict on the whole records: two sessions are needed that determine a structure's damping."
)


def campaign_sentences(campaign: CampaignResult) -> tuple[str, ...]:
    """Return the verdict; without one, what it would have said first, and why there is none."""
    if campaign.verdict is not None:
        return campaign.verdict.sentences
    asked = any(each.record_estimates for each in campaign.sessions)
    return (
        *specimens(campaign.homogeneity),
        *([_NO_VERDICT] if asked else []),
        *lost_trials(campaign.lost_trials, campaign.trials),
    )


def campaign_tables(
    campaign: CampaignResult, *, with_paper: bool = False, verbose: bool = True
) -> RenderableType:
    """Return the verdict, what it rests on, and the paper's Tables 3 to 5.

    Parameters
    ----------
    campaign : CampaignResult
    with_paper : bool
        Whether the paper's numbers stand beside these.
    verbose : bool
        Whether all tables are shown; otherwise, beside the verdict, the pooled modes and parameters
        are, and the tables of the paper if its numbers are to stand beside them.
    """
    parts: list[RenderableType] = []
    said = campaign_sentences(campaign)
    if said:
        first, *others = said
        parts += [Text(first, style="bold"), *map(Text, others)]
        if campaign.verdict is not None and campaign.verdict.experiments:
            parts.append(Text("Further experiments:"))
            parts += [Text(f"  {advice}") for advice in campaign.verdict.experiments]
        parts.append("")
    parts += spaced(shown_tables(campaign) if verbose else main_tables(campaign))
    if verbose or with_paper or campaign.headline is None:
        parts += spaced(paper_tables(campaign, with_paper=with_paper))
    parts += [
        Text(f"Warning: {session.path.name}: {warning}", style="yellow")
        for session in campaign.sessions
        for warning in session.warnings
    ]
    return Group(*parts)


def campaign_text(campaign: CampaignResult, *, with_paper: bool = False) -> str:
    """Return the same as plain text, with the files that were left out."""
    left_out = (Text(f"Left out: {failure.message}") for failure in campaign.failures)
    return as_text(Group(campaign_tables(campaign, with_paper=with_paper), *left_out))
