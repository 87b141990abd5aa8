"""What is wrong with a channel as recorded, whatever the beam: clipping, a motor that stops."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.selection.finding import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from analysis.whole_record import Measurement

_FEWEST_FLAT: Final = 4
"""Known values next to another at the very extreme: noise does not repeat its largest."""

_STILL_S: Final = 0.5
_STILL: Final = 0.02
"""Least stand-still worth a word, and motion then, over what was asked for."""


def clipping(measurement: Measurement) -> Iterator[Finding]:
    """Find a torque that stays at its extreme values."""
    torque, known = measurement.torque_nm, measurement.torque_known
    flat = []
    for limit in (torque[known].max(), torque[known].min()):
        at = known & (torque == limit)
        beside = at & (np.roll(at, 1) | np.roll(at, -1))
        if limit != 0 and np.count_nonzero(beside) >= _FEWEST_FLAT:
            flat.append((float(limit), int(np.count_nonzero(at))))
    if not flat:
        return
    limits = " and ".join(f"{limit:+.3g} N·m" for limit, _ in flat)
    count = sum(ticks for _, ticks in flat)
    yield Finding(
        kind="clipping",
        sentence=(
            f"The torque is clipped at {limits}: {count} values lie exactly there, none beyond, "
            "and no flag says so. What it would have been is not known."
        ),
        value=max(abs(limit) for limit, _ in flat),
        interval=None,
        unit="N·m",
        remedy="Use a larger range of the sensor, or a smaller amplitude; flag clipped values.",
    )


def stops(measurement: Measurement) -> Iterator[Finding]:
    """Find a motor that stands still while it is asked to move."""
    asked = measurement.reference_rad
    if asked is None:
        return
    length = max(round(_STILL_S * measurement.rate_hz), 2)
    blocks = asked.size // length
    if blocks == 0:
        return
    moved, wanted = (
        np.ptp(values[: blocks * length].reshape(blocks, length), axis=1)
        for values in (measurement.angle_rad, asked)
    )
    still = (wanted > np.median(wanted)) & (moved < _STILL * wanted)
    if not still.any():
        return
    first, last = _longest(still)
    yield Finding(
        kind="stop",
        sentence=(
            f"The motor stands still from {first * _STILL_S:.1f} to {last * _STILL_S:.1f} s of the "
            "record, though it is asked to move."
        ),
        value=(last - first) * _STILL_S,
        interval=None,
        unit="s",
        remedy="Look for what held the shaft or switched the drive off, and sweep again.",
    )


def _longest(true: NDArray[np.bool_]) -> tuple[int, int]:
    """First block of the longest run, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], true.astype(int), [0]])))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest])
