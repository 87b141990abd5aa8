"""The encoder while the torque is off: a hand may turn the motor, but nothing makes it jump.

The zero, and the limits with it, stand on the encoder's count. In a session the watch over the
limits sees every reading; this sees those before, between and after.
"""

from rigd.devices.contracts import DeviceError
from rigd.profile import Profile

REMEDY = (
    "The zero of the angle is void, and the limits with it: look at encoder, its cable and shield, "
    "then reset the rig and set the zero again."
)


class Standstill:
    """Compares each angle that is read without torque with those before it.

    From one tick to the next the speed may change by what ``limits.acceleration_rad_s2`` allows,
    as in the loop; over ticks that were missed the motor may move as fast as
    ``limits.velocity_rad_s``.

    Parameters
    ----------
    profile
        Of the rig.
    """

    def __init__(self, profile: Profile) -> None:
        rate_hz, limits = profile.rig.rate_hz, profile.limits
        self._period_ns = 1e9 / rate_hz
        # A difference of two movements has four readings in it, each half a step wrong.
        self._steps_rad = 2.0 * profile.rig.encoder.resolution_rad
        self._per_tick2_rad = limits.acceleration_rad_s2 / rate_hz**2
        self._per_tick_rad = limits.velocity_rad_s / rate_hz
        self.forget()

    def forget(self) -> None:
        """Begin anew with the next angle: the drive has been, or is being, controlled."""
        self._angle_rad: float | None = None
        self._due_ns = 0
        self._moved: tuple[float, float] | None = None

    @property
    def begun(self) -> bool:
        """Whether place and movement are known, with which the next angle is compared."""
        return self._moved is not None

    def check(self, angle_rad: float, due_ns: int) -> None:
        """Check an angle that is not stale.

        Parameters
        ----------
        angle_rad
            From any zero that stays where it is.
        due_ns
            When its tick was due.

        Raises
        ------
        DeviceError
            If nothing turns a motor like that.
        """
        before_rad, ticks = self._angle_rad, round((due_ns - self._due_ns) / self._period_ns)
        self._angle_rad, self._due_ns = angle_rad, due_ns
        if before_rad is None:
            return
        moved_rad = angle_rad - before_rad
        moved, self._moved = self._moved, None
        if ticks > 1:
            possible_rad = self._per_tick_rad * ticks + self._steps_rad
            jump_rad, key = moved_rad, "limits.velocity_rad_s"
        else:
            # Of the first movement nobody knows the one before it.
            last_rad, before_that_rad = moved or (0.0, self._per_tick_rad)
            # A latch may be late by most of a period, and the next one is not.
            possible_rad = (
                self._per_tick2_rad + self._steps_rad + abs(last_rad) + abs(before_that_rad)
            )
            jump_rad, key = moved_rad - last_rad, "limits.acceleration_rad_s2"
            self._moved = moved_rad, last_rad
        if not abs(jump_rad) <= possible_rad:
            ticks_taken = f"{ticks} ticks" if ticks > 1 else "one tick"
            raise DeviceError(
                f"The encoder jumped by {jump_rad:.4g} rad within {ticks_taken} while the torque "
                f"was off, and no more than {possible_rad:.2g} rad are possible ({key}). {REMEDY}"
            )
