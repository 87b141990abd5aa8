"""Entry point of the command ``rigd``, in a module that is imported quickly."""

import os
import select
import signal
import sys

_NOTHING_BEGAN_MESSAGE = b"Stopped before anything began.\n"
"""Message after Ctrl-C before a command has started."""
_PORTABLE_COMMANDS = ("list", "info", "recover", "replay", "profiles", "specimens")
"""Commands that use files only, and therefore also run on macOS and Windows."""


def main() -> None:
    """Run the command line ``rigd``; Ctrl-C during its import ends it with exit code 130."""
    signal.signal(signal.SIGINT, _end_on_interrupt)
    _fill_standard_descriptors()
    command = next(iter(sys.argv[1:]), "--help")
    is_linux = hasattr(os, "sched_setaffinity")  # the loop needs a processor core of its own
    if not is_linux and command not in _PORTABLE_COMMANDS and not command.startswith("-"):
        sys.exit(
            f"Error: rigd {command} needs Linux. This system has analyze, and of rigd the commands "
            f"{', '.join(_PORTABLE_COMMANDS)}."
        )
    from rigd.runtime import ignore_handled_signals
    from rigd.runtime.background import collect_garbage_rarely, use_one_thread

    use_one_thread()
    collect_garbage_rarely()
    if sys.argv[1:] == ["stop"]:
        from rigd.cli.stop_report import main as run
    elif sys.argv[1:] in (["status"], ["status", "--json"]):
        from rigd.cli.status_report import main as run
    else:
        from rigd.cli.app import main as run
    try:
        run()
    finally:
        ignore_handled_signals()


def _end_on_interrupt(*_: object) -> None:
    """Write to standard error that nothing has begun, and end the process at once."""
    try:
        if select.select([], [2], [], 0)[1]:  # a write to a full pipe would block
            os.write(2, _NOTHING_BEGAN_MESSAGE)
    except OSError:
        pass  # closed, or its terminal is gone
    os._exit(130)


def _fill_standard_descriptors() -> None:
    """Open closed standard descriptors, so that no other file gets the numbers 0 to 2."""
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)


if __name__ == "__main__":
    main()
