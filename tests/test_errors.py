"""The tree of errors that `rigd.errors` draws is the one that there is."""

import re
from pathlib import Path

from rigd import errors

ROOT = Path(__file__).parents[1]
BASES = {"RigdError", "UserError", "FailureError"}


def derived():
    """Classes that derive from one of the bases by name: each with that base."""
    declared = re.compile(r"^class (\w+)\(([^)]*)\)", re.MULTILINE)
    for path in (ROOT / "rigd").rglob("*.py"):
        for name, bases in declared.findall(path.read_text("utf-8")):
            yield from ((name, base) for base in re.findall(r"\w+", bases) if base in BASES)


def drawn():
    """Names in the drawing, each with the one that it hangs on."""
    above = {-1: "RigdError"}  # by column
    for line in errors.__doc__.splitlines():
        if (column := line.find("+-- ")) >= 0:
            above = {at: name for at, name in above.items() if at < column}
            parent = above[max(above)]
            names = re.match(r"\w+(, \w+)*", line[column + 4 :])[0].split(", ")
            above[column] = names[0]
            yield from ((name, parent) for name in names)


def test_drawing_has_every_error_under_its_base():
    assert sorted((name, base) for name, base in drawn() if base in BASES) == sorted(derived())


def test_base_classes_distinguish_the_two_kinds():
    assert errors.UserError("x").wrong_use
    assert not errors.FailureError("x").wrong_use
    assert errors.FailureError("what to do").full_message() == "what to do"
