"""Modal constants of any plant by Cauchy's integral, independent of the analyzer's closed form."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.identify import MODE_CONSTANT_NAMES
from rigd.beam import Plant, ResponseGrid

_CIRCLE = np.exp(2j * np.pi * np.arange(8) / 8)
_RADIUS = 0.2
"""Radius of the circle round a pole, relative to the decay rate."""


def modal_constants(plant: Plant, modes: Sequence[int]) -> NDArray[np.float64]:
    """Constants of some modes of a plant in turn, shape (4 n,); NaN where a mode has no pole.

    A residue is the mean over a circle round its pole (Cauchy's integral): exact for any ends and
    instruments that the response knows.

    Parameters
    ----------
    plant : Plant
    modes : sequence of int
    """
    found = {pole.mode: pole.at_rad_s for pole in plant.mode_poles(max(modes), ())}
    if not all(mode in found and found[mode].imag > 0 for mode in modes):
        return np.full(len(MODE_CONSTANT_NAMES) * len(modes), np.nan)
    poles = np.array([found[mode] for mode in modes])
    turns = (_RADIUS * np.abs(poles.real) + 1e-9 * np.abs(poles))[:, None] * _CIRCLE
    response = ResponseGrid((poles[:, None] + turns).ravel()).evaluate(plant)[0]
    residues = np.mean(response.reshape(turns.shape) * turns, axis=1)
    log_residues = np.log(residues / 1j)
    rows = (
        np.log(poles.imag / (2 * np.pi)),
        np.log(-poles.real / np.abs(poles)),
        log_residues.real,
        log_residues.imag,
    )
    return np.array(rows).T.ravel()
