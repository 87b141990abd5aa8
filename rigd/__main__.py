"""Entry point of ``rigd``, in a module that takes no time to import."""

import os
import select
import signal
import sys

_NOTHING_BEGAN = b"Stopped before anything began.\n"


def main() -> None:
    """Run the command line; Ctrl-C ends it with 130 even while it is still being imported."""
    signal.signal(signal.SIGINT, _end)
    _fill_standard_descriptors()
    from rigd.runtime import ignore_handled_signals, use_one_thread

    use_one_thread()
    if sys.argv[1:] == ["stop"]:
        from rigd.cli.stop_report import main as run
    else:
        from rigd.cli.app import main as run
    try:
        run()
    finally:
        ignore_handled_signals()


def _end(*_: object) -> None:
    """Say that nothing has begun, where somebody listens, and end at once."""
    try:
        if select.select([], [2], [], 0)[1]:  # a full pipe would be waited for
            os.write(2, _NOTHING_BEGAN)
    except OSError:
        pass  # closed, or its terminal is gone
    os._exit(130)


def _fill_standard_descriptors() -> None:
    """Reopen closed standard descriptors: other files would get the numbers 0 to 2."""
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)


if __name__ == "__main__":
    main()
