"""What every command that runs sessions does first."""

import contextlib
import os
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperGroup

from rigd.cli.exits import EXIT_FAILED, fail

if TYPE_CHECKING:
    from rigd.engine.signals import StopRequest
    from rigd.supervisor.crew import Crew


class CrewGroup(TyperGroup):
    """Commands that run sessions; Ctrl-C before they catch it themselves is told of.

    From :func:`start_crew` on it is a stop of the session, which says so.
    """

    # Typer's click is its own in some versions and the package of that name in others.
    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401
        """Run the command that was asked for."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            with contextlib.suppress(OSError):  # its terminal is gone
                typer.echo("Stopped before anything began.", err=True)
            raise


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
            "of open files (ulimit -n) and of shared memory (/dev/shm).",
            EXIT_FAILED,
        )
    except ChildError as error:
        fail(str(error), EXIT_FAILED)
