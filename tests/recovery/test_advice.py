"""Advice about torn files works, and none is given if nothing can be recovered."""

import re
import shlex
import shutil
import subprocess

import pytest

from rigd.cli.app import app
from rigd.runner.request import remaining_file_text
from rigd.session import (
    SessionError,
    SessionWriter,
    describe,
    read_controls,
    read_session,
    read_timings,
    recover,
)


@pytest.fixture
def run():
    from typer.testing import CliRunner

    return lambda *arguments: CliRunner().invoke(app, [str(argument) for argument in arguments])


def first_bytes(original, count):
    return original.data[:count]


@pytest.mark.parametrize("count", [8, 9, 500])
def test_no_recovery_of_a_file_without_samples(original, tmp_path, run, count):
    part = tmp_path / "a.mcap.part"
    part.write_bytes(first_bytes(original, count))
    message = run("info", part).stderr
    assert "0 complete samples are readable before that, so there is nothing to recover" in message
    assert "rigd recover" not in message
    assert run("recover", part).exit_code == 1
    message = remaining_file_text(tmp_path / "a.mcap")
    assert message == f"Nothing was recorded; {part} holds no sample and can be removed."


@pytest.mark.parametrize("content", [b"", b"\x89MC"])
def test_no_recovery_of_a_file_only_begun(tmp_path, content):
    (tmp_path / "a.mcap.part").write_bytes(content)
    assert "rigd recover" not in remaining_file_text(tmp_path / "a.mcap")


def test_advice_to_copy_a_file_damaged_before_any_sample(original, tmp_path, run):
    path = tmp_path / "a.mcap"
    data = bytearray(original.data)
    data[original.chunk_ends[0] - 1000] ^= 1
    path.write_bytes(data)
    message = run("info", path).stderr
    assert "nothing to recover. Copy it again from where it was recorded.\n" in message
    assert run("recover", path).exit_code == 1


def test_readable_samples_are_the_recoverable_ones(original, torn, run):
    data = bytearray(torn.read_bytes())
    data[data.index(b"profile.toml") + 40] ^= 1  # an attachment, before all samples
    torn.write_bytes(data)
    message = run("info", torn).stderr
    recovered = run("recover", torn)
    assert recovered.exit_code == 0
    (count,) = re.findall(r"; (\d+) complete samples are readable", message)
    assert f": {count} samples recovered" in recovered.stdout


def test_advice_to_move_a_file_that_blocks_recovery(torn, run):
    taken = torn.with_suffix("")
    taken.write_text("somebody else's")
    assert run("recover", torn).exit_code == 1
    message = run("info", torn).stderr
    assert (
        f"`rigd recover {torn}`, once {taken}, which may hold it already, is moved away" in message
    )


@pytest.mark.process
@pytest.mark.parametrize("name", ["a.mcap", "an antenna_1.mcap"])
def test_advised_commands_recover_the_part_of_a_taken_name(torn, tmp_path, run, name):
    folder = tmp_path / "sessions"
    folder.mkdir()
    path = folder / name
    part = folder / f"{name}.part"
    shutil.copy(torn, part)
    assert remaining_file_text(path).endswith(
        f"rigd recover {shlex.quote(str(part))} makes a clean file of it."
    )
    path.write_text("somebody else's")
    message = remaining_file_text(path)
    move, recovery = re.findall(r"after (mv .*) (rigd recover .*) makes a clean file", message)[0]
    assert subprocess.run(shlex.split(move), check=False).returncode == 0
    assert run(*shlex.split(recovery)[1:]).exit_code == 0
    assert path.read_text() == "somebody else's"
    (made,) = set(folder.glob("*.mcap")) - {path}
    assert len(read_session(made).samples) == 1000


def test_paths_may_be_plain_text(original, torn, tmp_path):
    recovery = recover(str(torn))
    path = str(recovery.path)
    assert len(read_session(path).samples) == 1000
    assert read_session(path).path == recovery.path
    assert describe(path).path == recovery.path
    assert len(read_timings(path)) == len(read_timings(recovery.path))
    assert len(read_controls(path)) == len(read_controls(recovery.path))
    writer = SessionWriter(str(tmp_path / "b.mcap"))
    writer.discard()
    with pytest.raises(SessionError, match="No such file"):
        read_session("nowhere.mcap")
