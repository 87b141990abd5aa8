"""Series of sessions of one request, which are planned once and run one after another.

`rigd run` and the daemon use it, each with its own implementation of `SeriesListener`.
"""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from rigd.devices import is_simulated_here, session_seed
from rigd.engine.shared_state import LogEvent
from rigd.excitation import Excitation, present_frequency_hz
from rigd.profile import Profile
from rigd.runner._rig import Rig, RigError, RigStoppedError
from rigd.runner._touch_search import touch_search
from rigd.runner.planning import RefusedError, plan_document, plan_session, predicted_metadata
from rigd.runner.quick_looks import QuickLookQueue
from rigd.runner.request import (
    SessionOrder,
    choose_session_path,
    require_disk_space,
    require_metadata,
)
from rigd.runner.session import SessionProgress, SessionResult, can_always_receive_stop
from rigd.runtime import StopRequest

_QUICK_LOOK_MAX_PAUSE_S: Final = 8.0
"""Maximum time in seconds that the next session waits for the quick look at the previous one, which
mostly takes two or three. An unfinished quick look is then suspended."""
_POLL_INTERVAL_S: Final = 0.05


class SeriesListener(Protocol):
    """Receiver of the progress of a series of sessions."""

    def on_start(self, session_number: int, session_path: Path) -> None:
        """Process the start of a session, with its number from 1 and the path of its file.

        An exception ends the series.
        """

    def on_message(self, level: Literal["info", "warning"], message_text: str) -> None:
        """Process a message for the operator before the first session."""

    def on_live_view(self, live_view_text: str) -> None:
        """Process the text with the address of the live view, or on why there is no view."""

    def on_progress(self, progress: SessionProgress, events: list[LogEvent]) -> None:
        """Process the progress and new events of a session; called about fifty times a second."""

    def on_result(self, result: SessionResult, *, look_follows: bool) -> None:
        """Process the result of a session; `look_follows` states whether a quick look follows."""


class Series:
    """Series of sessions with one excitation on one connection to the rig.

    The constructor plans the sessions, and checks limits, metadata and disk space.

    Parameters
    ----------
    profile, excitation
        Profile of the rig, and excitation of each session.
    folder
        Folder of the session files; created if it does not exist.
    session_count
        Number of sessions.
    notes
        Metadata of the user: operator, specimen, note and others. Empty texts are omitted. If the
        specimen has a file, the profile must already contain the beam of that file.
    allows_saturation
        See :func:`rigd.runner.planning.plan_session`.
    accepted_row_names
        Names of rows of `rigd check` that may fail. The failed rows are recorded in the files.
    watch_fit
        Fit each record repeatedly during the session.
    identifies_motor
        Whether the sessions identify the motor. A probing move then verifies only the values on
        which the limits of travel and speed depend.

    Attributes
    ----------
    plan
        Prediction of each session.
    results
        Results of the sessions so far.

    Raises
    ------
    CheckFailedError, UnknownRowError
        If a check of the profile fails and is not accepted, or `accepted_row_names` contains an
        unknown name.
    RefusedError, ControlDesignError, RealisationError
        If the sessions would exceed limits, cannot be predicted, or lack metadata that the profile
        requires.
    NoRoomError
        If the disk has no space for the first session.
    """

    def __init__(
        self,
        profile: Profile,
        excitation: Excitation,
        folder: Path,
        *,
        session_count: int = 1,
        notes: Mapping[str, str] | None = None,
        allows_saturation: bool = False,
        accepted_row_names: Sequence[str] = (),
        watch_fit: bool = False,
        identifies_motor: bool = False,
    ) -> None:
        self._watch_fit = watch_fit
        self._identifies_motor = identifies_motor
        self._profile = profile
        self._excitation = excitation
        self._folder = folder
        self._session_count = session_count
        self._notes = {
            note_name: note_text for note_name, note_text in (notes or {}).items() if note_text
        }
        require_metadata(profile, self._notes)
        if excitation.stays and session_count > 1:
            raise RefusedError(
                f"--repeat {session_count}: a {excitation.kind} does not end where it starts, so "
                "it is run once; omit the option."
            )
        self.plan = plan_session(
            profile,
            excitation,
            allows_saturation=allows_saturation,
            accepted_row_names=accepted_row_names,
        )
        self._touch = touch_search(profile, excitation)
        self.results: list[SessionResult] = []
        self._require_disk_space()

    @property
    def record_ticks(self) -> int:
        """Number of ticks in the record of each session."""
        return int(self._excitation.reference_rad.size)

    def frequency_hz(self, tick: int) -> float | None:
        """Return the frequency of the excitation in Hz at a tick, or None if it has none there."""
        return present_frequency_hz(self._excitation, tick)

    def plan_document(self) -> dict[str, Any]:
        """Return the plan, which is the same for each session, as a dictionary for JSON."""
        return plan_document(self._profile, self._excitation, self.plan)

    def run(
        self,
        rig: Rig,
        stop: StopRequest,
        listener: SeriesListener,
        *,
        with_live_view: bool,
        can_receive_stop: Callable[[], bool] = can_always_receive_stop,
        quick_looks: QuickLookQueue | None = None,
    ) -> None:
        """Run the sessions until a stop or the first incomplete session.

        The results are appended to `results`. Each session waits until the beam is at rest.

        Parameters
        ----------
        rig
            The connected rig.
        stop
            Stop request of the operator.
        listener
            Receiver of the progress.
        with_live_view
            Show each session in a live view.
        can_receive_stop
            See :class:`rigd.runner.session.SessionSupervisor`.
        quick_looks
            Queue to which each session is added for a quick look. The next session waits some
            seconds for the quick look.

        Raises
        ------
        NoRoomError
            If the disk has no space for a further session.
        RigError, SessionFailedError
            If a session cannot be run, or failed. Its result is not appended.
        ProbeFailedError
            If a probing move before the first session shows that the rig contradicts its profile.
        """
        try:
            probe_metadata = {} if stop.requested else self._probe_if_needed(rig, stop, listener)
        except RigError as error:
            if stop.requested and (rig.connected or isinstance(error, RigStoppedError)):
                return  # the probing move was stopped, and nothing failed
            raise
        for session_number in range(1, self._session_count + 1):
            if quick_looks is not None and session_number > 1:
                _await_quick_look(quick_looks, rig, stop)
            if stop.requested:
                return
            self._require_disk_space()
            is_numbered = self._session_count > 1
            session_path = choose_session_path(
                self._folder, self._excitation.kind, session_number if is_numbered else None
            )
            session_notes = self._notes | (
                {"series": f"{session_number} of {self._session_count}"} if is_numbered else {}
            )
            listener.on_start(session_number, session_path)
            session_order = SessionOrder(
                self._profile,
                self._excitation,
                session_path,
                tuple(session_notes.items()),
                tuple(
                    (
                        predicted_metadata(self._profile, self.plan.prediction, self._excitation)
                        | probe_metadata
                    ).items()
                ),
                self.plan.ending,
                self._touch,
                self._watch_fit,
                self._session_seed(session_number),
                self.plan.offline_check_result.accepted,
            )
            with contextlib.nullcontext() if quick_looks is None else quick_looks.suspended():
                if with_live_view:
                    listener.on_live_view(rig.show_session(session_order, stop))
                run_result = rig.run(session_order, stop, listener.on_progress, can_receive_stop)
            self.results.append(run_result)
            # The record of a vibration-free move contains no information on the modes.
            analysed_path = run_result.path if self._excitation.shows_modes else None
            listener.on_result(
                run_result, look_follows=quick_looks is not None and analysed_path is not None
            )
            if quick_looks is not None and analysed_path is not None:
                quick_looks.add_session(analysed_path)
            if not run_result.is_successful:
                return

    def _session_seed(self, session_number: int) -> int | None:
        """Return the seed of the simulated rig's noise in a session, or None for a random seed."""
        simulation = self._profile.rig.simulation
        if simulation is None or simulation.seed is None:
            return None
        return session_seed(simulation.seed, session_number)

    def _probe_if_needed(
        self, rig: Rig, stop: StopRequest, listener: SeriesListener
    ) -> dict[str, str]:
        """Make a probing move if it is needed, and return its result as metadata.

        The metadata are empty if no move is needed.
        """
        if is_simulated_here(self._profile.rig):
            return {}
        from rigd.runner import _probing  # late: a simulation in this process needs none

        probe_result = _probing.verify_by_probing(
            self._profile, rig, stop, listener.on_message, checks_motor=not self._identifies_motor
        )
        return {} if probe_result is None else probe_result.as_metadata()

    def _require_disk_space(self) -> None:
        """Raise NoRoomError if the disk lacks space for the next session."""
        require_disk_space(self._folder, self._excitation, self._profile.limits)


def _await_quick_look(quick_looks: QuickLookQueue, rig: Rig, stop: StopRequest) -> None:
    """Wait some seconds for the quick look at the previous session before the next session."""
    deadline_s = time.monotonic() + _QUICK_LOOK_MAX_PAUSE_S
    while quick_looks.is_busy and not stop.requested and time.monotonic() < deadline_s:
        try:
            rig.check_control_process()
        except RigStoppedError:
            if stop.requested:
                return  # the signal was sent to both processes
            raise
        quick_looks.poll()
        time.sleep(_POLL_INTERVAL_S)
