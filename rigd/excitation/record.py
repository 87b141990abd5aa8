"""What an excitation is: one reference angle a tick, in three segments."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.excitation.options import ExcitationError, not_negative, positive

FloatArray = NDArray[np.float64]

MAX_TICKS = 7_200_000
"""Two hours at 1 kHz: beyond, predicting the session takes gigabytes of memory."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """A reference, tick by tick.

    Attributes
    ----------
    kind
        ``chirp``, ``hold``, ``step``, ``multisine``, ``file`` or ``modes``.
    parameters
        The options it was made from, and what follows from them, with units in the names.
    rate_hz
        Ticks a second.
    reference_rad
        Shape (n,), relative to the start angle; read-only.
    segments
        ``rest``, ``sweep``, ``ring_down`` → first tick and end (exclusive).
    """

    kind: str
    parameters: Mapping[str, float | int | str]
    rate_hz: float
    reference_rad: FloatArray
    segments: Mapping[str, tuple[int, int]]


def lay_out_segments(
    rate_hz: float, rest_s: float, duration_s: float, ring_down_s: float
) -> dict[str, tuple[int, int]]:
    """Return rest, sweep and ring-down in ticks; the ring-down absorbs what rounding leaves."""
    not_negative("rest_s", rest_s)
    positive("duration_s", duration_s, "s")
    not_negative("ring_down_s", ring_down_s)
    check_ticks("The session", (rest_s + duration_s + ring_down_s) * rate_hz, rate_hz)
    first = round(rate_hz * rest_s)
    end = first + round(rate_hz * duration_s)
    last = max(end, round(rate_hz * (rest_s + duration_s + ring_down_s)))
    if end - first < 2:
        raise ExcitationError(
            f"duration_s = {duration_s:g} s is less than two ticks at {rate_hz:g} Hz; choose at "
            f"least {2 / rate_hz:g} s."
        )
    return {"rest": (0, first), "sweep": (first, end), "ring_down": (end, last)}


def check_ticks(what: str, ticks: float, rate_hz: float) -> None:
    """Refuse what would take more than `MAX_TICKS` ticks."""
    if ticks > MAX_TICKS:
        raise ExcitationError(
            f"{what} would take {ticks / rate_hz:g} s; {MAX_TICKS / rate_hz:g} s is the most at "
            f"{rate_hz:g} Hz: shorten it or run several sessions."
        )


def assemble(
    kind: str,
    parameters: Mapping[str, float | int | str],
    rate_hz: float,
    segments: Mapping[str, tuple[int, int]],
    sweep: FloatArray,
) -> Excitation:
    """Put a sweep (n,) between rest and ring-down."""
    reference = np.zeros(segments["ring_down"][1])
    reference[slice(*segments["sweep"])] = sweep
    reference[slice(*segments["ring_down"])] = sweep[-1]
    reference.flags.writeable = False
    return Excitation(kind, parameters, rate_hz, reference, segments)
