"""Encoder watch: detects an encoder that has failed while its messages stay fresh.

A frozen encoder shows a shaft at rest, and a controller that trusts it turns the motor without
limit. Three observations distinguish a frozen encoder from a shaft at rest:

* *Momentum.* A moving shaft does not stop within two ticks: torques and friction would have to
  supply an impulse of ``J v``.
* *Net torque.* Motor minus coupling torque, ``n = u - Γ``, turns the shaft as soon as it exceeds
  the breakaway torque. This needs no model of the beam, but friction limits it.
* *Coupling torque.* If a beam pulls at an apparently resting shaft more than by its own vibration,
  the shaft moves, or the beam is touched. This needs no knowledge of the friction, but does not
  exclude a touch. It therefore only starts a *test of the encoder*: the torque of the motor is
  ramped until the encoder moves by two steps, or until the net torque exceeds the breakaway
  torque, which is a fault.

An encoder that repeats readings, every second one for example, shows single ticks without movement
in a steady motion.
"""

from collections import deque
from math import copysign, inf, sqrt

from rigd.safety._beam_prediction import BeamPrediction
from rigd.safety._scale_monitor import SPEED_TICKS, WINDOW_TICKS, ScaleMonitor
from rigd.safety.limits import INTERLOCKS_BY_NAME, Violation

ENCODER_FAILURE_S = 0.004
"""Time in seconds for which the net torque may be large while the encoder shows no movement."""
_AVERAGING_WINDOWS_S = ENCODER_FAILURE_S, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512
"""Durations in seconds over which torques are averaged.

The short ones are within half a period of any excitation; in the long ones noise averages out."""
_MIN_STANDSTILL_S = 0.016
"""Time in seconds without an encoder step after which the coupling torque is compared."""
_MIN_SIGNIFICANT_STDS = 5.0
"""Standard deviations of the averaged noise above which a torque of the beam is significant."""
_MIN_SIGNIFICANT_FRACTION = 0.005
"""Smallest significant torque of the beam, as a fraction of the breakaway torque.

It applies to sensors without noise."""
_MODEL_ERROR_FRACTION = 0.5
"""Error of the predicted coupling torque, as a fraction of the coupling torque's rms.

Beams differ from their models. The error oscillates, so its mean over more than half a period of
the first mode is smaller."""
_RMS_TIME_CONSTANT_S = 0.25
"""Time constant in seconds of the coupling torque's rms."""
_TEST_RAMP_S = 0.02
"""Time in seconds in which the test torque rises by the breakaway torque."""
_MAX_TEST_BREAKAWAY_TORQUES = 2.0
"""Largest test torque, in breakaway torques; the test then restarts in the other direction."""
_PASSED_TEST_ENCODER_STEPS = 1.5
"""Movement of the shaft, in encoder steps, that proves during a test that the encoder works."""
_TEST_PAUSE_S = 0.5
"""Shortest time in seconds between a passed test and the next one."""
_TORQUE_RELATIVE_ERROR = 0.25
"""Largest relative error of the motor's torque that is tolerated."""
_MIN_MOMENTUM_FRACTION = 0.5
"""Fraction of the shaft's momentum that the measured torques must explain when the shaft stops.

Inertias are known to a quarter."""
_STANDSTILL_TICKS_AT_STOP = 2
"""Ticks without an encoder step after which the torques are checked to explain the stop."""
_MIN_STEPS_PER_TICK_AT_STOP = 4.0
"""Speed before a stop from which the stop is checked, in encoder steps per tick."""
_MIN_SCALE_CHECK_ENCODER_STEPS = 3.0
"""Smallest movement within `SPEED_TICKS` that the scale comparison uses, in encoder steps."""
_FAULTY_REPEAT_COUNT = 6
"""Number of repeated readings within `_REPEAT_WINDOW_TICKS` from which they are a fault."""
_REPEAT_WINDOW_TICKS = 32
"""Ticks within which repeated readings are counted."""
_MIN_REPEAT_CHECK_ENCODER_STEPS = 3.5
"""Smallest movement per tick before and after a repeated reading, in encoder steps."""
_SPEED_DIFFERENCE_WEIGHTS = tuple(
    (j, (1 if j in (2, SPEED_TICKS + 2) else 2) / (2 * SPEED_TICKS * WINDOW_TICKS))
    for j in range(2, SPEED_TICKS + 3)
)
"""Index from the end of the torques' sums, and weight of the mean torque over the window there."""


class EncoderMonitor:
    """Compares the encoder's readings with the torques on the shaft to detect a failed encoder.

    It runs in every tick in which the motor may exert torque.

    Parameters
    ----------
    prediction
        Prediction of the beam's coupling torque at the measured angle, or None if the rig has no
        beam.
    rate_hz
        Loop rate in ticks per second.
    resolution_rad
        Resolution of the encoder.
    inertia_kg_m2
        Inertia of the motor.
    breakaway_nm
        Net torque that exceeds any friction of the shaft.
    command_delay_ticks
        Ticks from a torque command to the torque.
    scale_monitor
        Check of the scales of encoder and motor, or None to omit it.

    Attributes
    ----------
    test_nm
        Torque to add to the next command to test the encoder.
    tests
        Number of tests that the encoder has passed.
    """

    __slots__ = (
        "_angles",
        "_breakaway_nm",
        "_coupling_nm2",
        "_decay",
        "_delayed_commands_nm",
        "_half_period_ticks",
        "_inertia_kg_m2",
        "_irregular_ticks",
        "_min_test_ticks",
        "_next_test_tick",
        "_noise_nm",
        "_prediction",
        "_rate_hz",
        "_repeat_ticks",
        "_resolution_rad",
        "_scale_monitor",
        "_standstill_count",
        "_sums",
        "_test_start_rad",
        "_test_step_nm",
        "_tick_count",
        "_windows",
        "test_nm",
        "tests",
    )

    def __init__(
        self,
        prediction: BeamPrediction | None,
        rate_hz: float,
        *,
        resolution_rad: float,
        inertia_kg_m2: float,
        breakaway_nm: float,
        command_delay_ticks: int,
        scale_monitor: ScaleMonitor | None = None,
    ) -> None:
        self._prediction = prediction
        self._scale_monitor = scale_monitor
        self._rate_hz = rate_hz
        self._resolution_rad = resolution_rad
        self._inertia_kg_m2 = inertia_kg_m2
        self._breakaway_nm = breakaway_nm
        window_ticks = [
            max(_STANDSTILL_TICKS_AT_STOP + 1, round(w * rate_hz)) for w in _AVERAGING_WINDOWS_S
        ]
        # Within an encoder step the shaft may reverse, with an acceleration of at most `8 step/T²`.
        turning_torque_nm = inertia_kg_m2 * 8.0 * resolution_rad * rate_hz**2
        self._windows = [
            (tick_count, turning_torque_nm / tick_count**2) for tick_count in window_ticks
        ]
        self._min_test_ticks = max(window_ticks[0], round(_MIN_STANDSTILL_S * rate_hz))
        # The mean of a sine over a time T is at most 2/(ω T) of its amplitude.
        self._half_period_ticks = (
            inf if prediction is None else 2.0 / prediction.first_rad_s * rate_hz
        )
        self._decay = 1.0 / (_RMS_TIME_CONSTANT_S * rate_hz)
        history_ticks = window_ticks[-1] + 2
        # Sums of net torque, motor torque and error of the predicted coupling torque since the
        # start: the difference of two gives the mean over a window.
        self._sums: deque[tuple[float, float, float]] = deque(maxlen=history_ticks)
        self._angles: deque[float] = deque(maxlen=SPEED_TICKS + WINDOW_TICKS + 1)
        self._repeat_ticks: deque[int] = deque(maxlen=_FAULTY_REPEAT_COUNT)
        self._delayed_commands_nm: deque[float] = deque(maxlen=command_delay_ticks)
        self.test_nm = 0.0
        self._test_step_nm = 0.0
        self._test_start_rad = 0.0
        self.tests = 0
        self.reset(0.0, 0.0)

    def reset(self, angle_rad: float, torque_noise_nm: float) -> None:
        """Forget all readings and start again with the shaft at rest.

        Parameters
        ----------
        angle_rad
            Angle of the shaft.
        torque_noise_nm
            Standard deviation of a reading of the coupling torque.
        """
        if self._prediction is not None:
            self._prediction.reset(angle_rad)
        self._noise_nm = torque_noise_nm
        for history in (
            self._sums,
            self._angles,
            self._repeat_ticks,
            self._delayed_commands_nm,
        ):
            history.clear()
        self._sums.extend([(0.0, 0.0, 0.0)] * 2)
        self._angles.append(angle_rad)
        self._delayed_commands_nm.extend([0.0] * (self._delayed_commands_nm.maxlen or 0))
        self._coupling_nm2 = 0.0
        if self._scale_monitor is not None:
            self._scale_monitor.reset()
        self._standstill_count = self._tick_count = self._next_test_tick = 0
        self._irregular_ticks = 0
        self.tests = 0
        self._end_encoder_test()

    def step(
        self, angle_rad: float, coupling_nm: float, sent_torque_nm: float, *, is_fresh: bool = True
    ) -> Violation | None:
        """Check the readings of one tick for signs of a failed encoder.

        Parameters
        ----------
        angle_rad, coupling_nm
            Measured angle and coupling torque.
        sent_torque_nm
            Torque that was commanded in the previous tick.
        is_fresh
            Whether angle and coupling torque were measured in this tick.

        Returns
        -------
        Violation or None
            Evidence of a failed encoder, or None. With a violation `test_nm` must be ignored.
        """
        pending_commands_nm = self._delayed_commands_nm
        pending_commands_nm.append(sent_torque_nm)
        motor_torque_nm = pending_commands_nm[0]
        if not is_fresh:
            self.skip(1, angle_rad)
            return None
        net_sum, motor_sum, error_sum = self._sums[-1]
        if self._prediction is not None:
            error_sum += self._prediction.step(angle_rad, coupling_nm)
        self._sums.append(
            (net_sum + motor_torque_nm - coupling_nm, motor_sum + motor_torque_nm, error_sum)
        )
        self._coupling_nm2 += self._decay * (coupling_nm * coupling_nm - self._coupling_nm2)
        self._tick_count += 1
        angles = self._angles
        standstill_ticks = self._standstill_count
        movement_rad = angle_rad - angles[-1]
        angles.append(angle_rad)
        if self._irregular_ticks:
            self._irregular_ticks -= 1
        elif self._tick_count % WINDOW_TICKS == 0 and self._scale_monitor is not None:
            violation = self._compare_scales(self._scale_monitor)
            if violation is not None:
                return violation
        if movement_rad:
            self._standstill_count = 0
            if standstill_ticks == 1 and not self._irregular_ticks:
                return self._check_repeats(movement_rad)
            if self._test_step_nm:
                min_passed_movement_rad = _PASSED_TEST_ENCODER_STEPS * self._resolution_rad
                if abs(angle_rad - self._test_start_rad) > min_passed_movement_rad:
                    self._end_encoder_test()
                    self.tests += 1
                    self._next_test_tick = self._tick_count + round(_TEST_PAUSE_S * self._rate_hz)
                    return None
        else:
            self._standstill_count = standstill_ticks = standstill_ticks + 1
            if standstill_ticks == _STANDSTILL_TICKS_AT_STOP and not self._irregular_ticks:
                violation = self._check_momentum()
                if violation is not None:
                    return violation
            violation = self._check_standstill(standstill_ticks)
            if violation is not None:
                return violation
        if self._test_step_nm:
            self.test_nm += self._test_step_nm
            if abs(self.test_nm) > _MAX_TEST_BREAKAWAY_TORQUES * self._breakaway_nm:
                # The controller has cancelled the torque, since its reference moves the other way.
                self._test_step_nm = -self._test_step_nm
                self.test_nm = 0.0
        return None

    def skip(self, skipped_ticks: int, angle_rad: float) -> None:
        """Advance the monitor over ticks that were missed or have only old readings.

        The torque was constant in these ticks.

        Parameters
        ----------
        skipped_ticks
            Number of these ticks.
        angle_rad
            Last angle that was read.
        """
        last_sums = self._sums[-1]
        for _ in range(skipped_ticks):
            if self._prediction is not None:
                self._prediction.skip(angle_rad)
            self._sums.append(last_sums)
        self._standstill_count = 0
        self._irregular_ticks = self._angles.maxlen or 0

    def _check_standstill(self, standstill_ticks: int) -> Violation | None:
        """Check the torques on a shaft whose encoder has not moved for `standstill_ticks` ticks.

        The shortest window is checked in every tick, the others in turn.
        """
        standstill_windows = self._windows
        ticks, max_turning_nm = standstill_windows[0]
        if standstill_ticks < ticks:
            return None
        violation = self._check_net_torque(ticks, max_turning_nm)
        ticks, max_turning_nm = standstill_windows[
            1 + self._tick_count % (len(standstill_windows) - 1)
        ]
        if violation is not None or standstill_ticks < ticks:
            return violation
        violation = self._check_net_torque(ticks, max_turning_nm)
        if (
            violation is None
            and standstill_ticks >= self._min_test_ticks
            and not self._test_step_nm
            and self._tick_count >= self._next_test_tick
        ):
            self._compare_coupling_torque(ticks)
        return violation

    def _check_momentum(self) -> Violation | None:
        """Return a violation if the torques cannot have stopped the shaft so suddenly."""
        angles = self._angles
        index_before_stop = -1 - _STANDSTILL_TICKS_AT_STOP
        if len(angles) < SPEED_TICKS - index_before_stop:
            return None
        movement_rad = angles[index_before_stop] - angles[index_before_stop - SPEED_TICKS]
        if (
            abs(movement_rad) < _MIN_STEPS_PER_TICK_AT_STOP * SPEED_TICKS * self._resolution_rad
            or not movement_rad
        ):
            return None
        window_ticks = min(SPEED_TICKS + _STANDSTILL_TICKS_AT_STOP, len(self._sums) - 2)
        net_sum, motor_sum = self._torque_sums(window_ticks)
        momentum_per_tick = (
            _MIN_MOMENTUM_FRACTION * self._inertia_kg_m2 * abs(movement_rad) / SPEED_TICKS
        )
        stopping_torque_nm = momentum_per_tick * self._rate_hz**2 / _STANDSTILL_TICKS_AT_STOP
        braking_torque_nm = max(0.0, -net_sum if movement_rad > 0 else net_sum)
        allowed_torque_nm = (
            self._breakaway_nm
            + (
                (1.0 + _TORQUE_RELATIVE_ERROR) * braking_torque_nm
                + _TORQUE_RELATIVE_ERROR * abs(motor_sum)
            )
            / _STANDSTILL_TICKS_AT_STOP
        )
        if stopping_torque_nm <= allowed_torque_nm:
            return None
        return INTERLOCKS_BY_NAME["stopped encoder"].violated(stopping_torque_nm, allowed_torque_nm)

    def _check_net_torque(self, window_ticks: int, max_turning_nm: float) -> Violation | None:
        """Return a violation if the mean net torque should have turned a shaft that seems at rest.

        `max_turning_nm` is the torque that may turn the shaft within an encoder step in this time.
        """
        net_sum, motor_sum = self._torque_sums(window_ticks)
        net_nm, coupling_nm = net_sum / window_ticks, (motor_sum - net_sum) / window_ticks
        net_torque_limit_nm = (
            self._breakaway_nm + _TORQUE_RELATIVE_ERROR * abs(coupling_nm) + max_turning_nm
        )
        if -net_torque_limit_nm < net_nm < net_torque_limit_nm:
            return None
        return INTERLOCKS_BY_NAME["frozen encoder"].violated(net_nm, net_torque_limit_nm)

    def _compare_coupling_torque(self, window_ticks: int) -> None:
        """Start a test of the encoder if the beam's torque differs from its prediction."""
        sums, noise_nm = self._sums, self._noise_nm
        prediction_error_nm = (sums[-1][2] - sums[-1 - window_ticks][2]) / window_ticks
        vibration_rms_nm = sqrt(max(0.0, self._coupling_nm2 - noise_nm * noise_nm))
        significant_error_nm = max(
            _MIN_SIGNIFICANT_FRACTION * self._breakaway_nm,
            _MIN_SIGNIFICANT_STDS * noise_nm / sqrt(window_ticks),
            _MODEL_ERROR_FRACTION
            * vibration_rms_nm
            * min(1.0, self._half_period_ticks / window_ticks),
        )
        if -significant_error_nm < prediction_error_nm < significant_error_nm:
            return
        # The test torque acts against the beam's torque, which brakes a runaway shaft, or in the
        # direction in which the breakaway torque is reached sooner.
        net_torque_nm = self._torque_sums(window_ticks)[0] / window_ticks
        is_near_breakaway = abs(net_torque_nm) > 0.5 * self._breakaway_nm
        ramp_step_nm = self._breakaway_nm / (_TEST_RAMP_S * self._rate_hz)
        self._test_step_nm = copysign(
            ramp_step_nm, net_torque_nm if is_near_breakaway else -prediction_error_nm
        )
        self._test_start_rad = self._angles[-1]

    def _check_repeats(self, movement_rad: float) -> Violation | None:
        """Return a violation if the encoder repeats readings too often while the shaft moves.

        The last tick showed no movement between two ticks with movement in the same direction.
        """
        angles = self._angles
        if len(angles) < SPEED_TICKS:
            return None
        previous_movement_rad = angles[-3] - angles[-4]
        min_movement_rad = _MIN_REPEAT_CHECK_ENCODER_STEPS * self._resolution_rad
        if (
            movement_rad * previous_movement_rad <= 0.0
            or min(abs(movement_rad), abs(previous_movement_rad)) < min_movement_rad
        ):
            return None
        repeat_ticks = self._repeat_ticks
        repeat_ticks.append(self._tick_count)
        if (
            len(repeat_ticks) < _FAULTY_REPEAT_COUNT
            or self._tick_count - repeat_ticks[0] >= _REPEAT_WINDOW_TICKS
        ):
            return None
        return INTERLOCKS_BY_NAME["repeated angle"].violated(
            len(repeat_ticks), _FAULTY_REPEAT_COUNT - 1
        )

    def _compare_scales(self, scale_monitor: ScaleMonitor) -> Violation | None:
        """Pass acceleration and net torque of the last window to the scale monitor."""
        angles, sums = self._angles, self._sums
        n = WINDOW_TICKS
        if len(angles) < n + SPEED_TICKS + 1 or len(sums) < n + SPEED_TICKS + 3:
            return None
        recent_movement_rad = angles[-1] - angles[-1 - SPEED_TICKS]
        previous_movement_rad = angles[-1 - n] - angles[-1 - n - SPEED_TICKS]
        min_movement_rad = _MIN_SCALE_CHECK_ENCODER_STEPS * self._resolution_rad
        if (
            recent_movement_rad * previous_movement_rad <= 0.0
            or min(abs(recent_movement_rad), abs(previous_movement_rad)) < min_movement_rad
        ):
            return None
        # Weighted like the difference of two mean speeds, the torques match the acceleration.
        net_torque_nm = motor_torque_nm = 0.0
        for j, weight in _SPEED_DIFFERENCE_WEIGHTS:
            end_net_sum, end_motor_sum, _ = sums[-j]
            start_net_sum, start_motor_sum, _ = sums[-j - n]
            net_torque_nm += weight * (end_net_sum - start_net_sum)
            motor_torque_nm += weight * (end_motor_sum - start_motor_sum)
        acceleration_rad_s2 = (
            (recent_movement_rad - previous_movement_rad) * self._rate_hz**2 / (SPEED_TICKS * n)
        )
        speed_rad_s = (
            (recent_movement_rad + previous_movement_rad) * self._rate_hz / (2 * SPEED_TICKS)
        )
        return scale_monitor.add_window(
            acceleration_rad_s2, speed_rad_s, motor_torque_nm - net_torque_nm, net_torque_nm
        )

    def _torque_sums(self, window_ticks: int) -> tuple[float, float]:
        """Return the sums of net torque and motor torque over the last `window_ticks` ticks in N·m.

        The present tick is excluded: its torque turns the shaft from now on.
        """
        net_sum, motor_sum, _ = self._sums[-2]
        earlier_net_sum, earlier_motor_sum, _ = self._sums[-2 - window_ticks]
        return net_sum - earlier_net_sum, motor_sum - earlier_motor_sum

    def _end_encoder_test(self) -> None:
        """Stop the test of the encoder and remove its torque."""
        self.test_nm = self._test_step_nm = 0.0
