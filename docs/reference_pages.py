"""Make the pages of the reference that follow from the code: Python, commands, profile, requests.

Sphinx calls `write_pages` before it reads its sources (see ``conf.py``). The pages are written
to ``docs/generated``, which is not under version control.
"""

import ast
import importlib
import inspect
import json
import textwrap
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import ModuleType, NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types
import typer
from page_requests import page_document, page_rows
from sphinx.pycode import ModuleAnalyzer

from analysis.cli.app import app as analyze_app
from rigd.cli.app import app as rigd_app
from rigd.daemon import _protocol
from rigd.profile import _schema

ROOT = Path(__file__).parents[1]
GENERATED = Path(__file__).parent / "generated"
HELP_WIDTH = 90
LONGEST_VALUE = 100
"""Number of characters up to which the value of a constant is shown."""


def write_pages(folder: Path = GENERATED) -> None:
    """Write all pages; files that would not change keep their times, so builds stay short."""
    interfaces = public_interfaces()
    page = page_document()
    pages = {
        "commands.txt": commands_text(),
        "profile_keys.txt": profile_text(),
        "socket_requests.json": json_text(_protocol._REQUEST_VALIDATOR.json_schema()),
        "page_requests.json": json_text(page),
        "page_requests.txt": table(PAGE_COLUMNS, page_rows(page)),
        "python.txt": interfaces_text(list(interfaces)),
    }
    pages |= {f"python/{name}.rst": python_page(name, names) for name, names in interfaces.items()}
    for path in folder.rglob("*.*"):
        if path.relative_to(folder).as_posix() not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


# Python


def public_interfaces() -> dict[str, list[str]]:
    """Return the public names of each package and of each public module at the top, by its name."""
    interfaces = {
        ".".join(stub.relative_to(ROOT).parent.parts): stub_names(stub)
        for folder in ("rigd", "analysis")
        for stub in (ROOT / folder).rglob("__init__.pyi")
    }
    interfaces["analysis"] = list(importlib.import_module("analysis").__all__)
    for folder in ("rigd", "analysis"):
        for path in (ROOT / folder).glob("[!_]*.py"):
            name = f"{folder}.{path.stem}"
            interfaces[name] = module_names(importlib.import_module(name))
    return dict(sorted(interfaces.items()))


def stub_names(stub: Path) -> list[str]:
    """Return the names that a stub offers."""
    imports = ast.parse(stub.read_text("utf-8")).body
    return [
        each.name for node in imports if isinstance(node, ast.ImportFrom) for each in node.names
    ]


def module_names(module: ModuleType) -> list[str]:
    """Return the public names that a module defines itself."""
    defined = ModuleAnalyzer.for_module(module.__name__)
    defined.analyze()
    own = {name for name in defined.tagorder if "." not in name}
    own |= {name for scope, name in defined.attr_docs if not scope}
    own -= {
        each.asname or each.name
        for node in ast.walk(ast.parse(inspect.getsource(module)))
        if isinstance(node, ast.ImportFrom)
        for each in node.names
    }
    values = vars(module)
    return [
        name
        for name in sorted(own & values.keys())
        if not name.startswith("_")
        and not inspect.ismodule(values[name])
        and getattr(values[name], "__module__", module.__name__) == module.__name__
    ]


def interfaces_text(names: list[str]) -> str:
    """Return a table of the packages and modules with what they are for."""
    rows = [
        (
            f"{{doc}}`{name} </generated/python/{name}>`",
            summary_of(importlib.import_module(name)).replace("``", "`"),
        )
        for name in names
    ]
    return table(("interface", "what for"), rows)


def python_page(module_name: str, names: list[str]) -> str:
    """Return the page of a package or module: its text, then each public name."""
    module = importlib.import_module(module_name)
    parts = [title(module_name), f".. py:module:: {module_name}\n\n{inspect.getdoc(module)}\n\n"]
    members = {name: getattr(module, name) for name in names}
    submodules = [name for name, member in members.items() if inspect.ismodule(member)]
    parts += [entry(module, name) for name in names if name not in submodules]
    for name in submodules:
        public = f"{module_name}.{name}"
        parts.append(f"{title(public, '-')}.. py:module:: {public}\n\n")
        parts.append(f"{inspect.getdoc(members[name])}\n\n")
        parts += [entry(members[name], each) for each in module_names(members[name])]
    return "".join(parts)


def entry(module: ModuleType, name: str) -> str:
    """Return the entry of one public name in the page of its module."""
    member = getattr(module, name)
    full = f"{module.__name__}.{name}"
    if inspect.isclass(member):
        return f".. autoclass:: {full}\n   :members:\n\n"
    if inspect.isroutine(inspect.unwrap(member)):  # also one that keeps its results
        return f".. autofunction:: {full}\n\n"
    # autodoc would show the documentation of the value's type.
    value = repr(member)
    shown = f"   :value: {value}\n" if len(value) <= LONGEST_VALUE and "0x" not in value else ""
    text = textwrap.indent(constant_text(module, name), "   ")
    return f".. py:data:: {name}\n   :module: {module.__name__}\n{shown}\n{text}\n\n"


def constant_text(module: ModuleType, name: str) -> str:
    """Return the docstring below the assignment of a constant, where it is assigned."""
    stub = Path(str(module.__file__)).with_suffix(".pyi")
    defined_in = module.__name__
    if stub.exists():
        for node in ast.parse(stub.read_text("utf-8")).body:
            if isinstance(node, ast.ImportFrom) and name in {each.name for each in node.names}:
                defined_in = f"{module.__name__}.{node.module}"
    analyzer = ModuleAnalyzer.for_module(defined_in)
    return "\n".join(analyzer.find_attr_docs().get(("", name), []))


def summary_of(module: ModuleType) -> str:
    """Return the first sentence of a module's text, on one line."""
    return (inspect.getdoc(module) or "").partition("\n\n")[0].replace("\n", " ")


def title(text: str, line: str = "=") -> str:
    """Return a heading in reStructuredText."""
    return f"{text}\n{line * len(text)}\n\n"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table in Markdown."""
    lines = [head, tuple("---" for _ in head), *rows]
    cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


# Commands


def commands_text() -> str:
    """Return the help of every command, each below a heading of its own."""
    parts = []
    for name, app in (("rigd", rigd_app), ("analyze", analyze_app)):
        for path, text in helps(typer.main.get_command(app), name):
            parts.append(
                f"##{'' if path == name else '#'} {path}\n\n```text\n{text.rstrip()}\n```\n"
            )
    return "\n".join(parts)


# Typer's click is its own in some versions and the package of that name in others.
def helps(command: Any, path: str, parent: Any = None) -> Iterator[tuple[str, str]]:  # noqa: ANN401
    """Yield the full name and the help of a command and of its subcommands."""
    context = command.context_class(
        command,
        info_name=path if parent is None else path.rpartition(" ")[2],
        parent=parent,
        terminal_width=HELP_WIDTH,
        max_content_width=HELP_WIDTH,
    )
    yield path, command.get_help(context)
    for name in getattr(command, "commands", {}):
        child = command.get_command(context, name)
        if not child.hidden:
            yield from helps(child, f"{path} {name}", context)


# Profile


def profile_text() -> str:
    """Return each section of a profile, with a table of its keys."""
    parts = []
    defaults = _schema.key_defaults()
    for section, cls in _schema.SECTIONS.items():
        texts, types = field_texts(cls), get_type_hints(cls, include_extras=True)
        rows = []
        for key, name in _schema.section_fields(section):
            default = describe_default(defaults[key]) if key in defaults else "required"
            text = " ".join(texts.get(name, "").split()).replace("``", "`")
            rows.append((f"`{key.rpartition('.')[2]}`", describe_type(types[name]), default, text))
        about = (inspect.getdoc(cls) or "").partition("Attributes\n---")[0].replace("``", "`")
        keys = table(("key", "values", "if left out", "meaning"), rows)
        parts.append(f"## [{section}]\n\n{about.strip()}\n\n{keys}")
    return "\n".join(parts)


def field_texts(cls: type) -> dict[str, str]:
    """Return the description of each field of a dataclass, also of those that it inherits."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__[:-1]):
        documented = ModuleAnalyzer.for_module(base.__module__).find_attr_docs()
        texts |= {
            n: "\n".join(doc) for (scope, n), doc in documented.items() if scope == base.__name__
        }
        texts |= numpydoc_attributes(inspect.getdoc(base) or "")
    return {each.name: texts[each.name] for each in fields(cls) if each.name in texts}


def numpydoc_attributes(docstring: str) -> dict[str, str]:
    """Return the descriptions in a docstring's section "Attributes", by name."""
    _, _, section = docstring.partition("Attributes\n----------\n")
    found: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        if line and not line.startswith(" "):
            if ":" not in line and not line.isidentifier() and "," not in line:
                break  # the next section
            names = [each.strip() for each in line.partition(" :")[0].split(",")]
        elif line.strip():
            for name in names:
                found[name] = f"{found.get(name, '')} {line.strip()}".strip()
    return found


def describe_type(hint: Any) -> str:  # noqa: ANN401
    """Return the values that a type allows, in words."""
    origin = get_origin(hint)
    if origin is Annotated:
        base, *conditions = get_args(hint)
        limits = [text for each in conditions if (text := describe_condition(each))]
        return ", ".join((describe_type(base), *limits))
    if origin is Literal:
        return " or ".join(f'`"{each}"`' for each in get_args(hint))
    if origin in (Union, UnionType):
        return " or ".join(describe_type(each) for each in get_args(hint) if each is not NoneType)
    if origin is tuple:
        first, *others = get_args(hint)
        if others == [...]:
            return f"list: {describe_type(first)}"
        return f"{1 + len(others)} values: {describe_type(first)}"
    if origin is dict:
        return "table"
    return {float: "number", int: "whole number", str: "text", bool: "true or false"}[hint]


def describe_condition(condition: object) -> str:
    """Return a condition of a type in words, or an empty text if it is none."""
    match condition:
        case annotated_types.Gt(gt=bound):
            return f"> {bound}"
        case annotated_types.Ge(ge=bound):
            return f"≥ {bound}"
        case annotated_types.Lt(lt=bound):
            return f"< {bound}"
        case annotated_types.Le(le=bound):
            return f"≤ {bound}"
        case annotated_types.MinLen(min_length=bound):
            return f"at least {bound}"
        case annotated_types.MaxLen(max_length=bound):
            return f"at most {bound}"
    return ""


def describe_default(default: object) -> str:
    """Return a default value as a profile writes it."""
    if default is None:
        return "not stated"
    return f"`{json.dumps(default)}`"


# Requests

PAGE_COLUMNS = ("request", "what it does", "needs the token")


def json_text(document: dict[str, Any]) -> str:
    """Return a schema as text."""
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"
