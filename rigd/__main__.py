"""Entry point of ``rigd``, in a module that takes no time to import."""

import os
import signal


def main() -> None:
    """Run the command line; Ctrl-C ends it with 130 even while it is still being imported."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    _fill_standard_descriptors()
    from rigd.cli.app import main as run

    try:
        run()
    finally:
        _be_past_stopping()


def _be_past_stopping() -> None:
    """Let signals pass from now on: an operator may press once more, and has been heard.

    Python gives each signal that is handled its default action back before it has cleaned up, and
    would end by it.
    """
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_IGN)


def _fill_standard_descriptors() -> None:
    """Open what whoever started this closed: other files would get the numbers 0 to 2."""
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)


if __name__ == "__main__":
    main()
