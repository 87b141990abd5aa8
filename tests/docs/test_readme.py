"""The how-tos of the README run as written."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
README = (PROJECT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


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


def test_its_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)]+)\)", README):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        assert (PROJECT / name).exists(), target
        if anchor:
            text = (PROJECT / name).read_text(encoding="utf-8") if name else README
            titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
            anchors = [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]
            assert anchor in anchors, target
