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

_Mode = tuple[complex, complex]
"""Pole and residue."""


@dataclass(frozen=True, slots=True)
class _Constant:
    """One real constant of a mode: its value, and the mode with it changed."""

    value: Callable[[complex, complex], float]
    changed: Callable[[complex, complex, float], _Mode]


def _ratio(pole: complex) -> float:
    return -pole.real / abs(pole)


def _with_ratio(pole: complex, ratio: float) -> complex:
    ratio = min(max(ratio, -1.0), 1.0)
    return abs(pole) * complex(-ratio, math.sqrt(1 - ratio * ratio))


_CONSTANTS: Final[Mapping[str, _Constant]] = {
    "ln_frequency": _Constant(
        lambda pole, _: math.log(pole.imag / (2 * math.pi)),
        lambda p, r, by: (p * math.exp(by), r),
    ),
    "ln_damping_ratio": _Constant(
        lambda pole, _: math.log(_ratio(pole)),
        lambda p, r, by: (_with_ratio(p, _ratio(p) * math.exp(by)), r),
    ),
    "ln_residue": _Constant(
        lambda _, residue: math.log(abs(residue)), lambda p, r, by: (p, r * math.exp(by))
    ),
    "residue_phase_rad": _Constant(
        lambda _, residue: cmath.phase(residue / 1j), lambda p, r, by: (p, r * cmath.rect(1.0, by))
    ),
}
"""Names end in the number of the mode, from 1 on."""

_BACKGROUND: Final = "background"
"""Its names end in the power of s."""


def constant_value(modal: ModalModel, name: str) -> float | None:
    """Return the value of a constant; None if the model has no such constant.

    Parameters
    ----------
    modal : ModalModel
    name : str
        Such as ``ln_frequency_1`` or ``background_0``.
    """
    kind, number = _split(name)
    if kind == _BACKGROUND and 0 <= number < len(modal.background):
        return modal.background[number]
    if kind in _CONSTANTS and 1 <= number <= len(modal.poles_rad_s):
        pole, residue = modal.poles_rad_s[number - 1], modal.residues[number - 1]
        return _CONSTANTS[kind].value(pole, residue)
    return None


def changed(modal: ModalModel, by: Mapping[str, float]) -> ModalModel:
    """Return the model with constants changed by amounts.

    Parameters
    ----------
    modal : ModalModel
    by : mapping of str to float
    """
    modes = list(zip(modal.poles_rad_s, modal.residues, strict=True))
    background = list(modal.background)
    for name, amount in by.items():
        kind, number = _split(name)
        if kind == _BACKGROUND:
            background[number] += amount
        else:
            modes[number - 1] = _CONSTANTS[kind].changed(*modes[number - 1], amount)
    return ModalModel(
        tuple(pole for pole, _ in modes), tuple(residue for _, residue in modes), tuple(background)
    )


def _split(name: str) -> tuple[str, int]:
    kind, _, number = name.rpartition("_")
    return kind, int(number) if number.isdecimal() else -1
