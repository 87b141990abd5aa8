"""What the estimators demand of the two records they are given."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.spectral.response import SpectralError


def checked_records(
    input_: ArrayLike, output: ArrayLike, rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both records as float arrays of one dimension, equal length and finite values.

    Raises
    ------
    SpectralError
        Naming which record is wrong, and how.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise SpectralError(f"The sampling rate must be a positive number of Hz, not {rate_hz!r}.")
    x = np.asarray(input_, dtype=np.float64)
    y = np.asarray(output, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape:
        raise SpectralError(
            "Input and output must be two records of one dimension and equal length; "
            f"their shapes are {x.shape} and {y.shape}."
        )
    for name, record in (("input", x), ("output", y)):
        if not np.isfinite(record).all():
            count = int(np.count_nonzero(~np.isfinite(record)))
            raise SpectralError(
                f"{count} of {record.size} samples of the {name} are NaN or infinite; "
                "fill or cut them before estimating a frequency response."
            )
    if not x.any():
        raise SpectralError(
            f"The input is zero in all of its {x.size} samples: nothing was excited, "
            "so there is no frequency response to estimate."
        )
    return x, y
