"""Implementation of ``rigd start``, whose sessions the daemon runs, and start of processes."""

import contextlib
import json
import signal
import time
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
    Accept,
    AsJson,
    Force,
    Meta,
    Note,
    Operator,
    Repeat,
    Specimen,
    TipSlope,
    WatchFit,
    complain,
    fail,
    session_notes,
)

if TYPE_CHECKING:
    from rigd.daemon.client import Client
    from rigd.excitation import Value
    from rigd.runner import ProcessGroup
    from rigd.runtime import StopRequest


_EVENT_TIMEOUT_S = 0.2
"""Longest wait in seconds for an event of the daemon, after which Ctrl-C is checked."""
_QUICK_LOOK_PATIENCE_S = 10.0
"""Longest wait in seconds for the last quick look after the end of a series."""


class SessionCommands(TyperGroup):
    """Group of commands that run sessions, which reports a Ctrl-C before a session begins.

    After :func:`start_processes` Ctrl-C stops the session, which reports it.
    """

    # Typer's click is its own in some versions and the package of that name in others.
    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401
        """Run the requested command, and report a Ctrl-C before a session begins."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            with contextlib.suppress(OSError):  # the terminal is gone
                typer.echo("Stopped before anything began.", err=True)
            raise


def start_processes(
    *, live: bool, touch: bool = False, fit: bool = False
) -> "tuple[StopRequest, ProcessGroup]":
    """Catch Ctrl-C as a request to stop, and start the processes of the first session.

    The processes import their modules while the command line imports others and plans.
    """
    from rigd.engine.processes import FIT, TOUCH
    from rigd.runner import ProcessGroup
    from rigd.runtime import StopRequest

    stop = StopRequest()
    stop.catch()
    try:
        extra_processes = [
            process for process, is_needed in ((TOUCH, touch), (FIT, fit)) if is_needed
        ]
        return stop, ProcessGroup(live=live, extra_processes=extra_processes)
    except OSError as error:
        fail(
            f"The processes of a session cannot be started ({error.strerror}); check the limits "
            "of open files (ulimit -n) and of shared memory (/dev/shm).",
            EXIT_FAILED,
        )


def start_sessions(
    kind: str,
    parameters: "Mapping[str, Value]",
    profile: DaemonOf = None,
    repeat: Repeat = 1,
    operator: Operator = "",
    specimen: Specimen = "",
    note: Note = "",
    meta: Meta = None,
    force: Force = False,
    accept: Accept = None,
    tip_slope_rad: TipSlope = None,
    detach: Annotated[
        bool, typer.Option("--detach", help="Return at once; rigd status shows the progress.")
    ] = False,
    watch_fit: WatchFit = False,
    as_json: AsJson = False,
) -> None:
    """Run sessions of an excitation by the daemon, and report how they ended."""
    from rigd.session.user_metadata import META_PREFIX

    notes: dict[str, Any] = {}
    for key, text in session_notes(operator, specimen, note, meta).items():
        if key.startswith(META_PREFIX):  # an older daemon does not know the member
            notes.setdefault("meta", {})[key.removeprefix(META_PREFIX)] = text
        else:
            notes[key] = text
    for name, value in {**parameters, "tip_slope_rad": tip_slope_rad}.items():
        if isinstance(value, float) and not isfinite(value):
            fail(f"{name} = {value} is not a finite number; give one.", EXIT_WRONG_USE)
    request = {
        "excitation": kind,
        "parameters": {
            name: str(value.absolute()) if isinstance(value, Path) else value
            for name, value in parameters.items()
        },
        "repeat": repeat,
        "notes": notes,
        "force": force,
    }
    if watch_fit:  # an older daemon does not know the member
        request["watch_fit"] = True
    if accept:  # likewise
        request["accept"] = accept
    if tip_slope_rad is not None:  # likewise
        request["tip_slope_rad"] = tip_slope_rad
    with daemon_of(profile) as client:
        daemon = client.ask("status")["daemon"]
        typer.echo(daemon["what_moves"], err=True)
        if not detach:
            client.ask("watch")
        with _Interrupts.caught() as interrupts:
            reply = client.ask_unless(lambda: interrupts.count > 0, "start", **request)
            if reply["reply"] == "stop":
                typer.echo("Stopped before the session began.", err=True)
                raise typer.Exit(EXIT_INTERRUPTED)
            if detach and interrupts.count:
                client.ask("stop")
                raise typer.Exit(EXIT_INTERRUPTED)
            if detach:
                if as_json:
                    typer.echo(json.dumps({"series": reply["series"]}))
                else:
                    _print_plan(reply["plan"], err=False)
                    typer.echo(
                        "Running; rigd status shows the progress, rigd stop ends the session."
                    )
                return
            _print_plan(reply["plan"], err=as_json)
            # An older daemon makes no quick looks, or does not report for which sessions.
            quick_looks = daemon.get("quick_looks", False)
            series = _follow_series(
                client, reply["series"], interrupts, as_json=as_json, quick_looks=quick_looks
            )
    if as_json:
        typer.echo(json.dumps({"sessions": series["sessions"]}))
    if series["failed"]:
        complain(series["reason"])
        raise typer.Exit(EXIT_FAILED)
    if series["stopped"]:
        raise typer.Exit(EXIT_INTERRUPTED)


class _Interrupts:
    """Counts Ctrl-C: the first requests a stop, the second ends the command."""

    def __init__(self) -> None:
        self.count = 0

    @classmethod
    @contextmanager
    def caught(cls) -> Iterator["_Interrupts"]:
        """Count Ctrl-C within this context instead of raising KeyboardInterrupt."""
        interrupts = cls()
        previous_handler = signal.signal(signal.SIGINT, lambda *_: interrupts.note())
        try:
            yield interrupts
        finally:
            signal.signal(signal.SIGINT, previous_handler)

    def note(self) -> None:
        """Count one Ctrl-C."""
        self.count += 1


def _follow_series(
    client: "Client", number: int, interrupts: _Interrupts, *, as_json: bool, quick_looks: bool
) -> dict[str, Any]:
    """Show the progress of a series until its end, and return its final event."""
    from rigd.engine.shared_state import Phase
    from rigd.runner import ProgressLine, result_line
    from rigd.runner.quick_looks import QuickLook

    stop_sent = False
    ended_sessions = 0
    awaited_quick_looks: set[str] = set()
    quick_look_paths: dict[str, str] = {}
    fits: dict[str, Any] = {}
    final_event: dict[str, Any] | None = None
    interrupts_at_end, deadline_s = 0, 0.0
    progress_line = ProgressLine()
    try:
        while final_event is None or (awaited_quick_looks and time.monotonic() < deadline_s):
            if final_event is not None and interrupts.count > interrupts_at_end:
                break
            if interrupts.count and not stop_sent:
                stop_sent = True
                client.send("stop")
                progress_line.say(
                    "Stopping; press Ctrl-C again to leave while the daemon finishes."
                )
            if final_event is None and interrupts.count > 1:
                raise typer.Exit(EXIT_INTERRUPTED)
            event = client.event(_EVENT_TIMEOUT_S) or {}
            match event.get("event"):
                # No bar between two sessions, where it would mix with the printed path.
                case "progress" if event["session"] > ended_sessions:
                    progress_line.update(
                        Phase[event["phase"].upper()],
                        event["tick"],
                        event["total"],
                        missed=event["missed"],
                        late=event["late"],
                        session_number_text=f"{event['session']}/{event['repeat']}"
                        if event["repeat"] > 1
                        else "",
                    )
                case "message" if "session" in event:
                    pass  # the end of a session is reported by the event of that name
                case "message" if event["level"] != "info":
                    progress_line.say(f"{event['level'].capitalize()}: {event['text']}")
                case "message" if event.get("notable") or event["text"].startswith("Live view"):
                    progress_line.say(event["text"])
                case "session":
                    progress_line.say(result_line(event))
                    progress_line.close()  # standard output may be the same terminal
                    if event["path"] is not None:
                        if not as_json:
                            typer.echo(event["path"])
                        if event.get("look_follows", quick_looks):
                            awaited_quick_looks.add(event["path"])
                        if "fit" in event:
                            fits[event["path"]] = event["fit"]
                    progress_line, ended_sessions = ProgressLine(), event["number"]
                case "quick_look" if event["path"] in awaited_quick_looks:
                    awaited_quick_looks.discard(event["path"])
                    quick_look = QuickLook.of_event(event)
                    if quick_look.path is not None:
                        quick_look_paths[event["path"]] = str(quick_look.path)
                    for text in quick_look.lines:
                        progress_line.say(text)
                case "series" if event["series"] == number:
                    final_event, interrupts_at_end = event, interrupts.count
                    deadline_s = time.monotonic() + _QUICK_LOOK_PATIENCE_S
                    if awaited_quick_looks:
                        progress_line.say("Quick look at the session; Ctrl-C skips it.")
    finally:
        progress_line.close()
    sessions = [
        each
        | {"look": quick_look_paths.get(each["path"])}
        | ({"fit": fits[each["path"]]} if each["path"] in fits else {})
        for each in final_event["sessions"]
    ]
    return final_event | {"sessions": sessions}


def _print_plan(plan: dict[str, Any], *, err: bool) -> None:
    """Print the plan of a session, with `err` to standard error."""
    from rigd.runner import plan_lines

    for line in plan_lines(plan):
        typer.echo(line, err=err)
