"""Series: the sessions of one request, planned once and run in sequence.

`rigd run` and the daemon use it, each with its own observer (`SeriesWatcher`).
"""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from rigd.devices import session_seed
from rigd.engine.shared_state import LogEvent
from rigd.excitation import Excitation, present_frequency_hz
from rigd.profile import Profile
from rigd.runner._rig import Rig, RigError
from rigd.runner._touch_search import touch_search
from rigd.runner.planning import RefusedError, plan_document, plan_session, predicted_metadata
from rigd.runner.quick_looks import QuickLooks
from rigd.runner.request import Order, check_required, choose_path, make_room
from rigd.runner.session import RunResult, SessionProgress, always
from rigd.runtime import StopRequest

_QUICK_LOOK_PATIENCE_S: Final = 8.0
"""Longest pause between two sessions for the quick look at the first one, which mostly takes two or
three seconds. If it is unfinished, it is suspended."""
_POLL_S: Final = 0.05


class SeriesWatcher(Protocol):
    """Observer of a series; these methods are called in this order for each of its sessions."""

    def begins(self, number: int, path: Path) -> None:
        """Receive number and file of the next session, from 1; an error ends the series."""

    def says(self, level: Literal["info", "warning"], text: str) -> None:
        """Receive a message before the first session."""

    def shown(self, where: str) -> None:
        """Receive the address of the live view, or why there is none."""

    def update(self, progress: SessionProgress, events: list[LogEvent]) -> None:
        """Receive progress and events, about fifty times a second."""

    def ended(self, result: RunResult, *, look_follows: bool) -> None:
        """Receive the result, and whether a quick look follows."""


class Series:
    """Sessions of one excitation on one connection, checked against limits and disk.

    Parameters
    ----------
    profile, excitation
        Rig and excitation of each session.
    folder
        Folder of the session files; created if it does not exist.
    repeat
        Number of sessions.
    notes
        Operator, specimen, note and added metadata; empty texts are omitted. The profile already
        has the beam of a specimen with a file.
    force
        See :func:`rigd.runner.planning.plan_session`.
    accept
        Names of rows of `rigd check` that may fail; the failed ones are recorded in the files.
    watch_fit
        Fit each record while it is recorded.
    identifies_motor
        The sessions measure the motor. A probing move then verifies only the values that the limits
        of travel and speed depend on.

    Attributes
    ----------
    plan
        Predicted behaviour of each session.
    results
        Results of the sessions so far.

    Raises
    ------
    CheckFailedError, UnknownRowError
        If a check on paper fails and is not accepted, or `accept` has an unknown name.
    RefusedError, ControlDesignError, RealisationError
        If the sessions would leave the limits, cannot be predicted, or lack metadata that the
        profile requires.
    NoRoomError
        If the disk has no room for the first session.
    """

    def __init__(
        self,
        profile: Profile,
        excitation: Excitation,
        folder: Path,
        *,
        repeat: int = 1,
        notes: Mapping[str, str] | None = None,
        force: bool = False,
        accept: Sequence[str] = (),
        watch_fit: bool = False,
        identifies_motor: bool = False,
    ) -> None:
        self._watch_fit = watch_fit
        self._identifies_motor = identifies_motor
        self._profile = profile
        self._excitation = excitation
        self._folder = folder
        self._repeat = repeat
        self._notes = {name: text for name, text in (notes or {}).items() if text}
        check_required(profile, self._notes)
        if excitation.stays and repeat > 1:
            raise RefusedError(
                f"--repeat {repeat}: a {excitation.kind} ends elsewhere than it starts and is run "
                "once; omit the option."
            )
        self.plan = plan_session(profile, excitation, force=force, accept=accept)
        self._touch = touch_search(profile, excitation)
        self.results: list[RunResult] = []
        self._make_room()

    @property
    def ticks(self) -> int:
        """Ticks of each session's record."""
        return int(self._excitation.reference_rad.size)

    def frequency_hz(self, tick: int) -> float | None:
        """Return the frequency of the excitation at a tick; None if it has none."""
        return present_frequency_hz(self._excitation, tick)

    def plan_document(self) -> dict[str, Any]:
        """Return the plan for JSON."""
        return plan_document(self._profile, self._excitation, self.plan)

    def run(
        self,
        rig: Rig,
        stop: StopRequest,
        watcher: SeriesWatcher,
        *,
        live: bool,
        listens: Callable[[], bool] = always,
        quick_looks: QuickLooks | None = None,
    ) -> None:
        """Run the sessions; end at a stop or at the first incomplete session.

        Each session waits until the beam is at rest.

        Parameters
        ----------
        rig
            The connected rig.
        stop
            Stop request of the operator.
        watcher
            Observer of the series.
        live
            Show each session in a live view.
        listens
            See :class:`rigd.runner.session.Session`.
        quick_looks
            Makes a quick look at each session; the next session waits some seconds for it.

        Raises
        ------
        NoRoomError
            If the disk has no room for a further session.
        RigError, SessionFailedError
            If a session cannot be run, or failed; its result is not stored.
        ProbeFailedError
            If a probing move before the first session shows that the rig contradicts its profile.
        """
        try:
            probed = {} if stop.requested else self._probe(rig, stop, watcher)
        except RigError:
            if stop.requested and rig.connected:
                return  # the move was stopped, and nothing else happened
            raise
        for number in range(1, self._repeat + 1):
            if quick_looks is not None and number > 1:
                _await_quick_look(quick_looks, rig, stop)
            if stop.requested:
                return
            self._make_room()
            counted = self._repeat > 1
            path = choose_path(self._folder, self._excitation.kind, number if counted else None)
            notes = self._notes | ({"series": f"{number} of {self._repeat}"} if counted else {})
            watcher.begins(number, path)
            order = Order(
                self._profile,
                self._excitation,
                path,
                tuple(notes.items()),
                tuple(
                    (
                        predicted_metadata(self._profile, self.plan.prediction, self._excitation)
                        | probed
                    ).items()
                ),
                self.plan.ending,
                self._touch,
                self._watch_fit,
                self._seed(number),
                self.plan.clearance.accepted,
            )
            with contextlib.nullcontext() if quick_looks is None else quick_looks.held():
                if live:
                    watcher.shown(rig.show(order, stop))
                result = rig.run(order, stop, watcher.update, listens)
            self.results.append(result)
            # The record of a vibration-free move contains no information on the modes.
            seen = result.path if self._excitation.shows_modes else None
            watcher.ended(result, look_follows=quick_looks is not None and seen is not None)
            if quick_looks is not None and seen is not None:
                quick_looks.begin(seen)
            if not result.went_well:
                return

    def _seed(self, number: int) -> int | None:
        """Return the seed of a simulated rig's noise in a session; None: a fresh one."""
        simulation = self._profile.rig.simulation
        if simulation is None or simulation.seed is None:
            return None
        return session_seed(simulation.seed, number)

    def _probe(self, rig: Rig, stop: StopRequest, watcher: SeriesWatcher) -> dict[str, str]:
        """Make a probing move if motor and encoder are not known; return its metadata."""
        if self._profile.rig.devices.drive == "sim":
            return {}
        from rigd.runner import _probing  # late: a simulation in this process needs none

        result = _probing.verify(
            self._profile, rig, stop, watcher.says, motor=not self._identifies_motor
        )
        return {} if result is None else result.as_metadata()

    def _make_room(self) -> None:
        make_room(self._folder, self._excitation, self._profile.limits)


def _await_quick_look(quick_looks: QuickLooks, rig: Rig, stop: StopRequest) -> None:
    """Wait for the quick look at the last session before the next session suspends it."""
    deadline_s = time.monotonic() + _QUICK_LOOK_PATIENCE_S
    while quick_looks.busy and not stop.requested and time.monotonic() < deadline_s:
        rig.watch()
        quick_looks.poll()
        time.sleep(_POLL_S)
