"""Declaration of an excitation that an installed package adds.

A package adds an excitation by an entry point of the group ``rigd.excitations``
(:mod:`rigd.plugins`), which names an `ExcitationKind`. Command line, page, socket, planning,
session file and analysis use this declaration and nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ExcitationKind:
    """Declaration of an excitation: its options, and the reference angle in its sweep."""

    name: str
    """Name of the excitation, equal to the name of the entry point."""
    summary: str
    """One line on the excitation, for help texts."""
    options: type
    """Frozen dataclass of the options, each a float, int or str with a default.

    Units are in the names; ranges and help (``annotated_types.doc``) are in ``Annotated``. The
    options ``duration_s``, ``rest_s`` and ``ring_down_s`` are required: the lengths of the segments
    in seconds; `rigd.excitation.RestS` and `rigd.excitation.RingDownS` are types of the last two,
    with their help."""
    reference_rad: Callable[[Any, NDArray[np.float64]], NDArray[np.float64]]
    """Function of the options and the times in s since the start of the sweep, shape (n,).

    It returns the reference angle in rad relative to the start angle, shape (n,)."""
    welch_exclusion: str = ""
    """Reason why the Welch method does not suit the excitation, as a clause; empty if it suits."""
