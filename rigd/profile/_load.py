"""Loader of profiles: reads a TOML file and validates it into frozen dataclasses.

Every number has the form ``{ value = 2.0e-3, source = "assumed" }``, with its unit in the key, so
that assumed and measured numbers are distinguishable. The dataclasses declare the ranges with
``annotated_types``; this module enforces them. All problems of a file are reported at once.

An unknown number has the form ``{ source = "unknown" }``, without a value.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from rigd import documents
from rigd.devices import MAY_BE_UNKNOWN
from rigd.devices.parameters import RigParameters
from rigd.documents import DocumentError
from rigd.errors import UserError
from rigd.profile import _diagnostics as diagnostics
from rigd.profile._locations import profile_files
from rigd.profile._schema import (
    OPTIONAL_SECTIONS,
    SECTIONS,
    SOURCES,
    UNKNOWN,
    Profile,
    defaults,
    fields_of,
    is_number,
    keys,
)


class ProfileError(UserError, ValueError):
    """A profile cannot be used; the message has a line with the remedy for each problem."""


def load_profile(name_or_path: str | Path) -> Profile:
    """Read and validate a profile.

    Parameters
    ----------
    name_or_path
        Path of a file, or file name without ``.toml``. The name is searched in ``hw_profiles`` of
        the working folder, then in the user's own folder (``$XDG_CONFIG_HOME/rigd/profiles``), then
        among the shipped profiles.

    Returns
    -------
    Profile

    Raises
    ------
    ProfileError
        If there is no such file, or it has mistakes. Every problem is reported with its key, value,
        unit and remedy.

    Examples
    --------
    >>> from rigd.profile import load_profile
    >>> rig = load_profile("sim").rig
    >>> rig.rate_hz, rig.beam.length_m
    (1000.0, 0.98)
    """
    path = _find(name_or_path)
    return profile_of(read_text(path), path)


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises
    ------
    ProfileError
        If it cannot be read, or is not text.
    """
    try:
        return documents.read_text(path)
    except DocumentError as error:
        raise ProfileError(f"{path}: {error}.") from error


def profile_of(text: str, path: Path) -> Profile:
    """Return the validated profile of a text; `path` is its present or future file.

    Raises
    ------
    ProfileError
        As :func:`load_profile`.
    """
    document = parse(text, path)
    problems: list[str] = []
    values, sources = flatten(document, problems)
    absent = {
        name for name in OPTIONAL_SECTIONS if not any(k.startswith(name + ".") for k in values)
    }
    unknown = frozenset(key for key, source in sources.items() if source == UNKNOWN)
    values = validate(values, problems, frozenset(absent), unknown)
    if not problems:
        problems.extend(_find_eds(path, values))
        problems.extend(diagnostics.contradictions(values))
        problems.extend(diagnostics.wiring_contradictions(values))
    if problems:
        raise complaint(path, problems)

    section = {name: _build(name, values) for name in SECTIONS if name not in absent}
    return Profile(
        name=values["name"],
        description=values["description"],
        path=path,
        text=text,
        rig=RigParameters(
            rate_hz=section["rig"].rate_hz,
            beam=section["beam"].uniform,
            damping=section["beam.damping"],
            motor=section["motor"],
            encoder=section["encoder"],
            sensor=section["sensor"],
            actuation=section["actuation"],
            devices=section["devices"],
            simulation=section.get("simulation"),
            name=values["name"],
            can=section.get("can"),
            acquisition=section.get("acquisition"),
            cia402=section.get("cia402"),
            ati_can=section.get("ati_can"),
            ati_serial=section.get("ati_serial"),
        ),
        control=section["control"],
        limits=section["limits"],
        session=section["session"],
        realtime=section["realtime"],
        metadata=section["metadata"],
        uncertainty=section["uncertainty"],
        sources=sources,
        tip_mass_kg=section["beam"].tip_mass_kg,
        axis_tilt_deg=section["rig"].axis_tilt_deg,
    )


def parse(text: str, path: Path) -> dict[str, Any]:
    """Return the document of a TOML text.

    Raises
    ------
    ProfileError
        If the text is not valid TOML.
    """
    try:
        return documents.parse_toml(text)
    except DocumentError as error:
        raise ProfileError(f"{path}: {error}.") from error


def complaint(path: Path, problems: Iterable[str]) -> ProfileError:
    """Return the error for a file, with one line for each problem."""
    # An array that is too short has one error for each missing number.
    return ProfileError("\n".join(f"{path}: {line}" for line in dict.fromkeys(problems)))


def _find(name_or_path: str | Path) -> Path:
    if not str(name_or_path):
        raise ProfileError(f"No profile is named; {_known_profiles()}, or give a .toml file.")
    given = Path(name_or_path)
    if given.suffix == ".toml" or given.parent != Path():
        if given.is_file():
            return given
        raise ProfileError(f"{given}: there is no such file; {_known_profiles()}.")
    files = profile_files()
    if str(given) in files:
        return files[str(given)][0].path
    raise ProfileError(
        f"There is no profile '{given}'; {_known_profiles()}. Make one of that name by "
        f"'rigd profiles copy sim {given}', or give the path of a .toml file."
    )


def known_profiles() -> list[str]:
    """Return the names of all profiles: of the working folder, of the user, and shipped ones."""
    return list(profile_files())


def _known_profiles() -> str:
    names = known_profiles()
    return "known profiles are " + ", ".join(names) if names else "no profiles are known here"


def _find_eds(path: Path, values: dict[str, Any]) -> Iterator[str]:
    """Make the path of the drive's EDS file absolute; yield a message if the file is missing."""
    given = values.get("cia402.eds")
    if not given:
        return
    eds = path.resolve().parent / given
    values["cia402.eds"] = str(eds)
    if not eds.is_file():
        yield (
            f'cia402.eds = "{given}": there is no file {eds}; give its path, relative to the '
            "profile's folder, or remove the key."
        )


def flatten(
    document: Mapping[str, Any], problems: list[str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Flatten the document into dotted keys, and separate the sources from the numbers."""
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for key, entry in _entries(document, ""):
        if not isinstance(entry, dict):
            values[key] = entry
            if _is_number(key):
                problems.append(diagnostics.bare_number(key, entry))
            continue
        source = entry.get("source")
        if source == UNKNOWN and key in MAY_BE_UNKNOWN and "value" not in entry:
            sources[key] = source
            values[key] = math.nan
            continue
        values[key] = entry.get("value")
        if source == UNKNOWN:
            problems.append(diagnostics.not_unknown(key, entry))
        elif source in SOURCES:
            sources[key] = source
        elif _is_number(key):
            problems.append(diagnostics.no_source(key, source))
        problems.extend(
            f"{key} has the unknown part '{other}'; only value and source go there."
            for other in sorted(entry.keys() - {"value", "source"})
        )
    return values, sources


def _is_number(key: str) -> bool:
    """Return whether the value of a key is a number or six numbers; False for unknown keys."""
    return key in keys() and is_number(keys()[key])


def _entries(table: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield dotted keys with their entries; a table with a value outside a section is a number."""
    for key, entry in table.items():
        dotted = prefix + key
        if isinstance(entry, dict) and (
            dotted in SECTIONS or (entry and not entry.keys() & {"value", "source"})
        ):
            yield from _entries(entry, dotted + ".")
        else:
            yield dotted, entry


def validate(
    values: Mapping[str, Any],
    problems: list[str],
    absent: frozenset[str],
    unknown: frozenset[str] = frozenset(),
) -> dict[str, Any]:
    """Check types and ranges, and return the values for the dataclasses.

    Parameters
    ----------
    values
        Values by their dotted keys.
    problems
        List to which a message for each problem is appended.
    absent
        Sections that the file omits; the top level has an empty name.
    unknown
        Keys without a value; their NaN is not checked.
    """
    # TOML has only arrays, and strict validation requires tuples.
    given = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    try:
        known = {key: value for key, value in given.items() if key not in unknown}
        model = _schema(absent, unknown).model_validate(known)
    except ValidationError as error:
        details = error.errors(include_url=False)
        missing = [str(d["loc"][0]) for d in details if d["type"] == "missing" and not d["loc"][1:]]
        problems.extend(diagnostics.missing(missing, given))
        for detail in details:
            if detail["type"] == "extra_forbidden":
                problems.append(diagnostics.unknown(str(detail["loc"][0]), given))
            elif str(detail["loc"][0]) not in missing:
                problems.append(diagnostics.wrong(detail))
        return given
    usable: dict[str, Any] = model.model_dump(by_alias=True)
    problems.extend(diagnostics.unusable_sizes(usable))
    return usable | dict.fromkeys(unknown, math.nan)


@cache
def _schema(absent: frozenset[str], unknown: frozenset[str]) -> type[BaseModel]:
    """Return one flat model for all keys; one model for each section would be slow to build."""
    definitions: dict[str, Any] = {
        f"key_{index}": (annotation, Field(default=defaults().get(key, ...), alias=key))
        for index, (key, annotation) in enumerate(keys().items())
        if key.rpartition(".")[0] not in absent and key not in unknown
    }
    config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    return create_model("Profile", __config__=config, **definitions)


def _build(section: str, values: Mapping[str, Any]) -> Any:  # noqa: ANN401
    return SECTIONS[section](**{field: values[key] for key, field in fields_of(section)})
