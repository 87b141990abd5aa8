"""Detection of a touch in the control loop, and the immediate reaction to it."""

from dataclasses import dataclass

from rigd.engine.cycle import Cycle
from rigd.engine.messages import TouchOrder
from rigd.excitation import after_touch
from rigd.session.layout import Status
from rigd.touch import TouchDetector

_ANGLE_STALE = int(Status.ANGLE_STALE)
_WRENCH_STALE = int(Status.WRENCH_STALE)
_TOUCHED = int(Status.TOUCHED)
_HARD_TICKS = 2
"""Consecutive ticks with an excessive force: a single one may be a disturbed reading."""


@dataclass(frozen=True, slots=True)
class DetectedContact:
    """A contact that the loop has detected."""

    message: str
    """Sentence for the operator."""
    ends: str = ""
    """Outcome with which the session ends at once; empty: it continues."""
    detected: bool = True
    """Whether the detector found a touch, which is then marked in its sample."""


class TouchWatch:
    """Detector of touches in a search, with the reaction to a touch.

    On the way out and in the pause after it, the motor brakes, waits, and returns to the start of
    the pass. On the way back the motor cannot avoid the obstacle, so the session is stopped.

    Parameters
    ----------
    order
        Description of the search.
    cycle
        Cycle with the readings of the last tick.
    reference_rad
        Reference of the session, relative to its start. The reaction to a touch is written to it.
    rate_hz
        Ticks a second.
    """

    def __init__(
        self, order: TouchOrder, cycle: Cycle, reference_rad: "memoryview[float]", rate_hz: float
    ) -> None:
        self._cycle = cycle
        self._reference_rad = reference_rad
        self._rate_hz = rate_hz
        self._approach = order.approach
        self._projection = order.shear_projection
        self._detector = TouchDetector(order.beam, rate_hz, order.settings)
        self._passes = iter(order.approach.passes)
        self._pass = next(self._passes)
        self._arms = self._pass.begins
        self._hard = 0

    def step(self, tick: int, missed: int) -> DetectedContact | None:
        """Check the tick that was just run, and return the contact if there is one.

        Parameters
        ----------
        tick
            Its number in the record.
        missed
            Ticks that were missed right before it.
        """
        cycle, detector = self._cycle, self._detector
        flags = cycle.flags
        shear_n = 0.0
        if self._projection is not None:
            px, py, pz, qx, qy, qz = self._projection
            fx, fy, fz, tx, ty, tz = cycle.wrench
            shear_n = px * fx + py * fy + pz * fz + qx * tx + qy * ty + qz * tz
        while tick >= self._pass.ends and (following := next(self._passes, None)) is not None:
            self._pass = following
            self._arms = following.begins
        if self._arms <= tick:
            self._arms = len(self._reference_rad)
            detector.arm()
        touched = detector.step(
            cycle.angle_rad,
            cycle.coupling_torque_nm,
            shear_n,
            missed=missed,
            angle_stale=bool(flags & _ANGLE_STALE),
            wrench_stale=bool(flags & _WRENCH_STALE),
        )
        too_hard = self._too_hard(shear_n)
        if too_hard is not None or not touched:
            return too_hard
        cycle.flags |= _TOUCHED
        if tick >= self._pass.returns:
            return DetectedContact(
                "The beam met something on its way back. Find what stands in its way.", "stopped"
            )
        self._react(tick)
        return DetectedContact(f"Touch detected at {tick / self._rate_hz:.3f} s.")

    def _react(self, tick: int) -> None:
        """Replace the remainder of the pass in the reference."""
        reference, current = self._reference_rad, self._pass
        self._detector.disarm()
        recent = reference[max(tick - 2, 0)], reference[max(tick - 1, 0)], reference[tick]
        start_rad = reference[current.begins - 1] if current.begins else 0.0
        path = after_touch(self._approach, current.ends, tick, recent, start_rad)
        reference[tick + 1 : current.ends] = memoryview(path)  # type: ignore[arg-type] # numpy's stubs

    def _too_hard(self, shear_n: float) -> DetectedContact | None:
        if self._projection is None:
            return None
        force_n = abs(self._detector.contact_force_n(shear_n))
        limit_n = self._approach.force_limit_n
        self._hard = self._hard + 1 if force_n > limit_n else 0
        if self._hard < _HARD_TICKS:
            return None
        return DetectedContact(
            f"Contact force {force_n:.3g} N exceeds force_limit_n = {limit_n:g} N. Choose a lower "
            "speed, or a higher limit.",
            "fault",
            detected=False,
        )
