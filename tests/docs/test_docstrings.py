"""Docstrings: public names are described to the last argument, and the examples run.

To be described are the arguments of functions, of classes and of their public methods,
and the fields of dataclasses, by these names and no others. A function or a method of one argument
may do without a section: its summary is about it.
"""

import ast
import dataclasses
import doctest
import importlib
import inspect
import re
import shutil
import textwrap
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import pytest
from cases import further

PROJECT = Path(__file__).parents[2]
SOURCES = sorted(
    path for package in ("rigd", "analysis") for path in (PROJECT / package).rglob("*.py")
)
STUBS = sorted(
    path for package in ("rigd", "analysis") for path in (PROJECT / package).rglob("*.pyi")
)
PUBLIC = [
    path
    for path in SOURCES
    # The options of commands have their help.
    if not path.name.startswith("_") and path.parent.name != "cli"
]


def name_of(path):
    """Dotted name of a module or of a package."""
    return ".".join(path.relative_to(PROJECT).with_suffix("").parts).removesuffix(".__init__")


def offered(path):
    """Functions and classes of a public interface or a public module."""
    module = importlib.import_module(name_of(path))
    if path.suffix == ".pyi":
        names = [each.name for node in ast.parse(path.read_text()).body for each in node.names]
        things = [getattr(module, name) for name in names]
    else:
        things = [
            thing
            for name, thing in vars(module).items()
            if not name.startswith("_") and getattr(thing, "__module__", "") == module.__name__
        ]
    return [thing for thing in things if inspect.isfunction(thing) or inspect.isclass(thing)]


def described(text, title):
    """Names that a section of a numpydoc docstring describes."""
    section = re.search(
        rf"^{title}\n-+\n(.*?)(?=^\w[^\n]*\n---|\Z)", text, re.DOTALL | re.MULTILINE
    )
    entries = re.findall(r"^\S.*", section[1], re.MULTILINE) if section else []
    return [name.strip(" *") for entry in entries for name in entry.split(" : ")[0].split(",")]


def with_string(cls):
    """Fields of a dataclass that are followed by a string."""
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
    return [
        field.target.id
        for field, below in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
    ]


def errors_of_function(function, text, *, may_be_in_summary=True):
    arguments = [each for each in inspect.signature(function).parameters if each != "self"]
    found = described(text, "Parameters")
    if found or not may_be_in_summary or len(arguments) > 1:
        yield from (f"{each} is not described" for each in arguments if each not in found)
        yield from (f"there is no {each}" for each in found if each not in arguments)


def errors_of_class(cls):
    text = inspect.cleandoc(vars(cls)["__doc__"])
    if dataclasses.is_dataclass(cls):
        found = described(text, "Attributes")
        fields = [each.name for each in dataclasses.fields(cls)]
        own = [name for name in fields if name in cls.__annotations__]
        missing = set(own) - {*found, *with_string(cls)}
        yield from (f"{each} is not described" for each in missing)
        # A field without slots or default is not an attribute of the class.
        existing = {*fields, *dir(cls)}
        yield from (f"there is no {each}" for each in found if each not in existing)
    elif "__init__" in vars(cls) and not getattr(cls, "_is_protocol", False):
        yield from errors_of_function(cls.__init__, text, may_be_in_summary=False)
    for name in vars(cls):
        method = getattr(cls, name)
        takes_arguments = inspect.isroutine(method) and not isinstance(method, cached_property)
        if not name.startswith("_") and takes_arguments:
            for each in errors_of_function(method, inspect.getdoc(method)):
                yield f"{name}: {each}"


@pytest.mark.parametrize("path", [*STUBS, *PUBLIC], ids=name_of)
def test_every_argument_and_field_is_described_by_its_name(path):
    found = [
        f"{thing.__module__}.{thing.__name__}: {complaint}"
        for thing in offered(path)
        for complaint in (
            errors_of_class(thing)
            if inspect.isclass(thing)
            else errors_of_function(thing, inspect.getdoc(thing))
        )
    ]
    assert not found


@pytest.mark.parametrize(
    ("text", "errors"),
    [
        ("Sum.\n\nParameters\n----------\na, b : int\n    Numbers.", []),
        (
            "Sum.\n\nParameters\n----------\na\n    One.\n\nReturns\n-------\nb",
            ["b is not described"],
        ),
        ("Sum.\n\nParameters\n----------\na, b, c\n    Numbers.", ["there is no c"]),
        ("Sum of `a` and `b`.", ["a is not described", "b is not described"]),
    ],
)
def test_check_finds_missing_descriptions(text, errors):
    assert list(errors_of_function(lambda a, b: a + b, text)) == errors


def test_descriptions_begin_with_a_noun():
    """Not "Of the copy.", but "Name of the copy."."""
    found = {
        name_of(path): lines
        for path in SOURCES
        if (lines := re.findall(r'^ *(?:""")?Of .*', path.read_text("utf-8"), re.MULTILINE))
    }
    assert not found


# Those that fit or design sessions repeat the tests of their functions.
COSTLY = ("analysis.api", "analysis.online", "rigd.excitation.experiment_design")
EXAMPLES = [
    further(path) if name_of(path) in COSTLY else path
    for path in SOURCES
    if ">>> " in path.read_text("utf-8")
]


@pytest.fixture
def folder_of_examples(short_chirps, tmp_path, monkeypatch):
    """Have the files that examples name in the working folder."""
    shutil.copy(short_chirps[0], tmp_path / "session.mcap")
    shutil.copy(PROJECT / "hw_profiles" / "sim.toml", tmp_path / "rig.toml")
    monkeypatch.chdir(tmp_path)


@pytest.mark.process
@pytest.mark.usefixtures("folder_of_examples")
@pytest.mark.parametrize("path", EXAMPLES, ids=name_of)
def test_examples_have_the_stated_output(path):
    failed, tried = doctest.testmod(importlib.import_module(name_of(path)))
    assert tried
    assert not failed
