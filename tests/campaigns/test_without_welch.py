"""A campaign of sessions that Welch's method does not suit: the whole records alone."""

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from analysis.campaigns import SessionFailure, SessionTask, analyse_session
from analysis.models import WelchSettings
from analysis.record_part import RecordSource
from analysis.report.campaign_report import campaign_page, campaign_text, write_campaign

pytestmark = pytest.mark.fit


@pytest.fixture(scope="module")
def found(make_file, tmp_path_factory, campaign_of):
    """Two sessions of a file that states a multisine as its excitation."""
    path = make_file(
        tmp_path_factory.mktemp("multisine") / "0.mcap", 0, excitation="multisine", specimen="A",
        operator="Eve", note="[clamp] <b>new</b>",
    )  # fmt: skip
    first = analyse_session(
        RecordSource(path), SessionTask(WelchSettings(types=("I",)), ("III",), (), None)
    )
    experiment = replace(first.experiment, session_identifiers=("1.mcap",))
    other = replace(
        first,
        source=RecordSource(path.with_name("1.mcap")),
        experiment=experiment,
        sample_digests=frozenset(),
    )
    return campaign_of([first, other], structures=("III",))


def test_only_whole_records_are_pooled(found, truth):
    assert found.failures == ()
    assert (found.nominal, found.statistics) == ((), ())
    assert found.freest.name == "VI"
    _, damping = truth
    zeta = found.freest.parameters_by_name["zeta"]
    assert zeta.interval[0] < damping.zeta < zeta.interval[1]
    for session in found.sessions:
        assert session.warnings[-1].startswith("Welch fits left out: a multisine")


@pytest.mark.further  # as the pooled estimate
def test_the_folder_has_no_table_or_figure_of_the_paper(found, tmp_path):
    write_campaign(found, tmp_path)
    names = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")}
    wanted = {"figures/pooled.svg", "figures/pooled_response.svg", "tables/pooled.csv"}
    assert wanted | {"tables/session_list.csv", "tables.txt"} <= names
    assert not [name for name in names if "/figure" in name or "/table" in name]
    assert "Table 3" not in (tmp_path / "tables.txt").read_text()
    page = (tmp_path / "report.html").read_text()
    assert 'id="paper"' not in page
    assert "Welch fits left out" in page
    json.loads((tmp_path / "campaign.json").read_text())


def test_common_warning_is_reported_once(found):
    text = " ".join(campaign_text(found).split())
    assert text.count("Welch fits left out") == 1
    assert "Warning: all 2 files: Welch fits left out: a multisine" in text
    page = campaign_page(found, (), datetime(2026, 1, 1, tzinfo=UTC), with_paper_values=False)
    assert page.count("Welch fits left out") == 1


def test_sessions_are_listed_with_their_metadata(found):
    line = next(each for each in campaign_text(found).splitlines() if each.startswith("0.mcap "))
    for value in ("A", "Eve", "[clamp] <b>new</b>", "yes"):
        assert value in line
    page = campaign_page(found, (), datetime(2026, 1, 1, tzinfo=UTC), with_paper_values=False)
    assert "[clamp] &lt;b&gt;new&lt;/b&gt;" in page
    assert "<b>" not in page


def test_odd_session_is_set_aside_without_affecting_others(make_session, campaign_of):
    sessions = [make_session(f"{number}.mcap") for number in range(3)]
    odd = replace(
        sessions[0].without_welch(), source=RecordSource(Path("odd.mcap")),
        warnings=("Welch fits left out: x.",),
        experiment=replace(sessions[0].experiment, session_identifiers=("odd",)),
    )  # fmt: skip
    found = campaign_of([*sessions, odd])
    used, (failure,) = found.sessions, found.failures
    assert [each.path for each in used] == [each.path for each in sessions]
    assert "odd.mcap: Welch fits left out: x. Most others have them" in failure.message
    found = campaign_of([sessions[0], odd])
    both, none = found.sessions, found.failures
    assert none == ()
    assert [each.frequency_hz.size for each in both] == [0, 0]


def test_search_with_chirps_counts_and_disables_welch(make_session, make_experiment, campaign_of):
    chirps = [make_session(f"{number}.mcap") for number in range(3)]
    search = replace(
        chirps[0].without_welch(),
        source=RecordSource(Path("until.mcap")),
        experiment=make_experiment("until.mcap", excitation="until"),
    )
    found = campaign_of([*chirps, search])
    used, none = found.sessions, found.failures
    assert none == ()
    assert [each.frequency_hz.size for each in used] == [0, 0, 0, 0]


def test_a_session_with_a_wrong_unit_is_set_aside(make_file, tmp_path, settings):
    """Its file states a beam 57.3 times too light and too soft."""
    beam = {
        "beam_density_kg_per_m": repr(4.7e-3 * math.pi / 180),
        "beam_bending_stiffness_n_m2": repr(0.090275 * math.pi / 180),
    }
    path = make_file(tmp_path / "degrees.mcap", 7, **beam)
    found = analyse_session(RecordSource(path), SessionTask(settings, ("III",), (), None))
    assert isinstance(found, SessionFailure)
    assert "degrees for radians" in found.message
    assert found.experiment is not None
