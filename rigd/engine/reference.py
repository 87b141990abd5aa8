"""Reference of a session in shared memory, either complete or appended in segments as it runs.

The control process does not pause to receive a reference in shared memory. However long the
session is, a drive that monitors the loop's heartbeat sees no gap.

The fit process appends segments, which the control process follows. As in a ring, the angles are
written before the field that announces them (`StateField.PLANNED_TICKS`). The control process never
waits for a segment: it holds the last angle until the next segment arrives.
"""

import mmap
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rigd.engine._ring import reserve_memory
from rigd.engine.shared_state import SharedState, StateField

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_DOUBLE_BYTES = 8  # bytes of a double
_REST_TOLERANCE_RAD = 1e-4
"""Largest deviation in rad of a segment's first and last angle from the start angle."""
_MAX_ANGLE_RAD = 6.3
"""Upper limit in rad of the angles of a segment; larger values are refused as errors."""


@dataclass(frozen=True, slots=True)
class ReferenceSpec:
    """File descriptor and length with which a process opens the reference in shared memory."""

    fd: int
    """File descriptor of the shared memory, which child processes inherit."""
    ticks: int
    """Capacity of the reference in ticks."""
    planned_ticks: int | None = None
    """Number of ticks that are planned at the start, before segments are appended; None: all."""


def write_reference(
    fd: int, reference_rad: "NDArray[np.float64]", planned_ticks: int | None = None
) -> ReferenceSpec:
    """Write reference angles to shared memory; return the data with which processes open it.

    Parameters
    ----------
    fd
        Descriptor of the memory.
    reference_rad
        Angle at each tick relative to the start angle, shape (n,).
    planned_ticks
        Number of ticks that are planned so far, if segments will be appended; None: all.

    Raises
    ------
    OSError
        If there is not enough shared memory.
    """
    reference_bytes = _DOUBLE_BYTES * reference_rad.size
    reserve_memory(fd, reference_bytes)
    with mmap.mmap(fd, reference_bytes) as shared_memory:
        # Without a copy: that of an hour would take 30 MB.
        shared_memory[:] = reference_rad.astype("float64", "C", copy=False).data.cast("B")
    return ReferenceSpec(fd, reference_rad.size, planned_ticks)


def map_reference(spec: ReferenceSpec) -> "memoryview[float]":
    """Return a view of a reference in shared memory: the angle in rad for each tick.

    If this process writes to a complete reference, no other process sees the change.
    """
    access_mode = mmap.ACCESS_COPY if spec.planned_ticks is None else mmap.ACCESS_READ
    shared_memory = mmap.mmap(spec.fd, _DOUBLE_BYTES * spec.ticks, access=access_mode)
    return memoryview(shared_memory).cast("d")


def covers_reference(shared_state: SharedState, scheduled_ticks: int, reference_ticks: int) -> bool:
    """Return whether a record is complete, i.e. extends to the end of its reference.

    Parameters
    ----------
    shared_state
        Shared state of the rig's processes.
    scheduled_ticks
        Number of ticks of the record.
    reference_ticks
        Number of ticks of the reference, or the capacity of a growing reference.
    """
    if scheduled_ticks == reference_ticks:
        return True
    return (
        bool(shared_state[StateField.LAST_SEGMENT])
        and scheduled_ticks
        >= shared_state[StateField.PLANNED_TICKS] + shared_state[StateField.HELD_TICKS]
        > 0
    )


class ReferenceWriter:
    """Writer that appends segments to a reference while the control loop follows it.

    Parameters
    ----------
    spec
        Reference that already contains the first segment.
    shared_state
        State that announces the planned ticks (`StateField.PLANNED_TICKS`).
    """

    def __init__(self, spec: ReferenceSpec, shared_state: SharedState) -> None:
        assert spec.planned_ticks is not None
        self._memory = mmap.mmap(spec.fd, _DOUBLE_BYTES * spec.ticks)
        self._shared_state = shared_state
        self.ticks = spec.planned_ticks
        """Number of ticks of the reference that are planned so far."""
        self.room = spec.ticks - spec.planned_ticks
        """Number of ticks that can still be appended to the reference."""

    def append(self, reference_rad: "NDArray[np.float64]") -> None:
        """Append a segment of angles to the reference, and announce it to the control loop.

        Parameters
        ----------
        reference_rad
            Angles of the segment relative to the start angle, shape (n,). The segment begins and
            ends at rest at the start angle.

        Raises
        ------
        ValueError
            If the capacity is exceeded, or the segment does not begin and end at the start angle.
        """
        segment_ticks = int(reference_rad.size)
        end_angles_rad = abs(reference_rad[0]), abs(reference_rad[-1])
        # Also refuse NaN: the loop follows every angle in this memory.
        if not (
            max(end_angles_rad) <= _REST_TOLERANCE_RAD and abs(reference_rad).max() < _MAX_ANGLE_RAD
        ):
            raise ValueError(f"a segment from {reference_rad[0]} rad to {reference_rad[-1]} rad")
        if segment_ticks > self.room:
            raise ValueError(f"a segment of {segment_ticks} ticks; there is room for {self.room}")
        start_offset = _DOUBLE_BYTES * self.ticks
        self._memory[start_offset : start_offset + _DOUBLE_BYTES * segment_ticks] = (
            reference_rad.astype("float64").tobytes()
        )
        self.ticks += segment_ticks
        self.room -= segment_ticks
        self._shared_state[StateField.PLANNED_TICKS] = self.ticks


class ReferenceReader:
    """Reader of a growing reference, which holds the last angle until the next segment arrives.

    A segment that would extend beyond the longest record is not begun, because the record would end
    while the motor moves.

    Parameters
    ----------
    reference_rad
        View of the reference in shared memory.
    planned_ticks
        Number of ticks that are planned at the start.
    shared_state
        State in which the writer announces the planned ticks (`StateField.PLANNED_TICKS`) and
        the last segment (`StateField.LAST_SEGMENT`). The reader writes to it the number of held
        ticks (`StateField.HELD_TICKS`), and for the segment that began last the number of held
        ticks before it (`HELD_TICKS_BEFORE_SEGMENT`) and its end (`BEGUN_REFERENCE_TICKS`).
    """

    def __init__(
        self, reference_rad: "memoryview[float]", planned_ticks: int, shared_state: SharedState
    ) -> None:
        self._reference_rad = reference_rad
        self._planned_ticks = planned_ticks
        self._announced_ticks = shared_state.field_view(StateField.PLANNED_TICKS)
        self._last_segment = shared_state.field_view(StateField.LAST_SEGMENT)
        self._held_ticks = shared_state.field_view(StateField.HELD_TICKS)
        self._held_ticks_before = shared_state.field_view(StateField.HELD_TICKS_BEFORE_SEGMENT)
        self._begun_ticks = shared_state.field_view(StateField.BEGUN_REFERENCE_TICKS)
        self._held_tick_count = 0

    def reference_at(self, tick: int) -> float:
        """Return the reference angle in rad of a tick; call this with increasing ticks."""
        reference_tick = tick - self._held_tick_count
        if reference_tick >= self._planned_ticks:
            announced_ticks = self._announced_ticks[0]
            if (
                self._planned_ticks
                < announced_ticks
                <= len(self._reference_rad) - self._held_tick_count
            ):
                self._planned_ticks = announced_ticks
                self._held_ticks_before[0] = self._held_tick_count
                self._begun_ticks[0] = announced_ticks
            if reference_tick >= self._planned_ticks:
                # The next segment starts at its first angle, however long the wait.
                self._held_tick_count += reference_tick + 1 - self._planned_ticks
                self._held_ticks[0] = self._held_tick_count
                return self._reference_rad[self._planned_ticks - 1]
        return self._reference_rad[reference_tick]

    def must_wait(self, tick: int) -> bool:
        """Return whether the reference of a tick is not planned yet but may be planned later."""
        reference_tick = tick - self._held_tick_count
        return (
            reference_tick >= self._planned_ticks
            and reference_tick >= self._announced_ticks[0]
            and not self._last_segment[0]
        )

    def is_after_end(self, tick: int) -> bool:
        """Return whether a tick is after the last segment, so that the record ends."""
        if not self._last_segment[0]:
            return False
        return tick - self._held_tick_count >= max(self._planned_ticks, self._announced_ticks[0])
