"""Sessions in the foreground: plan, tell the operator, run with progress, tell how it ended."""

import contextlib
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import typer

from rigd.beam import RealisationError
from rigd.control import ControlDesignError
from rigd.devices import Reality, UnknownDeviceError, simulated_differently, what_moves
from rigd.engine import Event
from rigd.excitation import Excitation, ExcitationError
from rigd.profile import Profile, ProfileError
from rigd.runner._planning import Plan, RefusedError, plan_session
from rigd.runner._process_group import Crew
from rigd.runner._request import (
    NoRoomError,
    Order,
    choose_path,
    load_rig,
    make_room,
    what_is_kept,
)
from rigd.runner._rig import Rig, RigError
from rigd.runner._session import SessionFailedError, SessionProgress, SessionResult
from rigd.runtime import RigBusyError, RigLock, StopRequest

_TERMINAL_PATIENCE_S = 2.0

Tell = Callable[[str], None]


class ForegroundError(Exception):
    """No session, or no further one; the message is for the operator.

    Parameters
    ----------
    message
        Text for the operator.
    wrong_use
        Whether the command was wrong, and not the rig.
    results
        Sessions that ended before.
    """

    def __init__(
        self, message: str, *, wrong_use: bool, results: Sequence[SessionResult] = ()
    ) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use
        self.results = list(results)
        """The sessions before, and the one that failed."""


def run_in_foreground(
    build: Callable[[Profile], Excitation],
    crew: Crew,
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
    quiet_stdout: bool,
    hardware: bool = False,
    prepare: Callable[[Profile], Profile] | None = None,
) -> list[SessionResult]:
    """Run `repeat` sessions, up to a stop or the first that does not end well.

    Parameters
    ----------
    build
        Makes the excitation for a rig.
    crew
        The processes, started but not yet needed; ended when this returns.
    stop
        The operator's.
    profile_name
        Name or path of the profile.
    folder
        Where the files go; made if it does not exist.
    repeat, seed, notes, fast, live, force, hardware
        As on the command line. The sessions of a series follow each other on one connection: each
        waits until the beam has come to rest.
    quiet_stdout
        Tell the operator on standard error, because standard output is for a document.
    prepare
        Changes the profile before it is planned with.

    Raises
    ------
    ForegroundError
        If a session is refused (wrong use) or cannot be run.
    """
    tell: Tell = partial(_tell, err=quiet_stdout)
    results: list[SessionResult] = []
    try:
        # The rig is given up last, when nobody has hold of the devices any more.
        with contextlib.ExitStack() as reserved, crew:
            profile, moving = load_rig(profile_name, fast=fast, seed=seed, hardware=hardware)
            if prepare is not None:
                profile = prepare(profile)
            _tell(what_moves(profile.rig, moving), err=True)
            for difference in simulated_differently(profile.rig):
                tell(f"Warning: the simulated rig has {difference}.")
            alone = not (fast and moving is Reality.SIMULATED)
            shared = moving is Reality.HARDWARE
            reserved.enter_context(RigLock(profile.name, "rigd run", hardware=shared, alone=alone))
            excitation = build(profile)
            plan = plan_session(profile, excitation, force=force)
            _tell_plan(tell, profile, excitation, plan)
            make_room(folder, excitation, profile.limits)
            rig = Rig(profile, fast=fast, crew=crew)
            told_where = ""
            if not stop.requested:
                rig.connect(moving)
            for number in range(1, repeat + 1):
                if stop.requested:
                    break
                make_room(folder, excitation, profile.limits)
                path = choose_path(folder, excitation.kind, number if repeat > 1 else None)
                given = {name: text for name, text in notes.items() if text}
                if repeat > 1:
                    given["series"] = f"{number} of {repeat}"
                order = Order(profile, excitation, path, tuple(given.items()))
                if live and (where := rig.show(order, stop)) != told_where:
                    tell(where)
                    told_where = where
                with _ProgressView(excitation.reference_rad.size) as view:
                    results.append(rig.run(order, stop, view.update))
                _tell_result(tell, results[-1])
                if not results[-1].went_well:
                    break
        if stop.requested:
            _tell_stop(results, repeat)
    except NoRoomError as error:
        raise ForegroundError(str(error), wrong_use=not results, results=results) from error
    except (
        ProfileError,
        UnknownDeviceError,
        ExcitationError,
        RefusedError,
        ControlDesignError,
        RealisationError,
    ) as error:
        raise ForegroundError(str(error), wrong_use=True) from error
    except RigBusyError as error:
        raise ForegroundError(str(error), wrong_use=False) from error
    except SessionFailedError as error:
        text = f"{error} {what_is_kept(error.path)}"
        results.append(error.result())
        raise ForegroundError(text, wrong_use=False, results=results) from error
    except RigError as error:
        raise ForegroundError(str(error), wrong_use=False, results=results) from error
    return results


def _tell(text: str, *, err: bool) -> None:
    with contextlib.suppress(OSError):  # the terminal is gone; the session is not
        typer.echo(text, err=err)


def _tell_plan(tell: Tell, profile: Profile, excitation: Excitation, plan: Plan) -> None:
    duration_s = excitation.reference_rad.size / profile.rig.rate_hz
    predicted, limits = plan.prediction, profile.limits
    tell(f"{excitation.kind} on {profile.name}: {duration_s:g} s of record.")
    tell(
        f"Predicted peaks: angle {predicted.peak_angle_rad:.3g} of {limits.angle_rad:g} rad, "
        f"speed {predicted.peak_velocity_rad_s:.3g} of {limits.velocity_rad_s:g} rad/s, "
        f"torque {predicted.peak_torque_nm:.3g} of {profile.rig.motor.peak_torque_nm:g} N·m."
    )
    if plan.tip_in_words:
        tell(plan.tip_in_words)
    for warning in plan.warnings:
        tell(f"Warning: {warning}")


def _tell_stop(results: Sequence[SessionResult], repeat: int) -> None:
    """Tell of a stop between two sessions or before the first; within one, the session tells."""
    if len(results) == repeat or any(not result.went_well for result in results):
        return
    after = f" after {len(results)} of {repeat} sessions" if results else ""
    _tell(f"stopped: no record{after}. Stopped by the operator before the session began.", err=True)


def _tell_result(tell: Tell, result: SessionResult) -> None:
    counts = (
        f"{result.scheduled} ticks scheduled = {result.recorded} recorded + {result.missed} "
        f"missed + {result.lost} lost; {result.late} late; {result.stale_angles} stale angles, "
        f"{result.stale_wrenches} stale wrenches."
    )
    if result.path is None:
        tell(f"{result.outcome}: no record. {result.reason}")
    else:
        tell(f"{result.outcome}: {counts}{' ' + result.reason if result.reason else ''}")
        if result.live_dropped:
            tell(f"The live view missed {result.live_dropped} samples; the file has them.")
        tell(str(result.path))


class _ProgressView:
    """One line that says how far the session is and how long it still takes.

    It is written by a thread of its own: a terminal that was stopped (Ctrl-S), or a pipe that
    nobody reads, must not keep the supervisor from its session.
    """

    def __init__(self, ticks: int) -> None:
        # Only now: the processes of the session are on their way.
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[counts]}"),
            console=Console(stderr=True),
            transient=True,
            auto_refresh=False,
        )
        self._task = self._progress.add_task("preparing", total=ticks, counts="")

        self._lock = threading.Lock()
        self._state: SessionProgress | None = None
        self._events: list[Event] = []
        self._ended = False
        self._changed = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> "_ProgressView":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._changed.set()
        self._thread.join(_TERMINAL_PATIENCE_S)

    def update(self, state: SessionProgress, events: list[Event]) -> None:
        """Show the progress of the session, and its events."""
        with self._lock:
            self._state = state
            self._events += events
        self._changed.set()

    def _work(self) -> None:
        with contextlib.suppress(OSError):
            self._progress.start()
        while not self._ended:
            self._changed.wait()
            self._changed.clear()
            with self._lock:
                state, events = self._state, self._events
                self._events = []
            if state is not None:
                with contextlib.suppress(OSError):
                    self._show(state, events)
        with contextlib.suppress(OSError):
            self._progress.stop()

    def _show(self, state: SessionProgress, events: list[Event]) -> None:
        for event in events:
            if event.level in ("warning", "error", "fatal"):
                self._progress.console.print(
                    f"{event.level.capitalize()}: {event.message}",
                    markup=False,
                    highlight=False,
                    soft_wrap=True,
                )
        self._progress.update(
            self._task,
            description=state.phase.words,
            completed=state.tick,
            counts=f"{state.missed} missed, {state.late} late" if state.missed else "",
        )
        self._progress.refresh()
