"""Lists of commands: no summary is truncated to its line of 80 characters."""

import pytest
import typer
from typer.testing import CliRunner

import analysis.cli.app
import rigd.cli.app


@pytest.mark.parametrize(
    ("app", "arguments"),
    [
        (rigd.cli.app.app, []),
        *((rigd.cli.app.app, [group]) for group in ("run", "start", "identify", "profiles")),
        (analysis.cli.app.app, ["export"]),
    ],
)
def test_no_summary_is_truncated(app, arguments):
    result = CliRunner().invoke(app, [*arguments, "--help"], terminal_width=80)

    _, commands = result.stdout.split("--help ", 1)
    lines = commands.splitlines()[1:]
    summaries = [line.split(maxsplit=1)[1] for line in lines if line.startswith("  ")]
    assert summaries
    assert all(summary.endswith(".") for summary in summaries)
    assert not [summary for summary in summaries if summary.endswith("...")]


def test_every_command_is_in_one_section():
    printed = CliRunner().invoke(rigd.cli.app.app, ["--help"], terminal_width=80).stdout

    names = [line.split()[0] for line in printed.splitlines() if line.startswith("  ")]
    commands = typer.main.get_command(rigd.cli.app.app).commands
    assert {*commands} <= {*names}
    assert all(names.count(name) == 1 for name in commands)
    assert "Other commands" not in printed
