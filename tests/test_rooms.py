"""Folders are entered by their doors: private modules stay private in `rigd` and `analysis`."""

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for room in ("rigd", "analysis") for path in (ROOT / room).rglob("*.py"))
DOORS = sorted(path for room in ("rigd", "analysis") for path in (ROOT / room).rglob("*.pyi"))


def name_of(path):
    """Dotted name of a module or of a folder's door."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imported_modules(path):
    """Modules of ours that a file names in its imports."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{each.name}" for each in node.names)
        elif isinstance(node, ast.Import):
            yield from (each.name for each in node.names)


def is_private(module):
    return module.split(".")[0] in ("rigd", "analysis") and any(
        part.startswith("_") and not part.startswith("__") for part in module.split(".")
    )


@pytest.mark.parametrize("room", sorted({path.parent for path in SOURCES}), ids=name_of)
def test_private_modules_are_imported_in_their_own_folder_only(room):
    foreign = {
        (path.name, module)
        for path in room.glob("*.py")
        for module in imported_modules(path)
        if is_private(module) and module.split("._")[0] != name_of(room)
    }
    assert not foreign


@pytest.mark.parametrize("path", DOORS, ids=name_of)
def test_a_door_says_what_the_room_is_and_offers_what_it_names(path):
    room = importlib.import_module(name_of(path))
    assert room.__doc__
    offered = [each.name for node in ast.parse(path.read_text()).body for each in node.names]
    assert offered
    for name in offered:
        assert hasattr(room, name)
    assert sorted(room.__all__) == sorted(offered)
