"""README, how-tos and tutorials run as written."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from eds_files import eds_path
from scipy.io import loadmat

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
    """Leave a session file without its end, as a killed recorder does."""
    torn.parent.mkdir(parents=True)
    torn.write_bytes(session.read_bytes()[:-2000])


def of_one_session(shell):
    """Whether a how-to has to do with the sessions that the first of them began to make."""
    return not re.search(r"--output (?!sessions\b)|^rigd check", shell)


SHORTENED = """#!/bin/sh
case "${0##*/} $*" in
    "analyze export "*|"analyze import "*|"analyze touch "*) ;;
    "rigd run chirp --profile sim --fast "*) set -- "$@" --duration 30 --ring-down 3 ;;
    "rigd run chirp --fast --output sessions "*) set -- "$@" --duration 30 --ring-down 3 ;;
    "rigd run chirp --repeat 20 "*) set -- "$@" --fast --duration 30 --ring-down 3 --repeat 2 ;;
    "rigd run chirp --amplitude "*) set -- "$@" --fast --duration 30 --ring-down 3 ;;
    "rigd run chirp"|"rigd run chirp --there-and-back "*|"rigd run chirp --watch-fit")
        set -- "$@" --fast --duration 30 --ring-down 3 ;;
    "rigd run multisine "*" --output long") set -- "$@" --period 2 --duration 24 ;;
    "rigd run multisine "*) set -- "$@" --period 2 --duration 6 ;;
    "rigd run modes "*) set -- "$@" --fast --duration 20 --ring-down 3 ;;
    "rigd run move "*|"rigd run touch "*|"rigd run until "*) set -- "$@" --fast ;;
    "analyze "*"-chirp.mcap") set -- "$@" --types VI --weights omega ;;
    "analyze long/"*) set -- "$@" --types VI --block 6 ;;
    "analyze "*) set -- "$@" --types VI ;;
esac
exec "FOLDER/${0##*/}" "$@"
"""
"""Wraps both programs: the same commands, except for sessions of minutes, real time, and a
second time that everything is fitted."""

OTHER_PAGES = {
    "campaigns": [
        "sessions/campaign.report/report.html", "both_ways/campaign.report/report.html"
    ],
    "touch": ["sessions/*-touch.mcap", "model.json", "touches/report.html"],
    "moves": ["sessions/*-move.mcap"],
    "simulated_obstacles": ["tryouts/*-step.mcap"],
    "better_experiments": ["sessions/*-modes.mcap"],
    "until": ["sessions/*-until.mcap"],
    "export_to_matlab": ["frf.mat"],
}  # fmt: skip
"""How-tos that run in a folder of their own, with files that they make."""

RUN_ELSEWHERE = {
    "exchange": "exchange/test_exchange_document.py",
    "python_api": "api/test_api.py",
    "opening_sessions": "docs/test_layouts.py",
    "library": "library/test_library_document.py",
    "your_own_device": "added/test_new_package.py",
    "your_own_controller": "added/test_new_package.py",
}
"""How-tos with a test of their own."""

NOT_RUN = {
    "python3 -m venv env": "installs from the package index; .ci/release installs what is built",
    "rigd plugins new mysensor": "installs a package; added/test_new_package.py does the same",
    "python -m pytest rigd-mysensor/tests": "added/test_new_package.py",
    "rigd plugins new mylaw --kind controller":
        "installs a package; added/test_new_package.py does the same",
    "rigd check --profile lab": "on the bench",
    "analyze SESSION.mcap --to 121": "a part of a record; report/test_analyze_command.py",
    "rigd bench": "three minutes; bench",
    "rigd bench --seconds 10": "three minutes; bench",
    "rigd serve --profile sim --web --output sessions": "packaging/test_automation.py, web",
    "ssh -L 8720:127.0.0.1:8720 rig-computer": "needs another computer",
    "ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 rig-computer": "needs another computer",
    "rigd run chirp --live          # in one terminal": "needs a screen; live, cli",
    "sudo useradd --system --gid rigd --groups dialout rigd": "changes the computer",
    "python tests/endurance/run_starved.py --minutes 10 --busy 4    "
    "# with programs that use all processor time": "make endurance",
    "python -m analysis.quick_look sessions/20261122-184457-chirp-02.mcap [--last EARLIER.mcap]":
        "every session of the other pages makes one; report",
    "pip install 'rigd[dask]'": "needs other computers; campaigns",
    "$ rigd run until --alpha 0.002": "is refused; cli/test_until.py",
}  # fmt: skip
"""First lines of the blocks ``console`` in tutorials and how-tos, with the reason or the test that
shows the same."""


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
    # Background processes of a failed how-to end with it.
    trap = "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT"
    return "\n".join(("set -em", trap, *shells))


@pytest.mark.process
@pytest.mark.timeout(900)
def test_every_how_to_on_sessions_runs_as_written(start, tmp_path):
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
        assert (tmp_path / report / "figures" / "welch_frf.svg").stat().st_size > 50_000

    (hold,) = (tmp_path / "sessions").glob("*-hold.mcap")
    tear(hold, tmp_path / "torn" / re.search(r"rigd recover (\S+)", recover)[1])
    with start("bash", "-c", recover, folder=tmp_path / "torn") as process:
        assert_went_well(process)


@pytest.mark.process
@pytest.mark.timeout(900)
def test_every_other_how_to_runs_as_written(start, write_profile, tmp_path):
    shells = [shell for shell in blocks("sh") if not of_one_session(shell)]
    assert len(shells) >= 6
    # The one in real time waits most of its time: it runs with the others, as a separate rig, and
    # tolerates a standstill of the machine.
    (live,) = (shell for shell in shells if "--live" in shell)
    shells.remove(live)
    patient = write_profile("sim", {"name": '"patient"'}, patient=True)
    live = live.replace("--live", f"--live --profile {patient}")
    with start("bash", "-c", live) as live_view:
        with start("bash", "-c", script_of(shells)) as process:
            assert_went_well(process)
        assert_went_well(live_view)
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
def test_steps_of_a_beginner_run_as_written(page, made, start, tmp_path):
    shutil.copy(TUTORIALS / "antenna.mcap", tmp_path)
    shutil.copy(eds_path("epos4_0170"), tmp_path / "drive.eds")
    for number, content in enumerate(blocks("toml", [PROJECT / page])):
        assert number == 0, "a page has one file to write"
        (tmp_path / "beam.toml").write_text(content)
    with start("bash", "-c", script_of(blocks("sh", [PROJECT / page]))) as process:
        assert_went_well(process)
    for pattern in made:
        assert list(tmp_path.glob(pattern)), pattern


@pytest.mark.process
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "start", [pytest.param("short sessions", marks=pytest.mark.further)], indirect=True
)
@pytest.mark.parametrize("page", OTHER_PAGES)
def test_single_how_to_runs_as_written(page, start, tmp_path):
    shutil.copy(TUTORIALS / "antenna.mcap", tmp_path)
    paths = [PROJECT / "docs" / f"{page}.md"]
    shells = blocks("sh", paths)
    if page in ("touch", "moves"):  # a session and its analysis, which the reader has
        shutil.copy(TUTORIALS / "antenna.mcap", tmp_path / "session.mcap")
    if page == "moves":
        shells.insert(0, "analyze session.mcap --json model.json")
    commands = [("bash", "-c", script_of(shells))]
    commands += [(sys.executable, "-c", code) for code in blocks("python", paths)]
    for command in commands:
        with start(*command) as process:
            assert_went_well(process)
    for pattern in OTHER_PAGES[page]:
        assert list(tmp_path.glob(pattern)), pattern


@pytest.mark.process
@pytest.mark.further  # the export is tested in tests/exchange
def test_matlab_lines_read_an_export(analyze_here, tmp_path):
    page = [PROJECT / "docs" / "export_to_matlab.md"]
    shutil.copy(TUTORIALS / "antenna.mcap", tmp_path)
    (command,), (lines,) = blocks("sh", page), blocks("matlab", page)
    assert analyze_here(*command.split()[1:]).returncode == 0
    assert set(re.findall(r"s\.(\w+)", lines)) <= loadmat(tmp_path / "frf.mat").keys()
    if octave := shutil.which("octave-cli"):
        instead = "semilogx = @(x, y) printf('%d points', numel(x + y));"  # needs no screen
        done = subprocess.run(
            [octave, "--norc", "--eval", instead + lines],
            cwd=tmp_path, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.stdout.endswith(" points"), done.stderr


BLOCK = re.compile(r"^ *```(\S*)\n *(.*?)\n(?:.*?\n)?? *```$", re.MULTILINE | re.DOTALL)


def all_blocks():
    """Page, language and first line of each block of the tutorials and how-tos."""
    contents = (PROJECT / "docs" / "how_to.md").read_text("utf-8")
    listed = re.findall(r"^\| \[.*?\]\((\w+)\.md\)", contents, re.MULTILINE)
    pages = [PROJECT / "docs" / f"{name}.md" for name in listed]
    for path in [*pages, *sorted(TUTORIALS.glob("*.md"))]:
        text = path.read_text("utf-8")
        for block in BLOCK.finditer(text):
            yield path.stem, block[1], block[2]


def test_every_block_is_run_or_has_a_reason():
    """``sh`` and other code is run, ``console`` is not and has a reason, ``text`` is output."""
    found = list(all_blocks())
    assert len(found) > 80
    tutorials = {path.stem for path in TUTORIALS.glob("*.md")}
    run = tutorials | set(OTHER_PAGES) | set(RUN_ELSEWHERE) | {path.stem for path in HOW_TOS}
    for page, language, line in found:
        assert language in (
            "sh", "python", "toml", "sql", "matlab", "octave", "console", "text", "{toctree}"
        ), f"{page}: {line}"  # fmt: skip
        if language not in ("console", "text", "{toctree}"):
            assert page in run, f"{page}: {line}"
    assert {line for _, language, line in found if language == "console"} == NOT_RUN.keys()
    for page, test in RUN_ELSEWHERE.items():
        assert page in (PROJECT / "tests" / test).read_text("utf-8")


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
