"""Fits of a running session, as the daemon reports them: as events, in the status, at the end."""

import json
from pathlib import Path

import pytest
from online_fits import online_fit
from operated_daemons import parse_request

from rigd.daemon._series import SeriesReporter, ServedSeries
from rigd.engine.shared_state import LogEvent, Phase
from rigd.runner.session import SessionProgress, SessionResult


@pytest.fixture
def reported_series():
    """A started series, its reporter, and the published events."""
    request = b'{"command": "start", "excitation": "chirp", "watch_fit": true}'
    series, events = ServedSeries(1, parse_request(request), is_running=True), []
    reporter = SeriesReporter(series, events.append, lambda: True, lambda: None)
    reporter.on_start(1, Path("1.mcap"))
    return series, reporter, events


def result(**members):
    document = {
        "path": Path("1.mcap"), "outcome": "complete", "reason": "", "scheduled": 9,
        "recorded": 9, "missed": 0, "late": 0, "lost": 0, "fault": False,
    }  # fmt: skip
    return SessionResult(**document | members)


def status_of_fit(reported_series, fit):
    """Return the report of a fit in the status."""
    series, reporter, _ = reported_series
    reporter.on_progress(SessionProgress(Phase.RUNNING, 9, 0, 0, (fit,)), [])
    return series.as_document()["fit"]


def test_report_of_a_fit_is_bounded(reported_series):
    fit = online_fit()
    document = status_of_fit(reported_series, fit)
    assert document["modes"] == fit["modes"]
    assert document["search"] == fit["search"]
    assert not document.keys() & {"plant", "covariance", "noise"}
    huge = fit | {
        "modes": 100 * fit["modes"], "findings": 100 * ["x" * 10_000],
        "search": fit["search"] | {"pieces": 100 * [{"name": "x" * 100}], "reason": "x" * 10_000},
    }  # fmt: skip
    assert len(json.dumps(status_of_fit(reported_series, huge))) < 24_000
    assert status_of_fit(reported_series, {}) == {}


def test_fits_in_events_and_status(reported_series):
    series, reporter, events = reported_series
    assert series.as_document()["fit"] is None
    row = LogEvent(0, "info", "  8.0 s 0.910 ± 0.010 %", notable=True)
    fits = (online_fit(6.0, 2.0), online_fit(8.0))
    reporter.on_progress(SessionProgress(Phase.RUNNING, 9, 0, 0, fits), [row])
    assert [event["event"] for event in events] == ["message", "fit", "fit"]
    assert events[0]["notable"]
    assert [event["duration_s"] for event in events[1:]] == [6.0, 8.0]
    assert events[1]["session"] == 1
    document = series.as_document()["fit"]
    assert {"event": "fit", "session": 1, **document} == events[-1]
    assert (document["modes"], document["text"]) == (fits[-1]["modes"], fits[-1]["text"])
    # The result has no temporary values, and states how a search ended.
    final = online_fit(9.0, search=False) | {"search": {"reason": "Reached.", "pieces": []}}
    del final["text"]
    reporter.on_result(result(fit=final), look_follows=True)
    assert events[-1]["fit"]["search"] == {"reason": "Reached."}
    assert events[-1]["look_follows"]
    series_document = series.as_document()
    assert series_document["fit"]["text"] == fits[-1]["text"]
    assert series_document["fit"]["duration_s"] == 9.0
    assert "fit" not in series_document["sessions"][0]
    reporter.on_start(2, Path("2.mcap"))
    assert series.as_document()["fit"] is None


def test_session_without_fits(reported_series):
    series, reporter, events = reported_series
    reporter.on_result(result(), look_follows=False)
    assert "fit" not in events[-1]
    assert not events[-1]["look_follows"]
    assert series.as_document()["fit"] is None


@pytest.mark.parametrize(
    ("outcome", "level"), [("complete", "info"), ("stopped", "warning"), ("fault", "error")]
)
def test_end_of_a_session_is_one_message_with_its_level(reported_series, outcome, level):
    _, reporter, events = reported_series
    reporter.on_result(result(outcome=outcome), look_follows=False)
    message, session = events
    assert (message["level"], message["session"]) == (level, session["number"])
    assert message["text"].startswith(f"{outcome.capitalize()}: ")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"excitation": "chirp"}, "chirp"),
        (
            {"excitation": "until", "parameters": {"targets": "damping 1%"}},
            "search for a precision",
        ),
    ],
)
def test_state_reasons_name_the_excitation_in_plain_words(fields, words):
    request = parse_request(json.dumps({"command": "start", **fields}).encode())
    series = ServedSeries(1, request)
    assert series.state_after("")[1] == f"{words} is complete"
    series.stop_request.request()
    assert series.state_after("")[1] == f"{words} was stopped"
