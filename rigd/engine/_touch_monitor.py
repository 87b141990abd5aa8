"""Detection of a touch in the control loop, and the immediate reaction to it."""

from dataclasses import dataclass

from rigd.engine.cycle import Cycle
from rigd.engine.messages import TouchOrder
from rigd.excitation import reference_after_touch
from rigd.session.layout import Status
from rigd.touch import TouchDetector

_ANGLE_STALE = int(Status.ANGLE_STALE)
_WRENCH_STALE = int(Status.WRENCH_STALE)
_TOUCHED = int(Status.TOUCHED)
_MIN_EXCESSIVE_FORCE_TICKS = 2
"""Number of consecutive ticks with an excessive force that end a session: a single tick may be a
disturbed reading."""


@dataclass(frozen=True, slots=True)
class DetectedContact:
    """Contact with an obstacle that the control loop has detected, and what follows from it."""

    message: str
    """Sentence for the operator."""
    session_outcome: str = ""
    """Outcome with which the contact ends the session; empty if the session continues."""
    is_touch: bool = True
    """Whether the detector found a touch, which is then marked in the tick's sample."""


class TouchMonitor:
    """Monitor that detects touches during a search, and makes the motor react to a touch.

    After a touch on the way out, or in the following pause, the motor brakes, waits, and returns to
    the start of the pass. After a touch on the way back the motor cannot avoid the obstacle, so the
    session is stopped.

    `order` has the passes of the search, and the settings of the touch detector. `reference_rad` is
    relative to the start angle. After a touch this array is overwritten with the motor's reaction.
    `rate_hz` is the number of ticks a second.
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
        self._arming_tick = self._pass.begin_tick
        self._excessive_force_ticks = 0

    def step(self, tick: int, missed_ticks: int) -> DetectedContact | None:
        """Check the last tick for a touch; return the contact, or None if nothing was touched.

        `tick` is the number of the tick in the record, and `missed_ticks` the number of ticks that
        were missed directly before it.
        """
        cycle, detector = self._cycle, self._detector
        status_flags = cycle.flags
        shear_n = 0.0
        if self._projection is not None:
            px, py, pz, qx, qy, qz = self._projection
            fx, fy, fz, tx, ty, tz = cycle.wrench
            shear_n = px * fx + py * fy + pz * fz + qx * tx + qy * ty + qz * tz
        while tick >= self._pass.end_tick and (next_pass := next(self._passes, None)) is not None:
            self._pass = next_pass
            self._arming_tick = next_pass.begin_tick
        if self._arming_tick <= tick:
            self._arming_tick = len(self._reference_rad)
            detector.arm()
        is_touched = detector.step(
            cycle.angle_rad,
            cycle.coupling_torque_nm,
            shear_n,
            missed_tick_count=missed_ticks,
            angle_stale=bool(status_flags & _ANGLE_STALE),
            wrench_stale=bool(status_flags & _WRENCH_STALE),
        )
        forceful_contact = self._check_force_limit(shear_n)
        if forceful_contact is not None or not is_touched:
            return forceful_contact
        cycle.flags |= _TOUCHED
        if tick >= self._pass.return_tick:
            return DetectedContact(
                "The beam met something on its way back. Find what is in its way.", "stopped"
            )
        self._return_after_touch(tick)
        return DetectedContact(f"Touch detected at {tick / self._rate_hz:.3f} s.")

    def _return_after_touch(self, tick: int) -> None:
        """Overwrite the remaining reference of the pass with braking, waiting and the way back."""
        reference_rad, current_pass = self._reference_rad, self._pass
        self._detector.disarm()
        last_angles_rad = (
            reference_rad[max(tick - 2, 0)],
            reference_rad[max(tick - 1, 0)],
            reference_rad[tick],
        )
        start_angle_rad = (
            reference_rad[current_pass.begin_tick - 1] if current_pass.begin_tick else 0.0
        )
        path_rad = reference_after_touch(
            self._approach, current_pass.end_tick, tick, last_angles_rad, start_angle_rad
        )
        reference_rad[tick + 1 : current_pass.end_tick] = memoryview(path_rad)  # type: ignore[arg-type] # numpy's stubs

    def _check_force_limit(self, shear_n: float) -> DetectedContact | None:
        """Return a contact if its force exceeded the limit in two consecutive ticks, else None."""
        if self._projection is None:
            return None
        force_n = abs(self._detector.contact_force_n(shear_n))
        force_limit_n = self._approach.force_limit_n
        self._excessive_force_ticks = (
            self._excessive_force_ticks + 1 if force_n > force_limit_n else 0
        )
        if self._excessive_force_ticks < _MIN_EXCESSIVE_FORCE_TICKS:
            return None
        return DetectedContact(
            f"Contact force {force_n:.3g} N exceeds force_limit_n = {force_limit_n:g} N. "
            "Choose a lower speed, or a higher limit.",
            "fault",
            is_touch=False,
        )
