"""A rig's profile: one TOML file, read and validated into frozen dataclasses.

Every number stands as ``{ value = 2.0e-3, source = "assumed" }``, with its unit in the key, so
that nobody takes an assumed number for a measured one. Ranges are declared where the number is
used (``annotated_types`` on the dataclasses) and enforced here. All problems of a file are
reported at once.
"""

import difflib
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from annotated_types import Ge, Gt, Le, MinLen
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from pydantic_core import ErrorDetails

from rigd.beam import Beam, Damping
from rigd.control import ControlDesignError, ControlSettings, LoopModel, design_pid
from rigd.devices.parameters import (
    Actuation,
    Encoder,
    Motor,
    RigParameters,
    Selection,
    Simulation,
    WrenchSensor,
)
from rigd.safety import Limits

SOURCES = ("paper", "datasheet", "measured", "assumed")


class ProfileError(ValueError):
    """A profile cannot be used; the message has one line a problem, each with its remedy."""


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """What happens round a record: taring before it, the way back and the check after it."""

    tare_s: Annotated[float, Ge(0.5), Le(60)]
    """Time at rest over which the sensor is averaged."""
    rest_velocity_rad_s: Annotated[float, Gt(0)]
    """Mean speed over the tare up to which the rig counts as resting."""
    tare_drift_nm: Annotated[float, Gt(0)]
    """Change of the coupling torque's zero over a session above which a warning is given."""
    return_s: Annotated[float, Gt(0), Le(60)]
    """Time of the smooth return to the start angle."""


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """What the control process asks of the operating system, where it is granted."""

    priority: Annotated[int, Ge(0), Le(99)]
    """SCHED_FIFO priority; 0 leaves the ordinary scheduler."""
    cpu: Annotated[int, Ge(-1)]
    """Core the process is bound to; -1 takes the last one it may use."""
    spin_us: Annotated[float, Ge(0), Le(200)]
    """Last part of each wait that is spent polling the clock instead of sleeping."""
    late_us: Annotated[float, Gt(0)]
    """Lateness above which a tick is flagged as late."""


@dataclass(frozen=True, slots=True)
class _RigSection:
    rate_hz: Annotated[float, Gt(0), Le(20_000)]


_SECTIONS: dict[str, type] = {
    "rig": _RigSection,
    "beam": Beam,
    "beam.damping": Damping,
    "motor": Motor,
    "encoder": Encoder,
    "sensor": WrenchSensor,
    "actuation": Actuation,
    "control": ControlSettings,
    "limits": Limits,
    "session": SessionSettings,
    "realtime": RealtimeSettings,
    "devices": Selection,
    "simulation": Simulation,
}
_OPTIONAL_SECTIONS = ("simulation",)
_TEXTS = ("name", "description")

# Longest endings first: the first that fits is the key's unit.
_UNITS = {
    "_nm_s_per_rad": "N·m·s/rad",
    "_kg_per_m": "kg/m",
    "_kg_m2": "kg·m²",
    "_n_m2": "N·m²",
    "_percent": "%",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_nm": "N·m",
    "_hz": "Hz",
    "_us": "µs",
    "_m": "m",
    "_n": "N",
    "_s": "s",
}
_UNITS_OF_SIX = {
    "sensor.resolution": "N, N, N, N·m, N·m, N·m",
    "sensor.range": "N, N, N, N·m, N·m, N·m",
    "sensor.projection": "1, 1, 1 (times m), 1, 1, 1",
    "simulation.offset": "N, N, N, N·m, N·m, N·m",
}


@dataclass(frozen=True, slots=True)
class Profile:
    """One rig, as its profile describes it."""

    name: str
    description: str
    path: Path
    text: str
    """The file as read, for the session that uses it."""
    rig: RigParameters
    control: ControlSettings
    limits: Limits
    session: SessionSettings
    realtime: RealtimeSettings
    sources: Mapping[str, str]
    """Where each number comes from: ``sources["motor.inertia_kg_m2"] == "assumed"``."""

    def loop_model(self) -> LoopModel:
        """Return what the closed loop's design and prediction need to know of this rig."""
        rig = self.rig
        return LoopModel(
            rate_hz=rig.rate_hz,
            beam=rig.beam,
            damping=rig.damping,
            motor_inertia_kg_m2=rig.motor.inertia_kg_m2,
            viscous_nm_s_per_rad=rig.motor.viscous_nm_s_per_rad,
            tool_inertia_kg_m2=rig.sensor.tool_inertia_kg_m2,
            actuation_delay_s=rig.actuation.delay_s,
            angle_delay_s=rig.encoder.delay_s,
            torque_delay_s=rig.sensor.delay_s,
            settings=self.control,
        )


def load_profile(name_or_path: str | Path) -> Profile:
    """Read and validate a profile.

    Parameters
    ----------
    name_or_path
        The name of a file in ``hw_profiles`` without its ``.toml`` (of the project's checkout, or
        of the working directory), or the path of a file.

    Returns
    -------
    Profile

    Raises
    ------
    ProfileError
        If there is no such file, or anything in it is wrong; every problem is named with its
        key, value, unit and remedy.
    """
    path = _find(name_or_path)
    try:
        text = path.read_bytes().decode("utf-8")
        document = tomllib.loads(text)
    except OSError as error:
        raise ProfileError(f"{path}: cannot be read ({error.strerror}).") from error
    except UnicodeDecodeError as error:
        raise ProfileError(f"{path}: is not a text file in UTF-8; save it as one.") from error
    except tomllib.TOMLDecodeError as error:
        raise ProfileError(f"{path}: is not valid TOML: {error}.") from error

    problems: list[str] = []
    values, sources = _flatten(document, problems)
    values = _validate(values, problems)
    if not problems:
        problems.extend(_contradictions(values))
    if problems:
        raise ProfileError("\n".join(f"{path}: {problem}" for problem in problems))

    section = {name: _build(name, values) for name in _SECTIONS if _present(name, document)}
    return Profile(
        name=values["name"],
        description=values["description"],
        path=path,
        text=text,
        rig=RigParameters(
            rate_hz=section["rig"].rate_hz,
            beam=section["beam"],
            damping=section["beam.damping"],
            motor=section["motor"],
            encoder=section["encoder"],
            sensor=section["sensor"],
            actuation=section["actuation"],
            devices=section["devices"],
            simulation=section.get("simulation"),
        ),
        control=section["control"],
        limits=section["limits"],
        session=section["session"],
        realtime=section["realtime"],
        sources=sources,
    )


def _find(name_or_path: str | Path) -> Path:
    given = Path(name_or_path)
    if given.suffix == ".toml" or given.parent != Path():
        if given.is_file():
            return given
        raise ProfileError(f"{given}: there is no such file; {_known_profiles()}.")
    for folder in _profile_folders():
        path = folder / f"{given}.toml"
        if path.is_file():
            return path
    raise ProfileError(
        f"There is no profile '{given}'; {_known_profiles()}, or give the path of a .toml file."
    )


def _profile_folders() -> tuple[Path, ...]:
    return Path(__file__).resolve().parents[1] / "hw_profiles", Path("hw_profiles")


def _known_profiles() -> str:
    names = sorted({path.stem for folder in _profile_folders() for path in folder.glob("*.toml")})
    return "known profiles are " + ", ".join(names) if names else "no profiles are known here"


def _flatten(
    document: Mapping[str, Any], problems: list[str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Take the document apart into dotted keys, and the sources off the numbers."""
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for key, entry in _entries(document, ""):
        if not isinstance(entry, dict):
            if isinstance(entry, str) or key not in _annotations():
                values[key] = entry
            else:
                problems.append(
                    f"{key} = {_show(entry)}{_unit(key)} does not say where it comes from; write "
                    f'{{ value = {_show(entry)}, source = "…" }} with {_choice(SOURCES)}.'
                )
                values[key] = entry
            continue
        values[key] = entry.get("value")
        source = entry.get("source")
        if source is None:
            problems.append(f"{key} has no source; add source = {_choice(SOURCES)}.")
        elif source not in SOURCES:
            problems.append(f"{key} has source = {_show(source)}; choose {_choice(SOURCES)}.")
        else:
            sources[key] = source
        problems.extend(
            f"{key} has the unknown part '{other}'; only value and source go there."
            for other in sorted(entry.keys() - {"value", "source"})
        )
    return values, sources


def _entries(table: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield dotted keys; a table that is no known section and has a value is a number."""
    for key, entry in table.items():
        dotted = prefix + key
        if isinstance(entry, dict) and (
            dotted in _SECTIONS or not entry.keys() & {"value", "source"}
        ):
            yield from _entries(entry, dotted + ".")
        else:
            yield dotted, entry


def _validate(values: Mapping[str, Any], problems: list[str]) -> dict[str, Any]:
    """Check types and ranges; returns the values with their defaults filled in."""
    # TOML knows only arrays, and strict validation wants tuples.
    given = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    absent = {
        name for name in _OPTIONAL_SECTIONS if not any(k.startswith(name + ".") for k in given)
    }
    try:
        model = _schema(frozenset(absent)).model_validate(given)
    except ValidationError as error:
        details = error.errors(include_url=False)
        missing = [str(d["loc"][0]) for d in details if d["type"] == "missing"]
        problems.extend(_missing(missing, given))
        for detail in details:
            if detail["type"] == "extra_forbidden":
                problems.append(_unknown(str(detail["loc"][0]), given))
            elif detail["type"] != "missing":
                problems.append(_wrong(detail))
        return given
    return model.model_dump(by_alias=True)


@cache
def _annotations() -> dict[str, tuple[Any, Any]]:
    """Dotted key → (annotation, default), of every key a profile may have."""
    keys: dict[str, tuple[Any, Any]] = {
        text: (Annotated[str, MinLen(1)], MISSING) for text in _TEXTS
    }
    for section, cls in _SECTIONS.items():
        hints = get_type_hints(cls, include_extras=True)
        for field in fields(cls):
            # A trailing underscore only keeps a field's name off a Python keyword.
            keys[f"{section}.{field.name.rstrip('_')}"] = (hints[field.name], field.default)
    return keys


@cache
def _schema(absent: frozenset[str]) -> type[BaseModel]:
    """One flat model for all keys: building one a section takes ten times as long."""
    definitions: dict[str, Any] = {}
    for index, (key, (annotation, default)) in enumerate(_annotations().items()):
        if key.partition(".")[0] not in absent:
            value = ... if default is MISSING else default
            definitions[f"key_{index}"] = (annotation, Field(value, alias=key))
    config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    return create_model("Profile", __config__=config, **definitions)


def _present(section: str, document: Mapping[str, Any]) -> bool:
    return section not in _OPTIONAL_SECTIONS or section in document


def _build(section: str, values: Mapping[str, Any]) -> Any:  # noqa: ANN401
    cls = _SECTIONS[section]
    return cls(
        **{field.name: values[f"{section}.{field.name.rstrip('_')}"] for field in fields(cls)}
    )


def _contradictions(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong between values that are each in range."""
    rated, peak = values["motor.rated_torque_nm"], values["motor.peak_torque_nm"]
    if peak < rated:
        yield (
            f"motor.peak_torque_nm = {peak:g} N·m is below motor.rated_torque_nm = {rated:g} N·m; "
            "the peak is at least the rated torque."
        )
    if not any(values["sensor.projection"]):
        yield "sensor.projection is all zero; give the row that makes motor torque of the wrench."
    try:
        design_pid(
            values["motor.inertia_kg_m2"],
            values["motor.viscous_nm_s_per_rad"],
            values["control.pole_rad_s"],
        )
    except ControlDesignError as error:
        yield str(error)
    simulated = "sim" in (values["devices.drive"], values["devices.sensor"])
    if simulated and "simulation.seed" not in values:
        yield "section [simulation] is missing, which the simulated devices of [devices] need."


def _missing(keys: list[str], given: Mapping[str, Any]) -> Iterator[str]:
    reported = set()
    for key in keys:
        section = key.rpartition(".")[0]
        if section and not any(k.rpartition(".")[0] == section for k in given):
            if section not in reported:
                reported.add(section)
                yield f"section [{section}] is missing."
        elif key in _TEXTS:
            yield f'{key} is missing; add {key} = "…" at the top.'
        else:
            yield f'{key} is missing; add it as {{ value = …, source = "…" }}{_unit(key, " in")}.'


def _unknown(key: str, given: Mapping[str, Any]) -> str:
    section = key.rpartition(".")[0]
    known = [k for k in _annotations() if k.rpartition(".")[0] == section]
    if not known:
        close = difflib.get_close_matches(section or key, _SECTIONS, 1)
        hint = f"did you mean [{close[0]}]?" if close else f"sections are {', '.join(_SECTIONS)}."
        return f"{key} is not a key of a profile; {hint}"
    for candidate in known:
        suffix = next((s for s in _UNITS if candidate.endswith(s)), "")
        stem = candidate.removesuffix(suffix)
        if suffix and key.startswith(stem + "_"):
            return (
                f"{key} = {_show(given[key])} has the wrong unit "
                f"('{key.removeprefix(stem + '_')}'); write {candidate}, the value in "
                f"{_UNITS[suffix]}."
            )
    close = difflib.get_close_matches(key, known, 1)
    if close:
        return f"{key} is unknown; did you mean {close[0]}{_unit(close[0], ', in')}?"
    names = ", ".join(k.rpartition(".")[2] for k in known)
    return f"{key} is unknown; [{section}] has {names}."


_KINDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text in quotes",
    "tuple_type": "an array of six numbers",
    "finite_number": "a finite number",
    "missing": "an array of six numbers",
    "too_long": "an array of six numbers",
    "string_too_short": "text",
}
_RANGES = {
    "greater_than": ("gt", "more than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def _wrong(detail: ErrorDetails) -> str:
    key, *place = detail["loc"]
    where = f"{key}[{place[0]}]" if place else str(key)
    what = f"{where} = {_show(detail['input'])}{_unit(str(key))}"
    if detail["type"] in _RANGES:
        name, words = _RANGES[detail["type"]]
        remedy = f"must be {words} {detail['ctx'][name]:g}"
        if str(key).startswith("beam.damping."):
            remedy += ": a negative coefficient or an order of 2 or more is an unstable beam"
    else:
        remedy = f"must be {_KINDS.get(detail['type'], detail['msg'])}"
    return f"{what} {remedy}."


def _unit(key: str, before: str = "") -> str:
    """Return the unit of a key as written after its value, or nothing."""
    unit = _UNITS_OF_SIX.get(key) or next((u for s, u in _UNITS.items() if key.endswith(s)), "")
    return f"{before} {unit}" if unit else ""


def _show(value: object) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_show(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _choice(words: tuple[str, ...]) -> str:
    return " or ".join(f'"{word}"' for word in words)
