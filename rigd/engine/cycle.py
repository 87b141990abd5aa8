"""One tick of the control loop (read, check, control, command), and the checks at rest.

`Cycle` runs a tick. The tare is the mean of readings without torque (`observe_rest`). A jump of the
encoder's count would shift the zero of the angle, and with it the limits. `LimitMonitor` therefore
checks every reading during a session, and `StandstillMonitor` before, between and after sessions.
While the torque is off, a person may turn the motor by hand, but its angle cannot jump.
"""

import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import exp, inf, isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigd.control.contracts import LoopController
from rigd.devices.contracts import DeviceError, Devices, GaugeSensor, Wrench
from rigd.engine.timing import TickScheduler
from rigd.profile import Profile
from rigd.runtime.addresses import UnsafeFolderError, runtime_folder
from rigd.safety import BeamPrediction, EncoderMonitor, LimitMonitor, ScaleMonitor, SensorMonitor
from rigd.safety.limits import INTERLOCKS_BY_NAME, Violation
from rigd.session.layout import WRENCH_FIELDS, Status

ENCODER_REMEDY = (
    "The zero of the angle and its limits are invalid: check the encoder, its cable and shield, "
    "then reset the rig and set the zero again."
)
"""Advice for the operator after an encoder fault, the end of several error messages."""

_ANGLE_STALE = int(Status.ANGLE_STALE)
_WRENCH_STALE = int(Status.WRENCH_STALE)
_WRENCH_SATURATED = int(Status.WRENCH_SATURATED)
_UNUSABLE_FLAGS = _ANGLE_STALE | _WRENCH_STALE | _WRENCH_SATURATED
_TORQUE_SATURATED = int(Status.TORQUE_SATURATED)
_LIMIT_WARNING = int(Status.LIMIT_WARNING)
_TORQUE_OFF = int(Status.TORQUE_OFF)

_STALE_ANGLE_CHANNELS = tuple(
    INTERLOCKS_BY_NAME[name].channel for name in ("stale angle", "stale angle share")
)
_STALE_WRENCH_CHANNELS = tuple(
    INTERLOCKS_BY_NAME[name].channel for name in ("stale wrench", "stale wrench share")
)

_SIGN_CHECK_TICKS = 32
"""Number of latest ticks whose angles and torques show whether a sign is wrong."""
_SPEED_WINDOW_TICKS = 4
"""Number of ticks from which the speed is computed, at either end of the last `_SIGN_CHECK_TICKS`
ticks."""
_MIN_SPEED_ENCODER_STEPS = 10
"""Minimum number of encoder steps in `_SPEED_WINDOW_TICKS` ticks with which the speed exceeds the
noise."""
_MIN_SPEED_CHANGE_RATIO = 0.2
"""Minimum change of the speed in `_SIGN_CHECK_TICKS`, as a fraction of the speed. A smaller
change does not show the sign of the torque."""
_OPPOSITE_ACCELERATION_RATIOS = 1 / 3, 3.0
"""Smallest and largest ratio of the measured acceleration to minus the expected acceleration that
show a wrong sign. The range allows for friction and for an inertia that is only assumed."""


# The encoder without torque


class StandstillMonitor:
    """Monitor that checks that the motor's angle does not jump while the torque is off.

    Each angle is compared with the angles before it. From one tick to the next the speed may change
    as much as ``limits.acceleration_rad_s2`` allows, as in the loop. After missed ticks the angle
    may have changed as much as ``limits.velocity_rad_s`` allows.

    Parameters
    ----------
    profile
        Profile of the rig.
    """

    def __init__(self, profile: Profile) -> None:
        rate_hz, limits = profile.rig.rate_hz, profile.limits
        self._period_ns = 1e9 / rate_hz
        # A difference of two movements has four readings in it, each half a step wrong.
        self._angle_tolerance_rad = 2.0 * profile.rig.encoder.resolution_rad
        self._max_movement_change_rad = limits.acceleration_rad_s2 / rate_hz**2
        self._max_movement_rad = limits.velocity_rad_s / rate_hz
        self.reset()

    def reset(self) -> None:
        """Discard the previous angles; call this after the drive has moved the motor."""
        self._angle_rad: float | None = None
        self._due_ns = 0
        self._last_movements_rad: tuple[float, float] | None = None

    @property
    def has_speed(self) -> bool:
        """Whether the last angle and speed are known, so that the next angle can be checked."""
        return self._last_movements_rad is not None

    def check_angle(self, angle_rad: float, due_ns: int) -> None:
        """Raise `DeviceError` if the angle has jumped since the last tick.

        Parameters
        ----------
        angle_rad
            Angle relative to a zero that does not change. The reading must not be stale.
        due_ns
            Time at which the tick of this angle was due.

        Raises
        ------
        DeviceError
            If the angle has changed more than the motor can turn since the last tick.
        """
        last_angle_rad, elapsed_ticks = (
            self._angle_rad,
            round((due_ns - self._due_ns) / self._period_ns),
        )
        self._angle_rad, self._due_ns = angle_rad, due_ns
        if last_angle_rad is None:
            return
        movement_rad = angle_rad - last_angle_rad
        last_movements_rad, self._last_movements_rad = self._last_movements_rad, None
        if elapsed_ticks > 1:
            max_jump_rad = self._max_movement_rad * elapsed_ticks + self._angle_tolerance_rad
            jump_rad, limit_key = movement_rad, "limits.velocity_rad_s"
        else:
            # The movement before the first is unknown.
            last_movement_rad, earlier_movement_rad = last_movements_rad or (
                0.0,
                self._max_movement_rad,
            )
            # One latch may be late by most of a period, and the next one punctual.
            max_jump_rad = (
                self._max_movement_change_rad
                + self._angle_tolerance_rad
                + abs(last_movement_rad)
                + abs(earlier_movement_rad)
            )
            jump_rad, limit_key = movement_rad - last_movement_rad, "limits.acceleration_rad_s2"
            self._last_movements_rad = movement_rad, last_movement_rad
        if not abs(jump_rad) <= max_jump_rad:
            elapsed_text = f"{elapsed_ticks} ticks" if elapsed_ticks > 1 else "one tick"
            raise DeviceError(
                f"The encoder jumped by {jump_rad:.4g} rad within {elapsed_text} while the torque "
                f"was off; at most {max_jump_rad:.2g} rad is possible ({limit_key}). "
                f"{ENCODER_REMEDY}"
            )


# One tick


class Cycle:
    """Cycle of the control loop: reads, checks, controls and commands in each tick.

    Parameters
    ----------
    devices
        Connected drive and sensor.
    projection
        Coupling torque about the motor's axis = projection · wrench.
    controller, limit_monitor
        Controller and limit monitor. The monitor checks every reading before the controller
        uses it.
    reading_monitors
        Monitors that check encoder and sensor readings for plausibility.

    Attributes
    ----------
    devices
        The argument of the same name.
    zero_rad
        Angle that the drive reports at the rig's zero.
    angle_rad, raw_wrench, wrench, coupling_torque_nm
        The last readings. The angle is measured from the rig's zero. Wrench and torque are tared,
        the raw wrench is not.
    torque_command_nm
        The present torque command, after the limits.
    flags
        Status bits of the last tick.
    encoder_monitor
        Check of the encoder against the torques, or None in a probing move, which checks the
        encoder itself.
    """

    def __init__(
        self,
        devices: Devices,
        projection: Wrench,
        controller: LoopController,
        limit_monitor: LimitMonitor,
        reading_monitors: "ReadingMonitors",
    ) -> None:
        self.devices = devices
        self._drive = devices.drive
        self._sensor = devices.sensor
        self._projection = projection
        self.controller: LoopController = controller
        self.limit_monitor = limit_monitor
        self.encoder_monitor: EncoderMonitor | None = reading_monitors.encoder
        self.sensor_monitor = reading_monitors.sensor
        self._gauges = devices.sensor if isinstance(devices.sensor, GaugeSensor) else None
        self.tare: Wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.zero_rad = 0.0
        self.angle_rad = 0.0
        self.raw_wrench: Wrench = self.tare
        self.wrench: Wrench = self.tare
        self.coupling_torque_nm = 0.0
        self.torque_command_nm = 0.0
        self.flags = _TORQUE_OFF
        self._last_unusable = False
        self._commanding = False
        self._torque_squares_nm2 = 0.0
        self._recent_ticks: deque[tuple[float, float, float]] = deque(maxlen=_SIGN_CHECK_TICKS)

    def read_devices(self, due_ns: int) -> None:
        """Read angle and wrench from the devices without changing the torque command."""
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
        status_flags = 0
        if drive.angle_stale:
            status_flags |= _ANGLE_STALE
        if sensor.wrench_stale:
            status_flags |= _WRENCH_STALE
        if sensor.wrench_saturated:
            status_flags |= _WRENCH_SATURATED
        if self.torque_command_nm == 0.0:
            status_flags |= _TORQUE_OFF
        self.flags = status_flags

    def step(self, due_ns: int, reference_rad: float) -> Violation | None:
        """Run one tick of the loop; return the violation if a limit is violated, otherwise None.

        After a violation the torque is off.

        Parameters
        ----------
        due_ns
            Time at which the tick was due.
        reference_rad
            Reference angle of this tick, from the rig's zero.

        Raises
        ------
        ControllerError
            If the controller of an installed package fails. The torque command is then unchanged.
        """
        self.read_devices(due_ns)
        status_flags = self.flags & ~_TORQUE_OFF
        limit_monitor = self.limit_monitor
        violation = limit_monitor.check(
            reference_rad,
            self.angle_rad,
            self.raw_wrench,
            angle_stale=bool(status_flags & _ANGLE_STALE),
        )
        violation = violation or self.check_stale() or self.check_sensor()
        encoder_monitor = self.encoder_monitor
        if encoder_monitor is not None and violation is None:
            violation = encoder_monitor.step(
                self.angle_rad,
                self.coupling_torque_nm,
                self.torque_command_nm,
                is_fresh=not status_flags & _UNUSABLE_FLAGS,
            )
        if violation is not None:
            self._recent_ticks.append((self.angle_rad, 0.0, 0.0))
            self.switch_torque_off()
            self.flags |= _LIMIT_WARNING
            return violation
        if limit_monitor.warning:
            status_flags |= _LIMIT_WARNING
        controller = self.controller
        torque_nm = controller.step(reference_rad, self.angle_rad, self.coupling_torque_nm)
        if controller.saturated:  # a torque that is not a number counts as saturated
            violation = limit_monitor.check_torque(controller.unlimited_torque_nm)
            if violation is not None:
                self.switch_torque_off()
                self.flags |= _LIMIT_WARNING | _TORQUE_SATURATED
                return violation
            status_flags |= _TORQUE_SATURATED | _LIMIT_WARNING
        if encoder_monitor is not None and encoder_monitor.test_nm:
            torque_limit_nm = controller.torque_limit_nm
            torque_nm = max(
                -torque_limit_nm, min(torque_limit_nm, torque_nm + encoder_monitor.test_nm)
            )
        self._commanding = True
        sent_torque_nm = self.torque_command_nm = self._drive.command(torque_nm)
        self._torque_squares_nm2 += sent_torque_nm * sent_torque_nm
        self._recent_ticks.append((self.angle_rad, self.coupling_torque_nm, sent_torque_nm))
        self.flags = status_flags
        return None

    def start_control(self, torque_noise_nm: float) -> None:
        """Reset controller and monitors to a motor at rest at the last angle.

        Parameters
        ----------
        torque_noise_nm
            Standard deviation of the coupling torque at rest.
        """
        self.controller.reset(self.angle_rad)
        self.limit_monitor.reset(self.angle_rad)
        if self.encoder_monitor is not None:
            self.encoder_monitor.reset(self.angle_rad, torque_noise_nm)
        self._recent_ticks.clear()

    def skip(self, missed_ticks: int) -> None:
        """Report missed ticks, in which the torque was unchanged, to limit and encoder monitors."""
        if missed_ticks:
            self.limit_monitor.skip(missed_ticks)
            self.skip_encoder(missed_ticks)

    def skip_encoder(self, missed_ticks: int) -> None:
        """Report missed ticks to the encoder monitor only."""
        if self.encoder_monitor is not None:
            self.encoder_monitor.skip(missed_ticks, self.angle_rad)

    def accelerates_against_torque(
        self, inertia_kg_m2: float, rate_hz: float, resolution_rad: float
    ) -> bool:
        """Return whether the shaft has just accelerated against the torque on it.

        The torque on the motor is the commanded torque less the measured coupling torque, which
        includes every load on the beam. If the measured acceleration is about
        −torque / inertia, the sign of angle or torque is wrong, or somebody turns the shaft.
        Call this after a tick that violated a limit.

        Parameters
        ----------
        inertia_kg_m2
            Inertia of the motor.
        rate_hz
            Ticks a second.
        resolution_rad
            Resolution of the encoder.
        """
        recent_ticks = self._recent_ticks
        if len(recent_ticks) < _SIGN_CHECK_TICKS:
            return False
        angles_rad = [angle_rad for angle_rad, _, _ in recent_ticks]
        earlier_movement_rad = angles_rad[_SPEED_WINDOW_TICKS] - angles_rad[0]
        last_movement_rad = angles_rad[-1] - angles_rad[-1 - _SPEED_WINDOW_TICKS]
        speed_change_rad = last_movement_rad - earlier_movement_rad
        if abs(last_movement_rad) < _MIN_SPEED_ENCODER_STEPS * resolution_rad or abs(
            speed_change_rad
        ) < _MIN_SPEED_CHANGE_RATIO * abs(last_movement_rad):
            return False
        half_window_ticks = _SPEED_WINDOW_TICKS // 2
        torques_nm = [sent_nm - coupling_nm for _, coupling_nm, sent_nm in recent_ticks]
        impulse_nm_s = sum(torques_nm[half_window_ticks : -1 - half_window_ticks]) / rate_hz
        expected_change_rad = impulse_nm_s / inertia_kg_m2 * _SPEED_WINDOW_TICKS / rate_hz
        min_ratio, max_ratio = _OPPOSITE_ACCELERATION_RATIOS
        opposed_change_rad2 = -speed_change_rad * expected_change_rad
        return (
            min_ratio * expected_change_rad**2
            <= opposed_change_rad2
            <= max_ratio * expected_change_rad**2
            and opposed_change_rad2 > 0.0
        )

    @property
    def has_stale_reading(self) -> bool:
        """Whether angle or wrench of the last tick is older than the tick."""
        return bool(self.flags & (_ANGLE_STALE | _WRENCH_STALE))

    @property
    def stale_reading_names(self) -> str:
        """Names of the last tick's stale readings, as text for a message."""
        flag_names = ((_ANGLE_STALE, "a new angle"), (_WRENCH_STALE, "a new wrench"))
        return " and ".join(
            reading_name for stale_flag, reading_name in flag_names if self.flags & stale_flag
        ).capitalize()

    def check_encoder(self, standstill: StandstillMonitor, due_ns: int) -> None:
        """Raise `DeviceError` if the last angle has jumped while the torque was off.

        Parameters
        ----------
        standstill
            Monitor of the angle at rest.
        due_ns
            Time at which the tick was due.

        Raises
        ------
        DeviceError
            If the encoder jumped.
        """
        if not self.flags & _ANGLE_STALE:
            standstill.check_angle(self.angle_rad + self.zero_rad, due_ns)

    def check_sensor(self) -> Violation | None:
        """Return a violation if the sensor repeats its readings, otherwise None.

        Call this after each reading.
        """
        if self.flags & _UNUSABLE_FLAGS & ~_ANGLE_STALE:
            return None
        gauge_sensor = self._gauges
        return self.sensor_monitor.step(
            self.raw_wrench if gauge_sensor is None else gauge_sensor.gauges
        )

    def check_stale(self) -> Violation | None:
        """Return a violation if a device has sent no usable reading for too long, else None."""
        status_flags = self.flags
        if not (status_flags & _UNUSABLE_FLAGS or self._last_unusable):
            return None
        self._last_unusable = bool(status_flags & _UNUSABLE_FLAGS)
        return self.limit_monitor.check_stale(
            bool(status_flags & _ANGLE_STALE),
            bool(status_flags & _WRENCH_STALE),
            bool(status_flags & _WRENCH_SATURATED),
        )

    def with_reported_cause(self, violation: Violation) -> Violation:
        """Return a violation whose remedy is the cause that the device reports.

        The violation is unchanged if the device reports no cause.

        Parameters
        ----------
        violation
            Any violation; devices report causes of stale readings only.
        """
        for device, channel_names in (
            (self._drive, _STALE_ANGLE_CHANNELS),
            (self._sensor, _STALE_WRENCH_CHANNELS),
        ):
            if violation.channel in channel_names and (cause := device.health().cause):
                return replace(violation, remedy=cause)
        return violation

    def check_slow_limits(
        self, due_ns: int, recorder_lag_s: float = 0.0, disk_free_mb: float = inf
    ) -> Violation | None:
        """Check motor heat, recorder lag and free disk space; return the violation or None.

        Parameters
        ----------
        due_ns
            Time at which the present tick was due.
        recorder_lag_s
            Time in s by which the recorder lags behind the loop.
        disk_free_mb
            Free space in MB on the disk that holds the session file.

        Returns
        -------
        Violation or None
            Violation of a limit, if there is one. The torque is then off.
        """
        torque_squares_nm2, self._torque_squares_nm2 = self._torque_squares_nm2, 0.0
        violation = self.limit_monitor.check_slow(
            due_ns, torque_squares_nm2, recorder_lag_s, disk_free_mb
        )
        if violation is not None:
            self.switch_torque_off()
        return violation

    def switch_torque_off(self) -> None:
        """Set the torque to zero, and disable the drive if it is enabled."""
        if self._commanding:
            self._commanding = False
            self._drive.disable()
        self.torque_command_nm = 0.0
        self.flags |= _TORQUE_OFF

    def mark_readings_stale(self) -> None:
        """Switch the torque off after a device failure, and mark the last readings as stale."""
        self.switch_torque_off()
        self.flags |= _ANGLE_STALE | _WRENCH_STALE


# Readings at rest


@dataclass(frozen=True, slots=True)
class RestReadings:
    """Readings of angle and wrench at rest, without torque.

    Attributes
    ----------
    duration_s
        Duration of the readings.
    wrenches
        Raw wrenches (not tared) in N and N·m, shape (n, 6).
    angles_rad
        Angles relative to the rig's zero, shape (n,).
    torques_nm
        Coupling torques of the raw wrenches, shape (n,).
    """

    duration_s: float
    wrenches: NDArray[np.float64]
    angles_rad: NDArray[np.float64]
    torques_nm: NDArray[np.float64]

    @property
    def speed_rad_s(self) -> float:
        """Range of the motor's angles divided by the duration, in rad/s."""
        return float(np.ptp(self.angles_rad)) / self.duration_s

    @property
    def torque_spread_nm(self) -> float:
        """Standard deviation of the coupling torque in N·m, from noise and the beam's vibration."""
        return float(self.torques_nm.std())

    @property
    def mean_wrench(self) -> Wrench:
        """Mean of the raw wrench at rest on each axis, in N and N·m."""
        fx, fy, fz, tx, ty, tz = (float(axis_mean) for axis_mean in self.wrenches.mean(axis=0))
        return fx, fy, fz, tx, ty, tz

    @property
    def wrench_std(self) -> Wrench:
        """Standard deviation of the raw wrench at rest on each axis, in N and N·m."""
        fx, fy, fz, tx, ty, tz = (float(axis_std) for axis_std in self.wrenches.std(axis=0, ddof=1))
        return fx, fy, fz, tx, ty, tz

    def as_metadata(self) -> dict[str, str]:
        """Return duration in s, and mean and standard deviation of each axis, as file metadata."""
        return {"tare_s": repr(self.duration_s)} | {
            f"tare_{statistic}_{axis}": repr(axis_value)
            for statistic, axis_values in (("mean", self.mean_wrench), ("std", self.wrench_std))
            for axis, axis_value in zip(WRENCH_FIELDS, axis_values, strict=True)
        }


def observe_rest(
    cycle: Cycle,
    scheduler: TickScheduler,
    *,
    rate_hz: float,
    duration_s: float,
    projection: Wrench,
    check_reading: Callable[[], None],
) -> RestReadings:
    """Read angle and wrench for a time without changing the torque; return the readings.

    Parameters
    ----------
    cycle, scheduler
        Cycle that reads the devices, and the schedule of its ticks.
    rate_hz, duration_s
        Rate and duration of the readings.
    projection
        Coupling torque = projection · wrench.
    check_reading
        Function that is called after each reading. An exception of it ends the readings.
    """
    wrenches: list[Wrench] = []
    angles_rad: list[float] = []
    for _ in range(round(duration_s * rate_hz)):
        scheduler.wait()
        cycle.read_devices(scheduler.due_ns)
        check_reading()
        wrenches.append(cycle.raw_wrench)
        angles_rad.append(cycle.angle_rad)
    wrench_array = np.array(wrenches)
    return RestReadings(
        duration_s, wrench_array, np.array(angles_rad), wrench_array @ np.array(projection)
    )


# The limit monitor, and the motor's heat


def make_limit_monitor(profile: Profile, heat_nm2: float = 0.0) -> LimitMonitor:
    """Return a limit monitor for a rig; one monitor is used as long as the rig is connected.

    Parameters
    ----------
    profile
        Profile of the rig.
    heat_nm2
        Heat of the motor in (N·m)²: mean square of the torque in the last thermal time constant.
    """
    rig = profile.rig
    limit_monitor = LimitMonitor(
        profile.limits,
        rig.sensor.range,
        rig.rate_hz,
        resolution_rad=rig.encoder.resolution_rad,
        peak_torque_nm=rig.motor.peak_torque_nm,
        continuous_torque_nm=rig.motor.continuous_torque_nm,
        thermal_time_constant_s=rig.motor.thermal_time_constant_s,
        tare_warning_nm=profile.session.tare_drift_nm,
    )
    limit_monitor.heat_nm2 = heat_nm2
    return limit_monitor


@dataclass(frozen=True, slots=True)
class ReadingMonitors:
    """Monitors that check encoder and sensor readings for plausibility."""

    encoder: EncoderMonitor
    """Check of the encoder against the torques on the shaft."""
    sensor: SensorMonitor
    """Check that the sensor does not repeat its last reading."""


def make_reading_monitors(profile: Profile, devices: Devices) -> ReadingMonitors:
    """Return the monitors that check a rig's encoder and sensor for plausible readings.

    Parameters
    ----------
    profile
        Profile of the rig.
    devices
        Devices that are read.
    """
    rig = profile.rig
    beam_prediction = BeamPrediction(rig.beam, rig.damping, rig.rate_hz)
    encoder_monitor = EncoderMonitor(
        beam_prediction,
        rig.rate_hz,
        resolution_rad=rig.encoder.resolution_rad,
        inertia_kg_m2=rig.motor.inertia_kg_m2,
        breakaway_nm=profile.standstill_torque_nm,
        command_delay_ticks=max(1, round(rig.actuation.delay_s * rig.rate_hz)),
        scale_monitor=ScaleMonitor(rig.motor.inertia_kg_m2, profile.limits.torque_ratio),
    )
    simulation = rig.simulation
    is_channel_noisy = [True] * 6
    if simulation is not None:
        is_channel_noisy = [simulation.force_noise_n > 0.0] * 3 + [
            simulation.torque_noise_nm > 0.0
        ] * 3
    channel_names: Sequence[str] = WRENCH_FIELDS
    if isinstance(devices.sensor, GaugeSensor):
        # Each gauge shows the noise of all axes.
        channel_names, is_channel_noisy = (
            [f"gauge {gauge_number}" for gauge_number in range(6)],
            [all(is_channel_noisy)] * 6,
        )
    return ReadingMonitors(
        encoder_monitor, SensorMonitor(channel_names, is_channel_noisy, rig.rate_hz)
    )


def store_motor_heat(profile: Profile, heat_nm2: float) -> None:
    """Store the heat of the motor in a file for this user's next connection to the rig.

    If it cannot be stored, the next connection assumes a cold motor.

    Parameters
    ----------
    profile
        Profile of the rig.
    heat_nm2
        Heat of the motor, from the limit monitor.
    """
    heat_document = {"heat_nm2": heat_nm2, "boot_s": time.clock_gettime(time.CLOCK_BOOTTIME)}
    with suppress(OSError, UnsafeFolderError):
        heat_path = _heat_file(profile)
        heat_path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary_path = heat_path.with_suffix(".new")
        temporary_path.write_text(json.dumps(heat_document), encoding="utf-8")
        temporary_path.replace(heat_path)


def stored_motor_heat_nm2(profile: Profile) -> float:
    """Return the heat in (N·m)² that the motor has left from the last connection; 0 if unknown.

    The motor has cooled since then with its thermal time constant.
    """
    try:
        heat_document = json.loads(_heat_file(profile).read_text("utf-8"))
        heat_nm2, boot_s = float(heat_document["heat_nm2"]), float(heat_document["boot_s"])
    except (OSError, UnsafeFolderError, ValueError, TypeError, KeyError):
        return 0.0
    elapsed_s = time.clock_gettime(time.CLOCK_BOOTTIME) - boot_s
    if not isfinite(heat_nm2) or not elapsed_s >= 0.0:  # from before a reboot
        return 0.0
    motor = profile.rig.motor
    max_heat_nm2 = motor.peak_torque_nm**2
    return min(max(0.0, heat_nm2), max_heat_nm2) * exp(-elapsed_s / motor.thermal_time_constant_s)


def _heat_file(profile: Profile) -> Path:
    """Return the path of the file that stores the heat of a rig's motor."""
    rig_file_name = "".join(c if c.isalnum() else "-" for c in profile.name).strip("-")
    return runtime_folder() / f"heat-{rig_file_name}.json"
