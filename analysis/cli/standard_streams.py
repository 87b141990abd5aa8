"""Standard output and error that tolerate any text, a closed pipe and a full disk."""

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

_STREAM_NAMES: Final = ("stdout", "stderr")
"""Attributes of `sys` with the standard streams."""
_FAILURE_EXIT_CODE: Final = 1
"""Exit code if a standard stream cannot be written."""


def print_error(message: str) -> None:
    """Print an error message to standard error."""
    typer.echo(f"Error: {readable_message(message)}", err=True)


def print_readable(console: Console, message: str) -> None:
    """Print a message to a console above its progress bar, with control characters escaped."""
    console.print(readable_message(message), markup=False, soft_wrap=True)


class StandardStreamError(OSError):
    """Error in writing to a standard stream, such as a full disk."""


class _PipeTolerantDescriptor(io.FileIO):
    """File descriptor of a standard stream that discards data after the pipe was closed.

    A reader such as ``head`` closes the pipe when it has enough. The command continues, and its
    exit code does not depend on the pipe.
    """

    def write(self, data: bytes) -> int | None:  # type: ignore[override]
        """Write data, or discard them if the pipe was closed."""
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(memoryview(data).cast("B"))
        except OSError as error:
            raise StandardStreamError(error.errno, error.strerror) from error


@contextmanager
def standard_streams() -> Iterator[None]:
    """Let standard output and error accept any text, and continue after a pipe was closed.

    A character that the stream's encoding lacks becomes a question mark. If a stream cannot be
    written, as on a full disk, the process ends with exit code 1.
    """
    for stream_name in _STREAM_NAMES:
        stream = getattr(sys, stream_name)
        if not isinstance(stream, io.TextIOWrapper):  # closed, or replaced by a test
            continue
        stream.reconfigure(errors="replace")
        # A terminal cannot lose its reader, and it is not just a file on Windows.
        if not stream.isatty():
            setattr(sys, stream_name, _pipe_tolerant_stream(stream))
    try:
        try:
            yield
        finally:
            _flush_streams()
    except StandardStreamError as error:
        with suppress(OSError):
            sys.stderr.write(f"Error: the output cannot be written ({error.strerror}).\n")
            sys.stderr.flush()
        # Python would try to write the buffered text again, and print an error.
        for descriptor_number in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor_number)
        sys.exit(_FAILURE_EXIT_CODE)


def _pipe_tolerant_stream(stream: io.TextIOWrapper) -> io.TextIOWrapper:
    """Return a text stream to the same file descriptor that ignores a closed pipe."""
    stream.flush()
    raw_stream: io.RawIOBase = _PipeTolerantDescriptor(stream.fileno(), "wb", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw_stream),
        encoding=stream.encoding,
        errors=stream.errors,
        # Standard error has no buffer of its own and is written at once.
        line_buffering=stream.line_buffering or stream.write_through,
    )


def _flush_streams() -> None:
    """Write the buffered text of both standard streams."""
    for stream_name in _STREAM_NAMES:
        stream = getattr(sys, stream_name)
        if stream is not None:
            stream.flush()
