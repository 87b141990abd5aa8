"""Every trial of the validation is accounted for: done, or lost and why."""

import xml.etree.ElementTree as ET
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cases import further
from ended_workers import call_unless_one

from analysis.campaigns import CampaignError, analyse_session, campaign
from analysis.campaigns.workers import FailedTask, process_pool
from analysis.cli.campaign import campaign_command
from analysis.cli.sessions import OutputOptions
from analysis.report import campaign_document
from analysis.report.campaign_report import campaign_page, campaign_text, write_campaign

pytestmark = pytest.mark.fit

REASON = "its worker process ended by itself twice"


class OneLost:
    """Workers of this process that report one of them as killed."""

    def run(self, _function, tasks, on_done):
        found = []
        for number, (function, source, *arguments) in enumerate(tasks):
            lost = source.path.name == "1.mcap"
            found.append(FailedTask(REASON) if lost else function(source, *arguments))
            on_done(number)
        return found


class Shaken:
    """A process that is killed; sessions are analysed already."""

    def __init__(self, pool, results):
        self._pool, self._results = pool, results

    def run(self, function, tasks, on_done):
        if function is analyse_session:
            for number, _ in enumerate(tasks):
                on_done(number)
            return [self._results[source.path] for source, _ in tasks]
        return self._pool.run(call_unless_one, [(function, *task) for task in tasks], on_done)


@pytest.fixture(scope="module", params=["reported", further("killed")])
def shaken(request, short_sessions, settings, done):
    """A campaign of four whose worker is killed in the middle of the validation."""
    results = {each.path: each for each in done[0].sessions}
    progress = []
    with process_pool(1) if request.param == "killed" else nullcontext(OneLost()) as pool:
        found = campaign(
            short_sessions, settings, structures=("III",), workers=Shaken(pool, results),
            on_progress=lambda *step: progress.append(step),
        )  # fmt: skip
    assert progress[-1][:2] == (8, 8)
    return found


@pytest.mark.process
def test_killed_worker_loses_its_trial_only(shaken):
    assert shaken.failures == ()
    (lost,) = shaken.failed_predictions
    assert (lost.source.path.name, shaken.trials) == ("1.mcap", 4)
    assert lost.reason.startswith(REASON)
    assert {each.source.path.name for each in shaken.validation} == {"0.mcap", "2.mcap", "3.mcap"}


@pytest.mark.process
def test_verdict_states_the_number_of_predictions(shaken):
    (foresight,) = (s for s in shaken.verdict.sentences if s.startswith("Leave-one-out error"))
    assert "mean of 3 of 4 sessions" in foresight
    sentence = shaken.verdict.sentences[-1]
    assert sentence.startswith(
        "Of 4 sessions to be predicted from the others, 3 were and 1 was not"
    )
    assert "(1.mcap: its worker process ended by itself twice" in sentence


@pytest.mark.process
def test_terminal_page_and_files_report_the_lost_trial(shaken):
    lines = campaign_text(shaken).splitlines()
    (row,) = (line for line in lines if line.startswith("record   III "))
    assert "3 of 4" in row
    page = campaign_page(shaken, (), datetime.now(UTC), with_paper_values=False)
    assert "3 of 4" in page
    assert (
        f"Not predicted from the others: {shaken.failed_predictions[0].source}: its worker" in page
    )
    content = campaign_document(shaken)
    trials = content["trials"]
    assert trials["asked"] == trials["done"] + len(trials["lost"]) == 4
    assert trials["lost"][0]["file"].endswith("1.mcap")
    (lost,) = (row for row in content["validation"] if row["lost"])
    assert (Path(lost["file"]).name, lost.get("error")) == ("1.mcap", None)


@pytest.mark.process
@pytest.mark.further  # as terminal and page
def test_figure_reports_the_lost_trial(shaken, tmp_path):
    write_campaign(shaken, tmp_path / "report", with_paper_values=False)
    texts = ET.parse(tmp_path / "report" / "figures" / "validation.svg").iter(
        "{http://www.w3.org/2000/svg}text"
    )
    assert any("".join(text.itertext()).strip().startswith("3 of 4 sessions") for text in texts)


@pytest.mark.process
def test_command_reports_the_lost_trial_and_fails(shaken, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("analysis.campaigns.campaign", lambda *_, **__: shaken)
    monkeypatch.setattr("analysis.report.campaign_report.write_campaign", lambda *_, **__: None)
    paths = [each.path for each in shaken.sessions]
    outputs = OutputOptions(report=tmp_path / "new")
    code = campaign_command(paths, shaken.settings, outputs, structures=("III",))
    assert code == 1
    assert "1.mcap is not predicted from the others: its worker" in capsys.readouterr().err


def test_unreadable_sessions_are_lost_with_the_reason(make_session, campaign_of):
    found = campaign_of([make_session(f"gone{number}.mcap") for number in range(3)], validated=True)
    assert found.validation == ()
    for number, lost in enumerate(found.failed_predictions):
        assert f"gone{number}.mcap" in lost.reason


def test_results_remain_if_all_workers_are_lost(make_session):
    sessions = [make_session(f"{n}.mcap") for n in range(3)]

    class Going:
        def run(self, function, *_):
            if function is not analyse_session:
                raise CampaignError("The Dask scheduler went away.")
            return sessions

    found = campaign([each.path for each in sessions], workers=Going())
    assert found.validation == ()
    assert [each.source.path.name for each in found.failed_predictions] == [
        "0.mcap",
        "1.mcap",
        "2.mcap",
    ]
    assert {each.reason for each in found.failed_predictions} == {"The Dask scheduler went away."}


def test_no_report_without_validation(done, campaign_of):
    found = campaign_of(done[0].sessions[:2], structures=())
    assert (found.trials, found.validation, found.failed_predictions) == (0, (), ())
    assert "predicted" not in campaign_text(found)
