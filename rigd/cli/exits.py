"""How a command ends: exit codes and messages for the operator."""

from typing import NoReturn

import typer

EXIT_FAILED = 1
EXIT_WRONG_USE = 2
EXIT_INTERRUPTED = 130


def fail(message: str, code: int) -> NoReturn:
    """Tell what is wrong on standard error and leave with an exit code."""
    typer.echo(f"Error: {message}", err=True)
    raise typer.Exit(code)
