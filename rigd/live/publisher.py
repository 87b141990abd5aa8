"""The publisher process: ring → Rerun.

It only looks at the ring, so neither the loop nor the recorder can feel it; what it cannot show
in time is dropped and counted. It ends when its standard input does, and takes the server along.
"""

import os
import signal
import time
from typing import TYPE_CHECKING

from rigd.engine import signals
from rigd.engine.board import Board, Word
from rigd.engine.process import Parent
from rigd.engine.ring import Observer, Ring
from rigd.live.feed import Feed
from rigd.live.server import ServerError
from rigd.session.format import SAMPLE_SIZE, decode_samples

if TYPE_CHECKING:
    from rigd.live.job import LiveJob

_PERIOD_S = 0.05
_STUCK_S = 20


def main() -> None:
    """Run as ``python -m rigd.live.publisher``."""
    signals.ignore(but=(signal.SIGTERM,))
    # The watchdog's signal works whatever this process was started with.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGALRM,))
    # What the SDK has to say about a server that is gone is no news to the operator.
    os.environ["RUST_LOG"] = "off"
    parent = Parent()
    job: LiveJob = parent.receive_job()
    observer = Observer(Ring(job.samples))
    board = Board(job.board_fd)
    try:
        feed = Feed(job.name)
    except (ServerError, ImportError) as error:
        parent.send(error=str(error))
        raise SystemExit(1) from None
    parent.send(url=feed.url)
    _publish(parent, _Publisher(observer, board, feed, round(job.rate_hz)))
    _linger(parent, job.linger_s)
    feed.close()
    # Not through the interpreter's clean-up: the SDK's may wait for a server that does not answer.
    os._exit(0)


class _Publisher:
    def __init__(self, observer: Observer, board: Board, feed: Feed, most: int) -> None:
        self._observer = observer
        self._board = board
        self._feed = feed
        self._most = most
        self._unsent = 0

    def transfer(self) -> None:
        """Show what the ring has, a second of it at most; count what cannot be shown."""
        self._board.beat(Word.LIVE_BEAT)
        block = self._observer.take(self._most)
        try:
            sent = not block or self._feed.offer(decode_samples(block))
        except ValueError:
            sent = False  # overwritten while it was copied
        if not sent:
            self._unsent += len(block) // SAMPLE_SIZE
        self._board[Word.LIVE_DROPPED] = self._observer.dropped + self._unsent


def _publish(parent: Parent, publisher: _Publisher) -> None:
    due = time.monotonic()
    ended = False
    while not ended:
        _arm_watchdog()
        due = max(due + _PERIOD_S, time.monotonic())
        ended = _ended(parent, due)
        publisher.transfer()


def _linger(parent: Parent, linger_s: float) -> None:
    end = time.monotonic() + linger_s
    while parent.alive() and time.monotonic() < end:
        _arm_watchdog()
        time.sleep(_PERIOD_S)


def _ended(parent: Parent, due: float) -> bool:
    """Wait until ``due``, on :func:`time.monotonic`, or until the session has ended."""
    while parent.alive():
        try:
            parent.poll(max(0.0, due - time.monotonic()))
        except EOFError:
            return True
        if time.monotonic() >= due:
            return False
    return True


def _arm_watchdog() -> None:
    """Have the system end this process if it does not come here again in time.

    A call into Rerun that never returned would keep the signal handlers of Python from running,
    so it is the default action of the signal that is relied upon; the server goes with it.
    """
    signal.alarm(_STUCK_S)


if __name__ == "__main__":
    main()
