"""Streams as shells and other systems give them: of another encoding, unread, closed, full."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from cases import further

pytestmark = pytest.mark.process

FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="needs a disk that is always full")

QUICK = (
    "--method",
    "welch",
    "--frf",
    "fft",
    "--types",
    "I",
    "--weights",
    "const",
)
GREEK = """
from analysis.cli.standard_streams import standard_streams
with standard_streams():
    for _ in range(20_000):
        print("\\u03b6 = 1")
    raise SystemExit(3)
"""


@pytest.fixture(scope="module")
def short_file(write_session, make_signals, tmp_path_factory):
    path = tmp_path_factory.mktemp("streams") / "short.mcap"
    return write_session(path, make_signals(rest_s=0.2, sweep_s=5.0, ring_down_s=0.3))


def analyze(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "analysis", *map(str, arguments)],
        stderr=subprocess.PIPE, encoding="cp1252", timeout=300, check=False, **options,
    )  # fmt: skip


def python(code, *arguments, **options):
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        stderr=subprocess.PIPE, text=True, timeout=300, check=False, **options,
    )  # fmt: skip


@pytest.fixture
def unread():
    """Writing end of a pipe whose reader has gone."""
    reading, writing = os.pipe()
    os.close(reading)
    yield writing
    os.close(writing)


@pytest.mark.further  # as on a full disk
def test_non_utf_8_stream_gets_question_marks(short_file, tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"}
    result = analyze(
        short_file, *QUICK, "--report", tmp_path / "r", "--json", tmp_path / "j.json",
        stdout=subprocess.PIPE, env=environment,
    )  # fmt: skip
    assert (result.returncode, result.stderr) == (0, "")
    assert "?" in result.stdout
    assert "Fits to Welch's estimate" in result.stdout
    assert "ζ" in (tmp_path / "r" / "tables.txt").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "j.json").read_text(encoding="utf-8"))["fits"]


WITHOUT_DRAWING = """
import runpy
from matplotlib.figure import Figure
Figure.savefig = lambda *_, **__: None  # drawing takes longer than all the rest
runpy.run_module("analysis", run_name="__main__", alter_sys=True)
"""


@needs_full
def test_full_disk_is_reported_and_written_files_remain(short_file, tmp_path):
    options = [short_file, *QUICK, "--report", tmp_path / "r", "--json", tmp_path / "j.json"]
    with FULL.open("w") as full:
        result = python(WITHOUT_DRAWING, *options, stdout=full)
    assert result.returncode == 1
    assert result.stderr == "Error: the output cannot be written (No space left on device).\n"
    assert json.loads((tmp_path / "r" / "analysis.json").read_text(encoding="utf-8"))["fits"]
    assert json.loads((tmp_path / "j.json").read_text(encoding="utf-8"))["fits"]


@needs_full
@pytest.mark.parametrize("stream", ["stdout", further("stderr")])
def test_help_and_errors_on_a_full_disk_end_without_a_traceback(stream):
    with FULL.open("w") as full:
        both = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, stream: full}
        arguments = ["--help"] if stream == "stdout" else ["nosuch.mcap"]
        result = subprocess.run(
            [sys.executable, "-m", "analysis", *arguments],
            **both, text=True, timeout=300, check=False,
        )  # fmt: skip
    assert result.returncode == 1
    if stream == "stdout":
        assert result.stderr == "Error: the output cannot be written (No space left on device).\n"


@pytest.mark.further  # as with a full disk behind the stream
def test_work_completes_without_a_reader(short_file, tmp_path, unread):
    result = analyze(
        short_file, *QUICK, "--report", tmp_path / "r", "--json", tmp_path / "j.json",
        stdout=unread,
    )  # fmt: skip
    assert (result.returncode, result.stderr) == (0, "")
    assert json.loads((tmp_path / "j.json").read_text(encoding="utf-8"))["fits"]


def test_exit_code_is_that_of_the_work(unread):
    result = python(GREEK, stdout=unread)
    assert (result.returncode, result.stderr) == (3, "")


def test_everything_is_written_before_the_end():
    result = python(GREEK, stdout=subprocess.PIPE, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert (result.returncode, result.stdout) == (3, "? = 1\n" * 20_000)


@pytest.mark.skipif(sys.platform == "win32", reason="a shell closes streams")
def test_closed_stream_is_no_error():
    command = f'"{sys.executable}" -m analysis --help >&- 2>&-'
    assert subprocess.run(command, shell=True, timeout=300, check=False).returncode == 0
