"""The page on a campaign: verdict, figures, tables, and how it was computed, in one file."""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING, Final

import matplotlib as mpl
import numpy as np

import rigd
from analysis.campaigns import homogeneity_tables, page_tables
from analysis.campaigns.page_paper_tables import paper_tables
from analysis.campaigns.session_list import session_list_table
from analysis.campaigns.tables import likely_estimates, without_verdict
from analysis.report.html.markup import Markup, element, section, table, void
from analysis.report.html.page import STYLE

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import datetime

    from analysis.campaigns.campaign import Campaign

_CONTENTS: Final = (
    ("verdict", "Verdict"),
    ("figures", "Figures"),
    ("tables", "Tables"),
    ("paper", "The paper's route"),
    ("how", "How it was computed"),
)
_OF_RECORDS: Final = ("pooled", "validation")
"""Figures that go with the verdict; the others are the paper's."""


def campaign_page(
    campaign: Campaign, figures: Mapping[str, Markup], made_at: datetime, *, with_paper: bool
) -> str:
    """Put a campaign's report together.

    Parameters
    ----------
    campaign : Campaign
    figures : mapping of str to Markup
        By the names of their files.
    made_at : datetime
        When, with a time zone.
    with_paper : bool
        Whether the paper's numbers stand beside these.

    Returns
    -------
    str
        An HTML document that refers to nothing outside it.
    """
    shown = [figures[name] for name in _OF_RECORDS if name in figures]
    of_paper = [figure for name, figure in figures.items() if name not in _OF_RECORDS]
    tables = _tables(campaign)
    titles = {
        name: title
        for name, title in _CONTENTS
        if (name != "verdict" or campaign.verdict or without_verdict(campaign))
        and (name != "figures" or shown)
        and (name != "paper" or campaign.nominal)
    }
    links = [element("li", element("a", title, href=f"#{name}")) for name, title in titles.items()]
    title = f"Campaign of {len(campaign.sessions)} sessions"
    paths = [each.path for each in campaign.sessions]
    head = element(
        "head",
        void("meta", charset="utf-8"),
        void("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", f"{title}: damping"),
        Markup(f"<style>\n{STYLE.read_text(encoding='utf-8')}</style>"),
    )
    body = element(
        "body",
        element(
            "header",
            element("h1", title),
            element("p", f"{paths[0].name} to {paths[-1].name}, in {paths[0].absolute().parent}"),
        ),
        element("nav", element("ul", *links), aria_label="Contents"),
        element(
            "main",
            _verdict(campaign, titles["verdict"]) if "verdict" in titles else "",
            _warnings(campaign),
            section("figures", titles["figures"], *shown) if shown else "",
            section("tables", titles["tables"], *tables),
            section(
                "paper", titles["paper"], *of_paper,
                *map(table, paper_tables(campaign, with_paper=with_paper)),
            )
            if "paper" in titles
            else "",
            section("how", titles["how"], *_how(campaign, made_at)),
        ),
    )  # fmt: skip
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _verdict(campaign: Campaign, title: str) -> Markup:
    verdict = campaign.verdict
    if verdict is None:
        return section(
            "verdict", title, *(element("p", each) for each in without_verdict(campaign))
        )
    first, *others = verdict.sentences
    said = [element("p", first, class_="damping"), *(element("p", each) for each in others)]
    advice = [element("li", each) for each in verdict.experiments]
    more = [element("p", "What would tell more:"), element("ul", *advice)] if advice else []
    return section("verdict", title, *said, *more)


def _warnings(campaign: Campaign) -> Markup:
    items = [element("li", f"Left out: {each.message}") for each in campaign.failures]
    items += [
        element("li", f"Not predicted from the others: {each.path}: {each.reason}")
        for each in campaign.lost_trials
    ]
    items += [
        element("li", f"{session.path.name}: {warning}")
        for session in campaign.sessions
        for warning in session.warnings
    ]
    return section("warnings", "Read this too", element("ul", *items)) if items else Markup("")


def _tables(campaign: Campaign) -> list[Markup]:
    withheld = campaign.verdict.withheld if campaign.verdict else frozenset[str]()
    found = campaign.homogeneity
    made = [session_list_table(campaign)]
    if len(found.specimens) > 1:
        made.append(homogeneity_tables.specimens_table(found))
    if found.mixed:
        made.append(homogeneity_tables.scatter_table(found))
    for place, each in enumerate(likely_estimates(campaign)):
        made.append(page_tables.parameters_table(each, campaign, withheld))
        if place == 0 and each.modes:
            made.append(page_tables.modes_table(each, found))
    if campaign.structures:
        made.append(page_tables.structures_table(campaign))
    if campaign.validation:
        made.append(page_tables.validation_table(campaign))
    if found.quantities and not found.mixed:
        made.append(homogeneity_tables.scatter_table(found))
    return [table(each) for each in (*made, page_tables.sessions_table(campaign))]


def _how(campaign: Campaign, made_at: datetime) -> list[Markup]:
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
                    "output error: the torque that the exact model (Eq. 25) makes of the measured "
                    "angle against the measured one, whitened with the noise found",
                ),
                ("band", f"{first_hz:g} to {last_hz:g} Hz"),
                (
                    "pooled",
                    "random effects: sessions with their own covariances, and a scatter of each "
                    "parameter between them (DerSimonian and Laird); Student's t",
                ),
                (
                    "structure",
                    "the freest on the beam of the lowest Bayesian information criterion of all "
                    "sessions together, the same for all sessions",
                ),
            ],
        ),
        (
            "The paper's route",
            [
                ("estimator", settings.estimator),
                ("band", f"{settings.band_hz[0]:g} to {settings.band_hz[1]:g} Hz"),
                ("types", ", ".join(settings.types)),
                ("weights", ", ".join(settings.weightings)),
            ],
        ),
        (
            "Versions",
            [
                ("report made", made_at.isoformat(timespec="seconds")),
                ("rigd", rigd.__version__),
                ("Python", platform.python_version()),
                ("numpy", np.__version__),
                ("matplotlib", mpl.__version__),
            ],
        ),
    ]
    if not campaign.nominal:
        del parts[2]
    if not campaign.sessions[0].record_estimates:
        del parts[1]
    return [_facts(title, facts) for title, facts in parts]


def _facts(title: str, facts: list[tuple[str, str]]) -> Markup:
    rows = [
        element("tr", element("th", name, scope="row"), element("td", value))
        for name, value in facts
    ]
    made = element("table", element("caption", title), element("tbody", *rows))
    return element("div", made, class_="table")
