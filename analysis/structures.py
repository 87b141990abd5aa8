"""Damping structures that installed packages add, found by entry points.

A package adds a structure by an entry point of the group ``analysis.structures``, which names a
`Structure`. It is fitted to the whole record and compared with types I to VII, but is none of the
candidates of the verdict: the reported numbers, campaigns and exported models are of types I to
VII, and how often the selection errs is known for these only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.models import STRUCTURES, Structure, parameters_text
from rigd.beam import PARAMETERS, Parameter
from rigd.plugins import Plugin, Registry, load_declaration, plugin_errors
from rigd.printable import listed, printable
from rigd.units import unit_of

_MAX_START_POINTS: Final = 64
"""Largest number of combinations of start values; each costs an evaluation of the whole record."""
_CHECKED_OMEGA_RAD_S: Final = np.geomspace(0.1, 1e4, 60)
"""Angular frequencies at which the damping of a package's structure is checked."""
_NEGATIVE_LOSS_TOLERANCE: Final = 1e-9
"""Largest negative imaginary part of a factor, relative to it, that rounding errors can cause."""


def check_structure(structure: Structure) -> None:
    """Raise ValueError if the declaration of a package's structure is not valid.

    Name and description are checked, and the units, ranges and start values of the parameters. At
    each start the damping must be finite, dissipate energy at all frequencies and be real in time.

    Parameters
    ----------
    structure : Structure
        Declaration to be checked.
    """
    if not structure.description.strip() or "\n" in structure.description:
        raise ValueError("its description is not one line of text.")
    if not structure.free:
        raise ValueError("it has no free parameter.")
    parameter_names = [parameter.name for parameter in structure.parameters]
    for parameter in structure.parameters:
        if parameter_names.count(parameter.name) > 1 or parameter.name in PARAMETERS:
            raise ValueError(
                f"the name of its parameter {parameter.name} is taken; choose another one."
            )
        _check_parameter(parameter)
    unknown_names = sorted(set(structure.fixed) - set(parameter_names))
    if unknown_names:
        raise ValueError(f"it fixes {listed(unknown_names)}, which it does not have.")
    start_points = structure.start_values()
    if len(start_points) > _MAX_START_POINTS:
        raise ValueError(
            f"it has {len(start_points)} combinations of start values; state at most "
            f"{_MAX_START_POINTS}."
        )
    for values in start_points:
        _check_damping(structure, values)


def _check_damping(structure: Structure, parameter_values: Mapping[str, float]) -> None:
    """Raise ValueError unless the damping at given parameters is valid (`check_structure`)."""
    s = (1j * _CHECKED_OMEGA_RAD_S).astype(np.complex128)
    factors = structure.finite_factors(s, parameter_values)
    structure.finite_factors(1.0 + s, parameter_values)  # causal responses are computed there
    for factor, name in zip(factors, ("stiffness", "external damping"), strict=True):
        gain_indices = np.flatnonzero(factor.imag < -_NEGATIVE_LOSS_TOLERANCE * np.abs(factor))
        if gain_indices.size:
            raise ValueError(
                f"its {name} gains energy at {_CHECKED_OMEGA_RAD_S[gain_indices[0]]:.3g} rad/s "
                f"with {parameters_text(parameter_values)}: the imaginary part is negative."
            )
    conjugate_factors = structure.finite_factors(s.conj(), parameter_values)
    for factor, at_conjugate in zip(factors, conjugate_factors, strict=True):
        if not np.allclose(at_conjugate, factor.conj(), rtol=1e-9, atol=0.0):
            raise ValueError(
                "its damping is not a real function of time with "
                f"{parameters_text(parameter_values)}: at "
                "the conjugate of s it must have the conjugate value."
            )


def _check_parameter(parameter: Parameter) -> None:
    """Raise ValueError if the name, unit, range or starts of a parameter are not valid."""
    name, range_text = parameter.name, f"{parameter.lower:g} to {parameter.upper:g}"
    if not name.isidentifier():
        raise ValueError(f"the name of its parameter {printable(name, 40)} is not an identifier.")
    if unit_of(name) not in ("", parameter.unit):
        raise ValueError(
            f'its parameter {name} has the unit "{parameter.unit}", but its name says '
            f"{unit_of(name)}."
        )
    if not (math.isfinite(parameter.lower) and math.isfinite(parameter.upper)):
        raise ValueError(f"the range of its parameter {name}, {range_text}, is not finite.")
    if not parameter.lower < parameter.upper or (parameter.logarithmic and parameter.lower <= 0):
        raise ValueError(
            f"the range of its parameter {name}, {range_text}, is not valid"
            f"{': a logarithmic one begins above 0' if parameter.logarithmic else ''}."
        )
    if not parameter.starts:
        raise ValueError(f"its parameter {name} states no start value.")
    for start in parameter.starts:
        if not parameter.lower <= start <= parameter.upper:
            raise ValueError(f"the start {start:g} of its parameter {name} is not in {range_text}.")


@dataclass(frozen=True, slots=True)
class AddedStructure:
    """Damping structure that an installed package adds.

    Attributes
    ----------
    structure : Structure
        Checked declaration.
    plugin : Plugin
        Package that adds it.
    """

    structure: Structure
    plugin: Plugin


def _load_structure(plugin: Plugin) -> Structure:
    """Import the damping structure of a package; raise PluginError if it is invalid."""
    structure = load_declaration(plugin, Structure)
    with plugin_errors(plugin):
        try:
            check_structure(structure)
        except ValueError as error:
            raise plugin.error(str(error)) from error
    return structure


_REGISTRY: Final = Registry("analysis.structures", STRUCTURES, _load_structure, "the analyser")
"""Damping structures, by name."""


def added_structures(structure_names: Sequence[str]) -> tuple[AddedStructure, ...]:
    """Return the structures of given names that installed packages add.

    Parameters
    ----------
    structure_names : sequence of str
        Names of structures.

    Raises
    ------
    LookupError
        If no package adds a structure of such a name; the message lists the available ones.
    PluginError
        If a package cannot be used.
    """
    structures = []
    for name in structure_names:
        plugin = _REGISTRY.owner(name)
        if plugin is None:
            available_names = [
                registered.name
                for registered in _REGISTRY.added_plugins()
                if not registered.problem
            ]
            raise LookupError(
                f"no installed package adds a structure '{printable(name, 40)}'; "
                f"{'there are ' + listed(available_names) if available_names else 'none adds any'}."
            )
        structures.append(AddedStructure(_REGISTRY.load(plugin), plugin))
    return tuple(structures)


def check_structure_plugin(plugin: Plugin) -> str:
    """Import the damping structure of a package, and return its description.

    Parameters
    ----------
    plugin : Plugin
        Part of an installed package.

    Raises
    ------
    PluginError
        If it cannot be used.
    """
    return _REGISTRY.load(plugin).description
