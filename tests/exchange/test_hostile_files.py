"""Files with false claims or oversized contents: refused, in bounded memory."""

import json
import os
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from cases import further

from analysis.exchange import ExchangeError, read_source

pytestmark = pytest.mark.process

READ = """
import json, resource, sys
from pathlib import Path
from analysis.exchange import ExchangeError, read_source
bound = resource.getrlimit(resource.RLIMIT_AS)
for line in sys.stdin:
    path, name = json.loads(line)
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    try:
        read_source(Path(path), [name])
        message = "read"
    except ExchangeError as error:
        message = str(error)
    assert resource.getrlimit(resource.RLIMIT_AS) == bound
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    print(json.dumps([message, int(status["VmHWM"].split()[0]) // 1024]), flush=True)
"""


@pytest.fixture(scope="module")
def reader():
    """A process that reads files, one after the other."""
    with subprocess.Popen(
        [sys.executable, "-c", READ], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        process.stdin.close()
        assert process.wait(300) == 0


@pytest.fixture
def refused(reader):
    """Read in another process; return the message and the most memory it took, in MB."""

    def read(path, name):
        print(json.dumps([str(path), name]), file=reader.stdin, flush=True)
        message, megabytes = json.loads(reader.stdout.readline())
        assert message.startswith(str(path)), message
        return message, megabytes

    return read


def test_ten_million_columns(refused, tmp_path):
    path = tmp_path / "wide.csv"
    line = b"1," * 10_000_000 + b"\n"
    path.write_bytes(line + line)
    message, megabytes = refused(path, "#1")
    assert "a line of more than" in message
    assert megabytes < 100


def test_unterminated_quotation_is_refused(refused, tmp_path):
    path = tmp_path / "quote.csv"
    path.write_bytes(b'a,b\n"' + b"1,2\n" * 1_000_000)
    message, megabytes = refused(path, "a")
    assert "line 2 has 1 cell" in message
    assert "a quotation does not end" in message
    assert megabytes < 100


def mat_element(dims, claimed, payload):
    """A variable `a` of MATLAB's version 5 that claims so many bytes of doubles."""
    body = struct.pack("<4I", 6, 8, 6, 0) + struct.pack("<2I2i", 5, 8, *dims)
    body += struct.pack("<2I8s", 1, 1, b"a") + struct.pack("<2I", 9, claimed) + payload
    return body


MAT_HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)


@pytest.mark.parametrize("dims", [further((1, 2**28)), (1, 1000)])
def test_two_gigabytes_in_two_megabytes_are_refused(refused, tmp_path, dims):
    """Zeros, compressed; with right or wrong dimensions."""
    size = 2**31
    body = mat_element(dims, size, b"")
    packer = zlib.compressobj(9)
    data = packer.compress(struct.pack("<2I", 14, len(body) + size) + body)
    data += packer.flush(zlib.Z_FULL_FLUSH)  # the rest can be repeated unchanged
    data += (size >> 20) * (packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH))
    path = tmp_path / "bomb.mat"
    path.write_bytes(MAT_HEADER + struct.pack("<2I", 15, len(data)) + data)
    message, megabytes = refused(path, "a")
    assert "cut the session out" in message or "800 MB" in message
    assert megabytes < 900


@pytest.mark.parametrize("dims", [(1, 2**30), further((1, 10))])
def test_absent_four_gigabytes_are_refused(refused, tmp_path, dims):
    claimed = 0xFFFFFFF0
    body = mat_element(dims, claimed, bytes(80))
    path = tmp_path / "claim.mat"
    path.write_bytes(MAT_HEADER + struct.pack("<2I", 14, len(body)) + body)
    _, megabytes = refused(path, "a")
    assert megabytes < 200


def test_matlab_7_3_reads_only_its_own_content(tmp_path):
    """A link or a data set may lead to any file that the importer can read, or to a pipe."""
    h5py = pytest.importorskip("h5py", reason="MATLAB 7.3 is read if h5py is there")
    secret, other, path = (tmp_path / name for name in ("secret", "other.h5", "a.mat"))
    secret.write_bytes(np.arange(50.0).tobytes())
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(other, "w") as file:
        file["x"] = np.arange(50.0)[None, :]
    with h5py.File(path, "w") as file:
        file["plain"] = np.arange(50.0)[None, :]
        file["soft"] = h5py.SoftLink("/plain")
        file["outside"] = h5py.ExternalLink(str(other), "/x")
        file["waits"] = h5py.ExternalLink(str(tmp_path / "pipe"), "/x")
        raw = [(str(secret), 0, h5py.h5f.UNLIMITED)]
        file.create_dataset("raw", (1, 50), "f8", external=raw)
        layout = h5py.VirtualLayout((1, 50), "f8")
        layout[:] = h5py.VirtualSource(str(other), "x", (1, 50))
        file.create_virtual_dataset("virtual", layout)
        group = file.create_group("log")
        group["angle"] = file["plain"]
        group["torque"] = h5py.SoftLink("/plain")
        group["back"] = group
    for name in ("plain", "log.angle", "log.back.angle"):
        assert read_source(path, [name])[1][name].values.tolist() == list(range(50))
    for name in ("soft", "outside", "waits", "raw", "virtual", "log.torque"):
        with pytest.raises(ExchangeError, match="stored elsewhere"):
            read_source(path, [name])
    for name in ("/plain", "log/angle", "log..", "plain.x"):
        with pytest.raises(ExchangeError, match="has no channel"):
            read_source(path, [name])


def test_universal_file_of_marks_is_refused(refused, tmp_path):
    pytest.importorskip("pyuff", reason="UFF58 needs pyuff")
    path = tmp_path / "marks.uff"
    path.write_bytes(b"    -1\n" * 3_000_000)
    message, megabytes = refused(path, "#1")
    assert "more than 10000 data sets" in message
    assert megabytes < 200


def lead_in(contents, length):
    return struct.pack("<4sIIQQ", b"TDSm", contents, 4713, length, length)


def tdms_object(number):
    name = f"/'g'/'c{number}'".encode()
    return struct.pack(f"<I{len(name)}sII", len(name), name, 0xFFFFFFFF, 0)


def test_tdms_of_ten_million_channels(refused, tmp_path):
    pytest.importorskip("nptdms", reason="TDMS needs npTDMS")
    path = tmp_path / "wide.tdms"
    contents = struct.pack("<I", 10_000_000) + tdms_object(1) * 1_000_000
    path.write_bytes(lead_in(6, len(contents)) + contents)
    message, megabytes = refused(path, "g/c1")
    assert "list more than" in message
    assert megabytes < 200


def test_tdms_with_repeated_channel_lists(refused, tmp_path):
    pytest.importorskip("nptdms", reason="TDMS needs npTDMS")
    path = tmp_path / "often.tdms"
    contents = struct.pack("<I", 20_000) + b"".join(map(tdms_object, range(20_000)))
    again = lead_in(2, 4) + struct.pack("<I", 0)
    path.write_bytes(lead_in(6, len(contents)) + contents + 20_000 * again)
    message, megabytes = refused(path, "g/c1")
    assert "list more than" in message
    assert megabytes < 200


def test_tdms_with_a_claimed_text_of_four_gigabytes(refused, tmp_path):
    pytest.importorskip("nptdms", reason="TDMS needs npTDMS")
    path = tmp_path / "text.tdms"
    path.write_bytes(lead_in(6, 100) + struct.pack("<II", 1, 0xFFFFFFF0) + b"abc")
    _, megabytes = refused(path, "g/c1")
    assert megabytes < 200
