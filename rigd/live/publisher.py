"""The publisher process, which shows the sessions of a rig in Rerun while they run.

It only observes the ring buffers with the loop's records, so it affects neither the loop nor the
recorder. Samples that it cannot show in time are dropped and counted. If the server is slow, some
seconds of samples are queued, and also events, which must not be dropped (`Backlog`). Results that
are computed from the samples do not depend on what could be shown. When the standard input is
closed, the process ends itself and the server.
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
from rigd.engine.messages import ProcessFailed
from rigd.engine.processes import Heartbeat, SupervisorConnection
from rigd.engine.shared_state import Activity, Phase, StateField, activity
from rigd.live._feed import DrawingStream
from rigd.live._program import RerunError
from rigd.live._ring_reader import SessionRecordReader
from rigd.live._server import RerunServer
from rigd.live.messages import LiveFit, LiveSession, LiveSessionEnded, LiveSessionShown, LiveTouches
from rigd.runtime import ignore_end_signals as ignore_signals
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
    ended_state,
    preparing_state,
)
from rigd.view.frequency_charts import LastResponse
from rigd.view.rrd_file import prepare_sdk_environment

if TYPE_CHECKING:
    from rigd.live.messages import LiveJob
    from rigd.view import Drawing


_DRAWING_INTERVAL_S: Final = 1 / 15
"""Interval in seconds at which drawings are sent during a session.

The picture is smooth at this interval. A shorter one would cost more, since the cost grows with the
number of messages."""
_IDLE_POLL_INTERVAL_S: Final = 1.0
"""Interval in seconds at which the publisher polls its server between sessions."""
_MIN_CATCH_UP_SAMPLES_S: Final = 0.2
"""Duration in seconds of the samples read at once from which the next reading follows at once."""
_MAX_QUEUED_SAMPLES_S: Final = 10.0
"""Seconds of samples that are queued for a stalled server."""
_WATCHDOG_TIMEOUT_S: Final = 20
"""Seconds without progress after which the system kills the publisher."""
_LAST_MESSAGES_WAIT_S: Final = 0.3
"""Seconds for the last messages to reach the viewers."""
_MAX_ORPHANED_SESSION_S: Final = 4.0
"""Longest time in seconds for which a session without supervisor is shown.

Such a session ends in a fraction of this time."""


def main() -> None:
    """Run the publisher as the program ``python -m rigd.live.publisher``."""
    ignore_signals()
    # The watchdog needs the signal, whatever handlers and masks are inherited.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGALRM,))
    prepare_sdk_environment()
    supervisor_connection = SupervisorConnection()
    job: LiveJob = supervisor_connection.receive_job()
    channels = attach_channels(job.channels)
    try:
        server_program = RerunServer(job.rig)
        import rerun  # noqa: F401 - half a second, spent while the server starts

        server_program.wait()
    except (RerunError, ImportError) as error:
        supervisor_connection.send(ProcessFailed(str(error)))
        raise SystemExit(1) from None
    publisher = _Publisher(supervisor_connection, channels, server_program)
    publisher.serve()
    publisher.keep_view_open(job.linger_s)
    server_program.close()
    # Without the interpreter's clean-up, in which the SDK may wait for an unresponsive server.
    os._exit(0)


class _Publisher:
    """Main loop of the publisher: receives sessions from the supervisor and shows them."""

    def __init__(
        self,
        supervisor_connection: SupervisorConnection,
        channels: Channels,
        server_program: RerunServer,
    ) -> None:
        self._supervisor_connection = supervisor_connection
        self._channels = channels
        self._server_program = server_program
        self._drawing_stream = DrawingStream(server_program)
        self._shown_session: _ShownSession | None = None
        self._last_response: LastResponse | None = None
        self._announced_server: int | None = None

    def serve(self) -> None:
        """Show sessions until the supervisor ends, or closes this process's standard input."""
        while self._supervisor_connection.alive():
            _arm_watchdog()
            self._show_new_records()
            try:
                supervisor_message = self._supervisor_connection.poll(self._pause_s)
            except EOFError:
                break
            match supervisor_message:
                case LiveSession():
                    self._begin_session(supervisor_message)
                case LiveTouches(touches):
                    if self._shown_session is not None:
                        self._shown_session.show_touches(touches)
                case LiveFit(fit):
                    if self._shown_session is not None:
                        self._shown_session.show_fit(fit)
                case LiveSessionEnded():
                    self._finish_session(supervisor_message)
        self._show_orphaned_session()

    def keep_view_open(self, linger_s: float) -> None:
        """Keep the view open for `linger_s` seconds after the last session."""
        earliest_end_s = time.monotonic() + (
            _LAST_MESSAGES_WAIT_S if self._drawing_stream.connections else 0.0
        )
        end_s = max(earliest_end_s, time.monotonic() + linger_s)
        while time.monotonic() < (end_s if self._supervisor_connection.alive() else earliest_end_s):
            _arm_watchdog()
            self._show_new_records()
            time.sleep(_DRAWING_INTERVAL_S)

    @property
    def _pause_s(self) -> float:
        """Time in s to wait for a message of the supervisor before the next drawings."""
        shown_session = self._shown_session
        if shown_session is not None and not shown_session.has_ended:
            # In a session that runs faster than real time, records would accumulate.
            return (
                _DRAWING_INTERVAL_S
                if shown_session.reader.read_duration_s < _MIN_CATCH_UP_SAMPLES_S
                else 0.0
            )
        must_send_soon = self._drawing_stream.stalled or (
            shown_session is not None and bool(shown_session.backlog)
        )
        return _DRAWING_INTERVAL_S if must_send_soon else _IDLE_POLL_INTERVAL_S

    def _begin_session(self, session: LiveSession) -> None:
        """Show a new session, after the end of the previous one."""
        self._finish_session(LiveSessionEnded(session.begins))
        if self._shown_session is not None:
            self._last_response = (
                self._shown_session.reader.scene.last_response or self._last_response
            )
        self._shown_session = _ShownSession(
            session, self._channels, last_response(session, self._last_response)
        )
        self._server_program.count_session()
        self._drawing_stream.begin(
            session.recording_id, self._shown_session.reader.scene.initial_drawings
        )
        self._show_new_records()
        self._supervisor_connection.send(LiveSessionShown(session.recording_id))

    def _finish_session(self, end_message: LiveSessionEnded) -> None:
        """Show the end of the present session, unless it is shown already."""
        if self._shown_session is not None and not self._shown_session.has_ended:
            self._shown_session.finish(end_message)
            self._show_new_records()

    def _show_orphaned_session(self) -> None:
        """Show the present session, whose supervisor has ended, until its torque is off."""
        shown_session, shared_state = self._shown_session, self._channels.shared_state
        if shown_session is None or shown_session.has_ended:
            return
        shown_session.supervisor_lost = True
        end_s = time.monotonic() + _MAX_ORPHANED_SESSION_S
        while shared_state[StateField.PHASE] != Phase.OFF and time.monotonic() < end_s:
            _arm_watchdog()
            self._show_new_records()
            time.sleep(_DRAWING_INTERVAL_S)
        self._finish_session(
            LiveSessionEnded(
                tuple(ring_buffer.written_count for ring_buffer in self._channels.rings)
            )
        )

    def _show_new_records(self) -> None:
        """Show the new records of the session, and count those that cannot be shown."""
        self._channels.shared_state.beat(StateField.LIVE_BEAT)
        if self._shown_session is not None:
            self._shown_session.queue_new_records()
        previous_connections = self._drawing_stream.connections
        if self._drawing_stream.ready() and self._shown_session is not None:
            self._shown_session.send(
                self._drawing_stream,
                is_new_connection=self._drawing_stream.connections != previous_connections,
            )
        self._announce_address()

    def _announce_address(self) -> None:
        """Send the view's address to the supervisor if the server was started or replaced."""
        live_address = self._server_program.address
        if live_address is not None and live_address.server != self._announced_server:
            self._announced_server = live_address.server
            self._supervisor_connection.send(live_address)


class _ShownSession:
    """Session that the live view shows, or showed last, with the queue of drawings to be sent."""

    def __init__(
        self, session: LiveSession, channels: Channels, earlier_response: LastResponse | None
    ) -> None:
        shared_state = self._shared_state = channels.shared_state
        first_sample, seen_sample_count = (
            session.begins[TOPICS.index(SAMPLE)],
            shared_state[StateField.LIVE_SAMPLES_SEEN],
        )
        # Continue the count of a previous publisher of the same session.
        self._dropped_before = (
            shared_state[StateField.LIVE_SAMPLES_DROPPED] if seen_sample_count > first_sample else 0
        )
        self.reader = SessionRecordReader(session, channels, seen_sample_count, earlier_response)
        self.backlog = Backlog(round(_MAX_QUEUED_SAMPLES_S * session.description.rate_hz))
        self.has_ended = False
        self.supervisor_lost = False
        self._health_reader = HealthReader(channels)
        self._state_reader = SessionStateReader(channels)
        self._unsent_samples = 0
        session_folder, session_name = session.folder, session.description.name
        self._quick_look_path = (
            None
            if session_folder is None
            else quick_look_path(session_folder / f"{session_name}.mcap")
        )

    @property
    def dropped_samples(self) -> int:
        """Number of the session's samples that could not be shown."""
        dropped_by_this_publisher = (
            self.reader.dropped_samples + self.backlog.dropped_samples + self._unsent_samples
        )
        return self._dropped_before + dropped_by_this_publisher

    def queue_new_records(self) -> None:
        """Queue the drawings of new records or, after the session, the text of its quick look."""
        if self.has_ended:
            self._queue_quick_look()
            return
        new_drawings = self.reader.read_new_records()
        queued_drawings = new_drawings.other_drawings
        now_s = time.monotonic()
        if self._health_reader.is_due(now_s):
            rig_health = self._health_reader.read(now_s, self.dropped_samples)
            queued_drawings += self.reader.scene.health_drawings(self.reader.t_ns, rig_health)
        banner_state = SUPERVISOR_LOST if self.supervisor_lost else self._state_reader.read(now_s)
        queued_drawings += self.reader.scene.state_drawings(self.reader.t_ns, banner_state)
        self.backlog.put_required(new_drawings.note_drawings)
        self.backlog.put(queued_drawings, new_drawings.new_sample_count)
        self._store_sample_counts()

    def _store_sample_counts(self) -> None:
        """Store the counts of shown and dropped samples for a publisher that replaces this one."""
        shared_state = self._shared_state
        shared_state[StateField.LIVE_SAMPLES_DROPPED] = self.dropped_samples
        shown_samples = self.reader.next_sample_number - self.backlog.queued_samples
        shared_state[StateField.LIVE_SAMPLES_SEEN] = max(
            shared_state[StateField.LIVE_SAMPLES_SEEN], shown_samples
        )

    def show_touches(self, touches: "Sequence[Mapping[str, Any]]") -> None:
        """Queue the drawings and log lines of estimated touches."""
        view_scene, t_ns = self.reader.scene, self.reader.t_ns
        log_notes = [Note(t_ns, "info", touch_line(touch)) for touch in touches]
        self.backlog.put_required(
            [*view_scene.touch_drawings(touches), *view_scene.event_drawings(log_notes)]
        )

    def show_fit(self, fit: "Mapping[str, Any]") -> None:
        """Queue the drawings and log lines of a fit of the record so far."""
        view_scene, t_ns = self.reader.scene, self.reader.t_ns
        log_notes = [Note(t_ns, "info", fit_line) for fit_line in fit["text"]]
        self.backlog.put_required(
            [*view_scene.fit_drawings(fit), *view_scene.event_drawings(log_notes)]
        )

    def finish(self, end_message: LiveSessionEnded) -> None:
        """Queue the drawings of the session's remaining records and of its outcome."""
        self.reader.set_end(end_message.ends)
        self.queue_new_records()
        view_scene, t_ns = self.reader.scene, self.reader.t_ns
        banner_state = ended_state(end_message.outcome, end_message.reason)
        if self.supervisor_lost:
            is_torque_off = self._shared_state[StateField.PHASE] == Phase.OFF
            banner_state = SUPERVISOR_LOST_TORQUE_OFF if is_torque_off else SUPERVISOR_LOST
            self.backlog.put_required(
                view_scene.event_drawings([Note(t_ns, "error", banner_state.reason)])
            )
        elif end_message.outcome:
            self.backlog.put_required(
                view_scene.event_drawings(
                    [outcome_note(t_ns, end_message.outcome, end_message.reason)]
                )
            )
        # They follow all queued drawings, which show a running session.
        self.backlog.put(
            [*view_scene.final_drawings(), *view_scene.state_drawings(t_ns, banner_state)], 0
        )
        self.has_ended = True
        self._queue_quick_look()

    def _queue_quick_look(self) -> None:
        """Queue the log lines of the session's quick look as soon as its file exists."""
        if self._quick_look_path is None or not self._quick_look_path.exists():
            return
        # Read only once: the file gets its name when it is complete, and an invalid one stays so.
        quick_look, self._quick_look_path = read_quick_look(self._quick_look_path), None
        if quick_look is None:
            return
        view_scene, t_ns = self.reader.scene, self.reader.t_ns
        self.backlog.put_required(
            view_scene.event_drawings(
                [Note(t_ns, "info", text_line) for text_line in quick_look["text"]]
            )
        )

    def send(self, drawing_stream: DrawingStream, *, is_new_connection: bool) -> None:
        """Send the queued drawings to the viewers.

        `is_new_connection` states that the connection is new. Then the stream has already sent all
        drawings that must not be dropped.
        """
        if is_new_connection:
            self.backlog.drop_required()
        if self.backlog:
            drawings, sample_count = self.backlog.take()
            if not drawing_stream.send(drawings):
                self._unsent_samples += sample_count
            if not self.has_ended:
                self._store_sample_counts()


def _arm_watchdog() -> None:
    """Make the system kill this process unless this function is called again in 20 s.

    A call into Rerun that never returns would block Python's signal handlers, so the watchdog uses
    the signal's default action. The server ends with this process.
    """
    signal.alarm(_WATCHDOG_TIMEOUT_S)


# Queue of drawings

_MAX_REQUIRED_DRAWINGS: Final = 1000
"""Largest number of queued events and other required drawings.

Only beyond it the oldest of them are dropped."""


class Backlog:
    """Queue of a session's drawings that the live view has not sent yet.

    Parameters
    ----------
    max_samples
        Largest number of queued samples; the oldest beyond it are dropped.

    Attributes
    ----------
    queued_samples
        Number of samples that the queued drawings show.
    dropped_samples
        Number of samples whose drawings were dropped.
    """

    def __init__(self, max_samples: int) -> None:
        self._max_samples = max_samples
        self._queue: collections.deque[tuple[list[Drawing], int]] = collections.deque()
        self.queued_samples = 0
        self._required_drawings: collections.deque[Drawing] = collections.deque(
            maxlen=_MAX_REQUIRED_DRAWINGS
        )
        self.dropped_samples = 0

    def __bool__(self) -> bool:
        """Return whether any drawings still have to be sent to the viewers."""
        return bool(self._queue or self._required_drawings)

    def put(self, drawings: "list[Drawing]", sample_count: int) -> None:
        """Queue drawings, and drop the oldest ones if there are too many samples.

        Parameters
        ----------
        drawings
            Drawings in the order in which they are sent.
        sample_count
            Number of samples that they show.
        """
        if drawings:
            self._queue.append((drawings, sample_count))
            self.queued_samples += sample_count
        while self.queued_samples > self._max_samples and len(self._queue) > 1:
            _, lost_samples = self._queue.popleft()
            self.queued_samples -= lost_samples
            self.dropped_samples += lost_samples

    def put_required(self, drawings: "Iterable[Drawing]") -> None:
        """Queue drawings that are sent even if the queue is full, such as those of events."""
        self._required_drawings.extend(drawings)

    def drop_required(self) -> None:
        """Remove the drawings that `put_required` queued; a new connection has received them."""
        self._required_drawings.clear()

    def take(self) -> "tuple[list[Drawing], int]":
        """Return all queued drawings and the number of samples they show, and clear the queue."""
        drawings = [
            *self._required_drawings,
            *(draw for drawing_batch, _ in self._queue for draw in drawing_batch),
        ]
        sample_count, self.queued_samples = self.queued_samples, 0
        self._required_drawings.clear()
        self._queue.clear()
        return drawings, sample_count


# Response of the last session


def last_response(
    session: "LiveSession", shown_response: LastResponse | None
) -> LastResponse | None:
    """Return the frequency response measured in the last session of the same specimen.

    It is read from the newest quick look in the session's folder, unless the response that this
    view showed last belongs to a later session.

    Parameters
    ----------
    session
        Session that begins.
    shown_response
        Frequency response of the session that this view showed last, or None.

    Returns
    -------
    LastResponse or None
        Response for comparison, or None if there is none.
    """
    specimen = session.description.specimen
    if shown_response is not None and shown_response.specimen != specimen:
        shown_response = None
    if session.folder is None:
        return shown_response
    newest_path_and_quick_look = last_quick_look(
        session.folder,
        specimen,
        excluded_session=session.description.name,
        is_usable=itemgetter("response"),
    )
    if newest_path_and_quick_look is None:
        return shown_response
    document_path, quick_look = newest_path_and_quick_look
    # Names of session files begin with the time of the session.
    if shown_response is not None and document_path.stem < shown_response.session:
        return shown_response
    frequency_hz, magnitude, phase_rad = (
        np.array(quick_look["response"][key]) for key in ("frequency_hz", "magnitude", "phase_rad")
    )
    return LastResponse(
        document_path.stem, specimen, frequency_hz, magnitude * np.exp(1j * phase_rad)
    )


# State and health of a session

_SUPERVISOR_TIMEOUT_S: Final = 0.6
"""Seconds without a heartbeat of the supervisor after which the view reports it as silent."""
_TORQUE_PHASES: Final = (Phase.SETTLING, Phase.READY, Phase.RUNNING, Phase.RETURNING)
"""Phases of a session in which the torque is on."""
_ACTIVITY_BANNERS: Final = {  # Banner for each activity of the rig
    Activity.STOPPING: STOPPING,
    Activity.RUNNING: RUNNING,
    Activity.RETURNING: RETURNING,
    Activity.FINISHING: FINISHING,
}


class SessionStateReader:
    """Derives the state of the session in the view's banner from the processes' shared memory.

    Parameters
    ----------
    channels
        Shared memory of the rig's processes.
    """

    def __init__(self, channels: Channels) -> None:
        self._shared_state = channels.shared_state
        self._supervisor = Heartbeat()

    def read(self, now_s: float) -> BannerState:
        """Return the state of the session for the banner; call it several times per second.

        Parameters
        ----------
        now_s
            Time of a monotonic clock.
        """
        shared_state = self._shared_state
        session_phase = Phase(shared_state[StateField.PHASE])
        supervisor_silence_s = self._supervisor.stalled_for(
            shared_state[StateField.SUPERVISOR_BEAT], now_s
        )
        if supervisor_silence_s > _SUPERVISOR_TIMEOUT_S:
            if session_phase in _TORQUE_PHASES:
                return SUPERVISOR_SILENT
            if shared_state[StateField.RECORD_MAY_START] and session_phase is Phase.OFF:
                return SUPERVISOR_SILENT_TORQUE_OFF
        current_activity = activity(shared_state)
        if current_activity is Activity.PREPARING:
            return preparing_state(
                "" if session_phase is Phase.OFF else f"{session_phase.display_text}.".capitalize()
            )
        return _ACTIVITY_BANNERS[current_activity]


HEALTH_POLL_INTERVAL_S: Final = 0.25
"""Interval in seconds at which the rig's health is read."""
_RATE_MEASUREMENT_POLLS: Final = 4
"""Number of readings over which the loop's rate is measured."""


class HealthReader:
    """Reads the rig's health from the shared state, a few times per second during a session.

    Parameters
    ----------
    channels
        Shared memory of the rig's processes.
    """

    def __init__(self, channels: Channels) -> None:
        self._shared_state = channels.shared_state
        self._samples = channels.samples
        self._ticks: collections.deque[tuple[float, int]] = collections.deque(
            maxlen=_RATE_MEASUREMENT_POLLS + 1
        )
        self._next_reading_s = 0.0

    def is_due(self, now_s: float) -> bool:
        """Return whether the next reading is due at the time `now_s` of a monotonic clock."""
        return now_s >= self._next_reading_s

    def read(self, now_s: float, view_dropped: int) -> Health:
        """Return the present health of the rig: missed ticks, bus load, errors and loop rate.

        Parameters
        ----------
        now_s
            Time of a monotonic clock.
        view_dropped
            Number of the session's samples that could not be shown.
        """
        shared_state = self._shared_state
        self._next_reading_s = now_s + HEALTH_POLL_INTERVAL_S
        # Until tick 0 the shared state has the counts of the previous session.
        has_begun = bool(shared_state[StateField.RECORD_MAY_START])
        scheduled_ticks, missed_ticks, late_ticks, lost_samples = (
            shared_state[state_field] if has_begun else 0
            for state_field in (
                StateField.SCHEDULED_TICKS,
                StateField.MISSED_TICKS,
                StateField.LATE_TICKS,
                StateField.LOST_SAMPLES,
            )
        )
        bus_load_ppm = shared_state.known_value(StateField.BUS_LOAD_PPM)
        return Health(
            missed_ticks=missed_ticks,
            late_ticks=late_ticks,
            lost_ticks=lost_samples,
            recorder_lag_ticks=self._samples.waiting_count,
            disk_free_mb=shared_state[StateField.DISK_FREE_MB] or None,
            view_dropped=view_dropped,
            bus_load_percent=None if bus_load_ppm is None else bus_load_ppm * 1e-4,
            bus_errors=shared_state.known_value(StateField.BUS_ERRORS),
            sensor_status=shared_state.known_value(StateField.SENSOR_STATUS),
            rate_hz=self._measured_loop_rate_hz(now_s, scheduled_ticks),
        )

    def _measured_loop_rate_hz(self, now_s: float, scheduled_ticks: int) -> float | None:
        """Return the measured rate of the loop in Hz, or None between sessions."""
        times_and_tick_counts = self._ticks
        if times_and_tick_counts and scheduled_ticks < times_and_tick_counts[-1][1]:
            times_and_tick_counts.clear()  # another session
        times_and_tick_counts.append((now_s, scheduled_ticks))
        (first_time_s, first_count), (last_time_s, last_count) = (
            times_and_tick_counts[0],
            times_and_tick_counts[-1],
        )
        # While the count is constant, there is no session, or it is in preparation.
        return (
            (last_count - first_count) / (last_time_s - first_time_s)
            if last_count > first_count
            else None
        )


if __name__ == "__main__":
    main()
