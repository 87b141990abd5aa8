"""Campaigns of which one session is left, or one whole record: there is nothing to pool."""

import json
import math
import shutil

import numpy as np
import pytest

from analysis.campaigns.pooling import pooled_bic

pytestmark = pytest.mark.fit

QUICK = (
    "--types", "I", "--weights", "const", "--segment", "2000", "--nfft", "8000", "--band", "1,50",
    "--figures", "svg",
)  # fmt: skip


@pytest.fixture
def run_here(in_this_process, without_drawing, analyze_here):
    with in_this_process(), without_drawing():
        yield lambda *arguments: analyze_here(*arguments, *QUICK)


def errors(result):
    return [line for line in result.stderr.splitlines() if line.startswith("Error: ")]


def test_single_session_is_reported_with_the_error_of_the_other(run_here, short_sessions, tmp_path):
    shutil.copy(short_sessions[0], tmp_path / "ok.mcap")
    result = run_here("ok.mcap", "nosuch.mcap", "--method", "welch", "--json", "all.json")
    assert result.returncode == 1
    (error,) = errors(result)
    assert "nosuch.mcap cannot be read: No such file" in error
    assert "ok.mcap is reported alone" in result.stderr
    assert "Warning" not in result.stderr
    assert "Report of ok.mcap: ok.report\n" in result.stdout
    assert (tmp_path / "ok.report" / "tables.txt").exists()
    assert not (tmp_path / "campaign.report").exists()
    content = json.loads((tmp_path / "all.json").read_text())
    assert {fit["file"] for fit in content["fits"]} == {"ok.mcap"}
    (failure,) = content["errors"]
    assert failure["file"] == "nosuch.mcap"
    assert failure["message"] in error


def test_file_given_twice_is_reported_as_such(run_here, short_sessions, tmp_path):
    shutil.copy(short_sessions[0], tmp_path / "ok.mcap")
    result = run_here("ok.mcap", "./ok.mcap", "--method", "welch", "--report", "r")
    assert result.returncode == 1
    assert errors(result) == ["Error: ok.mcap: the file is given more than once, and counts once."]
    assert (tmp_path / "r" / "figures" / "welch_frf.svg").exists()


def test_common_samples_of_two_files_count_once(run_here, make_file, short_sessions, tmp_path):
    """Another name, identity and time do not make another session of the same noise."""
    shutil.copy(short_sessions[0], tmp_path / "whole.mcap")
    make_file(tmp_path / "again.mcap", 0, id="another", start_utc_ns="1800000000000000000")
    result = run_here("whole.mcap", "again.mcap", "--method", "welch", "--report", "r")
    assert result.returncode == 1
    (error,) = errors(result)
    assert error.startswith("Error: again.mcap: it has samples of whole.mcap, noise included")
    assert "whole.mcap is reported alone" in result.stderr


def test_single_whole_record_is_ranked_alone(make_estimate, make_session, campaign_of):
    """The others' could not be used; with no common value, BIC is the session's own."""
    one = make_estimate(
        "III", {"zeta": 3e-4, "gamma": 0.2}, np.diag([1e-12, 1e-6]), ("zeta", "gamma"), cost=90.0
    )
    assert pooled_bic([one]) == pytest.approx(90.0 + 2 * math.log(100), abs=1e-9)
    sessions = [make_session("a.mcap", estimates=[one]), make_session("b.mcap")]
    (ranked,) = campaign_of(sessions).structures
    assert (ranked.name, ranked.fitted_sessions, ranked.is_pooled) == ("III", 1, False)
    assert ranked.bic_above_lowest == 0.0
