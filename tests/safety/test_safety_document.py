"""docs/safety.md agrees with the code."""

import re
from pathlib import Path

import pytest

from rigd.checks.stopping_distance import max_stopping_distance, stopping_distance_rows
from rigd.profile import load_profile
from rigd.safety.limits import INTERLOCKS

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "safety.md").read_text("utf-8")


def as_line(row):
    """An interlock as a line of the document's table."""
    if row.warning is None:
        warning = "–"
    elif isinstance(row.warning, str):
        warning = f"`{row.warning}`"
    elif row.below:
        warning = f"{row.warning:g} times that"
    else:
        warning = f"{100 * row.warning:g} % of it"
    limit = "it happens"
    if row.limit:
        limit = f"`{row.limit}`"
    elif row.unit:
        limit = "fixed, see below"
    if row.name == "encoder jump":
        limit += " and two encoder steps"
    channel = row.channel.format(axis="fx … tz", channel="fx … tz, or gauge")
    cells = (
        row.name,
        channel,
        row.unit or "–",
        warning,
        limit,
        row.checked.value,
        row.action.value,
        row.remedy,
    )
    return "| " + " | ".join(cells) + " |"


@pytest.mark.parametrize("row", INTERLOCKS, ids=lambda row: row.name)
def test_every_interlock_is_in_the_document(row):
    assert as_line(row) in TEXT.splitlines(), f"docs/safety.md lacks the line\n{as_line(row)}"


def test_the_document_has_no_other_interlock():
    table = TEXT[TEXT.index("## The interlocks") :].partition("\n## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")][1:]
    assert lines == [as_line(row) for row in INTERLOCKS]


def test_every_level_is_a_key_of_a_profile():
    profile = load_profile("antenna_can")

    def is_key(name):
        section, _, key = name.rpartition(".")
        owner = profile.rig if section == "motor" else profile
        return hasattr(getattr(owner, section), key)

    for row in INTERLOCKS:
        if row.limit:
            assert is_key(row.limit)
        if isinstance(row.warning, str):
            assert is_key(row.warning)
        assert row.remedy.endswith(".")


@pytest.mark.parametrize("name", ["antenna_can", "antenna_serial"])
def test_the_document_has_the_travel_of_the_shipped_profiles(name):
    profile = load_profile(name)
    section = TEXT[TEXT.index("## How far it turns") :].partition("\n## ")[0]
    for row in stopping_distance_rows(profile):
        numbers = re.findall(r"\d+\.\d\d rad", row.found + row.wanted)
        assert len(numbers) == 4
        what = row.what.removeprefix("worst, ")
        (blind_ms,) = re.findall(r"in the (\d+) ms", row.found)
        total, driven, coasting, margin = numbers
        line = f"| {name} | {what} | {blind_ms} ms | {driven} | {coasting} | {total} | {margin} |"
        assert line in section.splitlines(), f"docs/safety.md lacks the line\n{line}"
    free = max_stopping_distance(
        profile.rig, profile.limits, profile.rig.cia402.heartbeat_timeout_s
    )
    assert f"{free.total_distance_rad:.2f} rad" in section


def test_the_page_shows_the_steps_of_the_document_to_reset_a_fault():
    page = " ".join((ROOT / "rigd" / "web" / "static" / "index.html").read_text("utf-8").split())
    shown_list = page[page.index('<p id="fault-reason">') :].partition("</ol>")[0]
    shown = re.findall(r"<li>(.*?)</li>", shown_list)
    section = TEXT[TEXT.index("## How to reset") :].partition("\n\nA drive that")[0]
    stated = [" ".join(step.split()) for step in re.split(r"\n\d\. ", section)[1:]]
    assert len(shown) == len(stated)
    zone = re.search(r"The danger zone is [^.]+\d\.\d m\.", page).group()
    assert zone[1:] in " ".join(TEXT.replace("**", "").split())
    # Before the reset nothing depends on the program that the operator uses.
    before_reset = 4
    assert shown[:before_reset] == stated[:before_reset]
    for words, step in zip(
        ("<b>Reset</b>", "<b>Zero</b>", "rigd check"), shown[before_reset:], strict=True
    ):
        assert words in step
