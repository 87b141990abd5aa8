"""Transfer functions from motor angle to coupling torque that are to be realised.

A beam of the exact model and a modal model are described alike: the response, the poles of its
modes, the channel of the torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from analysis.identify import ResponseGrid
from rigd.beam import LoadedBeam, clamped_free_eigenvalues
from rigd.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.identify import ModalModel, Plant

Response = Callable[[NDArray[np.complex128]], NDArray[np.complex128]]

BEAM_BAND_HZ: Final = (0.05, 100.0)
"""Band in which a beam is realised."""

_BEYOND: Final = 4
"""Modes beyond the band that may be realised with those in it."""
_MOST_MODES: Final = 40
_OSCILLATING: Final = 0.8
"""Damping ratio above which a mode beyond the band is left to real poles."""
_RESIDUAL_FREQUENCIES: Final = (1.5, 2.2, 3.3, 5.0)
_RESIDUAL_DAMPING: Final = 0.5
_BUTTERWORTH: Final = 2**0.5


class LinearModelError(UserError, ValueError):
    """The model cannot be realised; the message names the cause and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Dynamics:
    """Response from motor angle to coupling torque, with its poles, to be realised.

    Attributes
    ----------
    response : callable
        From s (rad/s, not 0) to N·m/rad, without filters and delay of the torque's channel.
    pairs : ndarray of complex
        Upper poles of conjugate pairs that a realisation may have, in the order in which they
        are added.
    names : tuple of str
        Name of each pair.
    in_band : int
        Number of pairs within the band.
    band_hz : tuple of float
        Band in which the realisation has to be accurate.
    real_poles : tuple of float
        Poles of over-damped modes within it, which every realisation has.
    tool_inertia_kg_m2 : float
        Inertia between sensor and beam, part of the response.
    motor_inertia_kg_m2 : float or None
        Inertia of a motor that the realisation must not make unstable; None: of any.
    filters : tuple of (float, int)
        Time constant (s) and order of low-pass filters in the torque's channel.
    delay_s : float
        By how much the torque is older than the angle.
    """

    response: Response
    pairs: NDArray[np.complex128]
    names: tuple[str, ...]
    in_band: int
    band_hz: tuple[float, float]
    real_poles: tuple[float, ...] = ()
    tool_inertia_kg_m2: float = 0.0
    motor_inertia_kg_m2: float | None = None
    filters: tuple[tuple[float, int], ...] = ()
    delay_s: float = 0.0

    def filtered(self, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the response with the filters, still without the delay.

        Parameters
        ----------
        s : ndarray of complex
            In rad/s.
        """
        through = self.response(s)
        for constant_s, order in self.filters:
            x = constant_s * s
            through = through / (1 + x if order == 1 else 1 + _BUTTERWORTH * x + x * x)
        return through


@dataclass(frozen=True, slots=True, eq=False)
class Uncertain:
    """Dynamics as a function of parameters with known values and covariance.

    Attributes
    ----------
    at : callable
        From parameters, by the names below, to dynamics.
    names : tuple of str
        Names of the uncertain parameters; one with ``ln_`` is a natural logarithm.
    values : ndarray, shape (k,)
    covariance : ndarray, shape (k, k)
    allowed : callable
        Whether parameters are possible.
    """

    at: Callable[[Mapping[str, float]], Dynamics]
    names: tuple[str, ...] = ()
    values: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    allowed: Callable[[Mapping[str, float]], bool] = lambda _parameters: True

    @property
    def nominal(self) -> Dynamics:
        """Dynamics at the values."""
        return self.at(self.named(self.values))

    def named(self, values: NDArray[np.float64]) -> dict[str, float]:
        """Return values by name, shape (k,).

        Parameters
        ----------
        values : ndarray, shape (k,)
        """
        return dict(zip(self.names, values.tolist(), strict=True))


# Beam


def beam_dynamics(plant: Plant) -> Dynamics:
    """Describe a beam with its ends and channels.

    Parameters
    ----------
    plant : Plant

    Raises
    ------
    LinearModelError
        If its modes are too many, or their poles are not found.
    """
    pairs, numbers, real_poles = _beam_poles(plant)
    hz = np.abs(pairs) / (2 * np.pi)
    in_channel = replace(
        plant, delay_s=0.0, filter_time_constant_s=0.0, second_order_filter_time_constant_s=0.0
    )
    filters = (
        (plant.filter_time_constant_s, 1),
        (plant.second_order_filter_time_constant_s, 2),
    )
    return Dynamics(
        response=lambda s: ResponseGrid(s).evaluate(in_channel)[0],
        pairs=pairs,
        names=tuple(f"mode_{number}" for number in numbers),
        in_band=int((hz < BEAM_BAND_HZ[1]).sum()),
        band_hz=BEAM_BAND_HZ,
        real_poles=real_poles,
        tool_inertia_kg_m2=plant.tool_inertia_kg_m2,
        motor_inertia_kg_m2=plant.beam.inertia_kg_m2,
        filters=tuple(each for each in filters if each[0]),
        delay_s=plant.delay_s,
    )


def _beam_poles(
    plant: Plant,
) -> tuple[NDArray[np.complex128], NDArray[np.intp], tuple[float, ...]]:
    """Return upper poles up to some modes beyond the band, their modes, and real poles in it."""
    if plant.tip_mass_kg and any(plant.stiffness_offsets):
        raise LinearModelError(
            "The model has a tip mass and modes of their own stiffness, which together are not "
            "defined; export the modal model, without --beam."
        )
    reach = (2 * np.pi * BEAM_BAND_HZ[1]) ** 2 * plant.beam.density_over_stiffness
    in_band = int(reach**0.25 * plant.beam.length_m / np.pi) + 1
    if in_band > _MOST_MODES:
        raise LinearModelError(
            f"{plant.beam} has some {in_band} modes below {BEAM_BAND_HZ[1]:g} Hz, and a model of "
            f"at most {_MOST_MODES} is exported; check length and stiffness."
        )
    loaded = LoadedBeam(
        plant.beam,
        plant.damping,
        plant.tip_mass_kg,
        plant.root_compliance_rad_per_nm,
        plant.stiffness_offsets,
    )
    poles = loaded.poles(clamped_free_eigenvalues(in_band + _BEYOND + 1))
    lost = np.flatnonzero(np.isnan(poles[:, 0]))
    poles = poles[: lost[0] if lost.size else None]
    upper, edge = poles[:, 0], 2 * np.pi * BEAM_BAND_HZ[1]
    beyond = np.flatnonzero(np.abs(upper) >= edge)
    if lost.size and not beyond.size:
        raise LinearModelError(f"The poles of {loaded} were not found; check its parameters.")
    oscillates = upper.imag > 0
    light = (np.abs(upper) < edge) | (-upper.real < _OSCILLATING * np.abs(upper))
    if beyond.size:
        light[beyond[0] + _BEYOND :] = False
    numbers = np.flatnonzero(oscillates & light)
    real = poles[~oscillates].real.ravel()
    return upper[numbers], numbers + 1, tuple(real[np.abs(real) < edge].tolist())


# Modal model


def modal_dynamics(
    modal: ModalModel, band_hz: tuple[float, float], numbers: Sequence[int]
) -> Dynamics:
    """Describe a modal model within the band of its record.

    The background is a polynomial in s and thus no state space: the two powers beyond the
    acceleration are realised by well-damped pairs of poles above the band.

    Parameters
    ----------
    modal : ModalModel
    band_hz : tuple of float
    numbers : sequence of int
        Number of each mode; 0 for a resonance of something else.
    """
    modes = np.array(modal.poles_rad_s, dtype=np.complex128)
    angle = complex(-_RESIDUAL_DAMPING, math.sqrt(1 - _RESIDUAL_DAMPING**2))
    residual = 2 * np.pi * band_hz[1] * angle * np.array(_RESIDUAL_FREQUENCIES)
    return Dynamics(
        response=modal.response,
        pairs=np.concatenate([modes, residual]),
        names=(
            *(
                f"mode_{number}" if number else f"resonance_{index}"
                for index, number in enumerate(numbers, start=1)
            ),
            *(f"residual_{number}" for number in range(1, residual.size + 1)),
        ),
        in_band=modes.size,
        band_hz=band_hz,
    )
