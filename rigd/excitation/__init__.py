"""Reference trajectories of a session: chirp, hold, step, multisine, narrow sweeps, from a file.

A reference is relative to the angle at which the session starts. Every excitation has the same
three segments: rest (reference zero), sweep, ring-down (the sweep's last value held).
"""

from rigd.excitation.from_file import from_csv
from rigd.excitation.narrow_sweeps import modes
from rigd.excitation.signals import Excitation, ExcitationError, chirp, hold, multisine, step

__all__ = [
    "Excitation",
    "ExcitationError",
    "chirp",
    "from_csv",
    "hold",
    "modes",
    "multisine",
    "step",
]
