"""Entry point of the command ``analyze``, in a module that is fast to import."""

import os
import signal


def main() -> None:
    """Run the command; Ctrl-C ends it with exit code 130, even during the imports."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from rigd.runtime.background import collect_garbage_rarely

    collect_garbage_rarely()  # before the imports
    from analysis.cli.app import main as run
    from rigd.runtime import ignore_handled_signals

    try:
        run()
    finally:
        ignore_handled_signals()


if __name__ == "__main__":
    main()
