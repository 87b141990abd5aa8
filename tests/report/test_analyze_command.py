"""The command as users and scripts meet it: a process with files, streams and an exit code."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warm_start
from cases import further
from typer.testing import CliRunner

from analysis.cli.app import app

QUICK = ("--method", "welch", "--types", "I", "--weights", "const")


def run(*arguments, cwd):
    return warm_start.run(
        [sys.executable, "-m", "analysis", *map(str, arguments)],
        cwd=cwd, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


def refused(result, code, *words):
    """Check a user's error: its code, its message of one or two sentences, nothing else."""
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    for word in words:
        assert word in result.stderr, result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    assert len(errors) == 1, result.stderr
    return errors[0]


@pytest.fixture(scope="module")
def short_file(make_signals, write_session, tmp_path_factory):
    """Session of 20 s instead of two minutes."""
    signals = make_signals(rest_s=0.5, sweep_s=20.0, ring_down_s=1.0)
    return write_session(tmp_path_factory.mktemp("command") / "a.mcap", signals)


@pytest.fixture
def session(short_file, tmp_path):
    return shutil.copy(short_file, tmp_path / "session.mcap")


@pytest.fixture
def long_session(paper_file, tmp_path):
    return shutil.copy(paper_file, tmp_path / "session.mcap")


@pytest.mark.fit
def test_report_states_the_analysed_part(session, tmp_path, analyze_here, without_drawing):
    with without_drawing():
        result = analyze_here(
            session.name, "--to", "20", "--json", "fits.json", "--segment", "5000"
        )
    content = assert_whole(result, tmp_path)
    part = {"from_s": 0.0, "to_s": 20.0}
    (headline,), (file,), (from_record,) = (
        content[key] for key in ("headlines", "files", "records")
    )
    assert (headline["part"], file["part"]) == (part, part)
    assert from_record["verdict"][0] == "All results are for 0 to 20 s of the session."
    assert result.stdout.startswith(from_record["verdict"][0])
    page = (tmp_path / "session.report" / "report.html").read_text()
    assert "0 to 20 s of the session" in page
    # The sweep is at 48.75 Hz then, and no fit uses frequencies above.
    assert any("48.75" in warning for warning in file["warnings"])
    frequencies_hz = [mode["frequency_hz"]["value"] for mode in headline["modes"]]
    assert frequencies_hz == pytest.approx([2.57, 16.01, 44.83], abs=0.02)


@pytest.mark.process
@pytest.mark.further  # as a shorter one
def test_session_from_end_to_end(long_session, tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "analysis", long_session.name, "--json", "fits.json"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    content = assert_whole(result, tmp_path)
    for picture in (tmp_path / "session.report" / "figures").iterdir():
        assert ET.parse(picture).getroot().findall(".//{*}path")
    assert len(result.stdout.splitlines()) <= 30
    of_paper = [fit for fit in content["fits"] if fit["estimator"] == "welch"]
    best = min(of_paper, key=lambda fit: fit["indices"]["wmse"])
    assert (best["type"], best["weighting"]) == ("VI", "omega")
    # Welch's windows bias the damping by a third; the whole record gives the plant's.
    (from_record,) = content["records"]
    (selected,) = (
        fit for fit in content["fits"] if fit.get("candidate") == from_record["selected"]
    )  # fmt: skip
    for name, true in (("gamma", 5.5e-2), ("lambda", 0.594)):
        assert abs(selected["parameters"][name] - true) < 5 * selected["std"][name]
    assert len([m for m in content["modes"] if m["estimator"] == "record"]) == 3


def assert_whole(result, folder):
    """Check that all is written and printed of a session; return its document."""
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    report = folder / "session.report"
    assert sorted(path.name for path in report.iterdir()) == [
        "SHA256SUMS", "analysis.json", "figures", "report.html", "tables", "tables.txt",
    ]  # fmt: skip
    assert len(list((report / "figures").iterdir())) == 6
    content = json.loads((folder / "fits.json").read_text())
    assert content == json.loads((report / "analysis.json").read_text())
    of_paper = [fit for fit in content["fits"] if fit["estimator"] == "welch"]
    assert len(of_paper) == 12
    lines = result.stdout.splitlines()
    (from_record,) = content["records"]
    assert lines[0] in from_record["verdict"][0]
    modes = [line.split() for line in lines if line[:4].strip().isdigit()]
    assert [float(cells[1]) for cells in modes] == pytest.approx(
        [mode["frequency_hz"] for mode in content["modes"] if mode["estimator"] == "record"],
        rel=1e-4,
    )
    assert lines[-2:] == [
        "All results as JSON: fits.json", "Report of session.mcap: session.report/report.html",
    ]  # fmt: skip
    assert "Resonant peaks" not in result.stdout
    return content


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--from", "3", "--to", "2"), ("--from", "must be less than --to 2 s")),
        (("--from", "-1"), ("--from", "0 or more")),
        (("--to", "nan"), ("--to", "0 or more")),
        (("--to", "9", "other.mcap"), ("--to", "add --each")),
    ],
)
def test_times_without_samples_are_wrong_use(tmp_path, analyze_here, options, words):
    result = analyze_here("session.mcap", *options)
    assert result.returncode == 2
    assert all(word in result.stderr for word in words), result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fit
def test_json_is_alone_on_standard_output(session, tmp_path, analyze_here, without_drawing):
    named = session.rename(tmp_path / "ζ.mcap")
    with without_drawing():
        result = analyze_here(
            named.name, "--json", "-", "--types", "vi,III", "--weights", "omega,omega^-0.5",
            "--frf", "hv", "--band", "1,49", "--report", "out", "--method", "welch",
            "--segment", "5000",
        )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert result.stdout.isascii()  # for any encoding of the stream
    content = json.loads(result.stdout)
    assert content["files"][0]["file"] == "ζ.mcap"
    names = [(fit["type"], fit["weighting"], fit["frf"]) for fit in content["fits"]]
    assert names == [
        (t, w, "hv") for t in ("VI", "III") for w in ("omega", "omega^-0.5")
    ]  # fmt: skip
    assert "Fits to Welch's estimate" in result.stderr
    assert (tmp_path / "out" / "figures" / "welch_signals.svg").exists()


@pytest.mark.fit
@pytest.mark.further  # as in a campaign
def test_one_of_several_files_fails(session, tmp_path, analyze_here):
    shutil.copy(session, tmp_path / "other.mcap")
    before = tmp_path / "session.report"
    before.mkdir()
    (before / "frf.svg").write_text("mine")
    result = analyze_here(
        "session.mcap", "missing.mcap", "other.mcap", "--each", "--json", "all.json", *QUICK
    )
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert "missing.mcap" in result.stderr
    content = json.loads((tmp_path / "all.json").read_text())
    assert [fit["file"] for fit in content["fits"]] == ["session.mcap", "other.mcap"]
    assert [error["file"] for error in content["errors"]] == ["missing.mcap"]
    assert "over 2 files" in result.stdout
    # A report never lands on one that is there.
    assert (before / "frf.svg").read_text() == "mine"
    assert [path.name for path in before.iterdir()] == ["frf.svg"]
    assert (tmp_path / "session.report-2" / "figures" / "welch_frf.svg").stat().st_size > 10_000
    assert (tmp_path / "other.report" / "figures" / "welch_frf.svg").stat().st_size > 10_000


def broken_file(kind, path, good):
    data = good.read_bytes()
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "no container":
        path.write_bytes(b"time,angle\n0,1\n" * 100)
    elif kind == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "magic only":
        path.write_bytes(data[:8])
    elif kind == "foreign":
        from mcap.writer import Writer

        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("x", "jsonschema", b"{}")
            channel = writer.register_channel("/other", "json", schema)
            writer.add_message(channel, 0, b"{}", 0)
            writer.finish()
    elif kind == "a folder":
        path.mkdir()


@pytest.mark.fit
@pytest.mark.parametrize(
    "kind", ["missing", "empty", "no container", "truncated", "magic only", "foreign", "a folder"]
)
def test_non_session_file_is_refused(short_file, tmp_path, analyze_here, kind):
    path = tmp_path / "bad.mcap"
    broken_file(kind, path, short_file)
    before = sorted(tmp_path.iterdir())
    refused(analyze_here("bad.mcap", "--json", "fits.json"), 1, "bad.mcap")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.fit
@pytest.mark.parametrize("folder", [".", "/", ""])
def test_folder_instead_of_a_file_is_refused(tmp_path, analyze_here, folder):
    refused(analyze_here(folder), 1, folder)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fit
def test_too_short_session_is_refused_with_fitting_segments(
    write_session, short_signals, tmp_path, analyze_here
):
    write_session(tmp_path / "a.mcap", short_signals)
    done = analyze_here("a.mcap", "--method", "welch")
    refused(done, 1, "4000 samples", "17266", "--segment 575 --overlap 86")
    # Segments that were chosen are not dropped in silence.
    refused(analyze_here("a.mcap", "--segment", "5000"), 1, "4000 samples", "5000")


@pytest.mark.fit
@pytest.mark.parametrize("field", ["angle_rad", "torque_nm"])
def test_nan_in_the_record_is_refused(write_session, short_signals, tmp_path, analyze_here, field):
    values = getattr(short_signals, field).copy()
    values[77] = np.nan
    write_session(tmp_path / "a.mcap", replace(short_signals, **{field: values}))
    refused(analyze_here("a.mcap"), 1, "a.mcap", field, "tick 77")


@pytest.mark.fit
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--types", "VIII"), ("VIII", "I, II, III, IV, V, VI, VII")),
        (("--types", ","), ("--types", "I, II, III")),
        (("--weights", ","), ("--weights", "no weighting was named; choose from const, omega")),
        (("--weights", "log"), ("log", "const, omega")),
        (("--weights", "omega^nan"), ("omega^nan", "omega^K")),
        (("--weights", "omega^1e308"), ("omega^1e308",)),
        (("--method", "recrod"), ("there is no 'recrod'; choose from welch, record, all.",)),
        (("--method", "record", "b.mcap"), ("--method", "Tables 3 to 5", "add --each")),
        (("--frf", "h3"), ("there is no 'h3'; choose from h1, h2, hv, iv, fft.",)),
        (("--band", "nan,50"), ("--band", "nan,50")),
        (("--band", "50,1"), ("--band", "0 <= F0 < F1")),
        (("--band", "-1,50"), ("--band",)),
        (("--band", "1,inf"), ("--band",)),
        (("--band", "1"), ("--band",)),
        (("--band", "1,2,3"), ("--band",)),
        (("--band", "1,5000"), ("500 Hz",)),
        (("--band", "1,450", "--method", "record"), ("400 Hz", "lower --band")),
        (("--band", "1.0001,1.0002"), ("1.0001",)),
        (("--segment", "0"), ("--segment",)),
        (("--segment", "1e3"), ("--segment",)),
        (("--overlap", "-1"), ("--overlap",)),
        (("--segment", "100", "--overlap", "100"), ("--overlap", "100")),
        (("--overlap", "20000"), ("--overlap", "17266")),
        (("--nfft", "999999999999"), ("--nfft",)),
        (("--segment", "1000", "--nfft", "999"), ("--nfft", "1000")),
        (("--nfft", "100"), ("--nfft", "17266")),
        (("--colour", "blue"), ("--colour",)),
        (("--paper",), ("--paper", "only for campaigns")),
        (("--jobs", "2"), ("--jobs", "only for campaigns")),
        (("--dask", "tcp://x:1", "--paper"), ("--paper and --dask", "only for campaigns")),
        (("b.mcap", "--each", "--jobs", "2"), ("--jobs", "--each", "omit one of the two")),
        (("b.mcap", "--dask", "tcp://x:1", "--jobs", "2"), ("--jobs", "those of --dask")),
        (("--method", "welch", "--fix", "delay_s"), ("--fix", "--method all")),
        (("--method", "welch", "--uniformity", "0"), ("--uniformity", "--method all")),
        (("--uniformity", "-1"), ("--uniformity", "-1 % must lie between 0 and 10 %")),
        (("--uniformity", "nan"), ("--uniformity", "nan % must lie between 0 and 10 %")),
    ],
)
def test_wrong_options_are_refused(session, tmp_path, analyze_here, options, words):
    before = sorted(tmp_path.iterdir())
    refused(analyze_here(session, *options), 2, *words)
    assert sorted(tmp_path.iterdir()) == before


def test_band_far_beyond_the_excitation_is_refused(session, tmp_path, analyze_here):
    before = sorted(tmp_path.iterdir())
    result = analyze_here(session, "--band", "0,120", "--method", "record")
    refused(result, 1, "reaches 120 Hz", "covers 0.05 to 50 Hz", "--band that ends at 50 Hz")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.process
def test_no_file_is_wrong_use(tmp_path):
    refused(run(cwd=tmp_path), 2, "FILE")


@pytest.mark.fit
def test_existing_files_are_not_overwritten(session, tmp_path, analyze_here):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "frf.svg").write_text("mine")
    (tmp_path / "fits.json").write_text("mine")
    refused(analyze_here(session.name, "--report", "out"), 2, "--report out")
    refused(analyze_here(session.name, "--json", "fits.json"), 2, "--json fits.json")
    assert (tmp_path / "out" / "frf.svg").read_text() == "mine"
    assert (tmp_path / "fits.json").read_text() == "mine"
    assert not (tmp_path / "session.report").exists()


@pytest.mark.fit
def test_unwritable_report_is_refused(session, tmp_path, analyze_here):
    (tmp_path / "file").write_text("")
    refused(analyze_here(session.name, *QUICK, "--report", "file/out"), 1, "file/out")


@pytest.mark.process
def test_ctrl_c_ends_with_130_without_partial_files(session, tmp_path):
    process = warm_start.start(
        [sys.executable, "-m", "analysis", *([session.name] * 60),
         "--each", *QUICK, "--report", "out"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    out = tmp_path / "out"
    deadline = time.monotonic() + 300
    while not (out.exists() and any(out.iterdir())):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=300)
    assert (process.returncode, stdout, stderr) == (130, "", "Stopped.\n")
    for folder in out.iterdir():
        assert not folder.name.startswith("."), "a half-written report was left"
        assert len(list(folder.iterdir())) == 6


STOPPED = (
    "import analysis.cli.app\n"
    "def stopped(*_):\n"
    "{body}\n"
    "analysis.cli.app.session_command = stopped\n"
    "analysis.cli.app.main()\n"
)
CTRL_C = "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep({})"


def run_as_is(module, cwd):
    result = subprocess.run(
        [sys.executable, "-m", module, "session.mcap"],
        cwd=cwd, check=False, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    return result.returncode, result.stdout, result.stderr


@pytest.mark.process
@pytest.mark.parametrize(
    "body",
    [
        further(f"    exec('{CTRL_C.format(30)}')", id="code made from text"),
        # Exceptions in destructors are dropped.
        pytest.param(
            "    class Ending:\n"
            f"        def __del__(self): {CTRL_C.format(0)}\n"
            "    Ending()\n"
            "    time.sleep(30)",
            id="an object that ends",
        ),
    ],
)
def test_ctrl_c_inside_the_interpreter_ends_with_130(tmp_path, body):
    (tmp_path / "stopped.py").write_text("import time\n" + STOPPED.format(body=body))
    assert run_as_is("stopped", tmp_path) == (130, "", "Stopped.\n")


@pytest.mark.process
def test_ctrl_c_during_import_ends_with_130(tmp_path):
    (tmp_path / "typer.py").write_text(CTRL_C.format(30))
    assert run_as_is("analysis", tmp_path) == (130, "", "")


@pytest.mark.process
def test_ctrl_c_while_parsing_options_ends_with_130(tmp_path):
    (tmp_path / "early.py").write_text(
        "import analysis.cli.app\n"
        f"def app(): {CTRL_C.format(30)}\n"
        "analysis.cli.app.app = app\n"
        "analysis.cli.app.main()\n"
    )
    assert run_as_is("early", tmp_path) == (130, "", "")


def test_folder_means_its_sessions(tmp_path, monkeypatch):
    analysed = []
    monkeypatch.setattr(
        "analysis.cli.app.session_command", lambda files, *_: analysed.append(files)
    )
    monkeypatch.setattr(
        "analysis.cli.campaign.campaign_command",
        lambda files, *_, **__: analysed.append(files) or 0,
    )
    folder = tmp_path / "sessions"
    folder.mkdir()
    (folder / "torn.mcap.part").touch()
    refused = CliRunner().invoke(app, [str(folder)])
    assert refused.exit_code == 1
    assert f"{folder}: there is no session" in refused.stderr
    (folder / "elsewhere.mcap").symlink_to("unmounted/elsewhere.mcap")
    assert CliRunner().invoke(app, [str(folder)]).exit_code == 0
    assert analysed.pop() == [folder / "elsewhere.mcap"]  # its reader names what is wrong
    (folder / "elsewhere.mcap").unlink()
    assert "rigd recover" in refused.stderr
    for name in ("b.mcap", "a.mcap"):
        (folder / name).touch()
        CliRunner().invoke(app, [str(folder)])
    CliRunner().invoke(app, ["first.mcap", str(folder), "--each"])
    of_folder = [folder / "a.mcap", folder / "b.mcap"]
    assert analysed == [of_folder[1:], of_folder, [Path("first.mcap"), *of_folder]]


def test_newest_session_of_a_folder_on_request(record_briefly, tmp_path, monkeypatch):
    analysed = []
    monkeypatch.setattr(
        "analysis.cli.app.session_command", lambda files, *_: analysed.append(files)
    )
    monkeypatch.chdir(tmp_path)
    nothing = CliRunner().invoke(app, ["--latest"])
    assert nothing.exit_code == 1
    assert nothing.stderr.startswith("Error: --latest: there is no folder sessions; record a")
    for name, day in (("zulu", 1), ("alpha", 3), ("mike", 2)):
        record_briefly(name, day=day)
    CliRunner().invoke(app, ["--latest", "."])
    assert analysed == [[Path("alpha.mcap")]]
    two = CliRunner().invoke(app, ["--latest", ".", "sessions"])
    assert two.exit_code == 2
    assert "it takes one folder, and 2 were given" in two.stderr


def test_usage_without_a_file():
    refused = CliRunner().invoke(app, [])
    assert refused.exit_code == 2
    assert "Error: Missing argument 'FILE'. Name session files, or take --latest." in refused.stderr


def test_a_campaign_is_announced_before_it_starts(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(
        "analysis.cli.campaign.campaign_command", lambda files, *_, **__: started.append(files) or 0
    )
    result = CliRunner().invoke(app, ["a.mcap", "b.mcap"])
    assert result.exit_code == 0
    assert len(started) == 1
    assert result.stderr == (
        "2 sessions are analysed together, as a campaign; --each reports each by itself.\n"
    )


def test_shell_completion_can_be_installed():
    environment = {
        "_ANALYZE_COMPLETE": "source_bash"
    }  # as the option does, for a shell that it finds
    shown = CliRunner().invoke(app, [], prog_name="analyze", env=environment)
    assert shown.exit_code == 0
    assert "_ANALYZE_COMPLETE=complete_bash" in shown.stdout
    words = {"_ANALYZE_COMPLETE": "complete_bash", "COMP_WORDS": "analyze --la", "COMP_CWORD": "1"}
    completed = CliRunner().invoke(app, [], prog_name="analyze", env=words)
    assert completed.stdout.split() == ["--latest"]


@pytest.mark.fit
@pytest.mark.further  # as test_folder.py
def test_second_analysis_replaces_only_the_first(session, tmp_path, analyze_here):
    command = (session.name, "--json", "fits.json", "--report", "out", "--overwrite")
    assert analyze_here(*command, *QUICK).returncode == 0
    (tmp_path / "out" / "notes.txt").write_text("mine")
    quick = (*QUICK, "--types", "II")
    assert analyze_here(*command, *quick).returncode == 0
    for path in ("fits.json", "out/analysis.json"):
        (fit,) = json.loads((tmp_path / path).read_text())["fits"]
        assert fit["type"] == "II"
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
    # Without a name it is the report next to the file, under the same name again.
    for _ in range(2):
        assert analyze_here(session.name, "--overwrite", *quick).returncode == 0
    assert [path.name for path in tmp_path.glob("session.report*")] == ["session.report"]
    (tmp_path / "fits.json").write_text('{"mine": 1}')
    refused(analyze_here(*command, *quick), 2, "fits.json", "does not hold results")


@pytest.mark.process
def test_help_has_an_example_and_the_choices(tmp_path):
    result = run("--help", cwd=tmp_path)
    assert result.returncode == 0
    for word in ("Example: analyze session.mcap", "--types", "h2", "Exit code"):
        assert word in result.stdout


@pytest.mark.process
def test_help_and_wrong_options_import_nothing_heavy(tmp_path):
    code = (
        "import sys, analysis.cli.app; "
        "print([m for m in ('numpy', 'scipy', 'matplotlib', 'rich', 'mcap') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("files", [["a.mcap"], ["a.mcap", "b.mcap"]])
def test_options_of_one_record_hold_in_a_campaign(monkeypatch, files):
    fixed, formats, uniformity = [], [], []

    def run(_files, options, *_):
        fixed.append(options.fixed_parameters)
        formats.append(options.figures)
        uniformity.append(options.uniformity)
        return 0

    def campaign(*_, **options):
        fixed.append(options["fixed"])
        formats.append(options["formats"])
        uniformity.append(options["uniformity"])
        return 0

    monkeypatch.setattr("analysis.cli.app.session_command", run)
    monkeypatch.setattr("analysis.cli.campaign.campaign_command", campaign)
    result = CliRunner().invoke(app, [*files, "--fix", "tool_inertia_kg_m2, delay_s"])
    assert result.exit_code == 0, result.output
    assert fixed == [("delay_s", "tool_inertia_kg_m2")]
    assert formats == [("svg",)]
    result = CliRunner().invoke(app, [*files, "--figures", "pdf, png"])
    assert formats[1:] == [("png", "pdf")], result.output
    result = CliRunner().invoke(app, [*files, "--uniformity", "0.3"])
    assert uniformity == [None, None, pytest.approx(3e-3)], result.output
    for wrong in ("tiff", ","):
        result = CliRunner().invoke(app, [*files, "--figures", wrong])
        assert result.exit_code == 2
        assert "choose from png, svg, pdf" in result.output
    result = CliRunner().invoke(app, [*files, "--fix", "inertia"])
    assert result.exit_code == 2
    assert "there is no inertia; choose from density_over_stiffness" in result.output
