"""``rigd start``: sessions that the daemon runs; and starting the processes of a rig."""

import contextlib
import json
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from rigd.cli.daemon import DaemonOf, daemon_of
from rigd.cli.options import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_WRONG_USE,
    AsJson,
    Force,
    Note,
    Operator,
    Repeat,
    Specimen,
    fail,
    session_notes,
)

if TYPE_CHECKING:
    from rigd.daemon import Client
    from rigd.excitation import Value
    from rigd.runner import Crew
    from rigd.runtime import StopRequest


_POLL_S = 0.2


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
    from rigd.engine import ChildError
    from rigd.runner import Crew
    from rigd.runtime import StopRequest

    stop = StopRequest()
    stop.catch()
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


def start_sessions(
    kind: str,
    parameters: "Mapping[str, Value]",
    profile: DaemonOf = None,
    repeat: Repeat = 1,
    operator: Operator = "",
    specimen: Specimen = "",
    note: Note = "",
    force: Force = False,
    detach: Annotated[
        bool, typer.Option("--detach", help="Return at once; rigd status shows the progress.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Have the daemon run sessions, and report how they ended."""
    notes = session_notes(operator, specimen, note)
    for name, value in parameters.items():
        if isinstance(value, float) and not isfinite(value):
            fail(f"{name} = {value} is not a finite number; give one.", EXIT_WRONG_USE)
    request = {
        "excitation": kind,
        "parameters": {
            name: str(value.absolute()) if isinstance(value, Path) else value
            for name, value in parameters.items()
        },
        "repeat": repeat,
        "notes": {name: text for name, text in notes.items() if text},
        "force": force,
    }
    with daemon_of(profile) as client, _Interrupts.caught() as interrupts:
        typer.echo(client.ask("status")["daemon"]["what_moves"], err=True)
        if not detach:
            client.ask("watch")
        told = client.ask("start", **request)
        if detach and interrupts.count:
            client.ask("stop")
            raise typer.Exit(EXIT_INTERRUPTED)
        if detach:
            if as_json:
                typer.echo(json.dumps({"series": told["series"]}))
            else:
                _tell_plan(told["plan"], err=False)
                typer.echo("It is running; rigd status shows how far it is, rigd stop ends it.")
            return
        _tell_plan(told["plan"], err=as_json)
        series = _follow(client, told["series"], interrupts, as_json=as_json)
    if as_json:
        typer.echo(json.dumps({"sessions": series["sessions"]}))
    if series["failed"]:
        typer.echo(f"Error: {series['reason']}", err=True)
        raise typer.Exit(EXIT_FAILED)
    if series["stopped"]:
        raise typer.Exit(EXIT_INTERRUPTED)


class _Interrupts:
    """Counts Ctrl-C: the first asks for a stop, the second leaves."""

    def __init__(self) -> None:
        self.count = 0

    @classmethod
    @contextmanager
    def caught(cls) -> Iterator["_Interrupts"]:
        """Count from here on."""
        interrupts = cls()
        before = signal.signal(signal.SIGINT, lambda *_: interrupts.note())
        try:
            yield interrupts
        finally:
            signal.signal(signal.SIGINT, before)

    def note(self) -> None:
        """Take note of one."""
        self.count += 1


def _follow(
    client: "Client", number: int, interrupts: _Interrupts, *, as_json: bool
) -> dict[str, Any]:
    """Show the progress of a series to its end, and return what the daemon says of it."""
    asked = False
    with _ProgressView() as view:
        while True:
            if interrupts.count and not asked:
                asked = True
                client.send("stop")
                view.say("Stopping; Ctrl-C again leaves the rest to the daemon.")
            if interrupts.count > 1:
                raise typer.Exit(EXIT_INTERRUPTED)
            event = client.event(_POLL_S)
            kind = None if event is None else event.get("event")
            if event is None:
                continue
            if kind == "progress":
                view.update(event)
            elif kind == "message" and event["level"] != "info":
                view.say(f"{event['level'].capitalize()}: {event['text']}")
            elif kind == "message" and event["text"].startswith("Live view"):
                view.say(event["text"])
            elif kind == "session":
                view.say(_result_text(event))
                if not as_json and event["path"] is not None:
                    view.pause()
                    typer.echo(event["path"])
            elif kind == "series" and event["series"] == number:
                return event


def _tell_plan(plan: dict[str, Any], *, err: bool) -> None:
    typer.echo(
        f"{plan['record_s']:g} s of record. Predicted peaks: angle {plan['peak_angle_rad']:.3g} "
        f"rad, speed {plan['peak_velocity_rad_s']:.3g} rad/s, torque "
        f"{plan['peak_torque_nm']:.3g} N·m.",
        err=err,
    )
    # A daemon of before an update tells none; to fail here would leave its session without Ctrl-C.
    if words := plan.get("tip_in_words"):
        typer.echo(words, err=err)
    for warning in plan["warnings"]:
        typer.echo(f"Warning: {warning}", err=err)


def _result_text(session: dict[str, Any]) -> str:
    reason = f" {session['reason']}" if session["reason"] else ""
    if session["part"] is not None:
        return f"{session['outcome']}: no whole record, but {session['part']}.{reason}"
    if session["path"] is None:
        return f"{session['outcome']}: no record.{reason}"
    return (
        f"{session['outcome']}: {session['scheduled']} ticks scheduled = {session['recorded']} "
        f"recorded + {session['missed']} missed + {session['lost']} lost; "
        f"{session['late']} late; {session['stale_angles']} stale angles, "
        f"{session['stale_wrenches']} stale wrenches.{reason}"
    )


class _ProgressView:
    """One line on standard error that says how far the session is."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TextColumn("{task.fields[more]}"),
            console=Console(stderr=True),
            transient=True,
            auto_refresh=False,
        )
        self._task = self._progress.add_task("preparing", total=None, more="")

    def __enter__(self) -> "_ProgressView":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, progress: dict[str, Any]) -> None:
        """Show where the session is."""
        from rigd.engine import Phase

        number = f" {progress['session']}/{progress['repeat']}" if progress["repeat"] > 1 else ""
        left = progress["time_left_s"]
        more = "" if left is None else f"{left:.0f} s left"
        if progress["missed"]:
            more += f"; {progress['missed']} missed, {progress['late']} late"
        self._progress.update(
            self._task,
            description=Phase[progress["phase"].upper()].words + number,
            completed=progress["tick"],
            total=progress["total"],
            more=more,
        )
        self._progress.refresh()

    def say(self, text: str) -> None:
        """Write a line above it."""
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def pause(self) -> None:
        """Leave the line to standard output for a moment."""
        self._progress.refresh()
