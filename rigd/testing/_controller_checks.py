"""Checks of the behaviour of a controller that the control loop relies on."""

import gc
import random
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from math import isfinite

import numpy as np

from rigd.beam.realisation import realise
from rigd.control import DiscretePlant
from rigd.control.contracts import ControllerError, LoopController
from rigd.control.kinds import make_controller
from rigd.profile import Profile

Readings = tuple[float, float, float]
"""Reference angle (rad), measured angle (rad) and coupling torque (N·m) of a tick."""

_MAX_REST_TORQUE_FRACTION = 1e-6
"""Largest torque after a reset at rest, as a fraction of the motor's peak torque."""
_RANDOM_READING_TICKS = 2000
"""Number of ticks with random readings."""
_STALE_READING_TICKS = 20
"""Number of ticks for which the readings do not change, as those of a device that is silent."""
_MEMORY_CHECK_TICKS = 4000
"""Number of ticks in which the memory of the controller must not grow."""
_MAX_BYTES_PER_TICK = 2.0
"""Largest growth of the memory in bytes per tick that counts as none; a stored number takes 32."""
_BLOCKED_SHAFT_S = 2.0
"""Time in seconds for which the shaft is blocked, so that the torque reaches its limit."""
_MAX_RECOVERY_S = 1.5
"""Time in seconds after which the controller must have recovered from the limit."""
_RECOVERY_CHECK_S = 0.3
"""Time in seconds at the end of the recovery in which angle and torque are checked."""


def _require(is_satisfied: bool, message: str) -> None:
    """Raise AssertionError with a message unless a condition is true."""
    if not is_satisfied:
        raise AssertionError(message)


def _make_reset_controller(profile: Profile) -> LoopController:
    """Return a new controller of a profile, reset at the angle 0."""
    controller = make_controller(profile.controlled_rig())
    controller.reset(0.0)
    return controller


def _compute_torques(controller: LoopController, readings: Iterable[Readings]) -> list[float]:
    """Return the torques of a controller for some readings; raise AssertionError if it fails."""
    try:
        return [controller.step(*readings_of_tick) for readings_of_tick in readings]
    except ControllerError as error:
        raise AssertionError(f"a step fails: {error}") from error


def _random_readings(profile: Profile, tick_count: int) -> Iterator[Readings]:
    """Yield random readings within the limits of angle and sensor, constant in some ticks."""
    random_generator = random.Random(1)
    angle_rad, sensor = profile.limits.angle_rad, profile.rig.sensor
    torque_nm = sum(
        abs(factor) * axis_range
        for factor, axis_range in zip(sensor.projection, sensor.range, strict=True)
    )
    readings = 0.0, 0.0, 0.0
    for tick in range(tick_count):
        if tick % (4 * _STALE_READING_TICKS) >= _STALE_READING_TICKS:
            readings = (
                random_generator.uniform(-angle_rad, angle_rad),
                random_generator.uniform(-angle_rad, angle_rad),
                random_generator.uniform(-torque_nm, torque_nm),
            )
        yield readings


def _check_rest_after_reset(profile: Profile) -> None:
    """Check that after a reset at an angle, the torque there is 0, and outputs are reproducible."""
    controller = _make_reset_controller(profile)
    readings = list(_random_readings(profile, 200))
    first_torques_nm = _compute_torques(controller, readings)
    for start_rad in (profile.limits.angle_rad, -0.1 * profile.limits.angle_rad, 0.0):
        controller.reset(start_rad)
        (start_torque_nm,) = _compute_torques(controller, [(start_rad, start_rad, 0.0)])
        _require(
            abs(start_torque_nm) <= _MAX_REST_TORQUE_FRACTION * controller.torque_limit_nm,
            f"after a reset at {start_rad:g} rad it gives {start_torque_nm:g} N·m at rest there",
        )
    controller.reset(0.0)
    _require(
        _compute_torques(controller, readings) == first_torques_nm,
        "a reset does not restore its outputs",
    )


def _check_bounded_torque(profile: Profile) -> None:
    """Check that the torque is finite and within the limit for all readings of the rig."""
    controller = _make_reset_controller(profile)
    torque_limit_nm = profile.control_motor.peak_torque_nm
    _require(controller.torque_limit_nm == torque_limit_nm, "its limit is not motor.peak_torque_nm")
    torques_nm = _compute_torques(controller, _random_readings(profile, _RANDOM_READING_TICKS))
    _require(all(map(isfinite, torques_nm)), "a torque is not finite")
    _require(max(map(abs, torques_nm)) <= torque_limit_nm, "a torque exceeds motor.peak_torque_nm")


def _check_same_output_for_same_input(profile: Profile) -> None:
    """Check that two controllers give the same torques for the same readings."""
    readings = list(_random_readings(profile, 200))
    first_torques_nm, second_torques_nm = (
        _compute_torques(_make_reset_controller(profile), readings) for _ in range(2)
    )
    _require(first_torques_nm == second_torques_nm, "equal readings do not give equal torques")


def _check_constant_memory(profile: Profile) -> None:
    """Check that memory does not grow with the ticks, without garbage collector, as in the loop."""
    controller = _make_reset_controller(profile)
    readings = list(_random_readings(profile, 100))

    def run_ticks(tick_count: int) -> None:
        try:
            for tick in range(tick_count):
                controller.step(*readings[tick % len(readings)])
        except ControllerError as error:
            raise AssertionError(f"a step fails: {error}") from error

    was_enabled, was_tracing = gc.isenabled(), tracemalloc.is_tracing()
    gc.disable()
    tracemalloc.start()
    try:
        run_ticks(_MEMORY_CHECK_TICKS)  # a buffer of fixed length is filled
        before, _ = tracemalloc.get_traced_memory()
        run_ticks(_MEMORY_CHECK_TICKS)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        if not was_tracing:
            tracemalloc.stop()
        if was_enabled:
            gc.enable()
    bytes_per_tick = (after - before) / _MEMORY_CHECK_TICKS
    _require(
        bytes_per_tick <= _MAX_BYTES_PER_TICK,
        f"its memory grows by {bytes_per_tick:.0f} bytes a tick; allocate before the first tick",
    )


def _check_recovery_from_limit(profile: Profile) -> None:
    """Check that the loop recovers after a blocked shaft has driven the torque to its limit.

    The motor, the beam and the delays are those of the profile, without friction.
    """
    loop_model = profile.controlled_rig().loop
    plant = DiscretePlant(
        loop_model, None if loop_model.plant is None else realise(loop_model.plant)
    )
    rate_hz, limits = loop_model.rate_hz, profile.limits
    reference_rad = 0.25 * limits.tracking_error_rad
    while reference_rad <= limits.angle_rad:
        controller = _make_reset_controller(profile)
        _compute_torques(
            controller, [(reference_rad, 0.0, 0.0)] * round(_BLOCKED_SHAFT_S * rate_hz)
        )
        if controller.saturated:
            break
        reference_rad *= 2.0
    else:
        return  # the torque does not reach its limit
    plant_state = np.zeros(plant.b.size)
    largest_angle_rad, saturated_ticks = 0.0, 0
    first_checked_tick = round((_MAX_RECOVERY_S - _RECOVERY_CHECK_S) * rate_hz)
    for tick in range(round(_MAX_RECOVERY_S * rate_hz)):
        angle_rad = float(plant.measured_angle @ plant_state)
        (torque_nm,) = _compute_torques(
            controller, [(0.0, angle_rad, float(plant.measured_torque @ plant_state))]
        )
        plant_state = plant.a @ plant_state + plant.b * torque_nm
        if tick >= first_checked_tick:
            largest_angle_rad = max(largest_angle_rad, abs(angle_rad))
            saturated_ticks += controller.saturated
    _require(
        saturated_ticks == 0 and largest_angle_rad <= limits.tracking_error_rad,
        f"{_MAX_RECOVERY_S - _RECOVERY_CHECK_S:g} s after the torque was at its limit, the shaft "
        f"is still {largest_angle_rad:.3g} rad away, and {saturated_ticks} ticks are at the "
        "limit: stop the states from winding up (anti_windup)",
    )


CONTROLLER_CHECKS: tuple[Callable[[Profile], None], ...] = (
    _check_rest_after_reset,
    _check_bounded_torque,
    _check_same_output_for_same_input,
    _check_constant_memory,
    _check_recovery_from_limit,
)
"""Checks of the behaviour that the control loop relies on.

Each check takes a profile, makes its controller as the loop does, and raises AssertionError with
the problem. Nothing moves."""
