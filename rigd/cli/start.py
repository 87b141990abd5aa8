"""Implementation of ``rigd start`` (sessions that the daemon runs), and start of processes."""

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

from rigd.cli.daemon import DaemonProfile, daemon_client
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
    fail,
    print_error,
    session_notes,
)
from rigd.errors import RigdError

if TYPE_CHECKING:
    from rigd.daemon.client import Client
    from rigd.excitation import OptionValue
    from rigd.runner import ProcessGroup
    from rigd.runtime import StopRequest


_EVENT_TIMEOUT_S = 0.2
"""Longest wait in seconds for an event of the daemon, after which Ctrl-C is checked."""
_QUICK_LOOK_TIMEOUT_S = 10.0
"""Longest wait in seconds for the last quick look after the end of a series."""


class SessionCommands(TyperGroup):
    """Group of commands that run sessions, which handles a Ctrl-C before a session begins.

    After :func:`start_processes` a Ctrl-C stops the session, and the session reports it.
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
    *, with_live_view: bool, with_touch: bool = False, with_online_fit: bool = False
) -> "tuple[StopRequest, ProcessGroup]":
    """Make Ctrl-C a request to stop the session, and start the processes of the first session.

    The processes import their modules while the command imports others and plans the session.
    """
    from rigd.engine.workers import FIT, TOUCH
    from rigd.runner import ProcessGroup
    from rigd.runtime import StopRequest

    stop_request = StopRequest()
    stop_request.catch_signals()
    try:
        extra_processes = [
            extra_process
            for extra_process, is_needed in ((TOUCH, with_touch), (FIT, with_online_fit))
            if is_needed
        ]
        return stop_request, ProcessGroup(
            with_live_view=with_live_view, extra_processes=extra_processes
        )
    except OSError as error:
        fail(
            f"The processes of a session cannot be started ({error.strerror}); check the limits "
            "of open files (ulimit -n) and of shared memory (/dev/shm).",
            EXIT_FAILED,
        )


def start_sessions(
    excitation_kind: str,
    parameters: "Mapping[str, OptionValue]",
    profile: DaemonProfile = None,
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

    session_metadata: dict[str, Any] = {}
    for key, note_text in session_notes(operator, specimen, note, meta).items():
        if key.startswith(META_PREFIX):  # an older daemon does not know the member
            session_metadata.setdefault("meta", {})[key.removeprefix(META_PREFIX)] = note_text
        else:
            session_metadata[key] = note_text
    for parameter_name, parameter_value in {**parameters, "tip_slope_rad": tip_slope_rad}.items():
        if isinstance(parameter_value, float) and not isfinite(parameter_value):
            fail(
                f"{parameter_name} = {parameter_value} is not a finite number; give one.",
                EXIT_WRONG_USE,
            )
    start_request = {
        "excitation": excitation_kind,
        "parameters": {
            parameter_name: str(parameter_value.absolute())
            if isinstance(parameter_value, Path)
            else parameter_value
            for parameter_name, parameter_value in parameters.items()
        },
        "repeat": repeat,
        "notes": session_metadata,
        "force": force,
    }
    if watch_fit:  # an older daemon does not know the member
        start_request["watch_fit"] = True
    if accept:  # likewise
        start_request["accept"] = accept
    if tip_slope_rad is not None:  # likewise
        start_request["tip_slope_rad"] = tip_slope_rad
    with daemon_client(profile) as client:
        daemon_status = client.ask("status")["daemon"]
        typer.echo(daemon_status["what_moves"], err=True)
        if not detach:
            client.ask("watch")
        with _InterruptCounter.counting_presses() as interrupts:
            start_reply = client.request_unless_stopped(
                lambda: interrupts.count > 0, "start", **start_request
            )
            if start_reply["reply"] == "stop":
                typer.echo("Stopped before the session began.", err=True)
                if as_json and not detach:
                    _write_json([])
                raise typer.Exit(EXIT_INTERRUPTED)
            if detach and interrupts.count:
                client.ask("stop")
                raise typer.Exit(EXIT_INTERRUPTED)
            progress_advice = "rigd status shows the progress, rigd stop ends the session."
            try:
                _print_plan(start_reply["plan"], to_stderr=as_json)
                if detach:
                    typer.echo(
                        json.dumps({"series": start_reply["series"]})
                        if as_json
                        else f"Running; {progress_advice}"
                    )
            except OSError as error:  # the sessions run nevertheless
                if detach:
                    fail(
                        f"Running, but the output cannot be written ({error.strerror}); "
                        f"{progress_advice}",
                        EXIT_FAILED,
                    )
            if detach:
                return
            # An older daemon makes no quick looks, or does not report for which sessions.
            makes_quick_looks = daemon_status.get("quick_looks", False)
            session_results: list[dict[str, Any]] = []
            try:
                series_event = _follow_series(
                    client,
                    start_reply["series"],
                    interrupts,
                    session_results,
                    as_json=as_json,
                    makes_quick_looks=makes_quick_looks,
                )
            except (typer.Exit, RigdError):
                if as_json:
                    with contextlib.suppress(OSError):  # the exception has precedence
                        _write_json(session_results)
                raise
    if as_json:
        _write_json(session_results)
    if series_event["failed"]:
        print_error(series_event["reason"])
        raise typer.Exit(EXIT_FAILED)
    if series_event["stopped"]:
        if series_event["reason"] and not (session_results and session_results[-1]["reason"]):
            typer.echo(series_event["reason"], err=True)
        raise typer.Exit(EXIT_INTERRUPTED)


class _InterruptCounter:
    """Counter of presses of Ctrl-C: the first requests a stop, the second ends the command."""

    def __init__(self) -> None:
        self.count = 0

    @classmethod
    @contextmanager
    def counting_presses(cls) -> Iterator["_InterruptCounter"]:
        """Count Ctrl-C within this context instead of raising KeyboardInterrupt."""
        interrupts = cls()
        previous_handler = signal.signal(signal.SIGINT, lambda *_: interrupts.add_press())
        try:
            yield interrupts
        finally:
            signal.signal(signal.SIGINT, previous_handler)

    def add_press(self) -> None:
        """Register one press of Ctrl-C."""
        self.count += 1


def _follow_series(
    client: "Client",
    series_number: int,
    interrupts: _InterruptCounter,
    session_results: list[dict[str, Any]],
    *,
    as_json: bool,
    makes_quick_looks: bool,
) -> dict[str, Any]:
    """Show the progress of a series of sessions until its end, and return its final event.

    The result of each session is appended to `session_results` when the session has ended.
    """
    from rigd.daemon.client import DaemonUnreachableError
    from rigd.engine.shared_state import Phase
    from rigd.runner import ProgressLine, result_line
    from rigd.runner.quick_looks import QuickLook
    from rigd.session.quick_look import quick_look_path

    is_stop_sent = False
    ended_session_count = 0
    awaited_quick_looks: set[str] = set()
    final_event: dict[str, Any] | None = None
    interrupts_at_end, deadline_s = 0, 0.0
    progress_line = ProgressLine()
    try:
        while final_event is None or (awaited_quick_looks and time.monotonic() < deadline_s):
            if final_event is not None and interrupts.count > interrupts_at_end:
                break
            if interrupts.count and not is_stop_sent:
                is_stop_sent = True
                client.send("stop")
                progress_line.write_message(
                    "Stopping; press Ctrl-C again to leave while the daemon finishes."
                )
            if final_event is None and interrupts.count > 1:
                raise typer.Exit(EXIT_INTERRUPTED)
            try:
                daemon_event = client.next_event(_EVENT_TIMEOUT_S) or {}
            except DaemonUnreachableError:
                if final_event is None:
                    raise
                # The sessions have ended, and their results are known.
                progress_line.write_message("No quick look: the connection to the daemon is lost.")
                break
            match daemon_event.get("event"):
                # No bar between two sessions, where it would mix with the printed path.
                case "progress" if daemon_event["session"] > ended_session_count:
                    progress_line.update(
                        Phase[daemon_event["phase"].upper()],
                        daemon_event["tick"],
                        daemon_event["total"],
                        missed_ticks=daemon_event["missed"],
                        late_ticks=daemon_event["late"],
                        session_number_text=f"{daemon_event['session']}/{daemon_event['repeat']}"
                        if daemon_event["repeat"] > 1
                        else "",
                    )
                case "message" if "session" in daemon_event:
                    pass  # the end of a session is reported by the event of that name
                case "message" if daemon_event["level"] != "info":
                    progress_line.write_message(
                        f"{daemon_event['level'].capitalize()}: {daemon_event['text']}"
                    )
                case "message" if daemon_event.get("notable") or daemon_event["text"].startswith(
                    "Live view"
                ):
                    progress_line.write_message(daemon_event["text"])
                case "session":
                    session_results.append(
                        {"look": None}
                        | {
                            key: value
                            for key, value in daemon_event.items()
                            if key not in ("event", "number", "look_follows")
                        }
                    )
                    progress_line.write_message(result_line(daemon_event))
                    progress_line.close()  # standard output may be the same terminal
                    if daemon_event["path"] is not None:
                        if not as_json:
                            with contextlib.suppress(OSError):  # the series continues
                                typer.echo(daemon_event["path"])
                        if daemon_event.get("look_follows", makes_quick_looks):
                            awaited_quick_looks.add(daemon_event["path"])
                    progress_line, ended_session_count = ProgressLine(), daemon_event["number"]
                case "quick_look" if daemon_event["path"] in awaited_quick_looks:
                    awaited_quick_looks.discard(daemon_event["path"])
                    quick_look = QuickLook.from_event(daemon_event)
                    for session_result in session_results:
                        if session_result["path"] == daemon_event["path"] and quick_look.path:
                            session_result["look"] = str(quick_look.path)
                    for log_text in quick_look.lines:
                        progress_line.write_message(log_text)
                case "series" if daemon_event["series"] == series_number:
                    final_event, interrupts_at_end = daemon_event, interrupts.count
                    deadline_s = time.monotonic() + _QUICK_LOOK_TIMEOUT_S
                    if awaited_quick_looks:
                        progress_line.write_message("Quick look at the session; Ctrl-C skips it.")
        else:
            for session_path in sorted(awaited_quick_looks):
                progress_line.write_message(
                    "No quick look yet: the daemon still makes it; it will be "
                    f"{quick_look_path(Path(session_path))}."
                )
    finally:
        progress_line.close()
    return final_event


def _write_json(session_results: list[dict[str, Any]]) -> None:
    """Write the results of the sessions to standard output as JSON."""
    typer.echo(json.dumps({"sessions": session_results}))


def _print_plan(plan: dict[str, Any], *, to_stderr: bool) -> None:
    """Print the plan of a session to standard output, or to standard error if `to_stderr`."""
    from rigd.runner import plan_lines

    for plan_line in plan_lines(plan):
        typer.echo(plan_line, err=to_stderr)
