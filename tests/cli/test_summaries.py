"""Lists of commands: no summary is cut to fit its line of 80 characters."""

import pytest
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
def test_no_summary_is_cut(app, arguments):
    told = CliRunner().invoke(app, [*arguments, "--help"], terminal_width=80)

    _, commands = told.stdout.split("Commands:\n")
    summaries = [line.split(maxsplit=1)[1] for line in commands.splitlines() if line.strip()]
    assert all(summary.endswith(".") for summary in summaries)
    assert not [summary for summary in summaries if summary.endswith("...")]
