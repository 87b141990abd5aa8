"""Constants of a modal model by their names in the covariance of a fit: values and changes."""

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
    """Kind of constant of a mode, such as its damping ratio.

    ``value_of(pole, residue)`` is the constant. ``with_change(pole, residue, amount)`` returns the
    pole and the residue for which the constant is larger by the amount.
    """

    value_of: Callable[[complex, complex], float]
    with_change: Callable[[complex, complex, float], _PoleAndResidue]


def _damping_ratio(pole: complex) -> float:
    """Return the damping ratio of a complex pole, negative for an unstable one."""
    return -pole.real / abs(pole)


def _with_damping_ratio(pole: complex, damping_ratio: float) -> complex:
    """Return a pole of the same magnitude with another damping ratio."""
    damping_ratio = min(max(damping_ratio, -1.0), 1.0)
    return abs(pole) * complex(-damping_ratio, math.sqrt(1 - damping_ratio * damping_ratio))


_MODAL_CONSTANTS: Final[Mapping[str, _ModalConstant]] = {
    "ln_frequency": _ModalConstant(
        lambda pole, _: math.log(pole.imag / (2 * math.pi)),
        lambda p, r, amount: (p * math.exp(amount), r),
    ),
    "ln_damping_ratio": _ModalConstant(
        lambda pole, _: math.log(_damping_ratio(pole)),
        lambda p, r, amount: (_with_damping_ratio(p, _damping_ratio(p) * math.exp(amount)), r),
    ),
    "ln_residue": _ModalConstant(
        lambda _, residue: math.log(abs(residue)), lambda p, r, amount: (p, r * math.exp(amount))
    ),
    "residue_phase_rad": _ModalConstant(
        lambda _, residue: cmath.phase(residue / 1j),
        lambda p, r, amount: (p, r * cmath.rect(1.0, amount)),
    ),
}
"""Constants of a mode by their names without the number of the mode (from 1) at the end."""

_BACKGROUND_NAME: Final = "background"
"""Name of a background coefficient without the power of s at its end."""


def constant_value(modal: ModalModel, constant_name: str) -> float | None:
    """Return the value of a constant of a modal model, or None if there is no such constant.

    Names are, for example, ``ln_frequency_1`` and ``background_0``.
    """
    name_prefix, name_number = _split_mode_number(constant_name)
    if name_prefix == _BACKGROUND_NAME and 0 <= name_number < len(modal.background):
        return modal.background[name_number]
    if name_prefix in _MODAL_CONSTANTS and 1 <= name_number <= len(modal.poles_rad_s):
        pole, residue = modal.poles_rad_s[name_number - 1], modal.residues[name_number - 1]
        return _MODAL_CONSTANTS[name_prefix].value_of(pole, residue)
    return None


def with_changed_constants(modal: ModalModel, constant_changes: Mapping[str, float]) -> ModalModel:
    """Return a modal model with some of its constants changed.

    `constant_changes` are the amounts to be added to the constants, by name.
    """
    poles_and_residues = list(zip(modal.poles_rad_s, modal.residues, strict=True))
    background_terms = list(modal.background)
    for constant_name, added_amount in constant_changes.items():
        name_prefix, name_number = _split_mode_number(constant_name)
        if name_prefix == _BACKGROUND_NAME:
            background_terms[name_number] += added_amount
        else:
            poles_and_residues[name_number - 1] = _MODAL_CONSTANTS[name_prefix].with_change(
                *poles_and_residues[name_number - 1], added_amount
            )
    return ModalModel(
        tuple(pole for pole, _ in poles_and_residues),
        tuple(residue for _, residue in poles_and_residues),
        tuple(background_terms),
    )


def _split_mode_number(constant_name: str) -> tuple[str, int]:
    """Split a name such as "ln_frequency_2" into "ln_frequency" and 2; -1 if there is no number."""
    name_prefix, _, number_text = constant_name.rpartition("_")
    return name_prefix, int(number_text) if number_text.isdecimal() else -1
