"""Narrow bands round modes: where they lie, how far the reference goes in each, and for how long.

What a sweep tells of the damping is measured by the Fisher information of the exact model
(`rigd.beam`): of the torque, white noise of any size on it, for the damping's parameters beside
density, stiffness, delay and tool inertia. Of a band swept slowly it is proportional to the time
spent there, so that the times follow from the information of each band in a second.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rigd.beam import PARAMETERS, Beam, Damping, transfer_and_gradient, undamped_frequencies_rad_s
from rigd.excitation.mode_table import FoundMode

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_POINTS: Final = 64
"""Frequencies in a band at which the information is computed."""

_ROUNDS: Final = 500
_RIDGE: Final = 1e-12
"""Of the information, relatively: few bands leave some combinations of parameters untold."""


class Foresight(Protocol):
    """What is known of the rig before it moves."""

    @property
    def beam(self) -> Beam:
        """The specimen as the profile has it."""

    def tracking(self, frequency_hz: Real) -> Complex:
        """Angle over reference, of the shape given."""

    def share_of_limits(self, reference_rad: Real) -> float:
        """Largest share of a limit that a reference (n,) is predicted to take."""


@dataclass(frozen=True, slots=True)
class Band:
    """A narrow band that is swept linearly from its lower to its upper end."""

    mode: FoundMode
    start_hz: float
    stop_hz: float

    @classmethod
    def of_mode(cls, mode: FoundMode, widths: float) -> "Band":
        """Lay one round a mode, so many half-power widths to either side of where it may lie."""
        half_hz = widths * 2.0 * mode.damping_ratio * mode.frequency_hz + mode.uncertainty_hz
        # A sweep needs a period: strongly damped modes would begin at 0 Hz or below.
        return cls(
            mode, max(mode.frequency_hz - half_hz, 0.2 * mode.frequency_hz),
            mode.frequency_hz + half_hz,
        )  # fmt: skip

    @property
    def decay_s(self) -> float:
        """Time constant with which the mode rings up and down."""
        return 1.0 / (2.0 * pi * self.mode.frequency_hz * self.mode.damping_ratio)


def shares_of_time(bands: Sequence[Band], amplitudes_rad: Sequence[float], rig: Foresight) -> Real:
    """Split the time over bands so that the damping comes out most precisely.

    The geometric mean of the standard deviations of the damping's parameters is minimised, with all
    other parameters free, by multiplicative steps (D. M. Titterington, 1976; for other criteria
    than the determinant S. D. Silvey, D. M. Titterington and B. Torsney, 1978).

    Parameters
    ----------
    bands, amplitudes_rad
        Bands and what the reference's amplitude is in each.
    rig
        Tells how much of it becomes angle.

    Returns
    -------
    ndarray, shape (len(bands),)
        Shares, together 1.
    """
    damping = damping_of([band.mode for band in bands], rig.beam)
    rates, wanted = _information_rates(bands, amplitudes_rad, rig, damping)
    scale = np.sqrt(np.einsum("bii->i", rates))
    rates = rates / np.outer(scale, scale)
    shares = np.full(len(bands), 1.0 / len(bands))
    for _ in range(_ROUNDS):
        information = np.tensordot(shares, rates, axes=1)
        covariance = np.linalg.inv(information + _RIDGE * np.eye(len(scale)))
        lines = covariance[:wanted]
        of_bands = np.einsum("pi,bij,pj->bp", lines, rates, lines) / np.diag(covariance)[:wanted]
        shares = shares * np.sqrt(of_bands.sum(axis=1))
        shares /= shares.sum()
    return shares


def damping_of(modes: Sequence[FoundMode], beam: Beam) -> Damping:
    """Damping of first order, internal and external, that gives modes their damping ratios.

    By relative least squares of ``2 ratio = zeta omega + gamma / ((rho/EI) omega)``, neither
    coefficient negative.
    """
    omega = np.array([2.0 * pi * mode.frequency_hz for mode in modes])
    ratio = np.array([mode.damping_ratio for mode in modes])
    columns = np.stack([omega, 1.0 / (beam.density_over_stiffness * omega)]) / (2.0 * ratio)
    both = np.linalg.lstsq(columns.T, np.ones(len(modes)), rcond=None)[0]
    if (both < 0.0).any():
        alone = columns.sum(axis=1) / (columns**2).sum(axis=1)
        left = ((alone[:, None] * columns - 1.0) ** 2).sum(axis=1)
        both = np.where(np.arange(2) == np.argmin(left), alone, 0.0)
    return Damping(zeta=float(both[0]), alpha=1.0, gamma=float(both[1]), lambda_=1.0)


def _information_rates(
    bands: Sequence[Band], amplitudes_rad: Sequence[float], rig: Foresight, damping: Damping
) -> tuple[Real, int]:
    """Information in a second of each band, (bands, k, k); the damping's parameters come first.

    A coefficient counts relatively. The order of a damping that is absent cannot be told.
    """
    factors = {"zeta": damping.zeta, "alpha": 1.0, "gamma": damping.gamma, "lambda": 1.0}
    orders = {"alpha": damping.zeta, "lambda": damping.gamma}
    names = [n for n, factor in factors.items() if factor > 0.0 and orders.get(n, 1.0) > 0.0]
    rates = []
    for band, amplitude_rad in zip(bands, amplitudes_rad, strict=True):
        frequency_hz = np.linspace(band.start_hz, band.stop_hz, _POINTS)
        s = 2j * pi * frequency_hz
        beam = _tuned(rig.beam, band.mode.frequency_hz)
        g, gradient = transfer_and_gradient(s, beam, damping, (*names, *PARAMETERS[4:]))
        gradient[: len(names)] *= np.array([factors[name] for name in names])[:, None]
        rows = np.concatenate([gradient, [-s * g, s * s]])
        rows *= amplitude_rad * rig.tracking(frequency_hz)
        rates.append((rows.conj() @ rows.T).real / _POINTS)
    return np.array(rates), len(names)


def _tuned(beam: Beam, frequency_hz: float) -> Beam:
    """Change the density so that the nearest undamped mode lies at a frequency.

    A profile's beam is off by more than the width of such a band.
    """
    omega = 2.0 * pi * frequency_hz
    modes_rad_s = undamped_frequencies_rad_s(beam, 12)
    nearest = modes_rad_s[np.argmin(np.abs(np.log(modes_rad_s / omega)))]
    return Beam(
        length_m=beam.length_m,
        density_kg_per_m=beam.density_kg_per_m * float(nearest / omega) ** 2,
        bending_stiffness_n_m2=beam.bending_stiffness_n_m2,
    )
