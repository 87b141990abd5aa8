"""Command ``rigd plugins``: what installed packages add, and whether it can be used."""

import json
from typing import Annotated

import typer

from rigd.cli.options import EXIT_FAILED, EXIT_WRONG_USE, AsJson, fail
from rigd.printable import printable

plugins_app = typer.Typer(invoke_without_command=True, rich_markup_mode=None)


@plugins_app.callback()
def plugins(context: typer.Context, as_json: AsJson = False) -> None:
    """List what installed packages add to rigd, or show the section of a device.

    A package adds a device by an entry point of the group rigd.devices. Each is imported and
    checked; one that cannot be used is named with the reason, and the command exits with 1.

    Example: rigd plugins
    """
    if context.invoked_subcommand is not None:
        return
    from rigd.plugins import GROUPS, PluginError, check_plugin, installed_plugins

    rows = []
    for group in GROUPS:
        for plugin in installed_plugins(group):
            summary = problem = ""
            try:
                summary = check_plugin(plugin)
            except PluginError as error:
                problem = str(error)
            rows.append(
                {
                    "group": group,
                    "name": plugin.name,
                    "package": plugin.package,
                    "version": plugin.version,
                    "summary": summary,
                    "problem": problem,
                }
            )
    if as_json:
        typer.echo(json.dumps({"plugins": rows}, ensure_ascii=False))
    elif not rows:
        typer.echo(f"No installed package adds anything ({', '.join(GROUPS)}).")
    else:
        for row in rows:
            owner = f"{row['package']} {row['version']}"
            text = row["problem"] or f"{row['name']}: {row['summary']} ({row['group']}, {owner})"
            typer.echo(printable(f"Cannot be used: {text}" if row["problem"] else text))
    if any(row["problem"] for row in rows):
        raise typer.Exit(EXIT_FAILED)


@plugins_app.command()
def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the device.")],
) -> None:
    """Print the section of a profile for a device that an installed package adds.

    Example: rigd plugins show netft
    """
    from rigd.devices.kinds import find_kind, find_owner
    from rigd.profile import section_text

    kind = find_kind(name)
    if kind is None or find_owner(name) is None:
        fail(f"No installed package adds a device {printable(name, 40)}.", EXIT_WRONG_USE)
    typer.echo(section_text(kind), nl=False)
