"""What every command that runs sessions does first."""

import os
from typing import TYPE_CHECKING

from rigd.cli.exits import EXIT_FAILED, fail

if TYPE_CHECKING:
    from rigd.engine.signals import StopRequest
    from rigd.supervisor.crew import Crew


def start_crew(*, live: bool) -> "tuple[StopRequest, Crew]":
    """Catch the operator's stop, and start the processes of the first session.

    They import what they need while the command line imports the rest, and while it plans.
    """
    from rigd.engine.process import SINGLE_THREADED, ChildError
    from rigd.engine.signals import StopRequest
    from rigd.supervisor.crew import Crew

    stop = StopRequest()
    stop.catch()
    os.environ.update(SINGLE_THREADED)
    try:
        return stop, Crew(live=live)
    except OSError as error:
        fail(
            f"The processes of a session cannot be started ({error.strerror}); look at the limits "
            "of open files and of shared memory (/dev/shm).",
            EXIT_FAILED,
        )
    except ChildError as error:
        fail(str(error), EXIT_FAILED)
