"""README, how-tos and tutorials run as written."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from eds_files import eds_path

from analysis import load

PROJECT = Path(__file__).parents[2]
TUTORIALS = PROJECT / "docs" / "tutorials"
HOW_TOS = [
    PROJECT / "docs" / f"{name}.md"
    for name in ("run_sessions", "check_a_rig", "daemon", "session_files", "analyse", "profiles")
]
"""Pages whose commands make one story, in this order."""


def blocks(language, paths=HOW_TOS):
    """Blocks of code in a language, in the order of the pages."""
    text = "\n".join(path.read_text("utf-8") for path in paths)
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def assert_went_well(process):
    output, errors = process.communicate()
    assert process.returncode == 0, output + errors
    assert "Traceback" not in errors


def tear(session, torn):
    """Leave what a recorder leaves that dies: a session file without its end."""
    torn.parent.mkdir(parents=True)
    torn.write_bytes(session.read_bytes()[:-2000])


def of_one_session(shell):
    """Whether a how-to has to do with the sessions that the first of them began to make."""
    return not re.search(r"--output (?!sessions\b)|^rigd check", shell)


SHORTENED = """#!/bin/sh
case "${0##*/} $*" in
    "analyze export "*|"analyze import "*) ;;
    "rigd run chirp --profile sim --fast "*) set -- "$@" --duration 30 --ring-down 3 ;;
    "rigd run chirp --fast --output sessions "*) set -- "$@" --duration 30 --ring-down 3 ;;
    "rigd run multisine "*) set -- "$@" --period 2 --duration 6 ;;
    "rigd run modes "*) set -- "$@" --duration 20 --ring-down 3 ;;
    "analyze "*"-chirp.mcap") set -- "$@" --types VI --weights omega --figures png ;;
    "analyze "*) set -- "$@" --types VI --figures png ;;
esac
exec "FOLDER/${0##*/}" "$@"
"""
"""Stands before both programs: the same commands, but for sessions of minutes and a second time
that everything is fitted."""


# That the programs understand all commands is in test_documents.py.
@pytest.fixture(
    params=[
        pytest.param("short sessions", marks=pytest.mark.further),
        pytest.param("as it stands", marks=pytest.mark.slow),
    ]
)
def start(request, tmp_path, runtime_folder):
    """Start a command in the folder of an operator."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    if request.param == "short sessions":
        for program in ("rigd", "analyze"):
            instead = tmp_path / "bin" / program
            instead.parent.mkdir(exist_ok=True)
            instead.write_text(SHORTENED.replace("FOLDER", str(Path(sys.executable).parent)))
            instead.chmod(0o700)
        path = f"{instead.parent}{os.pathsep}{path}"
    own = {"XDG_RUNTIME_DIR": str(runtime_folder), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    environment = os.environ | own | {"PATH": path}

    def start(*command, folder=tmp_path):
        return subprocess.Popen(
            command,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )

    return start


def script_of(shells):
    # Job control, as on a terminal: the simulated rig of one how-to is ended by its job's number.
    # What a how-to that failed has left in the background ends with it.
    trap = "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT"
    return "\n".join(("set -em", trap, *shells))


@pytest.mark.process
@pytest.mark.timeout(900)
def test_every_how_to_from_a_session_to_what_becomes_of_it_runs_as_written(start, tmp_path):
    shells, python = list(filter(of_one_session, blocks("sh"))), blocks("python")
    assert len(shells) >= 6
    assert len(python) == 1
    (recover,) = (shell for shell in shells if "rigd recover" in shell)
    shells.remove(recover)
    for command in (("bash", "-c", script_of(shells)), (sys.executable, "-c", python[0])):
        with start(*command) as process:
            assert_went_well(process)
    assert len(list((tmp_path / "sessions").glob("*.mcap"))) == 8
    for report in ("one_look", "another_look"):
        assert (tmp_path / report / "figures" / "welch_frf.png").stat().st_size > 50_000

    (hold,) = (tmp_path / "sessions").glob("*-hold.mcap")
    tear(hold, tmp_path / "torn" / re.search(r"rigd recover (\S+)", recover)[1])
    with start("bash", "-c", recover, folder=tmp_path / "torn") as process:
        assert_went_well(process)


@pytest.mark.process
@pytest.mark.timeout(900)
def test_every_other_how_to_runs_as_written(start, write_profile, tmp_path):
    shells = [shell for shell in blocks("sh") if not of_one_session(shell)]
    assert len(shells) >= 6
    # The one in real time waits most of its time: beside the others, as a separate rig, and one
    # that bears a machine that stands still.
    (live,) = (shell for shell in shells if "--live" in shell)
    shells.remove(live)
    patient = write_profile("sim", {"name": '"patient"'}, patient=True)
    live = live.replace("--live", f"--live --profile {patient}")
    with start("bash", "-c", live) as beside:
        with start("bash", "-c", script_of(shells)) as process:
            assert_went_well(process)
        assert_went_well(beside)
    assert len(list((tmp_path / "tryouts").glob("*.mcap"))) == 3


@pytest.mark.process
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("page", "made"),
    [
        ("README.md", ["sessions/*-chirp.report/report.html"]),
        ("docs/tutorials/first_session.md", ["first/report.html", "second/report.html"]),
        ("docs/tutorials/own_beam.md", ["mine/report.html", "frf.mat", "model.mat"]),
        ("docs/tutorials/own_rig.md", ["first/*-chirp.mcap"]),
        ("docs/tutorials/campaign.md", ["campaign/*-chirp-*.mcap", "together/report.html"]),
    ],
)
def test_what_a_beginner_does_runs_as_written(page, made, start, tmp_path):
    shutil.copy(TUTORIALS / "antenna.mcap", tmp_path)
    shutil.copy(eds_path("epos4_0170"), tmp_path / "drive.eds")
    for number, content in enumerate(blocks("toml", [PROJECT / page])):
        assert number == 0, "a page has one file to write"
        (tmp_path / "beam.toml").write_text(content)
    with start("bash", "-c", script_of(blocks("sh", [PROJECT / page]))) as process:
        assert_went_well(process)
    for pattern in made:
        assert list(tmp_path.glob(pattern)), pattern


def test_each_tutorial_is_run():
    pages = {path.stem for path in TUTORIALS.glob("*.md")} - {"index"}
    assert pages == set(re.findall(r"tutorials/(\w+)\.md", Path(__file__).read_text("utf-8")))


def test_the_record_of_the_tutorials_is_small_and_whole():
    path = TUTORIALS / "antenna.mcap"
    assert path.stat().st_size < 3_000_000
    record = load(path)
    assert len(record.time_s) == 136_000
    assert record.outcome == "complete"
    assert not record.warnings


def test_the_readme_is_short():
    text = (PROJECT / "README.md").read_text("utf-8")
    assert 600 <= len(text.split()) <= 800
    assert text.index("wired STO") < text.index("rigd run chirp")
