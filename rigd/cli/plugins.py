"""Command ``rigd plugins``: what installed packages add, and whether it can be used."""

import json
import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rigd.cli.options import EXIT_FAILED, EXIT_WRONG_USE, AsJson, fail
from rigd.printable import printable

plugins_app = typer.Typer(invoke_without_command=True, rich_markup_mode=None)


@plugins_app.callback()
def plugins(context: typer.Context, as_json: AsJson = False) -> None:
    """List what installed packages add, or make a package.

    A package adds a device, a controller, an excitation, a file format or a damping structure by an
    entry point. Each is imported and checked; one that cannot be used is named with the reason, and
    the command exits with 1.

    Example: rigd plugins
    """
    if context.invoked_subcommand is not None:
        return
    from rigd.plugins import GROUPS, PluginError, check_plugin, installed_plugins

    plugin_rows = []
    for group in GROUPS:
        for plugin in installed_plugins(group):
            plugin_summary = plugin_problem = ""
            try:
                plugin_summary = check_plugin(plugin)
            except PluginError as error:
                plugin_problem = str(error)
            plugin_rows.append(
                {
                    "group": group,
                    "name": plugin.name,
                    "package": plugin.package,
                    "version": plugin.version,
                    "summary": plugin_summary,
                    "problem": plugin_problem,
                }
            )
    if as_json:
        typer.echo(json.dumps({"plugins": plugin_rows}, ensure_ascii=False))
    elif not plugin_rows:
        typer.echo(f"No installed package adds anything ({', '.join(GROUPS)}).")
    else:
        for row in plugin_rows:
            package_text = f"{row['package']} {row['version']}"
            row_text = (
                row["problem"]
                or f"{row['name']}: {row['summary']} ({row['group']}, {package_text})"
            )
            typer.echo(printable(f"Cannot be used: {row_text}" if row["problem"] else row_text))
    if any(row["problem"] for row in plugin_rows):
        raise typer.Exit(EXIT_FAILED)


@plugins_app.command()
def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the device or controller.")],
) -> None:
    """Print the section of a profile for a device or controller that an installed package adds.

    Example: rigd plugins show netft
    """
    from rigd.control.kinds import CONTROLLERS
    from rigd.devices.kinds import DEVICES
    from rigd.profile import section_text

    if DEVICES.owner(name) is not None:
        typer.echo(section_text(DEVICES[name]), nl=False)
        return
    if CONTROLLERS.owner(name) is None:
        fail(
            f"No installed package adds a device or a controller {printable(name, 40)}.",
            EXIT_WRONG_USE,
        )
    controller_kind = CONTROLLERS[name]
    typer.echo(f'# In [control]: controller = "{name}"')
    typer.echo(section_text(controller_kind), nl=False)


_TEMPLATE_FOLDER = Path(__file__).with_name("plugin_template")
"""Folder with the template of a package, in which NAME represents the name of its part."""


class PartKind(StrEnum):
    """Kind of the part that a new package adds to rigd."""

    DEVICE = "device"
    """Force-torque sensor."""
    CONTROLLER = "controller"
    """Controller of the motor's angle."""


_TEMPLATE_REPLACEMENTS = {
    PartKind.DEVICE: {
        "TITLE": "Force-torque sensor NAME",
        "GROUP": "rigd.devices",
        "DECLARATION": "DEVICE",
    },
    PartKind.CONTROLLER: {
        "TITLE": "Controller NAME",
        "GROUP": "rigd.controllers",
        "DECLARATION": "CONTROLLER",
    },
}
"""Words of the template's project file and README that differ between the kinds of parts."""
_PART_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
"""Pattern of the name of a part."""


@plugins_app.command()
def new(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the new device or controller.")
    ],
    kind: Annotated[
        PartKind, typer.Option("--kind", help="What the package adds.")
    ] = PartKind.DEVICE,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", metavar="FOLDER", help="New folder (default: rigd-NAME)."),
    ] = None,
) -> None:
    """Make a package with a force-torque sensor or a controller and its tests, to be changed.

    Example: rigd plugins new mysensor
    """
    if not _PART_NAME.fullmatch(name):
        fail(
            f"{printable(name, 40)}: choose a name of lower-case letters, digits and _, at most 32 "
            "characters, that begins with a letter.",
            EXIT_WRONG_USE,
        )
    if _is_name_taken(kind, name):
        fail(
            f"A {kind.value} {name} exists already (rigd plugins); choose another name.",
            EXIT_WRONG_USE,
        )
    template_files = {
        "pyproject.toml.txt": "pyproject.toml",
        "README.md.txt": "README.md",
        f"{kind.value}.py.txt": "rigd_NAME/__init__.py",
        f"test_{kind.value}.py.txt": "tests/test_NAME.py",
    }
    package_folder = folder if folder is not None else Path(f"rigd-{name}")
    try:
        package_folder.mkdir(parents=True)
        for template, path in template_files.items():
            file_text = (_TEMPLATE_FOLDER / template).read_text(encoding="utf-8")
            if not template.endswith(".py.txt"):
                for word, replacement in _TEMPLATE_REPLACEMENTS[kind].items():
                    file_text = file_text.replace(word, replacement)
            new_file = package_folder / path.replace("NAME", name)
            new_file.parent.mkdir(exist_ok=True)
            new_file.write_text(file_text.replace("NAME", name), encoding="utf-8")
    except FileExistsError:
        fail(f"{package_folder} exists already; choose another folder (--folder).", EXIT_WRONG_USE)
    except OSError as error:
        fail(f"{package_folder} cannot be written ({error.strerror}).", EXIT_FAILED)
    folder_text = printable(str(package_folder))
    typer.echo(
        f"{folder_text} is made. In the environment of rigd: pip install --editable "
        f"'{folder_text}[test]', "
        f"rigd plugins, python -m pytest {folder_text}/tests."
    )


def _is_name_taken(kind: PartKind, name: str) -> bool:
    """Return whether rigd or an installed package already has a part of this kind and name."""
    from rigd.control.kinds import CONTROLLERS
    from rigd.devices.kinds import DEVICES
    from rigd.plugins import PluginError

    try:
        return name in DEVICES if kind is PartKind.DEVICE else name in CONTROLLERS
    except PluginError:
        return True
