"""Hardware parameters of a profile: plain data, one class per device, units in the names.

The ranges (``Gt``, ``Ge``, …) are enforced where a profile is loaded (:mod:`rigd.profile`).
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MinLen

from rigd.beam import Beam, Damping

OPTIONAL = {"optional": True}
"""Metadata of a field whose key a profile may leave out: its default is then what holds."""

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True, slots=True)
class Motor:
    """Motor and gear as seen from the output shaft."""

    inertia_kg_m2: Positive
    """Inertia of rotor and gear."""
    viscous_nm_s_per_rad: NonNegative
    """Viscous friction."""
    coulomb_nm: NonNegative
    """Coulomb friction."""
    rated_torque_nm: Positive
    """Torque of 1000 thousandths in the drive (its object 6076)."""
    peak_torque_nm: Positive
    """Largest torque that is ever commanded."""
    continuous_torque_nm: Positive = math.inf
    """Continuous (rms) torque rating; infinite: none is known."""
    thermal_time_constant_s: Positive = 10.0
    """Time constant of the motor's heating, over which the rms torque is taken."""


@dataclass(frozen=True, slots=True)
class Encoder:
    """Incremental encoder, referred to the output shaft."""

    resolution_rad: Annotated[float, Ge(0), Le(0.1)]
    """Zero: the angle is not quantised (tests of the linear loop)."""
    delay_s: NonNegative = 0.0
    """Age of the angle at the tick that asks for it."""


@dataclass(frozen=True, slots=True)
class WrenchSensorSettings:
    """Force-torque sensor; every sequence of six is fx, fy, fz (N), tx, ty, tz (N·m)."""

    resolution: tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]
    """Smallest step of each axis."""
    range: tuple[Positive, Positive, Positive, Positive, Positive, Positive]
    """Magnitude at the end of each axis' range."""
    projection: tuple[float, float, float, float, float, float]
    """Torque about the motor axis = projection · wrench: axis, sign and lever arm in one."""
    tool_inertia_kg_m2: NonNegative = 0.0
    """Inertia about the motor axis between sensor and beam (the clamp)."""
    delay_s: NonNegative = 0.0
    """Age of the wrench at the tick that asks for it."""
    filter_hz: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Corner of the sensor's own low-pass filter, as used by the analysis; 0: none is known. Its
    delay is not part of `delay_s`."""
    filter_order: Annotated[int, Ge(1), Le(2)] = field(default=1, metadata=OPTIONAL)
    """Order of that filter: 1, or 2 (Butterworth)."""
    shear_projection: tuple[float, float, float, float, float, float] = field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), metadata=OPTIONAL
    )
    """Base shear, the force of the motor on the beam towards a positive angle = shear_projection ·
    wrench; all zero: not known."""


@dataclass(frozen=True, slots=True)
class Actuation:
    """Path of a torque command to the motor shaft."""

    delay_s: NonNegative
    """Time from the tick that computes a command to the moment the motor exerts it."""


@dataclass(frozen=True, slots=True)
class Simulation:
    """Parameters of a simulated rig only: noise, and how it is drawn."""

    torque_noise_nm: NonNegative
    """Standard deviation of white noise on each torque axis, each sample."""
    force_noise_n: NonNegative
    """Standard deviation of white noise on each force axis, each sample."""
    offset: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """What the sensor shows without a load, N and N·m: what the tare has to take away."""
    seed: Annotated[int, Ge(0)] | None = field(default=None, metadata=OPTIONAL)
    """Seed of the noise, for sessions that repeat each other; None: each has a fresh one."""
    density_ratio: Positive = field(default=1.0, metadata=OPTIONAL)
    """Density of the simulated beam over the one that the profile states."""
    stiffness_ratio: Positive = field(default=1.0, metadata=OPTIONAL)
    """Bending stiffness of the simulated beam over the one that the profile states."""
    clamp_compliance_rad_per_nm: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """By how much the clamp turns, between sensor and beam, for a torque; 0: it is rigid."""
    tip_mass_kg: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Point mass at the beam's tip."""
    torque_filter_hz: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Corner of a low-pass filter of the sensor; 0: it has none."""
    torque_filter_order: Annotated[int, Ge(1), Le(2)] = field(default=1, metadata=OPTIONAL)
    """Order of that filter: 1, or 2 (Butterworth)."""
    clock_rate_difference: Annotated[float, Ge(-1e-3), Le(0)] = field(
        default=0.0, metadata=OPTIONAL
    )
    """By how much the torque's samples lie farther apart than the angle's; below 0 the torque grows
    older all the time, and it cannot grow younger than it is."""
    hum_nm: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Amplitude of a sine that the sensor's torque picks up, whatever the beam does; 0: none."""
    hum_hz: Positive = field(default=50.0, metadata=OPTIONAL)
    """Its frequency, below half the rate at which the sensor takes readings."""
    stiffness_drift_per_s: Annotated[float, Ge(-1e-3), Le(1e-3)] = field(
        default=0.0, metadata=OPTIONAL
    )
    """Relative growth of the beam's bending stiffness per second, from the first enabling of the
    drive until it has changed by 5 %; below 0, as of a beam that warms, it falls."""
    air_drag_m: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Drag coefficient times diameter of the beam, C_D d, in air of 1.2 kg/m³; 0: no drag."""
    crosstalk_percent: Annotated[float, Ge(0), Le(20)] = field(default=0.0, metadata=OPTIONAL)
    """Error of the sensor's calibration: the largest reading of an axis, as a fraction of its
    range, at the full range of another."""
    zeta_scatter_percent: Annotated[float, Ge(0), Le(50)] = field(default=0.0, metadata=OPTIONAL)
    """Standard deviation between sessions of the logarithm of zeta."""
    gamma_scatter_percent: Annotated[float, Ge(0), Le(50)] = field(default=0.0, metadata=OPTIONAL)
    """The same of gamma."""
    stiffness_scatter_percent: Annotated[float, Ge(0), Le(50)] = field(
        default=0.0, metadata=OPTIONAL
    )
    """The same of the bending stiffness."""
    obstacles: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """What the beam meets, each as `rigd.devices.obstacles.parse_obstacle` reads it."""


@dataclass(frozen=True, slots=True)
class DeviceSelection:
    """Which driver serves each device: names in :mod:`rigd.devices._registry`."""

    drive: Annotated[str, MinLen(1)]
    """Name of the drive's driver."""
    sensor: Annotated[str, MinLen(1)]
    """Name of the sensor's driver."""


@dataclass(frozen=True, slots=True)
class CanBus:
    """CAN bus of the devices, as python-can names it."""

    interface: Annotated[str, MinLen(1)]
    """"socketcan", or another interface of python-can."""
    channel: Annotated[str, MinLen(1)]
    """Name of the bus, such as ``can0``."""
    bitrate_bit_s: Annotated[int, Ge(10_000), Le(1_000_000)]
    """Bit rate of the bus."""


@dataclass(frozen=True, slots=True)
class Acquisition:
    """Acquisition: which replies a tick works with."""

    mode: Literal["same_tick", "previous_tick"]
    """A tick waits for the replies to its own requests, or takes those of the tick before."""
    deadline_us: Annotated[float, Gt(0)]
    """How long after its start a tick waits for its own replies; then the last ones stand."""


@dataclass(frozen=True, slots=True)
class ServoDrive:
    """A CiA 402 drive on CANopen, in cyclic synchronous torque mode."""

    node_id: Annotated[int, Ge(1), Le(127)]
    """Node number of the drive."""
    vendor_id: Annotated[int, Ge(0), Le(0xFFFFFFFF)]
    """Identity object 1018:1 as it has to be; 0 accepts any."""
    product_code: Annotated[int, Ge(0), Le(0xFFFFFFFF)]
    """1018:2; 0 accepts any."""
    direction: Annotated[int, Ge(-1), Le(1)]
    """1, or -1 where the drive counts and pushes the other way round."""
    gear_ratio: Positive
    """Motor turns per turn of the output shaft; only to compare 6076 with the rated torque."""
    rated_torque_unit_nm: NonNegative
    """Torque of one count of 6076 at the motor's shaft; 0 disables the comparison."""
    torque_delivery: Literal["at_sync", "on_arrival"]
    """When a torque takes effect: RPDO of type 1, or of type 255."""
    heartbeat_period_s: Annotated[float, Gt(0), Le(1)]
    """How often the loop sends its own heartbeat."""
    heartbeat_timeout_s: Annotated[float, Gt(0), Le(5)]
    """After how long without it the drive acts (object 1016)."""
    drive_heartbeat_period_s: Annotated[float, Gt(0), Le(1)]
    """Object 1017 of the drive."""
    drive_heartbeat_timeout_s: Annotated[float, Gt(0), Le(5)]
    """After how long without the drive's heartbeat the loop stops."""
    host_node_id: Annotated[int, Ge(1), Le(127)]
    """Node number in this computer's own heartbeat."""
    abort_option: Annotated[int, Ge(1), Le(3)]
    """Object 6007, what the drive does on a lost connection: 1 fault, 2 disable, 3 quick stop."""
    communication_error_option: Annotated[int, Ge(0), Le(2)]
    """Object 1029:1: 0 to pre-operational, 1 no change, 2 stopped."""
    enable_timeout_s: Annotated[float, Gt(0), Le(10)]
    """How long each step up to operation enabled may take."""
    torque_tolerance_percent: Annotated[float, Ge(0), Le(100)] = 0.0
    """Percent of the rated torque by which the drive's actual torque (6077) may differ from the
    command for some ticks; 0 disables the comparison."""
    max_speed_rad_s: NonNegative = 0.0
    """At the output shaft: above it the drive by itself exerts no torque that makes it faster
    (object 6080, in motor turns a minute); 0 leaves what the drive has."""
    sto_error_code: Annotated[int, Ge(0), Le(0xFFFF)] = 0
    """Error code of this drive's emergency message for a dropped STO; 0: only its statusword shows
    it."""
    eds: str = field(default="", metadata=OPTIONAL)
    """The drive's EDS file; its types are used, and its identity has to be the drive's. Empty:
    none."""
    set_objects: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """Manufacturer-specific objects written at the start, each ``"index:sub type value"``; see
    `rigd.devices.cia402`."""
    accept_without: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """What this drive may lack, by names of `rigd.devices.cia402.requirements.ACCEPTABLE`."""
    own_watchdog_s: Annotated[float, Ge(0), Le(5)] = field(default=0.0, metadata=OPTIONAL)
    """After how long the drive's own watchdog takes the torque off when SYNC and RPDO stay
    away, for a drive that has neither 1016 nor 1400:5; 0: it has none."""
    sync_gaps: bool = field(default=False, metadata=OPTIONAL)
    """After a TPDO that did not come, a SYNC is left out to see whether it was lost or is late: for
    drives that tolerate a missing SYNC. False: no SYNC is ever left out, and replies are
    distinguished by counting alone."""
    torque_response_s: Annotated[float, Ge(0), Le(1)] = field(default=0.0, metadata=OPTIONAL)
    """Time constant with which the actual torque (6077) follows the commanded one; 0: at once."""
    follows_target_bit: bool = field(default=True, metadata=OPTIONAL)
    """Whether bit 12 of the statusword has to say that the drive follows the target torque."""

    @property
    def watchdog_s(self) -> float:
        """The longest time for which the torque may stay on after this computer fell silent.

        By the profile alone: the active watchdog is known once the drive is connected. Infinite
        where the profile accepts a drive without any.
        """
        if self.own_watchdog_s > 0:
            return max(self.heartbeat_timeout_s, self.own_watchdog_s)
        return math.inf if "watchdog" in self.accept_without else self.heartbeat_timeout_s


@dataclass(frozen=True, slots=True)
class AtiCan:
    """An ATI sensor behind a NETCANOEM box."""

    base_id: Annotated[int, Ge(0), Le(0x7F)]
    """The seven upper bits of its CAN identifiers."""
    calibration: Annotated[int, Ge(0), Le(15)]
    """Index of the active calibration."""
    serial_number: str
    """Serial number that the sensor has to answer; empty accepts any."""
    saturation_counts: Annotated[int, Gt(0), Le(32767)]
    """Magnitude of a raw gauge from which on the sensor is saturated."""


@dataclass(frozen=True, slots=True)
class AtiSerial:
    """An ATI Digital F/T sensor on a serial line."""

    port: Annotated[str, MinLen(1)]
    """Serial port, such as ``/dev/ttyUSB0``."""
    baud: Annotated[int, Gt(0)]
    """Bits a second."""
    stream_hz: Positive
    """Records a second that the sensor streams."""
    filter: Literal["mean", "triangle"]
    """Filter from the records to one per tick: mean of one tick's, or triangle over two ticks'."""
    calibration: Annotated[int, Ge(1), Le(16)]
    """Number of the calibration block that is loaded."""
    serial_number: str
    """Serial number that the sensor has to answer; empty accepts any."""
    saturation_counts: Annotated[int, Gt(0), Le(32767)]
    """Magnitude of a raw gauge from which on the sensor is saturated."""

    def records_per_tick(self, rate_hz: float) -> int:
        """Whole number of records that belong to one tick."""
        return max(1, round(self.stream_hz / rate_hz))

    def weights(self, rate_hz: float) -> tuple[float, ...]:
        """Return the decimating filter, oldest record first; the weights sum to one.

        Examples
        --------
        >>> from rigd.devices.parameters import AtiSerial
        >>> sensor = AtiSerial("/dev/ttyUSB0", 1_250_000, 3000.0, "triangle", 1, "", 32767)
        >>> [round(9 * weight) for weight in sensor.weights(rate_hz=1000)]
        [1, 2, 3, 2, 1]
        >>> round(1e6 * sensor.filter_delay_s(1000))  # µs
        667
        """
        n = self.records_per_tick(rate_hz)
        if self.filter == "mean":
            return (1.0 / n,) * n
        return tuple((n - abs(n - 1 - i)) / n**2 for i in range(2 * n - 1))

    def filter_delay_s(self, rate_hz: float) -> float:
        """Group delay of the decimating filter, behind the newest record."""
        return 0.5 * (len(self.weights(rate_hz)) - 1) / self.stream_hz


@dataclass(frozen=True, slots=True)
class RigParameters:
    """Everything a driver may need to know of the rig it belongs to."""

    rate_hz: Annotated[float, Gt(0), Le(20_000)]
    """Ticks a second."""
    beam: Beam
    """Nominal beam."""
    damping: Damping
    """Nominal damping of the beam."""
    motor: Motor
    """Motor and gear."""
    encoder: Encoder
    """Encoder at the output shaft."""
    sensor: WrenchSensorSettings
    """Force-torque sensor."""
    actuation: Actuation
    """From the command to the torque."""
    devices: DeviceSelection
    """Drivers of drive and sensor."""
    simulation: Simulation | None = field(default=None)
    """Noise of the simulated rig; None: it cannot be simulated in the process."""
    name: str = "rig"
    """Name of the profile, by which a driver finds the simulated rig that replaces this one."""
    can: CanBus | None = field(default=None)
    """CAN bus. None: the rig has none."""
    acquisition: Acquisition | None = field(default=None)
    """Deadlines of the readings. None: the rig has none."""
    cia402: ServoDrive | None = field(default=None)
    """Drive on CANopen. None: the rig has none."""
    ati_can: AtiCan | None = field(default=None)
    """Sensor on CAN. None: the rig has none."""
    ati_serial: AtiSerial | None = field(default=None)
    """Sensor on a serial line. None: the rig has none."""
