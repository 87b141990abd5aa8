"""How well the rig is doing, as far as the board and the rings tell."""

import collections
from typing import Final

from rigd.engine.board import Word
from rigd.engine.channels import Channels
from rigd.view.health import Health

LOOK_S: Final = 0.25
"""From one look to the next."""
_RATE_LOOKS: Final = 4
"""Over as many of them the rate is measured."""


class Vitals:
    """Looks at the board a few times a second while a session is run.

    Parameters
    ----------
    channels
        The memory of the rig's processes.
    """

    def __init__(self, channels: Channels) -> None:
        self._board = channels.board
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
        board = self._board
        self._due_s = now_s + LOOK_S
        # Until tick 0 the board has the counts of the session before.
        began = bool(board[Word.GO])
        scheduled, missed, late, lost = (
            board[word] if began else 0
            for word in (Word.SCHEDULED, Word.MISSED, Word.LATE, Word.LOST)
        )
        load_ppm = board.known(Word.BUS_LOAD_PPM)
        return Health(
            missed_ticks=missed,
            late_ticks=late,
            lost_ticks=lost,
            recorder_lag_ticks=self._samples.waiting,
            disk_free_mb=board[Word.DISK_FREE_MB] or None,
            view_dropped=view_dropped,
            bus_load_percent=None if load_ppm is None else load_ppm * 1e-4,
            bus_errors=board.known(Word.BUS_ERRORS),
            sensor_status=board.known(Word.SENSOR_STATUS),
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
