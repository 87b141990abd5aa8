"""``rigd info`` and ``rigd recover``: contents and recovery of session files."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from rigd.cli.options import EXIT_FAILED, AsJson, progress


def info(
    paths: Annotated[
        list[Path], typer.Argument(metavar="FILE...", readable=False, help="Session files.")
    ],
    as_json: AsJson = False,
) -> None:
    """Show the contents of session files.

    Example: rigd info sessions/20261120-101500-chirp.mcap
    """
    from rigd.session import SessionError, describe

    documents: list[dict[str, Any]] = []
    failed = False
    for number, path in enumerate(paths):
        try:
            found = describe(path)
        except SessionError as error:
            failed = True
            typer.echo(f"Error: {error}", err=True)
            documents.append({"path": str(path), "error": str(error)})
        else:
            documents.append(found.as_dict())
            if not as_json:
                typer.echo(("\n" if number else "") + "\n".join(found.lines()))
    if as_json and not (failed and len(paths) == 1):
        typer.echo(json.dumps(documents[0] if len(paths) == 1 else {"files": documents}))
    if failed:
        raise typer.Exit(EXIT_FAILED)


def recover(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", readable=False, help="Incomplete .mcap.part or damaged .mcap files."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Recover the intact part of incomplete or damaged session files.

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
