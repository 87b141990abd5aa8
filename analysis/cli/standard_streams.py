"""Standard output and error as a command needs them: of any encoding, unread, on a full disk."""

from __future__ import annotations

import io
import os
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

import typer

from rigd.printable import readable_message

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

_NAMES: Final = ("stdout", "stderr")
_EXIT_FAILED: Final = 1


def complain(message: str) -> None:
    """Write an error to standard error."""
    typer.echo(f"Error: {readable_message(message)}", err=True)


def print_readable(console: Console, message: str) -> None:
    """Write a message about a file above a line of progress."""
    console.print(readable_message(message), markup=False, soft_wrap=True)


class StandardStreamError(OSError):
    """A standard stream that takes no more, as on a full disk."""


class _Descriptor(io.FileIO):
    """A standard stream that goes nowhere once its reader has gone.

    Who reads no further, as ``head`` does, has what he wanted: the work goes on, and the exit code
    is that of the work.
    """

    def write(self, data: bytes) -> int | None:  # type: ignore[override]
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(memoryview(data).cast("B"))
        except OSError as error:
            raise StandardStreamError(error.errno, error.strerror) from error


@contextmanager
def standard_streams() -> Iterator[None]:
    """Have both streams take any text and outlive their reader; end with 1 where one is full.

    A character that the stream's encoding lacks becomes a question mark.
    """
    for name in _NAMES:
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # closed, or a test's
            continue
        stream.reconfigure(errors="replace")
        # A terminal has its reader for as long as it is one, and is not just a file on Windows.
        if not stream.isatty():
            setattr(sys, name, _like(stream))
    try:
        try:
            yield
        finally:
            _flush()
    except StandardStreamError as error:
        with suppress(OSError):
            sys.stderr.write(f"Error: the output cannot be written ({error.strerror}).\n")
            sys.stderr.flush()
        # What is left unwritten would be tried again, and complained of, by Python.
        for number in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        sys.exit(_EXIT_FAILED)


def _like(stream: io.TextIOWrapper) -> io.TextIOWrapper:
    stream.flush()
    raw: io.RawIOBase = _Descriptor(stream.fileno(), "wb", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=stream.errors,
        # Standard error, with no buffer of its own, is written through.
        line_buffering=stream.line_buffering or stream.write_through,
    )


def _flush() -> None:
    for name in _NAMES:
        stream = getattr(sys, name)
        if stream is not None:
            stream.flush()
