"""95 % bands of a fit's curves, and the frequency band in which a record determines the damping."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from analysis.identify import LOGARITHMIC_PARAMETERS, ResponseGrid
from analysis.identify.uniform_beam import PARAMETERS
from analysis.models import STRUCTURES
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify import ModalFit, Plant, RecordAnalysis
    from analysis.identify.uniform_beam import TolerantEstimate
    from analysis.models import Structure
    from analysis.record import Record
    from analysis.results import WholeRecord

    # Lowest and highest frequency of a band, in hertz.
    Band = tuple[float, float]

    # Array of real numbers.
    Real = NDArray[np.float64]

_BLOCK_BINS: Final = 24
"""Number of frequency bins over which the power is averaged to find the excited band."""
_EXCITED_TO_NOISE_POWER: Final = 4.0
"""Ratio of a block's mean power to the noise's power, above which the block counts as excited.

By chance the ratio exceeds 2 in one of 10 000 blocks."""


def supported_band_hz(whole_record: WholeRecord) -> Band | None:
    """Return the frequency band in which the data support the selected fit's loss factors.

    The modes determine the damping. A model whose orders the data support is also right between and
    beyond the modes, in the band in which the beam was excited. A model with an order that the data
    do not support only interpolates between the visible modes.

    Returns
    -------
    tuple of float or None
        First and last frequency in Hz; None if there is no such band.
    """
    if not whole_record.withheld:
        return excited_band_hz(whole_record.record, whole_record.analysis)
    frequencies = [mode.frequency_hz.value for mode in whole_record.headline.modes if mode.shown]
    if len(frequencies) < 2:
        return None
    return min(frequencies), max(frequencies)


def excited_band_hz(record: Record, analysis: RecordAnalysis) -> Band | None:
    """Return the lowest and highest frequency at which the torque's power exceeds the noise's.

    Parameters
    ----------
    record : Record
        Record with the measured torque.
    analysis : RecordAnalysis
        Analysis of the record, with its noise and with the band to which the result is limited.

    Returns
    -------
    tuple of float or None
        Lowest and highest frequency in Hz; None if the torque nowhere exceeds the noise.
    """
    torque = record.torque_nm - record.torque_nm.mean()
    frequency_hz = np.fft.rfftfreq(torque.size, 1 / record.rate_hz)
    in_band = (frequency_hz >= analysis.frequency_hz[0]) & (
        frequency_hz <= analysis.frequency_hz[-1]
    )
    # A narrow-band disturbance is not an excitation, and the compared bins contain none.
    nearest_bins = np.searchsorted(analysis.frequency_hz, frequency_hz[in_band])
    in_band[in_band] = analysis.compared[np.minimum(nearest_bins, analysis.compared.size - 1)]
    power = np.abs(np.fft.rfft(torque)[in_band]) ** 2 * 2 / (torque.size * record.rate_hz)
    power_over_noise = power / np.interp(
        frequency_hz[in_band], analysis.frequency_hz, analysis.noise_nm2_per_hz
    )
    bins_in_full_blocks = power_over_noise.size - power_over_noise.size % _BLOCK_BINS
    excited_blocks = np.flatnonzero(
        power_over_noise[:bins_in_full_blocks].reshape(-1, _BLOCK_BINS).mean(axis=1)
        > _EXCITED_TO_NOISE_POWER
    )
    if excited_blocks.size == 0:
        return None
    band_frequencies_hz = frequency_hz[in_band]
    return float(band_frequencies_hz[excited_blocks[0] * _BLOCK_BINS]), float(
        band_frequencies_hz[(excited_blocks[-1] + 1) * _BLOCK_BINS - 1]
    )


class Estimate(Protocol):
    """Fitted plant with the covariance of its parameters; a `RecordFit` is one."""

    @property
    def structure(self) -> Structure:
        """Damping structure of the fit."""

    @property
    def plant(self) -> Plant:
        """Fitted plant: beam, damping and delay."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """Values of the fit's parameters by name."""

    @property
    def determined(self) -> tuple[str, ...]:
        """Names of the parameters with a covariance, in the covariance's order."""

    @property
    def covariance(self) -> Real:
        """Covariance of the determined parameters; positive ones by their logarithms."""


@dataclass(frozen=True, slots=True)
class NearlyUniformBeam:
    """Beam estimated with a tolerance of its geometry, in the form of an `Estimate`.

    Attributes
    ----------
    structure : Structure
        Structure with both orders free.
    plant : Plant
        Estimated beam, damping and delay.
    parameters : mapping of str to float
        Values of the parameters by name.
    determined : tuple of str
        Names of the parameters in the covariance's order.
    covariance : ndarray, shape (7, 7)
        Covariance of the parameters; of positive ones by their logarithms.
    """

    structure: Structure
    plant: Plant
    parameters: Mapping[str, float]
    determined: tuple[str, ...]
    covariance: Real

    @classmethod
    def of(cls, tolerant_estimate: TolerantEstimate) -> NearlyUniformBeam:
        """Return the beam of an estimate with a tolerance of the geometry and both orders free."""
        return cls(
            STRUCTURES["VI"],
            tolerant_estimate.plant,
            tolerant_estimate.values,
            PARAMETERS,
            tolerant_estimate.covariance,
        )


def loss_estimate(whole_record: WholeRecord) -> Estimate | None:
    """Return the beam whose loss factors are drawn; None if no beam explains the losses."""
    headline = whole_record.headline
    if headline.tolerant is not None:
        return (
            None if headline.tolerant.basis == "none" else NearlyUniformBeam.of(headline.tolerant)
        )
    is_refused = headline.uniform_beam is not None and headline.uniform_beam.status == "refused"
    return None if is_refused else whole_record.fit


_GRID_POINTS: Final = 900
"""Number of frequencies that are spread over a band, without those at the peaks."""


def dense_grid(first_hz: float, last_hz: float, peaks_hz: Sequence[float]) -> Real:
    """Return frequencies that are dense over a band, and denser at the narrow peaks.

    Parameters
    ----------
    first_hz, last_hz : float
        Lowest and highest frequency of the band, positive.
    peaks_hz : sequence of float
        Frequencies of the peaks. Peaks outside the band are omitted.

    Returns
    -------
    ndarray, shape (n,)
    """
    band_grid = np.geomspace(first_hz, last_hz, _GRID_POINTS)
    offsets = np.geomspace(1e-4, 0.1, 40)
    peak_grids = [peak * (1 + np.r_[-offsets, 0.0, offsets]) for peak in peaks_hz]
    grid = np.unique(np.concatenate([band_grid, *peak_grids]))
    return np.asarray(grid[(grid >= first_hz) & (grid <= last_hz)])


_QUARTER_TURN: Final = np.pi / 2
"""Phase of the imaginary unit, in radians."""
_GRADIENT_NAMES: Final = {
    "density_over_stiffness": "ln_density_over_stiffness",
    "bending_stiffness_n_m2": "ln_stiffness",
}
"""Names under which the response's derivatives by a parameter's logarithm are computed, by
parameter."""


@dataclass(frozen=True, slots=True)
class ResponseBand:
    """Frequency response of a fitted plant, with its standard deviations.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n,)
        Frequencies of the response.
    response : ndarray of complex, shape (n,)
        Torque per angle in N·m/rad, without a delay between the channels.
    log_magnitude_std : ndarray, shape (n,)
        Standard deviation of ln |response|, which is the relative one of the magnitude.
    phase_std_rad : ndarray, shape (n,)
        Standard deviation of the phase.
    """

    frequency_hz: Real
    response: NDArray[np.complex128]
    log_magnitude_std: Real
    phase_std_rad: Real

    def magnitude_limits(self) -> tuple[Real, Real]:
        """Return the lower and upper limit of the magnitude's 95 % band, in N·m/rad, (n,) each."""
        return _logarithmic_limits(np.abs(self.response), self.log_magnitude_std)


def response_band(fit: Estimate, frequency_hz: Real) -> ResponseBand:
    """Return a fit's frequency response with the uncertainty that follows from its covariance.

    Parameters
    ----------
    fit : Estimate
        Fitted plant with the covariance of its parameters.
    frequency_hz : ndarray, shape (n,)
        Positive.

    Notes
    -----
    With g the derivatives of ln H by the determined parameters and C their covariance, the
    variance of ln |H| is ``Re g C Re g'`` and that of the phase ``Im g C Im g'``. Parameters that
    are fixed, or that the data do not determine, count as known.
    """
    plant: Plant = replace(fit.plant, delay_s=0.0)
    # The delay changes the measured phase, but not that of beam and clamp.
    indices = [i for i, name in enumerate(fit.determined) if name != "delay_s"]
    parameter_names = [fit.determined[i] for i in indices]
    response, *derivatives = ResponseGrid(2j * np.pi * frequency_hz).evaluate(
        plant, [_GRADIENT_NAMES.get(name, name) for name in parameter_names]
    )
    gradient = np.empty((len(parameter_names), frequency_hz.size), dtype=np.complex128)
    for gradient_row, name, derivative in zip(gradient, parameter_names, derivatives, strict=True):
        scale_by_value = name in LOGARITHMIC_PARAMETERS and name not in _GRADIENT_NAMES
        gradient_row[:] = derivative * (fit.parameters[name] if scale_by_value else 1.0) / response
    covariance = fit.covariance[np.ix_(indices, indices)]
    return ResponseBand(
        frequency_hz=frequency_hz,
        response=response,
        log_magnitude_std=_standard_deviations(gradient.real, covariance),
        phase_std_rad=_standard_deviations(gradient.imag, covariance),
    )


def modal_response_band(fit: ModalFit, frequency_hz: Real, delay_s: float = 0.0) -> ResponseBand:
    """Return a modal model's frequency response with the uncertainty from its covariance.

    Parameters
    ----------
    fit : ModalFit
        Modal model with the covariance of its parameters.
    frequency_hz : ndarray, shape (n,)
        Positive.
    delay_s : float
        Delay of the torque against the angle, as the file states it. It is removed from the
        response.
    """
    s = 2j * np.pi * frequency_hz
    response = fit.model.response(s)
    derivatives = []
    for pole, residue in zip(fit.model.poles_rad_s, fit.model.residues, strict=True):
        ratio = -pole.real / abs(pole)
        # By ln frequency and ln damping ratio. Those by the residue are residue and j residue.
        pole_derivatives = (pole, -ratio * pole.imag / (1 - ratio * ratio) ** 1.5)
        pole_term, conjugate_term = 1 / (s - pole), 1 / (s - pole.conjugate())
        derivatives += [
            residue * slope * pole_term**2 + (residue * slope).conjugate() * conjugate_term**2
            for slope in pole_derivatives
        ]
        derivatives += [
            slope * pole_term + slope.conjugate() * conjugate_term
            for slope in (residue, 1j * residue)
        ]
    derivatives += [s**power for power in range(len(fit.model.background))]
    gradient = np.array(derivatives) / response
    return ResponseBand(
        frequency_hz=frequency_hz,
        response=response * np.exp(s * delay_s),
        log_magnitude_std=_standard_deviations(gradient.real, fit.joint_covariance),
        phase_std_rad=_standard_deviations(gradient.imag, fit.joint_covariance),
    )


@dataclass(frozen=True, slots=True)
class LossFactor:
    """Loss factor over frequency, with its uncertainty.

    Attributes
    ----------
    value : ndarray, shape (n,)
        Loss factor; NaN where it has no meaning, because damping of a low order outweighs the
        inertia.
    log_std : ndarray, shape (n,)
        Standard deviation of the loss factor's logarithm.
    """

    value: Real
    log_std: Real

    def limits(self) -> tuple[Real, Real]:
        """Return the lower and upper limit of the loss factor's 95 % band, shape (n,) each."""
        return _logarithmic_limits(self.value, self.log_std)


@dataclass(frozen=True, slots=True)
class LossFactors:
    """Loss factors of a fitted plant over frequency: energy lost per radian over energy stored.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n,)
        Frequencies of the loss factors.
    internal, external : LossFactor or None
        Loss in the material and loss to the surroundings; None if the structure does not include
        it.
    total : LossFactor
        Sum of both. At a mode it is twice the damping ratio, without terms of second order.
    """

    frequency_hz: Real
    internal: LossFactor | None
    external: LossFactor | None
    total: LossFactor


def loss_factors(fit: Estimate, frequency_hz: Real) -> LossFactors:
    """Return internal, external and total loss factor of a fit, with their uncertainties.

    Parameters
    ----------
    fit : Estimate
        Fitted plant with the covariance of its parameters.
    frequency_hz : ndarray, shape (n,)
        Positive.

    Notes
    -----
    A mode with the stiffness k⁴ obeys ``(1 + zeta s^alpha) k⁴ + rho/EI s² + gamma s^lambda = 0``.
    On s = j omega, with ``z = zeta omega^alpha`` and ``g = gamma omega^lambda / (rho/EI omega²)``,
    the imaginary part of elastic and of inertial term over the real one is::

        z sin(alpha pi/2) / (1 + z cos(alpha pi/2))
        g sin(lambda pi/2) / (1 - g cos(lambda pi/2))

    and at a resonance, where the real parts cancel, their sum is the loss factor of the mode.
    """
    omega = 2 * np.pi * frequency_hz
    values = fit.parameters
    total_value = np.zeros(omega.size)
    total_slopes = np.zeros((len(fit.determined), omega.size))
    internal = external = None
    if fit.structure.internal:
        loss_value, slope_pair = _loss_with_slopes(omega, values["zeta"], values["alpha"], 1.0)
        gradient = _rows_by_parameter(
            fit, {"zeta": slope_pair[0], "alpha": slope_pair[1]}, omega.size
        )
        internal = LossFactor(loss_value, _standard_deviations(gradient, fit.covariance))
        total_value, total_slopes = total_value + loss_value, total_slopes + loss_value * gradient
    if fit.structure.external:
        inertia_term = values["density_over_stiffness"] * omega**2
        loss_value, slope_pair = _loss_with_slopes(
            omega, values["gamma"] / inertia_term, values["lambda"], -1.0
        )
        gradient = _rows_by_parameter(
            fit,
            {
                "gamma": slope_pair[0],
                "lambda": slope_pair[1],
                "density_over_stiffness": -slope_pair[0],
            },
            omega.size,
        )
        external = LossFactor(loss_value, _standard_deviations(gradient, fit.covariance))
        total_value, total_slopes = total_value + loss_value, total_slopes + loss_value * gradient
    with np.errstate(invalid="ignore", divide="ignore"):
        total_loss = LossFactor(
            total_value, _standard_deviations(total_slopes / total_value, fit.covariance)
        )
    return LossFactors(frequency_hz, internal, external, total_loss)


def _loss_with_slopes(
    omega: Real, coefficient: Real | float, order: float, sign: float
) -> tuple[Real, tuple[Real, Real]]:
    """Return a damping term's loss factor, and the slopes of its logarithm.

    The slopes are those by the coefficient's logarithm and by the order.
    """
    log_omega, angle = np.log(omega), _QUARTER_TURN * order
    magnitude = coefficient * omega**order
    in_phase_part, quadrature_part = magnitude * np.cos(angle), magnitude * np.sin(angle)
    real_part = 1 + sign * in_phase_part
    real_part = np.where(real_part > 0, real_part, np.nan)
    by_order = (
        log_omega
        + _QUARTER_TURN / np.tan(angle)
        - sign * (in_phase_part * log_omega - _QUARTER_TURN * quadrature_part) / real_part
    )
    return quadrature_part / real_part, (1 / real_part, by_order)


def _rows_by_parameter(fit: Estimate, slopes: dict[str, Real], points: int) -> Real:
    """Return slopes by parameter name as rows in the order of the fit's covariance, (k, n)."""
    return np.array([slopes.get(name, np.zeros(points)) for name in fit.determined]).reshape(
        len(fit.determined), points
    )


def _standard_deviations(gradient: Real, covariance: Real) -> Real:
    """Return standard deviations (n,) from slopes (k, n) and the parameters' covariance."""
    variance = np.einsum("in,ij,jn->n", gradient, covariance, gradient, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _logarithmic_limits(value: Real, log_std: Real) -> tuple[Real, Real]:
    """Return the limits of a value's 95 % interval, which is symmetric in the logarithm."""
    # An undetermined value may overflow. Its band then includes everything.
    factor = np.exp(np.minimum(NORMAL_95 * log_std, 300.0))
    return value / factor, value * factor
