"""The live view of a session: started, watched, and started again if it is lost."""

import time

from rigd.engine.board import Word
from rigd.engine.channels import Channels
from rigd.engine.events import Event, Level
from rigd.engine.process import ChildError
from rigd.engine.processes import LIVE, Pulse
from rigd.engine.topics import SAMPLE, TOPICS
from rigd.live.job import LiveJob
from rigd.supervisor.crew import Crew

_PATIENCE_S = 10.0
_MOST_RESTARTS = 3
"""In one session: what dies again and again is not worth the processor time."""


class LiveView:
    """The publisher process of one session, which the session never waits for.

    Parameters
    ----------
    crew
        With a publisher.
    name
        Of the session.
    rate_hz
        Samples a second.
    """

    def __init__(self, crew: Crew, name: str, rate_hz: float) -> None:
        self._crew = crew
        self._job = _job(crew.channels, name, rate_hz)
        self._pulse = Pulse()
        self._restarts = 0
        self._shown = False
        self._lost = False

    def start(self) -> str:
        """Start it and return the address of the view, or why there is none."""
        try:
            child = self._crew.fresh(LIVE)
            child.start(self._job)
            answer = child.poll(_PATIENCE_S) or {"error": "it does not answer."}
        except ChildError as error:
            answer = {"error": str(error)}
        if "url" in answer:
            self._shown = True
            return f"Live view: {answer['url']}"
        self._lost = True
        return f"No live view: {answer['error']} The session goes on without it."

    def attend(self) -> list[Event]:
        """See whether it is at work; if it died or hangs, start it again and say so."""
        if self._lost:
            return []
        board = self._crew.channels.board
        try:
            answer = self._crew[LIVE].poll(0.0)
        except ChildError as error:
            return self._restart(str(error))
        assert LIVE.hung_after_s is not None
        # It takes its time to start.
        patience_s = LIVE.hung_after_s if self._shown else _PATIENCE_S
        if self._pulse.look(board[Word.LIVE_BEAT], time.monotonic()) > patience_s:
            return self._restart(
                f"The live process has not moved for {patience_s:g} s and was killed."
            )
        if answer is None:
            return []
        if "url" in answer:
            self._shown = True
            return [_event("info", f"Live view: {answer['url']}")]
        return self._restart(f"No live view: {answer.get('error', answer)}")

    def _restart(self, why: str) -> list[Event]:
        self._restarts += 1
        if self._restarts > _MOST_RESTARTS:
            self._lost = True
            return [_event("warning", f"{why} It is not started again; the session goes on.")]
        self._pulse, self._shown = Pulse(), False
        try:
            child = self._crew.replace(LIVE)
            child.start(self._job)
        except ChildError as error:
            self._lost = True
            return [_event("warning", f"{error} The session goes on without a live view.")]
        return [_event("warning", f"{why} It is started again; the session goes on.")]


def _job(channels: Channels, name: str, rate_hz: float) -> LiveJob:
    specs = channels.specs
    return LiveJob(
        samples=specs.rings[TOPICS.index(SAMPLE)],
        board_fd=specs.board_fd,
        name=name,
        rate_hz=rate_hz,
    )


def _event(level: Level, message: str) -> Event:
    return Event(0, level, message)
