"""Schema of a profile: its sections, and the settings that no other module declares."""

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
    Encoder,
    Motor,
    RigParameters,
    Selection,
    ServoDrive,
    Simulation,
    WrenchSensor,
)
from rigd.errors import UserError
from rigd.safety.limits import Limits


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Settings around a record: taring before it, the way back and the check after it."""

    tare_s: Annotated[float, Ge(0.5), Le(60)]
    """Time at rest over which the sensor is averaged."""
    rest_velocity_rad_s: Annotated[float, Gt(0)]
    """Mean speed over the tare up to which the rig counts as resting."""
    rest_torque_nm: Annotated[float, Gt(0)]
    """Standard deviation of the coupling torque over the tare up to which the beam counts as
    resting; more than the sensor's noise alone."""
    rest_timeout_s: Annotated[float, Ge(0), Le(3600)]
    """How long a session waits for rest before it refuses to start."""
    tare_drift_nm: Annotated[float, Gt(0)]
    """Change of the coupling torque's zero over a session above which a warning is given."""
    return_s: Annotated[float, Gt(0), Le(60)]
    """Time of the smooth return to the start angle."""


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """What the processes of a rig ask of the operating system, where it is granted."""

    priority: Annotated[int, Ge(0), Le(99)]
    """SCHED_FIFO priority of the control process; 0 leaves all to the ordinary scheduler."""
    cpu: Annotated[int, Ge(-1)]
    """Core the process is bound to; -1 takes the last one it may use."""
    spin_us: Annotated[float, Ge(0), Le(200)]
    """Last part of each wait that is spent polling the clock instead of sleeping."""
    late_us: Annotated[float, Gt(0)]
    """Lateness above which a tick is flagged as late."""

    @property
    def supervision_priority(self) -> int:
        """SCHED_RR priority of supervisor and recorder: a quarter of the loop's.

        That is before every ordinary program, and behind the loop and the kernel's own threads (50
        for interrupts on a real-time kernel).
        """
        return self.priority // 4


_RelativePercent = Annotated[float, Ge(0), Le(50)]


@dataclass(frozen=True, slots=True)
class ScaleUncertainty:
    """Relative standard uncertainties (k = 1) of what all sessions of a rig have in common.

    They do not average out, and no session shows them: an analysis adds them to its statistical
    intervals. Zero: not stated, except for the uniformity, where zero is a uniform beam.
    """

    torque_scale_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Scale of the torque over the angle: calibration and mounting of the sensor."""
    length_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Length of the beam."""
    density_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Mass per length of the beam, such as from weighing it."""
    tip_mass_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Mass at the tip of the beam: the balance."""
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
    """Names of what a session must be given: metadata, ``operator``, ``specimen`` or ``note``."""


@dataclass(frozen=True, slots=True)
class RigSection:
    """Settings of the rig as a whole."""

    rate_hz: Annotated[float, Ge(100), Le(20_000)]
    """Slower loops check the other processes too seldom."""
    axis_tilt_deg: Annotated[float, Ge(-90), Le(90)] | None = field(default=None, metadata=OPTIONAL)
    """Inclination of the plane of motion along the beam at rest, positive where the tip is lower
    than the motor's axis: gravity acts along the beam with its sine; None: not measured."""


@dataclass(frozen=True, slots=True)
class BeamSection(Beam):
    """Section of the beam: the uniform beam, and what was weighed at its tip."""

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
    "sensor": WrenchSensor,
    "actuation": Actuation,
    "control": ControlSettings,
    "limits": Limits,
    "session": SessionSettings,
    "realtime": RealtimeSettings,
    "metadata": MetadataSettings,
    "devices": Selection,
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
"""The sections that a device of ``[devices]`` needs and that no other rig needs to have."""
OPTIONAL_SECTIONS = tuple(dict.fromkeys(name for names in WIRING.values() for name in names))
TEXTS = ("name", "description")
SOURCES = ("paper", "datasheet", "measured", "assumed")
UNKNOWN = "unknown"
"""Source of what has no value yet: in the parameters it is NaN (see `MAY_BE_UNKNOWN`)."""


@cache
def keys() -> dict[str, Any]:
    """Every key of a profile, dotted, and the annotated type of its value.

    A profile must have them all but those of :func:`defaults`.
    """
    types: dict[str, Any] = dict.fromkeys(TEXTS, Annotated[str, MinLen(1)])
    for section, cls in SECTIONS.items():
        hints = get_type_hints(cls, include_extras=True)
        types |= {key: hints[field] for key, field in fields_of(section)}
    return types


@cache
def defaults() -> dict[str, Any]:
    """Keys that a profile may leave out, and what holds then.

    Other defaults of the dataclasses do not count: a delay that nobody states is not known to be
    zero.
    """
    return {
        f"{section}.{each.name}": each.default
        for section, cls in SECTIONS.items()
        for each in fields(cls)
        if each.metadata.get("optional") and each.default is not MISSING
    }


def is_number(annotation: Any) -> bool:  # noqa: ANN401
    """Whether a key of this type takes a number, or six, which have a source; no text has one."""
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) is tuple:
        return str not in get_args(annotation)
    return annotation not in (str, bool) and get_origin(annotation) is not Literal


def fields_of(section: str) -> list[tuple[str, str]]:
    """Pairs of dotted key and field of a section's dataclass."""
    # A trailing underscore only keeps a field's name off a Python keyword.
    names = [field.name for field in fields(SECTIONS[section])]
    return [(f"{section}.{name.rstrip('_')}", name) for name in names]


@dataclass(frozen=True, slots=True)
class Specimen:
    """One specimen, as its own file describes it."""

    name: str
    """Name of the file without ``.toml``, by which sessions name the specimen."""
    path: Path
    """The file."""
    text: str
    """The file as read, for the session that uses it."""
    beam: Beam
    """Its beam."""
    damping: Damping | None
    """Its nominal damping; None: that of the profile."""
    uncertainty: ScaleUncertainty
    """How well its length and density are known; the torque's scale is the rig's."""
    note: str
    """Whatever else is to be known of it."""
    tip_mass_kg: float | None = None
    """Point mass at its tip; None: not known."""


_BREAKAWAY = 5.0
"""Breakaway torque over the Coulomb friction stated: a cold gear has several times its friction."""
_LEAST_BREAKAWAY = 0.05
"""The least of it, as a fraction of the peak torque."""


class UnknownValueError(UserError):
    """A profile states values as unknown without which nothing can be computed or moved."""


@dataclass(frozen=True, slots=True)
class Profile:
    """One rig, as its profile describes it."""

    name: str
    """Name of the rig."""
    description: str
    """One line on it."""
    path: Path
    """The file."""
    text: str
    """The file as read, for the session that uses it."""
    rig: RigParameters
    """Parameters that its drivers need."""
    control: ControlSettings
    """Settings of the controller."""
    limits: Limits
    """Levels that end a session."""
    session: SessionSettings
    """Settings around a record."""
    realtime: RealtimeSettings
    """What its processes ask of the operating system."""
    metadata: MetadataSettings
    """What its sessions must be given."""
    uncertainty: ScaleUncertainty
    """How well the scales are known that no session shows."""
    sources: Mapping[str, str]
    """Where each number comes from: ``sources["motor.inertia_kg_m2"] == "assumed"``."""
    design_motor: Motor | None = None
    """The motor that the controller is designed for, where that is not the profile's."""
    tip_mass_kg: float | None = None
    """Point mass at the beam's tip, as weighed; None: not known."""
    axis_tilt_deg: float | None = None
    """Inclination of the plane of motion along the beam at rest, positive where the tip is lower;
    None: not measured."""
    specimen: Specimen | None = None
    """Specimen that is mounted, where a file describes it: the rig's beam is its own then."""
    specimen_in_words: str = ""
    """The same for the operator, with what is otherwise than the profile has it."""

    @property
    def standstill_torque_nm(self) -> float:
        """Net torque that no friction of the shaft withstands."""
        motor, stated_nm = self.rig.motor, self.limits.standstill_torque_nm
        return stated_nm or max(
            _BREAKAWAY * motor.coulomb_nm, _LEAST_BREAKAWAY * motor.peak_torque_nm
        )

    @property
    def control_motor(self) -> Motor:
        """The motor as the controller takes it."""
        return self.design_motor or self.rig.motor

    def loop_model(self) -> LoopModel:
        """Return what the closed loop's design and prediction need to know of this rig.

        Raises
        ------
        UnknownValueError
            If a value of the profile is unknown: each is named, with the place to find it.
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
