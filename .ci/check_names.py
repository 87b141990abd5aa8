"""Check names of code, tests and benchmarks: plain words, unique classes, public imports.

    python .ci/check_names.py [ROOT]

Prints file and line of each offence and exits with 1 if there are any:

* a word of `WORDS` in an identifier or a docstring, apart from the identifiers in `ALLOWED_NAMES`
  and the terms in `ALLOWED_TERMS`;
* a class name that is defined twice in `rigd` and `analysis`, apart from `ALLOWED_TWICE`;
* more imports of private modules and names in `tests` than `MOST_PRIVATE_IMPORTS`.

An exception is added to these tables together with its reason.
"""

import ast
import io
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

WORDS: Final = frozenset({
    "anew", "asked", "attend", "beside", "board", "crawl", "encounter", "foreign", "heard", "judge",
    "keeper", "kept", "lone", "look", "looked", "looks", "outfit", "piece", "pieces", "place",
    "places", "promised", "promises", "reality", "ridge", "said", "saves", "share", "shares",
    "stands", "stretch", "taker", "tell", "telling", "tells", "told", "untold", "valley", "valleys",
    "whoever",
})  # fmt: skip
"""Words for which the field has a better one: report, poll, segment, offset, fraction, …"""

ALLOWED_TERMS: Final = re.compile(
    r"quick.?look(?:s|ed)?(?![a-z])|QuickLook|\.look\.json|decimal places?(?![a-z])"
    r"|(?<![a-z])in.place(?![a-z])",
    re.IGNORECASE,
)
"""Terms that contain such a word: the report after a session; digits; the term of NumPy."""

ALLOWED_NAMES: Final[dict[str, str]] = {
    "no_look": "option --no-look of the command line",
    "look_follows": "key of the documents on the socket",
    "look_target": "argument of Rerun",
    "column_shares": "argument of Rerun",
    "row_shares": "argument of Rerun",
}
"""Identifiers that are not ours to choose, each with its reason."""

ALLOWED_TWICE: Final[dict[str, str]] = {}
"""Class names that may be defined twice, at most five, each with its reason."""

MOST_PRIVATE_IMPORTS: Final = 99
"""Largest number of private imports in `tests`; it follows the count downwards."""

PRODUCT: Final = ("rigd", "analysis")


def words_in(text: str) -> list[str]:
    """Return the words of `WORDS` in an identifier or a text."""
    plain = ALLOWED_TERMS.sub(" ", text)
    parts = re.sub(r"([a-z])([A-Z])", r"\1 \2", plain).lower()
    return [word for word in re.findall(r"[a-z]+", parts) if word in WORDS]


def identifiers(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each identifier."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME:
            yield token.start[0], token.string


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line of the docstrings, those of constants included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            text = node.value.value
            if isinstance(text, str):
                yield from enumerate(text.splitlines(), node.lineno)


def word_offences(path: Path, source: str, tree: ast.AST) -> Iterator[str]:
    """Yield one line for each identifier and each line of a docstring with such a word."""
    for line, name in identifiers(source):
        if name not in ALLOWED_NAMES and (found := words_in(name)):
            yield f"{path}:{line}: {name}: {', '.join(found)}"
    for line, text in docstrings(tree):
        named = re.sub(r"`+([A-Za-z_.]+)`+", lambda m: " " if m[1] in ALLOWED_NAMES else m[0], text)
        if found := words_in(named):
            yield f"{path}:{line}: docstring: {', '.join(found)}"


def class_offences(classes: dict[str, list[str]]) -> Iterator[str]:
    """Yield one line for each definition of a class name that is defined more than once."""
    for name, where in sorted(classes.items()):
        if len(where) > 1 and name not in ALLOWED_TWICE:
            yield from (f"{each}: class {name} is defined {len(where)} times" for each in where)
    if len(ALLOWED_TWICE) > 5:
        yield f"{__file__}: ALLOWED_TWICE has more than five names"


def is_private(name: str) -> bool:
    """Whether a dotted name has a part that is private."""
    return any(re.match(r"_(?!_)", part) for part in name.split("."))


def private_imports(path: Path, tree: ast.AST) -> Iterator[str]:
    """Yield one line for each private module or name of ours that is imported."""
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.ImportFrom) and node.module:
            every = [f"{node.module}.{each.name}" for each in node.names]
            names = [node.module] if is_private(node.module) else every
        elif isinstance(node, ast.Import):
            names = [each.name for each in node.names]
        for name in names:
            if is_private(name) and name.split(".")[0] in PRODUCT:
                yield f"{path}:{node.lineno}: private import of {name}"


def offences(root: Path) -> Iterator[str]:
    """Yield one line for each offence below a folder."""
    classes: defaultdict[str, list[str]] = defaultdict(list)
    for package in PRODUCT:
        for path in sorted((root / package).rglob("*.py")):
            source, shown = path.read_text("utf-8"), path.relative_to(root)
            tree = ast.parse(source)
            yield from word_offences(shown, source, tree)
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef):
                    classes[node.name].append(f"{shown}:{node.lineno}")
    yield from class_offences(classes)
    private: list[str] = []
    for folder in ("benchmarks", "tests"):
        for path in sorted((root / folder).rglob("*.py")):
            source, shown = path.read_text("utf-8"), path.relative_to(root)
            tree = ast.parse(source)
            yield from word_offences(shown, source, tree)
            if folder == "tests":
                private += private_imports(shown, tree)
    if len(private) > MOST_PRIVATE_IMPORTS:
        yield from private
        yield f"tests: {len(private)} private imports, at most {MOST_PRIVATE_IMPORTS} are allowed"


if __name__ == "__main__":
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1]
    lines = list(offences(root))
    sys.stdout.writelines(f"{line}\n" for line in lines)
    sys.exit(f"{len(lines)} offences; CONTRIBUTING.md, Run the checks" if lines else 0)
