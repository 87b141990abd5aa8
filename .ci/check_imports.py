"""Check that no modules of `rigd` and `analysis` import each other in a circle.

    python .ci/check_imports.py [ROOT]

Prints the imports within each circle and exits with 1 if there are any. Imports for a type only and
by a function count as well. A public name of a package counts as one of its module in the `.pyi`.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

PRODUCT: Final = ("rigd", "analysis")


def module_name(path: Path, root: Path) -> str:
    """Return the dotted name of a module or package from the path of its file."""
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def public_names(root: Path) -> dict[str, str]:
    """Return the module that defines each public name of a package, by dotted name."""
    return {
        f"{module_name(path, root)}.{each.name}": f"{module_name(path, root)}.{node.module}"
        for package in PRODUCT
        for path in (root / package).rglob("__init__.pyi")
        for node in ast.parse(path.read_text("utf-8")).body
        if isinstance(node, ast.ImportFrom) and node.module
        for each in node.names
    }


def imported_names(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the dotted name and the line of everything that a file imports."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((f"{node.module}.{each.name}", node.lineno) for each in node.names)
        elif isinstance(node, ast.Import):
            yield from ((each.name, node.lineno) for each in node.names)


def offences(root: Path) -> Iterator[str]:
    """Yield one line for each import within a circle."""
    files = {module_name(p, root): p for name in PRODUCT for p in (root / name).rglob("*.py")}
    public = public_names(root)
    imports: dict[str, dict[str, int]] = {module: {} for module in files}
    for module, path in files.items():
        for name, line in imported_names(path):
            target = name if name in files else public.get(name, name.rpartition(".")[0])
            if target in files and target != module:
                imports[module].setdefault(target, line)
    reached: dict[str, set[str]] = {}
    for module in files:
        reached[module], ahead = set(), [module]
        while ahead:
            new = imports[ahead.pop()].keys() - reached[module]
            reached[module] |= new
            ahead.extend(new)
    for module, path in sorted(files.items()):
        for target, line in imports[module].items():
            if module in reached[target]:
                yield f"{path.relative_to(root)}:{line}: {target} leads back to {module}"


if __name__ == "__main__":
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1]
    sys.stdout.writelines(lines := [f"{line}\n" for line in offences(root)])
    sys.exit(f"{len(lines)} offences; move a definition to a module below both" if lines else 0)
