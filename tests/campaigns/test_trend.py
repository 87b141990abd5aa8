"""Changes with time: the straight line by itself, and over the blocks of one session."""

import csv
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.campaigns.specimen_sentences import describe_trends
from analysis.campaigns.trend import linear_trend
from analysis.record import RecordError
from analysis.record_part import RecordSource, blocks_of_session
from rigd.excitation import multisine
from rigd.session import SessionError
from rigd.testing import PAPER_BEAM, Signals, beam_torque, write_session

RATE_HZ = 250.0
BLOCKS = 5
STIFFNESS_CHANGE = -0.001
"""Relative change of the stiffness from block to block."""


def test_slope_by_hand():
    """Weights 1, 1, 1, 4: mean time 12/7 h, mean value 20/7; slope from the sums about them."""
    times_h, values, weights = np.arange(4), np.array([1.0, 2.0, 1.0, 4.0]), np.array([1, 1, 1, 4])
    trend = linear_trend([3600.0 * time_h for time_h in times_h], values, weights**-0.5)
    centred_h = times_h - np.average(times_h, weights=weights)
    slope = (weights * centred_h * values).sum() / (weights * centred_h**2).sum()
    residual = values - np.average(values, weights=weights) - slope * centred_h
    birge = max((weights * residual**2).sum() / 2, 1.0) ** 0.5
    assert trend.slope_per_h == pytest.approx(slope)
    assert trend.slope_std_per_h == pytest.approx(birge * (weights * centred_h**2).sum() ** -0.5)
    half_width = 4.302653 * trend.slope_std_per_h  # Student's t with two degrees of freedom
    assert trend.interval_95_per_h == pytest.approx((slope - half_width, slope + half_width))
    assert trend.covered_h == 3


def test_no_trend_without_times_or_with_too_few():
    hours_s = [0.0, 3600.0, 7200.0, 10800.0]
    assert linear_trend(hours_s, [1.0] * 4, [0.1] * 4).p_value == 1
    assert linear_trend(hours_s[:3], [1.0] * 3, [0.1] * 3) is None
    assert linear_trend([None, *hours_s[1:]], [1.0] * 4, [0.1] * 4) is None
    assert linear_trend([1.8e9 + 1e-6 * hour_s for hour_s in hours_s], [1.0] * 4, [0.1] * 4) is None


@pytest.mark.parametrize("unexplained", [1.0, 3.0])
def test_p_value_of_no_change_is_uniform(unexplained):
    """Also if sessions scatter by more than they state, with many of them."""
    rng = np.random.default_rng(4)
    times_s, stds = 600.0 * np.arange(20), rng.uniform(0.5, 2.0, 20)
    p_values = np.array(
        [
            linear_trend(times_s, unexplained * stds * rng.standard_normal(20), stds).p_value
            for _ in range(1000)
        ]
    )
    assert np.mean(p_values < 0.05) == pytest.approx(0.04, abs=0.02)
    assert np.mean(p_values < 0.5) == pytest.approx(0.48, abs=0.07)


# Blocks of one session


def write_blocks(path, stiffness_change, seed=1):
    """Write a session in which the stiffness changes from block to block, always at rest."""
    excitation = multisine(
        rate_hz=RATE_HZ, amplitude_rad=0.01, start_hz=1, stop_hz=25, period_s=5, duration_s=30,
        ring_down_s=9,
    )  # fmt: skip
    torques_nm = [
        beam_torque(
            excitation.reference_rad, RATE_HZ,
            beam=replace(
                PAPER_BEAM,
                bending_stiffness_n_m2=(1 + stiffness_change * number)
                * PAPER_BEAM.bending_stiffness_n_m2,
            ),
        )
        for number in range(BLOCKS)
    ]  # fmt: skip
    torque_nm = np.concatenate(torques_nm)
    torque_nm += 2e-3 * np.random.default_rng(seed).standard_normal(torque_nm.size)
    angle_rad = np.tile(excitation.reference_rad, BLOCKS)
    segments = {"rest": (0, 250), "sweep": (250, angle_rad.size)}
    metadata = {"excitation": "multisine", "start_hz": "1", "stop_hz": "25"}
    return write_session(
        path, Signals(angle_rad, angle_rad, torque_nm, segments, RATE_HZ, metadata)
    )


@pytest.fixture(scope="module")
def steady(made_once):
    return made_once("steady", lambda folder: write_blocks(folder / "s.mcap", 0.0)) / "s.mcap"


@pytest.fixture(scope="module")
def loosening(made_once):
    def make(folder):
        write_blocks(folder / "l.mcap", STIFFNESS_CHANGE)

    return made_once("loosening", make) / "l.mcap"


def test_blocks_cover_the_session(steady):
    blocks = blocks_of_session(steady, 60.0)
    assert [block.part_s for block in blocks] == [(None, 60.0), (60.0, 120.0), (120.0, None)]
    assert [block.part_name for block in blocks] == ["0 to 60 s", "60 to 120 s", "120 s to end"]
    assert blocks[0].as_json() == {"file": str(steady), "from_s": None, "to_s": 60.0}
    assert RecordSource(steady).as_json() == {"file": str(steady)}
    # A remainder of less than half a block belongs to the last one.
    assert [block.part_s for block in blocks_of_session(steady, 90.0)] == [
        (None, 90.0), (90.0, None),
    ]  # fmt: skip


def test_every_block_has_some_of_the_excitation(write_session, tmp_path):
    """Rest and ring-down may last longer than a block."""
    angle_rad = np.zeros(40 * 250)
    signals = Signals(
        angle_rad, angle_rad, angle_rad, {"rest": (0, 12 * 250), "sweep": (12 * 250, 26 * 250)},
        RATE_HZ, {"excitation": "multisine", "beam_length_m": "0.3"},
    )  # fmt: skip
    blocks = blocks_of_session(write_session(tmp_path / "a.mcap", signals), 5.0)
    assert [block.part_s for block in blocks] == [(None, 15.0), (15.0, 20.0), (20.0, None)]


def test_sessions_that_cannot_be_divided(steady, paper_file, short_signals, tmp_path):
    with pytest.raises(
        RecordError, match="199 s of excitation are too short for two blocks of 150"
    ):
        blocks_of_session(steady, 150.0)
    with pytest.raises(RecordError, match=r"blocks of one sweep .* --repeat"):
        blocks_of_session(paper_file, 30.0)
    with pytest.raises(RecordError, match=r"too short for an estimate, .* 3.92 s"):
        blocks_of_session(steady, 1e-6)
    metadata = {"excitation": "step"}
    step = write_session(tmp_path / "step.mcap", short_signals, metadata=metadata)
    with pytest.raises(RecordError, match="a step is one motion"):
        blocks_of_session(step, 2.0)
    (tmp_path / "cut.mcap").write_bytes(steady.read_bytes()[:-100_000])
    with pytest.raises(SessionError, match="is incomplete; save what is intact"):
        blocks_of_session(tmp_path / "cut.mcap", 40.0)


def test_blocks_of_a_record_that_begins_late(write_session, short_signals, tmp_path):
    ticks = 30_000 + np.arange(5000)
    path = write_session(
        tmp_path / "a.mcap", short_signals, ticks=ticks, segments={},
        metadata={"excitation": "multisine", "beam_length_m": "0.3"},
    )  # fmt: skip
    blocks = blocks_of_session(path, 2.5)
    assert [block.part_s for block in blocks] == [(None, 32.5), (32.5, None)]


@pytest.mark.fit
def test_change_is_stated_of_the_blocks(analyze_here, loosening, tmp_path):
    arguments = ("--block", "40", "--report", "r", "--json", "all.json")
    result = analyze_here(str(loosening), *arguments)
    assert result.returncode == 0, result.stderr
    assert "in blocks of 40 s" in result.stderr
    assert "The antenna did not stay in one state during the session" in result.stdout
    assert "Change with time over 2.67 min" in result.stdout
    assert (tmp_path / "r" / "figures" / "trends.svg").exists()
    assert "5 blocks of a session" in (tmp_path / "r" / "report.html").read_text("utf-8")
    with (tmp_path / "r" / "tables" / "homogeneity.csv").open(encoding="utf-8") as file:
        rows = {row["quantity"]: row for row in csv.DictReader(file)}
    # The frequency goes with the root of the stiffness, every 40 s.
    true_per_h = 16.011 * STIFFNESS_CHANGE / 2 * 90
    row = rows["frequency_hz_2"]
    assert float(row["trend_per_h"]) == pytest.approx(
        true_per_h, abs=3 * float(row["trend_std_per_h"])
    )
    assert float(row["trend_per_h"]) == pytest.approx(true_per_h, rel=0.05)
    assert float(row["trend_p_value"]) < 1e-3
    content = json.loads((tmp_path / "all.json").read_text("utf-8"))
    assert [(one["from_s"], one["to_s"]) for one in content["files"]] == [
        (None, 40.0), (40.0, 80.0), (80.0, 120.0), (120.0, 160.0), (160.0, None),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("step_s", "words"),
    [
        (40.0, "over 2 min (straight lines, 95 %): frequency of mode 2 by +0.0300 ± 0.0019 Hz. "),
        (1200.0, "over 1 h (straight lines, 95 %): frequency of mode 2 by +0.0300 ± 0.0019 Hz per"),
    ],
)
def test_change_in_less_than_an_hour_is_not_stated_per_hour(step_s, words):
    times_s = [step_s * block for block in range(4)]
    trend = linear_trend(times_s, [16.0, 16.01, 16.02, 16.03], [3.3e-4] * 4)
    scatter = SimpleNamespace(quantity="frequency_hz_2", trend=trend, has_significant_trend=True)
    (sentence,) = describe_trends(SimpleNamespace(quantities=(scatter,), is_one_session=False))
    assert words in sentence


@pytest.mark.fit
def test_steady_session_is_not_called_a_change(
    in_this_process, without_drawing, analyze_here, steady
):
    """Two modes do not determine the orders, so only modes are compared."""
    with in_this_process(), without_drawing():
        result = analyze_here(str(steady), "--block", "40", "--report", "r")
    assert result.returncode == 0, result.stderr
    assert "No significant change with time" in result.stdout
    assert "did not stay in one state" not in result.stdout
    assert "Wait longer at rest" not in result.stdout  # blocks begin in the middle of the motion


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("a.mcap", "b.mcap", "--block", "9"), "it takes one session, and 2 files were given"),
        (("a.mcap", "--block", "9", "--from", "1"), "leave --from and --to out"),
        (("a.mcap", "--block", "9", "--each"), "leave --each out"),
        (("a.mcap", "--block", "0"), "0 s must be more than 0"),
        (("a.mcap", "--block", "nan"), "nan s must be more than 0"),
    ],
)
def test_wrong_blocks_are_a_usage_error(analyze_here, arguments, words):
    result = analyze_here(*arguments)
    assert (result.returncode, words in result.stderr) == (2, True)


def test_sweep_in_blocks_is_refused_without_a_report(analyze_here, paper_file, tmp_path):
    result = analyze_here(str(paper_file), "--block", "30", "--report", "r")
    assert result.returncode == 1
    assert "blocks of one sweep have different frequencies" in result.stderr
    assert not (tmp_path / "r").exists()
