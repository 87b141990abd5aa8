"""What belongs to a campaign: one experiment on one specimen, each session once."""

from dataclasses import replace
from pathlib import Path

import pytest

from analysis.campaigns.campaign import _of_one_experiment
from analysis.campaigns.experiment import most_common
from analysis.campaigns.session import SessionFailure, SessionTask, analyse_session
from analysis.whole_record import BAND_HZ


@pytest.fixture
def chirps(make_session, make_experiment):
    def make(name, **facts):
        stated = {"excitation": "chirp", "amplitude_rad": 0.025, **facts}
        return replace(make_session(name), experiment=make_experiment(name, **stated))

    return make


def test_the_odd_one_is_left_out_though_it_comes_first(chirps):
    odd = chirps("odd.mcap", excitation="multisine")
    good = [chirps(f"{n}.mcap") for n in range(3)]
    sessions, (failure,) = _of_one_experiment([odd, *good])
    assert sessions == good
    assert "odd.mcap: excitation is multisine, but chirp in 0.mcap" in failure.message
    assert most_common([each.experiment for each in [odd, *good]]) == 1


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"beam_length_m": 0.8}, "beam_length_m is 0.8 m, but 0.98 m in 0.mcap"),
        ({"amplitude_rad": 0.0125}, "amplitude_rad is 0.0125 rad, but 0.025 rad in 0.mcap"),
        ({"stop_hz": 20.0}, None),  # the others do not state it: no reason to doubt
    ],
)
def test_what_differs_is_named(chirps, facts, words):
    found, failures = _of_one_experiment([chirps("0.mcap"), chirps("1.mcap"), chirps("2", **facts)])
    assert len(found) == 2 + (words is None)
    assert words is None or words in failures[0].message


def test_another_experiment_is_the_reason_where_the_analysis_failed_too(chirps, make_experiment):
    """A hold is too short for a Welch segment, but that is not why it does not belong here."""
    hold = SessionFailure(
        Path("hold.mcap"), "too short, --segment 1439", make_experiment("hold", excitation="hold")
    )
    torn = SessionFailure(Path("torn.mcap"), "torn.mcap is incomplete.")
    sessions, failures = _of_one_experiment([chirps("0.mcap"), hold, torn])
    assert len(sessions) == 1
    assert "excitation is hold, but chirp" in failures[0].message
    assert failures[1] == torn


def test_no_session_counts_twice(chirps):
    one, other = chirps("0.mcap"), chirps("1.mcap")
    sessions, (failure,) = _of_one_experiment([one, other, replace(one, path=Path("copy.mcap"))])
    assert sessions == [one, other]
    assert "copy.mcap: it is the same session as 0.mcap" in failure.message


def test_a_sweep_that_ended_early_is_left_out_and_one_stopped_after_it_is_not(make_experiment):
    assert "20 s of 120 s (outcome: stopped)" in make_experiment(
        sweep_s=20.0, duration_s=120.0
    ).unfinished("stopped")
    assert make_experiment(sweep_s=120.0, duration_s=120.0).unfinished("stopped") == ""
    assert make_experiment(sweep_s=20.0).unfinished("unknown") == ""


def test_a_stopped_session_says_so_and_not_that_it_is_short(make_file, settings, tmp_path):
    """30 s of sweep where the file says that 120 s were planned."""
    path = make_file(tmp_path / "stopped.mcap", 0, duration_s="120.0", excitation="chirp")
    failure = analyse_session(path, SessionTask(settings, (), (), BAND_HZ))
    assert "stopped.mcap: its sweep ended after 30 s of 120 s" in failure.message
    assert failure.experiment.facts["excitation"] == "chirp"
