"""Sessions in the foreground: plan, tell the operator, run with progress, tell how it ended."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import typer

from rigd.beam import RealisationError
from rigd.control import ControlDesignError
from rigd.devices.registry import Reality, UnknownDeviceError, simulated_differently
from rigd.engine.events import Event
from rigd.engine.signals import StopRequest
from rigd.excitation import Excitation, ExcitationError
from rigd.planning import Plan, RefusedError, plan_session
from rigd.profile import Profile, ProfileError
from rigd.supervisor.crew import Crew
from rigd.supervisor.lock import RigBusyError, RigLock
from rigd.supervisor.orders import (
    NoRoomError,
    Order,
    choose_path,
    load_rig,
    make_room,
    what_is_kept,
)
from rigd.supervisor.rig import Rig, RigError
from rigd.supervisor.session import SessionFailedError, SessionProgress, SessionResult

Tell = Callable[[str], None]


class ForegroundError(Exception):
    """No session, or no further one; the message is for the operator."""

    def __init__(
        self, message: str, *, wrong_use: bool, results: Sequence[SessionResult] = ()
    ) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use
        self.results = list(results)
        """The sessions before."""


def run_in_foreground(
    build: Callable[[float], Excitation],
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
    prepare: Callable[[Profile], Profile] | None = None,
) -> list[SessionResult]:
    """Run `repeat` sessions, up to a stop or the first that does not end well.

    Parameters
    ----------
    build
        Makes the excitation for a rate in Hz.
    crew
        The processes, started but not yet needed; ended when this returns.
    stop
        The operator's.
    profile_name
        Name or path of the profile.
    folder
        Where the files go; made if it does not exist.
    repeat, seed, notes, fast, live, force
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
    path: Path | None = None
    results: list[SessionResult] = []
    try:
        with contextlib.ExitStack() as ending:
            ending.enter_context(crew)
            profile, moving = load_rig(profile_name, fast=fast, seed=seed)
            if prepare is not None:
                profile = prepare(profile)
            if moving in (Reality.SIMULATOR, Reality.LOCK_STEP):
                tell(f"No hardware: {profile.name} is simulated ({moving.value}).")
                for difference in simulated_differently(profile.rig):
                    tell(f"Warning: the simulated rig has {difference}.")
            alone = not (fast and moving is Reality.SIMULATED)
            hardware = moving is Reality.HARDWARE
            ending.enter_context(RigLock(profile.name, "rigd run", hardware=hardware, alone=alone))
            excitation = build(profile.rig.rate_hz)
            plan = plan_session(profile, excitation, force=force)
            _tell_plan(tell, profile, excitation, plan)
            make_room(folder, excitation, profile.limits)
            rig = Rig(profile, fast=fast, crew=crew)
            if not stop.requested:
                rig.connect()
            for number in range(1, repeat + 1):
                if stop.requested:
                    break
                make_room(folder, excitation, profile.limits)
                path = choose_path(folder, excitation.kind, number if repeat > 1 else None)
                given = {name: text for name, text in notes.items() if text}
                if repeat > 1:
                    given["series"] = f"{number} of {repeat}"
                order = Order(profile, excitation, path, tuple(given.items()))
                if live:
                    tell(rig.show(order))
                with _ProgressView(excitation.reference_rad.size) as view:
                    results.append(rig.run(order, stop, view.update))
                _tell_result(tell, results[-1])
                if not results[-1].went_well:
                    break
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
    except (SessionFailedError, RigError) as error:
        kept = "" if path is None else f" The drive is disabled. {what_is_kept(path)}"
        raise ForegroundError(f"{error}{kept}", wrong_use=False, results=results) from error
    return results


def _tell(text: str, *, err: bool) -> None:
    with contextlib.suppress(OSError):  # the terminal is gone; the session is not
        typer.echo(text, err=err)


def _tell_plan(tell: Tell, profile: Profile, excitation: Excitation, plan: Plan) -> None:
    duration_s = excitation.reference_rad.size / profile.rig.rate_hz
    predicted, limits = plan.prediction, profile.limits
    tell(f"{excitation.kind} on {profile.name}: {duration_s:g} s of record.")
    tell(
        f"Predicted peaks: angle {predicted.peak_angle_rad:.4f} of {limits.angle_rad:g} rad, "
        f"speed {predicted.peak_velocity_rad_s:.2f} of {limits.velocity_rad_s:g} rad/s, "
        f"torque {predicted.peak_torque_nm:.2f} of {profile.rig.motor.peak_torque_nm:g} N·m."
    )
    for warning in plan.warnings:
        tell(f"Warning: {warning}")


def _tell_result(tell: Tell, result: SessionResult) -> None:
    counts = (
        f"{result.scheduled} ticks scheduled = {result.recorded} recorded + {result.missed} "
        f"missed + {result.lost} lost; {result.late} late."
    )
    if result.path is None:
        tell(f"{result.outcome}: no record. {result.reason}")
    else:
        tell(f"{result.outcome}: {counts}{' ' + result.reason if result.reason else ''}")
        if result.live_dropped:
            tell(f"The live view missed {result.live_dropped} samples; the file has them.")
        tell(str(result.path))


class _ProgressView:
    """One line that says how far the session is and how long it still takes."""

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

    def __enter__(self) -> "_ProgressView":
        with contextlib.suppress(OSError):
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._progress.stop()

    def update(self, state: SessionProgress, events: list[Event]) -> None:
        """Show where the session is, and what it has to say."""
        with contextlib.suppress(OSError):
            self._show(state, events)

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
