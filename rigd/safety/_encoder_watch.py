"""Encoder watch: detects an encoder that has failed while its messages stay fresh.

A frozen encoder shows a shaft at rest, and a controller that trusts it turns the motor without
limit. Three observations distinguish the two:

* *Momentum.* A moving shaft does not stop within two ticks: torques and friction would have to
  supply an impulse of ``J v``.
* *Net torque.* Motor minus coupling torque, ``n = u - Γ``, turns the shaft as soon as it exceeds
  the breakaway torque. This needs no model of the beam, but friction limits it.
* *Coupling torque.* If a beam pulls at an apparently resting shaft more than by its own vibration,
  the shaft moves, or the beam is touched. This needs no knowledge of the friction, but does not
  distinguish the two. It therefore only starts a *test of the encoder*: the torque of the motor is
  ramped until the encoder moves by two steps, or until the net torque exceeds the breakaway
  torque, which is a fault.

An encoder that repeats readings, every second one for example, shows single ticks without movement
in a steady motion.
"""

from collections import deque
from math import copysign, inf, sqrt

from rigd.safety._beam_prediction import BeamPrediction
from rigd.safety._scale_watch import SPEED_TICKS, WINDOW_TICKS, ScaleWatch
from rigd.safety.limits import BY_NAME, Violation

ENCODER_FAILURE_S = 0.004
"""Time after which large net torque on an encoder at rest is a fault."""
_WINDOWS_S = ENCODER_FAILURE_S, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512
"""Durations over which torques are averaged: short ones within half a period of any excitation,
long ones in which noise averages out."""
_STANDSTILL_S = 0.016
"""Time without an encoder step after which the coupling torque is compared."""
_SIGNIFICANT = 5.0
"""Standard deviations of the mean of the noise above which the beam pulls."""
_LEAST_PULL = 0.005
"""The same for a sensor without noise, as a fraction of the breakaway torque."""
_MODEL_ERROR = 0.5
"""Error of the prediction, as a fraction of the coupling torque's rms: beams differ from their
models. The error vibrates: a mean over more than half a period of the first mode has a lower
one."""
_VIBRATION_S = 0.25
"""Time constant of that rms."""
_RAMP_S = 0.02
"""Time in which the torque of a test rises by the breakaway torque."""
_RAMP_LIMIT = 2.0
"""Torque, in breakaway torques, at which a test starts again in the other direction."""
_ANSWER_STEPS = 1.5
"""Encoder steps that answer a test."""
_PAUSE_S = 0.5
"""Time after an answer without a further test."""
_TORQUE_ERROR = 0.25
"""Relative error of the motor's torque that is not a fault."""
_MOMENTUM = 0.5
"""Fraction of the shaft's momentum that needs an explanation: inertias are known to a quarter."""
_STOP_TICKS = 2
_STOP_STEPS = 4.0
"""Speed, in encoder steps a tick over `SPEED_TICKS`, from which a stop is examined."""
_SCALE_STEPS = 3.0
"""Encoder steps within `SPEED_TICKS` from which a speed counts for the scales."""
_MOST_REPEATS = 6
_REPEAT_TICKS = 32
_REPEAT_STEPS = 3.5
"""Least encoder steps before and after a repeated reading."""


class EncoderWatch:
    """Compares the encoder with the torques on the shaft, in every tick with torque.

    Parameters
    ----------
    prediction
        Coupling torque of the beam at the measured angle; None: the rig has no beam.
    rate_hz
        Ticks a second.
    resolution_rad
        Resolution of the encoder.
    inertia_kg_m2
        Inertia of the motor.
    breakaway_nm
        Net torque that exceeds any friction of the shaft.
    delay_ticks
        Ticks from a command to its torque.
    scales
        Comparison of the readings' scales; None: none.

    Attributes
    ----------
    test_nm
        Torque to add to the next command, for a test of the encoder.
    tests
        Number of tests that the encoder has answered.
    """

    __slots__ = (
        "_angles",
        "_breakaway_nm",
        "_count",
        "_coupling_nm2",
        "_decay",
        "_errors",
        "_inertia_kg_m2",
        "_long",
        "_noise_nm",
        "_pause",
        "_pending",
        "_prediction",
        "_rate_hz",
        "_repeats",
        "_resolution_rad",
        "_scales",
        "_standing",
        "_standstill",
        "_test_start_rad",
        "_test_step_nm",
        "_torques",
        "_uneven",
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
        delay_ticks: int,
        scales: ScaleWatch | None = None,
    ) -> None:
        self._prediction = prediction
        self._scales = scales
        self._rate_hz = rate_hz
        self._resolution_rad = resolution_rad
        self._inertia_kg_m2 = inertia_kg_m2
        self._breakaway_nm = breakaway_nm
        lengths = [max(_STOP_TICKS + 1, round(w * rate_hz)) for w in _WINDOWS_S]
        # Within an encoder step the shaft may reverse, with at most `8 step/T²`.
        turn_nm = inertia_kg_m2 * 8.0 * resolution_rad * rate_hz**2
        self._windows = [(ticks, turn_nm / ticks**2) for ticks in lengths]
        self._standstill = max(lengths[0], round(_STANDSTILL_S * rate_hz))
        # The mean of a sine over a time T is at most 2/(ω T) of its amplitude.
        self._long = inf if prediction is None else 2.0 / prediction.first_rad_s * rate_hz
        self._decay = 1.0 / (_VIBRATION_S * rate_hz)
        longest = lengths[-1] + 2
        # Cumulative sums, of which two give the mean over a window.
        self._torques: deque[tuple[float, float]] = deque(maxlen=longest)
        self._errors: deque[float] = deque(maxlen=longest)
        self._angles: deque[float] = deque(maxlen=SPEED_TICKS + WINDOW_TICKS + 1)
        self._repeats: deque[int] = deque(maxlen=_MOST_REPEATS)
        self._pending: deque[float] = deque(maxlen=delay_ticks)
        self.test_nm = 0.0
        self._test_step_nm = 0.0
        self._test_start_rad = 0.0
        self.tests = 0
        self.reset(0.0, 0.0)

    def reset(self, angle_rad: float, noise_nm: float) -> None:
        """Start from rest.

        Parameters
        ----------
        angle_rad
            Angle of the shaft.
        noise_nm
            Standard deviation of a reading of the coupling torque.
        """
        if self._prediction is not None:
            self._prediction.reset(angle_rad)
        self._noise_nm = noise_nm
        for history in (self._torques, self._errors, self._angles, self._repeats, self._pending):
            history.clear()
        self._torques.extend([(0.0, 0.0)] * 2)
        self._errors.append(0.0)
        self._angles.append(angle_rad)
        self._pending.extend([0.0] * (self._pending.maxlen or 0))
        self._coupling_nm2 = 0.0
        if self._scales is not None:
            self._scales.reset()
        self._standing = self._count = self._pause = 0
        self._uneven = 0
        self.tests = 0
        self._end_test()

    def step(
        self, angle_rad: float, coupling_nm: float, sent_nm: float, *, fresh: bool = True
    ) -> Violation | None:
        """Compare the readings of a tick.

        Parameters
        ----------
        angle_rad, coupling_nm
            Angle and coupling torque.
        sent_nm
            Torque that was commanded in the tick before.
        fresh
            Whether both readings are of this tick.

        Returns
        -------
        Violation or None
            Evidence of a failed encoder; `test_nm` is then to be ignored.
        """
        prediction = self._prediction
        pending = self._pending
        pending.append(sent_nm)
        motor_nm = pending[0]
        if not fresh:
            self.skip(1, angle_rad)
            return None
        error_nm = 0.0 if prediction is None else prediction.step(angle_rad, coupling_nm)
        net, motor = self._torques[-1]
        self._torques.append((net + motor_nm - coupling_nm, motor + motor_nm))
        self._errors.append(self._errors[-1] + error_nm)
        self._coupling_nm2 += self._decay * (coupling_nm * coupling_nm - self._coupling_nm2)
        self._count += 1
        angles = self._angles
        standing = self._standing
        moved_rad = angle_rad - angles[-1]
        angles.append(angle_rad)
        if self._uneven:
            self._uneven -= 1
        elif self._count % WINDOW_TICKS == 0 and self._scales is not None:
            violation = self._compare_scales(self._scales)
            if violation is not None:
                return violation
        if moved_rad:
            self._standing = 0
            if standing == 1 and not self._uneven:
                return self._check_repeats(moved_rad)
            if self._test_step_nm:
                answer_rad = _ANSWER_STEPS * self._resolution_rad
                if abs(angle_rad - self._test_start_rad) > answer_rad:
                    self._end_test()
                    self.tests += 1
                    self._pause = self._count + round(_PAUSE_S * self._rate_hz)
                    return None
        else:
            self._standing = standing = standing + 1
            if standing == _STOP_TICKS and not self._uneven:
                violation = self._check_momentum()
                if violation is not None:
                    return violation
            violation = self._check_standstill(standing)
            if violation is not None:
                return violation
        if self._test_step_nm:
            self.test_nm += self._test_step_nm
            if abs(self.test_nm) > _RAMP_LIMIT * self._breakaway_nm:
                # The controller has cancelled the torque, since its reference moves the other way.
                self._test_step_nm = -self._test_step_nm
                self.test_nm = 0.0
        return None

    def skip(self, ticks: int, angle_rad: float) -> None:
        """Step over ticks that were missed or have old readings; the torque was held.

        Parameters
        ----------
        ticks
            Number of these ticks.
        angle_rad
            Last angle that was read.
        """
        net, motor = self._torques[-1]
        error = self._errors[-1]
        for _ in range(ticks):
            if self._prediction is not None:
                self._prediction.skip(angle_rad)
            self._torques.append((net, motor))
            self._errors.append(error)
        self._standing = 0
        self._uneven = self._angles.maxlen or 0

    def _check_standstill(self, standing: int) -> Violation | None:
        """Check a shaft that seems to be at rest for some ticks.

        The shortest window is checked in every tick, the others in turn.
        """
        windows = self._windows
        ticks, turn_nm = windows[0]
        if standing < ticks:
            return None
        violation = self._check_net_torque(ticks, turn_nm)
        ticks, turn_nm = windows[1 + self._count % (len(windows) - 1)]
        if violation is not None or standing < ticks:
            return violation
        violation = self._check_net_torque(ticks, turn_nm)
        if (
            violation is None
            and standing >= self._standstill
            and not self._test_step_nm
            and self._count >= self._pause
        ):
            self._compare_coupling_torque(ticks)
        return violation

    def _check_momentum(self) -> Violation | None:
        """Check a stop within `_STOP_TICKS` against the impulse that it requires."""
        angles = self._angles
        before = -1 - _STOP_TICKS
        if len(angles) < SPEED_TICKS - before:
            return None
        moved_rad = angles[before] - angles[before - SPEED_TICKS]
        if abs(moved_rad) < _STOP_STEPS * SPEED_TICKS * self._resolution_rad or not moved_rad:
            return None
        ticks = min(SPEED_TICKS + _STOP_TICKS, len(self._torques) - 2)
        net, motor = self._over(ticks)
        per_tick_nm = _MOMENTUM * self._inertia_kg_m2 * abs(moved_rad) / SPEED_TICKS
        needed_nm = per_tick_nm * self._rate_hz**2 / _STOP_TICKS
        braking_nm = max(0.0, -net if moved_rad > 0 else net)
        allowed_nm = (
            self._breakaway_nm
            + ((1.0 + _TORQUE_ERROR) * braking_nm + _TORQUE_ERROR * abs(motor)) / _STOP_TICKS
        )
        if needed_nm <= allowed_nm:
            return None
        return BY_NAME["stopped encoder"].violated(needed_nm, allowed_nm)

    def _check_net_torque(self, ticks: int, turn_nm: float) -> Violation | None:
        """Check the mean net torque on a shaft that seems to be at rest."""
        net, motor = self._over(ticks)
        net_nm, coupling_nm = net / ticks, (motor - net) / ticks
        limit_nm = self._breakaway_nm + _TORQUE_ERROR * abs(coupling_nm) + turn_nm
        if -limit_nm < net_nm < limit_nm:
            return None
        return BY_NAME["frozen encoder"].violated(net_nm, limit_nm)

    def _compare_coupling_torque(self, ticks: int) -> None:
        """Start a test of the encoder if the beam pulls at a shaft that seems to be at rest."""
        errors, noise_nm = self._errors, self._noise_nm
        error_nm = (errors[-1] - errors[-1 - ticks]) / ticks
        vibration_nm = sqrt(max(0.0, self._coupling_nm2 - noise_nm * noise_nm))
        level_nm = max(
            _LEAST_PULL * self._breakaway_nm,
            _SIGNIFICANT * noise_nm / sqrt(ticks),
            _MODEL_ERROR * vibration_nm * min(1.0, self._long / ticks),
        )
        if -level_nm < error_nm < level_nm:
            return
        # Against the pull, which brakes a runaway shaft; or in the shorter direction.
        net_nm = self._over(ticks)[0] / ticks
        shorter = abs(net_nm) > 0.5 * self._breakaway_nm
        ramp_nm = self._breakaway_nm / (_RAMP_S * self._rate_hz)
        self._test_step_nm = copysign(ramp_nm, net_nm if shorter else -error_nm)
        self._test_start_rad = self._angles[-1]

    def _check_repeats(self, moved_rad: float) -> Violation | None:
        """Check a tick without movement between two in which the shaft moved the same way."""
        angles = self._angles
        if len(angles) < SPEED_TICKS:
            return None
        before_rad = angles[-3] - angles[-4]
        least_rad = _REPEAT_STEPS * self._resolution_rad
        if moved_rad * before_rad <= 0.0 or min(abs(moved_rad), abs(before_rad)) < least_rad:
            return None
        repeats = self._repeats
        repeats.append(self._count)
        if len(repeats) < _MOST_REPEATS or self._count - repeats[0] >= _REPEAT_TICKS:
            return None
        return BY_NAME["repeated angle"].violated(len(repeats), _MOST_REPEATS - 1)

    def _compare_scales(self, scales: ScaleWatch) -> Violation | None:
        """Compare the acceleration over the last `WINDOW_TICKS` with the net torque."""
        angles, torques = self._angles, self._torques
        n = WINDOW_TICKS
        if len(angles) < n + SPEED_TICKS + 1 or len(torques) < n + SPEED_TICKS + 3:
            return None
        now_rad = angles[-1] - angles[-1 - SPEED_TICKS]
        before_rad = angles[-1 - n] - angles[-1 - n - SPEED_TICKS]
        least_rad = _SCALE_STEPS * self._resolution_rad
        if now_rad * before_rad <= 0.0 or min(abs(now_rad), abs(before_rad)) < least_rad:
            return None
        # Weighting like the difference of two mean speeds gives the torque of that acceleration.
        net = motor = 0.0
        for j in range(1, SPEED_TICKS + 1):
            for last in (torques[-1 - j], torques[-2 - j]):
                net, motor = net + last[0], motor + last[1]
            for first in (torques[-1 - j - n], torques[-2 - j - n]):
                net, motor = net - first[0], motor - first[1]
        net, motor = net / (2 * SPEED_TICKS * n), motor / (2 * SPEED_TICKS * n)
        acceleration_rad_s2 = (now_rad - before_rad) * self._rate_hz**2 / (SPEED_TICKS * n)
        speed_rad_s = (now_rad + before_rad) * self._rate_hz / (2 * SPEED_TICKS)
        return scales.add(acceleration_rad_s2, speed_rad_s, motor - net, net)

    def _over(self, ticks: int) -> tuple[float, float]:
        """Return the sums of net torque and motor torque over the ticks that the angle shows.

        The torque of this tick turns the shaft from now on.
        """
        net, motor = self._torques[-2]
        net_before, motor_before = self._torques[-2 - ticks]
        return net - net_before, motor - motor_before

    def _end_test(self) -> None:
        self.test_nm = self._test_step_nm = 0.0
