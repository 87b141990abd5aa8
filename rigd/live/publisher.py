"""The publisher process, which shows the records of the rings in Rerun, session by session.

It only observes the rings, so it affects neither the loop nor the recorder. Samples that it cannot
show in time are dropped and counted. Some seconds of samples wait for a slow server, and so do
events, which must not be dropped (`Backlog`). The computations of the view do not depend on what
could be shown. The process ends with its standard input, together with the server.
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
from rigd.engine.processes import Heartbeat, Parent
from rigd.engine.shared_state import Activity, Phase, StateField, activity
from rigd.live._feed import Feed
from rigd.live._program import RerunError
from rigd.live._ring_reader import Intake
from rigd.live._server import Outlet
from rigd.live.messages import LiveEnd, LiveFit, LiveSession, LiveShown, LiveTouches
from rigd.runtime import ignore as ignore_signals
from rigd.session.quick_look import last_quick_look, quick_look_path, read_quick_look
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
"""Period of sending: smooth to the eye, while the cost grows with the number of messages."""
_IDLE_PERIOD_S: Final = 1.0
_HURRY_S: Final = 0.2
_WAITING_S: Final = 10.0
"""Duration of the samples that may wait for a stalled server."""
_STUCK_S: Final = 20
_PARTING_S: Final = 0.3
"""Time for the last messages to reach the viewers."""
_ORPHANED_S: Final = 4.0
"""Time for which a session without supervisor is shown; it ends in a fraction of that."""


def main() -> None:
    """Run as ``python -m rigd.live.publisher``."""
    ignore_signals()
    # The watchdog needs the signal, whatever handlers and masks are inherited.
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
    # Without the interpreter's clean-up, in which the SDK may wait for an unresponsive server.
    os._exit(0)


class _Publisher:
    def __init__(self, parent: Parent, channels: Channels, outlet: Outlet) -> None:
        self._parent = parent
        self._channels = channels
        self._outlet = outlet
        self._feed = Feed(outlet)
        self._shown: _ShownSession | None = None
        self._last: LastResponse | None = None
        self._announced_server: int | None = None

    def serve(self) -> None:
        """Show sessions until the supervisor is gone or closes the input."""
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
        self._show_orphaned()

    def linger(self, linger_s: float) -> None:
        """Keep the view open for a while after the last session."""
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
            # Faster than real time, too many records would wait.
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

    def _show_orphaned(self) -> None:
        """Show a session without supervisor until its torque is off."""
        shown, shared_state = self._shown, self._channels.shared_state
        if shown is None or shown.over:
            return
        shown.lost = True
        end = time.monotonic() + _ORPHANED_S
        while shared_state[StateField.PHASE] != Phase.OFF and time.monotonic() < end:
            _arm_watchdog()
            self._step()
            time.sleep(_PERIOD_S)
        self._finish(LiveEnd(tuple(ring.written for ring in self._channels.rings)))

    def _step(self) -> None:
        """Show the new records, and count those that cannot be shown."""
        self._channels.shared_state.beat(StateField.LIVE_BEAT)
        if self._shown is not None:
            self._shown.gather()
        before = self._feed.connections
        if self._feed.ready() and self._shown is not None:
            self._shown.send(self._feed, connected=self._feed.connections != before)
        self._announce_address()

    def _announce_address(self) -> None:
        """Send the view's address to the supervisor whenever the server is replaced."""
        address = self._outlet.address
        if address is not None and address.server != self._announced_server:
            self._announced_server = address.server
            self._parent.send(address)


class _ShownSession:
    """The session that is shown, or was shown last."""

    def __init__(self, session: LiveSession, channels: Channels, last: LastResponse | None) -> None:
        shared_state = self._shared_state = channels.shared_state
        begin, seen = session.begins[TOPICS.index(SAMPLE)], shared_state[StateField.LIVE_SEEN]
        # Continue the count of an earlier publisher of the same session.
        self._dropped_before = shared_state[StateField.LIVE_DROPPED] if seen > begin else 0
        self.intake = Intake(session, channels, seen, last)
        self.backlog = Backlog(round(_WAITING_S * session.subject.rate_hz))
        self.over = False
        self.lost = False  # whether the supervisor is gone
        self._vitals = Vitals(channels)
        self._states = StateWatch(channels)
        self._unsent = 0
        folder, name = session.folder, session.subject.name
        self._quick_look_path = None if folder is None else quick_look_path(folder / f"{name}.mcap")

    @property
    def dropped(self) -> int:
        """Number of samples that could not be shown."""
        dropped = self.intake.dropped + self.backlog.dropped + self._unsent
        return self._dropped_before + dropped

    def gather(self) -> None:
        """Process the new records, or after the session its quick look."""
        if self.over:
            self._add_quick_look()
            return
        harvest = self.intake.take()
        drawings = harvest.drawings
        now_s = time.monotonic()
        if self._vitals.due(now_s):
            health = self._vitals.read(now_s, self.dropped)
            drawings += self.intake.picture.health(self.intake.t_ns, health)
        state = SUPERVISOR_LOST if self.lost else self._states.read(now_s)
        drawings += self.intake.picture.state(self.intake.t_ns, state)
        self.backlog.put_required(harvest.notes)
        self.backlog.put(drawings, harvest.samples)
        self._store_counts()

    def _store_counts(self) -> None:
        """Write the counts to the shared state, for a publisher that takes over."""
        shared_state = self._shared_state
        shared_state[StateField.LIVE_DROPPED] = self.dropped
        shown = self.intake.next - self.backlog.samples
        shared_state[StateField.LIVE_SEEN] = max(shared_state[StateField.LIVE_SEEN], shown)

    def touched(self, touches: "Sequence[Mapping[str, Any]]") -> None:
        """Draw touches, with a log line for each."""
        picture, t_ns = self.intake.picture, self.intake.t_ns
        lines = [Note(t_ns, "info", touch_line(touch)) for touch in touches]
        self.backlog.put_required([*picture.touches(touches), *picture.events(lines)])

    def fitted(self, fit: "Mapping[str, Any]") -> None:
        """Draw a fit of the record so far, with log lines."""
        picture, t_ns = self.intake.picture, self.intake.t_ns
        lines = [Note(t_ns, "info", line) for line in fit["text"]]
        self.backlog.put_required([*picture.fit(fit), *picture.events(lines)])

    def finish(self, end: LiveEnd) -> None:
        """Process the remaining records and the outcome of the session."""
        self.intake.end(end.ends)
        self.gather()
        picture, t_ns = self.intake.picture, self.intake.t_ns
        state = ended(end.outcome, end.reason)
        if self.lost:
            off = self._shared_state[StateField.PHASE] == Phase.OFF
            state = SUPERVISOR_LOST_TORQUE_OFF if off else SUPERVISOR_LOST
            self.backlog.put_required(picture.events([Note(t_ns, "error", state.reason)]))
        elif end.outcome:
            self.backlog.put_required(picture.events([outcome_note(t_ns, end.outcome, end.reason)]))
        # After all waiting drawings, which show a running session.
        self.backlog.put([*picture.finish(), *picture.state(t_ns, state)], 0)
        self.over = True
        self._add_quick_look()

    def _add_quick_look(self) -> None:
        """Add the text of the quick look to the log, once it exists."""
        if self._quick_look_path is None or not self._quick_look_path.exists():
            return
        # Only once: the file gets its name when it is complete, and an invalid one stays invalid.
        quick_look, self._quick_look_path = read_quick_look(self._quick_look_path), None
        if quick_look is None:
            return
        picture, t_ns = self.intake.picture, self.intake.t_ns
        self.backlog.put_required(
            picture.events([Note(t_ns, "info", line) for line in quick_look["text"]])
        )

    def send(self, feed: Feed, *, connected: bool) -> None:
        """Send the waiting drawings; a new connection (`connected`) has the frame already."""
        if connected:
            self.backlog.drop_required()
        if self.backlog:
            drawings, samples = self.backlog.take()
            if not feed.send(drawings):
                self._unsent += samples
            if not self.over:
                self._store_counts()


def _arm_watchdog() -> None:
    """Make the system kill this process unless this function is called again in time.

    A call into Rerun that never returns would block Python's signal handlers, so the watchdog uses
    the signal's default action. The server ends with this process.
    """
    signal.alarm(_STUCK_S)


# Queue of drawings

_MOST_REQUIRED: Final = 1000


class Backlog:
    """Queue of one session's drawings for the viewers.

    Parameters
    ----------
    most_samples
        Limit of the waiting samples, beyond which the oldest are dropped.

    Attributes
    ----------
    samples
        Number of waiting samples.
    dropped
        Number of dropped samples.
    """

    def __init__(self, most_samples: int) -> None:
        self._most_samples = most_samples
        self._waiting: collections.deque[tuple[list[Drawing], int]] = collections.deque()
        self.samples = 0
        self._required: collections.deque[Drawing] = collections.deque(maxlen=_MOST_REQUIRED)
        self.dropped = 0

    def __bool__(self) -> bool:
        return bool(self._waiting or self._required)

    def put(self, drawings: "list[Drawing]", samples: int) -> None:
        """Add drawings, and drop the oldest ones beyond the limit.

        Parameters
        ----------
        drawings
            Drawings in order.
        samples
            Number of samples that they show.
        """
        if drawings:
            self._waiting.append((drawings, samples))
            self.samples += samples
        while self.samples > self._most_samples and len(self._waiting) > 1:
            _, lost = self._waiting.popleft()
            self.samples -= lost
            self.dropped += lost

    def put_required(self, drawings: "Iterable[Drawing]") -> None:
        """Add drawings that are never dropped for lack of room."""
        self._required.extend(drawings)

    def drop_required(self) -> None:
        """Drop these drawings, because the frame of a new connection contains them."""
        self._required.clear()

    def take(self) -> "tuple[list[Drawing], int]":
        """Remove and return all drawings, with the number of samples that they show."""
        drawings = [*self._required, *(draw for group, _ in self._waiting for draw in group)]
        samples, self.samples = self.samples, 0
        self._required.clear()
        self._waiting.clear()
        return drawings, samples


# Response of the last session


def last_response(session: "LiveSession", own: LastResponse | None) -> LastResponse | None:
    """Return the response of the last session of the same specimen.

    It is from the newest quick look in the session's folder, or from this view itself if that is of
    a later session.

    Parameters
    ----------
    session
        Session that begins.
    own
        Response of the session that this view showed last.
    """
    specimen = session.subject.specimen
    if own is not None and own.specimen != specimen:
        own = None
    if session.folder is None:
        return own
    found = last_quick_look(
        session.folder, specimen, but=session.subject.name, usable=itemgetter("response")
    )
    if found is None:
        return own
    path, quick_look = found
    # Names of session files begin with the time of the session.
    if own is not None and path.stem < own.session:
        return own
    frequency_hz, magnitude, phase_rad = (
        np.array(quick_look["response"][key]) for key in ("frequency_hz", "magnitude", "phase_rad")
    )
    return LastResponse(path.stem, specimen, frequency_hz, magnitude * np.exp(1j * phase_rad))


# State and health of a session

_SILENT_S: Final = 0.6
"""Time without a heartbeat of the supervisor after which the view reports it."""
_TORQUE_PHASES: Final = (Phase.SETTLING, Phase.READY, Phase.RUNNING, Phase.RETURNING)
_STATES: Final = {
    Activity.STOPPING: STOPPING,
    Activity.RUNNING: RUNNING,
    Activity.RETURNING: RETURNING,
    Activity.FINISHING: FINISHING,
}


class StateWatch:
    """Reader of a session's state in the shared state of the processes.

    Parameters
    ----------
    channels
        Shared memory of the rig's processes.
    """

    def __init__(self, channels: Channels) -> None:
        self._shared_state = channels.shared_state
        self._supervisor = Heartbeat()

    def read(self, now_s: float) -> BannerState:
        """Return the state of the session; call it several times per second.

        Parameters
        ----------
        now_s
            Time of a monotonic clock.
        """
        shared_state = self._shared_state
        phase = Phase(shared_state[StateField.PHASE])
        still_s = self._supervisor.stalled_for(shared_state[StateField.SUPERVISOR_BEAT], now_s)
        if still_s > _SILENT_S:
            if phase in _TORQUE_PHASES:
                return SUPERVISOR_SILENT
            if shared_state[StateField.GO] and phase is Phase.OFF:
                return SUPERVISOR_SILENT_TORQUE_OFF
        now = activity(shared_state)
        if now is Activity.PREPARING:
            return preparing("" if phase is Phase.OFF else f"{phase.words}.".capitalize())
        return _STATES[now]


POLL_S: Final = 0.25
"""Period of the polls."""
_RATE_POLLS: Final = 4
"""Number of polls over which the rate is measured."""


class Vitals:
    """Reader of the rig's health, a few times per second during a session.

    Parameters
    ----------
    channels
        Shared memory of the rig's processes.
    """

    def __init__(self, channels: Channels) -> None:
        self._shared_state = channels.shared_state
        self._samples = channels.samples
        self._ticks: collections.deque[tuple[float, int]] = collections.deque(
            maxlen=_RATE_POLLS + 1
        )
        self._due_s = 0.0

    def due(self, now_s: float) -> bool:
        """Return whether a poll is due at the time `now_s` of a monotonic clock."""
        return now_s >= self._due_s

    def read(self, now_s: float, view_dropped: int) -> Health:
        """Return the present health.

        Parameters
        ----------
        now_s
            As for :meth:`due`.
        view_dropped
            Number of the session's samples that could not be shown.
        """
        shared_state = self._shared_state
        self._due_s = now_s + POLL_S
        # Until tick 0 the shared state has the counts of the session before.
        began = bool(shared_state[StateField.GO])
        scheduled, missed, late, lost = (
            shared_state[field] if began else 0
            for field in (StateField.SCHEDULED, StateField.MISSED, StateField.LATE, StateField.LOST)
        )
        load_ppm = shared_state.known(StateField.BUS_LOAD_PPM)
        return Health(
            missed_ticks=missed,
            late_ticks=late,
            lost_ticks=lost,
            recorder_lag_ticks=self._samples.waiting,
            disk_free_mb=shared_state[StateField.DISK_FREE_MB] or None,
            view_dropped=view_dropped,
            bus_load_percent=None if load_ppm is None else load_ppm * 1e-4,
            bus_errors=shared_state.known(StateField.BUS_ERRORS),
            sensor_status=shared_state.known(StateField.SENSOR_STATUS),
            rate_hz=self._rate_hz(now_s, scheduled),
        )

    def _rate_hz(self, now_s: float, scheduled: int) -> float | None:
        ticks = self._ticks
        if ticks and scheduled < ticks[-1][1]:
            ticks.clear()  # another session
        ticks.append((now_s, scheduled))
        (first_s, first), (last_s, last) = ticks[0], ticks[-1]
        # While the count is constant, there is no session, or it is in preparation.
        return (last - first) / (last_s - first_s) if last > first else None


if __name__ == "__main__":
    main()
