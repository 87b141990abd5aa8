"""What waits until the server takes it: some seconds of samples, and what must not be left out."""

import collections
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rigd.view.picture import Drawing

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
        """Add drawings that show so many samples; if need be, make room."""
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
