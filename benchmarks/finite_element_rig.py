"""A simulated rig with a non-uniform beam in air, as a separate package added to rigd.

The beam is given by its modes with locked hub, from finite elements (`finite_element_beam.py`),
each with its own damping ratio; motor, friction, drag, encoder and sensor are computed here. Of
`rigd` only the interfaces of devices and the values of the profile are used.

With the modal coordinates q of unit modal mass, ``b`` the integral of density, position and shape,
and J the moment of inertia of the beam::

    q'' + 2 ξ ω q' + ω² q = -b θ'' + ∫ φ f dx
    torque = J θ'' + b·q'' - ∫ x f dx
    J_motor θ'' + viscous friction + Coulomb friction = motor's torque - torque

with the drag ``f = -ρ/2 C_D d |v| v`` of the speed ``v = x θ' + φ·q'``. The equations are linear
except for drag and Coulomb friction, which are constant over a period of the loop: the drag is
extrapolated to the middle of the period, the friction brings the shaft closest to rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import doc
from numpy.typing import NDArray
from scipy.linalg import expm

from rigd.devices.contracts import LineHealth, Wrench, WrenchSensor
from rigd.devices.declaration import DeviceKind, OpenedDrive
from rigd.devices.parameters import RigParameters

Real = NDArray[np.float64]

_AIR_KG_PER_M3 = 1.2
_STEPS_PER_PERIOD = 4
"""With one step, the extrapolated drag is 3 % too large and lags by 5 mrad at 45 Hz."""
NAME = "finite_elements"
"""Name of drive and sensor in a profile."""


@dataclass(frozen=True)
class Settings:
    """Keys of the profile's section."""

    file: Annotated[str, doc("file of `ModalBeam.write`")]


@dataclass(frozen=True, slots=True, eq=False)
class ModalBeam:
    """A beam by its modes with locked hub, and their shapes for the drag.

    Attributes
    ----------
    omega_rad_s, damping_ratio, participation : ndarray, shape (modes,)
        A participation is the integral of density, position and shape, in sqrt(kg)·m.
    shear_participation : ndarray, shape (modes,)
        Integral of density and shape, in sqrt(kg).
    inertia_kg_m2, moment_kg_m : float
        Moment of inertia about the hub, and first moment of mass.
    position_m : ndarray, shape (points,)
        Midpoints of intervals of equal length.
    shape : ndarray, shape (modes, points)
        Deflection at the midpoints for unit modal mass, in 1/sqrt(kg).
    drag_m : float
        C_D d.
    """

    omega_rad_s: Real
    damping_ratio: Real
    participation: Real
    shear_participation: Real
    inertia_kg_m2: float
    moment_kg_m: float
    position_m: Real
    shape: Real
    drag_m: float

    def write(self, path: Path) -> None:
        """Write the beam as a file for the rig."""
        np.savez(path, **{name: getattr(self, name) for name in self.__slots__})

    @classmethod
    def read(cls, path: str) -> ModalBeam:
        """Read a beam written by `write`."""
        with np.load(path) as stored:
            values: dict[str, Any] = {name: stored[name] for name in cls.__slots__}
        scalars = {name: float(value) for name, value in values.items() if value.ndim == 0}
        return cls(**values | scalars)


class Plant:
    """Motor and beam, advanced by periods of the loop."""

    def __init__(self, rig: RigParameters, beam: ModalBeam) -> None:
        modes, step_s = beam.omega_rad_s.size, 1 / (_STEPS_PER_PERIOD * rig.rate_hz)
        inertia = np.eye(modes + 1)
        inertia[0, 0] = rig.motor.inertia_kg_m2 + beam.inertia_kg_m2
        inertia[0, 1:] = inertia[1:, 0] = beam.participation
        stiffness = np.diag([0.0, *beam.omega_rad_s**2])
        loss = np.diag([rig.motor.viscous_nm_s_per_rad, *2 * beam.damping_ratio * beam.omega_rad_s])
        inverse = np.linalg.inv(inertia)
        n = 2 * (modes + 1)
        # Forces are the torque on the shaft and the generalised forces on the modes.
        generator = np.zeros((n + modes + 1,) * 2)
        generator[: n // 2, n // 2 : n] = np.eye(n // 2)
        generator[n // 2 : n, : n // 2] = -inverse @ stiffness
        generator[n // 2 : n, n // 2 : n] = -inverse @ loss
        generator[n // 2 : n, n:] = inverse
        step = expm(generator * step_s)
        self._free, self._forced = step[:n, :n], step[:n, n:]
        acceleration = generator[n // 2 : n]
        # Torque and shear at the beam's root, by state and forces, without the drag itself.
        root = np.array(
            [
                [beam.inertia_kg_m2, *beam.participation],
                [beam.moment_kg_m, *beam.shear_participation],
            ]
        )
        self._root = root @ acceleration
        self._reach = np.vstack([beam.position_m, beam.shape])
        spacing_m = 2 * beam.position_m[0]
        self._drag = -0.5 * _AIR_KG_PER_M3 * beam.drag_m * spacing_m
        self._coulomb_nm, self._peak_nm = rig.motor.coulomb_nm, rig.motor.peak_torque_nm
        self._state = np.zeros(n)
        self._speed = n // 2
        self._drag_forces = self._last_drag_forces = np.zeros(modes + 1)
        self._acting_nm = self._next_nm = 0.0
        self.enabled = False
        self.torque_nm = self.shear_n = 0.0

    @property
    def angle_rad(self) -> float:
        """Angle of the shaft."""
        return float(self._state[0])

    def enable(self) -> None:
        """Let torque act."""
        self.enabled = True

    def disable(self) -> None:
        """Let no torque act."""
        self.enabled = False
        self._acting_nm = self._next_nm = 0.0

    def command(self, torque_nm: float) -> float:
        """Let a torque act from the next tick on."""
        self._next_nm = min(max(torque_nm, -self._peak_nm), self._peak_nm) if self.enabled else 0.0
        return self._next_nm

    def advance(self) -> None:
        """Advance to the next tick."""
        drag_n = 0.0
        for _ in range(_STEPS_PER_PERIOD):
            # Mean over the step of the straight line through the last two forces.
            forces = 1.5 * self._drag_forces - 0.5 * self._last_drag_forces
            forces[0] += self._acting_nm
            unbraked = self._free @ self._state + self._forced @ forces
            brake = -unbraked[self._speed] / self._forced[self._speed, 0]
            forces[0] += min(max(brake, -self._coulomb_nm), self._coulomb_nm)
            self._state = self._free @ self._state + self._forced @ forces
            if self._drag:
                along = self._state[self._speed :] @ self._reach
                force = self._drag * np.abs(along) * along
                self._last_drag_forces, self._drag_forces = self._drag_forces, self._reach @ force
                drag_n = float(force.sum())
        drag_nm = float(self._drag_forces[0])
        # The torque jumps with that of the motor: a continuous signal passes through the middle.
        forces[0] += 0.5 * (self._next_nm - self._acting_nm)
        self._acting_nm = self._next_nm
        torque_nm, shear_n = self._root @ np.concatenate([self._state, forces])
        self.torque_nm, self.shear_n = float(torque_nm) - drag_nm, float(shear_n) - drag_n


class Drive:
    """Drive with an encoder."""

    def __init__(self, rig: RigParameters, plant: Plant) -> None:
        self._plant = plant
        self._period_ns = 1e9 / rig.rate_hz
        self._step_rad = rig.encoder.resolution_rad
        self._due_ns: int | None = None
        self.angle_stale = False
        self.angle_time_ns = 0
        self.off_doubt = ""

    def connect(self) -> None:
        """Do nothing."""

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:  # noqa: ARG002
        """Let torque act."""
        self._plant.enable()

    def latch(self, due_ns: int) -> None:
        """Advance the plant to this tick."""
        if self._due_ns is not None:
            for _ in range(round((due_ns - self._due_ns) / self._period_ns)):
                self._plant.advance()
        self._due_ns = self.angle_time_ns = due_ns

    def read_angle(self) -> float:
        """Return the angle in whole encoder steps."""
        return round(self._plant.angle_rad / self._step_rad) * self._step_rad

    def command(self, torque_nm: float) -> float:
        """Let a torque act from the next tick on."""
        return self._plant.command(torque_nm)

    def health(self) -> LineHealth:
        """Return that there is no line."""
        return LineHealth()

    def disable(self) -> None:
        """Let no torque act."""
        self._plant.disable()

    def close(self) -> None:
        """Let no torque act."""
        self.disable()


class Sensor:
    """Sensor of the torque and of the shear at the beam's root."""

    def __init__(self, rig: RigParameters, plant: Plant) -> None:
        assert rig.simulation is not None
        self._plant = plant
        self._std = np.repeat([rig.simulation.force_noise_n, rig.simulation.torque_noise_nm], 3)
        self._offset = np.array(rig.simulation.offset)
        self._resolution = np.array(rig.sensor.resolution)
        self._projections = np.array([rig.sensor.projection, rig.sensor.shear_projection])
        self._generator = np.random.default_rng()
        self.wrench_stale = False
        self.wrench_saturated = False
        self.wrench_time_ns = 0

    def renew_noise(self, seed: int | None) -> int:
        """Restart the noise with a seed."""
        seed = int(np.random.default_rng().integers(2**31)) if seed is None else seed
        self._generator = np.random.default_rng(seed)
        return seed

    def connect(self) -> None:
        """Do nothing."""

    def calibration(self) -> dict[str, object]:
        """Return the metadata of the sensor."""
        return {"device": "finite elements"}

    def request(self, due_ns: int) -> None:
        """Measure at this tick."""
        self.wrench_time_ns = due_ns

    def read_wrench(self) -> Wrench:
        """Return the wrench with noise, in whole sensor steps."""
        wrench = self._offset + self._std * self._generator.standard_normal(6)
        wrench += np.array([self._plant.torque_nm, self._plant.shear_n]) @ self._projections
        fx, fy, fz, tx, ty, tz = (np.round(wrench / self._resolution) * self._resolution).tolist()
        return fx, fy, fz, tx, ty, tz

    def health(self) -> LineHealth:
        """Return that there is no line."""
        return LineHealth(status=0)

    def close(self) -> None:
        """Do nothing."""


def open_rig(rig: RigParameters) -> OpenedDrive:
    """Create motor, beam, drive and sensor."""
    plant = Plant(rig, ModalBeam.read(rig.settings_of(Settings).file))
    sensor = Sensor(rig, plant)
    return OpenedDrive(
        rig,
        Drive(rig, plant),
        simulated=True,
        renew_noise=sensor.renew_noise,
        simulated_sensor=sensor,
    )


def open_sensor(_rig: RigParameters, opened: OpenedDrive) -> WrenchSensor:
    """Return the sensor of an opened rig."""
    assert opened.simulated_sensor is not None
    return opened.simulated_sensor


DEVICE = DeviceKind(
    NAME,
    "rig with a beam that is not uniform, in air",
    open_drive=open_rig,
    open_sensor=open_sensor,
    settings=Settings,
    sections=("simulation",),
    drives=(NAME,),
    in_process=True,
)


def install(folder: Path) -> None:
    """Write the metadata by which rigd finds this package into a folder of ``PYTHONPATH``."""
    metadata = folder / "finite_element_rig-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Name: finite-element-rig\nVersion: 1.0\n", "utf-8")
    entry = f"[rigd.devices]\n{NAME} = finite_element_rig:DEVICE\n"
    (metadata / "entry_points.txt").write_text(entry, "utf-8")
