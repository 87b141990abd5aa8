"""How a command ends: exit codes, messages for the operator, and Ctrl-C."""

from types import FrameType
from typing import NoReturn

import typer

EXIT_FAILED = 1
EXIT_WRONG_USE = 2
EXIT_INTERRUPTED = 130


def fail(message: str, code: int) -> NoReturn:
    """Tell what is wrong on standard error and leave with an exit code."""
    typer.echo(f"Error: {message}", err=True)
    raise typer.Exit(code)


class Interruption(KeyboardInterrupt):
    """Ctrl-C, by a name of its own.

    `python -m` ends by the signal, whatever exit code it is asked for, once a plain
    `KeyboardInterrupt` has passed through an `exec` of text; what defines a named tuple or a
    dataclass is one.
    """


def interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    """Handle a signal as Ctrl-C."""
    raise Interruption
