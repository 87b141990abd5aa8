"""Fisher information of a record on the parameters of the beam, before or after it is recorded.

The torque caused by a motion of the motor depends on the parameters. Its derivatives with respect
to them, whitened with the spectrum of the noise, determine the precision of a whole-record
fit: the inverse of their Gram matrix is the lower bound of any unbiased estimate's covariance
(Cramér and Rao), and the fit of `analysis` attains it. The nuisance terms of that fit are projected
out here as well: free decay from before the record, offset and drift of the torque.

The computation is in the time domain, at a reduced rate: the derivatives of a record and of a
segment after it add up sample by sample. The computing time of a segment depends on its own length
only, and the vibration after all earlier segments counts.

References
----------
M. B. Zarrop, Optimal experiment design for dynamic system identification, Springer (1979).
L. Pronzato and A. Pázman, Design of experiments in nonlinear models, Springer (2013).
"""

from dataclasses import dataclass
from math import pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import CausalTransform, fast_transform_length, gradient_name
from rigd.excitation._beam_estimate import (
    BAND_HZ,
    DEVIATION_STD_PER_UNIFORMITY,
    FIT_PARAMETERS,
    MODAL_CONSTANTS,
    POLE_AND_RESIDUE_DERIVATIVES,
    BeamEstimate,
    ComplexArray,
    RealArray,
    fit_parameter_factors,
)

_PRIOR_STD_BY_PARAMETER: Final = {
    "zeta": 3.0,
    "alpha": 1.0,
    "gamma": 3.0,
    "lambda": 1.0,
    "density_over_stiffness": 0.5,
    "bending_stiffness_n_m2": 0.5,
    "delay_s": 0.05,
}
"""Prior standard deviation of each parameter without a record: coefficients are known within a
factor of 20, and orders are in (0, 2)."""

_MIN_SAMPLE_RATE_PER_BAND: Final = 2.4
"""Smallest sampling rate, divided by the upper end of the band."""
_FADE_END_PER_BAND: Final = 1.1
"""Frequency from which the whitening weight is 0, divided by the upper end of the band."""
_TRANSFORM_DECAY_EXPONENT: Final = 5.0
"""Exponent of the damping of the Laplace transform, which is twice as long as the record."""


# Whitened derivatives of the torque


@dataclass(frozen=True, slots=True, eq=False)
class TorqueModel:
    """Exact beam model, evaluated once at the frequencies of records of a given length.

    The model predicts torque and slope of the tip for any motion of the motor.
    """

    estimate: BeamEstimate
    """Parameters of the model."""
    rate_hz: float
    """Rate of the angle in ticks a second."""
    tick_count: int
    """Length of the records in ticks, a multiple of `ticks_per_model_sample`."""
    ticks_per_model_sample: int
    """Number of ticks from one sample of the model to the next."""
    transform: CausalTransform
    """Laplace transform of records, at the rate of the samples."""
    derivative_kernels: ComplexArray
    """Whitened derivatives of the response from angle to torque with respect to the free
    parameters, shape (k, K)."""
    channel_responses: ComplexArray
    """Responses from angle to torque in N·m/rad and to the slope of the tip, shape (2, K)."""

    @classmethod
    def for_records(cls, estimate: BeamEstimate, rate_hz: float, tick_count: int) -> "TorqueModel":
        """Return the torque model of a beam for records of at least `tick_count` ticks."""
        ticks_per_point = ticks_per_sample(rate_hz)
        sample_count = fast_transform_length(-(-tick_count // ticks_per_point))
        # Higher frequencies belong neither to the band nor to a visible mode.
        transform = CausalTransform(
            2 * sample_count,
            rate_hz / ticks_per_point,
            _TRANSFORM_DECAY_EXPONENT,
            highest_hz=_FADE_END_PER_BAND * BAND_HZ,
        )
        return cls(
            estimate,
            rate_hz,
            sample_count * ticks_per_point,
            ticks_per_point,
            transform,
            whitened_kernels(estimate, transform.s, transform.rate_hz),
            np.stack(plant_responses(estimate, transform.s)[1:]),
        )

    @property
    def sample_hz(self) -> float:
        """Rate in Hz at which the torque's derivatives by the parameters are computed."""
        return self.rate_hz / self.ticks_per_model_sample

    def spectrum(self, angle_rad: RealArray) -> ComplexArray:
        """Return the Laplace transform of a motor angle at the frequencies of the band.

        The angle in rad begins at rest and has the shape (n,), with n at most `tick_count`.
        """
        return self.transform.forward(angle_rad, oversampling=self.ticks_per_model_sample)

    def whitened_derivatives(self, angle_transform: ComplexArray) -> RealArray:
        """Return the whitened derivatives of the torque for the k free parameters, at each sample.

        `angle_transform` is the transform of the angle. The shape is (k, samples).
        """
        return self.transform.inverse(
            self.derivative_kernels * angle_transform,
            self.tick_count // self.ticks_per_model_sample,
        )

    def torque_and_slope(self, angle_transform: ComplexArray) -> RealArray:
        """Return torque in N·m and slope of the tip in rad at every tick, shape (2, ticks).

        `angle_transform` is the transform of the angle.
        """
        return self.transform.inverse(
            self.channel_responses * angle_transform,
            self.tick_count,
            oversampling=self.ticks_per_model_sample,
        )


def plant_responses(
    estimate: BeamEstimate, s: ComplexArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return the transfer functions from the motor's angle to torques and to the slope of the tip.

    They are the torque on the beam and the measured torque, with tool inertia and channel, in
    N·m/rad, and the slope relative to the root, per angle. `s` is the Laplace variable in rad/s.
    """
    plant = estimate.plant
    g, slope_response = plant.transfer(s), plant.tip_slope(s)
    measured_response = (g + plant.tool_inertia_kg_m2 * s * s) * plant.channel_response(s)
    return g, measured_response, slope_response


def whitened_kernels(estimate: BeamEstimate, s: ComplexArray, sample_hz: float) -> ComplexArray:
    """Return whitened derivatives of the response from angle to torque for each parameter.

    They are divided by the noise spectrum so that the noise of a sample has variance 1. The shape
    is (k, K) for K values of the Laplace variable `s` in rad/s.
    """
    parameter_names = [
        parameter_name
        for parameter_name in estimate.free_parameters
        if parameter_name in FIT_PARAMETERS
    ]
    derivative_names = [
        gradient_name(n) for n in parameter_names if n not in ("delay_s", "tool_inertia_kg_m2")
    ]
    plant = estimate.plant
    g = beam_gradient = np.zeros((0, s.size), dtype=np.complex128)
    if parameter_names:
        g, beam_gradient = plant.transfer_and_gradient(s, derivative_names)
    channel_response = plant.channel_response(s)
    derivative_kernels: ComplexArray = np.empty(
        (len(estimate.free_parameters), s.size), dtype=np.complex128
    )
    derivative_kernels[len(parameter_names) :] = _modal_derivatives(estimate, s) * channel_response
    gradient_rows = iter(beam_gradient)
    for out, parameter_name, parameter_factor in zip(
        derivative_kernels[: len(parameter_names)],
        parameter_names,
        fit_parameter_factors(estimate),
        strict=True,
    ):
        if parameter_name == "delay_s":
            out[:] = -s * (g + plant.tool_inertia_kg_m2 * s * s) * channel_response
        elif parameter_name == "tool_inertia_kg_m2":
            out[:] = s * s * channel_response
        else:
            out[:] = parameter_factor * next(gradient_rows) * channel_response
    derivative_kernels *= _whitening_weights(estimate, s.imag / (2 * pi), sample_hz)
    return derivative_kernels


def _modal_derivatives(estimate: BeamEstimate, s: ComplexArray) -> ComplexArray:
    """Return the response's derivatives for the constants of free modes and of the background.

    The shape is (number of constants, K).
    """
    poles_by_mode = {beam_mode.mode: beam_mode.at_rad_s for beam_mode in estimate.modes()}
    derivative_rows = []
    for parameter_name in estimate.free_parameters:
        if parameter_name in FIT_PARAMETERS:
            continue
        constant_kind, _, mode_number = parameter_name.rpartition("_")
        if constant_kind == "background":
            derivative_rows.append((s / (2 * pi * BAND_HZ)) ** int(mode_number))
            continue
        mode_pole = poles_by_mode[int(mode_number)]
        mode_residue = complex(estimate.plant.residues(np.array([mode_pole]))[0]) * mode_pole**2
        pole_derivative, residue_derivative = POLE_AND_RESIDUE_DERIVATIVES[constant_kind](
            mode_pole, mode_residue
        )
        upper_term, lower_term = s - mode_pole, s - mode_pole.conjugate()
        row = mode_residue * pole_derivative / upper_term**2 + residue_derivative / upper_term
        conjugate_term = (
            mode_residue * pole_derivative
        ).conjugate() / lower_term**2 + residue_derivative.conjugate() / lower_term
        derivative_rows.append(row + conjugate_term)
    return np.array(derivative_rows, dtype=np.complex128).reshape(-1, s.size)


def ticks_per_sample(rate_hz: float) -> int:
    """Return the number of ticks per sample, so small that the samples contain the band."""
    return max(int(rate_hz / (_MIN_SAMPLE_RATE_PER_BAND * BAND_HZ)), 1)


def _whitening_weights(
    estimate: BeamEstimate, frequency_hz: NDArray[np.floating[Any]], sample_hz: float
) -> RealArray:
    """Return the weights of frequencies that whiten the torque noise: a sample has variance 1.

    They fade to 0 above the end of the band.
    """
    log_noise_density = np.interp(
        frequency_hz, estimate.noise_frequency_hz, np.log(estimate.noise_nm2_per_hz)
    )
    fade_factors = np.clip((frequency_hz / BAND_HZ - 1.0) / (_FADE_END_PER_BAND - 1.0), 0.0, 1.0)
    whitening_weights: RealArray = np.exp(-0.5 * log_noise_density) * np.sqrt(2.0 / sample_hz)
    whitening_weights *= 0.5 + 0.5 * np.cos(pi * fade_factors)
    return whitening_weights


# Information


@dataclass(frozen=True, slots=True, eq=False)
class RecordSoFar:
    """Whitened derivatives of a record's torque by the parameters, and the vibration after it.

    The record ends now. The vibration continues while the motor is held.
    """

    estimate: BeamEstimate
    """Estimate of the beam from which the information is computed."""
    past_gram_matrix: RealArray
    """Gram matrix of the derivatives by k parameters and of m nuisance terms, shape
    (k + m, k + m)."""
    future_derivatives: RealArray
    """Derivatives by the parameters, and nuisance terms, from now on if the motor is held, shape
    (k + m, samples)."""
    ringing_motion: RealArray
    """Torque in N·m and slope of the tip in rad from now on if the motor is held, shape
    (2, ticks)."""

    @classmethod
    def from_angle(
        cls, angle_rad: RealArray, estimate: BeamEstimate, rate_hz: float, future_s: float = 0.0
    ) -> "RecordSoFar":
        """Return a record's derivatives and continuing vibration, predicted from the motor's angle.

        The angle may be measured or predicted, from rest at the first tick. The continuing
        vibration is computed for `future_s` from now on.
        """
        ticks_per_point = ticks_per_sample(rate_hz)
        # Rest before it, so that a sample lies at its end.
        angle_rad = np.concatenate(
            [np.zeros(-angle_rad.size % ticks_per_point), angle_rad - angle_rad[0]]
        )
        future_samples = -(-round(future_s * rate_hz) // ticks_per_point)
        record_samples = angle_rad.size // ticks_per_point
        torque_model = TorqueModel.for_records(
            estimate, rate_hz, angle_rad.size + future_samples * ticks_per_point
        )
        spectrum = torque_model.spectrum(angle_rad)
        whitened_rows = np.concatenate(
            [
                torque_model.whitened_derivatives(spectrum)[:, : record_samples + future_samples],
                _nuisance_terms(estimate, record_samples + future_samples, torque_model.sample_hz),
            ]
        )
        ringing_motion = np.zeros((2, 0))
        if future_samples:
            next_tick = angle_rad.size
            ringing_motion = torque_model.torque_and_slope(spectrum)[
                :, next_tick : next_tick + future_samples * ticks_per_point
            ]
        recorded_rows = whitened_rows[:, :record_samples]
        return cls(
            estimate,
            recorded_rows @ recorded_rows.T,
            whitened_rows[:, record_samples:],
            ringing_motion,
        )

    @property
    def nuisance_projection(self) -> RealArray:
        """Matrix that projects the nuisance terms out of the derivatives, shape (k, k + m)."""
        parameter_count = len(self.estimate.free_parameters)
        return np.concatenate(
            [
                np.eye(parameter_count),
                -_regression_coefficients(self.past_gram_matrix, parameter_count),
            ],
            axis=1,
        )

    def information_after(
        self, added_derivatives: RealArray | None, sample_count: int
    ) -> RealArray:
        """Return the Fisher information on the parameters after further samples, shape (k, k).

        `added_derivatives` are the derivatives that a segment adds from now on, shape (k, n) with n
        at least `sample_count`; without them the motor is held.
        """
        whitened_rows = self.future_derivatives[:, :sample_count]
        if added_derivatives is not None:
            whitened_rows = whitened_rows.copy()
            whitened_rows[: added_derivatives.shape[0]] += added_derivatives[:, :sample_count]
        return projected_information(
            self.past_gram_matrix + whitened_rows @ whitened_rows.T,
            len(self.estimate.free_parameters),
        )


def information(angle_rad: RealArray, estimate: BeamEstimate, rate_hz: float) -> RealArray:
    """Return a record's Fisher information on the free parameters of the beam, shape (k, k).

    Free decay from before the record, and offset and drift of the torque, are unknown as well and
    reduce the information. The parameters are in the order of ``estimate.free_parameters``. For
    zeta, gamma, density over stiffness and stiffness, logarithms are used. The inverse of the
    information is the smallest covariance that an unbiased estimate can have.

    Parameters
    ----------
    angle_rad
        Motor angle, measured or predicted, shape (n,). The beam is at rest at the first tick.
    estimate
        Beam, damping, noise, and the free parameters.
    rate_hz
        Rate of the angle.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, Plant
    >>> from rigd.excitation import BeamEstimate, chirp, information
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> estimate = BeamEstimate(
    ...     plant=Plant(beam, Damping(zeta=7e-5, gamma=0.02)),
    ...     free_parameters=("zeta", "gamma", "density_over_stiffness"),
    ...     noise_frequency_hz=np.array([1.0]),
    ...     noise_nm2_per_hz=np.array([2e-7]),
    ... )
    >>> angle_rad = chirp(rate_hz=1000, start_hz=0.5, duration_s=5).reference_rad
    >>> std = np.sqrt(np.diag(np.linalg.inv(information(angle_rad, estimate, 1000))))
    >>> print(f"zeta {std[0]:.1%}, gamma {std[1]:.1%}")
    zeta 0.4%, gamma 1.4%
    """
    return RecordSoFar.from_angle(angle_rad, estimate, rate_hz).information_after(None, 0)


def projected_information(gram_matrix: RealArray, parameter_count: int) -> RealArray:
    """Return the Fisher information on the first k parameters if all others are unknown.

    `gram_matrix` is the Gram matrix of the derivatives for all parameters, shape (k + m, k + m).
    """
    information: RealArray = (
        gram_matrix[:parameter_count, :parameter_count]
        - _regression_coefficients(gram_matrix, parameter_count)
        @ gram_matrix[parameter_count:, :parameter_count]
    )
    return 0.5 * (information + information.T)


def _regression_coefficients(gram_matrix: RealArray, parameter_count: int) -> RealArray:
    """Return the coefficients of the regression of the first k derivatives on the m others.

    The shape is (k, m), and `gram_matrix` is the Gram matrix of all derivatives.
    """
    derivative_norms = np.sqrt(np.maximum(np.diag(gram_matrix)[parameter_count:], 1e-300))
    normalized_gram = gram_matrix[parameter_count:, parameter_count:] / np.outer(
        derivative_norms, derivative_norms
    ) + 1e-12 * np.eye(derivative_norms.size)
    coefficients: RealArray = (
        np.linalg.solve(
            normalized_gram,
            gram_matrix[parameter_count:, :parameter_count] / derivative_norms[:, None],
        ).T
        / derivative_norms
    )
    return coefficients


def covariance_of(fisher_information: RealArray, estimate: BeamEstimate) -> RealArray:
    """Return the parameters' covariance from a Fisher information and prior knowledge."""
    prior_stds = np.array(
        [_prior_std(parameter_name, estimate) for parameter_name in estimate.free_parameters]
    )
    # In units of the prior the matrix is well scaled wherever something is known.
    scaled_information = fisher_information * np.outer(prior_stds, prior_stds) + np.eye(
        len(prior_stds)
    )
    diagonal_square_roots = np.sqrt(np.diag(scaled_information))
    inverse_matrix: RealArray = np.linalg.inv(
        scaled_information / np.outer(diagonal_square_roots, diagonal_square_roots)
    )
    return inverse_matrix * np.outer(
        prior_stds / diagonal_square_roots, prior_stds / diagonal_square_roots
    )


def _prior_std(parameter_name: str, estimate: BeamEstimate) -> float:
    """Return the standard deviation that a parameter is assumed to have before any record."""
    beam = estimate.plant.beam
    constant_kind = parameter_name.rpartition("_")[0]
    if constant_kind == "background":
        return 10.0 * beam.bending_stiffness_n_m2 / beam.length_m
    if constant_kind in MODAL_CONSTANTS:
        return DEVIATION_STD_PER_UNIFORMITY.get(constant_kind, 1.0) * estimate.uniformity
    if parameter_name == "tool_inertia_kg_m2":
        return beam.inertia_kg_m2
    if parameter_name == "tip_mass_kg":
        return beam.density_kg_per_m * beam.length_m
    if parameter_name == "root_compliance_rad_per_nm":
        return beam.length_m / beam.bending_stiffness_n_m2
    return _PRIOR_STD_BY_PARAMETER[parameter_name]


def _nuisance_terms(estimate: BeamEstimate, sample_count: int, sample_hz: float) -> RealArray:
    """Return the nuisance terms of a record's torque: free decays, offset and drift.

    The shape is (m, samples).
    """
    time_s = np.arange(sample_count) / sample_hz
    mode_poles = np.array([beam_mode.at_rad_s for beam_mode in estimate.modes()])
    free_decays = np.exp(np.outer(mode_poles, time_s))
    decay_weights = _whitening_weights(estimate, mode_poles.imag / (2 * pi), sample_hz)[:, None]
    constant_weight = _whitening_weights(estimate, np.zeros(1), sample_hz)[0]
    offset_and_drift = np.stack([np.ones(sample_count), time_s]) * constant_weight
    return np.concatenate(
        [free_decays.real * decay_weights, free_decays.imag * decay_weights, offset_and_drift]
    )
