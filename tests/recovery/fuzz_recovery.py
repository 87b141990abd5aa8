"""Damage session files and recover them: ``python tests/recovery/fuzz_recovery.py 1000 [SEED]``.

Each case damages a copy of a sound session, as a whole file or as the ``.part`` that a process
leaves that dies before the end. Whatever the damage, the analyser refuses the copy, and recovery
either refuses it as well, with a message, or makes a file of which every number is one of the
original: all samples in chunks before the damage, and none that differs by a bit.
"""

import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from analysis.record import RecordError, load_record
from rigd.session import (
    Session,
    SessionError,
    SessionWriter,
    read_controls,
    read_session,
    read_timings,
    recover,
)
from rigd.session.layout import (
    SAMPLE_DTYPE,
    SAMPLE_SIZE,
    pack_control_into,
    pack_sample_into,
    pack_timing_into,
)

KINDS = ("truncated", "truncated part", "flipped", "flipped part", "smeared", "smeared part")
RATE_HZ = 1000
_SMEAR = 600
"""Most bytes that a smear overwrites."""


@dataclass(frozen=True)
class Original:
    """A sound session, and the ends of its parts."""

    data: bytes
    part_bytes: int
    """Its beginning, up to the outcome, as a dead process leaves it."""
    head_bytes: int
    """Offset up to which damage may cost the first sample."""
    chunk_ends: np.ndarray
    """(n,) byte at which each chunk with samples ends."""
    chunk_samples: np.ndarray
    """(n,) samples up to and with that chunk."""
    session: Session
    controls: np.ndarray
    timings: np.ndarray


def load_original(path):
    """Read a sound session, and find its chunks with another reader."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    chunks = [chunk for chunk in summary.chunk_indexes if 1 in chunk.message_index_offsets]
    ends = np.array([chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks])
    outcome = next(index for index in summary.metadata_indexes if index.name == "outcome")
    session = read_session(path)
    start = np.array([chunk.message_start_time for chunk in chunks]) - session.start_utc_ns
    # A chunk's first sample is its first message, or the next one after it.
    first = np.searchsorted(session.samples["t_ns"], start)
    return Original(
        data=path.read_bytes(),
        part_bytes=outcome.offset,
        head_bytes=int(ends[0]),
        chunk_ends=ends,
        chunk_samples=np.append(first[1:], len(session.samples)),
        session=session,
        controls=read_controls(path),
        timings=read_timings(path),
    )


def write_session(path, seconds=3.0, seed=0):
    """Record noise with all channels, and a gap of missed ticks in the middle."""
    rng = np.random.default_rng(seed)
    samples = np.zeros(round(seconds * RATE_HZ), SAMPLE_DTYPE)
    samples["tick"] = np.arange(len(samples))
    samples["t_ns"] = samples["tick"].astype(np.int64) * 1_000_000
    for name in SAMPLE_DTYPE.names[2:12]:
        samples[name] = np.round(rng.normal(size=len(samples)), 4)
    samples["work_ns"] = rng.integers(0, 2**32, len(samples))
    samples["status"][len(samples) // 2] = 16
    samples = np.delete(samples, np.s_[len(samples) // 2 - 3 : len(samples) // 2])
    metadata = {
        "id": "noise",
        "rate_hz": repr(float(RATE_HZ)),
        "beam_length_m": "0.98",
        "beam_density_kg_per_m": "0.0047",
        "beam_bending_stiffness_n_m2": "0.090275",
        "angle_delay_s": "0.0003",
    }
    segments = {"rest": (0, 200), "sweep": (200, len(samples) - 200)}
    attachments = {"profile.toml": b"rate_hz = 1000\n" * 20, "calibration.json": b"{}"}
    writer = SessionWriter(path)
    writer.begin(1_700_000_000_000_000_000, metadata, segments, attachments)
    writer.log(-1_000_000, "info", "Tared.")
    for i, sample in enumerate(samples.tolist()):
        t_ns, tick = sample[:2]
        if i % 10 == 0:
            control = bytearray(68)
            pack_control_into(control, 0, t_ns, tick, *rng.normal(size=6).tolist())
            writer.write_controls(control)
        timing = bytearray(32)
        pack_timing_into(timing, 0, t_ns, tick, 1e-6 * tick, -1e-6 * tick)
        writer.write_timings(timing)
        packed = bytearray(SAMPLE_SIZE)
        pack_sample_into(packed, 0, *sample)
        writer.write_samples(packed)
        if i % 700 == 600:
            writer.log(t_ns, "warning", f"Nothing in particular at tick {tick}.")
    counts = {"scheduled": len(samples) + 3, "recorded": len(samples), "missed": 3, "lost": 0}
    return writer.close(
        {"outcome": "complete", "reason": "", **{name: str(n) for name, n in counts.items()}}
    )


def damaged(original, kind, rng):
    """Return damaged data and the offset of the first changed byte."""
    is_part = kind.endswith("part")
    data = bytearray(original.data[: original.part_bytes] if is_part else original.data)
    at = rng.randrange(8, len(data))
    if kind.startswith("truncated"):
        del data[at:]
    elif kind.startswith("flipped"):
        data[at] ^= 1 << rng.randrange(8)
    else:
        before = bytes(data)
        size = min(rng.randrange(1, _SMEAR), len(data) - at)
        data[at : at + size] = rng.choice((bytes(size), rng.randbytes(size)))
        changed = np.flatnonzero(
            np.frombuffer(before, np.uint8) != np.frombuffer(bytes(data), np.uint8)
        )
        at = int(changed[0]) if len(changed) else len(data)
    return bytes(data), at


def check_case(original, kind, rng, folder):
    """Try one case in an empty folder; return its result."""
    data, at = damaged(original, kind, rng)
    path = folder / ("a.mcap.part" if kind.endswith("part") else "a.mcap")
    path.write_bytes(data)
    if data != original.data:
        try:
            load_record(path)
        except (SessionError, RecordError):
            pass
        else:
            raise AssertionError(f"{kind} at byte {at}: the damage was not noticed")
    try:
        recovery = recover(path)
    except SessionError as error:
        assert str(path) in str(error)
        assert list(folder.iterdir()) == [path]
        assert at < original.head_bytes, f"{kind} at byte {at}: refused: {error}"
        return "refused"
    assert path.read_bytes() == data
    if recovery.path is None:
        assert data == original.data
        return "sound"
    check_recovered(original, at, recovery, f"{kind} at byte {at}")
    assert sorted(folder.iterdir()) == sorted([path, recovery.path])
    return "recovered"


def identical(found, expected):
    """Compare structured arrays bit by bit."""
    return all(found[name].tobytes() == expected[name].tobytes() for name in expected.dtype.names)


def check_recovered(original, at, recovery, case):
    """Compare a recovered file with its original; `at` is the first byte that was damaged."""
    session, was = read_session(recovery.path), original.session
    samples = session.samples
    known = np.searchsorted(was.samples["tick"], samples["tick"])
    assert identical(samples, was.samples[known]), case
    whole = np.searchsorted(original.chunk_ends, at, side="right")
    least = original.chunk_samples[whole - 1] if whole else 0
    assert len(samples) >= least, f"{case}: {len(samples)} of {least} samples"
    assert (known[:least] == np.arange(least)).all(), case
    for read, expected in ((read_controls, original.controls), (read_timings, original.timings)):
        found = read(recovery.path)
        indices = np.searchsorted(expected["tick"], found["tick"])
        assert identical(found, expected[indices]), case
        assert np.count_nonzero(found["tick"] <= samples["tick"][-1]) >= np.count_nonzero(
            np.isin(expected["tick"], samples["tick"])
        ), case
    assert session.metadata == was.metadata, case
    assert session.segments == was.segments, case
    assert session.start_utc_ns == was.start_utc_ns, case
    assert [event for event in session.events if event not in was.events] == [], case
    assert session.attachments.items() <= was.attachments.items(), case
    check_outcome(original, session, known, case)


def check_outcome(original, session, known, case):
    """Check that the file states that it was recovered, and accounts for its ticks."""
    outcome, was = session.outcome, original.session.outcome
    assert outcome["recovered_from"].startswith("a.mcap"), case
    if outcome["outcome"] == was["outcome"]:
        assert was.items() <= outcome.items(), case
        assert len(session.samples) == len(original.session.samples), case
        return
    assert outcome["outcome"] == "fault", case
    assert outcome["reason"].startswith("Recovered from a.mcap"), case
    counts = {name: int(outcome[name]) for name in ("scheduled", "recorded", "missed", "lost")}
    assert counts["recorded"] == len(session.samples), case
    assert counts["scheduled"] == counts["recorded"] + counts["missed"] + counts["lost"], case
    assert counts["scheduled"] <= int(was["scheduled"]), case
    assert counts["scheduled"] > session.samples["tick"][-1], case
    assert counts["missed"] <= int(was["missed"]), case
    if len(known) < known[-1] + 1:
        assert counts["lost"] > 0, case


def fuzz(original, n, seed):
    """Run `n` cases of each kind; return how often each ended how."""
    rng = random.Random(seed)
    results = Counter()
    for kind in KINDS:
        for _ in range(n):
            with tempfile.TemporaryDirectory(prefix="rigd-fuzz-") as folder:
                results[kind, check_case(original, kind, rng, Path(folder))] += 1
    return results


def main():
    """Record a paper session on the simulated rig, and fuzz it."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    folder = Path(tempfile.mkdtemp(prefix="rigd-fuzz-"))
    try:
        rigd = Path(sys.executable).parent / "rigd"
        command = [rigd, "run", "chirp", "--fast", "--output", folder, "--json"]
        subprocess.run(command, check=True, capture_output=True)
        (path,) = folder.glob("*.mcap")
        original = load_original(path)
    finally:
        shutil.rmtree(folder)
    started = time.monotonic()
    results = fuzz(original, n, seed)
    lines = [f"{len(original.data)} bytes, {len(original.session.samples)} samples, seed {seed}"]
    lines += [
        f"{kind:15} {ending:10} {count:6}" for (kind, ending), count in sorted(results.items())
    ]
    lines.append(f"{(time.monotonic() - started) / len(KINDS) / n:.2f} s a case, nothing wrong")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
