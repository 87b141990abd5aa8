"""Simulated drive and sensor, which measure the simulated plant.

The drive's `latch`, the first call in a tick, advances the rig to this tick. During periods that
the loop missed, the last torque keeps acting, as on a real rig.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from math import sin, tau
from operator import mul
from typing import TypeVar, cast

import numpy as np

from rigd.beam import check_force_damping_order
from rigd.devices import fresh_seed
from rigd.devices.contracts import DeviceError, Devices, LineHealth, Wrench, wired_stop_dropped
from rigd.devices.obstacles import Disturbance, ObstacleError, describe_obstacle, with_obstacles
from rigd.devices.parameters import RigParameters, Simulation, WrenchSensorSettings
from rigd.runtime.computations import ComputationError, ForkedComputation
from rigd.sim._plant import SimulatedPlant
from rigd.sim._session_scatter import scatters_between_sessions, session_parameters

ReadingT = TypeVar("ReadingT")
"""Type of a reading."""

_DRIVE_NAME = "Simulated drive"
"""Name of the simulated drive in messages."""
_MAX_ADDED_DISTURBANCES = 4
"""Largest number of disturbances that can be added while the rig runs."""
_NOISE_BLOCK_READINGS = 128
"""Number of readings whose noise is drawn at a time, which takes 50 µs in one tick.

Thousands would take a whole period."""


class StuckReadings:
    """Replacement for the readings of a failed device, which repeats earlier readings.

    Parameters
    ----------
    calls_per_refresh
        Number of calls after which a new reading is returned; 0: the first reading is repeated for
        ever.
    """

    __slots__ = ("_calls_per_refresh", "_count", "_value")

    def __init__(self, calls_per_refresh: int = 0) -> None:
        self._calls_per_refresh = calls_per_refresh
        self._count = 0
        self._value: object = None

    def __call__(self, reading: ReadingT) -> ReadingT:
        """Return the given reading, or the earlier reading that is repeated in its stead."""
        if self._count == 0 or (
            self._calls_per_refresh and self._count % self._calls_per_refresh == 0
        ):
            self._value = reading
        self._count += 1
        return cast("ReadingT", self._value)


def open_simulated_rig(rig: RigParameters) -> Devices:
    """Create drive and sensor of a rig that is simulated in this process."""
    simulated_rig = SimulatedRig(rig)

    def renew_noise(seed: int | None) -> int:
        noise_seed = fresh_seed() if seed is None else seed
        simulated_rig.begin_session(noise_seed)
        return noise_seed

    return Devices(
        SimulatedDrive(simulated_rig, rig.rate_hz),
        simulated_rig.sensor,
        simulated=True,
        renew_noise=renew_noise,
    )


class SimulatedRig:
    """Simulated plant with encoder and sensor, which advances period by period.

    A streaming sensor is sampled several times per period; the step of the plant is then the period
    of the sensor's records.

    Parameters
    ----------
    rig
        Parameters of the rig with a section ``simulation``, including the delays to simulate.

    Attributes
    ----------
    plant, sensor
        Simulated plant, and simulated sensor that measures it.
    records_per_period : int
        Number of readings of the sensor per period.
    stuck_encoder : StuckReadings or None
        Replacement for the readings of a failed encoder; None if the encoder works.
    """

    def __init__(self, rig: RigParameters) -> None:
        if rig.simulation is None:
            raise DeviceError(
                "The profile has no section [simulation], which a simulated rig needs; copy it "
                "from that of rigd profiles show sim."
            )
        filter_weights: tuple[float, ...] = (1.0,)
        self.records_per_period = 1
        if rig.ati_serial is not None:
            filter_weights = rig.ati_serial.filter_weights(rig.rate_hz)
            self.records_per_period = rig.ati_serial.records_per_tick(rig.rate_hz)
            # The delay in the profile includes the filter's delay; the rest is the sensor's delay.
            remaining_delay_s = rig.sensor.delay_s - rig.ati_serial.filter_delay_s(rig.rate_hz)
            rig = replace(rig, sensor=replace(rig.sensor, delay_s=max(0.0, remaining_delay_s)))
        rig = replace(rig, rate_hz=rig.rate_hz * self.records_per_period)
        assert rig.simulation is not None
        self._parameters = rig
        self._added_disturbances: list[Disturbance] = []
        self._removed_disturbances: list[Disturbance] = []
        self._preparation: ForkedComputation[tuple[int, SimulatedPlant]] | None = None
        self.plant = SimulatedPlant(rig)
        self.sensor = SimulatedSensor(
            self.plant, rig.sensor, rig.simulation, rig.rate_hz, filter_weights
        )
        self._resolution_rad = rig.encoder.resolution_rad
        self.stuck_encoder: StuckReadings | None = None

    def begin_session(self, seed: int) -> None:
        """Restart the noise for a new session, with a new beam if the beam varies by session.

        With a new beam the drive is off afterwards; computing it takes a tenth of a second.

        Parameters
        ----------
        seed
            Seed of the session's noise and beam.
        """
        self.sensor.renew_noise(seed)
        if scatters_between_sessions(self._parameters):
            self.plant.adopt_parameters(SimulatedPlant(session_parameters(self._parameters, seed)))

    def advance(self, period_count: int) -> None:
        """Advance plant and sensor by whole periods, while the last torque command acts."""
        if self._preparation is not None:
            self._poll_preparation()
        if self.records_per_period == 1:
            self.plant.advance(period_count)
            self.sensor.advance_hum(period_count)
            return
        for _ in range(period_count * self.records_per_period):
            self.plant.advance(1)
            self.sensor.advance_hum(1)
            self.sensor.sample_wrench()

    def check_disturbance(self, disturbance: Disturbance) -> None:
        """Raise if an obstacle or impact cannot be simulated in addition to the present ones.

        Raises
        ------
        ObstacleError, RealisationError
            If the disturbance cannot be simulated; the message states the reason.
        """
        with_obstacles(self._parameters, [describe_obstacle(disturbance)])
        check_force_damping_order(self._parameters.damping)
        if len(self._added_disturbances) == _MAX_ADDED_DISTURBANCES:
            raise ObstacleError(
                f"{_MAX_ADDED_DISTURBANCES} obstacles and knocks were added while the simulated "
                "rig ran, and one more would make a tick too long; start it again."
            )

    def add_disturbance(self, disturbance: Disturbance, *, wait: bool) -> None:
        """Add an obstacle or impact to the simulation.

        Parameters
        ----------
        disturbance
            Obstacle or impact, whose times count from the first enabling of the drive.
        wait
            If True, block for about 0.1 s until the disturbance acts. If False, return at once;
            another process prepares it while the rig continues.
        """
        self._added_disturbances.append(disturbance)
        if wait:
            self._use_prepared_plant(self._plant_with_disturbances()[1])
        elif self._preparation is None:
            self._start_preparation()

    def remove_obstacle(self, disturbance: Disturbance) -> None:
        """Remove an obstacle that `add_disturbance` added."""
        self._removed_disturbances.append(disturbance)
        self.plant.remove_obstacle(disturbance)

    def _plant_with_disturbances(self) -> tuple[int, SimulatedPlant]:
        """Return the number of added obstacles and impacts, and a plant that has them all."""
        disturbance_texts = [
            describe_obstacle(disturbance) for disturbance in self._added_disturbances
        ]
        return len(disturbance_texts), SimulatedPlant(
            with_obstacles(self._parameters, disturbance_texts)
        )

    def _start_preparation(self) -> None:
        """Start computing the plant with all obstacles and impacts in another process."""

        def prepare_plant() -> tuple[int, SimulatedPlant]:
            with suppress(OSError):  # it has time
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            return self._plant_with_disturbances()

        self._preparation = ForkedComputation(prepare_plant)

    def _poll_preparation(self) -> None:
        """Use the plant that the other process has computed, if it is ready.

        If disturbances were added in the meantime, the computation of a plant with them is started.
        """
        assert self._preparation is not None
        if not self._preparation.has_ended():
            return
        preparation, self._preparation = self._preparation, None
        try:
            disturbance_count, prepared_plant = preparation.value()
        except ComputationError:
            raise DeviceError("The simulated rig could not prepare for an obstacle.") from None
        self._use_prepared_plant(prepared_plant)
        if disturbance_count < len(self._added_disturbances):
            self._start_preparation()

    def _use_prepared_plant(self, plant: SimulatedPlant) -> None:
        """Use the obstacles and impacts of a prepared plant, except those removed since then."""
        self.plant.use_obstacles_of(plant)
        for disturbance in self._removed_disturbances:
            self.plant.remove_obstacle(disturbance)

    def read_angle(self) -> float:
        """Return the sensed angle of the output shaft in rad, rounded to encoder steps."""
        angle_rad = self.plant.sensed_angle_rad
        encoder_step_rad = self._resolution_rad
        if encoder_step_rad:
            angle_rad = round(angle_rad / encoder_step_rad) * encoder_step_rad
        return angle_rad if self.stuck_encoder is None else self.stuck_encoder(angle_rad)


class SimulatedDrive:
    """Simulated torque-controlled drive with an incremental encoder."""

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
    def stuck_encoder(self) -> StuckReadings | None:
        """Replacement for the readings of a failed encoder, which can be set; None if it works."""
        return self._rig.stuck_encoder

    @stuck_encoder.setter
    def stuck_encoder(self, stuck_readings: StuckReadings | None) -> None:
        self._rig.stuck_encoder = stuck_readings

    def connect(self) -> None:
        """Do nothing: a drive simulated in this process needs no connection."""

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:  # noqa: ARG002
        """Switch the simulated drive on, or raise if the wired stop is dropped."""
        if self._sto_dropped:
            raise wired_stop_dropped(_DRIVE_NAME)
        self._plant.enable()

    def latch(self, due_ns: int) -> None:
        """Advance the simulated rig to the tick that was due at `due_ns`."""
        if self._due_ns is not None:
            self._rig.advance(round((due_ns - self._due_ns) / self._period_ns))
        self._due_ns = self.angle_time_ns = due_ns

    def command(self, torque_nm: float) -> float:
        """Command a torque in N·m; return the torque that will act, which is 0 while disabled."""
        return self._plant.command(torque_nm)

    def health(self) -> LineHealth:
        """Return a line health without values, since there is no communication line."""
        return LineHealth()

    def disable(self) -> None:
        """Zero the simulated drive's torque, and ignore further commands until it is enabled."""
        self._plant.disable()
        self.read_angle = self._rig.read_angle

    @property
    def sto_dropped(self) -> bool:
        """Whether the wired stop (STO) is dropped; setting it True removes the torque at once."""
        return self._sto_dropped

    @sto_dropped.setter
    def sto_dropped(self, dropped: bool) -> None:
        self._sto_dropped = dropped
        if dropped and self._plant.enabled:
            self._plant.disable()
            self.read_angle = self._raise_wired_stop

    def _raise_wired_stop(self) -> float:
        """Raise the error for a dropped wired stop."""
        raise wired_stop_dropped(_DRIVE_NAME)

    def close(self) -> None:
        """Disable the simulated drive."""
        self.disable()


class SimulatedSensor:
    """Simulated six-axis sensor with white noise, hum, offset, limited resolution and range.

    The wrench is the smallest one whose projections are the coupling torque (with hum) and the base
    shear; crosstalk is added to it. If the sensor streams, the wrench read is the output of the
    decimating filter for the last readings. `rate_hz` is the number of readings per second, which
    determines the phase of the hum. `filter_weights` are those of the last readings in the
    decimating filter, oldest first. A single weight means that a reading is taken on request.

    Attributes
    ----------
    stuck : StuckReadings or None
        Replacement for the readings of a failed sensor; None if the sensor works.
    """

    def __init__(
        self,
        plant: SimulatedPlant,
        sensor: WrenchSensorSettings,
        simulation: Simulation,
        rate_hz: float,
        filter_weights: tuple[float, ...] = (1.0,),
    ) -> None:
        self._plant = plant
        self._weights = filter_weights
        self.records: deque[Wrench] = deque(maxlen=len(filter_weights))
        self._sensor = sensor
        self._simulation = simulation
        torque_wrench, shear_wrench = _unit_wrenches(sensor, simulation.crosstalk_percent)
        # Axes on which neither torque nor shear acts show noise only, which is drawn, limited and
        # quantised in blocks. The other axes are computed tick by tick.
        self._loaded_axes = [
            (
                axis,
                torque_wrench[axis],
                shear_wrench[axis],
                sensor.range[axis],
                sensor.resolution[axis],
            )
            for axis in range(6)
            if torque_wrench[axis] != 0.0 or shear_wrench[axis] != 0.0
        ]
        self._noise_rows = chain.from_iterable(self._noise_blocks(simulation.seed))
        self._hum_nm = simulation.hum_nm
        self._hum_cycles_per_reading = simulation.hum_hz / rate_hz
        self._hum_cycles = 0.0
        self.stuck: StuckReadings | None = None
        self._saturated = False  # whether a reading since the last value read was saturated
        self.wrench_stale = False
        self.wrench_time_ns = 0
        self.wrench_saturated = False

    def connect(self) -> None:
        """Do nothing: a sensor simulated in this process needs no connection."""

    def calibration(self) -> dict[str, object]:
        """Return the calibration as a real sensor would report it."""
        return {
            "device": "simulated force-torque sensor",
            "axes": ["fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm"],
            "range": list(self._sensor.range),
            "resolution": list(self._sensor.resolution),
        }

    def request(self, due_ns: int) -> None:
        """Store the time of the tick; the drive's `latch` has already advanced the plant."""
        self.wrench_time_ns = due_ns

    def read_wrench(self) -> Wrench:
        """Return the wrench of this tick in N and N·m."""
        if len(self._weights) == 1:
            return self.measure()
        while len(self.records) < len(self._weights):  # before the first period
            self.sample_wrench()
        self.wrench_saturated, self._saturated = self._saturated, False
        fx, fy, fz, tx, ty, tz = (
            sum(map(mul, self._weights, axis)) for axis in zip(*self.records, strict=True)
        )
        return fx, fy, fz, tx, ty, tz

    def health(self) -> LineHealth:
        """Return a line health with status 0 (no error), since there is no communication line."""
        return LineHealth(status=0)

    def renew_noise(self, seed: int) -> None:
        """Restart the simulated sensor's noise from a seed."""
        self._noise_rows = chain.from_iterable(self._noise_blocks(seed))
        self.records.clear()

    def sample_wrench(self) -> None:
        """Measure the wrench of the simulated sensor once, and add it to the decimating filter."""
        self.records.append(self.measure())
        self._saturated |= self.wrench_saturated

    def advance_hum(self, reading_count: int) -> None:
        """Advance the phase of the hum by a number of reading periods."""
        if self._hum_nm:
            # Whole cycles are dropped to keep the phase exact.
            self._hum_cycles = (
                self._hum_cycles + reading_count * self._hum_cycles_per_reading
            ) % 1.0

    def measure(self) -> Wrench:
        """Return the simulated sensor's wrench, in N and N·m, at the current simulation time."""
        noise_row = next(self._noise_rows)
        torque_nm = self._plant.sensed_torque_nm
        if self._hum_nm:
            torque_nm += self._hum_nm * sin(tau * self._hum_cycles)
        shear_n = self._plant.sensed_shear_n
        is_saturated = False
        for (
            axis,
            reading_per_torque,
            reading_per_shear,
            axis_range,
            axis_resolution,
        ) in self._loaded_axes:
            axis_reading = (
                noise_row[axis] + reading_per_torque * torque_nm + reading_per_shear * shear_n
            )
            if not -axis_range < axis_reading < axis_range:
                axis_reading = axis_range if axis_reading > 0 else -axis_range
                is_saturated = True
            noise_row[axis] = (
                round(axis_reading / axis_resolution) * axis_resolution
                if axis_resolution
                else axis_reading
            )
        self.wrench_saturated = is_saturated
        fx, fy, fz, tx, ty, tz = noise_row
        wrench = fx, fy, fz, tx, ty, tz
        return wrench if self.stuck is None else self.stuck(wrench)

    def close(self) -> None:
        """Do nothing: a sensor simulated in this process has no connection to close."""

    def _noise_blocks(self, seed: int | None) -> Iterator[list[list[float]]]:
        """Yield blocks of unloaded readings, that is noise and offset in N and N·m.

        If the seed is None, the noise differs each time.
        """
        simulation = self._simulation
        random_generator = np.random.default_rng(seed)
        noise_deviations = np.array(
            [simulation.force_noise_n] * 3 + [simulation.torque_noise_nm] * 3
        )
        wrench_offset = np.array(simulation.offset)
        axis_ranges = np.array(self._sensor.range)
        axis_resolutions = np.array(self._sensor.resolution)
        unloaded_axes = [
            axis
            for axis in range(6)
            if axis not in {loaded_axis[0] for loaded_axis in self._loaded_axes}
        ]
        quantised_axes = [axis for axis in unloaded_axes if axis_resolutions[axis] > 0]
        while True:
            noise_block = (
                wrench_offset
                + random_generator.standard_normal((_NOISE_BLOCK_READINGS, 6)) * noise_deviations
            )
            noise_block[:, unloaded_axes] = np.clip(
                noise_block[:, unloaded_axes],
                -axis_ranges[unloaded_axes],
                axis_ranges[unloaded_axes],
            )
            noise_block[:, quantised_axes] = (
                np.round(noise_block[:, quantised_axes] / axis_resolutions[quantised_axes])
                * axis_resolutions[quantised_axes]
            )
            yield noise_block.tolist()


_CROSSTALK_PATTERN = (
    (0.0, -0.62, 0.31, 0.85, -0.44, 0.57),
    (0.73, 0.0, -0.52, -0.28, 0.91, -0.66),
    (-0.48, 0.39, 0.0, 0.64, -0.83, 1.0),
    (0.27, 0.94, -0.71, 0.0, 0.36, -0.59),
    (-0.88, -0.33, 0.46, 0.54, 0.0, 0.79),
    (0.41, -0.97, 0.68, -0.75, 0.29, 0.0),
)
"""Crosstalk of each axis (row) at the full range of another axis (column), relative to its range.

The values are fractions of the profile's crosstalk percentage; the largest is 1."""


def _unit_wrenches(
    sensor: WrenchSensorSettings, crosstalk_percent: float
) -> tuple[list[float], list[float]]:
    """Return the wrenches that a torque of 1 N·m alone and a base shear of 1 N alone cause."""
    projections = np.array([sensor.projection, sensor.shear_projection])
    has_projection = projections.any(axis=1)
    unit_wrenches = np.zeros((6, 2))
    projection_rows = projections[has_projection]
    unit_wrenches[:, has_projection] = projection_rows.T @ np.linalg.inv(
        projection_rows @ projection_rows.T
    )
    if crosstalk_percent:
        full_ranges = np.array(sensor.range)
        crosstalk_matrix = 0.01 * crosstalk_percent * np.array(_CROSSTALK_PATTERN)
        unit_wrenches += crosstalk_matrix * full_ranges[:, None] / full_ranges @ unit_wrenches
    torque_wrench, shear_wrench = unit_wrenches.T.tolist()
    return torque_wrench, shear_wrench
