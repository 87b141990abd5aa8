"""The option ``--version`` of ``analyze``."""

from __future__ import annotations

from typing import Annotated

import typer

import rigd


def _tell(asked: bool) -> None:
    if asked:
        typer.echo(f"analyze {rigd.__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_tell, is_eager=True, help="Say which it is.")
]
