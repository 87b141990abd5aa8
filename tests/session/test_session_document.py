"""docs/session_format.md agrees with the code, and its example runs."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rigd.session import limits, read_session
from rigd.session.layout import (
    CONTROL_FIELD_TYPES,
    SAMPLE_FIELD_TYPES,
    SAMPLE_WIRE_DTYPE,
    TOUCH_FIELD_TYPES,
    TOUCH_KINDS,
    TOUCH_SIZE,
    Status,
    field_tag,
)

DOCUMENT = (Path(__file__).parents[2] / "docs" / "session_format.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("message", "types"),
    [
        ("Sample", SAMPLE_FIELD_TYPES),
        ("Control", CONTROL_FIELD_TYPES),
        ("Touch", TOUCH_FIELD_TYPES),
    ],
)
def test_the_proto_text_is_the_layout(message, types):
    (body,) = re.findall(rf"message {message} {{(.*?)}}", DOCUMENT, re.DOTALL)
    fields = re.findall(r"(\w+)\s+(\w+) = (\d+);", body)
    assert [(name, kind, int(n)) for kind, name, n in fields] == [
        (name, kind, n) for n, (name, kind) in enumerate(types.items(), start=1)
    ]


def test_kinds_of_a_touch_are_those_of_the_code():
    (kinds,) = re.findall(r"kind = 9;\s*// (.*)", DOCUMENT)
    assert kinds == ", ".join(f"{n} {name}" for n, name in enumerate(TOUCH_KINDS))
    assert f"({TOUCH_SIZE} bytes), written at the end" in DOCUMENT


def test_the_tags_and_sizes_are_those_of_the_layout():
    tags = [field_tag(n, kind) for n, kind in enumerate(SAMPLE_FIELD_TYPES.values(), start=1)]
    assert " ".join(f"{tag:02x}" for tag in tags) in DOCUMENT
    assert f"always {SAMPLE_WIRE_DTYPE.itemsize} bytes" in DOCUMENT


def test_the_status_bits_are_those_of_the_code():
    rows = re.findall(r"^\| (\d+) \| (\d+) \| ([a-z ]+)", DOCUMENT, re.MULTILINE)
    assert len(rows) == len(Status)
    for bit, value, text in rows:
        assert int(value) == 1 << int(bit)
        words = Status(int(value)).name.lower().split("_")
        assert all(word in text for word in words if word not in ("after", "late"))


def test_the_limits_are_those_of_the_code():
    assert f"more than {limits.MAX_CHUNK_BYTES >> 20} MiB" in DOCUMENT
    assert f"more than {limits.MAX_TOTAL_UNPACKED_BYTES >> 30} GiB" in DOCUMENT
    assert limits.MAX_FILE_BYTES == limits.MAX_TOTAL_UNPACKED_BYTES
    assert f"more than {limits.MAX_DECLARATION_BYTES >> 20} MiB of schemas" in DOCUMENT
    assert f"more than {limits.MAX_DECLARATION_TEXT_BYTES >> 20} MiB of them" in DOCUMENT
    assert f"more than {limits.MAX_METADATA_KEYS // 1000} 000 keys" in DOCUMENT
    assert f"schema of more than {limits.MAX_SCHEMA_BYTES >> 10} KiB" in DOCUMENT
    assert f"more than {limits.MAX_CHANNELS_PER_TOPIC} channels" in DOCUMENT
    assert f"message of more than {limits.MAX_MESSAGE_BYTES >> 20} MiB" in DOCUMENT
    assert f"of more than {limits.MAX_SAMPLE_MESSAGE_BYTES >> 10} KiB" in DOCUMENT
    assert f"more than {limits.MAX_READING_STEPS // 10**6} million runs" in DOCUMENT
    assert f"more than {limits.MAX_SINGLY_DECODED_MESSAGES // 1000} 000 samples" in DOCUMENT
    assert f"up to {limits.MAX_RECORDED_SAMPLES / 1e6:g} million samples" in DOCUMENT
    assert f"up to {limits.MAX_SAMPLES / 1e6:g} million samples" in DOCUMENT


@pytest.mark.process
def test_the_example_writes_a_session(tmp_path):
    (program,) = re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)
    assert not re.search(r"import (rigd|numpy)|from rigd", program)
    script = tmp_path / "example.py"
    script.write_text(program, "utf-8")
    path = tmp_path / "example.mcap"
    subprocess.run([sys.executable, "-W", "error", script, path], check=True)
    session = read_session(path)
    samples = session.samples
    assert samples["tick"].tolist() == list(range(2000))
    t = samples["t_ns"] * 1e-9
    np.testing.assert_allclose(samples["angle_rad"], 0.02 * np.sin(np.pi * t), atol=1e-15)
    # The sign required by the document: in phase with the angular acceleration.
    inertia = session.number("beam_density_kg_per_m") * session.number("beam_length_m") ** 3 / 3
    acceleration = -0.02 * np.pi**2 * np.sin(np.pi * t)
    np.testing.assert_allclose(samples["coupling_torque_nm"], inertia * acceleration, atol=1e-12)
    assert session.number("rate_hz") == 1000
    assert (session.segments, session.outcome) == ({}, None)
    assert subprocess.run(
        [sys.executable, script, path], capture_output=True, check=False
    ).returncode  # it does not overwrite
