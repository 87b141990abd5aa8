"""Schema of a profile: its sections, and settings that no other module declares."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, MinLen

from rigd.beam import Beam, Damping
from rigd.control import ControlSettings, LoopModel
from rigd.devices import describe_unknown_values
from rigd.devices.parameters import (
    OPTIONAL,
    Acquisition,
    Actuation,
    AtiCan,
    AtiSerial,
    CanBus,
    DeviceSelection,
    Encoder,
    Motor,
    RigParameters,
    ServoDrive,
    Simulation,
    WrenchSensorSettings,
)
from rigd.errors import UserError
from rigd.safety.limits import Limits


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Settings before and after a record: tare, return and final check."""

    tare_s: Annotated[float, Ge(0.5), Le(60)]
    """Averaging time of the sensor at rest."""
    rest_velocity_rad_s: Annotated[float, Gt(0)]
    """Largest mean speed during the tare of a rig at rest."""
    rest_torque_nm: Annotated[float, Gt(0)]
    """Largest standard deviation of the coupling torque during the tare of a beam at rest; above
    the noise of the sensor."""
    rest_timeout_s: Annotated[float, Ge(0), Le(3600)]
    """Longest wait for rest before a session refuses to start."""
    tare_drift_nm: Annotated[float, Gt(0)]
    """Drift of the coupling torque's zero during a session above which a warning is given."""
    return_s: Annotated[float, Gt(0), Le(60)]
    """Duration of the smooth return to the start angle."""


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """Real-time settings that the processes of a rig request from the operating system."""

    priority: Annotated[int, Ge(0), Le(99)]
    """SCHED_FIFO priority of the control process; 0: ordinary scheduling."""
    cpu: Annotated[int, Ge(-1)]
    """Core of the control process; -1: the last permitted core."""
    spin_us: Annotated[float, Ge(0), Le(200)]
    """Last part of each wait, spent polling the clock instead of sleeping."""
    late_us: Annotated[float, Gt(0)]
    """Lateness above which a tick is flagged as late."""

    @property
    def supervision_priority(self) -> int:
        """SCHED_RR priority of supervisor and recorder: a quarter of the loop's.

        This is above every ordinary program, and below the loop and the kernel threads (50 for
        interrupts on a real-time kernel).
        """
        return self.priority // 4


_RelativePercent = Annotated[float, Ge(0), Le(50)]


@dataclass(frozen=True, slots=True)
class ScaleUncertainty:
    """Relative standard uncertainties (k = 1) that are common to all sessions of a rig.

    They do not average out and are not observable in a session, so an analysis adds them to its
    statistical intervals. Zero means not stated, except for the uniformity, where it means a
    uniform beam.
    """

    torque_scale_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Scale of the torque relative to the angle: calibration and mounting of the sensor."""
    length_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Length of the beam."""
    density_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Mass per length of the beam, for example from weighing."""
    tip_mass_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Mass at the tip of the beam, from the balance."""
    uniformity_percent: Annotated[float, Ge(0), Le(10)] = field(default=0.1, metadata=OPTIONAL)
    """Frequency of each mode relative to that of a uniform beam."""

    @property
    def stated(self) -> dict[str, float]:
        """Uncertainties that the profile states, by the names of the fields."""
        return {
            each.name: value
            for each in fields(self)
            if each.name != "uniformity_percent" and (value := getattr(self, each.name)) > 0
        }


@dataclass(frozen=True, slots=True)
class MetadataSettings:
    """Metadata of the sessions."""

    required: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """Required metadata of each session: their names, ``operator``, ``specimen`` or ``note``."""


@dataclass(frozen=True, slots=True)
class RigSection:
    """Settings of the rig as a whole."""

    rate_hz: Annotated[float, Ge(100), Le(20_000)]
    """Rate of the loop; slower loops would check the other processes too seldom."""
    axis_tilt_deg: Annotated[float, Ge(-90), Le(90)] | None = field(default=None, metadata=OPTIONAL)
    """Inclination of the plane of motion along the beam at rest, positive where the tip is lower
    than the motor's axis: gravity acts along the beam with its sine; None: not measured."""


@dataclass(frozen=True, slots=True)
class BeamSection(Beam):
    """Section of the beam: the uniform beam and the mass at its tip."""

    tip_mass_kg: Annotated[float, Ge(0)] | None = field(default=None, metadata=OPTIONAL)
    """Point mass at the tip; None: not known."""

    @property
    def uniform(self) -> Beam:
        """The beam alone."""
        return Beam(self.length_m, self.density_kg_per_m, self.bending_stiffness_n_m2)


SECTIONS: dict[str, type] = {
    "rig": RigSection,
    "beam": BeamSection,
    "beam.damping": Damping,
    "motor": Motor,
    "encoder": Encoder,
    "sensor": WrenchSensorSettings,
    "actuation": Actuation,
    "control": ControlSettings,
    "limits": Limits,
    "session": SessionSettings,
    "realtime": RealtimeSettings,
    "metadata": MetadataSettings,
    "devices": DeviceSelection,
    "can": CanBus,
    "acquisition": Acquisition,
    "cia402": ServoDrive,
    "ati_can": AtiCan,
    "ati_serial": AtiSerial,
    "simulation": Simulation,
    "uncertainty": ScaleUncertainty,
}
WIRING = {
    "cia402": ("can", "acquisition", "cia402"),
    "ati_can": ("can", "acquisition", "ati_can"),
    "ati_serial": ("acquisition", "ati_serial"),
    "sim": ("simulation",),
}
"""Sections that are required only by certain devices of ``[devices]``."""
OPTIONAL_SECTIONS = tuple(dict.fromkeys(name for names in WIRING.values() for name in names))
TEXTS = ("name", "description")
SOURCES = ("paper", "datasheet", "measured", "assumed")
UNKNOWN = "unknown"
"""Source of a number without a value, which is NaN in the parameters (see `MAY_BE_UNKNOWN`)."""


@cache
def keys() -> dict[str, Any]:
    """Return all dotted keys of a profile with the annotated types of their values.

    A profile must have all keys except those of :func:`defaults`.
    """
    types: dict[str, Any] = dict.fromkeys(TEXTS, Annotated[str, MinLen(1)])
    for section, cls in SECTIONS.items():
        hints = get_type_hints(cls, include_extras=True)
        types |= {key: hints[field] for key, field in fields_of(section)}
    return types


@cache
def defaults() -> dict[str, Any]:
    """Return the optional keys of a profile with their default values.

    Other defaults of the dataclasses are not used: for example, a delay that is not stated is
    unknown and not zero.
    """
    return {
        f"{section}.{each.name}": each.default
        for section, cls in SECTIONS.items()
        for each in fields(cls)
        if each.metadata.get("optional") and each.default is not MISSING
    }


def is_number(annotation: Any) -> bool:  # noqa: ANN401
    """Return whether a value of this type is a number or six numbers, which need a source."""
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) is tuple:
        return str not in get_args(annotation)
    return annotation not in (str, bool) and get_origin(annotation) is not Literal


def fields_of(section: str) -> list[tuple[str, str]]:
    """Return pairs of dotted key and field of a section's dataclass."""
    # A trailing underscore distinguishes the name of a field from a Python keyword.
    names = [field.name for field in fields(SECTIONS[section])]
    return [(f"{section}.{name.rstrip('_')}", name) for name in names]


@dataclass(frozen=True, slots=True)
class Specimen:
    """A specimen with its own file."""

    name: str
    """File name without ``.toml``, which is the name of the specimen in sessions."""
    path: Path
    """The file."""
    text: str
    """Content of the file."""
    beam: Beam
    """Beam of the specimen."""
    damping: Damping | None
    """Nominal damping; None: that of the profile."""
    uncertainty: ScaleUncertainty
    """Uncertainties of length and density; that of the torque scale belongs to the rig."""
    note: str
    """Free text."""
    tip_mass_kg: float | None = None
    """Point mass at the tip; None: not known."""


_BREAKAWAY = 5.0
"""Assumed ratio of breakaway torque to the stated Coulomb friction, for a cold gear."""
_LEAST_BREAKAWAY = 0.05
"""Smallest breakaway torque, as a fraction of the peak torque."""


class UnknownValueError(UserError):
    """The profile states a required value as unknown."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Validated profile of a rig."""

    name: str
    """Name of the rig."""
    description: str
    """Description in one line."""
    path: Path
    """The file."""
    text: str
    """Content of the file."""
    rig: RigParameters
    """Parameters of the rig and its drivers."""
    control: ControlSettings
    """Settings of the controller."""
    limits: Limits
    """Limits that end a session."""
    session: SessionSettings
    """Settings before and after a record."""
    realtime: RealtimeSettings
    """Real-time settings of the processes."""
    metadata: MetadataSettings
    """Required metadata of the sessions."""
    uncertainty: ScaleUncertainty
    """Uncertainties of the scales that are not observable in a session."""
    sources: Mapping[str, str]
    """Where each number comes from: ``sources["motor.inertia_kg_m2"] == "assumed"``."""
    design_motor: Motor | None = None
    """Motor for the design of the controller, if it differs from that of the rig."""
    tip_mass_kg: float | None = None
    """Measured point mass at the tip of the beam; None: not known."""
    axis_tilt_deg: float | None = None
    """Inclination of the plane of motion along the beam at rest, positive where the tip is lower;
    None: not measured."""
    specimen: Specimen | None = None
    """Mounted specimen with its own file, whose beam is then that of the rig; else None."""
    specimen_in_words: str = ""
    """Description of the specimen and its differences from the profile, for the operator."""

    @property
    def standstill_torque_nm(self) -> float:
        """Net torque above the largest friction of the shaft."""
        motor, stated_nm = self.rig.motor, self.limits.standstill_torque_nm
        return stated_nm or max(
            _BREAKAWAY * motor.coulomb_nm, _LEAST_BREAKAWAY * motor.peak_torque_nm
        )

    @property
    def control_motor(self) -> Motor:
        """Motor for the design of the controller."""
        return self.design_motor or self.rig.motor

    def loop_model(self) -> LoopModel:
        """Return the loop model of this rig, for the design and prediction of the closed loop.

        Raises
        ------
        UnknownValueError
            If values of the profile are unknown: names each one and where to find it.
        """
        rig = self.rig
        if unknown := describe_unknown_values(rig):
            raise UnknownValueError(
                "\n".join(f"{self.path}: {line}" for line in unknown.splitlines())
            )
        return LoopModel(
            rate_hz=rig.rate_hz,
            beam=rig.beam,
            damping=rig.damping,
            motor_inertia_kg_m2=self.control_motor.inertia_kg_m2,
            viscous_nm_s_per_rad=self.control_motor.viscous_nm_s_per_rad,
            tool_inertia_kg_m2=rig.sensor.tool_inertia_kg_m2,
            actuation_delay_s=rig.actuation.delay_s,
            angle_delay_s=rig.encoder.delay_s,
            torque_delay_s=rig.sensor.delay_s,
            settings=self.control,
            tip_mass_kg=self.tip_mass_kg or 0.0,
        )
