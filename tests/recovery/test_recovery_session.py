"""A session whose file cannot be written any more stops safely and retains its samples."""

import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import warm_start

from rigd.session import read_session, recover

pytestmark = pytest.mark.process

RIGD = Path(sys.executable).parent / "rigd"


def limit_files():
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000_000, 4_000_000))


@pytest.mark.further  # as test_recovery_disk.py
def test_a_file_at_its_size_limit_ends_the_session(tmp_path):
    result = subprocess.run(
        [RIGD, "run", "chirp", "--fast", "--json", "--output", tmp_path],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        preexec_fn=limit_files,
    )
    assert result.returncode == 1, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    (part,) = tmp_path.glob("*.mcap.part")
    assert f"{part} cannot be written: File too large" in result.stderr
    assert f"What was recorded is in {part}" in result.stderr
    (session,) = json.loads(result.stdout)["sessions"]
    assert (session["outcome"], session["path"], session["part"]) == ("fault", None, str(part))
    assert "File too large" in session["reason"]
    assert session["scheduled"] > 20_000
    assert session["recorded"] is session["lost"] is None
    samples = read_session(recover(part).path).samples
    assert samples["tick"].tolist() == list(range(len(samples)))
    assert len(samples) > 20_000


def test_a_removed_folder_ends_the_session(write_profile, tmp_path):
    folder = tmp_path / "sessions"
    where = ("--profile", write_profile("sim", patient=True), "--output", folder)
    process = warm_start.start(
        [RIGD, "run", "hold", "--json", "--duration", "60", "--rest", "0", *where],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 300.0
        while not any(p.stat().st_size > 60_000 for p in folder.glob("*.part")):
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.05)
        shutil.rmtree(folder)
        output, errors = process.communicate(timeout=300)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 1, output + errors
    assert "Traceback" not in errors
    (part,) = tmp_path.glob("*.mcap.part")
    assert "was removed or moved while it was recorded" in errors
    assert f"What was recorded is now {part}; rigd recover {part}" in errors
    (session,) = json.loads(output)["sessions"]
    assert (session["outcome"], session["path"], session["part"]) == ("fault", None, str(part))
    samples = read_session(recover(part).path).samples
    assert len(samples) > 300
    assert (samples["tick"][1:] > samples["tick"][:-1]).all()
