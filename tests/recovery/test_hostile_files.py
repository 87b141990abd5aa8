"""Files made to take memory, time or the terminal: each command stays within its limits."""

import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cases import further

from rigd.session import describe, read_session, read_timings, recover


@pytest.fixture(scope="session")
def hostile(load_script):
    return load_script("fuzz_hostile")


@pytest.mark.process
@pytest.mark.further  # the worst kinds are below
def test_files_of_each_hostile_kind_and_damaged_ones(hostile):
    """In a separate process, which forks for each command: this one is large, and has threads."""
    script = Path(hostile.__file__)
    count = 2 * len((*hostile.LOST_ONCE, *hostile.OTHERS))  # every second one is damaged
    code = f"import sys; sys.path.insert(0, {str(script.parent)!r}); import fuzz_hostile as f; "
    code += f"wrong = f.fuzz({count}, 3, scale=0.01); sys.exit('\\n'.join(wrong) or 0)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=1800
    )
    assert done.returncode == 0, done.stderr


FULL_SCALE = """
import random, sys, tempfile
from pathlib import Path
sys.path.insert(0, {folder!r})
import fuzz_hostile as f
f.MOST_MEGABYTES = {megabytes}
f.warm_up(["info"])
wrong = []
for kind in {kinds!r}.split():
    with tempfile.TemporaryDirectory() as folder:
        make = lambda: getattr(f, kind)(random.Random(1), {scale})
        wrong += [o.wrong() for o in f.check_file(make, kind, Path(folder), ["info"])]
sys.exit("".join(wrong) or 0)
"""


@pytest.mark.process
@pytest.mark.parametrize(
    ("kinds", "scale", "megabytes"),
    [
        further("digits long_key control_characters log_flood permuted", 1.0, 500),
        # A chunk of these has 50 MB, too much to be held as a whole.
        further("wide_chunks other_topic", 0.2, 80),
        pytest.param("wide_chunks other_topic in_turn", 1.0, 500, marks=pytest.mark.slow),
    ],
    ids=["full", "long chunks", "longest chunks"],
)
def test_files_that_once_took_all_memory_or_time(hostile, kinds, scale, megabytes):
    """`rigd info` alone: the others read in the same way."""
    folder = str(Path(hostile.__file__).parent)
    code = FULL_SCALE.format(folder=folder, kinds=kinds, scale=scale, megabytes=megabytes)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=1800
    )
    assert done.returncode == 0, done.stderr


def test_omitted_content_is_reported(hostile, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(hostile.long_key(random.Random(1)))
    info = describe(path)
    text = "\n".join(info.lines())
    assert "… and 19999800 more characters" in text
    shown = sum(line.startswith("key") for line in info.lines())
    assert shown > 500
    assert f"… and {20_000 - shown} more keys not shown" in text
    assert info.as_dict()["left_out"] == info.omission_texts


def test_an_excessive_log_is_cut_and_counted(hostile, tmp_path, monkeypatch):
    monkeypatch.setattr("rigd.session._reader.MAX_EVENTS", 10_000)  # a tenth, in a tenth the time
    path = tmp_path / "a.mcap"
    lines = b"".join(hostile.event(f"line {i}") for i in range(12_000))
    path.write_bytes(
        hostile.session_file(
            hostile.samples(10), hostile.chunk(hostile.event("y" * 2_000_000) + lines)
        )
    )
    session = read_session(path)
    assert session.events[0].message.endswith("bytes, not read)")
    assert session.events[1].message == "line 0"
    assert len(session.events) + session.omitted_event_count == 12_001
    shown = describe(path)
    assert f"… and {12_001 - len(shown.events)} more messages of the log" in shown.omission_texts[0]


def test_samples_with_another_order_of_fields_are_read(hostile, tmp_path):
    path, plain = tmp_path / "a.mcap", tmp_path / "b.mcap"
    path.write_bytes(hostile.session_file(hostile.samples(30_000, permuted=True)))
    plain.write_bytes(hostile.session_file(hostile.samples(30_000)))
    np.testing.assert_array_equal(read_session(path).samples, read_session(plain).samples)


def test_a_chunk_longer_than_a_block_is_read(hostile, tmp_path):
    """Records begin in one block and end in another; a long one that is not needed is skipped."""
    filler = hostile.channel(3, "/other", 0) + hostile.message(3, bytes(9_000_000))
    rows = hostile.sample_records(0, 70_000)
    records = rows[:1_500_000] + filler + rows[1_500_000:]
    plain = tmp_path / "plain.mcap"
    plain.write_bytes(hostile.session_file(hostile.samples(70_000)))
    for compression in ("lz4", "zstd", ""):
        path = tmp_path / f"{compression}.mcap"
        path.write_bytes(hostile.session_file(hostile.chunk(records, compression=compression)))
        np.testing.assert_array_equal(read_session(path).samples, read_session(plain).samples)


@pytest.mark.parametrize("order", [(0, 1, 1, 2, 3), (0, 1, 2, 1, 3), (0, 1, 2, 3, 0, 1)])
def test_repeated_chunks_are_recovered_once(hostile, tmp_path, order):
    path = tmp_path / "a.mcap"
    chunks = [hostile.chunk(hostile.sample_records(1000 * i, 1000)) for i in range(4)]
    path.write_bytes(hostile.session_file(*[chunks[i] for i in order]))
    recovery = recover(path)
    assert recovery.samples == 4000
    assert f"has {1000 * (len(order) - 4)} samples that repeat or precede" in recovery.damage
    session = read_session(recovery.path)
    assert session.samples["tick"].tolist() == list(range(4000))
    assert session.outcome["lost"] == "0"
    assert session.outcome["outcome"] == "fault"
    assert "repeat or precede" in session.outcome["recovered_damage"]


def test_a_repeated_chunk_is_omitted_from_every_channel(original, tmp_path):
    path = tmp_path / "a.mcap"
    first, second = original.chunk_ends[1:3]
    path.write_bytes(original.data[:second] + original.data[first:second] + original.data[second:])
    recovery = recover(path)
    samples = read_session(recovery.path).samples
    np.testing.assert_array_equal(samples["tick"], original.session.samples["tick"])
    assert len(read_timings(recovery.path)) == len(original.timings)


@pytest.mark.parametrize(
    ("ticks", "remaining"),
    [
        ([*range(40), 4_000_000_000, *range(41, 100)], [*range(40), *range(41, 100)]),
        ([7, 7, 3], [7]),
    ],
    ids=["one far too high", "one twice"],
)
def test_a_wrong_tick_leaves_the_others(hostile, tmp_path, ticks, remaining):
    path = tmp_path / "a.mcap"
    rows = b"".join(hostile.sample_records(tick, 1) for tick in ticks)
    path.write_bytes(hostile.session_file(hostile.chunk(rows)))
    recovery = recover(path)
    assert f"has {len(ticks) - len(remaining)} samples that repeat or precede" in recovery.damage
    assert read_session(recovery.path).samples["tick"].tolist() == remaining
