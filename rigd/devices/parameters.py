"""Hardware parameters of a profile: one dataclass per device, with units in the names.

The ranges (``Gt``, ``Ge``, …) are enforced where a profile is loaded (:mod:`rigd.profile`).
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeVar

from annotated_types import Ge, Gt, Le, MinLen

from rigd.beam import Beam, Damping

T = TypeVar("T")
"""Type of the settings of a device."""

OPTIONAL = {"optional": True}
"""Metadata of a field whose key a profile may omit; the field then has its default value."""

Positive = Annotated[float, Gt(0)]
"""Type of a number above 0."""
NonNegative = Annotated[float, Ge(0)]
"""Type of a number of at least 0."""


@dataclass(frozen=True, slots=True)
class Motor:
    """Parameters of motor and gear, referred to the output shaft."""

    inertia_kg_m2: Positive
    """Inertia of rotor and gear in kg·m²."""
    viscous_nm_s_per_rad: NonNegative
    """Viscous friction coefficient in N·m·s/rad."""
    coulomb_nm: NonNegative
    """Coulomb friction torque in N·m."""
    rated_torque_nm: Positive
    """Rated torque in N·m, which the drive represents as 1000 (its object 6076)."""
    peak_torque_nm: Positive
    """Largest torque in N·m that is ever commanded."""
    continuous_torque_nm: Positive = math.inf
    """Continuous (rms) torque rating in N·m; infinite if none is known."""
    thermal_time_constant_s: Positive = 10.0
    """Time constant of the motor's heating in seconds, over which the rms torque is averaged."""


@dataclass(frozen=True, slots=True)
class Encoder:
    """Parameters of the incremental encoder, referred to the output shaft."""

    resolution_rad: Annotated[float, Ge(0), Le(0.1)]
    """Angle of one encoder step in rad; 0 means that a simulated angle is not quantised."""
    delay_s: NonNegative = 0.0
    """Age in seconds of the angle at the tick that requests it."""


@dataclass(frozen=True, slots=True)
class WrenchSensorSettings:
    """Parameters of the force-torque sensor; six values are fx, fy, fz (N), tx, ty, tz (N·m)."""

    resolution: tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]
    """Smallest step of each axis in N and N·m."""
    range: tuple[Positive, Positive, Positive, Positive, Positive, Positive]
    """Largest magnitude of each axis in N and N·m."""
    projection: tuple[float, float, float, float, float, float]
    """Coefficients that give the torque about the motor axis: torque = projection · wrench.

    They contain axis, sign and lever arm."""
    tool_inertia_kg_m2: NonNegative = 0.0
    """Inertia in kg·m² about the motor axis of the parts between sensor and beam (the clamp)."""
    delay_s: NonNegative = 0.0
    """Age in seconds of the wrench at the tick that requests it."""
    filter_hz: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Corner frequency in Hz of the sensor's own low-pass filter, for the analysis; 0 if unknown.

    The filter's delay is not included in `delay_s`."""
    filter_order: Annotated[int, Ge(1), Le(2)] = field(default=1, metadata=OPTIONAL)
    """Order of the sensor's own low-pass filter: 1, or 2 (Butterworth)."""
    shear_projection: tuple[float, float, float, float, float, float] = field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), metadata=OPTIONAL
    )
    """Coefficients that give the base shear in N: base shear = shear_projection · wrench.

    The base shear is the force of the motor on the beam in the direction of a positive angle. All
    zero means that the coefficients are unknown."""


@dataclass(frozen=True, slots=True)
class Actuation:
    """Parameters of the path from a torque command to the motor shaft."""

    delay_s: NonNegative
    """Time in seconds from the tick that computes a torque command until the motor exerts it."""


@dataclass(frozen=True, slots=True)
class Simulation:
    """Parameters of a simulated rig only: noise, imperfections and obstacles."""

    torque_noise_nm: NonNegative
    """Standard deviation in N·m of the white noise on each torque axis of a sample."""
    force_noise_n: NonNegative
    """Standard deviation in N of the white noise on each force axis of a sample."""
    offset: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Sensor reading without load in N and N·m, which the tare has to remove."""
    seed: Annotated[int, Ge(0)] | None = field(default=None, metadata=OPTIONAL)
    """Seed of the noise for repeatable sessions; None: each session has a random seed."""
    density_ratio: Positive = field(default=1.0, metadata=OPTIONAL)
    """Density of the simulated beam divided by the density in the profile."""
    stiffness_ratio: Positive = field(default=1.0, metadata=OPTIONAL)
    """Bending stiffness of the simulated beam divided by the bending stiffness in the profile."""
    clamp_compliance_rad_per_nm: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Rotation in rad of the clamp, between sensor and beam, per N·m of torque; 0: rigid."""
    tip_mass_kg: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Point mass in kg at the beam's tip."""
    torque_filter_hz: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Corner frequency in Hz of a low-pass filter in the simulated sensor; 0: no filter."""
    torque_filter_order: Annotated[int, Ge(1), Le(2)] = field(default=1, metadata=OPTIONAL)
    """Order of the simulated sensor's low-pass filter: 1, or 2 (Butterworth)."""
    clock_rate_difference: Annotated[float, Ge(-1e-3), Le(0)] = field(
        default=0.0, metadata=OPTIONAL
    )
    """Sampling period of the sensor divided by that of the angle, minus 1; 0 or negative.

    With a negative value the age of the torque grows all the time. A positive value is impossible:
    the age would fall below zero."""
    hum_nm: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Amplitude in N·m of a sinusoidal interference in the sensor's torque; 0: none."""
    hum_hz: Positive = field(default=50.0, metadata=OPTIONAL)
    """Frequency in Hz of the sinusoidal interference, below half the sensor's sampling rate."""
    stiffness_drift_per_s: Annotated[float, Ge(-1e-3), Le(1e-3)] = field(
        default=0.0, metadata=OPTIONAL
    )
    """Relative change of the beam's bending stiffness per second, after the first enabling.

    The drift ends when the stiffness has changed by 5 %. It is negative for a beam that gets
    warmer."""
    air_drag_m: NonNegative = field(default=0.0, metadata=OPTIONAL)
    """Drag coefficient times diameter of the beam in m, C_D d, in air of 1.2 kg/m³; 0: no drag."""
    crosstalk_percent: Annotated[float, Ge(0), Le(20)] = field(default=0.0, metadata=OPTIONAL)
    """Calibration error of the sensor: crosstalk between its axes in percent.

    It is the largest reading of one axis, relative to its range, at the full range of another
    axis."""
    zeta_scatter_percent: Annotated[float, Ge(0), Le(50)] = field(default=0.0, metadata=OPTIONAL)
    """Standard deviation of the logarithm of the damping parameter zeta between sessions, in
    percent."""
    gamma_scatter_percent: Annotated[float, Ge(0), Le(50)] = field(default=0.0, metadata=OPTIONAL)
    """Standard deviation of the logarithm of the damping parameter gamma between sessions, in
    percent."""
    stiffness_scatter_percent: Annotated[float, Ge(0), Le(50)] = field(
        default=0.0, metadata=OPTIONAL
    )
    """Standard deviation of the logarithm of the bending stiffness between sessions, in percent."""
    obstacles: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """Obstacles and impacts on the beam, each in the syntax of
    `rigd.devices.obstacles.parse_obstacle`."""


@dataclass(frozen=True, slots=True)
class DeviceSelection:
    """Selection of the drivers for drive and sensor, by names in :mod:`rigd.devices._registry`."""

    drive: Annotated[str, MinLen(1)]
    """Name of the drive's driver."""
    sensor: Annotated[str, MinLen(1)]
    """Name of the sensor's driver."""


@dataclass(frozen=True, slots=True)
class CanBus:
    """Settings of the devices' CAN bus, as python-can names them."""

    interface: Annotated[str, MinLen(1)]
    """Kind of CAN interface: "socketcan", or another interface of python-can."""
    channel: Annotated[str, MinLen(1)]
    """Name of the bus, such as ``can0``."""
    bitrate_bit_s: Annotated[int, Ge(10_000), Le(1_000_000)]
    """Bit rate of the bus in bit/s."""


@dataclass(frozen=True, slots=True)
class Acquisition:
    """Settings of the acquisition: which replies of the devices a tick uses."""

    mode: Literal["same_tick", "previous_tick"]
    """Whether a tick waits for the replies to its own requests, or uses the replies to the requests
    of the previous tick."""
    deadline_us: Annotated[float, Gt(0)]
    """Time in microseconds from the start of a tick until which the tick waits for its own replies.

    After that the last values are used."""


@dataclass(frozen=True, slots=True)
class ServoDrive:
    """Settings of a CiA 402 drive on CANopen, in cyclic synchronous torque mode."""

    node_id: Annotated[int, Ge(1), Le(127)]
    """CANopen node number of the drive."""
    vendor_id: Annotated[int, Ge(0), Le(0xFFFFFFFF)]
    """Required vendor number of the drive (object 1018:1); 0 accepts any."""
    product_code: Annotated[int, Ge(0), Le(0xFFFFFFFF)]
    """Required product code of the drive (object 1018:2); 0 accepts any."""
    direction: Annotated[int, Ge(-1), Le(1)]
    """Sign of the drive's positive direction: 1, or -1 if position and torque have the opposite
    sign."""
    gear_ratio: Positive
    """Motor revolutions per revolution of the output shaft, used to check values that the drive
    states."""
    rated_torque_unit_nm: NonNegative
    """Unit of object 6076 in N·m at the motor shaft; 0 disables the check of the rated torque."""
    torque_delivery: Literal["at_sync", "on_arrival"]
    """When a torque command takes effect: at SYNC (RPDO type 1) or on arrival (RPDO type 255)."""
    heartbeat_period_s: Annotated[float, Gt(0), Le(1)]
    """Period in seconds at which the loop sends this computer's heartbeat."""
    heartbeat_timeout_s: Annotated[float, Gt(0), Le(5)]
    """Time in seconds without this computer's heartbeat after which the drive reacts (object
    1016)."""
    drive_heartbeat_period_s: Annotated[float, Gt(0), Le(1)]
    """Period in seconds at which the drive sends its heartbeat (object 1017)."""
    drive_heartbeat_timeout_s: Annotated[float, Gt(0), Le(5)]
    """Time in seconds without the drive's heartbeat after which the loop stops."""
    host_node_id: Annotated[int, Ge(1), Le(127)]
    """CANopen node number in this computer's heartbeat."""
    abort_option: Annotated[int, Ge(1), Le(3)]
    """Reaction of the drive to a lost connection (object 6007): 1 fault, 2 disable, 3 quick
    stop."""
    communication_error_option: Annotated[int, Ge(0), Le(2)]
    """NMT state after a communication error (object 1029:1): 0 pre-operational, 1 no change, 2
    stopped."""
    enable_timeout_s: Annotated[float, Gt(0), Le(10)]
    """Time limit in seconds for each step up to operation enabled."""
    torque_tolerance_percent: Annotated[float, Ge(0), Le(100)] = 0.0
    """Tolerance between actual torque (object 6077) and command, in percent of the rated torque.

    It may be exceeded for some ticks; 0 disables the comparison."""
    max_speed_rad_s: NonNegative = 0.0
    """Speed limit in the drive (object 6080), in rad/s at the output shaft.

    Above it the drive exerts no accelerating torque; 0 leaves the drive's own limit unchanged."""
    sto_error_code: Annotated[int, Ge(0), Le(0xFFFF)] = 0
    """Error code of the drive's emergency message for a dropped STO.

    0 means that only the drive's statusword shows it."""
    eds: str = field(default="", metadata=OPTIONAL)
    """Path of the drive's EDS file, whose data types are used and whose identity is checked.

    Empty if there is none."""
    set_objects: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """Manufacturer-specific objects to write at the start, each as ``"index:sub type value"``.

    See `rigd.devices.cia402`."""
    accept_without: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """Functions that the drive may lack, by the names in
    `rigd.devices.cia402.requirements.ACCEPTABLE_MISSING_FUNCTIONS`."""
    own_watchdog_s: Annotated[float, Ge(0), Le(5)] = field(default=0.0, metadata=OPTIONAL)
    """Timeout in seconds of the drive's manufacturer-specific watchdog over SYNC and RPDO.

    It is for a drive that has neither object 1016 nor 1400:5; 0 means that there is no such
    watchdog."""
    sync_gaps: bool = field(default=False, metadata=OPTIONAL)
    """Whether one SYNC is omitted after a missing TPDO, to find out if the TPDO was lost or is
    late.

    This requires a drive that tolerates a missing SYNC. If False, no SYNC is ever omitted, and
    replies are assigned by counting alone."""
    torque_response_s: Annotated[float, Ge(0), Le(1)] = field(default=0.0, metadata=OPTIONAL)
    """Time constant in seconds with which the actual torque (object 6077) follows the command; 0:
    none."""
    follows_target_bit: bool = field(default=True, metadata=OPTIONAL)
    """Whether bit 12 of the statusword has to show that the drive follows the target torque."""

    @property
    def watchdog_s(self) -> float:
        """Longest time in seconds for which the torque may remain after this computer fails.

        The time follows from the profile alone; the active watchdog is known only after the drive
        is connected. It is infinite if the profile accepts a drive without watchdog.
        """
        if self.own_watchdog_s > 0:
            return max(self.heartbeat_timeout_s, self.own_watchdog_s)
        return math.inf if "watchdog" in self.accept_without else self.heartbeat_timeout_s


@dataclass(frozen=True, slots=True)
class AtiCan:
    """Settings of an ATI sensor with a NETCANOEM box on the CAN bus."""

    base_id: Annotated[int, Ge(0), Le(0x7F)]
    """Seven upper bits of the sensor's CAN identifiers."""
    calibration: Annotated[int, Ge(0), Le(15)]
    """Index of the calibration to select."""
    serial_number: str
    """Serial number that the sensor has to report; empty accepts any."""
    saturation_counts: Annotated[int, Gt(0), Le(32767)]
    """Magnitude of a raw gauge reading from which on the sensor counts as saturated."""


@dataclass(frozen=True, slots=True)
class AtiSerial:
    """Settings of an ATI Digital F/T sensor on a serial line."""

    port: Annotated[str, MinLen(1)]
    """Serial port, such as ``/dev/ttyUSB0``."""
    baud: Annotated[int, Gt(0)]
    """Bit rate of the serial line in bit/s."""
    stream_hz: Positive
    """Number of records per second that the sensor streams."""
    filter: Literal["mean", "triangle"]
    """Filter that reduces the records to one value per tick.

    It is the mean over the records of one tick, or a triangle over the records of two ticks."""
    calibration: Annotated[int, Ge(1), Le(16)]
    """Number of the sensor's calibration block to load."""
    serial_number: str
    """Serial number that the sensor has to report; empty accepts any."""
    saturation_counts: Annotated[int, Gt(0), Le(32767)]
    """Magnitude of a raw gauge reading from which on the sensor counts as saturated."""

    def records_per_tick(self, rate_hz: float) -> int:
        """Return the number of records that the sensor streams per tick, rounded, at least 1."""
        return max(1, round(self.stream_hz / rate_hz))

    def filter_weights(self, rate_hz: float) -> tuple[float, ...]:
        """Return the weights of the decimating filter, oldest record first; their sum is 1.

        Examples
        --------
        >>> from rigd.devices.parameters import AtiSerial
        >>> sensor = AtiSerial("/dev/ttyUSB0", 1_250_000, 3000.0, "triangle", 1, "", 32767)
        >>> [round(9 * weight) for weight in sensor.filter_weights(rate_hz=1000)]
        [1, 2, 3, 2, 1]
        >>> round(1e6 * sensor.filter_delay_s(1000))  # µs
        667
        """
        n = self.records_per_tick(rate_hz)
        if self.filter == "mean":
            return (1.0 / n,) * n
        return tuple((n - abs(n - 1 - i)) / n**2 for i in range(2 * n - 1))

    def filter_delay_s(self, rate_hz: float) -> float:
        """Return the group delay of the decimating filter in s, relative to the newest record."""
        return 0.5 * (len(self.filter_weights(rate_hz)) - 1) / self.stream_hz


@dataclass(frozen=True, slots=True)
class RigParameters:
    """Parameters of a rig that its drivers and its simulation need."""

    rate_hz: Annotated[float, Gt(0), Le(20_000)]
    """Rate of the control loop in ticks per second."""
    beam: Beam
    """Nominal beam."""
    damping: Damping
    """Nominal damping of the beam."""
    motor: Motor
    """Parameters of motor and gear."""
    encoder: Encoder
    """Parameters of the encoder at the output shaft."""
    sensor: WrenchSensorSettings
    """Parameters of the force-torque sensor."""
    actuation: Actuation
    """Parameters of the path from torque command to torque."""
    devices: DeviceSelection
    """Drivers of drive and sensor."""
    simulation: Simulation | None = field(default=None)
    """Parameters of the simulated rig; None: the rig cannot be simulated in the process."""
    name: str = "rig"
    """Name of the profile, by which a driver finds the simulated rig that replaces the hardware."""
    can: CanBus | None = field(default=None)
    """Settings of the CAN bus; None: the rig has none."""
    acquisition: Acquisition | None = field(default=None)
    """Settings of the acquisition; None: the rig's drivers need none."""
    cia402: ServoDrive | None = field(default=None)
    """Settings of the drive on CANopen; None: the rig has none."""
    ati_can: AtiCan | None = field(default=None)
    """Settings of the sensor on CAN; None: the rig has none."""
    ati_serial: AtiSerial | None = field(default=None)
    """Settings of the sensor on a serial line; None: the rig has none."""
    added_settings: tuple[object, ...] = ()
    """Settings of devices that installed packages add, each of the type that its kind declares."""

    def settings_of(self, settings_type: type[T]) -> T:
        """Return the settings of a device that an installed package adds.

        Parameters
        ----------
        settings_type
            Dataclass that the device's kind declares as `settings`.

        Raises
        ------
        LookupError
            If the profile does not have the section.
        """
        for settings in self.added_settings:
            if isinstance(settings, settings_type):
                return settings
        raise LookupError(f"The profile has no section for {settings_type.__name__}.")
