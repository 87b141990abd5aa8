"""Transfer functions from motor angle to coupling torque that are to be realised.

A beam of the exact model and a modal model are described alike: by the response, the poles of the
modes, and the delay and filters of the torque channel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import ResponseGrid, clamped_free_eigenvalues
from rigd.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.identify import ModalModel
    from rigd.beam import Plant

ResponseFunction = Callable[[NDArray[np.complex128]], NDArray[np.complex128]]
"""Function from s in rad/s to a frequency response."""

BEAM_BAND_HZ: Final = (0.05, 100.0)
"""Band in which a beam is realised, in hertz."""

_MODES_BEYOND_BAND: Final = 4
"""Number of modes beyond the band that may be realised in addition to those within it."""
_MAX_BEAM_MODES: Final = 40
"""Largest number of modes of an exported beam."""

_MAX_OSCILLATING_DAMPING_RATIO: Final = 0.8
"""Smallest damping ratio at which a mode beyond the band is represented by real poles."""
_RESIDUAL_FREQUENCY_RATIOS: Final = (1.5, 2.2, 3.3, 5.0)
"""Frequencies of the pole pairs that represent the background of a modal model, relative to the end
of the band."""

_RESIDUAL_DAMPING_RATIO: Final = 0.5
"""Damping ratio of the pole pairs that represent the background of a modal model."""

_BUTTERWORTH_COEFFICIENT: Final = 2**0.5
"""Coefficient of s in the denominator of a second-order Butterworth filter."""


class LinearModelError(UserError, ValueError):
    """Error if a model cannot be exported. The message names the cause and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Dynamics:
    """Response from motor angle to coupling torque, with the poles that a state space of it has.

    Attributes
    ----------
    response : callable
        Function from s (rad/s, not 0) to N·m/rad, without filters and delay of the torque channel.
    pole_pairs : ndarray of complex
        Poles with positive imaginary part, in rad/s, of the conjugate pairs that a realisation may
        have. A realisation with n pairs has the first n.
    pair_names : tuple of str
        Name of each pair.
    pair_count_in_band : int
        Number of pairs within the band.
    band_hz : tuple of float
        Band in which the realisation has to be accurate.
    real_poles : tuple of float
        Poles of over-damped modes within the band in rad/s, which every realisation has.
    tool_inertia_kg_m2 : float
        Inertia between sensor and beam, part of the response.
    motor_inertia_kg_m2 : float or None
        Inertia of a motor that the realisation must not make unstable; None if it may.
    torque_filters : tuple of (float, int)
        Time constant (s) and order of each low-pass filter in the torque channel.
    delay_s : float
        Delay of the torque relative to the angle.
    """

    response: ResponseFunction
    pole_pairs: NDArray[np.complex128]
    pair_names: tuple[str, ...]
    pair_count_in_band: int
    band_hz: tuple[float, float]
    real_poles: tuple[float, ...] = ()
    tool_inertia_kg_m2: float = 0.0
    motor_inertia_kg_m2: float | None = None
    torque_filters: tuple[tuple[float, int], ...] = ()
    delay_s: float = 0.0

    def filtered_response(self, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the response in N·m/rad with the filters of the torque channel, without delay.

        The points s are in rad/s.
        """
        filtered_response = self.response(s)
        for time_constant_s, filter_order in self.torque_filters:
            x = time_constant_s * s
            filtered_response = filtered_response / (
                1 + x if filter_order == 1 else 1 + _BUTTERWORTH_COEFFICIENT * x + x * x
            )
        return filtered_response


@dataclass(frozen=True, slots=True, eq=False)
class UncertainDynamics:
    """Motor-to-torque dynamics as a function of parameters with estimates and covariance.

    Attributes
    ----------
    dynamics_of : callable
        Function from parameters by name to dynamics.
    parameter_names : tuple of str
        Names of the uncertain parameters. A name with ``ln_`` denotes a natural logarithm.
    parameter_values : ndarray, shape (k,)
        Estimates of the parameters.
    covariance : ndarray, shape (k, k)
        Covariance of the estimates.
    is_possible : callable
        Function that returns whether parameters are physically possible.
    """

    dynamics_of: Callable[[Mapping[str, float]], Dynamics]
    parameter_names: tuple[str, ...] = ()
    parameter_values: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    is_possible: Callable[[Mapping[str, float]], bool] = lambda _parameters: True

    @property
    def nominal_dynamics(self) -> Dynamics:
        """Return the dynamics for the estimated values of the parameters."""
        return self.dynamics_of(self.parameters_by_name(self.parameter_values))

    def parameters_by_name(self, parameter_values: NDArray[np.float64]) -> dict[str, float]:
        """Return parameter values as a dict by name; they are in the order of `parameter_names`."""
        return dict(zip(self.parameter_names, parameter_values.tolist(), strict=True))


# Beam


def beam_dynamics(plant: Plant) -> Dynamics:
    """Return the motor-to-torque dynamics of a beam with tip mass, clamp and torque channel.

    Raise `LinearModelError` if the beam has too many modes in the band, or their poles are not
    found.
    """
    pole_pairs_rad_s, mode_numbers, real_poles = _beam_poles(plant)
    pole_hz = np.abs(pole_pairs_rad_s) / (2 * np.pi)
    plant_without_channel = replace(
        plant, delay_s=0.0, filter_time_constant_s=0.0, second_order_filter_time_constant_s=0.0
    )
    torque_filters = (
        (plant.filter_time_constant_s, 1),
        (plant.second_order_filter_time_constant_s, 2),
    )
    return Dynamics(
        response=lambda s: ResponseGrid(s).evaluate(plant_without_channel)[0],
        pole_pairs=pole_pairs_rad_s,
        pair_names=tuple(f"mode_{mode_number}" for mode_number in mode_numbers),
        pair_count_in_band=int((pole_hz < BEAM_BAND_HZ[1]).sum()),
        band_hz=BEAM_BAND_HZ,
        real_poles=real_poles,
        tool_inertia_kg_m2=plant.tool_inertia_kg_m2,
        motor_inertia_kg_m2=plant.beam.inertia_kg_m2,
        torque_filters=tuple(torque_filter for torque_filter in torque_filters if torque_filter[0]),
        delay_s=plant.delay_s,
    )


def _beam_poles(
    plant: Plant,
) -> tuple[NDArray[np.complex128], NDArray[np.intp], tuple[float, ...]]:
    """Return the upper poles of the modes of a beam, their mode numbers, and the real poles.

    The upper poles include a few modes beyond the band. The real poles are those within the band.
    """
    quartic_eigenvalue_limit = (
        2 * np.pi * BEAM_BAND_HZ[1]
    ) ** 2 * plant.beam.density_over_stiffness
    mode_count = int(quartic_eigenvalue_limit**0.25 * plant.beam.length_m / np.pi) + 1
    if mode_count > _MAX_BEAM_MODES:
        raise LinearModelError(
            f"{plant.beam} has about {mode_count} modes below {BEAM_BAND_HZ[1]:g} Hz, and a model "
            f"of at most {_MAX_BEAM_MODES} is exported; check length and stiffness."
        )
    poles_rad_s = plant.poles(clamped_free_eigenvalues(mode_count + _MODES_BEYOND_BAND + 1))
    missing_modes = np.flatnonzero(np.isnan(poles_rad_s[:, 0]))
    poles_rad_s = poles_rad_s[: missing_modes[0] if missing_modes.size else None]
    upper_poles_rad_s, band_end_rad_s = poles_rad_s[:, 0], 2 * np.pi * BEAM_BAND_HZ[1]
    modes_beyond_band = np.flatnonzero(np.abs(upper_poles_rad_s) >= band_end_rad_s)
    if missing_modes.size and not modes_beyond_band.size:
        raise LinearModelError(f"The poles of {plant} were not found; check its parameters.")
    is_oscillating = upper_poles_rad_s.imag > 0
    is_realised = (np.abs(upper_poles_rad_s) < band_end_rad_s) | (
        -upper_poles_rad_s.real < _MAX_OSCILLATING_DAMPING_RATIO * np.abs(upper_poles_rad_s)
    )
    if modes_beyond_band.size:
        is_realised[modes_beyond_band[0] + _MODES_BEYOND_BAND :] = False
    mode_indices = np.flatnonzero(is_oscillating & is_realised)
    real_poles_rad_s = poles_rad_s[~is_oscillating].real.ravel()
    return (
        upper_poles_rad_s[mode_indices],
        mode_indices + 1,
        tuple(real_poles_rad_s[np.abs(real_poles_rad_s) < band_end_rad_s].tolist()),
    )


# Modal model


def modal_dynamics(
    modal_model: ModalModel, band_hz: tuple[float, float], mode_numbers: Sequence[int]
) -> Dynamics:
    """Return the motor-to-torque dynamics of a modal model within the band of its record.

    The background is a polynomial in s, which no state space realises: its two powers above s² are
    approximated by well-damped pairs of poles above the band. The number of a resonance that is not
    of the beam is 0.
    """
    modal_poles = np.array(modal_model.poles_rad_s, dtype=np.complex128)
    normalized_pole = complex(-_RESIDUAL_DAMPING_RATIO, math.sqrt(1 - _RESIDUAL_DAMPING_RATIO**2))
    background_poles = (
        2 * np.pi * band_hz[1] * normalized_pole * np.array(_RESIDUAL_FREQUENCY_RATIOS)
    )
    return Dynamics(
        response=modal_model.response,
        pole_pairs=np.concatenate([modal_poles, background_poles]),
        pair_names=(
            *(
                f"mode_{mode_number}" if mode_number else f"resonance_{pole_number}"
                for pole_number, mode_number in enumerate(mode_numbers, start=1)
            ),
            *(f"residual_{pole_number}" for pole_number in range(1, background_poles.size + 1)),
        ),
        pair_count_in_band=modal_poles.size,
        band_hz=band_hz,
    )
