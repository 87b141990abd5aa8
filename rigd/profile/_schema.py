"""Schema of a profile: sections, keys and sources, and the settings that this module declares."""

import json
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from annotated_types import DocInfo, Ge, Gt, Le, MinLen

from rigd.beam import Beam, Damping, Plant
from rigd.control import SHIPPED_CONTROLLER, ControlSettings, LoopModel
from rigd.control.declaration import ControlledRig, ControllerKind
from rigd.control.kinds import CONTROLLERS, linear_controller
from rigd.devices import describe_unknown_values
from rigd.devices.declaration import DeviceKind
from rigd.devices.kinds import DEVICES
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
from rigd.plugins import Plugin
from rigd.safety.limits import Limits
from rigd.units import unit_of


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Settings of a session's tare, return and final check, before and after its record."""

    tare_s: Annotated[float, Ge(0.5), Le(60)]
    """Time for which the sensor is averaged at rest."""
    rest_velocity_rad_s: Annotated[float, Gt(0)]
    """Largest mean speed during the tare at which the rig counts as at rest."""
    rest_torque_nm: Annotated[float, Gt(0)]
    """Largest standard deviation of the coupling torque at which the beam counts as at rest.

    It must be above the noise of the sensor."""
    rest_timeout_s: Annotated[float, Ge(0), Le(3600)]
    """Longest time that a session waits for rest before it refuses to start."""
    tare_drift_nm: Annotated[float, Gt(0)]
    """Drift of the coupling torque's zero during a session above which there is a warning."""
    return_s: Annotated[float, Gt(0), Le(60)]
    """Duration of the smooth return to the start angle."""


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """Real-time settings that the rig's processes request from the operating system."""

    priority: Annotated[int, Ge(0), Le(99)]
    """SCHED_FIFO priority of the control process, or 0 for ordinary scheduling."""
    cpu: Annotated[int, Ge(-1)]
    """Number of the processor core for the control process, or -1 for the last permitted core."""
    spin_us: Annotated[float, Ge(0), Le(200)]
    """Time at the end of each wait in which the loop polls the clock instead of sleeping."""
    late_us: Annotated[float, Gt(0)]
    """Lateness above which a tick is flagged as late."""

    @property
    def supervision_priority(self) -> int:
        """SCHED_RR priority of supervisor and recorder, a quarter of the loop's priority.

        This is above every ordinary program, and below the loop and the kernel threads (50 for
        interrupts on a real-time kernel).
        """
        return self.priority // 4


_RelativePercent = Annotated[float, Ge(0), Le(50)]


@dataclass(frozen=True, slots=True)
class ScaleUncertainty:
    """Relative standard uncertainties (k = 1) of scales that all sessions of a rig have in common.

    They do not average out and are not observable in a session, so an analysis adds them to its
    statistical intervals. Zero means that the uncertainty is not stated; for the uniformity it
    means a uniform beam.
    """

    torque_scale_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Uncertainty of the torque's scale, from calibration and mounting of the sensor."""
    length_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Uncertainty of the beam's length."""
    density_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Uncertainty of the beam's mass per length, for example from weighing."""
    tip_mass_percent: _RelativePercent = field(default=0.0, metadata=OPTIONAL)
    """Uncertainty of the mass at the beam's tip, from the balance."""
    uniformity_percent: Annotated[float, Ge(0), Le(10)] = field(default=0.1, metadata=OPTIONAL)
    """Standard deviation of each mode's frequency relative to that of a uniform beam."""

    @property
    def nonzero_percent_by_field(self) -> dict[str, float]:
        """Uncertainties in per cent that are not zero, by field name, without the uniformity."""
        return {
            scale_field.name: percent
            for scale_field in fields(self)
            if scale_field.name != "uniformity_percent"
            and (percent := getattr(self, scale_field.name)) > 0
        }


@dataclass(frozen=True, slots=True)
class MetadataSettings:
    """Metadata that the sessions of a rig must have."""

    required: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    """Names of metadata required for each session; also ``operator``, ``specimen`` or ``note``."""


@dataclass(frozen=True, slots=True)
class RigSection:
    """Settings of the rig as a whole."""

    rate_hz: Annotated[float, Ge(100), Le(20_000)]
    """Rate of the loop; slower loops would check the other processes too seldom."""
    axis_tilt_deg: Annotated[float, Ge(-90), Le(90)] | None = field(default=None, metadata=OPTIONAL)
    """Angle between the horizontal and the resting beam, or None if it was not measured.

    Its sine is (height of the root - height of the tip) / length: positive if the tip is lower."""


@dataclass(frozen=True, slots=True)
class BeamSection(Beam):
    """Section ``[beam]`` of a profile: the uniform beam and the mass at its tip."""

    tip_mass_kg: Annotated[float, Ge(0)] | None = field(default=None, metadata=OPTIONAL)
    """Point mass at the beam's tip, or None if it is unknown."""

    @property
    def uniform_beam(self) -> Beam:
        """Uniform beam without the tip mass."""
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
"""Map from a section's name to the dataclass of its keys."""
_GROUP_BY_ADDED_SECTION: dict[str, str] = {}
"""Map from each section that a part of an installed package has added, to the part's group."""


def optional_sections() -> tuple[str, ...]:
    """Return the names of the sections that only some devices or controllers require."""
    built_in_sections = [
        name for kind in DEVICES.built_in_parts.values() for name in kind.required_sections
    ]
    return tuple(dict.fromkeys([*built_in_sections, *sorted(_GROUP_BY_ADDED_SECTION)]))


def add_section(kind: DeviceKind | ControllerKind, plugin: Plugin) -> None:
    """Add the section of a part of an installed package to the sections of a profile.

    Nothing changes if it was added before. Raise `PluginError` if the declaration of its settings
    is invalid, or if the section is one of rigd's own or of another part.
    """
    settings_class = kind.settings
    if settings_class is None or SECTIONS.get(kind.name) is settings_class:
        return
    if kind.name in SECTIONS and _GROUP_BY_ADDED_SECTION.get(kind.name) != plugin.group:
        owner_text = (
            "another package's part" if kind.name in _GROUP_BY_ADDED_SECTION else "every profile"
        )
        raise plugin.error(
            f"[{kind.name}] is a section of {owner_text}; rename the {plugin.part_noun}."
        )
    if problem := _settings_problem(settings_class):
        raise plugin.error(f"its settings {settings_class.__name__} are invalid: {problem}")
    if unknown := set(kind.required_sections) - {kind.name} - set(SECTIONS):
        raise plugin.error(f"it requires the unknown section [{min(unknown)}].")
    SECTIONS[kind.name] = settings_class
    _GROUP_BY_ADDED_SECTION[kind.name] = plugin.group
    key_types.cache_clear()
    key_defaults.cache_clear()


def _settings_problem(settings_class: type) -> str:
    """Return the reason why a class cannot declare a section of a profile, or ""."""
    dataclass_parameters = getattr(settings_class, "__dataclass_params__", None)
    if dataclass_parameters is None or not dataclass_parameters.frozen:
        return "they are not a frozen dataclass; declare them with @dataclass(frozen=True)."
    # Late: the processes of a session, which get a loaded profile, do not need it.
    from pydantic import ConfigDict, TypeAdapter, ValidationError

    try:
        for key, value_type in get_type_hints(settings_class, include_extras=True).items():
            default_value = next(
                (f.default for f in fields(settings_class) if f.name == key), MISSING
            )
            # Also builds the validator, which finds types and ranges that cannot be checked.
            validator = TypeAdapter(value_type, config=ConfigDict(strict=True))
            if default_value is not MISSING:
                validator.validate_python(default_value)
    except ValidationError as error:
        return f"the default of {key} is not in its range ({error.errors()[0]['msg']})."
    except Exception as error:  # whatever a foreign declaration causes
        return f"{type(error).__name__}: {error}"
    return ""


def check_part_plugin(plugin: Plugin) -> str:
    """Import the device or controller that an installed package adds, and return its summary.

    Raises
    ------
    PluginError
        If it cannot be used.
    """
    is_device = plugin.group == DEVICES.group
    kind = DEVICES.load(plugin) if is_device else CONTROLLERS.load(plugin)
    add_section(kind, plugin)
    return kind.summary


TEXT_KEYS = ("name", "description")
"""Keys outside any section, whose values are texts."""
NUMBER_SOURCES = ("paper", "datasheet", "measured", "assumed")
"""Valid sources of a number in a profile."""
UNKNOWN_SOURCE = "unknown"
"""Source of a number without a value, which is NaN in the parameters (see `MAY_BE_UNKNOWN`)."""


def section_text(kind: DeviceKind | ControllerKind) -> str:
    """Return a section of a profile for a kind of part, with ranges, units and help as comments.

    Parameters
    ----------
    kind
        Kind of device or controller; without settings, the text is empty.
    """
    if kind.settings is None:
        return ""
    section_lines = [f"[{kind.name}]"]
    type_hint_by_field = get_type_hints(kind.settings, include_extras=True)
    for settings_field in fields(kind.settings):
        field_type = type_hint_by_field[settings_field.name]
        annotations = get_args(field_type)[1:] if get_origin(field_type) is Annotated else ()
        type_without_annotations = get_args(field_type)[0] if annotations else field_type
        help_texts = [each.documentation for each in annotations if isinstance(each, DocInfo)]
        if get_origin(type_without_annotations) is Literal:
            help_texts.append("one of " + ", ".join(map(str, get_args(type_without_annotations))))
        for each in annotations:
            for bound_name, bound_words in _BOUND_WORDS_BY_ATTRIBUTE.items():
                if (bound := getattr(each, bound_name, None)) is not None:
                    help_texts.append(f"{bound_words} {bound}")
        if unit := unit_of(settings_field.name):
            help_texts.append(f"in {unit}")
        if help_texts:
            section_lines.append(f"# {'; '.join(help_texts)}")
        is_optional = settings_field.default is not MISSING
        if is_optional:
            value_text = json.dumps(settings_field.default, ensure_ascii=False)
        else:
            value_text = "…" if is_number_type(field_type) else '"…"'
        entry_text = (
            f'{{ value = {value_text}, source = "assumed" }}'
            if is_number_type(field_type)
            else value_text
        )
        section_lines.append(f"{'# ' if is_optional else ''}{settings_field.name} = {entry_text}")
    return "\n".join(section_lines) + "\n"


_BOUND_WORDS_BY_ATTRIBUTE = {
    "gt": "more than",
    "ge": "at least",
    "lt": "less than",
    "le": "at most",
}
"""Words for the bounds of a range, by the attributes of ``annotated_types``."""


@cache
def key_types() -> dict[str, Any]:
    """Return the type of each key's value, by the dotted keys of a profile.

    A profile must have all keys except those of :func:`key_defaults`.
    """
    type_by_key: dict[str, Any] = dict.fromkeys(TEXT_KEYS, Annotated[str, MinLen(1)])
    for section_name, section_class in SECTIONS.items():
        type_hint_by_field = get_type_hints(section_class, include_extras=True)
        type_by_key |= {
            key: type_hint_by_field[field_name] for key, field_name in section_fields(section_name)
        }
    return type_by_key


@cache
def key_defaults() -> dict[str, Any]:
    """Return the default value of each optional key, by the dotted keys of a profile.

    Other defaults of rigd's own dataclasses are not used: for example, a delay that is not stated
    is unknown and not zero.
    """
    return {
        f"{section_name}.{dataclass_field.name}": dataclass_field.default
        for section_name, section_class in SECTIONS.items()
        for dataclass_field in fields(section_class)
        if dataclass_field.default is not MISSING
        and (dataclass_field.metadata.get("optional") or section_name in _GROUP_BY_ADDED_SECTION)
    }


def is_number_type(value_type: Any) -> bool:  # noqa: ANN401
    """Return whether values of a type are numbers, alone or as a tuple, which need a source."""
    if get_origin(value_type) is Annotated:
        value_type = get_args(value_type)[0]
    if get_origin(value_type) is tuple:
        return str not in get_args(value_type)
    return value_type not in (str, bool) and get_origin(value_type) is not Literal


def section_fields(section_name: str) -> list[tuple[str, str]]:
    """Return each dotted key of a section with the name of its dataclass field."""
    # A trailing underscore distinguishes the name of a field from a Python keyword.
    field_names = [dataclass_field.name for dataclass_field in fields(SECTIONS[section_name])]
    return [(f"{section_name}.{field_name.rstrip('_')}", field_name) for field_name in field_names]


@dataclass(frozen=True, slots=True)
class Specimen:
    """Specimen that is described by its own file."""

    name: str
    """File name without ``.toml``, which is the name of the specimen in sessions."""
    path: Path
    """Path of the specimen's file."""
    text: str
    """Content of the specimen's file."""
    beam: Beam
    """Uniform beam of the specimen."""
    damping: Damping | None
    """Nominal damping of the specimen, or None if that of the profile applies."""
    uncertainty: ScaleUncertainty
    """Uncertainties of the specimen's length and density, without the rig's torque scale."""
    note: str
    """Free text on the specimen."""
    tip_mass_kg: float | None = None
    """Point mass at the specimen's tip, or None if it is unknown."""


_BREAKAWAY_TO_COULOMB_RATIO = 5.0
"""Assumed ratio of breakaway torque to the stated Coulomb friction, for a cold gear."""
_MIN_BREAKAWAY_FRACTION = 0.05
"""Smallest breakaway torque, as a fraction of the peak torque."""


class UnknownValueError(UserError):
    """Error if the profile states a value as unknown that is needed."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Validated profile of a rig: all its parameters and settings."""

    name: str
    """Name of the rig."""
    description: str
    """Description of the rig in one line."""
    path: Path
    """Path of the profile's file."""
    text: str
    """Content of the profile's file."""
    rig: RigParameters
    """Parameters of the rig and its drivers."""
    control: ControlSettings
    """Settings of the controller."""
    limits: Limits
    """Limits that end a session."""
    session: SessionSettings
    """Settings of a session's tare, return and final check."""
    realtime: RealtimeSettings
    """Real-time settings of the processes."""
    metadata: MetadataSettings
    """Required metadata of the sessions."""
    uncertainty: ScaleUncertainty
    """Uncertainties of the scales that are not observable in a session."""
    sources: Mapping[str, str]
    """Source of each number by its dotted key: ``sources["motor.inertia_kg_m2"] == "assumed"``."""
    design_motor: Motor | None = None
    """Motor for which the controller is designed, or None if it is the motor of the rig."""
    tip_mass_kg: float | None = None
    """Measured point mass at the beam's tip, or None if it is unknown."""
    axis_tilt_deg: float | None = None
    """Angle between the horizontal and the resting beam, or None if it was not measured.

    It is positive if the tip is lower than the motor's axis."""
    controller_settings: object | None = None
    """Values of the section of the controller that a package adds, or None if it has no section."""
    specimen: Specimen | None = None
    """Mounted specimen whose file has replaced the profile's beam, or None."""
    specimen_in_words: str = ""
    """Sentence for the operator on the specimen and its differences from the profile."""

    @property
    def standstill_torque_nm(self) -> float:
        """Net torque in N·m on the shaft that exceeds its largest friction."""
        rig_motor, stated_nm = self.rig.motor, self.limits.standstill_torque_nm
        return stated_nm or max(
            _BREAKAWAY_TO_COULOMB_RATIO * rig_motor.coulomb_nm,
            _MIN_BREAKAWAY_FRACTION * rig_motor.peak_torque_nm,
        )

    @property
    def control_motor(self) -> Motor:
        """Motor for which the controller is designed."""
        return self.design_motor or self.rig.motor

    @property
    def plant(self) -> Plant:
        """Beam and torque channel as the profile states them."""
        rig = self.rig
        return Plant(
            rig.beam,
            rig.damping,
            delay_s=rig.sensor.delay_s - rig.encoder.delay_s,
            tool_inertia_kg_m2=rig.sensor.tool_inertia_kg_m2,
            tip_mass_kg=self.tip_mass_kg or 0.0,
        )

    @property
    def is_loop_modelled(self) -> bool:
        """Whether the model of the closed loop contains the rig's controller, not the PID instead.

        The PID replaces a controller of a package that states no matrices.
        """
        controller_name = self.control.controller
        controller_kind = (
            None if controller_name == SHIPPED_CONTROLLER else CONTROLLERS.get(controller_name)
        )
        return controller_kind is None or controller_kind.linear is not None

    def loop_model(self) -> LoopModel:
        """Return the model of this rig's closed loop, for its design and prediction.

        A controller without matrices is replaced by the PID (see `is_loop_modelled`).

        Raises
        ------
        UnknownValueError
            If values of the profile are unknown; the message names each one and where to find it.
        PluginError
            If the package that adds the controller cannot be used.
        """
        rig = self.controlled_rig()
        controller = linear_controller(rig)
        if controller is None:
            return rig.loop
        controller_kind = CONTROLLERS.get(self.control.controller)
        return replace(
            rig.loop,
            controller=controller,
            shifts_reference=controller_kind is not None and controller_kind.shifts_reference,
        )

    def controlled_rig(self) -> ControlledRig:
        """Return the rig for which the controller is made.

        Raises
        ------
        UnknownValueError
            If values of the profile are unknown; the message names each one and where to find it.
        """
        rig = self.rig
        if unknown_keys := describe_unknown_values(rig):
            raise UnknownValueError(
                "\n".join(
                    f"{self.path}: {message_line}" for message_line in unknown_keys.splitlines()
                )
            )
        loop = LoopModel(
            rate_hz=rig.rate_hz,
            plant=self.plant,
            motor_inertia_kg_m2=self.control_motor.inertia_kg_m2,
            viscous_nm_s_per_rad=self.control_motor.viscous_nm_s_per_rad,
            actuation_delay_s=rig.actuation.delay_s,
            angle_delay_s=rig.encoder.delay_s,
            torque_delay_s=rig.sensor.delay_s,
            settings=self.control,
        )
        return ControlledRig(loop, self.control_motor.peak_torque_nm, self.controller_settings)
