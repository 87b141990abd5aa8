"""Numbers that a session's file states of rig and specimen, each within what can be.

A unit mistaken for another, or a file from somewhere else, is told here by its key; no estimator
could say so half as well, and some would overflow.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from analysis.record_checks import RecordError
from rigd.beam import Beam

if TYPE_CHECKING:
    from rigd.session import Session

_BEAM_RANGES: Final = {
    "beam_length_m": (1e-3, 1e3, "m"),
    "beam_density_kg_per_m": (1e-6, 1e6, "kg/m"),
    "beam_bending_stiffness_n_m2": (1e-9, 1e15, "N·m²"),
}
_MAX_INERTIA_KG_M2: Final = 1e3
_MAX_DELAY_S: Final = 1.0
_FIRST_ROOT: Final = 1.8751040687119611
"""Of 1 + cos z cosh z: the first mode of a clamped beam has (root / length)² √(EI/rho) rad/s."""

_LEAST_PERIODS: Final = 0.1
"""Periods of the first mode that a record holds at least, with a beam's data ten times off."""


def stated_rate_hz(session: Session) -> float:
    """Rate of the ticks in Hz.

    Raises
    ------
    RecordError
        It is not positive.
    """
    rate_hz = session.number("rate_hz")
    if not rate_hz > 0.0:
        raise _wrong(session, "rate_hz", rate_hz, "Hz", "must be positive")
    return rate_hz


def stated_beam(session: Session, rate_hz: float, ticks: int) -> Beam:
    """Specimen, of which the record can show the first mode.

    Parameters
    ----------
    session : Session
    rate_hz : float
    ticks : int
        Length of the record.

    Raises
    ------
    RecordError
        A value, or the mode's frequency that they give together, cannot be.
    """
    values = []
    for key, (low, high, unit) in _BEAM_RANGES.items():
        value = session.number(key)
        if not value > 0.0:
            raise _wrong(session, key, value, unit, "must be positive")
        if not low <= value <= high:
            raise _wrong(session, key, value, unit, f"must lie between {low:g} and {high:g}")
        values.append(value)
    length_m, density, stiffness = values
    first_hz = (_FIRST_ROOT / length_m) ** 2 * math.sqrt(stiffness / density) / (2 * math.pi)
    lowest_hz = _LEAST_PERIODS * rate_hz / ticks
    if not lowest_hz < first_hz < rate_hz / 2:
        raise RecordError(
            f"{session.path}: with beam_length_m {length_m:g} m, beam_density_kg_per_m {density:g} "
            f"kg/m and beam_bending_stiffness_n_m2 {stiffness:g} N·m² the first mode would be at "
            f"{first_hz:.3g} Hz, which {ticks / rate_hz:.3g} s at {rate_hz:g} Hz cannot show; "
            + (
                "record longer, or correct the file's metadata if these are wrong."
                if first_hz <= lowest_hz
                else "correct the file's metadata."
            )
        )
    return Beam(length_m=length_m, density_kg_per_m=density, bending_stiffness_n_m2=stiffness)


def stated_tool_inertia_kg_m2(session: Session) -> float:
    """Inertia between torque sensor and beam, 0 if the file has none.

    Raises
    ------
    RecordError
        It is negative, or that of a vehicle.
    """
    key, unit = "tool_inertia_kg_m2", "kg·m²"
    inertia_kg_m2 = session.number(key, 0.0)
    if inertia_kg_m2 < 0.0:
        raise _wrong(session, key, inertia_kg_m2, unit, "an inertia cannot be negative")
    if inertia_kg_m2 > _MAX_INERTIA_KG_M2:
        raise _wrong(session, key, inertia_kg_m2, unit, f"must not exceed {_MAX_INERTIA_KG_M2:g}")
    return inertia_kg_m2


def stated_delay_s(session: Session, key: str) -> float:
    """Age of a channel's values at their time stamps in s, 0 if the file has none.

    Raises
    ------
    RecordError
        It is longer than any device's.
    """
    delay_s = session.number(key, 0.0)
    if abs(delay_s) > _MAX_DELAY_S:
        raise _wrong(session, key, delay_s, "s", f"must lie within ±{_MAX_DELAY_S:g}")
    return delay_s


def stated_torque_filter_s(session: Session) -> tuple[float, float]:
    """Time constants of the torque channel's low-pass filter of first and of second order.

    ``1 / (2 pi torque_filter_hz)`` for the order stated (`torque_filter_order`, 1 without it), 0
    for the other; both 0 if the file states no filter.

    Raises
    ------
    RecordError
        There is no such corner frequency, or the order is neither 1 nor 2.
    """
    corner_hz = session.number("torque_filter_hz", math.inf)
    order = session.number("torque_filter_order", 1.0)
    if not corner_hz > 0.0:
        raise _wrong(session, "torque_filter_hz", corner_hz, "Hz", "must be positive")
    if order not in (1.0, 2.0):
        raise _wrong(session, "torque_filter_order", order, "", "must be 1 or 2 (Butterworth)")
    constant_s = 1 / (2 * math.pi * corner_hz)
    return (constant_s, 0.0) if order == 1.0 else (0.0, constant_s)


def _wrong(session: Session, key: str, value: float, unit: str, rule: str) -> RecordError:
    return RecordError(
        f"{session.path}: {key} is {value:g} {unit}, but {rule}; correct the file's metadata."
    )
