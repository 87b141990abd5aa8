"""Values that are not finite: held from the sample before and flagged, or refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.exchange.errors import ExchangeError
from analysis.record_checks import too_much_unknown
from rigd.session import Status

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

_FLAGS: Final = {
    "angle_rad": Status.ANGLE_STALE,
    "coupling_torque_nm": Status.WRENCH_STALE,
}
"""Field of a sample → the flag that says its value is that of the sample before."""


def hold(
    path: Path, names: Mapping[str, str], columns: Mapping[str, NDArray[np.float64]]
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.uint32], int]:
    """Replace values that are not finite as the session format does: by the last good one.

    Parameters
    ----------
    path : Path
        For messages.
    names : mapping of str to str
        Field → name of its channel in the file, for messages.
    columns : mapping of str to ndarray of float, shape (n,)
        Field → values.

    Returns
    -------
    columns : dict of str to ndarray of float, shape (n - first,)
    status : ndarray of uint32, shape (n - first,)
        Bits of `rigd.session.Status`.
    first : int
        Samples at the beginning that had to be left out, having nothing to hold.

    Raises
    ------
    ExchangeError
        If it is too many values, or those of a channel that cannot be flagged.
    """
    bad = {name: ~np.isfinite(values) for name, values in columns.items()}
    for name, mask in bad.items():
        count = int(mask.sum())
        if count and name not in _FLAGS:
            raise ExchangeError(
                f"{path}: '{names[name]}' is not finite in {count} of {len(mask)} samples, first "
                f"in sample {int(np.argmax(mask)) + 1}; repair it, or leave this channel out: no "
                "analysis needs it."
            )
        much = too_much_unknown(f"'{names[name]}'", count, len(mask))
        if much:
            raise ExchangeError(
                f"{path}: {much} Or choose another channel, or cut the session out of the file."
            )
    first = max(int(np.argmin(mask)) for mask in bad.values())
    held = {name: _held(values, bad[name])[first:] for name, values in columns.items()}
    status = np.zeros(len(next(iter(held.values()))), dtype=np.uint32)
    for name, flag in _FLAGS.items():
        if name in bad:
            status[bad[name][first:]] |= np.uint32(flag)
    return held, status, first


def _held(values: NDArray[np.float64], bad: NDArray[np.bool_]) -> NDArray[np.float64]:
    if not bad.any():
        return values
    last_good = np.maximum.accumulate(np.where(bad, 0, np.arange(len(values))))
    return values[last_good]
