"""Estimates that a fit reports: size of a damping, mode, free decay at the start of a record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from analysis.statistics import chi_square_p_value

_RINGING_P_VALUE: Final = 1e-4
"""p-value of the free decay below which the beam rang when the record began."""


@dataclass(frozen=True, slots=True)
class PivotLossFactor:
    """Loss factor of one damping at its pivot frequency, where it depends least on the order.

    Attributes
    ----------
    omega_rad_s : float or None
        Pivot frequency, not below the first mode. None if the order is fixed or not determined.
    value, std : float
        Loss factor (energy lost per radian over stored energy) and its standard deviation: ``zeta
        omega^alpha sin(alpha pi/2)`` of internal damping, ``gamma omega^lambda sin(lambda pi/2)``
        over ``rho/EI omega²`` of external damping. If `omega_rad_s` is None, zeta or gamma.
    """

    omega_rad_s: float | None
    value: float
    std: float


@dataclass(frozen=True, slots=True)
class ModeEstimate:
    """Frequency and damping ratio of one mode of the fitted beam with locked hub."""

    number: int
    """Number of the mode, from 1."""
    frequency_hz: float
    """Frequency of the free decay in hertz, 0 if over-damped."""
    frequency_std_hz: float
    """Standard deviation of the frequency in hertz."""
    damping_ratio: float
    """Fraction of the critical damping, above 1 if over-damped."""
    damping_ratio_std: float
    """Standard deviation of the damping ratio."""


@dataclass(frozen=True, slots=True)
class Ringing:
    """Free decay of the beam at the start of a record, in addition to the response to the motor.

    Attributes
    ----------
    amplitude_nm : tuple of float
        Torque amplitude of each mode at the first compared sample.
    chi_square : float
        Chi-square of all amplitudes together, with any hum fitted as well.
    degrees_of_freedom : int
        Number of fitted amplitudes.
    residue_std_growth : float
        Factor by which the free decay makes the residue of a mode less certain; the largest of all
        modes. 1 if it was not computed.
    """

    amplitude_nm: tuple[float, ...]
    chi_square: float
    degrees_of_freedom: int
    residue_std_growth: float = 1.0

    @property
    def is_significant(self) -> bool:
        """Return whether chance gives such amplitudes in less than one of 10 000 records."""
        degrees_of_freedom = self.degrees_of_freedom
        return bool(
            degrees_of_freedom
            and chi_square_p_value(self.chi_square, degrees_of_freedom) < _RINGING_P_VALUE
        )
