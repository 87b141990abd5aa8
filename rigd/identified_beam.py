"""The beam as an analysis identified it: read from the document of ``analyze --json``."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Final

from rigd.beam import Beam, Damping
from rigd.documents import DocumentError, read_json
from rigd.errors import UserError
from rigd.units import finite_number, is_usable_size

_NEEDED: Final = ("density_over_stiffness", "bending_stiffness_n_m2")
_BELOW: Final = {"zeta": 1.0, "alpha": 2.0, "lambda": 2.0}
_UNITS: Final = {
    "zeta": "s^alpha",
    "gamma": "s^lambda/m⁴",
    "density_over_stiffness": "s²/m⁴",
    "bending_stiffness_n_m2": "N·m²",
    "tool_inertia_kg_m2": "kg·m²",
    "delay_s": "s",
}
_READ: Final = ("alpha", "lambda", *_UNITS)
_TWO_SIDED_95: Final = 1.959964
_REMEDY: Final = "write it with analyze session.mcap --json model.json"


class IdentifiedBeamError(UserError, ValueError):
    """A document holds no beam that can be used; the message names file, key and remedy."""


@dataclass(frozen=True, slots=True)
class IdentifiedBeam:
    """Parameters of the exact model from an analysis."""

    beam: Beam
    """Length as given, stiffness and density as identified."""
    damping: Damping
    """Damping as identified; none of a kind that the structure has not."""
    tool_inertia_kg_m2: float | None
    """Inertia between sensor and beam; None: it was not identified."""
    delay_s: float | None
    """Torque's age less the angle's; None: it was not identified."""
    std: Mapping[str, float]
    """Standard deviations by the parameters' names in the document, as far as they are known."""

    @property
    def frequency_uncertainty(self) -> float:
        """Relative standard uncertainty of the modes' frequencies."""
        return 0.5 * self.std.get(_NEEDED[0], 0.0) / self.beam.density_over_stiffness


def read_identified_beam(path: str | Path, length_m: float) -> IdentifiedBeam:
    """Read the parameters that an analysis headlines: of a campaign the pooled ones.

    Parameters
    ----------
    path
        Document of ``analyze session.mcap --json``: ``headlines[].parameters``.
    length_m
        Length of the beam, which no session shows.

    Raises
    ------
    IdentifiedBeamError
        If the file cannot be read, or has no such parameters.
    """
    path = Path(path)
    parameters = _parameters(path)
    values = {name: _value(path, name, parameters[name]) for name in _READ if name in parameters}
    for name in _NEEDED:
        if name not in values:
            raise IdentifiedBeamError(
                f"{path}: headlines[0].parameters.{name} is missing; take the document of an "
                "analysis that found it (analyze session.mcap --json model.json)."
            )
    density_over_stiffness, stiffness = (values[name] for name in _NEEDED)
    deviations = {name: _deviation(parameters[name]) for name in values}
    return IdentifiedBeam(
        beam=Beam(length_m, density_over_stiffness * stiffness, stiffness),
        damping=Damping(
            zeta=values.get("zeta", 0.0),
            alpha=values.get("alpha", 1.0),
            gamma=values.get("gamma", 0.0),
            lambda_=values.get("lambda", 1.0),
        ),
        tool_inertia_kg_m2=values.get("tool_inertia_kg_m2"),
        delay_s=values.get("delay_s"),
        std={name: std for name, std in deviations.items() if std is not None},
    )


def _parameters(path: Path) -> Mapping[str, Any]:
    try:
        document = read_json(path)
    except DocumentError as error:
        raise IdentifiedBeamError(f"{path}: {error}; {_REMEDY}.") from error
    headlines = document.get("headlines") if isinstance(document, dict) else None
    listed = headlines if isinstance(headlines, list) else []
    found = [each for each in listed if isinstance(each, dict)]
    pooled = [each for each in found if each.get("file", "") is None]
    parameters = next(iter(pooled + found), {}).get("parameters")
    if not isinstance(parameters, dict):
        raise IdentifiedBeamError(f"{path}: has no headlines[0].parameters; {_REMEDY}.")
    return parameters


def _value(path: Path, name: str, entry: object) -> float:
    """Return the value of a parameter, of a size that the exact model takes."""
    given = entry.get("value") if isinstance(entry, dict) else None
    value = finite_number(given)
    below = _BELOW.get(name, inf)
    least = -inf if name == "delay_s" else 0.0
    usable = value is not None and least <= value < below and is_usable_size(value)
    if value is not None and usable and (value > 0.0 or name not in _NEEDED):
        return value
    bound = "more than 0" if name in _NEEDED else "any size" if least < 0 else "0 or more"
    if below < inf:
        bound += f" below {below:g}"
    unit = f" {_UNITS[name]}" if name in _UNITS else ""
    raise IdentifiedBeamError(
        f"{path}: headlines[0].parameters.{name}.value = {json.dumps(given, default=str)[:60]} "
        f"must be a number of {bound}{unit}; {_REMEDY}."
    )


def _deviation(entry: Mapping[str, Any]) -> float | None:
    """Half of the 95 % interval over 1.96, which holds over all structures; else the std."""
    ends, std = entry.get("interval_95"), finite_number(entry.get("std"))
    if isinstance(ends, list) and len(ends) == 2:
        low, high = map(finite_number, ends)
        if low is not None and high is not None:
            return abs(high - low) / (2 * _TWO_SIDED_95)
    return std if std is not None and std > 0 else None
