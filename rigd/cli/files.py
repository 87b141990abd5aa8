"""``rigd info`` and ``rigd recover``: contents of a session file, and repair of a torn one."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from rigd.cli.options import EXIT_FAILED, AsJson, progress


def info(
    path: Annotated[Path, typer.Argument(metavar="FILE", readable=False, help="A session file.")],
    as_json: AsJson = False,
) -> None:
    """Show the contents of a session file.

    Example: rigd info sessions/20261120-101500-chirp.mcap
    """
    from rigd.session import describe

    found = describe(path)
    typer.echo(json.dumps(found.as_dict()) if as_json else "\n".join(found.lines()))


def recover(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", readable=False, help="Torn .mcap.part or damaged .mcap files."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Recover the intact part of torn or damaged session files.

    Writes X.mcap beside X.mcap.part, and X.recovered.mcap beside a damaged X.mcap: every sample up
    to the damage, marked as recovered. Nothing is overwritten or removed.

    Example: rigd recover sessions/20261120-101500-chirp.mcap.part
    """
    from rigd.session import SessionError
    from rigd.session import recover as recover_file

    documents: list[dict[str, Any]] = []
    failed = False
    for path in paths:
        try:
            with progress(path.name) as on_progress:
                recovery = recover_file(path, on_progress)
        except SessionError as error:
            failed = True
            typer.echo(f"Error: {error}", err=True)
            documents.append({"source": str(path), "path": None, "error": str(error)})
        else:
            documents.append(recovery.as_dict())
            if not as_json:
                typer.echo("\n".join(recovery.lines()))
    if as_json:
        typer.echo(json.dumps({"files": documents}))
    if failed:
        raise typer.Exit(EXIT_FAILED)
