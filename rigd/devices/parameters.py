"""What a profile says of the hardware: plain data, one class a device, units in the names.

The ranges (``Gt``, ``Ge``, …) are enforced where a profile is loaded (:mod:`rigd.profile`).
"""

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Ge, Gt, Le, MinLen

from rigd.beam import Beam, Damping

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True, slots=True)
class Motor:
    """Motor and gear as seen from the output shaft."""

    inertia_kg_m2: Positive
    viscous_nm_s_per_rad: NonNegative
    coulomb_nm: NonNegative
    rated_torque_nm: Positive
    peak_torque_nm: Positive


@dataclass(frozen=True, slots=True)
class Encoder:
    """Incremental encoder, referred to the output shaft."""

    resolution_rad: Annotated[float, Ge(0), Le(0.1)]
    """Zero: the angle is not quantised (tests of the linear loop)."""
    delay_s: NonNegative = 0.0
    """Age of the angle at the tick that asks for it."""


@dataclass(frozen=True, slots=True)
class WrenchSensor:
    """Force-torque sensor; every sequence of six is fx, fy, fz (N), tx, ty, tz (N·m)."""

    resolution: tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]
    range: tuple[Positive, Positive, Positive, Positive, Positive, Positive]
    projection: tuple[float, float, float, float, float, float]
    """Torque about the motor axis = projection · wrench: axis, sign and lever arm in one."""
    tool_inertia_kg_m2: NonNegative = 0.0
    """Inertia about the motor axis between sensor and beam (the clamp)."""
    delay_s: NonNegative = 0.0
    """Age of the wrench at the tick that asks for it."""


@dataclass(frozen=True, slots=True)
class Actuation:
    """The way of a torque command to the motor's shaft."""

    delay_s: NonNegative
    """From the tick that computes a command to the moment the motor exerts it."""


@dataclass(frozen=True, slots=True)
class Simulation:
    """What only a simulated rig has: noise, and how it is drawn."""

    torque_noise_nm: NonNegative
    """Standard deviation of white noise on each torque axis, each sample."""
    force_noise_n: NonNegative
    offset: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """What the sensor shows without a load, N and N·m: what the tare has to take away."""
    seed: Annotated[int, Ge(0)] = 0


@dataclass(frozen=True, slots=True)
class Selection:
    """Which driver serves each device: names in :mod:`rigd.devices.registry`."""

    drive: Annotated[str, MinLen(1)]
    sensor: Annotated[str, MinLen(1)]


@dataclass(frozen=True, slots=True)
class RigParameters:
    """Everything a driver may need to know of the rig it belongs to."""

    rate_hz: Annotated[float, Gt(0), Le(20_000)]
    beam: Beam
    damping: Damping
    motor: Motor
    encoder: Encoder
    sensor: WrenchSensor
    actuation: Actuation
    devices: Selection
    simulation: Simulation | None = field(default=None)
