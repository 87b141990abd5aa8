"""Full disks, removed folders, killed processes: all written samples are recovered."""

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from rigd.session import SessionError, SessionWriter, read_session, recover
from rigd.session.layout import SAMPLE_SIZE, decode_samples, pack_sample_into

METADATA = {"rate_hz": "1000.0", "beam_length_m": "1"}


def packed(first, count, rate_hz=1000.0):
    block = bytearray(count * SAMPLE_SIZE)
    rng = np.random.default_rng(first)
    for i, row in enumerate(rng.normal(size=(count, 10)).tolist()):
        tick = first + i
        t_ns = round(tick * 1e9 / rate_hz)
        pack_sample_into(block, i * SAMPLE_SIZE, t_ns, tick, *row, 0, 0, tick)
    return bytes(block)


def begun(path, **metadata):
    writer = SessionWriter(path)
    writer.begin(1_700_000_000_000_000_000, METADATA | metadata, {"sweep": (0, 10_000)}, {})
    return writer


def fill(writer, at_most=40):
    """Write until it fails; return how many samples were in chunks written before."""
    for number in range(at_most):
        try:
            writer.write_samples(packed(250 * number, 250))
        except SessionError as error:
            return 250 * number, str(error)
    raise AssertionError("the disk took everything")


def recovered_ticks(part):
    return read_session(recover(part).path).samples["tick"].tolist()


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 200 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", folder]
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root can mount a file system")
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a file system is not allowed here")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.mark.process
def test_a_full_disk_loses_no_recorded_samples(small_disk, tmp_path):
    writer = begun(small_disk / "a.mcap")
    count, message = fill(writer)
    assert count > 500
    assert message.startswith(f"{writer.part} cannot be written: No space left on device.")
    assert writer.abandon() == writer.part
    with pytest.raises(SessionError, match=r"a\.mcap cannot be written: No space left on device"):
        recover(writer.part)
    assert [p.name for p in small_disk.iterdir()] == ["a.mcap.part"]
    elsewhere = tmp_path / "a.mcap.part"
    shutil.copy(writer.part, elsewhere)
    # The last chunk may have fitted, and only its index not.
    assert recovered_ticks(elsewhere) in (list(range(count)), list(range(count + 250)))


@pytest.mark.process
def test_an_unwritable_disk_is_refused_before_motion(small_disk):
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    with pytest.raises(SessionError, match=r"cannot be written: Read-only file system\. Check"):
        SessionWriter(small_disk / "a.mcap")


def test_an_unwritable_folder_is_refused(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(SessionError, match=r"cannot be written: Permission denied\. Check"):
            SessionWriter(tmp_path / "a.mcap")
    finally:
        tmp_path.chmod(0o700)


def test_a_limit_of_the_file_size_loses_no_recorded_samples(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = begun(tmp_path / "a.mcap")
    resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, hard))
    try:
        count, message = fill(writer)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "cannot be written: File too large" in message
    assert writer.abandon() == writer.part
    assert recovered_ticks(writer.part) in (list(range(count)), list(range(count + 250)))
    assert count > 500


@pytest.fixture
def advance(monkeypatch):
    """Make the writer's next sync due."""
    now = [0.0]
    monkeypatch.setattr("rigd.session._writer.time.monotonic", lambda: now[0])

    def advance():
        now[0] += 2.0

    return advance


def remove_file(folder):
    (folder / "a.mcap.part").unlink()


def rename_folder(folder):
    folder.rename(folder.with_name("elsewhere"))


@pytest.mark.parametrize(
    ("mishap", "file_name"),
    [
        (remove_file, "sessions/a.mcap.part"),
        (shutil.rmtree, "a.mcap.part"),
        (rename_folder, "elsewhere/a.mcap.part"),
    ],
)
@pytest.mark.parametrize("at_the_end", [False, True])
def test_a_file_removed_while_recording_is_detected_and_saved(
    tmp_path, advance, mishap, file_name, at_the_end
):
    folder = tmp_path / "sessions"
    folder.mkdir()
    writer = begun(folder / "a.mcap")
    writer.write_samples(packed(0, 600))
    mishap(folder)
    with pytest.raises(SessionError, match=r"a\.mcap\.part was removed or moved while it was"):
        if at_the_end:
            writer.close({"outcome": "complete"})
        else:
            advance()
            writer.write_samples(packed(600, 250))
    assert writer.abandon() == tmp_path / file_name
    assert recovered_ticks(tmp_path / file_name) == list(range(600 if at_the_end else 850))


def test_samples_without_a_reader_are_reported_lost(tmp_path, monkeypatch):
    folder = tmp_path / "sessions"
    folder.mkdir()
    writer = begun(folder / "a.mcap")
    shutil.rmtree(folder)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rigd.session._writer.copy_new", full)
    assert writer.abandon() is None


CHILD = """
    import sys
    from pathlib import Path
    sys.path.insert(0, sys.argv[2])
    from test_recovery_disk import begun, packed
    from rigd.session.layout import SAMPLE_SIZE

    rate_hz = float(sys.argv[3])
    block = packed(0, 3000, rate_hz)
    writer = begun(Path(sys.argv[1]), rate_hz=repr(rate_hz))
    for tick in range(3000):
        writer.write_samples(block[tick * SAMPLE_SIZE : (tick + 1) * SAMPLE_SIZE])
        print(tick + 1, flush=True)
    input()
"""


@pytest.mark.process
@pytest.mark.parametrize(
    "rate_hz", [1000.0, *(pytest.param(hz, marks=pytest.mark.further) for hz in (100.0, 8000.0))]
)
def test_a_killed_recorder_loses_a_quarter_of_a_second(tmp_path, rate_hz):
    path = tmp_path / "a.mcap"
    here = Path(__file__).parent
    command = [sys.executable, "-c", textwrap.dedent(CHILD), path, here, repr(rate_hz)]
    after = random.Random(rate_hz).randrange(300, 3000)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        for line in child.stdout:
            if int(line) == after:
                break
        child.send_signal(signal.SIGKILL)
        # It prints what it was given; a line may be cut off by its death.
        given = max(after, *(int(line) for line in child.stdout if line.endswith(b"\n")), 0)
    samples = read_session(recover(tmp_path / "a.mcap.part").path).samples
    expected = decode_samples(packed(0, len(samples), rate_hz))
    assert samples.tolist() == expected.tolist()
    assert given - len(samples) <= min(0.25 * rate_hz, 250)
