"""``rigd --version``."""

from typing import Annotated

import typer

import rigd


def _tell(asked: bool) -> None:
    if asked:
        typer.echo(f"rigd {rigd.__version__}")
        raise typer.Exit


def before_a_command(
    version: Annotated[
        bool, typer.Option("--version", callback=_tell, is_eager=True, help="Say which it is.")
    ] = False,
) -> None:
    """Take the options that stand before a command; they have done their work by then."""
