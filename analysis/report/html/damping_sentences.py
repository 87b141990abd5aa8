"""What a fit says of the damping, in two or three sentences with intervals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from analysis.report.html.table import estimate
from analysis.report.record_figure_bands import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Collection

    from analysis.whole_record import DampingSize, ModeEstimate, RecordFit

_SMALL = 1e-3
"""Sizes below are told in the power of ten that zeta has in the paper."""


def damping_sentences(
    fit: RecordFit, withheld: Collection[str], visible: Collection[int] | None = None
) -> tuple[str, ...]:
    """Say how the modes are damped, and by which internal and external damping.

    Parameters
    ----------
    fit : RecordFit
    withheld : collection of str
        Orders that the data do not support.
    visible : collection of int, optional
        Modes that the record shows, by default all: of others nothing is said.

    Returns
    -------
    tuple of str
        95 % intervals in brackets.
    """
    found = []
    shown = [_mode(mode) for mode in fit.modes if visible is None or mode.number in visible]
    if shown:
        found.append(
            f"The antenna's damping ratio is {_listed(shown)} (in brackets: 95 % intervals)."
        )
    found.extend(
        f"The {what} damping is {_size(size, symbol, unit)}{_order(fit, order, name, withheld)}."
        for what, size, symbol, unit, order, name in (
            ("internal", fit.internal, ("ζ", "ω^α"), "", "alpha", "α"),
            ("external", fit.external, ("γ", "ω^λ"), " 1/m⁴", "lambda", "λ"),
        )
        # A size that holds for one assumed order says nothing of the antenna.
        if size is not None and (size.omega_rad_s is not None or order not in withheld)
    )
    return tuple(found)


def _mode(mode: ModeEstimate) -> str:
    ratio, std = mode.damping_ratio, mode.damping_ratio_std
    value, low, high = estimate(
        (ratio, ratio - NORMAL_95 * std, ratio + NORMAL_95 * std), std, 100.0
    )
    return f"{value.text} % ({low.text} to {high.text} %) at {mode.frequency_hz:.4g} Hz"


def _size(size: DampingSize, symbols: tuple[str, str], unit: str) -> str:
    coefficient, power = symbols
    half = NORMAL_95 * size.std
    factor, tenth = (1e5, " · 10⁻⁵") if size.value < _SMALL else (1.0, "")
    value, low, high = estimate(
        (size.value, size.value - half, size.value + half), size.std, factor
    )
    bounds = f"{value.text} ({low.text} to {high.text}){tenth}{unit}"
    if size.omega_rad_s is None:
        return f"{coefficient}\u00a0=\u00a0{bounds}"
    hertz = size.omega_rad_s / (2 * math.pi)
    return f"{coefficient}\u00a0{power}\u00a0=\u00a0{bounds} at {hertz:.3g} Hz"


def _order(fit: RecordFit, name: str, symbol: str, withheld: Collection[str]) -> str:
    interval = fit.interval.get(name)
    if name not in fit.structure.free:
        return f", of the fixed order {symbol}\u00a0=\u00a0{fit.parameters[name]:g}"
    if interval is None or name in withheld:
        return f"; its order {symbol} is not known"
    value, low, high = estimate((fit.parameters[name], *interval), fit.std[name])
    return f", of the order {symbol}\u00a0=\u00a0{value.text} ({low.text} to {high.text})"


def _listed(parts: list[str]) -> str:
    if len(parts) == 1:
        return parts[0]
    return f"{', '.join(parts[:-1])} and {parts[-1]}"
