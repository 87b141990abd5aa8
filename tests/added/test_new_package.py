"""A package that `rigd plugins new` makes passes its own tests, and is a part of rigd."""

import os
import re
import socket
import subprocess
import sys
import threading
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from packages import rigd_with
from typer.testing import CliRunner

from rigd.cli.app import app
from rigd.profile import load_profile

PROJECT = Path(__file__).parents[2]


def made(folder, name, *options):
    """Make a new package in a folder, as pip would install it."""
    code, output, errors = rigd_with(
        folder.parent, "plugins", "new", name, *options, "--folder", folder
    )
    assert code == 0, output + errors
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    module = project["name"].replace("-", "_")
    metadata = folder / f"{module}-{project['version']}.dist-info"
    metadata.mkdir()
    ((group, names),) = project["entry-points"].items()
    lines = [f"[{group}]", *(f"{name} = {reference}" for name, reference in names.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    return folder


@pytest.mark.process
def test_new_packages_pass_their_tests_and_are_found(tmp_path):
    device = made(tmp_path / "device", "mypart")
    law = made(tmp_path / "law", "mylaw", "--kind", "controller")
    done = subprocess.run(
        [sys.executable, "-P", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error",
         device / "tests", law / "tests"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": f"{device}:{law}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "18 passed" in done.stdout
    for folder, name, shown in (
        (device, "mypart", '# address of the instrument\nhost = "…"\n'),
        (law, "mylaw", '# In [control]: controller = "mylaw"\n[mylaw]\n'),
    ):
        code, output, _ = rigd_with(folder, "plugins", "show", name, cwd=tmp_path)
        assert code == 0
        assert shown in output


@pytest.mark.process
@pytest.mark.further
@pytest.mark.parametrize(
    ("name", "options", "page", "line_of_profile", "with_part"),
    [
        ("mysensor", (), "your_own_device", r'sensor = ".*"', 'sensor = "mysensor"'),
        (
            "mylaw",
            ("--kind", "controller"),
            "your_own_controller",
            r"\[control\]",
            '[control]\ncontroller = "mylaw"',
        ),
    ],
)
def test_new_package_runs_as_documented(
    runtime_folder, tmp_path, monkeypatch, name, options, page, line_of_profile, with_part
):
    package = made(tmp_path / "own", name, *options)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (section,) = blocks(page, "toml")
    lines = "".join(blocks(page, "sh")).splitlines()
    assert [line.partition(" ")[0] for line in lines] == ["rigd"] * 4
    for line in lines:
        arguments = line.replace("--duration 20", "--duration 2 --no-look").split()[1:]
        code, output, errors = rigd_with(package, *arguments, cwd=tmp_path)
        assert code == 0, output + errors
        if arguments[:2] == ["profiles", "copy"]:
            (profile,) = tmp_path.rglob("lab.toml")
            text, chosen = re.subn(
                rf"^{line_of_profile}", with_part, profile.read_text(), flags=re.MULTILINE
            )
            assert chosen == 1
            profile.write_text(text + section)
    assert list(tmp_path.glob("sessions/*-chirp.mcap"))


@pytest.mark.process
def test_new_driver_reads_an_instrument_as_documented(tmp_path):
    code, _ = blocks("your_own_device", "python")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as instrument:
        instrument.bind(("127.0.0.1", 0))
        settings = f'host="127.0.0.1", port={instrument.getsockname()[1]}, timeout_us=1e6'
        code = code.replace('host="192.168.1.20"', settings)

        def answer_twice():
            for _ in range(2):
                instrument.sendto(b"1 2 3 4 5 6", instrument.recvfrom(16)[1])

        answers = threading.Thread(target=answer_twice, daemon=True)
        answers.start()
        package = made(tmp_path / "own", "mysensor")
        status, output, errors = rigd_with(package, program=("-P", "-c", code), cold=True)
        answers.join(10.0)
    assert (status, errors) == (0, "")
    assert output.startswith("(1.0, 2.0, 3.0, 4.0, 5.0, 6.0) False LineHealth(")


def test_drive_is_declared_as_documented():
    class Settings:
        pass

    class MyDrive:
        def __init__(self, settings):
            self.settings = settings

    _, code = blocks("your_own_device", "python")
    exec(code, names := {"MyDrive": MyDrive, "Settings": Settings})
    profile = load_profile("sim")
    settings = Settings()
    opened = names["DEVICE"].open_drive(replace(profile.rig, added_settings=(settings,)))
    assert opened.drive.settings is settings
    assert not opened.simulated


def blocks(page, language):
    text = (PROJECT / "docs" / f"{page}.md").read_text("utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize(
    "arguments", [["Upper"], ["cia402"], ["a b"], ["../x"], ["pid", "--kind", "controller"]]
)
def test_invalid_name_is_refused(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["plugins", "new", *arguments])
    assert result.exit_code == 2
    assert not list(tmp_path.iterdir())
