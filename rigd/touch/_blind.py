"""Any force at one point: the likelihood of the point for any behaviour of the obstacle.

The force is white noise of unknown size, on steps of half a sample. Torque and shear are then
Gaussian with a covariance that depends on the point, and the likeliest point is the one at which
both agree with the measurement. This works for obstacles that move, yield or come from outside as
well as for springs, with a larger uncertainty.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.touch._kernels import ContactKernels
from rigd.touch._physical import WhitenedWindow

Real = NDArray[np.float64]

_FORCE_STDS_N = np.array([0.1, 0.4, 1.6, 6.4])
"""Standard deviations of the force in N that are compared."""


@dataclass(frozen=True, slots=True)
class AnyForceLikelihood:
    """Likelihood of a touch by any force, at each position along the beam."""

    x_m: Real
    """Positions along the beam, shape (m,)."""
    log_likelihood: Real
    """Logarithm of the likelihood at each position, for the likeliest size of the force; shape
    (m,)."""
    chi2: float
    """Sum of squared whitened residuals at the likeliest position."""
    degrees: int
    """Expectation of this sum."""
    force_n: Real
    """Estimated force on the beam at the likeliest position, shape (2 · samples,)."""
    force_std_n: float
    """Standard deviation of the force that is likeliest at this position."""

    def interval(self, drop: float = 1.92) -> tuple[float, float, float, float]:
        """Return the likeliest position, its standard deviation and the ends of its interval, in m.

        Parameters
        ----------
        drop
            Difference of the log-likelihood between the likeliest position and the ends; 1.92 for
            an interval of 95 %.
        """
        fine = np.linspace(self.x_m[0], self.x_m[-1], 4000)
        log_likelihood = np.interp(fine, self.x_m, self.log_likelihood)
        best = int(np.argmax(self.log_likelihood))
        at = float(self.x_m[best])
        if 0 < best < self.x_m.size - 1:
            low, mid, high = self.log_likelihood[best - 1 : best + 2]
            curvature = low - 2 * mid + high
            if curvature < 0:
                spacing = self.x_m[1] - self.x_m[0]
                at += float(np.clip(0.5 * (low - high) / curvature, -1, 1) * spacing)
        likely_m = fine[log_likelihood >= log_likelihood.max() - drop]
        weights = np.exp(log_likelihood - log_likelihood.max())
        mean = np.sum(weights * fine) / np.sum(weights)
        std = float(np.sqrt(np.sum(weights * (fine - mean) ** 2) / np.sum(weights)))
        return at, std, min(float(likely_m[0]), at), max(float(likely_m[-1]), at)


class AnyForceEstimator:
    """Computation of the likelihood of a touch by any force, prepared for one length of records.

    Parameters
    ----------
    kernels
        Contact kernels with two time steps a sample.
    stride
        Number of the kernels' positions from one scanned position to the next.
    samples
        Largest number of samples.
    """

    __slots__ = ("_effects", "_x_m")

    def __init__(self, kernels: ContactKernels, stride: int, samples: int) -> None:
        self._x_m = kernels.x_m[::stride]
        lag = 2 * np.arange(samples)[:, None] - np.arange(2 * samples)
        self._effects = [
            np.where(lag >= 0, table[::stride][:, np.clip(lag, 0, table.shape[1] - 1)], 0.0)
            for table in (kernels.torque, kernels.shear)
        ]  # (positions, samples, forces)

    def scan(self, window: WhitenedWindow) -> AnyForceLikelihood:
        """Return the likelihood of a touch by any force at each position.

        Parameters
        ----------
        window
            Whitened innovations of at most the prepared number of samples.
        """
        count = window.end - window.first
        noise = window.motion.noise
        effects = np.concatenate(
            [
                each[:, :count, : 2 * count] / sigma
                for each, sigma in zip(self._effects, noise, strict=False)
            ],
            axis=1,
        )
        effects = window.whitening @ effects
        data = window.data
        n = data.size
        force_covariance = effects @ effects.transpose(0, 2, 1)
        corner = float(data @ data) + 1.0
        log_likelihoods = np.empty((_FORCE_STDS_N.size, self._x_m.size))
        quadratic = np.empty_like(log_likelihoods)
        bordered = np.empty((self._x_m.size, n + 1, n + 1))
        bordered[:, n, :n] = bordered[:, :n, n] = data
        bordered[:, n, n] = corner
        for i, std_index in enumerate(_FORCE_STDS_N):
            bordered[:, :n, :n] = std_index**2 * force_covariance + np.eye(n)
            factor = np.linalg.cholesky(bordered)
            diagonal = np.diagonal(factor, axis1=1, axis2=2)
            quadratic[i] = corner - diagonal[:, n] ** 2
            log_likelihoods[i] = -0.5 * quadratic[i] - np.log(diagonal[:, :n]).sum(axis=1)
        std_index, position = np.unravel_index(np.argmax(log_likelihoods), log_likelihoods.shape)
        variance = _FORCE_STDS_N[std_index] ** 2
        covariance = variance * force_covariance[position] + np.eye(n)
        force = variance * effects[position].T @ np.linalg.solve(covariance, data)
        return AnyForceLikelihood(
            x_m=self._x_m,
            log_likelihood=log_likelihoods.max(axis=0),
            chi2=float(quadratic[std_index, position]),
            degrees=n,
            force_n=force,
            force_std_n=float(_FORCE_STDS_N[std_index]),
        )
