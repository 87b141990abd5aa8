"""Excitations by name and parameters, from a request or a command line."""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from rigd.excitation._from_file import from_csv
from rigd.excitation._narrow_sweeps import SweepRig, modes
from rigd.excitation._shortest_move import MoveRig, move
from rigd.excitation._signals import Excitation, chirp, hold, multisine, step
from rigd.excitation._touch_passes import touch
from rigd.excitation._until import ScanRig, until

Value = float | int | str | Path


class ExcitationRig(SweepRig, MoveRig, ScanRig, Protocol):
    """Interface to a rig for which an excitation is made."""


KINDS: Mapping[str, Callable[..., Excitation]] = {
    "chirp": chirp,
    "hold": hold,
    "step": step,
    "multisine": multisine,
    "file": from_csv,
    "modes": modes,
    "move": move,
    "touch": touch,
    "until": until,
}
"""Functions by the names that the command line and session files use."""

FROM_THE_RIG = frozenset({"rate_hz", "rig", "tip_slope_rad"})
"""Arguments that are not options of an excitation: data and limits of the rig."""


def make_excitation(
    kind: str, parameters: Mapping[str, Value], rate_hz: float, rig: ExcitationRig | None = None
) -> Excitation:
    """Return an excitation at a rig's rate.

    Parameters
    ----------
    kind
        A name of `KINDS`.
    parameters
        Keyword arguments of its function; missing ones have their defaults.
    rate_hz
        Ticks a second.
    rig
        Rig for which the excitation is made, if it depends on one.

    Raises
    ------
    ExcitationError
        If a value is absurd.

    Examples
    --------
    >>> from rigd.excitation import make_excitation
    >>> make_excitation("step", {"amplitude_rad": 0.01}, rate_hz=1000).parameters["amplitude_rad"]
    0.01
    """
    make = KINDS[kind]
    if "rig" in inspect.signature(make).parameters:
        return make(rate_hz=rate_hz, rig=rig, **parameters)
    return make(rate_hz=rate_hz, **parameters)
