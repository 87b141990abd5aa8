"""Reference trajectories: chirp, hold, step, multisine, narrow sweeps, moves, from a file.

A reference is relative to the angle at which the session starts. Every excitation has the same
three segments: rest (reference zero), sweep, ring-down (the sweep's last value held). The package
has a function per kind (`chirp` … `from_csv`, `modes`, `move`); `make_excitation` calls that of a
given name. The module `moves` has the paths of which moves consist, `targets` the target precisions
of a session. `rigd.runner` predicts whether a rig can follow a reference.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
