"""Drive and sensor of the simulated rig: what the plant does, as the devices would show it.

The drive's latch, which comes first in a tick, moves the plant on to it; periods that the loop
missed pass with the last torque held, as they do on a real rig.
"""

from collections.abc import Iterator
from itertools import chain

import numpy as np

from rigd.devices.contracts import DeviceError, Devices, Wrench
from rigd.devices.parameters import RigParameters, Simulation, WrenchSensor
from rigd.sim.plant import SimulatedPlant

_NOISE_BLOCK = 4096


def open_simulated_rig(rig: RigParameters) -> Devices:
    """Make the devices of a simulated rig; a seed gives the same noise again."""
    if rig.simulation is None:
        raise DeviceError(
            'The profile has no section [simulation], which drive = "sim" needs; copy it from '
            "hw_profiles/sim.toml."
        )
    plant = SimulatedPlant(rig)
    return Devices(
        drive=SimulatedDrive(plant, rig.encoder.resolution_rad, rig.rate_hz),
        sensor=SimulatedSensor(plant, rig.sensor, rig.simulation),
        simulated=True,
    )


class SimulatedDrive:
    """Torque-controlled drive with an incremental encoder."""

    def __init__(self, plant: SimulatedPlant, resolution_rad: float, rate_hz: float) -> None:
        self._plant = plant
        self._period_ns = 1e9 / rate_hz
        self._due_ns: int | None = None
        self._resolution_rad = resolution_rad
        self.angle_stale = False

    def connect(self) -> None:
        """Nothing to connect to."""

    def enable(self) -> None:
        """Let commands through."""
        self._plant.enable()

    def latch(self, due_ns: int) -> None:
        """Move the plant on to the tick at ``due_ns``."""
        if self._due_ns is not None:
            self._plant.advance(round((due_ns - self._due_ns) / self._period_ns))
        self._due_ns = due_ns

    def read_angle(self) -> float:
        """Return the angle in whole encoder steps, in rad."""
        angle_rad = self._plant.sensed_angle_rad
        step_rad = self._resolution_rad
        return round(angle_rad / step_rad) * step_rad if step_rad else angle_rad

    def command(self, torque_nm: float) -> None:
        """Set the torque in N·m; a drive that is not enabled exerts none."""
        self._plant.command(torque_nm)

    def disable(self) -> None:
        """Zero the torque, and let no command through."""
        self._plant.disable()

    def close(self) -> None:
        """Disable."""
        self.disable()


class SimulatedSensor:
    """Six-axis sensor with white noise, offset, limited resolution and range.

    The coupling torque appears as the smallest wrench whose projection it is.
    """

    def __init__(self, plant: SimulatedPlant, sensor: WrenchSensor, simulation: Simulation) -> None:
        self._plant = plant
        self._sensor = sensor
        self._simulation = simulation
        projection = np.array(sensor.projection)
        per_torque = (projection / (projection @ projection)).tolist()
        # Axes that the coupling torque does not reach show noise only, which is drawn, limited
        # and quantised by the block; the others are finished tick by tick.
        self._active = [
            (axis, per_torque[axis], sensor.range[axis], sensor.resolution[axis])
            for axis in range(6)
            if per_torque[axis] != 0.0
        ]
        self._rows = chain.from_iterable(self._noise())
        self.wrench_stale = False
        self.wrench_saturated = False

    def connect(self) -> None:
        """Nothing to connect to."""

    def calibration(self) -> dict[str, object]:
        """Return what a real sensor would say of itself."""
        return {
            "device": "simulated force-torque sensor",
            "axes": ["fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm"],
            "range": list(self._sensor.range),
            "resolution": list(self._sensor.resolution),
        }

    def request(self, due_ns: int) -> None:
        """Nothing to do: the drive's latch has moved the plant on."""

    def read_wrench(self) -> Wrench:
        """Return the wrench of this tick."""
        row = next(self._rows)
        torque_nm = self._plant.sensed_torque_nm
        saturated = False
        for axis, per_torque, limit, step in self._active:
            value = row[axis] + per_torque * torque_nm
            if not -limit < value < limit:
                value = limit if value > 0 else -limit
                saturated = True
            row[axis] = round(value / step) * step if step else value
        self.wrench_saturated = saturated
        fx, fy, fz, tx, ty, tz = row
        return fx, fy, fz, tx, ty, tz

    def close(self) -> None:
        """Nothing to release."""

    def _noise(self) -> Iterator[list[list[float]]]:
        """Yield blocks of rows, each an unloaded wrench."""
        simulation = self._simulation
        generator = np.random.default_rng(simulation.seed)
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
