"""Result of a fit to the whole record: parameters, their uncertainty, modes and residual."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from analysis.identify.noise import NoiseSpectrum
from analysis.statistics import nrmse_percent

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._estimates import ModeEstimate, PivotLossFactor, Ringing
    from analysis.identify.noise import NoiseLine
    from analysis.models import Structure
    from rigd.beam import Plant


class FitWithResidual(Protocol):
    """Fit of a model to a record, of which only the residual is used."""

    @property
    def residual(self) -> NDArray[np.complex128]:
        """Return the whitened spectrum of the residual, shape (K,)."""


@dataclass(frozen=True, slots=True)
class RecordFit:
    """Fit of one structure to a whole record.

    Attributes
    ----------
    structure : Structure
        Damping structure of the fit.
    plant : Plant
        Fitted plant, for use with `rigd.beam`.
    parameters : dict of str to float
        zeta, alpha, gamma, lambda, density_over_stiffness (s²/m⁴), bending_stiffness_n_m2, delay_s
        and tool_inertia_kg_m2, the fixed ones included.
    std : dict of str to (float or None)
        Standard deviations of the same parameters: 0 for fixed ones, None for those that rest on a
        bound or that the data do not determine. For a tool inertia at the bound 0, the standard
        deviation without that bound. If its true value is 0, the estimate is 0 in half of the
        records, and has a half-normal error in the others: its mean is 1/sqrt(2 pi) = 0.40 of this
        standard deviation too large, and it scatters by 0.58 of it.
    interval : dict of str to ((float, float) or None)
        95 % confidence intervals of the free parameters, None where `std` is None. Intervals of
        positive parameters are symmetric in the logarithm. The interval of a tool inertia ends at 0
        (`interval_from_zero`).
    determined : tuple of str
        Free parameters in the order of `covariance`.
    covariance : ndarray, shape (k, k)
        Covariance of the determined parameters, with zeta, gamma, density over stiffness and
        stiffness as logarithms.
    at_bounds : tuple of str
        Free parameters that rest on a bound of their range.
    internal, external : PivotLossFactor or None
        Loss factors of internal and external damping. None if absent or not determined.
    modes : tuple of ModeEstimate
        Modes within the band.
    ringing : Ringing
        Free decay at the start of the record.
    cost : float
        Sum of squares of the whitened residual.
    degrees_of_freedom : int
        Cost that is expected if the residual is noise only.
    residual : ndarray of complex, shape (K,)
        Whitened spectrum of the residual (prediction minus measurement) in the band. Its real and
        imaginary parts have variance 1 if it is noise only.
    """

    structure: Structure
    plant: Plant
    parameters: Mapping[str, float]
    std: Mapping[str, float | None]
    interval: Mapping[str, tuple[float, float] | None]
    determined: tuple[str, ...]
    covariance: NDArray[np.float64]
    at_bounds: tuple[str, ...]
    internal: PivotLossFactor | None
    external: PivotLossFactor | None
    modes: tuple[ModeEstimate, ...]
    ringing: Ringing
    cost: float
    degrees_of_freedom: int
    residual: NDArray[np.complex128]

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Return the correlation matrix of the determined parameters, shape (k, k)."""
        std = np.sqrt(np.diag(self.covariance))
        correlation: NDArray[np.float64] = self.covariance / np.outer(std, std)
        return correlation

    @property
    def std_of_free_parameters(self) -> dict[str, float | None]:
        """Return the standard deviations of all parameters, with None for fixed ones too."""
        return {name: std if name in self.interval else None for name, std in self.std.items()}

    @property
    def free_parameter_count(self) -> int:
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
        Frequencies of the bins of the residuals.
    is_compared : ndarray of bool, shape (K,)
        False at the bins of `lines`, where the residuals are 0.
    noise_nm2_per_hz : ndarray, shape (K,)
        One-sided power spectral density of the torque's noise, without lines.
    lines : tuple of NoiseLine
        Narrow-band disturbances of the torque, excluded from all comparisons.
    comparison : Comparison
        Data of the record that all fits were compared with.
    """

    fits: tuple[RecordFit, ...]
    frequency_hz: NDArray[np.float64]
    is_compared: NDArray[np.bool_]
    noise_nm2_per_hz: NDArray[np.float64]
    lines: tuple[NoiseLine, ...]
    comparison: Comparison

    @classmethod
    def from_fits(
        cls, fits: Iterable[RecordFit], noise: NoiseSpectrum, comparison: Comparison
    ) -> RecordAnalysis:
        """Return the analysis that contains fits to the same data under the same noise.

        Parameters
        ----------
        fits : iterable of RecordFit
            Fits in the requested order.
        noise : NoiseSpectrum
            Noise spectrum of all fits.
        comparison : Comparison
            Data of the record that all fits were compared with.
        """
        return cls(
            fits=tuple(fits),
            frequency_hz=comparison.frequency_hz,
            is_compared=noise.is_compared,
            noise_nm2_per_hz=2
            * noise.power
            / (comparison.sample_count * comparison.decimation.rate_hz),
            lines=noise.lines,
            comparison=comparison,
        )

    @property
    def noise(self) -> NoiseSpectrum:
        """Return the noise spectrum of the torque under which the fits were made."""
        density_factor = self.comparison.sample_count * self.comparison.decimation.rate_hz / 2
        return NoiseSpectrum(self.noise_nm2_per_hz * density_factor, self.is_compared, self.lines)

    def fit_percent(self, fit: FitWithResidual) -> float:
        """Return how well a model fits the measured torque in the band, in per cent (NRMSE).

        Narrow-band disturbances are removed, and bins at their lines are not compared. A decay that
        began before the record counts as explained, as initial conditions do.

        Parameters
        ----------
        fit : FitWithResidual
            One of `fits`, or one under the same noise.
        """
        comparison, noise = self.comparison, self.noise
        torque_nm = (
            comparison.torque_nm[comparison.retained_samples]
            + comparison.removed_torque_nm
            - comparison.hum_nm
        )
        measured_spectrum = comparison.spectrum(torque_nm)[noise.is_compared]
        unwhitened_residual = (fit.residual * np.sqrt(noise.power / 2))[noise.is_compared]
        return nrmse_percent(unwhitened_residual, measured_spectrum)
