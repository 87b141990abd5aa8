"""Entry point of ``analyze``, in a module that takes no time to import."""

import os
import signal


def main() -> None:
    """Run the command line; Ctrl-C ends it with 130 even while it is still being imported."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from analysis.cli.app import main as run
    from rigd.runtime import ignore_handled_signals

    try:
        run()
    finally:
        ignore_handled_signals()


if __name__ == "__main__":
    main()
