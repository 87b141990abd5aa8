"""An excitation by its name and its parameters, as a request or a command line gives them."""

from collections.abc import Callable, Mapping
from pathlib import Path

from rigd.excitation.csv_file import from_csv
from rigd.excitation.record import Excitation
from rigd.excitation.signals import chirp, hold, multisine, step

Value = float | int | str | Path

KINDS: Mapping[str, Callable[..., Excitation]] = {
    "chirp": chirp,
    "hold": hold,
    "step": step,
    "multisine": multisine,
    "file": from_csv,
}
"""By the names that the command line and session files have for them."""


def make_excitation(kind: str, parameters: Mapping[str, Value], rate_hz: float) -> Excitation:
    """Make one for a rig's rate.

    Parameters
    ----------
    kind
        A name of `KINDS`.
    parameters
        Keyword arguments of its function; what is left out has its default.
    rate_hz
        Ticks a second.

    Raises
    ------
    ExcitationError
        If a value is absurd.
    """
    return KINDS[kind](rate_hz=rate_hz, **parameters)
