"""Target precision of a session: quantities and their standard deviations."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf, isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import COEFFICIENT_OF, DAMPING_PARAMETERS, LOGARITHMIC_PARAMETERS, Pole
from rigd.excitation._beam_estimate import (
    BAND_HZ,
    BeamEstimate,
)
from rigd.excitation._signals import ExcitationError

RealArray = NDArray[np.float64]

MODE_QUANTITIES: Final = ("damping", "frequency")
"""Names of the target quantities that belong to a mode."""
QUANTITIES: Final = (*MODE_QUANTITIES, *DAMPING_PARAMETERS)
"""Names of the quantities whose precision can be a target: damping ratio and frequency of modes,
and the parameters of the damping."""

_UNIT_BY_QUANTITY: Final = {"frequency": "Hz"}
"""Unit of each target quantity that has one."""
_USELESS_STD_BY_QUANTITY: Final = {
    "damping": 0.01,
    "zeta": 0.5,
    "alpha": 0.5,
    "gamma": 0.5,
    "lambda": 0.5,
}
"""Standard deviation of each quantity, in its unit, from which a target is useless: the percent
sign was probably forgotten."""
_MAX_MODE_NUMBER: Final = 20
"""Largest number of a mode in a target."""
_DAMPING_KIND_BY_PARAMETER: Final = {
    "zeta": "internal",
    "alpha": "internal",
    "gamma": "external",
    "lambda": "external",
}
"""Kind of damping to which each parameter belongs."""


@dataclass(frozen=True, slots=True)
class Target:
    """Requested standard deviation of a quantity, such as the damping ratio of a mode."""

    quantity: str
    """Name of the quantity, one of `QUANTITIES`."""
    std: float
    """Requested standard deviation: a fraction of the value if `relative`, else in the unit of the
    quantity (a ratio, Hz, s^alpha, s^lambda/m⁴)."""
    is_relative: bool
    """Whether the standard deviation is a fraction of the value."""
    mode: int | None = None
    """Number of the mode, from 1; None: every mode in the band, or a quantity without modes."""

    @property
    def name(self) -> str:
        """Name of the quantity with the number of its mode, for the operator."""
        return self.quantity if self.mode is None else f"{self.quantity} of mode {self.mode}"

    def __str__(self) -> str:
        """Return quantity and requested standard deviation as text, for the operator."""
        unit = _UNIT_BY_QUANTITY.get(self.quantity, "")
        std_text = f"{100 * self.std:g} %" if self.is_relative else f"{self.std:g} {unit}".rstrip()
        return f"{self.name} to {std_text}"


def parse_target(quantity: str, text: str) -> Target:
    """Parse the requested precision of a quantity from an option's text, such as ``2:0.5%``.

    Parameters
    ----------
    quantity
        One of damping, frequency, zeta, alpha, gamma and lambda.
    text
        ``1%``: standard deviation as a percentage of the value, of every mode in the band;
        ``2:0.5%``: of mode 2; ``0.01``: in the unit of the quantity, optionally with the unit:
        ``1:0.002Hz``.

    Raises
    ------
    ExcitationError
        If quantity or text is invalid.

    Examples
    --------
    >>> from rigd.excitation.targets import parse_target
    >>> print(parse_target("damping", "2:0.5%"), "/", parse_target("alpha", "0.01"))
    damping of mode 2 to 0.5 % / alpha to 0.01
    """
    if quantity not in QUANTITIES:
        raise ExcitationError(
            f"The precision of {quantity!r} cannot be requested; choose from "
            f"{', '.join(QUANTITIES)}."
        )
    option, unit = f"--{quantity} {text}", _UNIT_BY_QUANTITY.get(quantity, "")
    example_text = {"damping": "1% or 2:0.5%", "frequency": "0.01% or 1:0.002Hz"}.get(
        quantity, "5% or 0.01"
    )
    mode_text, colon_text, std_text = text.strip().rpartition(":")
    mode_number = None
    if colon_text:
        if quantity not in MODE_QUANTITIES:
            raise ExcitationError(
                f"{option}: {quantity} is not a quantity of a mode; give for example "
                f"{example_text}."
            )
        if not mode_text.strip().isdecimal() or not 1 <= int(mode_text) <= _MAX_MODE_NUMBER:
            raise ExcitationError(
                f"{option}: {mode_text.strip()!r} is not the number of a mode, 1 to "
                f"{_MAX_MODE_NUMBER}; give for example {example_text}."
            )
        mode_number = int(mode_text)
    std_text = std_text.strip()
    is_relative = std_text.endswith("%")
    number_text = std_text.removesuffix("%") if is_relative else std_text.removesuffix(unit)
    try:
        std = float(number_text)
    except ValueError:
        raise ExcitationError(
            f"{option}: {std_text!r} is not a standard deviation; give a percentage of the value "
            f"or a number{f' in {unit}' if unit else ''}, for example {example_text}."
        ) from None
    std = std / 100 if is_relative else std
    if not (isfinite(std) and std > 0.0):
        raise ExcitationError(
            f"{option}: the standard deviation must be finite and more than 0; give for example "
            f"{example_text}."
        )
    useless_std = _USELESS_STD_BY_QUANTITY.get(quantity, inf)
    if not is_relative and std >= useless_std:
        raise ExcitationError(
            f"{option}: a standard deviation of {std:g} says nothing about {quantity}; give less "
            f"than {useless_std:g}; for a percentage of the value write {text.strip()}%."
        )
    return Target(quantity, std, is_relative, mode_number)


@dataclass(frozen=True, slots=True)
class Precision:
    """Standard deviation of one quantity, in comparison with the requested one."""

    target: Target
    """Target of the quantity, with the number of the mode if the quantity belongs to a mode."""
    value: float
    """Estimated value of the quantity."""
    std: float
    """Standard deviation of the estimated value."""
    target_std: float
    """Target standard deviation, in the same unit; 0 for a percentage of a value of 0."""
    impossible_reason: str = ""
    """Reason why no record can determine the quantity; empty if a record can."""

    @property
    def std_to_target_ratio(self) -> float:
        """Ratio of the standard deviation to the requested one; 1 or less: reached."""
        if self.impossible_reason:
            return inf
        return self.std / self.target_std if self.target_std > 0.0 else inf

    @property
    def reached(self) -> bool:
        """Whether the quantity's standard deviation has reached its target."""
        return self.std_to_target_ratio <= 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Quantities:
    """Quantities with a requested precision, as linear functions of the beam's parameters."""

    quantity_precisions: tuple[Precision, ...]
    """Value and target of each quantity; the standard deviations are still unknown."""
    gradients: RealArray
    """Derivatives of the q quantities with respect to the k free parameters, shape (q, k)."""

    @classmethod
    def from_targets(cls, targets: Iterable[Target], estimate: BeamEstimate) -> "Quantities":
        """Return the quantities with a requested precision, linearised at an estimate of the beam.

        Parameters
        ----------
        targets
            Targets. A target without a mode number applies to every mode in the band.
        estimate
            Estimate at which the quantities are linearised.
        """
        estimated_modes = estimate.modes()
        quantity_items, gradients = [], []
        for joint_target in targets:
            for single_target in _targets_of_modes(joint_target, estimated_modes):
                quantity_value, quantity_gradient, impossible_reason = _linearise(
                    single_target, estimate, estimated_modes
                )
                target_std = (
                    single_target.std * abs(quantity_value)
                    if single_target.is_relative
                    else single_target.std
                )
                if target_std == 0.0 and not impossible_reason:
                    impossible_reason = (
                        f"{single_target.name} is 0: no percentage of it is a precision"
                    )
                quantity_items.append(
                    Precision(single_target, quantity_value, inf, target_std, impossible_reason)
                )
                gradients.append(quantity_gradient)
        return cls(
            tuple(quantity_items),
            np.array(gradients).reshape(len(quantity_items), len(estimate.free_parameters)),
        )

    def std_to_target_ratios(self, covariance: RealArray) -> RealArray:
        """Return the ratio of each quantity's standard deviation to its target, shape (q,).

        The ratio is 0 for a quantity that no record can determine.

        Parameters
        ----------
        covariance
            Covariance of the free parameters, shape (k, k).
        """
        variances = np.einsum("qi,ij,qj->q", self.gradients, covariance, self.gradients)
        target_std = np.array(
            [
                inf if precision.impossible_reason else precision.target_std
                for precision in self.quantity_precisions
            ]
        )
        std_to_target_ratios: RealArray = np.sqrt(np.maximum(variances, 0.0)) / target_std
        return std_to_target_ratios

    def precisions(self, covariance: RealArray) -> tuple[Precision, ...]:
        """Return each quantity's standard deviation for a covariance (k, k) of the parameters."""
        return tuple(
            replace(
                precision,
                std=sqrt(max(float(quantity_gradient @ covariance @ quantity_gradient), 0.0)),
            )
            for precision, quantity_gradient in zip(
                self.quantity_precisions, self.gradients, strict=True
            )
        )


def _targets_of_modes(given_target: Target, modes: tuple[Pole, ...]) -> list[Target]:
    """Return a target for each mode, if the given target applies to every mode in the band."""
    if given_target.quantity not in MODE_QUANTITIES or given_target.mode is not None:
        return [given_target]
    return [replace(given_target, mode=estimated_mode.mode) for estimated_mode in modes]


def _linearise(
    given_target: Target, estimate: BeamEstimate, modes: tuple[Pole, ...]
) -> tuple[float, RealArray, str]:
    """Return the value of a quantity and its derivatives for the beam's parameters, shape (k,).

    The third result is the reason why no record can determine the quantity, or an empty text.
    """
    quantity_gradient = np.zeros(len(estimate.free_parameters))
    quantity_name = given_target.quantity
    if quantity_name in MODE_QUANTITIES:
        target_mode = next(
            (
                estimated_mode
                for estimated_mode in modes
                if estimated_mode.mode == given_target.mode
            ),
            None,
        )
        if target_mode is None:
            mode_numbers = ", ".join(str(estimated_mode.mode) for estimated_mode in modes) or "none"
            return (
                0.0,
                quantity_gradient,
                f"mode {given_target.mode} is not below {BAND_HZ:g} Hz (seen: {mode_numbers})",
            )
        if quantity_name == "damping":
            return target_mode.damping_ratio, target_mode.damping_ratio_derivative, ""
        return target_mode.frequency_hz, target_mode.frequency_derivative_hz, ""
    quantity_value = estimate.parameter_values[quantity_name]
    coefficient_name = COEFFICIENT_OF.get(quantity_name, quantity_name)
    if (
        estimate.parameter_values[coefficient_name] == 0.0
        or quantity_name not in estimate.free_parameters
    ):
        impossible_reason = (
            "is absent"
            if estimate.parameter_values[coefficient_name] == 0.0
            else f"has {quantity_name} fixed"
        )
        return (
            quantity_value,
            quantity_gradient,
            f"{_DAMPING_KIND_BY_PARAMETER[quantity_name]} damping {impossible_reason} in the "
            "estimate so far",
        )
    quantity_gradient[estimate.free_parameters.index(quantity_name)] = (
        quantity_value if quantity_name in LOGARITHMIC_PARAMETERS else 1.0
    )
    return quantity_value, quantity_gradient, ""
