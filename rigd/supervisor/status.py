"""What the board tells of a rig, for whoever looks: readings, counts, processes, topics."""

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass

from rigd.engine.board import Phase, Word
from rigd.engine.processes import PROCESSES, SUPERVISOR, Pulse
from rigd.engine.topics import TOPICS
from rigd.live.address import LiveAddress
from rigd.supervisor.crew import Crew
from rigd.supervisor.signal_watch import SignalStatus, SignalWatch


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """How one process of the table is."""

    name: str
    pid: int
    state: str
    """``at work``, ``waiting`` (for a session), ``hung`` or ``ended``."""
    still_s: float
    """For how long it has shown no sign of work, as far as somebody looked."""


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """What came of one topic of the table."""

    name: str
    written: int
    rate_hz: float | None
    """Since the last look; None where there was none."""
    expected_hz: float | None
    """While a session is recorded."""
    waiting: int
    """Records that the recorder has yet to take."""


@dataclass(frozen=True, slots=True)
class RigStatus:
    """A look at the board."""

    phase: Phase
    angle_rad: float
    """From the rig's zero."""
    coupling_torque_nm: float
    torque_command_nm: float
    tick: int
    missed: int
    late: int
    lost: int
    bus_load_percent: float | None
    """Of the busiest line; None where there is none. Likewise:"""
    bus_errors: int | None
    sensor_status: int | None
    disk_free_mb: int | None
    view_dropped: int
    """Samples that the live view did not get."""
    signals: SignalStatus | None
    """Of the record; None before its first sample."""
    processes: tuple[ProcessStatus, ...]
    topics: tuple[TopicStatus, ...]
    live_view: LiveAddress | None = None
    """Where the sessions are shown, if they are."""


class StatusWatch:
    """Looks at a rig now and again; what moves between two looks is known by them.

    Parameters
    ----------
    rate_hz
        Of the rig.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._pulses = {process: Pulse() for process in PROCESSES}
        self._written: tuple[float, tuple[int, ...]] | None = None
        self._signals = SignalWatch(rate_hz)

    def look(self, crew: Crew) -> RigStatus:
        """Return how it stands now."""
        board = crew.channels.board
        load_ppm = board.known(Word.BUS_LOAD_PPM)
        return RigStatus(
            phase=Phase(board[Word.PHASE]),
            angle_rad=board[Word.ANGLE_NRAD] * 1e-9,
            coupling_torque_nm=board[Word.COUPLING_TORQUE_NNM] * 1e-9,
            torque_command_nm=board[Word.TORQUE_COMMAND_NNM] * 1e-9,
            tick=board[Word.SCHEDULED],
            missed=board[Word.MISSED],
            late=board[Word.LATE],
            lost=board[Word.LOST],
            bus_load_percent=None if load_ppm is None else load_ppm * 1e-4,
            bus_errors=board.known(Word.BUS_ERRORS),
            sensor_status=board.known(Word.SENSOR_STATUS),
            disk_free_mb=board[Word.DISK_FREE_MB] or None,
            view_dropped=board[Word.LIVE_DROPPED],
            signals=self._signals.look(crew.channels.samples),
            processes=tuple(self._processes(crew)),
            topics=tuple(self._topics(crew)),
        )

    def _topics(self, crew: Crew) -> Iterator[TopicStatus]:
        rings, now_s = crew.channels.rings, time.monotonic()
        written = tuple(ring.written for ring in rings)
        before_s, before = self._written or (now_s, written)
        self._written = now_s, written
        passed_s = now_s - before_s
        for topic, ring, now, first in zip(TOPICS, rings, written, before, strict=True):
            # Other processes, other rings: they begin at 0 again.
            rate_hz = (now - first) / passed_s if passed_s > 0.0 and now >= first else None
            expected_hz = topic.expected_hz(self._rate_hz)
            yield TopicStatus(topic.name, now, rate_hz, expected_hz, ring.waiting)

    def _processes(self, crew: Crew) -> Iterator[ProcessStatus]:
        board, now_s = crew.channels.board, time.monotonic()
        for process in PROCESSES:
            still_s = self._pulses[process].look(board[process.beat], now_s)
            if process is SUPERVISOR:
                yield ProcessStatus(process.name, os.getpid(), "at work", still_s)
                continue
            if process not in crew:
                continue
            child = crew[process]
            if not child.running:
                state = "ended"
            elif not crew.has_job(process):
                state = "waiting"
            elif process.hung_after_s is not None and still_s > process.hung_after_s:
                state = "hung"
            else:
                state = "at work"
            yield ProcessStatus(process.name, child.pid, state, still_s)
