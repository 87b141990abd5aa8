"""The sessions of a campaign: one experiment on one specimen, each session once."""

from dataclasses import replace
from pathlib import Path

import pytest

from analysis.campaigns import SessionFailure, SessionTask, analyse_session
from analysis.record_part import RecordSource

pytestmark = pytest.mark.fit


@pytest.fixture
def of_one_experiment(campaign_of):
    """Return the sessions that a campaign of these results uses, and those that it does not."""

    def parted(results):
        found = campaign_of(results)
        return list(found.sessions), list(found.failures)

    return parted


@pytest.fixture
def chirps(make_session, make_experiment):
    def make(name, **facts):
        stated = {"excitation": "chirp", "amplitude_rad": 0.025, **facts}
        return replace(make_session(name), experiment=make_experiment(name, **stated))

    return make


def test_odd_session_is_left_out_even_if_first(of_one_experiment, chirps):
    odd = chirps("odd.mcap", excitation="multisine")
    good = [chirps(f"{n}.mcap") for n in range(3)]
    sessions, (failure,) = of_one_experiment([odd, *good])
    assert [each.path for each in sessions] == [each.path for each in good]
    assert "odd.mcap: excitation is multisine, but chirp in 0.mcap" in failure.message


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"beam_length_m": 0.8}, "beam_length_m is 0.8 m, but 0.98 m in 0.mcap"),
        ({"amplitude_rad": 0.0125}, "amplitude_rad is 0.0125 rad, but 0.025 rad in 0.mcap"),
        ({"stop_hz": 20.0}, None),  # the others do not state it: no reason to doubt
        ({"axis_tilt_deg": 2.0}, None),
    ],
)
def test_differences_are_reported(of_one_experiment, chirps, facts, words):
    found, failures = of_one_experiment([chirps("0.mcap"), chirps("1.mcap"), chirps("2", **facts)])
    assert len(found) == 2 + (words is None)
    assert words is None or words in failures[0].message


def test_sessions_of_another_tilt_are_left_out(of_one_experiment, chirps):
    """One that does not state it agrees with any other, but not with two that differ."""
    level = [chirps(f"{n}.mcap", axis_tilt_deg=0.5) for n in range(2)]
    tilted, unknown = chirps("tilted.mcap", axis_tilt_deg=2.0), chirps("unknown.mcap")
    assert of_one_experiment([unknown, *level])[1] == []
    sessions, failures = of_one_experiment([unknown, *level, tilted])
    assert [each.path for each in sessions] == [each.path for each in level]
    messages = " ".join(each.message for each in failures)
    assert "axis_tilt_deg is 2 °, but 0.5 ° in 0.mcap" in messages
    assert "axis_tilt_deg is not stated, but 0.5 °" in messages


def test_search_joins_any_excitation_but_never_two(of_one_experiment, chirps):
    search = {"excitation": "until", "amplitude_rad": 0.035, "start_hz": 0.5}
    searches = [chirps(f"until{n}.mcap", **search) for n in range(3)]
    small = chirps("small.mcap", amplitude_rad=0.0125)
    used, left_out = of_one_experiment([*searches, chirps("chirp.mcap"), small])
    assert [each.path.name for each in used] == [*(s.path.name for s in searches), "chirp.mcap"]
    assert "amplitude_rad is 0.0125 rad, but 0.025 rad in chirp.mcap" in left_out[0].message
    assert of_one_experiment(searches)[1] == []
    other = chirps("other.mcap", beam_length_m=0.8, **search)
    assert "beam_length_m is 0.8 m" in of_one_experiment([*searches, other])[1][0].message


def test_other_experiment_is_reported_before_a_failed_analysis(
    of_one_experiment, chirps, make_experiment
):
    """A hold is too short for a Welch segment, but that is not why it does not belong here."""
    hold = SessionFailure(
        RecordSource(Path("hold.mcap")),
        "too short, --segment 1439",
        make_experiment("hold", excitation="hold"),
    )
    torn = SessionFailure(RecordSource(Path("torn.mcap")), "torn.mcap is incomplete.")
    sessions, failures = of_one_experiment([chirps("0.mcap"), hold, torn])
    assert len(sessions) == 1
    assert "excitation is hold, but chirp" in failures[0].message
    assert failures[1].message == torn.message


def test_no_session_counts_twice(of_one_experiment, chirps):
    one, other = chirps("0.mcap"), chirps("1.mcap")
    sessions, (failure,) = of_one_experiment(
        [one, other, replace(one, source=RecordSource(Path("copy.mcap")))]
    )
    assert [each.path for each in sessions] == [one.path, other.path]
    assert "copy.mcap: it is the same session as 0.mcap" in failure.message


def test_session_stopped_within_its_sweep_is_left_out(make_experiment):
    assert "20 s of 120 s (outcome: stopped)" in make_experiment(
        sweep_s=20.0, duration_s=120.0
    ).unfinished_sweep_reason("stopped")
    assert make_experiment(sweep_s=120.0, duration_s=120.0).unfinished_sweep_reason("stopped") == ""
    assert make_experiment(sweep_s=20.0).unfinished_sweep_reason("unknown") == ""
    both = {"duration_s": 120.0, "there_and_back": 1.0}
    found = make_experiment(sweep_s=130.0, **both).unfinished_sweep_reason("stopped")
    assert "130 s of 240 s" in found
    assert make_experiment(sweep_s=240.0, **both).unfinished_sweep_reason("complete") == ""


def test_stopped_session_is_not_reported_as_short(make_file, settings, tmp_path):
    """20 s of sweep where the file states 120 s."""
    path = make_file(tmp_path / "stopped.mcap", 0, duration_s="120.0", excitation="chirp")
    failure = analyse_session(RecordSource(path), SessionTask(settings, (), (), None))
    assert "stopped.mcap: its sweep ended after 20 s of 120 s" in failure.message
    assert failure.experiment.facts["excitation"] == "chirp"


def test_specimens_are_distinguished_by_label_first(of_one_experiment, chirps, campaign_of):
    sessions = [chirps(f"{number}.mcap", specimen=label) for number, label in enumerate("AABBB")]
    used, left_out = of_one_experiment(sessions)
    assert [each.path.name for each in used] == ["2.mcap", "3.mcap", "4.mcap"]
    assert "specimen is “A”, but “B” in 2.mcap" in left_out[0].message
    first, second = campaign_of(sessions).homogeneity.specimens
    assert (first.facts["specimen"], second.facts["specimen"]) == ("B", "A")


def test_files_of_one_name_are_distinguished_by_folder(of_one_experiment, chirps):
    paths = ["/a/x.mcap", "/b/c/x.mcap", "/d/c/x.mcap", "/a/y.mcap", "/e/z.mcap", "/e/z.mcap"]
    used, (twice,) = of_one_experiment([chirps(path) for path in paths])
    assert [each.name for each in used] == [
        "a/x.mcap", "b/c/x.mcap", "d/c/x.mcap", "y.mcap", "/e/z.mcap",
    ]  # fmt: skip
    assert twice.name == "/e/z.mcap"


def test_unlabelled_session_belongs_to_the_only_specimen(of_one_experiment, chirps):
    one, two, unlabelled = chirps("1.mcap", specimen="A"), chirps("2.mcap", specimen="A"), "3.mcap"
    used, left_out = of_one_experiment([one, two, chirps(unlabelled)])
    assert (len(used), left_out) == (3, [])
    # With two labels its specimen is unknown, and it must not join the two.
    other = chirps("4.mcap", specimen="B")
    used, left_out = of_one_experiment([chirps(unlabelled), one, two, other])
    assert [each.path.name for each in used] == ["1.mcap", "2.mcap"]
    assert any("specimen is not stated, but “A”" in each.message for each in left_out)


def test_as_in_most_is_reported_for_a_majority_only(of_one_experiment, chirps):
    first, odd, third = chirps("0.mcap"), chirps("1.mcap", excitation="step"), chirps("2.mcap")
    (failure,) = of_one_experiment([first, odd])[1]
    assert "excitation is step, but chirp in 0.mcap; a campaign" in failure.message
    (failure,) = of_one_experiment([first, odd, third])[1]
    assert "excitation is step, but chirp in 0.mcap, as in most; a campaign" in failure.message
