"""Sessions in the foreground: plan them, show their progress, and print their results."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final, Self

import typer

from rigd.checks import check_on_paper
from rigd.devices import ActuationTarget, describe_actuation_target, simulated_differently
from rigd.engine.shared_state import LogEvent
from rigd.errors import FailureError, RigdError
from rigd.excitation import Excitation
from rigd.profile import Profile, with_specimen
from rigd.runner._console import ProgressLine, plan_lines, result_line
from rigd.runner._process_group import ProcessGroup
from rigd.runner._rig import Rig
from rigd.runner._series import Series
from rigd.runner._tip_slope import with_tip_slope
from rigd.runner.quick_looks import QuickLook, QuickLooks
from rigd.runner.request import load_rig, remaining_file_text
from rigd.runner.session import RunResult, SessionFailedError, SessionProgress
from rigd.runtime import RigLock, StopRequest

_QUICK_LOOK_PATIENCE_S: Final = 10.0
"""Longest run time of the last quick look after the end, without the time in which other programs
use the processor."""
_LONGEST_QUICK_LOOK_S: Final = 120.0
"""Longest total wait for it."""
_POLL_S: Final = 0.05

_Print = Callable[[str], None]


class SeriesFailedError(FailureError):
    """A session of a series could not be run, or failed.

    Parameters
    ----------
    message
        Reason, for the operator.
    results
        Results of the earlier sessions, and of the failed session if it had begun.

    Attributes
    ----------
    results
        The same results as a list.
    """

    def __init__(self, message: str, results: Sequence[RunResult] = ()) -> None:
        super().__init__(message)
        self.results = list(results)


def run_in_foreground(
    build: Callable[..., Excitation],
    group: ProcessGroup,
    stop: StopRequest,
    *,
    profile_name: str,
    folder: Path,
    repeat: int,
    seed: int | None,
    notes: Mapping[str, str],
    fast: bool,
    live: bool,
    force: bool,
    accept: Sequence[str] = (),
    quiet_stdout: bool,
    hardware: bool = False,
    quick_look: bool = False,
    from_angle: bool = False,
    prepare: Callable[[Profile], Profile] | None = None,
    obstacles: Sequence[str] = (),
    watch_fit: bool = False,
    identifies_motor: bool = False,
    tip_slope_rad: float | None = None,
) -> list[RunResult]:
    """Run `repeat` sessions; end at a stop or at the first incomplete session.

    Parameters
    ----------
    build
        Returns the excitation for a profile.
    group
        The started processes. They are ended when this function returns.
    stop
        Stop request of the operator.
    profile_name
        Name or path of the profile.
    folder
        Folder of the session files; created if it does not exist.
    repeat, seed, notes, fast, live, force, accept, hardware
        As on the command line. The sessions of a series use one connection. Each session waits
        until the beam is at rest.
    quiet_stdout
        Print all text on standard error, because standard output is reserved for a document.
    quick_look
        Make a quick look at each session, and wait some seconds for the last one.
    from_angle
        The excitation depends on the motor angle. The rig is connected first, and `build` receives
        the angle as ``start_rad``.
    prepare
        Returns a modified profile, applied before planning.
    obstacles
        Obstacles of a simulated beam, as on the command line.
    watch_fit
        Fit each record while it is recorded, and print the fits.
    identifies_motor
        See :class:`rigd.runner._series.Series`.
    tip_slope_rad
        Largest tip slope of an identification; None: the limit of the profile.

    Raises
    ------
    UserError
        If a session is refused before the first one is run.
    SeriesFailedError
        If a session cannot be run, or failed.
    """
    write: _Print = partial(_print, err=quiet_stdout)
    results: list[RunResult] = []

    def report(quick_look: QuickLook) -> None:
        quick_look.note(results)
        for line in quick_look.lines:
            write(line)

    quick_looks = QuickLooks(report) if quick_look else None
    try:
        # The rig is released last, when no process uses the devices any more.
        with contextlib.ExitStack() as reserved, group:
            profile, moving = load_rig(
                profile_name, fast=fast, seed=seed, hardware=hardware, obstacles=obstacles
            )
            specimen = notes.get("specimen", "")
            check_on_paper(with_specimen(profile, specimen), accept).require()
            if prepare is not None:
                profile = prepare(profile)
            profile = with_tip_slope(profile, tip_slope_rad)
            mounted = with_specimen(profile, specimen)
            _print(describe_actuation_target(profile.rig, moving), err=True)
            for difference in simulated_differently(profile.rig):
                write(f"Warning: the simulated rig has {difference}.")
            alone = not (fast and moving is ActuationTarget.SIMULATED)
            shared = moving is ActuationTarget.HARDWARE
            reserved.enter_context(RigLock(profile.name, "rigd run", hardware=shared, alone=alone))
            rig = Rig(profile, fast=fast, group=group)
            if from_angle and not stop.requested:
                rig.connect(moving)
                build = partial(build, start_rad=rig.angle_rad)
            series = Series(
                mounted,
                build(mounted),
                folder,
                repeat=repeat,
                notes=notes,
                force=force,
                accept=accept,
                watch_fit=watch_fit,
                identifies_motor=identifies_motor,
            )
            results = series.results
            for line in plan_lines(series.plan_document()):
                write(line)
            if not (stop.requested or rig.connected):
                rig.connect(moving)
            with _Operator(series.ticks, repeat, write) as operator:
                series.run(rig, stop, operator, live=live, quick_looks=quick_looks)
        if stop.requested:
            _print_stop(results, repeat)
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


class _Operator:
    """Print the progress and the results of a series of sessions."""

    def __init__(self, ticks: int, repeat: int, write: _Print) -> None:
        self._ticks = ticks
        self._repeat = repeat
        self._print = write
        self._line: ProgressLine | None = None
        self._number = ""
        self._where = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def begins(self, number: int, path: Path) -> None:  # noqa: ARG002 - printed when it exists
        self._number = f"{number}/{self._repeat}" if self._repeat > 1 else ""
        self._line = ProgressLine()

    def says(self, level: str, text: str) -> None:
        self._print(f"Warning: {text}" if level == "warning" else text)

    def shown(self, where: str) -> None:
        if where != self._where:
            self._print(where)
            self._where = where

    def update(self, progress: SessionProgress, events: list[LogEvent]) -> None:
        assert self._line is not None
        for event in events:
            if event.level in ("warning", "error", "fatal"):
                self._line.say(f"{event.level.capitalize()}: {event.message}")
            elif event.notable:
                self._line.say(event.message)
        self._line.update(
            progress.phase,
            progress.tick,
            self._ticks,
            missed=progress.missed,
            late=progress.late,
            number=self._number,
        )

    def ended(self, result: RunResult, *, look_follows: bool) -> None:  # noqa: ARG002
        self._close()
        self._print(result_line(result.as_dict()))
        if result.path is not None:
            if result.live_dropped:
                self._print(f"The viewer dropped {result.live_dropped} samples; the file has them.")
            self._print(str(result.path))

    def _close(self) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None


def _print(text: str, *, err: bool) -> None:
    with contextlib.suppress(OSError):  # the terminal is gone; the session is not
        typer.echo(text, err=err)


def _await_quick_looks(quick_looks: QuickLooks, stop: StopRequest) -> None:
    """Wait for the last quick looks; another Ctrl-C skips them."""
    stop.sessions_are_over()
    before, skipped = stop.requested, False

    def skip() -> None:
        nonlocal skipped
        skipped = True

    stop.on_request = skip
    quick_looks.poll()
    if quick_looks.busy:
        _print("Quick look at the session; Ctrl-C skips it.", err=True)
    deadline_s = time.monotonic() + _LONGEST_QUICK_LOOK_S
    while (
        quick_looks.busy
        and not skipped
        and quick_looks.spent_s < _QUICK_LOOK_PATIENCE_S
        and time.monotonic() < deadline_s
    ):
        time.sleep(_POLL_S)
        quick_looks.poll()
    if quick_looks.busy and not skipped:
        why = (
            "took too long"
            if quick_looks.spent_s >= _QUICK_LOOK_PATIENCE_S
            else "got no processor time"
        )
        _print(
            f"The quick look {why} and was skipped: python -m analysis.quick_look FILE makes it.",
            err=True,
        )
    stop.requested = before  # this Ctrl-C skipped the quick look only


def _print_stop(results: Sequence[RunResult], repeat: int) -> None:
    """Report a stop between two sessions or before the first one; a session reports its own."""
    if len(results) == repeat or any(not result.went_well for result in results):
        return
    after = f" after {len(results)} of {repeat} sessions" if results else ""
    _print(
        f"Stopped: no record{after}. Stopped by the operator before the session began.", err=True
    )
