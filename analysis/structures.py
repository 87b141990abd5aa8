"""Damping structures: those of the analyser by name, and those that installed packages add.

One declaration states all of a structure: its parameters, its damping as a function of s, and the
words for it in reports. Types I to VI have the fixed values of Table 2 of the reference paper. Type
VII follows from its conclusions: internal damping of integer order (alpha = 1) with external
damping of fractional order.

A package adds a structure by an entry point of the group ``analysis.structures``. It is fitted to
the whole record and compared with types I to VII, but is none of the candidates of the verdict: the
reported numbers, campaigns and exported models are of types I to VII, and how often the selection
errs is known for these only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import DAMPING_PARAMETERS, PARAMETERS, Damping, Parameter
from rigd.plugins import Plugin, find_plugin, installed_plugins, load_plugin, plugin_errors
from rigd.printable import listed, printable
from rigd.units import unit_of

STRUCTURE_GROUP: Final = "analysis.structures"
"""Group of the entry points by which packages add damping structures."""

Factors = tuple[NDArray[np.complex128], NDArray[np.complex128]]
"""Factor of the bending stiffness, and external damping in 1/m⁴, each of the shape of s."""
DampingFactors = Callable[[NDArray[np.complex128], Mapping[str, float]], Factors]
"""Function of s in rad/s and of the parameters by name that returns the `Factors`."""

_MAX_STARTS: Final = 64
"""Largest number of combinations of start values; each costs an evaluation of the whole record."""
_CHECKED_OMEGA_RAD_S: Final = np.geomspace(0.1, 1e4, 60)
"""Angular frequencies at which the damping of a package's structure is checked."""
_LOSS_TOLERANCE: Final = 1e-9
"""Largest gain of energy, relative to the factor, that rounding can cause."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Damping structure: its parameters, which of them are free, and its damping.

    The stiffness of the beam is ``EI c(s)``, and its equation of motion has ``rho/EI s² + e(s)``.

    Attributes
    ----------
    name : str
        "I" to "VII", or the name that a package gives its structure.
    description : str
        Words for the damping, as a sentence without its full stop.
    parameters : tuple of Parameter
        Parameters with symbol, meaning, unit and range. Those of a package state ``starts``; a
        ``logarithmic`` one is fitted by its logarithm.
    factors : callable
        Function of s (complex, rad/s) and of the parameters by name. It returns c and e: the
        stiffness relative to EI, and the external damping in 1/m⁴. Derivatives by the parameters
        are finite differences, so it must be smooth in them.
    fixed : mapping of str to float
        Values of the parameters that are not fitted. A damping that types I to VII lack has
        coefficient and order 0.
    free : tuple of str
        Names of the fitted parameters, in the order of `parameters`.

    Examples
    --------
    >>> from analysis.models import STRUCTURES
    >>> STRUCTURES["VII"].free
    ('zeta', 'gamma', 'lambda')
    >>> STRUCTURES["VII"].damping({"zeta": 7e-5, "gamma": 0.05, "lambda": 0.6})
    Damping(zeta=7e-05, alpha=1.0, gamma=0.05, lambda_=0.6)
    """

    name: str
    description: str
    parameters: tuple[Parameter, ...]
    factors: DampingFactors
    fixed: Mapping[str, float] = field(default_factory=dict)
    free: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        names = (parameter.name for parameter in self.parameters)
        object.__setattr__(self, "free", tuple(name for name in names if name not in self.fixed))

    @property
    def internal(self) -> bool:
        """Whether the structure has internal damping (of the material)."""
        return "zeta" in self.free

    @property
    def external(self) -> bool:
        """Whether the structure has external damping (of the environment)."""
        return "gamma" in self.free

    def has(self, parameter_name: str) -> bool:
        """Return whether the structure has the kind of damping to which a parameter belongs.

        The kinds are internal and external damping. The result is True for a parameter of beam or
        rig.

        Parameters
        ----------
        parameter_name : str
            Name of a parameter of damping, beam or rig.
        """
        if parameter_name in ("zeta", "alpha"):
            return self.internal
        if parameter_name in ("gamma", "lambda"):
            return self.external
        return True

    def damping(self, free_values: Mapping[str, float]) -> Damping:
        """Return the damping of types I to VII with given free parameters."""
        return Damping(
            *(
                self.fixed[name] if name in self.fixed else free_values[name]
                for name in DAMPING_PARAMETERS
            )
        )

    def check(self) -> None:
        """Raise ValueError if the declaration of a package's structure is not valid.

        Checked are the words, the parameters with their units, ranges and starts, and the damping
        at each start: finite, a loss at all frequencies, and real in time, as a causal force is.
        """
        if not self.description.strip() or "\n" in self.description:
            raise ValueError("its description is not one line of text.")
        if not self.free:
            raise ValueError("it has no free parameter.")
        names = [parameter.name for parameter in self.parameters]
        for parameter in self.parameters:
            if names.count(parameter.name) > 1 or parameter.name in PARAMETERS:
                raise ValueError(
                    f"the name of its parameter {parameter.name} is taken; choose another one."
                )
            _check_parameter(parameter)
        unknown_names = sorted(set(self.fixed) - set(names))
        if unknown_names:
            raise ValueError(f"it fixes {listed(unknown_names)}, which it does not have.")
        starts = self.start_values()
        if len(starts) > _MAX_STARTS:
            raise ValueError(
                f"it has {len(starts)} combinations of start values; state at most {_MAX_STARTS}."
            )
        for values in starts:
            self._check_damping(values)

    def start_values(self) -> list[dict[str, float]]:
        """Return all combinations of the parameters' start values, each with the fixed values."""
        free_starts = [each.starts for each in self.parameters if each.name not in self.fixed]
        return [
            {**self.fixed, **dict(zip(self.free, combination, strict=True))}
            for combination in product(*free_starts)
        ]

    def finite_factors(self, s: NDArray[np.complex128], values: Mapping[str, float]) -> Factors:
        """Return the factors c and e at `s`; raise ValueError unless they are finite numbers.

        Parameters
        ----------
        s : ndarray of complex, shape (n,)
            Laplace variable in rad/s, not 0.
        values : mapping of str to float
            Values of all parameters.
        """
        with np.errstate(all="ignore"):
            elastic, external = (
                np.broadcast_to(np.asarray(factor, dtype=np.complex128), s.shape)
                for factor in self.factors(s, values)
            )
        if not (np.isfinite(elastic).all() and np.isfinite(external).all()):
            raise ValueError(f"its damping is not finite at {_described(values)}.")
        return elastic, external

    def _check_damping(self, values: Mapping[str, float]) -> None:
        """Raise ValueError if the damping at some values is not finite, lossy and real in time."""
        s = (1j * _CHECKED_OMEGA_RAD_S).astype(np.complex128)
        factors = self.finite_factors(s, values)
        self.finite_factors(1.0 + s, values)  # causal responses are computed there
        for factor, name in zip(factors, ("stiffness", "external damping"), strict=True):
            gains = np.flatnonzero(factor.imag < -_LOSS_TOLERANCE * np.abs(factor))
            if gains.size:
                raise ValueError(
                    f"its {name} gains energy at {_CHECKED_OMEGA_RAD_S[gains[0]]:.3g} rad/s with "
                    f"{_described(values)}: the imaginary part is negative."
                )
        mirrored = self.finite_factors(s.conj(), values)
        for factor, at_conjugate in zip(factors, mirrored, strict=True):
            if not np.allclose(at_conjugate, factor.conj(), rtol=1e-9, atol=0.0):
                raise ValueError(
                    f"its damping is not real in time with {_described(values)}: at the conjugate "
                    "of s it must be the conjugate, which no causal force violates."
                )


def _check_parameter(parameter: Parameter) -> None:
    """Raise ValueError if the name, unit, range or starts of a parameter are not valid."""
    name, range_text = parameter.name, f"{parameter.lower:g} to {parameter.upper:g}"
    if not name.isidentifier():
        raise ValueError(f"the name of its parameter {printable(name, 40)} is no identifier.")
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


def _described(values: Mapping[str, float]) -> str:
    """Return names and values of parameters as a text."""
    return ", ".join(f"{name} = {value:.4g}" for name, value in values.items())


# Structures of the analyser


def _fractional_factors(s: NDArray[np.complex128], values: Mapping[str, float]) -> Factors:
    """Return the factors of fractional internal and external damping, as in the reference paper."""
    return (
        1 + values["zeta"] * s ** values["alpha"],
        (values["gamma"] * s ** values["lambda"]).astype(np.complex128),
    )


def _fractional(name: str, description: str, fixed_values: dict[str, float]) -> Structure:
    """Return a structure of fractional damping with given fixed parameters."""
    return Structure(
        name,
        description,
        tuple(PARAMETERS[parameter] for parameter in DAMPING_PARAMETERS),
        _fractional_factors,
        MappingProxyType(fixed_values),
    )


_NO_INTERNAL: Final = {"zeta": 0.0, "alpha": 0.0}
"""Values of the parameters of absent internal damping."""
_NO_EXTERNAL: Final = {"gamma": 0.0, "lambda": 0.0}
"""Values of the parameters of absent external damping."""

UNDAMPED: Final = _fractional("undamped", "No damping", _NO_INTERNAL | _NO_EXTERNAL)
"""Structure without damping, which leaves the parameters of beam and rig."""

STRUCTURES: Final[Mapping[str, Structure]] = MappingProxyType(
    {
        structure.name: structure
        for structure in (
            _fractional("I", "Internal damping only", {"alpha": 1.0, **_NO_EXTERNAL}),
            _fractional("II", "External damping only", {**_NO_INTERNAL, "lambda": 1.0}),
            _fractional("III", "Internal and external damping", {"alpha": 1.0, "lambda": 1.0}),
            _fractional("IV", "Internal damping only", _NO_EXTERNAL),
            _fractional("V", "External damping only", _NO_INTERNAL),
            _fractional("VI", "Internal and external damping", {}),
            _fractional("VII", "Internal and external damping", {"alpha": 1.0}),
        )
    }
)
"""Damping structures of the analyser by name, I to VII."""


# Structures of packages


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


def added_structures(names: Sequence[str]) -> tuple[AddedStructure, ...]:
    """Return the structures of given names that installed packages add.

    Parameters
    ----------
    names : sequence of str
        Names of structures.

    Raises
    ------
    LookupError
        If no package adds a structure of such a name; the message names those there are.
    PluginError
        If a package cannot be used.
    """
    structures = []
    for name in names:
        plugin = find_plugin(STRUCTURE_GROUP, name)
        if plugin is None:
            there = [each.name for each in installed_plugins(STRUCTURE_GROUP) if not each.problem]
            raise LookupError(
                f"no installed package adds a structure '{printable(name, 40)}'; "
                f"{'there are ' + listed(there) if there else 'none adds any'}."
            )
        structures.append(AddedStructure(load_structure(plugin), plugin))
    return tuple(structures)


def load_structure(plugin: Plugin) -> Structure:
    """Import the damping structure of a package, and check its declaration.

    Parameters
    ----------
    plugin : Plugin
        Part of an installed package.

    Raises
    ------
    PluginError
        If it cannot be used.
    """
    structure = load_plugin(plugin, Structure)
    if plugin.name.upper() in STRUCTURES:
        raise plugin.error("this structure is built into the analyser and cannot be replaced.")
    if structure.name != plugin.name:
        raise plugin.error(f'it declares the structure "{structure.name}"; rename one of the two.')
    with plugin_errors(plugin):
        try:
            structure.check()
        except ValueError as error:
            raise plugin.error(str(error)) from error
    return structure


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
    return load_structure(plugin).description
