"""Files that other programs run: the workflow, the hooks before a commit, the container."""

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
import urllib.request
from pathlib import Path

import check_jsonschema
import pytest
import yaml
from click.testing import CliRunner

PROJECT = Path(__file__).parents[2]
WORKFLOW = PROJECT / ".github" / "workflows" / "tests.yml"
DOCKERFILE = (PROJECT / "Dockerfile").read_text("utf-8")

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("schema", "file"),
    [("github-workflows", WORKFLOW), ("citation-file-format", PROJECT / "CITATION.cff")],
)
def test_a_file_has_the_form_that_its_reader_wants(schema, file):
    options = ["--builtin-schema", f"vendor.{schema}", str(file)]
    done = CliRunner().invoke(check_jsonschema.main, options)
    assert done.exit_code == 0, done.output


def test_the_workflow_calls_what_there_is():
    makefile = (PROJECT / "Makefile").read_text("utf-8")
    jobs = yaml.safe_load(WORKFLOW.read_text("utf-8"))["jobs"].values()
    commands = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
    assert len(commands) == 4
    for program, *arguments in map(shlex.split, commands):
        if program == "make":
            (target,) = arguments
            assert re.search(rf"^{target}:", makefile, re.MULTILINE)
        elif program == "python":
            assert arguments[:2] in (["-m", "pip"], ["-m", "pytest"])
            for each in arguments:
                assert (PROJECT / each).exists() or not each.startswith("tests/")
        else:
            assert os.access(PROJECT / program, os.X_OK)


def test_the_workflow_runs_on_every_system_and_version_that_is_claimed():
    jobs = yaml.safe_load(WORKFLOW.read_text("utf-8"))["jobs"]
    claimed = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]
    prefix = "Programming Language :: Python :: "
    versions = {each.removeprefix(prefix) for each in claimed["classifiers"] if prefix in each}
    assert versions >= {"3.11", "3.12", "3.13"}
    for job in jobs.values():
        assert versions <= set(job["strategy"]["matrix"]["python"])
    systems = {jobs["linux"]["runs-on"], *jobs["analyser"]["strategy"]["matrix"]["system"]}
    assert {each.partition("-")[0] for each in systems} == {"ubuntu", "macos", "windows"}


def test_the_hooks_are_the_checks_of_make():
    makefile = (PROJECT / "Makefile").read_text("utf-8")
    (recipe,) = re.findall(r"^check:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    checks = {re.sub(r"\$\(BIN\)/| --check| \.$", "", line) for line in recipe.split("\n\t")}
    config = yaml.safe_load((PROJECT / ".pre-commit-config.yaml").read_text("utf-8"))
    hooks = [hook["entry"] for repository in config["repos"] for hook in repository["hooks"]]
    entries = {hook.replace(".venv/bin/", "").replace(" --fix", "") for hook in hooks}
    assert entries == {check.strip() for check in checks}


def test_the_image_has_what_its_commands_name():
    (copied,) = re.findall(r"^COPY (constraints\.txt) ", DOCKERFILE, re.MULTILINE)
    assert (PROJECT / copied).exists()
    for extra in re.findall(r"\.whl\)\[(\w+)\]", DOCKERFILE):
        project = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]
        assert extra in project["optional-dependencies"]
    ignored = (PROJECT / ".dockerignore").read_text("utf-8").split()
    assert {".git", ".venv"} <= set(ignored)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


COMMAND = re.findall(r"^CMD (\[.*\])$", DOCKERFILE, re.MULTILINE)


def test_the_container_s_command_is_one(rigd_here):
    ((program, *arguments),) = map(json.loads, COMMAND)
    assert program == "rigd"
    done = rigd_here(*arguments, "--help")
    assert done.returncode == 0, done.stderr


@pytest.mark.further  # as tests/daemon and tests/web have it of such a command
def test_the_container_s_command_serves_the_page(tmp_path):
    (text,) = COMMAND
    port = str(free_port())
    command = json.loads(text.replace("8720", port).replace("/data", str(tmp_path / "data")))
    command[0] = shutil.which(command[0], path=str(Path(sys.executable).parent))
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    try:
        address = f"http://127.0.0.1:{port}/"
        while address not in (line := process.stderr.readline()):
            assert line, "the daemon has ended"
        with urllib.request.urlopen(address) as page:
            assert page.status == 200
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
    assert process.returncode == 0
