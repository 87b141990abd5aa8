"""Start and end of every command of ``rigd``; quick to import, so that ``rigd stop`` is quick."""

import contextlib
import errno
import io
import os
import signal
import sys
from collections.abc import Callable

from rigd.printable import readable_message
from rigd.runtime import raise_on_signals

EXIT_FAILED = 1
"""Exit code of a valid request that failed."""
EXIT_WRONG_USE = 2
"""Exit code of a request that must be changed."""
EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def run_command(command: Callable[[], object]) -> None:
    """Run a command; Ctrl-C or a system error ends the process with a message and an exit code."""
    raise_on_signals(signal.SIGINT)
    for stream in (sys.stdout, sys.stderr):
        # A terminal that cannot encode "·" or "²" gets a "?" instead of an error.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        command()
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
    except OSError as error:
        with contextlib.suppress(OSError):  # standard error may be closed as well
            sys.stderr.write(f"Error: {readable_message(_system_error_message(error))}\n")
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_FAILED)


def _system_error_message(error: OSError) -> str:
    """Return the message for the user on a system error that no command has caught."""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return (
            f"Too many open files ({error.strerror}); raise the limit (ulimit -n) "
            "or close other programs."
        )
    if error.filename is not None:
        return f"{error.filename}: {error.strerror}."
    # The reader of the output has ended, or the disk of the output file is full.
    return f"the output cannot be written ({error.strerror})."
