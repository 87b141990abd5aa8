"""Drive and sensor of the simulated rig: the plant as the devices measure it.

The drive's latch, which comes first in a tick, moves the rig on to it; periods that the loop
missed pass with the last torque held, as they do on a real rig.
"""

import os
import pickle
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from math import sin, tau
from operator import mul
from typing import IO, TypeVar, cast

import numpy as np

from rigd.beam import check_order
from rigd.devices import fresh_seed
from rigd.devices.contracts import DeviceError, Devices, LineHealth, Wrench, wired_stop_dropped
from rigd.devices.obstacles import Disturbance, ObstacleError, describe_obstacle, with_obstacles
from rigd.devices.parameters import RigParameters, Simulation, WrenchSensorSettings
from rigd.sim._plant import SimulatedPlant
from rigd.sim._session_scatter import scatters_between_sessions, session_parameters

T = TypeVar("T")

_NAME = "Simulated drive"
_MOST_MET = 4
_NOISE_BLOCK = 128
"""Readings drawn at a time, 50 µs of work in one tick; thousands would take a whole period."""


class Stuck:
    """Readings that repeat the one before although their messages are new.

    Parameters
    ----------
    every
        Number of readings of which the first is new; 0: none is.
    """

    __slots__ = ("_count", "_every", "_value")

    def __init__(self, every: int = 0) -> None:
        self._every = every
        self._count = 0
        self._value: object = None

    def __call__(self, value: T) -> T:
        """Return the reading that replaces a given one."""
        if self._count == 0 or (self._every and self._count % self._every == 0):
            self._value = value
        self._count += 1
        return cast("T", self._value)


def open_simulated_rig(rig: RigParameters) -> Devices:
    """Make the devices of a simulated rig; a seed gives the same noise again."""
    simulated = SimulatedRig(rig)

    def renew_noise(seed: int | None) -> int:
        chosen = fresh_seed() if seed is None else seed
        simulated.begin_session(chosen)
        return chosen

    return Devices(
        SimulatedDrive(simulated, rig.rate_hz),
        simulated.sensor,
        simulated=True,
        renew_noise=renew_noise,
    )


class SimulatedRig:
    """Plant, encoder and sensor, moved on period by period.

    A sensor that streams is sampled several times a period; then the plant goes in steps of its
    records.

    Parameters
    ----------
    rig
        With a section ``simulation``; its delays are those of the plant and of the readings.

    Attributes
    ----------
    plant, sensor
        Plant, and the sensor that measures it.
    records_per_period : int
        Readings of the sensor in one period.
    stuck_encoder : Stuck or None
        Readings of a failed encoder; None: it works.
    """

    def __init__(self, rig: RigParameters) -> None:
        if rig.simulation is None:
            raise DeviceError(
                "The profile has no section [simulation], which a simulated rig needs; copy it "
                "from that of rigd profiles show sim."
            )
        weights: tuple[float, ...] = (1.0,)
        self.records_per_period = 1
        if rig.ati_serial is not None:
            weights = rig.ati_serial.weights(rig.rate_hz)
            self.records_per_period = rig.ati_serial.records_per_tick(rig.rate_hz)
            # The filter's own delay is part of what the profile states; the rest is the sensor's.
            rest_s = rig.sensor.delay_s - rig.ati_serial.filter_delay_s(rig.rate_hz)
            rig = replace(rig, sensor=replace(rig.sensor, delay_s=max(0.0, rest_s)))
        rig = replace(rig, rate_hz=rig.rate_hz * self.records_per_period)
        assert rig.simulation is not None
        self._parameters = rig
        self._met: list[Disturbance] = []
        self._ended: list[Disturbance] = []
        self._preparing: tuple[int, IO[bytes]] | None = None
        self.plant = SimulatedPlant(rig)
        self.sensor = SimulatedSensor(self.plant, rig.sensor, rig.simulation, rig.rate_hz, weights)
        self._resolution_rad = rig.encoder.resolution_rad
        self.stuck_encoder: Stuck | None = None

    def begin_session(self, seed: int) -> None:
        """Restart the noise, and use the beam of this session if beams differ between sessions.

        The drive is off. A beam takes a tenth of a second to make.

        Parameters
        ----------
        seed
            Seed of the session.
        """
        self.sensor.renew_noise(seed)
        if scatters_between_sessions(self._parameters):
            self.plant.become(SimulatedPlant(session_parameters(self._parameters, seed)))

    def advance(self, n_periods: int) -> None:
        """Move on by whole periods, the torque held."""
        if self._preparing is not None:
            self._poll_preparation()
        if self.records_per_period == 1:
            self.plant.advance(n_periods)
            self.sensor.elapse(n_periods)
            return
        for _ in range(n_periods * self.records_per_period):
            self.plant.advance(1)
            self.sensor.elapse(1)
            self.sensor.sample()

    def check(self, disturbance: Disturbance) -> None:
        """Raise if a disturbance cannot be simulated in addition to the present ones.

        Raises
        ------
        ObstacleError, RealisationError
            Saying why.
        """
        with_obstacles(self._parameters, [describe_obstacle(disturbance)])
        check_order(self._parameters.damping)
        if len(self._met) == _MOST_MET:
            raise ObstacleError(
                f"{_MOST_MET} obstacles and knocks were added while the simulated rig ran, and one "
                "more would take too long a tick; start it again."
            )

    def meet(self, disturbance: Disturbance, *, wait: bool) -> None:
        """Add an obstacle or a knock.

        Parameters
        ----------
        disturbance
            Its times count from the first enabling of the drive.
        wait
            Whether it takes effect before the next period; the caller then waits a tenth of a
            second. Otherwise another process prepares it, and the rig continues meanwhile.
        """
        self._met.append(disturbance)
        if wait:
            self._take_over(self._prepared()[1])
        elif self._preparing is None:
            self._prepare()

    def end(self, disturbance: Disturbance) -> None:
        """Remove an obstacle that `meet` added."""
        self._ended.append(disturbance)
        self.plant.end_obstacle(disturbance)

    def _prepared(self) -> tuple[int, SimulatedPlant]:
        """Return a plant with all disturbances added so far, and their number."""
        texts = [describe_obstacle(disturbance) for disturbance in self._met]
        return len(texts), SimulatedPlant(with_obstacles(self._parameters, texts))

    def _prepare(self) -> None:
        """Start the preparation in a process: a thread would hold the interpreter's lock."""
        import tempfile  # late: no session needs it

        file = tempfile.TemporaryFile()  # noqa: SIM115 - closed when it was read
        process = os.fork()
        if process == 0:
            failed = True
            with suppress(BaseException):
                with suppress(OSError):  # it has time
                    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
                pickle.dump(self._prepared(), file, protocol=5)
                file.flush()
                failed = False
            os._exit(failed)
        self._preparing = process, file

    def _poll_preparation(self) -> None:
        """Use the prepared plant if it is ready; then prepare disturbances added meanwhile."""
        assert self._preparing is not None
        process, file = self._preparing
        ended, status = os.waitpid(process, os.WNOHANG)
        if not ended:
            return
        self._preparing = None
        with file:
            if status != 0:
                raise DeviceError("The simulated rig could not make ready for an obstacle.")
            file.seek(0)
            count, plant = pickle.load(file)
        self._take_over(plant)
        if count < len(self._met):
            self._prepare()

    def _take_over(self, plant: SimulatedPlant) -> None:
        self.plant.meet(plant)
        for disturbance in self._ended:
            self.plant.end_obstacle(disturbance)

    def read_angle(self) -> float:
        """Return the angle in whole encoder steps, in rad."""
        angle_rad = self.plant.sensed_angle_rad
        step_rad = self._resolution_rad
        if step_rad:
            angle_rad = round(angle_rad / step_rad) * step_rad
        return angle_rad if self.stuck_encoder is None else self.stuck_encoder(angle_rad)


class SimulatedDrive:
    """Torque-controlled drive with an incremental encoder."""

    def __init__(self, rig: SimulatedRig, rate_hz: float) -> None:
        self._rig = rig
        self._plant = rig.plant
        self._period_ns = 1e9 / rate_hz
        self._due_ns: int | None = None
        self._sto_dropped = False
        self.read_angle = rig.read_angle
        self.angle_stale = False
        self.angle_time_ns = 0
        self.off_doubt = ""

    @property
    def stuck_encoder(self) -> Stuck | None:
        """Readings of a failed encoder; None: it works. Can be set."""
        return self._rig.stuck_encoder

    @stuck_encoder.setter
    def stuck_encoder(self, stuck: Stuck | None) -> None:
        self._rig.stuck_encoder = stuck

    def connect(self) -> None:
        """Nothing to connect to."""

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:  # noqa: ARG002
        """Enable the drive."""
        if self._sto_dropped:
            raise wired_stop_dropped(_NAME)
        self._plant.enable()

    def latch(self, due_ns: int) -> None:
        """Move the rig on to the tick at ``due_ns``."""
        if self._due_ns is not None:
            self._rig.advance(round((due_ns - self._due_ns) / self._period_ns))
        self._due_ns = self.angle_time_ns = due_ns

    def command(self, torque_nm: float) -> float:
        """Set the torque in N·m, and return what is exerted: none while it is not enabled."""
        return self._plant.command(torque_nm)

    def health(self) -> LineHealth:
        """Report that there is no line."""
        return LineHealth()

    def disable(self) -> None:
        """Zero the torque, and ignore further commands."""
        self._plant.disable()
        self.read_angle = self._rig.read_angle

    @property
    def sto_dropped(self) -> bool:
        """Whether the wired stop is pressed; it may be set, and takes the torque away at once."""
        return self._sto_dropped

    @sto_dropped.setter
    def sto_dropped(self, dropped: bool) -> None:
        self._sto_dropped = dropped
        if dropped and self._plant.enabled:
            self._plant.disable()
            self.read_angle = self._refuse

    def _refuse(self) -> float:
        raise wired_stop_dropped(_NAME)

    def close(self) -> None:
        """Disable."""
        self.disable()


class SimulatedSensor:
    """Six-axis sensor with white noise, hum, offset, limited resolution and range.

    Coupling torque, with the hum on it, and base shear appear as the smallest wrench whose
    projections they are, with the crosstalk of the simulation. Where the readings are streamed,
    what is read is the last of them through the decimating filter.

    Parameters
    ----------
    plant, sensor, simulation
        Plant, sensor and its noise.
    rate_hz
        Rate of the readings, by which the hum goes on.
    weights
        Weights of the last readings in the value, oldest first; one weight: a reading is taken on
        request.

    Attributes
    ----------
    stuck : Stuck or None
        Readings of a failed sensor; None: it works.
    """

    def __init__(
        self,
        plant: SimulatedPlant,
        sensor: WrenchSensorSettings,
        simulation: Simulation,
        rate_hz: float,
        weights: tuple[float, ...] = (1.0,),
    ) -> None:
        self._plant = plant
        self._weights = weights
        self.records: deque[Wrench] = deque(maxlen=len(weights))
        self._sensor = sensor
        self._simulation = simulation
        per_torque, per_shear = _wrenches(sensor, simulation.crosstalk_percent)
        # Axes that neither torque nor shear reaches show noise only, which is drawn, limited and
        # quantised by the block; the others are finished tick by tick.
        self._active = [
            (axis, per_torque[axis], per_shear[axis], sensor.range[axis], sensor.resolution[axis])
            for axis in range(6)
            if per_torque[axis] != 0.0 or per_shear[axis] != 0.0
        ]
        self._rows = chain.from_iterable(self._noise(simulation.seed))
        self._hum_nm = simulation.hum_nm
        self._hum_turn = simulation.hum_hz / rate_hz
        self._hum_turns = 0.0
        self.stuck: Stuck | None = None
        self._saturated = False  # since the last that was read
        self.wrench_stale = False
        self.wrench_time_ns = 0
        self.wrench_saturated = False

    def connect(self) -> None:
        """Nothing to connect to."""

    def calibration(self) -> dict[str, object]:
        """Return the calibration as a real sensor would report it."""
        return {
            "device": "simulated force-torque sensor",
            "axes": ["fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm"],
            "range": list(self._sensor.range),
            "resolution": list(self._sensor.resolution),
        }

    def request(self, due_ns: int) -> None:
        """Note the time; the drive's latch has moved the plant on."""
        self.wrench_time_ns = due_ns

    def read_wrench(self) -> Wrench:
        """Return the wrench of this tick."""
        if len(self._weights) == 1:
            return self.measure()
        while len(self.records) < len(self._weights):  # before the first period
            self.sample()
        self.wrench_saturated, self._saturated = self._saturated, False
        fx, fy, fz, tx, ty, tz = (
            sum(map(mul, self._weights, axis)) for axis in zip(*self.records, strict=True)
        )
        return fx, fy, fz, tx, ty, tz

    def health(self) -> LineHealth:
        """Report that there is no line, and no fault."""
        return LineHealth(status=0)

    def renew_noise(self, seed: int) -> None:
        """Restart the noise from a seed."""
        self._rows = chain.from_iterable(self._noise(seed))
        self.records.clear()

    def sample(self) -> None:
        """Take a reading into the filter."""
        self.records.append(self.measure())
        self._saturated |= self.wrench_saturated

    def elapse(self, readings: int) -> None:
        """Advance the time by some readings."""
        if self._hum_nm:
            # Whole turns are left out, for the phase to stay exact.
            self._hum_turns = (self._hum_turns + readings * self._hum_turn) % 1.0

    def measure(self) -> Wrench:
        """Return a reading taken now."""
        row = next(self._rows)
        torque_nm = self._plant.sensed_torque_nm
        if self._hum_nm:
            torque_nm += self._hum_nm * sin(tau * self._hum_turns)
        shear_n = self._plant.sensed_shear_n
        saturated = False
        for axis, per_torque, per_shear, limit, step in self._active:
            value = row[axis] + per_torque * torque_nm + per_shear * shear_n
            if not -limit < value < limit:
                value = limit if value > 0 else -limit
                saturated = True
            row[axis] = round(value / step) * step if step else value
        self.wrench_saturated = saturated
        fx, fy, fz, tx, ty, tz = row
        wrench = fx, fy, fz, tx, ty, tz
        return wrench if self.stuck is None else self.stuck(wrench)

    def close(self) -> None:
        """Nothing to release."""

    def _noise(self, seed: int | None) -> Iterator[list[list[float]]]:
        """Yield blocks of rows, each an unloaded wrench; without a seed no others are alike."""
        simulation = self._simulation
        generator = np.random.default_rng(seed)
        scale = np.array([simulation.force_noise_n] * 3 + [simulation.torque_noise_nm] * 3)
        offset = np.array(simulation.offset)
        limit = np.array(self._sensor.range)
        step = np.array(self._sensor.resolution)
        passive = [axis for axis in range(6) if axis not in {active[0] for active in self._active}]
        quantised = [axis for axis in passive if step[axis] > 0]
        while True:
            block = offset + generator.standard_normal((_NOISE_BLOCK, 6)) * scale
            block[:, passive] = np.clip(block[:, passive], -limit[passive], limit[passive])
            block[:, quantised] = np.round(block[:, quantised] / step[quantised]) * step[quantised]
            yield block.tolist()


_CROSSTALK = (
    (0.0, -0.62, 0.31, 0.85, -0.44, 0.57),
    (0.73, 0.0, -0.52, -0.28, 0.91, -0.66),
    (-0.48, 0.39, 0.0, 0.64, -0.83, 1.0),
    (0.27, 0.94, -0.71, 0.0, 0.36, -0.59),
    (-0.88, -0.33, 0.46, 0.54, 0.0, 0.79),
    (0.41, -0.97, 0.68, -0.75, 0.29, 0.0),
)
"""Crosstalk of each axis (row) at the full range of another, over its range and the largest
entry."""


def _wrenches(
    sensor: WrenchSensorSettings, crosstalk_percent: float
) -> tuple[list[float], list[float]]:
    """Wrenches of a coupling torque of 1 N·m without shear, and of a base shear of 1 N alone."""
    projections = np.array([sensor.projection, sensor.shear_projection])
    known = projections.any(axis=1)
    wrenches = np.zeros((6, 2))
    rows = projections[known]
    wrenches[:, known] = rows.T @ np.linalg.inv(rows @ rows.T)
    if crosstalk_percent:
        full = np.array(sensor.range)
        crosstalk = 0.01 * crosstalk_percent * np.array(_CROSSTALK)
        wrenches += crosstalk * full[:, None] / full @ wrenches
    per_torque, per_shear = wrenches.T.tolist()
    return per_torque, per_shear
