"""Touches in session files: as messages that are written, read and recovered, and as metadata."""

import json
import math

import pytest

from rigd.session import read_session, read_touches, recover
from rigd.session.touches import packed_touches, touch_line, touches_of


def known(value, half):
    return {"value": value, "std": half / 2, "interval_95": [value - half, value + half]}


TOUCH = {
    "number": 1,
    "x_m": known(0.62, 0.002),
    "time_s": known(0.1234, 0.0002),
    "force_n": known(0.75, 0.04),
    "stiffness_n_per_m": None,
    "kind": "rigid",
}
BARE = {"number": 2}


def test_touches_are_written_at_the_end_and_read_back(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(600)))
    writer.write_touches(packed_touches([(128, TOUCH), (400, BARE)], 1000.0))
    writer.close(kit.OUTCOME)
    first, second = read_touches(tmp_path / "a.mcap")
    assert first["t_ns"] == 123_400_000
    assert (first["tick"], first["x_m"], first["x_std_m"]) == (128, 0.62, 0.001)
    assert (first["force_n"], first["kind"]) == (0.75, 1)
    assert math.isnan(first["stiffness_n_per_m"])
    assert (second["t_ns"], second["tick"], second["kind"]) == (400_000_000, 400, 0)
    assert math.isnan(second["x_m"])
    assert len(read_session(tmp_path / "a.mcap").samples) == 600


def test_ends_of_an_asymmetric_interval_are_written():
    stiffness = {"value": 43296.0, "std": 28263.0, "interval_95": [16341.0, 127134.0]}
    line = touch_line(TOUCH | {"stiffness_n_per_m": stiffness})
    assert "0.6200 ± 0.0020 m from the axis" in line
    assert "16341 to 127134 N/m, rigid" in line


def test_a_session_without_touches(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.close(kit.OUTCOME)
    assert len(read_touches(tmp_path / "a.mcap")) == 0


def test_touches_survive_a_recovery(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(300)))
    writer.write_touches(packed_touches([(128, TOUCH)], 1000.0))
    writer.abandon()
    recovery = recover(writer.part)
    assert read_touches(recovery.path)["tick"].tolist() == [128]


def test_a_block_of_another_size_is_refused(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    with pytest.raises(ValueError, match="not a whole number of 73-byte messages"):
        writer.write_touches(b"abc")
    writer.abandon()


def test_the_outcome_lists_touches():
    assert touches_of({"touches": json.dumps([TOUCH])}) == [TOUCH]
    assert touches_of(None) == touches_of({"outcome": "complete"}) == []


@pytest.mark.parametrize("text", ["", "{", "7", '{"number": 1}', "[1, null]", "[" * 100_000])
def test_invalid_lists_of_touches_are_omitted(text):
    assert touches_of({"touches": text}) == []


@pytest.mark.parametrize(
    "position_m",
    [
        7,
        {"value": 1.0},
        {"value": "1", "std": 1.0, "interval_95": [0.0, 1.0]},
        {"value": 1e300, "std": 1.0, "interval_95": [0.0, 1.0]},
        {"value": 1.0, "std": 1.0, "interval_95": [0.0, 1.0, 2.0]},
        {"value": 1.0, "std": 1.0, "interval_95": 3},
    ],
)
def test_an_invalid_number_is_unknown(position_m):
    (touch,) = touches_of({"touches": json.dumps([{"number": -1, "x_m": position_m, "kind": [1]}])})
    assert touch["x_m"] is None
    assert (touch["number"], touch["kind"]) == (0, "")


def test_a_line_states_the_known_values():
    assert touch_line(TOUCH) == (
        "Touch 1: 0.6200 ± 0.0020 m from the axis, 0.12340 ± 0.00020 s, 0.750 ± 0.040 N, rigid"
    )
    assert touch_line(BARE) == "Touch 2: not estimated"
