"""95 % bands of a fit's curves, and the frequency band in which a record determines the damping."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from analysis.identify.uniform_beam import PARAMETERS
from analysis.models import STRUCTURES
from analysis.statistics import NORMAL_95
from rigd.beam import LOGARITHMIC_PARAMETERS, ResponseGrid, gradient_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify import ModalFit, RecordAnalysis
    from analysis.identify.tolerant_estimate import TolerantEstimate
    from analysis.models import Structure
    from analysis.record import Record
    from analysis.results import WholeRecord
    from rigd.beam import Plant

    # Lowest and highest frequency of a band, in hertz.
    FrequencyBand = tuple[float, float]

    # Array of real numbers.
    RealArray = NDArray[np.float64]

_BLOCK_BINS: Final = 24
"""Number of frequency bins in a block, whose mean power decides whether the block was excited."""
_MIN_POWER_TO_NOISE_RATIO: Final = 4.0
"""Ratio of a block's mean power to the noise's power, above which the block counts as excited.

By chance the ratio exceeds 2 in one of 10 000 blocks."""


def supported_band_hz(whole_record: WholeRecord) -> FrequencyBand | None:
    """Return the frequency band in which the data support the selected fit's loss factors.

    The modes determine the damping. A model whose orders the data support is valid in the whole
    band in which the beam was excited, also between and beyond the modes. A model with an order
    that the data do not support is valid only between the visible modes.

    Returns
    -------
    tuple of float or None
        First and last frequency in Hz; None if there is no such band.
    """
    if not whole_record.withheld_orders:
        return excited_band_hz(whole_record.record, whole_record.analysis)
    mode_frequencies_hz = [
        mode.frequency_hz.value for mode in whole_record.headline.modes if mode.shown
    ]
    if len(mode_frequencies_hz) < 2:
        return None
    return min(mode_frequencies_hz), max(mode_frequencies_hz)


def excited_band_hz(record: Record, analysis: RecordAnalysis) -> FrequencyBand | None:
    """Return the lowest and highest frequency at which the torque is stronger than the noise.

    Parameters
    ----------
    record : Record
        Record with the measured torque.
    analysis : RecordAnalysis
        Analysis of the record with its noise spectrum. The result is limited to its band.

    Returns
    -------
    tuple of float or None
        Lowest and highest frequency in Hz; None if the torque is below the noise at all of them.
    """
    torque_nm = record.torque_nm - record.torque_nm.mean()
    frequency_hz = np.fft.rfftfreq(torque_nm.size, 1 / record.rate_hz)
    is_in_band = (frequency_hz >= analysis.frequency_hz[0]) & (
        frequency_hz <= analysis.frequency_hz[-1]
    )
    # A narrow-band disturbance is not an excitation, and the compared bins contain none.
    nearest_bins = np.searchsorted(analysis.frequency_hz, frequency_hz[is_in_band])
    is_in_band[is_in_band] = analysis.is_compared[
        np.minimum(nearest_bins, analysis.is_compared.size - 1)
    ]
    power_nm2_per_hz = (
        np.abs(np.fft.rfft(torque_nm)[is_in_band]) ** 2 * 2 / (torque_nm.size * record.rate_hz)
    )
    power_over_noise = power_nm2_per_hz / np.interp(
        frequency_hz[is_in_band], analysis.frequency_hz, analysis.noise_nm2_per_hz
    )
    bins_in_full_blocks = power_over_noise.size - power_over_noise.size % _BLOCK_BINS
    excited_blocks = np.flatnonzero(
        power_over_noise[:bins_in_full_blocks].reshape(-1, _BLOCK_BINS).mean(axis=1)
        > _MIN_POWER_TO_NOISE_RATIO
    )
    if excited_blocks.size == 0:
        return None
    band_frequencies_hz = frequency_hz[is_in_band]
    return float(band_frequencies_hz[excited_blocks[0] * _BLOCK_BINS]), float(
        band_frequencies_hz[(excited_blocks[-1] + 1) * _BLOCK_BINS - 1]
    )


class FittedPlant(Protocol):
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
        """Names of the parameters that the data determine, in the order of `covariance`."""

    @property
    def covariance(self) -> RealArray:
        """Covariance of the determined parameters, or of the logarithms of positive ones."""


@dataclass(frozen=True, slots=True)
class NearlyUniformBeam:
    """Beam estimated with a tolerance of its geometry, in the form of a `FittedPlant`.

    Attributes
    ----------
    structure : Structure
        Structure with both orders free.
    plant : Plant
        Estimated beam, damping and delay.
    parameters : mapping of str to float
        Values of the parameters by name.
    determined : tuple of str
        Names of the parameters in the order of `covariance`.
    covariance : ndarray, shape (7, 7)
        Covariance of the parameters, or of the logarithms of positive ones.
    """

    structure: Structure
    plant: Plant
    parameters: Mapping[str, float]
    determined: tuple[str, ...]
    covariance: RealArray

    @classmethod
    def from_estimate(cls, tolerant_estimate: TolerantEstimate) -> NearlyUniformBeam:
        """Return the beam that was estimated with a tolerance of the geometry and free orders."""
        return cls(
            STRUCTURES["VI"],
            tolerant_estimate.plant,
            tolerant_estimate.values,
            PARAMETERS,
            tolerant_estimate.covariance,
        )


def loss_estimate(whole_record: WholeRecord) -> FittedPlant | None:
    """Return the beam whose loss factors are drawn; None if no beam is known to explain the losses.

    If an order was fitted to the frequencies of a beam that is not uniform, it is unknown.
    """
    headline = whole_record.headline
    is_refused = headline.uniform_beam is not None and headline.uniform_beam.status == "refused"
    if headline.tolerant is None:
        return None if is_refused else whole_record.fit
    if headline.tolerant.basis == "none" or (is_refused and headline.tolerant.rests_on_frequencies):
        return None
    return NearlyUniformBeam.from_estimate(headline.tolerant)


_GRID_POINTS: Final = 900
"""Number of frequencies of a grid over a band, in addition to those near the peaks."""


def dense_grid(first_hz: float, last_hz: float, peaks_hz: Sequence[float]) -> RealArray:
    """Return frequencies on which curves over a band are drawn, denser near narrow peaks.

    Parameters
    ----------
    first_hz, last_hz : float
        Lowest and highest frequency of the band, positive.
    peaks_hz : sequence of float
        Frequencies of the peaks. Peaks outside the band are omitted.

    Returns
    -------
    ndarray, shape (n,)
        Frequencies in Hz, increasing.
    """
    band_grid = np.geomspace(first_hz, last_hz, _GRID_POINTS)
    relative_offsets = np.geomspace(1e-4, 0.1, 40)
    peak_grids = [
        peak_hz * (1 + np.r_[-relative_offsets, 0.0, relative_offsets]) for peak_hz in peaks_hz
    ]
    all_frequencies = np.unique(np.concatenate([band_grid, *peak_grids]))
    return np.asarray(all_frequencies[(all_frequencies >= first_hz) & (all_frequencies <= last_hz)])


_QUARTER_TURN: Final = np.pi / 2
"""Phase of the imaginary unit, in radians."""


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
        Standard deviation of ``ln |response|``, the relative standard deviation of the magnitude.
    phase_std_rad : ndarray, shape (n,)
        Standard deviation of the phase.
    """

    frequency_hz: RealArray
    response: NDArray[np.complex128]
    log_magnitude_std: RealArray
    phase_std_rad: RealArray

    def magnitude_limits(self) -> tuple[RealArray, RealArray]:
        """Return lower and upper limits of the magnitude's 95 % band in N·m/rad, (n,) each."""
        return _logarithmic_limits(np.abs(self.response), self.log_magnitude_std)


def response_band(fit: FittedPlant, frequency_hz: RealArray) -> ResponseBand:
    """Return a fit's frequency response with the uncertainty that follows from its covariance.

    Parameters
    ----------
    fit : FittedPlant
        Fitted plant with the covariance of its parameters.
    frequency_hz : ndarray, shape (n,)
        Positive.

    Notes
    -----
    Let g be the derivatives of ln H by the determined parameters, and C the parameters' covariance.
    The variance of ``ln |H|`` is ``Re g C Re g'``, the variance of the phase ``Im g C Im g'``.
    Parameters that are fixed, or that the data do not determine, count as known.
    """
    delay_free_plant: Plant = replace(fit.plant, delay_s=0.0)
    # The delay changes the measured phase, but not that of beam and clamp.
    parameter_indices = [
        i for i, parameter_name in enumerate(fit.determined) if parameter_name != "delay_s"
    ]
    parameter_names = [fit.determined[i] for i in parameter_indices]
    response, *derivatives = ResponseGrid(2j * np.pi * frequency_hz).evaluate(
        delay_free_plant,
        [gradient_name(parameter_name) for parameter_name in parameter_names],
    )
    log_response_gradient = np.empty((len(parameter_names), frequency_hz.size), dtype=np.complex128)
    for gradient_row, parameter_name, response_derivative in zip(
        log_response_gradient, parameter_names, derivatives, strict=True
    ):
        is_scaled_by_value = (
            parameter_name in LOGARITHMIC_PARAMETERS
            and gradient_name(parameter_name) == parameter_name
        )
        gradient_row[:] = (
            response_derivative
            * (fit.parameters[parameter_name] if is_scaled_by_value else 1.0)
            / response
        )
    covariance = fit.covariance[np.ix_(parameter_indices, parameter_indices)]
    return ResponseBand(
        frequency_hz=frequency_hz,
        response=response,
        log_magnitude_std=_standard_deviations(log_response_gradient.real, covariance),
        phase_std_rad=_standard_deviations(log_response_gradient.imag, covariance),
    )


def modal_response_band(
    fit: ModalFit, frequency_hz: RealArray, delay_s: float = 0.0
) -> ResponseBand:
    """Return a modal model's frequency response with the uncertainty from its covariance.

    Parameters
    ----------
    fit : ModalFit
        Modal model with the covariance of its parameters.
    frequency_hz : ndarray, shape (n,)
        Positive.
    delay_s : float
        Delay of the torque channel minus that of the angle channel, as the file states them. It is
        removed from the response.
    """
    s = 2j * np.pi * frequency_hz
    response = fit.model.response(s)
    response_derivatives = []
    for mode_pole, mode_residue in zip(fit.model.poles_rad_s, fit.model.residues, strict=True):
        residue_ratio = -mode_pole.real / abs(mode_pole)
        # By ln frequency and ln damping ratio. Those by the residue are residue and j residue.
        pole_derivatives = (
            mode_pole,
            -residue_ratio * mode_pole.imag / (1 - residue_ratio * residue_ratio) ** 1.5,
        )
        pole_term, conjugate_term = 1 / (s - mode_pole), 1 / (s - mode_pole.conjugate())
        response_derivatives += [
            mode_residue * parameter_slope * pole_term**2
            + (mode_residue * parameter_slope).conjugate() * conjugate_term**2
            for parameter_slope in pole_derivatives
        ]
        response_derivatives += [
            parameter_slope * pole_term + parameter_slope.conjugate() * conjugate_term
            for parameter_slope in (mode_residue, 1j * mode_residue)
        ]
    response_derivatives += [
        s**background_power for background_power in range(len(fit.model.background))
    ]
    log_response_gradient = np.array(response_derivatives) / response
    return ResponseBand(
        frequency_hz=frequency_hz,
        response=response * np.exp(s * delay_s),
        log_magnitude_std=_standard_deviations(log_response_gradient.real, fit.joint_covariance),
        phase_std_rad=_standard_deviations(log_response_gradient.imag, fit.joint_covariance),
    )


@dataclass(frozen=True, slots=True)
class LossFactor:
    """Loss factor over frequency, with its uncertainty.

    Attributes
    ----------
    value : ndarray, shape (n,)
        Loss factor; NaN at frequencies where the damping acts as a stiffness larger than the
        inertia, so that no loss factor is defined.
    log_std : ndarray, shape (n,)
        Standard deviation of the loss factor's logarithm.
    """

    value: RealArray
    log_std: RealArray

    def limits(self) -> tuple[RealArray, RealArray]:
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
        Loss factors of the material and of the surroundings; None if the structure has no such
        damping.
    total : LossFactor
        Sum of both. At a mode it is twice the damping ratio, to first order of the damping.
    """

    frequency_hz: RealArray
    internal: LossFactor | None
    external: LossFactor | None
    total: LossFactor


def loss_factors(fit: FittedPlant, frequency_hz: RealArray) -> LossFactors:
    """Return internal, external and total loss factor of a fit, with their uncertainties.

    Parameters
    ----------
    fit : FittedPlant
        Fitted plant with the covariance of its parameters.
    frequency_hz : ndarray, shape (n,)
        Positive.

    Notes
    -----
    A mode with the stiffness k⁴ obeys ``(1 + zeta s^alpha) k⁴ + rho/EI s² + gamma s^lambda = 0``.
    At s = j omega, with ``z = zeta omega^alpha`` and ``g = gamma omega^lambda / (rho/EI omega²)``,
    the imaginary part divided by the real part is, for the elastic and for the inertial term::

        z sin(alpha pi/2) / (1 + z cos(alpha pi/2))
        g sin(lambda pi/2) / (1 - g cos(lambda pi/2))

    At a resonance the real parts cancel, and the sum of both ratios is the loss factor of the mode.
    """
    omega_rad_s = 2 * np.pi * frequency_hz
    parameter_values = fit.parameters
    total_value = np.zeros(omega_rad_s.size)
    total_slopes = np.zeros((len(fit.determined), omega_rad_s.size))
    internal_loss = external_loss = None
    if fit.structure.has_internal_damping:
        loss_value, slope_pair = _loss_with_slopes(
            omega_rad_s, parameter_values["zeta"], parameter_values["alpha"], 1.0
        )
        log_loss_gradient = _rows_by_parameter(
            fit, {"zeta": slope_pair[0], "alpha": slope_pair[1]}, omega_rad_s.size
        )
        internal_loss = LossFactor(
            loss_value, _standard_deviations(log_loss_gradient, fit.covariance)
        )
        total_value, total_slopes = (
            total_value + loss_value,
            total_slopes + loss_value * log_loss_gradient,
        )
    if fit.structure.has_external_damping:
        inertia_term = parameter_values["density_over_stiffness"] * omega_rad_s**2
        loss_value, slope_pair = _loss_with_slopes(
            omega_rad_s, parameter_values["gamma"] / inertia_term, parameter_values["lambda"], -1.0
        )
        log_loss_gradient = _rows_by_parameter(
            fit,
            {
                "gamma": slope_pair[0],
                "lambda": slope_pair[1],
                "density_over_stiffness": -slope_pair[0],
            },
            omega_rad_s.size,
        )
        external_loss = LossFactor(
            loss_value, _standard_deviations(log_loss_gradient, fit.covariance)
        )
        total_value, total_slopes = (
            total_value + loss_value,
            total_slopes + loss_value * log_loss_gradient,
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        total_loss = LossFactor(
            total_value, _standard_deviations(total_slopes / total_value, fit.covariance)
        )
    return LossFactors(frequency_hz, internal_loss, external_loss, total_loss)


def _loss_with_slopes(
    omega_rad_s: RealArray,
    damping_coefficient: RealArray | float,
    damping_order: float,
    term_sign: float,
) -> tuple[RealArray, tuple[RealArray, RealArray]]:
    """Return a damping term's loss factor, and the derivatives of the loss factor's logarithm.

    The derivatives are with respect to the logarithm of the coefficient, and to the order.
    """
    log_omega, quarter_turn_angle = np.log(omega_rad_s), _QUARTER_TURN * damping_order
    term_magnitude = damping_coefficient * omega_rad_s**damping_order
    in_phase_part, quadrature_part = (
        term_magnitude * np.cos(quarter_turn_angle),
        term_magnitude * np.sin(quarter_turn_angle),
    )
    real_part = 1 + term_sign * in_phase_part
    real_part = np.where(real_part > 0, real_part, np.nan)
    slope_by_order = (
        log_omega
        + _QUARTER_TURN / np.tan(quarter_turn_angle)
        - term_sign * (in_phase_part * log_omega - _QUARTER_TURN * quadrature_part) / real_part
    )
    return quadrature_part / real_part, (1 / real_part, slope_by_order)


def _rows_by_parameter(
    fit: FittedPlant, slopes_by_name: dict[str, RealArray], point_count: int
) -> RealArray:
    """Return derivatives by parameters as rows (k, n), in the order of the fit's covariance.

    A parameter that is not in `slopes_by_name` has a row of zeros.
    """
    return np.array(
        [
            slopes_by_name.get(parameter_name, np.zeros(point_count))
            for parameter_name in fit.determined
        ]
    ).reshape(len(fit.determined), point_count)


def _standard_deviations(gradient: RealArray, covariance: RealArray) -> RealArray:
    """Return the standard deviations (n,) of a function of the parameters.

    `gradient` contains the function's derivatives, (k, n); `covariance` is the parameters', (k, k).
    """
    log_variance = np.einsum("in,ij,jn->n", gradient, covariance, gradient, optimize=True)
    return np.asarray(np.sqrt(np.maximum(log_variance, 0.0)))


def _logarithmic_limits(
    central_value: RealArray, log_std: RealArray
) -> tuple[RealArray, RealArray]:
    """Return lower and upper limits of 95 % intervals that are symmetric in the logarithm."""
    # An undetermined value may overflow. Its band then includes everything.
    limit_factor = np.exp(np.minimum(NORMAL_95 * log_std, 300.0))
    return central_value / limit_factor, central_value * limit_factor
