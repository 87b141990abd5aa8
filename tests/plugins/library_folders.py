"""Folders of sessions with quick looks and reports, for the library and `rigd list`."""

import json

import numpy as np
import pytest

from rigd.session import SessionWriter
from rigd.session.layout import encode_samples

DAY_NS = 86_400 * 10**9
START_UTC_NS = 1_700_000_000_000_000_000


@pytest.fixture
def record_briefly(tmp_path):
    """Write a session of a second to the folder, with the given metadata."""

    def write(name, *, day=0.0, outcome="complete", **metadata):
        writer = SessionWriter(tmp_path / f"{name}.mcap")
        stated = {"rate_hz": "1000.0", "excitation": "chirp", "profile": "sim"} | metadata
        writer.begin(START_UTC_NS + int(day * DAY_NS), stated, {}, {})
        writer.write_samples(encode_samples({"tick": np.arange(1000)}))
        counts = {"scheduled": "1010", "missed": "7", "lost": "3", "late": "2"}
        return writer.close({"outcome": outcome, "reason": "", **counts})

    return write


def quantity(value, half, flag=None):
    return {"value": value, "std": half / 2, "interval_95": [value - half, value + half],
            "flag": flag}  # fmt: skip


def mode(frequency_hz, half_hz=0.01, damping_ratio=0.005, half=0.0005):
    return {"frequency_hz": quantity(frequency_hz, half_hz),
            "damping_ratio": quantity(damping_ratio, half)}  # fmt: skip


@pytest.fixture
def write_quick_look():
    """Write the quick look of a session, with its modes."""

    def write(path, *modes, **others):
        target = path.with_name(f"{path.stem}.look.json")
        target.write_text(json.dumps({"version": 1, "modes": modes} | others))
        return target

    return write


@pytest.fixture
def write_report():
    """Write the report of a session, with its modes."""

    def write(path, *modes, number=1, **others):
        folder = path.with_name(f"{path.stem}.report{'' if number == 1 else f'-{number}'}")
        folder.mkdir()
        (folder / "report.html").write_text("<html>")
        (folder / "analysis.json").write_text(
            json.dumps({"headlines": [{"modes": modes} | others]})
        )
        return folder

    return write
