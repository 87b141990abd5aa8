"""Stream to the online fit: what is written is read, and nothing else is taken for a frame."""

import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.session import SessionError
from rigd.session.layout import SAMPLE_SIZE, decode_samples, pack_sample_into
from rigd.session.online_fit import (
    EstimateRequest,
    StreamStart,
    estimate_lines,
    mode_line,
    read_frames,
    read_start,
    write_request,
    write_samples,
    write_start,
)

TICKS = st.integers(0, 2**32 - 1)
STARTS = st.builds(
    StreamStart,
    metadata=st.dictionaries(st.text(), st.text()),
    segments=st.dictionaries(st.text(), st.tuples(TICKS, TICKS)),
    every_s=st.none() | st.floats(0.1, 1e3),
)
REQUESTS = st.builds(
    EstimateRequest, id=TICKS, tick=TICKS, whole=st.booleans(), from_last=st.booleans()
)
BLOCKS = st.lists(st.tuples(TICKS, *[st.floats(width=64, allow_nan=False)] * 3), max_size=5).map(
    lambda rows: b"".join(packed(*row) for row in rows)
)


def packed(tick, reference_rad=0.0, angle_rad=0.0, torque_nm=0.0) -> bytes:
    block = bytearray(SAMPLE_SIZE)
    values = (reference_rad, angle_rad, 0.0, torque_nm, *[0.0] * 6)
    pack_sample_into(block, 0, 10**6 * tick, tick, *values, 0, 0, 0)
    return bytes(block)


def stream_of(start, frames) -> io.BytesIO:
    stream = io.BytesIO()
    write_start(stream, start)
    for frame in frames:
        write = write_request if isinstance(frame, EstimateRequest) else write_samples
        write(stream, frame)
    stream.seek(0)
    return stream


@given(STARTS, st.lists(BLOCKS | REQUESTS, max_size=4))
def test_what_is_written_is_read(start, frames):
    stream = stream_of(start, frames)
    assert read_start(stream) == start
    for found, frame in zip(read_frames(stream), frames, strict=True):
        if isinstance(frame, EstimateRequest):
            assert found == frame
        else:
            np.testing.assert_array_equal(found, decode_samples(frame))


@given(st.data())
def test_a_stream_that_ends_within_a_frame_is_broken(data):
    whole = stream_of(StreamStart({}, {}, None), [packed(1), EstimateRequest(1, 2, True)])
    read_start(whole)
    frames = whole.read()
    length = data.draw(st.integers(1, len(frames) - 1))
    first = 5 + SAMPLE_SIZE
    stream = io.BytesIO(frames[:length])
    if length == first:
        assert len(list(read_frames(stream))) == 1
    else:
        with pytest.raises(SessionError, match="ended within a frame"):
            list(read_frames(stream))


@given(st.binary(min_size=1))
def test_garbage_is_refused_in_a_sentence(garbage):
    for read in (read_start, lambda stream: list(read_frames(stream))):
        with pytest.raises(SessionError, match="stream of samples to the online fit is broken"):
            read(io.BytesIO(garbage))


@pytest.mark.parametrize(
    "line",
    [
        b'{"version": 2, "metadata": {}, "segments": {}, "every_s": null}\n',
        b'{"version": 1, "metadata": [], "segments": {}, "every_s": null}\n',
        b'{"version": 1, "metadata": {}, "segments": {"a": 5}, "every_s": null}\n',
        b'{"version": 1, "metadata": {}, "segments": {}}\n',
        b"",
    ],
)
def test_another_first_line_is_refused(line):
    with pytest.raises(SessionError, match="is broken"):
        read_start(io.BytesIO(line))


@pytest.mark.parametrize(
    "frame",
    [
        b"X\x00\x00\x00\x00",
        b"S\x01\x00\x00\x00\x00",
        b"R\x02\x00\x00\x00{}",
        b"S\xff\xff\xff\xff",
        b"S" + SAMPLE_SIZE.to_bytes(4, "little") + bytes(SAMPLE_SIZE),
    ],
)
def test_another_frame_is_refused(frame):
    with pytest.raises(SessionError, match="is broken"):
        list(read_frames(io.BytesIO(frame)))


def quantity(value, half, flag=None) -> dict:
    ends = [value - half, value + half]
    return {"value": value, "std": half / 1.96, "interval_95": ends, "flag": flag}


def answer_with(*modes, **others) -> dict:
    return {"problem": "", "duration_s": 7.0, "modes": list(modes), "findings": []} | others


def mode(number, hz, damping, *, shown=True, flag=None) -> dict:
    return {
        "mode": number,
        "shown": shown,
        "frequency_hz": quantity(hz, 1.2e-3),
        "damping_ratio": quantity(damping, 1.2e-4, flag),
    }


def test_lines_tell_modes_changes_doubts_and_findings():
    before = answer_with(mode(1, 2.5, 0.01), mode(2, 16.0, 0.005, shown=False))
    now = answer_with(
        mode(1, 2.502, 0.0102),
        mode(2, 16.0, 0.005, flag="part of the record is unexplained"),
        mode(3, 45.0, 0.01, shown=False),
        findings=["A hum."],
        validity={"predicted_peak_tip_slope_rad": 0.6, "linear_model_error": 0.12},
    )
    json.dumps(now)
    assert estimate_lines(now, before) == [
        "After 7.0 s (± 95 %, statistical only; tip slope 0.6 rad, error ≤ 12 %):",
        "  mode 1: 2.5020 ± 0.0012 Hz, damping 1.020 ± 0.012 %; change +0.00200 Hz, +2 %",
        "  mode 2: 16.0000 ± 0.0012 Hz, damping 0.500 ± 0.012 % "
        "(doubtful: part of the record is unexplained)",
        "  not visible so far: mode 3",
        "  A hum.",
    ]
    assert "change" not in "".join(estimate_lines(now))
    assert "tip slope unknown" in estimate_lines(before)[0]
    assert mode_line(now["modes"][0]) in estimate_lines(now)[1]


def test_lines_tell_why_there_is_no_estimate():
    assert estimate_lines(answer_with(problem="Nothing is excited yet.")) == [
        "After 7.0 s: Nothing is excited yet."
    ]
