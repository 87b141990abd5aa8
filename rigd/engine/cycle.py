"""One tick: read the devices, check the limits, control, command."""

from collections import deque
from math import inf

from rigd.control import PidController
from rigd.devices.contracts import Devices, Wrench
from rigd.engine.standstill import Standstill
from rigd.safety import LimitWatch, Violation
from rigd.session.format import Status

_ANGLE_STALE = int(Status.ANGLE_STALE)
_WRENCH_STALE = int(Status.WRENCH_STALE)
_WRENCH_SATURATED = int(Status.WRENCH_SATURATED)
_UNUSABLE = _ANGLE_STALE | _WRENCH_STALE | _WRENCH_SATURATED
_TORQUE_SATURATED = int(Status.TORQUE_SATURATED)
_LIMIT_WARNING = int(Status.LIMIT_WARNING)
_TORQUE_OFF = int(Status.TORQUE_OFF)

_RECENT_TICKS = 32
_SPEED_TICKS = 4
"""Of the recent ticks, at either end, over which the speed is taken."""
_SURE_STEPS = 10
"""Encoder steps within `_SPEED_TICKS` above which a speed is one, and not the encoder's noise."""
_GAIN = 0.2
"""Part of the speed that has to be of these ticks: less says nothing about the torque in them."""
_AGAINST = 1 / 3, 3.0
"""Acceleration against the torque, over the one that the torque should give: friction and a motor
whose inertia is only assumed stay within."""


class Cycle:
    """The work of a tick, and what it left behind.

    Parameters
    ----------
    devices
        Connected drive and sensor.
    projection
        Coupling torque about the motor's axis = projection · wrench.
    controller, watch
        Ready to step; the watch sees every reading before the controller does.

    Attributes
    ----------
    devices
        As given.
    zero_rad
        The drive's own angle at the rig's zero.
    angle_rad, raw_wrench, wrench, coupling_torque_nm
        The last readings, the angle from the rig's zero; wrench and torque are tared, the raw
        wrench is not.
    torque_command_nm
        The torque that stands, after the limits.
    flags
        Status bits of the last tick.
    """

    def __init__(
        self,
        devices: Devices,
        projection: Wrench,
        controller: PidController,
        watch: LimitWatch,
    ) -> None:
        self.devices = devices
        self._drive = devices.drive
        self._sensor = devices.sensor
        self._projection = projection
        self.controller = controller
        self.watch = watch
        self.tare: Wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.zero_rad = 0.0
        self.angle_rad = 0.0
        self.raw_wrench: Wrench = self.tare
        self.wrench: Wrench = self.tare
        self.coupling_torque_nm = 0.0
        self.torque_command_nm = 0.0
        self.flags = _TORQUE_OFF
        self._were_unusable = False
        self._commanding = False
        self._torque_squares_nm2 = 0.0
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=_RECENT_TICKS)

    def observe(self, due_ns: int) -> None:
        """Read angle and wrench; the torque stays as it is (zero, before the drive is enabled)."""
        drive, sensor = self._drive, self._sensor
        drive.latch(due_ns)
        sensor.request(due_ns)
        self.angle_rad = drive.read_angle() - self.zero_rad
        self.raw_wrench = fx, fy, fz, tx, ty, tz = sensor.read_wrench()
        bx, by, bz, ox, oy, oz = self.tare
        px, py, pz, qx, qy, qz = self._projection
        self.wrench = (fx := fx - bx, fy := fy - by, fz := fz - bz,
                       tx := tx - ox, ty := ty - oy, tz := tz - oz)  # fmt: skip
        self.coupling_torque_nm = px * fx + py * fy + pz * fz + qx * tx + qy * ty + qz * tz
        flags = 0
        if drive.angle_stale:
            flags |= _ANGLE_STALE
        if sensor.wrench_stale:
            flags |= _WRENCH_STALE
        if sensor.wrench_saturated:
            flags |= _WRENCH_SATURATED
        if self.torque_command_nm == 0.0:
            flags |= _TORQUE_OFF
        self.flags = flags

    def step(self, due_ns: int, reference_rad: float) -> Violation | None:
        """Do a whole tick; where a limit is violated the torque is off when this returns."""
        self.observe(due_ns)
        flags = self.flags & ~_TORQUE_OFF
        watch = self.watch
        violation = watch.check(
            reference_rad,
            self.angle_rad,
            self.raw_wrench,
            angle_stale=bool(flags & _ANGLE_STALE),
        )
        violation = violation or self.check_stale()
        if violation is not None:
            self._recent.append((self.angle_rad, 0.0, 0.0))
            self.torque_off()
            self.flags |= _LIMIT_WARNING
            return violation
        if watch.warning:
            flags |= _LIMIT_WARNING
        controller = self.controller
        torque_nm = controller.step(reference_rad, self.angle_rad, self.coupling_torque_nm)
        if controller.saturated:  # which a torque that is not a number is as well
            violation = watch.check_torque(controller.unlimited_torque_nm)
            if violation is not None:
                self.torque_off()
                self.flags |= _LIMIT_WARNING | _TORQUE_SATURATED
                return violation
            flags |= _TORQUE_SATURATED | _LIMIT_WARNING
        self._commanding = True
        sent_nm = self.torque_command_nm = self._drive.command(torque_nm)
        self._torque_squares_nm2 += sent_nm * sent_nm
        self._recent.append((self.angle_rad, self.coupling_torque_nm, sent_nm))
        self.flags = flags
        return None

    def forget_recent(self) -> None:
        """Begin anew with what `turns_against_torque` goes by."""
        self._recent.clear()

    def turns_against_torque(
        self, inertia_kg_m2: float, rate_hz: float, resolution_rad: float
    ) -> bool:
        """Whether the shaft has just got faster and faster against the torque on it.

        The torque on the motor is the commanded one less the coupling torque, which the sensor
        measures: whatever is done to the beam is in it. A motor that answers by about as much as
        its inertia lets it, but the other way round, has the sign of its angle or torque wrong, or
        is turned by somebody at the shaft itself. Called after a tick whose check found a limit
        violated.
        """
        recent = self._recent
        if len(recent) < _RECENT_TICKS:
            return False
        angles_rad = [angle_rad for angle_rad, _, _ in recent]
        before_rad = angles_rad[_SPEED_TICKS] - angles_rad[0]
        now_rad = angles_rad[-1] - angles_rad[-1 - _SPEED_TICKS]
        faster_rad = now_rad - before_rad
        if abs(now_rad) < _SURE_STEPS * resolution_rad or abs(faster_rad) < _GAIN * abs(now_rad):
            return False
        half = _SPEED_TICKS // 2
        torques_nm = [sent_nm - coupling_nm for _, coupling_nm, sent_nm in recent]
        impulse_nm_s = sum(torques_nm[half : -1 - half]) / rate_hz
        expected_rad = impulse_nm_s / inertia_kg_m2 * _SPEED_TICKS / rate_hz
        least, most = _AGAINST
        against = -faster_rad * expected_rad
        return least * expected_rad**2 <= against <= most * expected_rad**2 and against > 0.0

    @property
    def stale(self) -> bool:
        """Whether a reading of the last tick did not come."""
        return bool(self.flags & (_ANGLE_STALE | _WRENCH_STALE))

    @property
    def what_is_stale(self) -> str:
        """Name what did not come in the last tick."""
        names = ((_ANGLE_STALE, "a new angle"), (_WRENCH_STALE, "a new wrench"))
        return " and ".join(name for flag, name in names if self.flags & flag).capitalize()

    def check_encoder(self, standstill: Standstill, due_ns: int) -> None:
        """Compare the angle just read with those before it, the torque being off.

        Raises
        ------
        DeviceError
            If the encoder jumped.
        """
        if not self.flags & _ANGLE_STALE:
            standstill.check(self.angle_rad + self.zero_rad, due_ns)

    def check_stale(self) -> Violation | None:
        """Say whether a device has given nothing usable for too long, after a tick's reading."""
        flags = self.flags
        if not (flags & _UNUSABLE or self._were_unusable):
            return None
        self._were_unusable = bool(flags & _UNUSABLE)
        return self.watch.check_stale(
            bool(flags & _ANGLE_STALE),
            bool(flags & _WRENCH_STALE),
            bool(flags & _WRENCH_SATURATED),
        )

    def look(
        self, due_ns: int, recorder_lag_s: float = 0.0, disk_free_mb: float = inf
    ) -> Violation | None:
        """Check what changes slowly, every `LOOK_EVERY` ticks.

        Parameters
        ----------
        due_ns
            When the present tick was due.
        recorder_lag_s
            By how much the recorder is behind the loop.
        disk_free_mb
            Of the disk that the session goes to.

        Returns
        -------
        Violation or None
            Where a limit is violated, the torque is off.
        """
        squares_nm2, self._torque_squares_nm2 = self._torque_squares_nm2, 0.0
        violation = self.watch.look(due_ns, squares_nm2, recorder_lag_s, disk_free_mb)
        if violation is not None:
            self.torque_off()
        return violation

    def torque_off(self) -> None:
        """Zero the torque and disable the drive, once: a real one takes its time."""
        if self._commanding:
            self._commanding = False
            self._drive.disable()
        self.torque_command_nm = 0.0
        self.flags |= _TORQUE_OFF

    def lose_readings(self) -> None:
        """Switch off because a device failed: what was read last stands, and is marked so."""
        self.torque_off()
        self.flags |= _ANGLE_STALE | _WRENCH_STALE
