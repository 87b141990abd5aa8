"""The publisher process: from the rings to Rerun, for one session after the other.

It only looks at the rings, so neither the loop nor the recorder can feel it; what it cannot show in
time is dropped and counted. Some seconds of samples wait until the server takes them, and so do
events, which must not be left out (`Backlog`). What is computed for the view does not depend on
what could be shown. The process ends when its standard input does, and takes the server along.
"""

import collections
import os
import signal
import time
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rigd.engine.channels import SAMPLE, TOPICS, Channels, attach_channels
from rigd.engine.messages import Failed
from rigd.engine.processes import Parent, Pulse
from rigd.engine.shared_state import Activity, Phase, Word, activity
from rigd.live._feed import Feed
from rigd.live._program import RerunError
from rigd.live._ring_reader import Intake
from rigd.live._server import Outlet
from rigd.live.messages import LiveEnd, LiveFit, LiveSession, LiveShown, LiveTouches
from rigd.runtime import ignore as ignore_signals
from rigd.session.quick_look import last_look, look_path, read_look
from rigd.session.touches import touch_line
from rigd.view import Health, Note, outcome_note
from rigd.view.banner import (
    FINISHING,
    RETURNING,
    RUNNING,
    STOPPING,
    SUPERVISOR_LOST,
    SUPERVISOR_LOST_TORQUE_OFF,
    SUPERVISOR_SILENT,
    SUPERVISOR_SILENT_TORQUE_OFF,
    BannerState,
    ended,
    preparing,
)
from rigd.view.frequency_charts import LastResponse
from rigd.view.rrd_file import settle_sdk

if TYPE_CHECKING:
    from rigd.live.messages import LiveJob
    from rigd.view import Drawing


_PERIOD_S: Final = 1 / 15
"""Period of sending: the cost grows with the number of messages; the eye takes this for smooth."""
_IDLE_PERIOD_S: Final = 1.0
_HURRY_S: Final = 0.2
_WAITING_S: Final = 10.0
"""Duration of samples that may wait for a stalled server."""
_STUCK_S: Final = 20
_PARTING_S: Final = 0.3
"""Time that the last messages take to the viewers."""
_ORPHANED_S: Final = 4.0
"""How long a session whose supervisor is gone is shown: it ends within a fraction of that."""


def main() -> None:
    """Run as ``python -m rigd.live.publisher``."""
    ignore_signals()
    # The watchdog's signal works whatever this process was started with.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGALRM,))
    settle_sdk()
    parent = Parent()
    job: LiveJob = parent.receive_job()
    channels = attach_channels(job.channels)
    try:
        outlet = Outlet(job.rig)
        import rerun  # noqa: F401 - half a second, spent while the server starts

        outlet.wait()
    except (RerunError, ImportError) as error:
        parent.send(Failed(str(error)))
        raise SystemExit(1) from None
    publisher = _Publisher(parent, channels, outlet)
    publisher.serve()
    publisher.linger(job.linger_s)
    outlet.close()
    # Not through the interpreter's clean-up: the SDK's may wait for a server that does not answer.
    os._exit(0)


class _Publisher:
    def __init__(self, parent: Parent, channels: Channels, outlet: Outlet) -> None:
        self._parent = parent
        self._channels = channels
        self._outlet = outlet
        self._feed = Feed(outlet)
        self._shown: _ShownSession | None = None
        self._last: LastResponse | None = None
        self._told: int | None = None

    def serve(self) -> None:
        """Show what there is, until the supervisor is gone or has no more use for it."""
        while self._parent.alive():
            _arm_watchdog()
            self._step()
            try:
                message = self._parent.poll(self._pause_s)
            except EOFError:
                break
            match message:
                case LiveSession():
                    self._begin(message)
                case LiveTouches(touches):
                    if self._shown is not None:
                        self._shown.touched(touches)
                case LiveFit(fit):
                    if self._shown is not None:
                        self._shown.fitted(fit)
                case LiveEnd():
                    self._finish(message)
        self._outlive()

    def linger(self, linger_s: float) -> None:
        """Leave viewers the time to show the last of it, and to look at it."""
        parted = time.monotonic() + (_PARTING_S if self._feed.connections else 0.0)
        end = max(parted, time.monotonic() + linger_s)
        while time.monotonic() < (end if self._parent.alive() else parted):
            _arm_watchdog()
            self._step()
            time.sleep(_PERIOD_S)

    @property
    def _pause_s(self) -> float:
        shown = self._shown
        if shown is not None and not shown.over:
            # Not in real time, more comes than can be left waiting.
            return _PERIOD_S if shown.intake.took_s < _HURRY_S else 0.0
        waits = self._feed.stalled or (shown is not None and bool(shown.backlog))
        return _PERIOD_S if waits else _IDLE_PERIOD_S

    def _begin(self, session: LiveSession) -> None:
        self._finish(LiveEnd(session.begins))
        if self._shown is not None:
            self._last = self._shown.intake.picture.last_response or self._last
        self._shown = _ShownSession(session, self._channels, last_response(session, self._last))
        self._outlet.begin_session()
        self._feed.begin(session.recording_id, self._shown.intake.picture.frame)
        self._step()
        self._parent.send(LiveShown(session.recording_id))

    def _finish(self, end: LiveEnd) -> None:
        if self._shown is not None and not self._shown.over:
            self._shown.finish(end)
            self._step()

    def _outlive(self) -> None:
        """Show a session whose supervisor is gone until its torque is off."""
        shown, shared_state = self._shown, self._channels.board
        if shown is None or shown.over:
            return
        shown.lost = True
        end = time.monotonic() + _ORPHANED_S
        while shared_state[Word.PHASE] != Phase.OFF and time.monotonic() < end:
            _arm_watchdog()
            self._step()
            time.sleep(_PERIOD_S)
        self._finish(LiveEnd(tuple(ring.written for ring in self._channels.rings)))

    def _step(self) -> None:
        """Show what has come; count what cannot be shown."""
        self._channels.board.beat(Word.LIVE_BEAT)
        if self._shown is not None:
            self._shown.gather()
        before = self._feed.connections
        if self._feed.ready() and self._shown is not None:
            self._shown.send(self._feed, connected=self._feed.connections != before)
        self._tell()

    def _tell(self) -> None:
        """Tell the supervisor where the view is, whenever that is another server."""
        address = self._outlet.address
        if address is not None and address.server != self._told:
            self._told = address.server
            self._parent.send(address)


class _ShownSession:
    """The session that is shown, or was last."""

    def __init__(self, session: LiveSession, channels: Channels, last: LastResponse | None) -> None:
        shared_state = self._shared_state = channels.board
        begin, seen = session.begins[TOPICS.index(SAMPLE)], shared_state[Word.LIVE_SEEN]
        # A session that another publisher has shown up to there keeps its count.
        self._dropped_before = shared_state[Word.LIVE_DROPPED] if seen > begin else 0
        self.intake = Intake(session, channels, seen, last)
        self.backlog = Backlog(round(_WAITING_S * session.subject.rate_hz))
        self.over = False
        self.lost = False  # its supervisor
        self._vitals = Vitals(channels)
        self._states = StateWatch(channels)
        self._unsent = 0
        folder, name = session.folder, session.subject.name
        self._look = None if folder is None else look_path(folder / f"{name}.mcap")

    @property
    def dropped(self) -> int:
        """Samples that could not be shown."""
        here = self.intake.dropped + self.backlog.dropped + self._unsent
        return self._dropped_before + here

    def gather(self) -> None:
        """Take what has come, while the session lasts, and then the quick look at it."""
        if self.over:
            self._take_look()
            return
        harvest = self.intake.take()
        drawings = harvest.drawings
        now_s = time.monotonic()
        if self._vitals.due(now_s):
            health = self._vitals.look(now_s, self.dropped)
            drawings += self.intake.picture.health(self.intake.t_ns, health)
        state = SUPERVISOR_LOST if self.lost else self._states.look(now_s)
        drawings += self.intake.picture.state(self.intake.t_ns, state)
        self.backlog.owe(harvest.notes)
        self.backlog.put(drawings, harvest.samples)
        self._tell()

    def _tell(self) -> None:
        """Write to the board what another publisher needs to know if it takes over."""
        shared_state = self._shared_state
        shared_state[Word.LIVE_DROPPED] = self.dropped
        shown = self.intake.next - self.backlog.samples
        shared_state[Word.LIVE_SEEN] = max(shared_state[Word.LIVE_SEEN], shown)

    def touched(self, touches: "Sequence[Mapping[str, Any]]") -> None:
        """Draw touches, with a line of each among the events."""
        picture, t_ns = self.intake.picture, self.intake.t_ns
        lines = [Note(t_ns, "info", touch_line(touch)) for touch in touches]
        self.backlog.owe([*picture.touches(touches), *picture.events(lines)])

    def fitted(self, fit: "Mapping[str, Any]") -> None:
        """Draw a fit of the record so far, and tell of it among the events."""
        picture, t_ns = self.intake.picture, self.intake.t_ns
        lines = [Note(t_ns, "info", line) for line in fit["text"]]
        self.backlog.owe([*picture.fit(fit), *picture.events(lines)])

    def finish(self, end: LiveEnd) -> None:
        """Take the rest of it, and what can only be known at its end."""
        self.intake.end(end.ends)
        self.gather()
        picture, t_ns = self.intake.picture, self.intake.t_ns
        state = ended(end.outcome, end.reason)
        if self.lost:
            off = self._shared_state[Word.PHASE] == Phase.OFF
            state = SUPERVISOR_LOST_TORQUE_OFF if off else SUPERVISOR_LOST
            self.backlog.owe(picture.events([Note(t_ns, "error", state.reason)]))
        elif end.outcome:
            self.backlog.owe(picture.events([outcome_note(t_ns, end.outcome, end.reason)]))
        # Behind all that waits, which says that the session goes on; nothing comes after it.
        self.backlog.put([*picture.finish(), *picture.state(t_ns, state)], 0)
        self.over = True
        self._take_look()

    def _take_look(self) -> None:
        """Add the text of the quick look to the events, once there is one."""
        if self._look is None or not self._look.exists():
            return
        # Once: it takes its name when it is whole, and garbage stays garbage.
        look, self._look = read_look(self._look), None
        if look is None:
            return
        picture, t_ns = self.intake.picture, self.intake.t_ns
        self.backlog.owe(picture.events([Note(t_ns, "info", line) for line in look["text"]]))

    def send(self, feed: Feed, *, connected: bool) -> None:
        """Send what waits; if newly `connected`, with the frame of the scene."""
        if connected:
            self.backlog.forgive()
        if self.backlog:
            drawings, samples = self.backlog.take()
            if not feed.send(drawings):
                self._unsent += samples
            if not self.over:
                self._tell()


def _arm_watchdog() -> None:
    """Have the system end this process if it does not come here again in time.

    A call into Rerun that never returned would keep the signal handlers of Python from running,
    so it is the default action of the signal that is relied upon; the server goes with it.
    """
    signal.alarm(_STUCK_S)


# Queue of drawings

_MOST_OWED: Final = 1000


class Backlog:
    """Drawings of one session on their way to the viewers.

    Parameters
    ----------
    most_samples
        How many samples may wait; beyond, the oldest are dropped.

    Attributes
    ----------
    samples
        Samples that wait.
    dropped
        Samples that were dropped.
    """

    def __init__(self, most_samples: int) -> None:
        self._most_samples = most_samples
        self._waiting: collections.deque[tuple[list[Drawing], int]] = collections.deque()
        self.samples = 0
        self._owed: collections.deque[Drawing] = collections.deque(maxlen=_MOST_OWED)
        self.dropped = 0

    def __bool__(self) -> bool:
        return bool(self._waiting or self._owed)

    def put(self, drawings: "list[Drawing]", samples: int) -> None:
        """Add drawings that show so many samples; if need be, make room.

        Parameters
        ----------
        drawings
            What is to be drawn, in order.
        samples
            How many samples they show.
        """
        if drawings:
            self._waiting.append((drawings, samples))
            self.samples += samples
        while self.samples > self._most_samples and len(self._waiting) > 1:
            _, lost = self._waiting.popleft()
            self.samples -= lost
            self.dropped += lost

    def owe(self, drawings: "Iterable[Drawing]") -> None:
        """Add drawings that wait as long as it takes."""
        self._owed.extend(drawings)

    def forgive(self) -> None:
        """Forget those: what they show is in the frame of a new connection."""
        self._owed.clear()

    def take(self) -> "tuple[list[Drawing], int]":
        """Return everything, and how many samples it shows; nothing waits any more."""
        drawings = [*self._owed, *(draw for group, _ in self._waiting for draw in group)]
        samples, self.samples = self.samples, 0
        self._owed.clear()
        self._waiting.clear()
        return drawings, samples


# Response of the last session


def last_response(session: "LiveSession", own: LastResponse | None) -> LastResponse | None:
    """Return the response of the last session of the same specimen.

    That is of the newest quick look beside the session's file, or what this view itself has
    computed where that is of a later session.

    Parameters
    ----------
    session
        Session that is about to be shown.
    own
        Response of the session that was shown last.
    """
    specimen = session.subject.specimen
    if own is not None and own.specimen != specimen:
        own = None
    if session.folder is None:
        return own
    found = last_look(
        session.folder, specimen, but=session.subject.name, usable=itemgetter("response")
    )
    if found is None:
        return own
    path, look = found
    # Names of session files begin with their time.
    if own is not None and path.stem < own.session:
        return own
    frequency_hz, magnitude, phase_rad = (
        np.array(look["response"][key]) for key in ("frequency_hz", "magnitude", "phase_rad")
    )
    return LastResponse(path.stem, specimen, frequency_hz, magnitude * np.exp(1j * phase_rad))


# State and health of a session

_SILENT_S: Final = 0.6
"""Time without a heartbeat of the supervisor from which on the view says so."""
_TORQUE_PHASES: Final = (Phase.SETTLING, Phase.READY, Phase.RUNNING, Phase.RETURNING)
_STATES: Final = {
    Activity.STOPPING: STOPPING,
    Activity.RUNNING: RUNNING,
    Activity.RETURNING: RETURNING,
    Activity.FINISHING: FINISHING,
}


class StateWatch:
    """Tells by the board in which state a session is.

    Parameters
    ----------
    channels
        The memory of the rig's processes.
    """

    def __init__(self, channels: Channels) -> None:
        self._shared_state = channels.board
        self._supervisor = Pulse()

    def look(self, now_s: float) -> BannerState:
        """Return the state; to be called several times a second.

        Parameters
        ----------
        now_s
            Time of a monotonic clock.
        """
        shared_state = self._shared_state
        phase = Phase(shared_state[Word.PHASE])
        still_s = self._supervisor.look(shared_state[Word.SUPERVISOR_BEAT], now_s)
        if still_s > _SILENT_S:
            if phase in _TORQUE_PHASES:
                return SUPERVISOR_SILENT
            if shared_state[Word.GO] and phase is Phase.OFF:
                return SUPERVISOR_SILENT_TORQUE_OFF
        now = activity(shared_state)
        if now is Activity.PREPARING:
            return preparing("" if phase is Phase.OFF else f"{phase.words}.".capitalize())
        return _STATES[now]


LOOK_S: Final = 0.25
"""Time from one look to the next."""
_RATE_LOOKS: Final = 4
"""Number of looks over which the rate is measured."""


class Vitals:
    """Reads the board a few times a second while a session is run.

    Parameters
    ----------
    channels
        The memory of the rig's processes.
    """

    def __init__(self, channels: Channels) -> None:
        self._shared_state = channels.board
        self._samples = channels.samples
        self._ticks: collections.deque[tuple[float, int]] = collections.deque(
            maxlen=_RATE_LOOKS + 1
        )
        self._due_s = 0.0

    def due(self, now_s: float) -> bool:
        """Whether it is time for another look, at `now_s` of any clock that does not jump."""
        return now_s >= self._due_s

    def look(self, now_s: float, view_dropped: int) -> Health:
        """Return how it is.

        Parameters
        ----------
        now_s
            As for :meth:`due`.
        view_dropped
            Samples of the session that could not be shown.
        """
        shared_state = self._shared_state
        self._due_s = now_s + LOOK_S
        # Until tick 0 the board has the counts of the session before.
        began = bool(shared_state[Word.GO])
        scheduled, missed, late, lost = (
            shared_state[field] if began else 0
            for field in (Word.SCHEDULED, Word.MISSED, Word.LATE, Word.LOST)
        )
        load_ppm = shared_state.known(Word.BUS_LOAD_PPM)
        return Health(
            missed_ticks=missed,
            late_ticks=late,
            lost_ticks=lost,
            recorder_lag_ticks=self._samples.waiting,
            disk_free_mb=shared_state[Word.DISK_FREE_MB] or None,
            view_dropped=view_dropped,
            bus_load_percent=None if load_ppm is None else load_ppm * 1e-4,
            bus_errors=shared_state.known(Word.BUS_ERRORS),
            sensor_status=shared_state.known(Word.SENSOR_STATUS),
            rate_hz=self._rate_hz(now_s, scheduled),
        )

    def _rate_hz(self, now_s: float, scheduled: int) -> float | None:
        ticks = self._ticks
        if ticks and scheduled < ticks[-1][1]:
            ticks.clear()  # another session
        ticks.append((now_s, scheduled))
        (first_s, first), (last_s, last) = ticks[0], ticks[-1]
        # As long as nothing moves there is no session, or it is prepared.
        return (last - first) / (last_s - first_s) if last > first else None


if __name__ == "__main__":
    main()
