"""Write what rigd depends on: `docs/dependencies.md` with licences, or `constraints.txt`.

Both describe the installed packages of this environment, so they are written on Linux with Python
3.11, the oldest version, which needs the most packages.

    python .ci/dependencies.py table        # docs/dependencies.md
    python .ci/dependencies.py constraints  # versions, once all tests have passed with them
"""

import argparse
import re
import sys
import tomllib
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parents[1]
TABLE, CONSTRAINTS = PROJECT / "docs" / "dependencies.md", PROJECT / "constraints.txt"
BASE = "rigd"

LONGEST_LICENCE = 40
"""Number of characters up to which the field `License` is a name; beyond, it is the text."""

TABLE_HEAD = "| package | needed by | licence |"
"""First line of the table; what is before it in the document is written by hand."""


def project_requirements() -> dict[str, list[str]]:
    """Return the requirements of each part: the base, the extras and the group of developers."""
    document = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))
    project = document["project"]
    extras = {k: v for k, v in project["optional-dependencies"].items() if k != "all"}
    return {BASE: project["dependencies"], **extras, "dev": document["dependency-groups"]["dev"]}


def installed_requirements(texts: list[str]) -> dict[str, Distribution]:
    """Return the installed packages that are required, also those that these require."""
    found: dict[str, Distribution] = {}
    waiting = [(text, "") for text in texts]
    while waiting:
        text, extra = waiting.pop()
        requirement = Requirement(text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        is_known = name in found
        package = found.setdefault(name, distribution(requirement.name))
        for each in requirement.extras if is_known else {"", *requirement.extras}:
            waiting += [(required, each) for required in package.requires or ()]
    return found


def licence(package: Distribution) -> str:
    """Return the licence that a package states in its metadata."""
    metadata = package.metadata
    if metadata["License-Expression"]:
        return metadata["License-Expression"]
    classifiers = [
        each.rpartition(" :: ")[2]
        for each in metadata.get_all("Classifier") or ()
        if each.startswith("License :: ") and each != "License :: OSI Approved"
    ]
    stated = metadata["License"] or ""
    if stated and len(stated) <= LONGEST_LICENCE:
        return re.sub(r"\s+", " ", stated)
    return ", ".join(classifiers) or "not stated"


def table() -> str:
    """Return the document with a new table of all packages, by the part that needs them."""
    introduction = TABLE.read_text("utf-8").partition(TABLE_HEAD)[0]
    lines = [introduction + TABLE_HEAD, "|---|---|---|"]
    parts = {
        part: installed_requirements(texts)
        for part, texts in project_requirements().items()
        if part != "dev"
    }
    packages = {name: package for part in parts.values() for name, package in part.items()}
    for name in sorted(packages):
        users = [part for part, required in parts.items() if name in required]
        part_text = BASE if BASE in users else ", ".join(f"rigd[{user}]" for user in users)
        lines.append(f"| {name} | {part_text} | {licence(packages[name])} |")
    return "\n".join(lines) + "\n"


def constraints() -> str:
    """Return the versions of all installed packages, also of those for developers."""
    texts = [text for part in project_requirements().values() for text in part]
    packages = installed_requirements(texts)
    version = ".".join(map(str, sys.version_info[:2]))
    return (
        f"# The versions with which all tests passed (Linux, Python {version}), also of what the\n"
        "# tests need: pip install --constraint constraints.txt 'rigd[all]'\n"
        "# Written by .ci/dependencies.py constraints.\n"
    ) + "".join(f"{name}=={packages[name].version}\n" for name in sorted(packages))


def main() -> None:
    """Write the requested file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["table", "constraints"])
    parser.add_argument("--output", type=Path, help="instead of the project's file")
    arguments = parser.parse_args()
    file, text = (TABLE, table()) if arguments.what == "table" else (CONSTRAINTS, constraints())
    (arguments.output or file).write_text(text, "utf-8")


if __name__ == "__main__":
    main()
