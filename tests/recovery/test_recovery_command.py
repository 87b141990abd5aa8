"""`rigd recover`, and the messages of `rigd info` and `analyze` on the files."""

import json
import os

import pytest
from typer.testing import CliRunner

from analysis.cli.app import app as analyze
from rigd.cli.app import app as rigd
from rigd.session import read_session


@pytest.fixture
def run():
    def run(app, *arguments):
        return CliRunner().invoke(app, [str(argument) for argument in arguments])

    return run


def test_several_files_and_one_unrecoverable(run, torn, tmp_path):
    result = run(rigd, "recover", tmp_path / "nothing.mcap.part", torn)
    assert result.exit_code == 1
    assert "nothing.mcap.part cannot be read: No such file" in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout.startswith(f"{tmp_path / 'a.mcap'}: 1000 samples recovered from {torn}")
    assert len(read_session(tmp_path / "a.mcap").samples) == 1000


def test_output_is_one_document(run, torn, tmp_path):
    result = run(rigd, "recover", torn, torn, "--json")
    assert result.exit_code == 1
    first, second = json.loads(result.stdout)["files"]
    assert first["path"] == str(tmp_path / "a.mcap")
    assert (first["samples"], first["bytes_lost"]) == (1000, 300)
    assert first["outcome"]["outcome"] == "fault"
    assert second == {
        "source": str(torn),
        "path": None,
        "error": f"{tmp_path / 'a.mcap'} exists and is not overwritten. "
        f"Move it away to recover {torn} again.",
    }


def test_paths_other_than_files_are_refused(run, tmp_path):
    pipe = tmp_path / "pipe.mcap.part"
    os.mkfifo(pipe)
    for path in ("/", ".", tmp_path, pipe):
        result = run(rigd, "recover", path)
        assert result.exit_code == 1
        assert "is not a file" in result.stderr
        assert result.exception is None or isinstance(result.exception, SystemExit)


def test_wrong_use_without_a_file(run):
    assert run(rigd, "recover").exit_code == 2


def test_info_and_analyze_offer_the_recovery(run, torn):
    for app, arguments in ((rigd, ("info", torn)), (analyze, (torn,))):
        result = run(app, *arguments)
        assert result.exit_code == 1
        assert "is incomplete: it ends in the middle of a record" in result.stderr
        assert f"Save them with `rigd recover {torn}`" in result.stderr
        assert "Traceback" not in result.output


def test_a_damaged_file_is_offered_a_copy_or_the_recovery(run, original, tmp_path):
    path = tmp_path / "a b.mcap"
    data = bytearray(original.data)
    data[original.chunk_ends[2] + 20_000] ^= 1
    path.write_bytes(data)
    result = run(analyze, path)
    assert result.exit_code == 1
    assert f"save what is intact with `rigd recover '{path}'`" in result.stderr
    assert run(rigd, "recover", path).exit_code == 0
    assert len(read_session(tmp_path / "a b.recovered.mcap").samples) == 750


def test_a_long_recovery_shows_its_progress(run, torn, monkeypatch):
    monkeypatch.setattr("rigd.cli.options._PROGRESS_DELAY_S", -1.0)
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes that for a terminal
    result = run(rigd, "recover", torn)
    assert result.exit_code == 0
    assert torn.name in result.stderr
    assert "━" in result.stderr
    assert torn.name not in result.stdout.replace(str(torn), "")
