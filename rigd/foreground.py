"""Sessions in the foreground: plan, tell the operator, run with progress, tell how it ended."""

import contextlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import typer

from rigd.beam import RealisationError
from rigd.control import ControlDesignError
from rigd.crew import Crew
from rigd.daemon import (
    Order,
    SessionFailedError,
    SessionProgress,
    SessionResult,
    choose_path,
    run_session,
    start_live,
    what_is_kept,
    with_seed,
)
from rigd.devices.registry import (
    Reality,
    UnknownDeviceError,
    check_selection,
    objections,
    reality,
    simulated_differently,
)
from rigd.engine.board import Phase
from rigd.engine.events import Event
from rigd.engine.signals import StopRequest
from rigd.excitation import Excitation, ExcitationError
from rigd.planning import Plan, RefusedError, plan_session
from rigd.profile import Profile, ProfileError, load_profile

_PHASES = {
    Phase.PREPARING: "preparing",
    Phase.SETTLING: "settling",
    Phase.TARING: "taring",
    Phase.READY: "ready",
    Phase.RUNNING: "recording",
    Phase.RETURNING: "returning",
    Phase.OFF: "drive off",
}

# Uncompressed, with the controller's terms and the index; a file never takes more.
_BYTES_PER_TICK = 180
_BYTES_SPARE = 1_000_000


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
        The processes of the first session, started but not yet needed.
    stop
        The operator's.
    profile_name
        Name or path of the profile.
    folder
        Where the files go; made if it does not exist.
    repeat, seed, notes, fast, live, force
        As on the command line. Each session of a series has its own seed, counted up.
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
    excitation: Excitation | None = None
    try:
        profile, moving = _load(profile_name, fast=fast, seed=seed)
        if prepare is not None:
            profile = prepare(profile)
        if moving in (Reality.SIMULATOR, Reality.LOCK_STEP):
            tell(f"No hardware: {profile.name} is simulated ({moving.value}).")
            for difference in simulated_differently(profile.rig):
                tell(f"Warning: the simulated rig has {difference}.")
        for number in range(repeat):
            with crew if number == 0 else Crew(live=live) as crew:
                if excitation is None:
                    excitation = build(profile.rig.rate_hz)
                    plan = plan_session(profile, excitation, force=force)
                    _tell_plan(tell, profile, excitation, plan)
                if stop.requested:
                    break
                _lay_out(crew, profile.rig.rate_hz)
                _make_room(folder, excitation)
                path = choose_path(folder, excitation.kind, number + 1 if repeat > 1 else None)
                order = Order(
                    profile=_seeded(profile, number),
                    excitation=excitation,
                    path=path,
                    fast=fast,
                    notes=tuple((name, text) for name, text in notes.items() if text),
                )
                if live:
                    tell(start_live(crew, order))
                with _ProgressView(excitation.reference_rad.size) as view:
                    results.append(run_session(order, crew, stop, view.update))
            _tell_result(tell, results[-1])
            if not results[-1].went_well:
                break
    except (
        ProfileError,
        UnknownDeviceError,
        ExcitationError,
        RefusedError,
        ControlDesignError,
        RealisationError,
    ) as error:
        raise ForegroundError(str(error), wrong_use=True) from error
    except SessionFailedError as error:
        kept = "" if path is None else f" The drive is disabled. {what_is_kept(path)}"
        raise ForegroundError(f"{error}{kept}", wrong_use=False, results=results) from error
    return results


def _tell(text: str, *, err: bool) -> None:
    with contextlib.suppress(OSError):  # the terminal is gone; the session is not
        typer.echo(text, err=err)


def _lay_out(crew: Crew, rate_hz: float) -> None:
    try:
        crew.lay_out(rate_hz)
    except OSError as error:
        raise SessionFailedError(
            f"There is not enough shared memory for the processes of a session "
            f"({error.strerror}); free some in /dev/shm."
        ) from error


def _make_room(folder: Path, excitation: Excitation) -> None:
    """Make the folder, and see that a session fits on its disk."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise RefusedError(
            f"--output {folder}: cannot be made a folder ({error.strerror}); choose another."
        ) from error
    needed = excitation.reference_rad.size * _BYTES_PER_TICK + _BYTES_SPARE
    if free < needed:
        raise RefusedError(
            f"--output {folder}: {free / 1e6:.1f} MB are free on its disk and the session may take "
            f"{needed / 1e6:.1f} MB; make room or choose another folder."
        )


def _load(name: str, *, fast: bool, seed: int | None) -> tuple[Profile, Reality]:
    profile = load_profile(name)
    check_selection(profile.rig.devices)
    refusals = objections(profile.rig)
    if refusals:
        raise RefusedError("\n".join(f"{profile.path}: {refusal}" for refusal in refusals))
    moving = reality(profile.rig)
    if fast and not moving.any_clock:
        raise RefusedError(
            f"--fast: {moving.value} of {profile.path} moves in real time, which cannot be "
            "skipped; leave the option out."
            + (" Or start rigd simulate with --lock-step." if moving is Reality.SIMULATOR else "")
        )
    if seed is not None:
        if moving is not Reality.SIMULATED:
            raise RefusedError(
                f"--seed: the noise of {moving.value} of {profile.path} is not made here; leave "
                "the option out."
            )
        profile = with_seed(profile, seed)
    return profile, moving


def _seeded(profile: Profile, number: int) -> Profile:
    simulation = profile.rig.simulation
    return profile if simulation is None else with_seed(profile, simulation.seed + number)


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
            description=_PHASES[state.phase],
            completed=state.tick,
            counts=f"{state.missed} missed, {state.late} late" if state.missed else "",
        )
        self._progress.refresh()
