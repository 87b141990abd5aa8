"""Installed packages that add devices and other parts by entry points, found without an import.

A package states in the file ``entry_points.txt`` of its metadata what it adds to which group. The
files of the installed packages are read directly, because ``importlib.metadata`` is slow to import
and fails for all packages if the file of one is invalid. A package that cannot be used is named
with the reason, and affects nothing else. Nothing is taken from the working folder.
"""

import contextlib
import importlib
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Protocol, TypeVar

from rigd.errors import FailureError, UserError
from rigd.printable import listed, printable

T = TypeVar("T")
"""Type of a part, or of the object that an entry point names."""


class Declaration(Protocol):
    """Declaration of a part, whose name is that of its entry point."""

    @property
    def name(self) -> str:
        """Name of the part."""


D = TypeVar("D", bound=Declaration)
"""Type of the declaration that an entry point names."""

GROUPS: Final = {
    "rigd.devices": ("device", "rigd.profile:check_part_plugin"),
    "rigd.controllers": ("controller", "rigd.profile:check_part_plugin"),
    "rigd.excitations": ("excitation", "rigd.excitation:check_excitation_plugin"),
    "analysis.formats": ("file format", "analysis.exchange:check_format_plugin"),
    "analysis.structures": ("structure", "analysis.structures:check_structure_plugin"),
}
"""Map from each group of entry points to the word for its parts in messages, and to the function
that checks a part of the group."""

_PART_NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,31}")
"""Pattern of the names that a package can add; they are keys of profiles and options."""
_OBJECT_REFERENCE_PATTERN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""Pattern of the object that an entry point names: module and attribute."""
_MAX_ENTRY_POINTS_FILE_BYTES = 1 << 20
"""Largest size in bytes of a file ``entry_points.txt`` that is read."""
_GROUP_HEADINGS = tuple(f"[{group}]".encode() for group in GROUPS)
"""Headings of the groups; a file without any of them adds no part."""


class PluginError(UserError):
    """Error of a package's part that cannot be used; the message has package, reason and remedy."""


@dataclass(frozen=True, slots=True)
class Plugin:
    """Part that an installed package adds to a group, before it is imported."""

    group: str
    """Group of the entry point, a key of `GROUPS`."""
    name: str
    """Name of the part, such as the name of a device in a profile."""
    object_reference: str
    """Module and object that declare the part, as ``module:object``."""
    package: str
    """Name of the package."""
    version: str
    """Version of the package."""
    problem: str = ""
    """Reason why the part cannot be used, as a sentence with a remedy; empty if none is known."""

    @property
    def part_noun(self) -> str:
        """Word for a part of the group, for messages."""
        return GROUPS[self.group][0]

    @property
    def label(self) -> str:
        """Name and version of the package, as stored in session files."""
        return f"{self.package} {self.version}".strip()

    def error(self, reason: str) -> PluginError:
        """Return the error that names package and part, with the reason as a sentence."""
        message = f"Package {self.label}, {self.group} entry point {self.name}: {reason}"
        return PluginError(printable(message))


def installed_plugins(group: str) -> tuple[Plugin, ...]:
    """Return the parts that the installed packages add to a group, sorted by name.

    Nothing is imported. A part whose `Plugin.problem` is not empty cannot be used.

    Parameters
    ----------
    group
        Group of entry points, a key of `GROUPS`.
    """
    return tuple(plugin for plugin in _scan_folders(_search_folders()) if plugin.group == group)


def find_plugin(group: str, name: str) -> Plugin | None:
    """Return the part with a given name that an installed package adds, or None.

    Parameters
    ----------
    group
        Group of entry points, a key of `GROUPS`.
    name
        Name of the part.

    Raises
    ------
    PluginError
        If the part is known to be unusable.
    """
    for plugin in installed_plugins(group):
        if plugin.name == name:
            if plugin.problem:
                raise plugin.error(plugin.problem)
            return plugin
    return None


def load_plugin(plugin: Plugin, expected_type: type[T]) -> T:
    """Import a package and return the object that its entry point names.

    Parameters
    ----------
    plugin
        Part of an installed package.
    expected_type
        Type that the object must have.

    Raises
    ------
    PluginError
        If the import fails in any way, or the object has another type.
    """
    if plugin.problem:
        raise plugin.error(plugin.problem)
    module_name, _, object_name = plugin.object_reference.partition(":")
    try:
        # A package that prints must not disturb the output of a command.
        with _without_working_folder(), contextlib.redirect_stdout(sys.stderr):
            named_object = getattr(importlib.import_module(module_name), object_name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit is no Exception
        raise plugin.error(
            f"{plugin.object_reference} cannot be imported ({error_text(error)}); repair, "
            "upgrade or uninstall the package."
        ) from error
    if not isinstance(named_object, expected_type):
        raise plugin.error(
            f"{plugin.object_reference} is a {type(named_object).__name__}, not a "
            f"{expected_type.__name__}; repair, upgrade or uninstall the package."
        )
    return named_object


def load_declaration(plugin: Plugin, expected_type: type[D]) -> D:
    """Import a package and return the declaration of its part, which has the entry point's name.

    Parameters
    ----------
    plugin
        Part of an installed package.
    expected_type
        Type that the declaration must have.

    Raises
    ------
    PluginError
        If the import fails in any way, or the declaration has another type or name.
    """
    declaration = load_plugin(plugin, expected_type)
    if declaration.name != plugin.name:
        raise plugin.error(
            f'it declares the {plugin.part_noun} "{declaration.name}"; the two names must be '
            "equal: rename one."
        )
    return declaration


class Registry(Mapping[str, T]):
    """Parts of one group by name: those that are built in, then those of installed packages.

    Iteration imports the parts of packages, and leaves out those that cannot be used. Access by
    name raises `PluginError` for a part that cannot be used.

    Parameters
    ----------
    group
        Group of the entry points by which packages add parts, a key of `GROUPS`.
    built_in_parts
        Parts that no package can replace, by name.
    load
        Function that imports and checks the part of a package; it raises `PluginError`.
    program
        Program into which the parts are built, for messages.
    """

    def __init__(
        self,
        group: str,
        built_in_parts: Mapping[str, T],
        load: Callable[[Plugin], T],
        program: str = "rigd",
    ) -> None:
        self.group = group
        self.built_in_parts = built_in_parts
        self._load = load
        self._program = program

    def owner(self, name: str) -> Plugin | None:
        """Return the package that adds a part, or None for a built-in or unknown one.

        Raises
        ------
        PluginError
            If the part is known to be unusable.
        """
        return None if name in self.built_in_parts else find_plugin(self.group, name)

    def load(self, plugin: Plugin) -> T:
        """Import and check the part that a package adds.

        Raises
        ------
        PluginError
            If the package cannot be imported, or its declaration is invalid or replaces a built-in
            part.
        """
        if plugin.name in map(str.lower, self.built_in_parts):
            raise plugin.error(
                f"this {plugin.part_noun} is built into {self._program} and cannot be replaced; "
                "rename it."
            )
        return self._load(plugin)

    def added_plugins(self) -> tuple[Plugin, ...]:
        """Return the parts that installed packages add, sorted by name; nothing is imported."""
        return installed_plugins(self.group)

    def names(self) -> list[str]:
        """Return the names of all parts, usable or not; nothing is imported."""
        return [*self.built_in_parts, *(plugin.name for plugin in self.added_plugins())]

    def __getitem__(self, name: str) -> T:
        """Return the part with a given name."""
        owner = self.owner(name)
        return self.built_in_parts[name] if owner is None else self.load(owner)

    def __iter__(self) -> Iterator[str]:
        """Yield the names of the parts that can be used."""
        yield from self.built_in_parts
        for plugin in self.added_plugins():
            with contextlib.suppress(PluginError):
                self.load(plugin)
                yield plugin.name

    def __len__(self) -> int:
        """Return the number of parts that can be used."""
        return sum(1 for _ in self)


def check_plugin(plugin: Plugin) -> str:
    """Import a part that a package adds, check it, and return its one-line summary.

    Raises
    ------
    PluginError
        If the part cannot be used.
    """
    module_name, _, function_name = GROUPS[plugin.group][1].partition(":")
    summary: str = getattr(importlib.import_module(module_name), function_name)(plugin)
    return summary


@contextlib.contextmanager
def plugin_errors(
    plugin: Plugin | None, passed_exceptions: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """Turn an unexpected exception of a package's code into an error that names the package.

    Errors whose message is for the operator, errors of the operating system, and all errors of
    rigd's own parts are passed on unchanged.

    Parameters
    ----------
    plugin
        Part of a package, or None for a part of rigd.
    passed_exceptions
        Further exceptions that are passed on.
    """
    passed_on_exceptions: tuple[type[Exception], ...] = (
        UserError,
        FailureError,
        OSError,
        *passed_exceptions,
    )
    try:
        yield
    except passed_on_exceptions:
        raise
    except (Exception, SystemExit) as error:  # SystemExit is no Exception
        if plugin is None:
            raise
        raise _package_failure(plugin, error) from error


def error_of_package(error: Exception, plugin: Plugin) -> PluginError | None:
    """Return the error that names a package, or None if its code did not raise the exception.

    Parameters
    ----------
    error
        Unexpected exception.
    plugin
        Part of an installed package.
    """
    package_module = plugin.object_reference.partition(":")[0].partition(".")[0]
    traceback = error.__traceback__
    while traceback is not None:
        module_name = str(traceback.tb_frame.f_globals.get("__name__"))
        if module_name.partition(".")[0] == package_module:
            return _package_failure(plugin, error)
        traceback = traceback.tb_next
    return None


def _package_failure(plugin: Plugin, error: BaseException) -> PluginError:
    """Return the error for an unexpected exception of a package's code."""
    return plugin.error(
        f"its code failed ({error_text(error)}); report that to the package's author."
    )


def error_text(error: BaseException) -> str:
    """Return type and message of an exception."""
    return f"{type(error).__name__}: {error}".removesuffix(": ")


def _starts_with_working_folder() -> bool:
    """Return whether Python has put the working folder at the start of the search path."""
    if sys.flags.safe_path or not sys.path:
        return False
    try:
        return sys.path[0] in ("", os.getcwd())  # noqa: PTH109 - pathlib would resolve nothing more
    except OSError:  # the folder was removed
        return False


@contextlib.contextmanager
def _without_working_folder() -> Iterator[None]:
    """Remove the working folder from the start of the search path in this context."""
    if not _starts_with_working_folder():
        yield
        return
    working_folder = sys.path.pop(0)
    try:
        yield
    finally:
        sys.path.insert(0, working_folder)


def _search_folders() -> tuple[str, ...]:
    """Return the folders in which installed packages are searched."""
    folders = sys.path[1:] if _starts_with_working_folder() else sys.path
    return tuple(folder for folder in dict.fromkeys(folders) if Path(folder).is_absolute())


@lru_cache(maxsize=8)
def _scan_folders(folders: tuple[str, ...]) -> tuple[Plugin, ...]:
    """Return all parts that the packages in these folders add, in the order of their names."""
    found_plugins: list[Plugin] = []
    package_names: set[str] = set()
    for folder in folders:
        with contextlib.suppress(OSError), os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda e: e.name):
                if not entry.name.endswith(".dist-info"):
                    continue
                package, _, version = entry.name.removesuffix(".dist-info").partition("-")
                normalized_name = re.sub(r"[-_.]+", "-", package).lower()
                if (
                    normalized_name not in package_names
                ):  # else it is hidden by the one found before
                    package_names.add(normalized_name)
                    found_plugins += _read_entry_points(
                        Path(entry.path, "entry_points.txt"), normalized_name, version
                    )
    return tuple(sorted(_with_clash_problems(found_plugins), key=lambda p: (p.group, p.name)))


def _with_clash_problems(found_plugins: list[Plugin]) -> Iterator[Plugin]:
    """Yield the parts, with a stated problem in those whose name several packages add."""
    labels_by_part: dict[tuple[str, str], list[str]] = {}
    for plugin in found_plugins:
        labels_by_part.setdefault((plugin.group, plugin.name), []).append(plugin.label)
    for plugin in found_plugins:
        package_labels = labels_by_part[plugin.group, plugin.name]
        clash_problem = f"{listed(package_labels)} add the same name; uninstall all but one."
        yield plugin if len(package_labels) == 1 else replace(plugin, problem=clash_problem)


def _read_entry_points(path: Path, package: str, version: str) -> Iterator[Plugin]:
    """Yield the parts that a package's file ``entry_points.txt`` names."""
    try:
        with path.open("rb") as file:
            file_bytes = file.read(_MAX_ENTRY_POINTS_FILE_BYTES)
    except OSError:
        return  # the package has none
    if not any(heading in file_bytes for heading in _GROUP_HEADINGS):
        return
    group = ""
    for line in file_bytes.decode("utf-8", errors="replace").splitlines():
        stripped_line = line.strip()
        if stripped_line.startswith("[") and stripped_line.endswith("]"):
            group = stripped_line[1:-1].strip()
        elif group in GROUPS and stripped_line and not stripped_line.startswith(("#", ";")):
            name, equals_sign, object_reference = (
                part.strip() for part in stripped_line.partition("=")
            )
            object_reference = object_reference.partition("[")[0].strip()
            problem = ""
            if not equals_sign or not _OBJECT_REFERENCE_PATTERN.fullmatch(object_reference):
                problem = "its line is not of the form name = module:object; correct it."
            elif not _PART_NAME_PATTERN.fullmatch(name):
                problem = (
                    "its name is not of lower-case letters, digits and _, at most 32; rename it."
                )
            yield Plugin(group, printable(name, 40), object_reference, package, version, problem)
