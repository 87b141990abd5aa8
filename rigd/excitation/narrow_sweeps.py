"""Narrow sweeps round modes that are known from an earlier session."""

from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.excitation.bands import Band, Foresight, shares_of_time
from rigd.excitation.mode_table import read_modes
from rigd.excitation.options import ExcitationError, frequency, positive, within_a_turn
from rigd.excitation.record import Excitation, assemble, lay_out_segments

FloatArray = NDArray[np.float64]

SHARE_OF_LIMITS: Final = 0.9
"""That the sweeps may be predicted to take: the rest is for a beam other than the profile's."""

_EASINGS: Final = 8
_CLOSE_ENOUGH: Final = 1.005

LEAST_SHARE: Final = 0.5
"""Of an equal part of the time, for every band: a mode is never left out."""


def modes(
    *,
    rate_hz: float,
    path: str | Path,
    amplitude_rad: float = 0.025,
    stop_hz: float = 50.0,
    widths: float = 1.0,
    duration_s: float = 120.0,
    rest_s: float = 1.0,
    ring_down_s: float = 15.0,
    taper_s: float = 1.0,
    rig: Foresight | None = None,
) -> Excitation:
    """Linear sweeps through narrow bands round modes, one after the other.

    Parameters
    ----------
    rate_hz
        Ticks a second.
    path
        JSON with the modes: see `rigd.excitation.mode_table.read_modes`.
    amplitude_rad
        Amplitude in each band; lower where the rig's limits ask for it.
    stop_hz
        Modes above are left out.
    widths
        Half-power widths swept to either side of a mode, beside its frequency's uncertainty.
    duration_s
        Of all sweeps together.
    rest_s, ring_down_s
        Time before and after them.
    taper_s
        Raised-cosine fade at both ends of every sweep: angle and speed are zero at the joints.
    rig
        Limits the amplitudes and splits the time by what each band tells of the damping. Without
        it neither happens.

    Raises
    ------
    ExcitationError
        If an option or the file is not what it should be.
    """
    positive("amplitude_rad", amplitude_rad, "rad")
    within_a_turn("amplitude_rad", amplitude_rad)
    frequency("stop_hz", stop_hz, rate_hz)
    positive("widths", widths, "half-power widths")
    positive("taper_s", taper_s, "s")
    segments = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    first, end = segments["sweep"]
    bands = _bands(Path(path), stop_hz, widths, rate_hz)
    fades = 2 * round(taper_s * rate_hz)
    if fades < 2 or LEAST_SHARE * (end - first) / len(bands) < fades:
        raise ExcitationError(
            f"duration_s = {duration_s:g} s is too short for fades of taper_s = {taper_s:g} s at "
            f"both ends of {len(bands)} sweeps; choose at least "
            f"{2.0 * taper_s * len(bands) / LEAST_SHARE:g} s, or a taper_s from {2 / rate_hz:g} s."
        )
    lengths = _lengths(np.full(len(bands), 1.0 / len(bands)), end - first)
    amplitudes_rad = [amplitude_rad] * len(bands)
    sweeps = [_unit_sweep(*item, fades, rate_hz) for item in zip(bands, lengths, strict=True)]
    if rig is not None:
        eased_rad = _within_limits(sweeps, amplitude_rad, rig)
        lengths = _lengths(_at_least(shares_of_time(bands, eased_rad, rig)), end - first)
        sweeps = [_unit_sweep(*item, fades, rate_hz) for item in zip(bands, lengths, strict=True)]
        amplitudes_rad = _within_limits(sweeps, amplitude_rad, rig)
    reference_rad = np.concatenate([a * s for a, s in zip(amplitudes_rad, sweeps, strict=True)])
    parameters: dict[str, float | int | str] = {
        "file": Path(path).name,
        "amplitude_rad": max(amplitudes_rad),
        "start_hz": min(band.start_hz for band in bands),
        "stop_hz": max(band.stop_hz for band in bands),
        "widths": widths,
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "taper_s": taper_s,
        "bands": "; ".join(
            f"{band.start_hz:.6g}-{band.stop_hz:.6g} Hz, {amplitude:.4g} rad, "
            f"{ticks / rate_hz:.6g} s"
            for band, amplitude, ticks in zip(bands, amplitudes_rad, lengths, strict=True)
        ),
    }
    return assemble("modes", parameters, rate_hz, segments, reference_rad)


def _bands(path: Path, stop_hz: float, widths: float, rate_hz: float) -> list[Band]:
    """Bands in the order of their sweeps: what rings longest comes first and rings on."""
    found = read_modes(path)
    inside = [mode for mode in found if mode.frequency_hz <= stop_hz]
    if not inside:
        raise ExcitationError(
            f"{path}: the lowest mode, frequency_hz = {found[0].frequency_hz:g} Hz, lies above "
            f"stop_hz = {stop_hz:g} Hz; raise stop_hz."
        )
    bands = sorted((Band.of_mode(mode, widths) for mode in inside), key=lambda band: -band.decay_s)
    for band in bands:
        frequency(f"The upper end of a band of {widths:g} widths", band.stop_hz, rate_hz)
    return bands


def _within_limits(
    sweeps: Sequence[FloatArray], amplitude_rad: float, rig: Foresight
) -> list[float]:
    """Return for each sweep the amplitude, or the largest that leaves the rig within its limits.

    One after the other, since a mode still rings while the next is swept.
    """
    amplitudes_rad = []
    before_rad = np.empty(0)
    for sweep in sweeps:
        eased_rad = amplitude_rad
        for _ in range(_EASINGS):
            share = rig.share_of_limits(np.concatenate([before_rad, eased_rad * sweep]))
            if share <= SHARE_OF_LIMITS * _CLOSE_ENOUGH:
                break
            eased_rad *= SHARE_OF_LIMITS / share
        amplitudes_rad.append(eased_rad)
        before_rad = np.concatenate([before_rad, eased_rad * sweep])
    return amplitudes_rad


def _lengths(shares: FloatArray, ticks: int) -> list[int]:
    """Split ticks by shares, without losing one to rounding."""
    ends = np.round(np.cumsum(shares) * ticks).astype(int)
    return [int(length) for length in np.diff(ends, prepend=0)]


def _at_least(shares: FloatArray) -> FloatArray:
    """Raise shares to the least one, at the cost of the others in proportion."""
    least = LEAST_SHARE / len(shares)
    low = shares < least
    for _ in shares:
        rest = (1.0 - least * np.count_nonzero(low)) / shares[~low].sum()
        raised = np.where(low, least, shares * rest)
        low = raised <= least
    return raised


def _unit_sweep(band: Band, ticks: int, fades: int, rate_hz: float) -> FloatArray:
    """Sweep of amplitude 1, (ticks,), with raised-cosine ends of ``fades / 2`` ticks each."""
    duration_s = ticks / rate_hz
    t = np.arange(ticks) / rate_hz
    phase = (
        2.0 * pi * (band.start_hz * t + (band.stop_hz - band.start_hz) * t**2 / (2 * duration_s))
    )
    edge = np.minimum(np.arange(ticks), ticks - np.arange(ticks)) / (fades / 2)
    return (0.5 - 0.5 * np.cos(pi * np.minimum(edge, 1.0))) * np.sin(phase)
