"""`analyze import` and `analyze export` next to `analyze FILE`: options, messages, exit codes."""

import subprocess
import sys

import numpy as np
import pytest

from rigd.session import read_session

N = 3000


@pytest.fixture
def source(csv_of):
    return csv_of(
        t=np.arange(N) / 1000,
        q=np.sin(np.arange(N) / 50),
        T=np.random.default_rng(0).normal(size=N),
    )


@pytest.fixture
def arguments(source, profile, tmp_path):
    return ["import", source, tmp_path / "a.mcap", "--profile", profile]


MAPPING = ("--angle", "q:deg", "--torque", "T:N.mm", "--time", "t:s")


def test_import_reports_its_session(analyze, arguments, tmp_path):
    result = analyze(
        *arguments,
        *MAPPING,
        "--sweep",
        "0.5,2.5",
        "--note",
        "first",
        "--specimen",
        "A",
        "--operator",
        "Eve",
    )
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    assert "3000 samples at 1000 Hz" in result.stdout
    assert "whole record" not in result.stdout
    session = read_session(tmp_path / "a.mcap")
    assert session.segments == {"sweep": (500, 2500)}
    assert [session.metadata[key] for key in ("note", "specimen", "operator")] == [
        "first", "A", "Eve",
    ]  # fmt: skip
    again = analyze(*arguments, *MAPPING)
    assert again.exit_code == 2
    assert "exists" in again.stderr
    assert "nothing is overwritten" in again.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--angle", "q:deg"), ("--torque",)),
        (("--angle", "q:deg", "--torque", "T:N.mm"), ("--time", "--rate-hz")),
        ((*MAPPING, "--rate-hz", "1000"), ("--time", "--rate-hz")),
        ((*MAPPING, "--angle", "q"), ("--angle", "CHANNEL:UNIT", "never guessed")),
        ((*MAPPING, "--tz", "T:nm"), ("--tz", "'nm'", "N.m, mN.m")),
        ((*MAPPING, "--sweep", "3"), ("--sweep", "1,121")),
        ((*MAPPING, "--rest", "2,1"), ("--rest",)),
        ((*MAPPING, "--ring-down", "0,inf"), ("--ring-down",)),
        ((*MAPPING, "--torque-delay-s", "nan"), ("--torque-delay-s",)),
        ((*MAPPING, "--angle-delay-s", "5"), ("--angle-delay-s",)),
    ],
)
def test_wrong_use_is_explained_without_output(analyze, arguments, tmp_path, options, words):
    result = analyze(*arguments, *options)
    assert result.exit_code == 2, result.output
    for word in words:
        assert word in result.stderr
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((*MAPPING, "--angle", "angle:deg"), ("record.csv", "no channel 'angle'", "'q'")),
        ((*MAPPING, "--sweep", "0,5"), ("record.csv", "which lasts 3 s")),
        ((*MAPPING, "--profile", "absent.toml"), ("absent.toml", "cannot be read")),
    ],
)
def test_unusable_file_is_explained(analyze, arguments, tmp_path, options, words):
    result = analyze(*arguments, *options)
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.startswith("Error: ")
    for word in words:
        assert word in result.stderr
    assert not list(tmp_path.glob("*.mcap*"))


def test_wrong_time_unit_is_refused_by_the_beam(analyze, csv_of, arguments):
    csv_of(t=1.0 * np.arange(N), q=np.sin(np.arange(N) / 50), T=np.cos(np.arange(N) / 9))
    result = analyze(*arguments, *MAPPING)
    assert result.exit_code == 1
    for words in (
        "the record lasts 3000 s at 1 Hz", "2.55 Hz, beyond the Nyquist frequency of 0.5 Hz",
        "state the unit of 't', which was taken to be s, with --time t:UNIT",
    ):  # fmt: skip
        assert words in result.stderr
    assert analyze(*arguments, *MAPPING, "--time", "t:ms").exit_code == 0


def test_record_shorter_than_a_period_has_a_warning(analyze, arguments):
    result = analyze(*arguments, *MAPPING, "--time", "t:ms")
    assert result.exit_code == 0
    assert "lasts 0.003 s at 1e+06 Hz, less than one period of the first mode" in result.stderr


def test_session_needs_its_suffix(analyze, source, profile, tmp_path):
    result = analyze("import", source, tmp_path / "a.csv", "--profile", profile, *MAPPING)
    assert result.exit_code == 2
    assert ".mcap" in result.stderr


def test_warnings_are_printed_on_standard_error(analyze, source, arguments):
    source.write_text(source.read_text().replace("t,q,T", "t,q_rad,T"))
    result = analyze(*arguments, *MAPPING, "--angle", "q_rad:deg")
    assert result.exit_code == 0
    assert result.stderr.startswith("Warning: The name 'q_rad'")
    assert "the whole record counts as the sweep" in result.stdout


@pytest.fixture
def session(analyze, arguments, tmp_path):
    assert analyze(*arguments, *MAPPING).exit_code == 0
    return tmp_path / "a.mcap"


@pytest.mark.parametrize(
    ("out", "options", "code", "words"),
    [
        ("a.xlsx", (), 2, ("a.xlsx", ".csv, .mat, .uff")),
        ("a.csv", ("--binary",), 2, ("--binary", ".uff")),
        ("record.csv", (), 2, ("record.csv exists", "nothing is overwritten")),
        ("absent/a.csv", (), 1, ("absent/a.csv cannot be written",)),
    ],
)
def test_impossible_export_is_explained(analyze, session, tmp_path, out, options, code, words):
    before = sorted(tmp_path.iterdir())
    for what in ("record", "frf"):
        own = () if what == "record" else ("--segment", "1000")
        result = analyze("export", what, session, tmp_path / out, *options, *own)
        assert result.exit_code == code, result.output
        for word in words:
            assert word in result.stderr
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (("--from", "nan"), "--from nan s must be a time since the session's start"),
        (("--from", "7", "--to", "5"), "from 7 to 5 s is empty; --from must be less than --to.\n"),
    ],
)
def test_a_part_without_time_is_refused(analyze, session, tmp_path, limits, words):
    result = analyze("export", "record", session, tmp_path / "a.csv", *limits)
    assert result.exit_code == 1
    assert words in result.stderr


def test_messages_of_the_analysis_are_those_of_an_export(analyze, session, tmp_path):
    result = analyze("export", "frf", session, tmp_path / "f.csv")
    assert result.exit_code == 1
    assert "fewer than one Welch segment" in result.stderr
    result = analyze("export", "frf", session, tmp_path / "f.csv", "--band", "1")
    assert result.exit_code == 2
    assert "--band" in result.stderr
    result = analyze("export", "record", tmp_path / "absent.mcap", tmp_path / "r.csv")
    assert result.exit_code == 1
    assert "absent.mcap cannot be read" in result.stderr
    assert not list(tmp_path.glob("[fr].csv"))


def test_full_disk_leaves_no_partial_file(analyze, session, tmp_path, monkeypatch):
    def full(_table, stream):
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("analysis.exchange._csv_format.write_csv", full)
    result = analyze("export", "record", session, tmp_path / "r.csv")
    assert result.exit_code == 1
    assert "r.csv cannot be written: No space left on device" in result.stderr
    assert not (tmp_path / "r.csv").exists()


def test_analysis_works_with_its_subcommands(analyze):
    text = analyze("--help").stdout
    assert "[OPTIONS] [FILE]..." in text  # optional, because of --latest
    commands = text[text.index("Commands:") :]
    for name in ("import", "export record", "export frf"):
        assert f"\n  {name} " in commands
    assert analyze().exit_code == 2
    assert "FILE" in analyze().stderr
    for name in ("import", "export", "default"):
        result = analyze(f"./{name}")
        assert (result.exit_code, "cannot be read" in result.stderr) == (1, True)
    assert "default cannot be read" in analyze("default").stderr
    assert analyze("--types", "I", "import").exit_code == 1  # a file of that name, not the command


@pytest.mark.process
def test_the_commands_load_no_library_before_they_run(analyze):
    code = (
        "import sys, analysis.cli.app; "
        "print(sorted({'numpy', 'scipy', 'matplotlib', 'nptdms', 'pyuff'} & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout == "[]\n"
