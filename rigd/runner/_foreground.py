"""Sessions of `rigd run`: plan them, show their progress, and print their results."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final, Self

import typer

from rigd.checks import run_offline_checks
from rigd.devices import ActuationTarget, describe_actuation_target, simulation_differences
from rigd.engine.shared_state import LogEvent
from rigd.errors import FailureError, RigdError
from rigd.excitation import Excitation
from rigd.profile import Profile, with_specimen
from rigd.runner._console import ProgressLine, plan_lines, result_line
from rigd.runner._process_group import ProcessGroup
from rigd.runner._rig import Rig
from rigd.runner._series import Series
from rigd.runner._tip_slope import with_tip_slope
from rigd.runner.quick_looks import QuickLook, QuickLookQueue
from rigd.runner.request import load_rig, remaining_file_text
from rigd.runner.session import SessionFailedError, SessionProgress, SessionResult
from rigd.runtime import StopRequest
from rigd.runtime.locks import RigLock

_QUICK_LOOK_MAX_RUN_TIME_S: Final = 10.0
"""Maximum run time in seconds of the last quick look after the sessions, without the time in which
it waits for the processor."""
_QUICK_LOOK_MAX_WAIT_S: Final = 120.0
"""Maximum time in seconds to wait for the last quick look, whatever time it has run."""
_POLL_INTERVAL_S: Final = 0.05

_PrintLine = Callable[[str], None]
"""Function that prints a line for the operator."""


class SeriesFailedError(FailureError):
    """Raised if a session of a series could not be run, or failed.

    Parameters
    ----------
    message
        Reason for the operator.
    results
        Results of the earlier sessions, and of the failed session if it had begun.

    Attributes
    ----------
    results
        The argument as a list.
    """

    def __init__(self, message: str, results: Sequence[SessionResult] = ()) -> None:
        super().__init__(message)
        self.results = list(results)


def run_in_foreground(
    build_excitation: Callable[..., Excitation],
    group: ProcessGroup,
    stop: StopRequest,
    *,
    profile_name: str,
    folder: Path,
    session_count: int,
    seed: int | None,
    notes: Mapping[str, str],
    uses_virtual_clock: bool,
    with_live_view: bool,
    allows_saturation: bool,
    accepted_row_names: Sequence[str] = (),
    quiet_stdout: bool,
    force_hardware: bool = False,
    with_quick_looks: bool = False,
    starts_at_present_angle: bool = False,
    prepare_profile: Callable[[Profile], Profile] | None = None,
    obstacles: Sequence[str] = (),
    watch_fit: bool = False,
    identifies_motor: bool = False,
    tip_slope_rad: float | None = None,
) -> list[SessionResult]:
    """Run a series of sessions for `rigd run`, and return the results.

    The series ends early after a stop or an incomplete session.

    Parameters
    ----------
    build_excitation
        Function that returns the excitation for a profile.
    group
        Started processes of the rig. They are ended when this function returns.
    stop
        Stop request of the operator.
    profile_name
        Name or path of the profile.
    folder
        Folder of the session files; created if it does not exist.
    session_count, seed, notes, allows_saturation, accepted_row_names
        Options of the command line. The rig is connected once for all sessions. Each session waits
        until the beam is at rest.
    uses_virtual_clock, with_live_view, force_hardware
        Options ``--fast``, ``--live`` and ``--hardware`` of the command line.
    quiet_stdout
        Print all text to standard error, because standard output is reserved for a JSON document.
    with_quick_looks
        Make a quick look at each session, and wait some seconds for the last one.
    starts_at_present_angle
        Whether the excitation depends on the present motor angle. The rig is then connected before
        planning, and `build_excitation` receives the angle as ``start_angle_rad``.
    prepare_profile
        Function that returns a modified profile before the sessions are planned.
    obstacles
        Obstacles of a simulated beam, as on the command line.
    watch_fit
        Fit each record repeatedly during the session, and print the estimates.
    identifies_motor
        See :class:`rigd.runner._series.Series`.
    tip_slope_rad
        Maximum tip slope of an identification, or None for the limit of the profile.

    Raises
    ------
    UserError
        If a session is refused before the first session is run.
    SeriesFailedError
        If a session cannot be run, or failed.
    """
    print_line: _PrintLine = partial(_print, to_stderr=quiet_stdout)
    results: list[SessionResult] = []

    def print_quick_look(quick_look: QuickLook) -> None:
        quick_look.add_path_to_results(results)
        for report_line in quick_look.lines:
            print_line(report_line)

    quick_looks = QuickLookQueue(print_quick_look) if with_quick_looks else None
    try:
        # The lock of the rig is released last, when no process uses the devices any more.
        with contextlib.ExitStack() as locks, group:
            profile, target = load_rig(
                profile_name,
                uses_virtual_clock=uses_virtual_clock,
                seed=seed,
                force_hardware=force_hardware,
                obstacles=obstacles,
            )
            specimen = notes.get("specimen", "")
            run_offline_checks(
                with_specimen(profile, specimen), accepted_row_names
            ).require_passed()
            if prepare_profile is not None:
                profile = prepare_profile(profile)
            profile = with_tip_slope(profile, tip_slope_rad)
            specimen_profile = with_specimen(profile, specimen)
            _print(describe_actuation_target(profile.rig, target), to_stderr=True)
            for difference in simulation_differences(profile.rig):
                print_line(f"Warning: the simulated rig has {difference}.")
            is_exclusive = not (uses_virtual_clock and target is ActuationTarget.SIMULATED)
            is_hardware = target is ActuationTarget.HARDWARE
            locks.enter_context(
                RigLock(profile.name, "rigd run", hardware=is_hardware, exclusive=is_exclusive)
            )
            rig = Rig(profile, uses_virtual_clock=uses_virtual_clock, group=group)
            if starts_at_present_angle and not stop.requested:
                rig.connect(target)
                build_excitation = partial(build_excitation, start_angle_rad=rig.angle_rad)
            session_series = Series(
                specimen_profile,
                build_excitation(specimen_profile),
                folder,
                session_count=session_count,
                notes=notes,
                allows_saturation=allows_saturation,
                accepted_row_names=accepted_row_names,
                watch_fit=watch_fit,
                identifies_motor=identifies_motor,
            )
            results = session_series.results
            for line in plan_lines(session_series.plan_document()):
                print_line(line)
            if not (stop.requested or rig.connected):
                rig.connect(target)
            with _TerminalProgress(
                session_series.record_ticks, session_count, print_line
            ) as operator:
                session_series.run(
                    rig, stop, operator, with_live_view=with_live_view, quick_looks=quick_looks
                )
        if stop.requested:
            _print_stop_message(results, session_count)
        if quick_looks is not None:
            _await_quick_looks(quick_looks, stop)
    except SessionFailedError as error:
        # The processes have ended, so that the remaining file can be reported.
        results.append(error.result())
        raise SeriesFailedError(f"{error} {remaining_file_text(error.path)}", results) from error
    except RigdError as error:
        if error.wrong_use and not results:
            raise
        raise SeriesFailedError(str(error), results) from error
    finally:
        if quick_looks is not None:
            quick_looks.close()
    return results


class _TerminalProgress:
    """Listener of a series of sessions that prints progress and results to the terminal."""

    def __init__(self, record_ticks: int, session_count: int, print_line: _PrintLine) -> None:
        self._record_ticks = record_ticks
        self._session_count = session_count
        self._print = print_line
        self._progress_line: ProgressLine | None = None
        self._session_number_text = ""
        self._last_view_text = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def on_start(self, session_number: int, session_path: Path) -> None:  # noqa: ARG002 - printed when it exists
        self._session_number_text = (
            f"{session_number}/{self._session_count}" if self._session_count > 1 else ""
        )
        self._progress_line = ProgressLine()

    def on_message(self, level: str, message_text: str) -> None:
        self._print(f"Warning: {message_text}" if level == "warning" else message_text)

    def on_live_view(self, live_view_text: str) -> None:
        if live_view_text != self._last_view_text:
            self._print(live_view_text)
            self._last_view_text = live_view_text

    def on_progress(self, progress: SessionProgress, events: list[LogEvent]) -> None:
        assert self._progress_line is not None
        for event in events:
            if event.level in ("warning", "error", "fatal"):
                self._progress_line.write_message(f"{event.level.capitalize()}: {event.message}")
            elif event.notable:
                self._progress_line.write_message(event.message)
        self._progress_line.update(
            progress.phase,
            progress.tick,
            self._record_ticks,
            missed_ticks=progress.missed,
            late_ticks=progress.late,
            session_number_text=self._session_number_text,
        )

    def on_result(self, result: SessionResult, *, look_follows: bool) -> None:  # noqa: ARG002
        self._close()
        self._print(result_line(result.as_dict()))
        if result.path is not None:
            if result.live_dropped:
                self._print(f"The viewer dropped {result.live_dropped} samples; the file has them.")
            self._print(str(result.path))

    def _close(self) -> None:
        if self._progress_line is not None:
            self._progress_line.close()
            self._progress_line = None


def _print(printed_text: str, *, to_stderr: bool) -> None:
    """Print a line to standard error if `to_stderr` is True, else to standard output."""
    with contextlib.suppress(OSError):  # the session continues without a terminal
        typer.echo(printed_text, err=to_stderr)


def _await_quick_looks(quick_looks: QuickLookQueue, stop: StopRequest) -> None:
    """Wait for the last quick looks to be completed, up to a time limit or another Ctrl-C."""
    stop.ignore_stop_signal()
    was_stopped, is_skipped = stop.requested, False

    def skip_quick_looks() -> None:
        nonlocal is_skipped
        is_skipped = True

    stop.on_request = skip_quick_looks
    quick_looks.poll()
    if quick_looks.is_busy:
        _print("Quick look at the session; Ctrl-C skips it.", to_stderr=True)
    deadline_s = time.monotonic() + _QUICK_LOOK_MAX_WAIT_S
    while (
        quick_looks.is_busy
        and not is_skipped
        and quick_looks.run_time_s < _QUICK_LOOK_MAX_RUN_TIME_S
        and time.monotonic() < deadline_s
    ):
        time.sleep(_POLL_INTERVAL_S)
        quick_looks.poll()
    if quick_looks.is_busy and not is_skipped:
        skip_reason = (
            "took too long"
            if quick_looks.run_time_s >= _QUICK_LOOK_MAX_RUN_TIME_S
            else "got no processor time"
        )
        _print(
            f"The quick look {skip_reason} and was skipped: python -m analysis.quick_look FILE "
            "makes it.",
            to_stderr=True,
        )
    stop.requested = was_stopped  # this Ctrl-C skipped the quick look only


def _print_stop_message(results: Sequence[SessionResult], session_count: int) -> None:
    """Print that a stop was requested before the first session or between two sessions.

    Nothing is printed if a session itself was stopped, because its result states the stop.
    """
    if len(results) == session_count or any(not result.is_successful for result in results):
        return
    session_count_text = f" after {len(results)} of {session_count} sessions" if results else ""
    _print(
        f"Stopped: no record{session_count_text}. Stopped by the operator before the session "
        "began.",
        to_stderr=True,
    )
