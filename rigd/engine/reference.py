"""Reference of a session, in shared memory: given whole, or piece by piece while it is followed.

It lies in shared memory so that the control process does not pause to receive it: however long the
session is, a drive that monitors the loop's heartbeat sees no gap.

Pieces are appended by another process than the one that follows them. The angles are in place
before the word that announces them (`Word.PLANNED`), as in a ring. Whoever follows the reference
never waits for a piece: it holds the last angle until the next one is there.
"""

import mmap
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rigd.engine._ring import reserve
from rigd.engine.shared_state import SharedState, Word

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_SIZE = 8  # bytes of a double
_AT_REST_RAD = 1e-4
"""Largest angle at either end of a piece: an encoder step or two."""
_FULL_TURN_RAD = 6.3


@dataclass(frozen=True, slots=True)
class ReferenceSpec:
    """What the control process needs to find it: an inherited descriptor and its length."""

    fd: int
    """Descriptor of the memory."""
    ticks: int
    """Ticks for which there is room."""
    planned: int | None = None
    """Ticks that are there from the start; None: all. What follows comes piece by piece."""


def put_reference(
    fd: int, reference_rad: "NDArray[np.float64]", planned: int | None = None
) -> ReferenceSpec:
    """Place a reference, shape (n,), in the memory of `fd`.

    Parameters
    ----------
    fd
        Descriptor of the memory.
    reference_rad
        From the rig's zero, one per tick.
    planned
        Ticks of it that are planned; None: all.

    Raises
    ------
    OSError
        If there is not enough shared memory.
    """
    size = _SIZE * reference_rad.size
    reserve(fd, size)
    with mmap.mmap(fd, size) as memory:
        memory[:] = reference_rad.astype("float64").tobytes()
    return ReferenceSpec(fd, reference_rad.size, planned)


def map_reference(spec: ReferenceSpec) -> "memoryview[float]":
    """Attach to a reference: one Python number per tick, read where it lies.

    What is written to one that was given whole stays in this process.
    """
    access = mmap.ACCESS_COPY if spec.planned is None else mmap.ACCESS_READ
    memory = mmap.mmap(spec.fd, _SIZE * spec.ticks, access=access)
    return memoryview(memory).cast("d")


def is_whole(board: SharedState, scheduled: int, ticks: int) -> bool:
    """Whether a record has all of its reference.

    Parameters
    ----------
    board
        Words of the session.
    scheduled
        Ticks of the record.
    ticks
        Those of the reference; of one that grows, the most.
    """
    if scheduled == ticks:
        return True
    return bool(board[Word.LAST_PIECE]) and scheduled >= board[Word.PLANNED] + board[Word.HELD] > 0


class PieceWriter:
    """Appends pieces to a reference that is being followed.

    Parameters
    ----------
    spec
        Reference, with its planned beginning in place.
    board
        Announces what is there, in `Word.PLANNED`.
    """

    def __init__(self, spec: ReferenceSpec, board: SharedState) -> None:
        assert spec.planned is not None
        self._memory = mmap.mmap(spec.fd, _SIZE * spec.ticks)
        self._board = board
        self.ticks = spec.planned
        """Ticks that are planned by now."""
        self.room = spec.ticks - spec.planned
        """Ticks for which there is room."""

    def append(self, reference_rad: "NDArray[np.float64]") -> None:
        """Append a piece, shape (n,), relative to the start angle.

        Parameters
        ----------
        reference_rad
            Begins and ends with the angle, speed and acceleration of what is there: at rest.

        Raises
        ------
        ValueError
            If there is no room for it, or it does not begin and end at the start angle.
        """
        size = int(reference_rad.size)
        ends_rad = abs(reference_rad[0]), abs(reference_rad[-1])
        # Also if one of them is not a number: the loop follows whatever stands here.
        if not (max(ends_rad) <= _AT_REST_RAD and abs(reference_rad).max() < _FULL_TURN_RAD):
            raise ValueError(f"a piece from {reference_rad[0]} rad to {reference_rad[-1]} rad")
        if size > self.room:
            raise ValueError(f"a piece of {size} ticks; there is room for {self.room}")
        start = _SIZE * self.ticks
        self._memory[start : start + _SIZE * size] = reference_rad.astype("float64").tobytes()
        self.ticks += size
        self.room -= size
        self._board[Word.PLANNED] = self.ticks


class PieceReader:
    """Follows a reference that grows, tick by tick; holds the last angle while there is no more.

    A piece that would not end with the record or before is not begun: the motor would have to stop
    at full swing.

    Parameters
    ----------
    reference_rad
        Memory of the reference.
    planned
        Ticks that are there from the start.
    board
        `Word.PLANNED` announces what is there, `Word.LAST_PIECE` that nothing more comes; the ticks
        in which the angle was held go into `Word.HELD`, those before the piece that was begun last
        into `Word.HELD_BEFORE`, and where that ends into `Word.BEGUN`.

    """

    def __init__(
        self, reference_rad: "memoryview[float]", planned: int, board: SharedState
    ) -> None:
        self._reference_rad = reference_rad
        self._planned = planned
        self._announced = board.word(Word.PLANNED)
        self._last_piece = board.word(Word.LAST_PIECE)
        self._held_word = board.word(Word.HELD)
        self._before_word = board.word(Word.HELD_BEFORE)
        self._begun_word = board.word(Word.BEGUN)
        self._held = 0

    def at(self, tick: int) -> float:
        """Return the reference of a tick, later than that of the last call."""
        place = tick - self._held
        if place >= self._planned:
            announced = self._announced[0]
            if self._planned < announced <= len(self._reference_rad) - self._held:
                self._planned = announced
                self._before_word[0] = self._held
                self._begun_word[0] = announced
            if place >= self._planned:
                # From the next tick on it follows what is appended by then, from its beginning.
                self._held += place + 1 - self._planned
                self._held_word[0] = self._held
                return self._reference_rad[self._planned - 1]
        return self._reference_rad[place]

    def waits(self, tick: int) -> bool:
        """Whether a tick has no reference yet, and one may come."""
        place = tick - self._held
        return place >= self._planned and place >= self._announced[0] and not self._last_piece[0]

    def over(self, tick: int) -> bool:
        """Whether a tick is after the last piece."""
        if not self._last_piece[0]:
            return False
        return tick - self._held >= max(self._planned, self._announced[0])
