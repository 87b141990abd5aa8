"""Excitations by name and parameters, from a request or a command line."""

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Protocol

from rigd.excitation._added import ExcitationFunction, load_excitation, plugin_excitation_function
from rigd.excitation._from_file import from_csv
from rigd.excitation._move import MoveRig, move
from rigd.excitation._narrow_sweeps import SweepRig, modes
from rigd.excitation._options import ExcitationOption, declared_options
from rigd.excitation._signals import Excitation, chirp, hold, multisine, step
from rigd.excitation._touch_passes import touch
from rigd.excitation._until import ScanRig, until
from rigd.excitation.declaration import ExcitationKind
from rigd.plugins import Plugin, Registry

OptionValue = float | int | str | Path
"""Type of an option's value in a request for an excitation."""


class ExcitationRig(SweepRig, MoveRig, ScanRig, Protocol):
    """Interface to a rig for which any kind of excitation is planned: limits and predictions."""


KINDS: Final[Registry[ExcitationFunction]] = Registry(
    "rigd.excitations",
    {
        "chirp": chirp,
        "hold": hold,
        "step": step,
        "multisine": multisine,
        "file": from_csv,
        "modes": modes,
        "move": move,
        "touch": touch,
        "until": until,
    },
    plugin_excitation_function,
)
"""Functions that return an excitation, by its name on the command line and in session files.

They include those of installed packages."""


def excitation_options(name: str) -> tuple[ExcitationOption, ...]:
    """Return the declared options of an excitation, in their order.

    Parameters
    ----------
    name
        Name of an excitation, a key of `KINDS`.

    Raises
    ------
    KeyError
        If there is no such excitation.
    PluginError
        If the package of the excitation cannot be used.
    """
    return declared_options(KINDS[name])


def make_excitation(
    kind: str,
    parameters: Mapping[str, OptionValue],
    rate_hz: float,
    rig: ExcitationRig | None = None,
) -> Excitation:
    """Return the excitation of a given kind, such as ``"chirp"``, at a rig's rate.

    Parameters
    ----------
    kind
        Kind of excitation, a key of `KINDS`.
    parameters
        Options of the excitation: keyword arguments of its function. Missing options have their
        default values.
    rate_hz
        Ticks a second.
    rig
        Rig for which the excitation is made, if it depends on one.

    Raises
    ------
    ExcitationError
        If the value of an option is invalid.

    Examples
    --------
    >>> from rigd.excitation import make_excitation
    >>> make_excitation("step", {"amplitude_rad": 0.01}, rate_hz=1000).parameters["amplitude_rad"]
    0.01
    """
    excitation_function = KINDS[kind]
    if "rig" in inspect.signature(excitation_function).parameters:
        return excitation_function(rate_hz=rate_hz, rig=rig, **parameters)
    return excitation_function(rate_hz=rate_hz, **parameters)


def find_excitation(name: str) -> tuple[ExcitationKind, Plugin] | None:
    """Return the excitation that an installed package adds under a name, and the package, or None.

    Parameters
    ----------
    name
        Name of an excitation.

    Raises
    ------
    PluginError
        If the package cannot be used.
    """
    owner_plugin = KINDS.owner(name)
    return None if owner_plugin is None else (load_excitation(owner_plugin), owner_plugin)


def check_excitation_plugin(plugin: Plugin) -> str:
    """Import the excitation that an installed package adds, and return its summary.

    Raises
    ------
    PluginError
        If it cannot be used.
    """
    KINDS.load(plugin)
    return load_excitation(plugin).summary
