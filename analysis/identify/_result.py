"""Result of a fit of the whole record: parameters, their uncertainty, modes and residual."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.noise import NoiseSpectrum
from analysis.statistics import chi_square_p_value, nrmse_percent

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._plant import Plant
    from analysis.identify.noise import NoiseLine
    from analysis.models import Structure

_RARE: Final = 1e-4
"""p-value below which a beam rang when the record began."""


@dataclass(frozen=True, slots=True)
class DampingSize:
    """Loss factor of a damping at the frequency where it depends least on its order.

    Attributes
    ----------
    omega_rad_s : float or None
        That frequency, not below the first mode; None if the order is fixed or not determined.
    value, std : float
        ``zeta omega^alpha sin(alpha pi/2)`` of internal damping, of external damping ``gamma
        omega^lambda sin(lambda pi/2)`` over ``rho/EI omega²``: energy lost per radian over stored
        energy. Without that frequency zeta or gamma itself.
    """

    omega_rad_s: float | None
    value: float
    std: float


@dataclass(frozen=True, slots=True)
class ModeEstimate:
    """One mode of the beam with locked hub (clamped–free), from the fitted plant."""

    number: int
    """From 1 on."""
    frequency_hz: float
    """Frequency of the free decay, 0 if over-damped."""
    frequency_std_hz: float
    """Its standard deviation."""
    damping_ratio: float
    """Above 1 if over-damped."""
    damping_ratio_std: float
    """Its standard deviation."""


@dataclass(frozen=True, slots=True)
class Ringing:
    """Free decay with which the record begins, in addition to the response to the motor.

    Attributes
    ----------
    amplitude_nm : tuple of float
        By mode, at the first sample compared.
    chi_square : float
        Chi-square of all its amplitudes together, with the hum, if any, fitted as well.
    degrees_of_freedom : int
    """

    amplitude_nm: tuple[float, ...]
    chi_square: float
    degrees_of_freedom: int

    @property
    def significant(self) -> bool:
        """Return whether chance gives as much in less than one record of ten thousand."""
        freedom = self.degrees_of_freedom
        return bool(freedom and chi_square_p_value(self.chi_square, freedom) < _RARE)


@dataclass(frozen=True, slots=True)
class RecordFit:
    """Fit of one structure to a whole record.

    Attributes
    ----------
    structure : Structure
    plant : Plant
        Fitted plant, for use with `rigd.beam`.
    parameters : dict of str to float
        zeta, alpha, gamma, lambda, density_over_stiffness (s²/m⁴), bending_stiffness_n_m2, delay_s
        and tool_inertia_kg_m2, the fixed ones included.
    std : dict of str to (float or None)
        Standard deviations of the same: 0 for the fixed ones, None for those that rest on a bound
        or that the data do not determine. For a tool inertia at the bound 0: the value without that
        bound. An estimate of 0 that cannot be negative is 0 in half of the records, and has a
        half-normal error in the others: its mean is 1/sqrt(2 pi) = 0.40 of this deviation too
        large, and it scatters by 0.58 of it.
    interval : dict of str to ((float, float) or None)
        95 % confidence intervals of the free ones, None as above. Those of positive parameters are
        symmetric in the logarithm; that of a tool inertia ends at 0 (`interval_from_zero`).
    determined : tuple of str
        Free parameters in the order of `covariance`.
    covariance : ndarray, shape (k, k)
        Covariance of the determined parameters; zeta, gamma, density over stiffness and stiffness
        counted as logarithms.
    at_bounds : tuple of str
        Free parameters that rest on the edge of their range.
    internal, external : DampingSize or None
        Decorrelated sizes of the damping; None where absent or not determined.
    modes : tuple of ModeEstimate
        Those within the band.
    ringing : Ringing
    cost : float
        Sum of squares of the whitened residual.
    degrees_of_freedom : int
        Expected cost by chance alone.
    residual : ndarray of complex, shape (K,)
        Whitened spectrum of the residual in the band (prediction minus measurement): real and
        imaginary parts of variance 1 if chance is all that remains.
    """

    structure: Structure
    plant: Plant
    parameters: Mapping[str, float]
    std: Mapping[str, float | None]
    interval: Mapping[str, tuple[float, float] | None]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]
    at_bounds: tuple[str, ...]
    internal: DampingSize | None
    external: DampingSize | None
    modes: tuple[ModeEstimate, ...]
    ringing: Ringing
    cost: float
    degrees_of_freedom: int
    residual: NDArray[np.complex128]

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Return the correlations of the determined parameters, shape (k, k)."""
        std = np.sqrt(np.diag(self.covariance))
        correlation: NDArray[np.float64] = self.covariance / np.outer(std, std)
        return correlation

    @property
    def free_parameters(self) -> int:
        """Return the number of estimated parameters."""
        return len(self.determined) + len(self.at_bounds)


@dataclass(frozen=True, slots=True)
class RecordAnalysis:
    """Fits of all structures to one record, under one noise spectrum.

    Attributes
    ----------
    fits : tuple of RecordFit
        Fits in the requested order; their costs are comparable.
    frequency_hz : ndarray, shape (K,)
        Bins of the residuals.
    compared : ndarray of bool, shape (K,)
        False at the lines; the residuals are 0 there.
    noise_nm2_per_hz : ndarray, shape (K,)
        One-sided power spectral density of the torque's noise, without lines.
    lines : tuple of NoiseLine
        Narrow-band disturbances of the torque, excluded from all comparisons.
    comparison : Comparison
        Data that all of them were compared with.
    """

    fits: tuple[RecordFit, ...]
    frequency_hz: NDArray[np.float64]
    compared: NDArray[np.bool_]
    noise_nm2_per_hz: NDArray[np.float64]
    lines: tuple[NoiseLine, ...]
    comparison: Comparison

    @classmethod
    def of(
        cls, fits: Iterable[RecordFit], noise: NoiseSpectrum, comparison: Comparison
    ) -> RecordAnalysis:
        """Return the analysis of fits to one comparison under one noise.

        Parameters
        ----------
        fits : iterable of RecordFit
            Fits in the requested order.
        noise : Noise
            Noise under which all of them were made.
        comparison : Comparison
            Record and band that all of them were compared with.
        """
        return cls(
            fits=tuple(fits),
            frequency_hz=comparison.frequency_hz,
            compared=noise.counts,
            noise_nm2_per_hz=2 * noise.power / (comparison.samples * comparison.decimation.rate_hz),
            lines=noise.lines,
            comparison=comparison,
        )

    @property
    def noise(self) -> NoiseSpectrum:
        """Return the noise spectrum of the fits: the power of each bin."""
        scale = self.comparison.samples * self.comparison.decimation.rate_hz / 2
        return NoiseSpectrum(self.noise_nm2_per_hz * scale, self.compared, self.lines)

    def fit_percent(self, fit: RecordFit | ModalFit) -> float:
        """Return the fit of a model to the measured torque in the band (`nrmse_percent`).

        Narrow-band disturbances are removed, and bins at their lines are not compared. A decay that
        began before the record counts as explained, as initial conditions do.

        Parameters
        ----------
        fit : RecordFit or ModalFit
            One of `fits`, or one under the same noise.
        """
        comparison, noise = self.comparison, self.noise
        torque_nm = (
            comparison.torque_nm[comparison.retained] + comparison.removed_nm - comparison.hum_nm
        )
        measured = comparison.spectrum(torque_nm)[noise.counts]
        residual = (fit.residual * np.sqrt(noise.power / 2))[noise.counts]
        return nrmse_percent(residual, measured)
