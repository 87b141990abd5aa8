"""Likelihood of each touch position for an arbitrary contact force over time.

The force is assumed to be white noise of unknown variance, in time steps of half a sample. Torque
and shear are then Gaussian with a covariance that depends on the position, and the likeliest
position is the one whose covariance fits the measurement best. No model of the obstacle is needed,
so that the obstacle may move or yield. The position is less certain than with a model.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.touch._kernels import ContactKernels
from rigd.touch._obstacle_contact import WhitenedWindow

RealArray = NDArray[np.float64]

_FORCE_STDS_N = np.array([0.1, 0.4, 1.6, 6.4])
"""Standard deviations in N of the random force, of which the likeliest is chosen."""


@dataclass(frozen=True, slots=True)
class AnyForceLikelihood:
    """Likelihood of a touch at each position along the beam, for an arbitrary force over time."""

    x_m: RealArray
    """Positions along the beam, shape (m,)."""
    log_likelihood: RealArray
    """Logarithm of the likelihood at each position, for the likeliest standard deviation of the
    force; shape (m,)."""
    chi2: float
    """Sum of squared whitened residuals at the likeliest position."""
    expected_chi2: int
    """Expectation of `chi2`."""
    force_n: RealArray
    """Estimated force on the beam at the likeliest position over time, shape (2 · samples,)."""
    force_std_n: float
    """Likeliest standard deviation of the force at the likeliest position."""

    def position_interval_m(
        self, log_likelihood_drop: float = 1.92
    ) -> tuple[float, float, float, float]:
        """Return the likeliest position, its standard deviation and the ends of its interval, in m.

        At the ends the log-likelihood is lower by `log_likelihood_drop`; 1.92 gives 95 %.
        """
        fine_positions_m = np.linspace(self.x_m[0], self.x_m[-1], 4000)
        log_likelihood = np.interp(fine_positions_m, self.x_m, self.log_likelihood)
        best_index = int(np.argmax(self.log_likelihood))
        best_position_m = float(self.x_m[best_index])
        if 0 < best_index < self.x_m.size - 1:
            left_value, best_value, right_value = self.log_likelihood[
                best_index - 1 : best_index + 2
            ]
            curvature = left_value - 2 * best_value + right_value
            if curvature < 0:
                spacing_m = self.x_m[1] - self.x_m[0]
                best_position_m += float(
                    np.clip(0.5 * (left_value - right_value) / curvature, -1, 1) * spacing_m
                )
        likely_positions_m = fine_positions_m[
            log_likelihood >= log_likelihood.max() - log_likelihood_drop
        ]
        likelihood_weights = np.exp(log_likelihood - log_likelihood.max())
        mean_position_m = np.sum(likelihood_weights * fine_positions_m) / np.sum(likelihood_weights)
        position_std_m = float(
            np.sqrt(
                np.sum(likelihood_weights * (fine_positions_m - mean_position_m) ** 2)
                / np.sum(likelihood_weights)
            )
        )
        return (
            best_position_m,
            position_std_m,
            min(float(likely_positions_m[0]), best_position_m),
            max(float(likely_positions_m[-1]), best_position_m),
        )


class AnyForceEstimator:
    """Estimator of the touch position for an arbitrary force over time.

    The torque responses to an impulse (kernels) have two time steps per sample. Every
    `position_stride`-th of the positions on the beam for which there is a kernel is compared, in
    windows of at most `sample_count` samples.
    """

    __slots__ = ("_force_effects", "_x_m")

    def __init__(self, kernels: ContactKernels, position_stride: int, sample_count: int) -> None:
        self._x_m = kernels.x_m[::position_stride]
        lag_samples = 2 * np.arange(sample_count)[:, None] - np.arange(2 * sample_count)
        self._force_effects = [
            np.where(
                lag_samples >= 0,
                response_table[::position_stride][
                    :, np.clip(lag_samples, 0, response_table.shape[1] - 1)
                ],
                0.0,
            )
            for response_table in (kernels.torque_nm_per_n, kernels.shear_per_n)
        ]  # (positions, samples, forces)

    def scan(self, sample_window: WhitenedWindow) -> AnyForceLikelihood:
        """Return the likelihood of a touch at each position, for an arbitrary force over time.

        The window has at most `sample_count` samples.
        """
        sample_count = sample_window.end_sample - sample_window.first_sample
        noise_stds = sample_window.motion.noise_stds
        force_effects = np.concatenate(
            [
                channel_effects[:, :sample_count, : 2 * sample_count] / noise_std
                for channel_effects, noise_std in zip(self._force_effects, noise_stds, strict=False)
            ],
            axis=1,
        )
        force_effects = sample_window.whitening_matrix @ force_effects
        whitened_data = sample_window.whitened_innovations
        n = whitened_data.size
        force_covariance = force_effects @ force_effects.transpose(0, 2, 1)
        bordered_corner = float(whitened_data @ whitened_data) + 1.0
        log_likelihoods = np.empty((_FORCE_STDS_N.size, self._x_m.size))
        quadratic_forms = np.empty_like(log_likelihoods)
        bordered_matrices = np.empty((self._x_m.size, n + 1, n + 1))
        bordered_matrices[:, n, :n] = bordered_matrices[:, :n, n] = whitened_data
        bordered_matrices[:, n, n] = bordered_corner
        for i, force_std_n in enumerate(_FORCE_STDS_N):
            bordered_matrices[:, :n, :n] = force_std_n**2 * force_covariance + np.eye(n)
            cholesky_factors = np.linalg.cholesky(bordered_matrices)
            factor_diagonals = np.diagonal(cholesky_factors, axis1=1, axis2=2)
            quadratic_forms[i] = bordered_corner - factor_diagonals[:, n] ** 2
            log_likelihoods[i] = -0.5 * quadratic_forms[i] - np.log(factor_diagonals[:, :n]).sum(
                axis=1
            )
        std_index, position_index = np.unravel_index(
            np.argmax(log_likelihoods), log_likelihoods.shape
        )
        force_variance_n2 = _FORCE_STDS_N[std_index] ** 2
        data_covariance = force_variance_n2 * force_covariance[position_index] + np.eye(n)
        force_n = (
            force_variance_n2
            * force_effects[position_index].T
            @ np.linalg.solve(data_covariance, whitened_data)
        )
        return AnyForceLikelihood(
            x_m=self._x_m,
            log_likelihood=log_likelihoods.max(axis=0),
            chi2=float(quadratic_forms[std_index, position_index]),
            expected_chi2=n,
            force_n=force_n,
            force_std_n=float(_FORCE_STDS_N[std_index]),
        )
