"""Entry point of ``rigd``, in a module that takes no time to import."""

import os
import signal


def main() -> None:
    """Run the command line; Ctrl-C ends it with 130 even while it is still being imported."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    _fill_standard_descriptors()
    from rigd.cli.app import main as run
    from rigd.interruption import let_pass

    try:
        run()
    finally:
        let_pass()


def _fill_standard_descriptors() -> None:
    """Open what whoever started this closed: other files would get the numbers 0 to 2."""
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)


if __name__ == "__main__":
    main()
