"""``rigd info``: what is in a session file."""

import json
from pathlib import Path
from typing import Annotated

import typer

from rigd.cli.exits import EXIT_FAILED, fail
from rigd.cli.options import AsJson


def info(
    path: Annotated[Path, typer.Argument(metavar="FILE", readable=False, help="A session file.")],
    as_json: AsJson = False,
) -> None:
    """Say what is in a session file.

    Example: rigd info sessions/20261120-101500-chirp.mcap
    """
    from rigd.session import SessionError, describe

    try:
        found = describe(path)
    except SessionError as error:
        fail(str(error), EXIT_FAILED)
    typer.echo(json.dumps(found.as_dict()) if as_json else "\n".join(found.lines()))
