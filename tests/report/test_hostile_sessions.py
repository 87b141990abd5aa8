"""Sessions with impossible claims or contents: one message, and bounded memory."""

import struct
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import zstandard
from cases import further
from session_schemas import schemas

from analysis.record import RecordError, load_record
from rigd.session import SessionError

MAGIC = b"\x89MCAP0\r\n"
MEGABYTES = 1000
ANALYZE = """
import atexit, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))  # of the test's own computer
def peak():
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    print(int(status["VmHWM"].split()[0]) // 1024)
atexit.register(peak)
from rigd.session import limits
limits.MAX_READING_STEPS //= {divisor}
from analysis.cli.app import main
main()
"""


def refused(path, divisor=1):
    """Analyse in its own process; return its message and the most memory it took, in MB.

    It is given one `divisor`-th of the work that a file may take.
    """
    before = sorted(path.parent.iterdir())
    program = ANALYZE.replace("{divisor}", str(divisor))
    result = subprocess.run(
        [sys.executable, "-c", program, path.name, "--method", "welch"],
        cwd=path.parent, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert result.returncode == 1, result.stderr
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"Error: {path.name}")
    assert sorted(path.parent.iterdir()) == before
    return line, int(result.stdout)


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value):
    return struct.pack("<I", len(value)) + value


def channel(number, topic=b"/rig/sample"):
    head = struct.pack("<HH", number, 1)
    return record(4, head + text(topic) + text(b"protobuf") + text(b""))


def metadata(name, values):
    content = b"".join(text(key) + text(value) for key, value in values.items())
    return record(12, text(name) + text(content))


def message(number, content=b""):
    return record(5, struct.pack("<HIQQ", number, 0, 0, 0) + content)


def chunk(records, claimed=None):
    packed = zstandard.compress(records, 1)
    size = len(records) if claimed is None else claimed
    head = struct.pack("<QQQI", 0, 0, size, 0) + text(b"zstd")
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


SCHEMA = record(
    3,
    struct.pack("<H", 1)
    + text(b"rigd.Sample")
    + text(b"protobuf")
    + text(schemas()["rigd.Sample"]),
)
SESSION = metadata(
    b"session",
    {
        b"rate_hz": b"1000",
        b"beam_length_m": b"0.98",
        b"beam_density_kg_per_m": b"0.0047",
        b"beam_bending_stiffness_n_m2": b"0.0903",
    },
)


def write(path, *parts):
    body = b"".join((record(1, text(b"") + text(b"")), SCHEMA, *parts, record(15, bytes(4))))
    path.write_bytes(MAGIC + body + record(2, struct.pack("<QQI", 0, 0, 0)) + MAGIC)
    return path


def repeated(records, count, parts):
    """So many records, in chunks that each hold an equal part."""
    return [chunk(records * (count // parts))] * parts


def in_turn(count):
    return repeated(message(1) + message(2), count, 8)


@pytest.mark.process
@pytest.mark.parametrize(
    ("parts", "message_", "divisor"),
    [
        (lambda: [chunk(message(1), claimed=10 << 30)], "claims 10737418240 bytes", 1),
        further(lambda: repeated(channel(1), 10_000_000, 4), "made of so many small parts", 1),
        further(
            lambda: repeated(metadata(b"x", {}), 10_000_000, 4), "declares channels, schemas, m", 1
        ),
        further(
            lambda: repeated(message(1), 8_000_000, 8),
            "more than the 4000000 messages of /rig/s",
            1,
        ),
        further(lambda: in_turn(2_000_000), "made of so many small parts", 10),
        pytest.param(
            lambda: in_turn(20_000_000), "made of so many small parts", 1, marks=pytest.mark.slow
        ),
    ],
    ids=["ten gigabytes", "channels", "metadata", "empty messages", "messages in turn", "longest"],
)
def test_oversized_content_in_a_small_file_is_refused(tmp_path, parts, message_, divisor):
    path = write(tmp_path / "a.mcap", channel(1), channel(2), SESSION, *parts())
    assert path.stat().st_size < 1_000_000
    line, megabytes = refused(path, divisor)
    assert message_ in line
    assert megabytes < MEGABYTES


def test_nonnumeric_values_are_refused(tmp_path, write_session, short_signals):
    torque = short_signals.torque_nm.copy()
    torque[[77, 1234]] = -np.inf, np.nan
    path = write_session(tmp_path / "a.mcap", replace(short_signals, torque_nm=torque))
    message = "coupling_torque_nm is -inf at tick 77 and not finite in 2 of 5000"
    with pytest.raises(RecordError, match=message):
        load_record(path)


@pytest.mark.parametrize(
    ("indices", "t_ns", "message_"),
    [
        (2000, 1_990_000_000, "from 1999000000 ns at tick 1999 to 1990000000 ns at tick 2000"),
        (2000, 1_999_000_000, "to 1999000000 ns at tick 2000, but time must go forward"),
        (2000, -(2**63), "to -9223372036854775808 ns at tick 2000"),
        (4999, 2**63 - 1, "rate_hz is 1000 Hz, but the time stamps t_ns advance at"),
    ],
)
def test_invalid_times_are_refused(tmp_path, write_session, short_signals, indices, t_ns, message_):
    times_ns = np.arange(5000) * 1_000_000
    times_ns[indices] = t_ns
    path = write_session(tmp_path / "a.mcap", short_signals, t_ns=times_ns)
    with pytest.raises(RecordError) as error:
        load_record(path)
    assert message_ in str(error.value)


def test_decreasing_ticks_are_refused(tmp_path, write_session, short_signals):
    ticks = np.arange(5000)
    ticks[2000:] -= 5
    times_ns = np.arange(5000) * 1_000_000
    path = write_session(tmp_path / "a.mcap", short_signals, ticks=ticks, t_ns=times_ns)
    with pytest.raises(SessionError, match="1995"):
        load_record(path)


def test_too_long_span_is_refused(tmp_path, monkeypatch, write_session, short_signals):
    """Nine in ten ticks missing, outside the sweep: the grid would be ten times the file."""
    ticks = np.arange(5000) * 9
    path = write_session(tmp_path / "a.mcap", short_signals, ticks=ticks, segments={})
    monkeypatch.setattr("analysis.record_checks.MAX_TICKS", 44_000)
    with pytest.raises(RecordError, match="spans 44992 ticks, and no more than 44000"):
        load_record(path)


def test_too_long_session_is_refused(tmp_path, monkeypatch, write_session, short_signals):
    path = write_session(tmp_path / "a.mcap", short_signals)
    monkeypatch.setattr("analysis.record.MAX_SAMPLES", 4999)
    with pytest.raises(SessionError, match=r"more than the 4999 .* Give a shorter session"):
        load_record(path)
    monkeypatch.setattr("analysis.record.MAX_SAMPLES", 5000)
    assert len(load_record(path).time_s) == 5000
