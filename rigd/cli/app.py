"""The command line ``rigd``, assembled from its commands."""

from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

import rigd
from rigd.cli.check import bench, check, reset
from rigd.cli.daemon import serve, status, stop, tare, zero
from rigd.cli.entry import run_command
from rigd.cli.identify import identify_app
from rigd.cli.library import info, list_sessions, recover, specimens
from rigd.cli.live import live, replay
from rigd.cli.options import exit_on_errors
from rigd.cli.plugins import plugins_app
from rigd.cli.probe import probe
from rigd.cli.profiles import profiles_app
from rigd.cli.run import run_app, start_app
from rigd.cli.simulate import inject, simulate
from rigd.printable import readable_errors


def _show_version(requested: bool) -> None:
    """Print the version and end the program, if the option ``--version`` was given."""
    if requested:
        typer.echo(f"rigd {rigd.__version__}")
        raise typer.Exit


def process_global_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Accept the options of ``rigd`` itself; their callbacks have already run."""


_COMMANDS_BY_SECTION: Final = {
    "Sessions": ("run", "serve", "start", "status", "stop"),
    "Rig": ("check", "tare", "zero", "reset", "live"),
    "Session files": ("list", "info", "replay", "recover"),
    "Set-up": ("profiles", "plugins", "specimens", "probe", "identify", "bench"),
    "Simulated devices": ("simulate", "inject"),
}
"""Names of the commands in each section of the help."""
_OTHER_COMMANDS_TITLE: Final = "Other commands"
"""Title of the section of the help with all commands that are not in `_COMMANDS_BY_SECTION`."""


class RigdGroup(TyperGroup):
    """Group of all commands of ``rigd``, which turns errors into messages and exit codes."""

    # Typer's click is its own in some versions and the package of that name in others.
    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401
        """Write the list of commands into the help text, in sections."""
        listed_command_names = {
            command_name
            for command_names in _COMMANDS_BY_SECTION.values()
            for command_name in command_names
        }
        other_command_names = tuple(
            command_name
            for command_name in self.list_commands(ctx)
            if command_name not in listed_command_names
        )
        for section_title, command_names in {
            **_COMMANDS_BY_SECTION,
            _OTHER_COMMANDS_TITLE: other_command_names,
        }.items():
            known_command_names = [
                command_name for command_name in command_names if command_name in self.commands
            ]
            if known_command_names:
                help_text_width = formatter.width - 6 - max(map(len, known_command_names))
                help_rows = [
                    (command_name, self.commands[command_name].get_short_help_str(help_text_width))
                    for command_name in known_command_names
                ]
                with formatter.section(section_title):
                    formatter.write_dl(help_rows)

    def make_context(self, *args: Any, **extra: Any) -> Any:  # noqa: ANN401
        """Parse the options that precede the command's name, with readable error messages."""
        with readable_errors():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401
        """Run the requested command, and end with the exit code of its error."""
        with readable_errors(), exit_on_errors():
            return super().invoke(ctx)


app = typer.Typer(
    cls=RigdGroup,
    help="Run the rig: excite the antenna, record every sample, watch it live.\n\n"
    "Example: rigd check --profile sim, then rigd run chirp --profile sim --fast",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.callback()(process_global_options)
# In the order in which an operator meets them.
app.command()(check)
app.add_typer(run_app, name="run")
app.command()(serve)
app.add_typer(start_app, name="start")
app.command()(live)
app.command()(status)
app.command()(stop)
app.command()(tare)
app.command()(zero)
app.command()(reset)
app.command("list")(list_sessions)
app.command()(specimens)
app.command()(info)
app.command()(replay)
app.command()(recover)
app.command()(probe)
app.add_typer(identify_app, name="identify")
app.add_typer(profiles_app, name="profiles")
app.add_typer(plugins_app, name="plugins")
app.command()(bench)
app.command()(simulate)
app.command()(inject)


def main() -> None:
    """Run the command line ``rigd``."""
    # Until a command starts, Ctrl-C only reports that nothing has begun.
    run_command(typer.main.get_command(app))
