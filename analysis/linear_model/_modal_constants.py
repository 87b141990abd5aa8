"""Uncertain constants of a modal model, by the names that the covariance of a fit has for them."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from analysis.identify import ModalModel

if TYPE_CHECKING:
    from collections.abc import Mapping

_PoleAndResidue = tuple[complex, complex]
"""Pole and residue of a mode."""


@dataclass(frozen=True, slots=True)
class _ModalConstant:
    """One real constant of a mode: functions that return its value, and that change it."""

    value: Callable[[complex, complex], float]
    change: Callable[[complex, complex, float], _PoleAndResidue]


def _damping_ratio(pole: complex) -> float:
    """Return the damping ratio of a pole."""
    return -pole.real / abs(pole)


def _with_damping_ratio(pole: complex, ratio: float) -> complex:
    """Return a pole of the same magnitude with another damping ratio."""
    ratio = min(max(ratio, -1.0), 1.0)
    return abs(pole) * complex(-ratio, math.sqrt(1 - ratio * ratio))


_MODAL_CONSTANTS: Final[Mapping[str, _ModalConstant]] = {
    "ln_frequency": _ModalConstant(
        lambda pole, _: math.log(pole.imag / (2 * math.pi)),
        lambda p, r, by: (p * math.exp(by), r),
    ),
    "ln_damping_ratio": _ModalConstant(
        lambda pole, _: math.log(_damping_ratio(pole)),
        lambda p, r, by: (_with_damping_ratio(p, _damping_ratio(p) * math.exp(by)), r),
    ),
    "ln_residue": _ModalConstant(
        lambda _, residue: math.log(abs(residue)), lambda p, r, by: (p, r * math.exp(by))
    ),
    "residue_phase_rad": _ModalConstant(
        lambda _, residue: cmath.phase(residue / 1j), lambda p, r, by: (p, r * cmath.rect(1.0, by))
    ),
}
"""Constants of a mode by the beginning of their names, which end in the number of the mode, from
1."""

_BACKGROUND_NAME: Final = "background"
"""Beginning of the names of background coefficients, which end in the power of s."""


def constant_value(modal: ModalModel, name: str) -> float | None:
    """Return the value of a constant of a modal model, or None if there is no such constant.

    Parameters
    ----------
    modal : ModalModel
        Fitted modal model.
    name : str
        Name of the constant, such as ``ln_frequency_1`` or ``background_0``.
    """
    kind, number = _split_name(name)
    if kind == _BACKGROUND_NAME and 0 <= number < len(modal.background):
        return modal.background[number]
    if kind in _MODAL_CONSTANTS and 1 <= number <= len(modal.poles_rad_s):
        pole, residue = modal.poles_rad_s[number - 1], modal.residues[number - 1]
        return _MODAL_CONSTANTS[kind].value(pole, residue)
    return None


def with_changed_constants(modal: ModalModel, by: Mapping[str, float]) -> ModalModel:
    """Return a modal model with some of its constants changed.

    Parameters
    ----------
    modal : ModalModel
        Fitted modal model.
    by : mapping of str to float
        Change of each constant, by name.
    """
    modes = list(zip(modal.poles_rad_s, modal.residues, strict=True))
    background = list(modal.background)
    for name, amount in by.items():
        kind, number = _split_name(name)
        if kind == _BACKGROUND_NAME:
            background[number] += amount
        else:
            modes[number - 1] = _MODAL_CONSTANTS[kind].change(*modes[number - 1], amount)
    return ModalModel(
        tuple(pole for pole, _ in modes), tuple(residue for _, residue in modes), tuple(background)
    )


def _split_name(name: str) -> tuple[str, int]:
    """Split the name of a constant into its beginning and its number, -1 without a number."""
    kind, _, number = name.rpartition("_")
    return kind, int(number) if number.isdecimal() else -1
