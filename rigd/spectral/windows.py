"""The windows that segments are weighted with."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.spectral.response import SpectralError

# All symmetric, as MATLAB's are by default; scipy's are periodic unless told otherwise.
_WINDOWS: Final[dict[str, Callable[[int], NDArray[np.float64]]]] = {
    "hamming": np.hamming,
    "hann": np.hanning,
    "rectangular": np.ones,
}


def window_named(name: str) -> Callable[[int], NDArray[np.float64]]:
    """Return the function from a length n to the symmetric window (n,) of that name.

    Raises
    ------
    SpectralError
        If there is none.
    """
    if name not in _WINDOWS:
        raise SpectralError(f"There is no window {name!r}; choose one of {', '.join(_WINDOWS)}.")
    return _WINDOWS[name]
