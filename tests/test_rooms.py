"""Private modules of `rigd` and `analysis` are imported in their own package only."""

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(
    path for package in ("rigd", "analysis") for path in (ROOT / package).rglob("*.py")
)
STUBS = sorted(path for package in ("rigd", "analysis") for path in (ROOT / package).rglob("*.pyi"))


IMPORTS = re.compile(r"^\s*(?:from ([\w.]+) import (\([^)]*\)|.*)|import (.*))$", re.MULTILINE)
"""Statement of an import: a module and the imported names, or modules."""


def name_of(path):
    """Dotted name of a module or of a package."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imported_modules(path):
    """Modules of ours that a file names in its imports."""
    text = re.sub(r" as \w+", "", path.read_text("utf-8"))
    for module, names, modules in IMPORTS.findall(text):
        if module:
            yield module
        yield from re.findall(r"[\w.]+", modules)
        yield from (f"{module}.{name}" for name in re.findall(r"\w+", names))


def is_private(module):
    return module.split(".")[0] in ("rigd", "analysis") and any(
        part.startswith("_") and not part.startswith("__") for part in module.split(".")
    )


@pytest.mark.parametrize("package", sorted({path.parent for path in SOURCES}), ids=name_of)
def test_private_modules_are_imported_in_their_own_folder_only(package):
    violations = {
        (path.name, module)
        for path in package.glob("*.py")
        for module in imported_modules(path)
        if is_private(module) and module.split("._")[0] != name_of(package)
    }
    assert not violations


@pytest.mark.parametrize("path", STUBS, ids=name_of)
def test_stub_matches_package(path):
    package = importlib.import_module(name_of(path))
    assert package.__doc__
    offered = [each.name for node in ast.parse(path.read_text()).body for each in node.names]
    assert offered
    for name in offered:
        assert hasattr(package, name)
    assert sorted(package.__all__) == sorted(offered)
