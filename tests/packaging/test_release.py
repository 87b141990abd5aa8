"""What a release states of itself: version, dependencies, licences, versions of packages."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import rigd

pytestmark = pytest.mark.process

PROJECT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))
EXTRAS = PYPROJECT["project"]["optional-dependencies"]
CONSTRAINTS = (PROJECT / "constraints.txt").read_text("utf-8")


def test_the_version_is_the_same_everywhere():
    assert PYPROJECT["project"]["dynamic"] == ["version"]
    assert f"\nversion: {rigd.__version__}\n" in (PROJECT / "CITATION.cff").read_text("utf-8")
    headings = re.findall(
        r"^## \[(.+?)\] - (.+)$", (PROJECT / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    assert headings[0][0] == rigd.__version__
    assert all(re.fullmatch(r"unreleased|\d{4}-\d\d-\d\d", date) for _, date in headings)


def test_starting_reads_no_metadata_of_packages():
    code = "import sys, rigd.cli.app; sys.exit('importlib.metadata' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_all_holds_every_extra():
    (requirement,) = EXTRAS["all"]
    assert requirement == f"rigd[{','.join(sorted(set(EXTRAS) - {'all'}))}]"


def test_an_upper_bound_has_its_reason():
    for line in (PROJECT / "pyproject.toml").read_text("utf-8").splitlines():
        if re.match(r'\s*(\w+ = \[)?"[\w-]+.*(==|<)[^"]*"', line):
            assert "#" in line, line


@pytest.mark.skipif(
    sys.platform != "linux" or sys.version_info[:2] != (3, 11), reason="it is Python 3.11's"
)
def test_the_table_of_licences_is_current(tmp_path):
    script = PROJECT / ".ci" / "dependencies.py"
    subprocess.run([sys.executable, script, "table", "--output", tmp_path / "table"], check=True)
    current = (tmp_path / "table").read_text("utf-8")
    assert current == (PROJECT / "docs" / "dependencies.md").read_text("utf-8")


def test_licences_that_are_not_permissive_are_named():
    text = (PROJECT / "docs" / "dependencies.md").read_text("utf-8")
    rows = [row.strip("| ").split(" | ") for row in text.splitlines() if row.startswith("| ")][1:]
    assert len(rows) > 50
    named = {name for name, _, licence in rows if re.search(r"GPL|MPL|not stated|Other", licence)}
    assert named == {"python-can", "nptdms"}


def test_constraints_hold_every_package_that_is_declared():
    pinned = dict(re.findall(r"^([a-z0-9-]+)==(\S+)$", CONSTRAINTS, re.MULTILINE))
    declared = [*PYPROJECT["project"]["dependencies"], *PYPROJECT["dependency-groups"]["dev"]]
    declared += [each for name, extra in EXTRAS.items() if name != "all" for each in extra]
    names = {re.match(r"[\w-]+", each)[0].lower() for each in declared}
    assert len(names) > 20
    assert names <= pinned.keys()
